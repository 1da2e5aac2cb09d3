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

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # float64 or complex128

# Rounding errors charged to each product of matrices, in units of n·UNIT·|A||B|, entry by entry; the
# classical bound is 1 for real and 2√2 for complex matrices (Higham, Accuracy and Stability, 3.6).
PRODUCT_ROUNDINGS = 4

# How many powers of a matrix are taken one by one, and how often the last of them is squared at most: what is
# smaller than 1 by 1e-6 has vanished by then.
POWERS, SQUARINGS = 8, 23

# Bounds tried: from the largest, the norm, towards the estimate, each time nearer by this factor.
RADII, NEARER = 224, 2.0**-0.25

# Relative error charged to ‖M^k‖ R^(−k) by way of logarithms: k·|log| below 10¹⁰, times UNIT.
LOGARITHMS = 1e-5

# Sweeps of balancing: after twice as many the bounds are hardly less.
SWEEPS = 8


def norms(stack: Matrix) -> Floats:
    """Return upper bounds on the 2-norms of matrices (…, n, m): the least of Frobenius and √(‖·‖₁‖·‖∞)."""
    size = np.abs(stack)
    if 0 in size.shape[-2:]:
        return np.zeros(size.shape[:-2])
    peak = size.max(axis=(-2, -1), keepdims=True)  # relative to it no square is lost
    peak = np.where(peak > 0, peak, 1.0)
    frobenius = np.sqrt(np.square(size / peak).sum(axis=(-2, -1))) * peak[..., 0, 0]
    mixed = np.sqrt(size.sum(axis=-2).max(axis=-1)) * np.sqrt(size.sum(axis=-1).max(axis=-1))
    return np.asarray(np.minimum(frobenius, mixed) * (1 + 4 * sum(size.shape[-2:]) * UNIT))


def balance(size: Floats) -> Floats:
    """Return d (…, n), powers of two, that make rows and columns of D⁻¹ |M| D about alike in norm.

    Parameters
    ----------
    size
        Magnitudes |M| (…, n, n). Where an entry is zero by chance but uncertain, its error should be added:
        it must not grow without limit.

    Notes
    -----
    As Parlett and Reinsch (Numerische Mathematik 13, 1969) in the 2-norm, the diagonal left out; of all
    states at once, so that each goes half-way, as those beside it go as well.
    """
    with np.errstate(all="ignore"):
        squared = np.where(np.eye(size.shape[-1], dtype=np.bool_), 0.0, np.square(size))
        turned = squared.swapaxes(-1, -2)
        scale = np.ones((*size.shape[:-1], 1))  # squared
        free = (squared @ scale > 0) & (turned @ scale > 0)
        for _ in range(SWEEPS):
            step = (squared @ scale) / (turned @ (1 / scale))  # rows by columns, times the scale squared
            scale *= np.where(free, np.sqrt(np.sqrt(step) / scale), 1.0)
        exponents = np.log2(scale[..., 0]) / 2
        return np.asarray(np.exp2(np.round(np.where(np.isfinite(exponents), exponents, 0.0))))


def pseudospectral_radius(matrix: Matrix, error: Floats, nearest: Floats) -> Floats:
    """Return R (k,) such that no matrix within an error (in the 2-norm) has an eigenvalue beyond R.

    Parameters
    ----------
    matrix
        The matrices (k, n, n).
    error
        How far the others may be from each (k,).
    nearest
        About how large the largest eigenvalue of each is (k,): bounds are tried near it.

    Notes
    -----
    For |z| ≥ R the Neumann series of the resolvent, grouped by K powers, gives

        ‖(z − M)⁻¹‖ ≤ Σ_{k<K} ‖M^k‖ R^(−k−1) / (1 − q),   q = ‖M^K‖ R^(−K) < 1,

    and while that is less than 1/error, z is no eigenvalue. Squaring M^K doubles K and multiplies the sum by
    at most 1 + q. The bound falls with R, so that one R is as good a proof as the whole circle; a chain of
    packets, whose eigenvalues rounding scatters far out, has powers that simply end.
    """
    largest = norms(matrix) * (1 + UNIT) + error  # no eigenvalue is larger than the norm
    logs = _power_norms(matrix)
    radii = nearest[:, None] + np.maximum(largest - nearest, 0.0)[:, None] * NEARER ** np.arange(RADII)
    with np.errstate(all="ignore"):
        exponents = np.array([*range(1, POWERS), *(POWERS * 2**j for j in range(SQUARINGS))])
        depth = exponents[: logs.shape[-1]] * np.log(radii)[..., None]
        terms = np.exp(logs[:, None] - depth) * (1 + LOGARITHMS)
        first, share = 1 + terms[..., : POWERS - 1].sum(axis=-1), terms[..., POWERS - 1 :]
        bound = (first / radii)[..., None] * np.cumprod(1 + share, axis=-1) / (1 + share) * (1 + LOGARITHMS)
        proved = (share < 1) & (bound * error[:, None, None] < (1 - share) * (1 - LOGARITHMS))
    least = np.where(proved.any(axis=-1), radii, np.inf).min(axis=-1)
    return np.asarray(np.minimum(least, largest))


def _power_norms(matrix: Matrix) -> Floats:
    """Return the logarithms of bounds on ‖M^k‖ for k = 1, 2, … K, 2K, 4K, … (k, m).

    An error of P ≈ M^i and one of Q ≈ M^j make one of at most ‖ΔP‖‖Q‖ + ‖P‖‖ΔQ‖ + ‖ΔP‖‖ΔQ‖ in P Q, and the
    product adds its roundings.
    """
    n = matrix.shape[-1]
    charge, tiny = PRODUCT_ROUNDINGS * (n + 2) * UNIT, n * n * float(np.finfo(np.float64).tiny)
    found: list[tuple[Matrix, Floats, Floats, Floats]] = []
    with np.errstate(all="ignore"):
        for step in range(1, POWERS + SQUARINGS):
            if step == 1:
                power, off, shift = matrix, np.zeros(len(matrix)), np.zeros(len(matrix))
            else:
                factors = (step // 2 - 1, step - step // 2 - 1) if step <= POWERS else (-1, -1)
                (one, one_off, one_size, one_shift), (two, two_off, two_size, two_shift) = (
                    found[place] for place in factors
                )
                power, shift = one @ two, one_shift + two_shift
                off = one_off * two_size + one_size * two_off + one_off * two_off
                off += charge * one_size * two_size + tiny
            # The power is e^shift times what stands for it, near 1 so that nothing is lost.
            size = norms(power)
            unit = np.exp2(np.round(np.log2(np.where(size > 0, size, 1.0))))
            found.append((power / unit[:, None, None], off / unit, size / unit, shift + np.log(unit)))
        return np.stack([np.log(size + off) + shift for _, off, size, shift in found], axis=-1)
