"""Loops with their contacts cut open, each tick of a contact weighted: do their forces take energy out?

Takes: loops with their contacts cut open (see `opened`).
Gives: `Weights`, `weights_of`; `least_of`, `is_proved`.
Guarantees: what is called proved holds for all matrices within their radii.
Does not: choose how much the tick before counts.

Closed again, f = φ(y) with f (y − f) ≥ 0 at each tick. With w = y − f and weights λ > 0 of the ticks,
Λ = diag(λ), the loop comes to rest if a storage ξᵀP ξ of it grows by less than −2 fᵀΛw, which is never above
0: the circle criterion (Tsypkin, 1964). With H from f to −y over a frame,

    He(Λ (H(e^{jθ}) + I)) ≻ 0        for all θ

What can drift with all contacts open is a pole of H at z = 1, R/(z − 1). Where it is one motion, y follows it
alike at all ticks, R = −s m, and with Λ s = −mᵀ the rest is free of it: He(−ΛR/(z − 1)) = mᵀm/2 on the
circle, of either sign of θ, is taken off. Where a frame has one tick only, that can be had in several modes.

Where φ is the same at all ticks and never falls, f is a slope of a convex function Ψ ≥ 0 of w, and

    f_k (w_k − w_{k−1}) ≥ Ψ(w_k) − Ψ(w_{k−1})

The storage ξᵀP ξ + 2 h Ψ(w) falls where that of ξ and of the w of the frame before, v, grows by less than
−2 fᵀ(Λ w + h (w − w_before)), for any h ≥ 0 (Jury and Lee, 1964). Of one-sided contacts Ψ is a square on
either side of the touch: the storage is quadratic piece by piece. Seen from where the drift has come to, v⁺
is the last w less s m f.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from apc.analysis.opened import Matrix, OpenLoop, negated
from apc.eigen.dissipation import least_real, proves_positive
from apc.frame.discretize import UNIT
from apc.frame.radius import RADII, radius_of, value_of, with_radius

Floats = NDArray[np.float64]

# λ of a tick of a part at a site, and its radius; 1 of those that are not there.
Weights = Mapping[tuple[str, str, int], tuple[float, float]]


def weights_of(loops: Sequence[OpenLoop]) -> Weights | str:
    """Return the weights that are free of what drifts, or why there are none.

    Parameters
    ----------
    loops
        All loops of a scene.
    """
    drifting = [one for one in loops if one.seen]
    if len(drifting) > 1 and any(len(one.ports) > 1 for one in drifting):
        names = " and ".join(one.name for one in drifting)
        return f"with all contacts open, what may drift is of several modes: {names}"
    weights: dict[tuple[str, str, int], tuple[float, float]] = {}
    for one in drifting:
        for k, (site, name, tick) in enumerate(one.ports):
            if not one.seen[k]:
                return f"{name} does not hold what may drift with all contacts open"
            by = -1 / (float(one.seen[k]) * one.counts[k])
            moved, off = (float(one.moved[which, 0, k]) for which in (0, 1))
            found = by * moved, abs(by) * (off + 8 * UNIT * abs(moved))
            if not found[0] > found[1]:
                return f"{name} drives away what may drift with all contacts open"
            weights.setdefault((site, name, tick), found)
    return weights


def least_of(one: OpenLoop, weights: Weights, lag: float = 0.0) -> float:
    """Return the least real part of a loop, weighted, at any frequency, less 1: above −1 it takes energy out.

    Parameters
    ----------
    one, weights
        The loop, and the weights of its ticks.
    lag
        h over the mean of the weights of a contact's ticks.
    """
    a, b, c, d, weight = (value_of(block) for block in _posed(one, weights, lag))
    root = np.sqrt(np.diag(value_of(_weigh(one, weights))))
    scaled = b / root, c / root[:, None], d / np.outer(root, root)
    return least_real(a, *scaled, weight / np.outer(root, root) - np.eye(len(root)))[0]


def is_proved(one: OpenLoop, weights: Weights, lag: float = 0.0) -> bool:
    """Say whether a loop, weighted, is proved to take energy out at all frequencies.

    Parameters
    ----------
    one, weights, lag
        As for `least_of`.
    """
    return proves_positive(*_posed(one, weights, lag))


def _posed(one: OpenLoop, weights: Weights, lag: float) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, C, D and W of a loop whose He(C (e^{jθ} − A)⁻¹ B + D) + W is to be positive."""
    weigh = _weigh(one, weights)
    half = RADII.multiply(np.swapaxes(one.moved / 2, -1, -2), one.moved)
    if one.seen and len(one.ports) == 1:  # Λ s = −p m for some p, which is 1 in the mode that Λ is of
        share = np.abs(value_of(weigh) / value_of(one.moved))
        own, doubt = (radius_of(each) / np.abs(value_of(each)) for each in (weigh, one.moved))
        half = RADII.multiply(half, with_radius(share, share * (own + doubt + 4 * UNIT) / (1 - doubt)))
    c, d = (RADII.multiply(weigh, block) for block in (one.c, one.d))
    weight = RADII.subtract(weigh, half)
    if not lag:
        return one.a, one.b, c, d, weight
    first, last, before = _course(one)
    n, held, many = one.a.shape[-1], len(last), len(one.ports)
    # −w = C ξ + (D + 1) f, and less that of the tick before, which is −v at the first of a frame.
    whole = RADII.add(one.d, RADII.exact(np.eye(many)))
    push = RADII.exact(np.diag(lag * _means(one, weights)))
    push[1] = 4 * UNIT * push[0]
    rise, first = (RADII.multiply(push, RADII.exact(each)) for each in (np.eye(many) - before, first))
    seen = np.array([float(share) for share in one.seen] or [0.0] * many)[last]
    drift = RADII.multiply(np.stack([seen, UNIT * np.abs(seen)])[..., None], one.moved)
    a, b = np.zeros((2, n + held, n + held)), np.zeros((2, n + held, many))
    a[:, :n, :n], a[:, n:, :n] = one.a, negated(one.c[:, last])
    b[:, :n], b[:, n:] = one.b, negated(RADII.add(whole[:, last], drift))
    c = np.concatenate([RADII.add(c, RADII.multiply(rise, one.c)), first], axis=-1)
    return a, b, c, RADII.add(d, RADII.multiply(rise, whole)), weight


