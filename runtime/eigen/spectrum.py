"""Eigenvalues with error bounds, and the verdict.

Takes: the `ClosedLoop`s that make up a whole.
Gives: `Mode`, `ModeMotion`, `Spectrum`, `solve_spectrum`, `mode_near`; `whole_vectors`, `angles_in_frame`,
`oscillation`, `finite`.
Guarantees: rigid modes are removed before any eigenvalue is computed; every reported error bounds what
rounding did since the site's coefficients. What floats leave open is proved in balls where that can be (see
`certify`), or else says that it is open.
Does not: close the loop (see `modes`).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.balls import unprovable
from apc.eigen.certify import MOST_PROVED, prove
from apc.eigen.closing import ClosedLoop
from apc.eigen.eigenpairs import Eigenpairs, components, pairs_to
from apc.eigen.enclosure import SMALL, WIDE, Enclosure, descending, discs, enclose_eigenvalues
from apc.eigen.relative import Relative, relative_bounded, relative_coordinates
from apc.eigen.rigid import RigidModes, find_rigid_modes, rigid_modes_of
from apc.frame.course import turns
from apc.frame.radius import UNIT
from apc.frame.schedule import Propagate
from apc.frame.site import every_matrix
from apc.later import LazyTuple
from apc.threads import single_threaded
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
Matrix = NDArray[Any]  # float64 or complex128

# So many modes are looked at as a rule, twice the rows of a table; how the rest move is made together.
LOOKED_AT = 64

# A mode that shrinks to less than this in a frame is one that ends in finite time, computed in floats.
DEADBEAT = 1e-12

# A proof serves for all that is told where it knows the radius to this many times the bound of floats.
AS_SHARP = 4.0

# An angle that no eigenvalue kept as two floats has unless it is real: their unit roundoff.
STRAIGHT = 2.0**-53

# A mode of which no continuous state has a larger share moves nothing: what moves is rounding.
LEAST_SHARE = 1e-9


@dataclass(frozen=True, slots=True)
class ModeMotion:
    """What a mode does inside a frame, and which states do it.

    `frequency_hz` and `damping_ratio` belong to s = log(eigenvalue)/frame on the branch the motion takes
    inside the frame; both are NaN where that can't be told. `participation` shares the mode out among the
    states (the shares add up to 1).
    """

    frequency_hz: float
    damping_ratio: float
    participation: tuple[tuple[str, float], ...]


@dataclass(frozen=True, slots=True)
class Mode:
    """One eigenvalue of the whole system's frame map, held `multiplicity` times.

    `magnitude` is per frame; `error` bounds |eigenvalue − truth|. `shape` is the system the mode belongs to.
    `motion` is one `ModeMotion`: of a large system it is dear, and made for the modes that are looked at.
    """

    eigenvalue: complex
    magnitude: float
    multiplicity: int
    shape: str
    error: float
    motion: Sequence[ModeMotion]

    @property
    def frequency_hz(self) -> float:
        """See `ModeMotion`."""
        return self.motion[0].frequency_hz

    @property
    def damping_ratio(self) -> float:
        """See `ModeMotion`."""
        return self.motion[0].damping_ratio

    @property
    def participation(self) -> tuple[tuple[str, float], ...]:
        """See `ModeMotion`."""
        return self.motion[0].participation


@dataclass(frozen=True, slots=True)
class Spectrum:
    """All modes but the rigid ones, the largest first, and what follows from them.

    `spectral_radius` is per frame; `stable` is None when the verdict is undecided. The error bounds the
    radius from both sides, the verdict needs one: where hardly anything bounds it from below, a system can be
    stable by less than its error. `proof` is what ball arithmetic proved, false where floats decided;
    `notes` are what could not be proved. `beyond` is how much larger than 1 the radius is, at least and at
    most, where something was proved: it can be closer to 1 than floats are to each other.
    """

    modes: Sequence[Mode]
    spectral_radius: float
    spectral_radius_error: float
    rigid_modes: int
    drifts: int
    verdict: StabilityVerdict
    stable: bool | None
    proof: StabilityProof
    notes: tuple[Note, ...]
    beyond: tuple[float, float] | None = None


def solve_spectrum(
    systems: Sequence[ClosedLoop], *, certify: bool = False, in_balls: bool = True
) -> Spectrum:
    """Compute the spectrum of a whole system given as independent closed systems.

    Parameters
    ----------
    systems
        The closed systems, each counted as often as its multiplicity says.
    certify
        Prove the verdict of every closed system in ball arithmetic; else of those only that floats leave
        open.
    in_balls
        Whether these are worth their time; else they stay open.

    Notes
    -----
    A drift leaves a second eigenvalue 1 behind when only the rigid direction is removed. So when every error
    disc keeps clear of 1 there is none, and the exact search for one is spared.
    """
    solved = [_solve(system, rigid_modes_of(system)) for system in systems]
    lowest = max((item.low for item in solved), default=0.0)
    notes: list[Note] = []
    for place, system in enumerate(systems):
        item = solved[place]
        drifting = bool(item.free.names) and not item.clear_of_one
        if not (certify or drifting or _is_open(item, lowest)):
            continue
        reason = unprovable(system)
        if not in_balls:
            reason = "balls were not asked"
        elif not reason and (states := _tied(system)) > MOST_PROVED:
            reason = f"it has {states} states, more than the {MOST_PROVED} that are proved"
        if not reason:
            solved[place] = _prove(system, item)
            continue
        if certify or _is_open(item, lowest):
            notes.append(Limitation(LimitationCode.NOT_PROVED, (system.name, reason)))
        if drifting and (free := find_rigid_modes(system)).drifts:
            solved[place] = _solve(system, free)
    low = max((item.low for item in solved), default=0.0)
    high = max((item.high for item in solved), default=0.0)
    largest = max((float(np.abs(item.pairs.values).max(initial=0.0)) for item in solved), default=0.0)
    radius = min(max(largest, low), high)  # a proof can know better than the vectors of floats
    rigid = drifts = 0
    for system, item in zip(systems, solved, strict=True):
        rigid += system.multiplicity * len(item.free.names)
        drifts += system.multiplicity * item.free.drifts
    verdict, stable = judge([item.inside for item in solved], rigid, drifts)
    return Spectrum(
        modes=LazyTuple(functools.partial(_modes, tuple(systems), tuple(solved))),
        spectral_radius=radius,
        spectral_radius_error=max(high - radius, radius - low, 0.0),
        rigid_modes=rigid,
        drifts=drifts,
        verdict=verdict,
        stable=stable,
        proof=_proof(solved, drifts),
        notes=tuple(notes),
        beyond=_beyond(solved),
    )


def _beyond(solved: Sequence[_SolvedLoop]) -> tuple[float, float] | None:
    if not any(item.bits for item in solved):
        return None
    least, most = map(max, zip(*(item.beyond for item in solved), strict=True))
    return least, most


def mode_near(systems: Sequence[ClosedLoop], eigenvalue: complex) -> Mode:
    """Return the mode of closed systems whose eigenvalue, or its conjugate, is nearest to a value."""
    modes = solve_spectrum(systems, in_balls=False).modes
    value = complex(eigenvalue.real, abs(eigenvalue.imag))
    return min(modes, key=lambda mode: abs(complex(mode.eigenvalue.real, abs(mode.eigenvalue.imag)) - value))


@dataclass(frozen=True, slots=True, eq=False)
class _SolvedLoop:
    """One closed system: its eigenvalues, each with its error, and bounds on its spectral radius.

    `inside` says whether all its eigenvalues but the rigid ones are inside the unit circle; `bits` with how
    many bits that was proved, 0 for floats; `beyond` how much larger than 1 the radius is, at least and most.
    """

    free: RigidModes
    at: Relative
    matrix: Floats  # of the relative coordinates
    pairs: Eigenpairs  # of each strongly connected part by itself
    bounds: Enclosure
    low: float
    high: float
    inside: bool | None
    bits: int
    beyond: tuple[float, float]

    @property
    def whole(self) -> Eigenpairs:
        """The vectors that the whole state follows from: where some is held, those of all that is left."""
        return pairs_to(self.matrix, self.pairs.values) if len(self.at.held) else self.pairs

    @property
    def clear_of_one(self) -> bool:
        """Whether no eigenvalue can be 1."""
        return bool((np.abs(self.pairs.values - 1) > self.bounds.errors).all())


def _tied(system: ClosedLoop) -> int:
    """Return how many states drive each other at most."""
    return max((len(part) for part in components(~(np.abs(system.matrix) + system.error == 0))), default=0)


def _is_open(solved: _SolvedLoop, lowest: float) -> bool:
    """Say whether floats leave something open that decides: the verdict, or the radius of the whole.

    `lowest` is what the radius of the whole is at least.
    """
    if not solved.high > lowest:  # another system decides
        return False
    return (solved.inside is None and not lowest > 1) or not solved.high - solved.low <= WIDE * max(
        solved.low, 1.0
    )


def _proof(solved: Sequence[_SolvedLoop], drifts: int) -> StabilityProof:
    """Return what was proved, nothing where floats decided everything."""
    bits = max((item.bits for item in solved), default=0)
    if not bits:
        return NO_PROOF
    unstable = [item.bits for item in solved if item.inside is False]
    outcome = ProofOutcome.DRIFTS if drifts else ProofOutcome.STABLE
    if any(unstable):
        outcome, bits = ProofOutcome.UNSTABLE, max(unstable)
    elif any(item.inside is None for item in solved):
        outcome = ProofOutcome.UNDECIDED
    elif unstable or not all(item.bits for item in solved if len(item.pairs.values)):
        outcome = ProofOutcome.PARTLY
    return StabilityProof(ProofMethod.BALLS, bits, outcome)


def judge(inside: Sequence[bool | None], rigid: int, drifts: int) -> tuple[StabilityVerdict, bool | None]:
    """Return the verdict and whether it means stable, from where the eigenvalues of each system are."""
    if False in inside:
        return StabilityVerdict.UNSTABLE, False
    if None in inside:
        return StabilityVerdict.UNDECIDED, None
    if drifts:
        return StabilityVerdict.DRIFTS, False
    return up_to(rigid), True


def up_to(translations: int, rotations: int = 0) -> StabilityVerdict:
    """Return the verdict of what is stable up to so many motions."""
    if translations:
        return StabilityVerdict.STABLE_MOVING if rotations else StabilityVerdict.STABLE_TRANSLATING
    return StabilityVerdict.STABLE_TURNING if rotations else StabilityVerdict.STABLE


def _solve(system: ClosedLoop, free: RigidModes) -> _SolvedLoop:
    """Solve a system in floats, rigid modes taken out."""
    at = relative_coordinates(free.basis)
    matrix, error = relative_bounded(system.matrix, system.error, at)
    pairs, bounds = enclose_eigenvalues(matrix, error)
    inside = False if bounds.low > 1 else True if bounds.high < 1 else None  # NaN decides nothing
    low, high = bounds.low, bounds.high
    return _SolvedLoop(free, at, matrix, pairs, bounds, low, high, inside, 0, (low - 1, high - 1))


def _prove(system: ClosedLoop, estimate: _SolvedLoop) -> _SolvedLoop:
    """Solve one system in balls; what these leave open stays as floats found it."""
    proof = prove(system, estimate.free)
    if proof.free.drifts != estimate.free.drifts:
        estimate = _solve(system, proof.free)
    inside, bits = proof.inside, proof.bits
    if inside is None and not estimate.free.names:
        # Weights known as floats only can cost balls more than floats: their bound counts these, too.
        inside, bits = estimate.inside, 0 if estimate.inside is not None else bits
    enclosure = discs(proof.centres, proof.centres, proof.radii)
    low, high = max(estimate.low, float(enclosure.low)), min(estimate.high, float(enclosure.high))
    beyond = (max(estimate.beyond[0], proof.beyond[0]), min(estimate.beyond[1], proof.beyond[1]))
    proved = replace(estimate, low=low, high=high, inside=inside, bits=bits, beyond=beyond)
    # A radius that floats know as well: the other eigenvalues a proof knows far better.
    if enclosure.high - enclosure.low > AS_SHARP * (estimate.high - estimate.low):
        return proved
    order = descending(proof.centres)
    pairs = pairs_to(estimate.matrix, proof.centres[order])
    return replace(
        proved, pairs=pairs, bounds=Enclosure(enclosure.low, enclosure.high, enclosure.errors[order])
    )


def _modes(systems: Sequence[ClosedLoop], solved: Sequence[_SolvedLoop]) -> tuple[Mode, ...]:
    """List the eigenvalues of all systems, the largest first; how they move is made when it is looked at."""
    ranked = sorted(
        (-abs(value), system.name, value.real, -value.imag, place, row)
        for place, (system, item) in enumerate(zip(systems, solved, strict=True))
        for row, value in enumerate(item.pairs.values.tolist())
    )
    modes = []
    for some in (ranked[:LOOKED_AT], ranked[LOOKED_AT:]):
        motions = LazyTuple(functools.partial(_motions, systems, solved, [item[-2:] for item in some]))
        for number, (*_, place, row) in enumerate(some):
            value = complex(solved[place].pairs.values[row])
            modes.append(
                Mode(
                    eigenvalue=value,
                    magnitude=abs(value),
                    multiplicity=systems[place].multiplicity,
                    shape=systems[place].name,
                    error=float(solved[place].bounds.errors[row]),
                    motion=LazyTuple(functools.partial(_one_of, motions, number)),
                )
            )
    return tuple(modes)


def _one_of(motions: Sequence[ModeMotion], number: int) -> tuple[ModeMotion]:
    return (motions[number],)


def _motions(
    systems: Sequence[ClosedLoop], solved: Sequence[_SolvedLoop], places: Sequence[tuple[int, int]]
) -> tuple[ModeMotion, ...]:
    """Describe some eigenvalues, given by their systems and rows."""
    result: dict[tuple[int, int], ModeMotion] = {}
    with single_threaded(), np.errstate(all="ignore"):
        for s, (system, item) in enumerate(zip(systems, solved, strict=True)):
            rows = [row for own, row in places if own == s]
            if rows:
                motions = _described(system, item, np.array(rows, dtype=np.intp))
                result |= {(s, row): motion for row, motion in zip(rows, motions, strict=True)}
    return tuple(result[place] for place in places)


def _described(system: ClosedLoop, solved: _SolvedLoop, rows: Integers) -> list[ModeMotion]:
    """Describe the eigenvalues of some rows of a system, in their order."""
    pairs = solved.whole.at(rows)
    vectors, shares = whole_vectors(system, solved.at, pairs)
    sizes = np.abs(pairs.values)
    gone = sizes <= np.maximum(DEADBEAT * len(system.names), np.minimum(solved.bounds.errors[rows], SMALL))
    # What ends in finite time has no frequency; but what is never computed anew can't end.
    angles = np.full(len(rows), 0.0 if _ticks(system) else np.nan)
    angles[~gone] = angles_in_frame(system, pairs.values[~gone], vectors[:, ~gone], shares[:, ~gone])
    motions = []
    for size, angle, ends, taking in zip(
        sizes.tolist(), angles.tolist(), gone.tolist(), shares.T.tolist(), strict=True
    ):
        frequency, damping = 0.0, 1.0
        if not ends or math.isnan(angle):
            frequency, damping = oscillation(size, angle, system.frame_s)
        motions.append(ModeMotion(frequency, damping, tuple(zip(system.names, taking, strict=True))))
    return motions


def _ticks(system: ClosedLoop) -> bool:
    """Say whether anything but the exact exponential makes the frame's map, as far as that is known."""
    return not system.sites or any(
        not isinstance(event, Propagate) for group in system.sites for event in group.schedule.events
    )


