"""Frame matrices over a rectangle of two parameters, as points of the unit square.

Takes: a `MatrixSource` of two free parameters and their ranges.
Gives: `Rectangle`, `rectangle_of`; `DirectFamily`, `family_over`.
Guarantees: every point is computed anew; errors are bounds at points inside the rectangle. Strongly connected
states form separate systems: with one-directional coupling, peers have nearly equal eigenvalues, which a
single matrix would split by rounding only.
Does not: bound values between points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.parameter_values.parameter_names import Range
from apc.spectrum.eigenpairs import driving_parts
from apc.studies.dominant_eigenvalue import DrivingPart
from apc.studies.frame_matrices import MatrixSource

Floats = NDArray[np.float64]

# Bounds on the errors of each system's matrices (k, n, n) at values (k, 2).
Errors = Callable[[Floats], tuple[Floats, ...]]

# Points of the unit square at which properties of the whole rectangle are determined.
INSIDE = np.array([[0.1, 0.1], [0.1, 0.9], [0.9, 0.1], [0.9, 0.9]])


@dataclass(frozen=True, slots=True, eq=False)
class Rectangle:
    """The rectangle of two parameter ranges in SI: lower ends `low` and widths `width` (2,)."""

    low: Floats
    width: Floats

    def values(self, points: Floats) -> Floats:
        """Return parameter values (k, 2) at points of the unit square."""
        return self.low + points * self.width

    def points(self, values: Floats) -> Floats:
        """Return the points of the unit square (k, 2) of parameter values."""
        return (values - self.low) / self.width

    @property
    def offset(self) -> Floats:
        """The offset from points to parameter values relative to zero (2,)."""
        return self.low / self.width


def rectangle_of(x: Range, y: Range) -> Rectangle:
    """Return the rectangle of two ranges."""
    low = np.array([float(x.low), float(y.low)])
    return Rectangle(low, np.array([float(axis.high - axis.low) for axis in (x, y)]))


@dataclass(frozen=True, slots=True, eq=False)
class DirectFamily:
    """Matrices over a rectangle, computed by an evaluator at every point.

    `parts` are the strongly connected parts of its systems, `errors` bound the errors of the parts' matrices
    (n, n).
    """

    evaluator: MatrixSource
    rectangle: Rectangle
    parts: tuple[DrivingPart, ...]
    errors: tuple[Floats, ...]

    @property
    def sizes(self) -> tuple[int, ...]:
        """The number of states of each part."""
        return tuple(len(part.states) for part in self.parts)

    def matrices(self, points: Floats) -> tuple[Floats, ...]:
        """Return each part's matrices (k, n, n) at points (k, 2)."""
        system_matrices = self.evaluator.matrices(self.rectangle.values(points))
        return tuple(_of_part(part, system_matrices[part.system]) for part in self.parts)

    def slopes(self, system: int, points: Floats) -> tuple[Floats, Floats]:
        """Return the matrices (k, n, n) of one part, and their derivatives (2, k, n, n) over x and y."""
        count, part = len(points), self.parts[system]
        values = np.concatenate([self.rectangle.values(points)] * 2)
        along = np.zeros_like(values)
        along[:count, 0], along[count:, 1] = self.rectangle.width
        pair = self.evaluator.slopes(values, along)[part.system]
        matrix, slope = (_of_part(part, value) for value in pair)
        return matrix[:count], slope.reshape(2, count, *slope.shape[1:])


def _of_part(part: DrivingPart, matrices: Floats) -> Floats:
    """Return the rows and columns of a part in matrices (k, n, n) of its system."""
    if len(part.states) == matrices.shape[1]:
        return matrices
    return matrices[:, part.states[:, None], part.states]


def family_over(source: MatrixSource, rectangle: Rectangle, errors: Errors) -> DirectFamily:
    """Return the matrices over a rectangle, divided into strongly connected parts.

    Parameters
    ----------
    source
        The matrices over two free parameters.
    rectangle
        The ranges of the parameters.
    errors
        Bounds (k, n, n) on the errors of each system's matrices at values (k, 2), entry by entry.
    """
    corners = rectangle.values(INSIDE)
    bounds = tuple(values.max(axis=0) for values in errors(corners))
    parts: list[DrivingPart] = []
    for system, (error, matrix) in enumerate(zip(bounds, source.matrices(corners), strict=True)):
        driving = driving_parts(np.abs(matrix).max(axis=0) + error != 0)
        parts += [DrivingPart(system, states) for states in driving or [np.arange(len(error))]]
    part_errors = tuple(bounds[part.system][np.ix_(part.states, part.states)] for part in parts)
    return DirectFamily(source, rectangle, tuple(parts), part_errors)
