"""Evaluation of a CasADi function's operations over any number type.

Takes: a CasADi SX Function and arguments that are rationals, intervals, long floats, arrays, anything with
arithmetic. Gives: `evaluate_exact`, `is_rational`; `ROWS`, NumPy's rules.
Guarantees: over `Fraction`, sums, products, quotients, whole powers, comparisons and constants are exact.
Does not: evaluate MX functions; transcendental operations over `Fraction` are rounded to double precision.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np

from apc.compiler.expression_data import ROUNDED, RULES, PlainFunction, straight, walk

# Functions with cached operations: an analysis evaluates the same few functions many times, and reading the
# operations from CasADi takes longer than the arithmetic.
CACHE_SIZE = 16
# Bits of a numerator or denominator: far above a thousand factors and divisors of 53 bits.
BITS = 2**20


def _row_power(base: Any, exponent: Any) -> Any:
    """Return base^exponent of real or complex-step arrays."""
    b, e = np.real(base), np.real(exponent)
    value = np.float_power(b, e)
    if not (np.iscomplexobj(base) or np.iscomplexobj(exponent)):
        return value
    slope = e * np.float_power(b, e - 1) * np.imag(base)
    exponent_slope = np.imag(exponent)
    if np.any(exponent_slope):
        slope = slope + value * np.log(b) * exponent_slope
    return _step(value, slope)


def _row_quotient(numerator: Any, denominator: Any) -> Any:
    """Return the quotient of real or complex-step arrays.

    A complex step does not avoid a division by zero.
    """
    if not (np.iscomplexobj(numerator) or np.iscomplexobj(denominator)):
        return np.true_divide(numerator, denominator)
    value = np.true_divide(np.real(numerator), np.real(denominator))
    return _step(value, (np.imag(numerator) - value * np.imag(denominator)) / np.real(denominator))


def _row_function(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return an elementary function of complex-step arrays, from one of real arrays.

    The result is NaN where the real part has no value, for complex steps too.
    """

    def value(a: Any) -> Any:
        """Return the function's value, with its slope by the complex step."""
        return _step(function(np.real(a)), np.imag(function(a))) if np.iscomplexobj(a) else function(a)

    return value


def _row_angle(y: Any, x: Any) -> Any:
    """Return atan2(y, x) of real or complex-step arrays."""
    value = np.arctan2(np.real(y), np.real(x))
    if not (np.iscomplexobj(y) or np.iscomplexobj(x)):
        return value
    numerator = np.real(x) * np.imag(y) - np.real(y) * np.imag(x)
    return _step(value, numerator / (np.real(x) ** 2 + np.real(y) ** 2))


def _step(value: Any, slope: Any) -> Any:
    """Return value + i slope, without a product by 1j, which would give NaN where the slope is infinite."""
    values = np.empty(np.broadcast_shapes(np.shape(value), np.shape(slope)), dtype=np.complex128)
    values.real, values.imag = value, slope
    return values


def _on_real_parts(rule: Callable[..., Any]) -> Callable[..., Any]:
    """Return an operation on the real parts of its operands; a condition gives 0 or 1, as in CasADi."""
    return lambda *operands: 1.0 * rule(*map(np.real, operands))


# The operations on NumPy's numbers and arrays, real or complex steps, whose imaginary part is a derivative
# and follows the real part.
ROWS: dict[str, Callable[..., Any]] = {
    **RULES,
    "const": np.float64,  # NaN too: the result is NaN, and reported as such
    "inv": lambda a: _row_quotient(1.0, a),
    "div": _row_quotient,
    "fabs": lambda a: np.where(np.real(a) < 0, -a, a),
    "sign": _on_real_parts(np.sign),
    "floor": _on_real_parts(np.floor),
    "ceil": _on_real_parts(np.ceil),
    "not": _on_real_parts(np.logical_not),
    "fmin": np.fmin,
    "fmax": np.fmax,
    "lt": _on_real_parts(np.less),
    "le": _on_real_parts(np.less_equal),
    "eq": _on_real_parts(np.equal),
    "ne": _on_real_parts(np.not_equal),
    "and": _on_real_parts(np.logical_and),
    "or": _on_real_parts(np.logical_or),
    "if_else_zero": lambda a, b: np.where(np.real(a), b, 0.0),
    "interpolate": lambda table, x: table.values(x),
    "slope": lambda table, x: table.slopes(x),
    "pow": _row_power,
    "constpow": _row_power,
    **{
        name: _row_function(getattr(np, f"arc{name[1:]}" if name.startswith("a") else name))
        for name in ROUNDED
        if name != "atan2"
    },
    "atan2": _row_angle,
}


