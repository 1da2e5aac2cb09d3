"""What may be set of a scene, as text and as data.

Takes: a `Parameters`. Gives: `parameters_text`.
Guarantees: a value stands in the unit that `--set` takes it in.
Does not: compute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from apc.compiler.words import with_unit
from apc.present.forms import Lines, quantity, sentences, table

if TYPE_CHECKING:
    from apc.frame.settable import Parameters, Settable

HOW = (
    '--set NAME="VALUE UNIT" sets one, in every command that analyses; words, as of a type, stand in the file'
)


def parameters_text(found: Parameters) -> Lines:
    """Yield a line a number: name, value, limits, and what it is."""
    yield f"{found.topology}: what may be set\n"
    rows = [(one.name, _value(one), _limits(one), _told(one)) for one in found.rows]
    yield from table([("name", "value", "limits", ""), *rows], later=6)
    yield ""
    yield from sentences(HOW)


def _value(one: Settable) -> str:
    if one.low == one.high:
        return quantity(one.low, one.unit, 9)
    return with_unit(f"{one.low:.4g} to {one.high:.4g}", one.unit)


def _limits(one: Settable) -> str:
    low = "" if one.minimum is None else f"{'>' if one.open_minimum else '≥'} {one.minimum:.9g}"
    high = "" if one.maximum is None else f"≤ {one.maximum:.9g}"
    return ", ".join(limit for limit in (low, high) if limit)


def _told(one: Settable) -> str:
    fixed = f"not to be set: {one.fixed}" if one.fixed else ""
    follows = f"follows: {one.follows}" if one.follows else ""
    return "; ".join(part for part in (one.about, follows, fixed) if part)
