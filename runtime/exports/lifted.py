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

from apc.analysis.analysis import lifted_groups, near_start
from apc.compiler.compiled import Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.distribution import versions
from apc.eigen.interconnection import ModalSystem, interconnect_with_inputs, lay_out_loop
from apc.eigen.modes import dense_loop
from apc.eigen.peer_classes import PeerClass, states_of
from apc.exports.identifiers import ExportedSignal
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.devices import Device, ForceInput, find_push
from apc.frame.discretize import TOO_LARGE, discretize
from apc.frame.evaluation_errors import finite_equations
from apc.frame.frame_inputs import OUTSIDE, with_cuts, with_holds, with_ports
from apc.frame.interval_arithmetic import FLOATS, MIDPOINT_RADIUS, Arithmetic, value_of
from apc.frame.lift import MOST_PACKETS, FrameMap, check_packets, compose, step_durations
from apc.frame.linear_subsystem import LinearSubsystem
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.schedule import ClockedValue, ReceivedSample, Schedule, Tick
from apc.memory import refuse_beyond
from apc.network.nominal_criterion import limitations
from apc.result import Result
from apc.simulation.program import timed_events
from apc.simulation.signals import local_signals, ticking_partitions
from apc.simulation.trajectory import parameters_of, texts_of
from apc.threads import single_threaded

if TYPE_CHECKING:
    import control

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Matrix = NDArray[Any]
Blocks = tuple[Matrix, Matrix, Matrix, Matrix]

# Bytes of an entry of the closed matrix while it is made: the matrix, its parts, and what is sent.
ENTRY = 40


Labels = tuple[ExportedSignal, ...]
Placed = list[tuple[ExportedSignal, int]]  # and where each is in z


@dataclass(frozen=True, slots=True, eq=False)
class StateSpace(Result):
    """A discrete state space with the sample time `frame_s`; `open_at` is the link or coupler where it is
    cut, "" if closed.

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
        """A, B, C and D."""
        return self.a, self.b, self.c, self.d

    @property
    def content(self) -> str:
        """The closed loop, or where it is cut."""
        return f"the loop cut at {self.open_at}" if self.open_at else "the closed loop"

    @property
    def meaning(self) -> str:
        """The hold of inputs, and the instants of outputs."""
        step = f"x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k], one step a frame of {self.frame_s!r} s"
        if self.open_at:
            closing = "as by control.feedback(system, the identity), it is the closed loop"
            return f"{step}, cut at {self.open_at}: closed again by u = -y, {closing}."
        held = "Forces are held for a frame; noise is added to each sample taken in it"
        return f"{step}. {held}; y are the values just before it."

    def to_control(self) -> control.StateSpace:
        """Return it as python-control's, names in letters, digits and `_`. Raises ApcError (E875)."""
        return self._shown("control")


@dataclass(frozen=True, slots=True, eq=False)
class FrameNumbers:
    """The numerical parts of a frame in one number type.

    `subsystem` returns the matrices of some peers, `inverses` the 1/m of the bodies with force inputs,
    `steps` [F G] for durations in seconds, with the given number of inputs after the holds, forces first.
    """

    subsystem: Callable[[PeerClass], LinearSubsystem]
    inverses: Callable[[PeerClass, ForceInput], Sequence[Any]]
    steps: Callable[[PeerClass, Sequence[ForceInput], int, Sequence[Fraction]], list[Matrix]]
    arithmetic: Arithmetic


def steps_in_floats(
    group: PeerClass, forces: Sequence[ForceInput], count: int, durations: Sequence[Fraction]
) -> list[Matrix]:
    """Return [F G] of some durations in floats, of exact matrices: see `FrameNumbers`."""
    columns = np.zeros((len(group.exact.a), count), dtype=object)
    for index, push in enumerate(forces):
        columns[list(push.velocities), index] = push.inverses
    steps = discretize(group.exact.a, np.concatenate([group.exact.b, columns], axis=1), durations)
    return [value_of(step) for step in steps]


IN_FLOATS = FrameNumbers(
    lambda group: group.subsystem, lambda group, push: [*map(float, push.inverses)], steps_in_floats, FLOATS
)


