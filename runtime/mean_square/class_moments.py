"""The mean dynamics and the channel noise of a model: the parts of its second-moment operator.

Takes: a `NumericModel` whose links lose or delay packets independently of each other.
Gives: `class_moments`; `Classes`, `classes_of`, `moments_of`; `PerTickReception`, `build_reception`,
`local_value`; `common_modal_system`, `stored_of`, `neutral_motions`, `instants`; `PeerVersusRest`,
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

from apc.analysis.analysis import lifted_classes
from apc.compiler.compiled import Clock, Model, PeerType
from apc.lifting.interval_arithmetic import error_radius, value_of
from apc.lifting.lift import FrameMap
from apc.lifting.model_numbers import PeerIndices
from apc.lifting.numeric_model import NumericModel
from apc.lifting.taylor_models import arithmetic_of
from apc.mean_square.mean_dynamics import (
    ReceivedChannel,
    ReceptionChannel,
    Route,
    RouteMemory,
    mean_loop,
    route_memory,
)
from apc.mean_square.receiver_memory import memory_of
from apc.mean_square.second_moment_operator import MomentBlock, Operator
from apc.network.channel import ChannelLaw, channel_law
from apc.spectrum.interconnection import Coupling, ModalSystem, without_packets
from apc.spectrum.modes import complete_degrees, complete_loops, couple, dense_loop, split_exchangeable
from apc.spectrum.peer_classes import PeerClass, incomplete_links
from apc.spectrum.relative_coordinates import Relative
from apc.spectrum.rigid_modes import find_rigid_modes
from apc.timing.communication_graph import CommunicationGraph
from apc.timing.schedule import (
    CouplingTerm,
    Event,
    Schedule,
    SendEvent,
    SentSample,
    Tick,
    UncertainSample,
    with_per_tick_inputs,
)
from apc.timing.scheduling import build_schedules

Floats = NDArray[np.float64]
Matrix = NDArray[Any]
Flags = NDArray[np.bool_]

# No loss probability has an error.
EXACTLY: Mapping[Route, tuple[float, ...]] = {}

# A link on which every packet takes the nominal delay.
PERFECT = ChannelLaw(0.0, 1.0, 0.0, 0.0, 0.0, 0.0, "uniform", None)


@dataclass(frozen=True, slots=True, eq=False)
class PerTickReception:
    """The peers of a model with a separate reception at each tick: `rows` lists them by class."""

    peer_classes: tuple[PeerClass, ...]
    comm_graph: CommunicationGraph
    rows: Mapping[int, tuple[UncertainSample, ...]]
    timings: Mapping[str, Fraction]
    frame: Fraction
    quantum: Fraction
    strictly: bool  # a tick does not receive a packet that arrives at the same instant

    def of(self, modal_system: ModalSystem) -> list[tuple[UncertainSample, ...]]:
        """Return the received sample of each row of r, for each subsystem of a loop."""
        return [self.rows[peer_class.index] for peer_class in modal_system.peer_classes]


def build_reception(
    numeric: NumericModel, *, first: Fraction = Fraction(0), stand_in: bool = False
) -> PerTickReception:
    """Return the peers of a model, lifted with a row of r for each tick that receives.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    first
        The start of the frames, in seconds.
    stand_in
        Whether peers send, at each tick, their own value as a substitute for a missing one.
    """
    model = numeric.model
    timings = dict(numeric.timings)
    for clock in model.clocks:
        timings[clock.phase] = (timings[clock.phase] - first) % timings[clock.period]
    patterns = [subsystem.pattern for subsystem in numeric.jacobians]
    stored = {link.name: 0 for link in model.links}
    schedules = build_schedules(model, timings, patterns, order=numeric.order, stored=stored)
    schedules_per_tick = {
        (schedule, group.peer_type): with_substitutes(schedule, model.peer_types[group.peer_type])
        if stand_in
        else with_per_tick_inputs(schedule)
        for schedule, group in zip(schedules, model.groups, strict=True)
    }
    by_tick = tuple(
        schedules_per_tick[schedule, group.peer_type]
        for schedule, group in zip(schedules, model.groups, strict=True)
    )
    shifted_model = replace(
        model, timings=tuple(replace(timing, value=timings[timing.name]) for timing in model.timings)
    )
    peer_classes, comm_graph = lifted_classes(replace(numeric, model=shifted_model, given_schedules=by_tick))
    rows = {
        peer_class.index: schedules[comm_graph.group_of(peer_class.peers.first)].selected
        for peer_class in peer_classes
    }
    strictly = numeric.order.index("tick") < numeric.order.index("deliver")
    frame, quantum = schedules[0].frame_s, schedules[0].quantum
    return PerTickReception(peer_classes, comm_graph, rows, timings, frame, quantum, strictly)


def local_value(row: UncertainSample) -> SentSample:
    """Return the name of a peer's own value at a tick, its substitute for a missing value."""
    return SentSample(f"{row.coupling_term.link} at {row.clock}", row.channel, row.tick)


