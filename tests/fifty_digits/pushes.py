"""What forces that change with time alone add to a motion, in balls.

Takes: a kind's equations between its ticks, one peer's numbers, an interval.
Gives: `in_the_way`, `Push`, `push_of`, `switches`, `impulse`.
Guarantees: forces are replaced by polynomials only where they are smooth, and where these are as right as
half the bits in hand say, at points that they were not made of.
Does not: serve a force that hangs on the motion too, or one whose switches are not linear in time.

Of x' = A x + B u + g(t), with g(s) = Σ_{k<K} g_k s^k within an interval of length h,

    ∫₀ʰ e^{A (h − s)} g(s) ds = Σ_{k<K} k! M_k g_k
    M_k = ∫₀ʰ e^{A (h − s)} s^k/k! ds = A M_{k+1} + h^{k+1}/(k+1)!

where the polynomial meets the force at K points of Chebyshev. The moments M_k come downwards from one that is
too small to count.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

import casadi
import flint

from apc.compiler.compiled import Kind
from apc.eigen.balls import precision
from apc.frame.exact import evaluate_exact, is_rational
from apc.frame.jacobians import guards_of

# K. Of a sine the polynomial is off by 1e-60 where it makes half a turn within the interval.
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
    size, h = push.a.nrows(), _ball(length)
    points, solving = _points(flint.ctx.prec)
    values = flint.arb_mat([_forces(push, _ball(start) + point * h) for point in points])
    terms = solving * values  # of (s/h)^k
    off = flint.arb(0)
    for place in (Fraction(1, 7), Fraction(4, 7), Fraction(13, 14)):
        powers = flint.arb_mat([[_ball(place) ** k for k in range(ORDER)]])
        true = flint.arb_mat([_forces(push, _ball(start + place * length))])
        off = max(off, _largest((powers * terms - true).entries()))
    # A force that begins at zero has a small impulse as well: what is spared is of 1 N if not of the force.
    enough = flint.arb(2) ** (-flint.ctx.prec // SPARED) * max(_largest(values.entries()), ONE)
    if not off <= enough and depth < MOST_HALVINGS:
        half = length / 2
        first = flint.arb_mat(size, 1, impulse(push, start, half, depth + 1))
        last = impulse(push, start + half, half, depth + 1)
        passed = (flint.arb_mat(push.a) * _ball(half)).exp() * first
        return [one + other for one, other in zip(passed.entries(), last, strict=True)]
    left = flint.arb(0, (off * h * (_norm(push.a) * h).exp()).upper())
    total = flint.arb_mat(size, 1, [left] * size)
    for k, moment in enumerate(_moments(push, length)):
        scale = flint.arb(math.factorial(k)) / h**k
        total = total + moment * flint.arb_mat(size, 1, [terms[k, i] * scale for i in range(size)])
    return list(total.entries())


@functools.cache
def _points(bits: int) -> tuple[list[Any], Any]:
    """Return points of Chebyshev within 0 and 1, and what makes coefficients of values there."""
    with precision(3 * bits):  # the inverse of powers loses digits
        angles = [flint.arb.pi() * (2 * k + 1) / (2 * ORDER) for k in range(ORDER)]
        points = [((1 + angle.cos()) / 2).mid() for angle in angles]
        solving = flint.arb_mat([[point**k for k in range(ORDER)] for point in points]).inv()
        return points, flint.arb_mat([[one.mid() for one in row] for row in solving.tolist()])


def _forces(push: Push, time: Any) -> list[Any]:
    """Return the forces (n_x,) at a time in seconds."""
    parameters = [_ball(one) for one in push.parameters]
    found = evaluate_exact(
        push.rate,
        [parameters, [time]],
        number=lambda value: _ball(Fraction(value)),
        rounded=lambda name, value: getattr(flint.arb(value), name)(),
    )[0]
    return [flint.arb(one) for one in found]


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
