"""Proof of stability for every value of some parameters in a box.

Takes: a `Model` and ranges.
Gives: `prove_robust_stability`; `search_box`, `CellTest`, `CellVerdict`,
`middle`; `BoxProblem`, `box_problem`; `TOGETHER`.
Guarantees: stable means proved for every point of the box, unstable proved at the named point.
Does not: find the boundary (see the undecided fraction).

The box is bisected until a norm proves each of its cells, all cells of a size together, in floats with their
radii (`cells`). Where these do not prove the middle of a cell stable, that point is analysed separately, to
test whether it is unstable.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze
from apc.analysis.box_result import UNDECIDED, RobustStability
from apc.compiler.compiled import Model
from apc.compiler.timings import part
from apc.extensions.parameter_boxes.cell_bounds import (
    Cell,
    ParametricClosedLoop,
    contracted,
    matrices_over,
    parametric_closed_loop,
)
from apc.extensions.parameter_boxes.parametric_frames import parametric_models
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import Range
from apc.spectrum.rigid_modes import classify_neutral_modes, find_rigid_modes, stays_rigid
from apc.spectrum.spectrum import up_to
from apc.support.threads import single_threaded
from apc.verdict import StabilityVerdict, Term

Floats = NDArray[np.float64]

# The limit of work, in analyses of a point, at some ten milliseconds each; the cost of a cell in floats as a
# fraction of one analysis.
MOST_CELLS = 500
LIGHT = 1 / 40

# Cells evaluated in floats together: their matrices then stay in the processor's cache.
TOGETHER = 128


@dataclass(frozen=True, slots=True, eq=False)
class CellVerdict:
    """The result of one cell: `reach` is None if the cell is proved stable, else the influence of each
    parameter.

    `unstable` states a proof of instability at the cell's middle; `work` is the cost, in analyses of a point.
    """

    reach: Floats | None
    unstable: bool = False
    work: float = 1.0


# Tests cells, one after the other, until one is unstable.
CellTest = Callable[[Sequence[Cell]], Iterator[CellVerdict]]


@part("box")
def prove_robust_stability(
    model: Model, ranges: Sequence[Range], *, cells: int | None = None, inside: float = 1.0
) -> RobustStability:
    """Return a proof that a model is stable in a complete box, or a point of the box where it is unstable.

    Parameters
    ----------
    model
        The compiled model.
    ranges
        The ranges of parameters, see `parametric_frames.parse_range`.
    cells
        The limit of evaluated cells; by default a limit of work of some seconds.
    inside
        The required bound on the spectral radius, by default 1.

    Raises
    ------
    ApcError
        E831 and E832 as `parametric_frames.parametric_models`; those of `analysis.analyze` at a point of the
        box.
    """
    with single_threaded(), np.errstate(all="ignore"):
        numeric = numeric_model(model)
        problem = box_problem(numeric, ranges, inside)

        def is_unstable(point: Sequence[Fraction]) -> bool:
            """Return whether the model is proved unstable, or beyond the required radius, at a point of
            the box.
            """
            values = [Override(interval.free, value) for interval, value in zip(ranges, point, strict=True)]
            analysis = analyze(numeric.at(apply(model, values)))
            return (
                analysis.verdict is StabilityVerdict.UNSTABLE
                or analysis.spectral_radius - analysis.spectral_radius_error > inside
            )

        box_proof = search_box(
            model.name,
            ranges,
            partial(_test_cells, problem.questions, is_unstable),
            is_unstable,
            stable=up_to(problem.translations, problem.rotations),
            unstable=StabilityVerdict.UNSTABLE,
            cells=0 if problem.notes else cells,
        )
        if problem.notes and box_proof.stable is None:
            return replace(box_proof, counterexample=(), notes=problem.notes)
        return box_proof


@dataclass(frozen=True, slots=True, eq=False)
class BoxProblem:
    """The closed systems of a model over a box, without their rigid modes, and the number of rigid modes.

    `notes` name the systems for which nothing can be proved over a box; they are not among the `questions`.
    """

    questions: tuple[ParametricClosedLoop, ...]
    translations: int
    rotations: int
    notes: tuple[str, ...]


def box_problem(numeric: NumericModel, ranges: Sequence[Range], inside: float) -> BoxProblem:
    """Return the closed systems of a model whose stability is to be proved over a box.

    Parameters
    ----------
    numeric, ranges, inside
        As for `prove_robust_stability`.
    """
    questions: list[ParametricClosedLoop] = []
    notes: list[str] = []
    translations = rotations = 0
    for closed, subsystems in parametric_models(numeric, ranges):
        rigid = find_rigid_modes(closed)
        if rigid.drifts or (rigid.names and not stays_rigid(closed, subsystems)):
            message = (
                "grows without bound" if rigid.drifts else "has a direction that depends on the parameters"
            )
            notes.append(f"{closed.name}: a rigid mode {message}, so no box can be proved")
            continue
        if rigid.names:
            neutral = classify_neutral_modes(closed, with_drifts=False)
            translations += neutral.translations
            rotations += neutral.rotations
        questions.append(parametric_closed_loop(closed, subsystems, rigid, inside))
    return BoxProblem(tuple(questions), translations, rotations, tuple(notes))


def search_box(
    name: str,
    ranges: Sequence[Range],
    cell_tests: CellTest,
    is_unstable: Callable[[tuple[Fraction, ...]], bool],
    *,
    stable: Term,
    unstable: Term,
    cells: int | None = None,
) -> RobustStability:
    """Return the result of tests at the middle and corners of a box, then of its cells, in order of size.

    Parameters
    ----------
    name, ranges
        The model's name, and the ranges of parameters.
    cell_tests
        The generator of the results of a list of cells.
    is_unstable
        Whether the model is proved unstable at a point.
    stable, unstable
        The verdicts of a box that is proved stable, and of one with an unstable point.
    cells
        As for `prove_robust_stability`.
    """
    box: Cell = tuple((interval.low, interval.high) for interval in ranges)
    evaluations, work = 0, 0.0

    def result_of(
        stable_or_none: bool | None, undecided: float, point: Sequence[Fraction]
    ) -> RobustStability:
        """Return the result, with the undecided fraction of the volume and a counterexample."""
        verdict = UNDECIDED if stable_or_none is None else stable if stable_or_none else unstable
        counterexample = tuple(map(float, point))
        return RobustStability(
            name, tuple(ranges), verdict, stable_or_none, max(evaluations, 1), undecided, counterexample, ()
        )

    def limit_reached() -> bool:
        """Return whether the limit of cells or of work is reached."""
        return work >= MOST_CELLS if cells is None else evaluations >= cells

    for point in (middle(box), *itertools.product(*box)):
        if is_unstable(point):
            return result_of(False, 1.0, point)
    level = [box]
    while level and not limit_reached():
        next_level, tested = list[Cell](), 0
        for cell, cell_test in zip(level, cell_tests(level), strict=False):
            evaluations, tested, work = evaluations + 1, tested + 1, work + cell_test.work
            if cell_test.unstable:
                return result_of(False, 1.0, middle(cell))
            if cell_test.reach is not None:
                widest = int(np.argmax(cell_test.reach))
                low, high = cell[widest]
                for half in ((low, (low + high) / 2), ((low + high) / 2, high)):
                    next_level.append((*cell[:widest], half, *cell[widest + 1 :]))
            if limit_reached():
                break
        level = level[tested:] + next_level
    if not level:
        return result_of(True, 0.0, ())
    share = sum(_volume(cell) for cell in level) / _volume(box)
    return result_of(None, float(share), middle(level[0]))


def middle(cell: Cell) -> tuple[Fraction, ...]:
    """Return the middle of a cell, one exact number for each parameter."""
    return tuple((low + high) / 2 for low, high in cell)


def _volume(cell: Cell) -> Fraction:
    """Return the volume of a cell."""
    return math.prod((high - low for low, high in cell), start=Fraction(1))


def _test_cells(
    questions: Sequence[ParametricClosedLoop],
    is_unstable: Callable[[tuple[Fraction, ...]], bool],
    cells: Sequence[Cell],
) -> Iterator[CellVerdict]:
    """Yield the result of each cell in floats; at the middle of an undecided cell, the result of an analysis.

    Cells are evaluated in batches of TOGETHER. The influence of a parameter is the largest over the closed
    systems that are not proved.
    """
    for start in range(0, len(cells), TOGETHER):
        batch = cells[start : start + TOGETHER]
        points: list[Cell] = [tuple((value, value) for value in middle(cell)) for cell in batch]
        proved, sound_at_middle = np.ones((2, len(batch)), dtype=np.bool_)
        reach = np.array([[float(high - low) for low, high in cell] for cell in batch])
        for question in questions:
            contraction = contracted(matrices_over(question, batch))
            sound_cells = contraction.inside | contraction.proved
            undecided = np.flatnonzero(~sound_cells)
            if len(undecided):
                undecided_points = [points[index] for index in undecided.tolist()]
                sound_cells[undecided] = contracted(matrices_over(question, undecided_points)).proved
            sound_at_middle &= sound_cells
            fails = ~contraction.proved & np.isfinite(contraction.reach).all(axis=1)
            first_failures = fails & proved
            reach[first_failures] = contraction.reach[first_failures]
            reach[fails] = np.maximum(reach, contraction.reach)[fails]
            proved &= contraction.proved
        for cell, is_proved, middle_is_sound, influence in zip(
            batch, proved, sound_at_middle, reach, strict=True
        ):
            if is_proved or middle_is_sound:
                yield CellVerdict(None if is_proved else influence, work=LIGHT)
            else:
                yield CellVerdict(influence, unstable=is_unstable(middle(cell)))
