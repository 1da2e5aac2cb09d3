"""Names out of a scene as other tools want them.

Takes: names such as `left[2].cube.x`. Gives: `Port`, `words`; `identifier`; `unique`.
Guarantees: an identifier is made of letters, digits and `_`, begins with a letter, and is none of C's words;
of several no two are equal.
Does not: say which tool wants that.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

# Words of C, and names of its library and of the texts, that nothing else may be called.
_TEXT = """
auto break case char const continue default do double else enum extern float for goto if inline int long
register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while
main quanta instant missing y0 y1 yn j0 j1 jn gamma
"""
RESERVED = frozenset(_TEXT.split())


@dataclass(frozen=True, slots=True)
class Port:
    """An input, an output or a state: its name, such as `left[2].cube.x`, and its SI unit."""

    name: str
    unit: str


def words(ports: Sequence[Port]) -> list[str]:
    """Return an identifier for each of some names, of which no two are equal."""
    return [*unique(identifier(port.name) for port in ports)]


def identifier(name: str) -> str:
    """Return a name as programs have it: letters, digits and _, no word of C."""
    text = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "n"
    return f"n{text}" if text[0].isdigit() else f"{text}_" if text in RESERVED else text


def unique(names: Iterable[str], taken: Iterable[str] = ()) -> tuple[str, ...]:
    """Return names of which none is equal to another or taken: a repeated one gets a number behind."""
    used, texts = set(taken), []
    for base in names:
        name, count = base, 1
        while name in used:
            count += 1
            name = f"{base}_{count}"
        used.add(name)
        texts.append(name)
    return tuple(texts)
