"""Proof that a scene is stable for every value of some parameters in a box.

Takes: a `CompiledSystem` and ranges.
Gives: `BoxProof`, `prove_box`; `search_box`, `Look`, `Looked`, `middle`; `BITS`, `TOGETHER`,
`UNDECIDED`.
Guarantees: stable means proved for every point of the box, unstable proved at the point that is named.
Does not: find the boundary (see the share that is left open).

The box is halved until a norm proves each of its cells, all cells of a size at once, in floats with their
radii (`cells`). Where these don't even prove a cell's middle stable, balls are asked: is it unstable, or is
the cell stable after all? There M(p) = M(c) + Σ_k S_k (p_k − c_k), each S_k a slope somewhere in the cell,
which balls hold all of; the norm is the same.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.analysis.box import Box, open_box
from apc.analysis.cells import Cell, OpenSystem, change_of_basis, look, open_system
from apc.compiler.compiled import CompiledSystem
from apc.compiler.timings import part
from apc.eigen.balls import (
    Balls,
    Dual,
    closed_frame,
    frame_steps,
    mapped,
    precision,
    rational_ball,
    reduced_balls,
    slope_of,
    square,
    step_duals,
)
from apc.eigen.certify import schur_cohn
from apc.eigen.closing import ClosedSystem
from apc.eigen.enclosure import misses_one
from apc.eigen.ratios import Ratio
from apc.eigen.relative import independent_places, relative_bounded, relative_coordinates
from apc.eigen.rigid import RigidModes, find_rigid_modes, rigid_modes_here, stays_rigid, what_stands
from apc.eigen.spectrum import UNSTABLE, up_to
from apc.frame.names import Range
from apc.frame.site import LinearSite, entrywise
from apc.result import Result
from apc.threads import single_threaded

Floats = NDArray[np.float64]
UNDECIDED = "undecided"

# Bits of the proof: those that 1,000 ticks lose, and twice those of a float.
BITS = 256

# Work for each closed system, in cells looked at in balls, at some ten milliseconds each; a cell in floats is
# this part of one.
MOST_CELLS = 500
LIGHT = 1 / 40

# Cells looked at in floats together: their matrices then stay in the cache of a processor.
TOGETHER = 128


@dataclass(frozen=True, slots=True)
class BoxProof(Result):
    """What was proved of a box; `stable` is None when neither was.

    `cells` were looked at; `open_share` of the box's volume is left open. `point`, SI values in the order of
    `ranges`, is where it is unstable, or the middle of the largest cell left open. `left_out` says what the
    verdict is without.
    """

    shown_by = "analysis:box_proof"

    topology: str
    ranges: tuple[Range, ...]
    verdict: str
    stable: bool | None
    cells: int
    open_share: float
    point: tuple[float, ...]
    notes: tuple[str, ...]
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What came out for a cell: nothing where it is proved, or else how much each parameter matters in it.

    `unstable` says that it is so, proved, at the cell's middle; `work` is what it took, in cells in balls.
    """

    reach: Floats | None
    unstable: bool = False
    work: float = 1.0


# Looks at cells, one after the other; nobody asks on after one that is unstable.
Look = Callable[[Sequence[Cell]], Iterator[Looked]]


@part("box")
def prove_box(system: CompiledSystem, ranges: Sequence[Range], *, cells: int | None = None) -> BoxProof:
    """Prove a scene stable in a whole box, or find a point of it where it is unstable.

    Parameters
    ----------
    system
        The compiled scene.
    ranges
        The parameters left open, see `box.parse_range`.
    cells
        How many cells of each closed system are looked at at most; without it, as many as take some seconds.

    Raises
    ------
    ApcError
        E831 and E832 as `box.open_box`.
    """
    with single_threaded(), np.errstate(all="ignore"), precision(BITS):
        return _prove_box(system.name, open_box(system, ranges), cells)


