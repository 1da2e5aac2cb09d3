"""The largest eigenvalue of each of many matrices, with a bound, by products of small matrices alone.

Takes: matrices (k, n, n), and bounds on what each entry may be off by.
Gives: `largest_pairs`; `Dominant`, `enclosed`; `all_within`, `misses_one`, `resolvents`.
Guarantees: the bounds hold for every matrix within the errors, whatever their conditioning; rounding in the
bounds themselves is charged. What is not shown is said to be open, never guessed.
Does not: give the other eigenvalues (see `enclosure`), or decide where two are about as large.

LAPACK takes ten times as long for an eigenvalue problem of order 8 as all products here: what a high power
of M leaves is the largest eigenvalue's, or the pair's, own space (the power method), and that it is, and that
nothing else is as large, is proved afterwards. Only where the power leaves more than that is LAPACK asked.

Notes
-----
X (n, 2) and W (2, n) are what floats give for the space of λ, λ̄ and for its left vectors, with Λ such that
M X ≈ X Λ and W M ≈ Λ W; K = W X ≈ 1. Π = X K⁻¹ W is then a projector, and for every matrix A within the error
of M, R = A X − X Λ and S = W A − Λ W,

    Π A Π ≙ Λ + K⁻¹ W R,   Π A (1 − Π) ≙ K⁻¹ S (1 − Π),   (1 − Π) A Π ≙ (1 − Π) R,
    (1 − Π) A (1 − Π) = A − X K⁻¹ Λ W − X K⁻¹ S − R K⁻¹ W + X K⁻¹ W R K⁻¹ W,

the last of which is within some ε of N = M − X Λ W. Where ‖(z − N)⁻¹‖ ≤ ρ for all |z| ≥ r and ρ ε < 1/2, an
eigenvalue z of A that large is one of Λ + K⁻¹ W R + H with ‖H‖ ≤ 2 ρ ‖K⁻¹ S (1 − Π)‖ ‖(1 − Π) R‖ (the Schur
complement), which is of the second order. In the basis of λ's own vectors that is a disc about λ of the
radius |w| |R v|, and of the second order again what the pair does to one another.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.eigenpairs import eigenpairs
from apc.frame.discretize import UNIT

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Truths = NDArray[np.bool_]
Matrix = NDArray[Any]

# M is squared so many times: what is smaller than the largest by 2 % is then gone to rounding; where it is
# not gone, so many times more, which leaves nothing of what is smaller by 0.1 %.
SQUARINGS, MORE = 11, 5

# After so many squarings the norm is brought to 1: no entry has left the range of floats by then.
EVERY = 3

# A power of a matrix with one largest eigenvalue is of rank 1 up to this.
ALONE = 1e-8

# A residual up to which vectors are taken as they are, relative to these.
SETTLED = 1e-14

# A residual beyond this means that others are left beside them.
VAGUE = 1e-12

# The largest has to be larger than the others by this share of it; its own bound has to be smaller.
APART = 1e-6

# Squarings of what is left until its norm is below 1/2.
TRIED = 20

# Matrices still in question, as a share of those at hand, below which only they are squared on.
SHORT_OF = 0.4

# What squares hide that leave the range of floats, beside the sum of others.
HIDDEN = 1e-150


@dataclass(frozen=True, slots=True, eq=False)
class Dominant:
    """The largest eigenvalue of each of k matrices, of a conjugate pair the one above; NaN where it is open.

    `error` bounds |value − truth|: exactly one eigenvalue is that near. It and its conjugate are the only
    ones of a magnitude of `others` or more, and where it is `alone`, of 1 or more.
    """

    value: Complexes  # (k,)
    error: Floats  # (k,)
    others: Floats  # (k,)
    alone: Truths  # (k,)


def largest_pairs(matrix: Floats) -> tuple[Complexes, Complexes, Complexes]:
    """Return the largest eigenvalue (k,) of each of many matrices, and its right and left vectors (k, n).

    Nothing says here that they are; where there is nothing to find they are NaN.

    Parameters
    ----------
    matrix
        Real matrices (k, n, n), their states scaled alike (see `pseudospectrum.balance`).
    """
    with np.errstate(all="ignore"):
        power = _squared(_shrunk(matrix), SQUARINGS)
        value, right, left = _left_by(power, matrix)
        moved = (matrix @ right[:, :, None])[:, :, 0] - value[:, None] * right
        again = np.flatnonzero(~(np.abs(moved).max(axis=1, initial=0.0) <= SETTLED * np.abs(value)))
        if len(again):
            some = matrix[again]
            value[again], right[again], left[again] = _left_by(_squared(power[again], MORE), some)
            moved = (some @ right[again, :, None])[:, :, 0] - value[again, None] * right[again]
            vague = ~(np.abs(moved).max(axis=1, initial=0.0) <= VAGUE * np.abs(value[again]))
            again = again[vague & np.isfinite(some).all(axis=(1, 2))]
        if len(again):
            value[again], right[again], left[again] = _largest_of_all(matrix[again])
        return value, right, left


def _largest_of_all(matrix: Floats) -> tuple[Complexes, Complexes, Complexes]:
    """Return the same of finite matrices by all their eigenvalues, where many are about as large."""
    pairs = eigenpairs(matrix)
    sizes = np.where(pairs.values.imag >= 0, np.abs(pairs.values), -1.0)
    place = sizes.argmax(axis=1)[:, None]
    value = np.take_along_axis(pairs.values, place, axis=1)[:, 0]
    v = np.take_along_axis(pairs.right, place[:, None], axis=2)[:, :, 0]
    w = np.take_along_axis(pairs.left, place[:, :, None], axis=1)[:, 0]
    v = v / np.abs(v).max(axis=1, keepdims=True)
    return value, v, w / (w * v).sum(axis=1, keepdims=True)


def _squared(power: Floats, times: int) -> Floats:
    """Square matrices (k, n, n) so many times, and bring their norms to 1."""
    for time in range(times):
        power = power @ power
        if time % EVERY == EVERY - 1 or time == times - 1:
            power = _shrunk(power)
    return power


def _shrunk(matrix: Floats) -> Floats:
    """Return matrices (k, n, n) over their norms."""
    return matrix / _norms(matrix)[:, None, None]


def _left_by(power: Floats, matrix: Floats) -> tuple[Complexes, Complexes, Complexes]:
    """Return the eigenvalue (k,), and its right and left vectors (k, n), that a power of a matrix leaves."""
    # It is of rank 1 or 2: its largest entry's column and row, and those of the rest.
    one = _cross(power)
    rest = power - one[0][:, :, None] * one[1][:, None]
    two = _cross(rest)
    alone = ~(np.abs(two[2]) > ALONE)
    right, left = np.stack([one[0], two[0]], axis=2), np.stack([one[1], two[1]], axis=1)
    form, pairing = left @ (matrix @ right), left @ right
    form[alone, 1], form[alone, 0, 1] = 0.0, 0.0
    pairing[alone, 1], pairing[alone, :, 1] = 0.0, [0.0, 1.0]
    value, along, across = _larger(_solved(pairing, form))
    v = (right @ along[:, :, None])[:, :, 0]
    w = (_solved(pairing.swapaxes(1, 2), across[:, :, None]).swapaxes(1, 2) @ left)[:, 0]
    v = v / np.abs(v).max(axis=1, keepdims=True)
    return value, v, w / (w * v).sum(axis=1, keepdims=True)


def _cross(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the column (k, n), and over it the row (k, n), of each matrix's largest entry; and that (k,)."""
    k, n = len(matrix), matrix.shape[-1]
    row, column = np.divmod(np.abs(matrix).reshape(k, n * n).argmax(axis=1), n)
    every = np.arange(k)
    peak = matrix[every, row, column]
    return matrix[every, :, column], matrix[every, row] / peak[:, None], peak


