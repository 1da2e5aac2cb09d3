"""Parsers of the language from grammar files, by Lark.

Takes: a grammar in this folder, and the actions of its rules.
Gives: `parser`, `ParseError`, `placing`, `TREE`, `token_type_of`, `unclosed`, `exponent_of`, `check_size`.
Guarantees: an error has the offset in its text, and its location after placing.
Does not: limit the length of a text: this is done by the callers.
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

MAX_NUMBER_EXPONENT = 300  # 1e300 is in the range of floats
TREE = Transformer[Token, Any]
_OPENED_BY = {"RPAR": "LPAR", "RBRACE": "LBRACE", "ELSE": "IF"}
_OPENERS = ("LPAR", "LBRACE", "IF", "THEN", "ELSEIF")


class ParseError(Exception):
    """An error in a text, without the location of the text, so that results can be cached by text."""

    def __init__(
        self,
        code: str,
        at: int | Token | None,
        message: str,
        expected: str = "",
        got: str = "",
        fix: str = "",
        *,
        advice: str = "",
        subject: str = "",
    ) -> None:
        """Create the error at an offset or token of the text.

        The other arguments are the fields of a diagnostic.
        """
        super().__init__(message)
        self.offset = (at.start_pos if isinstance(at, Token) else at) or 0
        self.mistake = Diagnostic(code, SourceLocation(""), message, expected, got, fix, advice, subject)


@contextmanager
def placing(text: str, location: SourceLocation) -> Iterator[None]:
    """Convert a ParseError in a text that starts at `location` to an ApcError."""
    try:
        yield
    except ParseError as fault:
        at = location_in(location, text, fault.offset)
        raise ApcError(replace(fault.mistake, location=at)) from None


def parser(grammar: str, starts: list[str], builder: TREE) -> Callable[[str, str], Any]:
    """Return the parser of a grammar file, a function of a text and a start rule.

    The methods of `builder` are the actions of rules and tokens; `starts` are the possible start rules.
    """
    text = Path(__file__).with_name(grammar).read_text(encoding="utf-8")
    return Lark(text, start=starts, parser="lalr", lexer="basic", transformer=builder).parse


def token_type_of(value: object) -> str:
    """Return the type of a token on the parser's stack; empty for a completed node."""
    return value.type if isinstance(value, Token) else ""


def check_size(number: str, at: int | Token, code: str) -> None:
    """Raise ParseError for a number, or a quotient of numbers, with an exponent outside the range of
    floats.
    """
    for exponent in re.findall(r"[eE]([+-]?[0-9]+)", number):
        if abs(int(exponent)) > MAX_NUMBER_EXPONENT:
            limit = f"an exponent from -{MAX_NUMBER_EXPONENT} to {MAX_NUMBER_EXPONENT}"
            raise ParseError(code, at, f"number {cut(number)}", limit)


def unclosed(stack: Sequence[object]) -> int:
    """Return the stack index of the innermost open parenthesis, brace or `if`; -1 if there is none."""
    opener = ""
    for index in reversed(range(len(stack))):
        kind = token_type_of(stack[index])
        if opener:
            opener = "" if kind == opener else opener
        elif kind in _OPENERS:
            return index
        else:
            opener = _OPENED_BY.get(kind, "")
    return -1


def exponent_of(parts: Sequence[Token]) -> Fraction:
    """Return the number represented by the tokens of an exponent. Raises ZeroDivisionError."""
    numerator, *denominators = (Fraction(part) for part in parts if part.type == "NUMBER")
    return (-numerator if "-" in parts else numerator) / (denominators[0] if denominators else 1)
