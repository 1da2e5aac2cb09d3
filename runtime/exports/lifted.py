"""A scene over one frame as a state space, all peers in it: from forces and noise to what is simulated.

Takes: a `Model`; a link or coupler to cut it at.
Gives: `StateSpace`, `state_space`; `FrameNumbers`, `lifted`, `peers_of`, `steps_in_floats`: the same in any
kind of number.
Guarantees: every event within a frame is in it, exactly but for rounding; its eigenvalues are those that
`analyze` finds, and 0 for each force that nothing else remembers until the frame ends. Cut open and closed
again by u = −y it is the closed loop.
Does not: write files (see `state_space_files`), or keep equal peers apart from different ones.

    x⁺ = A x + B u      y = C x + D u      once a frame

A force that comes in is held from one frame's beginning to the next; noise is added to every sample that is
taken of a measured value in that time, by ticks and by packets alike. What comes out is what a row of
`apc simulate` has at the frame's beginning: values just before the tick. Of a scene that is not linear, or
that forces of its own push, these are the small motions about its start.

Cut at a link, u is what each peer hears over it and −y what it would hear; cut at a coupler, u is what each
of its forces is at each tick of a frame and −y what the tick computed. D then holds what is sent or computed
upon it within the frame.
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
from apc.eigen.closing import ModalSystem, close_outside, lay_out_loop
from apc.eigen.modes import dense_loop
from apc.eigen.peers import PeerClass, states_of
from apc.exports.identifiers import ExportedSignal
from apc.frame.devices import Device, ForceInput, find_push
from apc.frame.discretize import TOO_LARGE, discretize
from apc.frame.exchange import CommunicationGraph
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.lift import MOST_PACKETS, FrameMap, check_packets, compose, step_durations
from apc.frame.ports import OUTSIDE, with_cuts, with_holds, with_ports
from apc.frame.radius import FLOATS, RADII, Arithmetic, value_of
from apc.frame.schedule import ClockedValue, ReceivedSample, Schedule, Tick
from apc.frame.site import LinearSubsystem
from apc.memory import refuse_beyond
from apc.network.nominal import left_out
from apc.result import Result
from apc.simulation.program import timed_events
from apc.simulation.signals import local_signals, ticking_partitions
from apc.simulation.trajectory import parameters_of, texts_of
from apc.threads import single_threaded

if TYPE_CHECKING:
    import control

Floats = NDArray[np.float64]
Places = NDArray[np.intp]
Matrix = NDArray[Any]
Blocks = tuple[Matrix, Matrix, Matrix, Matrix]

# Bytes of an entry of the closed matrix while it is made: the matrix, its parts, and what is sent.
ENTRY = 40


Labels = tuple[ExportedSignal, ...]
Placed = list[tuple[ExportedSignal, int]]  # and where each is in z


@dataclass(frozen=True, slots=True, eq=False)
class StateSpace(Result):
    """A scene as a discrete state space with the sample time `frame_s`; `cut` is where it is cut, "" closed.

    `notes` say what it leaves out. Where numbers are `free`, `function` is a `casadi.Function` of them, one
    argument each in SI, that gives A, B, C and D.
    """

    shown_by = "exports_output:state_space"

    topology: str
    cut: str
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
    free: tuple[ExportedSignal, ...] = ()
    function: Any = None

    @property
    def matrices(self) -> tuple[Floats, Floats, Floats, Floats]:
        """A, B, C and D."""
        return self.a, self.b, self.c, self.d

    @property
    def what(self) -> str:
        """The closed loop, or where it is cut."""
        return f"the loop cut at {self.cut}" if self.cut else "the closed loop"

    @property
    def meaning(self) -> str:
        """How inputs are held, and when outputs are read."""
        step = f"x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k], one step a frame of {self.frame_s!r} s"
        if self.cut:
            closing = "as by control.feedback(system, the identity), it is the closed loop"
            return f"{step}, cut at {self.cut}: closed again by u = -y, {closing}."
        held = "Forces are held for a frame; noise is added to each sample taken in it"
        return f"{step}. {held}; y are the values just before it."

    def to_control(self) -> control.StateSpace:
        """Return it as python-control's, names in letters, digits and `_`. Raises ApcError (E875)."""
        return self._shown("control")


