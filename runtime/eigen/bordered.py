"""The characteristic polynomial of a loop by a matrix that holds no packet: without poles, for any delay.

Takes: the one-frame maps of the sites of a loop, many at once, and how what they send comes back to them.
Gives: `Wires`, `wires_of`, `side_by_side`; `Bordered`, `bordered`, `Logarithm`, `logarithm`;
`beyond_circle`; `map_balls`, `wire_balls`, `proved_zero`.
Guarantees: `beyond_circle` is right for all maps within the errors given, and a zero lies in the ball of
`proved_zero`.
Does not: know where zeros may be (see `vary.plane`).

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

import flint
import numpy as np
from numpy.typing import NDArray

from apc.eigen.balls import frame_steps, site_balls, weight_balls
from apc.eigen.closing import Coupling, Loop, bounded_weight
from apc.eigen.peer_group import PeerGroup
from apc.eigen.pseudospectrum import PRODUCT_ROUNDINGS
from apc.eigen.winding import FIRST_ARCS, Ball, determinant_ball, wind
from apc.frame.discretize import UNIT
from apc.frame.lift import FrameMap, compose
from apc.frame.schedule import Way

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]
Matrix = NDArray[Any]
Balls = NDArray[Any]  # of flint.arb, and whole numbers

# Newton's steps in balls at most, from a root of floats: each doubles its digits.
NEWTON_STEPS = 6

# Bits of a box that rounding may take.
ROOM = 16

# Multiples of it, whole numbers left out, are spread evenly and favour no symmetry (Weyl).
GOLDEN = (5**0.5 - 1) / 2

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


def beyond_circle(
    maps: FrameMap, errors: FrameMap, wires: Wires, radius: float, close: Complexes
) -> int | None:
    """Return how many zeros F has beyond a circle about 0, None if that can't be told.

    Parameters
    ----------
    maps, errors
        The map of all sites as of one, and what it may be off by.
    wires
        How the sites hear each other.
    radius
        The circle's.
    close
        Zeros (z,) that it passes closely.
    """
    n_s, n_z = maps.s.shape
    unit, place = np.eye(n_s), np.arange(n_z)
    rounding = PRODUCT_ROUNDINGS * (maps.q.shape[1] + 2) * UNIT

    def within(points: Complexes, reach: Floats) -> Ball:
        matrix, slope = np.zeros((2, len(points), n_z + n_s, n_z + n_s), np.complex128)
        doubt = np.zeros(matrix.shape)
        weight, weight_slope = wires.at(points)
        size, off = wires.doubt(points, reach)
        near = size + reach[:, None, None] * np.abs(weight_slope)
        matrix[:, :n_z, :n_z], doubt[:, :n_z, :n_z] = -maps.p, errors.p + UNIT * np.abs(maps.p)
        matrix[:, place, place] += points[:, None]
        doubt[:, place, place] += UNIT * (np.abs(points)[:, None] + np.abs(maps.p[place, place]))
        slope[:, place, place] = 1.0
        matrix[:, n_z:, :n_z], doubt[:, n_z:, :n_z] = -maps.s, errors.s
        for rows, left, error in (
            (slice(n_z), maps.q, errors.q),
            (slice(n_z, None), maps.d, errors.d),
        ):
            matrix[:, rows, n_z:], slope[:, rows, n_z:] = -(left @ weight), -(left @ weight_slope)
            doubt[:, rows, n_z:] = error @ (near + off) + np.abs(left) @ (off + rounding * near)
        matrix[:, n_z:, n_z:] += unit
        doubt[:, n_z:, n_z:] += UNIT * unit
        return determinant_ball(matrix, slope, doubt, reach)

    arcs = max(FIRST_ARCS, 2 * max(wires.lags, default=0))
    with np.errstate(all="ignore"):
        turns = wind(within, 0.0, radius, arcs=arcs, close=close)
    return None if turns is None else n_z - turns


def wire_balls(loop: Loop) -> list[tuple[int, Balls]]:
    """Return the lags of a loop with their W in balls at the present precision."""
    weights = weight_balls(loop)
    sent = np.cumsum([0, *(len(group.schedule.sent) for group in loop.sites)]).tolist()
    lines = sum(len(group.schedule.heard) for group in loop.sites)
    found: dict[int, Balls] = {}
    line = 0
    for g, group in enumerate(loop.sites):
        for heard in group.schedule.heard:
            own = found.setdefault(heard.lag, np.zeros((lines, sent[-1]), dtype=object))
            for h, weight in weights[heard.way][g]:
                own[line, sent[h] + loop.sites[h].schedule.sent.index(heard.sent)] = weight
            line += 1
    return list(found.items())


def map_balls(loop: Loop) -> FrameMap:
    """Return the map of all sites of a loop as of one, in balls at the present precision."""
    pairs = zip(site_balls(loop), loop.sites, strict=True)
    return side_by_side(
        [compose(site, group.schedule, frame_steps(site, group.schedule)) for site, group in pairs]
    )


def proved_zero(maps: FrameMap, wires: Sequence[tuple[int, Balls]], guess: complex) -> Any:
    """Return a ball that a zero of F lies in, about where a root of floats is; None if none is shown.

    Parameters
    ----------
    maps
        The map of all sites as of one, in balls.
    wires
        The lags with their W in balls.
    guess
        Where it is about.

    Notes
    -----
    M(ζ) x = 0 with c x = 1, for u = (x, ζ): Newton's method, then Krawczyk's test. Where
    u − Y G(u) + (1 − Y J(U)) (U − u) lies within a box U about u, U holds a zero of G.
    """
    n = sum(maps.s.shape)
    matrix, _ = _bordered_balls(maps, wires, flint.acb(guess))
    start = flint.acb_mat(n, 1, (np.arange(1, n + 1) * GOLDEN % 1 + 0.5).tolist())
    try:
        vector = matrix.mid().solve(start, algorithm="approx").entries()
        largest = max(range(n), key=lambda row: abs(vector[row]).mid())
        norm = flint.acb_mat(1, n, [1 if row == largest else 0 for row in range(n)])
        at = flint.acb_mat(n + 1, 1, [*((one / vector[largest]).mid() for one in vector), flint.acb(guess)])
        for _ in range(NEWTON_STEPS):
            value, slope = _balanced(maps, wires, norm, at)
            inverse = slope.mid().inv().mid()
            step = inverse * value
            at = (at - step).mid()
        value, _ = _balanced(maps, wires, norm, at)
    except ZeroDivisionError:
        return None
    moved = inverse * value
    least = flint.arb(2) ** (ROOM - flint.ctx.prec)
    wide = max(
        4 * abs(one).upper() + least * (1 + abs(own).upper()) for one, own in zip(moved, at, strict=True)
    )
    box = flint.acb_mat(n + 1, 1, [flint.acb(flint.arb(0, wide), flint.arb(0, wide))] * (n + 1))
    _, slope = _balanced(maps, wires, norm, at + box)
    unit = flint.acb_mat([[int(i == j) for j in range(n + 1)] for i in range(n + 1)])
    image = (unit - inverse * slope) * box - moved
    held = all(bool(one.contains_interior(other)) for one, other in zip(box, image, strict=True))
    return at[n, 0] + image[n, 0] if held else None


def _balanced(maps: FrameMap, wires: Sequence[tuple[int, Balls]], norm: Any, at: Any) -> tuple[Any, Any]:
    """Return G = (M x, c x − 1) at (x, ζ) and its Jacobian."""
    n = norm.ncols()
    rows = at.entries()
    vector = flint.acb_mat(n, 1, rows[:n])
    matrix, slope = _bordered_balls(maps, wires, rows[n])
    value = [*(matrix * vector).entries(), (norm * vector)[0, 0] - 1]
    moved = (slope * vector).entries()
    listed = [[*row, one] for row, one in zip(matrix.tolist(), moved, strict=True)]
    return flint.acb_mat(n + 1, 1, value), flint.acb_mat([*listed, [*norm.entries(), 0]])


def _bordered_balls(maps: FrameMap, wires: Sequence[tuple[int, Balls]], point: Any) -> tuple[Any, Any]:
    """Return M at a ball, and its derivative there."""
    n_s, n_z = maps.s.shape
    q, d = _complex(maps.q), _complex(maps.d)
    weight, slope = flint.acb_mat(q.ncols(), n_s), flint.acb_mat(q.ncols(), n_s)
    for lag, one in wires:
        weight += _complex(one) * point ** (-lag)
        slope += _complex(one) * (-lag * point ** (-lag - 1))
    matrix = [
        [-one for one in left + right]
        for left, right in (
            *zip(_complex(maps.p).tolist(), (q * weight).tolist(), strict=True),
            *zip(_complex(maps.s).tolist(), (d * weight).tolist(), strict=True),
        )
    ]
    moved = [
        [flint.acb(0)] * n_z + [-one for one in row] for row in (*(q * slope).tolist(), *(d * slope).tolist())
    ]
    for place in range(n_z + n_s):
        matrix[place][place] += point if place < n_z else 1
        moved[place][place] += 1 if place < n_z else 0
    return flint.acb_mat(matrix), flint.acb_mat(moved)


def _complex(balls: Balls) -> Any:
    return flint.acb_mat(len(balls), balls.shape[1], [flint.acb(entry) for entry in balls.ravel().tolist()])
