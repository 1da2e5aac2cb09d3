"""A run beside what is said of its scene: simulated with what arrived when, analysed with what was measured.

Takes: a `RealtimeRun`. Gives: `RunComparison`, `compare_run`; `ArcRun`, `Ticks`, `ticks_of`.
Guarantees: the simulation is that of `simulate`, fed with the packets that each tick saw; where a peer's part
is missing, or begins later, there is none, and that is said.
Does not: write (see `run`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze
from apc.compiler.compiled import Link, Model
from apc.loop.peer import live_scene, traced
from apc.loop.run import PeerRun, RealtimeRun, delays_of, trace_name
from apc.moments.network_verdict import MeanSquareStability, judge_network
from apc.network.recorded import LinkFit, describe_delays
from apc.network.timetable import START, DeliveredPackets
from apc.result import Result
from apc.simulation.population import Population
from apc.simulation.rows_in_time import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.simulation.stepwise import InterpretedEngine

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
class ArcRun:
    """A way's packets: those `sent` (None where the sender's part is missing), and what came."""

    link: str
    sender: str
    receiver: str
    sent: int | None
    came: LinkFit
    trace: str


@dataclass(frozen=True, slots=True)
class MeasuredLink:
    """What is said of the scene with a link as it was: the `delay` heard after, the packets of a way."""

    link: str
    way: str
    delay: float
    analysis: Analysis
    network: MeanSquareStability | None


@dataclass(frozen=True, slots=True)
class RunComparison(Result):
    """A run beside its scene.

    `apart` has, of each unit of signals, the largest difference between what was played and what is
    simulated, and the largest number played; empty where there is no simulation, and `why_not` says why.
    """

    shown_by: ClassVar[str] = "loop_output:run_comparison"

    topology: str
    folder: str
    seconds: float
    emulated: bool
    ticks: tuple[Ticks, ...]
    ways: tuple[ArcRun, ...]
    apart: dict[str, tuple[float, float]]
    why_not: str
    measured: tuple[MeasuredLink, ...]


def ticks_of(peer: PeerRun, frame: float) -> Ticks:
    """Return what is told of a peer's ticks; a frame lasts so many seconds."""
    late, took = (_shares(values) for values in (peer.late, peer.took))
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


def compare_run(run: RealtimeRun) -> RunComparison:
    """Lay a run beside what `simulate` and `analyze` say of it.

    Raises
    ------
    ApcError
        Those of `prepare`, for a scene that can't be simulated.
    """
    system, peers = run.system, run.peers
    simulation = prepare(live_scene(system), Settings(_duration(peers), jit=False))
    frame = float(simulation.frame * simulation.quantum)
    why_not, ways = _incomplete(system, peers), _ways(run)
    heard = [[way for way in ways if way.link == link.name and way.came.law] for link in system.links]
    return RunComparison(
        topology=system.name,
        folder=run.folder,
        seconds=max((float(peer.time[-1]) for peer in peers if len(peer.time)), default=0.0),
        emulated=any(peer.emulated for peer in peers),
        ticks=tuple(ticks_of(peer, frame) for peer in peers),
        ways=ways,
        apart={} if why_not else _apart(run, simulation),
        why_not=why_not,
        measured=tuple(
            _measured(system, link, way_runs)
            for link, way_runs in zip(system.links, heard, strict=True)
            if way_runs
        ),
    )


def _duration(peers: tuple[PeerRun, ...]) -> Fraction:
    ends = [float(peer.time[-1]) for peer in peers if len(peer.time)]
    return Fraction(max(min(ends, default=0.0), 1e-3)).limit_denominator(10**6)


def _incomplete(system: Model, peers: tuple[PeerRun, ...]) -> str:
    """Return why the run can't be simulated again, empty if it can."""
    if len(peers) < system.peers:
        return f"of {system.peers} peers {len(peers)} left their part of the run"
    if own := [peer.name for peer in peers if peer.outside]:
        return f"{', '.join(own)} had a device outside, whose motion is not known"
    if none := [peer.name for peer in peers if not all(map(len, peer.packets))]:
        return f"{', '.join(none)} ended before the first tick that hears"
    late = [peer.name for peer in peers if peer.first]
    return f"{', '.join(late)} joined later, or again, in a state that others had not" if late else ""


