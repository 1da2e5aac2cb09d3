"""What a sweep can compute at each of its points.

Takes: a `CompiledSystem` and a name such as `analyze` or `critical:coordination.stiffness`.
Gives: `Quantity`, `QUANTITIES`, `find_quantity`, `faulty`.
Guarantees: what all points share is prepared once; a row depends on its point's numbers alone, not on the
points before it; a number that isn't finite is left out of a row.
Does not: choose points, or hold results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from apc.analysis.analysis import analyze, prepare
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place, nearest
from apc.eigen.spectrum import finite
from apc.frame.names import find, unit_of
from apc.tables import Column, Row

PLACE = Place("sweep")

# What stands in the verdict's column of a point whose numbers can't be computed with.
FAULT = "error: "


VERDICT = Column("verdict", "", "text")
MESSAGE = Column("message", "", "text")


@dataclass(frozen=True, slots=True)
class Quantity:
    """A result of one point: `evaluate` gives a row's cells, in the order of `columns`.

    The first column is the verdict, the last a message, empty but where a point is at fault.
    """

    columns: tuple[Column, ...]
    evaluate: Callable[[CompiledSystem], Row]


def find_quantity(system: CompiledSystem, text: str) -> Quantity:
    """Return the quantity a text names, ready to be evaluated with any numbers of the system.

    Parameters
    ----------
    system
        The scene whose points are to be computed.
    text
        `NAME`, or `NAME:ARGUMENT` where the quantity takes one.

    Raises
    ------
    ApcError
        E884 no such quantity; what the quantity's own argument can be wrong in.
    """
    name, _, argument = text.partition(":")
    make = QUANTITIES.get(name.strip())
    if make is None:
        what = f"{name[:80] or 'an empty name'} is nothing a sweep computes ({', '.join(QUANTITIES)})"
        raise ApcError(Mistake("E884", PLACE, what, hint=nearest(name, QUANTITIES)))
    return make(system, argument.strip())


def faulty(columns: tuple[Column, ...], error: ApcError) -> Row:
    """Return the row of a point at fault: the message's code as its verdict, and the message."""
    first = error.mistakes[0]
    return (FAULT + first.code, *(None for _ in columns[1:-1]), first.sentence)


def _analyze(system: CompiledSystem, argument: str) -> Quantity:
    """Return the verdict, the spectral radius, and how the leading mode moves."""
    if argument:
        raise ApcError(Mistake("E884", PLACE, "analyze", "no parameter", argument[:80], "--of analyze"))
    columns = (
        VERDICT,
        Column("spectral_radius", "", "number"),
        Column("spectral_radius_error", "", "number"),
        Column("rigid_modes", "", "count"),
        Column("frequency", "Hz", "number"),
        Column("damping_ratio", "", "number"),
        MESSAGE,
    )
    prepared = prepare(system)

    def evaluate(changed: CompiledSystem) -> Row:
        found = analyze(changed, prepared=prepared)
        leading = found.modes[0] if found.modes else None
        return (
            found.verdict,
            finite(found.spectral_radius),
            finite(found.spectral_radius_error),
            found.rigid_modes,
            finite(leading.frequency_hz) if leading else None,
            finite(leading.damping_ratio) if leading else None,
            "",
        )

    return Quantity(columns, evaluate)


def _critical(system: CompiledSystem, argument: str) -> Quantity:
    """Return the value at which the verdict changes with one parameter, and on which side it is stable."""
    from apc.vary.critical import critical  # a sweep of verdicts needs none of it

    if not argument:
        form = "--of critical:coordination.stiffness"
        raise ApcError(Mistake("E884", PLACE, "critical", "a parameter", "nothing", form))
    unit = unit_of(system, find(system, argument, PLACE).name)
    shown = "" if unit == "1" else unit
    columns = (
        VERDICT,
        Column("value", shown, "number"),
        Column("error", shown, "number"),
        Column("crossings", "", "count"),
        Column("proof", "", "text"),
        MESSAGE,
    )

    def evaluate(changed: CompiledSystem) -> Row:
        found = critical(changed, argument)
        if found.value is None or found.error is None:
            return (found.verdict, None, None, 0, None, "")
        verdict = f"stable {found.stable_side} the value"
        proof = next(one.proof for one in found.crossings if one.value == found.value)
        return (verdict, finite(found.value), finite(found.error), len(found.crossings), proof, "")

    return Quantity(columns, evaluate)


QUANTITIES: Mapping[str, Callable[[CompiledSystem, str], Quantity]] = {
    "analyze": _analyze,
    "critical": _critical,
}
