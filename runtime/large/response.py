"""What many sites together answer at a frequency, with a bound on its error in a disc.

Takes: `Transfer`s, and points.
Gives: `Response`, `respond`, `differentiate`.
Guarantees: a response holds in a disc about each point, not only at it, within the bound it comes with:
rounding, the errors of the matrices and the way across the disc included.
Does not: answer nearer to zero than twice `Transfer.inner`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT
from apc.large.transfer import CHUNK, Transfer

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# A pole nearer than the inverse of this is looked at by itself.
CLOSE = 300.0

# Answers computed together: they stay in the cache of a processor.
ANSWERS = 65_536


@dataclass(frozen=True, slots=True)
class Response:
    """T(ζ + h) = `value` + h · `slope`, but for what `doubt` bounds in the disc (z, n_s, n_r)."""

    value: Complexes
    slope: Complexes
    doubt: Floats


def respond(transfers: Sequence[Transfer], points: Complexes, reach: Floats) -> Response:
    """Add up what all sites answer at some points, and bound it in discs about them.

    Parameters
    ----------
    transfers
        The sites, those of a structure together.
    points
        ζ (z,), the centres.
    reach
        The discs' radii ρ (z,).

    Notes
    -----
    1/(ζ + h − p) = q − h q² + h² q²/(ζ + h − p), q = 1/(ζ − p): the last is at most (ρ|q|)² |q|/(1 − ρ|q|).
    """
    shape = (len(points), *transfers[0].series.shape[1:])
    value, slope = np.zeros(shape, np.complex128), np.zeros(shape, np.complex128)
    doubt = np.zeros(shape)
    # Each chunk's sum rounds once a pole, the sum of the chunks once a chunk.
    chunks = sum(1 + one.poles.shape[1] // CHUNK for one in transfers)
    most = max((len(one.poles) * min(CHUNK, one.poles.shape[1]) for one in transfers), default=0)
    rounding = (most + chunks + 16) * 2 * UNIT
    for one in transfers:
        _add_series(one, points, reach, value, slope, doubt)
        for chunk, places in _pieces(one, points):
            at, radius = points[places], reach[places, None, None]
            residues = one.residues[:, chunk].reshape(one.poles[:, chunk].size, shape[1] * shape[2])
            sizes = one.residue_sizes[:, chunk].reshape(residues.shape)
            inverse = 1.0 / (at[:, None, None] - one.poles[:, chunk])
            far, flat = np.abs(inverse), (len(at), -1)
            value[places] += (inverse.reshape(flat) @ residues).reshape(len(at), *shape[1:])
            inverse *= inverse
            slope[places] -= (inverse.reshape(flat) @ residues).reshape(len(at), *shape[1:])
            with np.errstate(divide="ignore", invalid="ignore"):
                moved = radius * far
                near = far / (1 - moved)  # 1/(|ζ − p| − ρ)
                # Negative where a pole is in the disc: nothing is known there.
                lost = near.min(axis=(1, 2), initial=0.0) < 0
                moved *= moved
                moved += 3 * (one.residue_error[chunk] + rounding)  # of the value, and twice of the slope
                moved *= near
                bound = (moved.reshape(flat) @ sizes).reshape(len(at), *shape[1:]) + _reaction(
                    one, chunk, near
                )
            bound[lost] = np.nan
            doubt[places] += bound
    return Response(value, slope, doubt)


def _reaction(one: Transfer, chunk: slice, near: Floats) -> Floats:
    """Return what the errors of a chunk's M do at most (z, n_s, n_r), see `build_transfer`.

    Sites whose poles are all far count all their poles as the nearest; only for the others it matters which.
    """
    nearest = np.maximum(near.max(axis=1, initial=0.0), one.block[chunk])
    close = ~(nearest <= CLOSE)
    nearest[close] = 0.0
    reach = nearest * one.loops[chunk]
    total = (nearest * nearest / np.where(reach < 1, 1 - reach, 0.0)) @ one.together[chunk]
    left, right = one.left[chunk], one.right[chunk]
    total = total.reshape(len(near), left.shape[2], right.shape[2])
    place, site = np.nonzero(close)
    if len(place):
        wide = np.concatenate([near[place, :, site], one.block[chunk][site, None]], axis=1)[:, None, :]
        circle = (wide[:, 0] * one.loop[chunk][site]).sum(axis=1)
        sent = (wide @ left[site])[:, 0] / np.where(circle < 1, 1 - circle, 0.0)[:, None]
        np.add.at(total, place, sent[:, :, None] * (wide @ right[site])[:, 0][:, None, :])
    return np.asarray(total)


def differentiate(transfers: Sequence[Transfer], points: Complexes) -> tuple[Complexes, Complexes]:
    """Return T (z, n_s, n_r) at some points (z,), and dT/dζ."""
    shape = (len(points), *transfers[0].series.shape[1:])
    value, slope = np.zeros(shape, np.complex128), np.zeros(shape, np.complex128)
    for one in transfers:
        exponents = np.arange(len(one.series))
        power = points[:, None] ** -exponents
        value += np.einsum("zj,jsr->zsr", power, one.series)
        slope -= np.einsum("zj,jsr->zsr", power * exponents / points[:, None], one.series)
        for chunk, places in _pieces(one, points):
            at = points[places]
            inverse = (1.0 / (at[:, None, None] - one.poles[:, chunk])).reshape(len(at), -1)
            residues = one.residues[:, chunk].reshape(one.poles[:, chunk].size, shape[1] * shape[2])
            value[places] += (inverse @ residues).reshape(len(at), *shape[1:])
            slope[places] -= ((inverse * inverse) @ residues).reshape(len(at), *shape[1:])
    return value, slope


def _pieces(one: Transfer, points: Complexes) -> Iterator[tuple[slice, slice]]:
    """Yield which sites answer at which points together."""
    count, sites = one.poles.shape
    most = max(1, ANSWERS // max(1, min(sites, CHUNK) * count))
    for start in range(0, sites, CHUNK):
        for place in range(0, len(points), most):
            yield slice(start, start + CHUNK), slice(place, place + most)


def _add_series(
    one: Transfer, points: Complexes, reach: Floats, value: Complexes, slope: Complexes, doubt: Floats
) -> None:
    """Add D and what dies out at once, and their bounds."""
    terms = np.arange(len(one.series))
    power = points[:, None] ** -terms
    value += np.einsum("zj,jsr->zsr", power, one.series)
    slope -= np.einsum("zj,jsr->zsr", power * terms / points[:, None], one.series)
    nearest = np.abs(points) - reach
    nearest = np.where(nearest >= 2 * one.inner, nearest, np.nan)  # too near to zero: nothing is known
    sizes, share = nearest[:, None] ** -terms, (reach / nearest)[:, None]
    rounded = sizes * (1 + terms * share)
    doubt += np.einsum("zj,jsr->zsr", rounded, one.series_errors + 64 * UNIT * one.series_sizes)
    # Taylor's remainder of ζ^−j.
    doubt += np.einsum("zj,jsr->zsr", sizes * share**2 * (terms * (terms + 1) / 2), one.series_sizes)
