"""CasADi functions as plain data, and back: CasADi's own reader is never applied to file contents.

Takes: the functions of a peer type, or the JSON of one. Gives: `PlainFunction`, `straight`; `walk`, `RULES`,
`ROUNDED`, `symbolic`: its operations over any number type; `AlgebraicLoop`, `composed`.
Guarantees: a function is arithmetic from a short list of operations on its inputs and constants, and for each
nonlinear loop Newton's iteration with fixed options. Data are checked completely before a function is built,
so that an untrusted text can build no other function, and none larger than the text. A round trip returns the
same data.
Does not: interpret functions.

CasADi's serialization can hold compilers to call and libraries to load, with options, and CasADi trusts it.

Values are numbered: first the entries of the inputs in order, then the constants, the tables, and then the
operations, each with the numbers of its operands; "interpolate" and "slope" take a table and an abscissa.
With loops, `given[k]` maps the inputs and the solutions of the loops before the k-th to its start value and
parameters; the result is a function of the inputs and all loop solutions.
"""

from __future__ import annotations

import functools
import itertools
import math
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi

from apc.compiler.interpolation import TABLE, Interpolation, function_of, table_of

READ, SLOPE = "interpolate", "slope"  # of a table, whose number comes first, and of its lines


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
    READ: Interpolation.value,
    SLOPE: Interpolation.slope,
}

# Those that have no rational value of a rational number.
ROUNDED: dict[str, Callable[..., float]] = {
    name: getattr(math, name)
    for name in (
        *("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
        "atan2",
    )
}
_CODES = {
    word: getattr(casadi, f"OP_{word.upper()}")
    for word in (*RULES, *ROUNDED, "pow", "constpow")
    if word not in (READ, SLOPE)
}
_NAMES = {code: word for word, code in _CODES.items()}
# CasADi's Newton iteration ends before it takes a step smaller than this, in SI. That step is taken
# afterwards and squares the error: the rest is rounding. A bound on the residual would depend on its scale.
POLISH = "polish"  # the name of that step
NEWTON = {"abstol": 0.0, "abstolStep": 1e-11, "max_iter": 100, "show_eval_warnings": False}


@dataclass(frozen=True, slots=True)
class PlainFunction:
    """A function of columns to columns.

    `inputs` are (name, number of entries); `operations` are (word, value) or (word, value, value); `results`
    the values that make up each output; `tables` the tables that some of them look up.
    """

    inputs: tuple[tuple[str, int], ...]
    constants: tuple[float, ...]
    operations: tuple[tuple[Any, ...], ...]
    results: tuple[tuple[int, ...], ...]
    tables: tuple[Interpolation, ...] = ()


def walk(
    function: PlainFunction, values: Iterable[Any], rule: Callable[[str], Callable[..., Any]]
) -> list[Any]:
    """Return a function's values in any kind of number: those of its inputs and constants, then all others.

    Parameters
    ----------
    function
        The function.
    values
        The entries of its inputs, then its constants; its tables follow as they are.
    rule
        The operations for this number type.
    """
    result = [*values, *function.tables]
    for word, *locations in function.operations:
        result.append(rule(word)(*(result[index] for index in locations)))
    return result


@functools.cache
def symbolic(word: str) -> Callable[..., Any]:
    """Return the CasADi expression of an operation."""
    if word == READ:
        return lambda table, at: function_of(table)(at)
    return lambda *operands: (casadi.SX.unary if len(operands) == 1 else casadi.SX.binary)(
        _CODES[word], *operands
    )


@dataclass(frozen=True, slots=True)
class AlgebraicLoop:
    """A nonlinear loop: `given(…) -> (begin (n,), q (m,))`, `residual(z (n,), q (m,)) -> (n,)`, zero at z."""

    given: Any  # casadi.Function
    residual: Any  # casadi.Function


def composed(name: str, loops: Sequence[AlgebraicLoop], result: Any, words: Sequence[str]) -> Any:
    """Return the function that solves loops one after another and then gives a result.

    Parameters
    ----------
    name
        The function's name.
    loops, result
        SX functions of the inputs and of the solutions of the loops before.
    words
        The names of the inputs.
    """
    inputs = [casadi.MX.sym(word, result.numel_in(index)) for index, word in enumerate(words)]
    outcome: list[Any] = []
    for index, loop in enumerate(loops):
        begin, q = loop.given.call([*inputs, *outcome])
        z, given = (casadi.SX.sym(word, loop.residual.numel_in(i)) for i, word in enumerate("zq"))
        residual = loop.residual(z, given)
        solver = casadi.rootfinder(f"loop{index}", "newton", {"x": z, "p": given, "g": residual}, NEWTON)
        last_step = casadi.solve(casadi.jacobian(residual, z), residual)
        polish = casadi.Function(POLISH, [z, given], [z - last_step])
        outcome.append(polish(solver(x0=begin, p=q)["x"], q))
    outputs = result.call([*inputs, *outcome])
    return casadi.Function(name, inputs, outputs, list(words), result.name_out())


def straight(function: Any) -> PlainFunction:
    """Return an SX function's data, with the nonzeros of sparse values."""
    inputs = tuple((word, int(function.nnz_in(i))) for i, word in enumerate(function.name_in()))
    starts = [0, *itertools.accumulate(size for _, size in inputs)]
    codes = [function.instruction_id(k) for k in range(function.n_instructions())]
    # By their text zeros of both signs are two constants, and NaN is one.
    texts = {
        k: repr(function.instruction_constant(k)) for k, code in enumerate(codes) if code == casadi.OP_CONST
    }
    called = _called(function, [k for k, code in enumerate(codes) if code == casadi.OP_CALL])
    constants, tables = dict.fromkeys(texts.values()), dict.fromkeys(table for _, table in called.values())
    number = {item: starts[-1] + index for index, item in enumerate((*constants, *tables))}
    work = [0] * function.sz_w()
    operations: list[tuple[Any, ...]] = []
    results = [[0] * function.nnz_out(i) for i in range(function.n_out())]

    def add(*operation: Any) -> int:
        operations.append(operation)
        return starts[-1] + len(number) + len(operations) - 1

    for k, code in enumerate(codes):
        used, given = function.instruction_input(k), function.instruction_output(k)
        if code == casadi.OP_OUTPUT:
            results[given[0]][given[1]] = work[used[0]]
            continue
        if code == casadi.OP_INPUT:
            value = starts[used[0]] + used[1]
        elif code == casadi.OP_CONST:
            value = number[texts[k]]
        elif code == casadi.OP_CALL:
            name, table = called[k]
            value = add(READ if name == TABLE else SLOPE, number[table], work[used[0]])
            if name != TABLE:  # a derivative, of any order, is the slope times what it is taken by
                value = add("mul", value, work[used[-1]])
        elif code in _NAMES:
            value = add(_NAMES[code], *(work[index] for index in used))
        else:
            raise ValueError(f"CasADi's operation {code} of {function.name()} is none of ours")
        work[given[0]] = value
    outputs = tuple(map(tuple, results))
    return PlainFunction(inputs, tuple(map(float, constants)), tuple(operations), outputs, tuple(tables))


def _called(function: Any, calls: Sequence[int]) -> dict[int, tuple[str, Interpolation]]:
    """Return the functions called by an SX function's call instructions, and the interpolated table."""
    expressions: Any = function.instructions_sx() if calls else None
    known: dict[bytes, Interpolation] = {}  # of equal rows, which are one table
    result = {}
    for k in calls:
        item = expressions[k].which_function()
        table = table_of(item)
        result[k] = item.name(), known.setdefault(table.times.tobytes() + table.numbers.tobytes(), table)
    return result
