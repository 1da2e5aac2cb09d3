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

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import matrix_balance, schur, solve_sylvester

from apc.runtime.discretize import UNIT
from apc.runtime.modes import ClosedSystem
from apc.runtime.rigid import RigidModes, find_rigid_modes

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

STABLE = "stable"
STABLE_TRANSLATING = "stable up to a common translation"
DRIFTS = "drifts"
UNSTABLE = "unstable"
UNDECIDED = "undecided: |ρ−1| below the error bound"

# A mode that shrinks to less than this in a frame is one that ends in finite time, computed in floats.
DEADBEAT = 1e-12

# Eigenvalues smaller than this decide nothing (e-folding in a fifth of a frame) and are often one defective
# cluster at zero, the queues running empty; they are bounded together, so that they spoil no other's bound.
SMALL = 1e-2

# A radius less certain than this is worth more work: other limits between large and small, this many.
WIDE = 1e-8
SPLITS_TRIED = 6

# Above so many states, the vectors of small eigenvalues come from the Schur form: a singular value
# decomposition for each of them costs n⁴.
MOST_SINGULAR = 128

# Powers of a block of small eigenvalues that bound its resolvent: a queue of that many packets is empty by
# then.
RESOLVENT_POWERS = 32

# Backward error of LAPACK's reduction to Schur form and of the few orthogonal products here, in units of
# n·UNIT·‖matrix‖_F: 'a modest constant' (LAPACK Users' Guide, 3rd ed., section 4.8); measured below 1.
SCHUR_ROUNDINGS = 10


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

    `spectral_radius` is per frame; `stable` is None when the verdict is undecided.
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
    found.sort(key=lambda mode: (-mode.magnitude, mode.shape, mode.eigenvalue.real, mode.eigenvalue.imag))
    radius = found[0].magnitude if found else 0.0
    error = max(high - radius, radius - low, 0.0)
    verdict, stable = _judge(radius, error, rigid, drifts)
    return Spectrum(tuple(found), radius, error, rigid, drifts, verdict, stable)


def _judge(radius: float, error: float, rigid: int, drifts: int) -> tuple[str, bool | None]:
    """Return the verdict and whether it means stable; one NaN decides nothing."""
    if radius - error > 1:
        return UNSTABLE, False
    if not radius + error < 1:
        return UNDECIDED, None
    if drifts:
        return DRIFTS, False
    return (STABLE_TRANSLATING if rigid else STABLE), True


def _solve(system: ClosedSystem, free: RigidModes) -> tuple[list[Mode], float, float]:
    """Return the modes of one system and bounds from below and above on its spectral radius."""
    n = len(system.names)
    # Balancing scales by powers of two: it changes no digit.
    _, (scale, _) = matrix_balance(system.matrix, permute=False, separate=True)
    matrix = system.matrix / scale[:, None] * scale
    error = system.error / scale[:, None] * scale
    count = free.basis.shape[1]
    if count == n:
        return [], 0.0, 0.0
    # Q = [Q1 Q2], Q1 spanning the rigid motions: Qᵀ M Q = [J C; 0 H], and H holds all the others.
    known = free.basis / scale[:, None]
    known = known / np.linalg.norm(known, axis=0)
    basis, _ = np.linalg.qr(known, mode="complete")
    rigid, rest = basis[:, :count], basis[:, count:]
    reduced = rest.T @ matrix @ rest
    reduced_error = np.abs(rest.T) @ error @ np.abs(rest)
    # The directions are rounded; the closer they are to one another, the more that turns their span.
    turned = float(np.linalg.cond(known)) if count else 1.0
    reduced_error += SCHUR_ROUNDINGS * n * UNIT * turned * float(np.linalg.norm(matrix))

    values, right, left, errors, low, high = _eigen(reduced, reduced_error)
    # Back to the whole state: the right vectors get their rigid part, the left ones have none.
    corner, coupling = rigid.T @ matrix @ rigid, rigid.T @ matrix @ rest
    modes = []
    for value, x, y, bound in zip(values, right.T, left, errors, strict=True):
        whole = rest @ x
        if count:
            whole = (
                whole + rigid @ np.linalg.lstsq(value * np.eye(count) - corner, coupling @ x, rcond=None)[0]
            )
        shares = np.abs(whole * (rest @ y))
        total = shares.sum()
        shares = shares / total if total > 0 else np.abs(whole) / np.abs(whole).sum()
        modes.append(_mode(system, complex(value), whole * scale, shares, float(bound)))
    return modes, low, high


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
    """Eigenvalue estimates and the discs that hold the true ones, as many as there are discs.

    `right` has the vectors as columns, `inverse` as rows; both are sound for the first `large` only.
    """

    values: Complexes
    centres: Complexes
    radii: Floats
    right: Complexes
    inverse: Complexes
    large: int

    @property
    def width(self) -> float:
        """How uncertain the spectral radius is."""
        low, high, _ = _clusters(self)
        return high - low


