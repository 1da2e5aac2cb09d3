"""Comparison of a real-time run with simulation (same packet arrivals) and analysis (measured network).

Takes: a `RealtimeRun`. Gives: `RunComparison`, `compare_run`; `ArcRun`, `Ticks`, `ticks_of`; `MeasuredLink`;
`DeliveredRun`, `reason_not_simulated`.
Guarantees: the simulation is that of `simulate` with the recorded packets in effect at each tick. Without the
complete record of a peer there is no simulation, and the reason is given.
Does not: write files (see `run`).
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
from apc.lifting.numeric_model import numeric_model
from apc.mean_square.mean_square_stability import MeanSquareStability, mean_square_stability
from apc.network.link_fit import LinkFit, fit_delays
from apc.network.packet_schedule import START, DeliveredPackets
from apc.parameter_values.parameters import resolve
from apc.realtime.peer import live_topology, traced
from apc.realtime.peer_run import PeerRun, RealtimeRun, delays_of, trace_name
from apc.result import Result
from apc.simulation.output_blocks import blocks
from apc.simulation.population import Population
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.timing.communication_graph import build_comm_graph

Floats = NDArray[np.float64]

# A directed link is analyzed packet by packet only up to this number of packets, with delays of at most this
# many periods. The analysis multiplies all frames with all packets in transit.
LONGEST, LATEST = 1_000, 4
SHARES = (0.5, 0.99, 0.999, 1.0)


@dataclass(frozen=True, slots=True)
class Ticks:
    """Quantiles (`SHARES`) of the delay and the execution time of a peer's ticks, in seconds."""

    peer: str
    ticks: int
    delayed: tuple[float, ...]
    took: tuple[float, ...]
    joined: float
    stopped: bool
    not_granted: tuple[str, ...]
    dropped: dict[str, int]


@dataclass(frozen=True, slots=True)
class ArcRun:
    """The packets of a directed link: the number `sent` (None without the sender's record), and the
    arrivals.
    """

    link: str
    sender: str
    receiver: str
    sent: int | None
    came: LinkFit
    trace: str


@dataclass(frozen=True, slots=True)
class MeasuredLink:
    """The analysis of the model with a link as measured: its `delay`, and the packets of one directed
    link, `arc`.
    """

    link: str
    arc: str
    delay: float
    analysis: Analysis
    network: MeanSquareStability | None


@dataclass(frozen=True, slots=True)
class RunComparison(Result):
    """Comparison of a run with simulation and analysis.

    `differences` has, for each unit of signals, the largest difference between recording and simulation, and
    the largest recorded value. It is empty without a simulation; `why_not` is the reason.
    """

    shown_by: ClassVar[str] = "realtime_output:run_comparison"

    topology: str
    folder: str
    seconds: float
    emulated: bool
    ticks: tuple[Ticks, ...]
    arcs: tuple[ArcRun, ...]
    differences: dict[str, tuple[float, float]]
    why_not: str
    measured: tuple[MeasuredLink, ...]


def ticks_of(peer: PeerRun, frame: float) -> Ticks:
    """Return statistics of a peer's ticks; `frame` is the length of a frame in seconds."""
    late, took = (_quantiles(values) for values in (peer.delayed, peer.took))
    return Ticks(
        peer=peer.name,
        ticks=len(peer.delayed),
        delayed=late,
        took=took,
        joined=peer.first * frame,
        stopped=peer.stopped,
        not_granted=peer.not_granted,
        dropped=dict(peer.dropped),
    )


def _quantiles(values: Floats) -> tuple[float, ...]:
    """Return the quantiles `SHARES` of some values; empty without values."""
    return tuple(float(np.quantile(values, share)) for share in SHARES) if len(values) else ()


