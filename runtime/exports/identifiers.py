"""Identifiers for other tools from the names of a model.

Takes: names such as `left[2].cube.x`. Gives: `ExportedSignal`, `words`; `identifier`; `prefixed`; `unique`.
Guarantees: an identifier consists of letters, digits and `_`, begins with a letter, and is no reserved word
of C; several identifiers are distinct. A prefixed identifier is no word or macro of C or C++ either.
Does not: select the tool.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

# Keywords of C, and names of its library that an identifier without a prefix could have.
_TEXT = """
auto break case char const continue default do double else enum extern float for goto if inline int long
register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while
main y0 y1 yn j0 j1 jn gamma M_SQRT1_2
"""
RESERVED = frozenset(_TEXT.split())


@dataclass(frozen=True, slots=True)
class ExportedSignal:
    """An input, an output or a state: its name, such as `left[2].cube.x`, and its SI unit."""

    name: str
    unit: str


def words(ports: Sequence[ExportedSignal]) -> list[str]:
    """Return distinct identifiers for the names of some signals."""
    return [*unique(identifier(port.name) for port in ports)]


def identifier(name: str) -> str:
    """Return an identifier for a name: letters, digits and _, no reserved word of C."""
    text = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "n"
    return f"n{text}" if text[0].isdigit() else f"{text}_" if text in RESERVED else text


def prefixed(prefix: str, names: Iterable[str]) -> tuple[str, ...]:
    """Return distinct identifiers with a prefix for some names, such as `link_lan`.

    No keyword, macro or identifier that a template writes itself begins with such a prefix and `_`.
    """
    return unique(
        f"{prefix}_{word}" for word in (re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") for name in names)
    )


def unique(names: Iterable[str]) -> tuple[str, ...]:
    """Return distinct names: a number is appended to a repeated name."""
    used, texts, counts = set[str](), list[str](), dict[str, int]()
    for base in names:
        name, count = base, counts.get(base, 1)
        while name in used:
            count += 1
            name = f"{base}_{count}"
        counts[base] = count
        used.add(name)
        texts.append(name)
    return tuple(texts)
