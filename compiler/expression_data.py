"""CasADi functions as plain data and the reverse, without CasADi's deserialization of file contents.

Takes: the functions of a peer type. Gives: `PlainFunction`, `straight`; `walk`, `RULES`,
`ROUNDED`, `symbolic`: its operations over any number type; `AlgebraicLoop`, `composed`.
Guarantees: a function is arithmetic from a short list of operations on its inputs and constants, and for each
nonlinear loop Newton's iteration with fixed options. Data are checked completely before a function is built,
so that an untrusted text can build no other function, and none larger than the text. A round trip returns the
same data.
Does not: interpret functions.

CasADi's serialization can contain calls of compilers and libraries, which CasADi executes without checks.

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

READ, SLOPE = "interpolate", "slope"  # value and slope of a table, which is the first operand


def _quotient(numerator: Any, denominator: Any) -> Any:
    """Return a quotient; the quotient of two integers (conditions) is a rational number."""
    return (
        Fraction(numerator, denominator)
        if isinstance(numerator, int) and isinstance(denominator, int)
        else numerator / denominator
    )


# The operations on Python's numbers and number types with the same operators, without the power, which every
# number type defines differently. A condition is 0 or 1.
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
    # The product with a condition: zero for every b if the condition is false.
    "if_else_zero": lambda a, b: b if a != 0 else 0 * b,
    READ: Interpolation.value,
    SLOPE: Interpolation.slope,
}

# Operations whose value for a rational number is not rational.
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
# CasADi's Newton iteration ends before a step smaller than `abstolStep`, in SI units. A last step is added,
# which squares the error, so that only rounding errors remain. A bound on the residual would depend on its
# scale.
POLISH = "polish"  # the name of the last step
NEWTON = {"abstol": 0.0, "abstolStep": 1e-11, "max_iter": 100, "show_eval_warnings": False}


@dataclass(frozen=True, slots=True)
class PlainFunction:
    """A function of columns to columns.

    `inputs` are (name, number of entries); `operations` are (word, value) or (word, value, value); `results`
    are the indices of the values in each output; `tables` the tables used by operations.
    """

    inputs: tuple[tuple[str, int], ...]
    constants: tuple[float, ...]
    operations: tuple[tuple[Any, ...], ...]
    results: tuple[tuple[int, ...], ...]
    tables: tuple[Interpolation, ...] = ()


def walk(
    function: PlainFunction, values: Iterable[Any], rule: Callable[[str], Callable[..., Any]]
) -> list[Any]:
    """Return all values of a function in some number type: inputs, constants, tables and operations,
    in order.

    Parameters
    ----------
    function
        The function.
    values
        The entries of the inputs, then the constants.
    rule
        The operations for this number type.
    """
    result = [*values, *function.tables]
    for word, *locations in function.operations:
        result.append(rule(word)(*(result[index] for index in locations)))
    return result


@functools.cache
def symbolic(word: str) -> Callable[..., Any]:
    """Return the CasADi expression of an operation, as a function of its operands."""
    if word == READ:
        return lambda table, time: function_of(table)(time)
    return lambda *operands: (casadi.SX.unary if len(operands) == 1 else casadi.SX.binary)(
        _CODES[word], *operands
    )


@dataclass(frozen=True, slots=True)
class AlgebraicLoop:
    """A nonlinear loop: find z with `residual(z (n,), q (m,)) -> (n,)` equal to zero.

    `given(…) -> (begin (n,), q (m,))` computes the start value and the parameters.
    """

    given: Any  # casadi.Function
    residual: Any  # casadi.Function


def composed(name: str, loops: Sequence[AlgebraicLoop], result: Any, words: Sequence[str]) -> Any:
    """Return the function that solves loops in sequence by Newton's iteration, then computes a result.

    Parameters
    ----------
    name
        The name of the function.
    loops, result
        SX functions of the inputs and of the solutions of the previous loops.
    words
        The names of the inputs.
    """
    inputs = [casadi.MX.sym(word, result.numel_in(index)) for index, word in enumerate(words)]
    solutions: list[Any] = []
    for index, loop in enumerate(loops):
        begin, q = loop.given.call([*inputs, *solutions])
        z, given = (casadi.SX.sym(word, loop.residual.numel_in(i)) for i, word in enumerate("zq"))
        residual = loop.residual(z, given)
        solver = casadi.rootfinder(f"loop{index}", "newton", {"x": z, "p": given, "g": residual}, NEWTON)
        last_step = casadi.solve(casadi.jacobian(residual, z), residual)
        polish = casadi.Function(POLISH, [z, given], [z - last_step])
        solutions.append(polish(solver(x0=begin, p=q)["x"], q))
    outputs = result.call([*inputs, *solutions])
    return casadi.Function(name, inputs, outputs, list(words), result.name_out())


def straight(function: Any) -> PlainFunction:
    """Return the data of an SX function; sparse values are represented by their nonzeros."""
    inputs = tuple((word, int(function.nnz_in(i))) for i, word in enumerate(function.name_in()))
    starts = [0, *itertools.accumulate(size for _, size in inputs)]
    codes = [function.instruction_id(k) for k in range(function.n_instructions())]
    # Constants are distinguished by their text: zeros of both signs differ, all NaNs are equal.
    texts = {
        k: repr(function.instruction_constant(k)) for k, code in enumerate(codes) if code == casadi.OP_CONST
    }
    called = _called_tables(function, [k for k, code in enumerate(codes) if code == casadi.OP_CALL])
    constants, tables = dict.fromkeys(texts.values()), dict.fromkeys(table for _, table in called.values())
    number = {item: starts[-1] + index for index, item in enumerate((*constants, *tables))}
    work = [0] * function.sz_w()
    operations: list[tuple[Any, ...]] = []
    results = [[0] * function.nnz_out(i) for i in range(function.n_out())]

    def add(*operation: Any) -> int:
        """Add an operation, and return the index of its value."""
        operations.append(operation)
        return starts[-1] + len(number) + len(operations) - 1

    for k, code in enumerate(codes):
        operands, targets = function.instruction_input(k), function.instruction_output(k)
        if code == casadi.OP_OUTPUT:
            results[targets[0]][targets[1]] = work[operands[0]]
            continue
        if code == casadi.OP_INPUT:
            value = starts[operands[0]] + operands[1]
        elif code == casadi.OP_CONST:
            value = number[texts[k]]
        elif code == casadi.OP_CALL:
            name, table = called[k]
            value = add(READ if name == TABLE else SLOPE, number[table], work[operands[0]])
            if name != TABLE:  # a derivative of any order is the slope times the derivative of the time
                value = add("mul", value, work[operands[-1]])
        elif code in _NAMES:
            value = add(_NAMES[code], *(work[index] for index in operands))
        else:
            raise ValueError(f"CasADi's operation {code} of {function.name()} is none of ours")
        work[targets[0]] = value
    outputs = tuple(map(tuple, results))
    return PlainFunction(inputs, tuple(map(float, constants)), tuple(operations), outputs, tuple(tables))


def _called_tables(function: Any, calls: Sequence[int]) -> dict[int, tuple[str, Interpolation]]:
    """Return the name and the table of the functions called by an SX function, by instruction index."""
    expressions: Any = function.instructions_sx() if calls else None
    known: dict[bytes, Interpolation] = {}  # tables with equal rows are the same table
    result = {}
    for k in calls:
        item = expressions[k].which_function()
        table = table_of(item)
        result[k] = item.name(), known.setdefault(table.times.tobytes() + table.numbers.tobytes(), table)
    return result