def _eigen(matrix: Floats, error: Floats) -> tuple[Complexes, Complexes, Complexes, Floats, float, float]:
    """Compute eigenvalues, right vectors (columns), left vectors (rows), errors, and the radius's bounds.

    The eigenvalues are split by magnitude, large from small, see `_enclose`. A chain of packets or forces
    that nobody answers is a Jordan block at zero, scattered by rounding over a ring that may reach far out:
    when the first split leaves the radius uncertain, the widest gaps between magnitudes are tried as well.
    """
    found = _enclose(matrix, error, SMALL)
    if not found.width <= WIDE:
        sizes = np.sort(np.abs(found.values))
        sizes = sizes[sizes > SMALL]
        gaps = np.argsort(sizes[:-1] / sizes[1:], kind="stable")[:SPLITS_TRIED]
        limits = [float(np.sqrt(sizes[gap] * sizes[gap + 1])) for gap in gaps]
        tried = [found, *(_enclose(matrix, error, limit) for limit in limits)]
        found = min(tried, key=lambda one: one.width)
    low, high, errors = _clusters(found)
    # A real matrix: an eigenvalue alone in a disc across the real axis has no conjugate, so it is real.
    alone = errors == found.radii
    values = found.values.copy()
    real = alone & (np.abs(values.imag) <= found.radii)
    values[real] = values[real].real
    right, left = _plain_vectors(matrix, found, values)
    return values, right, left, errors, low, high


