"""Explicit equations to CasADi functions, and the exchange between sites as structure.

Takes: `SortedSystem`. Gives: `CompiledSystem`.
Guarantees: a kind's functions hold only what its states, its samples and what it sends depend on; what the
scene named but nothing reads is listed in `dropped`.
Does not: write files, or put numbers in the place of parameters.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction
from typing import Any

import casadi
import sympy

from apc.compiler.clocks import HoldCrossing
from apc.compiler.compiled import (
    PEERS,
    Clock,
    ClockPartition,
    CompiledSystem,
    Group,
    Hold,
    Kind,
    Link,
    Origin,
    Parameter,
    Receive,
    SendPartition,
    State,
    Timing,
)
from apc.compiler.errors import Mistakes, Place
from apc.compiler.expression import Expr, Name, Number, evaluate, format_expression
from apc.compiler.library import Number as NumberParameter
from apc.compiler.scene import Part, Scene, Value
from apc.compiler.structure import SortedKind, SortedSystem
from apc.compiler.symbolic import derivative_symbol, symbol
from apc.compiler.units import format_dimension

NO_DELAY = "no delay"
_CASADI: dict[str, Callable[..., Any]] = {
    "min": casadi.fmin,
    "max": casadi.fmax,
    "abs": casadi.fabs,
    "sign": casadi.sign,
    "floor": casadi.floor,
    "exp": casadi.exp,
    "log": casadi.log,
    "sin": casadi.sin,
    "cos": casadi.cos,
    "tanh": casadi.tanh,
    "if": casadi.if_else,
    "and": casadi.logic_and,
    "or": casadi.logic_or,
    "not": casadi.logic_not,
    "less": casadi.SX.__lt__,
    "less_or_equal": casadi.SX.__le__,
    "more": casadi.SX.__gt__,
    "more_or_equal": casadi.SX.__ge__,
    "equal": casadi.SX.__eq__,
    "unequal": casadi.SX.__ne__,
}


def build_functions(system: SortedSystem, origin: Origin) -> CompiledSystem:
    """Write every kind as CasADi functions. Raises ApcError if a setting can't vary as asked."""
    scene = system.scene
    mistakes = Mistakes()
    timings = _Timings(scene)
    kinds = []
    dropped: list[tuple[str, str]] = []
    for kind in system.kinds:
        builder = _KindBuilder(kind, timings)
        kinds.append(builder.build())
        dropped += builder.dropped
    used_links = {receive.link for kind in kinds for clock in kind.clocks for receive in clock.receives}
    links = []
    for part in scene.parts:
        if part.section == "links":
            if part.name in used_links:
                links.append(_link(part, timings))
            else:
                dropped.append((part.name, "nobody hears what it would carry"))
    used_clocks = {link.clock for link in links} | {clock.clock for kind in kinds for clock in kind.clocks}
    clocks = []
    for clock in scene.clocks:
        if clock.name in used_clocks:
            names = (f"{clock.name}.period", f"{clock.name}.phase")
            clocks.append(
                Clock(
                    clock.name,
                    timings.use(*_timed(names[0], clock.period)),
                    timings.use(*_timed(names[1], clock.phase)),
                )
            )
        else:
            dropped.append((clock.name, "nothing ticks with it"))
    _check_common(scene, timings, mistakes)
    mistakes.raise_if_any()
    groups = tuple(
        Group(group.name, group.count, _kind_of(system, group.name), _settings(scene, group.values))
        for group in scene.groups
    )
    return CompiledSystem(
        scene.name,
        scene.about,
        tuple(clocks),
        tuple(links),
        timings.found,
        _parameters(scene, kinds),
        tuple(kinds),
        groups,
        tuple(dict.fromkeys(dropped)),
        origin,
    )


def _timed(name: str, value: Value) -> tuple[str, Fraction, str | None]:
    return name, value.number, value.expression


def _kind_of(system: SortedSystem, group: str) -> int:
    return next(i for i, kind in enumerate(system.kinds) if group in kind.clocked.flat.groups)


def _link(part: Part, timings: _Timings) -> Link:
    values = dict(part.values)
    clock = part.reference("clock")
    assert clock is not None
    name = f"{part.name}.delay"
    return Link(part.name, clock, timings.use(*_timed(name, values["delay"])), dict(part.options)["graph"])


