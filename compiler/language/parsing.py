"""The grammars of the language, read by Lark.

Takes: a grammar in this folder, and the actions of its rules.
Gives: `parser`, `ParseError`, `placing`, `TREE`, `token_type_of`, `unclosed`, `exponent_of`, `check_size`.
Guarantees: an error has the offset in its text, and its location after placing.
Does not: limit the length of a text: callers do.
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

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, location_in
from apc.compiler.wording import cut

MAX_NUMBER_EXPONENT = 300  # of 1e300: still a float
TREE = Transformer[Token, Any]
_OPENED_BY = {"RPAR": "LPAR", "RBRACE": "LBRACE", "ELSE": "IF"}
_OPENERS = ("LPAR", "LBRACE", "IF", "THEN", "ELSEIF")


class ParseError(Exception):
    """An error without the location of its text yet, so that results can be cached by text."""

    def __init__(
        self,
        code: str,
        at: int | Token | None,
        message: str,
        expected: str = "",
        got: str = "",
        hint: str = "",
        subject: str = "",
    ) -> None:
        super().__init__(message)
        self.offset = (at.start_pos if isinstance(at, Token) else at) or 0
        self.mistake = Diagnostic(code, SourceLocation(""), message, expected, got, hint, subject)


@contextmanager
def placing(text: str, location: SourceLocation) -> Iterator[None]:
    """Turn a FaultError of a text that starts at `location` into ApcError."""
    try:
        yield
    except ParseError as fault:
        at = location_in(location, text, fault.offset)
        raise ApcError(replace(fault.mistake, location=at)) from None


def parser(grammar: str, starts: list[str], builder: TREE) -> Callable[[str, str], Any]:
    """Return the parser of a grammar's file, with one of several start rules.

    Its rules and tokens call the methods of `builder`.
    """
    text = Path(__file__).with_name(grammar).read_text(encoding="utf-8")
    return Lark(text, start=starts, parser="lalr", lexer="basic", transformer=builder).parse


def token_type_of(value: object) -> str:
    """Return the type of a token on the parser's stack, an empty text for a completed node."""
    return value.type if isinstance(value, Token) else ""


def check_size(number: str, at: int | Token, code: str) -> None:
    """Raise FaultError for a number, or a quotient of two, whose exponent no float has."""
    for exponent in re.findall(r"[eE]([+-]?[0-9]+)", number):
        if abs(int(exponent)) > MAX_NUMBER_EXPONENT:
            limit = f"an exponent from -{MAX_NUMBER_EXPONENT} to {MAX_NUMBER_EXPONENT}"
            raise ParseError(code, at, "a number", limit, cut(exponent))


def unclosed(stack: Sequence[object]) -> int:
    """Return the stack position of the innermost open parenthesis, brace or `if`; -1 if none."""
    awaited = ""
    for at in reversed(range(len(stack))):
        kind = token_type_of(stack[at])
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