def state_space(system: Model, *, open_at: str = "") -> StateSpace:
    """Lift a model, all its peers in one system.

    Parameters
    ----------
    system
        The model.
    open_at
        The link or coupler to cut it at; "" leaves it closed.

    Raises
    ------
    ApcError
        E950 nothing to cut at; E951 too many states; and those of `analysis.lifted_groups`.
    """
    groups, exchange = peers_of(system)
    (a, b, c, d), (states, inputs, outputs), unpushed = lifted(system, groups, exchange, open_at, IN_FLOATS)
    if not all(np.isfinite(block).all() for block in (a, b, c, d)):
        raise ApcError(Diagnostic("E806", SourceLocation(system.name), TOO_LARGE))
    frame_s, notes = description(system)
    notes = (*notes, *unpushed)
    return StateSpace(
        system.name, open_at, frame_s, a, b, c, d, states, inputs, outputs, notes, made_by(system)
    )


def peers_of(
    system: Model, *, prepared: Prepared | None = None
) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
    """Return the peers of a system as `analysis.lifted_groups`, with oversized systems refused as E951."""
    try:
        return lifted_groups(system, prepared=prepared)
    except ApcError as error:
        if any(mistake.code != "E804" for mistake in error.mistakes):
            raise
        message = error.mistakes[0].message
        raise ApcError(
            Diagnostic("E951", SourceLocation(system.origin.topology), message, hint="fewer peers")
        ) from None


def description(system: Model) -> tuple[float, tuple[str, ...]]:
    """Return the length of a frame of a model, in seconds, and the limitations of its linear map."""
    prepared = prepare(system)
    return float(prepared.schedules[0].frame_s), (*near_start(system, prepared), *limitations(system))


def made_by(system: Model) -> str:
    """Return the provenance of a model's export, as one line of JSON."""
    description = {
        "topology": system.name,
        "texts": texts_of(system),
        "parameters": parameters_of(system),
        "timings": [(timing.name, str(timing.value)) for timing in system.timings],
        "versions": versions("casadi", "numpy"),
    }
    return json.dumps(description, ensure_ascii=False)


def lifted(
    system: Model,
    groups: Sequence[PeerClass],
    exchange: CommunicationGraph,
    open_at: str,
    numbers: FrameNumbers,
) -> tuple[Blocks, tuple[Labels, Labels, Labels], tuple[str, ...]]:
    """Return A, B, C and D of a model in a kind of number, the names of states, inputs, outputs, and notes.

    Parameters
    ----------
    system, open_at
        As for `state_space`.
    groups, exchange
        Its peers, from `analysis.lifted_groups`.
    numbers
        The numerical parts of the frame.
    """
    with single_threaded(), finite_equations(system.name), np.errstate(all="ignore"):
        link = _link_of(system, open_at)
        opened = [_open_loop(system, group, "" if link else open_at, numbers) for group in groups]
        _check_size(system, opened)
        loop = dense_loop([item.group for item in opened], exchange)
        of_schedule = {id(item.group.schedule): item for item in opened}
        subsystems = [of_schedule[id(subsystem.schedule)] for subsystem in loop.subsystems]
        blocks, labels = _closed(loop, subsystems, link=link, open_at=open_at, arithmetic=numbers.arithmetic)
    notes = () if open_at else tuple(dict.fromkeys(note for item in opened for note in item.unpushed))
    return blocks, labels, notes


@dataclass(frozen=True, slots=True, eq=False)
class _DrivenPeers:
    """Peers with external inputs: `group` includes the inputs, `map` is their frame map.

    `signals` are the simulated signals with their indices in z, `inputs` the inputs with theirs. `cuts` are
    the forces cut open and the entries of z with their computed values; the last received values replace
    them. `unpushed` lists the bodies without force input, with the reason.
    """

    group: PeerClass
    map: FrameMap
    signals: Placed
    inputs: Placed
    cuts: Placed
    unpushed: tuple[str, ...]


