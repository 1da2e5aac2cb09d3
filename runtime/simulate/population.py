"""All peers of a scene over one frame: each one's program, and the packets between them.

Takes: a `CompiledSystem`, its numbers and schedules, and the programs of its groups.
Gives: `Population`, `build_population`.
Guarantees: sums and means over a complete graph cost one addition a peer, over any other graph one product
an arc; a reduction that looks at each pair of peers costs one evaluation a pair; before a packet arrives a
receiver holds the sender's start values.
Does not: run it (see `simulation`).

    (carries, histories, impulses, number of the frame) -> (carries⁺, histories⁺, rows)

with one of each a member, a column a peer. A member is a group of the scene, or those of its peers that are
recorded, or those that are not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.runtime.frame.exchange import Exchange, check_mean
from apc.runtime.frame.gathering import Gate, Gathering
from apc.runtime.frame.jacobians import SiteJacobians
from apc.runtime.frame.schedule import Heard, Propagate, Schedule, Sent, Tick
from apc.runtime.frame.start import start_sends, start_values
from apc.runtime.simulate.pairs import Pairs
from apc.runtime.simulate.program import Program, Segment, seconds_at
from apc.runtime.simulate.propagate import Transitions

Floats = NDArray[np.float64]
Compile = Callable[[Sequence[Any]], Sequence[Any]]  # the kernels in another form, as fast as can be had


@dataclass(frozen=True, slots=True, eq=False)
class Member:
    """Peers of one group of the scene in a population.

    `peers` (count,) are their numbers in the scene. `rows` (count,) says which of the different sites each
    is; `parameters` are those sites' vectors, `transitions` theirs; `sends` is what each of them sends at the
    start, by link.
    """

    group: int
    peers: NDArray[np.int64]
    program: Program
    rows: NDArray[np.int64]
    parameters: Floats
    transitions: tuple[Transitions, ...]
    sends: tuple[Mapping[str, Sequence[float]], ...]
    carry: Floats  # (sites, rows of the carry)

    @property
    def count(self) -> int:
        """The number of peers."""
        return len(self.rows)

    def each(self, values: Floats) -> Floats:
        """Return one row a peer of what is one row a site."""
        return np.ascontiguousarray(values[self.rows])


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """`frame` is the function above; `start` are its first carries and histories, a row a peer."""

    members: tuple[Member, ...]
    frame: Any  # casadi.Function
    start: tuple[Floats, ...]


def build_member(
    group: int,
    peers: NDArray[np.int64],
    site: SiteJacobians,
    rows: NDArray[np.int64],
    vectors: Floats,
    program: Program,
    transitions: Sequence[Transitions],
) -> Member:
    """Collect what some peers of a group bring to a population.

    Parameters
    ----------
    group
        The group's place in the scene.
    peers
        The peers' numbers in the scene (count,).
    site
        The group's kind.
    rows, vectors, transitions
        Which of the group's different sites each peer is (count,), their parameters (sites, n_p), and what
        each does over the program's intervals.
    program
        What each peer does in a frame.
    """
    used, own = np.unique(rows, return_inverse=True)
    sends, carries = [], []
    for vector in vectors[used]:
        listed = [float(one) for one in vector]
        x, _, remembered = start_values(site, listed)
        carries.append(program.start(x, remembered))
        sends.append(start_sends(site, listed, float))
    moves = tuple(transitions[place] for place in used)
    return Member(group, peers, program, own, vectors[used], moves, tuple(sends), np.array(carries))


def exchanges_within(schedules: Sequence[Schedule]) -> tuple[int, ...]:
    """Return the instants, in quanta, at which peers meet within the frame.

    Something is sent that is heard in the same frame, or a tick looks at each sender by itself.
    """
    slots = {one.sent for schedule in schedules for one in schedule.heard if one.lag == 0}
    # Over an unreliable link anything may be heard as soon as it is sent.
    any_time = {one.sent.link for schedule in schedules for one in schedule.heard if one.clock}
    slots |= {sent for schedule in schedules for sent in schedule.sent if sent.link in any_time}
    instants = {
        schedule.sent_times[place]
        for schedule in schedules
        for place, sent in enumerate(schedule.sent)
        if sent in slots
    }
    return tuple(sorted(instants.union(*(_looks(schedule) for schedule in schedules))))


def _looks(schedule: Schedule) -> set[int]:
    """Return the instants, in quanta, of the ticks that look at each sender by itself."""
    now, found = 0, set()
    for event in schedule.events:
        if isinstance(event, Propagate):
            now += event.duration
        elif isinstance(event, Tick):
            rows = [row for one in event.heard for row in one]
            if any(schedule.heard[row].way.edge for row in rows):
                found.add(now)
    return found


def refuse_unheard_of(system: CompiledSystem) -> None:
    """Refuse a peer that has nothing of its own to stand in for what an unreliable link loses."""
    zero = {link.name for link in system.links if link.channel and link.channel.on_loss == "zero"}
    for kind in system.kinds:
        for partition in kind.clocks:
            for receive in partition.receives:
                if receive.link in zero and not any(one.link == receive.link for one in kind.sends):
                    what = (
                        f"{receive.name} hears {receive.link}, over which its peer sends nothing: it has no "
                        "value of its own to stand in for a missing one"
                    )
                    raise ApcError(Mistake("E893", Place(system.name), what, hint="on_loss: hold"))


def build_population(
    system: CompiledSystem,
    exchange: Exchange,
    members: Sequence[Member],
    kernels: Compile,
    gates: Sequence[Gate] = (),
) -> Population:
    """Join the programs of all groups by the packets between them.

    Parameters
    ----------
    system
        The compiled scene.
    exchange
        Who hears whom.
    members
        What each group brings, in the scene's order.
    kernels
        Turns the segments' functions into the form in which they run.
    gates
        The unreliable links.

    Raises
    ------
    ApcError
        E801 a mean over nobody, E802 a mean whose weights add up to 0.
    """
    segments = [segment for one in members for segment in one.program.segments]
    looked = [pairwise.pair.function for segment in segments for pairwise in segment.pairs]
    found = _distinct([*(segment.kernel for segment in segments), *looked])
    ready = dict(zip(found, kernels(list(found.values())), strict=True))
    ear = _Ear(system, exchange, members, gates)
    carries = [casadi.MX.sym(f"carry{g}", len(one.carry[0]), one.count) for g, one in enumerate(members)]
    histories = [
        casadi.MX.sym(f"history{g}", sum(one.program.schedule.depths), one.count)
        for g, one in enumerate(members)
    ]
    impulses = [
        casadi.MX.sym(f"impulses{g}", one.program.impulse_rows, len(one.parameters))
        for g, one in enumerate(members)
    ]
    number = casadi.MX.sym("frame")
    constants = [casadi.DM(one.each(_constants(one)).T) for one in members]
    ear.remember(histories)
    now, taken = list(carries), [0] * len(members)
    rows: list[list[Any]] = [[] for _ in members]
    for index in range(len(members[0].program.segments)):
        # All that is heard in a segment was sent before it began.
        heard = [
            casadi.vertcat(
                ear.hear(g, member.program.segments[index]),
                *ear.look(g, member.program.segments[index], now[g], constants[g], number, ready),
            )
            for g, member in enumerate(members)
        ]
        for g, member in enumerate(members):
            segment = member.program.segments[index]
            size = segment.kernel.numel_in("impulses")
            pushed = impulses[g][taken[g] : taken[g] + size, :]
            taken[g] += size
            many = ready[id(segment.kernel)].map(member.count)
            every = pushed[:, member.rows.tolist()] if size else casadi.MX(0, member.count)
            now[g], sent, recorded = many(now[g], heard[g], constants[g], every, number)
            rows[g].append(recorded)
            ear.send(g, segment, sent)
    frame = casadi.Function(
        "frame",
        [*carries, *histories, *ear.gathering.held, *impulses, *ear.gathering.inputs, number],
        [*now, *ear.histories(), *ear.gathering.finish(), *(casadi.vertcat(*one) for one in rows)],
    )
    start = [one.each(one.carry) for one in members] + [_first_history(one) for one in members]
    start += [_first_held(gate, members) for gate in gates]
    return Population(tuple(members), frame, tuple(start))


def _distinct(functions: Sequence[Any]) -> dict[int, Any]:
    return {id(function): function for function in functions}


def _constants(member: Member) -> Floats:
    pairs = zip(member.parameters, member.transitions, strict=True)
    return np.array([member.program.constants(vector, own) for vector, own in pairs])


def _first_history(member: Member) -> Floats:
    """Return the packets on their way at time 0: the senders' start values."""
    schedule, kind = member.program.schedule, member.program.kind
    channels = {sending.link: sending.channels for sending in kind.sends}
    rows = [
        [
            one[sent.link][channels[sent.link].index(sent.channel)]
            for sent, depth in zip(schedule.sent, schedule.depths, strict=True)
            for _ in range(depth)
        ]
        for one in member.sends
    ]
    return member.each(np.array(rows).reshape(len(rows), sum(schedule.depths)))


