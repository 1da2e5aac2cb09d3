"""CasADi functions as plain data, and back: nothing that a file says is given to CasADi's own reader.

Takes: the functions of a kind, or the JSON of one. Gives: `PlainFunction`, `plain`, `straight`,
`read_function`; `walk`, `RULES`, `ROUNDED`, `symbolic`: its operations over any kind of number; `Loop`,
`composed`.
Guarantees: a function is arithmetic from a short list of operations on its inputs and constants, and for each
nonlinear loop Newton's iteration with options of our own; what is read is checked in full before anything is
built, so that text from anywhere can build no other function, and none larger than the text. What is built
again from its own data gives the same data.
Does not: know what a function is for.

CasADi's serialization can hold compilers to call and libraries to load, with options, and CasADi trusts it.

Values are numbered: first the entries of the inputs in order, then the constants, the tables, and then the
operations, each of which names the values before it that it takes; "interpolate" and "slope" take a table and
where in it. With loops, `given[k]` takes the inputs and what the loops
before the k-th found, and gives where its iteration begins and what it depends on; the result takes the
inputs and what all the loops found.
"""

from __future__ import annotations

import functools
import math
import operator
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np

from apc.compiler.interpolation import TABLE, Interpolation, function_of, table_of

_UNARY = {
    name: getattr(casadi, f"OP_{name.upper()}")
    for name in (
        *("neg", "sq", "twice", "inv", "sqrt", "exp", "log", "fabs", "sign", "floor", "ceil", "not"),
        *("sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
    )
}
_BINARY = {
    name: getattr(casadi, f"OP_{name.upper()}")
    for name in (
        *("add", "sub", "mul", "div", "pow", "constpow", "fmin", "fmax", "atan2"),
        *("lt", "le", "eq", "ne", "and", "or", "if_else_zero"),
    )
}
_NAMES = {code: name for name, code in (_UNARY | _BINARY).items()}
LOOK = "interpolate"  # in a table, whose number comes first; "slope" is in what is derived from a function


def _quotient(above: Any, below: Any) -> Any:
    """Return a quotient; that of two conditions, which are whole numbers, is a rational too."""
    return Fraction(above, below) if isinstance(above, int) and isinstance(below, int) else above / below


# What the operations are of Python's numbers, and of all that compute as they do; a power means something
# else in every kind of number. A condition is 0 or 1.
RULES: dict[str, Callable[..., Any]] = {
    "neg": operator.neg,
    "sq": lambda a: a * a,
    "twice": lambda a: a + a,
    "inv": lambda a: 1 / a,
    "fabs": abs,
    "sign": lambda a: (a > 0) - (a < 0),
    "floor": math.floor,
    "ceil": math.ceil,
    "not": lambda a: int(a == 0),
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": _quotient,
    "fmin": min,
    "fmax": max,
    "lt": lambda a, b: int(a < b),
    "le": lambda a, b: int(a <= b),
    "eq": lambda a, b: int(a == b),
    "ne": lambda a, b: int(a != b),
    "and": lambda a, b: int(a != 0 and b != 0),
    "or": lambda a, b: int(a != 0 or b != 0),
    # The product with a condition: zero whatever b is, when the condition is false.
    "if_else_zero": lambda a, b: b if a != 0 else 0 * b,
    "interpolate": lambda table, at: table.value(at, float),
    "slope": lambda table, at: table.slope(at, float),
}

# Those that have no rational value of a rational number.
ROUNDED: dict[str, Callable[..., float]] = {
    name: getattr(math, name)
    for name in (
        *("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
        "atan2",
    )
}
_WORD = re.compile(r"[a-zA-Z][a-zA-Z0-9]*(_[a-zA-Z0-9]+)*\Z", re.ASCII)  # what CasADi takes as a name
LONGEST_WORD = 200
# CasADi's Newton iteration ends before it takes a step smaller than this, in SI. That step is taken
# afterwards and squares the error: the rest is rounding. A bound on the residual would depend on its scale.
NEWTON = {"abstol": 0.0, "abstolStep": 1e-11, "max_iter": 100, "show_eval_warnings": False}

_Columns = tuple[tuple[str, int], ...]  # of each: its name and how many entries it has


@dataclass(frozen=True, slots=True)
class PlainFunction:
    """A function of columns to columns.

    `operations` are (name, value) or (name, value, value); `results` the values that make up each output;
    `tables` what some of them look up.
    `loops` are pairs (given, residual), each without loops; with them the constants, operations and results
    are those of the result, whose further inputs are what the loops find.
    """

    name: str
    inputs: _Columns
    outputs: tuple[str, ...]
    constants: tuple[float, ...]
    operations: tuple[tuple[Any, ...], ...]
    results: tuple[tuple[int, ...], ...]
    loops: tuple[tuple[PlainFunction, PlainFunction], ...] | None
    tables: tuple[Interpolation, ...] = ()

    @property
    def sizes(self) -> tuple[list[int], list[int]]:
        """How many entries each input and each output has."""
        return [rows for _, rows in self.inputs], [len(values) for values in self.results]

    def document(self) -> dict[str, Any]:
        """Return it as JSON's data."""
        loops = self.loops
        return {
            "name": self.name,
            "inputs": [list(one) for one in self.inputs],
            "outputs": list(self.outputs),
            "constants": list(self.constants),
            "operations": [list(one) for one in self.operations],
            "results": [list(one) for one in self.results],
            "loops": None if loops is None else [[one.document() for one in loop] for loop in loops],
            "tables": [[one.times.tolist(), one.numbers.tolist()] for one in self.tables],
        }

    def build(self) -> Any:
        """Return the CasADi function."""
        if self.loops is None:
            return self._straight(self.name, self.inputs)
        built = [Loop(given.build(), residual.build()) for given, residual in self.loops]
        found = tuple((f"z{place}", one.residual.numel_in(0)) for place, one in enumerate(built))
        result = self._straight("result", (*self.inputs, *found))
        return composed(self.name, built, result, [name for name, _ in self.inputs])

    def _straight(self, name: str, inputs: _Columns) -> Any:
        columns = [casadi.SX.sym(word, rows) for word, rows in inputs]
        entries = [entry for column in columns if column.numel() for entry in casadi.vertsplit(column)]
        values = walk(self, [*entries, *map(casadi.SX, self.constants)], symbolic)
        # A structural zero is a zero like another.
        listed = [[values[place] for place in places] for places in self.results]
        results = [casadi.densify(casadi.vertcat(*one)) if one else casadi.SX(0, 1) for one in listed]
        return casadi.Function(name, columns, results, [word for word, _ in inputs], list(self.outputs))


def walk(
    function: PlainFunction, values: Iterable[Any], rule: Callable[[str], Callable[..., Any]]
) -> list[Any]:
    """Return a function's values in any kind of number: those of its inputs and constants, then all others.

    Parameters
    ----------
    function
        A function without loops.
    values
        The entries of its inputs, then its constants; its tables follow as they are.
    rule
        What an operation is in this kind of number.
    """
    found = [*values, *function.tables]
    for word, *places in function.operations:
        found.append(rule(word)(*(found[place] for place in places)))
    return found


@functools.cache
def symbolic(word: str) -> Callable[..., Any]:
    """Return what an operation is of CasADi's expressions."""
    if word == LOOK:
        return lambda table, at: function_of(table)(at)
    unary = word in _UNARY
    return functools.partial(
        casadi.SX.unary if unary else casadi.SX.binary, (_UNARY if unary else _BINARY)[word]
    )


@dataclass(frozen=True, slots=True)
class Loop:
    """A nonlinear loop: `given(…) -> (begin (n,), q (m,))`, `residual(z (n,), q (m,)) -> (n,)`, zero at z."""

    given: Any  # casadi.Function
    residual: Any  # casadi.Function


def composed(name: str, loops: Sequence[Loop], result: Any, words: Sequence[str]) -> Any:
    """Return the function that solves loops one after another and then gives a result.

    Parameters
    ----------
    name
        The function's name.
    loops, result
        SX functions of the inputs and of what the loops before have found.
    words
        The names of the inputs.
    """
    inputs = [casadi.MX.sym(word, result.numel_in(place)) for place, word in enumerate(words)]
    found: list[Any] = []
    for place, loop in enumerate(loops):
        begin, q = loop.given.call([*inputs, *found])
        z, given = (casadi.SX.sym(word, loop.residual.numel_in(i)) for i, word in enumerate("zq"))
        residual = loop.residual(z, given)
        solver = casadi.rootfinder(f"loop{place}", "newton", {"x": z, "p": given, "g": residual}, NEWTON)
        last_step = casadi.solve(casadi.jacobian(residual, z), residual)
        polish = casadi.Function("polish", [z, given], [z - last_step])
        found.append(polish(solver(x0=begin, p=q)["x"], q))
    outputs = result.call([*inputs, *found])
    return casadi.Function(name, inputs, outputs, list(words), result.name_out())


def plain(function: Any) -> PlainFunction:
    """Return a function's plain data: an SX function's, or one's that `composed` made."""
    assert all(function.nnz_out(i) == function.numel_out(i) for i in range(function.n_out()))
    if function.is_a("SXFunction"):
        return straight(function)
    called = [
        function.instruction_MX(k).which_function()
        for k in range(function.n_instructions())
        if function.instruction_id(k) == casadi.OP_CALL
    ]
    by_name = {one.name(): one for one in called}
    loops = [
        (straight(by_name[f"given{k}"]), straight(by_name[f"loop{k}"].oracle()))
        for k in range(sum(name.startswith("given") for name in by_name))
    ]
    result = straight(by_name["result"])
    return PlainFunction(
        function.name(),
        tuple((word, function.numel_in(i)) for i, word in enumerate(function.name_in())),
        result.outputs,
        result.constants,
        result.operations,
        result.results,
        tuple(loops),
        result.tables,
    )


def straight(function: Any) -> PlainFunction:
    """Return an SX function's data, the nonzeros of what is sparse. Raises ValueError if it has none."""
    inputs = tuple((word, int(function.nnz_in(i))) for i, word in enumerate(function.name_in()))
    first = [sum(rows for _, rows in inputs[:i]) for i in range(len(inputs) + 1)]
    instructions = [
        (function.instruction_id(k), function.instruction_input(k), function.instruction_output(k), k)
        for k in range(function.n_instructions())
    ]
    numbers = [function.instruction_constant(k) for code, _, _, k in instructions if code == casadi.OP_CONST]
    constants = {number: first[-1] + place for place, number in enumerate(dict.fromkeys(map(_key, numbers)))}
    called = _tables(function, [k for code, _, _, k in instructions if code == casadi.OP_CALL])
    tables = tuple(dict.fromkeys(table for _, table in called.values()))
    places = {table: first[-1] + len(constants) + place for place, table in enumerate(tables)}
    before = first[-1] + len(constants) + len(tables)
    work = [0] * function.sz_w()
    operations: list[tuple[Any, ...]] = []
    results = [[0] * function.nnz_out(i) for i in range(function.n_out())]
    for code, taken, given, k in instructions:
        if code == casadi.OP_INPUT:
            work[given[0]] = first[taken[0]] + taken[1]
        elif code == casadi.OP_OUTPUT:
            results[given[0]][given[1]] = work[taken[0]]
        elif code == casadi.OP_CONST:
            work[given[0]] = constants[_key(function.instruction_constant(k))]
        elif code == casadi.OP_CALL:
            name, table = called[k]
            at, by = work[taken[0]], work[taken[-1]]
            operations.append((LOOK if name == TABLE else "slope", places[table], at))
            if name != TABLE:  # a derivative, of any order, is the slope times what it is taken by
                operations.append(("mul", before + len(operations) - 1, by))
            work[given[0]] = before + len(operations) - 1
        elif code not in _NAMES:
            raise ValueError(f"CasADi's operation {code} of {function.name()} is none of ours")
        else:
            operations.append((_NAMES[code], *(work[place] for place in taken)))
            work[given[0]] = before + len(operations) - 1
    return PlainFunction(
        function.name(),
        inputs,
        tuple(function.name_out()),
        tuple(float(number) for number in constants),
        tuple(operations),
        tuple(tuple(listed) for listed in results),
        None,
        tables,
    )


def _tables(function: Any, calls: Sequence[int]) -> dict[int, tuple[str, Interpolation]]:
    """Return what an SX function's calls, by their instructions, call, and the table that is looked up."""
    found: dict[int, tuple[str, Interpolation]] = {}
    read: dict[int, Interpolation] = {}  # of each function, which may be called many times
    known: dict[tuple[bytes, bytes], Interpolation] = {}  # of equal rows, which are one table
    expressions: Any = function.instructions_sx() if calls else None
    for k in calls:
        one = expressions[k].which_function()
        if one.__hash__() not in read:
            table = table_of(one)
            rows = table.times.tobytes(), table.numbers.tobytes()
            read[one.__hash__()] = known.setdefault(rows, table)
        found[k] = one.name(), read[one.__hash__()]
    return found


def _key(number: float) -> str:
    return repr(float(number))  # zeros of both signs are two constants; NaN is one


def read_function(document: Any) -> PlainFunction:
    """Return the function that data of JSON tells. Raises ValueError, KeyError or TypeError if none."""
    loops = document["loops"]
    if loops is None:
        return _read(document, ())
    found: list[tuple[str, int]] = []
    pairs: list[tuple[PlainFunction, PlainFunction]] = []
    inputs = _columns(document["inputs"])
    for given, residual in loops:
        one, other = _read(given, ()), _read(residual, ())
        _must(one.inputs == (*inputs, *found) and len(other.inputs) == 2 and len(one.results) == 2)
        n = other.inputs[0][1]
        _must(n > 0 and one.sizes[1] == [n, other.inputs[1][1]] and other.sizes[1] == [n])
        found.append((f"z{len(pairs)}", n))
        pairs.append((one, other))
    return _read(document, tuple(found), tuple(pairs))


def _read(document: Any, found: _Columns, loops: tuple[Any, ...] | None = None) -> PlainFunction:
    inputs = _columns(document["inputs"])
    outputs = tuple(map(_word, document["outputs"]))
    constants = tuple(document["constants"])
    _must(all(type(one) is float for one in constants))
    tables = tuple(map(_table, document["tables"]))
    first = sum(rows for _, rows in (*inputs, *found)) + len(constants)
    count = first + len(tables)
    listed = range(first, count)
    operations = tuple(map(tuple, document["operations"]))
    for word, *places in operations:
        if word == LOOK:
            _must(len(places) == 2 and places[0] in listed)
            del places[0]
        else:
            known = _UNARY if len(places) == 1 else _BINARY
            _must(len(places) in (1, 2) and word in known)
        for place in places:
            _must(type(place) is int and 0 <= place < count and place not in listed)
        count += 1
    results = tuple(map(tuple, document["results"]))
    values = (place for places in results for place in places)
    _must(all(type(place) is int and 0 <= place < count and place not in listed for place in values))
    names = [*outputs, *(name for name, _ in (*inputs, *found))]
    _must(len(outputs) == len(results) and len(set(names)) == len(names))
    _must(loops is not None or document["loops"] is None)
    name = _word(document["name"])
    return PlainFunction(name, inputs, outputs, constants, operations, results, loops, tables)


def _table(rows: Any) -> Interpolation:
    _must(len(rows) == 2 and all(type(one) is float for column in rows for one in column))
    table = Interpolation(*map(np.array, rows))
    _must(table.is_consistent)
    return table


def _columns(listed: Any) -> _Columns:
    columns = tuple((_word(name), rows) for name, rows in listed)
    _must(all(type(rows) is int and rows >= 0 for _, rows in columns))
    return columns


def _word(word: Any) -> str:
    _must(isinstance(word, str) and len(word) <= LONGEST_WORD and bool(_WORD.match(word)))
    return str(word)


def _must(holds: bool) -> None:
    if not holds:
        raise ValueError("no function of plain data")
