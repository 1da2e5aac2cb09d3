"""Proof of stability for every value of some parameters in a box.

Takes: a `Model` and ranges.
Gives: `RobustStability`, `ChangingDelay`, `prove_robust_stability`; `search_box`, `CellTest`, `CellVerdict`,
`middle`; `BoxProblem`, `box_problem`; `TOGETHER`, `UNDECIDED`.
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
from apc.analysis.cell_bounds import (
    Cell,
    ParametricClosedLoop,
    contracted,
    matrices_over,
    parametric_closed_loop,
)
from apc.analysis.parametric_frames import parametric_models
from apc.compiler.compiled import Model
from apc.compiler.timings import part
from apc.eigen.rigid_modes import classify_neutral_modes, find_rigid_modes, stays_rigid
from apc.eigen.spectrum import up_to
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import Range
from apc.result import Result
from apc.threads import single_threaded
from apc.verdict import BoxVerdict, StabilityVerdict, Term

Floats = NDArray[np.float64]
UNDECIDED = BoxVerdict.UNDECIDED

# The limit of work for each closed system, in analyses of a point, at some ten milliseconds each; the cost of
# a cell in floats as a part of one.
MOST_CELLS = 500
LIGHT = 1 / 40

# Cells evaluated in floats together: their matrices then stay in the processor's cache.
TOGETHER = 128


@dataclass(frozen=True, slots=True)
class ChangingDelay:
    """The proved results for a delay that changes from packet to packet within a range.

    From the range's lower end to `proved_to` seconds the model is stable under any variation; None where that
    is proved for no part of it. `unstable` are the numbers of consecutive packets with the smallest and with
    the largest delay whose alternation makes it unstable. `note` is the reason if there is no result.
    """

    proved_to: float | None
    unstable: tuple[int, int] | None
    note: str = ""


@dataclass(frozen=True, slots=True)
class RobustStability(Result):
    """The result of a proof over a box; `stable` is None when neither verdict was proved.

    `cells` is the number of evaluated cells; `undecided_fraction` of the box's volume is undecided.
    `counterexample`, SI values in the order of `ranges`, is an unstable point, or the middle of the largest
    undecided cell. `changing`, for a box over a delay alone, is the result for a varying delay.
    """

    shown_by = "analysis_output:box_proof"

    topology: str
    ranges: tuple[Range, ...]
    verdict: Term
    stable: bool | None
    cells: int
    undecided_fraction: float
    counterexample: tuple[float, ...]
    notes: tuple[str, ...]
    limitations: tuple[str, ...] = ()
    changing: ChangingDelay | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CellVerdict:
    """The result of a cell: empty where it is proved, or else the influence of each parameter in it.

    `unstable` states a proof of instability at the cell's middle; `work` is the cost, in analyses of a point.
    """

    reach: Floats | None
    unstable: bool = False
    work: float = 1.0


# Tests cells, one after the other, until one is unstable.
CellTest = Callable[[Sequence[Cell]], Iterator[CellVerdict]]


@part("box")
def prove_robust_stability(
    system: Model, ranges: Sequence[Range], *, cells: int | None = None, inside: float = 1.0
) -> RobustStability:
    """Prove a model stable in a complete box, or find a point of it where it is unstable.

    Parameters
    ----------
    system
        The compiled model.
    ranges
        The ranges of parameters, see `parametric_frames.parse_range`.
    cells
        The limit of evaluated cells; by default, as many as take some seconds.
    inside
        The required bound on the spectral radius, by default 1.

    Raises
    ------
    ApcError
        E831 and E832 as `parametric_frames.parametric_models`; those of `analysis.analyze` at a point of the
        box.
    """
    with single_threaded(), np.errstate(all="ignore"):
        prepared = prepare(system)
        opened = box_problem(system, ranges, prepared, inside)

        def is_unstable(point: Sequence[Fraction]) -> bool:
            values = [Override(interval.free, value) for interval, value in zip(ranges, point, strict=True)]
            analysis = analyze(apply(system, values), prepared=prepared)
            return (
                analysis.verdict is StabilityVerdict.UNSTABLE
                or analysis.spectral_radius - analysis.spectral_radius_error > inside
            )

        box_proof = search_box(
            system.name,
            ranges,
            partial(_cell_tested, opened.questions, is_unstable),
            is_unstable,
            stable=up_to(opened.translations, opened.rotations),
            unstable=StabilityVerdict.UNSTABLE,
            cells=0 if opened.notes else cells,
        )
        if opened.notes and box_proof.stable is None:
            return replace(box_proof, counterexample=(), notes=opened.notes)
        return box_proof


@dataclass(frozen=True, slots=True, eq=False)
class BoxProblem:
    """The closed systems of a model over a box, without their rigid modes, and their number.

    `notes` name the systems for which nothing can be proved over a box; those are not among the `questions`.
    """

    questions: tuple[ParametricClosedLoop, ...]
    translations: int
    rotations: int
    notes: tuple[str, ...]


def box_problem(system: Model, ranges: Sequence[Range], prepared: Prepared, inside: float) -> BoxProblem:
    """Return the systems whose stability is to be proved over a box.

    Parameters
    ----------
    system, ranges, inside
        As for `prove_robust_stability`.
    prepared
        From `numeric_model.prepare`.
    """
    questions: list[ParametricClosedLoop] = []
    notes: list[str] = []
    translations = rotations = 0
    for closed, subsystems in parametric_models(system, ranges, prepared):
        free = find_rigid_modes(closed)
        if free.drifts or (free.names and not stays_rigid(closed, subsystems)):
            message = (
                "drifts" if free.drifts else "moves freely in a direction that changes with the parameters"
            )
            notes.append(f"{closed.name} {message}: nothing can be proved for a whole box")
            continue
        if free.names:
            neutral = classify_neutral_modes(closed, with_drifts=False)
            translations += neutral.translations
            rotations += neutral.rotations
        questions.append(parametric_closed_loop(closed, subsystems, free, inside))
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
    """Return the result of tests at the middle and the corners of a box, then cell by cell, the larger first.

    Parameters
    ----------
    name, ranges
        The model's name, and the ranges of parameters.
    cell_tests
        Tests cells.
    is_unstable
        Whether the model is proved unstable at a point.
    stable, unstable
        The texts of the verdicts.
    cells
        As of `prove_robust_stability`.
    """
    whole: Cell = tuple((interval.low, interval.high) for interval in ranges)
    evaluations, work = 0, 0.0

    def answer(known: bool | None, left: float, point: Sequence[Fraction]) -> RobustStability:
        verdict = UNDECIDED if known is None else stable if known else unstable
        where = tuple(map(float, point))
        return RobustStability(name, tuple(ranges), verdict, known, max(evaluations, 1), left, where, ())

    def enough() -> bool:
        return work >= MOST_CELLS if cells is None else evaluations >= cells

    for point in (middle(whole), *itertools.product(*whole)):
        if is_unstable(point):
            return answer(False, 1.0, point)
    level = [whole]
    while level and not enough():
        halves, done = list[Cell](), 0
        for cell, cell_test in zip(level, cell_tests(level), strict=False):
            evaluations, done, work = evaluations + 1, done + 1, work + cell_test.work
            if cell_test.unstable:
                return answer(False, 1.0, middle(cell))
            if cell_test.reach is not None:
                widest = int(np.argmax(cell_test.reach))
                low, high = cell[widest]
                for half in ((low, (low + high) / 2), ((low + high) / 2, high)):
                    halves.append((*cell[:widest], half, *cell[widest + 1 :]))
            if enough():
                break
        level = level[done:] + halves
    if not level:
        return answer(True, 0.0, ())
    share = sum(_volume(cell) for cell in level) / _volume(whole)
    return answer(None, float(share), middle(level[0]))


def middle(cell: Cell) -> tuple[Fraction, ...]:
    """Return the middle of a cell."""
    return tuple((low + high) / 2 for low, high in cell)


def _volume(cell: Cell) -> Fraction:
    return math.prod((high - low for low, high in cell), start=Fraction(1))


def _cell_tested(
    questions: Sequence[ParametricClosedLoop],
    is_unstable: Callable[[tuple[Fraction, ...]], bool],
    cells: Sequence[Cell],
) -> Iterator[CellVerdict]:
    """Return the results of cells in floats, many at a time, or at the middle where a cell is not proved.

    The influence of a parameter is the largest over the closed systems that are not proved.
    """
    for start in range(0, len(cells), TOGETHER):
        some = cells[start : start + TOGETHER]
        points: list[Cell] = [tuple((value, value) for value in middle(cell)) for cell in some]
        proved, inside = np.ones((2, len(some)), dtype=np.bool_)
        reach = np.array([[float(high - low) for low, high in cell] for cell in some])
        for question in questions:
            contraction = contracted(matrices_over(question, some))
            sound = contraction.inside | contraction.proved
            left = np.flatnonzero(~sound)
            if len(left):
                at = [points[index] for index in left.tolist()]
                sound[left] = contracted(matrices_over(question, at)).proved
            inside &= sound
            fails = ~contraction.proved & np.isfinite(contraction.reach).all(axis=1)
            first = fails & proved
            reach[first] = contraction.reach[first]
            reach[fails] = np.maximum(reach, contraction.reach)[fails]
            proved &= contraction.proved
        for cell, is_proved, is_sound, matters in zip(some, proved, inside, reach, strict=True):
            if is_proved or is_sound:
                yield CellVerdict(None if is_proved else matters, work=LIGHT)
            else:
                yield CellVerdict(matters, unstable=is_unstable(middle(cell)))
