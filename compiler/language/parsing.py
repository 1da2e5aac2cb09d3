"""The grammars of the language, read by Lark.

Takes: a grammar beside this module, and what its rules build.
Gives: `parser`, `ParseError`, `placing`, `TREE`, `kind_of`, `unclosed`, `exponent_of`, `check_size`.
Guarantees: a mistake knows the offset in its text, and its place once it is placed.
Does not: bound a text: whoever parses it does, before.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

from lark import Lark, Token, Transformer

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, place_in
from apc.compiler.words import cut

MAX_NUMBER_EXPONENT = 300  # of 1e300: still a float
TREE = Transformer[Token, Any]
_OPENED_BY = {"RPAR": "LPAR", "RBRACE": "LBRACE", "ELSE": "IF"}
_OPENERS = ("LPAR", "LBRACE", "IF", "THEN", "ELSEIF")


class ParseError(Exception):
    """A mistake that does not know yet where its text stands, so that results can be kept by text."""

    def __init__(
        self,
        code: str,
        at: int | Token | None,
        what: str,
        expected: str = "",
        got: str = "",
        hint: str = "",
        subject: str = "",
    ) -> None:
        super().__init__(what)
        self.offset = (at.start_pos if isinstance(at, Token) else at) or 0
        self.mistake = Diagnostic(code, SourceLocation(""), what, expected, got, hint, subject)


@contextmanager
def placing(text: str, place: SourceLocation) -> Iterator[None]:
    """Turn a FaultError of a text that starts at `place` into ApcError."""
    try:
        yield
    except ParseError as fault:
        at = place_in(place, text, fault.offset)
        raise ApcError(replace(fault.mistake, place=at)) from None


def parser(grammar: str, starts: list[str], builder: TREE) -> Callable[[str, str], Any]:
    """Return what parses a text by a grammar's file, from one of several starts.

    Its rules and tokens call the methods of `builder`.
    """
    text = Path(__file__).with_name(grammar).read_text(encoding="utf-8")
    return Lark(text, start=starts, parser="lalr", lexer="basic", transformer=builder).parse


def kind_of(value: object) -> str:
    """Return the kind of a token on the parser's stack, an empty text for what is built already."""
    return value.type if isinstance(value, Token) else ""


def check_size(number: str, at: int | Token, code: str) -> None:
    """Raise FaultError for a number, or a quotient of two, whose exponent no float has."""
    for exponent in re.findall(r"[eE]([+-]?[0-9]+)", number):
        if abs(int(exponent)) > MAX_NUMBER_EXPONENT:
            limit = f"an exponent from -{MAX_NUMBER_EXPONENT} to {MAX_NUMBER_EXPONENT}"
            raise ParseError(code, at, "a number", limit, cut(exponent))


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
