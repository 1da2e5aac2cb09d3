"""The characteristic polynomial of a loop by a matrix that holds no packet: without poles, for any delay.

Takes: the one-frame maps of the sites of a loop, many at once, and how what they send comes back to them.
Gives: `wires_of`, `side_by_side`; `Bordered`, `bordered`, `Logarithm`, `logarithm`.
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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import Coupling, bounded_weight
from apc.eigen.peers import PeerGroup
from apc.frame.lift import FrameMap
from apc.frame.schedule import Way
from apc.threads import load_pool

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]
Matrix = NDArray[Any]


# Entries of the matrices that are looked at together: they stay in the cache of a processor.
TOGETHER = 1 << 17


def wires_of(
    sites: Sequence[PeerGroup], coupling: Coupling, doubts: Mapping[Way, float]
) -> tuple[tuple[int, ...], Floats, Floats]:
    """Return how what the sites of a loop send comes back to them, r = Σ_l W_l ζ^(−l) s.

    Parameters
    ----------
    sites
        The K sites.
    coupling
        What each hears of each, W (K, K) by way.
    doubts
        By how much each entry of a way's W may be off, where it isn't exact.

    Returns
    -------
    The lags l, the weights W_l (l, n_r, n_s), and what these may be off by.
    """
    sent_starts = np.cumsum([0, *(len(group.schedule.sent) for group in sites)])
    heard_starts = np.cumsum([0, *(len(group.schedule.heard) for group in sites)])
    lags = sorted({heard.lag for group in sites for heard in group.schedule.heard})
    weights = np.zeros((2, len(lags), int(heard_starts[-1]), int(sent_starts[-1])))
    for g, group in enumerate(sites):
        for line, heard in enumerate(group.schedule.heard):
            for h, sender in enumerate(sites):
                if heard.sent in sender.schedule.sent:
                    row = sent_starts[h] + sender.schedule.sent.index(heard.sent)
                    known = bounded_weight(coupling[heard.way][g][h], doubts.get(heard.way, 0.0))
                    weights[:, lags.index(heard.lag), heard_starts[g] + line, row] = known
    return tuple(lags), *weights


def side_by_side(maps: Sequence[FrameMap]) -> FrameMap:
    """Return the map of all sites as of one."""
    block_diag = load_pool("scipy.linalg").block_diag
    return FrameMap(*(block_diag(*blocks) for blocks in zip(*(one.blocks for one in maps), strict=True)))


@dataclass(frozen=True, slots=True, eq=False)
class Bordered:
    """M(ζ) = ζ E + C + Σ_l ζ^(−l) C_l of many loops, E the unit matrix over z alone.

    `fixed` (n, n) is C, that of all loops, `heard` (l, k, n, n_s) the last columns of C_l, which has no
    others; `states` says how many rows z has.
    """

    fixed: Floats
    heard: Floats
    states: int


def bordered(maps: FrameMap, weights: Floats) -> Bordered:
    """Return the matrices of many loops.

    Parameters
    ----------
    maps
        The map of all sites as of one.
    weights
        W_l of each loop (l, k, n_r, n_s).
    """
    fixed = np.block([[-maps.p, np.zeros((len(maps.p), len(maps.s)))], [-maps.s, np.eye(len(maps.s))]])
    return Bordered(fixed, -(np.concatenate([maps.q, maps.d]) @ weights), len(maps.p))


@dataclass(frozen=True, slots=True, eq=False)
class Logarithm:
    """log F (z,) at points, and its derivative over the angle."""

    value: Complexes
    turning: Complexes


def logarithm(loops: Bordered, lags: Integers, rows: Integers, points: Complexes, rigid: int) -> Logarithm:
    """Return the logarithm of F at points, its `rigid` zeros at 1 divided out.

    Parameters
    ----------
    loops
        The matrices of many loops.
    lags
        The l of each point (z, l).
    rows, points
        Of which loop (z,), and ζ there.
    rigid
        How often 1 is an eigenvalue of all.

    Notes
    -----
    d log det M = tr(M⁻¹ dM).
    """
    n_z, n = loops.states, loops.fixed.shape[-1]
    value, turning = np.full((2, len(rows)), np.nan, np.complex128)
    place = np.arange(n_z)
    chunk = max(1, TOGETHER // max(n, 1) ** 2)
    for start in range(0, len(rows), chunk):
        some = slice(start, start + chunk)
        row, at, exponents = rows[some], points[some], lags[some].T
        powers = [at**-lag for lag in exponents]
        matrix = np.repeat(loops.fixed[None].astype(np.complex128), len(at), axis=0)
        matrix[:, place, place] += at[:, None]
        for power, heard in zip(powers, loops.heard, strict=True):
            matrix[:, :, n_z:] += power[:, None, None] * heard[row]
        sign, size = np.linalg.slogdet(matrix)
        good = np.isfinite(size)
        matrix[~good] = np.eye(n)
        inverse = np.linalg.inv(matrix).swapaxes(1, 2)
        turn = at * inverse[:, place, place].sum(axis=1)
        for lag, power, heard in zip(exponents, powers, loops.heard, strict=True):
            turn -= lag * power * np.einsum("zij,zij->z", inverse[:, :, n_z:], heard[row])
        with np.errstate(all="ignore"):
            value[some] = np.where(good, size + 1j * np.angle(sign) - rigid * np.log(1 - 1 / at), np.nan)
            turning[some] = 1j * (turn - rigid / (at - 1))
    return Logarithm(value, turning)