class _Timings:
    """The periods, phases and delays that the model refers to, each once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._found: dict[str, Timing] = {}

    @property
    def found(self) -> tuple[Timing, ...]:
        """All timings in use, in the order of first use."""
        return tuple(self._found.values())

    def use(self, name: str, value: Fraction, expression: str | None) -> str:
        """Register a timing and return its name."""
        self._found.setdefault(name, Timing(name, value, expression))
        return name

    def delay(self, hold: HoldCrossing) -> str:
        """Register the delay of a hold: a constant, or a parameter of a part."""
        expression = hold.delay
        if isinstance(expression, Number) and expression.value == 0:
            return self.use(NO_DELAY, Fraction(0), None)
        if isinstance(expression, Name):
            part, name = expression.parts
            value = dict(self.scene.part(part).values)[name]
            return self.use(f"{part}.{name}", value.number, value.expression)
        return self.use(f"{hold.variable} delay", self._evaluate(expression), format_expression(expression))

    def _evaluate(self, expression: Expr) -> Fraction:
        def number(parts: tuple[str, ...]) -> Fraction:
            if parts == (PEERS,):
                return Fraction(self.scene.peers)
            return dict(self.scene.part(parts[0]).values)[parts[1]].number

        return Fraction(evaluate(expression, number, place=Place(self.scene.name)))


def _check_common(scene: Scene, timings: _Timings, mistakes: Mistakes) -> None:
    names = {timing.name for timing in timings.found}
    for group in scene.groups:
        for name, value in group.values:
            if name in names:
                what = f"{name} is the same for all peers: a group can't set it"
                mistakes.add(
                    "E211",
                    value.place,
                    what,
                    hint=f"{name.partition('.')[2]}: … where {name.partition('.')[0]} is described",
                )


def _settings(scene: Scene, values: Iterable[tuple[str, Value]]) -> tuple[Parameter, ...]:
    return tuple(_parameter(scene, name, value) for name, value in values)


def _parameter(scene: Scene, name: str, value: Value) -> Parameter:
    unit = format_dimension(value.dimension)
    number = float(value.number)
    part, _, own = name.partition(".")
    if own:
        component = scene.part(part).component
        declared = component.parameter(own)
        if isinstance(declared, NumberParameter):
            return Parameter(
                name,
                unit,
                number,
                value.expression,
                None if declared.minimum is None else float(declared.minimum),
                declared.open_minimum,
                None if declared.maximum is None else float(declared.maximum),
                declared.about,
            )
        variable = component.variable(own)
        assert variable is not None
        return Parameter(name, unit, number, value.expression, about=f"start value: {variable.about}")
    return Parameter(name, unit, number, value.expression)


def _parameters(scene: Scene, kinds: Sequence[Kind]) -> tuple[Parameter, ...]:
    """Return every parameter of the scene: named ones, then each part's, then the start values of states."""
    found = {name: _parameter(scene, name, value) for name, value in scene.parameters}
    starts = {state.start: state for kind in kinds for state in kind.states}
    for part in scene.parts:
        for own, value in part.values:
            name = f"{part.name}.{own}"
            found[name] = _parameter(scene, name, value)
        given = dict(part.starts)
        for variable in part.component.variables:
            name = f"{part.name}.{variable.name}"
            if name in starts and variable.start is not None:
                default = Value(variable.start, variable.unit.dimension, None, part.place)
                found[name] = _parameter(scene, name, given.get(variable.name, default))
    found[PEERS] = Parameter(PEERS, "1", float(scene.peers), about="number of peers")
    return tuple(found.values())


