"""Rigid motions taken out of a matrix: the map of relative coordinates, in floats, at many points, in balls.

Takes: rigid motions V, and matrices M whose invariant space they span.
Gives: `Relative`, `relative_coordinates`, `with_doubt`; `relative`, `relative_rows`, `relative_bounded`;
`relative_places`, `independent_places`.
Guarantees: the bounds hold for all matrices within their errors, V itself rounded once.
Does not: find the motions (see `rigid`).

With V = [V_p; V_r], p as many places as there are motions, and W = V_r V_p⁻¹, the relative coordinates
x_r − W x_p move by themselves, by M_rr − W M_pr: that map has all other eigenvalues.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.matrix_norms import PRODUCT_ROUNDINGS
from apc.frame.radius import FLOATS, RADII, UNIT, Arithmetic, radius_of, value_of, with_radius
from apc.threads import load_pool

Floats = NDArray[np.float64]
Places = NDArray[np.intp]
Matrix = NDArray[Any]  # float64 or complex128; of balls where it says so


@dataclass(frozen=True, slots=True, eq=False)
class Relative:
    """The coordinates x_r − W x_p: `held` are the places p, `rest` all others, `weights` is W.

    `doubt` bounds what W is off by, entry by entry. Where W follows a parameter, both are those of many
    points (k, …).
    """

    held: Places
    rest: Places
    weights: Matrix  # (len(rest), len(held))
    doubt: Floats


def relative(matrix: Matrix, at: Relative, numbers: Arithmetic = FLOATS) -> Matrix:
    """Return M_rr − W M_pr of matrices (…, n, n) of some kind of number; M itself where nothing is held."""
    if not len(at.held):
        return matrix
    moving = matrix[..., _run(at.rest)]
    held = numbers.multiply(at.weights, moving[..., _run(at.held), :])
    return numbers.subtract(moving[..., _run(at.rest), :], held)


def _run(places: Places) -> Places | slice:
    """Return places as a slice where they follow one another: of these nothing is copied."""
    first, count = int(places[0]) if len(places) else 0, len(places)
    return slice(first, first + count) if (places == np.arange(first, first + count)).all() else places


def relative_rows(matrix: Matrix, at: Relative, numbers: Arithmetic = FLOATS) -> Matrix:
    """Return M_r − W M_p of the rows of matrices (…, n, m) of some kind of number: what moves x_r − W x_p."""
    within = matrix[..., at.rest, :]
    if not len(at.held):
        return within
    return numbers.subtract(within, numbers.multiply(at.weights, matrix[..., at.held, :]))


def with_doubt(at: Relative, numbers: Arithmetic = RADII) -> Relative:
    """Return coordinates whose weights W come with what they may be off by, in some kind of number."""
    return replace(at, weights=numbers.bounded(at.weights, at.doubt))


def relative_bounded(matrix: Matrix, error: Floats, at: Relative) -> tuple[Matrix, Floats]:
    """Return M_rr − W M_pr of matrices (…, n, n) known up to an error, and a bound on what that is off by."""
    if not len(at.held):
        return matrix, error
    values = relative(with_radius(matrix, error), with_doubt(at), RADII)
    return value_of(values), radius_of(values)


def independent_places(rows: NDArray[Any]) -> NDArray[np.intp]:
    """Return the places (m,) of m columns of rows (m, n) of which the others are small combinations."""
    if not len(rows):
        return np.zeros(0, dtype=np.intp)
    scaled = rows / np.maximum(np.abs(rows).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    order = load_pool("scipy.linalg").qr(scaled, mode="r", pivoting=True, check_finite=False)[1]
    return np.asarray(np.sort(order[: len(rows)]), dtype=np.intp)


def relative_places(basis: Floats) -> tuple[Places, Places]:
    """Return the places p whose coordinates rigid motions V (n, d) take away, d of them, and all others r."""
    held = independent_places(basis.T)
    return held, np.delete(np.arange(len(basis)), held)  # np.setdiff1d imports numpy.ma, 10 ms


def relative_coordinates(basis: Floats, places: tuple[Places, Places] | None = None) -> Relative:
    """Return the coordinates relative to rigid motions V (n, d), each entry rounded once.

    Notes
    -----
    The places p and r are those of `relative_places` unless given.
    W − W* = (V_r − W V_p + a rounding of either) V_p*⁻¹ up to sign.
    """
    held, rest = relative_places(basis) if places is None else places
    count = len(held)
    if not count:
        nothing = np.zeros((len(rest), 0))
        return Relative(held, rest, nothing, nothing)
    above, below = basis[held], basis[rest]
    inverse = np.linalg.inv(above)
    weights = below @ inverse
    charge = PRODUCT_ROUNDINGS * (count + 2) * UNIT
    left = np.abs(below - weights @ above) + charge * (np.abs(below) + np.abs(weights) @ np.abs(above))
    size = np.abs(inverse)
    wrong = np.abs(np.eye(count) - inverse @ above) + 2 * charge * (size @ np.abs(above))
    assert float(wrong.sum(axis=1).max()) < 0.5, "rigid motions too alike to tell apart"
    # V_p*⁻¹ = (I − F)⁻¹ Y, and |(I − F)⁻¹| ≤ I + |F| + …, at most doubling the largest.
    size = size + 2 * wrong.sum(axis=1, keepdims=True) * size.max(axis=0, initial=0.0)
    return Relative(held, rest, weights, left @ size)
