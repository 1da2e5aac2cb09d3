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

from apc.compiler.component import OTHERS
from apc.compiler.errors import Mistakes
from apc.compiler.expression import (
    Binary,
    Call,
    Expr,
    Name,
    Negate,
    Number,
    children,
    format_expression,
    names,
    transform,
)
from apc.compiler.flatten import FlatEquation, FlatKind, FlatSend, FlatSystem
from apc.compiler.scene import Scene

CONTINUOUS = "continuous"
REDUCTIONS = ("mean", "sum", "max", "min", "count")


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

    Without an `edge` it is of what they sent under the name `send`; with one, of the value that `edge` has
    for each of them, in which the names `others.…` are that peer's.
    """

    symbol: str
    operator: str
    send: str
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
        self.starts = {variable.name for variable in kind.variables if variable.start}
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
        lifted = [
            replace(send, expression=self._lift_hold(send.expression, send)) for send in self.kind.sends
        ]
        equations += self.extra
        for index, equation in enumerate(equations):
            for side in (equation.left, equation.right):
                self._visit(side, f"equation {index}", equation)
        sends = tuple(self._sent(send) for send in lifted)
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

    def _visit(self, expression: Expr, domain: str, equation: FlatEquation, *, heard: bool = False) -> None:
        """Join what ticks together; `heard` is inside a reduction, where alone `others` can be named."""
        if isinstance(expression, Name):
            name = ".".join(expression.parts)
            if name in self.variables:
                self._join(domain, name, equation)
            elif expression.parts[0] == OTHERS and not heard:
                shown = f"others.{expression.parts[-1]}"
                what = f"{shown} of {equation.origin} is a value of each other peer, and one is due here"
                self.mistakes.add("E506", equation.place, what, hint=f"mean({shown}), or sum, max, min")
        elif isinstance(expression, Call):
            self._visit_call(expression, domain, equation, heard)
        else:
            for child in children(expression):
                self._visit(child, domain, equation, heard=heard)

    def _visit_call(self, call: Call, domain: str, equation: FlatEquation, heard: bool) -> None:
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
        elif _hears(call):
            for argument in call.arguments:
                self._visit(argument, domain, equation, heard=True)
            if equation.clock is None:
                what = f"{equation.origin} hears the other peers but has no parameter that names one clock"
                self.mistakes.add("E504", equation.place, what, hint="parameters: {clock: clock}")
            else:
                self._pin(domain, equation.clock, text, equation)
        else:
            if call.function == "previous" and equation.clock is not None:
                self._pin(domain, equation.clock, text, equation)
            for argument in call.arguments:
                self._visit(argument, domain, equation, heard=heard)

    # ---- crossings ----

    def _lift_holds(self, equation: FlatEquation) -> FlatEquation:
        return replace(
            equation,
            left=self._lift_hold(equation.left, equation),
            right=self._lift_hold(equation.right, equation),
        )

    def _lift_hold(self, expression: Expr, where: FlatEquation | FlatSend) -> Expr:
        """Give an expression that is held a clocked variable of its own."""
        origin = where.origin if isinstance(where, FlatEquation) else where.name.rpartition(".")[0]
        clock = where.clock if isinstance(where, FlatEquation) else None

        def replacement(node: Expr) -> Expr | None:
            if not (isinstance(node, Call) and node.function == "hold"):
                return None
            delay = node.arguments[1] if len(node.arguments) == 2 else Number(Fraction(0))
            argument = node.arguments[0]
            if isinstance(argument, Name) and ".".join(argument.parts) in self.variables:
                return Call("hold", (argument, delay))
            name = Name((*origin.split("."), f"held{len(self.extra) + 1}"))
            self.variables[".".join(name.parts)] = None
            self.extra.append(FlatEquation(name, argument, origin, clock, where.place))
            return Call("hold", (name, delay))

        return transform(expression, replacement)

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
            variable = format_expression(call.arguments[0])
            source = self._clock(variable)
            if source == CONTINUOUS:
                what = f"{symbol} holds {variable}, which is continuous already"
                self.mistakes.add("E505", where.place, what, hint=variable)
            self.holds.setdefault(symbol, HoldCrossing(symbol, variable, source, call.arguments[1]))
            return Name((symbol,))
        if call.function == "previous":
            return self._previous(call, symbol, clock, where)
        if call.function == "initial":
            self._check_start(call, symbol, where)
            return Name((symbol,))
        if _hears(call):
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
            only = isinstance(argument, Name)
            edge = None if only else self._cross(argument, clock, where)
            link = self.links[sent[0]]
            self.receives.setdefault(
                symbol, ReceiveCrossing(symbol, call.function, sent[0], link, clock, edge)
            )
            return Name((symbol,))
        constant, terms = linear
        total: Expr | None = None
        if constant is not None:
            own = self._cross(constant, clock, where)
            count = Name((count_of(self.links[sent[0]]),))
            total = own if call.function == "mean" else Binary("*", count, own)
        for send, coefficient in terms.items():
            heard = Call(call.function, (Name((OTHERS, *send.split("."))),))
            name = format_expression(heard)
            link = self.links[send]
            self.receives.setdefault(name, ReceiveCrossing(name, call.function, send, link, clock))
            term: Expr = Name((name,))
            if coefficient is not None:
                term = Binary("*", self._cross(coefficient, clock, where), term)
            total = term if total is None else Binary("+", total, term)
        assert total is not None
        return total

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
            if whole in self.variables and self._clock(whole) != CONTINUOUS:
                its = _domain(self._clock(whole))
                what = f"{send.name} is sent at ticks of {send.link}, and {whole} is {its}"
                self.mistakes.add("E505", send.place, what, hint=f"sample(hold({whole}))")
        return replace(send, expression=self._cross(expression, CONTINUOUS, send))


def count_of(link: str) -> str:
    """Return the name of the parameter that counts, with their weights, the peers heard over a link."""
    return f"count({link})"


def _hears(call: Call) -> bool:
    """Return whether a call reduces the other peers to one value; max(a, b) is of two values, and doesn't."""
    return (
        call.function in REDUCTIONS
        and len(call.arguments) == 1
        and any(name.parts[0] == OTHERS for name in names(call))
    )


