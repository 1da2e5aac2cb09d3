"""Eigenvalues with error bounds, and the verdict.

Takes: the `ClosedLoop`s of a complete system.
Gives: `Mode`, `ModeMotion`, `Spectrum`, `solve_spectrum`, `mode_near`; `complete_vectors`, `angles_in_frame`,
`oscillation`, `finite`; `combine_verdicts`, `up_to`.
Guarantees: rigid modes are removed before any eigenvalue is computed; every reported error bounds all
rounding since the subsystem's coefficients. Cases undecided in floats are proved in balls where possible (see
`certification`), or reported as undecided.
Does not: close the loop (see `interconnection`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.lifting.phase_unwrapping import phase_advance
from apc.linearization.linear_subsystem import every_matrix
from apc.spectrum.ball_arithmetic import unprovable
from apc.spectrum.certification import MOST_PROVED, prove
from apc.spectrum.eigenpairs import Eigenpairs, components, pairs_of_eigenvalues
from apc.spectrum.enclosure import SMALL, WIDE, Enclosure, descending, discs, enclose_eigenvalues
from apc.spectrum.interconnection import ClosedLoop
from apc.spectrum.relative_coordinates import Relative, relative_bounded, relative_coordinates
from apc.spectrum.rigid_modes import RigidModes, find_rigid_modes, rigid_modes_of
from apc.support.lazy import LazyTuple
from apc.support.threads import single_threaded
from apc.timing.schedule import Propagate
from apc.verdict import (
    NO_PROOF,
    Limitation,
    LimitationCode,
    Note,
    ProofMethod,
    ProofOutcome,
    StabilityProof,
    StabilityVerdict,
)

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]

# The number of modes whose motion is computed first, twice the rows of a table; the others are computed in
# one call.
EVALUATED_AT = 64

# A mode that shrinks to less than this in a frame is a deadbeat mode, computed in floats.
DEADBEAT = 1e-12

# A proof replaces all results in floats if its bound of the radius is at most this multiple of theirs.
AS_SHARP = 4.0

# An angle that no nonreal eigenvalue stored as two floats has: their unit roundoff.
STRAIGHT = 2.0**-53

# A mode in which no continuous state has a larger share has no motion: its entries are rounding noise.
LEAST_SHARE = 1e-9


@dataclass(frozen=True, slots=True)
class ModeMotion:
    """The motion of a mode inside a frame, and the participation of the states.

    `frequency_hz` and `damping_ratio` belong to s = log(eigenvalue)/frame on the branch of the motion inside
    the frame; both are NaN where it is undetermined. `participation` are the shares of the states, which add
    up to 1; `in_transit` is the sum of the shares of packets in transit.
    """

    frequency_hz: float
    damping_ratio: float
    participation: tuple[tuple[str, float], ...]
    in_transit: float = field(default=0.0, repr=False)


@dataclass(frozen=True, slots=True)
class Mode:
    """One eigenvalue of the complete system's frame map, with its `multiplicity`.

    `magnitude` is per frame; `error` bounds |eigenvalue − truth|. `family` is the system of the mode.
    `motion` is one `ModeMotion`: for a large system it is expensive, and computed on access.
    """

    eigenvalue: complex
    magnitude: float
    multiplicity: int
    family: str
    error: float
    motion: Sequence[ModeMotion]

    @property
    def frequency_hz(self) -> float:
        """The frequency in Hz, NaN if undetermined (see `ModeMotion`)."""
        return self.motion[0].frequency_hz

    @property
    def damping_ratio(self) -> float:
        """The damping ratio, NaN if undetermined (see `ModeMotion`)."""
        return self.motion[0].damping_ratio

    @property
    def participation(self) -> tuple[tuple[str, float], ...]:
        """The share of each state in the mode (see `ModeMotion`)."""
        return self.motion[0].participation

    @property
    def in_transit(self) -> float:
        """See `ModeMotion`."""
        return self.motion[0].in_transit


@dataclass(frozen=True, slots=True)
class Spectrum:
    """All modes but the rigid ones, the largest first, with the verdict.

    `spectral_radius` is per frame; `verdict` counts every rigid mode as a translation.
    `spectral_radius_error` bounds the deviation on both sides. The verdict needs the upper bound only: a
    model can be proved stable although radius plus error exceeds 1. `drifts` is the number of motions that
    grow linearly. `proof` is the result of ball arithmetic, `NO_PROOF` where floats decided; `notes` state
    the unproved parts. `radius_excess` bounds the excess of the radius over 1 from below and above, if it was
    proved; the excess can be smaller than the rounding of floats near 1.
    """

    modes: Sequence[Mode]
    spectral_radius: float
    spectral_radius_error: float
    rigid_modes: int
    drifts: int
    verdict: StabilityVerdict
    proof: StabilityProof
    notes: tuple[Note, ...]
    radius_excess: tuple[float, float] | None = None

    @property
    def stable(self) -> bool | None:
        """Whether the verdict is stable, None if it is undecided."""
        return self.verdict.stable


def solve_spectrum(
    systems: Sequence[ClosedLoop],
    *,
    certify: bool = False,
    in_balls: bool = True,
    exact_work: float = math.inf,
) -> Spectrum:
    """Return the spectrum of a complete system given as independent closed systems.

    Parameters
    ----------
    systems
        The closed systems, with their multiplicities.
    certify
        Whether to prove the verdict of every closed system in ball arithmetic; by default only the verdicts
        that are undecided in floats.
    in_balls
        Whether undecided systems are solved in balls; else they stay undecided.
    exact_work
        The largest number of states times events of a frame for which a system that floats leave undecided
        is solved in balls, or its drifts are searched exactly.

    Notes
    -----
    With a drift, a second eigenvalue 1 remains if only the rigid direction is removed. If no error disc
    contains 1 there is no drift, and the exact search is skipped.
    """
    solved = [_solve_in_floats(closed_loop, rigid_modes_of(closed_loop)) for closed_loop in systems]
    lowest = max((solution.low for solution in solved), default=0.0)
    notes: list[Note] = []
    for index, closed_loop in enumerate(systems):
        solution = solved[index]
        drifting = bool(solution.rigid_modes.names) and not solution.clear_of_unity
        if not (certify or drifting or _is_undecided(solution, lowest)):
            continue
        reason, work = unprovable(closed_loop), _exact_work(closed_loop)
        if not in_balls:
            reason = "ball arithmetic was not requested"
        elif work > exact_work:
            reason = f"its frame has {work:,} states times events; the limit is {exact_work:,}"
        elif not reason and (states := _largest_component(closed_loop)) > MOST_PROVED:
            reason = f"it has {states} states; the limit of proofs is {MOST_PROVED}"
        if not reason:
            solved[index] = _solve_in_balls(closed_loop, solution)
            continue
        if certify or _is_undecided(solution, lowest):
            notes.append(Limitation(LimitationCode.NOT_PROVED, (closed_loop.name, reason)))
        if work <= exact_work and drifting and (rigid_modes := find_rigid_modes(closed_loop)).drifts:
            solved[index] = _solve_in_floats(closed_loop, rigid_modes)
    low = max((solution.low for solution in solved), default=0.0)
    high = max((solution.high for solution in solved), default=0.0)
    largest = max((float(np.abs(solution.pairs.values).max(initial=0.0)) for solution in solved), default=0.0)
    radius = min(max(largest, low), high)  # a proof can be more accurate than the vectors of floats
    rigid = drifts = 0
    for closed_loop, solution in zip(systems, solved, strict=True):
        rigid += closed_loop.multiplicity * len(solution.rigid_modes.names)
        drifts += closed_loop.multiplicity * solution.rigid_modes.drifts
    verdict = combine_verdicts([solution.inside for solution in solved], rigid, drifts)
    return Spectrum(
        modes=LazyTuple(functools.partial(_sorted_modes, tuple(systems), tuple(solved))),
        spectral_radius=radius,
        spectral_radius_error=max(high - radius, radius - low, 0.0),
        rigid_modes=rigid,
        drifts=drifts,
        verdict=verdict,
        proof=_proof(solved, drifts),
        notes=tuple(notes),
        radius_excess=_radius_excess(solved),
    )


def _radius_excess(solved: Sequence[_SolvedLoop]) -> tuple[float, float] | None:
    """Return bounds on the excess of the spectral radius over 1; None if nothing was proved in balls."""
    if not any(item.bits for item in solved):
        return None
    least, most = map(max, zip(*(item.radius_excess for item in solved), strict=True))
    return least, most


def mode_near(systems: Sequence[ClosedLoop], eigenvalue: complex) -> Mode:
    """Return the mode of closed systems whose eigenvalue, or its conjugate, is nearest to a value."""
    modes = solve_spectrum(systems, in_balls=False).modes
    value = complex(eigenvalue.real, abs(eigenvalue.imag))
    return min(modes, key=lambda mode: abs(complex(mode.eigenvalue.real, abs(mode.eigenvalue.imag)) - value))


@dataclass(frozen=True, slots=True, eq=False)
class _SolvedLoop:
    """One closed system: its eigenvalues, each with its error, and bounds on its spectral radius.

    `inside` states whether all its eigenvalues but the rigid ones are inside the unit circle; `bits` is the
    precision of the proof, 0 for floats; `radius_excess` bounds the excess of the radius over 1.
    """

    rigid_modes: RigidModes
    coordinates: Relative
    matrix: Floats  # of the relative coordinates
    pairs: Eigenpairs  # of each strongly connected part separately
    bounds: Enclosure
    low: float
    high: float
    inside: bool | None
    bits: int
    radius_excess: tuple[float, float]

    @property
    def complete(self) -> Eigenpairs:
        """The eigenpairs with vectors over all relative coordinates, not only over their component."""
        return (
            pairs_of_eigenvalues(self.matrix, self.pairs.values)
            if len(self.coordinates.eliminated)
            else self.pairs
        )

    @property
    def clear_of_unity(self) -> bool:
        """Whether 1 is proved not to be an eigenvalue."""
        return bool((np.abs(self.pairs.values - 1) > self.bounds.errors).all())


def _largest_component(closed_loop: ClosedLoop) -> int:
    """Return the number of states in the largest strongly connected component."""
    return max(
        (len(part) for part in components(~(np.abs(closed_loop.matrix) + closed_loop.error == 0))), default=0
    )


def _exact_work(closed_loop: ClosedLoop) -> int:
    """Return the number of states times the number of events of a frame."""
    return len(closed_loop.matrix) * sum(
        len(peer_class.schedule.events) for peer_class in closed_loop.peer_classes
    )


def _is_undecided(solved: _SolvedLoop, lowest: float) -> bool:
    """Return whether floats leave the verdict, or the radius of the complete system, undecided.

    `lowest` is a lower bound on the radius of the complete system.
    """
    if not solved.high > lowest:  # another system has the largest eigenvalue
        return False
    return (solved.inside is None and not lowest > 1) or not solved.high - solved.low <= WIDE * max(
        solved.low, 1.0
    )


def _proof(solved: Sequence[_SolvedLoop], drifts: int) -> StabilityProof:
    """Return the proof of stability or instability; `NO_PROOF` where floats decided all eigenvalues."""
    bits = max((loop.bits for loop in solved), default=0)
    if not bits:
        return NO_PROOF
    unstable = [loop.bits for loop in solved if loop.inside is False]
    outcome = ProofOutcome.DRIFTS if drifts else ProofOutcome.STABLE
    if any(unstable):
        outcome, bits = ProofOutcome.UNSTABLE, max(unstable)
    elif any(loop.inside is None for loop in solved):
        outcome = ProofOutcome.UNDECIDED
    elif unstable or not all(loop.bits for loop in solved if len(loop.pairs.values)):
        outcome = ProofOutcome.PARTLY
    return StabilityProof(ProofMethod.BALLS, bits, outcome)


def combine_verdicts(inside: Sequence[bool | None], rigid: int, drifts: int) -> StabilityVerdict:
    """Return the verdict from the eigenvalue locations of each system; rigid modes count as translations."""
    if False in inside:
        return StabilityVerdict.UNSTABLE
    if None in inside:
        return StabilityVerdict.UNDECIDED
    return StabilityVerdict.DRIFTS if drifts else up_to(rigid)


def up_to(translations: int, rotations: int = 0) -> StabilityVerdict:
    """Return the verdict of a system that is stable except for the given numbers of rigid modes."""
    if translations:
        return StabilityVerdict.STABLE_MOVING if rotations else StabilityVerdict.STABLE_TRANSLATING
    return StabilityVerdict.STABLE_TURNING if rotations else StabilityVerdict.STABLE


def _solve_in_floats(closed_loop: ClosedLoop, rigid_modes: RigidModes) -> _SolvedLoop:
    """Return the eigenvalues of one system, solved in floats with rigid modes removed."""
    coordinates = relative_coordinates(rigid_modes.basis)
    matrix, error = relative_bounded(closed_loop.matrix, closed_loop.error, coordinates)
    pairs, bounds = enclose_eigenvalues(matrix, error)
    inside = False if bounds.low > 1 else True if bounds.high < 1 else None  # NaN decides nothing
    low, high = bounds.low, bounds.high
    return _SolvedLoop(
        rigid_modes, coordinates, matrix, pairs, bounds, low, high, inside, 0, (low - 1, high - 1)
    )


def _solve_in_balls(closed_loop: ClosedLoop, estimate: _SolvedLoop) -> _SolvedLoop:
    """Return `estimate` with the bounds and the verdict that ball arithmetic proves.

    The eigenpairs of the proof replace those of floats unless its discs are wider by `AS_SHARP`.
    """
    proof = prove(closed_loop, estimate.rigid_modes)
    if proof.rigid_modes.drifts != estimate.rigid_modes.drifts:
        estimate = _solve_in_floats(closed_loop, proof.rigid_modes)
    inside, bits = proof.inside, proof.bits
    if inside is None and not estimate.rigid_modes.names:
        # If weights are known in floats only, balls can be wider than floats, whose bound includes them, too.
        inside, bits = estimate.inside, 0 if estimate.inside is not None else bits
    enclosure = discs(proof.centres, proof.centres, proof.radii)
    low, high = max(estimate.low, float(enclosure.low)), min(estimate.high, float(enclosure.high))
    radius_excess = (
        max(estimate.radius_excess[0], proof.radius_excess[0]),
        min(estimate.radius_excess[1], proof.radius_excess[1]),
    )
    proved = replace(estimate, low=low, high=high, inside=inside, bits=bits, radius_excess=radius_excess)
    # The discs of the proof are wider than floats bound the radius: the eigenpairs of floats are kept.
    if enclosure.high - enclosure.low > AS_SHARP * (estimate.high - estimate.low):
        return proved
    order = descending(proof.centres)
    pairs = pairs_of_eigenvalues(estimate.matrix, proof.centres[order])
    return replace(
        proved, pairs=pairs, bounds=Enclosure(enclosure.low, enclosure.high, enclosure.errors[order])
    )


def _sorted_modes(systems: Sequence[ClosedLoop], solved: Sequence[_SolvedLoop]) -> tuple[Mode, ...]:
    """Return the eigenvalues of all systems, the largest first; their motion is computed on access."""
    ranked = sorted(
        (-abs(value), closed_loop.name, value.real, -value.imag, index, row)
        for index, (closed_loop, item) in enumerate(zip(systems, solved, strict=True))
        for row, value in enumerate(item.pairs.values.tolist())
    )
    modes = []
    for ranked_part in (ranked[:EVALUATED_AT], ranked[EVALUATED_AT:]):
        motions = LazyTuple(
            functools.partial(_mode_motions, systems, solved, [item[-2:] for item in ranked_part])
        )
        for number, (*_, index, row) in enumerate(ranked_part):
            value = complex(solved[index].pairs.values[row])
            modes.append(
                Mode(
                    eigenvalue=value,
                    magnitude=abs(value),
                    multiplicity=systems[index].multiplicity,
                    family=systems[index].name,
                    error=float(solved[index].bounds.errors[row]),
                    motion=LazyTuple(functools.partial(_motion_of, motions, number)),
                )
            )
    return tuple(modes)


def _motion_of(motions: Sequence[ModeMotion], index: int) -> tuple[ModeMotion]:
    """Return the motion at an index as a tuple, for `Mode.motion`."""
    return (motions[index],)


def _mode_motions(
    systems: Sequence[ClosedLoop], solved: Sequence[_SolvedLoop], indices: Sequence[tuple[int, int]]
) -> tuple[ModeMotion, ...]:
    """Return the motions of some eigenvalues, each given by the index of its system and its row in it."""
    result: dict[tuple[int, int], ModeMotion] = {}
    with single_threaded(), np.errstate(all="ignore"):
        for s, (closed_loop, item) in enumerate(zip(systems, solved, strict=True)):
            rows = [row for index_of_system, row in indices if index_of_system == s]
            if rows:
                motions = _motions_of_rows(closed_loop, item, np.array(rows, dtype=np.intp))
                result |= {(s, row): motion for row, motion in zip(rows, motions, strict=True)}
    return tuple(result[index] for index in indices)


def _motions_of_rows(closed_loop: ClosedLoop, solved: _SolvedLoop, rows: Integers) -> list[ModeMotion]:
    """Return the motions of some eigenvalues of a system, by their rows."""
    pairs = solved.complete.at(rows)
    vectors, shares = complete_vectors(closed_loop, solved.coordinates, pairs)
    sizes = np.abs(pairs.values)
    is_deadbeat = sizes <= np.maximum(
        DEADBEAT * len(closed_loop.names), np.minimum(solved.bounds.errors[rows], SMALL)
    )
    # A deadbeat mode has no frequency; a system without computed values has no deadbeat mode.
    angles = np.full(len(rows), 0.0 if _has_discrete_updates(closed_loop) else np.nan)
    angles[~is_deadbeat] = angles_in_frame(
        closed_loop, pairs.values[~is_deadbeat], vectors[:, ~is_deadbeat], shares[:, ~is_deadbeat]
    )
    motions = []
    for size, angle, deadbeat, shares_of_mode in zip(
        sizes.tolist(), angles.tolist(), is_deadbeat.tolist(), shares.T.tolist(), strict=True
    ):
        frequency, damping = 0.0, 1.0
        if not deadbeat or math.isnan(angle):
            frequency, damping = oscillation(size, angle, closed_loop.frame_s)
        in_transit = sum(shares_of_mode[index] for index in closed_loop.layout.indices.values())
        participation = tuple(zip(closed_loop.names, shares_of_mode, strict=True))
        motions.append(ModeMotion(frequency, damping, participation, in_transit))
    return motions


def _has_discrete_updates(closed_loop: ClosedLoop) -> bool:
    """Return whether any discrete update, besides the exact exponential, forms the frame's map."""
    return not closed_loop.peer_classes or any(
        not isinstance(event, Propagate)
        for peer_class in closed_loop.peer_classes
        for event in peer_class.schedule.events
    )


