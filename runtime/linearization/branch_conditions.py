"""The decisions in a peer's equations: comparisons, max, min, abs and sign of variables.

Takes: a peer type of a `Model`.
Gives: `Decision`, `SwitchedPeerType`, `functions_of`, `find_switches`, `bound_peer_type`,
`decided_peer_type`.
Guarantees: found in the equations themselves: a comparison, an `if`, a `max`, `min`, `abs`, `sign` or `floor`
of something that moves is a decision, whatever the part is called.
Does not: compute the pieces that a motion can reach, or treat switches by time and parameters alone.

Each decision becomes a number d, 0 or 1 (c a condition):

    c: d     max(a, b), min(a, b): d a + (1 − d) b     |a|: (2 d − 1) a     sign(a): 2 d − 1

With all d set, the remaining equations have the slopes of one piece.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi

from apc.compiler.compiled import PeerType
from apc.compiler.expression_data import READ, straight, symbolic, walk
from apc.compiler.interpolation import Interpolation

# Equal, not equal: a variable is equal to a value at isolated instants only.
_POINTS = ("eq", "ne")
# Decisions whose symbol is 1 where the guard is positive; of all others it is where the guard is negative.
_ABOVE = ("fmax", "sign")
# Peer types with cached decisions.
CACHE_SIZE = 64


@dataclass(frozen=True, slots=True, eq=False)
class Decision:
    """A decision: its symbol, the names of the rows that it changes, and its `guard`, zero at the
    switching point.

    The symbol is 1 where the guard is positive if `above`, where the guard is zero if `point`, else where it
    is negative. A guard may depend on the symbols of earlier decisions. A decision at a point alone belongs
    to no piece.
    """

    symbol: Any  # casadi.SX
    changes: tuple[str, ...]
    guard: Any  # casadi.SX
    above: bool
    point: bool

    def holds(self, guard: Any) -> Any:
        """Return whether the decision is taken at values of its guard: numbers, or symbols of CasADi."""
        return guard == 0 if self.point else guard > 0 if self.above else guard < 0


@dataclass(frozen=True, slots=True, eq=False)
class _DecidedFunction:
    """A function with its decisions as symbols: its location `where`, its inputs, its output column.

    `rows` name the rows of its output; a function of many variants repeats them.
    """

    where: tuple[str, int, int]  # ("derivative" | "tick" | "send" | "edge", partition, receive)
    inputs: tuple[Any, ...]  # casadi.SX
    output: Any  # casadi.SX
    rows: tuple[str, ...]

    def names(self, expression: Any, symbol: Any) -> list[str]:
        """Return the names of the output rows in which an expression depends on a symbol, each once."""
        rows = [row for row in range(expression.size1()) if casadi.depends_on(expression[row, :], symbol)]
        return list(dict.fromkeys(self.rows[row % len(self.rows)] for row in rows))


@dataclass(frozen=True, slots=True, eq=False)
class SwitchedPeerType:
    """A peer type with symbols for its decisions.

    `walkable` is False if a nonlinear loop hides the decisions.

    All functions share the symbols of `columns`, by name: x, u, p, t, and m, r and s of each clock and link.
    """

    peer_type: PeerType
    decisions: tuple[Decision, ...]
    functions: tuple[_DecidedFunction, ...]
    walkable: bool
    columns: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class _Step:
    """A value of the walk through a function.

    `number` is equal for equal expressions. `moves` states that the value depends on the motion, `decided`
    that it depends on a decision.
    """

    expression: Any  # casadi.SX
    number: int
    moves: bool
    decided: bool


class _DecisionWalk:
    """Replaces decisions in the functions of one peer type by symbols; equal decisions share a symbol."""

    def __init__(self) -> None:
        self.numbers: dict[Any, int] = {}
        self.symbols: dict[int, Any] = {}
        self.operands: dict[int, list[Any]] = {}
        self.words: dict[int, str] = {}
        self.columns: dict[str, Any] = {}

    def number(self, key: Any) -> int:
        """Return the number of an expression by its key: operation and operands; a new number at its first
        use.
        """
        return self.numbers.setdefault(key, len(self.numbers))

    def decide(self, word: str, operands: Sequence[_Step]) -> _Step:
        """Return the symbol of a decision between operands, as a step of the walk."""
        number = self.number(("decision", word, *(operand.number for operand in operands)))
        if number not in self.symbols:
            self.symbols[number] = casadi.SX.sym(f"d{len(self.symbols)}")
            self.operands[number] = [operand.expression for operand in operands]
            self.words[number] = word
        return _Step(self.symbols[number], number, moves=False, decided=True)

    def open(self, function: Any, names: Sequence[str]) -> tuple[tuple[Any, ...], Any]:
        """Return the inputs and the output column of a function with its decisions as symbols.

        `names` are the names of the arguments; "p" and "t" do not vary with the motion.
        """
        plain_function = straight(function)
        for index, name in enumerate(names):
            if name not in self.columns:
                self.columns[name] = casadi.SX.sym(name, function.sparsity_in(index))
        inputs = tuple(self.columns[name] for name in names)
        steps = [
            _Step(entry, self.number((name, index)), name not in ("p", "t"), decided=False)
            for name, expression in zip(names, inputs, strict=True)
            for index, entry in enumerate(casadi.vertsplit(expression.nz[:]) if expression.nnz() else [])
        ]
        steps += [
            _Step(casadi.SX(value), self.number(("constant", value)), False, False)
            for value in plain_function.constants
        ]
        result = walk(
            plain_function,
            steps,
            lambda word: self.interpolate if word == READ else functools.partial(self.apply, word),
        )
        results = [result[index].expression for index in plain_function.results[0]]
        column = casadi.SX(function.sparsity_out(0), casadi.vertcat(*results)) if results else casadi.SX(0, 1)
        return inputs, casadi.densify(column)

    def interpolate(self, table: Interpolation, argument: _Step) -> _Step:
        """Return the value of an interpolation table as a step of the walk; a table is no decision."""
        number = self.number((READ, table, argument.number))
        return _Step(symbolic(READ)(table, argument.expression), number, argument.moves, argument.decided)

    def apply(self, word: str, *operands: _Step) -> _Step:
        """Return the result of an operation, or of the decision that it makes, as a step of the walk."""
        number = self.number((word, *(operand.number for operand in operands)))
        moves = any(operand.moves for operand in operands)
        decided = any(operand.decided for operand in operands)
        values = [operand.expression for operand in operands]
        if moves and word in ("lt", "le"):
            return self.decide(word, operands)
        if moves and word in _POINTS:
            equal = self.decide("eq", operands)
            return equal if word == "eq" else _Step(1 - equal.expression, number, False, True)
        if moves and word in ("fmin", "fmax"):
            d = self.decide(word, operands).expression
            return _Step(_branch(d, *values), number, True, True)
        if moves and word in ("floor", "ceil"):
            # Next to a whole number n, floor(z) is n − (z < n) and ceil(z) is n + (n < z).
            nearest = casadi.floor(values[0] + 0.5)
            nearest_integer = _Step(nearest, self.number(("nearest", operands[0].number)), False, decided)
            pair = (operands[0], nearest_integer) if word == "floor" else (nearest_integer, operands[0])
            d = self.decide("lt", pair).expression
            return _Step(nearest - d if word == "floor" else nearest + d, number, False, True)
        if moves and word in ("fabs", "sign"):
            d = self.decide("sign", operands).expression
            value = _branch(d, values[0], -values[0]) if word == "fabs" else 2 * d - 1
            return _Step(value, number, word == "fabs", True)
        if word == "if_else_zero" and operands[0].decided:
            return _Step(symbolic(word)(*values), number, moves, True)
        return _Step(symbolic(word)(*values), number, moves, decided)


def _branch(decision: Any, then: Any, otherwise: Any) -> Any:
    """Return a choice between two expressions; the expression not chosen may be infinite."""
    choose = symbolic("if_else_zero")
    return choose(decision, then) + choose(1 - decision, otherwise)


@functools.lru_cache(maxsize=CACHE_SIZE)
def find_switches(peer_type: PeerType) -> SwitchedPeerType:
    """Return the peer type with symbols for its decisions, cached."""
    functions = functions_of(peer_type)
    if not all(function.is_a("SXFunction") for _, function, _, _ in functions):
        return SwitchedPeerType(peer_type, (), (), walkable=False, columns={})
    decision_walk = _DecisionWalk()
    decided_functions = tuple(
        _DecidedFunction(where, *decision_walk.open(function, names), rows)
        for where, function, names, rows in functions
    )
    decisions = []
    for number, symbol in decision_walk.symbols.items():
        changed_outputs: dict[str, None] = {}
        for item in decided_functions:
            if casadi.depends_on(item.output, symbol):
                changed_outputs |= dict.fromkeys(
                    _changed_outputs(peer_type, item, symbol, decision_walk.operands[number])
                )
        first, *other_operands = decision_walk.operands[number]
        # Of a sign there is one operand.
        guard, word = first - other_operands[0] if other_operands else first, decision_walk.words[number]
        names = () if word == "eq" else tuple(changed_outputs)
        decisions.append(Decision(symbol, names, guard, word in _ABOVE, word == "eq"))
    return SwitchedPeerType(
        peer_type, tuple(decisions), decided_functions, walkable=True, columns=decision_walk.columns
    )


def functions_of(
    peer_type: PeerType,
) -> list[tuple[tuple[str, int, int], Any, tuple[str, ...], tuple[str, ...]]]:
    """Return a peer type's functions: location, function, and names of arguments and rows of each."""
    states = tuple(state.name for state in peer_type.states)
    functions: list[tuple[tuple[str, int, int], Any, tuple[str, ...], tuple[str, ...]]] = [
        (("derivative", 0, 0), peer_type.derivative, ("x", "u", "p", "t"), states)
    ]
    for p, partition in enumerate(peer_type.clocks):
        names = ("x", "u", f"m{p}", f"r{p}", "p", "t")
        functions.append((("tick", p, 0), partition.tick, names, partition.outputs))
        for index, receive in enumerate(partition.receives):
            if receive.edge is not None:
                sent = f"s{receive.edge.numel_in(3)} {receive.link}"  # an age may be a further row
                edge = ("x", "u", f"m{p}", sent, "p", "t")
                functions.append((("edge", p, index), receive.edge, edge, (receive.name,)))
    functions += [
        (("send", p, 0), send.send, ("x", "u", "p", "t"), send.channels)
        for p, send in enumerate(peer_type.sends)
    ]
    return functions


