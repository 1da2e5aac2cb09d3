"""Clock partitioning: the variables and equations of each clock.

Takes: `FlatSystem`. Gives: `partition`, a `ClockedSystem` of `ClockedPeerType`s with a `Partition` per clock;
`check_single`, for one component.
Guarantees: each variable is continuous or belongs to one clock, and so does each equation, or an error names
the missing crossing; each crossing has its clock.
Does not: solve or sort anything.

The method is Modelica's clock partitioning (Modelica Language Specification 3.6, section 16.7): variables of
one equation are merged into sets, whose clock is determined by samples, holds, `der` and the clock of a part.

Event order. Periods, phases and delays are exact rationals of a second. At an instant t:

1. continuous variables are sampled: their value at t⁻, before steps 2 to 4;
2. network clocks tick: each sender's packet contains the sample at t, and packets with an arrival time ≤ t
   are delivered;
3. force clocks tick: forces are computed from the samples at t and the newest delivered values;
4. holds switch: a force computed at t acts from t + its delay (0 means t⁺) until the next force acts;
5. links with `order: after` send, instead of in step 2: no tick at t receives such a packet.

For a link's delay T_d, a packet sent at t is available from t + T_d on, including a tick at exactly t + T_d.
Before the first packet arrives, a receiver uses the sender's start values; before the first force acts, the
force is zero.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from apc.compiler.components.component import Component
from apc.compiler.disjoint_sets import DisjointSets
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
from apc.compiler.language.unit_text import format_dimension
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
    """A peer type, partitioned by clock.

    `partitions` begins with the continuous partition. `samples`, `holds`, `previous` and `receives` are the
    conversions between partitions, and between peers.
    """

    flat: FlatPeerType
    partitions: tuple[Partition, ...]
    samples: tuple[SampleCrossing, ...]
    holds: tuple[HoldCrossing, ...]
    previous: tuple[PreviousCrossing, ...]
    receives: tuple[ReceiveCrossing, ...]


@dataclass(frozen=True, slots=True)
class ClockedSystem:
    """The topology with the partitioned peer types."""

    topology: Topology
    peer_types: tuple[ClockedPeerType, ...]


def partition(flat: FlatSystem) -> ClockedSystem:
    """Return the peer types with the clock of every variable and equation.

    Raises ApcError with all missing crossings between clocks.
    """
    mistakes = Mistakes(flat.topology.names)
    peer_types = tuple(_partitioned(peer_type, mistakes) for peer_type in flat.peer_types)
    mistakes.raise_if_any()
    return ClockedSystem(flat.topology, peer_types)


def check_single(component: Component, location: SourceLocation, mistakes: Mistakes) -> None:
    """Record errors of a component's clocks that are independent of a topology."""
    flat = flatten_single(component, location, mistakes)
    if mistakes:
        return
    clocks = _Clocks(flat, mistakes)
    for name, connector in component.connectors:
        for potential, flow in zip(connector.potentials, connector.flows, strict=True):
            text, other = (f"{component.name}.{name}.{variables.name}" for variables in (potential, flow))
            if clocks.known_clock(text) == CONTINUOUS != clocks.of(other) and other in clocks.given:
                clocks.report_flow(other, clocks.given[other])


