"""Stability over recorded delays that repeat periodically: the product of frame maps over a period.

Takes: a model all of whose unreliable links have a `trace`.
Gives: `trace_radius`, `TraceGrowth`; `Packets`.
Guarantees: the result is deterministic: after the first packets, each frame receives the same packets as in
`simulate`.
Does not: support substituted values, or a trace of losses only.

The trace determines the packet in effect at each tick. Every frame of a period is therefore a loop as with an
ideal network, with packets of other ages. The map of a period is the product of the frame maps.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, error_radius, value_of, with_error_radius
from apc.lifting.numeric_model import NumericModel
from apc.mean_square.class_moments import PerTickReception, build_reception, instants
from apc.network.packet_schedule import instant_of
from apc.spectrum.eigenpairs import largest_magnitudes
from apc.spectrum.enclosure import enclose_eigenvalues
from apc.spectrum.interconnection import ModalSystem, feedback_of, interconnect, lay_out_loop
from apc.spectrum.modes import decompose
from apc.spectrum.relative_coordinates import Relative, relative, relative_coordinates, with_uncertainty
from apc.spectrum.rigid_modes import find_rigid_modes
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import MATRIX_STATES
from apc.timing.schedule import ReceivedSample, SentSample, UncertainSample

Floats = NDArray[np.float64]
Balls = NDArray[Any]  # of numbers with their radii

# The limit of frames in a period, which are multiplied one by one.
MOST_FRAMES = 20_000


@dataclass(frozen=True, slots=True)
class TraceGrowth:
    """The growth of motions per frame: proved bounds, an estimate, and its difference from a second
    estimate.
    """

    low: float
    high: float
    radius: float
    uncertainty: float
    frames: int


class Packets:
    """The packets of a model, numbered from the first of the present frame, and the ticks that use them.

    `slots` is the number of packets per frame on each link.
    """

    def __init__(self, model: Model, reception: PerTickReception) -> None:
        if several := [link.name for link in model.links if len(link.clocks) > 1]:
            raise NotSupportedError(f"pairs of groups of {several[0]} have different clocks")
        self.reception = reception
        self.rows = dict.fromkeys(row for rows in reception.rows.values() for row in rows)
        self.links = {link.name: link for link in model.links}
        self.times = {clock.name: instants(reception, clock) for clock in model.clocks}
        self.slots = {name: len(self.times[link.clock]) for name, link in self.links.items()}

    def received(
        self, row: UncertainSample, delay: Fraction | None = None, trace: Floats | None = None
    ) -> list[int]:
        """Return the number of the packet in effect at a tick, frame by frame over a period.

        Parameters
        ----------
        row
            The coupling term and its tick.
        delay
            The delay of all packets in seconds, unless it is the nominal one.
        trace
            Periodic delays that replace the nominal delay, in seconds, infinite for a lost packet.
        """
        link, reception, slots = (
            self.links[row.coupling_term.link],
            self.reception,
            self.slots[row.coupling_term.link],
        )
        sent, tick = self.times[link.clock], self.times[row.clock][row.tick]
        delays: list[Fraction | None] = [
            reception.timings[row.coupling_term.delay] if delay is None else delay
        ]
        if trace is not None:
            finite = np.isfinite(trace).tolist()
            pairs = zip(trace.tolist(), finite, strict=True)
            delays = [
                instant_of(packet_delay, reception.quantum) if arrives else None
                for packet_delay, arrives in pairs
            ]
        longest = max(packet_delay for packet_delay in delays if packet_delay is not None)
        newest = link.channel is None or link.channel.reorder == "newest"
        numbers = []
        for frame in range(_frames_per_period(len(delays), slots)):
            best: tuple[Fraction, int] | None = None
            for number in itertools.count(slots - 1, -1):
                frames_ago, slot = divmod(number, slots)
                sent_at = sent[slot] + frames_ago * reception.frame
                if best is not None and (newest or sent_at + longest < best[0]):
                    break  # earlier packets cannot arrive later
                packet_delay = delays[(frame * slots + number) % len(delays)]
                if (
                    packet_delay is None
                    or sent_at + packet_delay > tick
                    or (sent_at + packet_delay == tick and reception.strictly)
                    or (sent_at == tick and link.after)
                ):
                    continue
                best = max(best or (sent_at + packet_delay, number), (sent_at + packet_delay, number))
            assert best is not None
            numbers.append(best[1])
        return numbers

    def depths(self, numbers: Iterable[tuple[UncertainSample, int]], least: int = 0) -> dict[str, int]:
        """Return the number of frames for which the packets of each link are stored, for given packets in
        effect.
        """
        depths = dict.fromkeys(self.links, least)
        for row, number in numbers:
            depths[row.coupling_term.link] = max(
                depths[row.coupling_term.link], -(number // self.slots[row.coupling_term.link])
            )
        return depths

    def loop(
        self, modal_system: ModalSystem, numbers: Mapping[UncertainSample, int], depths: Mapping[str, int]
    ) -> ModalSystem:
        """Return a loop whose ticks receive the packets of the given numbers."""
        peer_classes = []
        for peer_class, rows in zip(modal_system.peer_classes, self.reception.of(modal_system), strict=True):
            received = []
            for row in rows:
                frames, slot = divmod(numbers[row], self.slots[row.coupling_term.link])
                received.append(
                    ReceivedSample(
                        row.coupling_term, SentSample(row.coupling_term.link, row.channel, slot), -frames
                    )
                )
            stored = tuple(depths[sent.link] for sent in peer_class.schedule.sent)
            peer_classes.append(
                replace(
                    peer_class, schedule=replace(peer_class.schedule, received=tuple(received), depths=stored)
                )
            )
        return replace(modal_system, peer_classes=tuple(peer_classes))


def trace_radius(numeric: NumericModel) -> TraceGrowth:
    """Return the mean growth of motions per frame, over a period of the recorded delays.

    Parameters
    ----------
    numeric
        The model with its parameter values.

    Raises
    ------
    NotSupportedError
        The period or the delays are too long.
    """
    packets = Packets(numeric.model, build_reception(numeric))
    traces = {name: link.channel.trace for name, link in packets.links.items() if link.channel}
    lengths = {name: 1 if trace is None else len(trace) for name, trace in traces.items()}
    used_links = {row.coupling_term.link for row in packets.rows}
    frames = math.lcm(*(_frames_per_period(lengths.get(name, 1), packets.slots[name]) for name in used_links))
    if frames > MOST_FRAMES:
        message = f"the recorded delays repeat after {frames:,} frames"
        raise NotSupportedError(f"{message}; the limit is {MOST_FRAMES:,}")
    received = {row: packets.received(row, trace=traces.get(row.coupling_term.link)) for row in packets.rows}
    depths = packets.depths((row, number) for row, numbers in received.items() for number in numbers)
    result = []
    for modal_system in decompose(packets.reception.peer_classes, packets.reception.comm_graph).loops:
        stored = sum(
            depths[sent.link] for peer_class in modal_system.peer_classes for sent in peer_class.schedule.sent
        )
        if stored + sum(len(peer_class.z_names) for peer_class in modal_system.peer_classes) > MATRIX_STATES:
            raise NotSupportedError("the recorded delays exceed the supported length")
        result.append(_period_growth(modal_system, packets, received, depths, frames))
    low, high, radius, uncertainty = np.array(result).max(axis=0).tolist()
    return TraceGrowth(low, high, radius, uncertainty, frames)


def _frames_per_period(delays: int, slots: int) -> int:
    """Return the period in frames of a periodic sequence of delays."""
    return math.lcm(delays, slots) // slots


def _period_growth(
    modal_system: ModalSystem,
    packets: Packets,
    received: Mapping[UncertainSample, Sequence[int]],
    depths: Mapping[str, int],
    frames: int,
) -> tuple[float, float, float, float]:
    """Return bounds on the growth of a loop per frame, an estimate, and its difference from a second
    estimate.

    Parameters
    ----------
    modal_system, packets
        The loop, and the packets of the model.
    received
        The packet in effect at each tick, frame by frame over a period.
    depths, frames
        The number of frames for which packets of each link are stored, and the number of frames in a period.
    """
    frame_maps: dict[tuple[int, ...], Balls] = {}
    coordinates: Relative | None = None
    rows = dict.fromkeys(row for loop_rows in packets.reception.of(modal_system) for row in loop_rows)
    # The eigenvalues of a product are those of its halves in either order, with other roundings.
    halves: list[Balls] = []
    scale = 0
    for frame in range(frames):
        numbers = tuple(received[row][frame % len(received[row])] for row in rows)
        if numbers not in frame_maps:
            frame_loop = packets.loop(modal_system, dict(zip(rows, numbers, strict=True)), depths)
            layout = lay_out_loop(frame_loop)
            maps = [peer_class.lifted for peer_class in frame_loop.peer_classes]
            matrix = interconnect(
                maps, feedback_of(frame_loop, layout), layout, numbers=MIDPOINT_RADIUS
            ).matrix
            if coordinates is None:
                coordinates = with_uncertainty(
                    relative_coordinates(find_rigid_modes(frame_loop, with_drifts=False).basis)
                )
            frame_maps[numbers] = relative(matrix, coordinates, MIDPOINT_RADIUS)
        if frame in (0, frames // 2):
            halves.append(frame_maps[numbers])
        else:
            product = MIDPOINT_RADIUS.multiply(frame_maps[numbers], halves[-1])
            halves[-1], exponent = _scaled(product, float(np.abs(value_of(product)).max(initial=0.0)))
            scale += exponent
    first, last = halves[0], halves[-1]
    product, reordered = last, value_of(last)
    if frames > 1:
        product, reordered = MIDPOINT_RADIUS.multiply(last, first), value_of(first) @ value_of(last)
    # Enclosures are narrowest for a radius near 1.
    product, exponent = _scaled(product, float(largest_magnitudes(value_of(product))))
    _, bounds = enclose_eigenvalues(value_of(product), error_radius(product))
    radii = largest_magnitudes(np.stack([value_of(product), np.ldexp(reordered, -exponent)]))
    growths = np.array([bounds.low, bounds.high, *radii])
    low, high, radius, second_radius = growths ** (1 / frames) * math.exp2((scale + exponent) / frames)
    return low, high, radius, abs(second_radius - radius)


def _scaled(matrix: Balls, near: float) -> tuple[Balls, int]:
    """Return a matrix divided by a power of two near a given number, and the exponent."""
    exponent = math.frexp(near)[1] if 0 < near < math.inf else 0
    value, radius = (np.ldexp(item, -exponent) for item in (value_of(matrix), error_radius(matrix)))
    return with_error_radius(value, radius), exponent