def _solved(matrix: Floats, right: Matrix) -> Matrix:
    """Return M⁻¹ B of matrices M (k, 2, 2)."""
    (a, b), (c, d) = matrix[:, 0].T, matrix[:, 1].T
    adjugate = np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)
    return np.asarray((adjugate @ right) / (a * d - b * c)[:, None, None])


def _larger(form: Floats) -> tuple[Complexes, Complexes, Complexes]:
    """Return the larger eigenvalue (k,) of matrices (k, 2, 2), its right and its left vector (k, 2)."""
    (a, b), (c, d) = form[:, 0].T, form[:, 1].T
    middle, half = (a + d) / 2, (a - d) / 2
    root = np.sqrt(half * half + b * c + 0j)
    value = middle + np.where((root.imag == 0) & (middle < 0), -root, root)
    above, below = value - d, value - a
    upper = np.abs(above) >= np.abs(below)
    along = np.where(upper, [above, c + 0j], [b + 0j, below]).T
    across = np.where(upper, [above, b + 0j], [c + 0j, below]).T
    return value, along, across


def enclosed(matrix: Floats, error: Floats, value: Complexes, right: Complexes, left: Complexes) -> Dominant:
    """Bound what the largest eigenvalues are off by, and show that they are the largest.

    Parameters
    ----------
    matrix, error
        The matrices (k, n, n), and a bound on what each entry is off by.
    value, right, left
        From `largest_pairs`.
    """
    with np.errstate(all="ignore"):
        return _enclosed(matrix, error, value, right, left)


