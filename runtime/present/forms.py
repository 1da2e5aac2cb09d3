"""The forms that all results share: plain data, JSON, indented notes.

Takes: frozen values, texts. Gives: `document`, `json_text`, `note`; `MEANT`.
Guarantees: a document is made of what JSON has words for; the same value gives the same text.
Does not: know a result.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from fractions import Fraction
from typing import Any

from apc.compiler.words import wrapped
from apc.later import Later

# What stable means by a criterion, where it is not that motions die out.
MEANT = {
    "mean-square": "stable in mean square, over the network as it is",
    "passive": "stable with every passive hand at every device",
}

PLAIN = {str, int, bool, type(None)}


def document(value: Any, instead: Mapping[str, Any] | None = None) -> Any:
    """Return a value as plain data: a dataclass by its fields, a complex number as a pair, no NaN.

    Parameters
    ----------
    value
        Dataclasses, mappings, sequences and arrays of numbers, texts and None.
    instead
        What is taken in the place of fields of a dataclass.
    """
    if type(value) in PLAIN:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, tuple | list | Later):
        return [document(one) for one in value]
    if isinstance(value, complex):
        return document((value.real, value.imag))
    if isinstance(value, Fraction):
        return float(value)
    if is_dataclass(value):
        kind: Any = type(value)
        own = instead or {}
        return {name: document(own[name] if name in own else getattr(value, name)) for name in _names(kind)}
    if isinstance(value, Mapping):
        return {key: document(one) for key, one in value.items()}
    return document(value.tolist())  # of an array


@functools.cache
def _names(kind: Any) -> tuple[str, ...]:
    """Return the names of a dataclass's fields that are shown: there are as many modes as states."""
    return tuple(one.name for one in fields(kind) if one.repr)


def json_text(found: Any, *, indent: int | None = 2) -> str:
    """Return plain data as one JSON document, on one line if `indent` is None.

    JSON has no word for what is no finite number: null stands in its place, as in `document`.
    """
    try:
        return json.dumps(found, ensure_ascii=False, allow_nan=False, indent=indent)
    except ValueError:
        return json.dumps(document(found), ensure_ascii=False, allow_nan=False, indent=indent)


def note(text: str) -> list[str]:
    """Return a text as lines that stand a little to the right."""
    return wrapped(text, "  ", "    ")
