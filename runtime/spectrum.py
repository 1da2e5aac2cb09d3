"""Eigenvalues with error bounds, and the verdict.

Takes: the `ClosedSystem`s that make up a whole.
Gives: `Mode`, `Spectrum`, `solve_spectrum`.
Guarantees: rigid modes are removed before any eigenvalue is computed; every reported error bounds what
rounding did since the site's coefficients, and a verdict nearer to the boundary than its error says so.
Does not: raise the precision (an undecided verdict is left undecided).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.runtime.discretize import UNIT
from apc.runtime.modes import ClosedSystem
from apc.runtime.pseudospectrum import (
    PRODUCT_ROUNDINGS,
    balance,
    cluster_radius,
    norms,
    pseudospectral_radius,
)
from apc.runtime.rigid import RigidModes, find_rigid_modes

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Matrix = NDArray[Any]  # float64 or complex128

STABLE = "stable"
STABLE_TRANSLATING = "stable up to a common translation"
DRIFTS = "drifts"
UNSTABLE = "unstable"
UNDECIDED = "undecided: |ρ−1| below the error bound"

# A mode that shrinks to less than this in a frame is one that ends in finite time, computed in floats.
DEADBEAT = 1e-12

# Eigenvalues smaller than this decide nothing (e-folding in a fifth of a frame) and are often one defective
# cluster at zero, the queues running empty; the first split between large and small is here.
SMALL = 1e-2

# A radius less certain than this is worth more work: other splits, this many.
WIDE = 1e-8
SPLITS_TRIED = 8

# Eigenvalues nearer to one another than this, relatively, are enclosed together: their own vectors are hardly
# two.
CLOSE = 1e-6

# Backward error of LAPACK's eigenvalues of a small block, in units of n·UNIT·‖block‖_F: 'a modest constant'
# (LAPACK Users' Guide, 3rd ed., section 4.8); measured below 1.
EIGEN_ROUNDINGS = 10


@dataclass(frozen=True, slots=True)
class Mode:
    """One eigenvalue of the whole system's frame map, held `multiplicity` times.

    `magnitude` is per frame; `error` bounds |eigenvalue − truth|. `frequency_hz` and `damping_ratio` belong
    to s = log(eigenvalue)/frame on the branch the motion takes inside the frame. `shape` is the system the
    mode belongs to. `participation` shares the mode out among the states (the shares add up to 1).
    """

    eigenvalue: complex
    magnitude: float
    multiplicity: int
    frequency_hz: float
    damping_ratio: float
    shape: str
    participation: tuple[tuple[str, float], ...]
    error: float


@dataclass(frozen=True, slots=True)
class Spectrum:
    """All modes but the rigid ones, the largest first, and what follows from them.

    `spectral_radius` is per frame; `stable` is None when the verdict is undecided. The error bounds the
    radius from both sides, the verdict needs one: where hardly anything bounds it from below, a system can be
    stable by less than its error.
    """

    modes: tuple[Mode, ...]
    spectral_radius: float
    spectral_radius_error: float
    rigid_modes: int
    drifts: int
    verdict: str
    stable: bool | None


def solve_spectrum(systems: Sequence[ClosedSystem]) -> Spectrum:
    """Compute the spectrum of a whole system given as independent closed systems.

    Parameters
    ----------
    systems
        The closed systems, each counted as often as its multiplicity says.

    Notes
    -----
    A drift leaves a second eigenvalue 1 behind when only the rigid direction is removed. So when every error
    disc keeps clear of 1 there is none, and the exact search for one is spared.
    """
    found: list[Mode] = []
    rigid = drifts = 0
    low = high = 0.0
    for system in systems:
        free = find_rigid_modes(system, with_drifts=False)
        modes, least, most = _solve(system, free)
        if free.names and not all(abs(mode.eigenvalue - 1) > mode.error for mode in modes):
            free = find_rigid_modes(system)
            if free.drifts:
                modes, least, most = _solve(system, free)
        found += modes
        low, high = max(low, least), max(high, most)
        rigid += system.multiplicity * free.directions.shape[1]
        drifts += system.multiplicity * free.drifts
    found.sort(key=lambda mode: (-mode.magnitude, mode.shape, mode.eigenvalue.real, -mode.eigenvalue.imag))
    radius = found[0].magnitude if found else 0.0
    error = max(high - radius, radius - low, 0.0)
    verdict, stable = _judge(low, high, rigid, drifts)
    return Spectrum(tuple(found), radius, error, rigid, drifts, verdict, stable)


def _judge(low: float, high: float, rigid: int, drifts: int) -> tuple[str, bool | None]:
    """Return the verdict and whether it means stable, from the bounds on the radius; NaN decides nothing."""
    if low > 1:
        return UNSTABLE, False
    if not high < 1:
        return UNDECIDED, None
    if drifts:
        return DRIFTS, False
    return (STABLE_TRANSLATING if rigid else STABLE), True


def _solve(system: ClosedSystem, free: RigidModes) -> tuple[list[Mode], float, float]:
    """Return the modes of one system and bounds from below and above on its spectral radius.

    With the rigid motions V = [V_p; V_r], p as many places as there are motions, and W = V_r V_p⁻¹, the
    relative coordinates x_r − W x_p move by themselves, by M_rr − W M_pr: that map has all other eigenvalues.
    """
    n = len(system.names)
    count = free.basis.shape[1]
    if count == n:
        return [], 0.0, 0.0
    matrix, error = system.matrix, system.error
    held = _pivots(free.basis.T)
    rest = np.setdiff1d(np.arange(n), held)
    weights, weights_error = _relative(free.basis[held], free.basis[rest])
    reduced = matrix[np.ix_(rest, rest)] - weights @ matrix[np.ix_(held, rest)]
    size = np.abs(matrix) + error
    reduced_error = error[np.ix_(rest, rest)] + weights_error @ size[np.ix_(held, rest)]
    reduced_error += np.abs(weights) @ error[np.ix_(held, rest)]
    rounded = np.abs(weights) @ size[np.ix_(held, rest)]
    reduced_error += (PRODUCT_ROUNDINGS * (count + 2) * UNIT) * (rounded + np.abs(reduced) * (count > 0))

    values, right, left, errors, low, high = _eigen(reduced, reduced_error)
    # Back to the whole state: x_p follows from (λ − M_pp − M_pr W) x_p = M_pr y.
    corner = matrix[np.ix_(held, held)] + matrix[np.ix_(held, rest)] @ weights
    modes = []
    for value, x, y, bound in zip(values, right.T, left, errors, strict=True):
        vector, covector = np.zeros(n, dtype=np.complex128), np.zeros(n, dtype=np.complex128)
        vector[rest], covector[rest] = x, y
        if count:
            driven = matrix[np.ix_(held, rest)] @ x
            vector[held] = np.linalg.lstsq(value * np.eye(count) - corner, driven, rcond=None)[0]
            vector[rest] += weights @ vector[held]
            covector[held] = -(y @ weights)
        shares = np.abs(vector * covector)
        total = shares.sum()
        shares = shares / total if total > 0 else np.abs(vector) / np.abs(vector).sum()
        modes.append(_mode(system, complex(value), vector, shares, float(bound)))
    return modes, low, high


def _pivots(rows: Matrix) -> NDArray[np.intp]:
    """Return the places (m,) of m columns of rows (m, n) of which the others are small combinations."""
    left = np.array(rows)
    places: list[int] = []
    for _ in range(len(rows)):
        scaled = np.abs(left) / np.maximum(np.abs(rows).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
        line, place = divmod(int(np.argmax(scaled)), rows.shape[1])
        places.append(place)
        if left[line, place] != 0:
            pivot = left[line] / left[line, place]
            left = left - left[:, [place]] * pivot
            left[line] = 0.0
    return np.array(sorted(places), dtype=np.intp)


def _relative(held: Floats, rest: Floats) -> tuple[Floats, Floats]:
    """Return W = V_r V_p⁻¹ and a bound on its error, entry by entry; V itself is rounded once.

    W − W* = (V_r − W V_p + a rounding of either) V_p*⁻¹ up to sign.
    """
    count = len(held)
    inverse = np.linalg.inv(held)
    weights = rest @ inverse
    charge = PRODUCT_ROUNDINGS * (count + 2) * UNIT
    left = np.abs(rest - weights @ held) + charge * (np.abs(rest) + np.abs(weights) @ np.abs(held))
    size = np.abs(inverse)
    wrong = np.abs(np.eye(count) - inverse @ held) + 2 * charge * (size @ np.abs(held))
    assert count == 0 or float(wrong.sum(axis=1).max()) < 0.5, "rigid motions too alike to tell apart"
    # V_p*⁻¹ = (I − F)⁻¹ Y, and |(I − F)⁻¹| ≤ I + |F| + …, at most doubling the largest.
    size = size + 2 * wrong.sum(axis=1, keepdims=True) * size.max(axis=0, initial=0.0)
    return weights, left @ size


def _mode(system: ClosedSystem, value: complex, vector: Complexes, shares: Floats, error: float) -> Mode:
    """Describe one eigenvalue by its vector over the state and its states' shares."""
    magnitude = abs(value)
    if magnitude <= max(DEADBEAT * len(system.names), min(error, SMALL)):
        frequency, damping = 0.0, 1.0
    else:
        angle = _angle(system, value, vector, shares)
        rate = complex(np.log(magnitude), angle) / system.frame_s
        frequency = abs(rate.imag) / (2 * np.pi)
        damping = -rate.real / abs(rate) if rate else 1.0
    return Mode(
        eigenvalue=value,
        magnitude=magnitude,
        multiplicity=system.multiplicity,
        frequency_hz=float(frequency),
        damping_ratio=float(damping),
        shape=system.name,
        participation=tuple(zip(system.names, (float(share) for share in shares), strict=True)),
        error=error,
    )


