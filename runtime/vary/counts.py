"""How many peers a scene bears: the verdict over the count of a group.

Takes: a `CompiledSystem` and the count of one of its groups, or a number that counts follow from.
Gives: `search_counts`; `count_pieces` for a region with a count along one axis.
Guarantees: a count is a whole number; a change is told between two neighbouring counts, both judged.
Does not: know what happens between counts that weren't looked at: that is said.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction

from apc.compiler.compiled import CompiledSystem, group_count
from apc.compiler.crowd import least_peers
from apc.compiler.errors import ApcError, Mistake, Place
from apc.frame.names import Free, Range
from apc.frame.overrides import Override, apply
from apc.vary.delays import Piece
from apc.vary.search import COUNT, SPAN, Crossing, Search, Told

# So many counts from the lowest on are each looked at; then each is so many times the one before.
EVERY, FURTHER = 32, 1.25

# Without a limit, so many times the present count on graphs that aren't complete.
PLACED_SPAN = 10

# Strips of a region over a count.
MOST_STRIPS = 200

# What a change of the verdict between two counts rests on.
JUDGED = "both judged"


def search_counts(
    system: CompiledSystem,
    free: Free,
    limits: Sequence[Fraction | None],
    present: float,
    judge: Callable[[CompiledSystem], bool | None],
    place: Place,
    *,
    told: Told | None = None,
) -> Search:
    """Find between which counts the verdict changes.

    Parameters
    ----------
    system, free
        The compiled scene, and a count of it or what counts follow from.
    limits
        The lowest and highest count, two; where not given, the least that a scene may have, and `SPAN` times
        the present count, `PLACED_SPAN` on a graph that isn't complete.
    present
        The present count.
    judge
        Says of the scene with another count whether it is stable, None if that is left open.
    place
        Where it was asked for.
    told
        Is told how far the search is.

    Returns
    -------
    A crossing's value is the count on its stable side, its error 0 (see `Crossing`). Where the verdict is
    open at a count, that one stands for no change.

    Raises
    ------
    ApcError
        E842 no whole numbers, E626 and others of `overrides.apply`.
    """
    low, high = limits
    of_group = any(free.name == group_count(group.name) for group in system.groups)
    others = system.peers - int(present) if of_group else 0
    first = _whole(low, max(1, least_peers(system.kinds) - others), place)
    placed = any(link.graph.shape != "complete" for link in system.links)
    span = PLACED_SPAN if placed else SPAN  # there each peer has a place of its own
    most = min(
        (one.maximum for one in system.parameters if one.name == free.name and one.maximum is not None),
        default=math.inf,
    )
    last = _whole(high, int(min(max(math.ceil(span * present), first + 1), most)), place)
    known: dict[int, bool | None] = {}

    def at(count: int) -> bool | None:
        if count not in known:
            if told is not None:
                told(f"looking at {free.label} = {count:,}")
            known[count] = judge(apply(system, [Override(free, Fraction(count))]))
        return known[count]

    counts = [count for count in _looked_at(first, last) if at(count) is not None]
    edges, stable = [], [bool(at(counts[0]))] if counts else []
    for one, other in itertools.pairwise(counts):
        if at(one) == at(other):
            continue
        below, above, was = one, other, at(one)
        while above - below > 1:
            middle = (below + above) // 2
            if at(middle) is None:
                break
            below, above = (middle, above) if at(middle) == was else (below, middle)
        side, value = ("below", below) if was else ("above", above)
        proof = JUDGED if above - below == 1 else f"{above - below - 1} between are left open"
        edges.append(Crossing(float(value), 0.0, side, math.nan, COUNT, proof))
        stable.append(not was)
    return Search(
        edges=tuple(edges),
        stable=tuple(stable),
        scanned=(float(first), float(last)),
        whole=None not in known.values(),
        known=len(known) == last - first + 1,
        looked=len(known),
        enters=True,
    )


def _whole(limit: Fraction | None, otherwise: int, place: Place) -> int:
    """Return a limit as the whole number it is."""
    if limit is None:
        return otherwise
    if limit.denominator != 1:
        raise ApcError(Mistake("E842", place, "a number of peers", "a whole number", f"{float(limit):.12g}"))
    return int(limit)


def _looked_at(first: int, last: int) -> Iterator[int]:
    """Yield the counts to look at to begin with, in order."""
    count = first
    while count < last:
        yield count
        count = max(count + 1, min(last, math.floor(count * FURTHER)) if count >= first + EVERY else 0)
    yield last


def count_pieces(system: CompiledSystem, axis: Range, place: Place) -> Iterator[Piece]:
    """Yield a piece for each count of a range, from halfway to the one before to halfway to the next.

    Raises
    ------
    ApcError
        E881 a range that does not go from one whole number to another, or over too many.
    """
    if axis.low.denominator != 1 or axis.high.denominator != 1:
        got = f"{float(axis.low):g} to {float(axis.high):g}"
        raise ApcError(Mistake("E881", place, f"the range of {axis.free.label}", "whole numbers", got))
    if axis.high - axis.low >= MOST_STRIPS:
        got = f"{int(axis.high - axis.low) + 1:,}"
        raise ApcError(Mistake("E881", place, axis.free.label, f"at most {MOST_STRIPS} counts", got))
    half = Fraction(1, 2)
    for count in range(int(axis.low), int(axis.high) + 1):
        inside = apply(system, [Override(axis.free, Fraction(count))])
        yield Piece(max(axis.low, count - half), min(axis.high, count + half), None, inside)
