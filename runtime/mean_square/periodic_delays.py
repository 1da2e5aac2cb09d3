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
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.interconnection import ModalSystem, feedback_of, interconnect, lay_out_loop
from apc.eigen.modes import decompose
from apc.eigen.peer_classes import MOST_STATES
from apc.eigen.relative_coordinates import Relative, relative, relative_coordinates, with_uncertainty
from apc.eigen.rigid_modes import find_rigid_modes
from apc.frame.interval_arithmetic import MIDPOINT_RADIUS, error_radius, value_of, with_error_radius
from apc.frame.numeric_model import Prepared
from apc.frame.schedule import ReceivedSample, SentSample, UncertainSample
from apc.mean_square.class_moments import PerTickReception, build_reception, instants
from apc.network.packet_schedule import instant_of
from apc.not_supported import NotSupportedError

Floats = NDArray[np.float64]
Balls = NDArray[Any]  # of numbers with their radii

# Frames of a period that are multiplied one by one.
MOST_FRAMES = 20_000


@dataclass(frozen=True, slots=True)
class TraceGrowth:
    """The growth of motions per frame: proved bounds, an estimate, and its difference from another."""

    low: float
    high: float
    radius: float
    uncertainty: float
    frames: int


class Packets:
    """The packets of a model, numbered from the first of the present frame, and the ticks that use them.

    `slots` is the number of packets per frame on each link.
    """

    def __init__(self, system: Model, reception: PerTickReception) -> None:
        self.reception = reception
        self.rows = dict.fromkeys(row for listed in reception.rows.values() for row in listed)
        self.links = {link.name: link for link in system.links}
        self.times = {clock.name: instants(reception, clock) for clock in system.clocks}
        self.slots = {name: len(self.times[link.clock]) for name, link in self.links.items()}

    def received(
        self, row: UncertainSample, delay: Fraction | None = None, trace: Floats | None = None
    ) -> list[int]:
        """Return the packet in effect at a tick, frame by frame over a period.

        Parameters
        ----------
        row
            The tick.
        delay
            The delay of all packets in seconds, unless it is the nominal one.
        trace
            Periodic delays to use instead, in seconds, infinite for a lost packet.
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
            delays = [instant_of(late, reception.quantum) if arrives else None for late, arrives in pairs]
        longest = max(late for late in delays if late is not None)
        newest = link.channel is None or link.channel.reorder == "newest"
        numbers = []
        for frame in range(_period_of(len(delays), slots)):
            best: tuple[Fraction, int] | None = None
            for number in itertools.count(slots - 1, -1):
                ago, slot = divmod(number, slots)
                at = sent[slot] + ago * reception.frame
                if best is not None and (newest or at + longest < best[0]):
                    break  # earlier packets cannot arrive later
                late = delays[(frame * slots + number) % len(delays)]
                if late is None or at + late > tick or (at + late == tick and reception.strictly):
                    continue
                best = max(best or (at + late, number), (at + late, number))
            assert best is not None
            numbers.append(best[1])
        return numbers

    def depths(self, numbers: Iterable[tuple[UncertainSample, int]], least: int = 0) -> dict[str, int]:
        """Return the number of frames for which packets of each link are stored, given those in use."""
        depths = dict.fromkeys(self.links, least)
        for row, number in numbers:
            depths[row.coupling_term.link] = max(
                depths[row.coupling_term.link], -(number // self.slots[row.coupling_term.link])
            )
        return depths

    def loop(
        self, loop: ModalSystem, numbers: Mapping[UncertainSample, int], depths: Mapping[str, int]
    ) -> ModalSystem:
        """Return a loop whose ticks use the packets of these numbers."""
        subsystems = []
        for subsystem, rows in zip(loop.subsystems, self.reception.of(loop), strict=True):
            received = []
            for row in rows:
                frames, slot = divmod(numbers[row], self.slots[row.coupling_term.link])
                received.append(
                    ReceivedSample(
                        row.coupling_term, SentSample(row.coupling_term.link, row.channel, slot), -frames
                    )
                )
            stored = tuple(depths[sent.link] for sent in subsystem.schedule.sent)
            subsystems.append(
                replace(
                    subsystem, schedule=replace(subsystem.schedule, received=tuple(received), depths=stored)
                )
            )
        return replace(loop, subsystems=tuple(subsystems))


def trace_radius(system: Model, prepared: Prepared) -> TraceGrowth:
    """Return the mean growth of motions per frame, over a period.

    Parameters
    ----------
    system, prepared
        The model, and the result of `numeric_model.prepare`.

    Raises
    ------
    NotSupportedError
        The period or the delays are too long to follow.
    """
    packets = Packets(system, build_reception(system, prepared))
    traces = {name: link.channel.trace for name, link in packets.links.items() if link.channel}
    lengths = {name: 1 if trace is None else len(trace) for name, trace in traces.items()}
    used = {row.coupling_term.link for row in packets.rows}
    frames = math.lcm(*(_period_of(lengths.get(name, 1), packets.slots[name]) for name in used))
    if frames > MOST_FRAMES:
        message = f"the recorded delays come again after {frames:,} frames"
        raise NotSupportedError(f"{message}, and {MOST_FRAMES:,} are the most")
    received = {row: packets.received(row, trace=traces.get(row.coupling_term.link)) for row in packets.rows}
    depths = packets.depths((row, number) for row, numbers in received.items() for number in numbers)
    result = []
    for loop in decompose(packets.reception.groups, packets.reception.exchange).loops:
        stored = sum(depths[sent.link] for subsystem in loop.subsystems for sent in subsystem.schedule.sent)
        if stored + sum(len(subsystem.z_names) for subsystem in loop.subsystems) > MOST_STATES:
            raise NotSupportedError("the recorded delays are longer than can be followed")
        result.append(_period(loop, packets, received, depths, frames))
    low, high, radius, uncertainty = np.array(result).max(axis=0).tolist()
    return TraceGrowth(low, high, radius, uncertainty, frames)


def _period_of(delays: int, slots: int) -> int:
    """Return the period in frames of a periodic sequence of delays."""
    return math.lcm(delays, slots) // slots


def _period(
    loop: ModalSystem,
    packets: Packets,
    received: Mapping[UncertainSample, Sequence[int]],
    depths: Mapping[str, int],
    frames: int,
) -> tuple[float, float, float, float]:
    """Return bounds on the growth of a loop per frame, an estimate, and the difference of a second one."""
    known: dict[tuple[int, ...], Balls] = {}
    at: Relative | None = None
    rows = dict.fromkeys(row for listed in packets.reception.of(loop) for row in listed)
    # The eigenvalues of a product are those of its halves in either order, with other roundings.
    halves: list[Balls] = []
    scale = 0
    for frame in range(frames):
        numbers = tuple(received[row][frame % len(received[row])] for row in rows)
        if numbers not in known:
            now = packets.loop(loop, dict(zip(rows, numbers, strict=True)), depths)
            layout = lay_out_loop(now)
            maps = [subsystem.lifted for subsystem in now.subsystems]
            matrix = interconnect(maps, feedback_of(now, layout), layout, numbers=MIDPOINT_RADIUS).matrix
            if at is None:
                at = with_uncertainty(relative_coordinates(find_rigid_modes(now, with_drifts=False).basis))
            known[numbers] = relative(matrix, at, MIDPOINT_RADIUS)
        if frame in (0, frames // 2):
            halves.append(known[numbers])
        else:
            product = MIDPOINT_RADIUS.multiply(known[numbers], halves[-1])
            halves[-1], more = _scaled(product, float(np.abs(value_of(product)).max(initial=0.0)))
            scale += more
    first, last = (halves * 2)[:2]
    product, turned = last, value_of(last)
    if frames > 1:
        product, turned = MIDPOINT_RADIUS.multiply(last, first), value_of(first) @ value_of(last)
    # Enclosures are as narrow as asked for where the radius is near 1.
    product, more = _scaled(product, _radius(value_of(product)))
    _, bounds = enclose_eigenvalues(value_of(product), error_radius(product))
    grown = bounds.low, bounds.high, _radius(value_of(product)), _radius(np.ldexp(turned, -more))
    low, high, radius, other = np.array(grown) ** (1 / frames) * math.exp2((scale + more) / frames)
    return low, high, radius, abs(other - radius)


def _radius(matrix: Floats) -> float:
    """Return the spectral radius of a matrix, in floats."""
    return float(np.abs(np.linalg.eigvals(matrix)).max(initial=0.0))


def _scaled(matrix: Balls, near: float) -> tuple[Balls, int]:
    """Return a matrix over the power of two that a number is near to, and its exponent."""
    exponent = math.frexp(near)[1] if 0 < near < math.inf else 0
    value, radius = (np.ldexp(item, -exponent) for item in (value_of(matrix), error_radius(matrix)))
    return with_error_radius(value, radius), exponent
