"""How much a loop makes of what comes from outside, at the worst frequency: its H∞ norm, and a bound.

Takes: x⁺ = A x + B r, d = C x + D r, of floats or of floats with their radii.
Gives: `peak_gain`, `proves_gain`; `is_positive`.
Guarantees: what `proves_gain` says holds for all matrices within the radii.
Does not: take out rigid motions, or weigh what comes in (see `worst`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT
from apc.frame.radius import RADII, radius_of, value_of

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Levels tried on the way to the peak: each step squares the distance, so some four are needed.
LEVELS = 40

# How far above what is known a level is tried, relatively, and how near the axis, relatively, an eigenvalue
# may be on it: two that meet there are off by the square root of their rounding.
ABOVE, ON_AXIS = 1e-13, 1e-5

# Doublings of a Riccati equation; fewer than ten are needed unless a level is all but reached.
DOUBLINGS = 60

# The least storage of a state, beside the largest.
UNSEEN = 1e-9

# Parts of a storage that are left over for rounding, the first that serves.
SPARED = (1e-3, 1e-5, 1e-7, 1e-9)


def peak_gain(a: Floats, b: Floats, c: Floats, d: Floats) -> float:
    """Return max over θ of ‖C (e^{jθ} − A)⁻¹ B + D‖₂, infinite where A is not stable.

    Notes
    -----
    With z = (1 + s)/(1 − s) the unit circle becomes the imaginary axis, and the gain is γ at jω exactly where
    the Hamiltonian matrix of γ has the eigenvalue jω (Boyd, Balakrishnan and Kabamba, 1989). Between two such
    frequencies the gain is larger: the largest at their middles is the next level (Bruinsma and Steinbuch,
    1990).
    """
    n = len(a)
    if not b.size or not c.size:
        return 0.0
    values = np.linalg.eigvals(a)
    if n and np.abs(values).max() >= 1:
        return np.inf
    inverse = np.linalg.inv(np.eye(n) + a)
    a_c, b_c = inverse @ (a - np.eye(n)), np.sqrt(2) * inverse @ b
    c_c, d_c = np.sqrt(2) * c @ inverse, d - c @ inverse @ b

    def gain(angles: Floats) -> float:
        at = np.exp(1j * angles)[:, None, None]
        found = c @ np.linalg.solve(at * np.eye(n) - a, np.broadcast_to(b + 0j, (len(angles), *b.shape))) + d
        return float(np.linalg.svd(found, compute_uv=False).max(initial=0.0))

    best = gain(np.concatenate([[0.0, np.pi], np.angle(values)]))
    if not best:
        return 0.0
    for _ in range(LEVELS):
        level = best * (1 + ABOVE)
        r = np.linalg.inv(level**2 * np.eye(b.shape[1]) - d_c.T @ d_c)
        a_h = a_c + b_c @ r @ d_c.T @ c_c
        hamiltonian = np.block(
            [[a_h, b_c @ r @ b_c.T], [-c_c.T @ (np.eye(len(c)) + d_c @ r @ d_c.T) @ c_c, -a_h.T]]
        )
        found = np.linalg.eigvals(hamiltonian)
        near = np.sort(found.imag[(np.abs(found.real) <= ON_AXIS * np.abs(found)) & (found.imag >= 0)])
        near = np.concatenate([[0.0], near])
        angles = 2 * np.arctan(np.concatenate([near, (near[1:] + near[:-1]) / 2]))
        higher = gain(angles)
        if higher <= level:
            return max(best, higher)
        best = higher
    return best


def proves_gain(a: Matrix, b: Matrix, c: Matrix, d: Matrix, level: float) -> bool:
    """Say whether a loop is proved stable and its gain proved smaller than a level.

    Parameters
    ----------
    a, b, c, d
        The loop's matrices (2, …) with their radii.
    level
        More than the gain.

    Notes
    -----
    The bounded real lemma: both hold if some P ≻ 0 makes [P − AᵀPA − CᵀC, −AᵀPB − CᵀD; ·, γ² − DᵀD − BᵀPB]
    positive definite. P solves the Riccati equation of a C that is a little larger, in floats; that it serves
    is checked.
    """
    if not np.isfinite(level) or not all(np.isfinite(one).all() for one in (a, b, c, d)):
        return False
    plain = value_of(a), value_of(b), value_of(c), value_of(d)
    first = _storage(*plain, level, np.zeros(a.shape[-1]))
    if first is None:
        return False
    # What nothing comes of needs some storage, too, for that of all to be positive.
    sizes = np.diag(first)
    sizes = np.maximum(sizes, UNSEEN * sizes.max(initial=0.0) or 1.0)
    for part in SPARED:
        p = _storage(*plain, level, part * sizes)
        if p is not None and _serves(a, b, c, d, level, (p + p.T) / 2):
            return True
    return False


def _storage(a: Floats, b: Floats, c: Floats, d: Floats, level: float, more: Floats) -> Floats | None:
    """Solve P = AᵀPA + CᵀC + diag(more) + (…)(γ² − DᵀD − BᵀPB)⁻¹(…)ᵀ by doubling (Chu, Fan and Lin, 2005)."""
    n = len(a)
    with np.errstate(all="ignore"):
        try:
            r = np.linalg.inv(level**2 * np.eye(b.shape[1]) - d.T @ d)
            a_k, g = a + b @ r @ d.T @ c, -b @ r @ b.T
            h = c.T @ (np.eye(len(c)) + d @ r @ d.T) @ c + np.diag(more)
            for _ in range(DOUBLINGS):
                turned = np.linalg.solve(np.eye(n) + g @ h, np.hstack([a_k, g @ a_k.T]))
                one, other = turned[:, :n], turned[:, n:]
                rise = a_k.T @ h @ one
                h, g, a_k = h + rise, g + a_k @ other, a_k @ one
                if not np.isfinite(h).all():
                    return None
                if np.abs(rise).max(initial=0.0) <= UNIT * np.abs(h).max(initial=0.0):
                    return h
        except np.linalg.LinAlgError:
            return None
    return None


def _serves(a: Matrix, b: Matrix, c: Matrix, d: Matrix, level: float, p: Floats) -> bool:
    """Say whether P proves the level."""
    n, m = len(p), b.shape[-1]
    storage = RADII.exact(p)
    input_ = np.concatenate([a, b], axis=-1)
    output = np.concatenate([c, d], axis=-1)
    used = RADII.add(
        RADII.multiply(np.swapaxes(input_, -1, -2), RADII.multiply(storage, input_)),
        RADII.multiply(np.swapaxes(output, -1, -2), output),
    )
    given = np.zeros((2, n + m, n + m))
    given[0, :n, :n] = p
    given[0, n:, n:] = level**2 * (1 - 4 * UNIT) * np.eye(m)
    return is_positive(storage) and is_positive(RADII.subtract(given, used))


def is_positive(matrix: Matrix) -> bool:
    """Say whether all symmetric matrices within the radii of one (2, n, n) are proved positive definite.

    Notes
    -----
    They are if a Cholesky decomposition in floats of the matrix less c runs through, c being more than the
    radii's norm and what rounding does to the decomposition, γ_{n+1} tr / (1 − γ_{n+1}) (Rump, 2006). Rows
    and columns are scaled by powers of two before, which is exact.
    """
    value, radius = value_of(matrix), radius_of(matrix)
    n = len(value)
    diagonal = np.diag(value)
    if not np.isfinite(matrix).all() or (diagonal <= 0).any():
        return False
    scale = np.ldexp(1.0, -(np.frexp(diagonal)[1] // 2))
    value, radius = scale[:, None] * value * scale, scale[:, None] * radius * scale
    # The mean of the matrix and its transpose is within the radii of either, but for one rounding.
    off = np.maximum(radius, radius.T) + np.abs(value - value.T) + 2 * UNIT * np.abs(value)
    charge = (n + 2) * UNIT
    shift = 1.01 * (float(off.sum(axis=1).max(initial=0.0)) + charge / (1 - charge) * float(np.trace(value)))
    try:
        np.linalg.cholesky((value + value.T) / 2 - (shift + 4 * UNIT) * np.eye(n))
    except np.linalg.LinAlgError:
        return False
    return True
