"""State space of a model over one frame, with all peers: from forces and noise to simulated signals.

Takes: a `Model`; a link or coupler to cut it at.
Gives: `StateSpace`, `state_space`; `FrameNumbers`, `lifted`, `peers_of`, `steps_in_floats`: the same for any
number type.
Guarantees: every event within a frame is included, exact except for rounding. The eigenvalues are those of
`analyze`, and 0 for each force that no state stores until the end of the frame. Cut open and closed again by
u = −y it is the closed loop.
Does not: write files (see `state_space_files`), or exploit equal peers.

    x⁺ = A x + B u      y = C x + D u      once per frame

An input force is held over a frame. Noise is added to every sample of a measured value in the frame, in ticks
and packets. The outputs are the values of a row of `apc simulate` at the start of the frame: values just
before the tick. For a model that is nonlinear or has internal forces, these are small motions about its
start.

Cut at a link, u are the values that each peer receives over it, and −y those it would receive. Cut at a
coupler, u are its forces at each tick of a frame, and −y the values computed by the tick. D is then the
direct feedthrough within the frame.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_classes, near_start
from apc.compiler.compiled import Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.exports.identifiers import ExportedSignal
from apc.lifting.devices import Device, ForceInput, find_push
from apc.lifting.discretize import TOO_LARGE, discretize
from apc.lifting.frame_inputs import OUTSIDE, with_cuts, with_holds, with_ports
from apc.lifting.interval_arithmetic import FLOATS, MIDPOINT_RADIUS, Arithmetic, value_of
from apc.lifting.lift import MOST_PACKETS, FrameMap, check_packets, compose, step_durations
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.linearization.evaluation_errors import evaluating
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.network.nominal_criterion import limitations
from apc.result import Result
from apc.simulation.program import timed_events
from apc.simulation.signals import local_signals, ticking_partitions
from apc.simulation.trajectory import parameters_of, texts_of
from apc.spectrum.interconnection import ModalSystem, interconnect_with_inputs, lay_out_loop
from apc.spectrum.modes import dense_loop
from apc.spectrum.peer_classes import PeerClass, states_of
from apc.support.distribution import versions
from apc.support.memory import refuse_beyond
from apc.timing.communication_graph import CommunicationGraph
from apc.timing.schedule import ClockedValue, ReceivedSample, Schedule, Tick

if TYPE_CHECKING:
    import control

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Matrix = NDArray[Any]
Blocks = tuple[Matrix, Matrix, Matrix, Matrix]

# Bytes of an entry of the closed matrix while it is made: the matrix, its parts, and what is sent.
ENTRY = 40


Labels = tuple[ExportedSignal, ...]
Placed = list[tuple[ExportedSignal, int]]  # signals, each with its index in z


@dataclass(frozen=True, slots=True, eq=False)
class StateSpace(Result):
    """A discrete state space with the sampling period `frame_s` in seconds.

    `open_at` is the link or coupler where the loop is cut, "" for the closed loop. `notes` list the
    limitations. With `symbolic` parameters, `function` is a `casadi.Function` of them, one argument each in
    SI, that returns A, B, C and D.
    """

    shown_by = "exports_output:state_space"

    topology: str
    open_at: str
    frame_s: float
    a: Floats  # (n, n)
    b: Floats  # (n, inputs)
    c: Floats  # (outputs, n)
    d: Floats  # (outputs, inputs)
    states: tuple[ExportedSignal, ...]
    inputs: tuple[ExportedSignal, ...]
    outputs: tuple[ExportedSignal, ...]
    notes: tuple[str, ...]
    made_by: str
    symbolic: tuple[ExportedSignal, ...] = ()
    function: Any = None

    @property
    def matrices(self) -> tuple[Floats, Floats, Floats, Floats]:
        """The matrices A, B, C and D."""
        return self.a, self.b, self.c, self.d

    @property
    def content(self) -> str:
        """A text for the loop: closed, or cut at a link or coupler."""
        return f"the loop cut at {self.open_at}" if self.open_at else "the closed loop"

    @property
    def meaning(self) -> str:
        """A text on the hold of inputs and the instants of outputs."""
        step = "x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k], "
        step += f"one step per frame of {1e3 * self.frame_s:g} ms"
        if self.open_at:
            closing = "as by control.feedback(system, the identity), it is the closed loop"
            return f"{step}, cut at {self.open_at}: closed again by u = -y, {closing}."
        held = "Forces are held for a frame; noise is added to each sample taken in it"
        return f"{step}. {held}; y are the values just before it."

    def to_control(self) -> control.StateSpace:
        """Return the state space as `control.StateSpace`, with names as identifiers.

        Raises ApcError (E875).
        """
        return self._shown("control")


@dataclass(frozen=True, slots=True, eq=False)
class FrameNumbers:
    """The numerical parts of a frame in one number type.

    `subsystem` returns the matrices of some peers, `inverses` the effects 1/m of a force input on velocities,
    `steps` [F G] for durations in seconds, with the given number of inputs after the holds, forces first.
    """

    subsystem: Callable[[PeerClass], LinearSubsystem]
    inverses: Callable[[PeerClass, ForceInput], Sequence[Any]]
    steps: Callable[[PeerClass, Sequence[ForceInput], int, Sequence[Fraction]], list[Matrix]]
    arithmetic: Arithmetic


def steps_in_floats(
    peer_class: PeerClass, forces: Sequence[ForceInput], count: int, durations: Sequence[Fraction]
) -> list[Matrix]:
    """Return [F G] of some durations in floats, from exact matrices (see `FrameNumbers`)."""
    columns = np.zeros((len(peer_class.exact.a), count), dtype=object)
    for index, push in enumerate(forces):
        columns[list(push.velocities), index] = push.inverses
    steps = discretize(peer_class.exact.a, np.concatenate([peer_class.exact.b, columns], axis=1), durations)
    return [value_of(step) for step in steps]


IN_FLOATS = FrameNumbers(
    lambda peer_class: peer_class.subsystem,
    lambda peer_class, push: [*map(float, push.inverses)],
    steps_in_floats,
    FLOATS,
)


def state_space(model: Model, *, open_at: str = "") -> StateSpace:
    """Return the state space of a model, with all peers in one system.

    Parameters
    ----------
    model
        The model.
    open_at
        The link or coupler at which the loop is cut; "" for the closed loop.

    Raises
    ------
    ApcError
        E950 no such link or coupler; E951 too many states; and those of `analysis.lifted_classes`.
    """
    peer_classes, comm_graph = peers_of(numeric_model(model))
    (a, b, c, d), (states, inputs, outputs), unpushed = lifted(
        model, peer_classes, comm_graph, open_at, IN_FLOATS
    )
    if not all(np.isfinite(block).all() for block in (a, b, c, d)):
        raise ApcError(Diagnostic("E806", SourceLocation(model.name), TOO_LARGE))
    frame_s, notes = description(model)
    notes = (*notes, *unpushed)
    return StateSpace(
        model.name, open_at, frame_s, a, b, c, d, states, inputs, outputs, notes, made_by(model)
    )


def peers_of(numeric: NumericModel) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
    """Return the lifted peer classes of a model; ApcError E951 if one is too large."""
    try:
        return lifted_classes(numeric)
    except ApcError as error:
        if any(mistake.code != "E804" for mistake in error.mistakes):
            raise
        message = error.mistakes[0].message
        raise ApcError(
            Diagnostic(
                "E951",
                SourceLocation(numeric.model.origin.topology),
                message,
                advice="reduce the number of peers",
            )
        ) from None


def description(model: Model) -> tuple[float, tuple[str, ...]]:
    """Return the length of a model's frame in seconds, and the limitations of its linear map."""
    numeric = numeric_model(model)
    return float(numeric.schedules[0].frame_s), (*near_start(numeric), *limitations(model))


