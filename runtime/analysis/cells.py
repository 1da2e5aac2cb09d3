"""A closed system over many cells of some parameters at once, and which of them a norm proves stable.

Takes: a `ClosedLoop`, its sites over `Fraction` and `Ratio`, its rigid motions; cells.
Gives: `ParametricFrames`, `open_frames`, `frames_over`; `ParametricClosedLoop`, `open_system`,
`matrices_over`; `Cell`; `Contraction`, `contracted`.
Guarantees: a cell that is said to be stable is proved so, at every point of it; rounding is charged.
Does not: divide cells, or decide what floats leave open (see `box_proof`).

Entries of the sites are floats with their slopes over the cell and a radius for all else (`frame.taylor`);
so are the frames composed of them and the loop closed of these, M(p) = M(c) + Σ_k S_k ε_k + E for |ε_k| ≤ 1.
With a P from the equation of Stein and Lyapunov at the middle, P = RᵀR, a norm ‖R M R⁻¹‖ < 1 proves all
eigenvalues inside the circle. A norm is convex: it is largest at a corner of the cell.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import ClosedLoop, InterconnectionMatrices, bounded_weight, close, feedback_of
from apc.eigen.matrix_norms import balance, norms
from apc.eigen.ratios import Ratio
from apc.eigen.relative import Relative, relative, relative_coordinates, with_doubt
from apc.eigen.rigid import RigidModes
from apc.frame.discretize import exponential
from apc.frame.lift import FrameMap, compose, step_durations
from apc.frame.radius import UNIT, Arithmetic, radius_of, value_of
from apc.frame.schedule import Schedule
from apc.frame.site import LinearSubsystem, every_matrix
from apc.frame.taylor import reciprocal, taylor, within

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]
Matrix = NDArray[Any]
Cell = tuple[tuple[Fraction, Fraction], ...]

# Where between the spectral radius (0) and 1 the decay lies that the norm is made for; the nearer to 1, the
# better conditioned the norm, the nearer to 0, the more of it is left for the cell. Measured: flat about 1/2.
DECAY = 0.5

# Doublings of the sum P = Σ Aᵀᵏ Aᵏ: enough for an A that decays by 1e-9 a step.
DOUBLINGS = 40


# A polynomial over the parameters: exponents, and a coefficient with its radius.
Polynomial = Sequence[tuple[tuple[int, ...], tuple[float, float]]]


# A quotient of polynomials: numerator and denominator, none where that is 1.
Quotient = tuple[Polynomial, Polynomial | None]


@dataclass(frozen=True, slots=True, eq=False)
class ParametricFrames:
    """Sites over the open parameters of a box, ready to be lifted over cells.

    `quotients` are their entries that depend on these, by their texts, `texts` those of each by its `id`.
    """

    sites: tuple[LinearSubsystem, ...]
    schedules: tuple[Schedule, ...]
    texts: Mapping[int, str]
    quotients: Mapping[str, Quotient]


@dataclass(frozen=True, slots=True, eq=False)
class ParametricClosedLoop:
    """A closed system over a box: its sites over the open parameters, and who hears whom.

    Its relative coordinates serve all over the box. Eigenvalues are wanted inside a circle, of radius
    `inside`.
    """

    system: ClosedLoop
    frames: ParametricFrames
    feedback: tuple[InterconnectionMatrices, ...]
    relative: Relative
    inside: float


@dataclass(frozen=True, slots=True, eq=False)
class Contraction:
    """What is known of k cells: which are proved, or only their middles, and how much each parameter matters.

    Of points nothing matters: m is 0. Where there is no norm it is NaN.
    """

    proved: Truths  # (k,)
    inside: Truths  # (k,)
    reach: Floats  # (k, m)


def open_system(
    system: ClosedLoop, sites: Sequence[LinearSubsystem], rigid: RigidModes, inside: float = 1.0
) -> ParametricClosedLoop:
    """Make a closed system ready to be looked at over cells.

    Parameters
    ----------
    system
        The system, at some point of the box.
    sites
        Its sites' matrices, over `Fraction` and `Ratio`.
    rigid
        Its rigid motions, which are so all over the box.
    inside
        The radius of the circle that eigenvalues are wanted in.
    """
    return ParametricClosedLoop(
        system,
        open_frames(sites, [group.schedule for group in system.sites]),
        tuple(feedback_of(system, system.layout)),
        with_doubt(relative_coordinates(rigid.basis)),
        inside,
    )


def open_frames(sites: Sequence[LinearSubsystem], schedules: Sequence[Schedule]) -> ParametricFrames:
    """Make sites ready to be lifted over cells.

    Parameters
    ----------
    sites, schedules
        Their matrices, over `Fraction` and `Ratio`, and what happens in their frames.
    """
    ratios: list[Ratio] = []

    def collect(entries: Matrix) -> Matrix:
        ratios.extend(entry for entry in entries.flat if isinstance(entry, Ratio))
        return entries

    for site in {id(site): site for site in sites}.values():
        every_matrix(site, collect)
    texts = {id(ratio): f"{ratio.top}/{ratio.bottom}" for ratio in ratios}
    different = {texts[id(ratio)]: ratio for ratio in ratios}
    quotients = {text: _quotient(ratio) for text, ratio in different.items()}
    return ParametricFrames(tuple(sites), tuple(schedules), texts, quotients)


def contracted(matrix: Matrix) -> Contraction:
    """Say over which cells all eigenvalues of matrices (k, 2 + m, n, n) are inside the circle."""
    k, count, n = len(matrix), matrix.shape[1] - 2, matrix.shape[-1]
    proved, inside = np.full((2, k), not n)
    reach = np.zeros((k, count))
    if not n:
        return Contraction(proved, inside, reach)
    value, off, slopes = value_of(matrix), radius_of(matrix), matrix[:, 2:]
    basis = _change_of_basis(value)
    known = np.isfinite(basis).all(axis=(1, 2)) & np.isfinite(matrix).all(axis=(1, 2, 3))
    reach[~known] = np.nan
    if known.any():
        contraction = _contracted(basis[known], value[known], off[known], slopes[known])
        proved[known], inside[known], reach[known] = contraction.proved, contraction.inside, contraction.reach
    return Contraction(proved, inside, reach)


def _contracted(basis: Floats, value: Floats, off: Floats, slopes: Floats) -> Contraction:
    """Say whether ‖R M R⁻¹‖ < 1 all over each cell, and by how much each parameter moves it.

    Notes
    -----
    With Y about R⁻¹, ‖R M R⁻¹‖ ≤ ‖R M Y‖ / (1 − ‖1 − R Y‖). What the radii, and rounding, leave of R M Y is
    less in norm than |R| E |Y|.
    """
    count, n = slopes.shape[1:3]
    charge = (n + 4) * UNIT
    inverse = np.linalg.inv(basis)
    size, weight = np.abs(basis), np.abs(inverse)
    wrong = norms(np.eye(n) - basis @ inverse) + charge * (norms(size @ weight) + np.sqrt(n))
    moved = basis @ value @ inverse
    turned = basis[:, None] @ slopes @ inverse[:, None]
    spread = np.abs(value) + np.abs(slopes).sum(axis=1)
    loose = norms(size @ (off + 3 * charge * spread) @ weight)
    loose += (count + 1) * UNIT * (norms(moved) + norms(turned).sum(axis=1))
    limit = (1 - wrong - loose) * (1 - 8 * charge) - 8 * charge
    inside = limit > 0
    inside[inside] = _norm_below(moved[inside], limit[inside])
    proved = inside.copy()
    for signs in itertools.product((1.0, -1.0), repeat=count):
        corner = moved + np.tensordot(turned, np.array(signs), (1, 0))
        proved[proved] = _norm_below(corner[proved], limit[proved])
    return Contraction(proved, inside, norms(turned))


def _norm_below(matrix: Floats, limit: Floats) -> Truths:
    """Say whether the 2-norms of matrices N (k, n, n) are proved to be below limits (k,), all below 1.

    Notes
    -----
    limit²·I − NᵀN is positive definite if the decomposition of Cholesky in floats runs through of what is
    less than it by more than that rounds, γ_{n+1} tr / (1 − γ_{n+1}) (Rump, Verification of positive
    definiteness, 2006), and by what N ᵀN rounds.
    """
    n = matrix.shape[-1]
    rounded = (n + 2) * UNIT * (np.square(matrix).sum(axis=(1, 2)) + n) * 2
    left = -(matrix.swapaxes(1, 2) @ matrix)
    np.einsum("kii->ki", left)[:] += (np.square(limit) * (1 - 4 * UNIT) - rounded)[:, None]
    return np.asarray(np.isfinite(_cholesky(left)).all(axis=(1, 2)))


def _cholesky(matrix: Floats) -> Floats:
    """Return the lower triangular L (k, n, n) of matrices L Lᵀ, NaN where there is none."""
    values = np.full(matrix.shape, np.nan)
    for place, value in enumerate(matrix):  # NumPy refuses a whole stack where it refuses one of it
        with contextlib.suppress(np.linalg.LinAlgError):
            values[place] = np.linalg.cholesky(value)
    return values


def _change_of_basis(matrix: Floats) -> Floats:
    """Return R (k, n, n) with ‖R M R⁻¹‖₂ < 1 of matrices (k, n, n), NaN where rounding finds none.

    Notes
    -----
    With the decay γ between the spectral radius and 1, P = Σ_k (Mᵀ/γ)ᵏ (M/γ)ᵏ solves MᵀPM = γ² (P − I), so
    that ‖R M R⁻¹‖ ≤ γ for P = RᵀR.
    """
    n = matrix.shape[-1]
    values = np.full(matrix.shape, np.nan)
    some = np.flatnonzero(np.isfinite(matrix).all(axis=(1, 2)))
    if not len(some):
        return values
    # Cells of one box are alike enough for the units of one.
    scale = balance(np.abs(matrix[some]).max(axis=0) + np.finfo(np.float64).tiny)
    balanced = matrix[some] / scale[:, None] * scale
    radius = np.abs(np.linalg.eigvals(balanced)).max(axis=1)
    some, balanced, radius = (item[radius < 1] for item in (some, balanced, radius))
    if not len(some):
        return values
    power_of = balanced / (radius + DECAY * (1 - radius))[:, None, None]
    total = np.broadcast_to(np.eye(n), balanced.shape)
    for _ in range(DOUBLINGS):
        total = total + power_of.swapaxes(1, 2) @ total @ power_of
        power_of = power_of @ power_of
        if not np.abs(power_of).max() > np.finfo(np.float64).tiny:
            break
    values[some] = _cholesky((total + total.swapaxes(1, 2)) / 2).swapaxes(1, 2) / scale
    return values


def matrices_over(asked: ParametricClosedLoop, cells: Sequence[Cell]) -> Matrix:
    """Return the matrices in relative coordinates over cells (k, 2 + m, n, n), or of points (k, 2, n, n).

    Parameters
    ----------
    asked
        The system; as its circle's radius is to 1, so are the matrices to these.
    cells
        Of all its parameters, k of them; points, where low and high are the same.
    """
    maps = frames_over(asked.frames, cells)
    count = maps[0].p.shape[-3] - 2
    heard = [
        InterconnectionMatrices(within(feedback.now, count), within(feedback.before, count))
        for feedback in asked.feedback
    ]
    closed = close(maps, heard, asked.system.layout, numbers=taylor(count)).matrix
    closed = np.broadcast_to(closed, (len(cells), *closed.shape[-3:]))
    at = replace(asked.relative, weights=within(asked.relative.weights, count))
    values = relative(closed, at, taylor(count))
    if asked.inside == 1:
        return values
    larger = values / asked.inside
    radius_of(larger)[...] = (radius_of(larger) + UNIT * np.abs(larger).sum(axis=1)) * (1 + 8 * UNIT)
    return larger


def frames_over(asked: ParametricFrames, cells: Sequence[Cell]) -> list[FrameMap]:
    """Return each site's frame over cells (k, 2 + m, …), k being 1 of what stays.

    Parameters
    ----------
    asked
        The sites.
    cells
        As for `matrices_over`.
    """
    wide = any(low != high for low, high in cells[0])
    parameters = _parameters(cells, wide=wide)
    count = len(parameters) if wide else 0
    numbers = taylor(count)
    values = {
        text: _value(quotient, parameters, numbers)[..., 0, 0] for text, quotient in asked.quotients.items()
    }

    def over(entries: Matrix) -> Matrix:
        result = np.zeros((len(cells), 2 + count, *entries.shape))
        for (row, column), entry in np.ndenumerate(entries):
            if isinstance(entry, Ratio):
                result[..., row, column] = values[asked.texts[id(entry)]]
            elif entry:
                result[:, :2, row, column] = _bounded(Fraction(entry))
        return result

    known: dict[tuple[int, int], FrameMap] = {}
    maps = []
    for site, schedule in zip(asked.sites, asked.schedules, strict=True):
        key = id(site), id(schedule)
        if key not in known:
            linear_site = every_matrix(site, over)
            steps = {
                number: exponential(linear_site.a, linear_site.b, float(number * schedule.quantum), numbers)
                for number in step_durations(schedule)
            }
            known[key] = compose(linear_site, schedule, steps, numbers=numbers)
        maps.append(known[key])
    return maps


def _parameters(cells: Sequence[Cell], *, wide: bool) -> list[Matrix]:
    """Return the parameters over cells (k, 2 + m, 1, 1) each, m being 0 of points."""
    count = len(cells[0])
    result = []
    for place in range(count):
        number = np.zeros((len(cells), 2 + (count if wide else 0), 1, 1))
        number[:, 0, 0, 0] = [float((cell[place][0] + cell[place][1]) / 2) for cell in cells]
        if wide:
            number[:, 2 + place, 0, 0] = [float((cell[place][1] - cell[place][0]) / 2) for cell in cells]
        radius_of(number)[...] = UNIT * np.abs(number).sum(axis=1) * (1 + 8 * UNIT)
        result.append(number)
    return result


def _bounded(number: Fraction) -> tuple[float, float]:
    """Return a rational as a float with its radius, infinite of one that is too large for a float."""
    try:
        return bounded_weight(number, 0.0)
    except OverflowError:
        return np.inf, np.inf


def _quotient(ratio: Ratio) -> Quotient:
    """Return a quotient as numerator and denominator, none where it is 1."""
    over = _fraction(ratio.bottom.leading_coefficient())
    top, bottom = (
        [
            (tuple(map(int, powers)), _bounded(_fraction(item) / over))
            for powers, item in part.to_dict().items()
        ]
        for part in (ratio.top, ratio.bottom)
    )
    return top, None if ratio.bottom.is_constant() else bottom


def _fraction(number: Any) -> Fraction:
    return Fraction(int(number.p), int(number.q))


def _value(quotient: Quotient, parameters: Sequence[Matrix], numbers: Arithmetic) -> Matrix:
    """Return a quotient over cells (k, 2 + m, 1, 1)."""
    top = _polynomial(quotient[0], parameters, numbers)
    if quotient[1] is None:
        return top
    return numbers.multiply(top, reciprocal(_polynomial(quotient[1], parameters, numbers)))


def _polynomial(terms: Polynomial, parameters: Sequence[Matrix], numbers: Arithmetic) -> Matrix:
    total = numbers.exact(np.zeros((1, 1)))
    for place, (powers, (coefficient, off)) in enumerate(terms):
        term = numbers.exact(np.array([[coefficient]]))
        radius_of(term)[...] = off
        for number, power in zip(parameters, powers, strict=True):
            for _ in range(power):
                term = numbers.multiply(term, number)
        total = numbers.add(total, term) if place else term
    return total