def _enclose(matrix: Floats, error: Floats, limit: float) -> _Enclosure:
    """Enclose the eigenvalues of a matrix that is known up to `error`, entry by entry.

    Notes
    -----
    Schur form with the eigenvalues below `limit` last, T = [T₁ R; 0 T₂]; a Sylvester equation frees T₁ of R,
    and the eigenvectors V of T₁ diagonalize it. With X the transformation and E the error of the matrix,
    X⁻¹(M + E)X = diag(Λ, T₂) + G, |G| ≤ |X⁻¹| (|residual| + |E| |X|). Every eigenvalue then lies in one of
    the discs of Gershgorin about Λ, of radius Σ_j |G_ij|, or where ‖(λ − T₂)⁻¹‖ ‖G₂‖ ≥ 1 (Feingold and
    Varga, Block diagonally dominant matrices, 1962), which is inside a disc about 0, see `_resolvent_radius`.
    Discs that touch hold together as many eigenvalues as there are of them.

    Where the eigenvectors fail (a defective matrix), Elsner's bound holds for the matrix as a whole:
    |λ − λ̂| ≤ (‖M‖ + ‖M + E‖)^(1−1/n) ‖E‖^(1/n) (Stewart and Sun, Matrix Perturbation Theory, IV.1.3).
    """
    n = len(matrix)
    triangle, unitary, large = _sorted_schur(matrix, limit)
    values = np.diag(triangle).copy()
    upper, lower = triangle[:large, :large], triangle[large:, large:]
    right = np.zeros((n, n), dtype=np.complex128)
    right[large:, large:] = np.eye(n - large)
    if large:
        right[:large, :large] = _triangular_vectors(upper)
        if large < n:
            right[:large, large:] = solve_sylvester(upper, -lower, -triangle[:large, large:])
    right = unitary @ right
    right /= np.linalg.norm(right, axis=0)
    spread = float(np.linalg.norm(error)) + SCHUR_ROUNDINGS * n * UNIT * float(np.linalg.norm(matrix))
    crude = np.full(n, (2 * float(np.linalg.norm(matrix)) + spread) ** (1 - 1 / n) * spread ** (1 / n))
    try:
        inverse = np.linalg.inv(right).astype(np.complex128)
    except np.linalg.LinAlgError:
        inverse = np.full((n, n), np.nan + 0j)
    whole = _Enclosure(values, values, crude, right, inverse, large if np.isfinite(inverse).all() else 0)
    if not np.isfinite(inverse).all():
        return whole

    # The block diagonal form as it came out, and all that it leaves; the rounding of the products is
    # included.
    form = np.diag(values).astype(np.complex128)
    form[large:, large:] = inverse[large:] @ (matrix @ right[:, large:])
    doubt = np.abs(matrix @ right - right @ form) + error @ np.abs(right)
    doubt += 4 * (n + 2) * UNIT * (np.abs(matrix) @ np.abs(right) + np.abs(right) @ np.abs(form))
    weight = np.abs(inverse)
    # The computed inverse Y is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
    wrong = np.abs(np.eye(n) - inverse @ right) + 4 * n * UNIT * (weight @ np.abs(right))
    defect = float(wrong.sum(axis=1).max())
    if not defect < 0.5:
        return whole
    rows = (weight @ doubt).sum(axis=1)
    # A row of (I − F)⁻¹ Z = Z + F (I − F)⁻¹ Z: its own, and F's own row over the largest of (I − F)⁻¹ Z.
    rows = rows + wrong.sum(axis=1) / (1 - defect) * float(rows.max())
    centres, radii = values.copy(), rows
    centres[large:] = 0.0
    radii[large:] = _resolvent_radius(form[large:, large:], float(np.linalg.norm(rows[large:])))
    if not np.isfinite(radii).all():
        return whole
    sharp = _Enclosure(values, centres, radii, right, inverse, large)
    return sharp if sharp.width <= whole.width else whole


def _resolvent_radius(block: Complexes, error: float) -> float:
    """Return ρ such that no matrix within `error` (in the 2-norm) of the block has an eigenvalue beyond ρ.

    For |λ| > ρ the Neumann series of the resolvent, grouped by K powers, gives
    ‖(λ − T)⁻¹‖ ≤ Σ_{k<K} ‖T^k‖ ρ^(−k−1) / (1 − ‖T^K‖ ρ^(−K)); while that is less than 1/error, λ is no
    eigenvalue.
    """
    n = len(block)
    if not n:
        return 0.0
    size = float(np.linalg.norm(block))
    powers, norms, rounding = np.eye(n, dtype=np.complex128), [1.0], 0.0
    for _ in range(RESOLVENT_POWERS):
        rounding = rounding * size + 4 * n * UNIT * size * float(np.linalg.norm(powers))
        powers = powers @ block
        norms.append(min(float(np.linalg.norm(powers)) + rounding, norms[-1] * size))
    largest = size + error  # no eigenvalue is larger than the norm
    if largest == 0.0:
        return 0.0
    # The bound falls with ρ: on a grid of eighths of octaves, the smallest ρ that still passes.
    radii = largest * 2.0 ** (-np.arange(512) / 8)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        terms = np.array(norms)[None, :] / radii[:, None] ** np.arange(RESOLVENT_POWERS + 1)
        sums = np.cumsum(terms, axis=1)[:, :-1] / radii[:, None]
        passing = (terms[:, 1:] < 1) & (sums * error < 1 - terms[:, 1:])
    return float(min(largest, radii[passing.any(axis=1)].min(initial=largest)))