def made_by(model: Model) -> str:
    """Return the provenance of a model's export, as one line of JSON."""
    description = {
        "topology": model.name,
        "texts": texts_of(model),
        "parameters": parameters_of(model),
        "timings": [(timing.name, str(timing.value)) for timing in model.timings],
        "versions": versions("casadi", "numpy"),
    }
    return json.dumps(description, ensure_ascii=False)


def lifted(
    model: Model,
    peer_classes: Sequence[PeerClass],
    comm_graph: CommunicationGraph,
    open_at: str,
    numbers: FrameNumbers,
) -> tuple[Blocks, tuple[Labels, Labels, Labels], tuple[str, ...]]:
    """Return A, B, C and D of a model in a number type, the names of states, inputs and outputs, and notes.

    Parameters
    ----------
    model, open_at
        As for `state_space`.
    peer_classes, comm_graph
        The peers and the communication graph, from `analysis.lifted_classes`.
    numbers
        The numerical parts of the frame.
    """
    with evaluating(model):
        link = _link_of(model, open_at)
        driven_peers = [
            _open_loop(model, peer_class, "" if link else open_at, numbers) for peer_class in peer_classes
        ]
        _check_size(model, driven_peers)
        modal_system = dense_loop([item.peer_class for item in driven_peers], comm_graph)
        peers_of_class = {item.peer_class.index: item for item in driven_peers}
        subsystems = [peers_of_class[peer_class.index] for peer_class in modal_system.peer_classes]
        blocks, labels = _closed(
            modal_system, subsystems, link=link, open_at=open_at, arithmetic=numbers.arithmetic
        )
    notes = () if open_at else tuple(dict.fromkeys(note for item in driven_peers for note in item.unpushed))
    return blocks, labels, notes


