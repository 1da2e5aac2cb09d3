"""A closed system over many cells of some parameters, and proofs of stability of the cells by a norm.

Takes: a `ClosedLoop`, its subsystems over `Fraction` and `Ratio`, its rigid modes; cells.
Gives: `ParametricFrames`, `parametric_frames`, `frames_over`; `ParametricClosedLoop`,
`parametric_closed_loop`, `matrices_over`; `Cell`; `Contraction`, `contracted`.
Guarantees: stability of a cell is proved at every point of it; rounding is charged.
Does not: divide cells, or decide cells that floats leave undecided (see `robust_stability`).

Entries of the subsystems are floats with their slopes over the cell and a radius for the remainder
(`frame.taylor_models`); so are the frames composed of them and the closed loop, M(p) = M(c) + Σ_k S_k ε_k + E
for |ε_k| ≤ 1. With a P from the equation of Stein and Lyapunov at the middle, P = RᵀR, a norm ‖R M R⁻¹‖ < 1
proves all eigenvalues inside the circle. A norm is convex: it is largest at a corner of the cell.
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

from apc.eigen.interconnection import (
    ClosedLoop,
    InterconnectionMatrices,
    bounded_weight,
    feedback_of,
    interconnect,
)
from apc.eigen.matrix_norms import balance, norms
from apc.eigen.rational_functions import Ratio
from apc.eigen.relative_coordinates import Relative, relative, relative_coordinates, with_uncertainty
from apc.eigen.rigid_modes import RigidModes
from apc.frame.discretize import exponential
from apc.frame.interval_arithmetic import UNIT_ROUNDOFF, Arithmetic, error_radius, value_of
from apc.frame.lift import FrameMap, compose, step_durations
from apc.frame.linear_subsystem import LinearSubsystem, every_matrix
from apc.frame.schedule import Schedule
from apc.frame.taylor_models import reciprocal, taylor, within

Floats = NDArray[np.float64]
Truths = NDArray[np.bool_]
Matrix = NDArray[Any]
Cell = tuple[tuple[Fraction, Fraction], ...]

# The position between the spectral radius (0) and 1 of the norm's decay: nearer to 1 the norm is better
# conditioned, nearer to 0 more of it is left for the cell. Measured: flat about 1/2.
DECAY = 0.5

# Doublings of the sum P = Σ Aᵀᵏ Aᵏ: enough for an A that decays by 1e-9 per step.
DOUBLINGS = 40


# A polynomial over the parameters: exponents, and a coefficient with its radius.
Polynomial = Sequence[tuple[tuple[int, ...], tuple[float, float]]]


# A quotient of polynomials: numerator and denominator, none where that is 1.
Quotient = tuple[Polynomial, Polynomial | None]


@dataclass(frozen=True, slots=True, eq=False)
class ParametricFrames:
    """Subsystems over the open parameters of a box, ready to be lifted over cells.

    `quotients` are their entries that depend on these, by their texts, `texts` those of each by its `id`.
    """

    subsystems: tuple[LinearSubsystem, ...]
    schedules: tuple[Schedule, ...]
    texts: Mapping[int, str]
    quotients: Mapping[str, Quotient]


@dataclass(frozen=True, slots=True, eq=False)
class ParametricClosedLoop:
    """A closed system over a box: its subsystems over the open parameters, and their coupling.

    Its relative coordinates are valid over the complete box. The required bound on eigenvalues is `inside`.
    """

    system: ClosedLoop
    frames: ParametricFrames
    feedback: tuple[InterconnectionMatrices, ...]
    relative: Relative
    inside: float


@dataclass(frozen=True, slots=True, eq=False)
class Contraction:
    """The results of k cells: which are proved, or only their middles, and the influence of each parameter.

    Points have no parameters: m is 0. Without a norm it is NaN.
    """

    proved: Truths  # (k,)
    inside: Truths  # (k,)
    reach: Floats  # (k, m)


def parametric_closed_loop(
    system: ClosedLoop, subsystems: Sequence[LinearSubsystem], rigid: RigidModes, inside: float = 1.0
) -> ParametricClosedLoop:
    """Return a closed system ready for evaluation over cells.

    Parameters
    ----------
    system
        The system, at some point of the box.
    subsystems
        Its subsystems' matrices, over `Fraction` and `Ratio`.
    rigid
        Its rigid modes, valid over the complete box.
    inside
        The radius of the circle that is to contain the eigenvalues.
    """
    return ParametricClosedLoop(
        system,
        parametric_frames(subsystems, [group.schedule for group in system.subsystems]),
        tuple(feedback_of(system, system.layout)),
        with_uncertainty(relative_coordinates(rigid.basis)),
        inside,
    )


def parametric_frames(
    subsystems: Sequence[LinearSubsystem], schedules: Sequence[Schedule]
) -> ParametricFrames:
    """Return subsystems ready to be lifted over cells.

    Parameters
    ----------
    subsystems, schedules
        Their matrices, over `Fraction` and `Ratio`, and the events of their frames.
    """
    ratios: list[Ratio] = []

    def collect(entries: Matrix) -> Matrix:
        ratios.extend(entry for entry in entries.flat if isinstance(entry, Ratio))
        return entries

    for subsystem in {id(subsystem): subsystem for subsystem in subsystems}.values():
        every_matrix(subsystem, collect)
    texts = {id(ratio): f"{ratio.top}/{ratio.bottom}" for ratio in ratios}
    different = {texts[id(ratio)]: ratio for ratio in ratios}
    quotients = {text: _quotient(ratio) for text, ratio in different.items()}
    return ParametricFrames(tuple(subsystems), tuple(schedules), texts, quotients)


def contracted(matrix: Matrix) -> Contraction:
    """Return the cells over which all eigenvalues of matrices (k, 2 + m, n, n) are inside the circle."""
    k, count, n = len(matrix), matrix.shape[1] - 2, matrix.shape[-1]
    proved, inside = np.full((2, k), not n)
    reach = np.zeros((k, count))
    if not n:
        return Contraction(proved, inside, reach)
    value, error_bound, slopes = value_of(matrix), error_radius(matrix), matrix[:, 2:]
    basis = _change_of_basis(value)
    known = np.isfinite(basis).all(axis=(1, 2)) & np.isfinite(matrix).all(axis=(1, 2, 3))
    reach[~known] = np.nan
    if known.any():
        contraction = _contracted(basis[known], value[known], error_bound[known], slopes[known])
        proved[known], inside[known], reach[known] = contraction.proved, contraction.inside, contraction.reach
    return Contraction(proved, inside, reach)


def _contracted(basis: Floats, value: Floats, error_bound: Floats, slopes: Floats) -> Contraction:
    """Return whether ‖R M R⁻¹‖ < 1 over each complete cell, and its variation by each parameter.

    Notes
    -----
    With Y about R⁻¹, ‖R M R⁻¹‖ ≤ ‖R M Y‖ / (1 − ‖1 − R Y‖). The contribution of radii and rounding to R M Y
    has a norm below |R| E |Y|.
    """
    count, n = slopes.shape[1:3]
    charge = (n + 4) * UNIT_ROUNDOFF
    inverse = np.linalg.inv(basis)
    size, weight = np.abs(basis), np.abs(inverse)
    wrong = norms(np.eye(n) - basis @ inverse) + charge * (norms(size @ weight) + np.sqrt(n))
    moved = basis @ value @ inverse
    turned = basis[:, None] @ slopes @ inverse[:, None]
    spread = np.abs(value) + np.abs(slopes).sum(axis=1)
    loose = norms(size @ (error_bound + 3 * charge * spread) @ weight)
    loose += (count + 1) * UNIT_ROUNDOFF * (norms(moved) + norms(turned).sum(axis=1))
    limit = (1 - wrong - loose) * (1 - 8 * charge) - 8 * charge
    inside = limit > 0
    inside[inside] = _norm_below(moved[inside], limit[inside])
    proved = inside.copy()
    for signs in itertools.product((1.0, -1.0), repeat=count):
        corner = moved + np.tensordot(turned, np.array(signs), (1, 0))
        proved[proved] = _norm_below(corner[proved], limit[proved])
    return Contraction(proved, inside, norms(turned))


def _norm_below(matrix: Floats, limit: Floats) -> Truths:
    """Return whether ‖N_k‖₂ < limit_k is proved for matrices N (k, n, n) and limits (k,), all below 1.

    Notes
    -----
    If a floating-point Cholesky factorization of (limit² − c) I − NᵀN succeeds, limit² I − NᵀN is positive
    definite, provided that c exceeds the rounding of the factorization, γ_{n+1} tr / (1 − γ_{n+1}) (Rump,
    Verification of positive definiteness, 2006), plus that of NᵀN.
    """
    n = matrix.shape[-1]
    rounded = (n + 2) * UNIT_ROUNDOFF * (np.square(matrix).sum(axis=(1, 2)) + n) * 2
    left = -(matrix.swapaxes(1, 2) @ matrix)
    np.einsum("kii->ki", left)[:] += (np.square(limit) * (1 - 4 * UNIT_ROUNDOFF) - rounded)[:, None]
    return np.asarray(np.isfinite(_cholesky(left)).all(axis=(1, 2)))


def _cholesky(matrix: Floats) -> Floats:
    """Return the lower triangular L (k, n, n) of matrices L Lᵀ, NaN where there is none."""
    values = np.full(matrix.shape, np.nan)
    for index, value in enumerate(matrix):  # NumPy raises for the stack where it fails for one matrix
        with contextlib.suppress(np.linalg.LinAlgError):
            values[index] = np.linalg.cholesky(value)
    return values


def _change_of_basis(matrix: Floats) -> Floats:
    """Return R (k, n, n) with ‖R M R⁻¹‖₂ < 1 of matrices (k, n, n), NaN where rounding prevents it.

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
    # Cells of one box are similar enough to share the scaling of one.
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


