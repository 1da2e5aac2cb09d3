"""All eigenvalues of the paper's scene at a point of its map over K_C and K_T, in 60 digits.

One user who hears its own packets times an eigenvalue of the graph, its map written out by hand.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import flint

from tests.bench.by_hand import CUBE_DAMPING, DEVICE_DAMPING, DEVICE_MASS, SHARED_MASS, TICKS, USERS
from tests.bruteforce import as_ball

BITS = 200  # of precision: 60 decimal digits
CERTAIN = 1e-40  # so far, and no more, the truth itself may be off
DEVICE, CUBE = Fraction(DEVICE_MASS), Fraction(SHARED_MASS) / USERS  # the numbers a compiled scene holds


@dataclass(frozen=True)
class Truth:
    """All eigenvalues of a point, and the radius without the one that is 1."""

    values: list[flint.acb]
    radius: flint.arb


def truth(mesh: bool, k_c: float, k_t: float, damping: float) -> Truth:
    """Return the truth at a point, by one user who hears its own packets times an eigenvalue of W."""
    own = 2 if mesh else 1
    values: list[flint.acb] = []
    radius = flint.arb(0)
    for share, rigid in ((flint.arb(own), True), (-flint.arb(own) / 2, False)):
        matrix = _frame(own, share, flint.arb(k_c), flint.arb(k_t), flint.arb(damping))
        found = flint.acb_mat(matrix.mid()).eig(algorithm="approx")
        found.sort(key=lambda value: float(abs(value - 1).mid()))
        values += found
        assert not rigid or float(abs(found[0] - 1).mid()) < CERTAIN
        radius = max([radius, *(abs(value).mid() for value in found[1 if rigid else 0 :])])
    return Truth(values, radius)


@functools.cache
def _step() -> Any:
    """Return e^(A T) (6, 6) of a tick, over (x, v, x_O, v_O, F_C, F_T) with the forces held."""
    device, cube, zero = Fraction(DEVICE_DAMPING) / DEVICE, Fraction(CUBE_DAMPING) / CUBE, Fraction(0)
    rates = [[zero] * 6 for _ in range(6)]
    rates[0][1] = rates[2][3] = Fraction(1)
    rates[1][1], rates[1][4] = -device, -1 / DEVICE
    rates[3][3:6] = -cube, 1 / CUBE, -1 / CUBE
    return flint.arb_mat(6, 6, [as_ball(one / 1000) for row in rates for one in row]).exp()


def _frame(own: int, share: Any, k_c: Any, k_t: Any, damping: Any) -> Any:
    """Return one user's frame over (x, v, x_O, v_O, F_C, F_T, packet x_O, packet v_O)."""
    tick, step = flint.arb_mat(8, 8), _step()
    for row in range(4):
        for column in range(6):
            tick[row, column] = step[row, column]
    for column, value in enumerate((k_c, damping, -k_c, -damping)):
        tick[4, column] = value
    for column, value in enumerate((own * k_t, own * damping)):
        tick[5, 2 + column], tick[5, 6 + column] = value, -share * value / own
        tick[6 + column, 6 + column] = flint.arb(1)
    frame = tick**TICKS
    for column in range(8):
        frame[6, column], frame[7, column] = flint.arb(column == 2), flint.arb(column == 3)
    return frame
