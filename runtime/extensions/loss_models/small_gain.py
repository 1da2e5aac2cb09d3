"""Small-gain bounds on the effect of errors in received values, caused by losses and delays.

Takes: a loop with one packet in effect per tick, and the ticks at which another packet may be in effect.
Gives: `used_rows`; `ratios_of`, `Ratios`; `weight_of`, `Sizes`; `Response`, `change_of_sent`.
Guarantees: matrices have error radii that bound rounding.
Does not: bound the errors of the received values (see `dropout_bounds` and `time_varying_delay`).

Let q[k] be the sent value and d[k] = q[k] − q[k−1]. The value received instead of packet k has an error w, a
sum of some d. The total error at peer i is r_i = Σ_j W_ij w_ij, with ‖r‖ ≤ ‖|W|‖₂ ‖w‖ over all peers. If the
map from d to w has norm at most γ for all packet arrivals, the system is stable if ‖d ← r‖∞ ‖|W|‖₂ γ < 1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, value_of
from apc.spectrum.interconnection import (
    InterconnectionMatrices,
    ModalSystem,
    feedback_of,
    interconnect,
    lay_out_loop,
)
from apc.spectrum.kyp_bounds import peak_gain, proves_gain
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.relative_coordinates import (
    Relative,
    relative,
    relative_coordinates,
    relative_rows,
    with_uncertainty,
)
from apc.spectrum.rigid_modes import find_rigid_modes
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import GAIN_BOUND_STATES
from apc.timing.schedule import CouplingTerm, ReceivedSample

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# The scaling of a peer's state relative to those of others, by link and subsystem.
Sizes = Mapping[tuple[str, str], float]

# The coefficient of each channel in the combined value of receivers, by link and channel.
Ratios = Mapping[tuple[str, str], Fraction]

# The smallest scaling of a peer relative to the largest.
LEAST_UNIT = 1e-6

# Roundings of a norm of few weights, and of what a gain is compared with.
NORM_ROUNDINGS = 1000


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """A, B, C, D of d ← r over relative `coordinates`, with the state of each peer scaled by its unit."""

    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix
    coordinates: Relative

    @property
    def peak(self) -> float:
        """The largest gain over frequency, in floats."""
        return peak_gain(*map(value_of, (self.a, self.b, self.c, self.d)))[0]

    def is_below(self, gain: float) -> bool:
        """Return whether the response is proved stable, with a gain below a level."""
        return proves_gain(self.a, self.b, self.c, self.d, gain)


def used_rows(peer_class: PeerClass, link: str) -> list[tuple[int, ReceivedSample]]:
    """Return the rows of r of a subsystem that receive over a link and affect an output."""
    q, d = value_of(peer_class.lifted.q), value_of(peer_class.lifted.d)
    is_used = np.any(q, axis=0) | np.any(d, axis=0)
    rows = enumerate(peer_class.schedule.received)
    return [
        (line, received) for line, received in rows if received.coupling_term.link == link and is_used[line]
    ]


def change_of_sent(
    modal_system: ModalSystem,
    error_bound: Sequence[tuple[int, Mapping[int, int], float]],
    ratios: Ratios,
    sizes: Sizes,
) -> Response:
    """Return the response of the sent differences, frame by frame, to errors in received values.

    Parameters
    ----------
    modal_system
        A loop that stores each packet for at least one frame.
    error_bound
        The rows of r of a subsystem with a common error, their delays in frames, and their factors.
    ratios, sizes
        From `ratios_of` and `weight_of`.
    """
    layout = lay_out_loop(modal_system)
    if (n := len(layout.names)) > GAIN_BOUND_STATES:
        raise NotSupportedError(
            f"the peers form one system of {n:,} states; the limit is {GAIN_BOUND_STATES}"
        )

    def size(subsystem: int, link: str) -> float:
        """Return the norm of equal unit motions of a subsystem's n peers: √n, or weighted by scaling."""
        return math.sqrt(modal_system.peer_classes[subsystem].count) * sizes.get(
            (link, modal_system.peer_classes[subsystem].name), 1.0
        )

    channels = set()
    entering = []
    for g, lines, times in error_bound:
        received = modal_system.peer_classes[g].schedule.received[next(iter(lines))]
        channels.add((received.sent.link, received.sent.channel))
        # If several values are received as one combination, the first with a nonzero weight is the reference.
        if ratios.get((received.sent.link, received.sent.channel), 1) == 1:
            entering.append((g, lines, times / size(g, received.sent.link)))
    # The state is followed by the delayed errors, and these by the external inputs.
    starts = np.cumsum([n, *(max(lines.values()) for _, lines, _ in entering)]).tolist()
    states = starts[-1]
    feedback = []
    for g, receives in enumerate(feedback_of(modal_system, layout)):
        before = np.zeros((*receives.delayed.shape[:2], states + len(entering)))
        before[..., :n] = receives.delayed
        for index, (subsystem, lines, share) in enumerate(entering):
            for packet_row, delay_frames in lines.items() if subsystem == g else ():
                at = starts[index] + delay_frames - 1 if delay_frames else states + index
                before[:, packet_row, at] = share, 8 * UNIT_ROUNDOFF * share
        feedback.append(InterconnectionMatrices(receives.direct, before))
    closed = interconnect(
        [peer_class.lifted for peer_class in modal_system.peer_classes],
        feedback,
        layout,
        numbers=MIDPOINT_RADIUS,
    )
    senders = [
        (h, row, sent)
        for h, peer_class in enumerate(modal_system.peer_classes)
        for row, sent in enumerate(peer_class.schedule.sent)
    ]
    indices = {(packet.subsystem, packet.row, packet.lag): index for packet, index in layout.indices.items()}
    before, combined = np.zeros_like(closed.sent), dict[tuple[int, str, str], Matrix]()
    for packet_row, (h, row, sent) in enumerate(senders):
        if (sent.link, sent.channel) in channels:
            before[0, packet_row, indices[h, row, 1]] = 1.0
            ratio = ratios.get((sent.link, sent.channel))
            coefficient = float(ratio or 1) * size(h, sent.link)
            number = (h, sent.link, sent.channel if ratio is None else "")
            weight_row = combined.setdefault(number, np.zeros((2, len(senders))))
            weight_row[:, packet_row] = coefficient, 8 * UNIT_ROUNDOFF * abs(coefficient)
    weights = np.array(list(combined.values())).reshape(-1, 2, len(senders)).swapaxes(0, 1)
    output = MIDPOINT_RADIUS.multiply(weights, MIDPOINT_RADIUS.subtract(closed.sent, before))
    matrix = np.zeros((2, states, states + len(entering)))
    matrix[:, :n] = closed.matrix
    for index, (start, end) in enumerate(itertools.pairwise(starts)):
        for at in range(start, end):
            matrix[0, at, at - 1 if at > start else states + index] = 1.0
    basis = find_rigid_modes(modal_system, with_drifts=False).basis
    coordinates = relative_coordinates(np.concatenate([basis, np.zeros((states - n, basis.shape[1]))]))
    bounded_coordinates = with_uncertainty(coordinates)
    return Response(
        relative(matrix[..., :states], bounded_coordinates, MIDPOINT_RADIUS),
        relative_rows(matrix[..., states:], bounded_coordinates, MIDPOINT_RADIUS),
        output[..., coordinates.rest],
        output[..., states:],
        bounded_coordinates,
    )


