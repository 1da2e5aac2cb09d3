"""What a loop makes of errors in what is heard: the small gain by which losses and delays are harmless.

Takes: a loop whose ticks each hear one packet, and which of them may hear another one.
Gives: `felt_rows`; `ratios_of`, `Ratios`; `weight_of`, `Sizes`; `Response`, `change_of_sent`.
Guarantees: matrices come with the radii of their rounding.
Does not: say how far what is heard may be off (see `worst` and `changing_delay`).

Let q[k] be what is sent, and d[k] = q[k] − q[k−1]. What a receiver hears in the place of packet k is off by a
sum w of some d, and what peer i hears by r_i = Σ_j W_ij w_ij, ‖r‖ ≤ ‖|W|‖₂ ‖w‖ over all peers. If w comes of
d by an operator of norm at most γ, whatever the packets do, the scene is stable if ‖d ← r‖∞ ‖|W|‖₂ γ < 1.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import InterconnectionMatrices, ModalSystem, close, feedback_of, lay_out_loop
from apc.eigen.dissipation import peak_gain, proves_gain
from apc.eigen.peers import PeerClass
from apc.eigen.relative import Relative, relative, relative_coordinates, relative_rows, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.radius import RADII, UNIT, value_of
from apc.frame.schedule import CouplingTerm, ReceivedSample
from apc.unserved import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# How much the movement of a peer counts beside those of others, by link and site.
Sizes = Mapping[tuple[str, str], float]

# What each channel of a link counts in the one number that receivers combine them into, by link and channel.
Ratios = Mapping[tuple[str, str], Fraction]

# States of one loop; a Hamiltonian matrix of twice as many takes a tenth of a second.
MOST_STATES = 120

# The least of a peer's unit beside the largest.
LEAST_UNIT = 1e-6

# Roundings of a norm of few weights, and of what a gain is compared with.
NORM_ROUNDINGS = 1000


@dataclass(frozen=True, slots=True, eq=False)
class Response:
    """A, B, C, D of d ← r, over relative coordinates `at`, in coordinates of unit length for each peer."""

    a: Matrix
    b: Matrix
    c: Matrix
    d: Matrix
    at: Relative

    @property
    def peak(self) -> float:
        """Its largest gain, in floats."""
        return peak_gain(*map(value_of, (self.a, self.b, self.c, self.d)))[0]

    def is_below(self, gain: float) -> bool:
        """Say whether it is proved to be stable and of a smaller gain."""
        return proves_gain(self.a, self.b, self.c, self.d, gain)


def felt_rows(site: PeerClass, link: str) -> list[tuple[int, ReceivedSample]]:
    """Return the rows of r of a site that hear a link and that something follows from."""
    q, d = value_of(site.lifted.q), value_of(site.lifted.d)
    felt = np.any(q, axis=0) | np.any(d, axis=0)
    rows = enumerate(site.schedule.heard)
    return [(line, heard) for line, heard in rows if heard.way.link == link and felt[line]]


def change_of_sent(
    loop: ModalSystem, off: Sequence[tuple[int, Mapping[int, int], float]], ratios: Ratios, sizes: Sizes
) -> Response:
    """Return how what is sent changes from frame to frame, of errors in what is heard.

    Parameters
    ----------
    loop
        A loop that keeps each packet for a frame at least.
    off
        Which rows of r of a site are off by the same, how many frames after another, and by how many times r.
    ratios, sizes
        From `ratios_of` and `weight_of`.
    """
    layout = lay_out_loop(loop)
    if (n := len(layout.names)) > MOST_STATES:
        raise NotSupportedError(f"peers make one system of {n:,} states, and {MOST_STATES} are the most")

    def size(site: int, link: str) -> float:
        """Return how far n peers of a site that move alike by 1 move together: √n, or as they are weighed."""
        return math.sqrt(loop.sites[site].count) * sizes.get((link, loop.sites[site].name), 1.0)

    channels = set()
    entering = []
    for g, lines, times in off:
        heard = loop.sites[g].schedule.heard[next(iter(lines))]
        channels.add((heard.sent.link, heard.sent.channel))
        # Of several numbers that are heard as one, that which counts once is what the others add to.
        if ratios.get((heard.sent.link, heard.sent.channel), 1) == 1:
            entering.append((g, lines, times / size(g, heard.sent.link)))
    # Behind the state stands what is off later, and behind that what comes from outside.
    starts = np.cumsum([n, *(max(lines.values()) for _, lines, _ in entering)]).tolist()
    states = starts[-1]
    feedback = []
    for g, hears in enumerate(feedback_of(loop, layout)):
        before = np.zeros((*hears.before.shape[:2], states + len(entering)))
        before[..., :n] = hears.before
        for place, (site, lines, share) in enumerate(entering):
            for line, late in lines.items() if site == g else ():
                at = starts[place] + late - 1 if late else states + place
                before[:, line, at] = share, 8 * UNIT * share
        feedback.append(InterconnectionMatrices(hears.now, before))
    closed = close([site.lifted for site in loop.sites], feedback, layout, numbers=RADII)
    senders = [
        (h, row, sent) for h, site in enumerate(loop.sites) for row, sent in enumerate(site.schedule.sent)
    ]
    places = {(packet.site, packet.row, packet.lag): place for packet, place in layout.places.items()}
    before, combined = np.zeros_like(closed.sent), dict[tuple[int, str, str], Matrix]()
    for line, (h, row, sent) in enumerate(senders):
        if (sent.link, sent.channel) in channels:
            before[0, line, places[h, row, 1]] = 1.0
            ratio = ratios.get((sent.link, sent.channel))
            by = float(ratio or 1) * size(h, sent.link)
            number = (h, sent.link, sent.channel if ratio is None else "")
            weighing = combined.setdefault(number, np.zeros((2, len(senders))))
            weighing[:, line] = by, 8 * UNIT * abs(by)
    weights = np.array(list(combined.values())).reshape(-1, 2, len(senders)).swapaxes(0, 1)
    output = RADII.multiply(weights, RADII.subtract(closed.sent, before))
    matrix = np.zeros((2, states, states + len(entering)))
    matrix[:, :n] = closed.matrix
    for place, (start, end) in enumerate(itertools.pairwise(starts)):
        for at in range(start, end):
            matrix[0, at, at - 1 if at > start else states + place] = 1.0
    basis = find_rigid_modes(loop, with_drifts=False).basis
    coordinates = relative_coordinates(np.concatenate([basis, np.zeros((states - n, basis.shape[1]))]))
    within = with_doubt(coordinates)
    return Response(
        relative(matrix[..., :states], within, RADII),
        relative_rows(matrix[..., states:], within, RADII),
        output[..., coordinates.rest],
        output[..., states:],
        within,
    )


def ratios_of(sites: Sequence[PeerClass], lossy: frozenset[str]) -> Ratios:
    """Find the links of which every tick of every site combines all channels into the same number.

    Those of other links are kept apart. The first channel that counts has the ratio 1.
    """
    result: dict[tuple[str, str], Fraction] = {}
    for link in sorted(lossy):
        columns: dict[str, dict[tuple[int, int, int, CouplingTerm], Fraction]] = {}
        for g, site in enumerate(sites):
            used = {(heard.way, heard.sent.channel) for _, heard in felt_rows(site, link)}
            for partition, tick in enumerate(site.exact.ticks):
                for receive in range(tick.r.shape[1]):
                    for way, channel in site.schedule.ways(partition, receive):
                        if (way, channel) not in used:
                            continue
                        own = columns.setdefault(channel, {})
                        for row, entry in enumerate(tick.r[:, receive]):
                            if entry:
                                key = (g, partition, row, way)
                                own[key] = own.get(key, Fraction(0)) + entry
        if not columns or any(way.edge for column in columns.values() for *_, way in column):
            continue
        base = next(iter(columns.values()))
        ratios = {}
        for channel, own in columns.items():
            place = next(iter(own), None)
            ratio = own[place] / base[place] if place is not None and base.get(place) else None
            if ratio is None or own != {at: ratio * entry for at, entry in base.items()}:
                break
            ratios[link, channel] = ratio
        else:
            result |= ratios
    return result


def weight_of(loops: Sequence[ModalSystem], lossy: frozenset[str]) -> tuple[float, Sizes]:
    """Return ‖|W|‖₂, rounded up, and the sizes of peers by which it is as small as can be.

    Notes
    -----
    Of loops at right angles |W| is largest on the first, where all peers of a site move alike; of loops of
    one site each, where its eigenvalue is. Each peer may be measured by a unit of its own, as what a channel
    does to a number it does to any multiple: by √(v/u), u and v the vectors of Perron of |W| and |W|ᵀ, the
    norm becomes the spectral radius (Stoer and Witzgall, 1962).
    """
    largest = 0.0
    sizes: dict[tuple[str, str], float] = {}
    for link in sorted(lossy):
        used = {heard.way for loop in loops for site in loop.sites for _, heard in felt_rows(site, link)}
        for loop in loops if len(loops[0].sites) == 1 else loops[:1]:
            count = np.array([site.count for site in loop.sites], np.float64)
            blocks = [
                (np.abs(np.array(rows, np.float64)) + loop.doubts.get(way, 0.0))
                * np.sqrt(count[:, None] / count)
                for way, rows in loop.coupling.items()
                if way in used
            ]
            if not blocks:
                continue
            units = _units(np.sum(blocks, axis=0))
            sizes |= {(link, site.name): unit for site, unit in zip(loop.sites, units.tolist(), strict=True)}
            turned = np.concatenate([units[:, None] * block / units for block in blocks])
            largest = max(largest, float(np.linalg.norm(turned, 2)))
    return largest * (1 + NORM_ROUNDINGS * UNIT), sizes


def _units(weights: Floats) -> Floats:
    """Return units by which a matrix of weights has the smallest norm; 1 where some peers hear nobody."""
    result = []
    for matrix in (weights, weights.T):
        values, vectors = np.linalg.eig(matrix)
        result.append(np.abs(vectors[:, int(np.argmax(values.real))]))
    if min(float(item.min() / item.max()) for item in result) < LEAST_UNIT:
        return np.ones(len(weights))
    units = np.sqrt(result[1] / result[0])
    return np.asarray(units / units.max())