def _open_loop(system: Model, group: PeerClass, open_at: str, numbers: FrameNumbers) -> _DrivenPeers:
    """Let forces and noise into some peers, and cut the forces of a coupler open."""
    schedule, peer_type = _remembering(group), group.jacobians.peer_type
    (forces, unpushed), noises = _masses(system, group), _measured(group.subsystem)
    inverses = [numbers.inverses(group, force) for force in forces]
    wide = _with_inputs(numbers.subsystem(group), forces, inverses, noises)
    count = len(forces) + len(noises)
    nothing = np.zeros((0, sum(wide.b.shape)), dtype=wide.b.dtype)
    (subsystem,), full, ports = with_ports([wide], schedule, count, [0], [nothing], [])
    subsystem, full, cuts = _cut_open(subsystem, full, open_at)
    check_packets(full)
    durations = step_durations(full)
    steps = numbers.steps(group, forces, count, [duration * full.quantum for duration in durations])
    frame = compose(subsystem, full, dict(zip(durations, steps, strict=True)), numbers=numbers.arithmetic)
    first = {value: len(peer_type.states) + k for k, value in enumerate(schedule.discrete_states)}
    signals = [
        (
            ExportedSignal(local_signal.name, local_signal.unit),
            local_signal.index[0]
            if local_signal.role == "state"
            else first[ClockedValue(local_signal.index[0], local_signal.index[1], -1)],
        )
        for local_signal in local_signals(peer_type, group.schedule)
        if local_signal.role in ("state", "output")
    ]
    inputs = [ExportedSignal(f"force on {push.part}", "N") for push in forces]
    inputs += [
        ExportedSignal(f"noise on {peer_type.states[index].name}", peer_type.states[index].unit)
        for index in noises
    ]
    return _DrivenPeers(
        group=group.with_subsystem(subsystem, group.exact, full, frame.mapped(MIDPOINT_RADIUS.exact)),
        map=frame,
        signals=signals,
        inputs=list(zip(inputs, ports.input_slots.ravel().tolist(), strict=True)),
        cuts=cuts,
        unpushed=tuple(unpushed),
    )


