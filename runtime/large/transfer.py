"""What many sites together answer: their poles and residues, and their sum at a frequency, with bounds.

Takes: the maps x⁺ = P x + Q r, s = S x + D r of many sites, what these may be off by, and how often each
site counts; points.
Gives: `Transfer`, `build_transfer`; `Response`, `respond`, `differentiate`.
Guarantees: the errors hold all that rounding does, and those of the matrices. A response holds in a disc
about each point, not only at it.
Does not: answer nearer to zero than twice `Transfer.inner`.

    T(ζ) = Σ_i n_i (D_i + S_i (ζ − P_i)⁻¹ Q_i)

Each P_i is split, X⁻¹ P X = diag(p_1, …, p_K, T₂): the eigenvalues beyond `inner` one by one, and all that
is smaller, queues running empty and the like, as one block that may be defective. The block's part is a
short power series of 1/ζ, added up over all sites before any ζ is known.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.norms import PRODUCT_ROUNDINGS, balance
from apc.frame.discretize import UNIT
from apc.frame.lift import BoundedMap, FrameMap
from apc.large.diagonal import block_diagonal, block_norms, block_norms_along, block_resolvent

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Eigenvalues within this share of the largest go into the block; at twice that distance from zero its series
# gains a bit a term, (inner/|ζ|)^k < 2^−k.
INNER = 0.3

# Terms of the block's power series: at twice `inner`, 2^−64 of the first is left. It is cut where what is
# left is this share of a rounding. So many terms, two to this power, are had by one product: of matrices so
# small, it takes no longer than one term.
SERIES, CUT = 64, 2.0**-7
DOUBLINGS = 2

# What residues may be off by, relatively, before those that should be nothing count as larger.
FINE = 1e-9

# Sites worked on together: they stay in the cache of a processor.
CHUNK = 1024


@dataclass(frozen=True, slots=True, eq=False)
class Transfer:
    """Sites of one structure by their poles, k sites of at most K poles beyond `inner`.

    `eigenvalues` (k, n) are all of each site, `eigenvalue_errors` what they may be off by; `counts` (k,) how
    often each site is there. The rest is what `respond` adds up, multiplicities included: a place beyond a
    site's poles has the pole 0 and nothing on it.
    """

    inner: float
    counts: Floats
    eigenvalues: Complexes  # (k, n), the K largest first
    eigenvalue_errors: Floats
    poles: Complexes  # (K, k)
    residues: Complexes  # (K, k, n_s · n_r)
    residue_sizes: Floats
    residue_error: Floats  # (k,): what they may be off by, relative to their sizes, which are bounds for it
    block: Floats  # (k,): a bound on ‖(ζ − T₂)⁻¹‖ from twice `inner` on
    loop: Floats  # (k, K + 1): u w, see `build_transfer`; the block last
    left: Floats  # (k, K + 1, n_s): |S X| u
    right: Floats  # (k, K + 1, n_r): w |Y Q|
    together: Floats  # (k, n_s · n_r): what an error of P does where every |ζ − p_k| = 1
    loops: Floats  # (k,): Σ u w
    series: Floats  # (up to 1 + SERIES, n_s, n_r): D, then ζ⁻¹, ζ⁻², …
    series_sizes: Floats
    series_errors: Floats


def build_transfer(maps: BoundedMap, counts: Floats) -> Transfer:
    """Split every site into its poles and a block of what dies out at once.

    Parameters
    ----------
    maps
        Those of the k sites (k, …).
    counts
        How often each is there (k,).

    Notes
    -----
    With computed X and Y ≈ X⁻¹, P + E = X (Λ + Δ) X⁻¹ holds for some |Δ| ≤ |X⁻¹| (|P X − X Λ| + |E| |X|). A
    majorant of rank one, Δ_kl ≤ u_k w_l, makes the Neumann series of (ζ − Λ − Δ)⁻¹ a geometric one: what it
    changes is at most (Σ_k |S X|_k u_k/|ζ − p_k|) (Σ_l w_l |Y Q|_l/|ζ − p_l|) / (1 − Σ_k u_k w_k/|ζ − p_k|).
    """
    sites, n = maps.p.shape[:2]
    scale = balance(np.max(np.abs(maps.p) + maps.error.p, axis=0))
    values, vectors = np.empty((sites, n), np.complex128), np.empty((sites, n, n), np.complex128)
    for place in _chunks(np.arange(sites)):
        own, right = np.linalg.eig(maps.p[place] / scale[:, None] * scale)
        order = np.argsort(-np.abs(own), axis=1, kind="stable")
        values[place] = np.take_along_axis(own, order, axis=1)
        vectors[place] = np.take_along_axis(right, order[:, None, :], axis=2)
    inner = INNER * min(1.0, float(np.abs(values).max(initial=0.0))) or INNER
    return _gathered(maps, scale, counts, values, vectors, inner)


def _gathered(
    maps: BoundedMap, scale: Floats, counts: Floats, values: Complexes, vectors: Complexes, inner: float
) -> Transfer:
    """Split the sites, those of equally many poles together, and put the parts side by side."""
    sites, n = values.shape
    n_s, n_r = maps.d.shape[1:]
    large = (np.abs(values) > inner).sum(axis=1)
    most = int(large.max(initial=0))
    errors = np.full((sites, n), np.inf)
    poles = np.zeros((most, sites), np.complex128)
    residues = np.zeros((most, sites, n_s * n_r), np.complex128)
    sizes = np.zeros(residues.shape)
    doubt, block = np.zeros(sites), np.zeros(sites)
    loop = np.zeros((sites, most + 1))
    left, right = np.zeros((sites, most + 1, n_s)), np.zeros((sites, most + 1, n_r))
    series = np.zeros((3, 1 + SERIES, n_s, n_r))
    series[0, 0] += np.tensordot(counts, maps.d, 1)
    series[1, 0] += np.tensordot(counts, np.abs(maps.d), 1)
    series[2, 0] += np.tensordot(counts, maps.error.d, 1)
    for count in np.unique(large).tolist():
        for place in _chunks(np.flatnonzero(large == count)):
            own = _balanced(maps, place, scale)
            part = _split(own, counts[place], values[place], vectors[place], count, inner)
            poles[:count, place] = values[place, :count].T
            residues[:count, place] = (counts[place, None, None] * part.residues).swapaxes(0, 1)
            sizes[:count, place] = (counts[place, None, None] * part.sizes).swapaxes(0, 1)
            kept = [*range(count), most]  # the block comes last
            left[np.ix_(place, kept)] = counts[place, None, None] * part.left
            right[np.ix_(place, kept)], loop[np.ix_(place, kept)] = part.right, part.loop
            doubt[place], block[place] = part.doubt, part.block
            errors[place] = part.errors
            series += part.series
    used = max(1, 1 + int(np.flatnonzero(series.any(axis=(0, 2, 3))).max(initial=0)))
    series = series[:, :used].copy()  # a view would keep all terms
    return Transfer(
        inner=inner,
        counts=counts,
        eigenvalues=values,
        eigenvalue_errors=errors,
        poles=poles,
        residues=residues,
        residue_sizes=sizes,
        residue_error=doubt,
        block=block,
        loop=loop,
        left=left,
        right=right,
        together=(left.sum(axis=1)[:, :, None] * right.sum(axis=1)[:, None, :]).reshape(sites, n_s * n_r),
        loops=loop.sum(axis=1),
        series=series[0],
        series_sizes=series[1],
        series_errors=series[2],
    )


def _balanced(maps: BoundedMap, place: NDArray[np.intp], scale: Floats) -> BoundedMap:
    """Return some sites over states in other units, powers of two so that nothing is rounded."""
    inverse = (1.0 / scale)[:, None]

    def balanced(one: FrameMap) -> FrameMap:
        p, q = one.p[place] * inverse * scale, one.q[place] * inverse
        return FrameMap(p, q, one.s[place] * scale, one.d[place])

    return BoundedMap(*balanced(maps).blocks, balanced(maps.error))


def _chunks(places: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Cut places into chunks."""
    for start in range(0, len(places), CHUNK):
        yield places[start : start + CHUNK]


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """A chunk of sites of equally many poles; the fields as in `Transfer`, each site counted once.

    But for `series` (3, 1 + SERIES, n_s, n_r): its terms, their sizes and errors, of all sites together.
    """

    residues: Complexes
    sizes: Floats
    doubt: Floats
    block: Floats
    loop: Floats
    left: Floats
    right: Floats
    errors: Floats
    series: Floats