@dataclass(frozen=True, slots=True, eq=False)
class FrameNumbers:
    """What a frame is made of in a kind of number.

    `site` gives the matrices of some peers, `inverses` the 1/m of what is pushed, `steps` [F G] of each of
    some durations in seconds, with so many inputs behind the holds, forces first.
    """

    site: Callable[[PeerClass], LinearSubsystem]
    inverses: Callable[[PeerClass, ForceInput], Sequence[Any]]
    steps: Callable[[PeerClass, Sequence[ForceInput], int, Sequence[Fraction]], list[Matrix]]
    arithmetic: Arithmetic


def steps_in_floats(
    group: PeerClass, forces: Sequence[ForceInput], count: int, durations: Sequence[Fraction]
) -> list[Matrix]:
    """Return [F G] of some durations in floats, of exact matrices: see `FrameNumbers`."""
    columns = np.zeros((len(group.exact.a), count), dtype=object)
    for place, push in enumerate(forces):
        columns[list(push.velocities), place] = push.inverses
    steps = discretize(group.exact.a, np.concatenate([group.exact.b, columns], axis=1), durations)
    return [value_of(step) for step in steps]


IN_FLOATS = FrameNumbers(
    lambda group: group.site, lambda group, push: [*map(float, push.inverses)], steps_in_floats, FLOATS
)


def state_space(system: Model, *, cut: str = "") -> StateSpace:
    """Lift a scene, all its peers in one system.

    Parameters
    ----------
    system
        The compiled scene.
    cut
        The link or coupler to cut it at; "" leaves it closed.

    Raises
    ------
    ApcError
        E950 nothing to cut at; E951 too many states; and those of `analysis.lifted_groups`.
    """
    groups, exchange = peers_of(system)
    (a, b, c, d), (states, inputs, outputs), unpushed = lifted(system, groups, exchange, cut, IN_FLOATS)
    if not all(np.isfinite(block).all() for block in (a, b, c, d)):
        raise ApcError(Diagnostic("E806", SourceLocation(system.name), TOO_LARGE))
    frame_s, notes = about(system)
    notes = (*notes, *unpushed)
    return StateSpace(system.name, cut, frame_s, a, b, c, d, states, inputs, outputs, notes, made_by(system))


def peers_of(
    system: Model, *, prepared: Prepared | None = None
) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
    """Return the peers of a system as `analysis.lifted_groups`, and what is too large as E951."""
    try:
        return lifted_groups(system, prepared=prepared)
    except ApcError as error:
        if any(mistake.code != "E804" for mistake in error.mistakes):
            raise
        what = error.mistakes[0].what
        raise ApcError(
            Diagnostic("E951", SourceLocation(system.origin.topology), what, hint="fewer peers")
        ) from None


def about(system: Model) -> tuple[float, tuple[str, ...]]:
    """Return how long a frame of a scene is, in seconds, and what its linear map leaves out."""
    prepared = prepare(system)
    return float(prepared.schedules[0].frame_s), (*near_start(system, prepared), *left_out(system))


def made_by(system: Model) -> str:
    """Return what a scene's export is made of, as one line of JSON."""
    about = {
        "topology": system.name,
        "texts": texts_of(system),
        "parameters": parameters_of(system),
        "timings": [(timing.name, str(timing.value)) for timing in system.timings],
        "versions": versions("casadi", "numpy"),
    }
    return json.dumps(about, ensure_ascii=False)


def lifted(
    system: Model, groups: Sequence[PeerClass], exchange: CommunicationGraph, cut: str, numbers: FrameNumbers
) -> tuple[Blocks, tuple[Labels, Labels, Labels], tuple[str, ...]]:
    """Return A, B, C and D of a scene in a kind of number, the names of states, inputs, outputs, and notes.

    Parameters
    ----------
    system, cut
        As for `state_space`.
    groups, exchange
        Its peers, from `analysis.lifted_groups`.
    numbers
        What the matrices are of.
    """
    with single_threaded(), finite_equations(system.name), np.errstate(all="ignore"):
        link = _link_of(system, cut)
        opened = [_open(system, group, "" if link else cut, numbers) for group in groups]
        _check_size(system, opened)
        loop = dense_loop([item.group for item in opened], exchange)
        of_schedule = {id(item.group.schedule): item for item in opened}
        sites = [of_schedule[id(site.schedule)] for site in loop.sites]
        blocks, labels = _closed(loop, sites, link=link, cut=cut, arithmetic=numbers.arithmetic)
    notes = () if cut else tuple(dict.fromkeys(note for item in opened for note in item.unpushed))
    return blocks, labels, notes


