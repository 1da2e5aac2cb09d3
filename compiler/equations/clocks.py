"""Clock partitioning: the variables and equations of each clock.

Takes: `FlatSystem`. Gives: `partition`, a `ClockedSystem` of `ClockedPeerType`s with a `Partition` per clock;
`check_single`, for one component.
Guarantees: each variable is continuous or belongs to one clock, and so does each equation, or an error names
the missing crossing; each crossing has its clock.
Does not: solve or sort anything.

Modelica's clock partitioning (Modelica Language Specification 3.6, section 16.7) does the same: variables of
one equation are merged into sets, which samples, holds, `der` and a part's clock pin down.

Event order. Periods, phases and delays are exact rationals of a second. At an instant t:

1. continuous variables are sampled: their value at t⁻, before anything below happens;
2. network clocks tick: each sender's packet takes the sample at t, and packets with an arrival time ≤ t are
   delivered;
3. force clocks tick: forces are computed from the samples at t and the newest delivered values;
4. holds switch: a force computed at t acts from t + its delay (0 means t⁺) until the next one acts.

A link's delay T_d means: sent at t, available from t + T_d on; a tick at exactly t + T_d sees it. Before the
first packet arrives a receiver holds the sender's start values; before the first force acts it is zero.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from scipy.cluster.hierarchy import DisjointSet

from apc.compiler.components.component import Component
from apc.compiler.equations.flatten import (
    CONNECTION,
    FlatEquation,
    FlatPeerType,
    FlatSystem,
    HoldCrossing,
    PreviousCrossing,
    ReceiveCrossing,
    SampleCrossing,
    flatten_single,
)
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.expression import Call, Expr, Name, format_expression, names, transform, walk
from apc.compiler.topology.topology import Topology

CONTINUOUS = "continuous"


@dataclass(frozen=True, slots=True)
class Partition:
    """The equations and variables of one clock, or the continuous ones."""

    clock: str
    variables: tuple[str, ...]
    equations: tuple[FlatEquation, ...]


@dataclass(frozen=True, slots=True)
class ClockedPeerType:
    """A peer type, partitioned. `partitions` starts with the continuous one."""

    flat: FlatPeerType
    partitions: tuple[Partition, ...]
    samples: tuple[SampleCrossing, ...]
    holds: tuple[HoldCrossing, ...]
    previous: tuple[PreviousCrossing, ...]
    receives: tuple[ReceiveCrossing, ...]


@dataclass(frozen=True, slots=True)
class ClockedSystem:
    """The topology, partitioned."""

    topology: Topology
    peer_types: tuple[ClockedPeerType, ...]


def partition(flat: FlatSystem) -> ClockedSystem:
    """Give every variable its clock. Raises ApcError with every crossing that isn't said."""
    mistakes = Mistakes(flat.topology.names)
    peer_types = tuple(_partitioned(peer_type, mistakes) for peer_type in flat.peer_types)
    mistakes.raise_if_any()
    return ClockedSystem(flat.topology, peer_types)


def check_single(component: Component, location: SourceLocation, mistakes: Mistakes) -> None:
    """Record errors of a component's clocks that occur in every topology."""
    flat = flatten_single(component, location, mistakes)
    if mistakes:
        return
    clocks = _Clocks(flat, mistakes)
    for name, connector in component.connectors:
        for potential, flow in zip(connector.potentials, connector.flows, strict=True):
            text, other = (f"{component.name}.{name}.{variables.name}" for variables in (potential, flow))
            if clocks.pinned(text) == CONTINUOUS != clocks.of(other) and other in clocks.given:
                clocks.report_flow(other, clocks.given[other])