def _angle(system: ClosedSystem, value: complex, vector: Complexes, shares: Floats) -> float:
    """Return by how much the mode turns in a frame, in radians, whole turns counted.

    The eigenvalue knows the angle up to whole turns; these are counted on the continuous state that takes
    most part, from tick to tick of the fastest clock. A real vector has no angle but its sign: each change
    of sign is half a turn.
    """
    principal = float(np.angle(value))
    if not system.motion:
        return principal
    dominant = int(np.argmax(shares[list(system.motion)]))
    course = system.inside[:, dominant] @ vector
    if not np.all(np.abs(course) > 0):
        return principal
    turned = float(np.sum(np.angle(course[1:] / course[:-1])))
    return principal + 2 * np.pi * round((turned - principal) / (2 * np.pi))


@dataclass(frozen=True, slots=True)
class _Enclosure:
    """Bounds on the spectral radius, and how far each estimate can be from a true eigenvalue."""

    low: float
    high: float
    errors: Floats


def _eigen(matrix: Matrix, error: Floats) -> tuple[Complexes, Complexes, Complexes, Floats, float, float]:
    """Compute eigenvalues, right vectors (columns), left vectors (rows), errors, and the radius's bounds.

    The eigenvalues are split by magnitude, large from small, see `_enclose`. A chain of packets or forces
    that nobody answers is a Jordan block at zero, scattered by rounding over a ring that may reach far out:
    when the first split leaves the radius uncertain, the widest gaps between magnitudes are tried as well.
    What any split proves holds.
    """
    n = len(matrix)
    scale = balance(np.abs(matrix) + error)
    matrix, error = matrix / scale[:, None] * scale, error / scale[:, None] * scale
    values, right = (part.astype(np.complex128) for part in np.linalg.eig(matrix))
    order = np.lexsort((-values.imag, values.real, -np.abs(values)))
    values, right = values[order], right[:, order]
    left = _left_vectors(matrix, values)
    sizes = np.abs(values)

    # Splits between k and k + 1: conjugates stay together.
    ratios = np.append(sizes[1:], 0.0) / np.maximum(sizes, np.finfo(np.float64).tiny)
    first = int((sizes >= SMALL).sum())
    counts = [int(k) + 1 for k in np.argsort(ratios[:-1], kind="stable") if ratios[k] < 1 - CLOSE]
    others = [count for count in counts if count != first and sizes[count - 1] > SMALL]
    tried = [_enclose(matrix, error, values, right, left, first)]
    for count in (*others[:SPLITS_TRIED], 0):
        if min(one.high for one in tried) - max(one.low for one in tried) <= WIDE:
            break
        tried.append(_enclose(matrix, error, values, right, left, count))
    low, high = max(one.low for one in tried), min(one.high for one in tried)
    # No estimate is farther from its eigenvalue than both are from zero.
    errors = np.minimum(np.min([one.errors for one in tried], axis=0), sizes + high)
    if n:
        low = min(low, high)
    return values, right * scale[:, None], left / scale, errors, low, high


