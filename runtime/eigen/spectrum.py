"""Eigenvalues with error bounds, and the verdict.

Takes: the `ClosedSystem`s that make up a whole.
Gives: `Mode`, `Spectrum`, `solve_spectrum`.
Guarantees: rigid modes are removed before any eigenvalue is computed; every reported error bounds what
rounding did since the site's coefficients. What floats leave open is proved in balls where that can be (see
`certify`), or else says that it is open.
Does not: close the loop (see `modes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.runtime.eigen.balls import unprovable
from apc.runtime.eigen.certify import MOST_PROVED, prove
from apc.runtime.eigen.closing import ClosedSystem
from apc.runtime.eigen.components import components
from apc.runtime.eigen.enclosure import SMALL, WIDE, discs, enclose_eigenvalues
from apc.runtime.eigen.pseudospectrum import PRODUCT_ROUNDINGS
from apc.runtime.eigen.rigid import RigidModes, find_rigid_modes, independent_places, relative_places
from apc.runtime.frame.discretize import UNIT

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

# An angle that no eigenvalue kept as two floats has unless it is real: their unit roundoff.
STRAIGHT = 2.0**-53

# Angles up to here are half a turn the other way, which rounding or the sign of a zero made of a change
# of sign.
HALF_TURN_BACK = -np.pi * (1 - 2.0**-40)


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
    stable by less than its error. `proof` says what ball arithmetic proved, "" where floats decided; `notes`
    say what could not be proved.
    """

    modes: tuple[Mode, ...]
    spectral_radius: float
    spectral_radius_error: float
    rigid_modes: int
    drifts: int
    verdict: str
    stable: bool | None
    proof: str
    notes: tuple[str, ...]


def solve_spectrum(systems: Sequence[ClosedSystem], *, certify: bool = False) -> Spectrum:
    """Compute the spectrum of a whole system given as independent closed systems.

    Parameters
    ----------
    systems
        The closed systems, each counted as often as its multiplicity says.
    certify
        Prove the verdict of every closed system in ball arithmetic; else of those only that floats leave
        open.

    Notes
    -----
    A drift leaves a second eigenvalue 1 behind when only the rigid direction is removed. So when every error
    disc keeps clear of 1 there is none, and the exact search for one is spared.
    """
    solved = [_solve(system, find_rigid_modes(system, with_drifts=False)) for system in systems]
    lowest = max((one.low for one in solved), default=0.0)
    notes: list[str] = []
    for place, system in enumerate(systems):
        one = solved[place]
        drifting = bool(one.free.names) and not _clear_of_one(one)
        if not (certify or drifting or _is_open(one, lowest)):
            continue
        reason = unprovable(system)
        if not reason and (states := _tied(system)) > MOST_PROVED:
            reason = f"it has {states} states, more than the {MOST_PROVED} that are proved"
        if not reason:
            solved[place] = _prove(system, one)
            continue
        if certify or _is_open(one, lowest):
            notes.append(f"{system.name}: not proved, as {reason}")
        if drifting and (free := find_rigid_modes(system)).drifts:
            solved[place] = _solve(system, free)
    found = [mode for one in solved for mode in one.modes]
    found.sort(key=lambda mode: (-mode.magnitude, mode.shape, mode.eigenvalue.real, -mode.eigenvalue.imag))
    low = max((one.low for one in solved), default=0.0)
    high = max((one.high for one in solved), default=0.0)
    # A proof can know better than the vectors of floats.
    radius = min(max(found[0].magnitude, low), high) if found else 0.0
    rigid = drifts = 0
    for system, one in zip(systems, solved, strict=True):
        rigid += system.multiplicity * one.free.directions.shape[1]
        drifts += system.multiplicity * one.free.drifts
    verdict, stable = judge([one.inside for one in solved], rigid, drifts)
    return Spectrum(
        modes=tuple(found),
        spectral_radius=radius,
        spectral_radius_error=max(high - radius, radius - low, 0.0),
        rigid_modes=rigid,
        drifts=drifts,
        verdict=verdict,
        stable=stable,
        proof=_proof_in_words(solved, drifts),
        notes=tuple(notes),
    )


@dataclass(frozen=True, slots=True)
class _Solved:
    """One closed system: its modes and bounds on its spectral radius.

    `inside` says whether all its eigenvalues but the rigid ones are inside the unit circle; `bits` with how
    many bits that was proved, 0 for floats.
    """

    free: RigidModes
    modes: list[Mode]
    low: float
    high: float
    inside: bool | None
    bits: int


def _tied(system: ClosedSystem) -> int:
    """Return how many states drive each other at most."""
    return max((len(part) for part in components(~(np.abs(system.matrix) + system.error == 0))), default=0)


def _clear_of_one(one: _Solved) -> bool:
    """Say whether no eigenvalue can be 1."""
    return all(abs(mode.eigenvalue - 1) > mode.error for mode in one.modes)


def _is_open(one: _Solved, lowest: float) -> bool:
    """Say whether floats leave something open that decides: the verdict, or the radius of the whole.

    `lowest` is what the radius of the whole is at least.
    """
    if not one.high > lowest:  # another system decides
        return False
    return (one.inside is None and not lowest > 1) or not one.high - one.low <= WIDE * max(one.low, 1.0)


def _proof_in_words(solved: Sequence[_Solved], drifts: int) -> str:
    """Say what was proved, "" where floats decided everything."""
    bits = max((one.bits for one in solved), default=0)
    if not bits:
        return ""
    unstable = [one.bits for one in solved if one.inside is False]
    if any(unstable):
        return f"proved unstable with {max(unstable)} bits"
    if any(one.inside is None for one in solved):
        return f"undecided at {bits} bits"
    if unstable or not all(one.bits for one in solved if one.modes):
        return f"decided with {bits} bits where floats left it open"
    return f"proved {'to drift' if drifts else 'stable'} with {bits} bits"