@dataclass(frozen=True, slots=True, eq=False)
class _DrivenPeers:
    """Peers with external inputs: `peer_class` includes the inputs, `map` is their frame map.

    `signals` are the simulated signals with their indices in z, `inputs` the inputs with their indices.
    `cuts` are the forces cut open, with the indices of their computed values in z; the last received values
    replace these. `unpushed` lists the bodies without force input, with the reason.
    """

    peer_class: PeerClass
    map: FrameMap
    signals: Placed
    inputs: Placed
    cuts: Placed
    unpushed: tuple[str, ...]


def _open_loop(model: Model, peer_class: PeerClass, open_at: str, numbers: FrameNumbers) -> _DrivenPeers:
    """Return some peers with forces and noise as inputs, and with the forces of a coupler cut open."""
    schedule, peer_type = _with_computed_values(peer_class), peer_class.jacobians.peer_type
    (forces, unpushed), noises = _force_inputs(model, peer_class), _sampled_states(peer_class.subsystem)
    inverses = [numbers.inverses(peer_class, force) for force in forces]
    extended = _with_inputs(numbers.subsystem(peer_class), forces, inverses, noises)
    count = len(forces) + len(noises)
    no_readings = np.zeros((0, sum(extended.b.shape)), dtype=extended.b.dtype)
    (subsystem,), extended_schedule, ports = with_ports([extended], schedule, count, [0], [no_readings], [])
    subsystem, extended_schedule, cuts = _cut_open(subsystem, extended_schedule, open_at)
    check_packets(extended_schedule)
    durations = step_durations(extended_schedule)
    steps = numbers.steps(
        peer_class, forces, count, [duration * extended_schedule.quantum for duration in durations]
    )
    frame = compose(
        subsystem, extended_schedule, dict(zip(durations, steps, strict=True)), numbers=numbers.arithmetic
    )
    first = {value: len(peer_type.states) + k for k, value in enumerate(schedule.discrete_states)}
    signals = [
        (
            ExportedSignal(local_signal.name, local_signal.unit),
            local_signal.index[0]
            if local_signal.role == "state"
            else first[ClockedValue(local_signal.index[0], local_signal.index[1], -1)],
        )
        for local_signal in local_signals(peer_type, peer_class.schedule)
        if local_signal.role in ("state", "output")
    ]
    inputs = [ExportedSignal(f"force on {push.part}", "N") for push in forces]
    inputs += [
        ExportedSignal(f"noise on {peer_type.states[index].name}", peer_type.states[index].unit)
        for index in noises
    ]
    return _DrivenPeers(
        peer_class=peer_class.with_subsystem(
            subsystem, peer_class.exact, extended_schedule, frame.mapped(MIDPOINT_RADIUS.exact)
        ),
        map=frame,
        signals=signals,
        inputs=list(zip(inputs, ports.input_slots.ravel().tolist(), strict=True)),
        cuts=cuts,
        unpushed=tuple(unpushed),
    )


