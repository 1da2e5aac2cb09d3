"""Numbers of peers as samples: of a search, and along an axis of a region.

Takes: a `Model` and the count of one of its groups, or a number on which counts depend.
Gives: `count_range`, `count_segments`.
Guarantees: a count is an integer.
Does not: analyse a model (see `parameter_path`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from fractions import Fraction

from apc.compiler.compiled import Model, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.peer_counts import least_peers
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, Range
from apc.parameter_studies.delay_segments import DelaySegment
from apc.parameter_studies.parameter_path import SPAN

# The default range on graphs that are not complete, as a multiple of the present count.
PLACED_SPAN = 10

# Strips of a region over a count.
MOST_STRIPS = 200


def count_range(
    system: Model,
    free: ParameterRef,
    limits: Sequence[Fraction | None],
    present: float,
    location: SourceLocation,
) -> tuple[int, int]:
    """Return the lowest and the highest count of a range.

    Parameters
    ----------
    system, free
        The compiled model, and a count of it or a number on which counts depend.
    limits
        The two requested limits; by default, the minimum of the model, and `SPAN` times the present count,
        `PLACED_SPAN` on a graph that is not complete.
    present
        The present count.
    location
        The location of the request.

    Raises
    ------
    ApcError
        E842 the limits are not integers.
    """
    low, high = limits
    of_group = any(free.name == group_count(group.name) for group in system.groups)
    others = system.peers - int(present) if of_group else 0
    first = _whole(low, max(1, least_peers(system.peer_types) - others), location)
    placed = any(link.graph.shape != "complete" for link in system.links)
    span = PLACED_SPAN if placed else SPAN  # there each peer has an index in the graph
    most = min(
        (
            parameter.maximum
            for parameter in system.parameters
            if parameter.name == free.name and parameter.maximum is not None
        ),
        default=math.inf,
    )
    return first, _whole(high, int(min(max(math.ceil(span * present), first + 1), most)), location)


def _whole(limit: Fraction | None, otherwise: int, location: SourceLocation) -> int:
    """Return a limit as an integer."""
    if limit is None:
        return otherwise
    if limit.denominator != 1:
        raise ApcError(
            Diagnostic("E842", location, "a number of peers", "a whole number", f"{float(limit):.12g}")
        )
    return int(limit)


def count_segments(system: Model, axis: Range, location: SourceLocation) -> Iterator[DelaySegment]:
    """Yield a segment for each count of a range, from halfway to the one before to halfway to the next.

    Raises
    ------
    ApcError
        E881 a range that does not go from one integer to another, or over too many.
    """
    if axis.low.denominator != 1 or axis.high.denominator != 1:
        got = f"{float(axis.low):g} to {float(axis.high):g}"
        raise ApcError(Diagnostic("E881", location, f"the range of {axis.free.label}", "whole numbers", got))
    if axis.high - axis.low >= MOST_STRIPS:
        got = f"{int(axis.high - axis.low) + 1:,}"
        raise ApcError(Diagnostic("E881", location, axis.free.label, f"at most {MOST_STRIPS} counts", got))
    half = Fraction(1, 2)
    for count in range(int(axis.low), int(axis.high) + 1):
        inside = apply(system, [Override(axis.free, Fraction(count))])
        yield DelaySegment(max(axis.low, count - half), min(axis.high, count + half), None, inside)
