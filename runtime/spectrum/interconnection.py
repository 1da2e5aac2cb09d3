"""Interconnection: received values are sums of sent values, and one matrix maps the state of all subsystems.

Takes: peer classes, and their weights for each other's packets.
Gives: `ModalSystem`, `Coupling`, `without_packets`; `DelayedSample`, `StateLayout`, `lay_out`; `ClosedLoop`,
`close_loop`; `InterconnectionMatrices`, `bounded_weight`, `feedback_of`, `interconnect`,
`interconnect_with_inputs`; `lay_out_loop`.
Guarantees: the state contains, for each subsystem, z and then its packets in transit, in order of row and
age. The matrix of `close_loop` comes with an entrywise bound on its rounding error; `interconnect` takes one
system or many (k, …), real or complex.
Does not: derive the weights (see `modes`, `graph_loops`); compute eigenvalues (see `spectrum`).

    r_g = Σ_h W_gh s_h        each packet with its age at the receiver
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import (
    FLOATS,
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Arithmetic,
    common_shape,
    error_radius,
    value_of,
)
from apc.lifting.lift import FrameMap
from apc.spectrum.graph_modes import Surd
from apc.spectrum.peer_classes import PeerClass, states_of
from apc.timing.schedule import CouplingTerm, Schedule

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # float64 or complex128; balls where stated

# The received values of subsystem g from subsystem h in a coupling term: the weight of h's packet.
Coupling = Mapping[CouplingTerm, tuple[tuple[Fraction, ...], ...]]


@dataclass(frozen=True, slots=True)
class ModalSystem:
    """Some subsystems and their mutual weights, `coupling`: a closed system before its matrix is built.

    The complete system contains it `multiplicity` times. `weight_errors` and `surds` as in `ClosedLoop`.
    """

    name: str
    multiplicity: int
    peer_classes: tuple[PeerClass, ...]
    coupling: Coupling
    weight_errors: Mapping[CouplingTerm, float] = field(default_factory=dict)
    surds: Mapping[CouplingTerm, Surd] = field(default_factory=dict)

    @property
    def packets(self) -> tuple[DelayedSample, ...]:
        """The packets in transit, in order of state."""
        return tuple(
            DelayedSample(h, row, lag)
            for h, peer_class in enumerate(self.peer_classes)
            for row, depth in enumerate(peer_class.schedule.depths)
            for lag in range(1, depth + 1)
        )

    @property
    def layout(self) -> StateLayout:
        """The layout of the state, computed on each access."""
        return lay_out_loop(self)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the states."""
        return self.layout.names

    @property
    def states(self) -> int:
        """The number of states."""
        return sum(states_of(peer_class.schedule, peer_class.jacobians) for peer_class in self.peer_classes)


@dataclass(frozen=True, slots=True)
class DelayedSample:
    """A packet in transit: row of s of subsystem `subsystem`, sent `lag` frames ago (1 or more)."""

    subsystem: int
    row: int
    lag: int


@dataclass(frozen=True, slots=True)
class StateLayout:
    """The layout of a closed system's state: start of each subsystem's part, state names, packet indices."""

    offsets: tuple[int, ...]
    names: tuple[str, ...]
    indices: Mapping[DelayedSample, int]  # in order of state

    @property
    def packets(self) -> tuple[DelayedSample, ...]:
        """The packets in transit, in order of state."""
        return tuple(self.indices)


def without_packets(modal_system: ModalSystem) -> ModalSystem:
    """Return the loop without packets in its state: the number of rigid modes is independent of delays."""
    peer_classes = tuple(
        replace(
            peer_class, schedule=replace(peer_class.schedule, depths=(0,) * len(peer_class.schedule.depths))
        )
        for peer_class in modal_system.peer_classes
    )
    return replace(modal_system, peer_classes=peer_classes)