@dataclass(frozen=True, slots=True, eq=False)
class _DrivenPeers:
    """Peers that are moved from outside: `group` has the ways in, `map` is their frame.

    `signals` and where each is in z are what is simulated, `inputs`
    and the entries of z that they come in at what moves them. `cuts` are the forces cut open and the entries
    of z that hold what the ticks made of them; the last of what is heard stands in their place. `unpushed`
    says what no force comes in at, and why.
    """

    group: PeerClass
    map: FrameMap
    signals: Placed
    inputs: Placed
    cuts: Placed
    unpushed: tuple[str, ...]


def _open(system: Model, group: PeerClass, cut: str, numbers: FrameNumbers) -> _DrivenPeers:
    """Let forces and noise into some peers, and cut the forces of a coupler open."""
    schedule, kind = _remembering(group), group.jacobians.kind
    (forces, unpushed), noises = _masses(system, group), _measured(group.site)
    inverses = [numbers.inverses(group, force) for force in forces]
    wide = _with_inputs(numbers.site(group), forces, inverses, noises)
    count = len(forces) + len(noises)
    nothing = np.zeros((0, sum(wide.b.shape)), dtype=wide.b.dtype)
    (site,), full, ports = with_ports([wide], schedule, count, [0], [nothing], [])
    site, full, cuts = _cut_open(site, full, cut)
    check_packets(full)
    durations = step_durations(full)
    steps = numbers.steps(group, forces, count, [duration * full.quantum for duration in durations])
    frame = compose(site, full, dict(zip(durations, steps, strict=True)), numbers=numbers.arithmetic)
    first = {value: len(kind.states) + k for k, value in enumerate(schedule.carried)}
    signals = [
        (
            ExportedSignal(local_signal.name, local_signal.unit),
            local_signal.place[0]
            if local_signal.role == "state"
            else first[ClockedValue(local_signal.place[0], local_signal.place[1], -1)],
        )
        for local_signal in local_signals(kind, group.schedule)
        if local_signal.role in ("state", "output")
    ]
    inputs = [ExportedSignal(f"force on {push.part}", "N") for push in forces]
    inputs += [
        ExportedSignal(f"noise on {kind.states[place].name}", kind.states[place].unit) for place in noises
    ]
    return _DrivenPeers(
        group=group.with_site(site, group.exact, full, frame.mapped(RADII.exact)),
        map=frame,
        signals=signals,
        inputs=list(zip(inputs, ports.drawn.ravel().tolist(), strict=True)),
        cuts=cuts,
        unpushed=tuple(unpushed),
    )


def _remembering(group: PeerClass) -> Schedule:
    """Return a peer's frame with all that its clocks computed last among what it remembers."""
    schedule, kind = group.schedule, group.jacobians.kind
    at = _instants(schedule)
    values = [
        ClockedValue(p, o, -1)
        for p in ticking_partitions(schedule)
        for o in range(len(kind.clocks[p].outputs))
    ]
    values = [value for value in values if value not in schedule.carried]
    names = [
        f"{kind.clocks[value.partition].outputs[value.output]}"
        f"({float((at[value.partition][-1] - schedule.frame) * schedule.quantum * 1000):.6g} ms)"
        for value in values
    ]
    return replace(
        schedule,
        carried=(*schedule.carried, *values),
        value_names=(*schedule.value_names, *names),
        repeats=None,
    )


def _instants(schedule: Schedule) -> dict[int, list[int]]:
    """Return when in a frame each clock partition ticks, in quanta."""
    result: dict[int, list[int]] = {}
    for now, event in timed_events(schedule):
        if isinstance(event, Tick):
            result.setdefault(event.partition, []).append(now)
    return result


def _masses(system: Model, group: PeerClass) -> tuple[list[ForceInput], list[str]]:
    """Return what of a peer has a mass, and so can be pushed, each axis by itself; and why what can't."""
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    known: dict[str, Device | str | None] = {}
    result = [
        find_push(group.jacobians, group.parameters, unit_of, group.listening, place, known)
        for place, state in enumerate(group.jacobians.kind.states)
        if state.unit == "m"
    ]
    pushes: dict[str, ForceInput] = {}
    for push in result:
        if isinstance(push, ForceInput):
            pushes.setdefault(push.part, push)
    refused = dict.fromkeys(f"no force of its own: {text}" for text in result if isinstance(text, str))
    return list(pushes.values()), list(refused)


