"""Families of matrices whose spectral radius is known everywhere: for the geometry of stable regions."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# f, ∂f/∂x and ∂f/∂y at x and y.
Field = Callable[[Floats, Floats], tuple[Floats, Floats, Floats]]

MIX = np.array([[1.0, 0.5], [0.2, 1.0]])


class Fields:
    """One closed system a field f: a complex pair of magnitude exp(f), its angle moving with x."""

    def __init__(self, *fields: Field) -> None:
        self.fields = fields
        self.sizes = (2,) * len(fields)
        self.errors = (np.full((2, 2), 1e-15),) * len(fields)

    def matrices(self, points: Floats) -> tuple[Floats, ...]:
        return tuple(self.slopes(system, points)[0] for system in range(len(self.fields)))

    def slopes(self, system: int, points: Floats) -> tuple[Floats, Floats]:
        value, along_x, along_y = self.fields[system](points[:, 0], points[:, 1])
        angle = 0.7 + 0.3 * points[:, 0]
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).transpose(2, 0, 1)
        turned = 0.3 * np.array([[-np.sin(angle), -np.cos(angle)], [np.cos(angle), -np.sin(angle)]])
        size, back = np.exp(value)[:, None, None], np.linalg.inv(MIX)
        moved_x = along_x[:, None, None] * turn + turned.transpose(2, 0, 1)
        moved_y = along_y[:, None, None] * turn
        return MIX @ (size * turn) @ back, np.stack([MIX @ (size * one) @ back for one in (moved_x, moved_y)])


def disc(x: float, y: float, radius: float, sign: float = 1.0) -> Field:
    """Stable in a disc, or with sign −1 unstable in it."""
    return lambda a, b: (
        sign * ((a - x) ** 2 + (b - y) ** 2 - radius**2),
        sign * 2 * (a - x),
        sign * 2 * (b - y),
    )


def plane(a: float, b: float, c: float) -> Field:
    """Stable where a x + b y < c."""
    return lambda x, y: (a * x + b * y - c, a + 0 * x, b + 0 * y)


def cusp(x: float, y: float) -> Field:
    """Stable where (u − x)³ > (v − y)²."""
    return lambda u, v: ((v - y) ** 2 - (u - x) ** 3, -3 * (u - x) ** 2, 2 * (v - y))
