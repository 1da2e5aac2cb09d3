"""An engine for peers that join and leave: one simulation for each set of present peers.

Takes: a `Simulation` with its `Presence`.
Gives: `changing_engine`, `ChangingEngine`; `PresentPeers`, `PresentDeliveries`; `pair_indices`.
Guarantees: between changes the motion is exactly that of a model of the present peers alone. The rows of
absent peers are NaN.
Does not: read the instants (see `peer_times`).

At the start of the frame of a change, in this order:

1. The peers that leave are removed, with all their packets, also those in transit.
2. Each peer that joins has its start values. The states and stored values of its parts in `PeerType.joining`
   are the means of those of the peers of its group that stay; without any, its states are means over all.
3. The packets of a peer that joins are, at each instant of sending, the mean m of the packets of the peers of
   its group that stay, shifted to its own values: m + s(own values) − mean of s(values of the others), where
   s gives the sent values. If all its sent values are means, so are its packets.
4. Over an unreliable link, packets sent before the join of their sender or receiver do not arrive. Until the
   first packet the receiver holds the sender's values at the join. A directed link has the same losses and
   delays as if all peers were always present.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.extensions.changing_counts.peer_times import counts_of, model_of_present, packets_fault
from apc.network.packet_schedule import START, DeliveredPackets, Timetable
from apc.simulation.compiled_engine import CompiledEngine
from apc.simulation.interpreted_engine import InterpretedEngine
from apc.simulation.output_blocks import forces_in_time
from apc.simulation.population import DeliverySource, FrameRows
from apc.simulation.program import GroupProgram
from apc.simulation.simulation import Simulation, prepare

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class PresentPeers:
    """The simulation of the present peers (`present`, (N,)), with its engine.

    `sources` are the columns of its rows that are recorded in the columns `targets` of all peers' rows.
    `links` are the indices of its directed links among those of all peers, for each unreliable route.
    """

    present: Flags
    simulation: Simulation
    engine: CompiledEngine | InterpretedEngine
    sources: Integers
    targets: Integers
    links: tuple[Integers, ...]

    def indices(self, group: int, peers: Flags) -> Integers:
        """Return the indices of some peers (N,) among the present peers of a group."""
        first = np.cumsum([0, *(model_group.count for model_group in self.simulation.model.groups)])
        chosen = peers[self.present][first[group] : first[group + 1]]
        return np.flatnonzero(chosen)


@dataclass(frozen=True, slots=True)
class PresentDeliveries:
    """The packets in effect on the directed links of the present peers.

    `source` are the packets of all peers, `links` as in `PresentPeers`; `first` are the numbers of the first
    packets that can arrive, on each directed link of all peers.
    """

    source: DeliverySource
    links: tuple[Integers, ...]
    first: tuple[Integers, ...]

    def take(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return the packets in effect at the ticks before an instant (see `DeliverySource`)."""
        result = []
        for delivered, links, first in zip(self.source.take(until), self.links, self.first, strict=True):
            packets = delivered.packets[:, links]
            early = packets < first[links]
            in_effect = np.ascontiguousarray(np.where(early, START, packets))
            result.append(DeliveredPackets(in_effect, delivered.missing[:, links]))
        return tuple(result)


def changing_engine(
    simulation: Simulation, deliveries: Callable[[int], DeliverySource] | None = None
) -> ChangingEngine:
    """Return an engine of a simulation in which peers join and leave.

    `deliveries` gives the packets of a run of all peers, as recorded by `apc run`; by default a `Timetable`.
    """
    return ChangingEngine(simulation, deliveries)


