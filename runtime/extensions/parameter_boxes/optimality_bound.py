"""Upper bound on the possible improvement of optimal gains, proved by branch and bound.

Takes: the models of the active scenarios, the gains' ranges, and the optimum found.
Gives: `cells_without_better_gains`.
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

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.extensions.parameter_boxes.cell_bounds import Cell, ParametricClosedLoop, matrices_over
from apc.extensions.parameter_boxes.robust_stability import TOGETHER, box_problem
from apc.lifting.interval_arithmetic import value_of
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.parameter_names import Range
from apc.spectrum.enclosure import least_radius
from apc.tuning.specification import OPTIMALITY_GAP

# The limits of gains and of matrix entries over all cells: some seconds.
GAINS, ENTRIES = 3, 600_000


def cells_without_better_gains(
    topologies: Sequence[Model],
    numeric: NumericModel,
    gains: Sequence[Range],
    objective: int,
    *,
    value: Fraction,
    larger: bool,
    inside: float,
    until: float,
) -> int | None:
    """Return the number of cells in a proof that no gains improve the objective by `OPTIMALITY_GAP`.

    The result is None without a proof.

    Parameters
    ----------
    topologies, numeric
        The models with the most active constraints, and their topology with any parameter values.
    gains, objective
        The gains' ranges, and the index of the objective's gain.
    value, larger
        The objective at the optimum, and whether it is maximized.
    inside
        The required bound on the magnitude of eigenvalues.
    until
        The time limit, by `time.monotonic`.
    """
    improved_value = value + (1 if larger else -1) * OPTIMALITY_GAP * abs(value)
    better_box = [(gain.low, gain.high) for gain in gains]
    better_box[objective] = (
        (improved_value, gains[objective].high) if larger else (gains[objective].low, improved_value)
    )
    if not better_box[objective][0] < better_box[objective][1] or len(gains) > GAINS:
        return None
    try:
        problems = [box_problem(numeric.at(topology), gains, inside) for topology in topologies]
    except ApcError:  # a model that is no rational function of the gains
        return None
    questions = [question for problem in problems for question in problem.questions]
    cells: list[Cell] = [tuple(better_box)]
    evaluations = entries = 0
    while cells:
        if not questions or entries > ENTRIES or time.monotonic() > until:
            return None
        batch, cells = cells[:TOGETHER], cells[TOGETHER:]
        evaluations += len(batch)
        unstable, widest, size = _test_cells(questions, batch)
        entries += size
        for cell, position in ((batch[index], int(widest[index])) for index in np.flatnonzero(~unstable)):
            low, high = cell[position]
            halves = ((low, (low + high) / 2), ((low + high) / 2, high))
            cells += [(*cell[:position], half, *cell[position + 1 :]) for half in halves]
    return evaluations


def _test_cells(
    questions: Sequence[ParametricClosedLoop], cells: Sequence[Cell]
) -> tuple[NDArray[np.bool_], NDArray[np.intp], int]:
    """Return the mask of cells proved unstable, the most sensitive gain of each, and the entries
    evaluated.
    """
    unstable, size = np.zeros(len(cells), dtype=np.bool_), 0
    reach = np.zeros((len(cells), len(cells[0])))
    for question in questions:
        undecided = np.flatnonzero(~unstable)
        if not len(undecided):
            break
        matrix = matrices_over(question, [cells[index] for index in undecided.tolist()])
        size += matrix[:, 0].size
        reach[undecided] = np.maximum(reach[undecided], np.abs(matrix[:, 2:]).sum(axis=(2, 3)))
        is_unstable = np.asarray(np.isfinite(matrix).all(axis=(1, 2, 3)))
        values = np.linalg.eigvals(value_of(matrix[is_unstable]))
        is_unstable[is_unstable] = np.abs(values).max(axis=1, initial=0.0) > 1
        lower_bounds = [least_radius(stacked[0], stacked[2:], stacked[1]) for stacked in matrix[is_unstable]]
        unstable[undecided[is_unstable]] = np.array(lower_bounds) > 1
    return unstable, reach.argmax(axis=1), size