def with_substitutes(schedule: Schedule, peer_type: PeerType) -> Schedule:
    """Return `with_per_tick_inputs` of a schedule that also sends substitutes for missing values at
    the ticks.
    """
    partition = {send.link: index for index, send in enumerate(peer_type.sends)}
    sent = list(schedule.sent)
    events: list[Event] = []
    for event in schedule.events:
        indices = (
            [index for rows_of_receive in event.input_rows for index in rows_of_receive]
            if isinstance(event, Tick)
            else []
        )
        for row in (schedule.selected[index - len(schedule.received)] for index in indices):
            if row.gap:
                own_value = local_value(row)
                if own_value not in sent:
                    sent.append(own_value)
                number = partition[row.coupling_term.link]
                channel = peer_type.sends[number].channels.index(row.channel)
                events.append(SendEvent(number, ((channel, sent.index(own_value)),)))
        events.append(event)
    added_count = len(sent) - len(schedule.sent)
    return replace(
        with_per_tick_inputs(schedule),
        events=tuple(events),
        sent=tuple(sent),
        depths=(*schedule.depths, *[0] * added_count),
        sent_names=(*schedule.sent_names, *[item.link for item in sent[len(schedule.sent) :]]),
        sent_times=(*schedule.sent_times, *[0] * added_count),
        repeats=None,
    )


@dataclass(frozen=True, slots=True, eq=False)
class PeerVersusRest:
    """A loop in which one peer of a class, its first subsystem, deviates from the other peers.

    `class_of` is the class of each subsystem. `candidates` is, for each subsystem, the number of peers that
    can be the first subsystem, seen from a peer of that subsystem: it weights the channel noise from all of
    them. `neutral` are the loop's rigid motions over the subsystems' own z.
    """

    modal_system: ModalSystem
    class_of: tuple[int, ...]
    candidates: tuple[int, ...]
    neutral: Floats

    def subsystems_of(self, class_index: int) -> list[tuple[int, int]]:
        """Return the subsystems of a class, each with its number of `candidates`."""
        pairs = enumerate(zip(self.class_of, self.candidates, strict=True))
        return [
            (subsystem, weight)
            for subsystem, (subsystem_class, weight) in pairs
            if subsystem_class == class_index
        ]


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
        return [peer_class.count for peer_class in self.common.peer_classes]


def classes_of(reception: PerTickReception) -> Classes:
    """Return the classes of exchangeable peers of a model, with the loops and rigid motions of each."""
    common, weights = common_modal_system(reception)
    loops = []
    for class_index, peer_class in enumerate(common.peer_classes):
        one_peer = PeerIndices((range(peer_class.peers.first, peer_class.peers.first + 1),))
        subsystems = [(class_index, replace(peer_class, count=1, peers=one_peer), 1)]
        for g, other in enumerate(common.peer_classes):
            first = int(g == class_index)
            if count := other.count - first:
                candidates = count if first else peer_class.count
                others = other.peers.others if first else other.peers
                subsystems.append((g, replace(other, count=count, peers=others), candidates))
        coupling = {
            coupling_term: tuple(
                tuple(
                    rows[g][h] * (sender_class.count - (index == column))
                    for column, (h, sender_class, _) in enumerate(subsystems)
                )
                for index, (g, *_) in enumerate(subsystems)
            )
            for coupling_term, rows in weights.items()
        }
        modal_system = ModalSystem(peer_class.name, 1, tuple(member for _, member, _ in subsystems), coupling)
        class_data = tuple(g for g, *_ in subsystems), tuple(candidates for *_, candidates in subsystems)
        loops.append(PeerVersusRest(modal_system, *class_data, neutral_motions(modal_system)))
    return Classes(reception, common, weights, tuple(loops))


