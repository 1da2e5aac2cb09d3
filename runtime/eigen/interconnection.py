"""Interconnection: received values are sums of sent values, and one matrix maps the state of all subsystems.

Takes: groups of equal peers, and their weights for each other's packets.
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

from apc.eigen.graph_modes import Surd
from apc.eigen.peer_classes import PeerClass, states_of
from apc.frame.interval_arithmetic import (
    FLOATS,
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Arithmetic,
    common_shape,
    error_radius,
    value_of,
)
from apc.frame.lift import FrameMap
from apc.frame.schedule import CouplingTerm, Schedule

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
    subsystems: tuple[PeerClass, ...]
    coupling: Coupling
    weight_errors: Mapping[CouplingTerm, float] = field(default_factory=dict)
    surds: Mapping[CouplingTerm, Surd] = field(default_factory=dict)

    @property
    def packets(self) -> tuple[DelayedSample, ...]:
        """The packets in transit, in order of state."""
        return tuple(
            DelayedSample(h, row, lag)
            for h, group in enumerate(self.subsystems)
            for row, depth in enumerate(group.schedule.depths)
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
        return sum(states_of(group.schedule, group.jacobians) for group in self.subsystems)


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


def without_packets(loop: ModalSystem) -> ModalSystem:
    """Return the loop without packets in its state: the number of rigid modes is independent of delays."""
    subsystems = tuple(
        replace(group, schedule=replace(group.schedule, depths=(0,) * len(group.schedule.depths)))
        for group in loop.subsystems
    )
    return replace(loop, subsystems=subsystems)


def lay_out(z_names: Sequence[Sequence[str]], schedules: Sequence[Schedule]) -> StateLayout:
    """Return the layout of a state: for each subsystem the names of its z, then its packets."""
    offsets: list[int] = []
    names: list[str] = []
    indices: dict[DelayedSample, int] = {}
    for subsystem, (z_name, schedule) in enumerate(zip(z_names, schedules, strict=True)):
        offsets.append(len(names))
        names += z_name
        over, under = (schedule.quantum * 1000).as_integer_ratio()  # there are thousands of packets
        for row, depth in enumerate(schedule.depths):
            for lag in range(1, depth + 1):
                when = (schedule.sent_times[row] - lag * schedule.frame) * over / under
                indices[DelayedSample(subsystem, row, lag)] = len(names)
                names.append(f"{schedule.sent_names[row]}({when:.6g} ms)")
    return StateLayout(tuple(offsets), tuple(names), indices)


def lay_out_loop(loop: ModalSystem | ClosedLoop) -> StateLayout:
    """Return the layout of a loop's state; with several subsystems, each name includes its peer."""
    groups = loop.subsystems
    layout = lay_out([group.z_names for group in groups], [group.schedule for group in groups])
    if len(groups) == 1:
        return layout
    sizes = np.diff([*layout.offsets, len(layout.names)])
    owners = (group.name for group, size in zip(groups, sizes, strict=True) for _ in range(size))
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
    subsystems: tuple[PeerClass, ...]
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
    maps = [group.lifted for group in loop.subsystems]
    layout = lay_out_loop(loop)
    closed = interconnect(maps, feedback_of(loop, layout), layout, numbers=MIDPOINT_RADIUS)
    return ClosedLoop(
        name=loop.name,
        multiplicity=loop.multiplicity,
        subsystems=loop.subsystems,
        coupling=loop.coupling,
        frame_s=float(loop.subsystems[0].schedule.frame_s),
        layout=layout,
        matrix=value_of(closed.matrix),
        error=error_radius(closed.matrix),
        received=tuple(map(value_of, closed.received)),
        motion=tuple(
            offset + index
            for group, offset in zip(loop.subsystems, layout.offsets, strict=True)
            for index in range(len(group.subsystem.peer_type.states))
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
    """Return a weight as a float and its error bound: the given one, and the rounding if there is any."""
    known = float(weight)
    is_exact = known.as_integer_ratio() == weight.as_integer_ratio()  # comparing a Fraction is far slower
    return known, weight_error if is_exact else weight_error + UNIT_ROUNDOFF * abs(known)


def feedback_of(loop: ModalSystem | ClosedLoop, layout: StateLayout) -> list[InterconnectionMatrices]:
    """Return the interconnection matrices, each weight with the radius of its error and rounding."""
    row_of = [{sent: row for row, sent in enumerate(group.schedule.sent)} for group in loop.subsystems]
    starts = np.cumsum([0] + [len(group.schedule.sent) for group in loop.subsystems]).tolist()
    # Few weights at many indices: each is converted once, and plain keys are found faster than packets.
    indices = {(packet.subsystem, packet.row, packet.lag): index for packet, index in layout.indices.items()}
    known: dict[tuple[int, int, float], tuple[float, float]] = {}
    feedbacks = []
    for g, group in enumerate(loop.subsystems):
        now = np.zeros((2, len(group.schedule.received), starts[-1]))
        before = np.zeros((2, len(group.schedule.received), len(layout.names)))
        for line, received in enumerate(group.schedule.received):
            weight_error = loop.weight_errors.get(received.coupling_term, 0.0)
            columns, weights = [], []
            for h, weight in enumerate(loop.coupling[received.coupling_term][g]):
                if not (weight or weight_error):
                    continue
                key = weight.numerator, weight.denominator, weight_error
                row = row_of[h][received.sent]
                columns.append(indices[h, row, received.lag] if received.lag else starts[h] + row)
                weights.append(known.get(key) or known.setdefault(key, bounded_weight(weight, weight_error)))
            if columns:
                (before if received.lag else now)[:, line, columns] = np.array(weights).T
        feedbacks.append(InterconnectionMatrices(now, before))
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
        The maps of each subsystem, over real or complex numbers.
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
    parts = [block for frame_map in maps for block in frame_map.blocks] + [item.delayed for item in feedback]
    many = common_shape(*(block.shape[:-2] for block in parts))
    number = np.result_type(*parts)
    starts = np.cumsum([0] + [frame_map.s.shape[-2] for frame_map in maps])
    rows = [
        slice(start, start + frame_map.s.shape[-2]) for frame_map, start in zip(maps, starts, strict=False)
    ]
    z = [
        slice(offset, offset + frame_map.p.shape[-1])
        for frame_map, offset in zip(maps, layout.offsets, strict=True)
    ]
    sent = np.zeros((*many, starts[-1], columns), dtype=number)
    for frame_map, received, row, index in zip(maps, feedback, rows, z, strict=True):
        if numbers.vanishes(frame_map.d):
            sent[..., row, index] = frame_map.s
        else:
            _put(sent[..., row, :], index, frame_map.s, frame_map.d, received.delayed, numbers)
    at_once = any(received.direct.any() for received in feedback)
    if at_once:
        within = np.zeros((*many, starts[-1], starts[-1]), dtype=number)
        for frame_map, received, row in zip(maps, feedback, rows, strict=True):
            within[..., row, :] = numbers.multiply(frame_map.d, received.direct)
        sent = _sent_in_turn(within, sent, numbers)
    matrix = np.zeros((*many, n, columns), dtype=number)
    input_rows = []
    for frame_map, received, index in zip(maps, feedback, z, strict=True):
        r = (
            numbers.add(numbers.multiply(received.direct, sent), received.delayed)
            if at_once
            else received.delayed
        )
        input_rows.append(r)
        _put(matrix[..., index, :], index, frame_map.p, frame_map.q, r, numbers)
    unit = numbers.exact(np.array(1))
    for packet, at in layout.indices.items():  # each grows older by a frame
        if packet.lag == 1:
            matrix[..., at, :] = sent[..., starts[packet.subsystem] + packet.row, :]
        else:
            matrix[..., at, layout.indices[DelayedSample(packet.subsystem, packet.row, packet.lag - 1)]] = (
                unit
            )
    return ClosedLoopMatrices(matrix, tuple(input_rows), sent)


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
        The maps of its subsystems, with the external inputs as the last received values.
    external_counts
        The number of inputs of each subsystem.
    layout
        The layout of the state.
    numbers
        The number type of the maps.
    """
    total, first = sum(external_counts), 0
    feedback = []
    for many, known in zip(external_counts, feedback_of(loop, layout), strict=True):
        plain = known if numbers is MIDPOINT_RADIUS else known.plain
        around = plain.direct.shape[:-2]
        now = np.zeros((*around, plain.direct.shape[-2] + many, plain.direct.shape[-1]))
        before = np.zeros((*around, now.shape[-2], len(layout.names) + total))
        received = plain.direct.shape[-2]
        now[..., :received, :], before[..., :received, : len(layout.names)] = plain.direct, plain.delayed
        columns = len(layout.names) + first
        before[..., received:, columns : columns + many] = numbers.exact(np.eye(many))
        feedback.append(InterconnectionMatrices(now, before))
        first += many
    return interconnect(maps, feedback, layout, numbers=numbers)


def _put(
    rows: Matrix, z: slice, matrix: Matrix, of_received: Matrix, received: Matrix, numbers: Arithmetic
) -> None:
    """Write the products with a subsystem's own z and its received values into its rows over the state."""
    rows[...] = numbers.multiply(of_received, received)
    rows[..., z] = matrix if numbers.vanishes(received[..., z]) else numbers.add(rows[..., z], matrix)


def _sent_in_turn(within: Matrix, alone: Matrix, numbers: Arithmetic) -> Matrix:
    """Return (1 − D W₀)⁻¹ times the values sent without reception in this frame; NaN where a part is."""
    sent = term = alone
    for _ in range(within.shape[-1]):
        term = numbers.multiply(within, term)
        if numbers.vanishes(term):
            return sent
        sent = numbers.add(sent, term)
    assert not (np.isfinite(term) & (term != 0)).any(), "a packet is heard before it is sent"
    return sent