def _split(
    maps: BoundedMap, counts: Floats, values: Complexes, vectors: Complexes, large: int, inner: float
) -> _Parts:
    """Split sites that all have `large` poles beyond `inner`."""
    sites, n = values.shape
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    found = block_diagonal(maps.p, maps.error.p, values, vectors, large)
    basis, dual, small, change, grown = found.basis, found.dual, found.small, found.change, found.grown
    weight, size = np.abs(dual), np.abs(basis)

    a, b = maps.s @ basis, dual @ maps.q
    a_doubt = (maps.error.s + charge * np.abs(maps.s)) @ size
    b_doubt = weight @ (maps.error.q * grown + charge * np.abs(maps.q))
    b_doubt += (grown - 1) * np.abs(b).max(axis=1, keepdims=True)
    a_size, b_size = np.abs(a), np.abs(b)
    residues = a[:, :, :large].swapaxes(1, 2)[..., None] * b[:, :large, None, :]
    product = (a_size + a_doubt).swapaxes(1, 2)[:, :large, :, None] * (b_size + b_doubt)[:, :large, None, :]
    exact = np.abs(residues)
    off = np.maximum(product - exact, 0.0) + 8 * UNIT * product
    # Relative to each residue. One that should be nothing is off by something all the same: where that would
    # spoil the others, it counts as large as its error says.
    least = UNIT * product.max(axis=(1, 2, 3), initial=0.0) + np.finfo(np.float64).tiny
    doubt = (off / np.maximum(exact, least[:, None, None, None])).max(axis=(1, 2, 3), initial=0.0)
    whole = off.max(axis=(1, 2, 3), initial=0.0) / np.maximum(exact.max(axis=(1, 2, 3), initial=0.0), least)
    doubt = np.minimum(doubt, np.maximum(whole, FINE))
    sizes = np.maximum(
        exact, (1 + 8 * UNIT) * off / np.maximum(doubt, np.finfo(np.float64).tiny)[:, None, None, None]
    )

    u, w = _rank_one(block_norms(change, large))
    left = block_norms_along(a_size + a_doubt, large) * u[:, None, :]
    right = block_norms_along((b_size + b_doubt).swapaxes(1, 2), large) * w[:, None, :]
    errors = np.repeat(u[:, -1:] * w[:, -1:], n, axis=1)
    errors[:, :large] = _disc_radii(values[:, :large], u * w, inner)
    block = block_resolvent(small, 2 * inner)
    return _Parts(
        residues=residues.reshape(sites, large, a.shape[1] * b.shape[2]),
        sizes=sizes.reshape(sites, large, a.shape[1] * b.shape[2]),
        doubt=doubt,
        block=block,
        loop=u * w,
        left=left.swapaxes(1, 2),
        right=right.swapaxes(1, 2),
        errors=errors,
        series=_block_series(counts, (a, b, a_doubt, b_doubt), small, charge, block, 2 * inner),
    )


