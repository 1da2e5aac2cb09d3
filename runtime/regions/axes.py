"""The axes of a stable region: two parameters of a model, and their ranges.

Takes: a `Model` and texts such as `contact.stiffness=10 N/m:3000 N/m`.
Gives: `parse_axes`; `LOCATION`.
Guarantees: a parameter that cannot be an axis raises an error with the reason.
Does not: analyse.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import with_unit
from apc.parameter_values.parameter_names import Range, overlap, proposed_range
from apc.studies.grid import parse_axis
from apc.studies.timing_values import refuse_phase
from apc.support.option_value import NamedValues, named_values

LOCATION = SourceLocation("region")

# The smallest relative width of a range: half the digits of a float remain to distinguish its points.
NARROWEST = Fraction(1, 2**26)

_FORM = "contact.stiffness=10 N/m:3000 N/m"


def parse_axes(
    model: Model, x: str | NamedValues | None, y: str | NamedValues | None, *, scale: Fraction = Fraction(1)
) -> tuple[Range, Range]:
    """Return the two axes of a region from texts `PATH=LOW:HIGH`, by default the model's own axes.

    Parameters
    ----------
    model
        The model.
    x, y
        Texts such as `contact.stiffness=10 N/m:3000 N/m`, or names with the two ends; None is the axis of
        `studies: region:`.
    scale
        The divisor of the range of y.

    Raises
    ------
    ApcError
        E901 another form of text, or a missing axis; E902 the same parameter twice; E903 a parameter that
        cannot be an axis, or a range too narrow for floats; E622, E881, E204, E624 as for `grid.parse_axis`.
    """
    intervals = []
    for letter, given, index in (("x", x, 0), ("y", y, 1)):
        if given is None and len(model.region) == 2:
            local = model.region[index]
            given = local.parameter, (local.low, local.high)
        if given is None:
            message = f"--{letter} is missing, and the topology has no studies.region"
            other = named_values((y if letter == "x" else x) or "")[0]
            fix = f'--{letter} "{proposed_range(model, without=other)}"'
            raise ApcError(Diagnostic("E901", LOCATION, message, fix=fix))
        name, span = named_values(given)
        if not name or (span.count(":") != 1 if isinstance(span, str) else len(span) != 2):
            fix, got = f'--{letter} "{_FORM}"', str(given)[:80] or "nothing"
            raise ApcError(Diagnostic("E901", LOCATION, f"--{letter}", "PATH=LOW:HIGH", got, fix))
        try:
            axis = parse_axis(model, name, span, ends=True)
        except ApcError as error:
            raise ApcError(
                replace(mistake, location=SourceLocation(f"--{letter}")) for mistake in error.mistakes
            ) from None
        refuse_phase(model, axis.free, LOCATION, code="E903")
        low, high = axis.values[0], axis.values[-1]
        least = NARROWEST * max(abs(low), abs(high))
        if high - low < least:
            expected = with_unit(f"a width of at least {float(least):.2g}", axis.unit)
            message, got = f"range of {axis.free.label}", with_unit(f"{float(high - low):.2g}", axis.unit)
            raise ApcError(Diagnostic("E903", SourceLocation(f"--{letter}"), message, expected, got))
        intervals.append(Range(axis.free, axis.unit, axis.values[0], axis.values[-1]))
    first, second = intervals
    if overlap(model, first.free, second.free):
        item, other = first.free.label, second.free.label
        message = f"{item} is on both axes; a region needs two parameters"
        if item != other:
            message = f"{item} and {other} overlap: a parameter without a group includes all groups"
        raise ApcError(Diagnostic("E902", LOCATION, message))
    return first, replace(second, low=second.low / scale, high=second.high / scale)
