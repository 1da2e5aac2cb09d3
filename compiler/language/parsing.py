"""The grammars of the language, read by Lark.

Takes: a grammar beside this module, and what its rules build.
Gives: `parser`, `FaultError`, `TREE`, `kind_of`, `unclosed`, `exponent_of`.
Guarantees: a mistake knows the offset in its text, and its place once it is placed.
Does not: bound a text: whoever parses it does, before.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from lark import Lark, Token, Transformer

from apc.compiler.errors import ApcError, Mistake, Place, place_in

TREE = Transformer[Token, Any]
_OPENED_BY = {"RPAR": "LPAR", "RBRACE": "LBRACE", "ELSE": "IF"}
_OPENERS = ("LPAR", "LBRACE", "IF", "THEN", "ELSEIF")


class FaultError(Exception):
    """A mistake that does not know yet where its text stands, so that results can be kept by text."""

    def __init__(self, code: str, offset: int | None, *words: str, hint: str = "") -> None:
        super().__init__(*words)
        self.code, self.offset, self.words, self.hint = code, offset or 0, words, hint

    def placed(self, text: str, place: Place) -> ApcError:
        """Return the mistake of a text that starts at `place`."""
        return ApcError(Mistake(self.code, place_in(place, text, self.offset), *self.words, hint=self.hint))


def parser(grammar: str, starts: list[str], builder: TREE) -> Lark:
    """Return the parser of a grammar's file, whose rules and tokens call the methods of `builder`."""
    text = Path(__file__).with_name(grammar).read_text(encoding="utf-8")
    return Lark(text, start=starts, parser="lalr", lexer="basic", transformer=builder)


def kind_of(value: object) -> str:
    """Return the kind of a token on the parser's stack, an empty text for what is built already."""
    return value.type if isinstance(value, Token) else ""


def unclosed(stack: Sequence[object]) -> int:
    """Return where on the parser's stack the innermost parenthesis, brace or `if` is open; -1 if none is."""
    awaited = ""
    for at in reversed(range(len(stack))):
        kind = kind_of(stack[at])
        if awaited:
            awaited = "" if kind == awaited else awaited
        elif kind in _OPENERS:
            return at
        else:
            awaited = _OPENED_BY.get(kind, "")
    return -1


def exponent_of(parts: Sequence[Token]) -> Fraction:
    """Return the number that the tokens of an exponent are. Raises ZeroDivisionError."""
    above, *below = (Fraction(part) for part in parts if part.type == "NUMBER")
    return (-above if "-" in parts else above) / (below[0] if below else 1)