def _partitioned(peer_type: FlatPeerType, mistakes: Mistakes) -> ClockedPeerType:
    """Return a peer type with the partition of each clock, and the clock of each crossing."""
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
            holding = [one for one in peer_type.equations if one.location == hold.location]
            # Parts of one component have equations at the same location.
            texts = (_local(hold.shown, equation) for equation in holding)
            held = next((text for text in texts if text != hold.shown), hold.shown)
            if (given := clocks.given.get(hold.shown)) and (fix := _sampled_text(given)):
                message = f"hold({held}): {held} must be sampled at a clock"
                mistakes.add("E505", given.location, message, fix=fix)
            elif clocks.is_undetermined(hold.variable):
                message = f"hold({held}): {held} belongs to no clock"
                advice = f"an equation that determines {held} must sample a continuous variable"
                mistakes.add("E505", hold.location, message, advice=advice)
            else:
                message = f"hold({held}): {held} is already continuous"
                fix = next((_unheld_text(equation, held) for equation in holding), "")
                mistakes.add("E505", hold.location, message, fix=fix)
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
                message = f"{send.name} is sent at ticks of {send.link}, but {variable} is on clock {clock}"
                shown = variable.removeprefix(f"{send.name.rpartition('.')[0]}.")
                mistakes.add("E505", send.location, message, fix=f"sample(hold({shown}))")
    members: dict[str, tuple[list[str], list[FlatEquation]]] = {CONTINUOUS: ([], [])}
    for index, equation in enumerate(peer_type.equations):
        members.setdefault(clocks.of(f"equation {index}"), ([], []))[1].append(equation)
    for variable in clocks.variables:
        members.setdefault(clocks.of(variable), ([], []))[0].append(variable)
    partitions = tuple(
        Partition(clock, tuple(variables), tuple(equations))
        for clock, (variables, equations) in members.items()
    )
    return ClockedPeerType(peer_type, partitions, samples, holds, previous, receives)


# Operators whose arguments need no further sample.
CROSSING = ("sample", "hold", "previous", "mean", "sum", "max", "min")


def _leaves(equation: FlatEquation) -> Iterator[Name]:
    """Yield the names on both sides of an equation."""
    for side in (equation.left, equation.right):
        yield from names(side)


def _sampled_text(equation: FlatEquation) -> str:
    """Return the text of a part's equation with its connectors' variables sampled; empty if there is none."""
    written = equation.written
    if written is None or equation.clock is None:
        return ""

    def sample(node: Expr) -> Expr | None:
        """Return the sample of a variable of a connector or its derivative, or None if a node remains."""
        if isinstance(node, Call) and node.function in CROSSING:
            return node
        variable = node.arguments[0] if isinstance(node, Call) and node.function == "der" else node
        return Call("sample", (node,)) if isinstance(variable, Name) and len(variable.parts) > 1 else None

    right = transform(written.right, sample)
    unchanged = right is written.right
    return "" if unchanged else f"{format_expression(written.left)} = {format_expression(right)}"


def _local(text: str, equation: FlatEquation) -> str:
    """Return a text with the names of a part as in its component: `contact.a.f` as `a.f`."""
    return re.sub(rf"(?<![\w.])(others\.)?{re.escape(equation.origin)}\.", r"\1", text)


def _converted_text(equation: FlatEquation, name: str, operator: str) -> str:
    """Return the text of a part's equation with `operator`, sample or hold, applied to a name or call.

    The result is empty if there is none.
    """
    written = equation.written
    if written is None:
        return ""

    def converted(node: Expr) -> Expr | None:
        """Return the conversion of the name or call, or None if a node remains."""
        return Call(operator, (node,)) if format_expression(node) == name else None

    right = transform(written.right, converted)
    unchanged = right is written.right
    return "" if unchanged else f"{format_expression(written.left)} = {format_expression(right)}"


def _unheld_text(equation: FlatEquation, held: str) -> str:
    """Return the text of a part's equation without the hold of `held`; empty if there is none."""
    written = equation.written
    if written is None:
        return ""

    def argument(node: Expr) -> Expr | None:
        """Return the argument of the hold, or None if a node remains."""
        if isinstance(node, Call) and node.function == "hold":
            return node.arguments[0] if format_expression(node.arguments[0]) == held else None
        return None

    right = transform(written.right, argument)
    unchanged = right is written.right
    return "" if unchanged else f"{format_expression(written.left)} = {format_expression(right)}"


