"""A closed system over many cells of some parameters, and proofs of stability of the cells by a norm.

Takes: a `ClosedLoop`, its subsystems over `Fraction` and `Ratio`, its rigid modes; cells.
Gives: `ParametricFrames`, `parametric_frames`, `frames_over`; `ParametricClosedLoop`,
`parametric_closed_loop`, `matrices_over`; `Cell`; `Contraction`, `contracted`.
Guarantees: stability of a cell is proved at every point of it; rounding is charged.
Does not: divide cells, or decide cells that floats leave undecided (see `robust_stability`).

Entries of the subsystems are floats with their slopes over the cell and a radius for the remainder
(`lifting.taylor_models`); so are the frames composed of them and the closed loop, M(p) = M(c) + Σ_k S_k ε_k +
E for |ε_k| ≤ 1. With a P from the equation of Stein and Lyapunov at the middle, P = RᵀR, a norm ‖R M R⁻¹‖ < 1
proves all eigenvalues inside the circle. A norm is convex: it is largest at a corner of the cell.
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.extensions.parameter_boxes.rational_functions import Ratio
from apc.lifting.discretize import exponential
from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF, Arithmetic, error_radius, value_of
from apc.lifting.lift import FrameMap, compose, step_durations
from apc.lifting.taylor_models import reciprocal, taylor, within
from apc.linearization.linear_subsystem import LinearSubsystem, every_matrix
from apc.spectrum.eigenpairs import largest_magnitudes
from apc.spectrum.interconnection import (
    ClosedLoop,
    InterconnectionMatrices,
    bounded_weight,
    feedback_of,
    interconnect,
)
from apc.spectrum.matrix_norms import balance, norms
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.relative_coordinates import Relative, relative, relative_coordinates, with_uncertainty
from apc.spectrum.rigid_modes import RigidModes

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
    """Subsystems with symbolic parameters, ready to be lifted over cells of a box.

    `subsystems` are the matrices of each class by its index, with texts as symbolic entries; `quotients` are
    these entries by their texts. `classes` are the classes in the order of the system.
    """

    classes: tuple[PeerClass, ...]
    subsystems: Mapping[int, LinearSubsystem]
    quotients: Mapping[str, Quotient]


@dataclass(frozen=True, slots=True, eq=False)
class ParametricClosedLoop:
    """A closed system over a box: its subsystems with symbolic parameters, and their coupling.

    `closed_loop` is the closed system at a point of the box, `frames` its subsystems over the box, and
    `feedback` the interconnection of each. `relative` are relative coordinates that are valid over the
    complete box. `inside` is the required bound on the magnitude of eigenvalues.
    """

    closed_loop: ClosedLoop
    frames: ParametricFrames
    feedback: tuple[InterconnectionMatrices, ...]
    relative: Relative
    inside: float


@dataclass(frozen=True, slots=True, eq=False)
class Contraction:
    """The results of k cells: whether each is proved stable.

    `inside` states whether its middle is proved stable, `reach` is the influence of each parameter (NaN
    without a norm). For points, m is 0.
    """

    proved: Truths  # (k,)
    inside: Truths  # (k,)
    reach: Floats  # (k, m)


def parametric_closed_loop(
    closed_loop: ClosedLoop, subsystems: Sequence[LinearSubsystem], rigid: RigidModes, radius: float = 1.0
) -> ParametricClosedLoop:
    """Return a closed loop whose matrices can be evaluated over cells of a box of parameter ranges.

    Parameters
    ----------
    closed_loop
        The system, at some point of the box.
    subsystems
        The matrices of its subsystems, with entries `Fraction`, or `Ratio` (a rational function of the
        parameters).
    rigid
        Its rigid modes, valid over the complete box.
    radius
        The radius of the circle that must contain the eigenvalues.
    """
    return ParametricClosedLoop(
        closed_loop,
        parametric_frames(tuple(subsystems), closed_loop.peer_classes),
        tuple(feedback_of(closed_loop, closed_loop.layout)),
        with_uncertainty(relative_coordinates(rigid.basis)),
        radius,
    )


@lru_cache(maxsize=2)
def parametric_frames(
    subsystems: tuple[LinearSubsystem, ...], classes: tuple[PeerClass, ...]
) -> ParametricFrames:
    """Return subsystems with symbolic parameters, ready to be lifted over cells.

    Closed systems of the same subsystems share the result, and its frames over the last cells.

    Parameters
    ----------
    subsystems, classes
        Their matrices, over `Fraction` and `Ratio`, and their classes at a point of the box.
    """
    quotients: dict[str, Quotient] = {}

    def with_texts(entries: Matrix) -> Matrix:
        """Return a matrix with its symbolic entries replaced by their texts, and keep these entries."""
        result = entries.copy()
        for position, entry in np.ndenumerate(entries):
            if isinstance(entry, Ratio):
                result[position] = text = f"{entry.top}/{entry.bottom}"
                if text not in quotients:
                    quotients[text] = _quotient(entry)
        return result

    first_of_class = {peers.index: subsystem for peers, subsystem in zip(classes, subsystems, strict=True)}
    symbolic = {index: every_matrix(subsystem, with_texts) for index, subsystem in first_of_class.items()}
    return ParametricFrames(tuple(classes), symbolic, quotients)


def contracted(matrix: Matrix) -> Contraction:
    """Return the results of cells: whether all eigenvalues of their matrices (k, 2 + m, n, n) are inside the
    circle.
    """
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
        contraction = _contraction_in_basis(basis[known], value[known], error_bound[known], slopes[known])
        proved[known], inside[known], reach[known] = contraction.proved, contraction.inside, contraction.reach
    return Contraction(proved, inside, reach)


def _contraction_in_basis(basis: Floats, value: Floats, error_bound: Floats, slopes: Floats) -> Contraction:
    """Return whether ‖R M R⁻¹‖ < 1 over each complete cell, and the influence of each parameter on this norm.

    Parameters
    ----------
    basis
        R (k, n, n) for each cell.
    value, error_bound, slopes
        M at the centre (k, n, n), a bound on its error, and its changes to the upper side of each parameter
        (k, m, n, n).
    """
    count, n = slopes.shape[1:3]
    rounding = (n + 4) * UNIT_ROUNDOFF
    inverse = np.linalg.inv(basis)
    abs_basis, abs_inverse = np.abs(basis), np.abs(inverse)
    inverse_error = norms(np.eye(n) - basis @ inverse) + rounding * (
        norms(abs_basis @ abs_inverse) + np.sqrt(n)
    )
    transformed = basis @ value @ inverse
    transformed_slopes = basis[:, None] @ slopes @ inverse[:, None]
    magnitude = np.abs(value) + np.abs(slopes).sum(axis=1)
    radius_norm = norms(abs_basis @ (error_bound + 3 * rounding * magnitude) @ abs_inverse)
    radius_norm += (count + 1) * UNIT_ROUNDOFF * (norms(transformed) + norms(transformed_slopes).sum(axis=1))
    limit = (1 - inverse_error - radius_norm) * (1 - 8 * rounding) - 8 * rounding
    inside = limit > 0
    inside[inside] = _norm_below(transformed[inside], limit[inside])
    proved = inside.copy()
    for signs in itertools.product((1.0, -1.0), repeat=count):
        corner = transformed + np.tensordot(transformed_slopes, np.array(signs), (1, 0))
        proved[proved] = _norm_below(corner[proved], limit[proved])
    return Contraction(proved, inside, norms(transformed_slopes))


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
    difference = -(matrix.swapaxes(1, 2) @ matrix)
    np.einsum("kii->ki", difference)[:] += (np.square(limit) * (1 - 4 * UNIT_ROUNDOFF) - rounded)[:, None]
    return np.asarray(np.isfinite(_cholesky(difference)).all(axis=(1, 2)))


def _cholesky(matrix: Floats) -> Floats:
    """Return the lower triangular L (k, n, n) with L Lᵀ equal to each matrix, NaN for a matrix without a
    factorization.
    """
    values = np.full(matrix.shape, np.nan)
    for index, value in enumerate(matrix):  # NumPy raises for the stack where it fails for one matrix
        with contextlib.suppress(np.linalg.LinAlgError):
            values[index] = np.linalg.cholesky(value)
    return values


def _change_of_basis(matrix: Floats) -> Floats:
    """Return a basis R (k, n, n) with ‖R M R⁻¹‖₂ < 1 for each matrix M, NaN where none is found."""
    n = matrix.shape[-1]
    values = np.full(matrix.shape, np.nan)
    indices = np.flatnonzero(np.isfinite(matrix).all(axis=(1, 2)))
    if not len(indices):
        return values
    # Cells of one box are similar enough to share one scaling.
    scale = balance(np.abs(matrix[indices]).max(axis=0) + np.finfo(np.float64).tiny)
    balanced = matrix[indices] / scale[:, None] * scale
    radius = largest_magnitudes(balanced)
    stable = radius < 1
    indices, balanced, radius = indices[stable], balanced[stable], radius[stable]
    if not len(indices):
        return values
    scaled_power = balanced / (radius + DECAY * (1 - radius))[:, None, None]
    total = np.broadcast_to(np.eye(n), balanced.shape)
    for _ in range(DOUBLINGS):
        total = total + scaled_power.swapaxes(1, 2) @ total @ scaled_power
        scaled_power = scaled_power @ scaled_power
        if not np.abs(scaled_power).max() > np.finfo(np.float64).tiny:
            break
    values[indices] = _cholesky((total + total.swapaxes(1, 2)) / 2).swapaxes(1, 2) / scale
    return values


def matrices_over(problem: ParametricClosedLoop, cells: Sequence[Cell]) -> Matrix:
    """Return a system's matrices in relative coordinates over cells (k, 2 + m, n, n), or at points (k,
    2, n, n).

    Parameters
    ----------
    problem
        The closed system; its matrices are divided by the circle's radius.
    cells
        The k cells over all parameters; points have equal lower and upper ends.
    """
    maps = frames_over(problem.frames, tuple(cells))
    count = maps[0].p.shape[-3] - 2
    received = [
        InterconnectionMatrices(within(feedback.direct, count), within(feedback.delayed, count))
        for feedback in problem.feedback
    ]
    closed = interconnect(maps, received, problem.closed_loop.layout, numbers=taylor(count)).matrix
    closed = np.broadcast_to(closed, (len(cells), *closed.shape[-3:]))
    coordinates = replace(problem.relative, weights=within(problem.relative.weights, count))
    values = relative(closed, coordinates, taylor(count))
    if problem.inside == 1:
        return values
    scaled = values / problem.inside
    error_radius(scaled)[...] = (error_radius(scaled) + UNIT_ROUNDOFF * np.abs(scaled).sum(axis=1)) * (
        1 + 8 * UNIT_ROUNDOFF
    )
    return scaled


@lru_cache(maxsize=2)  # the cells, and their middles
def frames_over(problem: ParametricFrames, cells: tuple[Cell, ...]) -> list[FrameMap]:
    """Return the frame map of each subsystem over cells (k, 2 + m, …), with k = 1 for constant subsystems.

    Parameters
    ----------
    problem
        The subsystems with symbolic parameters.
    cells
        As for `matrices_over`.
    """
    wide = any(low != high for low, high in cells[0])
    parameters = _parameters(cells, wide=wide)
    count = len(parameters) if wide else 0
    arithmetic = taylor(count)
    values = {
        text: _value(quotient, parameters, arithmetic)[..., 0, 0]
        for text, quotient in problem.quotients.items()
    }

    def evaluate(entries: Matrix) -> Matrix:
        """Return a matrix over the cells, (k, 2 + m, rows, columns), from exact and symbolic entries."""
        result = np.zeros((len(cells), 2 + count, *entries.shape))
        for (row, column), entry in np.ndenumerate(entries):
            if isinstance(entry, str):
                result[..., row, column] = values[entry]
            elif entry:
                result[:, :2, row, column] = _bounded(Fraction(entry))
        return result

    maps: dict[int, FrameMap] = {}
    for peers in problem.classes:
        if peers.index not in maps:
            schedule = peers.schedule
            linear_subsystem = every_matrix(problem.subsystems[peers.index], evaluate)
            steps = {
                number: exponential(
                    linear_subsystem.a, linear_subsystem.b, float(number * schedule.quantum), arithmetic
                )
                for number in step_durations(schedule)
            }
            maps[peers.index] = compose(linear_subsystem, schedule, steps, numbers=arithmetic)
    return [maps[peers.index] for peers in problem.classes]


def _parameters(cells: Sequence[Cell], *, wide: bool) -> list[Matrix]:
    """Return the Taylor model of each parameter over the cells (k, 2 + m, 1, 1), with m = 0 for points."""
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
    """Return numerator and denominator of a symbolic entry as polynomials with float coefficients and radii.

    Both are divided by the leading coefficient of the denominator; a constant denominator is None.
    """
    leading = _fraction(ratio.bottom.leading_coefficient())
    top, bottom = (
        [
            (tuple(map(int, powers)), _bounded(_fraction(coefficient) / leading))
            for powers, coefficient in polynomial.to_dict().items()
        ]
        for polynomial in (ratio.top, ratio.bottom)
    )
    return top, None if ratio.bottom.is_constant() else bottom


def _fraction(number: Any) -> Fraction:
    """Return a rational of FLINT as a `Fraction`."""
    return Fraction(int(number.p), int(number.q))


def _value(quotient: Quotient, parameters: Sequence[Matrix], arithmetic: Arithmetic) -> Matrix:
    """Return a quotient of polynomials over the cells (k, 2 + m, 1, 1)."""
    numerator = _polynomial(quotient[0], parameters, arithmetic)
    if quotient[1] is None:
        return numerator
    return arithmetic.multiply(numerator, reciprocal(_polynomial(quotient[1], parameters, arithmetic)))


def _polynomial(terms: Polynomial, parameters: Sequence[Matrix], arithmetic: Arithmetic) -> Matrix:
    """Return a polynomial over the cells (k, 2 + m, 1, 1)."""
    total = arithmetic.exact(np.zeros((1, 1)))
    for index, (powers, (coefficient, error_bound)) in enumerate(terms):
        term = arithmetic.exact(np.array([[coefficient]]))
        error_radius(term)[...] = error_bound
        for number, power in zip(parameters, powers, strict=True):
            for _ in range(power):
                term = arithmetic.multiply(term, number)
        total = arithmetic.add(total, term) if index else term
    return total