def lay_out(z_names: Sequence[Sequence[str]], schedules: Sequence[Schedule]) -> StateLayout:
    """Return the layout of a state: for each subsystem the names of its z, then the names of its packets."""
    offsets: list[int] = []
    names: list[str] = []
    indices: dict[DelayedSample, int] = {}
    for subsystem, (z_name, schedule) in enumerate(zip(z_names, schedules, strict=True)):
        offsets.append(len(names))
        names += z_name
        numerator, denominator = (
            schedule.quantum * 1000
        ).as_integer_ratio()  # there are thousands of packets
        for row, depth in enumerate(schedule.depths):
            for lag in range(1, depth + 1):
                when = (schedule.sent_times[row] - lag * schedule.frame) * numerator / denominator
                indices[DelayedSample(subsystem, row, lag)] = len(names)
                names.append(f"{schedule.sent_names[row]}({when:.6g} ms)")
    return StateLayout(tuple(offsets), tuple(names), indices)


def lay_out_loop(loop: ModalSystem | ClosedLoop) -> StateLayout:
    """Return the layout of a loop's state; for several subsystems each name includes its peer."""
    peer_classes = loop.peer_classes
    layout = lay_out(
        [peer_class.z_names for peer_class in peer_classes],
        [peer_class.schedule for peer_class in peer_classes],
    )
    if len(peer_classes) == 1:
        return layout
    sizes = np.diff([*layout.offsets, len(layout.names)])
    owners = (
        peer_class.name for peer_class, size in zip(peer_classes, sizes, strict=True) for _ in range(size)
    )
    return replace(
        layout, names=tuple(f"{owner}.{name}" for owner, name in zip(owners, layout.names, strict=True))
    )


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoop:
    """One autonomous system: state⁺ = `matrix` · state, once per frame.

    `layout` describes the state; `motion` are the indices of the continuous states, by subsystem. `error`
    bounds the rounding error of the matrix entry by entry. `received` are the received values of each
    subsystem in a frame, over the state. `weight_errors` bound the errors of the weights of coupling terms;
    `surds`, for one subsystem, are its weights in closed form.
    """

    name: str
    multiplicity: int
    peer_classes: tuple[PeerClass, ...]
    coupling: Coupling
    frame_s: float
    layout: StateLayout
    matrix: Floats  # (n, n)
    error: Floats  # (n, n)
    received: tuple[Floats, ...]  # (n_r, n), one per subsystem
    motion: tuple[int, ...]
    weight_errors: Mapping[CouplingTerm, float] = field(default_factory=dict)
    surds: Mapping[CouplingTerm, Surd] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the states."""
        return self.layout.names

    @property
    def offsets(self) -> tuple[int, ...]:
        """The index of each subsystem's first state."""
        return self.layout.offsets

    @property
    def packets(self) -> tuple[DelayedSample, ...]:
        """The packets in transit, in order of state."""
        return self.layout.packets


def close_loop(loop: ModalSystem | ClosedLoop) -> ClosedLoop:
    """Return the closed loop of K subsystems: r_g = Σ_h W_gh s_h, each packet with its age at arrival."""
    maps = [peer_class.lifted for peer_class in loop.peer_classes]
    layout = lay_out_loop(loop)
    closed = interconnect(maps, feedback_of(loop, layout), layout, numbers=MIDPOINT_RADIUS)
    return ClosedLoop(
        name=loop.name,
        multiplicity=loop.multiplicity,
        peer_classes=loop.peer_classes,
        coupling=loop.coupling,
        frame_s=float(loop.peer_classes[0].schedule.frame_s),
        layout=layout,
        matrix=value_of(closed.matrix),
        error=error_radius(closed.matrix),
        received=tuple(map(value_of, closed.received)),
        motion=tuple(
            offset + index
            for peer_class, offset in zip(loop.peer_classes, layout.offsets, strict=True)
            for index in range(len(peer_class.subsystem.peer_type.states))
        ),
        weight_errors=loop.weight_errors,
        surds=loop.surds,
    )


@dataclass(frozen=True, slots=True, eq=False)
class InterconnectionMatrices:
    """The received values of a subsystem, r = `direct` s + `delayed` x, in floats or with their radii.

    s are the packets that all subsystems send in this frame; x is the state, followed by external inputs if
    `delayed` has more columns.
    """

    direct: Matrix  # (n_r, n_s)
    delayed: Matrix  # (n_r, n)

    @property
    def plain(self) -> InterconnectionMatrices:
        """The matrices without their radii."""
        return InterconnectionMatrices(value_of(self.direct), value_of(self.delayed))