class _Clocks:
    """The clock of each variable and equation of a peer type, by sets of names with a common clock.

    The name of a clock is a member of its set. `given` are the parts' equations, by the name on the left
    side; `variables` has each variable, and whether it has a start value.
    """

    def __init__(self, peer_type: FlatPeerType, mistakes: Mistakes) -> None:
        """Merge the names of each equation, and record errors for parts without a clock."""
        self.mistakes = mistakes
        self.variables = {variable.name: variable.start for variable in peer_type.variables}
        self._dimensions = {variable.name: variable.dimension for variable in peer_type.variables}
        self.given: dict[str, FlatEquation] = {}
        self._crossings = {crossing.symbol: crossing for crossing in peer_type.crossings}
        self._sets = DisjointSets()
        sample_clocks = (
            crossing.clock for crossing in peer_type.crossings if isinstance(crossing, SampleCrossing)
        )
        clock_names = {
            CONTINUOUS,
            *sample_clocks,
            *(equation.clock for equation in peer_type.equations if equation.clock is not None),
        }
        self._clocks = {
            clock: clock for clock in clock_names
        }  # the clock of each set that has one, by the root of the set
        self._counts = [  # the number of variables in each equation
            len({format_expression(leaf) for leaf in _leaves(equation)} & self.variables.keys())
            for equation in peer_type.equations
        ]
        self._reported: set[str] = set()  # parts whose clocked flow was reported
        receiving: dict[str, FlatEquation] = {}
        for index, equation in enumerate(peer_type.equations):
            if isinstance(equation.left, Name) and equation.origin != CONNECTION:
                self.given.setdefault(format_expression(equation.left), equation)
            for side in (equation.left, equation.right):
                self._visit(side, f"equation {index}", equation, receiving)
        for name, equation in receiving.items():
            if self.of(name) == CONTINUOUS:
                message = f"{equation.origin} receives from other peers but has no clock parameter"
                mistakes.add("E504", equation.location, message, advice="add clock: clock to its parameters")

    def of(self, name: str) -> str:
        """Return the clock of a variable or equation; continuous if no clock is determined."""
        return self.known_clock(name) or CONTINUOUS

    def known_clock(self, name: str) -> str:
        """Return the clock of a name, empty if no clock is determined."""
        return self._clocks.get(self._root(name), "")

    def is_undetermined(self, name: str) -> bool:
        """Return whether a variable has no clock, and depends on no constant: each equation of the variables
        that it depends on has at least two of them.
        """
        if self.known_clock(name):
            return False
        counts = [
            count
            for index, count in enumerate(self._counts)
            if self._root(f"equation {index}") == self._root(name)
        ]
        return min(counts, default=0) > 1

    def check_start(self, name: str, location: SourceLocation) -> None:
        """Record the error E507 for `initial(x)` or `previous(x)` of a variable x without a start value."""
        call, _, variable = name[:-1].partition("(")
        if call in ("initial", "previous") and not self.variables.get(variable, True):
            unit = format_dimension(self._dimensions[variable])
            fix = f"{variable.rpartition('.')[2]}: {{unit: {unit}, start: 0}}"
            self.mistakes.add("E507", location, f"{name} needs a start value of {variable}", fix=fix)

    def _root(self, name: str) -> str:
        """Return the representative name of the set of a name."""
        return next(iter(self._sets[name]))

    def _visit(
        self, expression: Expr, domain: str, equation: FlatEquation, receiving: dict[str, FlatEquation]
    ) -> None:
        """Merge the names in an expression with its domain.

        Parameters
        ----------
        expression, domain
            The expression, and its domain: the name of the equation, or of the argument of a sample.
        equation
            The equation that contains the expression.
        receiving
            By domain, the equations of parts without a clock that receive values of other peers; added to.
        """
        for node in walk(expression):
            if isinstance(node, Call) and node.function == "der":
                self._merge(domain, CONTINUOUS, format_expression(node), equation)
            if not isinstance(node, Name):
                continue
            name = ".".join(node.parts)
            self.check_start(name, equation.location)
            crossing = self._crossings.get(name)
            if name in self.variables:
                self._merge(domain, name, name, equation)
            if isinstance(crossing, PreviousCrossing | ReceiveCrossing) and equation.clock is not None:
                self._merge(domain, equation.clock, name, equation)
            match crossing:
                case SampleCrossing():
                    self._merge(domain, crossing.clock, name, equation)
                    inside = f"inside {name} of {equation.origin}"
                    self._merge(inside, CONTINUOUS, name, equation)
                    self._visit(crossing.expression, inside, equation, receiving)
                case HoldCrossing():
                    self._merge(domain, CONTINUOUS, name, equation)
                case PreviousCrossing():
                    self._merge(domain, crossing.variable, crossing.variable, equation)
                case ReceiveCrossing():
                    self._visit(crossing.argument, domain, equation, receiving)
                    self._merge(domain, name, name, equation)
                    if equation.clock is None:
                        receiving.setdefault(domain, equation)

    def _merge(self, domain: str, name: str, shown: str, equation: FlatEquation) -> None:
        """Merge the sets of a domain and of a name; record an error if they have different clocks.

        `shown` is the name as in `equation`, for the message.
        """
        domain_clock, name_clock = self.known_clock(domain), self.known_clock(name)
        if domain_clock and name_clock and domain_clock != name_clock:
            self._report(shown, name_clock, domain_clock, equation)
        else:
            self._sets.merge(domain, name)
            self._clocks[self._root(name)] = domain_clock or name_clock

    def _report(self, name: str, clock: str, other_clock: str, equation: FlatEquation) -> None:
        """Record the error E505: a name and the other names of its equation are on different clocks.

        The location is the part's equation in which a sample or hold is missing. `clock` is that of the name,
        `other_clock` that of the other names.
        """
        if equation.origin == CONNECTION and other_clock == CONTINUOUS and name in self.given:
            self.report_flow(name, self.given[name])
            return
        if equation.origin == CONNECTION:  # of the unsampled names in a part's equation
            sides = {format_expression(side) for side in (equation.left, equation.right)}
            candidates = [
                given for given in self.given.values() if sides & set(map(format_expression, _leaves(given)))
            ]
        else:
            candidates = [equation] if clock == CONTINUOUS else []
        for other in candidates if CONTINUOUS in (clock, other_clock) else ():
            if fix := _sampled_text(other):
                message = (
                    f"this equation of {other.origin} is on clock {other.clock}, so continuous values need "
                    "sample()"
                )
                self.mistakes.add("E505", other.location, message, fix=fix)
                return
        fix, advice = f"sample(hold({name}))", "use one clock for both"
        if CONTINUOUS in (clock, other_clock):
            advice = ""
            operator = "sample" if clock == CONTINUOUS else "hold"
            local = _local(name, equation)
            fix = _converted_text(equation, local, operator) or f"{operator}({local})"
        words = [CONTINUOUS if text == CONTINUOUS else f"on clock {text}" for text in (clock, other_clock)]
        message = f"{name} is {words[0]}, but the other terms of `{equation.text}` are {words[1]}"
        if equation.written is not None:
            shown = f"{_local(name, equation)} of {equation.origin}"
            message = f"{shown} is {words[0]}, but the equation is {words[1]}"
        self.mistakes.add("E505", equation.location, message, fix=fix, advice=advice)

    def report_flow(self, name: str, given: FlatEquation) -> None:
        """Record the error E505 for a part's clocked flow, once per part, with a hold as the fix."""
        if given.origin not in self._reported and given.written is not None:
            self._reported.add(given.origin)
            left, right = format_expression(given.written.left), format_expression(given.written.right)
            message = f"{name} is continuous, but its value is on clock {self.of(name)}"
            self.mistakes.add("E505", given.location, message, fix=f"{left} = hold({right})")