def complete_vectors(
    closed_loop: ClosedLoop,
    coordinates: Relative,
    pairs: Eigenpairs,
) -> tuple[Complexes, Floats]:
    """Return the eigenvectors (n, k) over the complete state, and the participation of each state (n, k).

    Parameters
    ----------
    closed_loop, coordinates
        The closed system and its relative coordinates.
    pairs
        Eigenvalues (k,) of the relative coordinates, with their vectors.
    """
    matrix = closed_loop.matrix
    eliminated, remaining, weights, count = (
        coordinates.eliminated,
        coordinates.rest,
        coordinates.weights,
        len(coordinates.eliminated),
    )
    vectors, covectors = np.zeros((2, len(closed_loop.names), len(pairs.values)), dtype=np.complex128)
    vectors[remaining], covectors[remaining] = pairs.right, pairs.left.T
    if count:
        # Vectors of the complete state: x_p follows from (λ − M_pp − M_pr W) x_p = M_pr y.
        coupling = matrix[eliminated[:, None], remaining]
        eliminated_block = matrix[eliminated[:, None], eliminated] + coupling @ weights
        driven = coupling @ pairs.right
        shifted = pairs.values[:, None, None] * np.eye(count) - eliminated_block
        inverse = np.linalg.pinv(shifted, rcond=count * 2 * UNIT_ROUNDOFF)
        vectors[eliminated] = np.einsum("kij,jk->ik", inverse, driven)
        vectors[remaining] += weights @ vectors[eliminated]
        covectors[eliminated] = -(pairs.left @ weights).T
    shares = np.abs(vectors * covectors)
    total = shares.sum(axis=0)
    sizes = np.abs(vectors)
    shares = np.where(total > 0, shares, sizes)
    return vectors, shares / shares.sum(axis=0)


