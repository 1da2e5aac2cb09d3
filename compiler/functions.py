"""Explicit equations to CasADi functions, and the exchange between sites as structure.

Takes: `SortedSystem`. Gives: `CompiledSystem`.
Guarantees: a kind's functions hold only what its states, its samples and what it sends depend on; what the
scene named but nothing reads is listed in `dropped`. They are SX functions, unless the kind has a nonlinear
loop: then they are MX functions, with a Newton solver for each loop inside.
Does not: write files, or put numbers in the place of parameters.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import casadi
import sympy

from apc.compiler.blocks import ImplicitBlock
from apc.compiler.clocks import HoldCrossing, ReceiveCrossing
from apc.compiler.compiled import (
    ClockPartition,
    CompiledSystem,
    Hold,
    Kind,
    Origin,
    Ports,
    Receive,
    SendPartition,
    State,
)
from apc.compiler.component import OTHERS
from apc.compiler.exchange import Timings, all_parameters, compiled_groups, used_clocks, used_links
from apc.compiler.ports import held_ports
from apc.compiler.scene import Scene
from apc.compiler.structure import SortedKind, SortedSystem
from apc.compiler.symbolic import derivative_symbol, no_derivative, symbol, to_sympy
from apc.compiler.tables import TimeTable
from apc.compiler.units import format_dimension

Definition: TypeAlias = sympy.Expr | ImplicitBlock
# CasADi's Newton iteration ends before it takes a step smaller than this, in SI. That step is taken
# afterwards and squares the error: the rest is rounding. A bound on the residual would depend on its scale.
NEWTON = {"abstol": 0.0, "abstolStep": 1e-11, "max_iter": 100}
_CASADI: dict[str, Callable[..., Any]] = {
    "min": casadi.fmin,
    "max": casadi.fmax,
    "abs": casadi.fabs,
    "Abs": casadi.fabs,  # what SymPy makes of sqrt(x^2)
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
    "less": operator.lt,
    "less_or_equal": operator.le,
    "more": operator.gt,
    "more_or_equal": operator.ge,
    "equal": operator.eq,
    "unequal": operator.ne,
}


def build_functions(system: SortedSystem, origin: Origin) -> CompiledSystem:
    """Write every kind as CasADi functions, and what lies between the sites beside them."""
    scene = system.scene
    timings = Timings(scene)
    builders = [_KindBuilder(scene, kind, timings) for kind in system.kinds]
    rows = _shared_rows(builders)
    kinds = [builder.build(rows) for builder in builders]
    dropped = [item for builder in builders for item in builder.dropped]
    links, unheard = used_links(scene, kinds, timings)
    clocks, silent = used_clocks(scene, kinds, links, timings)
    numbers = {group: i for i, kind in enumerate(system.kinds) for group in kind.clocked.flat.groups}
    return CompiledSystem(
        scene.name,
        scene.about,
        tuple(clocks),
        tuple(links),
        timings.found,
        all_parameters(scene, kinds, links),
        tuple(kinds),
        compiled_groups(scene, kinds, numbers, links, timings),
        tuple(dict.fromkeys([*dropped, *unheard, *silent])),
        origin,
        scene.experiment,
        scene.region,
    )


def _shared_rows(builders: Sequence[_KindBuilder]) -> dict[str, str]:
    """Return, for each send that some kind hears, the send whose row it travels in.

    Two sends over one link share a row when every kind sends the same under both names.
    """
    rows: dict[str, str] = {}
    for builder in builders:
        for name in builder.heard_sends():
            if name not in rows:
                rows[name] = next(
                    (
                        other
                        for other in dict.fromkeys(rows.values())
                        if _same_everywhere(name, other, builders)
                    ),
                    name,
                )
    return rows


def _same_everywhere(name: str, other: str, builders: Sequence[_KindBuilder]) -> bool:
    for builder in builders:
        one, two = builder.sends.get(name), builder.sends.get(other)
        if one is None and two is None:
            continue
        if one is None or two is None or one.link != two.link or one.expression != two.expression:
            return False
    return True


class _KindBuilder:
    """One kind's functions: first what is needed is found, then it is written."""

    def __init__(self, scene: Scene, kind: SortedKind, timings: Timings) -> None:
        self.kind = kind
        self.scene = scene
        self.tables = {
            f"{part.name}.{table.name}": table
            for part in scene.parts
            if part.name in kind.clocked.flat.parts
            for table in part.tables
        }
        self.timings = timings
        self.dropped: list[tuple[str, str]] = []
        self.continuous: dict[sympy.Symbol, Definition] = kind.partitions[0].definitions
        self.clocked: dict[sympy.Symbol, Definition] = {
            s: definition for part in kind.partitions[1:] for s, definition in part.definitions.items()
        }
        self.samples = {symbol(name): expression for name, _, expression in kind.samples}
        self.known_holds = {symbol(hold.symbol): hold for hold in kind.holds}
        self.known_previous = {symbol(previous.symbol): previous for previous in kind.previous}
        self.known_receives = {symbol(receive.symbol): receive for receive in kind.receives}
        self.sends = {send.name: send for send in kind.sends}
        self.edges = {
            symbol(receive.symbol): to_sympy(receive.edge, no_derivative)
            for receive in kind.receives
            if receive.edge is not None
        }

        self.reached = self._reach()

    def heard_sends(self) -> list[str]:
        """Return the names this kind hears of the others, each once."""
        found: dict[str, None] = {}
        for s, receive in self.known_receives.items():
            if s in self.reached:
                found[receive.send] = None
                if s in self.edges:
                    found.update(dict.fromkeys(_others(self.edges[s])))
        return list(found)

    def build(self, rows: dict[str, str]) -> Kind:
        """Write the kind's functions; `rows` says in which row each send that is heard travels."""
        reached = self.reached
        holds = [hold for s, hold in self.known_holds.items() if s in reached]
        self.dropped += [
            (hold.variable, "nobody reads this held value")
            for s, hold in self.known_holds.items()
            if s not in reached
        ]
        receives = {s: receive for s, receive in self.known_receives.items() if s in reached}
        outputs = self._outputs(holds, reached)
        channels = self._channels(rows)
        states = self.kind.states
        self.dropped += [(name, "nobody hears it") for name in self.sends if name not in rows]
        type_: Any = casadi.MX if self._loops() else casadi.SX
        x = {symbol(name): type_.sym(name) for name in states}
        u = {symbol(hold.symbol): type_.sym(hold.symbol) for hold in holds}
        names = self._parameter_names(reached, {*x, *u})
        p = {name: type_.sym(name) for name in names}
        time = type_.sym("time")
        # A start value has the name of its variable; the name itself is what is computed.
        computed = {*self.continuous, *self.clocked}
        known = {symbol(name): value for name, value in p.items() if symbol(name) not in computed}
        known |= {symbol(f"initial({name})"): value for name, value in p.items()}
        known |= {**x, **u, symbol("time"): time}
        writer = _Writer(type_, known, {**self.continuous, **self.samples}, self.tables, p)
        inputs = {"x": _stack(type_, x.values()), "u": _stack(type_, u.values())}
        inputs |= {"p": _stack(type_, p.values()), "t": time}
        derivative = casadi.Function(
            "derivative",
            [inputs["x"], inputs["u"], inputs["p"], time],
            [_stack(type_, (writer.write(derivative_symbol(name)) for name in states))],
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
                    self.timings.delay(hold, self.kind.clocked.flat),
                )
                for hold in holds
            ),
            tuple(names),
            derivative,
            clocks,
            sends,
            self._ports(writer, inputs),
        )

    def _ports(self, writer: _Writer, inputs: dict[str, Any]) -> Ports | None:
        """Write where held values act, of those that anything reads."""
        written = writer.known.keys()
        found = [port for port in held_ports(self.scene, self.kind) if port.symbols <= written]
        if not found:
            return None
        rows = [port.potential for port in found] + [port.flow for port in found]
        port = casadi.Function(
            "port",
            [inputs["x"], inputs["u"], inputs["p"], inputs["t"]],
            [writer.column(writer.translate(row) for row in rows)],
            ["x", "u", "p", "t"],
            ["potentials_flows"],
        )
        return Ports(tuple(port.part for port in found), port)

    @staticmethod
    def _hold_name(hold: HoldCrossing, holds: Sequence[HoldCrossing]) -> str:
        same = sum(other.variable == hold.variable for other in holds)
        return hold.variable if same == 1 else hold.symbol

    def _state(self, name: str) -> State:
        return State(name, self._unit(name), name)

    def _unit(self, name: str) -> str:
        variable = next(v for v in self.kind.clocked.flat.variables if v.name == name)
        return format_dimension(variable.dimension)

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
            if s in self.edges:
                work += self.edges[s].free_symbols
            if s in self.known_receives:
                heard = [self.known_receives[s].send, *_others(self.edges.get(s))]
                work += [
                    t
                    for name in heard
                    if name in self.sends
                    for t in self.sends[name].expression.free_symbols
                ]
        return seen

    def _outputs(self, holds: Sequence[HoldCrossing], reached: set[sympy.Symbol]) -> dict[str, list[str]]:
        outputs: dict[str, dict[str, None]] = {part.clock: {} for part in self.kind.partitions[1:]}
        for hold in holds:
            outputs[hold.clock][hold.variable] = None
        for s, previous in self.known_previous.items():
            if s in reached:
                outputs[previous.clock][previous.variable] = None
        return {clock: list(names) for clock, names in outputs.items()}

    def _channels(self, rows: dict[str, str]) -> dict[str, tuple[str, int]]:
        """Return for each send that is heard its link and its row among what this kind sends over it."""
        own = [name for name in rows if name in self.sends]
        by_link: dict[str, list[str]] = {}
        for name in own:
            listed = by_link.setdefault(self.sends[name].link, [])
            if rows[name] not in listed:
                listed.append(rows[name])
        return {
            name: (self.sends[name].link, by_link[self.sends[name].link].index(rows[name])) for name in own
        }

    def _parameter_names(self, reached: set[sympy.Symbol], inputs: set[sympy.Symbol]) -> list[str]:
        """Return the parameters of the kind: those its functions read, and its start values."""
        defined = {*self.continuous, *self.clocked, *self.samples, *self.known_holds, *inputs}
        defined |= {*self.known_previous, *self.known_receives, symbol("time")}
        defined |= {symbol(name) for name in self.tables}
        free = {s.name for s in reached - defined if not s.name.startswith(f"{OTHERS}.")}
        starts = set(self.kind.states)
        starts |= {previous.variable for s, previous in self.known_previous.items() if s in reached}
        starts |= {name[8:-1] for name in free if name.startswith("initial(")}
        guessed = {name for loop in self._loops() for name in loop.tearing}
        starts |= {v.name for v in self.kind.clocked.flat.variables if v.start and v.name in guessed}
        return sorted({name for name in free if not name.startswith("initial(")} | starts)

    def _loops(self) -> list[ImplicitBlock]:
        """Return the nonlinear loops that the kind's functions have to solve."""
        tables = (self.continuous, self.clocked)
        found = (table[s] for s in self.reached for table in tables if s in table)
        return [definition for definition in found if isinstance(definition, ImplicitBlock)]

    def _clock(
        self,
        clock: str,
        outputs: list[str],
        receives: dict[sympy.Symbol, Any],
        channels: dict[str, tuple[str, int]],
        writer: _Writer,
        inputs: dict[str, Any],
    ) -> ClockPartition:
        heard = {s: receive for s, receive in receives.items() if receive.clock == clock}
        remembered = {
            s: previous
            for s, previous in self.known_previous.items()
            if previous.clock == clock and previous.variable in outputs
        }
        type_ = writer.type_
        r = {s: type_.sym(s.name) for s in heard}
        m = {s: type_.sym(s.name) for s in remembered}
        own = writer.extended({**r, **m}, self.clocked)
        alone = writer.extended(m, self.clocked)  # what one pair of peers knows: nothing that is heard
        tick = casadi.Function(
            f"tick_{clock}",
            [
                inputs["x"],
                inputs["u"],
                own.column(m.values()),
                own.column(r.values()),
                inputs["p"],
                inputs["t"],
            ],
            [own.column(own.write(symbol(name)) for name in outputs)],
            ["x", "u", "m", "r", "p", "t"],
            ["y"],
        )
        return ClockPartition(
            clock,
            tuple(outputs),
            tuple(self._unit(name) for name in outputs),
            tuple(outputs.index(previous.variable) for previous in remembered.values()),
            tuple(previous.variable for previous in remembered.values()),
            tuple(
                Receive(
                    receive.symbol,
                    receive.operator,
                    receive.link,
                    channels[receive.send][1],
                    self._edge(s, receive, channels, alone, m, inputs) if s in self.edges else None,
                )
                for s, receive in heard.items()
            ),
            tick,
        )

    def _edge(
        self,
        s: sympy.Symbol,
        receive: ReceiveCrossing,
        channels: dict[str, tuple[str, int]],
        writer: _Writer,
        remembered: dict[sympy.Symbol, Any],
        inputs: dict[str, Any],
    ) -> Any:
        """Write what a reduction runs over, for one peer that hears and one that is heard."""
        size = 1 + max(row for link, row in channels.values() if link == receive.link)
        sent = writer.type_.sym("s", size)
        theirs = {
            symbol(f"{OTHERS}.{name}"): sent[row]
            for name, (link, row) in channels.items()
            if link == receive.link
        }
        own = writer.extended(theirs, {})
        return casadi.Function(
            "edge",
            [inputs["x"], inputs["u"], own.column(remembered.values()), sent, inputs["p"], inputs["t"]],
            [own.translate(self.edges[s])],
            ["x", "u", "m", "s", "p", "t"],
            ["value"],
        )

    def _send(
        self, link: str, channels: dict[str, tuple[str, int]], writer: _Writer, inputs: dict[str, Any]
    ) -> SendPartition:
        first: dict[int, str] = {}
        for name, (its_link, row) in channels.items():
            if its_link == link:
                first.setdefault(row, name)
        names = [first[row] for row in sorted(first)]
        send = casadi.Function(
            f"send_{link}",
            [inputs["x"], inputs["u"], inputs["p"], inputs["t"]],
            [writer.column(writer.translate(self.sends[name].expression) for name in names)],
            ["x", "u", "p", "t"],
            ["s"],
        )
        return SendPartition(link, tuple(names), tuple(self.sends[name].unit for name in names), send)