def _rank_one(sizes: Floats) -> tuple[Floats, Floats]:
    """Return u and w with u_k w_l ≥ sizes_kl."""
    floor = np.finfo(np.float64).tiny
    u = np.maximum(sizes.max(axis=2), floor)
    w = np.maximum((sizes / u[:, :, None]).max(axis=1), floor)
    u = np.maximum((sizes / w[:, None, :]).max(axis=2), floor)
    return u, w


def _disc_radii(values: Complexes, loop: Floats, inner: float) -> Floats:
    """Return how far the large eigenvalues can be off: where Σ_k u_k w_k/|z − p_k| < 1 there is none.

    Twice all their shares together is far enough from each; its own share is, where the others, at half
    their distance, leave it room.
    """
    own, total = loop[:, :-1], loop[:, :-1].sum(axis=1, keepdims=True)
    gaps = np.abs(values[:, :, None] - values[:, None, :]) / 2
    gaps[:, range(gaps.shape[1]), range(gaps.shape[1])] = np.inf
    with np.errstate(divide="ignore"):
        others = (own[:, None, :] / gaps).sum(axis=2) + loop[:, -1:] / inner
    alone = np.where(others < 0.5, own / (1 - np.minimum(others, 0.5)), np.inf)
    alone = np.where(alone < gaps.min(axis=2, initial=np.inf), alone, np.inf)
    together = np.where(loop[:, -1:] / inner < 0.5, 2 * total, np.inf)
    return np.minimum(alone, together)