def judge(inside: Sequence[bool | None], rigid: int, drifts: int) -> tuple[str, bool | None]:
    """Return the verdict and whether it means stable, from where the eigenvalues of each system are."""
    if False in inside:
        return UNSTABLE, False
    if None in inside:
        return UNDECIDED, None
    if drifts:
        return DRIFTS, False
    return (STABLE_TRANSLATING if rigid else STABLE), True


def _solve(system: ClosedSystem, free: RigidModes) -> _Solved:
    """Solve one system in floats.

    With the rigid motions V = [V_p; V_r], p as many places as there are motions, and W = V_r V_p⁻¹, the
    relative coordinates x_r − W x_p move by themselves, by M_rr − W M_pr: that map has all other eigenvalues.
    """
    n = len(system.names)
    count = free.basis.shape[1]
    if count == n:
        return _Solved(free, [], 0.0, 0.0, True, 0)
    matrix, error = system.matrix, system.error
    held, rest = relative_places(free.basis)
    weights, weights_error = _relative(free.basis[held], free.basis[rest])
    reduced = matrix[np.ix_(rest, rest)] - weights @ matrix[np.ix_(held, rest)]
    size = np.abs(matrix) + error
    reduced_error = error[np.ix_(rest, rest)] + weights_error @ size[np.ix_(held, rest)]
    reduced_error += np.abs(weights) @ error[np.ix_(held, rest)]
    rounded = np.abs(weights) @ size[np.ix_(held, rest)]
    reduced_error += (PRODUCT_ROUNDINGS * (count + 2) * UNIT) * (rounded + np.abs(reduced) * (count > 0))

    values, right, left, errors, low, high = enclose_eigenvalues(reduced, reduced_error, whole=count > 0)
    inside = False if low > 1 else True if high < 1 else None  # NaN decides nothing
    return _Solved(free, _modes(system, free, values, right, left, errors), low, high, inside, 0)


def _prove(system: ClosedSystem, estimate: _Solved) -> _Solved:
    """Solve one system in balls; what these leave open stays as floats found it."""
    proof = prove(system, estimate.free, independent_places(estimate.free.basis.T).tolist())
    if proof.free.drifts != estimate.free.drifts:
        estimate = _solve(system, proof.free)
    inside, bits = proof.inside, proof.bits
    if inside is None and not estimate.free.names:
        # Weights known as floats only can cost balls more than floats: their bound counts these, too.
        inside, bits = estimate.inside, 0 if estimate.inside is not None else bits
    if not len(proof.values):
        return replace(estimate, inside=inside, bits=bits)
    found = discs(proof.values, proof.values, proof.radii)
    modes = estimate.modes
    known = not found.high - found.low > estimate.high - estimate.low
    if known and proof.right is not None and proof.left is not None:
        modes = _modes(system, proof.free, proof.values, proof.right, proof.left, found.errors)
    low, high = max(estimate.low, found.low), min(estimate.high, found.high)
    return _Solved(proof.free, modes, low, high, inside, bits)


def _modes(
    system: ClosedSystem,
    free: RigidModes,
    values: Complexes,
    right: Complexes,
    left: Complexes,
    errors: Floats,
) -> list[Mode]:
    """Describe eigenvalues of the relative coordinates, their vectors as columns and rows."""
    n = len(system.names)
    count = free.basis.shape[1]
    matrix = system.matrix
    held, rest = relative_places(free.basis)
    weights, _ = _relative(free.basis[held], free.basis[rest])
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
    return modes


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
        angle = angle_in_frame(system, value, vector, shares)
        frequency, damping = oscillation(magnitude, angle, system.frame_s)
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


def oscillation(magnitude: float, angle: float, frame_s: float) -> tuple[float, float]:
    """Return the frequency in Hz and the damping ratio of what shrinks and turns so much in a frame."""
    turn = angle if abs(angle) > STRAIGHT else 0.0  # a real eigenvalue's, in more digits than a float has
    rate = complex(np.log(magnitude), turn) / frame_s
    return abs(rate.imag) / (2 * np.pi), -rate.real / abs(rate) if rate else 1.0


def angle_in_frame(system: ClosedSystem, value: complex, vector: Complexes, shares: Floats) -> float:
    """Return by how much the mode turns in a frame, in radians, whole turns counted.

    The eigenvalue knows the angle up to whole turns; these are counted on the continuous state that takes
    most part, from tick to tick of the fastest clock. A real vector has no angle but its sign: each change
    of sign is half a turn.

    Parameters
    ----------
    system
        The closed system.
    value, vector
        An eigenvalue and its vector (n,) over the state.
    shares
        How much each state takes part (n,).
    """
    if not system.motion:
        return float(np.angle(value))
    dominant = int(np.argmax(shares[list(system.motion)]))
    return turned_along(system.inside[:, dominant] @ vector, value)


def turned_along(course: Complexes, value: complex) -> float:
    """Return the angle of an eigenvalue, in radians, with the whole turns of a state at a frame's marks.

    A change of sign is half a turn forwards, whatever the sign of the zero beside it.
    """
    principal = float(np.angle(value))
    if not np.all(np.abs(course) > 0):
        return principal
    phases = course / np.abs(course)  # the courses themselves can grow or shrink out of the range of floats
    turns = np.angle(phases[1:] / phases[:-1])
    turned = float(np.sum(np.where(turns <= HALF_TURN_BACK, turns + 2 * np.pi, turns)))
    return principal + 2 * np.pi * round((turned - principal) / (2 * np.pi))
