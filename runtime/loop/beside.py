"""A run beside what is said of its scene: simulated with what arrived when, analysed with what was measured.

Takes: a `Run`. Gives: `RunComparison`, `compare_run`; `WayRun`, `Ticks`, `ticks_of`.
Guarantees: the simulation is that of `simulate`, fed with the packets that each tick saw; where a peer's part
is missing, or begins later, there is none, and that is said.
Does not: write (see `run`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze
from apc.compiler.compiled import Channel, CompiledSystem
from apc.loop.peer import live_scene
from apc.loop.run import PeerRun, Run, delays_of, trace_name
from apc.moments.network import NetworkVerdict, judge_network
from apc.network.recorded import NetworkRecording, describe_delays
from apc.network.timetable import START, Seen
from apc.result import Result
from apc.simulation.blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from apc.simulation.stepwise import Stepwise

Floats = NDArray[np.float64]

# A way is judged packet by packet only if there are so few of them, none later than so many of its periods:
# each frame is multiplied out, with all packets that are on their way in it.
LONGEST, LATEST = 1_000, 4
SHARES = (0.5, 0.99, 0.999, 1.0)


@dataclass(frozen=True, slots=True)
class Ticks:
    """How late a peer's ticks began and how long they took, in seconds: `SHARES` of them at most so."""

    peer: str
    ticks: int
    late: tuple[float, ...]
    took: tuple[float, ...]
    joined: float
    stopped: bool
    not_given: tuple[str, ...]
    dropped: dict[str, int]


@dataclass(frozen=True, slots=True)
class WayRun:
    """A way's packets: those `sent` (None where the sender's part is missing), and what came."""

    link: str
    sender: str
    receiver: str
    sent: int | None
    came: NetworkRecording
    trace: str


@dataclass(frozen=True, slots=True)
class Measured:
    """What is said of the scene with a link as it was: the `delay` heard after, the packets of a way."""

    link: str
    way: str
    delay: float
    analysis: Analysis
    network: NetworkVerdict | None


@dataclass(frozen=True, slots=True)
class RunComparison(Result):
    """A run beside its scene.

    `apart` has, of each unit of signals, the largest difference between what was played and what is
    simulated, and the largest number played; empty where there is no simulation, and `why_not` says why.
    """

    shown_by: ClassVar[str] = "loop:run_comparison"

    topology: str
    folder: str
    seconds: float
    emulated: bool
    ticks: tuple[Ticks, ...]
    ways: tuple[WayRun, ...]
    apart: dict[str, tuple[float, float]]
    why_not: str
    measured: tuple[Measured, ...]


def ticks_of(peer: PeerRun, frame: float) -> Ticks:
    """Return what is told of a peer's ticks; a frame lasts so many seconds."""
    late, took = (_shares(one) for one in (peer.late, peer.took))
    return Ticks(
        peer=peer.name,
        ticks=len(peer.late),
        late=late,
        took=took,
        joined=peer.first * frame,
        stopped=peer.stopped,
        not_given=peer.not_given,
        dropped=dict(peer.dropped),
    )


def _shares(values: Floats) -> tuple[float, ...]:
    return tuple(float(np.quantile(values, share)) for share in SHARES) if len(values) else ()


def compare_run(run: Run) -> RunComparison:
    """Lay a run beside what `simulate` and `analyze` say of it.

    Raises
    ------
    ApcError
        Those of `prepare`, for a scene that can't be simulated.
    """
    system, peers = run.system, run.peers
    simulation = prepare(live_scene(system), Settings(_duration(peers), jit=False))
    frame = float(simulation.frame * simulation.quantum)
    why_not = _incomplete(system, peers)
    return RunComparison(
        topology=system.name,
        folder=run.folder,
        seconds=max((float(one.time[-1]) for one in peers if len(one.time)), default=0.0),
        emulated=any(one.emulated for one in peers),
        ticks=tuple(ticks_of(one, frame) for one in peers),
        ways=(ways := _ways(run)),
        apart={} if why_not else _apart(run),
        why_not=why_not,
        measured=tuple(_measured(run, link.name, ways) for link in system.links if _heard(ways, link.name)),
    )


def _duration(peers: tuple[PeerRun, ...]) -> Fraction:
    ends = [float(one.time[-1]) for one in peers if len(one.time)]
    return Fraction(max(min(ends, default=0.0), 1e-3)).limit_denominator(10**6)


def _incomplete(system: CompiledSystem, peers: tuple[PeerRun, ...]) -> str:
    """Return why the run can't be simulated again, empty if it can."""
    if len(peers) < system.peers:
        return f"of {system.peers} peers {len(peers)} left their part of the run"
    if own := [one.name for one in peers if one.outside]:
        return f"{', '.join(own)} had a device outside, whose motion is not known"
    if none := [one.name for one in peers if not all(map(len, one.packets))]:
        return f"{', '.join(none)} ended before the first tick that hears"
    late = [one.name for one in peers if one.first]
    return f"{', '.join(late)} joined later, or again, in a state that others had not" if late else ""