def _prove_box(name: str, box: Box, most: int | None) -> BoxProof:
    whole: Cell = tuple((one.low, one.high) for one in box.ranges)
    questions: list[OpenSystem] = []
    notes: list[str] = []
    translations = rotations = 0
    for system, sites in zip(box.systems, box.sites, strict=True):
        free = _rigid_modes(system)
        if free.names:
            standing = what_stands(system, with_drifts=False)
            translations += standing.translations
            rotations += standing.rotations
        if free.drifts or (free.names and not stays_rigid(system, sites)):
            what = "drifts" if free.drifts else "moves freely in a direction that changes with the parameters"
            notes.append(f"{system.name} {what}: nothing can be proved for a whole box")
            continue
        questions.append(open_system(system, sites, free))
    points = [middle(whole), *itertools.product(*whole)]
    for question in questions:
        stable = look(question, [_only(point) for point in points]).proved
        for point, known in zip(points, stable.tolist(), strict=True):
            if not known and _is_unstable(question, point):
                return _answer(name, box, UNSTABLE, False, 1, 1.0, point)
    cells, left, where = 0, 1.0 if notes else 0.0, tuple[Fraction, ...]()
    for question in questions:
        found = _halved(whole, partial(_looked, question), most)
        cells += found.cells
        if found.unstable:
            return _answer(name, box, UNSTABLE, False, cells, 1.0, found.point)
        if found.open_share > left:
            left, where = found.open_share, found.point
    if left:
        return _answer(name, box, UNDECIDED, None, cells, left, where, notes)
    return _answer(name, box, up_to(translations, rotations), True, cells, 0.0, ())


def _rigid_modes(system: ClosedSystem) -> RigidModes:
    """Return the rigid modes of a system; drifts are not looked for where its matrix tells of none."""
    free = rigid_modes_here(system)
    left = relative_bounded(system.matrix, system.error, relative_coordinates(free.basis))
    return free if misses_one(*left) else find_rigid_modes(system)


@dataclass(frozen=True, slots=True)
class _Halved:
    """What a search in the box found: where it is unstable, or is left open."""

    cells: int
    open_share: float
    unstable: bool
    point: tuple[Fraction, ...]


def _answer(
    name: str,
    box: Box,
    verdict: str,
    stable: bool | None,
    cells: int,
    left: float,
    point: Sequence[Fraction],
    notes: Sequence[str] = (),
) -> BoxProof:
    where = tuple(float(value) for value in point)
    return BoxProof(name, box.ranges, verdict, stable, cells, left, where, tuple(notes))


def search_box(
    name: str,
    ranges: Sequence[Range],
    looks: Look,
    is_unstable: Callable[[tuple[Fraction, ...]], bool],
    *,
    stable: str,
    unstable: str,
    cells: int | None = None,
) -> BoxProof:
    """Look at the middle and the corners of a box, then prove it cell by cell.

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
    whole: Cell = tuple((one.low, one.high) for one in ranges)

    def answer(verdict: str, cells: int, left: float, point: Sequence[Fraction]) -> BoxProof:
        known = {stable: True, unstable: False}.get(verdict)
        return BoxProof(name, tuple(ranges), verdict, known, cells, left, tuple(map(float, point)), ())

    for point in (middle(whole), *itertools.product(*whole)):
        if is_unstable(point):
            return answer(unstable, 1, 1.0, point)
    found = _halved(whole, looks, cells)
    if found.unstable:
        return answer(unstable, found.cells, 1.0, found.point)
    if found.open_share:
        return answer(UNDECIDED, found.cells, found.open_share, found.point)
    return answer(stable, found.cells, 0.0, ())


def _halved(whole: Cell, looks: Look, most: int | None) -> _Halved:
    """Prove cells, the larger before the smaller; all as in `search_box`."""
    level, looked, work = [whole], 0, 0.0

    def enough() -> bool:
        return work >= MOST_CELLS if most is None else looked >= most

    while level and not enough():
        halves, done = list[Cell](), 0
        for cell, one in zip(level, looks(level), strict=False):
            looked, done, work = looked + 1, done + 1, work + one.work
            if one.unstable:
                return _Halved(looked, 1.0, True, middle(cell))
            if one.reach is not None:
                widest = int(np.argmax(one.reach))
                low, high = cell[widest]
                for half in ((low, (low + high) / 2), ((low + high) / 2, high)):
                    halves.append((*cell[:widest], half, *cell[widest + 1 :]))
            if enough():
                break
        level = level[done:] + halves
    share = float(sum((_volume(cell) for cell in level), Fraction(0)) / _volume(whole))
    return _Halved(looked, share, False, middle(level[0]) if level else ())


def middle(cell: Cell) -> tuple[Fraction, ...]:
    """Return the middle of a cell."""
    return tuple((low + high) / 2 for low, high in cell)


def _volume(cell: Cell) -> Fraction:
    volume = Fraction(1)
    for low, high in cell:
        volume *= high - low
    return volume


def _only(point: Sequence[Fraction]) -> Cell:
    """Return the cell that is one point."""
    return tuple((value, value) for value in point)


def _looked(question: OpenSystem, cells: Sequence[Cell]) -> Iterator[Looked]:
    """Look at cells in floats, many at a time; in balls where these don't prove even the middle stable."""
    for start in range(0, len(cells), TOGETHER):
        some = cells[start : start + TOGETHER]
        found = look(question, some)
        inside = found.inside.copy()
        left = np.flatnonzero(~inside)
        if len(left):
            inside[left] = look(question, [_only(middle(some[place])) for place in left.tolist()]).proved
        for cell, proved, sound, reach in zip(some, found.proved, inside, found.reach, strict=True):
            if proved or sound:
                yield Looked(None if proved else reach, work=LIGHT)
            elif _is_unstable(question, middle(cell)):
                yield Looked(reach, unstable=True)
            else:
                yield Looked(_reach_out(question, cell))