def compare_run(run: RealtimeRun) -> RunComparison:
    """Return the comparison of a run with the results of `simulate` and `analyze`.

    Raises
    ------
    ApcError
        Those of `prepare`, for a model that cannot be simulated.
    """
    model, peers = run.model, run.peers
    simulation = _prepared(run)
    frame = float(simulation.frame * simulation.quantum)
    why_not, arcs = reason_not_simulated(model, peers, simulation), _arc_runs(run)
    received = [
        [arc for arc in arcs if arc.link == link.name and arc.came.distribution] for link in model.links
    ]
    return RunComparison(
        topology=model.name,
        folder=run.folder,
        seconds=max((float(peer.time[-1]) for peer in peers if len(peer.time)), default=0.0),
        emulated=any(peer.emulated for peer in peers),
        ticks=tuple(ticks_of(peer, frame) for peer in peers),
        arcs=arcs,
        differences={} if why_not else _differences(run, simulation),
        why_not=why_not,
        measured=tuple(
            _measured_link(model, link, arc_runs)
            for link, arc_runs in zip(model.links, received, strict=True)
            if arc_runs
        ),
    )


def _prepared(run: RealtimeRun) -> Simulation:
    """Return the simulation of a run, with the joins and leaves that were recorded."""
    model, duration = run.model, _duration(run.model, run.peers)
    joins, leaves = (
        tuple(item for item in items if item.at < duration)
        for items in (model.experiment.joins, model.experiment.leaves)
    )
    recorded = replace(model, experiment=replace(model.experiment, joins=joins, leaves=leaves))
    return prepare(live_topology(recorded), Settings(duration, jit=False))


def _duration(model: Model, peers: tuple[PeerRun, ...]) -> Fraction:
    """Return the duration in seconds that all peers recorded, except those that leave."""
    leaving = {item.peer.strip() for item in model.experiment.leaves}
    ends = [float(peer.time[-1]) for peer in peers if len(peer.time) and peer.name not in leaving]
    return Fraction(max(min(ends, default=0.0), 1e-3)).limit_denominator(10**6)


def reason_not_simulated(
    model: Model, peers: tuple[PeerRun, ...], simulation: Simulation | None = None
) -> str:
    """Return the reason why the run cannot be simulated, "" if it can.

    `simulation` is that of the run, None if all peers are always present.
    """
    presence = simulation.presence if simulation else None
    joins = presence.joins // simulation.frame if simulation and presence else np.zeros(model.peers)
    if len(peers) < model.peers:
        return f"only {len(peers)} of {model.peers} peers recorded the run"
    if local := [peer.name for peer in peers if peer.outside]:
        return f"{', '.join(local)} had an external device with unknown motion"
    if none := [peer.name for peer in peers if not all(map(len, peer.packets))]:
        return f"{', '.join(none)} ended before the first tick with received samples"
    late = [peer.name for peer in peers if peer.first != joins[peer.number]]
    return f"{', '.join(late)} joined later or again, in a different state" if late else ""


