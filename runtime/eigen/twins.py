"""Peers that can change places: a loop of many sites as a few small ones.

Takes: the `Loop` of a whole system.
Gives: `split_twins`.
Guarantees: the loops it returns, each as often as its multiplicity says, have together the spectrum of the
loop.
Does not: find symmetries other than of two sites that change places.

Twins g and h are of equal dynamics, hear all others alike and are heard by them alike. A class c of n_c
twins that weigh themselves by w_own and one another by w_other moves alike, as one site that hears
w_own + (n_c − 1) w_other times itself and n_d W_cd times class d; or apart, its sum zero and all else at
rest, each twin hearing w_own − w_other times itself, n_c − 1 times over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np

from apc.eigen.closing import Loop
from apc.eigen.peer_group import PeerGroup, group_name
from apc.frame.exchange import Exchange
from apc.frame.schedule import Way


def split_twins(loop: Loop, exchange: Exchange) -> tuple[Loop, ...]:
    """Split a loop by its twins.

    Parameters
    ----------
    loop
        Of all peers, one a site, its weights exact; without twins it is returned as it is.
    exchange
        The links, for the names of the groups.
    """
    classes: list[list[int]] = []
    for place in range(len(loop.sites)):
        alike = (members for members in classes if _are_twins(loop, members[0], place))
        found = next(alike, None)
        if found is None:
            classes.append([place])
        else:
            found.append(place)
    if loop.doubts or len(classes) == len(loop.sites):
        return (loop,)
    sites = tuple(_together([loop.sites[place] for place in members], exchange) for members in classes)
    coupling = {
        way: tuple(tuple(_weight_of(loop, way, members, others) for others in classes) for members in classes)
        for way in loop.coupling
    }
    loops = [replace(loop, name="common", sites=sites, coupling=coupling)]
    for site, members in zip(sites, classes, strict=True):
        if len(members) > 1:
            first, second = members[:2]
            apart = {
                way: ((rows[first][first] - rows[first][second],),) for way, rows in loop.coupling.items()
            }
            many = loop.multiplicity * (len(members) - 1)
            loops.append(Loop(f"difference {site.name}", many, (site,), apart))
    return tuple(loops)


def _are_twins(loop: Loop, g: int, h: int) -> bool:
    """Say whether two sites can change places."""
    one, other = loop.sites[g], loop.sites[h]
    if one.lifted is not other.lifted or one.schedule is not other.schedule:
        return False
    rest = [place for place in range(len(loop.sites)) if place not in (g, h)]
    return all(
        rows[g][g] == rows[h][h]
        and rows[g][h] == rows[h][g]
        and all(rows[g][k] == rows[h][k] and rows[k][g] == rows[k][h] for k in rest)
        for rows in loop.coupling.values()
    )


def _weight_of(loop: Loop, way: Way, members: Sequence[int], others: Sequence[int]) -> Fraction:
    """Return what a site of one class hears of a class whose sites all move alike."""
    row = loop.coupling[way][members[0]]
    return sum((row[place] for place in others), Fraction(0))


def _together(sites: Sequence[PeerGroup], exchange: Exchange) -> PeerGroup:
    """Return equal sites as one group."""
    peers = np.sort(np.concatenate([np.array(list(site.peers)) for site in sites]))
    groups = np.searchsorted(exchange.starts, peers, side="right") - 1
    parts = [(int(group), peers[groups == group] - exchange.starts[group]) for group in np.unique(groups)]
    return replace(sites[0], name=group_name(parts, exchange), count=len(peers), peers=peers)
