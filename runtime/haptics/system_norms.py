"""H∞ and H2 norms of the modes of a model.

Takes: a mode with force inputs (`modal_response.DrivenMode`), and its rigid modes.
Gives: `Peak`, `tick_peak`, `sampled_data_peak`; `noise_variance`.
Guarantees: no grid of frequencies decides anything; an output that observes a rigid mode has no norm.
Does not: prove H∞ norms: their `error` is that of rounding to first order; a variance has a bound.

On ticks, a force is held between consecutive events, and the outputs are read at these: one node at the
beginning of each interval. Otherwise force and motion are taken at Gauss nodes of each interval, as
polynomials whose norms these give exactly: the truncation error falls faster than any power of their number
(Bamieh and Pearson, IEEE Trans. Autom. Control 37 (1992) 418, reduce the same operator; its H∞ norm is that
of this map).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.kyp_bounds import gains_at, is_positive, peak_gain
from apc.eigen.matrix_norms import balance
from apc.eigen.relative_coordinates import relative, relative_coordinates, relative_rows, with_uncertainty
from apc.frame.discretize import exponential
from apc.frame.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    error_radius,
    value_of,
    with_error_radius,
)
from apc.haptics.modal_response import DrivenMode, DrivenPeer, force_columns
from apc.mean_square.second_moment_operator import congruence, stein

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Gauss nodes of an interval, and the additional ones for the error estimate.
NODES, MORE = 4, 2

# The tolerance of a rigid mode in an output, relatively.
UNSEEN = 1e-9

# The smallest variance of a state relative to the others' for scaling.
AT_REST = 1e-12

# The smallest relative error of a norm.
ROUNDED = 1e-12


@dataclass(frozen=True, slots=True)
class Peak:
    """An H∞ norm, in SI per newton, ± `error`, and the frequency in Hz of the largest gain.

    An unstable mode has an infinite norm, and the frequency of its fastest motion.
    """

    norm: float
    error: float
    frequency_hz: float


def tick_peak(loop: DrivenMode, pushed: int, of: int, row: int, basis: Floats) -> Peak:
    """Return the norm on ticks of the map from a force at all devices of a subsystem to a state of another.

    Parameters
    ----------
    loop, pushed, of, row
        The mode, the driven subsystem, and the subsystem and state of the output.
    basis
        The rigid modes (n, d) of the loop.
    """
    return _peak(loop, pushed, of, row, basis, np.zeros(1), np.ones(1), np.zeros(0))[0]


def sampled_data_peak(
    loop: DrivenMode, pushed: int, of: int, row: int, basis: Floats, frequency_hz: Floats
) -> tuple[Peak, Floats]:
    """Return the norm of the same map from arbitrary forces to motions between ticks as well.

    Also its gains at frequencies (k,). The norm is their supremum where the mode is stable; it is infinite
    where it is not.

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
    subsystem, other, nodes = loop.subsystems[pushed], loop.subsystems[of], len(at)
    # The coefficients over σ^i/i!, σ from 0 to 1, of a force that is 1 at its node and 0 at the others.
    powers = at[:, None] ** np.arange(nodes) / np.cumprod([1, *range(1, nodes)])
    forces = np.linalg.inv(powers) / np.sqrt(weights)
    columns = nodes * len(subsystem.seconds)
    inputs = np.zeros((loop.k.shape[-1], columns))
    input_columns = {
        seconds: _input_columns(subsystem, float(seconds), nodes) @ forces / float(seconds) ** 0.5
        for seconds in set(subsystem.seconds)
    }
    for index, seconds in enumerate(subsystem.seconds):
        local = slice(index * nodes, (index + 1) * nodes)
        inputs[loop.forced_increments[pushed][index, :-1], local] = input_columns[seconds]
    rows = nodes * len(other.seconds)
    outputs, through = np.zeros((rows, loop.c.shape[-2])), np.zeros((rows, columns))
    known = {seconds: _within(other, float(seconds), at, row, forces) for seconds in set(other.seconds)}
    for index, seconds in enumerate(other.seconds):
        local = slice(index * nodes, (index + 1) * nodes)
        observed, pushes = known[seconds]
        scale = np.sqrt(weights * float(seconds))[:, None]
        outputs[local, loop.reads[of][index]] = scale * observed
        if pushed == of:
            through[local, local] = scale * pushes / float(seconds) ** 0.5
    if not all(np.isfinite(matrix).all() for matrix in (inputs, outputs, through)):  # overflow
        return Peak(np.nan, np.nan, np.nan), np.full(len(frequency_hz), np.nan)
    c = outputs @ value_of(loop.c)
    if _shows(basis, c):
        return Peak(np.inf, 0.0, 0.0), np.full(len(frequency_hz), np.inf)
    to = relative_coordinates(basis)
    b, c = relative_rows(value_of(loop.k) @ inputs, to), c[:, to.rest]
    a = relative(loop.m, with_uncertainty(to), MIDPOINT_RADIUS)
    d = outputs @ value_of(loop.d) @ inputs + through
    turn = 2 * np.pi * float(loop.frame)
    gains = gains_at(value_of(a), b, c, d, turn * frequency_hz)
    gain, angle = peak_gain(value_of(a), b, c, d)
    if not np.isfinite(gain):
        fastest = max(np.linalg.eigvals(value_of(a)), key=abs)
        return Peak(np.inf, 0.0, float(np.abs(np.angle(fastest))) / turn), gains
    # The error of the state matrix changes the gain there, to first order, by this.
    still = np.exp(1j * angle) * np.eye(len(b)) - value_of(a)
    left, right = np.abs(np.linalg.solve(still.T, c.T)).T, np.abs(np.linalg.solve(still, b))
    error_bound = float(np.linalg.norm(left @ error_radius(a) @ right, 2)) + ROUNDED * gain
    return Peak(gain, error_bound, angle / turn), gains


