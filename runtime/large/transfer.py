"""What many sites together answer, as their poles and residues, with what these may be off by.

Takes: the matrices of x⁺ = M x + B r, s = S x + D r of many sites, what these may be off by, and how often
each site counts.
Gives: `StateSpace`, `Transfer`, `build_transfer`.
Guarantees: the errors hold all that rounding does, and those of the matrices.
Does not: say what they answer at a frequency (see `response`).

    T(ζ) = Σ_i n_i (D_i + S_i (ζ − M_i)⁻¹ B_i)

Each M_i is split, X⁻¹ M X = diag(p_1, …, p_K, T₂): the eigenvalues beyond `inner` one by one, and all that
is smaller, queues running empty and the like, as one block that may be defective. The block's part is a
short power series of 1/ζ, added up over all sites before any ζ is known.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.pseudospectrum import PRODUCT_ROUNDINGS, balance
from apc.frame.discretize import UNIT
from apc.large.diagonal import block_diagonal, block_norms, block_norms_along, block_resolvent

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Eigenvalues within this share of the largest go into the block; at twice that distance from zero its series
# gains a bit a term, (inner/|ζ|)^k < 2^−k.
INNER = 0.3

# Terms of the block's power series: at twice `inner`, 2^−60 of the first is left. It is cut where what is
# left is this share of a rounding.
SERIES, CUT = 60, 2.0**-7

# Sites worked on together: they stay in the cache of a processor.
CHUNK = 1024


@dataclass(frozen=True, slots=True)
class StateSpace:
    """k sites x⁺ = M x + B r, s = S x + D r; `*_error` bounds the error, entry by entry."""

    m: Floats  # (k, n, n)
    b: Floats  # (k, n, n_r)
    s: Floats  # (k, n_s, n)
    d: Floats  # (k, n_s, n_r)
    m_error: Floats
    b_error: Floats
    s_error: Floats
    d_error: Floats


@dataclass(frozen=True, slots=True)
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
    residue_error: Floats  # (k,): what they may be off by, relative to their sizes
    block: Floats  # (k,): a bound on ‖(ζ − T₂)⁻¹‖ from twice `inner` on
    loop: Floats  # (k, K + 1): u w, see `build_transfer`; the block last
    left: Floats  # (k, K + 1, n_s): |S X| u
    right: Floats  # (k, K + 1, n_r): w |Y B|
    together: Floats  # (k, n_s · n_r): what an error of M does where every |ζ − p_k| = 1
    loops: Floats  # (k,): Σ u w
    series: Floats  # (up to 1 + SERIES, n_s, n_r): D, then ζ⁻¹, ζ⁻², …
    series_sizes: Floats
    series_errors: Floats


def build_transfer(space: StateSpace, counts: Floats) -> Transfer:
    """Split every site into its poles and a block of what dies out at once.

    Parameters
    ----------
    space
        The k sites.
    counts
        How often each is there (k,).

    Notes
    -----
    With computed X and Y ≈ X⁻¹, M + E = X (Λ + Δ) X⁻¹ holds for some |Δ| ≤ |X⁻¹| (|M X − X Λ| + |E| |X|). A
    majorant of rank one, Δ_kl ≤ u_k w_l, makes the Neumann series of (ζ − Λ − Δ)⁻¹ a geometric one: what it
    changes is at most (Σ_k |S X|_k u_k/|ζ − p_k|) (Σ_l w_l |Y B|_l/|ζ − p_l|) / (1 − Σ_k u_k w_k/|ζ − p_k|).
    """
    sites, n = space.m.shape[:2]
    scale = balance(np.max(np.abs(space.m) + space.m_error, axis=0))
    values, vectors = np.empty((sites, n), np.complex128), np.empty((sites, n, n), np.complex128)
    for place in _chunks(np.arange(sites)):
        own, right = np.linalg.eig(space.m[place] / scale[:, None] * scale)
        order = np.argsort(-np.abs(own), axis=1, kind="stable")
        values[place] = np.take_along_axis(own, order, axis=1)
        vectors[place] = np.take_along_axis(right, order[:, None, :], axis=2)
    inner = INNER * min(1.0, float(np.abs(values).max(initial=0.0))) or INNER
    return _gathered(space, scale, counts, values, vectors, inner)


def _gathered(
    space: StateSpace, scale: Floats, counts: Floats, values: Complexes, vectors: Complexes, inner: float
) -> Transfer:
    """Split the sites, those of equally many poles together, and put the parts side by side."""
    sites, n = values.shape
    n_s, n_r = space.d.shape[1:]
    large = (np.abs(values) > inner).sum(axis=1)
    most = int(large.max(initial=0))
    errors = np.full((sites, n), np.inf)
    poles = np.zeros((most, sites), np.complex128)
    residues = np.zeros((most, sites, n_s * n_r), np.complex128)
    doubt, block = np.zeros(sites), np.zeros(sites)
    loop = np.zeros((sites, most + 1))
    left, right = np.zeros((sites, most + 1, n_s)), np.zeros((sites, most + 1, n_r))
    series = np.zeros((3, 1 + SERIES, n_s, n_r))
    series[0, 0] += np.tensordot(counts, space.d, 1)
    series[1, 0] += np.tensordot(counts, np.abs(space.d), 1)
    series[2, 0] += np.tensordot(counts, space.d_error, 1)
    for count in np.unique(large).tolist():
        for place in _chunks(np.flatnonzero(large == count)):
            own = _balanced(space, place, scale)
            part = _split(own, counts[place], values[place], vectors[place], count, inner)
            poles[:count, place] = values[place, :count].T
            residues[:count, place] = (counts[place, None, None] * part.residues).swapaxes(0, 1)
            kept = [*range(count), most]  # the block comes last
            left[np.ix_(place, kept)] = counts[place, None, None] * part.left
            right[np.ix_(place, kept)], loop[np.ix_(place, kept)] = part.right, part.loop
            doubt[place], block[place] = part.doubt, part.block
            errors[place] = part.errors
            series += part.series
    used = max(1, 1 + int(np.flatnonzero(series.any(axis=(0, 2, 3))).max(initial=0)))
    series = series[:, :used]
    return Transfer(
        inner=inner,
        counts=counts,
        eigenvalues=values,
        eigenvalue_errors=errors,
        poles=poles,
        residues=residues,
        residue_sizes=np.abs(residues),
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


def _balanced(space: StateSpace, place: NDArray[np.intp], scale: Floats) -> StateSpace:
    """Return some sites over states in other units, powers of two so that nothing is rounded."""
    inverse = (1.0 / scale)[:, None]
    return StateSpace(
        m=space.m[place] * inverse * scale,
        b=space.b[place] * inverse,
        s=space.s[place] * scale,
        d=space.d[place],
        m_error=space.m_error[place] * inverse * scale,
        b_error=space.b_error[place] * inverse,
        s_error=space.s_error[place] * scale,
        d_error=space.d_error[place],
    )


def _chunks(places: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Cut places into chunks."""
    for start in range(0, len(places), CHUNK):
        yield places[start : start + CHUNK]


