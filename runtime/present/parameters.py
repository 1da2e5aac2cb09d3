"""What may be set of a scene, as text and as data.

Takes: a `Parameters`. Gives: `parameters_text`, `parameters_document`.
Guarantees: a value stands in the unit that `--set` takes it in.
Does not: compute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from apc.compiler.words import beside, with_unit, wrapped
from apc.present.forms import document

if TYPE_CHECKING:
    from apc.frame.settable import Parameters, Settable

HOW = (
    '--set NAME="VALUE UNIT" sets one, in every command that analyses; words, as of a type, stand in the file'
)


def parameters_text(found: Parameters) -> str:
    """Return a line a number: name, value, limits, and what it is."""
    rows = [
        ("name", "value", "limits", ""),
        *((one.name, _value(one), _limits(one), _told(one)) for one in found.rows),
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = [f"{found.topology}: what may be set", ""]
    for *cells, told in rows:
        shown = "  ".join(f"{cell:<{width}}" for cell, width in zip(cells, widths, strict=True))
        lines += beside(f"  {shown}", told)
    return "\n".join([*lines, "", *wrapped(HOW, "  ", "  ")])


def _value(one: Settable) -> str:
    if one.low == one.high:
        return with_unit(f"{one.low:.9g}", one.unit)
    return with_unit(f"{one.low:.4g} to {one.high:.4g}", one.unit)


def _limits(one: Settable) -> str:
    low = "" if one.minimum is None else f"{'>' if one.open_minimum else '≥'} {one.minimum:.9g}"
    high = "" if one.maximum is None else f"≤ {one.maximum:.9g}"
    return ", ".join(limit for limit in (low, high) if limit)


def _told(one: Settable) -> str:
    fixed = f"not to be set: {one.fixed}" if one.fixed else ""
    follows = f"follows: {one.follows}" if one.follows else ""
    return "; ".join(part for part in (one.about, follows, fixed) if part)


def parameters_document(found: Parameters) -> dict[str, Any]:
    """Return the same as plain data, in SI."""
    whole: dict[str, Any] = document(found)
    return whole
