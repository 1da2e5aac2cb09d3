"""Proof that a scene is stable for every value of some parameters in a box.

Takes: a `CompiledSystem` and ranges.
Gives: `BoxProof`, `prove_box`; `Cell`, `search_box`, `middle`, `site_at`, `range_ball`, `ball_radii`;
`BITS`, `UNDECIDED`.
Guarantees: stable means proved for every point of the box, unstable proved at the point that is named.
Does not: find the boundary (see the share that is left open).

About the middle c of a cell of the box, M(p) = M(c) + Σ_k S_k (p_k − c_k), each S_k a slope somewhere in the
cell: balls hold all of them. With a P from the equation of Stein and Lyapunov at the middle, P = RᵀR, a norm
‖R M R⁻¹‖ < 1 proves all eigenvalues inside the circle. A norm is convex: it is largest at a corner of the
cell. A cell where that fails is halved.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import partial
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.analysis.box import Box, open_box
from apc.compiler.compiled import CompiledSystem
from apc.compiler.frozen import dataclass
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
from apc.eigen.pseudospectrum import balance
from apc.eigen.ratios import Ratio
from apc.eigen.relative import independent_places
from apc.eigen.rigid import RigidModes, find_rigid_modes, stays_rigid, what_stands
from apc.eigen.spectrum import STABLE, STABLE_TRANSLATING, UNSTABLE
from apc.frame.discretize import UNIT
from apc.frame.names import Range
from apc.frame.site import LinearSite, entrywise
from apc.result import Result
from apc.threads import single_threaded

Floats = NDArray[np.float64]
Cell = tuple[tuple[Fraction, Fraction], ...]

UNDECIDED = "undecided"

# Bits of the proof: those that 1,000 ticks lose, and twice those of a float.
BITS = 256

# Cells tried for each closed system, at some ten milliseconds each.
MOST_CELLS = 500

# Where between the spectral radius (0) and 1 the decay lies that the norm is made for; the nearer to 1, the
# better conditioned the norm, the nearer to 0, the more of it is left for the cell. Measured: flat about 1/2.
DECAY = 0.5

# Doublings of the sum P = Σ Aᵀᵏ Aᵏ: enough for an A that decays by 1e-9 a step.
DOUBLINGS = 40


@dataclass(frozen=True, slots=True)
class BoxProof(Result):
    """What was proved of a box; `stable` is None when neither was.

    `cells` were looked at; `open_share` of the box's volume is left open. `point`, SI values in the order of
    `ranges`, is where it is unstable, or the middle of the largest cell left open.
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


@dataclass(frozen=True, slots=True, eq=False)
class _Question:
    """One closed system over the box: its sites over the open parameters, its rigid motions and where."""

    system: ClosedSystem
    sites: tuple[LinearSite, ...]
    vectors: tuple[tuple[Fraction, ...], ...]
    held: NDArray[np.intp]


@part("box")
def prove_box(system: CompiledSystem, ranges: Sequence[Range]) -> BoxProof:
    """Prove a scene stable in a whole box, or find a point of it where it is unstable.

    Parameters
    ----------
    system
        The compiled scene.
    ranges
        The parameters left open, see `box.parse_range`.

    Raises
    ------
    ApcError
        E831 and E832 as `box.open_box`.
    """
    with single_threaded(), np.errstate(all="ignore"), precision(BITS):
        return _prove_box(system.name, open_box(system, ranges))


