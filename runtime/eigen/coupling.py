"""What peers weigh one another's packets by: a sum, a mean, or the one that is largest or smallest.

Takes: groups of equal peers, the exchange, the weight of each in a plain sum.
Gives: `couple`, `complete_degrees`.
Guarantees: exact weights; a mean over nobody, or of weights that add up to 0, raises.
Does not: choose the sites of a loop (see `modes`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction

from apc.eigen.closing import Coupling
from apc.eigen.peer_group import PeerGroup, used_ways
from apc.frame.exchange import Exchange, check_mean
from apc.frame.schedule import Way


def couple(
    groups: Sequence[PeerGroup],
    exchange: Exchange,
    weigh: Callable[[Way, int, int], Fraction],
    degrees: Mapping[tuple[str, int], Fraction],
) -> Coupling:
    """Weigh each site's packets at each other, way by way.

    Parameters
    ----------
    groups
        The sites.
    exchange
        The links.
    weigh
        The weight of a packet of site h at site g in a plain sum.
    degrees
        What a mean is divided by, by link and site; who hears nobody has no entry.
    """
    coupling = {}
    for way in used_ways(group.schedule for group in groups):
        rows = []
        for g, group in enumerate(groups):
            hears = any(one.way == way for one in group.schedule.heard)
            if hears and way.operator == "mean":
                total = degrees.get((way.link, g))
                check_mean(
                    exchange, int(group.peers[0]), way.link, "mean", total is not None, total or Fraction(0)
                )
            row = []
            for h, sender in enumerate(groups):
                weight = weigh(way, g, h) if hears and sender.sends(way.link) else Fraction(0)
                if weight and exchange.delay(way.link, sender.role, group.role) == way.delay:
                    if way.operator == "mean":
                        weight /= degrees[way.link, g]
                    elif way.operator in ("max", "min"):  # the one it is taken from counts once
                        weight = Fraction(1 if weight > 0 else -1)
                    row.append(weight * group.gain(way, sender))
                else:
                    row.append(Fraction(0))
            rows.append(tuple(row))
        coupling[way] = tuple(rows)
    return coupling


def complete_degrees(groups: Sequence[PeerGroup], exchange: Exchange) -> dict[tuple[str, int], Fraction]:
    """Return how many others a peer of each group hears over each complete link."""
    degrees = {}
    for link in exchange.links:
        total = sum(group.count for group in groups if group.sends(link))
        for g, group in enumerate(groups):
            number = total - (1 if group.sends(link) else 0)
            if number:
                degrees[link, g] = Fraction(number)
    return degrees
