"""What forces that change with time alone add to a motion, in balls.

Takes: a kind's equations between its ticks, one peer's numbers, an interval.
Gives: `in_the_way`, `Push`, `push_of`, `switches`, `impulse`.
Guarantees: the balls hold the true impulse; forces are expanded only where they are smooth.
Does not: serve a force that hangs on the motion too, or one whose switches are not linear in time.

Of x' = A x + B u + g(t), with g expanded about the beginning of an interval of length h,

    g(s) = Σ_{k<K} g_k s^k + ρ s^K,    ∫₀ʰ e^{A (h − s)} g(s) ds = Σ_{k<K} k! M_k g_k + R
    M_k = ∫₀ʰ e^{A (h − s)} s^k/k! ds = A M_{k+1} + h^{k+1}/(k+1)!

where ρ is g's coefficient K somewhere within the interval (Taylor's remainder, as Lagrange has it), so that
|R| ≤ e^{|A| h} h^{K+1}/(K+1) max |ρ|. The moments M_k come downwards from one that is too small to count.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import casadi
import flint

from apc.compiler.compiled import Kind
from apc.frame.exact import evaluate_exact, is_rational
from apc.frame.jacobians import guards_of

# K. Of a sine the terms left out are 1e-56 where it makes a tenth of a turn within the interval.
ORDER = 40
# What is left may be this part of the bits in hand: half of them, which is 1e-77 at the fewest.
SPARED = 2
MOST_HALVINGS = 12  # of an interval: four thousand parts; more is not certain to so many digits
ONE = flint.arb(1)

# What has no Taylor series here: a power that is not whole, and what is constant but where it jumps.
_WITHOUT = (casadi.OP_POW, casadi.OP_CONSTPOW, casadi.OP_FLOOR, casadi.OP_CEIL)


@dataclass(frozen=True, slots=True, eq=False)
class Push:
    """The forces on one peer: g (p, t) and what changes sign where it is not smooth, with its numbers.

    `a` is A (n_x, n_x), exact; `moments` keeps M_k at the present precision, by length.
    """

    rate: Any  # casadi.Function
    guards: Any  # casadi.Function
    parameters: tuple[Fraction, ...]
    a: Any  # flint.fmpq_mat
    moments: dict[Fraction, list[Any]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Germ:
    """A function's Taylor series about the `middle`, the beginning (`near`) and all (`wide`) of an interval.

    Germs are compared by their values in the middle, which is right between two switches.
    """

    middle: Any  # flint.arb_series of one term
    near: Any  # flint.arb_series
    wide: Any  # flint.arb_series

    def each(self, step: Callable[[Any], Any]) -> Germ:
        """Apply a step to all three."""
        return Germ(step(self.middle), step(self.near), step(self.wide))

    def both(self, step: Callable[[Any, Any], Any], other: Any) -> Germ:
        """Join with another germ or a constant."""
        one = other if isinstance(other, Germ) else _constant(other)
        return Germ(step(self.middle, one.middle), step(self.near, one.near), step(self.wide, one.wide))

    def __add__(self, other: Any) -> Germ:
        return self.both(operator.add, other)

    def __sub__(self, other: Any) -> Germ:
        return self.both(operator.sub, other)

    def __mul__(self, other: Any) -> Germ:
        return self.both(operator.mul, other)

    def __truediv__(self, other: Any) -> Germ:
        return self.both(operator.truediv, other)

    def __radd__(self, other: Any) -> Germ:
        return self.both(operator.add, other)

    def __rmul__(self, other: Any) -> Germ:
        return self.both(operator.mul, other)

    def __rsub__(self, other: Any) -> Germ:
        return (-self).both(operator.add, other)

    def __rtruediv__(self, other: Any) -> Germ:
        return _constant(other) / self

    def __neg__(self) -> Germ:
        return self.each(operator.neg)

    def __abs__(self) -> Germ:
        return -self if self < 0 else self

    def __lt__(self, other: Any) -> bool:
        return bool((self - other).middle[0] < 0)

    def __gt__(self, other: Any) -> bool:
        return bool((self - other).middle[0] > 0)

    def __le__(self, other: Any) -> bool:
        return not self > other

    def __ge__(self, other: Any) -> bool:
        return not self < other


def in_the_way(kind: Kind) -> str:
    """Say why a kind's forces can't be followed in balls, "" if they can."""
    function = kind.derivative
    symbols = function.sx_in()
    codes = {function.instruction_id(index) for index in range(function.n_instructions())}
    if not is_rational(function) and codes & set(_WITHOUT):
        return f"a force on {kind.name} holds a power that is not whole, or a step"
    guards = _guards(function(*symbols), symbols[-1])
    curved = casadi.jacobian(casadi.jacobian(guards, symbols[-1]), symbols[-1])
    if casadi.sparsify(curved).nnz() or not is_rational(casadi.Function("guards", symbols, [guards])):
        return f"a force on {kind.name} switches by what is not linear in time"
    return ""


def _guards(rate: Any, time: Any) -> Any:
    found = guards_of(casadi.densify(rate), time)
    return casadi.densify(casadi.vertcat(*found)) if found else casadi.SX(0, 1)


def push_of(kind: Kind, parameters: Sequence[Fraction], a: Any) -> Push | None:
    """Return the forces on a peer that change with time or whose value is no rational, None without such.

    Parameters
    ----------
    kind
        Its kind, for which `in_the_way` is "".
    parameters
        Its numbers (n_p,).
    a
        Its A (n_x, n_x), `flint.fmpq_mat`.
    """
    symbols = kind.derivative.sx_in()
    rate = casadi.densify(kind.derivative(*symbols))
    if is_rational(kind.derivative) and not casadi.depends_on(rate, symbols[-1]):
        return None
    zeros = [casadi.SX.zeros(symbol.shape) for symbol in symbols[:-2]]
    at_rest = casadi.densify(casadi.substitute([rate], symbols[:-2], zeros)[0])
    own = symbols[-2:]
    return Push(
        casadi.Function("push", own, [at_rest]),
        casadi.Function("guards", own, [_guards(at_rest, symbols[-1])]),
        tuple(parameters),
        a,
    )


def switches(push: Push, start: Fraction, end: Fraction) -> set[Fraction]:
    """Return the instants within (start, end) at which the forces may not be smooth.

    A comparison is linear in time between the switches of those it is made of: whoever's line through two
    instants of a piece is zero within it splits it, until nothing does.
    """
    found: set[Fraction] = set()
    if not push.guards.numel_out(0):
        return found
    while True:
        new = {
            root
            for low, high in itertools.pairwise(sorted({start, end, *found}))
            for root in _roots(push, low, high)
        }
        if not new:
            return found
        found |= new


def _roots(push: Push, low: Fraction, high: Fraction) -> list[Fraction]:
    """Return where lines through two instants of a piece are zero within it."""
    third = (high - low) / 3
    values = [evaluate_exact(push.guards, [push.parameters, [at]])[0] for at in (low + third, high - third)]
    lines = [(first, last) for first, last in zip(*values, strict=True) if first != last]
    roots = [low + third - first * third / (last - first) for first, last in lines]
    return [root for root in roots if low < root < high]


def impulse(push: Push, start: Fraction, length: Fraction, depth: int = 0) -> list[Any]:
    """Return what the forces add to the states (n_x,) from `start` on, at the present precision.

    Parameters
    ----------
    push
        The forces.
    start, length
        An interval within which nothing switches, in seconds.
    depth
        How often it was halved before.
    """
    size, h, norm = push.a.nrows(), _ball(length), _norm(push.a)
    germs = _germs(push, start, length)
    most = _largest([abs(germ.wide[ORDER]) for germ in germs])
    left = (norm * h).exp() * h ** (ORDER + 1) / (ORDER + 1) * most
    # A force that begins at zero has a small impulse as well: what is spared is of 1 N if not of the force.
    enough = flint.arb(2) ** (-flint.ctx.prec // SPARED) * h * max(_largest([g.near[0] for g in germs]), ONE)
    if not left <= enough and depth < MOST_HALVINGS:
        half = length / 2
        first = flint.arb_mat(size, 1, impulse(push, start, half, depth + 1))
        last = impulse(push, start + half, half, depth + 1)
        passed = (flint.arb_mat(push.a) * _ball(half)).exp() * first
        return [one + other for one, other in zip(passed.entries(), last, strict=True)]
    total = flint.arb_mat(size, 1, [flint.arb(0, left.upper())] * size)
    moments = _moments(push, length)
    for k in range(ORDER):
        column = [germ.near[k] * math.factorial(k) for germ in germs]
        if any(not entry.is_zero() for entry in column):
            total = total + moments[k] * flint.arb_mat(size, 1, column)
    return list(total.entries())


def _germs(push: Push, start: Fraction, length: Fraction) -> list[Germ]:
    """Expand every force on an interval."""
    begin, end = _ball(start), _ball(start + length)
    with _terms(ORDER + 1):
        time = Germ(
            flint.arb_series([_ball(start + length / 2)], prec=1),
            flint.arb_series([begin, 1]),
            flint.arb_series([begin.union(end), 1]),
        )
        found = evaluate_exact(push.rate, [push.parameters, [time]], rounded=_transcendental)[0]
        return [one if isinstance(one, Germ) else _constant(one) for one in found]


def _constant(value: Any) -> Germ:
    return Germ(*(flint.arb_series([_ball(Fraction(value))]) for _ in range(3)))


def _transcendental(name: str, *values: Any) -> Germ:
    (value,) = values
    germ = value if isinstance(value, Germ) else _constant(value)
    return germ.each(lambda series: _SERIES[name](series))


_SERIES: dict[str, Callable[[Any], Any]] = {
    **{
        name: operator.methodcaller(name)
        for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan")
    },
    "sinh": lambda series: (series.exp() - (-series).exp()) / 2,
    "cosh": lambda series: (series.exp() + (-series).exp()) / 2,
    "tanh": lambda series: 1 - 2 / ((2 * series).exp() + 1),
}


@contextmanager
def _terms(count: int) -> Iterator[None]:
    """Set the number of terms of python-flint's series for a while."""
    before, flint.ctx.cap = flint.ctx.cap, count
    try:
        yield
    finally:
        flint.ctx.cap = before


