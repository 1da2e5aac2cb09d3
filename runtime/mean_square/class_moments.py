"""The mean dynamics and the channel noise of a model: the parts of its second-moment operator.

Takes: a `Model` whose links lose or delay packets independently of each other.
Gives: `class_moments`; `Classes`, `classes_of`, `moments_of`; `PerTickReception`, `build_reception`,
`local_value`; `peer_classes`, `stored_of`, `neutral_motions`, `instants`; `PeerVersusRest`,
`MomentCoordinates`, `Moments`.
Guarantees: on complete graphs the cost is independent of the number of equal peers. Exchangeable peers form
one class on any graph.
Does not: report unsupported models (see `mean_square_stability`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Clock, Model, PeerType
from apc.eigen.interconnection import Coupling, ModalSystem, without_packets
from apc.eigen.modes import complete_degrees, complete_loops, couple, dense_loop, split_exchangeable
from apc.eigen.peer_classes import PeerClass, used_coupling_terms
from apc.eigen.relative_coordinates import Relative
from apc.eigen.rigid_modes import find_rigid_modes
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.interval_arithmetic import error_radius, value_of
from apc.frame.lift import FrameMap
from apc.frame.numeric_model import PeerIndices, Prepared
from apc.frame.parameters import resolve
from apc.frame.schedule import (
    CouplingTerm,
    Event,
    Schedule,
    SendEvent,
    SentSample,
    Tick,
    UncertainSample,
    with_per_tick_inputs,
)
from apc.frame.scheduling import build_schedules
from apc.frame.taylor_models import arithmetic_of
from apc.mean_square.mean_dynamics import (
    Listened,
    ReceptionChannel,
    Route,
    RouteMemory,
    mean_loop,
    route_memory,
)
from apc.mean_square.receiver_memory import memory_of
from apc.mean_square.second_moment_operator import MomentBlock, Operator
from apc.network.channel import ChannelLaw, channel_law

Floats = NDArray[np.float64]
Matrix = NDArray[Any]
Flags = NDArray[np.bool_]

# No share lost is off by anything.
EXACTLY: Mapping[str, tuple[float, ...]] = {}

# A link on which every packet takes the nominal delay.
PERFECT = ChannelLaw(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, "uniform", None)


@dataclass(frozen=True, slots=True, eq=False)
class PerTickReception:
    """The peers of a model with a separate reception at each tick: `rows` lists them by schedule id."""

    groups: tuple[PeerClass, ...]
    exchange: CommunicationGraph
    rows: Mapping[int, tuple[UncertainSample, ...]]
    timings: Mapping[str, Fraction]
    frame: Fraction
    quantum: Fraction
    strictly: bool  # a tick misses what arrives just then

    def of(self, loop: ModalSystem) -> list[tuple[UncertainSample, ...]]:
        """Return the received sample of each row of r, for each subsystem of a loop."""
        return [self.rows[id(subsystem.schedule)] for subsystem in loop.subsystems]


def build_reception(
    system: Model, prepared: Prepared, *, first: Fraction = Fraction(0), stand_in: bool = False
) -> PerTickReception:
    """Lift the peers of a model with a row of r for each tick that receives.

    Parameters
    ----------
    system, prepared
        The model, and its result of `numeric_model.prepare`.
    first
        The start of the frames, in seconds.
    stand_in
        Whether peers send, at each tick, their substitute for a missing value (see `local_value`).
    """
    timings = dict(resolve(system).timings)
    for clock in system.clocks:
        timings[clock.phase] = (timings[clock.phase] - first) % timings[clock.period]
    patterns = [subsystem.pattern for subsystem in prepared.jacobians]
    stored = {link.name: 0 for link in system.links}
    schedules = build_schedules(system, timings, patterns, order=prepared.order, stored=stored)
    peer_versus_rest = {
        (id(schedule), group.peer_type): substituting(schedule, system.peer_types[group.peer_type])
        if stand_in
        else with_per_tick_inputs(schedule)
        for schedule, group in zip(schedules, system.groups, strict=True)
    }
    by_tick = tuple(
        peer_versus_rest[id(schedule), group.peer_type]
        for schedule, group in zip(schedules, system.groups, strict=True)
    )
    rows = {id(local): schedule.selected for schedule, local in zip(schedules, by_tick, strict=True)}
    moved = replace(
        system, timings=tuple(replace(timing, value=timings[timing.name]) for timing in system.timings)
    )
    groups, exchange = lifted_groups(moved, prepared=replace(prepared, schedules=by_tick, timings=timings))
    strictly = prepared.order.index("tick") < prepared.order.index("deliver")
    frame, quantum = schedules[0].frame_s, schedules[0].quantum
    return PerTickReception(groups, exchange, rows, timings, frame, quantum, strictly)


def local_value(row: UncertainSample) -> SentSample:
    """Return the name of a peer's own value at a tick, the substitute for a missing one."""
    return SentSample(f"{row.coupling_term.link} at {row.clock}", row.channel, row.tick)


