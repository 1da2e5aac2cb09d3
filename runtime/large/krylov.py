"""The largest eigenvalues of a sparse frame map, and a count of those that are larger.

Takes: crowds of different peers on any graphs, and the exchange between them.
Gives: `solve_sparse`.
Guarantees: rigid motions are taken out by their exact directions before any eigenvalue is computed. Errors
are estimates to first order, from residuals and the errors of the matrix, and so is the radius they bound;
that nothing lies beyond it is counted by the argument principle on samples of the determinant. The notes say
so.
Does not: list more than the largest modes.

Arnoldi's method (ARPACK) finds the eigenvalues nearest to a few shifts, where copies of some peers, all
alike, would have their largest ones. A count then tells whether larger ones were missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.spectrum import Mode, Spectrum, judge, oscillation
from apc.frame.course import turns
from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange
from apc.large.crowds import Crowd, hear_roughly, site_one, some_rows
from apc.large.relative import (
    RelativeMatrix,
    RigidSpace,
    nothing_rigid,
    relative_matrix,
    rigid_space,
)
from apc.large.sampled_count import argument_of, count_beyond
from apc.large.sparse_system import SparseSystem, sparse_system
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

# Steps of inverse iteration for a left vector, from a shift this far aside of the eigenvalue.
STEPS, NEAR = 3, 1e-11

# The circle of the count is so many errors outside of the largest eigenvalue, and at least this far.
OUTSIDE, FARTHEST = 20.0, 1e-9

# An eigenvalue this near to 1 may belong to a drift, which rounding splits by the root of its errors.
DRIFTING = 1e-6


@dataclass(frozen=True, slots=True)
class _Pair:
    """An eigenvalue with its right and left vector and an estimate of its error."""

    value: complex
    right: Complexes
    left: Complexes
    error: float


def solve_sparse(listed: Sequence[Crowd], exchange: Exchange) -> Spectrum:
    """Compute the largest eigenvalues of different peers on any graphs.

    Parameters
    ----------
    listed
        All peers, one crowd a group of the scene.
    exchange
        The links.
    """
    system = sparse_system(listed, exchange)
    motions = free_motions(listed, exchange)
    rigid = rigid_space(system, exchange, motions) if motions else None
    told = rigid is not None
    rigid = rigid or nothing_rigid(system)
    whole = relative_matrix(system, rigid)
    argument, alone = argument_of(system, listed), _alone(listed)
    pairs: list[_Pair] = []
    shifts = _shifts(system, listed)
    for nearest in NEAREST:
        pairs = _largest(whole, shifts, pairs, nearest)
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


def _shifts(system: SparseSystem, listed: Sequence[Crowd]) -> list[complex]:
    """Return where the largest eigenvalues may be: those of populations of copies of one peer."""
    found = []
    heard = np.asarray(sum(abs(one) for one in system.hearing).sum(axis=1)).ravel()
    lines = np.array([len(crowd.schedule.heard) for crowd in listed])[system.crowd_of]
    starts = np.concatenate([[0], np.cumsum(lines)[:-1]])
    for g, crowd in enumerate(listed):
        few = np.unique(np.linspace(0, len(crowd.parameters) - 1, SAMPLES).astype(np.int64))
        some = some_rows(crowd.lifted, few)
        peers = np.flatnonzero(system.crowd_of == g)
        most = heard[starts[peers][:, None] + np.arange(len(crowd.schedule.heard))].max(axis=0)
        for share in SHARES:
            own = np.tile(share * most, (len(few), 1))
            found.append(np.linalg.eigvals(hear_roughly(some, crowd.schedule, own, 0 * own)[0]).ravel())
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
    whole: RelativeMatrix, shifts: Sequence[complex], found: Sequence[_Pair], nearest: int
) -> list[_Pair]:
    """Return the largest eigenvalues near some shifts, or found before, each once, conjugates left out."""
    linalg = load_pool("scipy.sparse.linalg")
    n = whole.matrix.shape[0]
    start = np.ones(n) + np.linspace(0.0, 1.0, n)
    values = [np.array([pair.value for pair in found], np.complex128)]
    vectors = [np.stack([pair.right for pair in found], axis=1) if found else np.zeros((n, 0), np.complex128)]
    for shift in shifts:
        factors = whole.factor(shift)
        inverse = linalg.LinearOperator(
            (n, n), lambda right, factors=factors: _solved(factors, right), dtype=np.complex128
        )
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
        known = [pair.value for pair in pairs]
        if any(min(abs(one - other), abs(one.conjugate() - other)) <= 10 * FOUND for other in known):
            continue
        pairs.append(_paired(whole, one, vector[:, place]))
        if len(pairs) == LISTED:
            break
    return sorted(pairs, key=lambda pair: -abs(pair.value))


def _solved(factors: Any, right: Complexes, trans: str = "N") -> Complexes:
    """Solve with R − shift or its transpose by the factors of what is bordered."""
    whole = np.zeros(factors.shape[0], np.complex128)
    whole[: len(right)] = right
    return np.asarray(factors.solve(whole, trans=trans)[: len(right)])


def _paired(whole: RelativeMatrix, value: complex, right: Complexes) -> _Pair:
    """Refine an eigenvalue with its left vector: Rayleigh's quotient is right to the vectors' square."""
    factors = whole.factor(value + NEAR * max(abs(value), LEAST))
    left = right.conj()
    for _ in range(STEPS):
        left = _solved(factors, left, "T")
        left /= np.linalg.norm(left)
        right = _solved(factors, right)
        right /= np.linalg.norm(right)
    scale = abs(left @ right)
    moved = whole.matrix @ right
    value = complex((left @ moved) / (left @ right))
    residual = np.abs(left) @ np.abs(moved - value * right)
    off = np.abs(left) @ (whole.error @ np.abs(right)) + residual
    if abs(value.imag) <= off / scale:
        value = complex(value.real)
    return _Pair(value, right, left, float(off / scale) + 8 * UNIT * abs(value))


def _alone(listed: Sequence[Crowd]) -> tuple[Complexes, Floats]:
    """Return the eigenvalues of all peers when they hear nothing, and how often each is there."""
    values = [np.linalg.eigvals(crowd.lifted.p).astype(np.complex128).ravel() for crowd in listed]
    counts = [np.repeat(crowd.counts, crowd.lifted.p.shape[-1]) for crowd in listed]
    return np.concatenate(values), np.concatenate(counts)


def _mode(system: SparseSystem, listed: Sequence[Crowd], rigid: RigidSpace, pair: _Pair) -> Mode:
    """Describe an eigenvalue over the whole state; the shares of all peers of a crowd are added up.

    M [x_p; x_r] = λ [x_p; x_r] with x_r = y + W x_p, and M_pp + M_pr W = 1: (λ − 1) x_p = M_pr y.
    """
    n = int(system.starts[-1])
    vector, covector = np.zeros(n, np.complex128), np.zeros(n, np.complex128)
    vector[rigid.rest], covector[rigid.rest] = pair.right, pair.left
    if len(rigid.held) and pair.value != 1:
        moved = system.matrix.tocsr()[rigid.held][:, rigid.rest] @ pair.right / (pair.value - 1)
        vector[rigid.held] = moved
        vector[rigid.rest] += rigid.relative @ moved
        covector[rigid.held] = -(rigid.relative.T @ pair.left)
    own = np.abs(vector * covector)
    shares: dict[str, float] = {}
    for g, crowd in enumerate(listed):
        waiting = zip(crowd.schedule.sent_names, crowd.schedule.depths, strict=True)
        names = [*crowd.lifted.z_names, *(name for name, depth in waiting for _ in range(depth))]
        starts = system.starts[:-1][system.crowd_of == g]
        for place, name in enumerate(names):
            name = f"{crowd.name}.{name}" if len(listed) > 1 else name
            shares[name] = shares.get(name, 0.0) + float(own[starts + place].sum())
    total = sum(shares.values()) or 1.0
    peer = int(np.argmax(np.add.reduceat(own, system.starts[:-1])))
    frequency, damping = _frequency(system, listed, peer, vector, covector, pair.value)
    return Mode(
        eigenvalue=pair.value,
        magnitude=abs(pair.value),
        multiplicity=1,
        frequency_hz=frequency,
        damping_ratio=damping,
        shape="different peers",
        participation=tuple((name, share / total) for name, share in shares.items()),
        error=pair.error,
    )


def _frequency(
    system: SparseSystem,
    listed: Sequence[Crowd],
    peer: int,
    vector: Complexes,
    covector: Complexes,
    value: complex,
) -> tuple[float, float]:
    """Return frequency and damping, whole turns counted on the state of a peer that takes most part."""
    crowd, row = listed[system.crowd_of[peer]], int(system.row_of[peer])
    n_z, count = crowd.lifted.p.shape[-1], len(crowd.jacobians.kind.states)
    own = slice(int(system.starts[peer]), int(system.starts[peer]) + n_z)
    if not count:
        return 0.0, 1.0
    state = np.array([int(np.argmax(np.abs(vector[own] * covector[own])[:count]))])
    # What the peer hears is what its memory of it says: P z + Q r = ζ z.
    left = value * vector[own] - crowd.lifted.p[row] @ vector[own]
    heard = np.linalg.lstsq(crowd.lifted.q[row], left, rcond=None)[0]
    start, one = vector[own, None], np.array([value])
    angle = turns(site_one(crowd, row), crowd.schedule, start, heard[:, None], state, one)
    return oscillation(abs(value), float(angle[0]), crowd.lifted.frame_s)
