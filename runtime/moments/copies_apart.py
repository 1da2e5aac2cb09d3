"""How far copies are from each other while hands push at random, over the network as it is.

Takes: a scene that is stable in mean square, and how its second moments move.
Gives: `Forced`, `forced`, `PeerReadings`; `moments_error`, `largest_error`.
Guarantees: the peers move as before, and are pushed besides; positions are those at the start of a frame of
the scene, whenever frames are said to begin.
Does not: say whether the scene is stable (see `network_verdict`); bound rounding.

Every device is pushed by a force of its own of variance 1 N², drawn anew at each tick of the fastest clock as
a frame begins; the error of a copy is its position less the mean of the others', as frames begin. Pushes add
to second moments frame by frame, and what of that lasts is what the operator makes of them, over and over.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model, PeerType
from apc.eigen.modes import dense_loop
from apc.eigen.peers import PeerClass
from apc.eigen.relative import Relative
from apc.frame.devices import Device, coupled_directly, find_device
from apc.frame.ports import with_holds, with_ports
from apc.frame.site import LinearSubsystem
from apc.moments.crowd import Moments, PerTickReception, instants
from apc.moments.operator import settled
from apc.unserved import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# How far a motion that nothing holds back may move copies: those of rational weights are rounded.
STANDING = 1e-9

# A copy is called by the link and channel that tell others where it is.
Copy = tuple[str, str]


@dataclass(frozen=True, slots=True)
class PeerReadings:
    """What of z a peer got: `drawn` are forces in N as a frame begins, `copies` positions in m."""

    drawn: range
    copies: Mapping[Copy, int]


@dataclass(frozen=True, slots=True)
class Forced:
    """The peers of a scene, pushed; `peers` says what of z they got, by the schedule's id."""

    hearing: PerTickReception
    peers: Mapping[int, PeerReadings]

    def of(self, sites: Sequence[PeerClass]) -> list[tuple[int, PeerReadings]]:
        """Return of each class of peers how many there are, and what they got."""
        return [(site.count, self.peers[id(site.schedule)]) for site in sites]

    def peer_by_peer(self) -> list[tuple[int, PeerReadings]]:
        """Return what each peer got, one after another."""
        return self.of(dense_loop(self.hearing.groups, self.hearing.exchange).sites)


def forced(system: Model, hearing: PerTickReception, first: Fraction = Fraction(0)) -> Forced:
    """Push what hands hold, each for itself, by a force of variance 1 N².

    Parameters
    ----------
    system
        The compiled scene.
    hearing
        Its peers.
    first
        When frames begin there, in seconds.

    Raises
    ------
    NotSupportedError
        It is not clear what hands hold.
    """
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    direct = coupled_directly(system.kinds)
    used = {part.clock for kind in system.kinds for part in kind.clocks} | {
        link.clock for link in system.links
    }
    fastest = min(
        (clock for clock in system.clocks if clock.name in used),
        key=lambda clock: hearing.timings[clock.period],
    )
    ticks = instants(hearing, fastest)
    groups, rows, peers = [], {}, {}
    built: dict[tuple[int, int], tuple[PeerClass, PeerReadings]] = {}
    for group in hearing.groups:
        key = id(group.schedule), id(group.lifting)
        if key not in built:
            held = find_device(group.jacobians, group.parameters, unit_of, group.listening, direct=direct)
            if isinstance(held, str):
                raise NotSupportedError(held)
            built[key] = _pushed(group, held, ticks, -first % hearing.frame)
        pushed, peer = built[key]
        groups.append(
            replace(
                group,
                jacobians=pushed.jacobians,
                site=pushed.site,
                exacting=pushed.exacting,
                schedule=pushed.schedule,
                lifting=pushed.lifting,
            )
        )
        rows[id(pushed.schedule)] = hearing.rows.get(id(group.schedule), ())
        peers[id(pushed.schedule)] = peer
    if not any(peer.drawn for peer in peers.values()):
        raise NotSupportedError("no peer holds anything but what it tells others about")
    return Forced(replace(hearing, groups=tuple(groups), rows=rows), peers)


def _pushed(
    group: PeerClass, device: Device | None, ticks: Sequence[Fraction], start: Fraction
) -> tuple[PeerClass, PeerReadings]:
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
    for site in (group.site, group.exact):
        push = np.zeros((len(site.a), 1), dtype=site.a.dtype)
        if device is not None:
            push[device.velocity] += device.inverse if site.a.dtype == object else float(device.inverse)
        sites.append(with_holds(site, push))
        readings.append(_positions(sites[-1], kind))
    at = [int(time / schedule.quantum) for time in ticks] if device is not None else []
    taken = int(start / schedule.quantum)
    (site, exact), full, ports = with_ports(sites, schedule, 1, at, readings, [taken])
    drawn = ports.drawn.ravel().tolist()
    peer = PeerReadings(
        drawn=range(drawn[0], drawn[-1] + 1) if drawn else range(0),
        copies=dict(zip(copies, ports.read[0].tolist(), strict=True)),
    )
    return group.with_site(site, exact, full), peer


