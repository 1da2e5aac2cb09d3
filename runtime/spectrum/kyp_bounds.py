"""Frequency-domain extremes of a loop: its H∞ norm and the smallest eigenvalue of its Hermitian part.

Takes: x⁺ = A x + B r, d = C x + D r, of floats or of floats with their radii.
Gives: `gains_at`, `peak_gain`, `least_real`; `proves_gain`, `proves_positive`; `is_positive`.
Guarantees: a proof holds for all matrices within the radii. No grid of frequencies decides anything.
Does not: remove rigid modes, or scale inputs.

With G(z) = C (zI − A)⁻¹ B + D and He G = (G + G*)/2, both problems are one, as −‖G‖₂/2 is the smallest
eigenvalue of the Hermitian part of [[0, G], [0, 0]]. A proof is a storage function xᵀP x, P ≻ 0, that grows
by less than the supply, for every input:

    xᵀPx − x⁺ᵀPx⁺ + [x; r]ᵀ S [x; r] > 0        gain below γ: S(x, r) = γ²|r|² − |d|²
                                                He G + W ≻ 0: S(x, r) = 2 rᵀ(d + W r)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, error_radius, value_of

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Levels tried on the way to the extreme: each step squares the distance, so some four are needed.
LEVELS = 40

# Angles of the first samples of a response: an even grid, and those of the eigenvalues nearest to the circle,
# with neighbours at the distance of their half-power points.
EVENLY, NEAREST = 17, 8

# How far above the known extreme a level is tried, relatively, and how near the axis, relatively, an
# eigenvalue counts as imaginary: two that merge there have an error of the square root of rounding.
ABOVE, ON_AXIS = 1e-13, 1e-5

# Doublings of a Riccati equation: fewer than ten are needed unless a level is near the extreme, and some 20
# where one is within 1e-10 of it.
DOUBLINGS = 30

# The smallest storage of a state, relative to the largest.
UNSEEN = 1e-9

# Fractions of a storage that are left for rounding, the first that suffices.
SPARED = tuple(10.0**-k for k in range(3, 12))


def peak_gain(a: Floats, b: Floats, c: Floats, d: Floats) -> tuple[float, float]:
    """Return max over θ of ‖C (e^{jθ} − A)⁻¹ B + D‖₂ and its θ in [0, π]; infinite where A is not stable.

    Notes
    -----
    The Hermitian part of [[0, G], [0, 0]] has the smallest eigenvalue −‖G‖₂/2.
    """
    if not d.size:
        return 0.0, 0.0

    # The other outputs and inputs are zero.
    p, m = d.shape
    wide_b, wide_c, wide_d = (
        np.pad(b, [(0, 0), (p, 0)]),
        np.pad(c, [(0, m), (0, 0)]),
        np.pad(d, [(0, m), (p, 0)]),
    )
    minimum, angle = _minimum_over_frequency(
        a,
        wide_b,
        wide_c,
        wide_d,
        np.zeros((p + m, p + m)),
        lambda a, b, angles: -gains_at(a, b[:, p:], c, d, angles) / 2,
    )
    return -2 * minimum, angle


def gains_at(a: Floats, b: Floats, c: Floats, d: Floats, angles: Floats) -> Floats:
    """Return ‖C (e^{jθ} − A)⁻¹ B + D‖₂ at some angles.

    Parameters
    ----------
    a, b, c, d
        The loop's matrices.
    angles
        θ (k,), in rad.
    """
    return np.asarray(np.linalg.svd(_response(a, b, c, d, angles), compute_uv=False)[:, 0])


def least_real(a: Floats, b: Floats, c: Floats, d: Floats, weight: Floats) -> tuple[float, float]:
    """Return min over θ of the smallest eigenvalue of He(C (e^{jθ} − A)⁻¹ B + D) + W, and its θ in [0, π].

    −∞ where A is not stable; +∞ without inputs.

    Parameters
    ----------
    a, b, c, d
        The loop's matrices, as many inputs as outputs.
    weight
        W (m, m), symmetric.
    """
    if not weight.size:
        return np.inf, 0.0

    def least(a: Floats, b: Floats, angles: Floats) -> Floats:
        """Return the smallest eigenvalue at each angle."""
        response = _response(a, b, c, d, angles)
        adjoint = np.swapaxes(response, -1, -2).conj()
        return np.asarray(np.linalg.eigvalsh((response + adjoint) / 2 + weight)[:, 0])

    return _minimum_over_frequency(a, b, c, d, weight, least)


def _minimum_over_frequency(
    a: Floats,
    b: Floats,
    c: Floats,
    d: Floats,
    weight: Floats,
    least: Callable[[Floats, Floats, Floats], Floats],
) -> tuple[float, float]:
    """Return the minimum over θ of the smallest eigenvalue of a Hermitian part, and its θ in [0, π].

    `least` returns the smallest eigenvalues (k,) for A and B at given angles (k,).

    Notes
    -----
    The smallest eigenvalue is s at θ exactly where the pencil of D + Dᵀ + 2 (W − s I) has the eigenvalue
    e^{jθ}. With z = (1 + s)/(1 − s) that is a Hamiltonian matrix with an imaginary eigenvalue, whose point at
    infinity must not be the minimum: θ = π, or θ = 0 of −A and −B. Between two frequencies at which the
    smallest eigenvalue equals a level just below all known values it is lower: the lowest at their midpoints
    is the next level (Bruinsma and Steinbuch, 1990).
    """
    values = np.linalg.eigvals(a)
    if np.abs(values).max(initial=0.0) >= 1:
        return -np.inf, 0.0
    at_zero, at_pi = map(float, least(a, b, np.array([0.0, np.pi])))
    is_mirrored = at_zero > at_pi
    mirrored = (-a, -b) if is_mirrored else (a, b)
    a_c, b_c, c_c, d_c = _continuous_time(*mirrored, c, d)
    scale = max(float(np.abs(d_c + weight).max()), abs(at_zero), abs(at_pi))

    best, best_angle = -float(np.finfo(np.float64).max), 0.0
    largest = values[np.argsort(-np.abs(values))[:NEAREST]]
    angle, separation = np.abs(np.angle(-largest if is_mirrored else largest)), 1 - np.abs(largest)
    grid = np.linspace(0, np.pi, EVENLY)
    angles = np.clip(np.concatenate([grid, angle, angle - separation, angle + separation]), 0, np.pi)
    for _ in range(LEVELS):
        depths = -least(*mirrored, angles)
        index = int(np.argmax(depths))
        improves = depths[index] > best + ABOVE * abs(best)
        if depths[index] > best:
            best, best_angle = float(depths[index]), float(angles[index])
        level = best + ABOVE * max(abs(best), scale)
        if not improves or not level:
            break
        r = np.linalg.inv(d_c + d_c.T + 2 * weight + 2 * level * np.eye(len(weight)))
        a_h = a_c - b_c @ r @ c_c
        pencil_values = np.linalg.eigvals(np.block([[a_h, -b_c @ r @ b_c.T], [c_c.T @ r @ c_c, -a_h.T]]))
        frequencies = np.sort(
            pencil_values.imag[
                (np.abs(pencil_values.real) <= ON_AXIS * np.abs(pencil_values)) & (pencil_values.imag >= 0)
            ]
        )
        frequencies = np.concatenate([[0.0], frequencies])
        angles = 2 * np.arctan(np.concatenate([frequencies, (frequencies[1:] + frequencies[:-1]) / 2]))
    return -best, np.pi - best_angle if is_mirrored else best_angle


def _continuous_time(a: Floats, b: Floats, c: Floats, d: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Return A, B, C, D over s of a loop given over z = (1 + s)/(1 − s)."""
    inverse = np.linalg.inv(np.eye(len(a)) + a)
    a_c, b_c = inverse @ (a - np.eye(len(a))), np.sqrt(2) * inverse @ b
    return a_c, b_c, np.sqrt(2) * c @ inverse, d - c @ inverse @ b


