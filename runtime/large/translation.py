"""How many motions nothing holds back, in a population of peers that all differ.

Takes: crowds, and the exchange between them.
Gives: `count_translations`, `common_translation`.
Guarantees: a motion counts if it is one in exact arithmetic for every peer, each with its own numbers.
Does not: find a motion that only some peers of a crowd are free to make: a count of eigenvalues (see `zeros`)
then finds one more at 1 than was said, and the verdict is left open.

The first peer of each crowd stands for all: were all peers like it, the standing solutions of the common and
the difference system would be found exactly (see `rigid`). Each of these is then put into the equations of
every peer, modulo two primes.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.runtime.eigen.modes import Loop, complete_loops
from apc.runtime.eigen.peers import PeerGroup, group_of_row, states_of, used_ways
from apc.runtime.eigen.rigid import find_rigid_modes, stays_rigid
from apc.runtime.frame.exact import evaluate_exact
from apc.runtime.frame.exchange import Exchange
from apc.runtime.frame.linearize import site_of_entries
from apc.runtime.frame.residues import PRIMES, Residues, residues_of
from apc.runtime.frame.schedule import Way
from apc.runtime.frame.site import LinearSite
from apc.runtime.large.crowds import Crowd

Floats = NDArray[np.float64]


def representatives(listed: Sequence[Crowd], exchange: Exchange) -> list[PeerGroup]:
    """Return the first peer of each crowd, as many as there are peers in it."""
    return [
        group_of_row(
            crowd.jacobians, crowd.parameters[0], crowd.schedule, exchange, crowd.group, len(crowd.rows)
        )
        for crowd in listed
    ]


def count_translations(listed: Sequence[Crowd], exchange: Exchange) -> int | None:
    """Return how many independent motions nothing holds back on complete graphs; None if it can't be told.

    Parameters
    ----------
    listed
        All peers.
    exchange
        The links, all of them complete.
    """
    groups = representatives(listed, exchange)
    crowd_of = {id(group): crowd for group, crowd in zip(groups, listed, strict=True)}
    total = 0
    for loop in complete_loops(groups, exchange):
        free = find_rigid_modes(loop, with_drifts=False).directions.shape[1]
        if free and not hold_for_all(loop, [crowd_of[id(group)] for group in loop.sites]):
            return None
        total += loop.multiplicity * free
    return total


def common_translation(listed: Sequence[Crowd], exchange: Exchange) -> list[Floats] | None:
    """Return the motions of all peers together that nothing holds back, whatever the graph.

    Parameters
    ----------
    listed
        All peers.
    exchange
        The links.

    Returns
    -------
    For each crowd the motions (n_g, d) over the state of one of its peers, z and then its packets, as in
    `crowds.hear_themselves`; None if it can't be told, or if peers are free to move one by one.
    """
    groups = representatives(listed, exchange)
    total = _sums(listed, exchange)
    if total is None:
        return None
    ways = used_ways(group.schedule for group in groups)
    coupling = {
        way: tuple(
            tuple(
                _share(groups, way, exchange, g, h) * (1 if way.operator == "mean" else total[way.link])
                for h in range(len(groups))
            )
            for g in range(len(groups))
        )
        for way in ways
    }
    loop = Loop("common", 1, tuple(groups), coupling)
    free = find_rigid_modes(loop, with_drifts=False)
    deaf = Loop(
        "deaf", 1, tuple(groups), {way: ((Fraction(0),) * len(groups),) * len(groups) for way in ways}
    )
    if find_rigid_modes(deaf, with_drifts=False).names or not hold_for_all(loop, listed):
        return None
    ends = np.cumsum([0, *(states_of(group.schedule, group.jacobians) for group in groups)])
    return [free.directions[a:b] for a, b in itertools.pairwise(ends)]


def _share(groups: Sequence[PeerGroup], way: Way, exchange: Exchange, g: int, h: int) -> Fraction:
    """Return crowd h's share of what crowd g hears on a way, if all senders move alike."""
    on_the_way = [
        one.sends(way.link) and exchange.delay(way.link, one.role, groups[g].role) == way.delay
        for one in groups
    ]
    return Fraction(1, sum(on_the_way)) if on_the_way[h] else Fraction(0)


def _sums(listed: Sequence[Crowd], exchange: Exchange) -> dict[str, Fraction] | None:
    """Return the sum of the weights that every peer hears over each link of a sum; None when they differ."""
    found = {}
    for way in used_ways(crowd.schedule for crowd in listed):
        if way.operator == "sum" and way.link not in found:
            pairs, weights = exchange.arcs(way.link)
            sums = np.bincount(pairs[:, 1], weights, minlength=exchange.peers)
            if np.any(sums != sums[0]) or len(listed) > 1:
                return None
            found[way.link] = Fraction(float(sums[0]))
    return found


def hold_for_all(loop: Loop, listed: Sequence[Crowd]) -> bool:
    """Say whether the rigid modes of a loop of representatives are those of every peer of their crowds.

    Parameters
    ----------
    loop
        Its sites are the representatives.
    listed
        The crowd of each site.
    """
    try:
        for prime in PRIMES:
            for place, crowd in enumerate(listed):
                sites = [group.exact() for group in loop.sites]
                sites[place] = _all_peers(crowd, prime)
                if not stays_rigid(loop, sites):
                    return False
    except (TypeError, ValueError, ZeroDivisionError):  # an operation that is none of a field
        return False
    return True


def _all_peers(crowd: Crowd, prime: int) -> LinearSite:
    """Return the matrices of all different peers of a crowd, each entry a column modulo a prime."""
    built = crowd.jacobians
    columns = [residues_of(column, prime) for column in crowd.parameters.T]
    zero = Residues(np.zeros(len(crowd.parameters), np.int64), prime)
    arguments = [[zero] * built.function.numel_in(argument) for argument in range(4)]

    def number(value: float) -> Residues:
        return zero + Fraction(value)

    flat = evaluate_exact(built.function, [*arguments, columns, [zero]], number=number)[0]
    return site_of_entries(built, flat)