def _input_columns(subsystem: DrivenPeer, seconds: float, count: int) -> Floats:
    """Return γ_i (n_x, count) of an interval, σ^i/i! in units of its length."""
    n = len(subsystem.states)
    return np.asarray(value_of(force_columns(subsystem, seconds, count))[:n, n:])


def _within(
    subsystem: DrivenPeer, seconds: float, at: Floats, row: int, forces: Floats
) -> tuple[Floats, Floats]:
    """Return a state within an interval at σ (q,), over states and holds (q, n_x + n_u) and forces (q, q)."""
    n, count = len(subsystem.states), len(at)
    observed, pushed = [], []
    for share in at.tolist():
        step = exponential(value_of(subsystem.a), value_of(subsystem.b), seconds * share)
        observed.append(step[row])
        # σ^i/i! up to a fraction of the interval: in units of that fraction, smaller by that power of it.
        input_columns = _input_columns(subsystem, seconds * share, count) * share ** np.arange(count)
        pushed.append(input_columns[row] @ forces)
    return np.array(observed).reshape(count, n + value_of(subsystem.b).shape[1]), np.array(pushed)


def _shows(basis: Floats, outputs: Floats) -> bool:
    """Return whether outputs over states (m, n) observe any of the rigid modes (n, d)."""
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
    """Return the variance of some states under white noise, averaged over the ticks of a frame.

    With an error bound, proved for all matrices within their radii.

    Parameters
    ----------
    loop
        The mode.
    ticks
        The instants in a frame at which noise is drawn, in seconds, from 0 on.
    sources
        The variance of the noise of each subsystem.
    outputs
        The weights of the states, by subsystem and state.
    basis
        The mode's rigid modes (n, d).
    sensors
        Whether noise is added to the samples of devices' positions, in m, or to their forces, in N.

    Returns
    -------
    None where noise drives a rigid mode that the states observe (a drift), or the sum cannot be bounded.
    """
    columns = []
    for subsystem, variance in sources.items():
        local = loop.subsystems[subsystem]
        inputs = np.zeros((2, loop.k.shape[-1], len(ticks)))
        for index, (seconds, start) in enumerate(zip(local.seconds, local.starts, strict=True)):
            input_slots = bisect_right(ticks, start) - 1
            if sensors:
                inputs[0, loop.forced_increments[subsystem][index, -1], input_slots] = 1.0
            else:
                input_columns = force_columns(local, float(seconds), 1)
                inputs[:, loop.forced_increments[subsystem][index, :-1], input_slots] = input_columns[
                    :, : len(local.states), -1
                ]
        inputs *= variance**0.5
        inputs[1] += 4 * UNIT_ROUNDOFF * np.abs(inputs[0])
        columns.append(inputs)
    inputs = np.concatenate(columns, axis=-1)
    read = np.zeros((2, len(ticks), loop.c.shape[-2]))
    for (subsystem, state), weight in outputs.items():
        index_of = {start: index for index, start in enumerate(loop.subsystems[subsystem].starts)}
        for line, tick in enumerate(ticks):
            read[0, line, loop.reads[subsystem][index_of[tick], state]] += weight
    read[1] = 4 * UNIT_ROUNDOFF * np.abs(read[0])
    observed = MIDPOINT_RADIUS.multiply(read, loop.c)
    if _shows(basis, value_of(observed)):
        return None
    at = with_uncertainty(relative_coordinates(basis))
    root = relative_rows(MIDPOINT_RADIUS.multiply(loop.k, inputs), at, MIDPOINT_RADIUS)
    driven = MIDPOINT_RADIUS.multiply(root, np.swapaxes(root, -1, -2))
    moments = _lasting(relative(loop.m, at, MIDPOINT_RADIUS), driven)
    if moments is None:
        return None
    through = MIDPOINT_RADIUS.multiply(MIDPOINT_RADIUS.multiply(read, loop.d), inputs)
    whole = MIDPOINT_RADIUS.add(
        congruence(observed[..., at.rest], moments, MIDPOINT_RADIUS),
        MIDPOINT_RADIUS.multiply(through, np.swapaxes(through, -1, -2)),
    )
    value, error_bound = (
        float(np.trace(matrix)) / len(ticks) for matrix in (value_of(whole), error_radius(whole))
    )
    return value, error_bound + (len(ticks) + 4) * UNIT_ROUNDOFF * value