def evaluate_exact(
    function: Any,
    arguments: Sequence[Sequence[Any]],
    *,
    number: Callable[[float], Any] = Fraction,
    rounded: Callable[..., Any] | None = None,
    rules: Mapping[str, Callable[..., Any]] | None = None,
) -> list[list[Any]]:
    """Evaluate an SX function operation by operation over another number type.

    Parameters
    ----------
    function
        A `casadi.Function` built from SX; its arguments dense.
    arguments
        One sequence of numbers per argument, in the function's order, one number per nonzero (column-major).
    number
        Converts the function's own constants (doubles, taken as exact) into the number type.
    rounded
        Evaluates a transcendental function, by its name in `math` and its operands, in the number type. By
        default, its value is first rounded to a double.
    rules
        Operations, by their names in `expression_data`, that differ from Python's for this number type;
        `const` converts the function's constants, including NaN.

    Returns
    -------
    One list per output, with one number per structural nonzero of the output.

    Raises
    ------
    ValueError
        The function contains an unknown operation, or one without a value.
    OverflowError
        A rational number takes more than BITS bits.
    """
    plain_function = _operations(function)
    operations = _rules_of(number, rounded)
    if rules:
        operations = {**operations, **rules}
    if "const" not in operations and any(map(math.isnan, plain_function.constants)):
        raise ValueError("math domain error")  # of constants alone, which CasADi evaluates
    entries = [
        entry
        for (_, size), argument in zip(plain_function.inputs, arguments, strict=True)
        for entry in _checked_argument(argument, size)
    ]
    constants = map(operations.get("const", number), plain_function.constants)
    result = walk(plain_function, [*entries, *constants], operations.__getitem__)
    return [[result[index] for index in indices] for indices in plain_function.results]


def _checked_argument(argument: Sequence[Any], size: int) -> Sequence[Any]:
    """Return an argument unchanged; its number of entries is asserted."""
    assert len(argument) == size, "an argument of another size"
    return argument


def is_rational(function: Any) -> bool:
    """Return whether a function's value over `Fraction` is exact: no operation is rounded to a double."""
    if not function.is_a("SXFunction"):
        return False
    plain_function = _operations(function)
    input_count = sum(size for _, size in plain_function.inputs)
    constants = dict(enumerate(plain_function.constants, input_count))
    for word, *indices in plain_function.operations:
        if word in ("pow", "constpow"):
            exponent = constants.get(indices[1], 0.5)
            if exponent != int(exponent):
                return False
        elif word in ROUNDED:
            return False
    return True


@functools.lru_cache(maxsize=CACHE_SIZE)
def _operations(function: Any) -> PlainFunction:
    """Return the operations of a function, cached."""
    return straight(function)


@functools.lru_cache(maxsize=CACHE_SIZE)
def _rules_of(
    number: Callable[[float], Any], rounded: Callable[..., Any] | None
) -> dict[str, Callable[..., Any]]:
    """Return the operations of a number type with Python's arithmetic."""
    power = functools.partial(_power, number)
    result: dict[str, Callable[..., Any]] = {**_CHECKED_RULES, "pow": power, "constpow": power}
    result["interpolate"] = lambda table, x: table.value(x, number)
    result["slope"] = lambda table, x: table.slope(x, number)
    for name, float_function in ROUNDED.items():
        operation = functools.partial(_rounded, number, float_function)
        result[name] = operation if rounded is None else functools.partial(rounded, name)
    return result


def _rounded(number: Callable[[float], Any], float_function: Callable[..., float], *values: Any) -> Any:
    """Return a function's value, computed in double precision, in a number type."""
    return number(float_function(*map(float, values)))


def _checked(value: Any) -> Any:
    """Return a number unchanged.

    Raises
    ------
    OverflowError
        A rational has more than BITS bits, as after repeated squaring.
    """
    if _bits(value) > BITS:
        raise OverflowError(f"a number of more than {BITS} bits")
    return value


def _bits(value: Any) -> int:
    """Return the number of bits of a rational's numerator or denominator, whichever is larger.

    For numbers of other types the result is 0.
    """
    if not isinstance(value, int | Fraction):
        return 0
    return max(value.numerator.bit_length(), value.denominator.bit_length())


def _power(number: Callable[[float], Any], base: Any, exponent: Any) -> Any:
    """Return base**exponent, exactly if the exponent is whole."""
    if exponent == int(exponent):
        if _bits(base) * abs(int(exponent)) > BITS and abs(base) != 1:
            raise OverflowError(f"a number of more than {BITS} bits")
        return base ** int(exponent)
    if base < 0:
        raise ValueError("math domain error")  # as of math.sqrt; Python's own power is complex
    return number(float(base) ** float(exponent))


def _with_size_check(rule: Callable[..., Any]) -> Callable[..., Any]:
    """Return an operation whose result is checked by `_checked`."""
    return lambda *operands: _checked(rule(*operands))


_CHECKED_RULES = {word: _with_size_check(rule) for word, rule in RULES.items()}
