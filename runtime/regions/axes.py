"""The axes of a stable region: two parameters of a model, and their ranges.

Takes: a `Model` and texts such as `contact.stiffness=10 N/m:3000 N/m`.
Gives: `parse_axes`; `LOCATION`.
Guarantees: a parameter that can't be an axis is refused, and said why.
Does not: analyse.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import with_unit
from apc.frame.parameter_names import Range, overlap, proposed_range, unit_of
from apc.parameter_studies.timing_values import refuse_phase
from apc.sweeps.grid import parse_axis

LOCATION = SourceLocation("region")

# The smallest relative width of a range: half the digits of a float remain to distinguish its points.
NARROWEST = Fraction(1, 2**26)

_FORM = "contact.stiffness=10 N/m:3000 N/m"


def parse_axes(
    system: Model, x: str | None, y: str | None, *, scale: Fraction = Fraction(1)
) -> tuple[Range, Range]:
    """Read the two axes of a region: `PATH=LOW:HIGH` each, or the model's own where one is left out.

    Parameters
    ----------
    system
        The model.
    x, y
        `contact.stiffness=10 N/m:3000 N/m`, or None for that of `studies: region:`.
    scale
        The divisor of the range of y.

    Raises
    ------
    ApcError
        E901 not of that form, or missing; E902 the same parameter twice; E903 a parameter that can't be an
        axis, or a range too narrow for floats; E622, E881, E204, E624 as `grid.parse_axis`.
    """
    intervals = []
    for letter, text, index in (("x", x, 0), ("y", y, 1)):
        if text is None and len(system.region) == 2:
            local = system.region[index]
            unit = unit_of(system, local.parameter)
            text = f"{local.parameter}={float(local.low)!r} {unit}:{float(local.high)!r} {unit}"
        if text is None:
            message = f"the topology has no studies: region:, so that --{letter} must be given"
            given = (y if letter == "x" else x) or ""
            other = given.partition("=")[0].strip()
            hint = f'--{letter} "{proposed_range(system, without=other)}"'
            raise ApcError(Diagnostic("E901", LOCATION, message, hint=hint))
        name, equals, span = (part.strip() for part in text.partition("="))
        if not (equals and name and span.count(":") == 1):
            hint = f'--{letter} "{_FORM}"'
            raise ApcError(
                Diagnostic("E901", LOCATION, f"--{letter}", "PATH=LOW:HIGH", text[:80] or "nothing", hint)
            )
        try:
            axis = parse_axis(system, name, span, ends=True)
        except ApcError as error:
            raise ApcError(
                replace(mistake, location=SourceLocation(f"--{letter}")) for mistake in error.mistakes
            ) from None
        refuse_phase(system, axis.free, LOCATION, code="E903")
        low, high = axis.values[0], axis.values[-1]
        least = NARROWEST * max(abs(low), abs(high))
        if high - low < least:
            expected = with_unit(f"a width of at least {float(least):.2g}", axis.unit)
            message, got = f"the range of {axis.free.label}", with_unit(f"{float(high - low):.2g}", axis.unit)
            raise ApcError(Diagnostic("E903", SourceLocation(f"--{letter}"), message, expected, got))
        intervals.append(Range(axis.free, axis.unit, axis.values[0], axis.values[-1]))
    first, second = intervals
    if overlap(system, first.free, second.free):
        item, other = first.free.label, second.free.label
        message = f"{item} is on both axes; a region has two parameters"
        if item != other:
            message = f"{item} and {other} are not apart: without a group it is that of all groups"
        raise ApcError(Diagnostic("E902", LOCATION, message))
    return first, replace(second, low=second.low / scale, high=second.high / scale)
