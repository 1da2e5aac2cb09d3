"""Equal peers on a graph of very many eigenvalues: only the systems that decide are solved.

Takes: one group of equal peers and the exchange between them.
Gives: `LargeGraph`, `is_large_ring`, `deciding_loops`, `with_the_rest`.
Guarantees: the systems left out are shown to have all their eigenvalues below a bound, see `extremes`; the
spectrum's radius holds for them too.
Does not: take a graph that is no ring, or whose eigenvalues are not real.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from apc.eigen.graph_loops import common_graph, graph_loop, graph_scale
from apc.eigen.graph_modes import ring_mode, ring_values
from apc.eigen.modes import Arrangement
from apc.eigen.peer_group import PeerGroup, used_ways
from apc.eigen.rigid import find_rigid_modes
from apc.eigen.spectrum import Spectrum, judge
from apc.frame.exchange import Exchange

# From so many eigenvalues on.
MANY = 128


@dataclass(frozen=True, slots=True)
class LargeGraph:
    """The loops that decide; the others are bounded by `below` and have `rigid` rigid motions together."""

    arrangement: Arrangement
    below: float
    rigid: int


def is_large_ring(groups: Sequence[PeerGroup], exchange: Exchange) -> bool:
    """Say whether all peers are equal, on one ring of many."""
    ways = used_ways(group.schedule for group in groups)
    shapes = {exchange.links[way.link].graph.shape for way in ways}
    if len(groups) > 1 or shapes != {"ring"} or exchange.peers <= 2 * MANY:
        return False
    return not common_graph(ways, exchange)


def deciding_loops(groups: Sequence[PeerGroup], exchange: Exchange) -> LargeGraph:
    """Choose the loops of equal peers on a large ring that decide.

    Parameters
    ----------
    groups
        All peers, one group (see `is_large_ring`).
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
    from apc.large.extremes import find_extremes  # most scenes only ask `is_large_ring`

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
    return LargeGraph(
        Arrangement("modes", tuple(loops), (note,)), found.below, left_out * free.directions.shape[1]
    )


def with_the_rest(spectrum: Spectrum, large: LargeGraph) -> Spectrum:
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