class _AsSeen:
    """What the ticks of a run saw, frame by frame (see `Timetable`)."""

    def __init__(self, run: Run, simulation: object) -> None:
        self.now = 0
        self.seen = []
        population = simulation.population  # type: ignore[attr-defined]
        self.frame = population.frame
        self.routes = population.hearing.routes
        for place, route in enumerate(self.routes):
            rows = min(len(one.packets[place]) for one in run.peers if one.packets[place].size)
            packets = np.full((rows, len(route.pairs)), START, np.int64)
            missing = np.zeros(packets.shape, np.bool_)
            for peer in run.peers:
                ways = np.flatnonzero(route.pairs[:, 1] == peer.number)
                if len(ways):
                    packets[:, ways] = peer.packets[place][:rows]
                    missing[:, ways] = peer.missing[place][:rows]
            self.seen.append(Seen(packets, missing))

    def take(self, until: int) -> tuple[Seen, ...]:
        """Return what each route's ticks saw until an instant in quanta, a whole number of frames."""
        first, last, self.now = self.now // self.frame, until // self.frame, until
        found = []
        for route, seen in zip(self.routes, self.seen, strict=True):
            rows = np.minimum(np.arange(first * route.ticks, last * route.ticks), len(seen.packets) - 1)
            found.append(Seen(seen.packets[rows], seen.missing[rows]))
        return tuple(found)


def _apart(run: Run) -> dict[str, tuple[float, float]]:
    """Return how far the peers' signals are from the simulated ones, by unit."""
    simulation = prepare(live_scene(run.system), Settings(_duration(run.peers), jit=False))
    player = Stepwise(simulation.population, lambda _: _AsSeen(run, simulation))
    whole = np.concatenate([block.values for block in blocks(simulation, player=player)])
    units = {one.name: one.unit for one in simulation.signals}
    columns = {one.name: column for column, one in enumerate(simulation.signals)}
    found: dict[str, tuple[float, float]] = {}
    for peer in run.peers:
        rows = min(len(peer.values), len(whole))
        for column, name in enumerate(peer.signals):
            played = peer.values[:rows, column]
            far = float(np.abs(played - whole[:rows, columns[name]]).max(initial=0.0))
            most, large = found.get(units[name], (0.0, 0.0))
            found[units[name]] = max(most, far), max(large, float(np.abs(played).max(initial=0.0)))
    return found


def _ways(run: Run) -> tuple[WayRun, ...]:
    system, names = run.system, {one.number: one for one in run.peers}
    clocks = {one.name: one for one in system.clocks}
    timings = {one.name: float(one.value) for one in system.timings}
    found = []
    for peer in run.peers:
        for link, sender in sorted({(int(link), int(sender)) for link, sender in peer.arrivals[:, :2]}):
            trace = trace_name(system, link, sender, peer.number)
            other = names.get(sender)
            period = timings[clocks[system.links[link].clock].period]
            found.append(
                WayRun(
                    link=system.links[link].name,
                    sender=other.name if other else trace.split("-to-")[0],
                    receiver=peer.name,
                    sent=None if other is None else other.sent.get((link, peer.number), 0),
                    came=describe_delays(delays_of(peer, link, sender), trace, interval=period),
                    trace=str(Path(run.folder) / trace),
                )
            )
    return tuple(found)


def _heard(ways: tuple[WayRun, ...], link: str) -> bool:
    return any(one.link == link and one.came.law is not None for one in ways)


def _measured(run: Run, link: str, ways: tuple[WayRun, ...]) -> Measured:
    """Return what is said of the scene with a link as its worst way was: most lost, then latest."""
    heard = [one for one in ways if one.link == link and one.came.law is not None]
    worst = max(heard, key=lambda one: (one.came.lost.value, one.came.mean))
    system = run.system
    own = next(one for one in system.links if one.name == link)
    median = dict(worst.came.quantiles).get(0.5, worst.came.mean)
    tick = min(float(one.value) for one in system.timings if one.name in {c.period for c in system.clocks})
    delay = Fraction(int(np.ceil(median / tick - 1e-9))) * Fraction(tick).limit_denominator(10**9)
    channel = Channel(
        None,
        None,
        "uniform",
        own.channel.reorder if own.channel else "newest",
        own.channel.on_loss if own.channel else "hold",
        worst.came.delays,
    )
    timings = tuple(replace(one, value=delay) if one.name == own.delay else one for one in system.timings)
    period = next(
        one.value
        for one in timings
        if one.name == next(c.period for c in system.clocks if c.name == own.clock)
    )
    links = tuple(
        replace(one, channel=channel, delays=()) if one.name == link else one for one in system.links
    )
    measured = replace(system, timings=timings, links=links)
    way = f"{worst.sender} to {worst.receiver}"
    late = worst.came.longest > LATEST * float(period)
    network = None if late or worst.came.packets > LONGEST else judge_network(measured)
    return Measured(link, way, float(delay), analyze(measured), network)