def _sorted_schur(matrix: Floats, limit: float) -> tuple[Complexes, Complexes, int]:
    """Return the complex Schur form with the eigenvalues below a limit last, its basis, and how many are not.

    The sort fails when rounding carries an eigenvalue across the limit; then there is no split.
    """
    try:
        triangle, unitary, large = schur(matrix, output="complex", sort=lambda z: abs(z) >= limit)
    except np.linalg.LinAlgError:
        triangle, unitary = schur(matrix, output="complex")
        large = len(matrix)
    return triangle, unitary, int(large)


def _triangular_vectors(triangle: Complexes) -> Complexes:
    """Return the eigenvectors of a triangular matrix as columns, in the order of its diagonal.

    A repeated diagonal entry is moved by a rounding, so that a defective matrix gives vectors that are nearly
    parallel instead of a division by zero; what that costs shows in the residual.
    """
    n = len(triangle)
    tiny = max(UNIT * float(np.linalg.norm(triangle)), np.finfo(np.float64).tiny)
    vectors = np.eye(n, dtype=np.complex128)
    for k in range(n):
        for i in range(k - 1, -1, -1):
            gap = triangle[k, k] - triangle[i, i]
            if abs(gap) < tiny:
                gap = complex(tiny)
            vectors[i, k] = triangle[i, i + 1 : k + 1] @ vectors[i + 1 : k + 1, k] / gap
        vectors[:, k] /= np.linalg.norm(vectors[:, k])
    return vectors


def _clusters(found: _Enclosure) -> tuple[float, float, Floats]:
    """Return bounds on the spectral radius and, for each estimate, how far its eigenvalue can be.

    k discs that hang together hold k eigenvalues, nobody knows which in which: each estimate is then off by
    at most the distance to the far side of any of them.
    """
    centres, radii = found.centres, found.radii
    n = len(centres)
    touching = np.abs(centres[:, None] - centres[None, :]) <= radii[:, None] + radii[None, :]
    cluster = np.arange(n)
    for _ in range(n):
        spread = np.array([cluster[touching[i]].min() for i in range(n)])
        if np.array_equal(spread, cluster):
            break
        cluster = spread
    reach = np.abs(found.values[:, None] - centres[None, :]) + radii[None, :]
    errors = np.where(cluster[:, None] == cluster[None, :], reach, 0.0).max(axis=1)
    inner = np.abs(centres) - radii
    low = max(0.0, *(float(inner[cluster == one].min()) for one in np.unique(cluster)))
    return low, float((np.abs(centres) + radii).max()), errors


def _plain_vectors(matrix: Floats, found: _Enclosure, values: Complexes) -> tuple[Complexes, Complexes]:
    """Return right vectors (columns) and left vectors (rows) in the order of the values.

    The large ones are columns of X and rows of its inverse. Of a small or defective one the vectors are
    singular vectors of M − λ: some vector that is right to rounding, where no full set exists; in a large
    matrix vectors of the Schur form, which are as good as the eigenvalue is apart from others.
    """
    n = len(matrix)
    right, left = found.right.copy(), found.inverse.copy()
    if n > MOST_SINGULAR:
        # Their part of the Schur form, still triangular; a vector's own size serves for its left one.
        block = np.triu(found.inverse[found.large :] @ matrix @ found.right[:, found.large :])
        right[:, found.large :] = found.right[:, found.large :] @ _triangular_vectors(block)
        left[found.large :] = right[:, found.large :].conj().T
        return right, left
    for i in range(found.large, n):
        rows, _, columns = np.linalg.svd(matrix - values[i] * np.eye(n))
        right[:, i], left[i] = columns[-1].conj(), rows[:, -1].conj()
    return right, left