def _is_unstable(question: OpenSystem, point: Sequence[Fraction]) -> bool:
    """Say whether an eigenvalue is proved outside the circle at a point of the box."""
    exact = [rational_ball(value) for value in point]
    return schur_cohn(square(_matrix(question, exact, None)).charpoly().coeffs()) is False


def _matrix(question: OpenSystem, point: Sequence[Any], by: int | None) -> Balls:
    """Return the matrix in relative coordinates at a point of balls, or its slope by a parameter there."""
    sites = [_site_at(site, point, by) for site in question.loop.sites]
    steps = [
        frame_steps(site, group.schedule, step_duals)
        for site, group in zip(sites, question.loop.system.sites, strict=True)
    ]
    matrix = closed_frame(question.loop.system, sites, steps)
    if by is not None:
        matrix = mapped(slope_of, matrix)
    return reduced_balls(matrix, question.rigid.exact, independent_places(question.rigid.basis.T))


def _site_at(site: LinearSite, point: Sequence[Any], by: int | None) -> LinearSite:
    """Return a site's matrices at a point; `by` a parameter, each entry that depends on it with its slope."""

    def at(entry: Any) -> Any:
        if not isinstance(entry, Ratio):
            return rational_ball(entry)
        value = entry.at(point)
        if by is not None and (slope := entry.slope(by)):
            return Dual(value, slope.at(point))
        return value

    return entrywise(site, at)


def _reach_out(question: OpenSystem, cell: Cell) -> Floats | None:
    """Return None when a cell is proved, or else how much each parameter moves the matrix in it."""
    balls = [_range_ball(low, high) for low, high in cell]
    centre = square(_matrix(question, [rational_ball(value) for value in middle(cell)], None))
    slopes = [square(_matrix(question, balls, by)) for by in range(len(cell))]
    reaches = [rational_ball((high - low) / 2) for low, high in cell]
    n = centre.nrows()
    if n == 0:
        return None
    [change] = change_of_basis(_floats(centre)[None])
    if not np.isfinite(change).all():
        return np.array([float(high - low) for low, high in cell])
    basis = flint.arb_mat(n, n, [flint.arb(value) for value in change.ravel().tolist()])
    inverse = basis.inv()
    moved = basis * centre * inverse
    turned = [basis * slope.mid() * inverse * reach for slope, reach in zip(slopes, reaches, strict=True)]
    loose = flint.arb(0)
    for slope, reach in zip(slopes, reaches, strict=True):
        loose += _frobenius(basis * (slope - slope.mid()) * inverse) * reach
    limit = 1 - loose
    if limit > 0 and all(
        _norm_below(sum((one * sign for one, sign in zip(turned, signs, strict=True)), moved), limit)
        for signs in itertools.product((1, -1), repeat=len(turned))
    ):
        return None
    return np.array([float(_frobenius(one).mid()) for one in turned])


def _range_ball(low: Fraction, high: Fraction) -> Any:
    """Return a ball that holds a range."""
    return flint.arb(rational_ball(low)).union(flint.arb(rational_ball(high)))


def _floats(matrix: Any) -> Floats:
    n = matrix.nrows()
    return np.array([float(entry.mid()) for entry in matrix.entries()], dtype=np.float64).reshape(n, n)


def _frobenius(matrix: Any) -> Any:
    """Return an upper bound on the Frobenius norm of all matrices in the balls."""
    total = flint.arb(0)
    for entry in matrix.entries():
        size = entry.abs_upper()
        total += size * size
    return total.sqrt()


def _norm_below(matrix: Any, limit: Any) -> bool:
    """Say whether the 2-norm of all matrices N in the balls is proved to be below a limit.

    limit²·I − NᵀN is positive definite exactly if it has L D Lᵀ with D > 0.
    """
    n = matrix.nrows()
    product = matrix.transpose() * matrix
    left = [[(limit * limit if i == j else 0) - product[i, j] for j in range(n)] for i in range(n)]
    for k in range(n):
        pivot = left[k][k]
        if not pivot > 0:
            return False
        for i in range(k + 1, n):
            factor = left[i][k] / pivot
            for j in range(k + 1, i + 1):
                left[i][j] -= factor * left[j][k]
    return True