@dataclass(frozen=True, slots=True)
class _Parts:
    """A chunk of sites of equally many poles; the fields as in `Transfer`, each site counted once.

    But for `series` (3, 1 + SERIES, n_s, n_r): its terms, their sizes and errors, of all sites together.
    """

    residues: Complexes
    doubt: Floats
    block: Floats
    loop: Floats
    left: Floats
    right: Floats
    errors: Floats
    series: Floats


def _split(
    space: StateSpace, counts: Floats, values: Complexes, vectors: Complexes, large: int, inner: float
) -> _Parts:
    """Split sites that all have `large` poles beyond `inner`."""
    sites, n = values.shape
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    found = block_diagonal(space.m, space.m_error, values, vectors, large)
    basis, dual, small, change, grown = found.basis, found.dual, found.small, found.change, found.grown
    weight, size = np.abs(dual), np.abs(basis)

    a, b = space.s @ basis, dual @ space.b
    a_doubt = (space.s_error + charge * np.abs(space.s)) @ size
    b_doubt = weight @ (space.b_error * grown + charge * np.abs(space.b))
    b_doubt += (grown - 1) * np.abs(b).max(axis=1, keepdims=True)
    a_size, b_size = np.abs(a), np.abs(b)
    residues = a[:, :, :large].swapaxes(1, 2)[..., None] * b[:, :large, None, :]
    product = (a_size + a_doubt).swapaxes(1, 2)[:, :large, :, None] * (b_size + b_doubt)[:, :large, None, :]
    exact = np.abs(residues)
    off = np.maximum(product - exact, 0.0) + 8 * UNIT * product
    # Relative to each residue; one that should be nothing is off by something all the same.
    floor = UNIT * product.max(axis=(1, 2, 3), initial=0.0)[:, None, None, None]
    doubt = (off / np.maximum(exact, floor + np.finfo(np.float64).tiny)).max(axis=(1, 2, 3), initial=0.0)

    u, w = _rank_one(block_norms(change, large))
    left = block_norms_along(a_size + a_doubt, large) * u[:, None, :]
    right = block_norms_along((b_size + b_doubt).swapaxes(1, 2), large) * w[:, None, :]
    errors = np.repeat(u[:, -1:] * w[:, -1:], n, axis=1)
    errors[:, :large] = _disc_radii(values[:, :large], u * w, inner)
    block = block_resolvent(small, 2 * inner)
    return _Parts(
        residues=residues.reshape(sites, large, a.shape[1] * b.shape[2]),
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
    """Return the terms S X₂ T₂^j Y₂ B of ζ^(−j−1) of all sites, their sizes, and what they may be off by.

    What is left of the series when it is cut, at |ζ| = radius, is charged to the constant term.

    Parameters
    ----------
    counts
        How often each site is there (k,).
    ends
        S X (k, n_s, n) and Y B (k, n, n_r), and what they may be off by.
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
    row_size, size, weight = np.abs(row), np.abs(column), np.abs(small)
    terms = np.zeros((3, 1 + SERIES, row.shape[1], column.shape[2]))
    height = np.linalg.norm(row_size, axis=2)[:, :, None]
    first = height * np.linalg.norm(size, axis=1)[:, None, :]
    for term in range(SERIES):
        left = height * np.linalg.norm(size, axis=1)[:, None, :] * (block * radius**-term)[:, None, None]
        if np.all(left <= CUT * UNIT * first):
            break
        value = row @ column
        off = row_size @ doubt + row_doubt @ (size + doubt) + charge * (row_size @ size) + np.abs(value.imag)
        for kind, part in enumerate((value.real, np.abs(value), off)):
            terms[kind, term + 1] = np.tensordot(counts, part, 1)
        column, doubt = small @ column, weight @ (doubt + charge * size)
        size = np.abs(column)
    terms[2, 0] += np.tensordot(counts, left, 1)
    return terms
