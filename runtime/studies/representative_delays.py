"""Delays that represent a range: the ends and middles of segments in which a model is constant.

Takes: a `Model` and a range of the delay of one of its links.
Gives: `is_delay`, `representative_delays`; `LOCATION`.
Guarantees: packets are read at ticks, so that the model is constant between two delays at which a packet is
read a tick later.
Does not: analyze a model.
"""

from __future__ import annotations

from collections.abc import Iterator
from fractions import Fraction

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.parameter_names import ParameterRef, Range
from apc.studies.delay_segments import delay_segments

LOCATION = SourceLocation("box")


def is_delay(model: Model, parameter_ref: ParameterRef) -> bool:
    """Return whether a timing is the delay of a link, or of some pairs of its peers."""
    return any(parameter_ref.name in link.delays for link in model.links)


def representative_delays(model: Model, delay: Range) -> Iterator[tuple[Fraction, Fraction]]:
    """Yield delays to analyse, each with the length of the segment that it represents, in seconds.

    They are the lower end (length 0) and the midpoint (length of the segment) of each segment between
    coincidences of events, and the upper end of the range (length 0).

    Raises
    ------
    ApcError
        E831 the delay also delays forces, so that instants of events change continuously with it.
    """
    segments = delay_segments(numeric_model(model), delay.free, delay.low, location=LOCATION, high=delay.high)
    for segment in segments:
        if segment.evaluator is not None:
            message = f"{delay.free.label} also delays forces; only pure link delays can be ranges"
            raise ApcError(Diagnostic("E831", LOCATION, message, fix=f"apc critical {delay.free.label}"))
        high = min(segment.high, delay.high)
        yield segment.low, Fraction(0)
        yield (segment.low + high) / 2, high - segment.low
    yield delay.high, Fraction(0)
