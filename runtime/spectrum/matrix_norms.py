"""Bounds on matrix norms, and balancing of rows and columns.

Takes: matrices, real or complex.
Gives: `norms`, `balance`; `PRODUCT_ROUNDINGS`.
Guarantees: a norm is a bound, rounding included; scales are powers of two, which round nothing.
Does not: compute the smallest bound.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # float64 or complex128

# Rounding errors charged to each product of matrices, in units of n·UNIT·|A||B|, entry by entry; the
# classical bound is 1 for real and 2√2 for complex matrices (Higham, Accuracy and Stability, 3.6).
PRODUCT_ROUNDINGS = 4

# Sweeps of balancing: twice as many hardly reduce the bounds.
SWEEPS = 8


def norms(stack: Matrix) -> Floats:
    """Return upper bounds on the 2-norms of matrices (…, n, m): the smaller of Frobenius norm and
    √(‖·‖₁‖·‖∞).
    """
    size = np.abs(stack)
    if 0 in size.shape[-2:]:
        return np.zeros(size.shape[:-2])
    peak = size.max(axis=(-2, -1), keepdims=True)  # relative to it no square underflows
    peak = np.where(peak > 0, peak, 1.0)
    frobenius = np.sqrt(np.square(size / peak).sum(axis=(-2, -1))) * peak[..., 0, 0]
    mixed = np.sqrt(size.sum(axis=-2).max(axis=-1)) * np.sqrt(size.sum(axis=-1).max(axis=-1))
    return np.asarray(np.minimum(frobenius, mixed) * (1 + 4 * sum(size.shape[-2:]) * UNIT_ROUNDOFF))


def balance(size: Floats) -> Floats:
    """Return d (…, n), powers of two, for nearly equal row and column norms of D⁻¹ |M| D.

    Parameters
    ----------
    size
        Magnitudes |M| (…, n, n). The error of an uncertain entry should be added, so that an entry that is
        zero by chance does not grow without limit.

    Notes
    -----
    As Parlett and Reinsch (Numerische Mathematik 13, 1969) in the 2-norm, without the diagonal; for all
    states simultaneously, so that each takes half a step.
    """
    with np.errstate(all="ignore"):
        squared = np.where(np.eye(size.shape[-1], dtype=np.bool_), 0.0, np.square(size))
        transposed = squared.swapaxes(-1, -2)
        scale = np.ones((*size.shape[:-1], 1))  # squared
        is_scaled = (squared @ scale > 0) & (transposed @ scale > 0)
        for _ in range(SWEEPS):
            step = (squared @ scale) / (transposed @ (1 / scale))  # rows by columns, times the scale squared
            scale *= np.where(is_scaled, np.sqrt(np.sqrt(step) / scale), 1.0)
        exponents = np.log2(scale[..., 0]) / 2
        return np.asarray(np.exp2(np.round(np.where(np.isfinite(exponents), exponents, 0.0))))