def _measured(site: LinearSubsystem) -> list[int]:
    """Return the states that something samples."""
    looking = [
        values.any(axis=0) for values in (*(tick.x for tick in site.ticks), *(send.x for send in site.sends))
    ]
    places: list[int] = np.flatnonzero(np.any(looking, axis=0)).tolist() if looking else []
    return places


def _with_inputs(
    site: LinearSubsystem,
    forces: Sequence[ForceInput],
    inverses: Sequence[Sequence[Any]],
    noises: Sequence[int],
) -> LinearSubsystem:
    """Return a site with a hold for each force and for each noise, which is added to what is sampled.

    `inverses` are what each force does to each of its velocities, `noises` the states with noisy samples.
    """
    columns = np.zeros((len(site.a), len(forces) + len(noises)), dtype=site.b.dtype)
    for place, (push, inverse) in enumerate(zip(forces, inverses, strict=True)):
        columns[list(push.velocities), place] = inverse
    wide = with_holds(site, columns)
    sampled = [*((tick.u, tick.x) for tick in wide.ticks), *((send.u, send.x) for send in wide.sends)]
    for u, x in sampled if noises else ():
        u[:, -len(noises) :] = x[:, noises]
    return wide


def _link_of(system: Model, cut: str) -> str:
    """Return the link that a cut names, "" for a coupler. Raises ApcError (E950) if it names neither."""
    links = [link.name for link in system.links]
    parts = {hold.name.rpartition(".")[0] for kind in system.kinds for hold in kind.holds}
    if cut in links:
        return cut
    if cut and cut not in parts:
        known = [*links, *sorted(parts)]
        listed = ", ".join(known) or "it has none"
        what = f"{cut[:80]} is no link or coupler with ticks of {system.name} ({listed})"
        near = nearest(cut, known) or (known[0] if known else "")
        raise ApcError(
            Diagnostic("E950", SourceLocation("--cut"), what, hint=f"--cut {near}" if near else "")
        )
    return ""


def _cut_open(
    site: LinearSubsystem, schedule: Schedule, cut: str
) -> tuple[LinearSubsystem, Schedule, Placed]:
    """Let the forces of a coupler come from outside at each tick; what the tick computes of them is in z."""
    kind = site.kind
    numbers = {partition.clock: p for p, partition in enumerate(kind.clocks)}
    forces = [hold for hold in kind.holds if cut and hold.name.rpartition(".")[0] == cut]
    cuts = list(dict.fromkeys((numbers[hold.clock], hold.output) for hold in forces))
    cuts = [(partition, output) for partition, output in cuts if schedule.ticks[partition]]
    at, ports = _instants(schedule), []
    for partition, output in cuts:
        clock = kind.clocks[partition]
        times = [float(number * schedule.quantum * 1000) for number in at[partition]]
        ports += [
            ExportedSignal(f"{clock.outputs[output]} at {when:.6g} ms", clock.units[output]) for when in times
        ]
    if len(schedule.heard) + len(ports) > MOST_PACKETS:
        what = f"{len(ports):,} ticks a frame, each an input where it is cut, and {MOST_PACKETS} are the most"
        raise ApcError(Diagnostic("E951", SourceLocation("--cut"), what, hint="--cut LINK"))
    wide, whole = with_cuts(site, schedule, cuts)
    names = (*schedule.value_names, *(f"{port.name} computed" for port in ports))
    first = len(kind.states) + len(schedule.carried)
    computed = [(port, first + place) for place, port in enumerate(ports)]
    return wide, replace(whole, value_names=names), computed


def _check_size(system: Model, opened: Sequence[_DrivenPeers]) -> None:
    """Refuse a scene whose matrix does not fit the memory: ApcError E951."""
    columns = sum(item.group.count * states_of(item.group.schedule, item.group.jacobians) for item in opened)
    peers = sum(item.group.count for item in opened)
    what = f"{columns:,} × {columns:,} numbers, the states and inputs of all {peers:,} peers together,"
    first = max(opened, key=lambda opened: opened.group.count).group
    hint = f"fewer peers: --set {system.groups[0].name if len(opened) == 1 else first.name}.count=10"
    refuse_beyond(ENTRY * columns**2, "E951", SourceLocation(system.origin.topology), what, hint)