def _enclosed(matrix: Floats, error: Floats, value: Complexes, right: Complexes, left: Complexes) -> Dominant:
    n = matrix.shape[-1]
    charge = (n + 6) * UNIT  # of real matrices, and what is done to an entry besides
    paired = value.imag != 0
    size = np.abs(value) * (1 + 4 * UNIT)
    twice = np.where(paired, 2.0, 1.0)[:, None, None]
    x, turned_x = (_columns(one, paired) for one in (right, value[:, None] * right))  # X, X Λ
    w, turned_w = (_rows(one, paired) * twice for one in (left, value[:, None] * left))  # W, Λ W
    off_x, off_w = matrix @ x - turned_x, w @ matrix - turned_w

    # ‖R‖ and ‖S‖ for every matrix within the error, and ‖K − 1‖.
    own = w @ x
    own[:, 0, 0] -= 1.0
    own[:, 1, 1] -= paired
    norm_x, norm_w, norm_m, norm_e = map(_norms, (x, w, matrix, error))
    doubt = norm_e + charge * (norm_m + 3 * size)
    rest_x, rest_w = _norms(off_x) + doubt * norm_x, _norms(off_w) + doubt * norm_w
    wrong = _norms(own) + charge * norm_w * norm_x

    # |R v| of the complex vector v. What the error of M does to v is |E| |v|; the roundings of both its parts
    # add up.
    parts = np.abs(x).sum(axis=2)
    rounded = (np.abs(matrix) @ parts[:, :, None])[:, :, 0] + 3 * size[:, None] * parts
    off_v = np.abs(off_x).sum(axis=2) + charge * rounded + (error @ np.abs(right)[:, :, None])[:, :, 0]
    first = (np.abs(left) * off_v).sum(axis=1) * (1 + charge)

    inverse = 1 / (1 - wrong)  # ‖K⁻¹‖
    apart = 1 + norm_x * inverse * norm_w  # ‖1 − Π‖
    remainder = matrix - turned_x @ w
    large = norm_m + 2 * norm_x * size * norm_w
    away = norm_e + charge * large + norm_x * size * inverse * wrong * norm_w
    away += inverse * (norm_x * rest_w + rest_x * norm_w * apart) + 2 * UNIT * large
    # Of what grows it is asked first whether nothing else does.
    others = size * (1 - APART)
    beyond = np.minimum(others, 1.0)
    within = resolvents(remainder / beyond[:, None, None])
    more = np.flatnonzero(~(within * away < 0.5 * beyond) & (others > 1))
    if len(more):
        beyond[more] = others[more]
        within[more] = resolvents(remainder[more] / others[more, None, None])
    second = inverse * apart**2 * rest_x * rest_w * 2 * within / beyond
    radius = first + inverse * wrong * norm_w * rest_x + second
    mixed = radius  # |w R v̄| has the bound of |w R v|
    radius = radius + np.where(paired, 2 * mixed * mixed / np.abs(value.imag), 0.0)
    radius *= 1 + 64 * charge
    known = (wrong < 0.1) & (within * away < 0.5 * beyond) & (radius < APART / 2 * size)
    known &= ~paired | (mixed < np.abs(value.imag) / 4)
    nothing = np.where(known, 0.0, np.nan)
    return Dominant(value + nothing, radius + nothing, others + nothing, known & (beyond <= 1))