def _course(one: OpenLoop) -> tuple[Floats, list[int], Floats]:
    """Return how the ticks of each contact follow one another.

    Which contact each tick is the first of (m, c), the place of the last of each contact, and which tick
    comes before each (m, m).
    """
    contacts = list(dict.fromkeys((site, part) for site, part, _ in one.ports))
    first, before = np.zeros((len(one.ports), len(contacts))), np.zeros((len(one.ports), len(one.ports)))
    last = []
    for column, contact in enumerate(contacts):
        places = [k for k, port in enumerate(one.ports) if port[:2] == contact]
        first[places[0], column] = before[places[1:], places[:-1]] = 1.0
        last.append(places[-1])
    return first, last, before


def _means(one: OpenLoop, weights: Weights) -> Floats:
    """Return the mean weight of each tick's contact, of all its peers."""
    own: dict[tuple[str, str], list[float]] = {}
    for port in one.ports:
        own.setdefault(port[:2], []).append(weights.get(port, (1.0, 0.0))[0])
    return np.array([float(np.mean(own[port[:2]])) for port in one.ports]) * one.counts


def _weigh(one: OpenLoop, weights: Weights) -> Matrix:
    """Return the weights of a loop's ticks, of all their peers, on a diagonal with their radii."""
    found = np.zeros((2, len(one.ports), len(one.ports)))
    for k, (port, count) in enumerate(zip(one.ports, one.counts.tolist(), strict=True)):
        value, radius = weights.get(port, (1.0, 0.0))
        found[:, k, k] = value * count, (radius + UNIT * value) * count * (1 + 4 * UNIT)
    return found