def _with_computed_values(peer_class: PeerClass) -> Schedule:
    """Return a peer's schedule with the last computed values of its clocks among the discrete states."""
    schedule, peer_type = peer_class.schedule, peer_class.jacobians.peer_type
    tick_times = _instants(schedule)
    values = [
        ClockedValue(p, o, -1)
        for p in ticking_partitions(schedule)
        for o in range(len(peer_type.clocks[p].outputs))
    ]
    values = [value for value in values if value not in schedule.discrete_states]
    names = [
        f"{peer_type.clocks[value.partition].outputs[value.output]}"
        f"({float((tick_times[value.partition][-1] - schedule.frame) * schedule.quantum * 1000):.6g} ms)"
        for value in values
    ]
    return replace(
        schedule,
        discrete_states=(*schedule.discrete_states, *values),
        value_names=(*schedule.value_names, *names),
        repeats=None,
    )


def _instants(schedule: Schedule) -> dict[int, list[int]]:
    """Return the tick times of each clock partition in a frame, in quanta."""
    result: dict[int, list[int]] = {}
    for now, event in timed_events(schedule):
        if isinstance(event, Tick):
            result.setdefault(event.partition, []).append(now)
    return result


def _force_inputs(model: Model, peer_class: PeerClass) -> tuple[list[ForceInput], list[str]]:
    """Return the force inputs of a peer's bodies, axis by axis, and the reasons for bodies without one."""
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    device_cache: dict[str, Device | str | None] = {}
    result = [
        find_push(
            peer_class.jacobians,
            peer_class.parameters,
            unit_of,
            peer_class.initial_reception,
            index,
            device_cache,
        )
        for index, state in enumerate(peer_class.jacobians.peer_type.states)
        if state.unit == "m"
    ]
    pushes: dict[str, ForceInput] = {}
    for push in result:
        if isinstance(push, ForceInput):
            pushes.setdefault(push.part, push)
    refused = dict.fromkeys(f"no separate force input: {text}" for text in result if isinstance(text, str))
    return list(pushes.values()), list(refused)


def _sampled_states(subsystem: LinearSubsystem) -> list[int]:
    """Return the states that a tick or a send samples."""
    patterns = [
        values.any(axis=0)
        for values in (*(tick.x for tick in subsystem.ticks), *(send.x for send in subsystem.sends))
    ]
    indices: list[int] = np.flatnonzero(np.any(patterns, axis=0)).tolist() if patterns else []
    return indices


def _with_inputs(
    subsystem: LinearSubsystem,
    forces: Sequence[ForceInput],
    inverses: Sequence[Sequence[Any]],
    noises: Sequence[int],
) -> LinearSubsystem:
    """Return a subsystem with a hold for each force and for each noise, which is added to sampled values.

    `inverses` are the effects of each force on its velocities, `noises` the states with noisy samples.
    """
    columns = np.zeros((len(subsystem.a), len(forces) + len(noises)), dtype=subsystem.b.dtype)
    for index, (push, inverse) in enumerate(zip(forces, inverses, strict=True)):
        columns[list(push.velocities), index] = inverse
    extended = with_holds(subsystem, columns)
    sampled = [*((tick.u, tick.x) for tick in extended.ticks), *((send.u, send.x) for send in extended.sends)]
    for u, x in sampled if noises else ():
        u[:, -len(noises) :] = x[:, noises]
    return extended


def _link_of(model: Model, open_at: str) -> str:
    """Return the link at which the loop is cut, "" for a coupler. Raises ApcError E950 for another name."""
    links = [link.name for link in model.links]
    parts = {hold.name.rpartition(".")[0] for peer_type in model.peer_types for hold in peer_type.holds}
    if open_at in links:
        return open_at
    if open_at and open_at not in parts:
        known = [*links, *sorted(parts)]
        listed = ", ".join(known) or "it has none"
        message = f"{open_at[:80]} is not a link or sampled coupler of {model.name} ({listed})"
        near = nearest(open_at, known) or (known[0] if known else "")
        raise ApcError(
            Diagnostic("E950", SourceLocation("--open-at"), message, fix=f"--open-at {near}" if near else "")
        )
    return ""


