"""How many motions nothing holds back, in a population of peers that all differ.

Takes: populations, and the exchange between them.
Gives: `count_translations`.
Guarantees: a motion counts if it is one in exact arithmetic for every peer, each with its own numbers.
Does not: find a motion that only some peers of a population are free to make: a count of eigenvalues (see
`zeros`) then finds one more at 1 than was said, and the verdict is left open.

The first peer of each population stands for all: were all peers like it, the standing solutions of the common
and the difference system would be found exactly (see `rigid`). Each of these is then put into the equations
of every peer, modulo two primes.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.weights import exact_weight
from apc.eigen.closing import Loop
from apc.eigen.modes import complete_loops
from apc.eigen.peer_group import PeerGroup
from apc.eigen.peers import group_of_row
from apc.eigen.rigid import find_rigid_modes, stays_rigid
from apc.frame.exact import evaluate_exact
from apc.frame.exchange import Exchange
from apc.frame.linearize import site_of_entries
from apc.frame.residues import PRIMES, Residues, residues_of, residues_of_rounded
from apc.frame.schedule import Way
from apc.frame.site import LinearSite
from apc.large.populations import Population

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def representatives(listed: Sequence[Population], exchange: Exchange) -> list[PeerGroup]:
    """Return the first peer of each population, as many as there are peers in it."""
    return [
        group_of_row(
            population.jacobians,
            population.parameters[0],
            population.schedule,
            exchange,
            population.group,
            len(population.rows),
        )
        for population in listed
    ]


def count_translations(listed: Sequence[Population], exchange: Exchange) -> int | None:
    """Return how many independent motions nothing holds back on complete graphs; None if it can't be told.

    Parameters
    ----------
    listed
        All peers.
    exchange
        The links, all of them complete.
    """
    groups = representatives(listed, exchange)
    population_of = {id(group): population for group, population in zip(groups, listed, strict=True)}
    total = 0
    for loop in complete_loops(groups, exchange):
        free = find_rigid_modes(loop, with_drifts=False).directions.shape[1]
        if free and not hold_for_all(loop, [population_of[id(group)] for group in loop.sites]):
            return None
        total += loop.multiplicity * free
    return total


def _shares(groups: Sequence[PeerGroup], exchange: Exchange, way: Way) -> tuple[tuple[Fraction, ...], ...]:
    """Return what each population hears of each on a way, in shares of all that it hears.

    As if it heard as much of every population that it hears.
    """
    sending = [one.sends(way.link) for one in groups]
    rows = []
    for g, group in enumerate(groups):
        heard = exchange.hears(way.link, g, sending)
        late = [exchange.delay(way.link, one.role, group.role) == way.delay for one in groups]
        rows.append(
            tuple(
                Fraction(1, len(heard)) if h in heard and late[h] else Fraction(0) for h in range(len(groups))
            )
        )
    return tuple(rows)


def _weighed(
    rows: Sequence[Sequence[Fraction]], totals: Sequence[Fraction]
) -> tuple[tuple[Fraction, ...], ...]:
    """Return shares as parts of totals."""
    return tuple(tuple(total * share for share in row) for row, total in zip(rows, totals, strict=True))


def _heard_arcs(listed: Sequence[Population], exchange: Exchange, link: str) -> tuple[Integers, Floats]:
    """Return who hears something over a link, arc by arc, and the weights."""
    pairs, weights = exchange.arcs(link)
    sends = np.repeat(
        [population.sends(link) for population in listed], [len(population.rows) for population in listed]
    )
    heard = sends[pairs[:, 0]]
    return pairs[heard, 1], weights[heard]


def _all_totals(listed: Sequence[Population], exchange: Exchange, link: str, prime: int) -> Integers:
    """Return what each peer hears over a link in all, modulo a prime (N,)."""
    receivers, weights = _heard_arcs(listed, exchange, link)
    found = np.zeros(exchange.peers, np.int64)
    exact = [exact_weight(weight) for weight in np.unique(weights).tolist()]
    np.add.at(found, receivers, residues_of_rounded(weights, exact, prime).column)
    return found % prime


def _subtract(vector: list[Fraction], times: Fraction, other: Sequence[Fraction], start: int) -> None:
    """Take so many times another vector from a part of a vector, in place."""
    if times:
        for place, entry in enumerate(other):
            vector[start + place] -= times * entry


def hold_for_all(loop: Loop, listed: Sequence[Population], *, exchange: Exchange | None = None) -> bool:
    """Say whether the rigid modes of a loop of representatives are those of every peer of their populations.

    Parameters
    ----------
    loop
        Its sites are the representatives.
    listed
        The population of each site.
    exchange
        The links, where a sum over one is as large as what each peer hears itself; else all hear what their
        representative does.
    """
    sums = [way for way in loop.coupling if way.operator == "sum"]
    shares = {way: _shares(loop.sites, exchange, way) for way in sums} if exchange else {}
    try:
        for prime in PRIMES:
            links = dict.fromkeys(way.link for way in shares)
            totals = [_all_totals(listed, exchange, link, prime) for link in links] if exchange else []
            for place, population in enumerate(listed):
                # Its peers, each once that differ in their numbers or in what they hear.
                first = int(exchange.starts[population.group]) if exchange else 0
                own = [one[first : first + len(population.rows)] for one in totals]
                rows, *heard = np.unique(np.stack([population.rows, *own]), axis=1)
                total_of = {link: Residues(one, prime) for link, one in zip(links, heard, strict=True)}
                sites = [group.exact for group in loop.sites]
                sites[place] = _all_peers(population, rows, prime)
                coupling: dict[Way, Any] = dict(loop.coupling)
                for way, listed_shares in shares.items():
                    weights = tuple(total_of[way.link] * share for share in listed_shares[place])
                    coupling[way] = (*coupling[way][:place], weights, *coupling[way][place + 1 :])
                if not stays_rigid(loop, sites, coupling=coupling):
                    return False
    except (TypeError, ValueError, ZeroDivisionError):  # an operation that is none of a field
        return False
    return True


def _all_peers(population: Population, rows: Integers, prime: int) -> LinearSite:
    """Return the matrices of some of a population's different peers, each entry a column modulo a prime."""
    built = population.jacobians
    columns = [residues_of(column, prime) for column in population.parameters[rows].T]
    for place, rationals in built.kind.rounded:
        columns[place] = residues_of_rounded(population.parameters[rows, place], rationals, prime)
    zero = Residues(np.zeros(len(rows), np.int64), prime)
    arguments = [[zero] * built.function.numel_in(argument) for argument in range(4)]

    def number(value: float) -> Residues:
        return zero + Fraction(value)

    flat = evaluate_exact(built.function, [*arguments, columns, [zero]], number=number)[0]
    return site_of_entries(built, flat, zero)