def whole_vectors(
    system: ClosedLoop,
    at: Relative,
    pairs: Eigenpairs,
) -> tuple[Complexes, Floats]:
    """Return the vectors (n, k) over the whole state, and how much each state takes part (n, k), shares of 1.

    Parameters
    ----------
    system, at
        The closed system and its relative coordinates.
    pairs
        Eigenvalues (k,) of the relative coordinates, with their vectors.
    """
    matrix = system.matrix
    held, rest, weights, count = at.held, at.rest, at.weights, len(at.held)
    vectors, covectors = np.zeros((2, len(system.names), len(pairs.values)), dtype=np.complex128)
    vectors[rest], covectors[rest] = pairs.right, pairs.left.T
    if count:
        # Back to the whole state: x_p follows from (λ − M_pp − M_pr W) x_p = M_pr y.
        across = matrix[held[:, None], rest]
        corner = matrix[held[:, None], held] + across @ weights
        driven = across @ pairs.right
        shifted = pairs.values[:, None, None] * np.eye(count) - corner
        inverse = np.linalg.pinv(shifted, rcond=count * 2 * UNIT)
        vectors[held] = np.einsum("kij,jk->ik", inverse, driven)
        vectors[rest] += weights @ vectors[held]
        covectors[held] = -(pairs.left @ weights).T
    shares = np.abs(vectors * covectors)
    total = shares.sum(axis=0)
    sizes = np.abs(vectors)
    shares = np.where(total > 0, shares, sizes)
    return vectors, shares / shares.sum(axis=0)


