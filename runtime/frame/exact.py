"""Walk a CasADi function's instructions over any kind of number.

Takes: a CasADi SX Function and arguments that are rationals, intervals, long floats, anything with
arithmetic. Gives: `evaluate_exact`, `is_rational`.
Guarantees: over `Fraction`, sums, products, quotients, whole powers, comparisons and constants are exact.
Does not: evaluate MX functions; transcendental operations over `Fraction` are rounded to double precision.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import casadi

# Functions whose instructions are kept: an analysis walks the same few of a scene's kinds many times, and to
# ask CasADi for them takes longer than the arithmetic.
KEPT = 16
# Of a numerator or denominator: what a thousand factors of 53 bits, each divided by as many, stay well below.
BITS = 2**20

_UNARY: dict[int, Callable[[Any], Any]] = {
    casadi.OP_ASSIGN: lambda a: a,
    casadi.OP_NEG: operator.neg,
    casadi.OP_SQ: lambda a: a * a,
    casadi.OP_TWICE: lambda a: a + a,
    casadi.OP_INV: lambda a: 1 / a,
    casadi.OP_FABS: abs,
    casadi.OP_SIGN: lambda a: (a > 0) - (a < 0),
    casadi.OP_NOT: lambda a: int(a == 0),
    casadi.OP_FLOOR: math.floor,
    casadi.OP_CEIL: math.ceil,
}
_BINARY: dict[int, Callable[[Any, Any], Any]] = {
    casadi.OP_ADD: operator.add,
    casadi.OP_SUB: operator.sub,
    casadi.OP_MUL: operator.mul,
    casadi.OP_FMIN: min,
    casadi.OP_FMAX: max,
    casadi.OP_LT: lambda a, b: int(a < b),
    casadi.OP_LE: lambda a, b: int(a <= b),
    casadi.OP_EQ: lambda a, b: int(a == b),
    casadi.OP_NE: lambda a, b: int(a != b),
    casadi.OP_AND: lambda a, b: int(a != 0 and b != 0),
    casadi.OP_OR: lambda a, b: int(a != 0 or b != 0),
    # The product with a condition: zero whatever b is, when the condition is false.
    casadi.OP_IF_ELSE_ZERO: lambda a, b: b if a != 0 else 0 * b,
}
_ROUNDED: dict[int, Callable[[float], float]] = {
    casadi.OP_SQRT: math.sqrt,
    casadi.OP_EXP: math.exp,
    casadi.OP_LOG: math.log,
    casadi.OP_SIN: math.sin,
    casadi.OP_COS: math.cos,
    casadi.OP_TAN: math.tan,
    casadi.OP_ASIN: math.asin,
    casadi.OP_ACOS: math.acos,
    casadi.OP_ATAN: math.atan,
    casadi.OP_SINH: math.sinh,
    casadi.OP_COSH: math.cosh,
    casadi.OP_TANH: math.tanh,
}


def evaluate_exact(
    function: Any,
    arguments: Sequence[Sequence[Any]],
    *,
    number: Callable[[float], Any] = Fraction,
    rounded: Callable[[str, Any], Any] | None = None,
    rules: Mapping[int, Callable[..., Any]] | None = None,
) -> list[list[Any]]:
    """Evaluate an SX function instruction by instruction over another number type.

    Parameters
    ----------
    function
        A `casadi.Function` built from SX; its arguments dense.
    arguments
        One sequence of numbers an argument, in the function's order, one number a nonzero (column-major).
    number
        Turns the function's own constants (doubles, taken as exact) into the number type.
    rounded
        Evaluates a transcendental function, by its name in `math`, in the number type. Left out, its
        value is rounded to a double first.
    rules
        Operations, by CasADi's code, that this kind of number does in another way than Python's numbers.

    Returns
    -------
    One list an output, one number a structural nonzero of that output.

    Raises
    ------
    ValueError
        The function holds an operation this walk does not know, or one without a value.
    OverflowError
        A rational number takes more than BITS bits.
    """
    work: list[Any] = [None] * function.sz_w()
    results: list[list[Any]] = [[number(0.0)] * function.nnz_out(i) for i in range(function.n_out())]
    own = rules or {}

    def transcendental(code: int, a: Any) -> Any:
        function_of = _ROUNDED[code]
        return rounded(function_of.__name__, a) if rounded else number(function_of(float(a)))

    for code, inputs, outputs, constant in _instructions(function):
        if code == casadi.OP_INPUT:
            work[outputs[0]] = arguments[inputs[0]][inputs[1]]
        elif code == casadi.OP_OUTPUT:
            results[outputs[0]][outputs[1]] = work[inputs[0]]
        elif code == casadi.OP_CONST:
            if math.isnan(constant) and code not in own:
                raise ValueError("math domain error")  # of constants alone, which CasADi evaluates at once
            work[outputs[0]] = own[code](constant) if code in own else number(constant)
        elif code in own:
            work[outputs[0]] = own[code](*(work[place] for place in inputs))
        elif code == casadi.OP_DIV:
            work[outputs[0]] = _short(_quotient(work[inputs[0]], work[inputs[1]]))
        elif code in (casadi.OP_POW, casadi.OP_CONSTPOW):
            work[outputs[0]] = _power(work[inputs[0]], work[inputs[1]], number)
        elif code in _UNARY:
            work[outputs[0]] = _short(_UNARY[code](work[inputs[0]]))
        elif code in _BINARY:
            work[outputs[0]] = _short(_BINARY[code](work[inputs[0]], work[inputs[1]]))
        elif code in _ROUNDED:
            work[outputs[0]] = transcendental(code, work[inputs[0]])
        else:
            raise ValueError(f"no exact rule for CasADi operation {code} in {function.name()}")
    return results


def is_rational(function: Any) -> bool:
    """Say whether a function's value over `Fraction` is exact: no step of it is rounded to a double."""
    if not function.is_a("SXFunction"):
        return False
    constants: dict[int, float] = {}
    for code, inputs, outputs, constant in _instructions(function):
        if code == casadi.OP_CONST:
            constants[outputs[0]] = constant
            continue
        if code in (casadi.OP_POW, casadi.OP_CONSTPOW):
            exponent = constants.get(inputs[1], 0.5)
            if exponent != int(exponent):
                return False
        elif code in _ROUNDED:
            return False
        if code != casadi.OP_OUTPUT:
            constants.pop(outputs[0], None)
    return True


