"""The numbers with which a compiled system becomes matrices.

Takes: a `CompiledSystem` and overrides.
Gives: `Numbers`, `resolve`; `exact_numbers`.
Guarantees: peers with the same parameters share one row; what depends on a parameter that differs from peer
to peer is worked out peer by peer, in floats, in a time that grows with the number of peers.
Does not: read or apply overrides (`overrides`); build a matrix (`linearize`, `scheduling`).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Kind
from apc.frame.overrides import Override, apply
from apc.frame.resolver import Floats, different_rows


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """Everything a compiled system needs to become matrices.

    `parameters` holds one matrix (k, n_p) a group: its peers' different rows, in the order in which they come
    first, columns in the order of its kind's parameters; `rows` (count,) says which of them each peer has.
    `timings` are seconds by name.
    """

    parameters: tuple[Floats, ...]
    rows: tuple[NDArray[np.int64], ...]
    timings: Mapping[str, Fraction]


def resolve(system: CompiledSystem, overrides: Sequence[Override] = ()) -> Numbers:
    """Return the numbers of a system, after the overrides.

    Raises
    ------
    ApcError
        As `apply`.
    """
    system = apply(system, overrides)
    found = [different_rows(system, group) for group in system.groups]
    return Numbers(
        parameters=tuple(parameters for parameters, _ in found),
        rows=tuple(rows for _, rows in found),
        timings={timing.name: timing.value for timing in system.timings},
    )


def exact_numbers(kind: Kind, vector: Floats) -> list[Fraction]:
    """Return a peer's parameters (n_p,) exactly: as the floats they are, or what these floats round.

    Parameters
    ----------
    kind
        Of the peer: knows what is rounded.
    vector
        Its parameters (n_p,), in the order of `Kind.parameters`.
    """
    numbers = [Fraction(value) for value in vector.tolist()]
    for place, rationals in kind.rounded:
        near = bisect_left(rationals, vector[place], key=float)
        assert float(rationals[near]) == vector[place], f"{kind.parameters[place]} is none of its values"
        numbers[place] = rationals[near]
    return numbers