class DeliveredRun:
    """The packets in effect at the ticks of a run, frame by frame (see `packet_schedule`)."""

    def __init__(self, run: RealtimeRun, population: Population) -> None:
        self.now, self.run, self.frame = 0, run, population.frame
        self.routes = population.exchange_program.routes

    def take(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return the packets in effect at each route's ticks until the end of a frame, in quanta.

        The first and the last recorded ones of a peer are continued.
        """
        first, last, self.now = self.now // self.frame, until // self.frame, until
        delivered = []
        for index, route in enumerate(self.routes):
            ticks = np.arange(first * route.ticks, last * route.ticks)
            packets = np.full((len(ticks), len(route.pairs)), START, np.int64)
            missing = np.zeros(packets.shape, np.bool_)
            for peer in self.run.peers:
                if len(arcs := np.flatnonzero(route.pairs[:, 1] == peer.number)):
                    rows = np.clip(ticks - peer.first * route.ticks, 0, len(peer.packets[index]) - 1)
                    packets[:, arcs], missing[:, arcs] = peer.packets[index][rows], peer.missing[index][rows]
            delivered.append(DeliveredPackets(packets, missing))
        return tuple(delivered)


def _differences(run: RealtimeRun, simulation: Simulation) -> dict[str, tuple[float, float]]:
    """Return the largest differences between recorded and simulated signals, by unit."""
    player = simulation.player(lambda _: DeliveredRun(run, simulation.population))
    output = list(blocks(simulation, player=player))
    time, simulated_rows = (
        np.concatenate([getattr(block, name) for block in output]) for name in ("time", "values")
    )
    simulated = {
        signal.name: (signal.unit, simulated_rows[:, column])
        for column, signal in enumerate(simulation.signals)
    }
    result: dict[str, tuple[float, float]] = {}
    for peer in run.peers:
        first = int(np.argmin(np.abs(time - peer.time[0])))
        rows = slice(first, first + len(peer.time))
        for name, recorded in zip(peer.signals, peer.values[: len(time) - first].T, strict=True):
            unit, values = simulated[name]
            difference = float(np.abs(recorded - values[rows]).max(initial=0.0))
            largest_difference, largest_value = result.get(unit, (0.0, 0.0))
            result[unit] = (
                max(largest_difference, difference),
                max(largest_value, float(np.abs(recorded).max(initial=0.0))),
            )
    return result


def _arc_runs(run: RealtimeRun) -> tuple[ArcRun, ...]:
    """Return the packets of each directed link, with statistics of their arrivals."""
    model, peers = run.model, {peer.number: peer for peer in run.peers}
    timings = {timing.name: float(timing.value) for timing in model.timings}
    periods = {clock.name: timings[clock.period] for clock in model.clocks}
    comm_graph = build_comm_graph(model, resolve(model).timings)
    arc_runs = []
    for peer in run.peers:
        for number, sender in peer.arcs:
            link, trace = model.links[number], trace_name(model, number, sender, peer.number)
            other = peers.get(sender)
            clock = link.clock_at(
                comm_graph.delay(link.name, comm_graph.group_of(sender), comm_graph.group_of(peer.number))
            )
            came = fit_delays(delays_of(peer, number, sender), trace, interval=periods[clock])
            arc_runs.append(
                ArcRun(
                    link=link.name,
                    sender=other.name if other else trace.split("-to-")[0],
                    receiver=peer.name,
                    sent=other.sent.get(number, {}).get(peer.number, 0) if other else None,
                    came=came,
                    trace=str(Path(run.folder) / trace),
                )
            )
    return tuple(arc_runs)


def _measured_link(model: Model, link: Link, arcs: Sequence[ArcRun]) -> MeasuredLink:
    """Return the analysis with the worst directed link of a network link: most losses, then largest delay."""
    worst = max(arcs, key=lambda arc: (arc.came.lost.value, arc.came.mean))
    came, clocks = worst.came, {clock.name: clock.period for clock in model.clocks}
    tick = min(float(timing.value) for timing in model.timings if timing.name in clocks.values())
    median = dict(came.quantiles).get(0.5, came.mean)
    delay = Fraction(int(np.ceil(median / tick - 1e-9))) * Fraction(tick).limit_denominator(10**9)
    pairs = tuple(replace(pair, channel=None) for pair in link.pairs if pair.clock)
    replaced = {link.delay, *(pair.delay for pair in pairs)}
    timings = tuple(
        replace(timing, value=delay) if timing.name in replaced else timing for timing in model.timings
    )
    periods = [clocks[name] for name in link.clocks]
    period = min(float(timing.value) for timing in timings if timing.name in periods)
    measured_link = replace(traced(link, came.delays), pairs=pairs)
    links = tuple(measured_link if item is link else item for item in model.links)
    measured_model = replace(model, timings=timings, links=links)
    too_long = came.longest > LATEST * period or came.packets > LONGEST
    network = None if too_long else mean_square_stability(numeric_model(measured_model))
    arc = f"{worst.sender} to {worst.receiver}"
    return MeasuredLink(link.name, arc, float(delay), analyze(numeric_model(measured_model)), network)