def _left_vectors(matrix: Matrix, values: Complexes) -> Complexes:
    """Return left eigenvectors as rows in the order of the values: those of Mᵀ, each to its nearest value."""
    n = len(matrix)
    found, vectors = np.linalg.eig(matrix.T)
    distances = np.abs(values[:, None] - found[None, :])
    left = np.empty((n, n), dtype=np.complex128)
    for i in range(n):
        nearest = int(np.argmin(distances[i]))
        left[i] = vectors[:, nearest]
        distances[:, nearest] = np.inf
    return left


def _enclose(
    matrix: Matrix, error: Floats, values: Complexes, right: Complexes, left: Complexes, large: int
) -> _Enclosure:
    """Enclose the eigenvalues of a matrix known up to `error` entry by entry, the `large` first sharply.

    Notes
    -----
    X = [X₁ X₂]: X₁ the right vectors of the large ones, X₂ annihilated by their left vectors. Then
    X⁻¹(M + E)X = diag(T₁, …, T_k, T) + G, |G| ≤ |X⁻¹| (|residual| + |E| |X|), one block T_c a cluster of
    large eigenvalues that are nearly equal, and T for all that are small. Every eigenvalue z then has
    ‖(z − T_c)⁻¹‖ Σ_b ‖G_cb‖ ≥ 1 for some block c (Feingold and Varga, Block diagonally dominant matrices,
    1962): it is in a disc of `cluster_radius` about an eigenvalue of T_c, or within `pseudospectral_radius`
    of T about zero. Discs that touch hold together as many eigenvalues as there are of them.
    """
    n = len(matrix)
    worst = _Enclosure(0.0, np.inf, np.full(n, np.inf))
    clusters = _close(values[:large])
    basis: Matrix = np.zeros((n, n), dtype=np.complex128)
    free = np.arange(n)
    for cluster in clusters:
        span = right[:, cluster]
        basis[:, cluster] = np.linalg.qr(span)[0] if len(cluster) > 1 else span
    if large:
        rows = left[:large].copy()
        for cluster in clusters:
            if len(cluster) > 1:
                rows[cluster] = np.linalg.qr(rows[cluster].T)[0].T
        held = _pivots(rows)
        free = np.setdiff1d(free, held)
        try:
            basis[np.ix_(held, np.arange(large, n))] = -np.linalg.solve(rows[:, held], rows[:, free])
        except np.linalg.LinAlgError:
            return worst
    basis[free, np.arange(large, n)] = 1.0
    if not basis.imag.any():
        basis = basis.real
    try:
        inverse = np.linalg.inv(basis)
    except np.linalg.LinAlgError:
        return worst
    blocks = [*clusters, np.arange(large, n)] if large < n else clusters

    # The block diagonal form as it came out, and all that it leaves; the products' roundings are included.
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    moved = matrix @ basis
    product = inverse @ moved
    form = np.zeros_like(product)
    for block in blocks:
        form[np.ix_(block, block)] = product[np.ix_(block, block)]
    real = np.isrealobj(matrix)
    if real:  # the large ones are whole conjugate pairs, so what is left is real
        form[large:, large:] = form[large:, large:].real
    size, weight = np.abs(basis), np.abs(inverse)
    doubt = np.abs(moved - basis @ form) + error @ size
    doubt += charge * (np.abs(matrix) @ size + size @ np.abs(form))
    # The computed inverse Y is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
    wrong = (np.abs(np.eye(n) - inverse @ basis) + charge * (weight @ size)).sum(axis=1)
    defect = float(wrong.max(initial=0.0))
    if not defect < 0.5:
        return worst
    left_over = weight @ doubt * (1 + charge)
    left_over += wrong[:, None] / (1 - defect) * left_over.max(axis=0, initial=0.0)
    if not np.isfinite(left_over).all():
        return worst

    # Σ_b ‖G_cb‖ in the Frobenius norm; relative to the largest entry, so that no square is lost.
    member = np.zeros((n, len(blocks)))
    for place, block in enumerate(blocks):
        member[block, place] = 1.0
    peak = float(left_over.max(initial=0.0))
    squares = np.square(left_over / peak) if peak > 0 else left_over
    sizes = peak * (1 + charge) * (np.sqrt(member.T @ squares @ member) + 1e-150)
    if large < n:
        sizes[-1, -1] = norms(left_over[large:, large:])  # often much less: many entries, few in a row
    totals = sizes.sum(axis=1)

    centres, radii = np.zeros(n, dtype=np.complex128), np.zeros(n)
    for block, total in zip(blocks, totals, strict=True):
        own = form[np.ix_(block, block)]
        if block[0] >= large:
            radii[block] = pseudospectral_radius(own.real if real else own, float(total))
        else:
            centres[block], radii[block] = _block_discs(own, float(total))
    return _discs(values, centres, radii)