def _columns(vectors: Complexes, paired: Truths) -> Floats:
    """Return the real and imaginary parts of vectors (k, n) as columns (k, n, 2), of real ones only those."""
    found = np.ascontiguousarray(vectors).view(np.float64).reshape(*vectors.shape, 2).copy()
    found[~paired, :, 1] = 0.0
    return found


def _rows(vectors: Complexes, paired: Truths) -> Floats:
    """Return the real parts of vectors (k, n) and the imaginary ones with a minus, as rows (k, 2, n)."""
    found = np.stack([vectors.real, -vectors.imag], axis=1)
    found[~paired, 1] = 0.0
    return found


def all_within(matrix: Floats, error: Floats, radius: Floats) -> Truths:
    """Say whether all eigenvalues of matrices (k, n, n) known up to an error are within a radius (k,)."""
    with np.errstate(all="ignore"):
        shrunk = matrix / radius[:, None, None]
        away = _norms(error) / radius + 2 * UNIT * _norms(shrunk)
        return np.asarray(resolvents(shrunk) * away < 0.5)


def misses_one(matrix: Floats, error: Floats) -> Truths:
    """Say of matrices (k, n, n) known up to an error whether 1 is certainly no eigenvalue."""
    n = matrix.shape[-1]
    unit = np.eye(n)
    with np.errstate(all="ignore"):
        away = unit - matrix
        try:
            inverse = np.linalg.inv(away)
        except np.linalg.LinAlgError:
            return np.zeros(len(matrix), dtype=np.bool_)
        doubt = _norms(error) + (n + 4) * UNIT * (n + _norms(matrix))
        wrong = np.asarray(unit - inverse @ away, dtype=np.float64)
        return np.asarray(_norms(wrong) + _norms(np.asarray(inverse)) * doubt < 0.5)


def resolvents(matrix: Floats) -> Floats:
    """Return bounds on ‖(z − N)⁻¹‖ for all |z| ≥ 1 (k,), infinite where there seems to be none.

    Parameters
    ----------
    matrix
        Real matrices (k, n, n).

    Notes
    -----
    (z − N)⁻¹ = z⁻¹ (1 + N/z) (1 + N²/z²) (1 + N⁴/z⁴) … (1 − N^K/z^K)⁻¹ with ‖N^K‖ < 1/2, each power with a
    bound on its rounding.
    """
    k, n = matrix.shape[:2]
    charge = (n + 6) * UNIT  # of real matrices, and what is done to an entry besides
    found, left = np.full(k, np.inf), np.arange(k)
    power, off, product = matrix, np.zeros(k), np.ones(k)
    size = _norms(power)
    for _ in range(TRIED):
        most = size + off
        found[left] = np.where(most < 0.5, product * (1 + 1e-12) / (1 - most), np.inf)
        on = ~(most < 0.5) & (product < 1e60)
        if not on.any():
            break
        if np.count_nonzero(on) < SHORT_OF * len(on):  # to carry on with a few that are done costs less
            left, power, off, product, size = left[on], power[on], off[on], product[on], size[on]
            most = most[on]
        product = product * (1 + most)
        off = 2 * size * off + off * off + charge * size * size
        power = power @ power
        size = _norms(power)
    return found


def _norms(matrix: Floats) -> Floats:
    """Return upper bounds on the 2-norms of matrices (k, n, m)."""
    flat = matrix.reshape(len(matrix), matrix.shape[1] * matrix.shape[2])
    return np.asarray(np.sqrt(np.einsum("ki,ki->k", flat, flat)) * (1 + 4 * flat.shape[1] * UNIT) + HIDDEN)