def ratios_of(peer_classes: Sequence[PeerClass], lossy: frozenset[str]) -> Ratios:
    """Return the ratios of channels that every tick of every subsystem combines into the same number.

    The channels of other links stay separate. The first channel with nonzero weight has the ratio 1.
    """
    result: dict[tuple[str, str], Fraction] = {}
    for link in sorted(lossy):
        columns: dict[str, dict[tuple[int, int, int, CouplingTerm], Fraction]] = {}
        for g, peer_class in enumerate(peer_classes):
            used_channels = {
                (received.coupling_term, received.sent.channel) for _, received in used_rows(peer_class, link)
            }
            for partition, tick in enumerate(peer_class.exact.ticks):
                for receive in range(tick.r.shape[1]):
                    for coupling_term, channel in peer_class.schedule.coupling_terms(partition, receive):
                        if (coupling_term, channel) not in used_channels:
                            continue
                        channel_column = columns.setdefault(channel, {})
                        for row, entry in enumerate(tick.r[:, receive]):
                            if entry:
                                key = (g, partition, row, coupling_term)
                                channel_column[key] = channel_column.get(key, Fraction(0)) + entry
        if not columns or any(
            coupling_term.edge for column in columns.values() for *_, coupling_term in column
        ):
            continue
        base = next(iter(columns.values()))
        ratios = {}
        for channel, channel_column in columns.items():
            index = next(iter(channel_column), None)
            ratio = channel_column[index] / base[index] if index is not None and base.get(index) else None
            if ratio is None or channel_column != {
                key_of_entry: ratio * entry for key_of_entry, entry in base.items()
            }:
                break
            ratios[link, channel] = ratio
        else:
            result |= ratios
    return result


def weight_of(loops: Sequence[ModalSystem], lossy: frozenset[str]) -> tuple[float, Sizes]:
    """Return ‖|W|‖₂, rounded up, and the scalings of peers that minimize it.

    Notes
    -----
    For orthogonal loops the norm of |W| is that of the first loop, in which all peers of a subsystem have
    equal motions; for loops of one subsystem each it is the eigenvalue. Each peer may be scaled separately,
    as channels are homogeneous. With the scaling √(v/u), u and v the Perron vectors of |W| and |W|ᵀ, the norm
    becomes the spectral radius (Stoer and Witzgall, 1962).
    """
    largest = 0.0
    sizes: dict[tuple[str, str], float] = {}
    for link in sorted(lossy):
        used_terms = {
            received.coupling_term
            for modal_system in loops
            for peer_class in modal_system.peer_classes
            for _, received in used_rows(peer_class, link)
        }
        for modal_system in loops if len(loops[0].peer_classes) == 1 else loops[:1]:
            count = np.array([peer_class.count for peer_class in modal_system.peer_classes], np.float64)
            blocks = [
                (np.abs(np.array(rows, np.float64)) + modal_system.weight_errors.get(coupling_term, 0.0))
                * np.sqrt(count[:, None] / count)
                for coupling_term, rows in modal_system.coupling.items()
                if coupling_term in used_terms
            ]
            if not blocks:
                continue
            units = _balancing_units(np.sum(blocks, axis=0))
            sizes |= {
                (link, peer_class.name): unit
                for peer_class, unit in zip(modal_system.peer_classes, units.tolist(), strict=True)
            }
            scaled = np.concatenate([units[:, None] * block / units for block in blocks])
            largest = max(largest, float(np.linalg.norm(scaled, 2)))
    return largest * (1 + NORM_ROUNDINGS * UNIT_ROUNDOFF), sizes


def _balancing_units(weights: Floats) -> Floats:
    """Return the scaling with the smallest norm of a weight matrix; 1 if some peers receive nothing."""
    result = []
    for matrix in (weights, weights.T):
        values, vectors = np.linalg.eig(matrix)
        result.append(np.abs(vectors[:, int(np.argmax(values.real))]))
    if min(float(item.min() / item.max()) for item in result) < LEAST_UNIT:
        return np.ones(len(weights))
    units = np.sqrt(result[1] / result[0])
    return np.asarray(units / units.max())