def _without_holds(expression: Expr) -> Expr:
    def drop(node: Expr) -> Expr | None:
        return Number(Fraction(0)) if isinstance(node, Call) and node.function == "hold" else None

    return transform(expression, drop)


Affine = tuple[Expr | None, dict[str, Expr | None]]  # constant and coefficients; None: 0, and 1


def affine_in_others(expression: Expr) -> Affine | None:
    """Return an expression as c₀ + Σ cₖ·others.k, or None when it is not of that form.

    c₀ is None for 0, cₖ None for 1; k is the name of what is sent.
    """
    if not any(name.parts[0] == OTHERS for name in names(expression)):
        return expression, {}
    match expression:
        case Name(parts=parts):
            return None, {".".join(parts[1:]): None}
        case Negate(operand=operand):
            inside = affine_in_others(operand)
            return None if inside is None else _scaled(inside, Number(Fraction(-1)), "*")
        case Binary(operator="+" | "-" as operator, left=left, right=right):
            one, two = affine_in_others(left), affine_in_others(right)
            if one is None or two is None:
                return None
            return _added(one, two if operator == "+" else _scaled(two, Number(Fraction(-1)), "*"))
        case Binary(operator="*" | "/" as operator, left=left, right=right):
            one, two = affine_in_others(left), affine_in_others(right)
            if one is None or two is None:
                return None
            if not two[1]:
                return _scaled(one, right, operator)
            return _scaled(two, left, "*") if operator == "*" and not one[1] else None
    return None


def _scaled(affine: Affine, factor: Expr, operator: str) -> Affine:
    def scaled(expression: Expr | None) -> Expr:
        if expression is None:
            return factor if operator == "*" else Binary("/", Number(Fraction(1)), factor)
        return Binary(operator, expression, factor)

    constant, terms = affine
    return (None if constant is None else scaled(constant)), {name: scaled(c) for name, c in terms.items()}


def _added(one: Affine, two: Affine) -> Affine:
    def added(a: Expr | None, b: Expr | None, nothing: Expr) -> Expr:
        return Binary("+", a or nothing, b or nothing)

    unit = Number(Fraction(1))
    constant = one[0] if two[0] is None else two[0] if one[0] is None else Binary("+", one[0], two[0])
    terms = dict(one[1])
    for name, coefficient in two[1].items():
        terms[name] = added(terms[name], coefficient, unit) if name in terms else coefficient
    return constant, terms


def _domain(clock: str) -> str:
    return "continuous" if clock == CONTINUOUS else f"on clock {clock}"