def _ball(value: Fraction) -> Any:
    return flint.arb(flint.fmpq(value.numerator, value.denominator))


def _largest(values: Sequence[Any]) -> Any:
    """Return the largest magnitude, from above; infinite where one is no number."""
    bounds = [abs(value).upper() for value in values]
    return max((one if one.is_finite() else flint.arb("inf") for one in bounds), default=flint.arb(0))


def _norm(a: Any) -> Any:
    """Return |A|, the largest sum of a row, from above."""
    return _largest([sum((abs(flint.arb(entry)) for entry in row), flint.arb(0)) for row in a.tolist()])


def _moments(push: Push, length: Fraction) -> list[Any]:
    """Return M_0 to M_{K−1} (n_x, n_x) of a length, at the present precision."""
    if length in push.moments:
        return push.moments[length]
    size, h, norm = push.a.nrows(), _ball(length), _norm(push.a)
    last, bound = ORDER, (norm * h).exp() * h ** (ORDER + 1) / math.factorial(ORDER + 1)
    # |M_last| is at most this, and reaches the moments below by factors of |A|.
    while not bound * max(norm, ONE) ** last <= flint.arb(2) ** -flint.ctx.prec:
        last += 1
        bound = bound * h / (last + 1)
    a, unit = flint.arb_mat(push.a), [int(i == j) for i in range(size) for j in range(size)]
    moment = flint.arb_mat(size, size, [flint.arb(0, bound.upper())] * size**2)
    found = []
    for k in reversed(range(last)):
        moment = a * moment + flint.arb_mat(size, size, unit) * (h ** (k + 1) / math.factorial(k + 1))
        found.append(moment)
    push.moments[length] = found[::-1][:ORDER]
    return push.moments[length]