@functools.lru_cache(maxsize=KEPT)
def _instructions(function: Any) -> tuple[tuple[int, list[int], list[int], float], ...]:
    """Return each instruction of an SX function: its code, where it reads and writes, and its constant."""
    listed = []
    for index in range(function.n_instructions()):
        code = function.instruction_id(index)
        constant = function.instruction_constant(index) if code == casadi.OP_CONST else 0.0
        listed.append((code, function.instruction_input(index), function.instruction_output(index), constant))
    return tuple(listed)


def _quotient(above: Any, below: Any) -> Any:
    """Return a quotient; that of two conditions, which are whole numbers, is a rational too."""
    return Fraction(above, below) if isinstance(above, int) and isinstance(below, int) else above / below


def _short(value: Any) -> Any:
    """Return a value, unless it is a rational number of digits without end: a square squared and so on."""
    if _bits(value) > BITS:
        raise OverflowError(f"a number of more than {BITS} bits")
    return value


def _bits(value: Any) -> int:
    if not isinstance(value, int | Fraction):
        return 0
    return max(value.numerator.bit_length(), value.denominator.bit_length())


def _power(base: Any, exponent: Any, number: Callable[[float], Any]) -> Any:
    """Return base**exponent, exactly when the exponent is whole."""
    if exponent == int(exponent):
        if _bits(base) * abs(int(exponent)) > BITS and abs(base) != 1:
            raise OverflowError(f"a number of more than {BITS} bits")
        return base ** int(exponent)
    if base < 0:
        raise ValueError("math domain error")  # as of math.sqrt; Python's own power is complex
    return number(float(base) ** float(exponent))
