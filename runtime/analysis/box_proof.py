"""Proof that a scene is stable for every value of some parameters in a box.

Takes: a `Model` and ranges.
Gives: `RobustStability`, `ChangingDelay`, `prove_box`; `search_box`, `CellTest`, `CellVerdict`, `middle`;
`BoxProblem`, `open_questions`; `TOGETHER`, `UNDECIDED`.
Guarantees: stable means proved for every point of the box, unstable proved at the point that is named.
Does not: find the boundary (see the share that is left open).

The box is halved until a norm proves each of its cells, all cells of a size at once, in floats with their
radii (`cells`). Where these don't even prove a cell's middle stable, that point is analysed by itself: is it
unstable?
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
from apc.analysis.box import open_systems
from apc.analysis.cells import Cell, ParametricClosedLoop, contracted, matrices_over, open_system
from apc.compiler.compiled import Model
from apc.compiler.timings import part
from apc.eigen.rigid import find_rigid_modes, stays_rigid, what_stands
from apc.eigen.spectrum import up_to
from apc.frame.instance import Prepared, prepare
from apc.frame.names import Range
from apc.frame.overrides import Override, apply
from apc.result import Result
from apc.threads import single_threaded
from apc.verdict import BoxVerdict, StabilityVerdict, Term

Floats = NDArray[np.float64]
UNDECIDED = BoxVerdict.UNDECIDED

# Work for each closed system, in analyses of a point, at some ten milliseconds each; a cell in floats is this
# part of one.
MOST_CELLS = 500
LIGHT = 1 / 40

# Cells looked at in floats together: their matrices then stay in the cache of a processor.
TOGETHER = 128


@dataclass(frozen=True, slots=True)
class ChangingDelay:
    """What was proved of a delay that changes from packet to packet within a range, each way by itself.

    From the range's lower end to `proved_to` seconds the scene is stable however it changes; None where that
    is proved of no part of it. `unstable` is a number of packets with the least delay and one with the
    largest which, by turns, make it unstable. `note` says why nothing is said.
    """

    proved_to: float | None
    unstable: tuple[int, int] | None
    note: str = ""


@dataclass(frozen=True, slots=True)
class RobustStability(Result):
    """What was proved of a box; `stable` is None when neither was.

    `cells` were looked at; `open_share` of the box's volume is left open. `point`, SI values in the order of
    `ranges`, is where it is unstable, or the middle of the largest cell left open. `left_out` says what the
    verdict is without. `changing`, of a box over a delay alone, is for one that doesn't stay constant.
    """

    shown_by = "analysis_output:box_proof"

    topology: str
    ranges: tuple[Range, ...]
    verdict: Term
    stable: bool | None
    cells: int
    open_share: float
    point: tuple[float, ...]
    notes: tuple[str, ...]
    left_out: tuple[str, ...] = ()
    changing: ChangingDelay | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CellVerdict:
    """What came out for a cell: nothing where it is proved, or else how much each parameter matters in it.

    `unstable` says that it is so, proved, at the cell's middle; `work` is what it took, in analyses of a
    point.
    """

    reach: Floats | None
    unstable: bool = False
    work: float = 1.0


# Looks at cells, one after the other; nobody asks on after one that is unstable.
CellTest = Callable[[Sequence[Cell]], Iterator[CellVerdict]]


@part("box")
def prove_box(
    system: Model, ranges: Sequence[Range], *, cells: int | None = None, inside: float = 1.0
) -> RobustStability:
    """Prove a scene stable in a whole box, or find a point of it where it is unstable.

    Parameters
    ----------
    system
        The compiled scene.
    ranges
        The parameters left open, see `box.parse_range`.
    cells
        How many cells are looked at at most; without it, as many as take some seconds.
    inside
        What the spectral radius has to be below, in the place of 1.

    Raises
    ------
    ApcError
        E831 and E832 as `box.open_systems`; those of `analysis.analyze` at a point of the box.
    """
    with single_threaded(), np.errstate(all="ignore"):
        prepared = prepare(system)
        opened = open_questions(system, ranges, prepared, inside)

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
            partial(_looked, opened.questions, is_unstable),
            is_unstable,
            stable=up_to(opened.translations, opened.rotations),
            unstable=StabilityVerdict.UNSTABLE,
            cells=0 if opened.notes else cells,
        )
        if opened.notes and box_proof.stable is None:
            return replace(box_proof, point=(), notes=opened.notes)
        return box_proof


@dataclass(frozen=True, slots=True, eq=False)
class BoxProblem:
    """The closed systems of a scene over a box, without their rigid motions, and how many these are.

    `notes` say of which systems nothing can be proved for a whole box; those are not among the `questions`.
    """

    questions: tuple[ParametricClosedLoop, ...]
    translations: int
    rotations: int
    notes: tuple[str, ...]


def open_questions(system: Model, ranges: Sequence[Range], prepared: Prepared, inside: float) -> BoxProblem:
    """Return what is to be proved of a scene all over a box.

    Parameters
    ----------
    system, ranges, inside
        As for `prove_box`.
    prepared
        From `instance.prepare`.
    """
    questions: list[ParametricClosedLoop] = []
    notes: list[str] = []
    translations = rotations = 0
    for closed, sites in open_systems(system, ranges, prepared):
        free = find_rigid_modes(closed)
        if free.drifts or (free.names and not stays_rigid(closed, sites)):
            what = "drifts" if free.drifts else "moves freely in a direction that changes with the parameters"
            notes.append(f"{closed.name} {what}: nothing can be proved for a whole box")
            continue
        if free.names:
            standing = what_stands(closed, with_drifts=False)
            translations += standing.translations
            rotations += standing.rotations
        questions.append(open_system(closed, sites, free, inside))
    return BoxProblem(tuple(questions), translations, rotations, tuple(notes))


def search_box(
    name: str,
    ranges: Sequence[Range],
    looks: CellTest,
    is_unstable: Callable[[tuple[Fraction, ...]], bool],
    *,
    stable: Term,
    unstable: Term,
    cells: int | None = None,
) -> RobustStability:
    """Look at the middle and the corners of a box, then prove it cell by cell, the larger before the smaller.

    Parameters
    ----------
    name, ranges
        The scene's, and the parameters left open.
    looks
        Looks at cells.
    is_unstable
        Whether it is proved unstable at a point.
    stable, unstable
        The verdicts.
    cells
        As of `prove_box`.
    """
    whole: Cell = tuple((interval.low, interval.high) for interval in ranges)
    looked, work = 0, 0.0

    def answer(known: bool | None, left: float, point: Sequence[Fraction]) -> RobustStability:
        verdict = UNDECIDED if known is None else stable if known else unstable
        where = tuple(map(float, point))
        return RobustStability(name, tuple(ranges), verdict, known, max(looked, 1), left, where, ())

    def enough() -> bool:
        return work >= MOST_CELLS if cells is None else looked >= cells

    for point in (middle(whole), *itertools.product(*whole)):
        if is_unstable(point):
            return answer(False, 1.0, point)
    level = [whole]
    while level and not enough():
        halves, done = list[Cell](), 0
        for cell, look in zip(level, looks(level), strict=False):
            looked, done, work = looked + 1, done + 1, work + look.work
            if look.unstable:
                return answer(False, 1.0, middle(cell))
            if look.reach is not None:
                widest = int(np.argmax(look.reach))
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


def _looked(
    questions: Sequence[ParametricClosedLoop],
    is_unstable: Callable[[tuple[Fraction, ...]], bool],
    cells: Sequence[Cell],
) -> Iterator[CellVerdict]:
    """Look at cells in floats, many at a time; at the middle alone where these don't prove it stable.

    A parameter matters as much as it does in that closed system, of those not proved, where it matters most.
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
                at = [points[place] for place in left.tolist()]
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
