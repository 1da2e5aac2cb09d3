"""The decisions in a peer's equations: comparisons, max, min, abs and sign of what moves.

Takes: a kind of a `CompiledSystem`.
Gives: `Decision`, `SwitchedKind`, `find_switches`, `bind`, `bound_kind`; `varying_slopes`.
Guarantees: found in the equations themselves: a comparison, an `if`, a `max`, `min`, `abs` or `sign` of
something that moves is a decision, whatever the part is called.
Does not: know which pieces a motion can reach, or switch what depends on time and parameters alone.

Each decision becomes a number d, 0 or 1 (c a condition):

    c: d     max(a, b), min(a, b): d a + (1 − d) b     |a|: (2 d − 1) a     sign(a): 2 d − 1

With all d set, what is left has the slopes of one piece.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi

from apc.compiler.compiled import Kind
from apc.compiler.interpolation import Interpolation, jacobian
from apc.compiler.plain import LOOK, straight, symbolic, walk
from apc.frame.jacobians import SiteJacobians, jacobians

# Equal, not equal: of things that move they are so at an instant at most.
_POINTS = {"eq": 0.0, "ne": 1.0}


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """A decision: its symbol, the names of what it changes, and `guard`, which is zero where it is taken."""

    symbol: Any  # casadi.SX
    changes: tuple[str, ...]
    guard: Any  # casadi.SX


@dataclass(frozen=True, slots=True, eq=False)
class _Opened:
    """A function with its decisions as symbols: `where` it stands, its inputs, its output column.

    `rows` name what its rows compute; a function of many variants computes them again and again.
    """

    where: tuple[str, int, int]  # ("derivative" | "tick" | "send" | "edge", partition, receive)
    inputs: tuple[Any, ...]  # casadi.SX
    output: Any  # casadi.SX
    rows: tuple[str, ...]

    def names(self, expression: Any, symbol: Any) -> list[str]:
        """Return the names of the rows of an expression of them that depend on a symbol, each once."""
        rows = [row for row in range(expression.size1()) if casadi.depends_on(expression[row, :], symbol)]
        return list(dict.fromkeys(self.rows[row % len(self.rows)] for row in rows))


@dataclass(frozen=True, slots=True, eq=False)
class SwitchedKind:
    """A kind with its decisions laid open. `walkable` is False where a nonlinear loop hides them."""

    kind: Kind
    decisions: tuple[Decision, ...]
    functions: tuple[_Opened, ...]
    walkable: bool


@dataclass(frozen=True, slots=True)
class _Step:
    """A value on the walk: its expression, its number (equal expressions have one), and what it hangs on."""

    expression: Any  # casadi.SX
    number: int
    moves: bool
    decided: bool


class _Walk:
    """Opens the functions of one kind; equal decisions, wherever they stand, are one."""

    def __init__(self) -> None:
        self.numbers: dict[Any, int] = {}
        self.symbols: dict[int, Any] = {}
        self.operands: dict[int, list[Any]] = {}

    def number(self, key: Any) -> int:
        return self.numbers.setdefault(key, len(self.numbers))

    def decide(self, word: str, operands: Sequence[_Step]) -> _Step:
        """Return the symbol of a decision between these operands."""
        number = self.number(("decision", word, *(operand.number for operand in operands)))
        if number not in self.symbols:
            self.symbols[number] = casadi.SX.sym(f"d{len(self.symbols)}")
            self.operands[number] = [operand.expression for operand in operands]
        return _Step(self.symbols[number], number, moves=False, decided=True)

    def open(self, function: Any, names: Sequence[str]) -> tuple[tuple[Any, ...], Any]:
        """Return the inputs and the output column of a function with its decisions as symbols.

        `names` are the arguments', "p" and "t" those that do not move.
        """
        plain_function = straight(function)
        inputs = tuple(casadi.SX.sym(name, function.sparsity_in(i)) for i, name in enumerate(names))
        steps = [
            _Step(entry, self.number((name, place)), name not in ("p", "t"), decided=False)
            for name, expression in zip(names, inputs, strict=True)
            for place, entry in enumerate(casadi.vertsplit(expression.nz[:]) if expression.nnz() else [])
        ]
        steps += [
            _Step(casadi.SX(value), self.number(("constant", value)), False, False)
            for value in plain_function.constants
        ]
        result = walk(
            plain_function,
            steps,
            lambda word: self.look if word == LOOK else functools.partial(self.apply, word),
        )
        results = [result[place].expression for place in plain_function.results[0]]
        column = casadi.SX(function.sparsity_out(0), casadi.vertcat(*results)) if results else casadi.SX(0, 1)
        return inputs, casadi.densify(column)

    def look(self, table: Interpolation, at: _Step) -> _Step:
        """Return what a table says: a value like another, that of no decision."""
        number = self.number((LOOK, table, at.number))
        return _Step(symbolic(LOOK)(table, at.expression), number, at.moves, at.decided)

    def apply(self, word: str, *operands: _Step) -> _Step:
        """Return an operation of the function, or what a decision makes of it."""
        number = self.number((word, *(operand.number for operand in operands)))
        moves = any(operand.moves for operand in operands)
        decided = any(operand.decided for operand in operands)
        values = [operand.expression for operand in operands]
        if moves and word in ("lt", "le"):
            return self.decide(word, operands)
        if moves and word in _POINTS:
            return _Step(casadi.SX(_POINTS[word]), number, False, False)
        if moves and word in ("fmin", "fmax"):
            d = self.decide(word, operands).expression
            return _Step(d * values[0] + (1 - d) * values[1], number, True, True)
        if moves and word in ("fabs", "sign"):
            d = self.decide("sign", operands).expression
            value = (2 * d - 1) * values[0] if word == "fabs" else 2 * d - 1
            return _Step(value, number, word == "fabs", True)
        if word == "if_else_zero" and operands[0].decided:
            return _Step(values[0] * values[1], number, moves, True)
        return _Step(symbolic(word)(*values), number, moves, decided)


def find_switches(kind: Kind) -> SwitchedKind:
    """Lay a kind's decisions open."""
    functions = _functions(kind)
    if not all(function.is_a("SXFunction") for _, function, _, _ in functions):
        return SwitchedKind(kind, (), (), walkable=False)
    opening = _Walk()
    opened = tuple(
        _Opened(where, *opening.open(function, names), rows) for where, function, names, rows in functions
    )
    decisions = []
    for number, symbol in opening.symbols.items():
        changed: dict[str, None] = {}
        for item in opened:
            if casadi.depends_on(item.output, symbol):
                changed |= dict.fromkeys(_changed(kind, item, symbol, opening.operands[number]))
        first, *others = opening.operands[number]
        # Of a sign there is one operand.
        decisions.append(Decision(symbol, tuple(changed), first - others[0] if others else first))
    return SwitchedKind(kind, tuple(decisions), opened, walkable=True)