def _prove_box(name: str, box: Box) -> BoxProof:
    whole: Cell = tuple((one.low, one.high) for one in box.ranges)
    questions: list[_Question] = []
    notes: list[str] = []
    translations = 0
    for system, sites in zip(box.systems, box.sites, strict=True):
        free = find_rigid_modes(system)
        translations += what_stands(system, with_drifts=False).translations
        if free.drifts or not stays_rigid(system, sites):
            what = "drifts" if free.drifts else "moves freely in a direction that changes with the parameters"
            notes.append(f"{system.name} {what}: nothing can be proved for a whole box")
            continue
        questions.append(_question(system, sites, free))
    corners = [middle(whole), *itertools.product(*whole)]
    for question, point in itertools.product(questions, corners):
        if _is_unstable(question, point):
            return _answer(name, box, UNSTABLE, False, 1, 1.0, point)
    cells, left, where = 0, 1.0 if notes else 0.0, tuple[Fraction, ...]()
    for question in questions:
        found = _halved(whole, partial(_reach_out, question), partial(_is_unstable, question))
        cells += found.cells
        if found.unstable:
            return _answer(name, box, UNSTABLE, False, cells, 1.0, found.point)
        if found.open_share > left:
            left, where = found.open_share, found.point
    if left:
        return _answer(name, box, UNDECIDED, None, cells, left, where, notes)
    return _answer(name, box, STABLE_TRANSLATING if translations else STABLE, True, cells, 0.0, ())


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


def _question(system: ClosedSystem, sites: tuple[LinearSite, ...], free: RigidModes) -> _Question:
    return _Question(system, sites, free.exact, independent_places(free.basis.T))


def search_box(
    name: str,
    ranges: Sequence[Range],
    reach_out: Callable[[Cell], Floats | None],
    is_unstable: Callable[[tuple[Fraction, ...]], bool],
    *,
    stable: str,
    unstable: str,
) -> BoxProof:
    """Look at the middle and the corners of a box, then prove it cell by cell.

    Parameters
    ----------
    name, ranges
        The scene's, and the parameters left open.
    reach_out
        Returns None when a cell is proved, or else how much each parameter matters in it.
    is_unstable
        Whether it is proved unstable at a point.
    stable, unstable
        The verdicts.
    """
    whole: Cell = tuple((one.low, one.high) for one in ranges)

    def answer(verdict: str, cells: int, left: float, point: Sequence[Fraction]) -> BoxProof:
        known = {stable: True, unstable: False}.get(verdict)
        return BoxProof(name, tuple(ranges), verdict, known, cells, left, tuple(map(float, point)), ())

    for point in (middle(whole), *itertools.product(*whole)):
        if is_unstable(point):
            return answer(unstable, 1, 1.0, point)
    found = _halved(whole, reach_out, is_unstable)
    if found.unstable:
        return answer(unstable, found.cells, 1.0, found.point)
    if found.open_share:
        return answer(UNDECIDED, found.cells, found.open_share, found.point)
    return answer(stable, found.cells, 0.0, ())


def _halved(
    whole: Cell,
    reach_out: Callable[[Cell], Floats | None],
    is_unstable: Callable[[tuple[Fraction, ...]], bool],
) -> _Halved:
    """Prove cell after cell, the largest first; all as in `search_box`."""
    waiting = deque([whole])
    looked = 0
    while waiting and looked < MOST_CELLS:
        cell = waiting.popleft()
        looked += 1
        reach = reach_out(cell)
        if reach is None:
            continue
        inner = middle(cell)
        if is_unstable(inner):
            return _Halved(looked, 1.0, True, inner)
        widest = int(np.argmax(reach))
        low, high = cell[widest]
        for half in ((low, inner[widest]), (inner[widest], high)):
            waiting.append((*cell[:widest], half, *cell[widest + 1 :]))
    share = float(sum((_volume(cell) for cell in waiting), Fraction(0)) / _volume(whole))
    return _Halved(looked, share, False, middle(waiting[0]) if waiting else ())


def middle(cell: Cell) -> tuple[Fraction, ...]:
    """Return the middle of a cell."""
    return tuple((low + high) / 2 for low, high in cell)


def _volume(cell: Cell) -> Fraction:
    volume = Fraction(1)
    for low, high in cell:
        volume *= high - low
    return volume