class ChangingEngine:
    """An engine that passes from one set of present peers to the next."""

    def __init__(
        self, simulation: Simulation, deliveries: Callable[[int], DeliverySource] | None = None
    ) -> None:
        assert simulation.presence is not None
        self.deliveries = deliveries
        self.simulation, self.presence = simulation, simulation.presence
        last = int(simulation.settings.duration / simulation.quantum)
        self.changes = (self.presence.changes(last) // simulation.frame).tolist()
        self.simulations: dict[object, Simulation] = {}
        starts = self.presence.first_peers
        self.column_of = {
            (signal.group, starts[signal.group] + signal.peer - 1, signal.local): column
            for signal, column in zip(simulation.signals, simulation.order.tolist(), strict=True)
        }
        self.routes = simulation.population.exchange_program.routes
        # A peer of `apc run` receives packets before its join.
        self.first = tuple(
            self.presence.joins[route.pairs].max(axis=1) // simulation.frame * route.slots * (not deliveries)
            for route in self.routes
        )
        for frame in (0, *self.changes):  # errors of all numbers of peers are found before the first row
            if _packets(self._simulation(self._present_in(frame))) != _packets(simulation):
                raise packets_fault(simulation.topology, frame * simulation.frame * simulation.quantum)
        self.begin(0)

    def begin(self, run: int) -> None:
        """Reset all peers to time 0 of a run (see `population.FrameEngine`)."""
        self.work_of_absent = np.zeros(len(self.simulation.population.parts))
        seed = self.simulation.seed
        self.source: DeliverySource = (
            self.deliveries(run)
            if self.deliveries
            else Timetable(self.routes, self.simulation.arrival_processes, seed=seed, run=run)
        )
        self.now = self._prepare(self._present_in(0))

    def advance(self, first: int, count: int, pushes: Sequence[Floats | None]) -> FrameRows:
        """Simulate the frames from number `first` on (see `population.FrameEngine`)."""
        population = self.simulation.population
        rows = np.full((count, population.sample_count, population.width), np.nan)
        work = np.zeros((count, len(population.parts)))
        ends = [*(frame for frame in self.changes if first < frame < first + count), first + count]
        begin = first
        for end in ends:
            if begin in self.changes:
                self._change(begin)
            now, length = self.now, end - begin
            forces = forces_in_time(replace(now.simulation, length=length), begin)
            simulated = now.engine.advance(begin, length, forces)
            done = slice(begin - first, begin - first + simulated.frames)
            own_rows = simulated.rows.reshape(length, population.sample_count, -1)
            rows[done, :, now.targets] = own_rows[: simulated.frames, :, now.sources]
            work[done] = self.work_of_absent + simulated.work[: simulated.frames]
            begin += simulated.frames
            if simulated.frames < length:
                break
        return FrameRows(rows.reshape(-1, population.width), work, begin - first)

    def in_range(self) -> bool:
        """Return whether all states of the present peers are finite."""
        return self.now.engine.in_range()

    def _present_in(self, frame: int) -> Flags:
        """Return which peers are present in a frame (N,)."""
        present: Flags = self.presence.at(np.array([frame * self.simulation.frame]))[0]
        return present

    def _prepare(self, present: Flags) -> PresentPeers:
        """Return the present peers with their simulation, and a new engine."""
        simulation, starts = self._simulation(present), self.presence.first_peers
        peers, counts = np.flatnonzero(present), [group.count for group in simulation.model.groups]
        first = dict(zip(starts, np.cumsum([0, *counts]).tolist(), strict=False))
        pairs = [
            (source, self.column_of[key])
            for signal, source in zip(simulation.signals, simulation.order.tolist(), strict=True)
            if (key := (signal.group, int(peers[first[signal.group] + signal.peer - 1]), signal.local))
            in self.column_of
        ]
        sources, targets = np.array(pairs, np.int64).reshape(-1, 2).T
        routes = zip(simulation.population.exchange_program.routes, self.routes, strict=True)
        links = tuple(pair_indices(peers[route.pairs], all_links.pairs) for route, all_links in routes)
        deliveries = partial(self._deliveries, links) if links else None
        engine = simulation.player(deliveries)
        assert isinstance(engine, (CompiledEngine, InterpretedEngine))
        return PresentPeers(present, simulation, engine, sources, targets, links)

    def _simulation(self, present: Flags) -> Simulation:
        """Return the simulation of some peers, with all signals that are recorded of any peer of a group.

        Without values of single peers it is that of any as many peers.
        """
        base, counts = self.simulation, counts_of(self.simulation.topology, present)
        own = any(group.columns for group in base.topology.groups)
        key = present.tobytes() if own else tuple(counts)
        if key not in self.simulations:
            patterns = dict.fromkeys(f"{signal.group}.{signal.local}" for signal in base.signals)
            model = model_of_present(base.topology, present)
            self.simulations[key] = simulation = prepare(model, base.settings, signals=tuple(patterns))
            assert len(simulation.population.members) == len(counts), "all peers of a group are recorded"
        return self.simulations[key]

    def _deliveries(self, links: tuple[Integers, ...], _: int) -> PresentDeliveries:
        """Return the packets on the directed links of present peers in the present run."""
        return PresentDeliveries(self.source, links, self.first)

    def _change(self, frame: int) -> None:
        """Pass to the peers that are present from a frame on."""
        old, new = self.now, self._prepare(self._present_in(frame))
        members = list(zip(old.simulation.population.members, old.engine.carries, strict=True))
        for group, (member, carry) in enumerate(members):
            layout, leaving = member.program.layout, old.indices(group, ~new.present)
            parts = [self.simulation.population.parts.index(part) for part in layout.parts]
            np.add.at(self.work_of_absent, parts, carry[layout.work][:, leaving].sum(axis=1))
        carries, packets = _changed(old, new, frame)
        received = [_received(old, new, route, carries, frame) for route in range(len(self.routes))]
        for array, values in zip(new.engine.carries, carries, strict=True):
            array[:] = values
        new.engine.packets[:] = packets
        for route, (held, effective) in enumerate(received):
            new.engine.held[route][:], new.engine.effective[route][:] = held, effective
        self.now = new


def _packets(simulation: Simulation) -> tuple[object, ...]:
    """Return the packets of a frame, which must not depend on the present peers."""
    program = simulation.population.exchange_program
    routes = [(route.link, route.clock, route.sent_by) for route in program.routes]
    return simulation.frame * simulation.quantum, program.ring, program.keys, routes


def _changed(old: PresentPeers, new: PresentPeers, frame: int) -> tuple[list[Floats], Floats]:
    """Return the carries of each group and the packets of the peers present after a change."""
    stay, join = old.present & new.present, new.present & ~old.present
    before, after = old.simulation.population, new.simulation.population
    means = _state_means(old, stay)
    packets = np.empty(new.engine.packets.shape)
    carries, column, old_column = [], 0, 0
    for group, member in enumerate(after.members):
        staying, old_staying = new.indices(group, stay), old.indices(group, stay)
        joining, old_carry = new.indices(group, join), old.engine.carries[group]
        carry = member.each(member.carry).T.copy()
        carry[:, staying] = old_carry[:, old_staying]
        columns = slice(column, column + member.count)
        own = packets[:, :, columns]
        own[:, :, staying] = old.engine.packets[:, :, old_column + old_staying]
        if len(joining):
            _set_joining_values(member, carry, joining, staying, means)
            seconds = float(frame * after.frame * after.quantum)
            for key, sent in enumerate(after.exchange_program.keys):
                values = _sent(member, carry, sent.link, sent.channel, seconds)
                history = own[:, key, staying] - values[staying]
                mean = history.mean(axis=1) if len(staying) else np.zeros(len(packets))
                own[:, key, joining] = mean[:, None] + values[joining]
        carries.append(carry)
        column, old_column = column + member.count, old_column + before.members[group].count
    return carries, packets


def _received(
    old: PresentPeers, new: PresentPeers, route: int, carries: Sequence[Floats], frame: int
) -> tuple[Floats, Integers]:
    """Return the held values and the packets in effect on the directed links of a route after a change."""
    population = new.simulation.population
    program, pairs = population.exchange_program, population.exchange_program.routes[route].pairs
    seconds = float(frame * population.frame * population.quantum)
    held = np.zeros(new.engine.held[route].shape)
    for row, keys in enumerate(program.channels[route]):
        sent = program.keys[keys[0]]
        members = zip(population.members, carries, strict=True)
        values = [_sent(member, carry, sent.link, sent.channel, seconds) for member, carry in members]
        held[row] = np.concatenate(values)[pairs[:, 0]]
    effective = np.full(len(pairs), START, np.int64)
    _, before, after = np.intersect1d(old.links[route], new.links[route], return_indices=True)
    held[:, after] = old.engine.held[route][:, before]
    effective[after] = old.engine.effective[route][before]
    return held, effective


def pair_indices(pairs: Integers, all_pairs: Integers) -> Integers:
    """Return the index of each (sender, receiver) pair in a list of pairs that contains it."""
    index_of = {pair: index for index, pair in enumerate(map(tuple, all_pairs.tolist()))}
    return np.array([index_of[sender, receiver] for sender, receiver in pairs.tolist()], np.int64)


def _state_means(old: PresentPeers, stay: Flags) -> dict[str, float]:
    """Return the mean of each state over the staying peers of all groups that have it."""
    values: dict[str, list[Floats]] = {}
    for group, member in enumerate(old.simulation.population.members):
        staying = old.indices(group, stay)
        for row, state in enumerate(member.program.peer_type.states):
            values.setdefault(state.name, []).append(old.engine.carries[group][row, staying])
    joined = {name: np.concatenate(arrays) for name, arrays in values.items()}
    return {name: float(array.mean()) for name, array in joined.items() if len(array)}


def _set_joining_values(
    member: GroupProgram, carry: Floats, joining: Integers, staying: Integers, means: dict[str, float]
) -> None:
    """Set the rows of a carry that belong to the parts in `PeerType.joining`, at the joining peers.

    They are the means over the peers of the group that stay, as `apc analyze --changing` assumes; without
    any, states are the means over all groups.
    """
    peer_type, layout = member.program.peer_type, member.program.layout
    partitions = {partition.clock: partition for partition in peer_type.clocks}
    names = [
        *(state.name for state in peer_type.states),
        *(peer_type.clocks[partition].outputs[output] for partition, output in layout.outputs),
        *(partitions[hold.clock].outputs[hold.output] for hold in peer_type.holds),
        *(peer_type.clocks[value.partition].outputs[value.output] for value in layout.later_values),
    ]
    for row, name in enumerate(names):
        if peer_type.joins_at_mean(name) and len(staying):
            carry[row, joining] = carry[row, staying].mean()
        elif peer_type.joins_at_mean(name) and row < layout.states and name in means:
            carry[row, joining] = means[name]


def _sent(member: GroupProgram, carry: Floats, link: str, channel: str, seconds: float) -> Floats:
    """Return the values that each peer of a member sends in a channel (count,), 0 without such a channel."""
    layout = member.program.layout
    for send in member.program.peer_type.sends:
        if send.link == link and channel in send.channels:
            function = send.send.map(member.count)
            parameters = member.each(member.parameters).T
            values = function(carry[: layout.states], carry[layout.held], parameters, seconds)
            sent: Floats = np.asarray(values, np.float64)[send.channels.index(channel)]
            return sent
    return np.zeros(member.count)
