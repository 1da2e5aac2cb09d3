"""The nodes of a YAML text with their locations, and its lines.

Takes: nothing (data types). Gives: `Scalar`, `Sequence`, `Mapping`, their union `Node`; `Lines`, `MAX_BYTES`.
Guarantees: plain frozen data; all locations on a line share the string of the line.
Does not: read YAML (see `compose`), or interpret keys.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from apc.compiler.errors import SourceLocation

MAX_BYTES = 1 << 20  # 1 MiB; the largest known topology has a hundredth of this size


@dataclass(frozen=True, slots=True)
class Scalar:
    """A leaf: `text` without quotes; `value` by the core schema; `plain` if it was unquoted."""

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
    """Keys and their nodes in the order of the text; keys are unique."""

    entries: tuple[tuple[Scalar, Node], ...]
    location: SourceLocation

    def get(self, key: str) -> Node | None:
        """Return the node of a key, or None if there is no such key."""
        return next((node for scalar, node in self.entries if scalar.text == key), None)

    def keys(self) -> tuple[str, ...]:
        """Return the keys in the order of the text."""
        return tuple(scalar.text for scalar, _ in self.entries)


Node = Scalar | Sequence | Mapping


class Lines:
    """The lines of a text: every `SourceLocation` on a line shares its string."""

    def __init__(self, file: str, text: str) -> None:
        self.file = file
        self.lines = re.split(r"\r\n|\n|\r", text)

    def location(self, line: int, column: int) -> SourceLocation:
        """Return the location of a line and column, which count from 0 as in YAML marks."""
        source_line = self.lines[line] if line < len(self.lines) else ""
        return SourceLocation(self.file, line + 1, column + 1, source_line)

    def of(self, mark: Any) -> SourceLocation:
        """Return the location of a YAML mark."""
        return self.location(mark.line, mark.column)