def _positions(site: LinearSubsystem, kind: PeerType) -> Matrix:
    """Return what of states and holds the positions depend on that are sent (positions, n_x + n_u)."""
    rows = [
        np.concatenate([send.x[place], send.u[place]])
        for send, sending in zip(site.sends, kind.sends, strict=True)
        for place, unit in enumerate(sending.units)
        if unit == "m"
    ]
    return np.array(rows, dtype=site.b.dtype).reshape(len(rows), sum(site.b.shape))


def moments_error(of: Moments, classes: Sequence[tuple[int, PeerReadings]]) -> float:
    """Return the largest error of copies in m.

    Parameters
    ----------
    of
        The loops of peers that are pushed, and their luck.
    classes
        How many peers each class has, and what they got.
    """
    added = []
    for moving, n in zip(of.moving, of.operator.sizes, strict=True):
        drawn = np.zeros(n)
        if moving.heard is None:  # a peer that is pushed
            _, peer = classes[moving.loop.of[0]]
            whole = np.zeros(len(moving.at.held) + len(moving.at.rest))
            whole[np.array(peer.drawn, np.intp)] = 1.0
            drawn[:] = whole[moving.at.rest]
        added.append(np.diag(drawn))
    moments = settled(of.operator, added)
    variances = dict[tuple[Copy, int], float]()
    for moving, moment in zip(of.moving, moments, strict=True):
        sites = [
            (site.count, classes[g][1])
            for site, g in zip(moving.loop.loop.sites, moving.loop.of, strict=True)
        ]
        for copy, place, row in _error_rows(sites, moving.at, moving.offsets):
            n, weight = len(row), moving.loop.many[place] * (moving.heard or 1)
            key = copy, moving.loop.of[place]
            variances[key] = variances.get(key, 0.0) + weight * float(row @ moment[:n, :n] @ row)
    return _largest(np.array(list(variances.values())))


def largest_error(
    moments: Floats, at: Relative, offsets: Sequence[int], classes: Sequence[tuple[int, PeerReadings]]
) -> float:
    """Return the largest error of copies in m of peers that are followed one by one.

    Parameters
    ----------
    moments
        The second moments (n, n) of a long run over relative coordinates.
    at, offsets
        These, of states that begin at the offsets, peer by peer.
    classes
        What each peer got, as for `moments_error`.
    """
    rows = _error_rows(classes, at, offsets)
    return _largest(np.array([row @ moments @ row for *_, row in rows]))


def _largest(variances: Floats) -> float:
    """Return the root of the largest variance."""
    largest = float(variances.max())
    if not largest >= 0:
        raise NotSupportedError("rounding leaves its digits in doubt")
    return math.sqrt(largest)


def _error_rows(
    sites: Sequence[tuple[int, PeerReadings]], at: Relative, offsets: Sequence[int]
) -> list[tuple[Copy, int, Floats]]:
    """Return the error of a copy of each site that has others: which copy and site, and it over coordinates.

    It is x_i − (Σ_j x_j − x_i)/(N − 1).

    Parameters
    ----------
    sites
        How many peers each site has, and what they got.
    at, offsets
        Relative coordinates, of states that begin at the offsets, site by site.
    """
    errors = []
    for copy in dict.fromkeys(copy for _, peer in sites for copy in peer.copies):
        places = {
            g: offsets[g] + peer.copies[copy] for g, (_, peer) in enumerate(sites) if copy in peer.copies
        }
        others = sum(sites[g][0] for g in places) - 1
        for g in places if others else ():
            row = np.zeros(len(at.held) + len(at.rest))
            for k, place in places.items():
                row[place] = (k == g) * (1 + 1 / others) - sites[k][0] / others
            moved = row[at.held] + row[at.rest] @ at.weights
            if np.abs(moved).max(initial=0.0) > STANDING * np.abs(row).max(initial=0.0):
                raise NotSupportedError(
                    "nothing holds the copies together: what they differ by grows for ever"
                )
            errors.append((copy, g, row[at.rest]))
    if not errors:
        raise NotSupportedError("no position of a mass is told to others")
    return errors
