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

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import Loop
from apc.eigen.modes import complete_loops
from apc.eigen.peers import PeerGroup, group_of_row
from apc.eigen.rigid import find_rigid_modes, stays_rigid
from apc.frame.exact import evaluate_exact
from apc.frame.exchange import Exchange
from apc.frame.linearize import site_of_entries
from apc.frame.residues import PRIMES, Residues, residues_of, residues_of_rounded
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
        free = len(find_rigid_modes(loop, with_drifts=False).names)
        if free and not hold_for_all(loop, [population_of[id(group)] for group in loop.sites]):
            return None
        total += loop.multiplicity * free
    return total


def hold_for_all(loop: Loop, listed: Sequence[Population]) -> bool:
    """Say whether the rigid modes of a loop of representatives are those of every peer of their populations.

    Parameters
    ----------
    loop
        Its sites are the representatives; all peers hear what they do.
    listed
        The population of each site.
    """
    try:
        for prime in PRIMES:
            for place, population in enumerate(listed):
                sites = [group.exact for group in loop.sites]
                sites[place] = _all_peers(population, np.unique(population.rows), prime)
                if not stays_rigid(loop, sites):
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