def _is_unstable(question: _Question, point: Sequence[Fraction]) -> bool:
    """Say whether an eigenvalue is proved outside the circle at a point of the box."""
    exact = [rational_ball(value) for value in point]
    return schur_cohn(square(_matrix(question, exact, None)).charpoly().coeffs()) is False


def _matrix(question: _Question, point: Sequence[Any], by: int | None) -> Balls:
    """Return the matrix in relative coordinates at a point of balls, or its slope by a parameter there."""
    sites = [site_at(site, point, by) for site in question.sites]
    steps = [
        frame_steps(site, group.schedule, step_duals)
        for site, group in zip(sites, question.system.sites, strict=True)
    ]
    matrix = closed_frame(question.system, sites, steps)
    if by is not None:
        matrix = mapped(slope_of, matrix)
    return reduced_balls(matrix, question.vectors, question.held)


def site_at(site: LinearSite, point: Sequence[Any], by: int | None) -> LinearSite:
    """Return a site's matrices at a point; `by` a parameter, each entry that depends on it with its slope."""

    def at(entry: Any) -> Any:
        if not isinstance(entry, Ratio):
            return rational_ball(entry)
        value = entry.at(point)
        if by is not None and (slope := entry.slope(by)):
            return Dual(value, slope.at(point))
        return value

    return entrywise(site, at)


def _reach_out(question: _Question, cell: Cell) -> Floats | None:
    """Return None when a cell is proved, or else how much each parameter moves the matrix in it."""
    balls = [range_ball(low, high) for low, high in cell]
    centre = square(_matrix(question, [rational_ball(value) for value in middle(cell)], None))
    slopes = [square(_matrix(question, balls, by)) for by in range(len(cell))]
    reaches = [rational_ball((high - low) / 2) for low, high in cell]
    n = centre.nrows()
    if n == 0:
        return None
    change = _change_of_basis(_floats(centre))
    if change is None:
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


def range_ball(low: Fraction, high: Fraction) -> Any:
    """Return a ball that holds a range."""
    return flint.arb(rational_ball(low)).union(flint.arb(rational_ball(high)))


def ball_radii(balls: Balls) -> Floats:
    """Return balls (n, m) as floats with their radii (2, n, m)."""
    found = np.zeros((2, *balls.shape))
    for place, ball in np.ndenumerate(balls):
        if isinstance(ball, int):
            found[(0, *place)] = ball
            continue
        value = float(ball.mid())
        found[(0, *place)] = value
        found[(1, *place)] = float((ball - value).abs_upper()) * (1 + 4 * UNIT)
    return found


def _floats(matrix: Any) -> Floats:
    n = matrix.nrows()
    return np.array([float(entry.mid()) for entry in matrix.entries()], dtype=np.float64).reshape(n, n)


def _change_of_basis(matrix: Floats) -> Floats | None:
    """Return R with ‖R M R⁻¹‖₂ < 1, or None where rounding finds none.

    With the decay γ between the spectral radius and 1, P = Σ_k (Mᵀ/γ)ᵏ (M/γ)ᵏ solves MᵀPM = γ² (P − I), so
    that ‖R M R⁻¹‖ ≤ γ for P = RᵀR.
    """
    n = len(matrix)
    scale = balance(np.abs(matrix) + np.finfo(np.float64).tiny)
    balanced = matrix / scale[:, None] * scale
    if not np.isfinite(balanced).all():
        return None
    radius = float(np.abs(np.linalg.eigvals(balanced)).max())
    if not radius < 1:
        return None
    power = balanced / (radius + DECAY * (1 - radius))
    total = np.eye(n)
    for _ in range(DOUBLINGS):
        total = total + power.T @ total @ power
        power = power @ power
        if not np.abs(power).max() > np.finfo(np.float64).tiny:
            break
    try:
        root = np.linalg.cholesky((total + total.T) / 2).T
    except np.linalg.LinAlgError:
        return None
    return np.asarray(root / scale)


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
