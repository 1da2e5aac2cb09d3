"""Where the coefficients of a scene's equations bend as one number varies.

Takes: a `BatchEvaluator` and which of its free parameters varies.
Gives: `Bends`, `bends`.
Guarantees: between neighbours of the points it returns, every coefficient is a cubic to `STRAIGHT` of its
size: balls enclose its fourth derivative there. However narrow a bump or step is, it can't hide between them.
Does not: say what the eigenvalues do (see `crossings`).

A cubic through the values and slopes of both ends of a cell of width h is off by f⁗ h⁴/384 at most.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi
import flint
import numpy as np
from numpy.typing import NDArray

from apc.compiler.plain import straight, symbolic
from apc.frame.exact import evaluate_exact
from apc.frame.parameters import free_values
from apc.vary.batch import BatchEvaluator

Floats = NDArray[np.float64]

# How far a coefficient may be from the cubic of its cell, relative to its size there: the eigenvalues' own
# cubics are looked at beside it. What is so much smaller than it gets elsewhere decides nothing.
STRAIGHT, NOTHING = 1e-2, 1e-6

# Cells narrower than this, relative to the value, hold a step: they are left.
NARROW = 1e-9

# Cells looked at, at a tenth of a millisecond each: more than any smooth function asks for.
MOST_CELLS = 4000

# Of a Taylor series, as far as the fourth derivative; 64 bits lose nothing that a hundredth could show.
TERMS, BITS = 5, 64

# Operations that may make a step, or a kink, of what is straight on either side.
_STEPS = frozenset(
    ["lt", "le", "eq", "ne", "not", "if_else_zero", "fabs", "sign", "floor", "ceil", "fmin", "fmax"]
)


# Lines whose coefficients are kept for the next question, and numbers that stand in them.
KEPT, KEPT_CONSTANTS = 64, 1024


class _OpenError(Exception):
    """Not decided for a whole cell."""


@dataclass(frozen=True, slots=True)
class Bends:
    """Those coefficients that are not linear in a value, as functions of it; `present` is what it is now."""

    functions: tuple[Any, ...]  # casadi.Function
    present: float

    def between(self, points: Floats, least: float) -> tuple[Floats, bool]:
        """Return points (k,) with as many more among them as the coefficients ask for.

        Parameters
        ----------
        points
            In order.
        least
            Cells are measured against the value, or against this where the value is smaller.

        Returns
        -------
        The points in order, and whether between all of them every coefficient is known.
        """
        if not self.functions:
            return points, True
        found = points.tolist()
        known = {value: self._values(value) for value in found}
        largest = np.max([*known.values(), self._values(self.present)], axis=0)
        # The widest first: what is largest is met soon.
        waiting = deque(itertools.pairwise(found))
        looked = 0
        while waiting and looked < MOST_CELLS:
            low, high = waiting.popleft()
            looked += 1
            size = np.maximum(np.maximum(known[low], known[high]), NOTHING * largest)
            if self._straight(low, high, size):
                continue
            if high - low <= NARROW * max(abs(low), abs(high), least):
                continue
            middle = (low + high) / 2
            known[middle] = self._values(middle)
            largest = np.maximum(largest, known[middle])
            found.append(middle)
            waiting += [(low, middle), (middle, high)]
        return np.sort(np.array(found)), not waiting

    def _values(self, value: float) -> Floats:
        """Return the sizes of all coefficients, 0 where one has none."""
        listed = [np.asarray(one(value), dtype=np.float64).ravel() for one in self.functions]
        return np.abs(np.nan_to_num(np.concatenate(listed), posinf=0.0, neginf=0.0))

    def _straight(self, low: float, high: float, size: Floats) -> bool:
        """Say whether every coefficient is a cubic between two values, to `STRAIGHT` of a size each."""
        bits, flint.ctx.prec = flint.ctx.prec, BITS
        try:
            middle = (flint.arb(low) + flint.arb(high)) / 2
            around = flint.arb(middle.mid(), (flint.arb(high) - flint.arb(low)) / 2)
            value = flint.arb_series([around, 1], prec=TERMS)
            listed = [
                entry
                for one in self.functions
                for entry in evaluate_exact(
                    one, [[value]], number=_constant, rounded=_transcendental, rules=_RULES
                )[0]
            ]
            # The fourth coefficient is f⁗/24.
            off = [float(abs(_term(one, TERMS - 1)).upper()) * (high - low) ** 4 / 16 for one in listed]
        except (_OpenError, ValueError, ZeroDivisionError, OverflowError):
            return False
        finally:
            flint.ctx.prec = bits
        return bool(np.all(np.array(off) <= STRAIGHT * size))


@lru_cache(maxsize=KEPT)
def bends(family: BatchEvaluator, base: tuple[float, ...], column: int) -> Bends | None:
    """Return the coefficients that bend as one of the free parameters varies, the others at `base` (m,).

    None where the equations hold a loop that Newton's method solves, or a value that has no expression.
    """
    value = casadi.SX.sym("value")
    free = {one: value if place == column else base[place] for place, one in enumerate(family.free)}
    functions: dict[object, Any] = {}
    for group in family.groups:
        built = group.jacobians
        if not built.walkable:
            return None
        place, peer = family.first_peer(group)
        vector = free_values(family.system, family.system.groups[place], peer, free, symbolic)
        key = (built.kind.name, tuple(one if isinstance(one, float) else None for one in vector))
        if key not in functions:
            functions[key] = _bending(built.function, value, casadi.vertcat(*vector))
    found = tuple(one for one in functions.values() if one is not None)
    return Bends(found, base[column])


def _bending(function: Any, value: Any, vector: Any) -> Any:
    """Return what of a function's coefficients is not linear in a value, as a function of it."""
    zeros = [casadi.SX.zeros(function.numel_in(place)) for place in range(6)]
    (flat,) = function.call([*zeros[:4], vector, zeros[5]])
    flat = flat.nz[:]
    moved = [place for place, one in enumerate(casadi.which_depends(flat, value, 1, True)) if one]
    if not moved:
        return None
    flat = flat[moved]
    whole = casadi.Function("coefficients", [value], [flat])
    if _STEPS.isdisjoint(word for word, *_ in straight(whole).operations):
        bent = [place for place, one in enumerate(casadi.which_depends(flat, value, 2, True)) if one]
        if not bent:
            return None
        whole = casadi.Function("coefficients", [value], [flat[bent]])
    return whole