def _changed_outputs(
    peer_type: PeerType, function: _DecidedFunction, symbol: Any, operands: Sequence[Any]
) -> list[str]:
    """Return the names of the outputs of a function that depend on a decision.

    Parameters
    ----------
    peer_type, function
        The peer type, and one of its functions with symbols for decisions.
    symbol, operands
        The symbol of the decision, and the expressions that it compares.
    """
    subject, p, index = function.where
    changed = function.names(function.output, symbol)
    if subject == "edge":  # outputs that depend on the received value
        partition = peer_type.clocks[p]
        inputs = partition.tick.sx_in()
        computed = partition.tick(*inputs)
        tick = _DecidedFunction(("tick", p, 0), tuple(inputs), computed, partition.outputs)
        return tick.names(computed, inputs[3][index])
    if subject != "derivative":
        return changed
    # A continuous force has no name in the equations of motion; the part whose parameters decide has.
    symbols = casadi.vertsplit(function.inputs[2]) if peer_type.parameters else []
    moving = {state.name.rpartition(".")[0] for state in peer_type.states}
    owners = dict.fromkeys(
        name.rpartition(".")[0]
        for name, parameter in zip(peer_type.parameters, symbols, strict=True)
        if any(casadi.depends_on(operand, parameter) for operand in operands)
    )
    return [owner for owner in owners if owner and owner not in moving] or changed


