"""A command that ran in the process of a test: its code, and what it said."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple


class Ran(NamedTuple):
    """How a command ended: its code, its output, and what it said on stderr."""

    code: int
    out: str
    err: str


Cli = Callable[..., Ran]


def write(name: str, text: str) -> None:
    """Write a file of the working folder."""
    Path(name).write_text(text, encoding="utf-8")


def folder() -> list[str]:
    """Return the names in the working folder."""
    return sorted(path.name for path in Path().iterdir())
