"""Equations partitioned by clock, the crossings between partitions named.

Takes: `FlatSystem`. Gives: `ClockedSystem`.
Guarantees: each variable is continuous or belongs to one clock; a value crosses between partitions only
through a named crossing (sample, hold, previous, receive, send).
Does not: solve or sort anything.

Time, written once. Periods, phases and delays are exact rationals of a second. At an instant t:

1. continuous variables are sampled: their value at t⁻, before anything below happens;
2. network clocks tick: each sender's packet takes the sample at t, and packets with an arrival time ≤ t are
   delivered;
3. force clocks tick: forces are computed from the samples at t and the newest delivered values;
4. holds switch: a force computed at t acts from t + its delay (0 means t⁺) until the next one acts.

A link's delay T_d means: sent at t, available from t + T_d on; a tick at exactly t + T_d sees it. Before the
first packet arrives a receiver holds the sender's start values; before the first force acts it is zero.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.compiled import count_of
from apc.compiler.components.component import OTHERS, Component
from apc.compiler.equations.clock_inference import CONTINUOUS, ClockInference, domain
from apc.compiler.equations.flatten import (
    FlatEquation,
    FlatKind,
    FlatSend,
    FlatSystem,
    flatten_alone,
    is_made,
)
from apc.compiler.equations.reductions import Of, affine_in_others, hears_others, of_others
from apc.compiler.errors import Mistakes, Place
from apc.compiler.language.expression import (
    Binary,
    Call,
    Expr,
    Name,
    Number,
    format_expression,
    names,
    transform,
)
from apc.compiler.scene.scene import Scene

HEARD_AGE = f"{OTHERS}.age"  # in what a reduction runs over; no send has this name, as a part's stands before


def check_alone(component: Component, place: Place, mistakes: Mistakes) -> None:
    """Record what a component by itself says of clocks that no scene can mend."""
    flat = flatten_alone(component, place, mistakes)
    if mistakes:
        return
    clocks = ClockInference({variable.name for variable in flat.variables}, mistakes)
    for index, equation in enumerate(flat.equations):
        clocks.visit(f"equation {index}", equation)
    clocks.finish()
    for name, connector in component.connectors:
        for potential, flow in zip(connector.potentials, connector.flows, strict=True):
            whole = f"{component.name}.{name}"
            clocks.joined(f"{whole}.{potential.name}", f"{whole}.{flow.name}")


@dataclass(frozen=True, slots=True)
class SampleCrossing:
    """`symbol` stands in a clocked equation for a continuous expression, taken at t⁻ of the clock's tick."""

    symbol: str
    clock: str
    expression: Expr


@dataclass(frozen=True, slots=True)
class HoldCrossing:
    """`symbol` stands in a continuous equation for a clocked variable, held from its tick + `delay` on."""

    symbol: str
    variable: str
    clock: str
    delay: Expr


@dataclass(frozen=True, slots=True)
class PreviousCrossing:
    """`symbol` stands for a clocked variable's value at the previous tick of its clock."""

    symbol: str
    variable: str
    clock: str


@dataclass(frozen=True, slots=True)
class ReceiveCrossing:
    """`symbol` stands, at a tick, for a reduction over the other peers that are heard over `link`.

    Without an `edge` it is of what they sent, as `of` says; with one, of the value that `edge` has for each
    of them, in which the names `others.…` are that peer's, and `HEARD_AGE` is the age of its packet.
    """

    symbol: str
    operator: str
    of: Of
    link: str
    clock: str
    edge: Expr | None = None


@dataclass(frozen=True, slots=True)
class Partition:
    """The equations and variables of one clock, or the continuous ones."""

    clock: str
    variables: tuple[str, ...]
    equations: tuple[FlatEquation, ...]


@dataclass(frozen=True, slots=True)
class ClockedKind:
    """A kind of peer, partitioned. `partitions` starts with the continuous one."""

    flat: FlatKind
    partitions: tuple[Partition, ...]
    samples: tuple[SampleCrossing, ...]
    holds: tuple[HoldCrossing, ...]
    previous: tuple[PreviousCrossing, ...]
    receives: tuple[ReceiveCrossing, ...]
    sends: tuple[FlatSend, ...]


@dataclass(frozen=True, slots=True)
class ClockedSystem:
    """The scene, partitioned."""

    scene: Scene
    kinds: tuple[ClockedKind, ...]


def partition(flat: FlatSystem) -> ClockedSystem:
    """Give every variable its clock. Raises ApcError with every crossing that isn't said."""
    mistakes = Mistakes(flat.scene.names)
    kinds = tuple(_Partitioner(kind, mistakes).run() for kind in flat.kinds)
    mistakes.raise_if_any()
    return ClockedSystem(flat.scene, kinds)