def _first_held(gate: Gate, members: Sequence[Member]) -> Floats:
    """Return what every way of a gate holds at time 0, a row a way: its sender's start values."""
    link = gate.route.link
    packet = []
    for member in members:
        channels = next((one.channels for one in member.program.kind.sends if one.link == link), ())
        rows = [
            [one[link][channels.index(channel)] if channel in channels else 0.0 for channel in gate.channels]
            for one in member.sends
        ]
        packet.append(member.each(np.array(rows).reshape(len(rows), len(gate.channels))))
    return np.concatenate(packet)[gate.place[gate.route.pairs[:, 0]]]


class _Ear:
    """The packets of one frame, as they are sent, remembered and heard."""

    def __init__(
        self, system: CompiledSystem, exchange: Exchange, members: Sequence[Member], gates: Sequence[Gate]
    ) -> None:
        self.system, self.exchange, self.members = system, exchange, members
        self.gathering = Gathering(gates, exchange, members, self.packet)
        self.old: dict[tuple[int, Sent, int], Any] = {}  # (group, what, frames ago)
        self.new: dict[tuple[int, Sent], Any] = {}
        self.totals: dict[tuple[Sent, int, tuple[int, ...]], Any] = {}
        self.weights: dict[tuple[str, bool], Any] = {}
        self.sending = {
            link.name: [any(one.link == link.name for one in m.program.kind.sends) for m in members]
            for link in system.links
        }
        self.pairs = Pairs(exchange, members, self.sending, self.gathering, self._packet)

    def remember(self, histories: Sequence[Any]) -> None:
        """Take in what was sent in earlier frames."""
        for g, (member, history) in enumerate(zip(self.members, histories, strict=True)):
            row = 0
            schedule = member.program.schedule
            for sent, depth in zip(schedule.sent, schedule.depths, strict=True):
                for ago in range(1, depth + 1):
                    self.old[g, sent, ago] = history[row, :]
                    row += 1

    def send(self, group: int, segment: Segment, sent: Any) -> None:
        """Take in what a group sends in a segment."""
        schedule = self.members[group].program.schedule
        for place, row in enumerate(segment.sent):
            self.new[group, schedule.sent[row]] = sent[place, :]
        self.gathering.renew()

    def histories(self) -> list[Any]:
        """Return what is remembered when the frame ends."""
        result = []
        for g, member in enumerate(self.members):
            rows = []
            for sent, depth in zip(member.program.schedule.sent, member.program.schedule.depths, strict=True):
                listed = [self.new[g, sent], *(self.old[g, sent, ago] for ago in range(1, depth))]
                rows += listed[:depth]
            result.append(casadi.vertcat(*rows) if rows else casadi.MX(0, member.count))
        return result

    def hear(self, group: int, segment: Segment) -> Any:
        """Return what a group hears in a segment, a column a peer."""
        schedule = self.members[group].program.schedule
        rows = [self._heard(group, schedule.heard[row]) for row in segment.heard]
        return casadi.vertcat(*rows) if rows else casadi.MX(0, self.members[group].count)

    def look(
        self, group: int, segment: Segment, carry: Any, constants: Any, number: Any, ready: Mapping[int, Any]
    ) -> list[Any]:
        """Return what a group hears pair by pair as a segment begins, a column a peer."""
        schedule, found = self.members[group].program.schedule, []
        for one in segment.pairs:
            own = casadi.vertcat(carry[list(one.carry), :], constants[list(one.constants), :])
            t = seconds_at(schedule, number, one.now)
            rows = [schedule.heard[row] for row in one.heard]
            found.append(self.pairs.hear(group, rows, own, t, ready[id(one.pair.function)]))
        return found

    def packet(self, group: int, sent: Sent, ago: int) -> Any:
        """Return what a group sent some frames ago, a column a peer: zeros if that is nothing, or later."""
        found = self.old.get((group, sent, ago)) if ago else self.new.get((group, sent))
        return casadi.MX(1, self.members[group].count) if found is None else found

    def _packet(self, group: int, heard: Heard) -> Any:
        return self.old[group, heard.sent, heard.lag] if heard.lag else self.new[group, heard.sent]

    def _heard(self, listener: int, heard: Heard) -> Any:
        if heard.clock:
            return self.gathering.hear(listener, heard)
        way, exchange = heard.way, self.exchange
        own = self.members[listener].group
        senders = [
            h
            for h, does in enumerate(self.sending[way.link])
            if does and exchange.delay(way.link, self.members[h].group, own) == way.delay
        ]
        count = self.members[listener].count
        if not exchange.is_complete(way.link):
            total = casadi.MX.zeros(1, count)
            for h in senders:
                matrix = self._weights(way.link, way.operator == "mean", h, listener)
                if matrix.nnz():
                    total = total + self._packet(h, heard) @ matrix
            return total
        key = (heard.sent, heard.lag, tuple(senders))
        if key not in self.totals:
            self.totals[key] = casadi.sum2(casadi.horzcat(*(self._packet(h, heard) for h in senders)))
        total = casadi.repmat(self.totals[key], 1, count)
        if listener in senders:
            total = total - self._packet(listener, heard)
        if way.operator == "mean":
            listed = zip(self.members, self.sending[way.link], strict=True)
            everybody = sum(member.count for member, does in listed if does)
            total = total / (everybody - int(self.sending[way.link][listener]))
        return total

    def _weights(self, link: str, mean: bool, sender: int, receiver: int) -> Any:
        """Return what each peer of a group weighs each of another by, (senders, receivers), sparse."""
        import scipy.sparse

        exchange = self.exchange
        if (link, mean) not in self.weights:
            pairs, weights = exchange.arcs(link)
            n = exchange.peers
            whole = scipy.sparse.coo_array((weights, (pairs[:, 0], pairs[:, 1])), shape=(n, n)).tocsc()
            if mean:
                sums = np.asarray(whole.sum(axis=0)).ravel()
                for peer in np.flatnonzero(sums == 0):
                    if self._averages(int(peer), link):
                        hears = bool((pairs[:, 1] == peer).any())
                        check_mean(exchange, int(peer), link, "mean", hears, Fraction(0))
                whole = whole @ scipy.sparse.diags_array(1 / np.where(sums == 0, 1.0, sums))
            self.weights[link, mean] = whole.tocsc()
        columns = self.weights[link, mean][:, self.members[receiver].peers]
        block = columns.tocsr()[self.members[sender].peers].tocsc()
        block.sort_indices()  # CasADi wants the rows of a column in order
        return casadi.DM(block)

    def _averages(self, peer: int, link: str) -> bool:
        """Say whether a peer takes a mean over a link."""
        group = int(np.searchsorted(self.exchange.starts, peer, side="right")) - 1
        heard = next(one for one in self.members if one.group == group).program.schedule.heard
        return any(one.way.link == link and one.way.operator == "mean" for one in heard)
