"""The spectrum of a population from its characteristic function: bounds, verdict, dominant modes.

Takes: loops with long delays, or populations of different peers on complete graphs.
Gives: `solve_loops`, `solve_populations`; `radius_in_floats`.
Guarantees: as `zeros`: the radius is bounded from both sides, without missed eigenvalues. A radius closer to
1 than its bound is reported as undecided. Rigid modes are determined from the equations.
Does not: list more than the largest modes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import value_of
from apc.spectrum.characteristic import Characteristic, matrices_in, parts_in
from apc.spectrum.determinant import TransferMember, loop_characteristic, population_characteristic
from apc.spectrum.heterogeneous_peers import (
    HeterogeneousGroup,
    close_self_feedback,
    mode_oscillation,
    own_packet_rows,
)
from apc.spectrum.interconnection import ModalSystem, without_packets
from apc.spectrum.rigid_modes import find_rigid_modes
from apc.spectrum.spectrum import Mode, ModeMotion, Spectrum, combine_verdicts
from apc.spectrum.transfer import CHUNK, TransferSubsystems
from apc.spectrum.zeros import Zero, Zeros, find_zeros, largest_zero, near_poles
from apc.timing.communication_graph import CommunicationGraph
from apc.verdict import NO_PROOF

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# The number of modes listed for each system; fewer for many peers, as each needs the shares of all peers.
LISTED, LISTED_OF_MANY, MANY = 5, 1, 20_000

# Number of poles of a population's subsystems near which zeros are searched.
NEAR_POLES = 6

# Number of equal copies of a peer whose spectra provide start values for common zeros.
SAMPLES = 2

# Smaller eigenvalues of the copies are not used as start values; eigenvalues this near to 1 are rigid.
LEAST_START, SAME_START = 0.5, 1e-9

# Zeros of a loop that Newton's method starts from, the largest by their estimate.
STARTS = 64

# The relative offset from an eigenvalue for inverse iteration of its vectors; larger at a pole, where the
# response is large and rounded.
ALONGSIDE, BESIDE_POLE = 1e-13, 1e-10


@dataclass(frozen=True, slots=True)
class _SolvedSystem:
    """The zeros and modes of one independent system, with its numbers of rigid modes and drifts."""

    zeros: Zeros
    rigid: int
    drifts: int
    modes: tuple[Mode, ...]


def solve_loops(loops: Sequence[ModalSystem]) -> Spectrum:
    """Return the spectrum of independent loops, with delays of any length.

    Parameters
    ----------
    loops
        The loops, each counted with its multiplicity.
    """
    return _spectrum(
        [_solve_loop(modal_system) for modal_system in loops],
        [modal_system.multiplicity for modal_system in loops],
    )


def radius_in_floats(loops: Sequence[ModalSystem]) -> float:
    """Return the spectral radius of independent loops in floats, on its true side of 1; NaN if unknown.

    Parameters
    ----------
    loops
        The loops.
    """
    radii = []
    for modal_system in loops:
        function, _ = loop_characteristic(
            modal_system.peer_classes, modal_system.coupling, modal_system.weight_errors
        )
        rigid = len(find_rigid_modes(without_packets(modal_system), with_drifts=False).names)
        radii.append(largest_zero(function, _loop_starts(function), rigid=rigid))
    return float(np.max(radii))  # NaN if one is


def solve_populations(
    populations: Sequence[HeterogeneousGroup], comm_graph: CommunicationGraph, *, rigid: int
) -> Spectrum:
    """Return the spectrum of different peers on complete graphs.

    Parameters
    ----------
    populations
        All peers.
    comm_graph
        The links, all of them complete.
    rigid
        The number of common translations, from the equations (see `translation`).
    """
    function, members = population_characteristic(populations, comm_graph)
    peers = int(sum(len(population.parameters) for population in populations))
    zeros = find_zeros(
        function,
        _common_starts(members),
        rigid=rigid,
        listed=LISTED_OF_MANY if peers > MANY else LISTED,
        near=NEAR_POLES,
    )
    modes = [
        _mode_of_zero(function, members, zero, "different peers", 1)
        if zero.subsystem is None
        else _single_peer_mode(members, zero)
        for zero in zeros.zeros
    ]
    return _spectrum([_SolvedSystem(zeros, rigid, 0, _with_conjugates(modes))], [1])


def _spectrum(solved: Sequence[_SolvedSystem], multiplicities: Sequence[int]) -> Spectrum:
    """Return the spectrum of a model from its independent systems."""
    modes = sorted(
        (mode for item in solved for mode in item.modes),
        key=lambda mode: (-mode.magnitude, mode.family, mode.eigenvalue.real, -mode.eigenvalue.imag),
    )
    low = max(item.zeros.low for item in solved)
    high = max(item.zeros.high for item in solved)
    radius = max(item.zeros.radius for item in solved)
    rigid = sum(item.rigid * multiplicity for item, multiplicity in zip(solved, multiplicities, strict=True))
    drifts = sum(
        item.drifts * multiplicity for item, multiplicity in zip(solved, multiplicities, strict=True)
    )
    inside = [False if item.zeros.low > 1 else True if item.zeros.high < 1 else None for item in solved]
    verdict = combine_verdicts(inside, rigid, drifts)
    notes = ["the largest modes only; the argument principle excludes larger ones"]
    if not all(item.zeros.counted for item in solved):
        notes = [
            "the largest modes found; the argument principle excludes larger ones only outside a wider circle"
        ]
    error = max(high - radius, radius - low, 0.0)
    return Spectrum(tuple(modes), radius, error, rigid, drifts, verdict, NO_PROOF, tuple(notes))


def _solve_loop(modal_system: ModalSystem) -> _SolvedSystem:
    """Return the zeros and the largest modes of a loop."""
    function, members = loop_characteristic(
        modal_system.peer_classes, modal_system.coupling, modal_system.weight_errors
    )
    without_delays = without_packets(modal_system)
    rigid, drifts = len(find_rigid_modes(without_delays, with_drifts=False).names), 0
    starts = _loop_starts(function)
    zeros = find_zeros(function, starts, rigid=rigid, listed=LISTED, near=0)
    if (
        rigid
        and np.isfinite(zeros.high)
        and not zeros.rigid_counted
        and (drifts := find_rigid_modes(modal_system).drifts)
    ):
        zeros = find_zeros(function, starts, rigid=rigid + drifts, listed=LISTED, near=0)
    modes = _with_conjugates(
        _mode_of_zero(function, members, zero, modal_system.name, modal_system.multiplicity)
        for zero in zeros.zeros
    )
    return _SolvedSystem(zeros, rigid, drifts, modes)


def _loop_starts(function: Characteristic) -> Complexes:
    """Return approximate zeros of a loop with a long delay d.

    With an eigenvalue k of T(ζ) W(ζ) ζ^d, f has a zero if ζ^d = k(ζ): near the unit circle ζ is |k|^(1/d)
    times a d-th root of 1, rotated by the d-th part of the angle of k.
    """
    delay = max(1, function.longest)
    rotations = np.arange(delay // 2 + 1)
    on_circle = np.exp(2j * np.pi * rotations / delay) * (1 + 1e-9)
    loop_gain = (
        np.eye(function.transfer.shape[0]) - matrices_in(function, on_circle, np.zeros(len(rotations)))[:, 0]
    )
    finite = np.isfinite(loop_gain).all(axis=(1, 2))  # where a frame grows by many decades, it overflows
    loop_gain, rotations, on_circle = loop_gain[finite], rotations[finite], on_circle[finite]
    gain = np.linalg.eigvals(loop_gain) * (on_circle**delay)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        logarithm = (np.log(gain) + 2j * np.pi * rotations[:, None]) / delay
    starts = np.exp(logarithm).ravel()
    largest = np.sort(np.abs(starts[np.isfinite(starts)]))[-STARTS:] if len(starts) else starts
    starts = starts[np.abs(starts) >= largest.min(initial=np.inf)]
    poles = near_poles(function, NEAR_POLES)
    return np.concatenate([starts, poles * (1 + 1e-3), poles * (1 - 1e-3)])


def _common_starts(members: Sequence[TransferMember]) -> Complexes:
    """Return the eigenvalues of populations of equal copies of a peer, for some peers, as approximate
    common modes.
    """
    result = [np.zeros(0, np.complex128)]
    for member in members:
        samples = np.unique(np.linspace(0, len(member.subsystems.counts) - 1, SAMPLES).astype(np.int64))
        frame_map = member.subsystems.maps.mapped(lambda block, samples=samples: block[samples])
        copies = close_self_feedback(
            frame_map, member.schedule, member.total_weights, 0 * member.total_weights
        )
        matrices = value_of(copies.p)
        matrices = matrices[np.isfinite(matrices).all(axis=(1, 2))]
        values = np.linalg.eigvals(matrices).astype(np.complex128).ravel()
        is_start = (values.imag >= 0) & (np.abs(values) > LEAST_START) & (np.abs(values - 1) > SAME_START)
        result.append(values[is_start])
    return np.concatenate(result)


def _single_peer_mode(members: Sequence[TransferMember], zero: Zero) -> Mode:
    """Return the mode of a single peer's eigenvalue: a difference mode, or that of a peer without
    receivers.
    """
    assert zero.subsystem is not None
    which, row = zero.subsystem
    item, subsystems = members[which], members[which].subsystems
    single = TransferSubsystems(
        subsystems.maps.mapped(lambda block: block[row : row + 1]),
        *(np.ones(1), np.arange(len(subsystems.rows)), np.arange(len(subsystems.lines))),
    )
    member = replace(item, subsystems=single, subsystem=lambda _: item.subsystem(row))
    return _mode_of_zero(None, [member], zero, f"{item.name} alone", zero.multiplicity)


def _mode_of_zero(
    function: Characteristic | None,
    members: Sequence[TransferMember],
    zero: Zero,
    family: str,
    multiplicity: int,
) -> Mode:
    """Return the mode of a zero; participations are summed over a population's peers and a channel's packets.

    Parameters
    ----------
    function
        f, None without coupling.
    members
        All members.
    zero
        A zero of f, or a pole that is an eigenvalue.
    family, multiplicity
        The family and the multiplicity of the mode, as in `Mode`.

    Notes
    -----
    Inverse iteration with a small excitation of all states. It also applies if I − T W has no null vector, at
    a pole that is an eigenvalue. Let the uncoupled subsystems send s₁, with left weights t₁. The coupled
    subsystems send s = (I − T W)⁻¹ s₁, and their left weights of received values are t = t₁ (I − W T)⁻¹.
    """
    value = zero.value * (1 + (BESIDE_POLE if zero.subsystem else ALONGSIDE))
    random = np.random.default_rng(0)
    vectors_of = [_mode_vectors(member, value, random) for member in members]
    n_s = 1 + max((int(row) for member in members for row in member.subsystems.rows), default=-1)
    n_r = 1 + max((int(line) for member in members for line in member.subsystems.lines), default=-1)
    transfer_values, receiving = np.zeros((n_s, n_r), np.complex128), np.zeros((n_r, n_s), np.complex128)
    if function is not None:
        transfer_values, receiving = (
            part[0, 0] for part in parts_in(function, np.array([value]), np.zeros(1))
        )
    uncoupled_sent, uncoupled_weights = np.zeros(n_s, np.complex128), np.zeros(n_r, np.complex128)
    for member, vectors in zip(members, vectors_of, strict=True):
        uncoupled_sent[member.subsystems.rows] += member.subsystems.counts @ vectors.sends(
            vectors.right[..., 0]
        )
        uncoupled_weights[member.subsystems.lines] += member.subsystems.counts @ (
            member.other_weights * vectors.left[:, vectors.n_z :, 0]
        )
    sent = np.linalg.solve(np.eye(n_s) - transfer_values @ receiving, uncoupled_sent)
    received_weights = np.linalg.solve(
        (np.eye(n_r) - receiving @ transfer_values).T, uncoupled_weights
    ).astype(np.complex128)
    received, weight = receiving @ sent, received_weights @ receiving
    weights = {} if function is None else dict(zip(function.lags.tolist(), function.weights, strict=True))
    shares: dict[str, float] = {}
    most, oscillation = -1.0, (0.0, 1.0)
    for member, vectors in zip(members, vectors_of, strict=True):
        subsystems, schedule, n_z = member.subsystems, member.schedule, vectors.n_z
        right = vectors.right[..., 0] + vectors.right[..., 1:] @ received[subsystems.lines]
        left = vectors.left[..., 0] + vectors.left[..., 1:] @ weight[subsystems.rows]
        z, r, w, mu = right[:, :n_z], right[:, n_z:], left[:, :n_z], left[:, n_z:]
        prefix = f"{member.name}." if len(members) > 1 else ""
        participation = np.abs(w * z)
        listed = dict(zip(member.z_names, subsystems.counts @ participation, strict=True))
        own_weights = {
            lag: member.own_weights[:, None] * selection
            for lag, selection in own_packet_rows(schedule).items()
        }
        packets = vectors.sends(right)
        for row, (name, depth) in enumerate(zip(schedule.sent_names, schedule.depths, strict=True)):
            by_others = _packet_weights(weights, value, received_weights[None], depth, subsystems.rows[row])
            weights_of_packets = _packet_weights(own_weights, value, mu, depth, row) + by_others
            packet_weights = weights_of_packets * value ** -np.arange(1.0, depth + 1)[:, None]
            listed[name] = (
                listed.get(name, 0.0)
                + np.abs(packet_weights * packets[:, row]).sum(axis=0) @ subsystems.counts
            )
        for name, share in listed.items():
            shares[prefix + name] = shares.get(prefix + name, 0.0) + float(share)
        peer = int(np.argmax(participation.sum(axis=1)))
        if float(participation[peer].sum()) > most:
            most = float(participation[peer].sum())
            oscillation = mode_oscillation(
                member.subsystem(peer), schedule, zero.value, z[peer], r[peer], w[peer]
            )
    total = sum(shares.values()) or 1.0
    motion = ModeMotion(*oscillation, tuple((name, share / total) for name, share in shares.items()))
    return Mode(zero.value, abs(zero.value), multiplicity, family, zero.error, (motion,))


@dataclass(frozen=True, slots=True, eq=False)
class _ModeVectors:
    """Mode vectors of subsystems at ζ: `right` (k, n, 1 + n_r), states z and r for the excitation and for
    each τ.

    `left` (k, n, 1 + n_s) are the left vectors, for the excitation and for each packet weight; `sending` (k,
    n_s, n) is [S D].
    """

    right: Complexes
    left: Complexes
    sending: Floats
    n_z: int

    def sends(self, vectors: Complexes) -> Complexes:
        """Return the sent values (k, n_s) of subsystems with mode vectors (k, n)."""
        return np.asarray((self.sending @ vectors[..., None])[..., 0])


def _mode_vectors(member: TransferMember, value: complex, random: np.random.Generator) -> _ModeVectors:
    """Return the mode vectors of subsystems at ζ, with self-feedback and an excitation v for each.

    (ζ − P) z = Q r + v and r = own N (S z + D r) + others τ, with N = Σ_l ζ^(−l) A_l. Any v works that no
    symmetry of the model makes unobservable.
    """
    p, q, s, d = map(value_of, member.subsystems.maps.blocks)
    n_z, n_r = q.shape[1:]
    k, n_s = s.shape[:2]
    loop = np.zeros((n_r, n_s), np.complex128)
    for lag, selection in own_packet_rows(member.schedule).items():
        loop += value**-lag * member.own_weights[:, None] * selection
    sending = np.concatenate([s, d], axis=-1)
    excitation = np.zeros((k, n_z + n_r, 1))
    excitation[:, :n_z] = random.uniform(0.5, 1.0, (k, n_z, 1))
    received = np.zeros((k, n_z + n_r, n_r))
    received[:, n_z:] = np.diag(member.other_weights)
    right_inputs = np.concatenate([excitation, received], axis=-1)
    left_inputs = np.concatenate([excitation, sending.swapaxes(1, 2)], axis=-1)
    right = np.empty((k, n_z + n_r, 1 + n_r), np.complex128)
    left = np.empty((k, n_z + n_r, 1 + n_s), np.complex128)
    for start in range(0, k, CHUNK):
        chunk = slice(start, start + CHUNK)
        top = np.concatenate([p[chunk], q[chunk]], axis=-1)
        matrix = np.concatenate([top, loop @ sending[chunk]], axis=1) * -1.0
        matrix += np.diag([value] * n_z + [1.0] * n_r)
        right[chunk] = np.linalg.solve(matrix, right_inputs[chunk])
        left[chunk] = np.linalg.solve(matrix.swapaxes(1, 2), left_inputs[chunk])
    return _ModeVectors(right, left, sending, n_z)


def _packet_weights(
    weights: Mapping[int, Floats], value: complex, line_weights: Complexes, depth: int, row: int
) -> Complexes:
    """Return the left weights of a row's packets, l = 1 … depth frames old, (depth, k), over all receivers.

    Parameters
    ----------
    weights
        The weights of packets for each entry of r by lag (n_r, n_s).
    value
        ζ.
    line_weights
        The left weights of each entry of r (k, n_r).
    depth, row
        The largest age, and the row of s.
    """
    ages = np.arange(1, depth + 1)
    values = np.zeros((depth, len(line_weights)), np.complex128)
    for lag, weight in weights.items():
        values[:lag] += (value ** (ages[:lag] - lag - 1.0))[:, None] * (line_weights @ weight[:, row])
    return values


def _with_conjugates(modes: Iterable[Mode]) -> tuple[Mode, ...]:
    """Return modes, each complex one followed by its conjugate."""
    result = []
    for mode in modes:
        result.append(mode)
        if mode.eigenvalue.imag:
            result.append(replace(mode, eigenvalue=mode.eigenvalue.conjugate()))
    return tuple(result)