def oscillation(magnitude: float, angle: float, frame_s: float) -> tuple[float, float]:
    """Return the frequency in Hz and the damping ratio of a given decay and phase advance per frame.

    Both are NaN where the angle is NaN.
    """
    if math.isnan(angle):
        return math.nan, math.nan
    phase = angle if abs(angle) > STRAIGHT else 0.0  # a real eigenvalue's, beyond a float's digits
    rate = complex(np.log(magnitude), phase) / frame_s
    return abs(rate.imag) / (2 * np.pi), float(-rate.real / abs(rate)) if rate else 1.0


def finite(value: float) -> float | None:
    """Return a number for JSON and tables; None for NaN and infinity."""
    return float(value) if np.isfinite(value) else None


def angles_in_frame(closed_loop: ClosedLoop, values: Complexes, vectors: Complexes, shares: Floats) -> Floats:
    """Return the phase advance of modes in a frame (k,), in radians, with complete turns.

    NaN if undetermined.

    The eigenvalue determines the angle up to multiples of 2π; the turns are counted on the continuous state
    of largest participation, or else on a discrete state. If only packets participate, the angle is the
    eigenvalue's.

    Parameters
    ----------
    closed_loop
        The closed system.
    values, vectors, shares
        Eigenvalues (k,), their vectors (n, k) over the state, and the participation of each state (n, k).
    """
    angles = np.angle(values)
    if not closed_loop.motion or not len(values):
        return angles
    motion, mode_numbers = np.array(closed_loop.motion), np.arange(len(values))
    dominant = motion[np.argmax(shares[motion], axis=0)]
    own_states = np.setdiff1d(np.arange(len(shares)), list(closed_loop.layout.indices.values()))
    alternative = own_states[np.argmax(shares[own_states], axis=0)]
    dominant = np.where(shares[dominant, mode_numbers] > LEAST_SHARE, dominant, alternative)
    moving = shares[dominant, mode_numbers] > LEAST_SHARE
    if not closed_loop.peer_classes:
        return np.where(moving, np.nan, angles)
    subsystem_of = np.searchsorted(closed_loop.offsets, dominant, side="right") - 1
    for g, (peer_class, offset, received) in enumerate(
        zip(closed_loop.peer_classes, closed_loop.offsets, closed_loop.received, strict=True)
    ):
        mode_indices = np.flatnonzero(moving & (subsystem_of == g))
        if len(mode_indices):
            start = vectors[offset : offset + len(peer_class.z_names), mode_indices].T
            input_rows = (received @ vectors[:, mode_indices]).T
            subsystem = every_matrix(peer_class.subsystem, lambda matrix: matrix[None])
            angles[mode_indices] = phase_advance(
                subsystem,
                peer_class.schedule,
                start,
                input_rows,
                dominant[mode_indices] - offset,
                values[mode_indices],
            )
    return angles
