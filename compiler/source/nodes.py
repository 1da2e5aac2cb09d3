"""The nodes of a YAML text with their locations, and its lines.

Takes: nothing (data types). Gives: `Scalar`, `Sequence`, `Mapping`, their union `Node`; `Lines`, `MAX_BYTES`.
Guarantees: plain frozen data; every place on a line shares the line's string.
Does not: read YAML (see `compose`), or interpret keys.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from apc.compiler.errors import SourceLocation

MAX_BYTES = 1 << 20  # 1 MiB; the largest topology we know of is a hundredth of it


@dataclass(frozen=True, slots=True)
class Scalar:
    """A leaf: `text` as written, quotes undone; `value` by the core schema; `plain` if it was unquoted."""

    text: str
    value: bool | int | float | str | None
    plain: bool
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class Sequence:
    """A list of nodes."""

    items: tuple[Node, ...]
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class Mapping:
    """Keys and nodes in the order of the text; no two keys have the same text."""

    entries: tuple[tuple[Scalar, Node], ...]
    location: SourceLocation

    def get(self, key: str) -> Node | None:
        """Return the node of a key, or None when the key is not there."""
        return next((node for scalar, node in self.entries if scalar.text == key), None)

    def keys(self) -> tuple[str, ...]:
        """Return the keys in the order of the text."""
        return tuple(scalar.text for scalar, _ in self.entries)


Node = Scalar | Sequence | Mapping


class Lines:
    """The lines of a text, each kept once: every `SourceLocation` on a line shares its string."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.lines = re.split(r"\r\n|\n|\r", text)

    def location(self, line: int, column: int) -> SourceLocation:
        """Return a place; `line` and `column` count from 0, as YAML's marks do."""
        source_line = self.lines[line] if line < len(self.lines) else ""
        return SourceLocation(self.file, line + 1, column + 1, source_line)

    def of(self, mark: Any) -> SourceLocation:
        """Return the place of a YAML mark."""
        return self.location(mark.line, mark.column)
