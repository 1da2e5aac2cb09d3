"""The paper's topology in 60 digits by hand: all eigenvalues at a point, and the stability limit.

Three users, forces 1 ms late, packets 8 ms late. A user who hears its own packets times an eigenvalue of the
graph is all there is: 1 times the mean of the others where all move alike, −1/2 times where they move apart.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint

from apc.spectrum.ball_arithmetic import precision

BITS = 200
CERTAIN = 1e-40  # so far, and no more, an eigenvalue may be off
DEVICE, CUBE = Fraction(0.1), Fraction(0.6) / 3  # kg, as a compiled topology holds them
DAMPING = 5  # N·s/m of either


@dataclass(frozen=True)
class Truth:
    """All eigenvalues of a point, and the radius without the one that is 1."""

    values: list[Any]
    radius: Any


@functools.cache
def _step() -> Any:
    """Return e^(A T) (6, 6) of a tick, over (x_H, v_H, x_O, v_O, F_C, F_T) with the forces held."""
    rates = [[Fraction(0)] * 6 for _ in range(6)]
    rates[0][1] = rates[2][3] = Fraction(1)
    rates[1][1], rates[1][4] = -DAMPING / DEVICE, -1 / DEVICE
    rates[3][3:6] = -DAMPING / CUBE, 1 / CUBE, -1 / CUBE
    entries = [flint.fmpq(*(one / 1000).as_integer_ratio()) for row in rates for one in row]
    with precision(BITS):
        return flint.arb_mat(flint.fmpq_mat(6, 6, entries)).exp()


def frame(own: int, share: Any, contact: Any, coordination: Any, damping: Any) -> Any:
    """Return the frame's map over (x_H, v_H, x_O, v_O, F_C, F_T, x_O and v_O sent a frame ago).

    Parameters
    ----------
    own
        How often a user's own position counts: 1, or in a mesh the number of others.
    share
        Of its packets that it hears.
    contact, coordination, damping
        K_C, K_T and B_C = B_T.
    """
    tick, step = flint.arb_mat(8, 8), _step()
    for row in range(4):
        for column in range(6):
            tick[row, column] = step[row, column]
    for column, value in enumerate((contact, damping, -contact, -damping)):
        tick[4, column] = flint.arb(value)
    for column, value in enumerate((coordination, damping)):
        tick[5, 2 + column], tick[5, 6 + column] = own * flint.arb(value), -share * flint.arb(value)
        tick[6 + column, 6 + column] = flint.arb(1)
    whole = tick**8
    for column in range(8):
        whole[6, column], whole[7, column] = flint.arb(column == 2), flint.arb(column == 3)
    return whole


def truth(mesh: bool, contact: float, coordination: float, damping: float) -> Truth:
    """Return all eigenvalues at a point."""
    own = 2 if mesh else 1
    listed, radius = [], flint.arb(0)
    with precision(BITS):
        for share in (flint.arb(own), -flint.arb(own) / 2):
            matrix = flint.acb_mat(frame(own, share, contact, coordination, damping).mid())
            values = matrix.eig(algorithm="approx")
            values.sort(key=lambda value: float(abs(value - 1).mid()))
            listed += values
            rigid = share > 0  # all can move together
            assert not rigid or float(abs(values[0] - 1).mid()) < CERTAIN
            radius = max([radius, *(abs(value).mid() for value in values[int(rigid) :])])
    return Truth(listed, radius)


def limit(contact: float, near: float) -> float:
    """Return K_T on the boundary at K_C for the mean and no damping, by secants from a value near it."""

    def growth(coordination: Any) -> Any:
        values = flint.acb_mat(frame(1, flint.arb(-1) / 2, contact, coordination, 0).mid()).eig(
            algorithm="approx"
        )
        return max(abs(value).mid() for value in values) - 1

    with precision(BITS):
        a, b = flint.arb(near), flint.arb(near) * (1 + flint.arb(10) ** -8)
        at_a, at_b = growth(a), growth(b)
        for _ in range(5):
            a, b, at_a = b, (b - at_b * (b - a) / (at_b - at_a)).mid(), at_b
            at_b = growth(b)
            if abs(at_b) < 1e-40:
                break
        return float(b)