def matrices_over(question: ParametricClosedLoop, cells: Sequence[Cell]) -> Matrix:
    """Return the matrices in relative coordinates over cells (k, 2 + m, n, n), or of points (k, 2, n, n).

    Parameters
    ----------
    question
        The system; its matrices are divided by the circle's radius.
    cells
        Of all its parameters, k of them; points, where low and high are equal.
    """
    maps = frames_over(question.frames, cells)
    count = maps[0].p.shape[-3] - 2
    received = [
        InterconnectionMatrices(within(feedback.direct, count), within(feedback.delayed, count))
        for feedback in question.feedback
    ]
    closed = interconnect(maps, received, question.system.layout, numbers=taylor(count)).matrix
    closed = np.broadcast_to(closed, (len(cells), *closed.shape[-3:]))
    at = replace(question.relative, weights=within(question.relative.weights, count))
    values = relative(closed, at, taylor(count))
    if question.inside == 1:
        return values
    larger = values / question.inside
    error_radius(larger)[...] = (error_radius(larger) + UNIT_ROUNDOFF * np.abs(larger).sum(axis=1)) * (
        1 + 8 * UNIT_ROUNDOFF
    )
    return larger


def frames_over(question: ParametricFrames, cells: Sequence[Cell]) -> list[FrameMap]:
    """Return each subsystem's frame over cells (k, 2 + m, …), with k = 1 for constant ones.

    Parameters
    ----------
    question
        The subsystems.
    cells
        As for `matrices_over`.
    """
    wide = any(low != high for low, high in cells[0])
    parameters = _parameters(cells, wide=wide)
    count = len(parameters) if wide else 0
    numbers = taylor(count)
    values = {
        text: _value(quotient, parameters, numbers)[..., 0, 0]
        for text, quotient in question.quotients.items()
    }

    def over(entries: Matrix) -> Matrix:
        result = np.zeros((len(cells), 2 + count, *entries.shape))
        for (row, column), entry in np.ndenumerate(entries):
            if isinstance(entry, Ratio):
                result[..., row, column] = values[question.texts[id(entry)]]
            elif entry:
                result[:, :2, row, column] = _bounded(Fraction(entry))
        return result

    known: dict[tuple[int, int], FrameMap] = {}
    maps = []
    for subsystem, schedule in zip(question.subsystems, question.schedules, strict=True):
        key = id(subsystem), id(schedule)
        if key not in known:
            linear_subsystem = every_matrix(subsystem, over)
            steps = {
                number: exponential(
                    linear_subsystem.a, linear_subsystem.b, float(number * schedule.quantum), numbers
                )
                for number in step_durations(schedule)
            }
            known[key] = compose(linear_subsystem, schedule, steps, numbers=numbers)
        maps.append(known[key])
    return maps


