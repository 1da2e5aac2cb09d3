"""Upper bound on the improvement possible over the gains found, proved by branch and bound.

Takes: the models of the active scenarios, the gains' ranges, and the optimum found.
Gives: `SHARE`, `none_better`.
Guarantees: over each cell of better gains, one of the models is proved to have an eigenvalue outside the unit
circle.
Does not: show that better gains exist where the proof fails.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.analysis.cell_bounds import Cell, ParametricClosedLoop, matrices_over
from apc.analysis.robust_stability import TOGETHER, box_problem
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.eigen.enclosure import least_radius
from apc.frame.interval_arithmetic import value_of
from apc.frame.numeric_model import Prepared
from apc.frame.parameter_names import Range

# The improvement considered irrelevant; the largest numbers of gains and of matrix entries of all cells: some
# seconds.
SHARE = Fraction(2, 100)
GAINS, ENTRIES = 3, 600_000


def none_better(
    topologies: Sequence[Model],
    prepared: Prepared,
    gains: Sequence[Range],
    objective: int,
    *,
    value: Fraction,
    larger: bool,
    inside: float,
    until: float,
) -> int | None:
    """Return in how many cells it is proved that no gains do better by `SHARE`; None where it is not.

    Parameters
    ----------
    topologies, prepared
        The models that limit the gains most, and the result of `numeric_model.prepare` for one.
    gains, objective
        The gains' ranges, and the place of that which is to be large, or small.
    value, larger
        The objective at the optimum; whether it is maximized.
    inside
        The radius of the circle that eigenvalues are wanted in.
    until
        The time limit, by `time.monotonic`.
    """
    beyond = value + (1 if larger else -1) * SHARE * abs(value)
    spans = [(gain.low, gain.high) for gain in gains]
    spans[objective] = (beyond, gains[objective].high) if larger else (gains[objective].low, beyond)
    if not spans[objective][0] < spans[objective][1] or len(gains) > GAINS:
        return None
    try:
        opened = [box_problem(topology, gains, prepared, inside) for topology in topologies]
    except ApcError:  # a model that is no rational function of the gains
        return None
    questions = [question for item in opened for question in item.questions]
    cells: list[Cell] = [tuple(spans)]
    evaluations = entries = 0
    while cells:
        if not questions or entries > ENTRIES or time.monotonic() > until:
            return None
        some, cells = cells[:TOGETHER], cells[TOGETHER:]
        evaluations += len(some)
        unstable, widest, size = _test_cells(questions, some)
        entries += size
        for cell, position in ((some[index], int(widest[index])) for index in np.flatnonzero(~unstable)):
            low, high = cell[position]
            halves = ((low, (low + high) / 2), ((low + high) / 2, high))
            cells += [(*cell[:position], half, *cell[position + 1 :]) for half in halves]
    return evaluations


def _test_cells(
    questions: Sequence[ParametricClosedLoop], cells: Sequence[Cell]
) -> tuple[NDArray[np.bool_], NDArray[np.intp], int]:
    """Return the cells proved unstable, the most sensitive gain of each, and the entries evaluated."""
    unstable, size = np.zeros(len(cells), dtype=np.bool_), 0
    reach = np.zeros((len(cells), len(cells[0])))
    for question in questions:
        left = np.flatnonzero(~unstable)
        if not len(left):
            break
        matrix = matrices_over(question, [cells[index] for index in left.tolist()])
        size += matrix[:, 0].size
        reach[left] = np.maximum(reach[left], np.abs(matrix[:, 2:]).sum(axis=(2, 3)))
        outside = np.asarray(np.isfinite(matrix).all(axis=(1, 2, 3)))
        values = np.linalg.eigvals(value_of(matrix[outside]))
        outside[outside] = np.abs(values).max(axis=1, initial=0.0) > 1
        low = [least_radius(item[0], item[2:], item[1]) for item in matrix[outside]]
        unstable[left[outside]] = np.array(low) > 1
    return unstable, reach.argmax(axis=1), size