def varying_slopes(site: SiteJacobians) -> tuple[str, ...]:
    """Return the names of what has slopes that change with time in some piece, whatever else moves.

    Of a kind with a nonlinear loop nothing is known: all that is in the loop depends on all that drives it.
    """
    if not site.timed:
        return ()
    result: dict[str, None] = {}
    for function in find_switches(site.kind).functions:
        *moving, _, t = function.inputs
        slopes = jacobian(function.output, casadi.vertcat(*moving))
        result |= dict.fromkeys(function.names(slopes, t))
    return tuple(result)


def bind(switched: SwitchedKind, base: SiteJacobians, settings: Mapping[int, bool]) -> SiteJacobians:
    """Return the Jacobians of a kind with every decision set.

    Parameters
    ----------
    switched
        The kind.
    base
        Its ordinary Jacobians: states, start values and structural patterns stay theirs, so that every piece
        has the same frame and the same states.
    settings
        By the place of the decision; what is left out is off.
    """
    return replace(jacobians(bound_kind(switched, settings)), kind=base.kind, pattern=base.pattern)


def _functions(kind: Kind) -> list[tuple[tuple[str, int, int], Any, tuple[str, ...], tuple[str, ...]]]:
    """Return a kind's functions: where each stands, itself, its arguments' names, and those of its rows."""
    states = tuple(state.name for state in kind.states)
    listed: list[tuple[tuple[str, int, int], Any, tuple[str, ...], tuple[str, ...]]] = [
        (("derivative", 0, 0), kind.derivative, ("x", "u", "p", "t"), states)
    ]
    for p, partition in enumerate(kind.clocks):
        names = ("x", "u", f"m{p}", f"r{p}", "p", "t")
        listed.append((("tick", p, 0), partition.tick, names, partition.outputs))
        for place, receive in enumerate(partition.receives):
            if receive.edge is not None:
                edge = ("x", "u", f"m{p}", f"s {receive.link}", "p", "t")
                listed.append((("edge", p, place), receive.edge, edge, (receive.name,)))
    listed += [
        (("send", p, 0), send.send, ("x", "u", "p", "t"), send.channels) for p, send in enumerate(kind.sends)
    ]
    return listed


def _changed(kind: Kind, opened: _Opened, symbol: Any, operands: Sequence[Any]) -> list[str]:
    """Return the names of what a decision changes in a function."""
    what, p, place = opened.where
    changed = opened.names(opened.output, symbol)
    if what == "edge":  # what is computed of what is heard
        partition = kind.clocks[p]
        inputs = partition.tick.sx_in()
        computed = partition.tick(*inputs)
        tick = _Opened(("tick", p, 0), tuple(inputs), computed, partition.outputs)
        return tick.names(computed, inputs[3][place])
    if what != "derivative":
        return changed
    # A continuous force has no name in the equations of motion; the part whose parameters decide has.
    symbols = casadi.vertsplit(opened.inputs[2]) if kind.parameters else []
    moving = {state.name.rpartition(".")[0] for state in kind.states}
    owners = dict.fromkeys(
        name.rpartition(".")[0]
        for name, parameter in zip(kind.parameters, symbols, strict=True)
        if any(casadi.depends_on(operand, parameter) for operand in operands)
    )
    return [owner for owner in owners if owner and owner not in moving] or changed


def bound_kind(switched: SwitchedKind, settings: Mapping[int, bool]) -> Kind:
    """Return the kind with its decisions set to numbers; those left out are off."""
    symbols = casadi.vertcat(*(decision.symbol for decision in switched.decisions))
    values = casadi.vertcat(
        *(casadi.SX(float(settings.get(place, False))) for place in range(len(switched.decisions)))
    )
    result: dict[tuple[str, int, int], Any] = {}
    for function in switched.functions:
        output = (
            casadi.substitute(function.output, symbols, values) if switched.decisions else function.output
        )
        result[function.where] = casadi.Function(
            function.where[0], list(function.inputs), [casadi.sparsify(output)]
        )
    kind = switched.kind
    clocks = tuple(
        replace(
            partition,
            tick=result["tick", p, 0],
            receives=tuple(
                replace(receive, edge=result["edge", p, place]) if receive.edge is not None else receive
                for place, receive in enumerate(partition.receives)
            ),
        )
        for p, partition in enumerate(kind.clocks)
    )
    sends = tuple(replace(send, send=result["send", p, 0]) for p, send in enumerate(kind.sends))
    return replace(kind, derivative=result["derivative", 0, 0], clocks=clocks, sends=sends)
