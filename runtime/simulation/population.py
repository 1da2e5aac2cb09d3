"""All peers of a scene over one frame: each one's program, and the packets between them.

Takes: a `CompiledSystem`, who hears whom, and the members, with their programs.
Gives: `Population`, `build_population`; `exchanges_within`, `refuse_unheard_of`.
Guarantees: sums and means over a complete graph cost one addition a peer, over any other graph one product
an arc; a reduction that looks at each pair of peers costs one evaluation a pair; before a packet arrives a
receiver holds the sender's start values.
Does not: run it (see `simulation`).

    (carries, histories, impulses, number of the frame) -> (carries⁺, histories⁺, rows)

with one of each a member, a column a peer. A member is a group of the scene, or those of its peers that are
recorded, or those that are not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.exchange import Exchange
from apc.frame.schedule import Propagate, Schedule, Tick
from apc.network.timetable import Route
from apc.simulation.frame_packets import FramePackets
from apc.simulation.program import Member

Floats = NDArray[np.float64]

Compile = Callable[[Sequence[Any]], Sequence[Any]]  # the kernels in another form, as fast as can be had


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """`frame` is the function above; `start` are its first carries and histories, a row a peer."""

    members: tuple[Member, ...]
    frame: Any  # casadi.Function
    start: tuple[Floats, ...]


def exchanges_within(schedules: Sequence[Schedule]) -> tuple[int, ...]:
    """Return the instants, in quanta, at which peers meet within the frame.

    Something is sent that is heard in the same frame, or a tick looks at each sender by itself.
    """
    slots = {one.sent for schedule in schedules for one in schedule.heard if one.lag == 0}
    # Over an unreliable link anything may be heard as soon as it is sent.
    any_time = {one.way.link for schedule in schedules for one in schedule.selected}
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
            if any(schedule.received[row].way.edge for row in rows):
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
    exchange: Exchange,
    members: Sequence[Member],
    kernels: Compile,
    routes: Sequence[Route] = (),
) -> Population:
    """Join the programs of all groups by the packets between them.

    Parameters
    ----------
    exchange
        Who hears whom.
    members
        What each group brings, in the scene's order.
    kernels
        Turns the segments' functions into the form in which they run.
    routes
        The unreliable links.

    Raises
    ------
    ApcError
        E801 a mean over nobody, E802 a mean whose weights add up to 0.
    """
    segments = [segment for one in members for segment in one.program.segments]
    looked = [pairwise.function for segment in segments for pairwise in segment.pairs]
    found = _distinct([*(segment.kernel for segment in segments), *looked])
    ready = dict(zip(found, kernels(list(found.values())), strict=True))
    packets = FramePackets(exchange, members, routes)
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
    packets.remember(histories)
    now, taken = list(carries), [0] * len(members)
    rows: list[list[Any]] = [[] for _ in members]
    for index in range(len(members[0].program.segments)):
        # All that is heard in a segment was sent before it began.
        heard = [
            casadi.vertcat(
                packets.hear(g, member.program.segments[index]),
                *packets.look(g, member.program.segments[index], now[g], constants[g], number, ready),
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
            packets.send(g, segment, sent)
    frame = casadi.Function(
        "frame",
        [*carries, *histories, *packets.selection.held, *impulses, *packets.selection.inputs, number],
        [*now, *packets.histories(), *packets.selection.finish(), *(casadi.vertcat(*one) for one in rows)],
    )
    start = [one.each(one.carry) for one in members] + [_first_history(one) for one in members]
    start += packets.selection.start()
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
