"""Equal peers on a ring of very many: which of its eigenvalues decide, without solving a system for each.

Takes: one group of equal peers and the exchange between them.
Gives: `LargeRing`, `deciding_loops`, `with_the_rest`; `Extremes`, `find_extremes`.
Guarantees: every system that is left out has all its eigenvalues within `below`: whole intervals of graph
eigenvalues are shown to be so from their middles, rounding included. The spectrum's radius holds for them
too.
Does not: take a graph that is no ring, or solve the systems that decide (see `spectrum`).

A site that hears μ times what it sent moves by a matrix M(μ) = M₀ + μ M₁. At the middle c of an interval,
X⁻¹ M(c) X is diagonal but for a block of what dies out at once, and X⁻¹ M(μ) X differs from it by (μ − c) G,
G = X⁻¹ M₁ X. For |ζ| ≥ bound there is no eigenvalue if in each row of blocks ζ less the diagonal outweighs
all the rest (Feingold and Varga, Block diagonally dominant matrices, Pacific J. Math. 1962).

All 50,001 systems of 10⁵ peers in one batch would take more than ten times as long, to find vectors
for the bounds of what dies out long before the few that decide.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.eigen.graph_loops import graph_loop, graph_scale
from apc.eigen.graph_modes import ring_mode, ring_values
from apc.eigen.modes import Arrangement
from apc.eigen.peer_group import PeerGroup, used_ways
from apc.eigen.pseudospectrum import balance
from apc.eigen.relative import relative_bounded, relative_coordinates
from apc.eigen.rigid import find_rigid_modes
from apc.eigen.spectrum import Spectrum, judge
from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange
from apc.large.diagonal import block_diagonal, block_norms, block_resolvent
from apc.large.populations import hear_themselves, rows_of
from apc.large.transfer import INNER

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LargeRing:
    """The loops that decide; the others are bounded by `below` and have `rigid` rigid motions together."""

    arrangement: Arrangement
    below: float
    rigid: int


def deciding_loops(groups: Sequence[PeerGroup], exchange: Exchange) -> LargeRing:
    """Choose the loops of equal peers on a large ring that decide.

    Parameters
    ----------
    groups
        All peers, one group (see `plan.is_large_ring`).
    exchange
        The links.
    """
    ways = used_ways(group.schedule for group in groups)
    [group] = groups
    scale = graph_scale(group, ways, exchange)
    n = exchange.peers
    values = ring_values(n, mean=scale.by_mean)
    weights = np.array([float(scale.weights[one.way]) for one in group.schedule.heard])
    any_other = graph_loop(group, ring_mode(1, n, mean=scale.by_mean), scale)
    # What is rigid in one system that is not the common one hears nothing: it is rigid in all of them.
    free = find_rigid_modes(any_other, with_drifts=False)
    found = find_extremes(group, weights, values[1:], free.directions)
    places = [0, *(found.places + 1).tolist()]
    loops = [graph_loop(group, ring_mode(k, n, mean=scale.by_mean), scale) for k in places]
    left_out = n - sum(loop.multiplicity for loop in loops)
    named = " and ".join(f"{link} (ring)" for link in dict.fromkeys(way.link for way in ways))
    how = "shown" if found.proved else "estimated"
    note = (
        f"{n // 2 + 1:,} systems, one an eigenvalue of the graph of {named}: {len(loops)} of them are"
        f" solved, all others are {how} to die out faster"
    )
    return LargeRing(
        Arrangement("modes", tuple(loops), (note,)), found.below, left_out * free.directions.shape[1]
    )


def with_the_rest(spectrum: Spectrum, large: LargeRing) -> Spectrum:
    """Return the spectrum of the loops solved, its radius widened to hold for those left out."""
    high = spectrum.spectral_radius + spectrum.spectral_radius_error
    if large.below <= high:
        return replace(spectrum, rigid_modes=spectrum.rigid_modes + large.rigid)
    low = spectrum.spectral_radius - spectrum.spectral_radius_error
    inside = False if low > 1 else True if large.below < 1 and spectrum.stable else None
    verdict, stable = judge([inside], spectrum.rigid_modes + large.rigid, spectrum.drifts)
    return replace(
        spectrum,
        spectral_radius_error=large.below - spectrum.spectral_radius,
        rigid_modes=spectrum.rigid_modes + large.rigid,
        verdict=verdict,
        stable=stable,
    )


# Intervals of no more graph eigenvalues than this are looked at one by one.
LEAF = 8

# Graph eigenvalues looked at to begin with, to have a bound to compare with.
FIRST = 64

# Systems whose radius is within this of the largest, relatively, are all solved.
ALIKE = 1e-9

# How much the leading eigenvalue's row is made to outweigh, against the others', in turn.
EMPHASES = (1.0, 30.0, 1000.0)

# Roundings charged to a graph's eigenvalue: those of a cosine's argument, up to π, twice, and its own.
GRAPH_ROUNDINGS = 32

# Systems that are solved, the largest by estimate; matrices looked at together.
MOST_SOLVED, TOGETHER = 64, 4096


@dataclass(frozen=True, slots=True, eq=False)
class Extremes:
    """The places of the graph eigenvalues that decide, and a bound for the radii of all others.

    `proved` is False when too many are as large as each other, or hear within the frame, for a proof: then
    `below` is an estimate.
    """

    places: Integers
    below: float
    proved: bool


def find_extremes(group: PeerGroup, weights: Floats, values: Floats, rigid: Floats) -> Extremes:
    """Find the graph eigenvalues with the largest spectral radii.

    Parameters
    ----------
    group
        The peers, all equal.
    weights
        What each line of r weighs a neighbour's packet by, in units of the graph's W (n_r,).
    values
        The graph's real eigenvalues (m,), the common one left out.
    rigid
        Motions (n, d) that are rigid whatever the graph's eigenvalue is.
    """
    family = _Family(group, weights, rigid, float(np.abs(values).max(initial=0.0)))
    order = np.argsort(values, kind="stable")
    ordered = values[order]
    if not family.affine:
        radii = family.radii(ordered)
        best = float(radii.max())
        chosen = np.argsort(-radii, kind="stable")[:MOST_SOLVED]
        return Extremes(order[chosen], best, False)
    first = np.unique(np.linspace(0, len(values) - 1, FIRST).astype(np.int64))
    best = float(family.radii(ordered[first]).max())
    starts, ends = np.array([0]), np.array([len(values)])
    alone = [first]
    while len(starts):
        open_ = ~family.below(ordered[starts], ordered[ends - 1], best * (1 - ALIKE))
        starts, ends = starts[open_], ends[open_]
        few = ends - starts <= LEAF
        leaves = [np.arange(a, b) for a, b in zip(starts[few], ends[few], strict=True)]
        if leaves:
            alone += leaves
            best = max(best, float(family.radii(ordered[np.concatenate(leaves)]).max()))
        starts, ends = starts[~few], ends[~few]
        middle = np.searchsorted(ordered, (ordered[starts] + ordered[ends - 1]) / 2)
        middle = np.clip(middle, starts + 1, ends - 1)  # equal eigenvalues are cut anywhere
        starts, ends = np.concatenate([starts, middle]), np.concatenate([middle, ends])
    places = np.unique(np.concatenate(alone))
    places = places[~family.below(ordered[places], ordered[places], best * (1 - ALIKE))]
    if len(places) > MOST_SOLVED:
        radii = family.radii(ordered[places])
        places = places[np.argsort(-radii, kind="stable")[:MOST_SOLVED]]
        return Extremes(np.sort(order[places]), best * (1 + ALIKE), False)
    return Extremes(np.sort(order[places]), best * (1 - ALIKE), True)


class _Family:
    """M(μ) of a site, the rigid motions taken out."""

    def __init__(self, group: PeerGroup, weights: Floats, rigid: Floats, largest: float) -> None:
        self.group, self.weights = group, weights
        self.relative = relative_coordinates(rigid)
        delayed = all(one.lag for one in group.schedule.heard)
        self.affine = delayed or not group.lifted.d.any()
        ends, error = self._matrices(np.array([0.0, largest]))
        scale = balance(np.abs(ends).max(axis=0) + error.max(axis=0))
        self.scale = scale
        self.still = _scaled(ends[0], scale)
        self.slope = _scaled(ends[1] - ends[0], scale) / (largest or 1.0)
        rounding = 8 * UNIT * np.abs(ends).max(axis=0)
        self.error = _scaled(2 * error.max(axis=0) + rounding, scale)

    def _matrices(self, values: Floats) -> tuple[Floats, Floats]:
        """Return M(μ) (k, n, n), relative coordinates, and bounds on their errors."""
        own = values[:, None] * self.weights
        maps = hear_themselves(rows_of(self.group.lifted, len(values)), self.group.schedule, own, 0 * own)
        return relative_bounded(maps.p, maps.error.p, self.relative)

    def radii(self, values: Floats) -> Floats:
        """Return estimates of the spectral radii at some graph eigenvalues."""
        found = []
        for start in range(0, len(values), TOGETHER):
            some = values[start : start + TOGETHER]
            matrices = (
                self.still + some[:, None, None] * self.slope if self.affine else self._matrices(some)[0]
            )
            found.append(np.abs(np.linalg.eigvals(matrices)).max(axis=1, initial=0.0))
        return np.concatenate(found) if found else np.zeros(0)

    def below(self, low: Floats, high: Floats, bound: float) -> NDArray[np.bool_]:
        """Say of intervals of graph eigenvalues whether all radii in them are proved below a bound."""
        # The values themselves are rounded, a cosine of an angle up to π a few times.
        rounding = GRAPH_ROUNDINGS * UNIT * np.maximum(np.maximum(np.abs(low), np.abs(high)), 1.0)
        middle, half = (low + high) / 2, (high - low) / 2 + rounding
        matrices = self.still + middle[:, None, None] * self.slope
        values, vectors = (part.astype(np.complex128) for part in np.linalg.eig(matrices))
        order = np.argsort(-np.abs(values), axis=1, kind="stable")
        values = np.take_along_axis(values, order, axis=1)
        vectors = np.take_along_axis(vectors, order[:, None, :], axis=2)
        large = (np.abs(values) > INNER * bound).sum(axis=1)
        proved = np.zeros(len(middle), dtype=bool)
        for count in np.unique(large).tolist():
            place = np.flatnonzero(large == count)
            error = np.broadcast_to(self.error, (len(place), *self.error.shape))
            found = block_diagonal(matrices[place], error, values[place], vectors[place], count)
            turned = found.dual @ self.slope @ found.basis
            proved[place] = _dominates(
                values[place, :count],
                turned,
                found.change + half[place, None, None] * (found.grown - 1) * np.abs(turned),
                block_resolvent(found.small, bound),
                half[place],
                bound,
            )
        return proved


def _dominates(
    values: NDArray[np.complex128],
    turned: NDArray[np.complex128],
    change: Floats,
    block: Floats,
    half: Floats,
    bound: float,
) -> NDArray[np.bool_]:
    """Say whether ζ − diag(p, T₂) outweighs t G + Δ for all |t| ≤ half and |ζ| ≥ bound, row by row."""
    large = values.shape[1]
    own = np.arange(large)
    sizes = half[:, None, None] * block_norms(np.abs(turned), large) + block_norms(change, large)
    moved = half[:, None] * turned[:, own, own]
    reach = np.maximum(np.abs(values + moved), np.abs(values - moved))
    leading = np.abs(values) >= (1 - 1e-6) * np.abs(values).max(axis=1, keepdims=True, initial=0.0)
    passed = np.zeros(len(values), dtype=bool)
    for emphasis in EMPHASES:
        scale = np.concatenate([np.where(leading, emphasis, 1.0), np.ones((len(values), 1))], axis=1)
        rows = sizes * scale[:, None, :] / scale[:, :, None]
        beside = rows.sum(axis=2)
        beside[:, :large] -= half[:, None] * np.abs(turned[:, own, own])  # in `reach`
        good = np.all(reach + np.maximum(beside[:, :large], 0.0) * (1 + 1e-9) < bound, axis=1)
        passed |= good & (block * beside[:, large] < 1)
    return passed


def _scaled(matrix: Floats, scale: Floats) -> Floats:
    return matrix / scale[:, None] * scale