def _lasting(matrix: Matrix, driven: Matrix) -> Matrix | None:
    """Return Σ_k M^k B M^kᵀ of a matrix M (2, n, n) and symmetric B, None where convergence is not proved.

    Notes
    -----
    Let X̂ be the result in floats, and E = B + M X̂ Mᵀ − X̂ its residual, −θ D² ≤ E ≤ θ D² in the order of
    symmetric matrices for some diagonal D. For a P ≥ 0 with P − M P Mᵀ ≥ (1 − φ) D², φ < 1, the powers of M
    converge to 0 (Lyapunov), and X − X̂ = Σ_k M^k E M^kᵀ lies between −θ/(1 − φ) P and θ/(1 − φ) P. D² is the
    diagonal of X̂, P is Σ_k M^k D² M^kᵀ in floats; θ and φ are the largest sums of rows, over D (Gershgorin).
    """
    value, n = value_of(matrix), matrix.shape[-1]
    moments = stein(value, value_of(driven))
    if moments is None or not n:
        return None if moments is None else driven
    units = balance(np.abs(value)) ** 2
    shares = np.diagonal(moments) / units
    # Powers of two, so that division and multiplication by them are exact.
    sizes = np.sqrt(units * np.maximum(shares, AT_REST * shares.max() or 1.0))
    weights = np.asarray(np.exp2(np.round(np.log2(sizes))), dtype=np.float64)
    seed = np.diag(weights**2)
    gripped = stein(value, seed)
    if gripped is None:
        return None
    (moments, theta), (gripped, phi) = (
        (guess, _left(matrix, added, guess, weights))
        for guess, added in (
            ((moments + moments.T) / 2, driven),
            ((gripped + gripped.T) / 2, MIDPOINT_RADIUS.exact(seed)),
        )
    )
    shape = gripped / np.outer(weights, weights)
    if not (phi < 1 and is_positive(with_error_radius(shape, 2 * UNIT_ROUNDOFF * np.abs(shape)))):
        return None
    wide = np.sqrt(np.diagonal(gripped))
    return with_error_radius(moments, theta / (1 - phi) * np.outer(wide, wide) * (1 + 16 * UNIT_ROUNDOFF))


def _left(matrix: Matrix, added: Matrix, guess: Floats, weights: Floats) -> float:
    """Return the largest sum of a row of B + M X̂ Mᵀ − X̂, over weights."""
    exact = MIDPOINT_RADIUS.exact(guess)
    left = MIDPOINT_RADIUS.subtract(
        MIDPOINT_RADIUS.add(congruence(matrix, exact, MIDPOINT_RADIUS), added), exact
    )
    size = (np.abs(value_of(left)) + error_radius(left)) / np.outer(weights, weights)
    return float(size.sum(axis=-1).max() * (1 + (len(guess) + 8) * UNIT_ROUNDOFF))
