"""How far rounding may be off at many points that are near each other, worked out once for all of them.

Takes: matrices at many points, in order of the groups they are in.
Gives: `NEARBY`; `nearby`, `alike`; `composed_nearby`.
Guarantees: what the same sums and products in floats give at any point of a group is off by no more than the
radius of what they give here, whatever the order in which a sum is added up.
Does not: give the numbers at a point (the floats do); charge what underflows, less than 1e-307 a product.

A matrix of a group has a third axis from the end, (…, 3, n, m): a value v, a radius r and a range w. At each
point of the group the floats F are within w of v, and within r of what they stand for. Then

    |fl(F G) − …| ≤ γ |F| |G| + |F| r_G + r_F (|G| + r_G),    |F| ≤ |v| + w

as of one point (see `radius`), so that the bound is wider than that of each point by what |v| + w is more
than |F|, and costs nothing a point.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import COEFFICIENT_ROUNDINGS, UNIT, Step
from apc.frame.lift import FrameMap, compose
from apc.frame.radius import Arithmetic, common_shape, radius_of, value_of
from apc.frame.schedule import Schedule
from apc.frame.site import LinearSite, every_matrix

Matrix = NDArray[Any]
Places = NDArray[np.intp]


def nearby(matrix: Matrix, off: Matrix | float, starts: Places) -> Matrix:
    """Return matrices at many points (k, n, m) as those of groups (g, 3, n, m).

    Parameters
    ----------
    matrix
        The matrices; of one point (1, n, m), what all points have in common.
    off
        What each entry may be off by (k, n, m), or as a share of its magnitude.
    starts
        Where each group starts (g,).
    """

    def together(find: Any, one: Matrix) -> Matrix:
        return one if len(one) == 1 else np.asarray(find.reduceat(one, starts, axis=0))

    low, high = together(np.minimum, matrix), together(np.maximum, matrix)
    found = np.empty((len(low), 3, *matrix.shape[1:]))
    middle = np.divide(low + high, 2, out=value_of(found))
    found[:, 2] = np.maximum(high - middle, middle - low) * (1 + 2 * UNIT)
    size = np.maximum(np.abs(low), np.abs(high))
    radius_of(found)[...] = off * size if isinstance(off, float) else together(np.maximum, off)
    return found


def alike(matrix: Matrix) -> Matrix:
    """Return matrices with their radii (…, 2, n, m) that are the same at all points."""
    return np.concatenate([matrix, np.zeros_like(matrix[..., :1, :, :])], axis=-3)


def _range_of(matrix: Matrix) -> Matrix:
    return matrix[..., 2, :, :]


def _multiply(left: Matrix, right: Matrix) -> Matrix:
    a, b, off_a, off_b = value_of(left), value_of(right), radius_of(left), radius_of(right)
    charge = (a.shape[-1] + 2) * UNIT
    many = common_shape(a.shape[:-2], b.shape[:-2])
    found = np.empty((*many, 3, a.shape[-2], b.shape[-1]))
    np.matmul(a, b, out=value_of(found))
    own_a, own_b = np.abs(a), np.abs(b)
    size_a, size_b = own_a + _range_of(left), own_b + _range_of(right)
    rounded = charge * (size_a @ size_b)
    off = np.add(size_a @ off_b, rounded, out=radius_of(found))
    off += off_a @ (size_b + off_b)
    apart = np.add(own_a @ _range_of(right), 2 * rounded, out=_range_of(found))
    apart += _range_of(left) @ size_b
    found[..., 1:, :, :] *= 1 + 8 * charge
    return found


def _sum(found: Matrix, left: Matrix, right: Matrix) -> Matrix:
    """Return a sum or difference, of which there are the values."""
    found[..., 1:, :, :] = left[..., 1:, :, :] + right[..., 1:, :, :]
    rounded = UNIT * (np.abs(value_of(found)) + _range_of(found))
    radius_of(found)[...] += rounded
    _range_of(found)[...] += 2 * rounded
    found[..., 1:, :, :] *= 1 + 8 * UNIT
    return found


def _exact(value: Matrix) -> Matrix:
    """Return exact matrices, or an exact row or number."""
    nothing = np.zeros_like(value)
    return np.stack([value, nothing, nothing], axis=-min(value.ndim + 1, 3))


NEARBY = Arithmetic(
    _multiply,
    lambda left, right: _sum(left + right, left, right),
    lambda left, right: _sum(left - right, left, right),
    _exact,
)


def composed_nearby(
    site: LinearSite, schedule: Schedule, steps: Mapping[int, Step], starts: Places
) -> FrameMap:
    """Return what bounds the frames of many sites composed in floats, of all in a group at once.

    Parameters
    ----------
    site, schedule, steps
        The sites' matrices (k, …), what happens in a frame, and its exponentials by duration in quanta.
    starts
        Where each group of sites starts (g,).
    """
    off = {
        duration: nearby(step.matrix, step.roundings * UNIT * step.size, starts)
        for duration, step in steps.items()
    }
    charge = COEFFICIENT_ROUNDINGS * UNIT
    groups = every_matrix(site, lambda matrix: nearby(matrix, charge, starts))
    return compose(groups, schedule, off, numbers=NEARBY)
