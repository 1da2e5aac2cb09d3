"""The equilibrium of a model as text and plain data.

Takes: an `OperatingPoint`.
Gives: `operating_point_text`, `operating_point_document`; `rest_lines`, the table in an analysis.
Guarantees: positions in the units of the topology; plain data in SI.
Does not: compute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apc.output.formatting import Lines, Plain, headed, labelled, quantity, record

if TYPE_CHECKING:
    from apc.lifting.rest_position import OperatingPoint

MOST_POSITIONS = 12  # rows in an analysis; apc.operating_point has all


def operating_point_text(result: OperatingPoint) -> Lines:
    """Yield the equilibrium of a model: positions, contacts and the residual."""
    begun = "end of a simulation" if result.initial == "simulation" else "start values"
    yield f"{result.topology}: equilibrium, from the {begun}"
    yield from headed("Positions", rest_lines(result, most=len(result.positions)))


def rest_lines(result: OperatingPoint, *, most: int = MOST_POSITIONS) -> Lines:
    """Yield the first positions of an equilibrium, its contacts and limits, and the residual force."""
    shown = result.positions[:most]
    yield from labelled(*((position.name, position.text) for position in shown))
    if len(shown) < len(result.positions):
        yield f"  … {len(result.positions) - len(shown)} more: apc.operating_point"
    on, off = (", ".join(name for name, active in result.active if active is side) for side in (True, False))
    residual = f"below {quantity(result.tolerance, result.residual_unit, 2)}"
    yield from labelled(("on", on), ("off", off), ("residual", residual))


def operating_point_document(result: OperatingPoint) -> Plain:
    """Return the equilibrium as plain data in SI."""
    active = dict(result.active)
    return record(result, {"active": active, "model": ...})