def _partitioned(peer_type: FlatPeerType, mistakes: Mistakes) -> ClockedPeerType:
    clocks = _Clocks(peer_type, mistakes)
    crossings = [
        crossing
        if isinstance(crossing, SampleCrossing)
        else replace(crossing, clock=clocks.of(getattr(crossing, "variable", crossing.symbol)))
        for crossing in peer_type.crossings
    ]
    samples = tuple(crossing for crossing in crossings if isinstance(crossing, SampleCrossing))
    holds = tuple(crossing for crossing in crossings if isinstance(crossing, HoldCrossing))
    previous = tuple(crossing for crossing in crossings if isinstance(crossing, PreviousCrossing))
    receives = tuple(crossing for crossing in crossings if isinstance(crossing, ReceiveCrossing))
    for hold in holds:
        if hold.clock == CONTINUOUS:
            call = format_expression(Call("hold", (Name((hold.shown,)), hold.delay)))
            message = f"{call} holds {hold.shown}, which is continuous already"
            if (given := clocks.given.get(hold.shown)) and (hint := _sampled(given)):
                message = f"{call} acts from a tick on, so that {hold.shown} samples what moves"
                mistakes.add("E505", given.location, message, hint=hint)
            else:
                mistakes.add("E505", hold.location, message, hint=hold.shown)
    for previous_crossing in previous:
        if previous_crossing.clock == CONTINUOUS:
            mistakes.add(
                "E505",
                previous_crossing.location,
                previous_crossing.symbol,
                expected="a variable that belongs to a clock",
            )
    for send in peer_type.sends:
        for variable in map(format_expression, names(send.expression)):
            clocks.check_start(variable, send.location)
            if variable in clocks.variables and (clock := clocks.of(variable)) != CONTINUOUS:
                message = f"{send.name} is sent at ticks of {send.link}, and {variable} is on clock {clock}"
                shown = variable.removeprefix(f"{send.name.rpartition('.')[0]}.")
                mistakes.add("E505", send.location, message, hint=f"sample(hold({shown}))")
    members: dict[str, tuple[list[str], list[FlatEquation]]] = {CONTINUOUS: ([], [])}
    for index, equation in enumerate(peer_type.equations):
        members.setdefault(clocks.of(f"equation {index}"), ([], []))[1].append(equation)
    for variable in clocks.variables:
        members.setdefault(clocks.of(variable), ([], []))[0].append(variable)
    partitions = tuple(
        Partition(clock, tuple(variables), tuple(of)) for clock, (variables, of) in members.items()
    )
    return ClockedPeerType(peer_type, partitions, samples, holds, previous, receives)


# Operators beneath which nothing is sampled once more.
CROSSING = ("sample", "hold", "previous", "mean", "sum", "max", "min")


def _leaves(equation: FlatEquation) -> Iterator[Name]:
    """Yield the names in an equation."""
    for side in (equation.left, equation.right):
        yield from names(side)


def _sampled(equation: FlatEquation) -> str:
    """Return a part's equation with all that is continuous at its connectors sampled, "" where nothing is."""
    written = equation.written
    if written is None or equation.clock is None:
        return ""

    def sample(node: Expr) -> Expr | None:
        if isinstance(node, Call) and node.function in CROSSING:
            return node
        of = node.arguments[0] if isinstance(node, Call) and node.function == "der" else node
        return Call("sample", (node,)) if isinstance(of, Name) and len(of.parts) > 1 else None

    right = transform(written.right, sample)
    same = right is written.right
    return "" if same else f"{format_expression(written.left)} = {format_expression(right)}"


