"""Parser of expressions and equations.

Takes: a text and its location. Gives: `parse_expression`, `parse_equation`.
Guarantees: length, depth, digits and exponents are bounded, so parsing always ends soon;
`parse_expression(format_expression(e)) == e` for every parsed `e`; nothing is ever run as Python.
Does not: resolve names or units.

The grammar is expression.lark; Lark reads it.
"""

from __future__ import annotations

import contextlib
import re
import unicodedata
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import cache, lru_cache
from itertools import accumulate, takewhile
from typing import Any, NoReturn

from lark import Token
from lark.exceptions import UnexpectedCharacters, UnexpectedToken

from apc.compiler.errors import SourceLocation, nearest
from apc.compiler.language.expression import (
    CONDITIONS,
    FUNCTIONS,
    KEYWORDS,
    PI,
    Call,
    Equation,
    Expr,
    Name,
    NumberLiteral,
    children,
    format_expression,
    interval_of,
)
from apc.compiler.language.parsing import (
    TREE,
    ParseError,
    check_size,
    exponent_of,
    parser,
    placing,
    token_type_of,
    unclosed,
)
from apc.compiler.wording import cut

SIMILAR = 0.8  # of the letters of a function's name, for another to be the one that was meant
MAX_LENGTH = 10_000  # characters of an expression
MAX_DEPTH = 100  # levels of the tree; Python's own stack allows about 300
TOO_DEEP = f"this is nested or chained more than {MAX_DEPTH} deep: give a part of it a name"
MAX_DIGITS = 1000  # characters of a number: Python refuses an integer of 4300 digits
MAX_POWER = 100  # of x^100

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
_CLOSERS = {"LPAR": ")", "LBRACE": "}", "IF": "then", "ELSEIF": "then", "THEN": "else"}
_STRAY = {
    ")": "this ) closes nothing",
    "}": "this } closes nothing",
    ",": "commas stand between arguments, or entries of a vector, only",
    "=": "an expression wants one value, got an equation",
}
_OPENED = {"LPAR": "an opened (", "LBRACE": "an opened {", "THEN": "an if … then"}


def parse_expression(text: str, location: SourceLocation) -> Expr:
    """Return the tree of an expression that is a number; conditions occur inside an `if` only.

    Parameters
    ----------
    text
        One expression.
    location
        The location of the first character of `text`; errors are reported relative to it.

    Raises
    ------
    ApcError
        E321 a character, E322 a wrong or missing token, E323 a number, E324 a name, E325 a function,
        E326 an exponent, E327 a condition where a number is due or the reverse, E328 too long or too deep.
    """
    with placing(text, location):
        expr: Expr = _parsed(text, "expression")[0]
        _check(expr, text)
        return expr


def parse_equation(text: str, location: SourceLocation) -> Equation:
    """Return both sides of `left = right`: as `parse_expression`, and E329 unless there is just one `=`."""
    with placing(text, location):
        left, *others = _parsed(text, "equation")
        if isinstance(left, Call) and left.function == "==" and not others:
            # The usual slip: `a == b` for `a = b`.
            hint = " = ".join(map(format_expression, left.arguments))
            raise ParseError("E329", len(text), "an equation", "one =", "==, which compares", hint=hint)
        if not others:
            raise ParseError("E329", len(text), "an equation", "one =, as in a = b", "none")
        if len(others) > 2:
            raise ParseError("E329", others[2], "an equation", "one =", "a second one")
        _check(left, text)
        _check(others[1], text)
        return Equation(left, others[1], text, location)


@lru_cache(maxsize=1024)
def _parsed(text: str, start: str) -> list[Any]:
    """Return an expression, or the sides of an equation with the positions of the signs between them."""
    if len(text) > MAX_LENGTH:
        expected = f"at most {MAX_LENGTH} characters"
        raise ParseError("E328", 0, "an expression", expected, f"{len(text)}")
    nesting = accumulate((c in "({") - (c in ")}") for c in text)
    if (deep := next((at for at, depth in enumerate(nesting) if depth >= MAX_DEPTH), None)) is not None:
        raise ParseError("E328", deep + 1, TOO_DEEP)
    try:
        sides: list[Any] = _grammar()(text, start)
    except UnexpectedCharacters as fault:
        _refuse_character(text, fault.pos_in_stream or 0)
    except UnexpectedToken as fault:
        _refuse_token(text, fault)
    return sides


@cache
def _grammar() -> Callable[[str, str], Any]:
    return parser("expression.lark", ["expression", "equation"], _Trees())


