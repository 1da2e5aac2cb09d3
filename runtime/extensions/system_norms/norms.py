"""H∞ and H2 norms of the modes of a model.

Takes: a mode with force inputs (`modal_response.DrivenMode`), and its rigid modes.
Gives: `tick_peak`, `sampled_data_peak`; `noise_variance`.
Guarantees: norms do not depend on a grid of frequencies; an output that observes a rigid mode has no norm.
Does not: prove H∞ norms: their `error` is the rounding to first order; a variance has a proved bound.

On ticks, a force is held between consecutive events, and the outputs are read at these: one node at the
beginning of each interval. Otherwise force and motion are taken at Gauss nodes of each interval, as
polynomials whose norms these give exactly: the truncation error falls faster than any power of their number
(Bamieh and Pearson, IEEE Trans. Autom. Control 37 (1992) 418, reduce the same operator; its H∞ norm is that
of this map).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.haptics.modal_response import DrivenMode, DrivenPeer, force_columns
from apc.haptics.response_norms import Peak
from apc.lifting.discretize import exponential
from apc.lifting.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    error_radius,
    value_of,
    with_error_radius,
)
from apc.mean_square.second_moment_operator import congruence, stein
from apc.spectrum.kyp_bounds import gains_at, is_positive, peak_gain
from apc.spectrum.matrix_norms import balance
from apc.spectrum.relative_coordinates import relative, relative_coordinates, relative_rows, with_uncertainty

Floats = NDArray[np.float64]
Matrix = NDArray[Any]
Gains = Callable[[], Floats]

# Gauss nodes of an interval, and the additional ones for the error estimate.
NODES, MORE = 4, 2

# The tolerance of a rigid mode in an output, relatively.
UNSEEN = 1e-9

# The smallest variance of a state relative to the others' for scaling.
AT_REST = 1e-12

# The smallest relative error of a norm.
ROUNDED = 1e-12


def tick_peak(loop: DrivenMode, pushed: int, output: int, row: int, basis: Floats) -> Peak:
    """Return the H∞ norm on ticks of the map from a force at all devices of a subsystem to a state.

    Parameters
    ----------
    loop, pushed, output, row
        The mode, the driven subsystem, and the subsystem and state of the output.
    basis
        The rigid modes (n, d) of the loop.
    """
    return _peak(loop, pushed, output, row, basis, np.zeros(1), np.ones(1), np.zeros(0))[0]


def sampled_data_peak(
    loop: DrivenMode, pushed: int, output: int, row: int, basis: Floats, frequency_hz: Floats
) -> tuple[Peak, Gains]:
    """Return the H∞ norm of the map from arbitrary forces to motions at all times, and a function that
    returns its gains (k,).

    The norm is the supremum of the gains of a stable mode, and infinite for an unstable mode.

    Parameters
    ----------
    loop, pushed, output, row, basis
        As for `tick_peak`.
    frequency_hz
        The frequencies (k,) in Hz.
    """
    gauss = (np.polynomial.legendre.leggauss(nodes) for nodes in (NODES, NODES + MORE))
    (coarse, _), (fine, gains) = (
        _peak(loop, pushed, output, row, basis, (at + 1) / 2, share / 2, frequency_hz) for at, share in gauss
    )
    if not np.isfinite(fine.norm):
        return fine, gains
    return replace(fine, error=abs(fine.norm - coarse.norm) + fine.error), gains


def _peak(
    loop: DrivenMode,
    pushed: int,
    output: int,
    row: int,
    basis: Floats,
    at: Floats,
    weights: Floats,
    frequency_hz: Floats,
) -> tuple[Peak, Gains]:
    """Return the norm, and the function of the gains.

    Forces and motions are taken at nodes (q,), 0 to 1, of each interval, with weights.
    """
    subsystem, output_subsystem, nodes = loop.subsystems[pushed], loop.subsystems[output], len(at)
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
        node_columns = slice(index * nodes, (index + 1) * nodes)
        inputs[loop.forced_increments[pushed][index, :-1], node_columns] = input_columns[seconds]
    rows = nodes * len(output_subsystem.seconds)
    outputs, through = np.zeros((rows, loop.c.shape[-2])), np.zeros((rows, columns))
    cached = {
        seconds: _state_at_nodes(output_subsystem, float(seconds), at, row, forces)
        for seconds in set(output_subsystem.seconds)
    }
    for index, seconds in enumerate(output_subsystem.seconds):
        node_columns = slice(index * nodes, (index + 1) * nodes)
        state_map, force_map = cached[seconds]
        scale = np.sqrt(weights * float(seconds))[:, None]
        outputs[node_columns, loop.reads[output][index]] = scale * state_map
        if pushed == output:
            through[node_columns, node_columns] = scale * force_map / float(seconds) ** 0.5
    if not all(np.isfinite(matrix).all() for matrix in (inputs, outputs, through)):  # overflow
        return Peak(np.nan, np.nan, np.nan), partial(np.full, len(frequency_hz), np.nan)
    c = outputs @ value_of(loop.c)
    if _observes_rigid_mode(basis, c):
        return Peak(np.inf, 0.0, 0.0), partial(np.full, len(frequency_hz), np.inf)
    coordinates = relative_coordinates(basis)
    b, c = relative_rows(value_of(loop.k) @ inputs, coordinates), c[:, coordinates.rest]
    a = relative(loop.m, with_uncertainty(coordinates), MIDPOINT_RADIUS)
    d = outputs @ value_of(loop.d) @ inputs + through
    radians_per_hz = 2 * np.pi * float(loop.frame)
    gains = partial(gains_at, value_of(a), b, c, d, radians_per_hz * frequency_hz)
    gain, angle = peak_gain(value_of(a), b, c, d)
    if not np.isfinite(gain):
        fastest = max(np.linalg.eigvals(value_of(a)), key=abs)
        return Peak(np.inf, 0.0, float(np.abs(np.angle(fastest))) / radians_per_hz), gains
    # The first-order effect of the error of the state matrix on the gain.
    resolvent_inverse = np.exp(1j * angle) * np.eye(len(b)) - value_of(a)
    left, right = (
        np.abs(np.linalg.solve(resolvent_inverse.T, c.T)).T,
        np.abs(np.linalg.solve(resolvent_inverse, b)),
    )
    error_bound = float(np.linalg.norm(left @ error_radius(a) @ right, 2)) + ROUNDED * gain
    return Peak(gain, error_bound, angle / radians_per_hz), gains


def _input_columns(subsystem: DrivenPeer, seconds: float, count: int) -> Floats:
    """Return γ_i (n_x, count) of an interval, for forces σ^i/i! in units of its length."""
    n = len(subsystem.states)
    return np.asarray(value_of(force_columns(subsystem, seconds, count))[:n, n:])


def _state_at_nodes(
    subsystem: DrivenPeer, seconds: float, at: Floats, row: int, forces: Floats
) -> tuple[Floats, Floats]:
    """Return a state at nodes σ (q,) of an interval, as maps of states and holds, and of forces.

    The maps have the shapes (q, n_x + n_u) and (q, q).
    """
    n, count = len(subsystem.states), len(at)
    state_rows, force_rows = [], []
    for share in at.tolist():
        step = exponential(value_of(subsystem.a), value_of(subsystem.b), seconds * share)
        state_rows.append(step[row])
        # For a fraction of the interval, σ^i/i! is in units of the fraction, which scales it by a power.
        input_columns = _input_columns(subsystem, seconds * share, count) * share ** np.arange(count)
        force_rows.append(input_columns[row] @ forces)
    return np.array(state_rows).reshape(count, n + value_of(subsystem.b).shape[1]), np.array(force_rows)


def _observes_rigid_mode(basis: Floats, outputs: Floats) -> bool:
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
    """Return the variance of an output under white noise, averaged over the ticks of a frame, and its bound.

    The bound is proved for all matrices within their radii.

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
    The variance and its bound; None if noise drives an observed rigid mode (a drift), or without a bound.
    """
    columns = []
    for subsystem, variance in sources.items():
        noisy_subsystem = loop.subsystems[subsystem]
        inputs = np.zeros((2, loop.k.shape[-1], len(ticks)))
        for index, (seconds, start) in enumerate(
            zip(noisy_subsystem.seconds, noisy_subsystem.starts, strict=True)
        ):
            input_slots = bisect_right(ticks, start) - 1
            if sensors:
                inputs[0, loop.forced_increments[subsystem][index, -1], input_slots] = 1.0
            else:
                input_columns = force_columns(noisy_subsystem, float(seconds), 1)
                inputs[:, loop.forced_increments[subsystem][index, :-1], input_slots] = input_columns[
                    :, : len(noisy_subsystem.states), -1
                ]
        inputs *= variance**0.5
        inputs[1] += 4 * UNIT_ROUNDOFF * np.abs(inputs[0])
        columns.append(inputs)
    inputs = np.concatenate(columns, axis=-1)
    read = np.zeros((2, len(ticks), loop.c.shape[-2]))
    for (subsystem, state), weight in outputs.items():
        index_of = {start: index for index, start in enumerate(loop.subsystems[subsystem].starts)}
        for row, tick in enumerate(ticks):
            read[0, row, loop.reads[subsystem][index_of[tick], state]] += weight
    read[1] = 4 * UNIT_ROUNDOFF * np.abs(read[0])
    observed = MIDPOINT_RADIUS.multiply(read, loop.c)
    if _observes_rigid_mode(basis, value_of(observed)):
        return None
    coordinates = with_uncertainty(relative_coordinates(basis))
    noise_input = relative_rows(MIDPOINT_RADIUS.multiply(loop.k, inputs), coordinates, MIDPOINT_RADIUS)
    driven = MIDPOINT_RADIUS.multiply(noise_input, np.swapaxes(noise_input, -1, -2))
    moments = _moment_sum(relative(loop.m, coordinates, MIDPOINT_RADIUS), driven)
    if moments is None:
        return None
    through = MIDPOINT_RADIUS.multiply(MIDPOINT_RADIUS.multiply(read, loop.d), inputs)
    covariance = MIDPOINT_RADIUS.add(
        congruence(observed[..., coordinates.rest], moments, MIDPOINT_RADIUS),
        MIDPOINT_RADIUS.multiply(through, np.swapaxes(through, -1, -2)),
    )
    value, error_bound = (
        float(np.trace(matrix)) / len(ticks) for matrix in (value_of(covariance), error_radius(covariance))
    )
    return value, error_bound + (len(ticks) + 4) * UNIT_ROUNDOFF * value


def _moment_sum(matrix: Matrix, driven: Matrix) -> Matrix | None:
    """Return Σ_k M^k B M^kᵀ of a matrix M (2, n, n) and symmetric B, None if convergence is not proved.

    Notes
    -----
    Let X̂ be the result in floats, and E = B + M X̂ Mᵀ − X̂ its residual, −θ D² ≤ E ≤ θ D² in the order of
    symmetric matrices for some diagonal D. For a P ≥ 0 with P − M P Mᵀ ≥ (1 − φ) D², φ < 1, the powers of M
    converge to 0 (Lyapunov), and X − X̂ = Σ_k M^k E M^kᵀ lies between −θ/(1 − φ) P and θ/(1 − φ) P. D² is the
    diagonal of X̂, P is Σ_k M^k D² M^kᵀ in floats; θ and φ are the largest row sums, relative to D
    (Gershgorin).
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
    lyapunov = stein(value, seed)
    if lyapunov is None:
        return None
    (moments, theta), (lyapunov, phi) = (
        (guess, _largest_residual(matrix, added, guess, weights))
        for guess, added in (
            ((moments + moments.T) / 2, driven),
            ((lyapunov + lyapunov.T) / 2, MIDPOINT_RADIUS.exact(seed)),
        )
    )
    scaled_lyapunov = lyapunov / np.outer(weights, weights)
    if not (
        phi < 1
        and is_positive(with_error_radius(scaled_lyapunov, 2 * UNIT_ROUNDOFF * np.abs(scaled_lyapunov)))
    ):
        return None
    scales = np.sqrt(np.diagonal(lyapunov))
    return with_error_radius(moments, theta / (1 - phi) * np.outer(scales, scales) * (1 + 16 * UNIT_ROUNDOFF))


def _largest_residual(matrix: Matrix, driven: Matrix, guess: Floats, weights: Floats) -> float:
    """Return the largest row sum of the residual B + M X̂ Mᵀ − X̂, scaled by weights."""
    exact = MIDPOINT_RADIUS.exact(guess)
    residual = MIDPOINT_RADIUS.subtract(
        MIDPOINT_RADIUS.add(congruence(matrix, exact, MIDPOINT_RADIUS), driven), exact
    )
    size = (np.abs(value_of(residual)) + error_radius(residual)) / np.outer(weights, weights)
    return float(size.sum(axis=-1).max() * (1 + (len(guess) + 8) * UNIT_ROUNDOFF))