class _Clocks:
    """The clock of each variable and equation of a peer type, by sets of names with a common clock.

    A clock is a member of its set, by its own name. `given` are the parts' equations, by the name on their
    left side; `variables` are those with a start value.
    """

    def __init__(self, peer_type: FlatPeerType, mistakes: Mistakes) -> None:
        self.mistakes = mistakes
        self.variables = {variable.name: variable.start for variable in peer_type.variables}
        self.given: dict[str, FlatEquation] = {}
        self._crossings = {crossing.symbol: crossing for crossing in peer_type.crossings}
        self._sets = DisjointSet()
        crossed = (crossing.clock for crossing in peer_type.crossings if isinstance(crossing, SampleCrossing))
        named = {
            CONTINUOUS,
            *crossed,
            *(equation.clock for equation in peer_type.equations if equation.clock is not None),
        }
        self._clocks = {clock: clock for clock in named}  # of each set that has one, by its root
        self._reported: set[str] = set()  # parts whose clocked flow was reported
        receiving: dict[str, FlatEquation] = {}
        for index, equation in enumerate(peer_type.equations):
            if isinstance(equation.left, Name) and equation.origin != CONNECTION:
                self.given.setdefault(format_expression(equation.left), equation)
            for side in (equation.left, equation.right):
                self._visit(side, f"equation {index}", equation, receiving)
        for name, equation in receiving.items():
            if self.of(name) == CONTINUOUS:
                message = f"{equation.origin} hears the other peers but has no parameter that names one clock"
                mistakes.add("E504", equation.location, message, hint="parameters: {clock: clock}")

    def of(self, name: str) -> str:
        """Return the clock of a variable or equation; continuous where nothing asks for a clock."""
        return self.pinned(name) or CONTINUOUS

    def pinned(self, name: str) -> str:
        """Return the clock that something asks for, empty if nothing does."""
        return self._clocks.get(self._root(name), "")

    def check_start(self, name: str, location: SourceLocation) -> None:
        """Record the error E507 if a name such as `initial(x)` or `previous(x)` has no start value."""
        call, _, variable = name[:-1].partition("(")
        if call in ("initial", "previous") and not self.variables.get(variable, True):
            hint = f"variables: {{{variable.rpartition('.')[2]}: {{unit: …, start: 0}}}}"
            self.mistakes.add("E507", location, f"{name} needs a start value of {variable}", hint=hint)

    def _root(self, name: str) -> str:
        self._sets.add(name)
        return str(self._sets[name])

    def _visit(
        self, expression: Expr, domain: str, equation: FlatEquation, receiving: dict[str, FlatEquation]
    ) -> None:
        """Merge the names in an expression with its domain: its equation, or the argument of a sample."""
        for node in walk(expression):
            if isinstance(node, Call) and node.function == "der":
                self._join(domain, CONTINUOUS, format_expression(node), equation)
            if not isinstance(node, Name):
                continue
            name = ".".join(node.parts)
            self.check_start(name, equation.location)
            crossing = self._crossings.get(name)
            if name in self.variables:
                self._join(domain, name, name, equation)
            if isinstance(crossing, PreviousCrossing | ReceiveCrossing) and equation.clock is not None:
                self._join(domain, equation.clock, name, equation)
            match crossing:
                case SampleCrossing():
                    self._join(domain, crossing.clock, name, equation)
                    inside = f"inside {name} of {equation.origin}"
                    self._join(inside, CONTINUOUS, name, equation)
                    self._visit(crossing.expression, inside, equation, receiving)
                case HoldCrossing():
                    self._join(domain, CONTINUOUS, name, equation)
                case PreviousCrossing():
                    self._join(domain, crossing.variable, crossing.variable, equation)
                case ReceiveCrossing():
                    self._visit(crossing.argument, domain, equation, receiving)
                    self._join(domain, name, name, equation)
                    if equation.clock is None:
                        receiving.setdefault(domain, equation)

    def _join(self, domain: str, name: str, shown: str, equation: FlatEquation) -> None:
        """Merge the sets of a domain and of a name in it, unless they have different clocks."""
        clock, other = self.pinned(domain), self.pinned(name)
        if clock and other and clock != other:
            self._report(shown, other, clock, equation)
        elif self._sets.merge(self._root(domain), self._root(name)) and (clock or other):
            self._clocks[self._root(name)] = clock or other

    def _report(self, name: str, clock: str, others: str, equation: FlatEquation) -> None:
        if equation.origin == CONNECTION and others == CONTINUOUS and name in self.given:
            self.report_flow(name, self.given[name])
            return
        if equation.origin == CONNECTION:  # of the unsampled names in a part's equation
            sides = {format_expression(side) for side in (equation.left, equation.right)}
            taking = [
                equation
                for equation in self.given.values()
                if sides & set(map(format_expression, _leaves(equation)))
            ]
        else:
            taking = [equation] if clock == CONTINUOUS else []
        for other in taking if CONTINUOUS in (clock, others) else ():
            if hint := _sampled(other):
                message = (
                    f"`{other.text}` of {other.origin} is on clock {other.clock}, and samples what moves"
                )
                self.mistakes.add("E505", other.location, message, hint=hint)
                return
        hint = f"one clock for both, or sample(hold({name}))"
        if CONTINUOUS in (clock, others):
            hint = f"sample({name})" if clock == CONTINUOUS else f"hold({name})"
        words = [CONTINUOUS if text == CONTINUOUS else f"on clock {text}" for text in (clock, others)]
        message = (
            f"in `{equation.text}` of {equation.origin}, {name} is {words[0]} and the rest is {words[1]}"
        )
        self.mistakes.add("E505", equation.location, message, hint=hint)

    def report_flow(self, name: str, given: FlatEquation) -> None:
        """Report a part's clocked flow at its equation, with a hold as the fix."""
        if given.origin not in self._reported and given.written is not None:
            self._reported.add(given.origin)
            left, right = format_expression(given.written.left), format_expression(given.written.right)
            message = f"{name} acts on what it is joined to at all times, and is on clock {self.of(name)}"
            self.mistakes.add("E505", given.location, message, hint=f"{left} = hold({right})")
