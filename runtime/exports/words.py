"""Names out of a scene as other tools want them.

Takes: names such as `left[2].cube.x`. Gives: `Port`, `word`, `words`.
Guarantees: a word is made of letters, digits and `_`, and begins with a letter; of several no two are alike.
Does not: say which tool wants that.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Port:
    """An input, an output or a state: its name, such as `left[2].cube.x`, and its SI unit."""

    name: str
    unit: str


def words(ports: Sequence[Port]) -> list[str]:
    """Return a word for each of some names."""
    found: list[str] = []
    taken: set[str] = set()
    for port in ports:
        one = own = word(port.name)
        number = 1
        while one in taken:
            number += 1
            one = f"{own}_{number}"
        taken.add(one)
        found.append(one)
    return found


def word(name: str) -> str:
    """Return a name as a word."""
    found = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")
    return found if found[:1].isalpha() else f"x_{found}".rstrip("_")