def _response(a: Floats, b: Floats, c: Floats, d: Floats, angles: Floats) -> NDArray[np.complex128]:
    """Return C (e^{jθ} − A)⁻¹ B + D at angles θ (k,)."""
    z = np.exp(1j * angles)[:, None, None]
    inner = np.linalg.solve(z * np.eye(len(a)) - a, np.broadcast_to(b + 0j, (len(angles), *b.shape)))
    return np.asarray(c @ inner + d)


def proves_gain(a: Matrix, b: Matrix, c: Matrix, d: Matrix, level: float) -> bool:
    """Return whether a loop is proved stable and its gain proved smaller than a level.

    Parameters
    ----------
    a, b, c, d
        The loop's matrices (2, …) with their radii.
    level
        The level to prove, above the gain.
    """
    n, m = b.shape[-2:]
    supplied = np.zeros((2, n + m, n + m))
    supplied[0, n:, n:] = level**2 * (1 - 4 * UNIT_ROUNDOFF) * np.eye(m)
    output = np.concatenate([c, d], axis=-1)
    output_power = MIDPOINT_RADIUS.multiply(np.swapaxes(output, -1, -2), output)
    return _dissipates(a, b, MIDPOINT_RADIUS.subtract(supplied, output_power), SPARED)


def proves_positive(
    a: Matrix, b: Matrix, c: Matrix, d: Matrix, weight: Matrix, *, spared: Sequence[float] = SPARED
) -> bool:
    """Return whether a loop is proved stable and He(C (e^{jθ} − A)⁻¹ B + D) + W proved positive for all θ.

    Parameters
    ----------
    a, b, c, d, weight
        The loop's matrices and W (2, …) with their radii.
    spared
        Fractions of the storage that are left for rounding, tried in order: less than the relative margin of
        the supply.

    """
    n, m = b.shape[-2:]
    supply, direct = np.zeros((2, n + m, n + m)), MIDPOINT_RADIUS.add(d, weight)
    supply[:, n:, :n], supply[:, :n, n:] = c, np.swapaxes(c, -1, -2)
    supply[:, n:, n:] = MIDPOINT_RADIUS.add(direct, np.swapaxes(direct, -1, -2))
    return _dissipates(a, b, supply, spared)


