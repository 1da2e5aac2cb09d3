"""The spectrum of a population from its characteristic function: bounds, verdict, dominant modes.

Takes: loops with long delays, or populations of different peers on complete graphs.
Gives: `solve_loops`, `solve_populations`.
Guarantees: as `zeros`: the radius is bounded from both sides, without missed eigenvalues. A radius closer to
1 than its bound is reported as undecided. Rigid modes are determined from the equations.
Does not: list more than the largest modes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.eigen.interconnection import ModalSystem, without_packets
from apc.eigen.rigid_modes import find_rigid_modes
from apc.eigen.spectrum import Mode, ModeMotion, Spectrum, combine_verdicts
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.interval_arithmetic import value_of
from apc.large_scale.characteristic import Characteristic, matrices_in, parts_in
from apc.large_scale.determinant import TransferMember, of_loop, of_populations
from apc.large_scale.heterogeneous_peers import (
    HeterogeneousGroup,
    lines_of,
    receive_from_themselves,
    turned_by,
)
from apc.large_scale.transfer import CHUNK, TransferSubsystems
from apc.large_scale.zeros import Zero, Zeros, find_zeros, near_poles
from apc.verdict import NO_PROOF

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Modes listed of each system; of many peers fewer, as the shares of all peers are worked out for each.
LISTED, LISTED_OF_MANY, MANY = 5, 1, 20_000

# Number of poles of a population's subsystems near which zeros are searched.
NEAR_POLES = 6

# Number of equal copies of a peer whose spectra provide start values for common zeros.
SAMPLES = 2

# Smaller eigenvalues of these decide nothing, and those this near to 1 are rigid.
LEAST_START, SAME_START = 0.5, 1e-9

# Zeros of a loop that Newton's method starts from, the largest by their estimate.
STARTS = 64

# The relative offset from an eigenvalue for inverse iteration of its vectors; larger at a pole, where the
# response is large and rounded.
ALONGSIDE, BESIDE_POLE = 1e-13, 1e-10


@dataclass(frozen=True, slots=True)
class _SolvedSystem:
    """One system: its zeros and modes."""

    zeros: Zeros
    rigid: int
    drifts: int
    modes: tuple[Mode, ...]


def solve_loops(loops: Sequence[ModalSystem]) -> Spectrum:
    """Compute the spectrum of independent loops, with delays of any length.

    Parameters
    ----------
    loops
        The loops, each counted with its multiplicity.
    """
    return _spectrum([_solve_loop(loop) for loop in loops], [loop.multiplicity for loop in loops])


def solve_populations(
    populations: Sequence[HeterogeneousGroup], exchange: CommunicationGraph, *, rigid: int
) -> Spectrum:
    """Compute the spectrum of different peers on complete graphs.

    Parameters
    ----------
    populations
        All peers.
    exchange
        The links, all of them complete.
    rigid
        The number of common translations, from the equations (see `translation`).
    """
    function, members = of_populations(populations, exchange)
    peers = int(sum(len(population.parameters) for population in populations))
    zeros = find_zeros(
        function,
        _common_starts(members),
        rigid=rigid,
        listed=LISTED_OF_MANY if peers > MANY else LISTED,
        near=NEAR_POLES,
    )
    modes = [
        _mode(function, members, zero, "different peers", 1)
        if zero.subsystem is None
        else _local_mode(members, zero)
        for zero in zeros.zeros
    ]
    return _spectrum([_SolvedSystem(zeros, rigid, 0, _with_conjugates(modes))], [1])


def _spectrum(solved: Sequence[_SolvedSystem], multiplicities: Sequence[int]) -> Spectrum:
    """Put the answers of independent systems together."""
    modes = sorted(
        (mode for item in solved for mode in item.modes),
        key=lambda mode: (-mode.magnitude, mode.family, mode.eigenvalue.real, -mode.eigenvalue.imag),
    )
    low = max(item.zeros.low for item in solved)
    high = max(item.zeros.high for item in solved)
    radius = max(item.zeros.radius for item in solved)
    rigid = sum(item.rigid * many for item, many in zip(solved, multiplicities, strict=True))
    drifts = sum(item.drifts * many for item, many in zip(solved, multiplicities, strict=True))
    inside = [False if item.zeros.low > 1 else True if item.zeros.high < 1 else None for item in solved]
    verdict, stable = combine_verdicts(inside, rigid, drifts)
    notes = ["the largest modes only; that none is larger was counted by the argument principle"]
    if not all(item.zeros.counted for item in solved):
        notes = ["the largest modes found; the count that none is larger was had farther out only"]
    error = max(high - radius, radius - low, 0.0)
    return Spectrum(tuple(modes), radius, error, rigid, drifts, verdict, stable, NO_PROOF, tuple(notes))


def _solve_loop(loop: ModalSystem) -> _SolvedSystem:
    """Find the largest modes of a loop."""
    function, members = of_loop(loop.subsystems, loop.coupling, loop.weight_errors)
    prompt = without_packets(loop)
    rigid, drifts = len(find_rigid_modes(prompt, with_drifts=False).names), 0
    starts = _delay_starts(function)
    zeros = find_zeros(function, starts, rigid=rigid, listed=LISTED, near=0)
    if (
        rigid
        and np.isfinite(zeros.high)
        and not zeros.rigid_counted
        and (drifts := find_rigid_modes(loop).drifts)
    ):
        zeros = find_zeros(function, starts, rigid=rigid + drifts, listed=LISTED, near=0)
    modes = _with_conjugates(
        _mode(function, members, zero, loop.name, loop.multiplicity) for zero in zeros.zeros
    )
    return _SolvedSystem(zeros, rigid, drifts, modes)


def _delay_starts(function: Characteristic) -> Complexes:
    """Return approximate zeros of a loop with a long delay d.

    Where k is an eigenvalue of T(ζ) W(ζ) ζ^d, f has a zero if ζ^d = k(ζ): near the unit circle ζ is
    |k|^(1/d) times a d-th root of 1, turned by what k is turned.
    """
    delay = max(1, function.longest)
    rotations = np.arange(delay // 2 + 1)
    on_circle = np.exp(2j * np.pi * rotations / delay) * (1 + 1e-9)
    around = (
        np.eye(function.transfer.shape[0]) - matrices_in(function, on_circle, np.zeros(len(rotations)))[:, 0]
    )
    gain = np.linalg.eigvals(around) * (on_circle**delay)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = (np.log(gain) + 2j * np.pi * rotations[:, None]) / delay
    starts = np.exp(logarithm).ravel()
    largest = np.sort(np.abs(starts[np.isfinite(starts)]))[-STARTS:] if len(starts) else starts
    starts = starts[np.abs(starts) >= largest.min(initial=np.inf)]
    poles = near_poles(function, NEAR_POLES)
    return np.concatenate([starts, poles * (1 + 1e-3), poles * (1 - 1e-3)])


def _common_starts(members: Sequence[TransferMember]) -> Complexes:
    """Return the eigenvalues of populations of copies of one peer, for some peers: common modes."""
    result = [np.zeros(0, np.complex128)]
    for member in members:
        few = np.unique(np.linspace(0, len(member.subsystems.counts) - 1, SAMPLES).astype(np.int64))
        frame_map = member.subsystems.maps.mapped(lambda block, few=few: block[few])
        interchangeable = receive_from_themselves(
            frame_map, member.schedule, member.interchangeable, 0 * member.interchangeable
        )
        values = np.linalg.eigvals(value_of(interchangeable.p)).astype(np.complex128).ravel()
        stored = (values.imag >= 0) & (np.abs(values) > LEAST_START) & (np.abs(values - 1) > SAME_START)
        result.append(values[stored])
    return np.concatenate(result)


def _local_mode(members: Sequence[TransferMember], zero: Zero) -> Mode:
    """Describe an eigenvalue of a single peer: a difference mode, or that of a peer without receivers."""
    assert zero.subsystem is not None
    which, row = zero.subsystem
    item, every = members[which], members[which].subsystems
    alone = TransferSubsystems(
        every.maps.mapped(lambda block: block[row : row + 1]),
        *(np.ones(1), np.arange(len(every.rows)), np.arange(len(every.lines))),
    )
    member = replace(item, subsystems=alone, subsystem=lambda _: item.subsystem(row))
    return _mode(None, [member], zero, f"{item.name} by itself", zero.multiplicity)


def _mode(
    function: Characteristic | None,
    members: Sequence[TransferMember],
    zero: Zero,
    shape: str,
    multiplicity: int,
) -> Mode:
    """Describe a zero; participations of a population's peers are summed, and those of a channel's packets.

    Parameters
    ----------
    function
        f, None without coupling.
    members
        All members.
    zero
        Of f, or a pole that is an eigenvalue.
    shape, multiplicity
        As in `LossMode`.

    Notes
    -----
    Inverse iteration with a small excitation of all states. It also applies if I − T W has no null vector, at
    a pole that is an eigenvalue. Let the uncoupled subsystems send s₁, with left weights t₁. The coupled
    subsystems send s = (I − T W)⁻¹ s₁, and their left weights of received values are t = t₁ (I − W T)⁻¹.
    """
    value = zero.value * (1 + (BESIDE_POLE if zero.subsystem else ALONGSIDE))
    random = np.random.default_rng(0)
    moves = [_moves(member, value, random) for member in members]
    n_s = 1 + max((int(row) for member in members for row in member.subsystems.rows), default=-1)
    n_r = 1 + max((int(line) for member in members for line in member.subsystems.lines), default=-1)
    answer, receiving = np.zeros((n_s, n_r), np.complex128), np.zeros((n_r, n_s), np.complex128)
    if function is not None:
        answer, receiving = (part[0, 0] for part in parts_in(function, np.array([value]), np.zeros(1)))
    alone, weighed = np.zeros(n_s, np.complex128), np.zeros(n_r, np.complex128)
    for member, move in zip(members, moves, strict=True):
        alone[member.subsystems.rows] += member.subsystems.counts @ move.sends(move.right[..., 0])
        weighed[member.subsystems.lines] += member.subsystems.counts @ (
            member.others * move.left[:, move.n_z :, 0]
        )
    sent = np.linalg.solve(np.eye(n_s) - answer @ receiving, alone)
    used = np.linalg.solve((np.eye(n_r) - receiving @ answer).T, weighed).astype(np.complex128)
    received, weight = receiving @ sent, used @ receiving
    weights = {} if function is None else dict(zip(function.lags.tolist(), function.weights, strict=True))
    shares: dict[str, float] = {}
    most, turned = -1.0, (0.0, 1.0)
    for member, move in zip(members, moves, strict=True):
        subsystems, schedule, n_z = member.subsystems, member.schedule, move.n_z
        right = move.right[..., 0] + move.right[..., 1:] @ received[subsystems.lines]
        left = move.left[..., 0] + move.left[..., 1:] @ weight[subsystems.rows]
        z, r, w, mu = right[:, :n_z], right[:, n_z:], left[:, :n_z], left[:, n_z:]
        prefix = f"{member.name}." if len(members) > 1 else ""
        local = np.abs(w * z)
        listed = dict(zip(member.z_names, subsystems.counts @ local, strict=True))
        known = {lag: member.local[:, None] * picked for lag, picked in lines_of(schedule).items()}
        packets = move.sends(right)
        for row, (name, depth) in enumerate(zip(schedule.sent_names, schedule.depths, strict=True)):
            by_others = _waiting(weights, value, used[None], depth, subsystems.rows[row])
            waiting = _waiting(known, value, mu, depth, row) + by_others
            aged = waiting * value ** -np.arange(1.0, depth + 1)[:, None]
            listed[name] = (
                listed.get(name, 0.0) + np.abs(aged * packets[:, row]).sum(axis=0) @ subsystems.counts
            )
        for name, share in listed.items():
            shares[prefix + name] = shares.get(prefix + name, 0.0) + float(share)
        peer = int(np.argmax(local.sum(axis=1)))
        if float(local[peer].sum()) > most:
            most = float(local[peer].sum())
            turned = turned_by(member.subsystem(peer), schedule, zero.value, z[peer], r[peer], w[peer])
    total = sum(shares.values()) or 1.0
    motion = ModeMotion(*turned, tuple((name, share / total) for name, share in shares.items()))
    return Mode(zero.value, abs(zero.value), multiplicity, shape, zero.error, (motion,))


@dataclass(frozen=True, slots=True, eq=False)
class _Moves:
    """Mode vectors of subsystems at ζ: `right` (k, n, 1 + n_r), states z and r, excited, then by each τ.

    `left` (k, n, 1 + n_s) are the left vectors, excited, then by each packet weight; `sending` (k, n_s, n) is
    [S D].
    """

    right: Complexes
    left: Complexes
    sending: Floats
    n_z: int

    def sends(self, moved: Complexes) -> Complexes:
        """Return the sent values (k, n_s) of subsystems with mode vectors (k, n)."""
        return np.asarray((self.sending @ moved[..., None])[..., 0])


def _moves(member: TransferMember, value: complex, random: np.random.Generator) -> _Moves:
    """Return the mode vectors of subsystems at ζ, with self-feedback and an excitation v each, in chunks.

    (ζ − P) z = Q r + v and r = own N (S z + D r) + others τ, with N = Σ_l ζ^(−l) A_l. Any v works that no
    symmetry of the model makes unobservable.
    """
    p, q, s, d = map(value_of, member.subsystems.maps.blocks)
    n_z, n_r = q.shape[1:]
    k, n_s = s.shape[:2]
    loop = np.zeros((n_r, n_s), np.complex128)
    for lag, picked in lines_of(member.schedule).items():
        loop += value**-lag * member.local[:, None] * picked
    sending = np.concatenate([s, d], axis=-1)
    pushed = np.zeros((k, n_z + n_r, 1))
    pushed[:, :n_z] = random.uniform(0.5, 1.0, (k, n_z, 1))
    received = np.zeros((k, n_z + n_r, n_r))
    received[:, n_z:] = np.diag(member.others)
    driven = np.concatenate([pushed, received], axis=-1)
    weighed = np.concatenate([pushed, sending.swapaxes(1, 2)], axis=-1)
    right = np.empty((k, n_z + n_r, 1 + n_r), np.complex128)
    left = np.empty((k, n_z + n_r, 1 + n_s), np.complex128)
    for start in range(0, k, CHUNK):
        some = slice(start, start + CHUNK)
        top = np.concatenate([p[some], q[some]], axis=-1)
        matrix = np.concatenate([top, loop @ sending[some]], axis=1) * -1.0
        matrix += np.diag([value] * n_z + [1.0] * n_r)
        right[some] = np.linalg.solve(matrix, driven[some])
        left[some] = np.linalg.solve(matrix.swapaxes(1, 2), weighed[some])
    return _Moves(right, left, sending, n_z)


def _waiting(
    weights: Mapping[int, Floats], value: complex, used: Complexes, depth: int, row: int
) -> Complexes:
    """Return the left weights of a row's packets, l = 1 … depth frames old, (depth, k), over all receivers.

    Parameters
    ----------
    weights
        The weights of packets at each line by lag (n_r, n_s).
    value
        ζ.
    used
        The left weights of each line (k, n_r).
    depth, row
        The largest age, and the row of s.
    """
    ages = np.arange(1, depth + 1)
    values = np.zeros((depth, len(used)), np.complex128)
    for lag, weight in weights.items():
        values[:lag] += (value ** (ages[:lag] - lag - 1.0))[:, None] * (used @ weight[:, row])
    return values


def _with_conjugates(modes: Iterable[Mode]) -> tuple[Mode, ...]:
    """Return modes with the conjugate of each that is complex."""
    result = []
    for mode in modes:
        result.append(mode)
        if mode.eigenvalue.imag:
            result.append(replace(mode, eigenvalue=mode.eigenvalue.conjugate()))
    return tuple(result)