class _AsSeen:
    """What the ticks of a run saw, frame by frame (see `Timetable`)."""

    def __init__(self, run: RealtimeRun, population: Population) -> None:
        self.now, self.seen = 0, list[DeliveredPackets]()
        self.frame = population.frame
        self.routes = population.hearing.routes
        for place, route in enumerate(self.routes):
            rows = min(len(peer.packets[place]) for peer in run.peers if peer.packets[place].size)
            packets = np.full((rows, len(route.pairs)), START, np.int64)
            missing = np.zeros(packets.shape, np.bool_)
            for peer in run.peers:
                ways = np.flatnonzero(route.pairs[:, 1] == peer.number)
                if len(ways):
                    packets[:, ways] = peer.packets[place][:rows]
                    missing[:, ways] = peer.missing[place][:rows]
            self.seen.append(DeliveredPackets(packets, missing))

    def take(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return what each route's ticks saw until an instant in quanta, a whole number of frames."""
        first, last, self.now = self.now // self.frame, until // self.frame, until
        seens = []
        for route, seen in zip(self.routes, self.seen, strict=True):
            rows = np.minimum(np.arange(first * route.ticks, last * route.ticks), len(seen.packets) - 1)
            seens.append(DeliveredPackets(seen.packets[rows], seen.missing[rows]))
        return tuple(seens)


def _apart(run: RealtimeRun, simulation: Simulation) -> dict[str, tuple[float, float]]:
    """Return how far the peers' signals are from the simulated ones, by unit."""
    player = InterpretedEngine(simulation.population, lambda _: _AsSeen(run, simulation.population))
    whole = np.concatenate([block.values for block in blocks(simulation, player=player)])
    simulated = {
        signal.name: (signal.unit, whole[:, column]) for column, signal in enumerate(simulation.signals)
    }
    result: dict[str, tuple[float, float]] = {}
    for peer in run.peers:
        for name, played in zip(peer.signals, peer.values[: len(whole)].T, strict=True):
            unit, values = simulated[name]
            far = float(np.abs(played - values[: len(played)]).max(initial=0.0))
            most, large = result.get(unit, (0.0, 0.0))
            result[unit] = max(most, far), max(large, float(np.abs(played).max(initial=0.0)))
    return result


def _ways(run: RealtimeRun) -> tuple[ArcRun, ...]:
    system, peers = run.system, {peer.number: peer for peer in run.peers}
    timings = {timing.name: float(timing.value) for timing in system.timings}
    periods = {clock.name: timings[clock.period] for clock in system.clocks}
    way_runs = []
    for peer in run.peers:
        for number, sender in peer.ways:
            link, trace = system.links[number], trace_name(system, number, sender, peer.number)
            other = peers.get(sender)
            came = describe_delays(delays_of(peer, number, sender), trace, interval=periods[link.clock])
            way_runs.append(
                ArcRun(
                    link=link.name,
                    sender=other.name if other else trace.split("-to-")[0],
                    receiver=peer.name,
                    sent=other.sent.get(number, {}).get(peer.number, 0) if other else None,
                    came=came,
                    trace=str(Path(run.folder) / trace),
                )
            )
    return tuple(way_runs)


def _measured(system: Model, link: Link, ways: Sequence[ArcRun]) -> MeasuredLink:
    """Return what is said of the scene with a link as the worst of its ways was: most lost, then latest."""
    worst = max(ways, key=lambda way: (way.came.lost.value, way.came.mean))
    came, clocks = worst.came, {clock.name: clock.period for clock in system.clocks}
    tick = min(float(timing.value) for timing in system.timings if timing.name in clocks.values())
    median = dict(came.quantiles).get(0.5, came.mean)
    delay = Fraction(int(np.ceil(median / tick - 1e-9))) * Fraction(tick).limit_denominator(10**9)
    timings = tuple(
        replace(timing, value=delay) if timing.name == link.delay else timing for timing in system.timings
    )
    period = next(float(timing.value) for timing in timings if timing.name == clocks[link.clock])
    worse = replace(traced(link, came.delays), delays=())
    links = tuple(worse if item is link else item for item in system.links)
    measured = replace(system, timings=timings, links=links)
    late = came.longest > LATEST * period or came.packets > LONGEST
    network = None if late else judge_network(measured)
    way = f"{worst.sender} to {worst.receiver}"
    return MeasuredLink(link.name, way, float(delay), analyze(measured), network)
