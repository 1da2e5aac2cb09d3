"""How far out the eigenvalues of an uncertain matrix can be, whether or not it has a set of eigenvectors.

Takes: square matrices, real or complex, and bounds on what they may be off by.
Gives: `balance`, `pseudospectral_radius`, `norms`.
Guarantees: `pseudospectral_radius` is a bound, rounding included, and finite whenever the matrix is; it does
not ask for diagonalizability.
Does not: find eigenvalues, or the smallest bound there is.

The ε-pseudospectrum holds the eigenvalues of all matrices within ε (in the 2-norm): the z with
‖(z − M)⁻¹‖ ≥ 1/ε (Trefethen and Embree, Spectra and Pseudospectra, 2005, chapter 2).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # float64 or complex128

# Rounding errors charged to each product of matrices, in units of n·UNIT·|A||B|, entry by entry; the
# classical bound is 1 for real and 2√2 for complex matrices (Higham, Accuracy and Stability, 3.6).
PRODUCT_ROUNDINGS = 4

# How many powers' norms are taken one by one, fewer of a matrix so large that they would fill the memory;
# then how many times the last of them is squared.
POWERS, FEWER_POWERS, LARGE = 64, 16, 300
SQUARINGS = 24

# Bounds tried: from the largest, the norm, towards the estimate, each time nearer by this factor.
RADII, STRIDE, NEARER = 224, 16, 2.0**-0.25

# Relative error charged to ‖M^k‖ R^(−k) by way of logarithms: k·|log| below 10¹⁰, times UNIT.
LOGARITHMS = 1e-5

# Sweeps of balancing; chains that nobody answers would go on forever, to no one's use.
SWEEPS = 12


# A norm below it can't be scaled to 1 within the range of floats.
SMALLEST = 2.0**-1000


def norms(stack: Matrix) -> Floats:
    """Return upper bounds on the 2-norms of matrices (…, n, m): the least of Frobenius and √(‖·‖₁‖·‖∞)."""
    size = np.abs(stack)
    if 0 in size.shape[-2:]:
        return np.zeros(size.shape[:-2])
    frobenius = _frobenius(size)
    mixed = np.sqrt(size.sum(axis=-2).max(axis=-1)) * np.sqrt(size.sum(axis=-1).max(axis=-1))
    return np.asarray(np.minimum(frobenius, mixed) * (1 + 4 * sum(size.shape[-2:]) * UNIT))


def balance(size: Floats) -> Floats:
    """Return d, powers of two, that make the rows and columns of D⁻¹ |M| D alike in norm.

    Parameters
    ----------
    size
        Magnitudes |M| (n, n). Where an entry is zero by chance but uncertain, its error should be added: it
        must not grow without limit.

    Notes
    -----
    Parlett and Reinsch's loop (Numerische Mathematik 13, 1969) in the 2-norm, the diagonal left out.
    """
    squared = np.square(size)
    np.fill_diagonal(squared, 0.0)
    scale = np.ones(len(size))
    for _ in range(SWEEPS):
        columns, rows = squared.sum(axis=0), squared.sum(axis=1)
        told = (columns > 0) & (columns < np.inf) & (rows > 0) & (rows < np.inf)
        quarters = np.round(np.log2(rows[told] / columns[told]) / 4)
        unsettled = np.flatnonzero(told)[quarters != 0]
        if not len(unsettled):
            break
        for i in unsettled.tolist():  # one after another, as each changes the sums of others
            column, row = float(squared[:, i].sum()), float(squared[i].sum())
            factor = 2.0 ** round(math.log2(row / column) / 4)
            scale[i] *= factor
            squared[:, i] *= factor * factor
            squared[i] /= factor * factor
    return scale


def pseudospectral_radius(matrix: Matrix, error: float) -> float:
    """Return R such that no matrix within `error` (in the 2-norm) of this one has an eigenvalue beyond R.

    Notes
    -----
    For |z| ≥ R the Neumann series of the resolvent, grouped by K powers, gives

        ‖(z − M)⁻¹‖ ≤ Σ_{k<K} ‖M^k‖ R^(−k−1) / (1 − q),   q = ‖M^K‖ R^(−K) < 1,

    and while that is less than 1/error, z is no eigenvalue. Squaring M^K doubles K and multiplies the sum by
    at most 1 + q. The bound falls with R, so that one R is as good a proof as the whole circle; a chain of
    packets, whose eigenvalues rounding scatters far out, has powers that simply end.
    """
    n = len(matrix)
    if not n:
        return 0.0
    if n == 1:
        return float((abs(matrix[0, 0]) + error) * (1 + 4 * UNIT))
    if n == 2:
        return _radius_of_two(matrix, error)
    largest = float(norms(matrix)) * (1 + UNIT) + error  # no eigenvalue is larger than the norm
    if not 0 < largest < np.inf:
        return largest
    nearest = float(np.abs(np.linalg.eigvals(matrix)).max())
    # A power of two near the estimate keeps the powers within the range of floats.
    unit = 2.0 ** np.ceil(np.log2(max(nearest, largest * 2.0**-8)))
    exponents, logs = _powers(matrix / unit)
    steps = (largest - nearest) * NEARER ** np.arange(RADII)

    def least(radii: Floats) -> float:
        return float(radii[_outside(exponents, logs, radii, unit, error, _base(n))].min(initial=largest))

    # Bounds far apart first, then those between the least that serves and the next, which does not.
    coarse = nearest + steps[::STRIDE]
    place = STRIDE * int((coarse > least(coarse)).sum())
    return min(least(np.append(nearest + steps[place : place + STRIDE], 1.0)), largest)


def _radius_of_two(matrix: Matrix, error: float) -> float:
    """Return the same of two states, in closed form.

    Notes
    -----
    For |z| = r, ‖(z − M)⁻¹‖ ≤ ‖z − M‖ / |det(z − M)| ≤ (√2 r + ‖M‖) / (r² − |tr M| r − |det M|), with norms
    of Frobenius: less than 1/ε beyond the positive root of r² − (|tr M| + √2 ε) r − (|det M| + ε ‖M‖).
    """
    (a, b), (c, d) = matrix.tolist()
    trace, size = abs(a + d), math.hypot(*map(abs, (a, b, c, d)))
    determinant = abs(a * d - b * c) + 8 * UNIT * (abs(a * d) + abs(b * c))
    if (a and d) or (b and c):  # what vanishes of a product is less than the smallest float
        determinant += float(np.finfo(np.float64).tiny)
    linear = trace + 4 * UNIT * (abs(a) + abs(d)) + math.sqrt(2) * error
    root = math.sqrt(linear * linear + 4 * (determinant + error * size))
    return float((linear + root) / 2 * (1 + 16 * UNIT))


def _outside(
    exponents: Floats, logs: Floats, radii: Floats, unit: float, error: float, base: int
) -> NDArray[np.bool_]:
    """Say of each R whether the powers prove that no eigenvalue is beyond it."""
    depth = np.log(radii / unit)[:, None]
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):
        terms = np.exp(logs - exponents * depth) * (1 + LOGARITHMS)
        first, q = terms[:, :base].sum(axis=1) / radii * (1 + 8 * base * UNIT), terms[:, base:]
        bound = first[:, None] * np.cumprod(1 + q, axis=1) / (1 + q) * (1 + LOGARITHMS)
        return np.asarray(((q < 1) & (bound * error < (1 - q) * (1 - LOGARITHMS))).any(axis=1))


def _base(n: int) -> int:
    """Return how many powers of a matrix of order n are taken one by one."""
    return POWERS if n <= LARGE else FEWER_POWERS


def _powers(matrix: Matrix) -> tuple[Floats, Floats]:
    """Return exponents k = 0, 1, … K−1, K, 2K, 4K, … and the logarithms of bounds on ‖M^k‖.

    An error of P ≈ M^i and one of Q ≈ M^j make one of at most ‖ΔP‖‖Q‖ + ‖P‖‖ΔQ‖ + ‖ΔP‖‖ΔQ‖ in P Q, and the
    product adds its roundings, `PRODUCT_ROUNDINGS`·n·UNIT·|P||Q|; `norms` bounds the 2-norm of |P| too.
    """
    n = len(matrix)
    base = _base(n)
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    tiny = n * n * float(np.finfo(np.float64).tiny)  # what underflow hides

    def worse(off: Any, size: Any, other_off: float, other_size: float) -> Any:
        return off * other_size + size * other_off + off * other_off + charge * size * other_size + tiny

    # M, M², then M³ and M⁴ from these, and so on, doubling to the K-th; `off` bounds what each is off by.
    stack = np.array(matrix, ndmin=3)
    size, off = norms(stack), np.zeros(1)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore", under="ignore"):
        while len(stack) < base:
            last, last_size, last_off = stack[-1], float(size[-1]), float(off[-1])
            off = np.append(off, worse(off, size, last_off, last_size))
            further = stack @ last
            stack, size = np.concatenate([stack, further]), np.append(size, norms(further))
        logs = [0.0, *np.log(size + off).tolist()]
        exponents = list(range(base + 1))
        power, power_off, power_size = stack[-1], float(off[-1]), float(size[-1])
        shift = 0.0  # the power is 2^shift times what is kept of it, near 1 so that nothing is lost
        for _ in range(SQUARINGS):
            if not SMALLEST < power_size < np.inf:  # nothing of it is left to square
                break
            step = -round(math.log2(power_size))
            power, power_size, power_off = power * 2.0**step, power_size * 2.0**step, power_off * 2.0**step
            shift = 2 * (shift - step)
            power_off = float(worse(power_off, power_size, power_off, power_size))
            power = power @ power
            power_size = float(norms(power))
            logs.append(float(np.log(power_size + power_off)) + shift * math.log(2.0))
            exponents.append(2 * exponents[-1])
            if not power_off < 1:  # nothing is known any more
                break
        return np.array(exponents, dtype=np.float64), np.array(logs)


def _frobenius(stack: Matrix) -> Floats:
    """Return the Frobenius norms, of entries however small: squares of these would vanish."""
    size = np.abs(stack)
    peak = size.max(axis=(-2, -1), keepdims=True)
    peak = np.where(peak > 0, peak, 1.0)
    return np.asarray(np.sqrt(np.square(size / peak).sum(axis=(-2, -1))) * peak[..., 0, 0])
