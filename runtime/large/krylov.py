"""The largest eigenvalues of a sparse frame map, and a count of those that are larger.

Takes: populations of different peers on any graphs, and the exchange between them.
Gives: `solve_sparse`; `argument_of`, `count_beyond`.
Guarantees: rigid motions are taken out by their exact directions before any eigenvalue is computed. Errors
are estimates to first order, from residuals and the errors of the matrix, and so is the radius they bound;
that nothing lies beyond it is counted by the argument principle on samples of the determinant, and where two
rules for the argument's change differ, more samples are taken, or nothing is said. The notes say so.
Does not: list more than the largest modes, or bound the determinant between samples (see `characteristic`,
for small ones).

Arnoldi's method (ARPACK) finds the eigenvalues nearest to a few shifts, where copies of some peers, all
alike, would have their largest ones. A count then tells whether larger ones were missed. It goes around

    g(ζ) = det(I − R/ζ) / Π_k (1 − p_k/ζ),

R the whole and p_k the eigenvalues of peers by themselves, hearing nothing, and those of R that are known: it
goes to 1 as ζ goes to infinity, and its argument moves far less than that of the determinant.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.spectrum import Mode, Spectrum, judge
from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange
from apc.large.populations import (
    Population,
    hear_roughly,
    mode_of,
    site_one,
    some_rows,
    state_names,
    turned_by,
)
from apc.large.sparse_system import (
    RigidSpace,
    SparseSystem,
    nothing_rigid,
    rigid_space,
    small_matrix,
    sparse_system,
    without_rigid,
)
from apc.large.translation import free_motions, may_drift
from apc.threads import load_pool

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Peers whose copies tell where to look, no more than so many, and by which share of what they hear these
# move: from all alike to each opposite to its neighbours.
SAMPLES, SHARES = 2000, (1.0, 0.5, 0.0, -0.5, -1.0)

# Shifts tried, how far apart, and a little off, as a shift must not be an eigenvalue; the least of them.
SHIFTS, APART, ASIDE, LEAST = 6, 0.02, 1.0 + 3e-5, 1e-6

# Eigenvalues sought near each shift; if a count says that some were missed, more, and a little farther out.
NEAREST, FURTHER = (6, 24, 60), 1.002

# What Arnoldi's method is asked for, relatively, before each value is refined by itself, and its restarts.
FOUND, RESTARTS = 1e-9, 60

# Modes listed.
LISTED = 4

# Steps of inverse iteration for both vectors, from a shift this far aside of the eigenvalue; from where they
# lead again while that is elsewhere, so many times.
STEPS, NEAR, ROUNDS = 3, 1e-11, 4

# The circle of the count is so many errors outside of the largest eigenvalue, and at least this far.
OUTSIDE, FARTHEST = 20.0, 1e-9

# An eigenvalue this near to 1 may belong to a drift, which rounding splits by the root of its errors.
DRIFTING = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """An eigenvalue with its right and left vector and an estimate of its error."""

    value: complex
    right: Complexes
    left: Complexes
    error: float


def solve_sparse(listed: Sequence[Population], exchange: Exchange) -> Spectrum:
    """Compute the largest eigenvalues of different peers on any graphs.

    Parameters
    ----------
    listed
        All peers, one population a group of the scene.
    exchange
        The links.
    """
    system = sparse_system(listed, exchange)
    motions = free_motions(listed, exchange)
    rigid = rigid_space(system, exchange, motions) if motions else None
    told = rigid is not None
    rigid = rigid or nothing_rigid(system)
    reduced, error = without_rigid(system, rigid)
    argument, alone = argument_of(system, listed), _alone(listed)
    pairs: list[_Pair] = []
    shifts = _shifts(system, listed)
    for nearest in NEAREST:
        pairs = _largest(reduced, error, shifts, pairs, nearest)
        radius, off = abs(pairs[0].value), pairs[0].error
        beyond = radius + max(OUTSIDE * off, FARTHEST)
        if beyond >= 1 > radius + off:
            beyond = (1 + radius) / 2
        # The rigid motions left in: that is what is counted.
        known = np.array([pair.value for pair in pairs] + [1.0] * len(rigid.held))
        count = count_beyond(argument, alone, known, beyond)
        count -= len(rigid.held) if beyond < 1 and count >= 0 else 0
        if count <= 0:
            break
        shifts = [pair.value * FURTHER for pair in pairs[:2]] + shifts[:2]
    inside = False if radius - off > 1 else True if count == 0 and beyond < 1 else None
    radius_error = max(beyond - radius, off) if count == 0 else max(1.0, radius)
    notes = ["the largest modes only, by Arnoldi's method; their errors are estimates, not bounds"]
    notes.append(
        "that no eigenvalue is larger was counted by the argument principle on samples"
        if not count
        else "how many eigenvalues are larger could not be counted: the verdict is left open"
        if count < 0
        else f"{count} larger eigenvalues were counted but not found"
    )
    at_one = min(abs(pair.value - 1) for pair in pairs) < DRIFTING
    if inside is None and (not told or (at_one and may_drift(listed, exchange))):
        radius_error = max(radius_error, radius)
        notes.append("a motion that stands still or drifts is among these: the radius without it may be less")
    verdict, stable = judge([inside], len(rigid.held), 0)
    modes = tuple(_mode(system, listed, rigid, pair) for pair in pairs)
    return Spectrum(modes, radius, radius_error, len(rigid.held), 0, verdict, stable, "", tuple(notes))


def _shifts(system: SparseSystem, listed: Sequence[Population]) -> list[complex]:
    """Return where the largest eigenvalues may be: those of populations of copies of one peer."""
    found = []
    heard = np.asarray(sum(abs(one) for one in system.hearing).sum(axis=1)).ravel()
    lines = np.array([len(population.schedule.heard) for population in listed])[system.population_of]
    starts = np.concatenate([[0], np.cumsum(lines)[:-1]])
    for g, population in enumerate(listed):
        few = np.unique(np.linspace(0, len(population.parameters) - 1, SAMPLES).astype(np.int64))
        some = some_rows(population.lifted, few)
        peers = np.flatnonzero(system.population_of == g)
        most = heard[starts[peers][:, None] + np.arange(len(population.schedule.heard))].max(axis=0)
        for share in SHARES:
            own = np.tile(share * most, (len(few), 1))
            found.append(np.linalg.eigvals(hear_roughly(some, population.schedule, own, 0 * own).p).ravel())
    values = np.concatenate(found).astype(np.complex128)
    values = values[(values.imag >= 0)]
    values = values[np.argsort(-np.abs(values), kind="stable")]
    kept: list[complex] = []
    for value in values.tolist():
        if all(abs(value - one) > APART for one in kept):
            kept.append(value)
        if len(kept) == SHIFTS:
            break
    return [value * ASIDE if abs(value) > LEAST else LEAST for value in kept]


def _largest(
    matrix: Any, error: Any, shifts: Sequence[complex], found: Sequence[_Pair], nearest: int
) -> list[_Pair]:
    """Return the largest eigenvalues near some shifts, or found before, each once, conjugates left out."""
    linalg = load_pool("scipy.sparse.linalg")
    n = matrix.shape[0]
    start = np.ones(n) + np.linspace(0.0, 1.0, n)
    values = [np.array([pair.value for pair in found], np.complex128)]
    vectors = [np.stack([pair.right for pair in found], axis=1) if found else np.zeros((n, 0), np.complex128)]
    for shift in shifts:
        factors = _factor(matrix, shift)
        inverse = linalg.LinearOperator((n, n), factors.solve, dtype=np.complex128)
        sought = min(nearest, n - 2)
        try:
            near, right = linalg.eigs(
                inverse, k=sought, v0=start, ncv=min(n, 4 * sought), tol=FOUND, maxiter=RESTARTS
            )
        except linalg.ArpackNoConvergence as partial:
            near, right = partial.eigenvalues, partial.eigenvectors
        values.append(shift + 1 / near)
        vectors.append(right)
    value, vector = np.concatenate(values), np.concatenate(vectors, axis=1)
    pairs: list[_Pair] = []
    for place in np.argsort(-np.abs(value), kind="stable"):
        one = complex(value[place])
        if _is_known(one, pairs):
            continue
        pair = _paired(matrix, error, one, vector[:, place])
        if not _is_known(pair.value, pairs):  # what Arnoldi's method left apart may be one
            pairs.append(pair)
        if len(pairs) == LISTED:
            break
    return sorted(pairs, key=lambda pair: -abs(pair.value))


def _is_known(value: complex, pairs: Sequence[_Pair]) -> bool:
    """Say whether an eigenvalue or its conjugate is among those listed."""
    return any(
        min(abs(value - pair.value), abs(value.conjugate() - pair.value)) <= 10 * FOUND for pair in pairs
    )


def _factor(matrix: Any, shift: complex) -> Any:
    """Return LU factors of a sparse matrix less a shift."""
    import scipy.sparse

    shifted = matrix - shift * scipy.sparse.identity(matrix.shape[0])
    return load_pool("scipy.sparse.linalg").splu(shifted.tocsc().astype(np.complex128))


def _paired(matrix: Any, error: Any, value: complex, right: Complexes) -> _Pair:
    """Refine an eigenvalue with its left vector: Rayleigh's quotient is right to the vectors' square."""
    left = right.conj()
    for _ in range(ROUNDS):
        factors, before = _factor(matrix, value + NEAR * max(abs(value), LEAST)), value
        for _ in range(STEPS):
            left = factors.solve(left, "T")
            left /= np.linalg.norm(left)
            right = factors.solve(right)
            right /= np.linalg.norm(right)
        moved = matrix @ right
        value = complex((left @ moved) / (left @ right))
        if abs(value - before) <= FOUND * abs(value):
            break
    scale = abs(left @ right)
    residual = np.abs(left) @ np.abs(moved - value * right)
    off = np.abs(left) @ (error @ np.abs(right)) + residual
    if abs(value.imag) <= off / scale:
        value = complex(value.real)
    return _Pair(value, right, left, float(off / scale) + 8 * UNIT * abs(value))


def _alone(listed: Sequence[Population]) -> tuple[Complexes, Floats]:
    """Return the eigenvalues of all peers when they hear nothing, and how often each is there."""
    values = [np.linalg.eigvals(population.lifted.p).astype(np.complex128).ravel() for population in listed]
    counts = [np.repeat(population.counts, population.lifted.p.shape[-1]) for population in listed]
    return np.concatenate(values), np.concatenate(counts)


def _mode(system: SparseSystem, listed: Sequence[Population], rigid: RigidSpace, pair: _Pair) -> Mode:
    """Describe an eigenvalue over the whole state; the shares of all peers of a population are added up.

    With y of the map without rigid motions, M x = λ x of x = y + V c, V_p c = M_p y/(λ − 1); its left
    vectors are those of M.
    """
    vector, covector = pair.right, pair.left
    if len(rigid.held) and pair.value != 1:
        vector = vector + rigid.motions @ (system.matrix[rigid.held] @ vector / (pair.value - 1))
    own = np.abs(vector * covector)
    shares: dict[str, float] = {}
    for g, population in enumerate(listed):
        starts = system.starts[:-1][system.population_of == g]
        for place, name in enumerate(state_names(population)):
            name = f"{population.name}.{name}" if len(listed) > 1 else name
            shares[name] = shares.get(name, 0.0) + float(own[starts + place].sum())
    peer = int(np.argmax(np.add.reduceat(own, system.starts[:-1])))
    population, row = listed[system.population_of[peer]], int(system.row_of[peer])
    z, w = (
        part[system.starts[peer] : system.starts[peer] + population.lifted.p.shape[-1]]
        for part in (vector, covector)
    )
    # What the peer hears is what its memory of it says: P z + Q r = ζ z.
    heard = np.linalg.lstsq(
        population.lifted.q[row], pair.value * z - population.lifted.p[row] @ z, rcond=None
    )[0]
    turned = turned_by(site_one(population, row), population.schedule, pair.value, z, heard, w)
    return mode_of(pair.value, pair.error, turned, shares, "different peers", 1)


# The argument of a function of ζ.
Argument = Callable[[complex], float]

# Arcs of the half circle to begin with; eigenvalues this near to the circle, relatively, are not divided by,
# but looked at, so many of them.
ARCS, NEAR_CIRCLE, LOOKED_AT = 16, 0.02, 9

# A peer's own eigenvalue this near to a known one, relatively, takes its place.
SAME = 1e-9

# The argument's rate of change is measured over this angle; an arc is settled when two rules for its integral
# differ by less than that (radians); no arc is narrower, and after so many factorizations it is given up.
ANGLE, SETTLED, NARROWEST, MOST_FACTORS = 1e-8, 0.5, 1e-12, 1200


def count_beyond(argument: Argument, alone: tuple[Complexes, Floats], known: Complexes, radius: float) -> int:
    """Return how many eigenvalues are larger than a radius, −1 if it can't be told.

    Parameters
    ----------
    argument
        That of det(I − R/ζ), see `argument_of`.
    alone
        The eigenvalues of the peers by themselves and how often each is there.
    known
        Eigenvalues of R, conjugates left out.
    radius
        The circle's.

    Notes
    -----
    g is taken with what is far from the circle only, and with the eigenvalues that are known: what is near to
    the circle turns it in an angle too small to be seen between samples. Its argument is followed around the
    upper half; the change along an arc is known up to whole turns from its ends, and its rate tells the
    turns: Simpson's rule, as far as the trapezoidal rule on half the arc agrees.
    """
    values, counts = alone
    pairs = np.concatenate([known, known[known.imag != 0].conj()])
    near = np.abs(np.abs(values) - radius) <= NEAR_CIRCLE * radius
    # Of many equal peers that all hear one other, most move by themselves: these eigenvalues are divided by.
    for value in np.unique(pairs[np.abs(np.abs(pairs) - radius) <= NEAR_CIRCLE * radius]).tolist():
        alike = np.abs(values - value) <= SAME * radius
        if alike.any():
            near &= ~alike
            pairs = pairs[pairs != value]
    divided = np.concatenate([values[~near], pairs]), np.concatenate([counts[~near], np.ones(len(pairs))])
    samples: dict[float, tuple[float, float]] = {}

    def sample(angle: float) -> tuple[float, float]:
        if angle not in samples:
            points = [radius * np.exp(1j * one) for one in (angle, angle + ANGLE)]
            here, there = (
                _wrapped(argument(point) - float(divided[1] @ np.angle(1 - divided[0] / point)))
                for point in points
            )
            samples[angle] = here, _wrapped(there - here) / ANGLE
        return samples[angle]

    # The eigenvalues that were missed are most likely near those of peers by themselves.
    there = np.angle(values[near & (values.imag >= 0)])
    likely = np.quantile(there, np.linspace(0, 1, LOOKED_AT)) if len(there) else there
    edges = np.unique(
        np.concatenate([np.linspace(0.0, np.pi, ARCS + 1), likely, np.angle(known[known.imag > 0])])
    )
    pending = list(itertools.pairwise(edges.tolist()))
    turned = 0.0
    while pending:
        if 2 * len(samples) > MOST_FACTORS:
            return -1
        a, b = pending.pop()
        middle = (a + b) / 2
        (at_a, rate_a), (_, rate_m), (at_b, rate_b) = sample(a), sample(middle), sample(b)
        simpson = (b - a) / 6 * (rate_a + 4 * rate_m + rate_b)
        halves = (b - a) / 4 * (rate_a + 2 * rate_m + rate_b)
        exact = simpson + _wrapped(at_b - at_a - simpson)
        if abs(simpson - halves) < SETTLED and abs(exact - simpson) < SETTLED:
            turned += exact
        elif b - a < NARROWEST:
            return -1
        else:
            pending += [(a, middle), (middle, b)]
    outside = float(divided[1][np.abs(divided[0]) > radius].sum())
    turns = 2 * turned / (2 * np.pi)  # the lower half mirrors the upper
    return round(outside - turns) if abs(turns - round(turns)) < 0.1 else -1


def argument_of(system: SparseSystem, listed: Sequence[Population]) -> Argument:
    """Return the argument of det(I − R/ζ), from a small matrix: see `sparse_system.small_matrix`."""
    linalg = load_pool("scipy.sparse.linalg")
    small = small_matrix(system, listed)

    def argument(point: complex) -> float:
        factors = linalg.splu(small(point))
        total = float(np.angle(factors.U.diagonal()).sum())
        total += np.pi * (_odd(factors.perm_r) ^ _odd(factors.perm_c))
        for population in listed:
            p = population.lifted.p
            sign, _ = np.linalg.slogdet(np.eye(p.shape[-1]) - p / point)
            total += float(population.counts @ np.angle(sign))
        return _wrapped(total)

    return argument


def _odd(permutation: NDArray[np.int32]) -> bool:
    """Say whether a permutation is odd: n less its cycles."""
    import scipy.sparse

    n = len(permutation)
    graph = scipy.sparse.csr_matrix((np.ones(n), (np.arange(n), permutation)), shape=(n, n))
    cycles = scipy.sparse.csgraph.connected_components(graph, directed=False)[0]
    return bool((n - cycles) % 2)


def _wrapped(angle: float) -> float:
    """Return an angle in (−π, π]."""
    return float(np.pi - (np.pi - angle) % (2 * np.pi))