@dataclass(frozen=True, slots=True, eq=False)
class ClosedLoopMatrices:
    """A closed loop over its state and external inputs: the next state, received and sent values."""

    matrix: Matrix  # (n, n) or more columns
    received: tuple[Matrix, ...]  # one per subsystem
    sent: Matrix  # of all subsystems, stacked


def bounded_weight(weight: Fraction, weight_error: float) -> tuple[float, float]:
    """Return a weight as a float, and its error bound: `weight_error` plus the rounding of the conversion."""
    rounded_weight = float(weight)
    is_exact = (
        rounded_weight.as_integer_ratio() == weight.as_integer_ratio()
    )  # comparing a Fraction is far slower
    return rounded_weight, weight_error if is_exact else weight_error + UNIT_ROUNDOFF * abs(rounded_weight)


def feedback_of(loop: ModalSystem | ClosedLoop, layout: StateLayout) -> list[InterconnectionMatrices]:
    """Return the interconnection matrices, each weight with the radius of its error and rounding."""
    row_of = [
        {sent: row for row, sent in enumerate(peer_class.schedule.sent)} for peer_class in loop.peer_classes
    ]
    starts = np.cumsum([0] + [len(peer_class.schedule.sent) for peer_class in loop.peer_classes]).tolist()
    # Few weights at many indices: each is converted once, and plain keys are found faster than packets.
    indices = {(packet.subsystem, packet.row, packet.lag): index for packet, index in layout.indices.items()}
    converted: dict[tuple[int, int, float], tuple[float, float]] = {}
    feedbacks = []
    for g, peer_class in enumerate(loop.peer_classes):
        direct = np.zeros((2, len(peer_class.schedule.received), starts[-1]))
        delayed = np.zeros((2, len(peer_class.schedule.received), len(layout.names)))
        for input_row, received in enumerate(peer_class.schedule.received):
            weight_error = loop.weight_errors.get(received.coupling_term, 0.0)
            columns, weights = [], []
            for h, weight in enumerate(loop.coupling[received.coupling_term][g]):
                if not (weight or weight_error):
                    continue
                key = weight.numerator, weight.denominator, weight_error
                row = row_of[h][received.sent]
                columns.append(indices[h, row, received.lag] if received.lag else starts[h] + row)
                weights.append(
                    converted.get(key) or converted.setdefault(key, bounded_weight(weight, weight_error))
                )
            if columns:
                (delayed if received.lag else direct)[:, input_row, columns] = np.array(weights).T
        feedbacks.append(InterconnectionMatrices(direct, delayed))
    return feedbacks


def interconnect(
    maps: Sequence[FrameMap],
    feedback: Sequence[InterconnectionMatrices],
    layout: StateLayout,
    *,
    numbers: Arithmetic = FLOATS,
) -> ClosedLoopMatrices:
    """Return the matrices of a closed loop, or of many with one layout (k, …).

    Parameters
    ----------
    maps, feedback
        The frame map and the interconnection matrices of each subsystem, real or complex.
    layout
        The layout of the state.
    numbers
        The number type.

    Notes
    -----
    Packets received in the frame in which they are sent form a loop within the frame, s = S z + D r and r =
    W₀ s + …, that is ordered in time: D W₀ is nilpotent, and I − D W₀ is solved exactly in at most as many
    steps as there are packets.
    """
    n, columns = len(layout.names), feedback[0].delayed.shape[-1]
    parts = [block for frame_map in maps for block in frame_map.blocks] + [
        matrices.delayed for matrices in feedback
    ]
    batch_shape = common_shape(*(block.shape[:-2] for block in parts))
    dtype = np.result_type(*parts)
    starts = np.cumsum([0] + [frame_map.s.shape[-2] for frame_map in maps])
    rows = [
        slice(start, start + frame_map.s.shape[-2]) for frame_map, start in zip(maps, starts, strict=False)
    ]
    z = [
        slice(offset, offset + frame_map.p.shape[-1])
        for frame_map, offset in zip(maps, layout.offsets, strict=True)
    ]
    sent = np.zeros((*batch_shape, starts[-1], columns), dtype=dtype)
    for frame_map, connection, row, z_slice in zip(maps, feedback, rows, z, strict=True):
        if numbers.vanishes(frame_map.d):
            sent[..., row, z_slice] = frame_map.s
        else:
            _write_rows(sent[..., row, :], z_slice, frame_map.s, frame_map.d, connection.delayed, numbers)
    has_direct = any(connection.direct.any() for connection in feedback)
    if has_direct:
        direct_loop = np.zeros((*batch_shape, starts[-1], starts[-1]), dtype=dtype)
        for frame_map, connection, row in zip(maps, feedback, rows, strict=True):
            direct_loop[..., row, :] = numbers.multiply(frame_map.d, connection.direct)
        sent = _solve_sent(direct_loop, sent, numbers)
    matrix = np.zeros((*batch_shape, n, columns), dtype=dtype)
    received_values = []
    for frame_map, connection, z_slice in zip(maps, feedback, z, strict=True):
        r = (
            numbers.add(numbers.multiply(connection.direct, sent), connection.delayed)
            if has_direct
            else connection.delayed
        )
        received_values.append(r)
        _write_rows(matrix[..., z_slice, :], z_slice, frame_map.p, frame_map.q, r, numbers)
    unit = numbers.exact(np.array(1))
    for packet, index_of_packet in layout.indices.items():  # the age of each packet increases by a frame
        if packet.lag == 1:
            matrix[..., index_of_packet, :] = sent[..., starts[packet.subsystem] + packet.row, :]
        else:
            matrix[
                ...,
                index_of_packet,
                layout.indices[DelayedSample(packet.subsystem, packet.row, packet.lag - 1)],
            ] = unit
    return ClosedLoopMatrices(matrix, tuple(received_values), sent)