def _refuse_character(text: str, at: int) -> NoReturn:
    """Raise E321: the invalid character, with the probable intention."""
    character = text[at]
    if character in _UNEXPECTED:
        raise ParseError("E321", at, f"{character} cannot stand here: {_UNEXPECTED[character]}")
    got = character if character.isascii() and character.isprintable() else ""
    if not got:
        name = unicodedata.name(character, "no character that has a name")
        got = f"{character if character.isprintable() else ''} (U+{ord(character):04X}, {name})".lstrip()
    expected, hint = "ASCII letters, digits and + - * / ^ ( )", _LOOKALIKES.get(character, "")
    raise ParseError("E321", at, "an expression", expected, got, hint=hint)


def _refuse_token(text: str, fault: UnexpectedToken) -> NoReturn:
    """Raise the error of a token that cannot follow the parser's stack."""
    token, stack = fault.token, fault.state.value_stack
    if token.type == "$END":
        token = Token("$END", "the end of the text", len(text))
    if token.type in ("NAME", "FUNCTION"):
        _check_name(token)
    got, at = "^" if token.type == "POWER" else cut(token), unclosed(stack)
    opener = token_type_of(stack[at]) if at >= 0 else ""
    called = f"{stack[at - 1]}(" if at > 0 and token_type_of(stack[at - 1]) == "FUNCTION" else ""
    tail = [token, *takewhile(token_type_of, reversed(stack))]  # the tokens that are no part of a node yet
    kinds = [token_type_of(value) for value in tail]
    if "POWER" in kinds[1:] and "$END" not in fault.expected:
        start = tail[kinds.index("POWER", 1) - 1]
        raise ParseError("E326", start, "an exponent", "a number written out, as in x^2 or x^(1/2)", got)
    if "NAME" in fault.expected:
        if token.type in ("IF", "NOT"):
            raise ParseError("E322", token, f"{token} … needs parentheses here")
        if kinds[1:2] == ["COMMA"] and got == _CLOSERS[opener]:
            each = f"an argument of {called[:-1]}" if called else "an entry of a vector"
            raise ParseError("E322", token, f"{each} is missing behind the comma")
        raise ParseError("E322", token, f"a number, a name or ( was expected here, not {got}")
    if token.type == "POWER":
        raise ParseError("E326", token, "a power of a power needs parentheses", hint="(x^2)^3")
    if kinds[1:2] == ["NUMBER"] and "POWER" not in kinds and kinds[0] in ("NAME", "FUNCTION", "NUMBER"):
        number = tail[1]
        described = text[number.start_pos : token.end_pos]
        if not text[number.end_pos : token.start_pos].strip(" "):
            message = f"{cut(described)} is not a number, and units stand on parameters only"
            factors = re.match(r"[\w.]*(\s*[*/]\s*\w+)*", text[token.start_pos :])
            product = f"{number}*{factors[0] if factors else token}"
            if kinds[0] == "NAME" and token != "pi":
                product = f"a parameter, with default: {number} {token}; of a name, {product}"
            hint = product
            hint = hint if Fraction(number) else str(number)  # nothing is nothing in any unit
            with contextlib.suppress(ValueError):
                hint = str(int(described, 0))  # 0x10 is 16
            raise ParseError("E323", number, message, hint="" if kinds[0] == "NUMBER" else hint)
    if token.type == "COMPARISON":
        raise ParseError("E322", token, "a comparison has two sides", hint="a < b and b < c")
    if opener:
        inside = called or _OPENED.get(opener, "an if")
        raise ParseError("E322", token, inside, _CLOSERS[opener], got)
    message = _STRAY.get(token, f"an operator was expected here, not {got}")
    if token in KEYWORDS:
        message = f"{token} belongs to an if … then … else, and none is open here"
    raise ParseError("E322", token, message)


def _check(expr: Expr, text: str, depth: int = 1, *, conditional: bool = False) -> None:
    """Raise E328 if a tree is too deep, E327 for a condition where a number is due or the reverse."""
    if depth > MAX_DEPTH:
        raise ParseError("E328", expr.start, TOO_DEEP)
    word = expr.function if isinstance(expr, Call) else ""
    condition = word in CONDITIONS
    # A name may represent a condition; only its declaration determines its type.
    if condition != conditional and not isinstance(expr, Name):
        kinds = "a condition, and a number" if condition else "a number, and a condition"
        message = f"{cut(text[expr.start : expr.end])} is {kinds} is due here"
        raise ParseError("E327", expr.start, message)
    parts = children(expr)
    for index, part in enumerate(parts):
        due = word in ("and", "or", "not") or (index == 0 and word == "if")
        # A first operand that is a leaf is read at the level of its operator.
        deeper = bool(index or len(parts) == 1 or children(part))
        _check(part, text, depth + deeper, conditional=due)


