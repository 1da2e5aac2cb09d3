"""How much a scene makes of what hands do: H∞ and H2 norms of its modes.

Takes: a mode whose peers may be pushed (`response.DrivenMode`), and its rigid motions.
Gives: `Peak`, `tick_peak`, `sampled_data_peak`; `noise_variance`.
Guarantees: no grid of frequencies decides anything; an output that a rigid motion shows in has no norm.
Does not: prove H∞: such norms are right to `error`, what roundings make of them to first order; a variance
has a bound.

On ticks, a force is held from one instant at which anything happens to the next, and what comes of it is read
at these: one node at the beginning of each interval. Of the motion in between, force and motion are taken at
Gauss nodes of each interval, as polynomials whose norms these give exactly: what is left out falls faster
than any power of their number (Bamieh and Pearson, IEEE Trans. Autom. Control 37 (1992) 418, reduce the same
operator; its H∞ norm is that of this map).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.dissipation import gains_at, is_positive, peak_gain
from apc.eigen.matrix_norms import balance
from apc.eigen.relative import relative, relative_coordinates, relative_rows, with_doubt
from apc.frame.discretize import exponential
from apc.frame.radius import RADII, UNIT, radius_of, value_of, with_radius
from apc.hands.response import DrivenMode, DrivenPeer, force_lanes
from apc.moments.operator import congruence, stein

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Gauss nodes of an interval, and how many more tell how far the norm is off.
NODES, MORE = 4, 2

# What counts as none of a rigid motion in an output, relatively.
UNSEEN = 1e-9

# What share of the others' a state's variance counts as at least.
AT_REST = 1e-12

# What a norm is off by at least, relatively.
ROUNDED = 1e-12


@dataclass(frozen=True, slots=True)
class Peak:
    """An H∞ norm, in SI a newton, ± `error`, and the frequency in Hz where the gain is so large.

    Of what grows the norm is infinite, and the frequency that of the fastest motion.
    """

    norm: float
    error: float
    frequency_hz: float


def tick_peak(loop: DrivenMode, pushed: int, of: int, row: int, basis: Floats) -> Peak:
    """Return the norm on ticks of the map from a force at all devices of a site to a state of another.

    Parameters
    ----------
    loop, pushed, of, row
        The mode, the site that is pushed, and which state of which site is read.
    basis
        The rigid motions (n, d) of the mode.
    """
    return _peak(loop, pushed, of, row, basis, np.zeros(1), np.ones(1), np.zeros(0))[0]


def sampled_data_peak(
    loop: DrivenMode, pushed: int, of: int, row: int, basis: Floats, frequency_hz: Floats
) -> tuple[Peak, Floats]:
    """Return the norm of the same map from forces of any course to motions between ticks as well.

    With its gains at frequencies (k,). Of these the norm is the largest where the mode is stable; it is
    infinite where it is not.

    Parameters
    ----------
    loop, pushed, of, row, basis
        As for `tick_peak`.
    frequency_hz
        (k,), in Hz.
    """
    gauss = (np.polynomial.legendre.leggauss(nodes) for nodes in (NODES, NODES + MORE))
    (few, _), (many, gains) = (
        _peak(loop, pushed, of, row, basis, (at + 1) / 2, share / 2, frequency_hz) for at, share in gauss
    )
    if not np.isfinite(many.norm):
        return many, gains
    return replace(many, error=abs(many.norm - few.norm) + many.error), gains


def _peak(
    loop: DrivenMode,
    pushed: int,
    of: int,
    row: int,
    basis: Floats,
    at: Floats,
    weights: Floats,
    frequency_hz: Floats,
) -> tuple[Peak, Floats]:
    """Return norm and gains with forces and motions at nodes (q,) of each interval, 0 to 1, by weight."""
    site, other, nodes = loop.sites[pushed], loop.sites[of], len(at)
    # A force of one value at its node and none at the others, as coefficients of σ^i/i!, σ from 0 to 1.
    powers = at[:, None] ** np.arange(nodes) / np.cumprod([1, *range(1, nodes)])
    forces = np.linalg.inv(powers) / np.sqrt(weights)
    columns = nodes * len(site.seconds)
    inputs = np.zeros((loop.k.shape[-1], columns))
    lanes = {
        seconds: _lanes(site, float(seconds), nodes) @ forces / float(seconds) ** 0.5
        for seconds in set(site.seconds)
    }
    for place, seconds in enumerate(site.seconds):
        own = slice(place * nodes, (place + 1) * nodes)
        inputs[loop.kicks[pushed][place, :-1], own] = lanes[seconds]
    rows = nodes * len(other.seconds)
    outputs, through = np.zeros((rows, loop.c.shape[-2])), np.zeros((rows, columns))
    known = {seconds: _within(other, float(seconds), at, row, forces) for seconds in set(other.seconds)}
    for place, seconds in enumerate(other.seconds):
        own = slice(place * nodes, (place + 1) * nodes)
        seen, pushes = known[seconds]
        scale = np.sqrt(weights * float(seconds))[:, None]
        outputs[own, loop.reads[of][place]] = scale * seen
        if pushed == of:
            through[own, own] = scale * pushes / float(seconds) ** 0.5
    if not all(np.isfinite(matrix).all() for matrix in (inputs, outputs, through)):  # beyond floats
        return Peak(np.nan, np.nan, np.nan), np.full(len(frequency_hz), np.nan)
    c = outputs @ value_of(loop.c)
    if _shows(basis, c):
        return Peak(np.inf, 0.0, 0.0), np.full(len(frequency_hz), np.inf)
    to = relative_coordinates(basis)
    b, c = relative_rows(value_of(loop.k) @ inputs, to), c[:, to.rest]
    a = relative(loop.m, with_doubt(to), RADII)
    d = outputs @ value_of(loop.d) @ inputs + through
    turn = 2 * np.pi * float(loop.frame)
    gains = gains_at(value_of(a), b, c, d, turn * frequency_hz)
    gain, angle = peak_gain(value_of(a), b, c, d)
    if not np.isfinite(gain):
        fastest = max(np.linalg.eigvals(value_of(a)), key=abs)
        return Peak(np.inf, 0.0, float(np.abs(np.angle(fastest))) / turn), gains
    # What the state's matrix is off by moves the gain there, to first order, by so much.
    still = np.exp(1j * angle) * np.eye(len(b)) - value_of(a)
    left, right = np.abs(np.linalg.solve(still.T, c.T)).T, np.abs(np.linalg.solve(still, b))
    off = float(np.linalg.norm(left @ radius_of(a) @ right, 2)) + ROUNDED * gain
    return Peak(gain, off, angle / turn), gains


def _lanes(site: DrivenPeer, seconds: float, count: int) -> Floats:
    """Return γ_i (n_x, count) of an interval, σ^i/i! in units of it."""
    n = len(site.states)
    return np.asarray(value_of(force_lanes(site, seconds, count))[:n, n:])


def _within(site: DrivenPeer, seconds: float, at: Floats, row: int, forces: Floats) -> tuple[Floats, Floats]:
    """Return a state within an interval at σ (q,), over states and holds (q, n_x + n_u) and forces (q, q)."""
    n, count = len(site.states), len(at)
    seen, pushed = [], []
    for share in at.tolist():
        step = exponential(value_of(site.a), value_of(site.b), seconds * share)
        seen.append(step[row])
        # σ^i/i! up to a share of the interval: in units of that share, so many powers of it smaller.
        lanes = _lanes(site, seconds * share, count) * share ** np.arange(count)
        pushed.append(lanes[row] @ forces)
    return np.array(seen).reshape(count, n + value_of(site.b).shape[1]), np.array(pushed)


def _shows(basis: Floats, outputs: Floats) -> bool:
    """Say whether outputs over states (m, n) see any of the rigid motions (n, d)."""
    if not basis.size:
        return False
    return bool(np.abs(outputs @ basis).max() > UNSEEN * np.abs(outputs).max() * np.abs(basis).max())


def noise_variance(
    loop: DrivenMode,
    ticks: Sequence[Fraction],
    sources: Mapping[int, float],
    outputs: Mapping[tuple[int, int], float],
    basis: Floats,
    *,
    sensors: bool,
) -> tuple[float, float] | None:
    """Return the variance of what white noise makes of some states, on the average over the ticks of a frame.

    With a bound on what it is off by, proved for all matrices within their radii.

    Parameters
    ----------
    loop
        The mode.
    ticks
        When in a frame noise is drawn anew, in seconds, from 0 on.
    sources
        The variance of each site's noise, by site.
    outputs
        What the states are weighed by, by site and state.
    basis
        The mode's rigid motions (n, d).
    sensors
        Whether noise is on the samples of devices' positions, in m, and not on their forces, in N.

    Returns
    -------
    None where a rigid motion that noise drives shows in the states: it drifts; or nearly, so that no end of
    it is known.
    """
    columns = []
    for site, variance in sources.items():
        own = loop.sites[site]
        inputs = np.zeros((2, loop.k.shape[-1], len(ticks)))
        for place, (seconds, start) in enumerate(zip(own.seconds, own.starts, strict=True)):
            drawn = bisect_right(ticks, start) - 1
            if sensors:
                inputs[0, loop.kicks[site][place, -1], drawn] = 1.0
            else:
                lanes = force_lanes(own, float(seconds), 1)
                inputs[:, loop.kicks[site][place, :-1], drawn] = lanes[:, : len(own.states), -1]
        inputs *= variance**0.5
        inputs[1] += 4 * UNIT * np.abs(inputs[0])
        columns.append(inputs)
    inputs = np.concatenate(columns, axis=-1)
    read = np.zeros((2, len(ticks), loop.c.shape[-2]))
    for (site, state), weight in outputs.items():
        place_of = {start: place for place, start in enumerate(loop.sites[site].starts)}
        for line, tick in enumerate(ticks):
            read[0, line, loop.reads[site][place_of[tick], state]] += weight
    read[1] = 4 * UNIT * np.abs(read[0])
    seen = RADII.multiply(read, loop.c)
    if _shows(basis, value_of(seen)):
        return None
    at = with_doubt(relative_coordinates(basis))
    root = relative_rows(RADII.multiply(loop.k, inputs), at, RADII)
    driven = RADII.multiply(root, np.swapaxes(root, -1, -2))
    moments = _lasting(relative(loop.m, at, RADII), driven)
    if moments is None:
        return None
    through = RADII.multiply(RADII.multiply(read, loop.d), inputs)
    whole = RADII.add(
        congruence(seen[..., at.rest], moments, RADII), RADII.multiply(through, np.swapaxes(through, -1, -2))
    )
    value, off = (float(np.trace(matrix)) / len(ticks) for matrix in (value_of(whole), radius_of(whole)))
    return value, off + (len(ticks) + 4) * UNIT * value


def _lasting(matrix: Matrix, driven: Matrix) -> Matrix | None:
    """Return Σ_k M^k B M^kᵀ of a matrix M (2, n, n) and symmetric B, None where it is not proved to end.

    Notes
    -----
    Let X̂ be what floats say, and E = B + M X̂ Mᵀ − X̂ what they leave, −θ D² ≤ E ≤ θ D² in the order of
    symmetric matrices for some diagonal D. For a P ≥ 0 with P − M P Mᵀ ≥ (1 − φ) D², φ < 1, the powers of M
    die out (Lyapunov), and X − X̂ = Σ_k M^k E M^kᵀ lies between −θ/(1 − φ) P and θ/(1 − φ) P. D² is as X̂ on
    its diagonal, P as floats have Σ_k M^k D² M^kᵀ; θ and φ are the largest sums of rows, over D (Gershgorin).
    """
    value, n = value_of(matrix), matrix.shape[-1]
    moments = stein(value, value_of(driven))
    if moments is None or not n:
        return None if moments is None else driven
    units = balance(np.abs(value)) ** 2
    shares = np.diagonal(moments) / units
    # Powers of two, so that what is divided and multiplied by them is exact.
    sizes = np.sqrt(units * np.maximum(shares, AT_REST * shares.max() or 1.0))
    weights = np.asarray(np.exp2(np.round(np.log2(sizes))), dtype=np.float64)
    seed = np.diag(weights**2)
    held = stein(value, seed)
    if held is None:
        return None
    (moments, theta), (held, phi) = (
        (guess, _left(matrix, added, guess, weights))
        for guess, added in (
            ((moments + moments.T) / 2, driven),
            ((held + held.T) / 2, RADII.exact(seed)),
        )
    )
    shape = held / np.outer(weights, weights)
    if not (phi < 1 and is_positive(with_radius(shape, 2 * UNIT * np.abs(shape)))):
        return None
    wide = np.sqrt(np.diagonal(held))
    return with_radius(moments, theta / (1 - phi) * np.outer(wide, wide) * (1 + 16 * UNIT))


def _left(matrix: Matrix, added: Matrix, guess: Floats, weights: Floats) -> float:
    """Return the largest sum of a row of B + M X̂ Mᵀ − X̂, over weights."""
    exact = RADII.exact(guess)
    left = RADII.subtract(RADII.add(congruence(matrix, exact, RADII), added), exact)
    size = (np.abs(value_of(left)) + radius_of(left)) / np.outer(weights, weights)
    return float(size.sum(axis=-1).max() * (1 + (len(guess) + 8) * UNIT))
