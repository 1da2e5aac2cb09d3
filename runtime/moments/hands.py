"""Forces on what hands hold, and where copies are as frames begin: states that a scene gets beside its own.

Takes: a `CompiledSystem` and its peers (`crowd.Hearing`).
Gives: `Forced`, `Peer`, `forced`.
Guarantees: the peers move as before, and are pushed besides; positions are those at the start of a frame of
the scene, whenever frames are said to begin.
Does not: compute moments (see `errors`).

What hands hold is `devices.find_device`'s to say. Each force is drawn as the frame begins, and acts from one
tick of the fastest clock to the next (see `ports`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Kind
from apc.eigen.peer_group import PeerGroup
from apc.frame.devices import Device, find_device
from apc.frame.ports import with_holds, with_ports
from apc.frame.site import LinearSite
from apc.moments.crowd import Hearing, instants

Matrix = NDArray[Any]

# A copy is called by the link and channel that tell others where it is.
Copy = tuple[str, str]


@dataclass(frozen=True, slots=True)
class Peer:
    """What of z a peer got: `drawn` are forces in N as a frame begins, `copies` positions in m.

    `added` are all that it got.
    """

    drawn: range
    added: range
    copies: Mapping[Copy, int]


@dataclass(frozen=True, slots=True)
class Forced:
    """The peers of a scene, pushed; `peers` says what of z they got, by the schedule's id."""

    told: Hearing
    peers: Mapping[int, Peer]


def forced(system: CompiledSystem, told: Hearing, first: Fraction = Fraction(0)) -> Forced | str:
    """Push what hands hold, each for itself, by a force of variance 1 N²; or say why that can't be done.

    Parameters
    ----------
    system
        The compiled scene.
    told
        Its peers.
    first
        When frames begin there, in seconds.
    """
    unit_of = {one.name: one.unit for one in system.parameters}
    used = {part.clock for kind in system.kinds for part in kind.clocks} | {one.clock for one in system.links}
    periods = {clock.name: told.timings[clock.period] for clock in system.clocks if clock.name in used}
    fastest = next(
        clock for clock in system.clocks if clock.name == min(periods, key=lambda name: periods[name])
    )
    ticks = instants(told, fastest)
    groups, rows, peers, built = [], {}, {}, {}
    pushed = False
    for group in told.groups:
        key = id(group.schedule), id(group.lifting)
        if key not in built:
            held = find_device(group.jacobians, group.parameters, unit_of, group.listening)
            if isinstance(held, str):
                return held
            pushed = pushed or held is not None
            built[key] = _pushed(group, held, ticks, -first % told.frame)
        found, own = built[key]
        groups.append(
            replace(
                group,
                jacobians=found.jacobians,
                site=found.site,
                exacting=found.exacting,
                schedule=found.schedule,
                lifting=found.lifting,
            )
        )
        rows[id(found.schedule)] = told.rows[id(group.schedule)]
        peers[id(found.schedule)] = own
    if not pushed:
        return "no peer holds anything but what it tells others about"
    return Forced(replace(told, groups=tuple(groups), rows=rows), peers)


def _pushed(
    group: PeerGroup, device: Device | None, ticks: Sequence[Fraction], start: Fraction
) -> tuple[PeerGroup, Peer]:
    """Return the first peer of a group with forces, drawn as a frame begins, and its copies' positions.

    Parameters
    ----------
    group
        The peers.
    device
        What a hand pushes.
    ticks
        When each force begins to act, in seconds of a frame.
    start
        When positions are taken, in seconds of a frame.
    """
    kind, schedule = group.jacobians.kind, group.schedule
    copies = [
        (sending.link, name)
        for sending in kind.sends
        for name, unit in zip(sending.channels, sending.units, strict=True)
        if unit == "m"
    ]
    sites, readings = [], []
    for one in (group.site, group.exact):
        push = np.zeros((len(one.a), 1), dtype=one.a.dtype)
        if device is not None:
            push[device.velocity] += device.inverse if one.a.dtype == object else float(device.inverse)
        sites.append(with_holds(one, push))
        readings.append(_told(sites[-1], kind))
    at = [int(time / schedule.quantum) for time in ticks] if device is not None else []
    taken = int(start / schedule.quantum)
    (site, exact), full, ports = with_ports(sites, schedule, 1, at, readings, [taken])
    own = group.with_site(site, exact, full)
    drawn = ports.drawn.ravel().tolist()
    return own, Peer(
        drawn=range(drawn[0], drawn[-1] + 1) if drawn else range(0),
        added=ports.added,
        copies=dict(zip(copies, ports.read[0].tolist(), strict=True)),
    )


def _told(site: LinearSite, kind: Kind) -> Matrix:
    """Return what of states and holds the positions depend on that are sent (positions, n_x + n_u)."""
    rows = [
        np.concatenate([send.x[place], send.u[place]])
        for send, sending in zip(site.sends, kind.sends, strict=True)
        for place, unit in enumerate(sending.units)
        if unit == "m"
    ]
    return np.array(rows, dtype=site.b.dtype).reshape(len(rows), sum(site.b.shape))
