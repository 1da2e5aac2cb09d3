"""What passive hands may do with a mode, proved in ball arithmetic.

Takes: an opened scene, one of its loops and where it was cut (see `port`), and what floats found.
Gives: `certified`.
Guarantees: every rounding since the exact numbers of the sites' equations is inside a ball, but for the roots
that inputs and outputs are scaled by, which may be any numbers.
Does not: find anything out: a verdict, and the worst angle, come from `passivity`.
"""

from __future__ import annotations

from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

from apc.eigen.balls import BALLS, Balls, frame_balls, precision, square, unprovable
from apc.eigen.closing import Loop, close_loop
from apc.eigen.dissipation import storages
from apc.hands.port import Cut, Maps

# Bits, the first that serve.
PRECISIONS = (128, 256, 512)

# Parts of a storage that are left over, the first that serves.
SPARED = tuple(10.0**-k for k in range(3, 11))


def certified(loop: Loop, cut: Cut, dampings: NDArray[np.float64], *, passive: bool, angle: float) -> int:
    """Prove that hands can draw no energy from a mode, or that they can.

    Parameters
    ----------
    loop, cut, dampings
        The mode, its devices moved from outside, where it is cut and what damps each device, N·s/m.
    passive
        What is to be proved.
    angle
        Where they draw most, by how much it turns in a frame.

    Returns
    -------
    The bits with which it is proved; 0 where it isn't, or the equations can't be had exactly.
    """
    if unprovable(loop) or cut.rigid.size:
        return 0
    closed = close_loop(loop)
    for bits in PRECISIONS:
        with precision(bits):
            maps = cut.maps(frame_balls(closed), BALLS.exact(dampings[:, None]), BALLS)
            if maps is not None and (_gives_nothing(maps) if passive else _gives(maps, angle)):
                return bits
    return 0


def _gives_nothing(maps: Maps) -> bool:
    """Say whether a storage of floats proves He H + W positive all over the circle (see `dissipation`)."""
    a, b, c = maps.a, maps.b, maps.c
    whole = maps.d + maps.weight
    n, m = b.shape
    supply: Balls = np.zeros((n + m, n + m), dtype=object)
    supply[n:, :n], supply[:n, n:], supply[n:, n:] = c, c.T, whole + whole.T
    moved = np.concatenate([a, b], axis=1)
    for p in storages(_middle(a), _middle(b), _middle(supply), SPARED):
        storage = BALLS.exact((p + p.T) / 2)
        less = supply - BALLS.multiply(np.ascontiguousarray(moved.T), BALLS.multiply(storage, moved))
        less[:n, :n] = less[:n, :n] + storage
        if _is_positive(storage) and _is_positive(less):
            return True
    return False


def _gives(maps: Maps, angle: float) -> bool:
    """Say whether the Hermitian part is negative in the worst direction at a rational point of the circle."""
    half = flint.arb(float(np.tan(angle / 2)))
    z = flint.acb(1 - half * half, 2 * half) / (1 + half * half)
    n = len(maps.a)
    middle = tuple(map(_middle, (maps.a, maps.b, maps.c, maps.d, maps.weight)))
    at = complex(float(z.real.mid()), float(z.imag.mid()))
    response = middle[2] @ np.linalg.solve(at * np.eye(n) - middle[0], middle[1] + 0j) + middle[3]
    direction = np.linalg.eigh((response + response.conj().T) / 2 + middle[4])[1][:, 0]
    v = flint.acb_mat([[flint.acb(float(one.real), float(one.imag))] for one in direction])
    still = flint.acb_mat([[z if i == j else 0 for j in range(n)] for i in range(n)]) - _complex(maps.a)
    try:
        states = still.solve(_complex(maps.b) * v)
    except ZeroDivisionError:
        return False
    pushed = _complex(maps.c) * states + _complex(maps.d + maps.weight) * v
    drawn = sum(
        (one.conjugate() * other).real for one, other in zip(v.entries(), pushed.entries(), strict=True)
    )
    return bool(drawn < 0)


def _is_positive(matrix: Balls) -> bool:
    """Say whether all symmetric matrices in the balls are positive definite: each pivot of LDLᵀ is."""
    rest = matrix.copy()
    while len(rest):
        pivot = flint.arb(rest[0, 0])
        if not pivot > 0:
            return False
        row = rest[1:, 0]
        rest = rest[1:, 1:] - np.outer(row, row) / pivot
    return True


def _middle(block: Balls) -> NDArray[np.float64]:
    """Return the middles of balls, in floats."""
    entries = [float(flint.arb(one).mid()) for one in block.ravel().tolist()]
    return np.array(entries, dtype=np.float64).reshape(block.shape)


def _complex(block: Balls) -> Any:
    """Return balls as a complex matrix of python-flint."""
    return flint.acb_mat(square(block))