# ---- Taylor series with balls for coefficients, as numbers ----


@lru_cache(maxsize=KEPT_CONSTANTS)
def _constant(value: float) -> Any:
    return flint.arb_series([flint.arb(value)], prec=TERMS)


def _term(value: Any, place: int) -> Any:
    """Return a coefficient of a series, of a plain number as well; refuse one that is not known at all."""
    found = (value if isinstance(value, flint.arb_series) else _constant(value))[place]
    if not found.is_finite():
        raise _OpenError
    return found


def _sign(value: Any) -> int:
    """Return the sign of a series' value in all of the cell."""
    ball = _term(value, 0)
    if ball == 0:
        return 0
    if ball > 0 or ball < 0:
        return 1 if ball > 0 else -1
    raise _OpenError


def _floor(value: Any) -> Any:
    whole = _term(value, 0).floor()
    if not whole.is_exact():
        raise _OpenError
    return _constant(float(whole))


def _power(base: Any, exponent: Any) -> Any:
    ball = _term(exponent, 0)
    fixed = ball.is_exact() and all(_term(exponent, place) == 0 for place in range(1, TERMS))
    if fixed and ball.is_integer():
        whole = int(float(ball))
        return base**whole if whole >= 0 else 1 / base**-whole
    if _sign(base) <= 0:
        raise _OpenError
    return (exponent * base.log()).exp()


def _truth(condition: Callable[[int], bool]) -> Callable[[Any, Any], Any]:
    return lambda a, b: _constant(float(condition(_sign(a - b))))


_RULES: dict[str, Callable[..., Any]] = {
    "pow": _power,
    "constpow": _power,
    "fabs": lambda a: a if _sign(a) >= 0 else -a,
    "sign": lambda a: _constant(_sign(a)),
    "floor": _floor,
    "ceil": lambda a: -_floor(-a),
    "fmin": lambda a, b: a if _sign(a - b) <= 0 else b,
    "fmax": lambda a, b: a if _sign(a - b) >= 0 else b,
    "lt": _truth(lambda sign: sign < 0),
    "le": _truth(lambda sign: sign <= 0),
    "eq": _truth(lambda sign: sign == 0),
    "ne": _truth(lambda sign: sign != 0),
    "not": lambda a: _constant(float(_sign(a) == 0)),
    "and": lambda a, b: _constant(float(_sign(a) != 0 and _sign(b) != 0)),
    "or": lambda a, b: _constant(float(_sign(a) != 0 or _sign(b) != 0)),
    "if_else_zero": lambda a, b: b if _sign(a) else _constant(0.0),
}


def _transcendental(name: str, *values: Any) -> Any:
    if name == "atan2":
        return _angle(*values)
    value = values[0] if isinstance(values[0], flint.arb_series) else _constant(values[0])
    match name:
        case "tanh":
            return _tanh(value)
        case "sinh" | "cosh":
            up, down = value.exp(), (-value).exp()
            return (up - down if name == "sinh" else up + down) / 2
    return getattr(value, name)()


def _angle(y: Any, x: Any) -> Any:
    """Return atan2(y, x), whose jump at y = 0 > x is not decided."""
    if _term(x, 0) > 0:
        return (y / x).atan()
    return -(x / y).atan() + flint.arb.pi() / 2 * _sign(y)


def _tanh(value: Any) -> Any:
    """Return T(x₀ + h) by T′ = 1 − T²: far out, where e^x is beyond every ball, T is next to ±1."""
    terms = [value[0].tanh()]
    for k in range(TERMS - 1):
        product = sum((terms[i] * terms[k - i] for i in range(k + 1)), flint.arb(0))
        terms.append(((1 if k == 0 else 0) - product) / (k + 1))
    step, found = value - value[0], _constant(0.0)
    for one in reversed(terms):
        found = found * step + one
    return found