def _block_series(
    counts: Floats,
    ends: tuple[Complexes, Complexes, Floats, Floats],
    small: Complexes,
    charge: float,
    block: Floats,
    radius: float,
) -> Floats:
    """Return the terms S X₂ T₂^j Y₂ Q of ζ^(−j−1) of all sites, their sizes, and what they may be off by.

    What is left of the series when it is cut, at |ζ| = radius, is charged to the constant term.

    Parameters
    ----------
    counts
        How often each site is there (k,).
    ends
        S X (k, n_s, n) and Y Q (k, n, n_r), and what they may be off by.
    small
        T₂ (k, m, m), over the last m states.
    charge
        What a product is off by, relative to that of the sizes.
    block, radius
        The bound on ‖(ζ − T₂)⁻¹‖ (k,) from |ζ| = radius on.
    """
    large = ends[0].shape[2] - small.shape[2]
    row, column, row_doubt, doubt = (
        ends[0][:, :, large:],
        ends[1][:, large:],
        ends[2][:, :, large:],
        ends[3][:, large:],
    )
    lines, together = column.shape[2], 2**DOUBLINGS
    terms = np.zeros((3, 1 + SERIES, row.shape[1], lines))
    row_size = np.abs(row)
    height = np.linalg.norm(row_size, axis=2)[:, :, None]
    first = height * np.linalg.norm(np.abs(column), axis=1)[:, None, :]
    left = first * block[:, None, None]
    column, doubt, power, power_doubt = _doubled(column, doubt, small, charge)
    for term in range(0, SERIES, together):
        more = ~(left <= CUT * UNIT * first).all(axis=(1, 2))
        if not more.any():
            break
        if 2 * np.count_nonzero(more) < len(more):  # go on with the few sites that die out slowly
            terms[2, 0] += np.tensordot(counts[~more], left[~more], 1)
            counts, block, height, first = (one[more] for one in (counts, block, height, first))
            row, row_size, row_doubt = row[more], row_size[more], row_doubt[more]
            column, doubt = column[more], doubt[more]
            power, power_doubt = power[more], power_doubt[more]
        size = np.abs(column)
        value, rounded, most = row @ column, doubt + charge * size, size + doubt
        off = row_size @ rounded + row_doubt @ most + np.abs(value.imag)
        for kind, part in enumerate((value.real, np.abs(value), off)):
            added = np.tensordot(counts, part, 1).reshape(-1, together, lines)
            terms[kind, term + 1 : term + 1 + together] += added.swapaxes(0, 1)
        column, doubt = power @ column, np.abs(power) @ rounded + power_doubt @ most
        dying = np.linalg.norm(np.abs(column[:, :, :lines]), axis=1)[:, None, :]
        left = height * dying * (block * radius ** -(term + together))[:, None, None]
    terms[2, 0] += np.tensordot(counts, left, 1)
    return terms


def _doubled(
    column: Complexes, doubt: Floats, small: Complexes, charge: float
) -> tuple[Complexes, Floats, Complexes, Floats]:
    """Return C, T C, T² C, … side by side, the next power of T, and what both may be off by.

    Parameters
    ----------
    column, doubt
        C (k, m, n_r), and what it may be off by.
    small
        T (k, m, m).
    charge
        What a product is off by, relative to that of the sizes.
    """
    power, power_doubt = small, np.zeros(small.shape)
    for _ in range(DOUBLINGS):
        size, weight = np.abs(column), np.abs(power)
        more = weight @ (doubt + charge * size) + power_doubt @ (size + doubt)
        column = np.concatenate([column, power @ column], axis=2)
        doubt = np.concatenate([doubt, more], axis=2)
        power_doubt = weight @ (power_doubt + charge * weight) + power_doubt @ (weight + power_doubt)
        power = power @ power
    return column, doubt, power, power_doubt


# A pole nearer than the inverse of this is looked at by itself.
CLOSE = 300.0

# Answers computed together: they stay in the cache of a processor.
ANSWERS = 65_536


@dataclass(frozen=True, slots=True, eq=False)
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
    """Return what the errors of a chunk's P do at most (z, n_s, n_r), see `build_transfer`.

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
