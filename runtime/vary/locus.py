"""Where the eigenvalues of a scene go as one of its numbers grows: the root locus, in the plane of z.

Takes: a `CompiledSystem` and a `Critical` of it. Gives: `Locus`, `root_locus`.
Guarantees: every point is an eigenvalue of the frame with that value, what is rigid at every value left out,
every packet on time; a value that the scene can't have is left out.
Does not: prove anything; the crossings are those of `critical`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze, prepare
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Place
from apc.compiler.timings import part
from apc.eigen.eigenpairs import eigenvalues as eigenvalues_of
from apc.frame.names import Free, find
from apc.frame.overrides import apply
from apc.vary.evaluator import evaluator_of_many, overrides_at, reaches_time

if TYPE_CHECKING:
    from apc.vary.critical import Critical

POINTS = 100  # values looked at
BEYOND = 2.0  # times what matters most is looked up to: the present value, and where stability changes


@dataclass(frozen=True, slots=True, eq=False)
class Locus:
    """Eigenvalues by value: `eigenvalues[k]` (n_k,) are those at `values[k]`, in SI; `now` the present ones.

    `critical` says which parameter it is, and where stability changes.
    """

    critical: Critical
    frame_s: float
    values: NDArray[np.float64]
    eigenvalues: tuple[NDArray[np.complex128], ...]
    now: NDArray[np.complex128]


@part("locus")
def root_locus(system: CompiledSystem, found: Critical) -> Locus:
    """Follow the eigenvalues of a scene over the values at which its stability was looked at.

    Parameters
    ----------
    system
        The compiled scene, all other numbers as they are.
    found
        What `critical` says of one of its parameters: that one is varied.
    """
    free = find(system, found.parameter, counts=True)
    low, high = found.scanned
    most = max([abs(found.present), *(one.value for one in found.crossings[:1]), found.value or 0.0])
    high = min(high, BEYOND * most) if most > low else high
    values = np.linspace(low, high, POINTS)
    if found.counted:
        values = np.unique(np.round(values))
    here = analyze(system)
    now = np.array([mode.eigenvalue for mode in here.modes])
    if found.counted or reaches_time(system, free):
        values, eigenvalues = _one_by_one(system, free, values)
    else:
        values, eigenvalues = _at_once(system, free, values)
    return Locus(found, here.frame_s, values, eigenvalues, now)


def _at_once(
    system: CompiledSystem, free: Free, values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[NDArray[np.complex128], ...]]:
    """Return the values of a parameter that have eigenvalues, and these, by all matrices in one go."""
    with np.errstate(all="ignore"):
        family = evaluator_of_many(system, [free], Place(free.label), prepared=prepare(system))
        matrices = family.matrices(values[:, None])
    known = np.all([np.isfinite(one).all(axis=(1, 2)) for one in matrices], axis=0) & np.isfinite(values)
    chosen = [one[known] if len(one) > 1 else one for one in matrices]
    listed = [eigenvalues_of(one, np.zeros_like(one))[0] for one in chosen]
    count = int(known.sum())
    every = np.concatenate([np.broadcast_to(one, (count, one.shape[1])) for one in listed], axis=1)
    return values[known], tuple(every.astype(np.complex128))


def _one_by_one(
    system: CompiledSystem, free: Free, values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], tuple[NDArray[np.complex128], ...]]:
    """Return the same of a time or a number of peers, with which the frame itself is another."""
    kept, eigenvalues = [], []
    for value in values.tolist():
        try:
            modes = analyze(apply(system, overrides_at(system, [free], [value]))).modes
        except ApcError:
            continue  # a delay, for one, that an order of events allows no more
        kept.append(value)
        eigenvalues.append(np.array([mode.eigenvalue for mode in modes]))
    return np.array(kept), tuple(eigenvalues)