def _dissipates(a: Matrix, b: Matrix, supply: Matrix, spared: Sequence[float]) -> bool:
    """Return whether a loop is proved stable and dissipative for a supply rate.

    Parameters
    ----------
    a, b
        The loop's matrices (2, n, n) and (2, n, m) with their radii.
    supply
        S (2, n + m, n + m), symmetric, with its radii; its first block must be negative semidefinite (no
        supply without input).
    spared
        As for `proves_positive`.

    Notes
    -----
    P solves the Riccati equation of a slightly smaller supply, in floats; the proof then verifies P.
    """
    if not all(np.isfinite(values).all() for values in (a, b, supply)):
        return False
    plain = value_of(a), value_of(b), value_of(supply)
    first = _storage(*plain, np.zeros(len(plain[0])))
    if first is None:
        return False
    # States without an effect need some storage, too, so that P is positive definite.
    sizes = np.diag(first)
    sizes = np.maximum(sizes, UNSEEN * sizes.max(initial=0.0) or 1.0)
    storages = (_storage(*plain, part * sizes) for part in spared)
    return any(_is_storage(a, b, supply, (p + p.T) / 2) for p in storages if p is not None)


def _storage(a: Floats, b: Floats, supply: Floats, added: Floats) -> Floats | None:
    """Return P = AᵀPA − S₁₁ + diag(added) + (AᵀPB − S₁₂)(S₂₂ − BᵀPB)⁻¹(…)ᵀ by doubling.

    The result is None without convergence.

    Notes
    -----
    Chu, Fan and Lin (2005).
    """
    n = len(a)
    with np.errstate(all="ignore"):
        try:
            initial = np.linalg.solve(supply[n:, n:], np.hstack([supply[n:, :n], b.T]))
            a_k, g = a - b @ initial[:, :n], -b @ initial[:, n:]
            h = supply[:n, n:] @ initial[:, :n] - supply[:n, :n] + np.diag(added)
            for _ in range(DOUBLINGS):
                solution = np.linalg.solve(np.eye(n) + g @ h, np.hstack([a_k, g @ a_k.T]))
                values, reciprocal = solution[:, :n], solution[:, n:]
                increment = a_k.T @ h @ values
                h, g, a_k = h + increment, g + a_k @ reciprocal, a_k @ values
                if not np.isfinite(h).all():
                    return None
                if np.abs(increment).max(initial=0.0) <= UNIT_ROUNDOFF * np.abs(h).max(initial=0.0):
                    return h
        except np.linalg.LinAlgError:
            return None
    return None


def _is_storage(a: Matrix, b: Matrix, supply: Matrix, p: Floats) -> bool:
    """Return whether the storage function xᵀP x proves that a loop is dissipative for a supply rate.

    Parameters
    ----------
    a, b, supply
        The loop's matrices and S, with their radii, as for `_dissipates`.
    p
        P (n, n), symmetric.
    """
    n = len(p)
    storage = MIDPOINT_RADIUS.exact(p)
    next_state = np.concatenate([a, b], axis=-1)
    next_storage = MIDPOINT_RADIUS.multiply(
        np.swapaxes(next_state, -1, -2), MIDPOINT_RADIUS.multiply(storage, next_state)
    )
    supplied = np.array(supply)
    supplied[:, :n, :n] = MIDPOINT_RADIUS.add(supplied[:, :n, :n], storage)
    return is_positive(storage) and is_positive(MIDPOINT_RADIUS.subtract(supplied, next_storage))


def is_positive(matrix: Matrix) -> bool:
    """Return whether all symmetric matrices within the radii of a matrix (2, n, n) are proved positive
    definite.

    Notes
    -----
    They are if a floating-point Cholesky factorization of the matrix minus c I succeeds, where c exceeds the
    norm of the radii and the rounding of the factorization, γ_{n+1} tr / (1 − γ_{n+1}) (Rump, 2006). Rows and
    columns are scaled by powers of two before, which is exact.
    """
    value, radius = value_of(matrix), error_radius(matrix)
    n = len(value)
    diagonal = np.diag(value)
    if not np.isfinite(matrix).all() or (diagonal <= 0).any():
        return False
    scale = np.ldexp(1.0, -(np.frexp(diagonal)[1] // 2))
    value, radius = scale[:, None] * value * scale, scale[:, None] * radius * scale
    # The mean of the matrix and its transpose is within the radii of either, but for one rounding.
    error_bound = np.maximum(radius, radius.T) + np.abs(value - value.T) + 2 * UNIT_ROUNDOFF * np.abs(value)
    rounding = (n + 2) * UNIT_ROUNDOFF
    shift = 1.01 * (
        float(error_bound.sum(axis=1).max(initial=0.0)) + rounding / (1 - rounding) * float(np.trace(value))
    )
    try:
        np.linalg.cholesky((value + value.T) / 2 - (shift + 4 * UNIT_ROUNDOFF) * np.eye(n))
    except np.linalg.LinAlgError:
        return False
    return True
