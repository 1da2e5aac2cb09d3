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
    """Return base^exponent."""
    b, e = np.real(base), np.real(exponent)
    value = np.float_power(b, e)
    if not (np.iscomplexobj(base) or np.iscomplexobj(exponent)):
        return value
    slope = e * np.float_power(b, e - 1) * np.imag(base)
    growing = np.imag(exponent)
    if np.any(growing):
        slope = slope + value * np.log(b) * growing
    return _step(value, slope)


def _row_quotient(above: Any, below: Any) -> Any:
    """Return a quotient; a complex step does not avoid a division by zero."""
    if not (np.iscomplexobj(above) or np.iscomplexobj(below)):
        return np.true_divide(above, below)
    value = np.true_divide(np.real(above), np.real(below))
    return _step(value, (np.imag(above) - value * np.imag(below)) / np.real(below))


def _row_function(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return an elementary function; NaN where the real part has no value, for complex steps too."""

    def value(a: Any) -> Any:
        return _step(function(np.real(a)), np.imag(function(a))) if np.iscomplexobj(a) else function(a)

    return value


def _row_angle(y: Any, x: Any) -> Any:
    """Return atan2(y, x)."""
    value = np.arctan2(np.real(y), np.real(x))
    if not (np.iscomplexobj(y) or np.iscomplexobj(x)):
        return value
    turned = np.real(x) * np.imag(y) - np.real(y) * np.imag(x)
    return _step(value, turned / (np.real(x) ** 2 + np.real(y) ** 2))


def _step(value: Any, slope: Any) -> Any:
    """Return a complex step without a product by 1j, which would give NaN where the slope is infinite."""
    values = np.empty(np.broadcast_shapes(np.shape(value), np.shape(slope)), dtype=np.complex128)
    values.real, values.imag = value, slope
    return values


def _of_real(rule: Callable[..., Any]) -> Callable[..., Any]:
    """Return an operation on the real parts alone: steps, and conditions, which are 0 or 1 as in CasADi."""
    return lambda *operands: 1.0 * rule(*map(np.real, operands))


# The operations on NumPy's numbers and arrays, real or complex steps, whose imaginary part is a derivative
# and follows the real part.
ROWS: dict[str, Callable[..., Any]] = {
    **RULES,
    "const": np.float64,  # NaN too: the result is NaN, and reported as such
    "inv": lambda a: _row_quotient(1.0, a),
    "div": _row_quotient,
    "fabs": lambda a: np.where(np.real(a) < 0, -a, a),
    "sign": _of_real(np.sign),
    "floor": _of_real(np.floor),
    "ceil": _of_real(np.ceil),
    "not": _of_real(np.logical_not),
    "fmin": np.fmin,
    "fmax": np.fmax,
    "lt": _of_real(np.less),
    "le": _of_real(np.less_equal),
    "eq": _of_real(np.equal),
    "ne": _of_real(np.not_equal),
    "and": _of_real(np.logical_and),
    "or": _of_real(np.logical_or),
    "if_else_zero": lambda a, b: np.where(np.real(a), b, 0.0),
    "interpolate": lambda table, at: table.values(at),
    "slope": lambda table, at: table.slopes(at),
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
    One list an output, one number a structural nonzero of that output.

    Raises
    ------
    ValueError
        The function contains an unknown operation, or one without a value.
    OverflowError
        A rational number takes more than BITS bits.
    """
    plain_function = _operations(function)
    local = _rules_of(number, rounded)
    if rules:
        local = {**local, **rules}
    if "const" not in local and any(map(math.isnan, plain_function.constants)):
        raise ValueError("math domain error")  # of constants alone, which CasADi evaluates
    entries = [
        entry
        for (_, size), argument in zip(plain_function.inputs, arguments, strict=True)
        for entry in _of_size(argument, size)
    ]
    constants = map(local.get("const", number), plain_function.constants)
    result = walk(plain_function, [*entries, *constants], local.__getitem__)
    return [[result[index] for index in indices] for indices in plain_function.results]


def _of_size(argument: Sequence[Any], size: int) -> Sequence[Any]:
    assert len(argument) == size, "an argument of another size"
    return argument


def is_rational(function: Any) -> bool:
    """Return whether a function's value over `Fraction` is exact: no step of it is rounded to a double."""
    if not function.is_a("SXFunction"):
        return False
    plain_function = _operations(function)
    first = sum(size for _, size in plain_function.inputs)
    constants = dict(enumerate(plain_function.constants, first))
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
    return straight(function)


@functools.lru_cache(maxsize=CACHE_SIZE)
def _rules_of(
    number: Callable[[float], Any], rounded: Callable[..., Any] | None
) -> dict[str, Callable[..., Any]]:
    """Return the operations of a number type with Python's arithmetic."""
    power = functools.partial(_power, number)
    result: dict[str, Callable[..., Any]] = {**_SHORT, "pow": power, "constpow": power}
    result["interpolate"] = lambda table, at: table.value(at, number)
    result["slope"] = lambda table, at: table.slope(at, number)
    for name, of_float in ROUNDED.items():
        local = functools.partial(_rounded, number, of_float)
        result[name] = local if rounded is None else functools.partial(rounded, name)
    return result


def _rounded(number: Callable[[float], Any], of_float: Callable[..., float], *values: Any) -> Any:
    return number(of_float(*map(float, values)))


def _short(value: Any) -> Any:
    """Return a value, unless it is a rational with too many bits, as by repeated squaring."""
    if _bits(value) > BITS:
        raise OverflowError(f"a number of more than {BITS} bits")
    return value


def _bits(value: Any) -> int:
    if not isinstance(value, int | Fraction):
        return 0
    return max(value.numerator.bit_length(), value.denominator.bit_length())


def _power(number: Callable[[float], Any], base: Any, exponent: Any) -> Any:
    """Return base**exponent, exactly when the exponent is whole."""
    if exponent == int(exponent):
        if _bits(base) * abs(int(exponent)) > BITS and abs(base) != 1:
            raise OverflowError(f"a number of more than {BITS} bits")
        return base ** int(exponent)
    if base < 0:
        raise ValueError("math domain error")  # as of math.sqrt; Python's own power is complex
    return number(float(base) ** float(exponent))


def _shortened(rule: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *operands: _short(rule(*operands))


_SHORT = {word: _shortened(rule) for word, rule in RULES.items()}
