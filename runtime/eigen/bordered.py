"""The characteristic polynomial of a loop by a matrix that holds no packet: without poles, for any delay.

Takes: the one-frame maps of the sites of a loop, many at once, and how what they send comes back to them.
Gives: `Wires`, `wires_of`, `side_by_side`; `Bordered`, `bordered`, `Logarithm`, `logarithm`.
Guarantees: the logarithm is finite wherever the function is not 0, however long the delays.
Does not: know where zeros may be (see `vary.encirclements`).

    F(ζ) = det [ζ − P   −Q W(ζ)]        W(ζ) = Σ_l W_l ζ^(−l)
               [ −S    1 − D W(ζ)]

z⁺ = P z + Q r and s = S z + D r are the frames of all sites, r = W s what they hear of each other, packets of
l frames ago with ζ^(−l). The characteristic polynomial of the closed loop is F times ζ to the number of
packets on their way: on the unit circle they have the same zeros, and F goes around 0 as often, less that
number.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import Coupling, bounded_weight
from apc.eigen.peer_group import PeerGroup
from apc.frame.discretize import UNIT
from apc.frame.lift import FrameMap
from apc.frame.schedule import Way

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]
Matrix = NDArray[Any]


# Entries of the matrices that are looked at together: they stay in the cache of a processor.
TOGETHER = 1 << 17


@dataclass(frozen=True, slots=True, eq=False)
class Wires:
    """How what all sites send comes back to them: r = Σ_l W_l ζ^(−l) s.

    `weights` (l, n_r, n_s) are W_l, right to `errors`, and `lags` the l.
    """

    lags: tuple[int, ...]
    weights: Floats
    errors: Floats

    def at(self, points: Complexes) -> tuple[Complexes, Complexes]:
        """Return W (z, n_r, n_s) at points, and dW/dζ."""
        lags = np.array(self.lags)
        powers = points[:, None] ** -lags
        flat = self.weights.reshape(len(lags), -1).astype(np.complex128)
        shape = (len(points), *self.weights.shape[1:])
        slopes = (-lags * powers / points[:, None]) @ flat
        return (powers @ flat).reshape(shape), slopes.reshape(shape)

    def doubt(self, points: Complexes, reach: Floats) -> tuple[Floats, Floats]:
        """Return a bound on |W| at points, and what W in discs may be off by from value and slope there."""
        lags = np.array(self.lags)
        # Taylor's remainder of ζ^−l; a power by way of logarithms loses a rounding a turn.
        near = np.maximum(np.abs(points) - reach, np.finfo(np.float64).tiny)[:, None]
        share, largest = reach[:, None] / near, near**-lags
        wander = largest * (share**2 * lags * (lags + 1) / 2 + (1 + lags * share) * (16 + 8 * lags) * UNIT)
        doubt = np.einsum("zl,lrs->zrs", wander, np.abs(self.weights))
        doubt += np.einsum("zl,lrs->zrs", largest, self.errors)
        return np.einsum("zl,lrs->zrs", np.abs(points[:, None]) ** -lags, np.abs(self.weights)), doubt


def wires_of(
    sites: Sequence[PeerGroup],
    coupling: Coupling,
    doubts: Mapping[Way, float],
    *,
    only: Callable[[Way], bool] = lambda way: True,
) -> Wires:
    """Return how the sites of a loop hear each other.

    Parameters
    ----------
    sites
        The K sites.
    coupling
        What each hears of each, W (K, K) by way.
    doubts
        By how much each entry of a way's W may be off, where it isn't exact.
    only
        Which ways count.
    """
    sent_starts = np.cumsum([0, *(len(group.schedule.sent) for group in sites)])
    heard_starts = np.cumsum([0, *(len(group.schedule.heard) for group in sites)])
    lags = sorted({heard.lag for group in sites for heard in group.schedule.heard if only(heard.way)})
    weights = np.zeros((2, len(lags), int(heard_starts[-1]), int(sent_starts[-1])))
    for g, group in enumerate(sites):
        for line, heard in enumerate(group.schedule.heard):
            if not only(heard.way):
                continue
            layer = lags.index(heard.lag)
            for h, sender in enumerate(sites):
                weight = coupling[heard.way][g][h]
                if heard.sent in sender.schedule.sent:
                    row = sent_starts[h] + sender.schedule.sent.index(heard.sent)
                    known = bounded_weight(weight, doubts.get(heard.way, 0.0))
                    weights[:, layer, heard_starts[g] + line, row] = known
    return Wires(tuple(lags), *weights)


def side_by_side(maps: Sequence[FrameMap]) -> FrameMap:
    """Return the map of all sites as of one, of many with a leading axis (k)."""

    def diagonal(blocks: Sequence[Matrix]) -> Matrix:
        rows, columns = (np.cumsum([0, *(one.shape[axis] for one in blocks)]) for axis in (-2, -1))
        many = np.broadcast_shapes(*(one.shape[:-2] for one in blocks))
        found = np.zeros((*many, rows[-1], columns[-1]), dtype=np.result_type(*blocks))
        for place, one in enumerate(blocks):
            found[..., rows[place] : rows[place + 1], columns[place] : columns[place + 1]] = one
        return found

    if len(maps) == 1:
        return FrameMap(*maps[0].blocks)
    return FrameMap(*(diagonal(blocks) for blocks in zip(*(one.blocks for one in maps), strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class Bordered:
    """M(ζ) = ζ E + C + Σ_l ζ^(−l) C_l of many loops, E the unit matrix over z alone.

    `fixed` (k, n, n) is C, `heard` (l, k, n, n_s) the last columns of C_l, which has no others; `states` says
    how many rows z has.
    """

    fixed: Floats
    heard: Floats
    states: int


def bordered(maps: FrameMap, weights: Floats, unit: float = 1.0) -> Bordered:
    """Return the matrices of many loops, or with `unit` 0 the derivatives of them.

    Parameters
    ----------
    maps
        The maps (k, …) of all sites as of one, or their derivatives.
    weights
        W_l (l, n_r, n_s), or those of each loop (l, k, n_r, n_s).
    unit
        What stands for 1.
    """
    weights = weights if weights.ndim > 3 else weights[:, None]
    n_s, n_z = maps.s.shape[-2:]
    count = max(len(maps.s), weights.shape[1])
    fixed = np.zeros((count, n_z + n_s, n_z + n_s))
    fixed[:, :n_z, :n_z], fixed[:, n_z:, :n_z] = -maps.p, -maps.s
    fixed[:, n_z:, n_z:] = unit * np.eye(n_s)
    back = np.concatenate([maps.q, maps.d], axis=-2)
    return Bordered(fixed, -(back @ weights), n_z)


@dataclass(frozen=True, slots=True, eq=False)
class Logarithm:
    """log F (z,) at points, its derivative over the angle and that over what varies in the maps."""

    value: Complexes
    turning: Complexes
    moving: Complexes


def logarithm(
    loops: Bordered, slopes: Bordered | None, lags: Integers, rows: Integers, points: Complexes, rigid: int
) -> Logarithm:
    """Return the logarithm of F at points, its `rigid` zeros at 1 divided out.

    Parameters
    ----------
    loops, slopes
        The matrices of many loops, and their derivatives over what varies, None for nothing.
    lags
        The l of all points, or of each (z, l).
    rows, points
        Of which loop (z,), and ζ there.
    rigid
        How often 1 is an eigenvalue of all.

    Notes
    -----
    d log det M = tr(M⁻¹ dM).
    """
    n_z, n = loops.states, loops.fixed.shape[-1]
    value, turning, moving = np.full((3, len(rows)), np.nan, np.complex128)
    place = np.arange(n_z)
    chunk = max(1, TOGETHER // n**2)
    for start in range(0, len(rows), chunk):
        some = slice(start, start + chunk)
        row, at = rows[some], points[some]
        exponents = np.broadcast_to(lags, (len(rows), lags.shape[-1]))[some].T
        powers = [at**-lag for lag in exponents]
        matrix = loops.fixed[row].astype(np.complex128)
        matrix[:, place, place] += at[:, None]
        for power, heard in zip(powers, loops.heard, strict=True):
            matrix[:, :, n_z:] += power[:, None, None] * heard[row]
        sign, size = np.linalg.slogdet(matrix)
        good = np.isfinite(size)
        matrix[~good] = np.eye(n)
        inverse = np.linalg.inv(matrix).swapaxes(1, 2)
        turn = at * inverse[:, place, place].sum(axis=1)
        for lag, power, heard in zip(exponents, powers, loops.heard, strict=True):
            turn -= lag * power * _product(inverse[:, :, n_z:], heard[row])
        move = np.zeros(len(at), np.complex128)
        if slopes is not None:
            move += _product(inverse, slopes.fixed[row])
            for power, slope in zip(powers, slopes.heard, strict=True):
                move += power * _product(inverse[:, :, n_z:], slope[row])
        with np.errstate(all="ignore"):
            value[some] = np.where(good, size + 1j * np.angle(sign) - rigid * np.log(1 - 1 / at), np.nan)
            turning[some] = 1j * (turn - rigid / (at - 1))
            moving[some] = move
    return Logarithm(value, turning, moving)


def _product(one: Matrix, other: Floats) -> Matrix:
    """Return the sums of matrices' products entry by entry (z,)."""
    return np.asarray(np.einsum("zij,zij->z", one, other))