def _others(expression: sympy.Expr | None) -> list[str]:
    """Return what an expression reads of another peer."""
    if expression is None:
        return []
    prefix = f"{OTHERS}."
    return sorted(s.name.removeprefix(prefix) for s in expression.free_symbols if s.name.startswith(prefix))


def _stack(type_: Any, values: Iterable[Any]) -> Any:
    """Return a dense column of scalars, (0, 1) when there are none."""
    listed = list(values)
    return casadi.densify(casadi.vertcat(*listed)) if listed else type_(0, 1)


class _Writer:
    """Translates SymPy expressions to CasADi, each definition once.

    `type_` is casadi.SX, or casadi.MX where a definition is a loop; `starts` gives the start values of the
    unknowns that have one, where a loop's iteration begins.
    """

    def __init__(
        self,
        type_: Any,
        known: Mapping[sympy.Symbol, Any],
        definitions: Mapping[sympy.Symbol, Definition],
        tables: Mapping[str, TimeTable],
        starts: Mapping[str, Any],
    ) -> None:
        self.type_ = type_
        self.known = dict(known)
        self.definitions = definitions
        self.tables = tables
        self.starts = starts

    def column(self, values: Iterable[Any]) -> Any:
        """Return a dense column of scalars."""
        return _stack(self.type_, values)

    def extended(
        self, known: Mapping[sympy.Symbol, Any], definitions: Mapping[sympy.Symbol, Definition]
    ) -> _Writer:
        """Return a writer that knows more."""
        return _Writer(
            self.type_, {**self.known, **known}, {**self.definitions, **definitions}, self.tables, self.starts
        )

    def write(self, wanted: sympy.Symbol) -> Any:
        """Return the value of a symbol, writing what it depends on first.

        A stack instead of recursion, so that the length of a chain of definitions is no limit.
        """
        work = [wanted]
        while work:
            s = work[-1]
            if s in self.known:
                work.pop()
                continue
            missing = [t for t in self._needed(self.definitions[s]) if t not in self.known]
            if missing:
                work += missing
            else:
                definition = self.definitions[s]
                if isinstance(definition, ImplicitBlock):
                    self.known |= self._solve(definition)
                else:
                    self.known[s] = self._build(definition)
        return self.known[wanted]

    def _solve(self, loop: ImplicitBlock) -> dict[sympy.Symbol, Any]:
        """Return the unknowns of a loop: those torn by Newton's iteration, the others from them."""
        outer = self._needed(loop)
        own = {symbol(name): casadi.SX.sym(name) for name in loop.tearing}
        given = {s: casadi.SX.sym(s.name) for s in outer}
        others = {symbol(name): expression for name, expression in loop.inner}
        inside = _Writer(casadi.SX, {**own, **given}, others, self.tables, {})
        z, q = inside.column(own.values()), inside.column(given.values())
        residual = inside.column(inside.translate(expression) for expression in loop.residuals)
        solver = casadi.rootfinder("loop", "newton", {"x": z, "p": q, "g": residual}, NEWTON)
        last_step = casadi.solve(casadi.jacobian(residual, z), residual)
        polish = casadi.Function("polish", [z, q], [z - last_step])
        rest = casadi.Function("rest", [z, q], [inside.column(inside.write(s) for s in others)])
        guess = self.column(self.starts.get(name, self.type_(0)) for name in loop.tearing)
        values = self.column(self.known[s] for s in outer)
        torn = polish(solver(x0=guess, p=values)["x"], values)
        found = rest(torn, values)
        return {s: torn[i] for i, s in enumerate(own)} | {s: found[i] for i, s in enumerate(others)}

    def translate(self, expression: sympy.Expr) -> Any:
        """Return the value of an expression."""
        for s in self._needed(expression):
            self.write(s)
        return self._build(expression)

    def _needed(self, expression: Definition) -> list[sympy.Symbol]:
        return sorted((s for s in expression.free_symbols if s.name not in self.tables), key=str)

    def _build(self, expression: sympy.Expr) -> Any:
        if expression.is_Symbol:
            return self.known[expression]
        if expression.is_number and not expression.args:
            return self.type_(float(expression))
        if expression.is_Mul:
            return self._product(expression)
        if expression.func.__name__ == "interpolate":
            return self._interpolated(*expression.args)
        arguments = [self._build(argument) for argument in expression.args]
        if expression.is_Add:
            return _fold(arguments, operator.add)
        if expression.is_Pow:
            return _power(arguments[0], expression.exp, arguments[1])
        return _CASADI[expression.func.__name__](*arguments)

    def _interpolated(self, table: sympy.Symbol, time: sympy.Expr) -> Any:
        """Return a table's value, linear between its rows and constant beyond its ends."""
        found = self.tables[table.name]
        start, end = found.times[0], found.times[-1]
        inside = casadi.fmin(casadi.fmax(self._build(time), start), end)
        return casadi.pw_lin(inside, found.times.tolist(), found.numbers.tolist())

    def _product(self, expression: sympy.Expr) -> Any:
        """Return a product, dividing by its factors of negative power: a/b rounds once, a*b**-1 twice."""
        above = [self._build(node) for node in expression.args if not _is_reciprocal(node)]
        below = [self._build(1 / node) for node in expression.args if _is_reciprocal(node)]
        product = _fold(above, operator.mul) if above else self.type_(1)
        return product / _fold(below, operator.mul) if below else product


def _fold(values: Sequence[Any], join: Callable[[Any, Any], Any]) -> Any:
    total = values[0]
    for value in values[1:]:
        total = join(total, value)
    return total


def _is_reciprocal(node: sympy.Expr) -> bool:
    return bool(node.is_Pow and node.exp.is_Number and node.exp.is_negative)


def _power(base: Any, exponent: sympy.Expr, written: Any) -> Any:
    if exponent == -1:
        return 1 / base
    if exponent == sympy.Rational(1, 2):
        return casadi.sqrt(base)
    if exponent.is_Integer and 0 < abs(int(exponent)) <= 100:
        product = _fold([base] * abs(int(exponent)), operator.mul)
        return product if exponent > 0 else 1 / product
    return base**written
