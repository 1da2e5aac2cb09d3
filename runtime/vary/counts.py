"""Numbers of peers that are looked at: of a search, and along an axis of a region.

Takes: a `Model` and the count of one of its groups, or a number that counts follow from.
Gives: `count_range`, `count_pieces`.
Guarantees: a count is a whole number.
Does not: judge a scene (see `line`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction

from apc.compiler.compiled import Model, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.peer_counts import least_peers
from apc.frame.names import ParameterRef, Range
from apc.frame.overrides import Override, apply
from apc.vary.delays import DelaySegment
from apc.vary.line import SPAN

# Without a limit, so many times the present count on graphs that aren't complete.
PLACED_SPAN = 10

# Strips of a region over a count.
MOST_STRIPS = 200


def count_range(
    system: Model,
    free: ParameterRef,
    limits: Sequence[Fraction | None],
    present: float,
    place: SourceLocation,
) -> tuple[int, int]:
    """Return the lowest and the highest count to look at.

    Parameters
    ----------
    system, free
        The compiled scene, and a count of it or what counts follow from.
    limits
        What was asked for, two; where not given, the least that a scene may have, and `SPAN` times the
        present count, `PLACED_SPAN` on a graph that isn't complete.
    present
        The present count.
    place
        Where it was asked for.

    Raises
    ------
    ApcError
        E842 no whole numbers.
    """
    low, high = limits
    of_group = any(free.name == group_count(group.name) for group in system.groups)
    others = system.peers - int(present) if of_group else 0
    first = _whole(low, max(1, least_peers(system.kinds) - others), place)
    placed = any(link.graph.shape != "complete" for link in system.links)
    span = PLACED_SPAN if placed else SPAN  # there each peer has a place of its own
    most = min(
        (
            parameter.maximum
            for parameter in system.parameters
            if parameter.name == free.name and parameter.maximum is not None
        ),
        default=math.inf,
    )
    return first, _whole(high, int(min(max(math.ceil(span * present), first + 1), most)), place)


def _whole(limit: Fraction | None, otherwise: int, place: SourceLocation) -> int:
    """Return a limit as the whole number it is."""
    if limit is None:
        return otherwise
    if limit.denominator != 1:
        raise ApcError(
            Diagnostic("E842", place, "a number of peers", "a whole number", f"{float(limit):.12g}")
        )
    return int(limit)


def count_pieces(system: Model, axis: Range, place: SourceLocation) -> Iterator[DelaySegment]:
    """Yield a piece for each count of a range, from halfway to the one before to halfway to the next.

    Raises
    ------
    ApcError
        E881 a range that does not go from one whole number to another, or over too many.
    """
    if axis.low.denominator != 1 or axis.high.denominator != 1:
        got = f"{float(axis.low):g} to {float(axis.high):g}"
        raise ApcError(Diagnostic("E881", place, f"the range of {axis.free.label}", "whole numbers", got))
    if axis.high - axis.low >= MOST_STRIPS:
        got = f"{int(axis.high - axis.low) + 1:,}"
        raise ApcError(Diagnostic("E881", place, axis.free.label, f"at most {MOST_STRIPS} counts", got))
    half = Fraction(1, 2)
    for count in range(int(axis.low), int(axis.high) + 1):
        inside = apply(system, [Override(axis.free, Fraction(count))])
        yield DelaySegment(max(axis.low, count - half), min(axis.high, count + half), None, inside)
