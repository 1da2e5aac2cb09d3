"""Catalogue of message codes: title, cause, remedy and an example of each code.

Takes: message_catalogue.yaml.
Gives: `MessageEntry`, `MessageExample`; `catalogue`, `ranges`, `without_example`.
Guarantees: the file is read once; entries are in the order of the file, by ranges of codes.
Does not: define messages, or run examples.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml

_FILE = Path(__file__).with_suffix(".yaml")


@dataclass(frozen=True, slots=True)
class MessageExample:
    """A command and the message that it prints, without location; `…` represents any text.

    The command runs in a folder with the topologies of the library. If `files` is not empty, the folder
    contains these files only: pairs of path and text, among them topology.yaml if a topology is given.
    """

    command: str
    message: str
    files: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class MessageEntry:
    """A message code with its title, what causes the message, and what the user does."""

    code: str
    title: str
    cause: str
    remedy: str
    example: MessageExample | None = None


@cache
def catalogue() -> Mapping[str, MessageEntry]:
    """Return the entries of all message codes, by code.

    Examples
    --------
    >>> catalogue()["E101"].title
    'missing file'
    """
    entries = {key: value for key, value in _document().items() if key not in ("ranges", "without_example")}
    return MappingProxyType({code: _entry(code, fields) for code, fields in entries.items()})


def ranges() -> Mapping[str, str]:
    """Return the heading of each range of codes, by the first two characters of its codes."""
    return MappingProxyType(_document()["ranges"])


def without_example() -> Mapping[str, str]:
    """Return the reason of each code that has no example."""
    return MappingProxyType(_document()["without_example"])


@cache
def _document() -> dict[str, Any]:
    """Return the nodes of the file."""
    result: dict[str, Any] = yaml.safe_load(_FILE.read_text(encoding="utf-8"))
    return result


def _entry(code: str, fields: Mapping[str, Any]) -> MessageEntry:
    """Return the entry of a code from its mapping in the file."""
    example = fields.get("example")
    if example is None:
        return MessageEntry(code, fields["title"], fields["cause"], fields["remedy"])
    topology = (("topology.yaml", example["text"]),) if "text" in example else ()
    files = (*topology, *example.get("files", {}).items())
    printed = MessageExample(example["command"], example["message"], files)
    return MessageEntry(code, fields["title"], fields["cause"], fields["remedy"], printed)
