"""The text of an expression to tokens.

Takes: a text and where it stands. Gives: `Token`, `tokens`.
Guarantees: every character is part of a token or refused by name (E321), every name is one of the language's
(E324); `**` reads as `^`; the last token is of the kind "end".
Does not: know which token may follow which (see `grammar`).
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NoReturn

from apc.compiler.errors import ApcError, Mistake, Place, place_in
from apc.compiler.language.expression import (
    KEYWORDS,
)
from apc.compiler.words import cut

_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+)"
    r"|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*(?:\[[0-9]+\])?(?:\.[A-Za-z_][A-Za-z0-9_]*(?:\[[0-9]+\])?)*)"
    r"|(?P<symbol>\*\*|<=|>=|==|!=|[-+*/^(){},<>=])"
)
_INDEX = re.compile(r"\[([0-9]+)\]")
_LOOKALIKES = {"−": "-", "–": "-", "×": "*", "·": "*", "⋅": "*", "÷": "/", "²": "^2", "³": "^3"} | {
    "≤": "<=",
    "≥": ">=",
    "≠": "!=",
}
_UNEXPECTED = {
    "[": "an index is a whole number right behind its name, as in finger[2]",
    ".": "only a name can be followed by a dot and another name",
    "'": "an expression holds no quoted text",
    '"': "an expression holds no quoted text",
    "!": "an opposite is written not, an inequality !=",
    "&": "two conditions are joined by and",
    "|": "two conditions are joined by or",
    "%": "there is no % in an expression; write a hundredth as 0.01",
}


@dataclass(frozen=True, slots=True)
class Token:
    """A piece of a text: `start` and `end` are offsets into it."""

    kind: str  # "number", "name", "end", or the keyword or symbol itself
    text: str
    start: int
    end: int


def tokens(text: str, place: Place) -> Iterator[Token]:
    """Split a text; `**` becomes `^`."""
    at = 0
    while at < len(text):
        found = _TOKEN.match(text, at)
        if found is None:
            _refuse_character(text, place, at)
        token, kind = found.group(), found.lastgroup or ""
        if kind == "symbol":
            kind = token = "^" if token == "**" else token
        elif token in KEYWORDS:
            kind = token
        elif kind == "name":
            _check_name(token, text, place, at)
        if kind != "space":
            yield Token(kind, token, at, found.end())
        at = found.end()
    yield Token("end", "", len(text), len(text))


def _refuse_character(text: str, place: Place, at: int) -> NoReturn:
    """Raise E321: what the character is, and what was probably meant."""
    character, where = text[at], place_in(place, text, at)
    if character in _UNEXPECTED:
        what = f"{character} cannot stand here: {_UNEXPECTED[character]}"
        raise ApcError(Mistake("E321", where, what))
    got = character if character.isascii() and character.isprintable() else ""
    if not got:
        name = unicodedata.name(character, "no character that has a name")
        got = f"{character if character.isprintable() else ''} (U+{ord(character):04X}, {name})".lstrip()
    expected, hint = "ASCII letters, digits and + - * / ^ ( )", _LOOKALIKES.get(character, "")
    raise ApcError(Mistake("E321", where, "an expression", expected, got, hint))


def _check_name(name: str, text: str, place: Place, at: int) -> None:
    """Raise E324 for a name that can't be one."""
    where = place_in(place, text, at)
    for segment in name.split("."):
        if segment.startswith("_"):
            raise ApcError(Mistake("E324", where, "a name", "a letter first", cut(name)))
        if segment in KEYWORDS:
            raise ApcError(Mistake("E324", where, f"{segment} is a word of the language, not a name"))
    for index in _INDEX.findall(name):
        if index.startswith("0") or len(index) > 9:
            raise ApcError(Mistake("E324", where, "an index", "a whole number counted from 1", cut(index)))