@dataclass(frozen=True, slots=True, eq=False)
class MomentCoordinates:
    """The coordinates of a block: relative coordinates of a loop whose subsystems begin at `offsets`.

    The block represents `received` channels to the loop's first subsystem; None: the subsystem itself.
    """

    loop: PeerVersusRest
    coordinates: Relative
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
    received_channel: ReceivedChannel
    noises: range
    noise_covariances: tuple[Matrix, ...]


def class_moments(model: Model, reception: PerTickReception) -> Moments:
    """Return the second-moment operator of a model: its mean loops and the channel noise that drives them.

    Parameters
    ----------
    model
        The model, with the parameter values to analyze.
    reception
        The peers of the model.
    """
    classes = classes_of(reception)
    return moments_of(classes, stored_of(model, classes.reception, classes.common))


def moments_of(
    classes: Classes, memories: Sequence[RouteMemory], frames: Mapping[str, FrameMap] | None = None
) -> Moments:
    """Return the second-moment operator for classes of exchangeable peers.

    Parameters
    ----------
    classes
        The classes of exchangeable peers.
    memories
        From `stored_of`.
    frames
        As for `mean_dynamics.mean_loop`.
    """
    moment_classes = _moment_classes(classes, memories)
    noise_covariances = [
        covariance for moment_class in moment_classes for covariance in moment_class.noise_covariances
    ]
    widths = [len(covariance[0]) for covariance in noise_covariances]
    blocks, moving, states = list[MomentBlock](), list[MomentCoordinates](), 0
    for h, peer_versus_rest in enumerate(classes.loops):
        driving = [moment_class for moment_class in moment_classes if moment_class.receiver == h]
        rows = classes.reception.of(peer_versus_rest.modal_system)
        received_channels = [moment_class.received_channel for moment_class in driving]
        mean = mean_loop(
            peer_versus_rest.modal_system, rows, memories, received_channels, peer_versus_rest.neutral, frames
        )
        n = len(mean.coordinates.rest)
        for moment_class, channel in [(None, None), *zip(driving, mean.channels, strict=True)]:
            indices = np.arange(n) if channel is None else np.r_[0:n, channel.stored]
            noise = channel.noise if channel else range(0)
            forms = _forms(moment_classes, peer_versus_rest, mean.reception_errors, moment_class, channel)
            blocks.append(
                _block(
                    mean.matrix, indices, noise, forms, widths, moment_class.noises if moment_class else ()
                )
            )
            moving.append(
                MomentCoordinates(
                    peer_versus_rest,
                    mean.coordinates,
                    mean.offsets,
                    moment_class.received if moment_class else None,
                )
            )
            states = max(states, len(indices))
    width, first_matrix = max(widths, default=0), blocks[0].matrix
    covariances = np.zeros((len(widths), len(first_matrix), width, width))
    for padded, covariance, size in zip(covariances, noise_covariances, widths, strict=True):
        padded[: len(covariance), :size, :size] = covariance
    entries = sum(size * (size + 1) // 2 for size in widths)
    return Moments(Operator(tuple(blocks), covariances), tuple(moving), entries, states)


# A source of noise: its index, its weight, and its linear form over a block's states and noise.
Form = tuple[int, float, Matrix]


def _forms(
    moment_classes: Sequence[_MomentClass],
    peer_versus_rest: PeerVersusRest,
    reception_errors: Mapping[tuple[int, Route, int], Matrix],
    moment_class: _MomentClass | None,
    channel: ReceptionChannel | None,
) -> list[Form]:
    """Return the linear forms of the noise sources over a loop that channels of one class drive, or over no
    channel.

    Parameters
    ----------
    moment_classes, peer_versus_rest
        All channel classes, and the loop.
    reception_errors
        The difference between sent and received values, by subsystem, route and slot.
    moment_class, channel
        The class of the driving channel, and the channel in the loop; None without a channel.
    """
    forms = []
    for target in moment_classes:
        for (slot, noise), (subsystem, candidates) in itertools.product(
            enumerate(target.noises), peer_versus_rest.subsystems_of(target.sender)
        ):
            error_form = reception_errors[subsystem, target.received_channel.route, slot]
            weight = candidates * (1 if moment_class is None else moment_class.received)
            if (
                channel and target is moment_class and subsystem
            ):  # one of these channels is that whose packet it is
                weight -= 1
                forms.append(
                    (noise, 1.0, arithmetic_of(error_form).add(error_form, channel.reception_errors[slot]))
                )
            if weight:
                forms.append((noise, float(weight), error_form))
    return forms


def _block(
    matrix: Matrix,
    states: NDArray[np.intp],
    noise: range,
    forms: Sequence[Form],
    widths: Sequence[int],
    noises: Sequence[int],
) -> MomentBlock:
    """Return a block of the operator.

    Parameters
    ----------
    matrix
        The state matrix of a loop.
    states, noise
        The indices of the block's states, and of the noise states that drive it.
    forms
        The linear forms of the noise sources over the states.
    widths, noises
        The dimension of each noise vector, and the indices of those that drive the block, in order.
    """
    p = max(widths, default=0)
    ends = np.cumsum([noise.start, *(widths[source] for source in noises)]).tolist()
    spans = [slice(*span) for span in itertools.pairwise(ends)]
    noise_inputs = np.zeros((len(noises), len(matrix), len(states), p))
    noise_forms, shares = (
        np.zeros((len(forms), len(matrix), p, len(states))),
        np.zeros((len(widths), len(forms))),
    )
    same_frame = np.zeros((len(forms), len(noises), len(matrix), p, p))
    for e, span in enumerate(spans):
        noise_inputs[e, ..., : span.stop - span.start] = matrix[:, states, span]
    for k, (number, weight, form) in enumerate(forms):
        shares[number, k] = weight
        noise_forms[k, :, : widths[number]] = form[..., states]
        for e, span in enumerate(spans):
            same_frame[k, e, :, : widths[number], : span.stop - span.start] = form[..., span]
    inner = matrix[:, states[:, None], states]
    return MomentBlock(
        inner, noise_inputs, tuple(noises), noise_forms, shares, same_frame if same_frame.any() else None
    )


def _moment_classes(classes: Classes, memories: Sequence[RouteMemory]) -> list[_MomentClass]:
    """Return the classes of channels with random losses or delays, with their noise covariances."""
    moment_classes: list[_MomentClass] = []
    first, counts = 0, classes.counts
    for memory in memories:
        if not any(memory.sizes):
            continue
        numbers = np.ones((len(memory.channels),) * 2)  # all numbers of a packet are lost together
        noise_covariances = tuple(
            np.kron(numbers, memory.memory.replacement_covariance(slot))
            for slot in range(memory.memory.slots)
        )
        for h, g in itertools.product(range(len(counts)), repeat=2):
            weighed = {
                coupling_term: rows[h][g]
                for coupling_term, rows in classes.weights.items()
                if (coupling_term.link, coupling_term.delay) == memory.route
            }
            received = counts[g] - (g == h)
            if received and any(weighed.values()):
                noises = range(first, first := first + len(noise_covariances))
                moment_classes.append(
                    _MomentClass(
                        g, h, received, ReceivedChannel(0, memory.route, weighed), noises, noise_covariances
                    )
                )
    return moment_classes


def neutral_motions(modal_system: ModalSystem) -> Floats:
    """Return the rigid modes of a loop over its subsystems' own states (n, d)."""
    states = sum(len(peer_class.z_names) for peer_class in modal_system.peer_classes)
    return find_rigid_modes(without_packets(modal_system), with_drifts=False).basis[:states]


def common_modal_system(reception: PerTickReception) -> tuple[ModalSystem, Coupling]:
    """Return the loop of all classes of peers, and the coupling weights between classes.

    Peers of a class are exchangeable: each receives from all peers of a class, its own included, with equal
    weight, or from none.
    """
    peer_classes, comm_graph = reception.peer_classes, reception.comm_graph
    if not incomplete_links((peer_class.schedule for peer_class in peer_classes), comm_graph):
        degrees = complete_degrees(peer_classes, comm_graph)

        def weight(coupling_term: CouplingTerm, g: int, h: int) -> Fraction:
            """Return 1 if a class has a peer that a peer of class g receives from, else 0."""
            return Fraction(peer_classes[h].count > (1 if g == h else 0))

        return complete_loops(peer_classes, comm_graph)[0], couple(peer_classes, comm_graph, weight, degrees)
    dense = dense_loop(peer_classes, comm_graph)
    common = split_exchangeable(dense, comm_graph)[0]
    index = {peer_class.peers.first: number for number, peer_class in enumerate(dense.peer_classes)}
    first = [index[peer_class.peers.first] for peer_class in common.peer_classes]
    last = [index[peer_class.peers.last] for peer_class in common.peer_classes]
    weights = {
        coupling_term: tuple(
            tuple(rows[g][last[k] if g == h else h] for k, h in enumerate(first)) for g in first
        )
        for coupling_term, rows in dense.coupling.items()
    }
    return common, weights


def stored_of(
    model: Model,
    reception: PerTickReception,
    common: ModalSystem,
    *,
    perfect: bool = False,
    lost: Mapping[Route, tuple[float, ...]] = EXACTLY,
) -> list[RouteMemory]:
    """Return the receiver memory of each route that affects an output.

    Parameters
    ----------
    model, reception
        The model and its peers.
    common
        The loop of all classes.
    perfect
        Whether every packet arrives with its nominal delay.
    lost
        The error bound of a route's loss probability and its change over a cell, by route, as for
        `receiver_memory.memory_of`.
    """
    received: dict[Route, list[UncertainSample]] = {}
    for peer_class, rows in zip(common.peer_classes, reception.of(common), strict=True):
        size = peer_class.lifted.mapped(lambda block: np.abs(value_of(block)) + error_radius(block))
        is_used: Flags = np.any(size.q, axis=0) | np.any(size.d, axis=0)
        for index, row in enumerate(rows):
            if is_used[index] and not row.gap:
                received.setdefault((row.coupling_term.link, row.coupling_term.delay), []).append(row)
    links = {link.name: link for link in model.links}
    memories = []
    times = {clock.name: instants(reception, clock) for clock in model.clocks}
    for route, selected in sorted(received.items()):
        link, delay = links[route[0]], reception.timings[route[1]]
        clock = selected[0].coupling_term.clock
        sent = times[clock or link.clock]
        ticks = {(row.clock, row.tick): times[row.clock][row.tick] for row in selected}
        law = PERFECT if perfect or link.channel is None else channel_law(model, link, route[1])
        error_bound = lost.get(route, (0.0,))
        memory = memory_of(
            law,
            delay,
            sent,
            ticks,
            reception.frame,
            strictly=reception.strictly,
            after=link.after,
            lost=error_bound,
        )
        memories.append(route_memory(route, memory, sorted({row.channel for row in selected}), clock))
    return memories


def instants(reception: PerTickReception, clock: Clock) -> list[Fraction]:
    """Return the tick times of a clock in a frame, in seconds."""
    phase, period = reception.timings[clock.phase], reception.timings[clock.period]
    return [phase % period + number * period for number in range(int(reception.frame / period))]
