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

from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.errors import Mistakes
from apc.compiler.expression import (
    Call,
    Expr,
    Name,
    Number,
    children,
    format_expression,
    names,
    transform,
    walk,
)
from apc.compiler.flatten import OTHERS, FlatEquation, FlatKind, FlatSend, FlatSystem
from apc.compiler.scene import Scene

CONTINUOUS = "continuous"
REDUCTIONS = ("mean", "sum")


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
    """`symbol` stands, at a tick, for the mean or sum of what the other peers sent under the name `send`."""

    symbol: str
    operator: str
    send: str
    link: str
    clock: str


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
    mistakes = Mistakes()
    kinds = tuple(_Partitioner(kind, mistakes).run() for kind in flat.kinds)
    mistakes.raise_if_any()
    return ClockedSystem(flat.scene, kinds)


class _Partitioner:
    """One kind's clock inference: variables and equations that must tick together are merged into sets."""

    def __init__(self, kind: FlatKind, mistakes: Mistakes) -> None:
        self.kind = kind
        self.mistakes = mistakes
        self.variables = {variable.name: None for variable in kind.variables}  # a dict keeps their order
        self.parents: dict[str, str] = {}
        self.clock_of_set: dict[str, str] = {}
        self.extra: list[FlatEquation] = []
        self.samples: dict[str, SampleCrossing] = {}
        self.holds: dict[str, HoldCrossing] = {}
        self.previous: dict[str, PreviousCrossing] = {}
        self.receives: dict[str, ReceiveCrossing] = {}
        self.links = {send.name: send.link for send in kind.sends}

    def run(self) -> ClockedKind:
        equations = [self._lift_holds(equation) for equation in self.kind.equations]
        equations += self.extra
        for index, equation in enumerate(equations):
            for side in (equation.left, equation.right):
                self._visit(side, f"equation {index}", equation)
        sends = tuple(self._sent(send) for send in self.kind.sends)
        if self.mistakes:
            return ClockedKind(self.kind, (), (), (), (), (), ())
        by_clock: dict[str, list[FlatEquation]] = {CONTINUOUS: []}
        for index, equation in enumerate(equations):
            clock = self._clock(f"equation {index}")
            by_clock.setdefault(clock, []).append(self._crossed(equation, clock))
        members: dict[str, list[str]] = {clock: [] for clock in by_clock}
        for name in self.variables:
            members.setdefault(self._clock(name), []).append(name)
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

    # ---- sets of names that tick together ----

    def _find(self, name: str) -> str:
        root = name
        while (parent := self.parents.get(root, root)) != root:
            root = parent
        while (parent := self.parents.get(name, name)) != root:
            self.parents[name] = root
            name = parent
        return root

    def _clock(self, name: str) -> str:
        return self.clock_of_set.get(self._find(name), CONTINUOUS)

    def _join(self, one: str, two: str, equation: FlatEquation) -> None:
        a, b = self._find(one), self._find(two)
        if a == b:
            return
        clock_a, clock_b = self.clock_of_set.get(a), self.clock_of_set.get(b)
        if clock_a is not None and clock_b is not None and clock_a != clock_b:
            self._report(two, clock_b, clock_a, equation)
            return
        self.parents[b] = a
        if clock_b is not None:
            self.clock_of_set[a] = clock_b

    def _pin(self, name: str, clock: str, because: str, equation: FlatEquation) -> None:
        root = self._find(name)
        known = self.clock_of_set.setdefault(root, clock)
        if known != clock:
            self._report(because, clock, known, equation)

    def _report(self, name: str, its: str, others: str, equation: FlatEquation) -> None:
        if its == CONTINUOUS:
            hint = f"sample({name})"
        elif others == CONTINUOUS:
            hint = f"hold({name})"
        else:
            hint = f"one clock for both, or sample(hold({name}))"
        self.mistakes.add(
            "E505",
            equation.place,
            f"in `{equation.text}` of {equation.origin}, "
            f"{name} is {_domain(its)} and the rest is {_domain(others)}",
            hint=hint,
        )

    # ---- one pass that finds the clocks ----

    def _visit(self, expression: Expr, domain: str, equation: FlatEquation) -> None:
        if isinstance(expression, Name):
            name = ".".join(expression.parts)
            if name in self.variables:
                self._join(domain, name, equation)
        elif isinstance(expression, Call):
            self._visit_call(expression, domain, equation)
        else:
            for child in children(expression):
                self._visit(child, domain, equation)

    def _visit_call(self, call: Call, domain: str, equation: FlatEquation) -> None:
        text = format_expression(call)
        if call.function == "sample":
            assert isinstance(call.arguments[1], Name)
            self._pin(domain, call.arguments[1].parts[0], text, equation)
            inner = f"inside {text} of {equation.origin}"
            self._pin(inner, CONTINUOUS, text, equation)
            self._visit(call.arguments[0], inner, equation)
        elif call.function == "hold":
            self._pin(domain, CONTINUOUS, text, equation)  # its variable was pinned by its own equation
        elif call.function == "der":
            self._pin(domain, CONTINUOUS, text, equation)
            self._visit(call.arguments[0], domain, equation)
        elif call.function in REDUCTIONS and OTHERS in {part.parts[0] for part in names(call)}:
            if equation.clock is None:
                what = f"{equation.origin} hears the other peers but has no parameter that names one clock"
                self.mistakes.add("E504", equation.place, what, hint="parameters: {clock: clock}")
            else:
                self._pin(domain, equation.clock, text, equation)
        else:
            if call.function == "previous" and equation.clock is not None:
                self._pin(domain, equation.clock, text, equation)
            for argument in call.arguments:
                self._visit(argument, domain, equation)

    # ---- crossings ----

    def _lift_holds(self, equation: FlatEquation) -> FlatEquation:
        """Give an expression that is held a clocked variable of its own."""

        def replace(node: Expr) -> Expr | None:
            if not (isinstance(node, Call) and node.function == "hold"):
                return None
            delay = node.arguments[1] if len(node.arguments) == 2 else Number(Fraction(0))
            argument = node.arguments[0]
            if isinstance(argument, Name) and ".".join(argument.parts) in self.variables:
                return Call("hold", (argument, delay))
            name = Name((equation.origin, f"held{len(self.extra) + 1}"))
            self.variables[".".join(name.parts)] = None
            self.extra.append(FlatEquation(name, argument, equation.origin, equation.clock, equation.place))
            return Call("hold", (name, delay))

        left, right = transform(equation.left, replace), transform(equation.right, replace)
        return FlatEquation(left, right, equation.origin, equation.clock, equation.place)

    def _crossed(self, equation: FlatEquation, clock: str) -> FlatEquation:
        """Return the equation with a symbol in the place of each crossing."""

        def replace(node: Expr) -> Expr | None:
            return self._crossing(node, clock, equation) if isinstance(node, Call) else None

        left, right = transform(equation.left, replace), transform(equation.right, replace)
        return FlatEquation(left, right, equation.origin, equation.clock, equation.place)

    def _crossing(self, call: Call, clock: str, equation: FlatEquation) -> Expr | None:
        symbol = format_expression(call)
        if call.function == "sample":
            self.samples.setdefault(symbol, SampleCrossing(symbol, clock, call.arguments[0]))
            return Name((symbol,))
        if call.function == "hold":
            variable = format_expression(call.arguments[0])
            source = self._clock(variable)
            if source == CONTINUOUS:
                what = f"{symbol} of {equation.origin} holds {variable}, which is continuous already"
                self.mistakes.add("E505", equation.place, what, hint=variable)
            self.holds.setdefault(symbol, HoldCrossing(symbol, variable, source, call.arguments[1]))
            return Name((symbol,))
        if call.function == "previous":
            variable = format_expression(call.arguments[0])
            if variable not in self.variables or clock == CONTINUOUS:
                what = f"{symbol} of {equation.origin}"
                self.mistakes.add("E505", equation.place, what, expected="a variable that belongs to a clock")
            self.previous.setdefault(symbol, PreviousCrossing(symbol, variable, clock))
            return Name((symbol,))
        if call.function in REDUCTIONS:
            return self._receive(call, symbol, clock, equation)
        return None

    def _receive(self, call: Call, symbol: str, clock: str, equation: FlatEquation) -> Expr | None:
        argument = call.arguments[0]
        heard = isinstance(argument, Name) and argument.parts[0] == OTHERS
        if not (heard and isinstance(argument, Name)):
            what = f"{symbol} of {equation.origin}"
            expected = "one value that the others send, such as others.x"
            self.mistakes.add("E506", equation.place, what, expected=expected)
            return None
        send = ".".join(argument.parts[1:])
        self.receives.setdefault(
            symbol, ReceiveCrossing(symbol, call.function, send, self.links[send], clock)
        )
        return Name((symbol,))

    def _sent(self, send: FlatSend) -> FlatSend:
        """Return the send with its samples taken off: it is evaluated at the link's tick as a whole."""

        def replace(node: Expr) -> Expr | None:
            is_sample = isinstance(node, Call) and node.function == "sample"
            return node.arguments[0] if isinstance(node, Call) and is_sample else None

        for node in walk(send.expression):
            if isinstance(node, Name) and self._clock(".".join(node.parts)) != CONTINUOUS:
                name = ".".join(node.parts)
                what = (
                    f"{send.name} is sent at ticks of {send.link}, and {name} is {_domain(self._clock(name))}"
                )
                self.mistakes.add("E505", send.place, what, hint=f"sample(hold({name}))")
        return FlatSend(send.name, send.link, transform(send.expression, replace), send.dimension, send.place)


def _domain(clock: str) -> str:
    return "continuous" if clock == CONTINUOUS else f"on clock {clock}"
