"""Numbers of peers as samples: of a search, and along an axis of a region.

Takes: a `Model` and the count of one of its groups, or a number on which counts depend.
Gives: `count_range`, `whole_range`, `count_segments`.
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
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, Range
from apc.studies.delay_segments import DelaySegment
from apc.studies.parameter_path import SPAN

# The default range on graphs that are not complete, as a multiple of the present count.
PLACED_SPAN = 10

# Strips of a region over a count.
MOST_STRIPS = 200


def count_range(
    model: Model,
    parameter_ref: ParameterRef,
    limits: Sequence[Fraction | None],
    present: float,
    location: SourceLocation,
) -> tuple[int, int]:
    """Return the lowest and the highest count of a search.

    Parameters
    ----------
    model, parameter_ref
        The compiled model, and a count of it or a number on which counts depend.
    limits
        The two given limits; None is the minimum of the model, or `SPAN` times the present count
        (`PLACED_SPAN` on a graph that is not complete).
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
    of_group = any(parameter_ref.name == group_count(group.name) for group in model.groups)
    other_peers = model.peers - int(present) if of_group else 0
    least = max(_least_count(model, parameter_ref.name), least_peers(model.peer_types) - other_peers)
    first = _integer_limit(low, least, location)
    incomplete_graph = any(link.graph.shape != "complete" for link in model.links)
    span = PLACED_SPAN if incomplete_graph else SPAN  # there each peer has an index in the graph
    largest_allowed = min(
        (
            parameter.maximum
            for parameter in model.parameters
            if parameter.name == parameter_ref.name and parameter.maximum is not None
        ),
        default=math.inf,
    )
    return first, _integer_limit(
        high, int(min(max(math.ceil(span * present), first + 1), largest_allowed)), location
    )


def _least_count(model: Model, count: str) -> int:
    """Return the smallest count of a group: two if a mean, maximum or minimum receives from it alone, else 1.

    `count` is the name of a parameter; that of no group has the limit 1.
    """
    reduced = {
        receive.link
        for peer_type in model.peer_types
        for partition in peer_type.clocks
        for receive in partition.receives
        if receive.operator != "sum"
    }
    for link in model.links:
        senders: dict[str, set[str]] = {}
        for sender, receiver, _ in link.graph.groups if link.name in reduced else ():
            senders.setdefault(group_count(receiver), set()).add(group_count(sender))
        if senders.get(count) == {count}:
            return 2
    return 1


def _integer_limit(limit: Fraction | None, default: int, location: SourceLocation) -> int:
    """Return a limit as an integer, the default if it is None; an error E842 if it is no integer."""
    if limit is None:
        return default
    if limit.denominator != 1:
        raise ApcError(
            Diagnostic("E842", location, "number of peers", "a whole number", f"{float(limit):.12g}")
        )
    return int(limit)


def whole_range(label: str, low: Fraction, high: Fraction) -> str:
    """Return a text `NAME=LOW:HIGH` of the whole numbers between two ends; empty if there are none."""
    first, last = math.ceil(low), math.floor(high)
    return f"{label}={first}:{last}" if first < last else ""


def count_segments(model: Model, axis: Range, location: SourceLocation) -> Iterator[DelaySegment]:
    """Yield a segment for each count of a range, with ends halfway to the neighbouring counts.

    Raises
    ------
    ApcError
        E881 a range whose ends are no integers, or with too many counts.
    """
    if axis.low.denominator != 1 or axis.high.denominator != 1:
        got = f"{float(axis.low):g} to {float(axis.high):g}"
        subject, fix = f"range of {axis.free.label}", whole_range(axis.free.label, axis.low, axis.high)
        raise ApcError(Diagnostic("E881", location, subject, "whole numbers", got, fix))
    if axis.high - axis.low >= MOST_STRIPS:
        got = f"{int(axis.high - axis.low) + 1:,}"
        expected, most = f"at most {MOST_STRIPS} counts", axis.low + MOST_STRIPS - 1
        fix = whole_range(axis.free.label, axis.low, most)
        raise ApcError(Diagnostic("E881", location, axis.free.label, expected, got, fix))
    half = Fraction(1, 2)
    for count in range(int(axis.low), int(axis.high) + 1):
        inside = apply(model, [Override(axis.free, Fraction(count))])
        yield DelaySegment(max(axis.low, count - half), min(axis.high, count + half), None, inside)