def _cut_open(
    subsystem: LinearSubsystem, schedule: Schedule, open_at: str
) -> tuple[LinearSubsystem, Schedule, Placed]:
    """Return a subsystem whose coupler forces are external inputs at each tick, its schedule, and the
    computed forces.
    """
    peer_type = subsystem.peer_type
    numbers = {partition.clock: p for p, partition in enumerate(peer_type.clocks)}
    forces = [hold for hold in peer_type.holds if open_at and hold.name.rpartition(".")[0] == open_at]
    cuts = list(dict.fromkeys((numbers[hold.clock], hold.output) for hold in forces))
    cuts = [(partition, output) for partition, output in cuts if schedule.ticks[partition]]
    tick_times, ports = _instants(schedule), []
    for partition, output in cuts:
        clock = peer_type.clocks[partition]
        times = [float(number * schedule.quantum * 1000) for number in tick_times[partition]]
        ports += [
            ExportedSignal(f"{clock.outputs[output]} at {when:.6g} ms", clock.units[output]) for when in times
        ]
    if len(schedule.received) + len(ports) > MOST_PACKETS:
        message = f"{len(ports):,} inputs at the opened loop, one for each tick; the limit is {MOST_PACKETS}"
        raise ApcError(
            Diagnostic("E951", SourceLocation("--open-at"), message, advice="open the loop at a link")
        )
    cut_subsystem, cut_schedule = with_cuts(subsystem, schedule, cuts)
    names = (*schedule.value_names, *(f"{port.name} computed" for port in ports))
    first = len(peer_type.states) + len(schedule.discrete_states)
    computed = [(port, first + index) for index, port in enumerate(ports)]
    return cut_subsystem, replace(cut_schedule, value_names=names), computed


def _check_size(model: Model, opened: Sequence[_DrivenPeers]) -> None:
    """Raise ApcError E951 for a model whose matrix exceeds the memory."""
    columns = sum(
        item.peer_class.count * states_of(item.peer_class.schedule, item.peer_class.jacobians)
        for item in opened
    )
    peers = sum(item.peer_class.count for item in opened)
    message = f"{columns:,} × {columns:,} numbers (states and inputs of {peers:,} peers)"
    first = max(opened, key=lambda opened: opened.peer_class.count).peer_class
    advice = (
        "reduce the number of peers, such as by --set "
        f"{model.groups[0].name if len(opened) == 1 else first.name}.count=10"
    )
    refuse_beyond(ENTRY * columns**2, "E951", SourceLocation(model.origin.topology), message, advice)


