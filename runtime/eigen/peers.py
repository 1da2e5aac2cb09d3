"""Which peers move alike: the groups of equal peers of a scene.

Takes: a `CompiledSystem`, its numbers, Jacobians and schedules, and the exchange.
Gives: `peer_groups`, `more_differ`, `group_of_row`.
Guarantees: as few groups as there are peers of different dynamics, found in a time that grows with the number
of peers, not with its square. A site that is not affine is linearized at its own start values, hearing the
others at theirs.
Does not: close the loop between them (see `modes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.listening import StartClasses
from apc.eigen.peer_group import PeerGroup, Peers, Runs, build_group, check_size, joined, used_ways
from apc.frame.exchange import Exchange
from apc.frame.jacobians import SiteJacobians
from apc.frame.linearize import linearize, linearize_rows, site_of_row
from apc.frame.parameters import Numbers
from apc.frame.schedule import Schedule

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# More different peers than this are refused where each has to be looked at with each other: the slopes of
# edge functions and the start values of what is heard cost their square.
MOST_DIFFERENT = 400

# Peers looked at together for whether they differ: mostly, the first ones tell.
PEEK = 1024

# What equal peers have in common: their kind, their role in the exchange, their numbers as bytes.
_Key = tuple[int, int, bytes]


def peer_groups(
    system: CompiledSystem,
    jacobians: Sequence[SiteJacobians],
    schedules: Sequence[Schedule],
    numbers: Numbers,
    exchange: Exchange,
) -> tuple[PeerGroup, ...]:
    """Find the groups of equal peers of a system, linearize each once.

    Parameters
    ----------
    system
        The compiled scene.
    jacobians
        One a kind.
    schedules
        One a group of the scene.
    numbers
        The parameters and timings.
    exchange
        The links.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over nobody, E802 a mean whose weights add up to 0, E803 a maximum or
        minimum that is not smooth at the start, E804 more different peers than one system can hold.
    """
    used = [jacobians[group.kind] for group in system.groups]
    if all(site.parameters_suffice for site in used):
        return _by_matrices(system, jacobians, schedules, numbers, exchange)
    return _by_start(system, jacobians, schedules, numbers, exchange)


def _by_matrices(
    system: CompiledSystem,
    jacobians: Sequence[SiteJacobians],
    schedules: Sequence[Schedule],
    numbers: Numbers,
    exchange: Exchange,
) -> tuple[PeerGroup, ...]:
    """Group peers of equal matrices, whatever their start values and constant forces."""
    rows: dict[_Key, tuple[int, Floats, Floats]] = {}
    members: dict[_Key, list[tuple[int, Peers]]] = {}
    for place, group in enumerate(system.groups):
        parameters = numbers.parameters[place]
        keys: list[_Key] = []
        for vector, matrices in zip(
            parameters, linearize_rows(jacobians[group.kind], parameters), strict=True
        ):
            keys.append((group.kind, exchange.role(place), matrices.tobytes()))
            rows.setdefault(keys[-1], (place, vector, matrices))
        for key, peers in _split(keys, numbers.rows[place]):
            members.setdefault(key, []).append((place, peers))
    check_size([jacobians[key[0]] for key in members], exchange)
    found = []
    for number, (key, parts) in enumerate(members.items()):
        place, vector, matrices = rows[key]
        built = jacobians[key[0]]
        site = site_of_row(built, matrices)
        found.append(build_group(number, parts, vector, built, site, schedules[place], exchange))
    return tuple(found)


def _by_start(
    system: CompiledSystem,
    jacobians: Sequence[SiteJacobians],
    schedules: Sequence[Schedule],
    numbers: Numbers,
    exchange: Exchange,
) -> tuple[PeerGroup, ...]:
    """Group peers that start alike among others that start alike, and linearize them there."""
    links = {way.link for way in used_ways(schedules)}
    complete = all(exchange.is_complete(link) for link in links)
    members: dict[tuple[Any, ...], list[tuple[int, Peers]]] = {}
    for place, group in enumerate(system.groups):
        role, vectors = exchange.role(place), numbers.parameters[place]
        keys = [(group.kind, role, (vector + 0.0).tobytes()) for vector in vectors]
        for key, peers in _split(keys, numbers.rows[place]):
            if complete:
                members.setdefault(key, []).append((place, peers))
            else:  # who hears whom may differ from peer to peer
                members |= {
                    (*key, place, int(peer)): [(place, np.array([peer]))]
                    for peer in peers[: MOST_DIFFERENT + 1]
                }
    if len(members) > MOST_DIFFERENT:
        what = f"more than {MOST_DIFFERENT} peers that differ, in their place in a graph or at the start,"
        raise ApcError(Mistake("E804", Place(exchange.scene), f"{what} can't be linearized pair by pair"))
    parts = sorted(members.values(), key=lambda part: (part[0][0], int(part[0][1][0])))
    sites = StartClasses(system, jacobians, schedules, numbers, exchange, parts)
    listened = [sites.listen(g) for g in range(len(parts))]

    # Peers apart in the graph are one group if they turned out alike, and weigh all others alike.
    merged: dict[tuple[Any, ...], int] = {}
    alike = all(len(listed) == 1 for _, gains in listened for listed in gains.values())
    joined: dict[int, list[tuple[int, Peers]]] = {}
    for g, (listening, gains) in enumerate(listened):
        own = parts[g][0][0]
        same = (
            *(system.groups[own].kind, exchange.role(own), sites.vectors[g].tobytes()),
            *(listening, tuple(gains.items()), g if not alike else 0),
        )
        joined.setdefault(merged.setdefault(same, g), []).extend(parts[g])
    first = list(joined)
    built = [jacobians[system.groups[parts[g][0][0]].kind] for g in first]
    check_size(built, exchange)
    return tuple(
        build_group(
            g,
            _together(joined[g]),
            sites.vectors[g],
            site,
            linearize(site, sites.vectors[g], listened[g][0]),
            schedules[parts[g][0][0]],
            exchange,
            listening=listened[g][0],
            gains=listened[g][1],
        )
        for g, site in zip(first, built, strict=True)
    )


def more_differ(
    system: CompiledSystem,
    jacobians: Sequence[SiteJacobians],
    numbers: Numbers,
    exchange: Exchange,
    count: int,
) -> bool:
    """Say whether there are more than `count` peers of different matrices, all affine and without edges.

    Parameters
    ----------
    system
        The compiled scene.
    jacobians
        One a kind.
    numbers
        The scene's numbers.
    exchange
        The links.
    count
        How many are not too many; with one more the search ends.
    """
    keys: set[_Key] = set()
    for place, group in enumerate(system.groups):
        parameters = numbers.parameters[place]
        for start in range(0, len(parameters), PEEK):
            rows = linearize_rows(jacobians[group.kind], parameters[start : start + PEEK])
            keys |= {(group.kind, exchange.role(place), row.tobytes()) for row in rows}
            if len(keys) > count:
                return True
    return False


def group_of_row(
    built: SiteJacobians, vector: Floats, schedule: Schedule, exchange: Exchange, group: int, count: int
) -> PeerGroup:
    """Return `count` peers of the scene's group `group` as if all were like one of them.

    Parameters
    ----------
    built, vector, schedule
        Its kind's Jacobians, its parameters (n_p,), its schedule.
    exchange
        The links.
    group, count
        The scene's group, and how many.
    """
    site = site_of_row(built, linearize_rows(built, vector[None])[0])
    parts = [(group, Runs((range(count),)))]
    return build_group(group, parts, vector, built, site, schedule, exchange)


def _split(keys: Sequence[_Key], row_of: Integers) -> list[tuple[_Key, Peers]]:
    """Return, for each different key, the peers (counted in their group) whose row has it."""
    different = list(dict.fromkeys(keys))
    if len(different) == 1:
        return [(different[0], Runs((range(len(row_of)),)))]
    number = {key: place for place, key in enumerate(different)}
    of_peer = np.array([number[key] for key in keys])[row_of]
    order = np.argsort(of_peer, kind="stable")
    ends = np.cumsum(np.bincount(of_peer, minlength=len(different)))[:-1]
    return list(zip(different, np.split(order, ends), strict=True))


def _together(parts: Sequence[tuple[int, Peers]]) -> list[tuple[int, Peers]]:
    """Join the parts of each group of the scene."""
    found: dict[int, list[Peers]] = {}
    for group, peers in parts:
        found.setdefault(group, []).append(peers)
    return [(group, joined(listed)) for group, listed in found.items()]