def _remembering(group: PeerClass) -> Schedule:
    """Return a peer's frame map with the last computed values of its clocks among the states."""
    schedule, peer_type = group.schedule, group.jacobians.peer_type
    at = _instants(schedule)
    values = [
        ClockedValue(p, o, -1)
        for p in ticking_partitions(schedule)
        for o in range(len(peer_type.clocks[p].outputs))
    ]
    values = [value for value in values if value not in schedule.discrete_states]
    names = [
        f"{peer_type.clocks[value.partition].outputs[value.output]}"
        f"({float((at[value.partition][-1] - schedule.frame) * schedule.quantum * 1000):.6g} ms)"
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


def _masses(system: Model, group: PeerClass) -> tuple[list[ForceInput], list[str]]:
    """Return a peer's bodies with a mass as force inputs, axis by axis; and the reasons for others."""
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    known: dict[str, Device | str | None] = {}
    result = [
        find_push(group.jacobians, group.parameters, unit_of, group.initial_reception, index, known)
        for index, state in enumerate(group.jacobians.peer_type.states)
        if state.unit == "m"
    ]
    pushes: dict[str, ForceInput] = {}
    for push in result:
        if isinstance(push, ForceInput):
            pushes.setdefault(push.part, push)
    refused = dict.fromkeys(f"no force of its own: {text}" for text in result if isinstance(text, str))
    return list(pushes.values()), list(refused)


def _measured(subsystem: LinearSubsystem) -> list[int]:
    """Return the states that something samples."""
    looking = [
        values.any(axis=0)
        for values in (*(tick.x for tick in subsystem.ticks), *(send.x for send in subsystem.sends))
    ]
    indices: list[int] = np.flatnonzero(np.any(looking, axis=0)).tolist() if looking else []
    return indices


def _with_inputs(
    subsystem: LinearSubsystem,
    forces: Sequence[ForceInput],
    inverses: Sequence[Sequence[Any]],
    noises: Sequence[int],
) -> LinearSubsystem:
    """Return a subsystem with a hold for each force and for each noise, which is added to sampled values.

    `inverses` are what each force does to each of its velocities, `noises` the states with noisy samples.
    """
    columns = np.zeros((len(subsystem.a), len(forces) + len(noises)), dtype=subsystem.b.dtype)
    for index, (push, inverse) in enumerate(zip(forces, inverses, strict=True)):
        columns[list(push.velocities), index] = inverse
    wide = with_holds(subsystem, columns)
    sampled = [*((tick.u, tick.x) for tick in wide.ticks), *((send.u, send.x) for send in wide.sends)]
    for u, x in sampled if noises else ():
        u[:, -len(noises) :] = x[:, noises]
    return wide


def _link_of(system: Model, open_at: str) -> str:
    """Return the link that a cut names, "" for a coupler. Raises ApcError (E950) if it names neither."""
    links = [link.name for link in system.links]
    parts = {hold.name.rpartition(".")[0] for peer_type in system.peer_types for hold in peer_type.holds}
    if open_at in links:
        return open_at
    if open_at and open_at not in parts:
        known = [*links, *sorted(parts)]
        listed = ", ".join(known) or "it has none"
        message = f"{open_at[:80]} is no link or coupler with ticks of {system.name} ({listed})"
        near = nearest(open_at, known) or (known[0] if known else "")
        raise ApcError(
            Diagnostic("E950", SourceLocation("--open-at"), message, hint=f"--open-at {near}" if near else "")
        )
    return ""


def _cut_open(
    subsystem: LinearSubsystem, schedule: Schedule, open_at: str
) -> tuple[LinearSubsystem, Schedule, Placed]:
    """Make the forces of a coupler external inputs at each tick; the computed forces are entries of z."""
    peer_type = subsystem.peer_type
    numbers = {partition.clock: p for p, partition in enumerate(peer_type.clocks)}
    forces = [hold for hold in peer_type.holds if open_at and hold.name.rpartition(".")[0] == open_at]
    cuts = list(dict.fromkeys((numbers[hold.clock], hold.output) for hold in forces))
    cuts = [(partition, output) for partition, output in cuts if schedule.ticks[partition]]
    at, ports = _instants(schedule), []
    for partition, output in cuts:
        clock = peer_type.clocks[partition]
        times = [float(number * schedule.quantum * 1000) for number in at[partition]]
        ports += [
            ExportedSignal(f"{clock.outputs[output]} at {when:.6g} ms", clock.units[output]) for when in times
        ]
    if len(schedule.received) + len(ports) > MOST_PACKETS:
        message = (
            f"{len(ports):,} ticks a frame, each an input where it is cut, and {MOST_PACKETS} are the most"
        )
        raise ApcError(Diagnostic("E951", SourceLocation("--open-at"), message, hint="--open-at LINK"))
    wide, whole = with_cuts(subsystem, schedule, cuts)
    names = (*schedule.value_names, *(f"{port.name} computed" for port in ports))
    first = len(peer_type.states) + len(schedule.discrete_states)
    computed = [(port, first + index) for index, port in enumerate(ports)]
    return wide, replace(whole, value_names=names), computed


def _check_size(system: Model, opened: Sequence[_DrivenPeers]) -> None:
    """Refuse a model whose matrix does not fit the memory: ApcError E951."""
    columns = sum(item.group.count * states_of(item.group.schedule, item.group.jacobians) for item in opened)
    peers = sum(item.group.count for item in opened)
    message = f"{columns:,} × {columns:,} numbers, the states and inputs of all {peers:,} peers together,"
    first = max(opened, key=lambda opened: opened.group.count).group
    hint = f"fewer peers: --set {system.groups[0].name if len(opened) == 1 else first.name}.count=10"
    refuse_beyond(ENTRY * columns**2, "E951", SourceLocation(system.origin.topology), message, hint)


def _closed(
    loop: ModalSystem,
    subsystems: Sequence[_DrivenPeers],
    *,
    link: str,
    open_at: str,
    arithmetic: Arithmetic,
) -> tuple[Blocks, tuple[Labels, Labels, Labels]]:
    """Close a loop, but where it is cut; return A, B, C and D, and the names of states, inputs, outputs."""
    layout = lay_out_loop(loop)
    n, peers = len(layout.names), [subsystem.name for subsystem in loop.subsystems]
    received = [subsystem.group.schedule.received for subsystem in subsystems]
    opened = [
        [
            row
            for row, subject in enumerate(rows)
            if subject is OUTSIDE or (link and subject.coupling_term.link == link)
        ]
        for rows in received
    ]
    maps = [_from_outside(subsystem.map, rows) for subsystem, rows in zip(subsystems, opened, strict=True)]
    whole = interconnect_with_inputs(loop, maps, [*map(len, opened)], layout, numbers=arithmetic)

    def spread(listed: Sequence[Placed]) -> tuple[Labels, Indices]:
        """Return the entries of each subsystem by its peer's name, and their indices in the state."""
        every = [
            (_named(port, peer), index + offset)
            for ports, peer, offset in zip(listed, peers, layout.offsets, strict=True)
            for port, index in ports
        ]
        return tuple(port for port, _ in every), np.array([index for _, index in every], np.intp)

    inputs, input_slots = spread([subsystem.inputs for subsystem in subsystems])
    forces, computed = spread([subsystem.cuts for subsystem in subsystems])
    stored = np.delete(np.arange(n), np.concatenate([input_slots, computed]))
    names = layout.names if len(subsystems) > 1 else tuple(f"{peers[0]}.{name}" for name in layout.names)
    units = {
        name: _units(subsystem.group.jacobians.peer_type)
        for name, subsystem in zip(peers, subsystems, strict=True)
    }
    states = tuple(ExportedSignal(name, _unit(units, name)) for name in map(names.__getitem__, stored))
    matrix, outer = whole.matrix, slice(n, None)
    if not open_at:
        outputs, observed = spread([subsystem.signals for subsystem in subsystems])
        c = (stored[None, :] == observed[:, None]).astype(np.float64)
        blocks = (
            matrix[np.ix_(stored, stored)],
            matrix[np.ix_(stored, input_slots)],
            c,
            np.zeros((len(c), len(input_slots))),
        )
        return blocks, (states, inputs, outputs)
    if link:
        sent = {name: unit for item in units.values() for name, unit in item.items()}
        forces, _ = spread([_received_ports(rows, link, sent) for rows in received])
        back = -np.concatenate([r[rows] for r, rows in zip(whole.received, opened, strict=True)])
    else:
        back = -matrix[computed]
    outputs = tuple(replace(port, name=f"{port.name} back") for port in forces)
    blocks = matrix[np.ix_(stored, stored)], matrix[stored, outer], back[:, stored], back[:, outer]
    return blocks, (states, forces, outputs)


def _from_outside(frame_map: FrameMap, rows: Sequence[int]) -> FrameMap:
    """Return a peer's map that has some received values as external inputs, after all others."""
    q, d = (np.concatenate([block, block[:, rows]], axis=1) for block in (frame_map.q, frame_map.d))
    q[:, rows] = d[:, rows] = 0.0
    return replace(frame_map, q=q, d=d)


def _named(port: ExportedSignal, peer: str) -> ExportedSignal:
    """Return a peer's port, its name with the peer's: `force on left[2].cube`."""
    word, on, rest = port.name.rpartition(" on ")
    return replace(port, name=f"{word}{on}{peer}.{rest}")


def _received_ports(received: Sequence[ReceivedSample], link: str, units: Mapping[str, str]) -> Placed:
    """Return the received samples of a peer over a link: packet of the frame, and age in frames."""
    received = [subject for subject in received if subject.coupling_term.link == link]
    several = any(subject.sent.slot for subject in received)
    named = [
        f"{subject.coupling_term.operator} "
        f"{subject.sent.channel}{f' #{subject.sent.slot + 1}' * several}({-subject.lag})"
        for subject in received
    ]
    listed = zip(named, received, strict=True)
    return [(ExportedSignal(name, units[subject.sent.channel]), 0) for name, subject in listed]


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
    peer, _, local = name.partition(".")
    return units[peer][local.partition("(")[0].partition(" ")[0]]
