"""How many motions nothing holds back, in a population of peers that all differ.

Takes: populations, and the exchange between them.
Gives: `count_translations`.
Guarantees: a motion counts if it is one in exact arithmetic, whatever the numbers in which peers differ.
Does not: find a motion that only some peers of a population are free to make, or only by a relation between
these numbers: a count of eigenvalues (see `zeros`) then finds one more at 1 than was said, and the verdict is
left open.

The first peer of each population stands for all: were all peers like it, the standing solutions of the common
and the difference system would be found exactly (see `rigid`). Each of these is then put into the
equations of a peer with random rationals in the place of the numbers in which peers differ: a quotient of
polynomials that vanishes there vanishes for all, but for one chance in 2^50.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from random import Random

import numpy as np

from apc.eigen.closing import ModalSystem
from apc.eigen.modes import complete_loops
from apc.eigen.peers import representatives
from apc.eigen.rigid import find_rigid_modes, stays_rigid
from apc.frame.exact import evaluate_exact, is_rational
from apc.frame.instance import Instance
from apc.frame.jacobians import guards_of
from apc.frame.linearize import site_of_entries
from apc.frame.parameters import exact_numbers
from apc.frame.site import LinearSubsystem
from apc.large.populations import HeterogeneousGroup

LARGEST = 2**61 - 1  # of what random numbers are made of: a prime


def count_translations(instance: Instance, populations: Sequence[HeterogeneousGroup]) -> int | None:
    """Return how many independent motions nothing holds back on complete graphs; None if it can't be told.

    Parameters
    ----------
    instance
        The scene, all links of it complete.
    populations
        Its peers, by their groups.
    """
    groups = representatives(instance)
    population_of = {id(group): population for group, population in zip(groups, populations, strict=True)}
    total = 0
    for loop in complete_loops(groups, instance.exchange):
        free = len(find_rigid_modes(loop, with_drifts=False).names)
        if free and not hold_for_all(loop, [population_of[id(group)] for group in loop.sites]):
            return None
        total += loop.multiplicity * free
    return total


def hold_for_all(loop: ModalSystem, populations: Sequence[HeterogeneousGroup]) -> bool:
    """Say whether the rigid modes of a loop of representatives are those of every peer of their populations.

    Parameters
    ----------
    loop
        Its sites are the representatives; all peers hear what they do.
    populations
        The population of each site.
    """
    for place, population in enumerate(populations):
        sites: list[LinearSubsystem | None] = [group.exact for group in loop.sites]
        sites[place] = _any_peer(population)
        linear_sites = [site for site in sites if site is not None]
        if len(linear_sites) < len(sites) or not stays_rigid(loop, linear_sites):
            return False
    return True


def _any_peer(population: HeterogeneousGroup) -> LinearSubsystem | None:
    """Return the matrices of a peer of random numbers where peers differ; None unless they are quotients."""
    built, numbers = population.jacobians, population.parameters
    symbols = built.function.sx_in()
    if not is_rational(built.function) or guards_of(built.function(*symbols), symbols[4]):
        return None
    vector, random = exact_numbers(built.kind, numbers[0]), Random(0)
    for place in np.flatnonzero((numbers != numbers[0]).any(axis=0)):
        vector[place] = Fraction(random.randrange(1, LARGEST), LARGEST)
    arguments = [[Fraction(0)] * size for size in map(built.function.numel_in, range(4))]
    result = evaluate_exact(built.function, [*arguments, vector, [Fraction(0)]])[0]
    return site_of_entries(built, result, 0)