def interconnect_with_inputs(
    loop: ModalSystem | ClosedLoop,
    maps: Sequence[FrameMap],
    external_counts: Sequence[int],
    layout: StateLayout,
    *,
    numbers: Arithmetic = FLOATS,
) -> ClosedLoopMatrices:
    """Return a closed loop with external inputs to its subsystems, over the state and then the inputs.

    Parameters
    ----------
    loop
        The loop.
    maps
        The frame maps of the loop's subsystems, with the external inputs as the last received values.
    external_counts
        The number of inputs of each subsystem.
    layout
        The layout of the state.
    numbers
        The number type of the maps.
    """
    total, first_input = sum(external_counts), 0
    feedback = []
    for count, bounded in zip(external_counts, feedback_of(loop, layout), strict=True):
        matrices = bounded if numbers is MIDPOINT_RADIUS else bounded.plain
        batch_shape = matrices.direct.shape[:-2]
        direct = np.zeros((*batch_shape, matrices.direct.shape[-2] + count, matrices.direct.shape[-1]))
        delayed = np.zeros((*batch_shape, direct.shape[-2], len(layout.names) + total))
        received = matrices.direct.shape[-2]
        direct[..., :received, :], delayed[..., :received, : len(layout.names)] = (
            matrices.direct,
            matrices.delayed,
        )
        columns = len(layout.names) + first_input
        delayed[..., received:, columns : columns + count] = numbers.exact(np.eye(count))
        feedback.append(InterconnectionMatrices(direct, delayed))
        first_input += count
    return interconnect(maps, feedback, layout, numbers=numbers)


def _write_rows(
    rows: Matrix, z: slice, matrix: Matrix, received_matrix: Matrix, received: Matrix, numbers: Arithmetic
) -> None:
    """Write P z + Q r, or S z + D r, of one subsystem into its rows over the state.

    Parameters
    ----------
    rows, z
        The rows, changed in place, and the columns of the subsystem's z.
    matrix, received_matrix
        P and Q, or S and D.
    received
        The received values r as rows over the state.
    numbers
        The number type.
    """
    rows[...] = numbers.multiply(received_matrix, received)
    rows[..., z] = matrix if numbers.vanishes(received[..., z]) else numbers.add(rows[..., z], matrix)


def _solve_sent(direct_loop: Matrix, without_loop: Matrix, numbers: Arithmetic) -> Matrix:
    """Return the sent values (I − D W₀)⁻¹ s₀, with s₀ (`without_loop`) those sent without reception in the
    same frame.
    """
    sent = term = without_loop
    for _ in range(direct_loop.shape[-1]):
        term = numbers.multiply(direct_loop, term)
        if numbers.vanishes(term):
            return sent
        sent = numbers.add(sent, term)
    assert not (np.isfinite(term) & (term != 0)).any(), "a packet is received before it is sent"
    return sent
