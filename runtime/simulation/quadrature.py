"""The integral of a force over an interval, as seen from its end: weights at the nodes of two Gauss rules.

Takes: A, which states are pushed, an interval's length; parts of it.
Gives: `Kernel`, `kernel_of`, `Panels`, `whole`, `panels`, `integrate`, `magnitude`; `AGREE`.
Guarantees: the weights of a whole interval are right to the last digit but one; those of a part to a few
roundings of the largest within the interval.
Does not: know the force, or where it is smooth (see `forcing`).

    c = ∫ e^{A (T − s)} g(s) ds  =  Σ weights · g(nodes)

by Gauss and Legendre's rule, whose error for n nodes over a length h is h^{2n+1} (n!)⁴ / ((2n + 1) (2n)!³)
times the 2n-th derivative of the integrand (Davis and Rabinowitz, Methods of Numerical Integration, section
2.7): for a sine of half a turn within h, 4e-27 at 10 nodes. Whether 10 nodes are enough is seen from 16.

The exponential at the nodes of a part is that of the polynomial through the 16 nodes of the whole, where that
polynomial is one to rounding; then only the whole needs exact ones. What a rounding there leaves is no more
than what the rounding of the instant leaves at which the part begins or ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT, discretize

Floats = NDArray[np.float64]

COARSE, FINE = (np.polynomial.legendre.leggauss(n) for n in (10, 16))
NODES = np.concatenate([COARSE[0], FINE[0]])
WEIGHTS = np.concatenate([COARSE[1], FINE[1]])
FIRST_FINE = len(COARSE[0])
# Sums and polynomials of so few terms agree within this many units of their magnitudes, each of them rounded
# once or twice.
AGREE = 16 * UNIT


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """e^{A (T − s)} over an interval: `steps` (26, n_x, pushed) at the coarse, then the fine nodes.

    `a` (n_x, n_x) is A, exact, and `pushed` the states that a force pushes; `smooth` says that the
    polynomial through the fine nodes is the exponential to rounding.
    """

    a: NDArray[Any]
    pushed: tuple[int, ...]
    duration: Fraction
    steps: Floats
    smooth: bool


@dataclass(frozen=True, slots=True, eq=False)
class Panels:
    """Parts of an interval: `after` (k, 26) seconds from its start, `weights` (k or 1, 26, n_x, pushed).

    `sizes`, of the same shape, are what each weight is right to some roundings of.
    """

    after: Floats
    weights: Floats
    sizes: Floats

    def chosen(self, which: NDArray[np.bool_]) -> Panels:
        """Return some of the parts."""
        return Panels(self.after[which], self.weights[which], self.sizes[which])


def kernel_of(a: NDArray[Any], pushed: Sequence[int], duration: Fraction) -> Kernel:
    """Compute the exponential over an interval.

    Parameters
    ----------
    a
        A (n_x, n_x), exact.
    pushed
        The states that a force pushes.
    duration
        The interval's length in seconds.
    """
    steps = _exact(a, pushed, duration, _nodes(np.zeros(1), np.array([float(duration)]))[0])
    # At the coarse nodes, and at the end, where nothing has moved yet, it is known what the polynomial gives.
    known = np.concatenate([steps[:FIRST_FINE], np.eye(len(a))[None][:, :, list(pushed)]])
    guessed = np.tensordot(_through_fine(np.append(COARSE[0], 1.0)), steps[FIRST_FINE:], 1)
    smooth = bool((np.abs(guessed - known) <= AGREE * np.abs(steps).max(axis=0, initial=0.0)).all())
    return Kernel(a, tuple(pushed), duration, steps, smooth)


def whole(kernel: Kernel) -> Panels:
    """Return the whole interval as one panel."""
    high = float(kernel.duration)
    weights = kernel.steps * (WEIGHTS * high / 2)[:, None, None]
    return Panels(_nodes(np.zeros(1), np.array([high])), weights[None], np.abs(weights)[None])


def panels(kernel: Kernel, low: Floats, high: Floats) -> Panels:
    """Return parts of the interval, from `low` to `high` (k,) in seconds after its start."""
    after = _nodes(low, high)
    if kernel.smooth:
        through = _through_fine(2 * after.reshape(-1) / float(kernel.duration) - 1)
        steps = np.tensordot(through, kernel.steps[FIRST_FINE:], 1)
        sizes = np.broadcast_to(np.abs(kernel.steps).max(axis=0), steps.shape)
    else:
        # Halved alike, many intervals have the same parts.
        each, place = np.unique(after.reshape(-1), return_inverse=True)
        steps = _exact(kernel.a, kernel.pushed, kernel.duration, each)[place]
        sizes = np.abs(steps)
    shape = (*after.shape, *kernel.steps.shape[1:])
    own = ((high - low)[:, None] * WEIGHTS / 2)[:, :, None, None]
    return Panels(after, steps.reshape(shape) * own, sizes.reshape(shape) * own)


def integrate(found: Panels, g: Floats) -> tuple[Floats, Floats]:
    """Integrate over each panel by the fine rule, and say how far the coarse one is from it.

    Parameters
    ----------
    found
        The panels.
    g
        The forces (pushed, k, 26).
    """
    terms, weights = _flat(found.weights, g)
    first = FIRST_FINE * len(g)
    fine = _summed(terms[:, first:], weights[:, first:])
    return fine, np.abs(fine - _summed(terms[:, :first], weights[:, :first]))


def magnitude(found: Panels, g: Floats) -> Floats:
    """Return what the fine rule is right to some roundings of (k, n_x); g as for `integrate`."""
    terms, sizes = _flat(found.sizes, g)
    first = FIRST_FINE * len(g)
    return _summed(np.abs(terms[:, first:]), sizes[:, first:])


def _flat(weights: Floats, g: Floats) -> tuple[Floats, Floats]:
    """Return the forces (k, nodes and pushed) and the weights (k or 1, nodes and pushed, n_x)."""
    k, _, states, pushed = weights.shape
    flat = weights.transpose(0, 1, 3, 2).reshape(k, len(NODES) * pushed, states)
    return g.transpose(1, 2, 0).reshape(g.shape[1], len(NODES) * pushed), flat


def _summed(terms: Floats, weights: Floats) -> Floats:
    if len(weights) == 1:
        return np.asarray(terms @ weights[0])
    return np.asarray((terms[:, None, :] @ weights)[:, 0])


def _nodes(low: Floats, high: Floats) -> Floats:
    return np.asarray(low[:, None] + (high - low)[:, None] * (NODES + 1) / 2)


def _exact(a: NDArray[Any], pushed: Sequence[int], duration: Fraction, after: Floats) -> Floats:
    """Return e^{A (T − s)} (k, n_x, pushed) at instants (k,) of an interval."""
    nothing = np.zeros((len(a), 0), dtype=object)
    left = [duration - Fraction(float(one)) for one in after]
    steps = discretize(a, nothing, left)
    return np.array([step.matrix[:, list(pushed)] for step in steps]).reshape(len(after), len(a), len(pushed))


def _through_fine(at: Floats) -> Floats:
    """Return the polynomials (k, 16) that are 1 at one fine node and 0 at the others, at places in −1 … 1.

    In the barycentric form, which is forward stable where the Lebesgue constant is small, as here (Higham,
    IMA Journal of Numerical Analysis 24, 2004); for Legendre's nodes x its weights are (−1)^i √((1 − x²) w),
    w the weights of the rule (Wang and Xiang, Mathematics of Computation 81, 2012).
    """
    nodes, weights = FINE
    shares = (-1.0) ** np.arange(len(nodes)) * np.sqrt((1 - nodes**2) * weights)
    apart = at[:, None] - nodes
    met = apart == 0
    terms = shares / np.where(met, 1.0, apart)
    terms[met.any(axis=1)] = 0.0
    terms[met] = 1.0
    return np.asarray(terms / terms.sum(axis=1, keepdims=True))