class _KindBuilder:
    """One kind's functions: first what is needed is found, then it is written."""

    def __init__(self, kind: SortedKind, timings: _Timings) -> None:
        self.kind = kind
        self.timings = timings
        self.dropped: list[tuple[str, str]] = []
        self.continuous = {symbol(name): expression for name, expression in kind.partitions[0].assignments}
        self.clocked = {
            symbol(name): expression for part in kind.partitions[1:] for name, expression in part.assignments
        }
        self.samples = {symbol(name): expression for name, _, expression in kind.samples}
        self.known_holds = {symbol(hold.symbol): hold for hold in kind.holds}
        self.known_previous = {symbol(previous.symbol): previous for previous in kind.previous}
        self.known_receives = {symbol(receive.symbol): receive for receive in kind.receives}
        self.sends = {send.name: send for send in kind.sends}

    def build(self) -> Kind:
        reached = self._reach()
        holds = [hold for s, hold in self.known_holds.items() if s in reached]
        self.dropped += [
            (hold.variable, "nobody reads this force")
            for s, hold in self.known_holds.items()
            if s not in reached
        ]
        receives = {s: receive for s, receive in self.known_receives.items() if s in reached}
        outputs = self._outputs(holds, reached)
        channels = self._channels(receives.values())
        states = self.kind.states
        self.dropped += [(name, "nobody hears it") for name in self.sends if name not in channels]
        x = {symbol(name): casadi.SX.sym(name) for name in states}
        u = {symbol(hold.symbol): casadi.SX.sym(hold.symbol) for hold in holds}
        parameters = self._parameters(reached, x, u)
        p = {s: casadi.SX.sym(s.name) for s in parameters}
        time = casadi.SX.sym("time")
        writer = _Writer({**x, **u, **p, symbol("time"): time}, {**self.continuous, **self.samples})
        inputs = {"x": _column(x), "u": _column(u), "p": _column(p), "t": time}
        derivative = casadi.Function(
            "derivative",
            [inputs["x"], inputs["u"], inputs["p"], time],
            [_stack(writer.write(derivative_symbol(name)) for name in states)],
            ["x", "u", "p", "t"],
            ["dx"],
        )
        clocks = tuple(
            self._clock(part.clock, outputs[part.clock], receives, channels, writer, inputs)
            for part in self.kind.partitions[1:]
            if outputs[part.clock]
        )
        sends = tuple(
            self._send(link, channels, writer, inputs)
            for link in dict.fromkeys(c[0] for c in channels.values())
        )
        return Kind(
            self.kind.clocked.flat.name,
            tuple(self._state(name) for name in states),
            tuple(
                Hold(
                    self._hold_name(hold, holds),
                    hold.clock,
                    outputs[hold.clock].index(hold.variable),
                    self.timings.delay(hold),
                )
                for hold in holds
            ),
            tuple(s.name for s in parameters),
            derivative,
            clocks,
            sends,
        )

    @staticmethod
    def _hold_name(hold: HoldCrossing, holds: Sequence[HoldCrossing]) -> str:
        same = sum(other.variable == hold.variable for other in holds)
        return hold.variable if same == 1 else hold.symbol

    def _state(self, name: str) -> State:
        variable = next(v for v in self.kind.clocked.flat.variables if v.name == name)
        return State(name, format_dimension(variable.dimension), name)

    def _reach(self) -> set[sympy.Symbol]:
        """Return every symbol that the motion of the states, through all crossings, depends on."""
        seen: set[sympy.Symbol] = set()
        work = [derivative_symbol(name) for name in self.kind.states]
        while work:
            s = work.pop()
            if s in seen:
                continue
            seen.add(s)
            for table in (self.continuous, self.clocked, self.samples):
                if s in table:
                    work += table[s].free_symbols
            if s in self.known_holds:
                work.append(symbol(self.known_holds[s].variable))
            if s in self.known_previous:
                work.append(symbol(self.known_previous[s].variable))
            if s in self.known_receives:
                work += self.sends[self.known_receives[s].send].expression.free_symbols
        return seen

    def _outputs(self, holds: Sequence[HoldCrossing], reached: set[sympy.Symbol]) -> dict[str, list[str]]:
        outputs: dict[str, dict[str, None]] = {part.clock: {} for part in self.kind.partitions[1:]}
        for hold in holds:
            outputs[hold.clock][hold.variable] = None
        for s, previous in self.known_previous.items():
            if s in reached:
                outputs[previous.clock][previous.variable] = None
        return {clock: list(names) for clock, names in outputs.items()}

    def _channels(self, receives: Iterable[Any]) -> dict[str, tuple[str, int]]:
        """Return for each send that is heard its link and row; equal expressions on a link share a row."""
        rows: dict[str, list[sympy.Expr]] = {}
        found = {}
        for name in dict.fromkeys(receive.send for receive in receives):
            send = self.sends[name]
            row = rows.setdefault(send.link, [])
            if send.expression not in row:
                row.append(send.expression)
            found[name] = (send.link, row.index(send.expression))
        return found

    def _parameters(self, reached: set[sympy.Symbol], *others: Iterable[sympy.Symbol]) -> list[sympy.Symbol]:
        defined = {*self.continuous, *self.clocked, *self.samples, *self.known_holds}
        defined |= {*self.known_previous, *self.known_receives, symbol("time")}
        defined |= {s for other in others for s in other}
        return sorted(reached - defined, key=lambda s: s.name)

    def _clock(
        self,
        clock: str,
        outputs: list[str],
        receives: dict[sympy.Symbol, Any],
        channels: dict[str, tuple[str, int]],
        writer: _Writer,
        inputs: dict[str, casadi.SX],
    ) -> ClockPartition:
        heard = {s: receive for s, receive in receives.items() if receive.clock == clock}
        remembered = {
            s: previous
            for s, previous in self.known_previous.items()
            if previous.clock == clock and previous.variable in outputs
        }
        r = {s: casadi.SX.sym(s.name) for s in heard}
        m = {s: casadi.SX.sym(s.name) for s in remembered}
        own = writer.extended({**r, **m}, self.clocked)
        tick = casadi.Function(
            f"tick_{clock}",
            [inputs["x"], inputs["u"], _column(m), _column(r), inputs["p"], inputs["t"]],
            [_stack(own.write(symbol(name)) for name in outputs)],
            ["x", "u", "m", "r", "p", "t"],
            ["y"],
        )
        return ClockPartition(
            clock,
            tuple(outputs),
            tuple(outputs.index(previous.variable) for previous in remembered.values()),
            tuple(previous.variable for previous in remembered.values()),
            tuple(
                Receive(receive.symbol, receive.operator, receive.link, channels[receive.send][1])
                for receive in heard.values()
            ),
            tick,
        )

    def _send(
        self, link: str, channels: dict[str, tuple[str, int]], writer: _Writer, inputs: dict[str, casadi.SX]
    ) -> SendPartition:
        first: dict[int, str] = {}
        for name, (its_link, row) in channels.items():
            if its_link == link:
                first.setdefault(row, name)
        names = [first[row] for row in sorted(first)]
        send = casadi.Function(
            f"send_{link}",
            [inputs["x"], inputs["u"], inputs["p"], inputs["t"]],
            [_stack(writer.translate(self.sends[name].expression) for name in names)],
            ["x", "u", "p", "t"],
            ["s"],
        )
        return SendPartition(link, tuple(names), tuple(self.sends[name].unit for name in names), send)