def _closed(
    modal_system: ModalSystem,
    subsystems: Sequence[_DrivenPeers],
    *,
    link: str,
    open_at: str,
    arithmetic: Arithmetic,
) -> tuple[Blocks, tuple[Labels, Labels, Labels]]:
    """Return A, B, C and D of a loop that is closed except at the cut, and the names of states, inputs and
    outputs.

    Parameters
    ----------
    modal_system, subsystems
        The loop of all peers, and the driven peers of each subsystem.
    link, open_at
        The link at which the loop is cut, "" for none; and the link or coupler.
    arithmetic
        The number type.
    """
    layout = lay_out_loop(modal_system)
    n, peers = len(layout.names), [peer_class.name for peer_class in modal_system.peer_classes]
    received = [subsystem.peer_class.schedule.received for subsystem in subsystems]
    external_rows = [
        [
            row
            for row, subject in enumerate(rows)
            if subject is OUTSIDE or (link and subject.coupling_term.link == link)
        ]
        for rows in received
    ]
    maps = [
        _with_external_receptions(subsystem.map, rows)
        for subsystem, rows in zip(subsystems, external_rows, strict=True)
    ]
    closed_loop = interconnect_with_inputs(
        modal_system, maps, [*map(len, external_rows)], layout, numbers=arithmetic
    )

    def in_state(signals_of_subsystems: Sequence[Placed]) -> tuple[Labels, Indices]:
        """Return the signals of all subsystems, named by peer, and their indices in the state."""
        entries = [
            (_named(port, peer), index + offset)
            for ports, peer, offset in zip(signals_of_subsystems, peers, layout.offsets, strict=True)
            for port, index in ports
        ]
        return tuple(port for port, _ in entries), np.array([index for _, index in entries], np.intp)

    inputs, input_slots = in_state([subsystem.inputs for subsystem in subsystems])
    forces, computed = in_state([subsystem.cuts for subsystem in subsystems])
    stored = np.delete(np.arange(n), np.concatenate([input_slots, computed]))
    names = layout.names if len(subsystems) > 1 else tuple(f"{peers[0]}.{name}" for name in layout.names)
    units = {
        name: _units(subsystem.peer_class.jacobians.peer_type)
        for name, subsystem in zip(peers, subsystems, strict=True)
    }
    states = tuple(ExportedSignal(name, _unit(units, name)) for name in map(names.__getitem__, stored))
    matrix, input_columns = closed_loop.matrix, slice(n, None)
    if not open_at:
        outputs, signal_indices = in_state([subsystem.signals for subsystem in subsystems])
        c = (stored[None, :] == signal_indices[:, None]).astype(np.float64)
        blocks = (
            matrix[np.ix_(stored, stored)],
            matrix[np.ix_(stored, input_slots)],
            c,
            np.zeros((len(c), len(input_slots))),
        )
        return blocks, (states, inputs, outputs)
    if link:
        sent = {name: unit for item in units.values() for name, unit in item.items()}
        forces, _ = in_state([_received_ports(rows, link, sent) for rows in received])
        feedback_rows = -np.concatenate(
            [r[rows] for r, rows in zip(closed_loop.received, external_rows, strict=True)]
        )
    else:
        feedback_rows = -matrix[computed]
    outputs = tuple(replace(port, name=f"{port.name} back") for port in forces)
    blocks = (
        matrix[np.ix_(stored, stored)],
        matrix[stored, input_columns],
        feedback_rows[:, stored],
        feedback_rows[:, input_columns],
    )
    return blocks, (states, forces, outputs)


def _with_external_receptions(frame_map: FrameMap, rows: Sequence[int]) -> FrameMap:
    """Return a peer's map with some received values as external inputs, after all others."""
    q, d = (np.concatenate([block, block[:, rows]], axis=1) for block in (frame_map.q, frame_map.d))
    q[:, rows] = d[:, rows] = 0.0
    return replace(frame_map, q=q, d=d)


def _named(port: ExportedSignal, peer: str) -> ExportedSignal:
    """Return a peer's signal, named with the peer: `force on left[2].cube`."""
    word, on, rest = port.name.rpartition(" on ")
    return replace(port, name=f"{word}{on}{peer}.{rest}")


def _received_ports(received: Sequence[ReceivedSample], link: str, units: Mapping[str, str]) -> Placed:
    """Return the received values of a peer over a link as signals, named by packet of the frame and age."""
    received = [subject for subject in received if subject.coupling_term.link == link]
    several = any(subject.sent.slot for subject in received)
    named = [
        f"{subject.coupling_term.operator} "
        f"{subject.sent.channel}{f' #{subject.sent.slot + 1}' * several}"
        f"{f' at {subject.sent.clock}' * bool(subject.sent.clock)}({-subject.lag})"
        for subject in received
    ]
    pairs = zip(named, received, strict=True)
    return [(ExportedSignal(name, units[subject.sent.channel]), 0) for name, subject in pairs]


def _units(peer_type: PeerType) -> dict[str, str]:
    """Return the units of a peer's states, computed values and sent values, by name."""
    result = {state.name: state.unit for state in peer_type.states}
    for clock in peer_type.clocks:
        result |= zip(clock.outputs, clock.units, strict=True)
    for send in peer_type.sends:
        result |= zip(send.channels, send.units, strict=True)
    return result


def _unit(units: Mapping[str, Mapping[str, str]], name: str) -> str:
    """Return the unit of an entry of the state, such as `user[1].coordination.x sent(-8 ms)`."""
    peer, _, name_in_peer = name.partition(".")
    return units[peer][name_in_peer.partition("(")[0].partition(" ")[0]]