def _closed(
    loop: ModalSystem,
    sites: Sequence[_DrivenPeers],
    *,
    link: str,
    cut: str,
    arithmetic: Arithmetic,
) -> tuple[Blocks, tuple[Labels, Labels, Labels]]:
    """Close a loop, but where it is cut; return A, B, C and D, and the names of states, inputs, outputs."""
    layout = lay_out_loop(loop)
    n, peers = len(layout.names), [site.name for site in loop.sites]
    heard = [site.group.schedule.heard for site in sites]
    opened = [
        [row for row, what in enumerate(rows) if what is OUTSIDE or (link and what.way.link == link)]
        for rows in heard
    ]
    maps = [_from_outside(site.map, rows) for site, rows in zip(sites, opened, strict=True)]
    whole = close_outside(loop, maps, [*map(len, opened)], layout, numbers=arithmetic)

    def spread(listed: Sequence[Placed]) -> tuple[Labels, Places]:
        """Return what each site has, by its peer's name, and where in the state."""
        every = [
            (_named(port, peer), place + offset)
            for ports, peer, offset in zip(listed, peers, layout.offsets, strict=True)
            for port, place in ports
        ]
        return tuple(port for port, _ in every), np.array([place for _, place in every], np.intp)

    inputs, drawn = spread([site.inputs for site in sites])
    forces, computed = spread([site.cuts for site in sites])
    kept = np.delete(np.arange(n), np.concatenate([drawn, computed]))
    names = layout.names if len(sites) > 1 else tuple(f"{peers[0]}.{name}" for name in layout.names)
    units = {name: _units(site.group.jacobians.kind) for name, site in zip(peers, sites, strict=True)}
    states = tuple(ExportedSignal(name, _unit(units, name)) for name in map(names.__getitem__, kept))
    matrix, outer = whole.matrix, slice(n, None)
    if not cut:
        outputs, seen = spread([site.signals for site in sites])
        c = (kept[None, :] == seen[:, None]).astype(np.float64)
        blocks = matrix[np.ix_(kept, kept)], matrix[np.ix_(kept, drawn)], c, np.zeros((len(c), len(drawn)))
        return blocks, (states, inputs, outputs)
    if link:
        sent = {name: unit for item in units.values() for name, unit in item.items()}
        forces, _ = spread([_heard_ports(rows, link, sent) for rows in heard])
        back = -np.concatenate([r[rows] for r, rows in zip(whole.heard, opened, strict=True)])
    else:
        back = -matrix[computed]
    outputs = tuple(replace(port, name=f"{port.name} back") for port in forces)
    blocks = matrix[np.ix_(kept, kept)], matrix[kept, outer], back[:, kept], back[:, outer]
    return blocks, (states, forces, outputs)


def _from_outside(frame_map: FrameMap, rows: Sequence[int]) -> FrameMap:
    """Return a peer's map that takes some of what it hears from outside, behind all that it hears."""
    q, d = (np.concatenate([block, block[:, rows]], axis=1) for block in (frame_map.q, frame_map.d))
    q[:, rows] = d[:, rows] = 0.0
    return replace(frame_map, q=q, d=d)


def _named(port: ExportedSignal, peer: str) -> ExportedSignal:
    """Return a peer's port, its name with the peer's: `force on left[2].cube`."""
    word, on, rest = port.name.rpartition(" on ")
    return replace(port, name=f"{word}{on}{peer}.{rest}")


def _heard_ports(heard: Sequence[ReceivedSample], link: str, units: Mapping[str, str]) -> Placed:
    """Return what a peer hears over a link: of which packet of a frame, and how many frames ago."""
    heard = [what for what in heard if what.way.link == link]
    several = any(what.sent.slot for what in heard)
    named = [
        f"{what.way.operator} {what.sent.channel}{f' #{what.sent.slot + 1}' * several}({-what.lag})"
        for what in heard
    ]
    listed = zip(named, heard, strict=True)
    return [(ExportedSignal(name, units[what.sent.channel]), 0) for name, what in listed]


def _units(kind: PeerType) -> dict[str, str]:
    """Return the units of what a peer has: of its states, of what is computed and sent, by their names."""
    result = {state.name: state.unit for state in kind.states}
    for clock in kind.clocks:
        result |= zip(clock.outputs, clock.units, strict=True)
    for send in kind.sends:
        result |= zip(send.channels, send.units, strict=True)
    return result


def _unit(units: Mapping[str, Mapping[str, str]], name: str) -> str:
    """Return the unit of an entry of the state, such as `user[1].coordination.x sent(-8 ms)`."""
    peer, _, own = name.partition(".")
    return units[peer][own.partition("(")[0].partition(" ")[0]]