def oscillation(magnitude: float, angle: float, frame_s: float) -> tuple[float, float]:
    """Return the frequency in Hz and the damping ratio of what shrinks and turns so much in a frame.

    Both are NaN for an angle that is.
    """
    if math.isnan(angle):
        return math.nan, math.nan
    turn = angle if abs(angle) > STRAIGHT else 0.0  # a real eigenvalue's, in more digits than a float has
    rate = complex(np.log(magnitude), turn) / frame_s
    return abs(rate.imag) / (2 * np.pi), float(-rate.real / abs(rate)) if rate else 1.0


def finite(value: float) -> float | None:
    """Return a number for JSON and tables, None for one that can't be told or is beyond measure."""
    return float(value) if np.isfinite(value) else None


def angles_in_frame(system: ClosedLoop, values: Complexes, vectors: Complexes, shares: Floats) -> Floats:
    """Return by how much modes turn in a frame (k,), in radians, with whole turns; NaN if it can't be told.

    The eigenvalue knows the angle up to whole turns; these are counted on the continuous state that takes
    most part, or else on what is remembered. Where neither takes part, as in what only packets carry, the
    angle is the eigenvalue's.

    Parameters
    ----------
    system
        The closed system.
    values, vectors, shares
        Eigenvalues (k,), their vectors (n, k) over the state, and how much each state takes part (n, k).
    """
    angles = np.angle(values)
    if not system.motion or not len(values):
        return angles
    motion, every = np.array(system.motion), np.arange(len(values))
    dominant = motion[np.argmax(shares[motion], axis=0)]
    own = np.setdiff1d(np.arange(len(shares)), list(system.layout.places.values()))
    rest = own[np.argmax(shares[own], axis=0)]
    dominant = np.where(shares[dominant, every] > LEAST_SHARE, dominant, rest)
    moving = shares[dominant, every] > LEAST_SHARE
    if not system.sites:
        return np.where(moving, np.nan, angles)
    site_of = np.searchsorted(system.offsets, dominant, side="right") - 1
    for g, (group, offset, heard) in enumerate(zip(system.sites, system.offsets, system.heard, strict=True)):
        own = np.flatnonzero(moving & (site_of == g))
        if len(own):
            start = vectors[offset : offset + len(group.z_names), own].T
            received = (heard @ vectors[:, own]).T
            site = every_matrix(group.site, lambda matrix: matrix[None])
            angles[own] = turns(site, group.schedule, start, received, dominant[own] - offset, values[own])
    return angles
