"""The number of neutral modes in a population of peers that all differ.

Takes: populations, and their communication graph.
Gives: `count_translations`.
Guarantees: a neutral mode counts if it exists in exact arithmetic for all values of the differing parameters.
Does not: find a neutral mode of some peers of a population only, or one that needs a relation between these
parameters. A count of eigenvalues (see `zeros`) then finds an additional one at 1, and the verdict is
undecided.

The first peer of each population represents all. The neutral modes of the common and the difference system of
such equal peers are computed exactly (see `rigid_modes`). Each is then inserted into the equations of a peer
with random rationals for the differing parameters. A rational function that vanishes there vanishes
identically, except with probability 2^−50.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from random import Random

import numpy as np

from apc.lifting.numeric_model import NumericModel
from apc.linearization.jacobians import guards_of
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.linearization.linearize import subsystem_of_entries
from apc.parameter_values.exact_arithmetic import evaluate_exact, is_rational
from apc.parameter_values.parameters import rationals
from apc.spectrum.heterogeneous_peers import HeterogeneousGroup
from apc.spectrum.interconnection import ModalSystem
from apc.spectrum.modes import complete_loops
from apc.spectrum.peer_classes import representatives
from apc.spectrum.rigid_modes import find_rigid_modes, stays_rigid

LARGEST = 2**61 - 1  # the denominator of random rationals: a prime


def count_translations(numeric: NumericModel, populations: Sequence[HeterogeneousGroup]) -> int | None:
    """Return the number of independent neutral modes of populations on complete graphs; None if undetermined.

    Parameters
    ----------
    numeric
        The model with its parameter values, with complete graphs only.
    populations
        The peers of the model, by group.
    """
    peer_classes = representatives(numeric)
    total = 0
    for modal_system in complete_loops(peer_classes, numeric.comm_graph):
        free = len(find_rigid_modes(modal_system, with_drifts=False).names)
        if free and not are_common_to_all_peers(
            modal_system, [populations[peer_class.index] for peer_class in modal_system.peer_classes]
        ):
            return None
        total += modal_system.multiplicity * free
    return total


def are_common_to_all_peers(modal_system: ModalSystem, populations: Sequence[HeterogeneousGroup]) -> bool:
    """Return whether the rigid modes of a loop of representatives are those of all represented peers.

    Parameters
    ----------
    modal_system
        A loop whose subsystems are the representatives.
    populations
        The population of each subsystem.
    """
    for index, population in enumerate(populations):
        if not (population.parameters != population.parameters[0]).any():
            continue  # every represented peer equals its representative
        subsystems: list[LinearSubsystem | None] = [
            peer_class.exact for peer_class in modal_system.peer_classes
        ]
        subsystems[index] = _random_peer(population)
        linear_subsystems = [subsystem for subsystem in subsystems if subsystem is not None]
        if len(linear_subsystems) < len(subsystems) or not stays_rigid(modal_system, linear_subsystems):
            return False
    return True


def _random_peer(population: HeterogeneousGroup) -> LinearSubsystem | None:
    """Return the matrices of a peer with random rationals for all differing parameters.

    The result is None if the matrices are not rational functions of the parameters.
    """
    jacobians, numbers = population.jacobians, population.parameters
    symbols = jacobians.function.sx_in()
    if not is_rational(jacobians.function) or guards_of(jacobians.function(*symbols), symbols[4]):
        return None
    vector, random = rationals(numbers[0]), Random(0)
    for index in np.flatnonzero((numbers != numbers[0]).any(axis=0)):
        vector[index] = Fraction(random.randrange(1, LARGEST), LARGEST)
    arguments = [[Fraction(0)] * size for size in map(jacobians.function.numel_in, range(4))]
    result = evaluate_exact(jacobians.function, [*arguments, vector, [Fraction(0)]])[0]
    return subsystem_of_entries(jacobians, result, 0)