def _block_discs(block: Matrix, error: float) -> tuple[Complexes, float]:
    """Return the centres and the radius of discs that hold the eigenvalues of a block known up to `error`."""
    if len(block) == 1:
        return block[0].astype(np.complex128), error
    own = np.linalg.eigvals(block).astype(np.complex128)
    norm = float(np.linalg.norm(block))
    rounding = EIGEN_ROUNDINGS * len(block) * UNIT
    departure = norm**2 - float((np.abs(own) ** 2).sum())
    departure = np.sqrt(max(departure, 0.0) + 4 * rounding * norm**2)
    return own, cluster_radius(len(block), float(departure), error + rounding * norm)


def _close(values: Complexes) -> list[NDArray[np.intp]]:
    """Return the places of eigenvalues that are nearly equal, chain by chain."""
    near = np.abs(values[:, None] - values[None, :]) <= CLOSE * np.abs(values)[:, None]
    label = _connected(near)
    return [np.flatnonzero(label == one) for one in np.unique(label)]


def _connected(touching: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return for each place the least place that it hangs together with."""
    n = len(touching)
    touching = touching | touching.T
    label = np.arange(n)
    while True:
        spread = np.where(touching, label[None, :], n).min(axis=1, initial=n)
        if np.array_equal(spread, label):
            return label
        label = spread


def _discs(values: Complexes, centres: Complexes, radii: Floats) -> _Enclosure:
    """Return bounds on the spectral radius and, for each estimate, how far its eigenvalue can be.

    k discs that hang together hold k eigenvalues, nobody knows which in which: each estimate is then off by
    at most the distance to the far side of any of them.
    """
    label = _connected(np.abs(centres[:, None] - centres[None, :]) <= radii[:, None] + radii[None, :])
    reach = np.abs(values[:, None] - centres[None, :]) + radii[None, :]
    errors = np.where(label[:, None] == label[None, :], reach, 0.0).max(axis=1)
    inner = np.abs(centres) - radii
    low = max(0.0, *(float(inner[label == one].min()) for one in np.unique(label)))
    return _Enclosure(low, float((np.abs(centres) + radii).max()), errors)
