"""Quadratic Lyapunov functions of matrices that switch arbitrarily.

Takes: matrices (2, n, n): midpoints and radii.
Gives: `has_common_function`, `decreases`, `balanced`.
Guarantees: a positive answer holds for all matrices within the radii, with all rounding included.
Does not: prove that no function exists.

If one P ≻ 0 satisfies P − Mᵀ P M ≻ 0 for every matrix M of a set, every product of the matrices decays.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, error_radius, value_of
from apc.spectrum.eigenpairs import largest_magnitudes
from apc.spectrum.kyp_bounds import is_positive
from apc.spectrum.matrix_norms import balance
from apc.support.optional import need

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # (2, n, n): midpoints and radii


def balanced(matrices: Sequence[Matrix]) -> list[Matrix]:
    """Return matrices (2, n, n) whose rows and columns are balanced together, by powers of two."""
    scale = balance(np.max([np.abs(value_of(matrix)) + error_radius(matrix) for matrix in matrices], axis=0))
    return [matrix / scale[:, None] * scale for matrix in matrices]


def decreases(before: Floats, matrix: Matrix, after: Floats) -> bool:
    """Return whether P − Mᵀ L M ≻ 0 is proved, for P before a step M (2, n, n) and L after it."""
    multiply, exact = MIDPOINT_RADIUS.multiply, MIDPOINT_RADIUS.exact
    moved = multiply(np.swapaxes(matrix, -1, -2), multiply(exact(after), matrix))
    return is_positive(MIDPOINT_RADIUS.subtract(exact(before), moved))


def has_common_function(matrices: Sequence[Matrix]) -> bool:
    """Return whether one xᵀ P x is proved to decrease under each of some matrices (2, n, n).

    P with P − Mᵀ P M ⪰ I is found by a semidefinite program, and then verified.

    Raises
    ------
    ApcError
        E875 cvxpy is not installed.
    """
    if any(value_of(matrix).size and largest_magnitudes(value_of(matrix)) >= 1 for matrix in matrices):
        return False
    cvxpy = need("cvxpy", "sdp")
    n = matrices[0].shape[-1]
    unknown = cvxpy.Variable((n, n), symmetric=True)
    steps = [value_of(matrix) for matrix in matrices]
    constraints = [unknown - step.T @ unknown @ step >> np.eye(n) for step in steps]
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.trace(unknown)), constraints)
    try:
        with warnings.catch_warnings():  # of an inaccurate solution, which is verified below
            warnings.simplefilter("ignore")
            problem.solve(solver=cvxpy.CLARABEL)
    except cvxpy.error.SolverError:
        return False
    if unknown.value is None:
        return False
    function = np.asarray((unknown.value + unknown.value.T) / 2, dtype=np.float64)
    return is_positive(MIDPOINT_RADIUS.exact(function)) and all(
        decreases(function, matrix, function) for matrix in matrices
    )