def bound_peer_type(switched: SwitchedPeerType, settings: Mapping[int, bool]) -> PeerType:
    """Return the peer type with its decisions set to 0 or 1; decisions not in `settings` are 0."""
    numbers = [casadi.SX(float(settings.get(index, False))) for index in range(len(switched.decisions))]
    return decided_peer_type(switched, numbers)


def decided_peer_type(switched: SwitchedPeerType, values: Sequence[Any]) -> PeerType:
    """Return the peer type with an expression (casadi.SX) for each decision's symbol."""
    symbols = casadi.vertcat(*(decision.symbol for decision in switched.decisions))
    result: dict[tuple[str, int, int], Any] = {}
    for function in switched.functions:
        output = (
            casadi.substitute(function.output, symbols, casadi.vertcat(*values))
            if switched.decisions
            else function.output
        )
        result[function.where] = casadi.Function(
            function.where[0], list(function.inputs), [casadi.sparsify(output)]
        )
    peer_type = switched.peer_type
    clocks = tuple(
        replace(
            partition,
            tick=result["tick", p, 0],
            receives=tuple(
                replace(receive, edge=result["edge", p, index]) if receive.edge is not None else receive
                for index, receive in enumerate(partition.receives)
            ),
        )
        for p, partition in enumerate(peer_type.clocks)
    )
    sends = tuple(replace(send, send=result["send", p, 0]) for p, send in enumerate(peer_type.sends))
    return replace(peer_type, derivative=result["derivative", 0, 0], clocks=clocks, sends=sends)