class _Partitioner:
    """One kind: clocks are inferred, then crossings are named."""

    def __init__(self, kind: FlatKind, mistakes: Mistakes) -> None:
        self.kind = kind
        self.mistakes = mistakes
        self.variables = {variable.name: None for variable in kind.variables}  # a dict keeps their order
        self.starts = {variable.name for variable in kind.variables if variable.start}
        self.clocks = ClockInference(self.variables, mistakes)
        self.samples: dict[str, SampleCrossing] = {}
        self.holds: dict[str, HoldCrossing] = {}
        self.previous: dict[str, PreviousCrossing] = {}
        self.receives: dict[str, ReceiveCrossing] = {}
        self.named = {  # what the made variables are
            format_expression(one.left): format_expression(one.right)
            for one in kind.equations
            if isinstance(one.left, Name) and is_made(one.left.parts[-1])
        }
        self.links = {send.name: send.link for send in kind.sends}

    def run(self) -> ClockedKind:
        equations = self.kind.equations
        for index, equation in enumerate(equations):
            self.clocks.visit(f"equation {index}", equation)
        self.clocks.finish()
        sends = tuple(self._sent(send) for send in self.kind.sends)
        if self.mistakes:
            return ClockedKind(self.kind, (), (), (), (), (), ())
        by_clock: dict[str, list[FlatEquation]] = {CONTINUOUS: []}
        for index, equation in enumerate(equations):
            clock = self.clocks.of(f"equation {index}")
            by_clock.setdefault(clock, []).append(self._crossed(equation, clock))
        members: dict[str, list[str]] = {clock: [] for clock in by_clock}
        for name in self.variables:
            members.setdefault(self.clocks.of(name), []).append(name)
        partitions = tuple(
            Partition(clock, tuple(members[clock]), tuple(by_clock.get(clock, ()))) for clock in members
        )
        return ClockedKind(
            self.kind,
            partitions,
            tuple(self.samples.values()),
            tuple(self.holds.values()),
            tuple(self.previous.values()),
            tuple(self.receives.values()),
            sends,
        )

    # ---- crossings ----

    def _crossed(self, equation: FlatEquation, clock: str) -> FlatEquation:
        """Return the equation with a symbol in the place of each crossing."""
        return replace(
            equation,
            left=self._cross(equation.left, clock, equation),
            right=self._cross(equation.right, clock, equation),
        )

    def _cross(self, expression: Expr, clock: str, where: FlatEquation | FlatSend) -> Expr:
        def replacement(node: Expr) -> Expr | None:
            return self._crossing(node, clock, where) if isinstance(node, Call) else None

        return transform(expression, replacement)

    def _crossing(self, call: Call, clock: str, where: FlatEquation | FlatSend) -> Expr | None:
        symbol = format_expression(call)
        if call.function == "sample":
            inside = self._cross(call.arguments[0], CONTINUOUS, where)
            self.samples.setdefault(symbol, SampleCrossing(symbol, clock, inside))
            return Name((symbol,))
        if call.function == "hold":
            delay = call.arguments[1] if len(call.arguments) == 2 else Number(Fraction(0))
            symbol = format_expression(Call("hold", (call.arguments[0], delay)))
            variable = format_expression(call.arguments[0])
            source = self.clocks.of(variable)
            if source == CONTINUOUS:
                shown = self.named.get(variable, variable)
                told = format_expression(Call("hold", (Name((shown,)), delay)))
                what = f"{told} holds {shown}, which is continuous already"
                self.mistakes.add("E505", where.place, what, hint=shown)
            self.holds.setdefault(symbol, HoldCrossing(symbol, variable, source, delay))
            return Name((symbol,))
        if of_others(call):
            return Name((HEARD_AGE,)) if call.function == "age" else self._no_edge(call, where)
        if call.function == "previous":
            return self._previous(call, symbol, clock, where)
        if call.function == "initial":
            self._check_start(call, symbol, where)
            return Name((symbol,))
        if hears_others(call):
            return self._receive(call, symbol, clock, where)
        return None

    def _previous(self, call: Call, symbol: str, clock: str, where: FlatEquation | FlatSend) -> Expr:
        variable = format_expression(call.arguments[0])
        if variable not in self.variables or clock == CONTINUOUS:
            expected = "a variable that belongs to a clock"
            self.mistakes.add("E505", where.place, symbol, expected=expected)
        else:
            self._check_start(call, symbol, where)
            self.previous.setdefault(symbol, PreviousCrossing(symbol, variable, clock))
        return Name((symbol,))

    def _check_start(self, call: Call, symbol: str, where: FlatEquation | FlatSend) -> None:
        variable = format_expression(call.arguments[0])
        if variable not in self.starts:
            what = f"{symbol} needs a start value of {variable}"
            hint = f"variables: {{{variable.rpartition('.')[2]}: {{unit: …, start: 0}}}}"
            self.mistakes.add("E507", where.place, what, hint=hint)

    # ---- what is heard of the others ----

    def _receive(self, call: Call, symbol: str, clock: str, where: FlatEquation | FlatSend) -> Expr:
        """Take a linear reduction apart, so that N peers cost N; leave another one whole, pair by pair."""
        argument = call.arguments[0]
        if call.function == "count":
            part = next(name.parts[1:] for name in names(call) if name.parts[0] == OTHERS)
            return self._count(part, where)
        sent = [".".join(n.parts[1:]) for n in names(argument) if n.parts[0] == OTHERS]
        links = {self.links.get(send) for send in sent}
        if None in links or len(links) != 1:
            what = f"{symbol} reads something that nobody sends, or over two links"
            expected = "one value that the others send, such as others.x"
            self.mistakes.add("E506", where.place, what, expected=expected)
            return Name((symbol,))
        linear = affine_in_others(argument) if call.function in ("mean", "sum") else None
        if linear is None:
            only = isinstance(argument, Name)  # max or min
            edge = None if only else self._cross(argument, clock, where)
            link = self.links[sent[0]]
            of_ages = edge is not None and all(
                name.parts[0] != OTHERS for name in names(edge) if name.parts != (HEARD_AGE,)
            )
            return self._reduced(call.function, argument, Of(sent[0]), link, clock, edge, counted=of_ages)
        constant, terms = linear
        total: Expr | None = None
        if constant is not None:
            own = self._cross(constant, clock, where)
            count = Name((count_of(self.links[sent[0]]),))
            total = own if call.function == "mean" else Binary("*", count, own)
        for of, coefficient in terms.items():
            link = self.links[of.send]
            term = self._reduced(call.function, of.expression, of, link, clock, counted=not of.value)
            if coefficient is not None:
                term = Binary("*", self._cross(coefficient, clock, where), term)
            total = term if total is None else Binary("+", total, term)
        assert total is not None
        return total

    def _reduced(
        self,
        operator: str,
        argument: Expr,
        of: Of,
        link: str,
        clock: str,
        edge: Expr | None = None,
        *,
        counted: bool,
    ) -> Expr:
        """Return the symbol of a reduction; with `counted` a sum is a mean as often as any are heard."""
        many = counted and operator == "sum"
        operator = "mean" if many else operator
        name = format_expression(Call(operator, (argument,)))
        self.receives.setdefault(name, ReceiveCrossing(name, operator, of, link, clock, edge))
        return Binary("*", Name((count_of(link),)), Name((name,))) if many else Name((name,))

    def _no_edge(self, call: Call, where: FlatEquation | FlatSend) -> Expr:
        """Refuse what was heard before where each sender is looked at by itself."""
        heard = next(names(call)).parts[-1]
        what = f"previous(others.{heard})"
        hint = f"mean(previous(others.{heard})), or sum"
        expected = "a mean or sum that is linear in it"
        self.mistakes.add("E506", where.place, what, expected=expected, hint=hint)
        return Number(Fraction(0))

    def _count(self, part: tuple[str, ...], where: FlatEquation | FlatSend) -> Expr:
        """Return how many of the others are heard, each counted with its weight: a parameter of the site."""
        own = [send for send in self.kind.sends if send.name.rpartition(".")[0] == ".".join(part)]
        if not own:
            what = "count(others) counts those that are heard, and this component sends nothing"
            self.mistakes.add("E506", where.place, what, hint="sends: {x: sample(object.x)}")
            return Number(Fraction(0))
        return Name((count_of(own[0].link),))

    def _sent(self, send: FlatSend) -> FlatSend:
        """Return the send with its samples taken off: it is evaluated at the link's tick as a whole."""

        def bare(node: Expr) -> Expr | None:
            if isinstance(node, Call) and node.function == "sample":
                return transform(node.arguments[0], bare)
            return None

        expression = transform(send.expression, bare)
        for name in names(_without_holds(expression)):
            whole = ".".join(name.parts)
            if whole in self.variables and self.clocks.of(whole) != CONTINUOUS:
                its = domain(self.clocks.of(whole))
                what = f"{send.name} is sent at ticks of {send.link}, and {whole} is {its}"
                own = whole.removeprefix(f"{send.name.rpartition('.')[0]}.")
                self.mistakes.add("E505", send.place, what, hint=f"sample(hold({own}))")
        return replace(send, expression=self._cross(expression, CONTINUOUS, send))


def _without_holds(expression: Expr) -> Expr:
    def drop(node: Expr) -> Expr | None:
        return Number(Fraction(0)) if isinstance(node, Call) and node.function == "hold" else None

    return transform(expression, drop)