def _column(symbols: dict[sympy.Symbol, casadi.SX]) -> casadi.SX:
    return _stack(symbols.values())


def _stack(values: Iterable[casadi.SX]) -> casadi.SX:
    """Return a dense column of scalars, (0, 1) when there are none."""
    listed = list(values)
    return casadi.densify(casadi.vertcat(*listed)) if listed else casadi.SX.zeros(0, 1)


class _Writer:
    """Translates SymPy expressions to CasADi, each definition once."""

    def __init__(
        self, known: dict[sympy.Symbol, casadi.SX], definitions: dict[sympy.Symbol, sympy.Expr]
    ) -> None:
        self.known = dict(known)
        self.definitions = definitions

    def extended(
        self, known: dict[sympy.Symbol, casadi.SX], definitions: dict[sympy.Symbol, sympy.Expr]
    ) -> _Writer:
        """Return a writer that knows more."""
        return _Writer({**self.known, **known}, {**self.definitions, **definitions})

    def write(self, wanted: sympy.Symbol) -> casadi.SX:
        """Return the value of a symbol, writing what it depends on first.

        A stack instead of recursion, so that the length of a chain of definitions is no limit.
        """
        work = [wanted]
        while work:
            s = work[-1]
            if s in self.known:
                work.pop()
                continue
            missing = [t for t in sorted(self.definitions[s].free_symbols, key=str) if t not in self.known]
            if missing:
                work += missing
            else:
                self.known[s] = self._build(self.definitions[s])
        value: casadi.SX = self.known[wanted]
        return value

    def translate(self, expression: sympy.Expr) -> casadi.SX:
        """Return the value of an expression."""
        for s in sorted(expression.free_symbols, key=str):
            self.write(s)
        return self._build(expression)

    def _build(self, expression: sympy.Expr) -> casadi.SX:
        if expression.is_Symbol:
            known: casadi.SX = self.known[expression]
            return known
        if expression.is_Number:
            return casadi.SX(float(expression))
        if expression.is_Mul:
            return self._product(expression)
        arguments = [self._build(argument) for argument in expression.args]
        if expression.is_Add:
            return _fold(arguments, operator.add)
        if expression.is_Pow:
            return _power(arguments[0], expression.exp, arguments[1])
        value: casadi.SX = _CASADI[expression.func.__name__](*arguments)
        return value

    def _product(self, expression: sympy.Expr) -> casadi.SX:
        """Return a product, dividing by its factors of negative power: a/b rounds once, a*b**-1 twice."""
        above = [self._build(node) for node in expression.args if not _is_reciprocal(node)]
        below = [self._build(1 / node) for node in expression.args if _is_reciprocal(node)]
        product = _fold(above, operator.mul) if above else casadi.SX(1)
        return product / _fold(below, operator.mul) if below else product


def _fold(values: Sequence[casadi.SX], join: Callable[[casadi.SX, casadi.SX], casadi.SX]) -> casadi.SX:
    total = values[0]
    for value in values[1:]:
        total = join(total, value)
    return total


def _is_reciprocal(node: sympy.Expr) -> bool:
    return bool(node.is_Pow and node.exp.is_Number and node.exp.is_negative)


def _power(base: casadi.SX, exponent: sympy.Expr, written: casadi.SX) -> casadi.SX:
    if exponent == -1:
        return 1 / base
    if exponent == sympy.Rational(1, 2):
        return casadi.sqrt(base)
    if exponent.is_Integer and 0 < abs(int(exponent)) <= 100:
        product = _fold([base] * abs(int(exponent)), operator.mul)
        return product if exponent > 0 else 1 / product
    return base**written