def _parameters(cells: Sequence[Cell], *, wide: bool) -> list[Matrix]:
    """Return each parameter over cells (k, 2 + m, 1, 1), with m = 0 for points."""
    count = len(cells[0])
    result = []
    for index in range(count):
        number = np.zeros((len(cells), 2 + (count if wide else 0), 1, 1))
        number[:, 0, 0, 0] = [float((cell[index][0] + cell[index][1]) / 2) for cell in cells]
        if wide:
            number[:, 2 + index, 0, 0] = [float((cell[index][1] - cell[index][0]) / 2) for cell in cells]
        error_radius(number)[...] = UNIT_ROUNDOFF * np.abs(number).sum(axis=1) * (1 + 8 * UNIT_ROUNDOFF)
        result.append(number)
    return result


def _bounded(number: Fraction) -> tuple[float, float]:
    """Return a rational as a float with its radius, infinite if it overflows."""
    try:
        return bounded_weight(number, 0.0)
    except OverflowError:
        return np.inf, np.inf


def _quotient(ratio: Ratio) -> Quotient:
    """Return a quotient as numerator and denominator, None where it is 1."""
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
    for index, (powers, (coefficient, error_bound)) in enumerate(terms):
        term = numbers.exact(np.array([[coefficient]]))
        error_radius(term)[...] = error_bound
        for number, power in zip(parameters, powers, strict=True):
            for _ in range(power):
                term = numbers.multiply(term, number)
        total = numbers.add(total, term) if index else term
    return total