def substituting(schedule: Schedule, peer_type: PeerType) -> Schedule:
    """Return `with_per_tick_inputs` of a schedule that also sends the substitutes for missing values at the
    ticks.
    """
    partition = {send.link: index for index, send in enumerate(peer_type.sends)}
    sent = list(schedule.sent)
    events: list[Event] = []
    for event in schedule.events:
        indices = (
            [index for listed in event.input_rows for index in listed] if isinstance(event, Tick) else []
        )
        for row in (schedule.selected[index - len(schedule.received)] for index in indices):
            if row.gap:
                local = local_value(row)
                if local not in sent:
                    sent.append(local)
                number = partition[row.coupling_term.link]
                channel = peer_type.sends[number].channels.index(row.channel)
                events.append(SendEvent(number, ((channel, sent.index(local)),)))
        events.append(event)
    more = len(sent) - len(schedule.sent)
    return replace(
        with_per_tick_inputs(schedule),
        events=tuple(events),
        sent=tuple(sent),
        depths=(*schedule.depths, *[0] * more),
        sent_names=(*schedule.sent_names, *[item.link for item in sent[len(schedule.sent) :]]),
        sent_times=(*schedule.sent_times, *[0] * more),
        repeats=None,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PeerVersusRest:
    """A loop in which one peer of a class, its first subsystem, deviates from the other peers.

    `of` is the class of each subsystem. `many` is, per subsystem, the number of peers that could replace the
    first subsystem in relation to a peer of that subsystem; it weighs the channel noise from all of them.
    `neutral` are the loop's rigid motions over the subsystems' own z.
    """

    loop: ModalSystem
    of: tuple[int, ...]
    many: tuple[int, ...]
    neutral: Floats

    def subsystems_of(self, which: int) -> list[tuple[int, int]]:
        """Return the subsystems of a class, and `many` of each."""
        listed = enumerate(zip(self.of, self.many, strict=True))
        return [(subsystem, many) for subsystem, (local, many) in listed if local == which]


@dataclass(frozen=True, slots=True, eq=False)
class Classes:
    """The classes of exchangeable peers of a model: the common loop, and a single-peer loop for each class.

    `weights` has the coupling weight of a peer of one class at a peer of another.
    """

    reception: PerTickReception
    common: ModalSystem
    weights: Coupling
    loops: tuple[PeerVersusRest, ...]

    @property
    def counts(self) -> list[int]:
        """The number of peers of each class."""
        return [subsystem.count for subsystem in self.common.subsystems]


def classes_of(reception: PerTickReception) -> Classes:
    """Return the loops of a model with their rigid motions."""
    common, weights = peer_classes(reception)
    loops = []
    for which, local in enumerate(common.subsystems):
        alone = PeerIndices((range(local.peers.first, local.peers.first + 1),))
        subsystems = [(which, replace(local, count=1, peers=alone), 1)]
        for g, subsystem in enumerate(common.subsystems):
            first = int(g == which)
            if count := subsystem.count - first:
                many = count if first else local.count
                others = subsystem.peers.others if first else subsystem.peers
                subsystems.append((g, replace(subsystem, count=count, peers=others), many))
        coupling = {
            coupling_term: tuple(
                tuple(rows[g][h] * (to.count - (index == of)) for of, (h, to, _) in enumerate(subsystems))
                for index, (g, *_) in enumerate(subsystems)
            )
            for coupling_term, rows in weights.items()
        }
        loop = ModalSystem(local.name, 1, tuple(subsystem for _, subsystem, _ in subsystems), coupling)
        listed = tuple(g for g, *_ in subsystems), tuple(many for *_, many in subsystems)
        loops.append(PeerVersusRest(loop, *listed, neutral_motions(loop)))
    return Classes(reception, common, weights, tuple(loops))


@dataclass(frozen=True, slots=True, eq=False)
class MomentCoordinates:
    """The coordinates of a block: relative coordinates `at` of a loop whose subsystems begin at `offsets`.

    It represents `received` channels to the loop's first subsystem, or that subsystem itself.
    """

    loop: PeerVersusRest
    at: Relative
    offsets: tuple[int, ...]
    received: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """The second-moment operator of a model, and the meaning of each of its blocks.

    `entries` is the number of noise covariances, `states` the order of the largest loop driven by noise.
    """

    operator: Operator
    moving: tuple[MomentCoordinates, ...]
    entries: int
    states: int


@dataclass(frozen=True, slots=True, eq=False)
class _MomentClass:
    """The channels from peers of class `sender` to those of class `receiver`; their noise, slot by slot.

    Each slot's packet replaces stored values at random, with covariance `noise_covariances`; each receiver
    has `received` such channels.
    """

    sender: int
    receiver: int
    received: int
    listened: Listened
    noises: range
    noise_covariances: tuple[Matrix, ...]


def class_moments(system: Model, reception: PerTickReception) -> Moments:
    """Return the second-moment operator of a model: its mean loops and the channel noise that drives them.

    Parameters
    ----------
    system
        The model, with the parameter values to analyze.
    reception
        The peers of the model.
    """
    of = classes_of(reception)
    return moments_of(of, stored_of(system, of.reception, of.common))


def moments_of(
    of: Classes, memories: Sequence[RouteMemory], frames: Mapping[str, FrameMap] | None = None
) -> Moments:
    """Return the second-moment operator for classes of exchangeable peers.

    Parameters
    ----------
    of
        The classes.
    memories
        From `stored_of`.
    frames
        As for `mean_dynamics.mean_loop`.
    """
    peer_types = _peer_types(of, memories)
    noise_covariances = [spread for peer_type in peer_types for spread in peer_type.noise_covariances]
    widths = [len(spread[0]) for spread in noise_covariances]
    blocks, moving, states = list[MomentBlock](), list[MomentCoordinates](), 0
    for h, peer_versus_rest in enumerate(of.loops):
        driving = [peer_type for peer_type in peer_types if peer_type.receiver == h]
        rows = of.reception.of(peer_versus_rest.loop)
        listened = [peer_type.listened for peer_type in driving]
        mean = mean_loop(peer_versus_rest.loop, rows, memories, listened, peer_versus_rest.neutral, frames)
        n = len(mean.at.rest)
        for peer_type, channel in [(None, None), *zip(driving, mean.channels, strict=True)]:
            local = np.arange(n) if channel is None else np.r_[0:n, channel.stored]
            noise = channel.noise if channel else range(0)
            forms = _forms(peer_types, peer_versus_rest, mean.reception_errors, peer_type, channel)
            blocks.append(
                _block(mean.matrix, local, noise, forms, widths, peer_type.noises if peer_type else ())
            )
            moving.append(
                MomentCoordinates(
                    peer_versus_rest, mean.at, mean.offsets, peer_type.received if peer_type else None
                )
            )
            states = max(states, len(local))
    width, like = max(widths, default=0), blocks[0].matrix
    listed = np.zeros((len(widths), len(like), width, width))
    for local, spread, size in zip(listed, noise_covariances, widths, strict=True):
        local[: len(spread), :size, :size] = spread
    entries = sum(size * (size + 1) // 2 for size in widths)
    return Moments(Operator(tuple(blocks), listed), tuple(moving), entries, states)


# A source of noise: its index, its weight, and its linear form over a block's states and noise.
Form = tuple[int, float, Matrix]


def _forms(
    peer_types: Sequence[_MomentClass],
    peer_versus_rest: PeerVersusRest,
    reception_errors: Mapping[tuple[int, Route, int], Matrix],
    peer_type: _MomentClass | None,
    channel: ReceptionChannel | None,
) -> list[Form]:
    """Return the linear forms of the noise sources over a loop driven by channels of one type, or by none.

    Parameters
    ----------
    peer_types, peer_versus_rest
        All channel types, and the loop.
    reception_errors
        The difference between sent and received values, by subsystem, route and slot.
    peer_type, channel
        The type of the driving channel, and the channel in the loop.
    """
    forms = []
    for target in peer_types:
        for (slot, noise), (subsystem, many) in itertools.product(
            enumerate(target.noises), peer_versus_rest.subsystems_of(target.sender)
        ):
            miss = reception_errors[subsystem, target.listened.route, slot]
            weight = many * (1 if peer_type is None else peer_type.received)
            if (
                channel and target is peer_type and subsystem
            ):  # one of these channels is that whose packet it is
                weight -= 1
                forms.append((noise, 1.0, arithmetic_of(miss).add(miss, channel.reception_errors[slot])))
            if weight:
                forms.append((noise, float(weight), miss))
    return forms


def _block(
    matrix: Matrix,
    local: NDArray[np.intp],
    noise: range,
    forms: Sequence[Form],
    widths: Sequence[int],
    by: Sequence[int],
) -> MomentBlock:
    """Return a block of the operator.

    Parameters
    ----------
    matrix
        The state matrix of a loop.
    local, noise
        The indices of the block's states, and of the noise states that drive it.
    forms
        The linear forms of the noise sources over the states.
    widths, by
        The dimension of each noise vector, and the indices of those that drive the block, in order.
    """
    p = max(widths, default=0)
    ends = np.cumsum([noise.start, *(widths[noise] for noise in by)]).tolist()
    spans = [slice(*span) for span in itertools.pairwise(ends)]
    enters = np.zeros((len(by), len(matrix), len(local), p))
    observed, shares = np.zeros((len(forms), len(matrix), p, len(local))), np.zeros((len(widths), len(forms)))
    at_once = np.zeros((len(forms), len(by), len(matrix), p, p))
    for e, span in enumerate(spans):
        enters[e, ..., : span.stop - span.start] = matrix[:, local, span]
    for k, (number, weight, form) in enumerate(forms):
        shares[number, k] = weight
        observed[k, :, : widths[number]] = form[..., local]
        for e, span in enumerate(spans):
            at_once[k, e, :, : widths[number], : span.stop - span.start] = form[..., span]
    moved = matrix[:, local[:, None], local]
    return MomentBlock(moved, enters, tuple(by), observed, shares, at_once if at_once.any() else None)


def _peer_types(of: Classes, memories: Sequence[RouteMemory]) -> list[_MomentClass]:
    """Return the kinds of channels left to chance."""
    peer_types: list[_MomentClass] = []
    first, counts = 0, of.counts
    for memory in memories:
        if not any(memory.sizes):
            continue
        numbers = np.ones((len(memory.channels),) * 2)  # all numbers of a packet are lost together
        noise_covariances = tuple(
            np.kron(numbers, memory.memory.spread(slot)) for slot in range(memory.memory.slots)
        )
        for h, g in itertools.product(range(len(counts)), repeat=2):
            weighed = {
                coupling_term: rows[h][g]
                for coupling_term, rows in of.weights.items()
                if (coupling_term.link, coupling_term.delay) == memory.route
            }
            received = counts[g] - (g == h)
            if received and any(weighed.values()):
                noises = range(first, first := first + len(noise_covariances))
                peer_types.append(
                    _MomentClass(
                        g, h, received, Listened(0, memory.route, weighed), noises, noise_covariances
                    )
                )
    return peer_types


def neutral_motions(loop: ModalSystem) -> Floats:
    """Return the rigid motions of a loop over its subsystems' own states."""
    states = sum(len(subsystem.z_names) for subsystem in loop.subsystems)
    return find_rigid_modes(without_packets(loop), with_drifts=False).basis[:states]


def peer_classes(reception: PerTickReception) -> tuple[ModalSystem, Coupling]:
    """Return the loop of all classes of peers, and the coupling weights between classes.

    Peers of a class are exchangeable: each receives from all peers of a class, its own included, with equal
    weight, or from none.
    """
    groups, exchange = reception.groups, reception.exchange
    if all(
        exchange.is_complete(coupling_term.link)
        for coupling_term in used_coupling_terms(group.schedule for group in groups)
    ):
        degrees = complete_degrees(groups, exchange)

        def weight(coupling_term: CouplingTerm, g: int, h: int) -> Fraction:
            return Fraction(groups[h].count > (1 if g == h else 0))

        return complete_loops(groups, exchange)[0], couple(groups, exchange, weight, degrees)
    whole = dense_loop(groups, exchange)
    common = split_exchangeable(whole, exchange)[0]
    index = {group.peers.first: number for number, group in enumerate(whole.subsystems)}
    first = [index[subsystem.peers.first] for subsystem in common.subsystems]
    last = [index[subsystem.peers.last] for subsystem in common.subsystems]
    weights = {
        coupling_term: tuple(
            tuple(rows[g][last[k] if g == h else h] for k, h in enumerate(first)) for g in first
        )
        for coupling_term, rows in whole.coupling.items()
    }
    return common, weights


def stored_of(
    system: Model,
    reception: PerTickReception,
    common: ModalSystem,
    *,
    perfect: bool = False,
    lost: Mapping[str, tuple[float, ...]] = EXACTLY,
) -> list[RouteMemory]:
    """Return the receiver memory of each route in use.

    Parameters
    ----------
    system, reception
        The model and its peers.
    common
        The loop of all classes.
    perfect
        Whether every packet counts as on time.
    lost
        The error bound of a link's loss probability and its change over a cell, by the name of the link, as
        for `receiver_memory.memory_of`.
    """
    received: dict[Route, list[UncertainSample]] = {}
    for subsystem, rows in zip(common.subsystems, reception.of(common), strict=True):
        size = subsystem.lifted.mapped(lambda block: np.abs(value_of(block)) + error_radius(block))
        used: Flags = np.any(size.q, axis=0) | np.any(size.d, axis=0)
        for index, row in enumerate(rows):
            if used[index] and not row.gap:
                received.setdefault((row.coupling_term.link, row.coupling_term.delay), []).append(row)
    links = {link.name: link for link in system.links}
    memories = []
    times = {clock.name: instants(reception, clock) for clock in system.clocks}
    for route, selected in sorted(received.items()):
        link, delay = links[route[0]], reception.timings[route[1]]
        sent = times[link.clock]
        ticks = {(row.clock, row.tick): times[row.clock][row.tick] for row in selected}
        law = PERFECT if perfect or link.channel is None else channel_law(system, link, delay)
        error_bound = lost.get(route[0], (0.0,))
        memory = memory_of(
            law, delay, sent, ticks, reception.frame, strictly=reception.strictly, lost=error_bound
        )
        memories.append(route_memory(route, memory, sorted({row.channel for row in selected})))
    return memories


def instants(reception: PerTickReception, clock: Clock) -> list[Fraction]:
    """Return the tick times of a clock in a frame, in seconds."""
    phase, period = reception.timings[clock.phase], reception.timings[clock.period]
    return [phase % period + number * period for number in range(int(reception.frame / period))]
