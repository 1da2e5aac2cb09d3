"""The paper's stability limit in 50 digits: the difference mode of three users by hand.

Average position, B_C = B_T = 0, forces 1 ms late, packets 8 ms late: with the users' sum at rest each
hears the mean of the others as −1/2 of what it sends itself.
"""

from __future__ import annotations

from typing import Any

import flint

BITS = 200


def frame(contact: Any, coordination: Any) -> Any:
    """Return the frame's map over (x_H, v_H, x_O, v_O, F_C, F_T, x_O sent a frame ago)."""
    q = flint.fmpq
    rates = [[q(0)] * 6 for _ in range(6)]
    rates[0][1] = rates[2][3] = q(1)
    rates[1][1], rates[1][4] = q(-50), q(-10)
    rates[3][3], rates[3][4], rates[3][5] = q(-25), q(5), q(-5)
    step = flint.arb_mat(flint.fmpq_mat(6, 6, [one * q(1, 1000) for row in rates for one in row])).exp()
    tick = flint.arb_mat(7, 7)
    for row in range(4):
        for column in range(6):
            tick[row, column] = step[row, column]
    tick[4, 0], tick[4, 2] = contact, -contact
    tick[5, 2], tick[5, 6] = coordination, coordination / 2
    tick[6, 6] = flint.arb(1)
    whole = tick**8
    for column in range(7):
        whole[6, column] = flint.arb(1 if column == 2 else 0)
    return whole


def growth(contact: Any, coordination: Any) -> Any:
    """Return log ρ of the difference mode."""
    values = flint.acb_mat(frame(contact, coordination)).eig()
    return max((abs(value).log() for value in values if abs(value).mid() > 0.1), key=lambda one: one.mid())


def limit(contact: float, near: float) -> float:
    """Return K_T on the boundary at K_C, right to the last digit, by secants from a value near it."""
    precision = flint.ctx.prec
    flint.ctx.prec = BITS
    try:
        k_c = flint.arb(contact)
        a, b = flint.arb(near), flint.arb(near) * (1 + flint.arb(10) ** -8)
        at_a, at_b = growth(k_c, a), growth(k_c, b)
        for _ in range(4):
            a, b, at_a = b, (b - at_b * (b - a) / (at_b - at_a)).mid(), at_b
            at_b = growth(k_c, b)
            if abs(at_b).mid() < 1e-40:
                break
        return float(b.mid())
    finally:
        flint.ctx.prec = precision
