"""Smooth plane curves as chains of cubic Bézier segments.

Takes: points (k, 2) along a curve, and tangents there or handles.
Gives: `handles_of`, `straight_handles`, `between`, `tangents`, `area_under`, `distance_from_arc`.
Guarantees: `between` is the interpolant of the results; scaling a curve scales its points and handles.
Does not: use the meaning of the curves.

Between two points a and b lies the cubic with control points a, c, d, b; the handles (k − 1, 2, 2) of a curve
are c and d of each of its segments.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def handles_of(a: Floats, b: Floats, tangent_a: Floats, tangent_b: Floats) -> Floats:
    """Return the inner control points (k, 2, 2) of cubics from a to b (k, 2) with unit tangents at both ends.

    Notes
    -----
    The derivatives have the length of those that match a circular arc to sixth order: chord/cos²(θ/4), θ the
    angle between the tangents (de Boor, Höllig and Sabin, High accuracy geometric Hermite interpolation,
    1987).
    """
    cosine = np.clip((tangent_a * tangent_b).sum(axis=1), -1, 1)
    length = 2 * np.linalg.norm(b - a, axis=1) / (1 + np.sqrt((1 + cosine) / 2))
    third = length[:, None] / 3
    return np.stack([a + third * tangent_a, b - third * tangent_b], axis=1)


def straight_handles(points: Floats) -> Floats:
    """Return the handles (k − 1, 2, 2) of the straight lines from each point (k, 2) to the next."""
    third = np.diff(points, axis=0) / 3
    return np.stack([points[:-1] + third, points[1:] - third], axis=1)


def between(points: Floats, handles: Floats, share: float) -> Floats:
    """Return the points (k − 1, 2) at a relative position, from 0 to 1, of each segment of a curve."""
    s, t = share, 1 - share
    ends = t**3 * points[:-1] + s**3 * points[1:]
    values: Floats = ends + 3 * s * t * (t * handles[:, 0] + s * handles[:, 1])
    return values


def tangents(points: Floats, handles: Floats) -> Floats:
    """Return the unit tangents (k, 2) at the points of a curve."""
    along = np.concatenate([handles[:, 0] - points[:-1], points[-1:] - handles[-1:, 1]])
    values: Floats = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), np.finfo(float).tiny)
    return values


def area_under(points: Floats, handles: Floats) -> float:
    """Return ∫ x dy along a curve, exactly, by three Gauss points per segment."""
    steps = np.diff(np.stack([points[:-1], handles[:, 0], handles[:, 1], points[1:]]), axis=0)[..., 1]
    total = 0.0
    for node, weight in zip((-np.sqrt(0.6), 0.0, np.sqrt(0.6)), (5 / 18, 8 / 18, 5 / 18), strict=True):
        s = (1 + node) / 2
        rate = 3 * ((1 - s) ** 2 * steps[0] + 2 * s * (1 - s) * steps[1] + s**2 * steps[2])
        total += weight * float(between(points, handles, s)[:, 0] @ rate)
    return total


def distance_from_arc(tangent_a: Floats, tangent_b: Floats, length: Floats) -> Floats:
    """Return the largest distance of a cubic of `handles_of` from the circular arc with these tangents.

    With θ the angle of the chord it is (2/27) r sin⁶(θ/4)/cos²(θ/4), r = chord/(2 sin(θ/2)).
    """
    cosine = np.clip((tangent_a * tangent_b).sum(axis=1), -1, 1)
    quarter = np.arccos(cosine) / 4
    distance: Floats = length / 54 * np.sin(quarter) ** 5 / np.cos(quarter) ** 3
    return distance