def _check_name(token: Token) -> None:
    """Raise E324 for a name that cannot be one."""
    for segment in token.split("."):
        word, _, index = segment.rstrip("]").partition("[")
        if word.startswith("_"):
            raise ParseError("E324", token, "a name", "a letter first", cut(token))
        if segment in KEYWORDS:
            raise ParseError("E324", token, f"{word} is a word of the language, not a name")
        if index.startswith("0") or len(index) > 9:
            raise ParseError("E324", token, "an index", "a whole number counted from 1", cut(index))


class _Trees(TREE):
    """The actions of the rules and tokens of expression.lark; a node's text includes its parentheses."""

    def NUMBER(self, token: Token) -> Token:
        """Return the token of a number, its length and size checked. Raises ParseError E323."""
        if len(token) > MAX_DIGITS:
            expected = f"at most {MAX_DIGITS} characters"
            raise ParseError("E323", token, "a number", expected, f"{len(token)}")
        check_size(token, token, "E323")
        return token

    def NAME(self, token: Token) -> Token:
        _check_name(token)
        return token

    def FUNCTION(self, token: Token) -> Token:
        _check_name(token)
        if token not in FUNCTIONS:
            close = nearest(token, FUNCTIONS, similarity=SIMILAR)
            message = f"there is no function {cut(token)}"
            if not close:
                message += f"; there are: {', '.join(sorted(FUNCTIONS))}"
            raise ParseError("E325", token, message, hint=f"{close}(…)" if close else "")
        return token

    def expression(self, parts: list[Any]) -> list[Any]:
        return parts

    def equation(self, parts: list[Any]) -> list[Any]:
        return [part.start_pos if token_type_of(part) else part for part in parts]

    def number(self, parts: list[Token]) -> Expr:
        return NumberLiteral(Fraction(parts[0]), **_span(*parts))

    def name(self, parts: list[Token]) -> Expr:
        if parts[0] == "pi":
            return NumberLiteral(PI, **_span(*parts))
        return Name(tuple(parts[0].split(".")), **_span(*parts))

    def exponent(self, parts: list[Token]) -> Expr:
        try:
            value = exponent_of(parts)
        except ZeroDivisionError:
            raise ParseError("E326", parts[0], "this exponent divides by zero") from None
        if abs(value) > MAX_POWER or value.denominator > MAX_POWER:
            limit = f"-{MAX_POWER} to {MAX_POWER}, or a fraction of such numbers"
            raise ParseError("E326", parts[0], "an exponent", limit, cut(str(value)))
        return NumberLiteral(value, **_span(*parts))

    def binary(self, parts: list[Any]) -> Any:
        left, operator, right = parts
        word = "^" if operator.type == "POWER" else str(operator)
        return Call(word, (left, right), **_span(left, right))

    def unary(self, parts: list[Any]) -> Any:
        sign, operand = parts
        if sign != "+":
            return Call("neg" if sign == "-" else "not", (operand,), **_span(*parts))
        if isinstance(operand, Call) and operand.function in CONDITIONS:
            message = f"{cut(format_expression(operand))} is a condition, and a number is due here"
            raise ParseError("E327", operand.start, message)
        return operand

    def parenthesis(self, parts: list[Any]) -> Any:
        return replace(parts[1], **_span(*parts))

    def vector(self, parts: list[Any]) -> Expr:
        if len(parts) == 2:
            message = "a vector has entries; one of zeros is {0, 0}"
            raise ParseError("E322", parts[0], message)
        return Call("{", tuple(parts[1:-1]), **_span(*parts))

    def call(self, parts: list[Any]) -> Expr:
        function, _, *arguments, _ = parts
        least, most = FUNCTIONS[function]
        if not least <= len(arguments) <= most:
            requested = f"{least}" if least == most else f"{least} to {most}"
            plural = "argument" if most == 1 else "arguments"
            raise ParseError("E325", function, function, f"{requested} {plural}", f"{len(arguments)}")
        if function != "interval":
            return Call(str(function), tuple(arguments), **_span(*parts))
        [clock] = arguments
        if not isinstance(clock, Name) or len(clock.parts) > 1:
            got = format_expression(clock)
            raise ParseError("E325", clock.start, function, "the name of a clock", got)
        return Name((interval_of(clock.parts[0]),), **_span(*parts))

    def conditional(self, parts: list[Any]) -> Expr:
        _, condition, _, then, *_, otherwise = parts
        return Call("if", (condition, then, otherwise), **_span(*parts))


def _span(*parts: Any) -> dict[str, int]:
    """Return the start of the first of several tokens or nodes, and the end of the last."""
    first, last = parts[0], parts[-1]
    return {
        "start": first.start_pos if token_type_of(first) else first.start,
        "end": last.end_pos if token_type_of(last) else last.end,
    }
