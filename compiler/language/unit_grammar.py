"""The text of a unit to its scale and dimension.

Takes: a text such as `N*s/m`, and what each name in it stands for.
Gives: `Factor`, `parse_factor`; `FaultError`.
Guarantees: exact scales; exponents and the bits of a scale are bounded; a mistake says where in the text.
Does not: know any name of a unit (see `unit_names`).

The grammar:

    unit     = power {("*" | "·" | "/") power}          left to right: N/m*s is (N/m)*s
    power    = (name | "1" | "(" unit ")") ["^" ["-"] integer | "^(" ["-"] integer ["/" integer] ")"]
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from fractions import Fraction
from typing import NoReturn

from apc.compiler.errors import ApcError, Mistake, Place, place_in
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.words import cut

MAX_EXPONENT = 9  # of a unit: m^9
MAX_BITS = 4096  # of a unit's scale; 10^300 has 997
_WORD = r"[^\W\d_²³][^\W²³]*|[%°]"  # Python counts ² among the letters of a word
NAME = re.compile(_WORD)
_TOKEN = re.compile(rf"\s*(\*\*|[*·⋅/^()+-]|[0-9]+|{_WORD}|[²³])")
_SAME = {"**": "^", "·": "*", "⋅": "*"}


class FaultError(Exception):
    """A mistake that does not know yet where its text stands, so that results can be kept by text."""

    def __init__(
        self, code: str, offset: int, what: str, expected: str = "", got: str = "", hint: str = ""
    ) -> None:
        super().__init__(what)
        self.code, self.offset, self.what = code, offset, what
        self.expected, self.got, self.hint = expected, got, hint

    def placed(self, text: str, place: Place) -> ApcError:
        """Return the mistake of a text that starts at `place`."""
        at = place_in(place, text, self.offset)
        return ApcError(Mistake(self.code, at, self.what, self.expected, self.got, self.hint))


Factor = tuple[Fraction, Dimension]  # the scale and dimension of a unit


def parse_factor(text: str, look_up: Callable[[str, int], Factor]) -> Factor:
    """Return the scale and dimension of a unit.

    Parameters
    ----------
    text
        The unit as written.
    look_up
        Gives the scale and dimension of a name and its offset in the text.

    Raises
    ------
    FaultError
        E222 not the text of a unit, E225 an exponent or scale that is too large; and those of `look_up`.
    """
    return _UnitParser(text, look_up).parse()


class _UnitParser:
    """Recursive descent; the length of a unit bounds how deep its parentheses go."""

    def __init__(self, text: str, look_up: Callable[[str, int], Factor]) -> None:
        self.text, self.look_up = text, look_up
        self.tokens = list(_unit_tokens(text))
        self.at = 0

    @property
    def token(self) -> str:
        return self.tokens[self.at][0]

    def step(self) -> str:
        token = self.token
        self.at += 1
        return token

    def fail(self, expected: str, hint: str = "") -> NoReturn:
        token, offset = self.tokens[self.at]
        raise FaultError("E222", offset, "a unit", expected=expected, got=token or "its end", hint=hint)

    def parse(self) -> Factor:
        factor = self.product()
        if self.token:
            text = self.text.strip()
            joined = re.sub(r"(\w)\s+(?=\w)", r"\1*", text)
            self.fail("* or / between two names", joined if joined != text else "")
        return factor

    def product(self) -> Factor:
        scale, dimension = self.power()
        while self.token in ("*", "/"):
            divided = self.step() == "/"
            factor, other = self.power()
            scale = scale / factor if divided else scale * factor
            dimension = dimension.divide(other) if divided else dimension.multiply(other)
            self.check(scale, dimension)
        return scale, dimension

    def power(self) -> Factor:
        scale, dimension = self.atom()
        if self.token == "²" or self.token == "³":
            exponent = Fraction(2 if self.step() == "²" else 3)
        elif self.token == "^":
            self.step()
            exponent = self.exponent()
        else:
            return scale, dimension
        scale, dimension = self.scale_power(scale, exponent), dimension.power(exponent)
        self.check(scale, dimension)
        return scale, dimension

    def atom(self) -> Factor:
        token, offset = self.tokens[self.at]
        if token == "(":
            self.step()
            inner = self.product()
            if self.token != ")":
                self.fail(")")
            self.step()
            return inner
        if token == "1":
            self.step()
            return Fraction(1), DIMENSIONLESS
        if not NAME.fullmatch(token):
            self.fail("a name such as N, m or s")
        self.step()
        return self.look_up(token, offset)

    def exponent(self) -> Fraction:
        inside = self.token == "("
        if inside:
            self.step()
        sign = -1 if self.token == "-" else 1
        if self.token in ("-", "+"):
            self.step()
        value = sign * Fraction(self.integer())
        if inside:
            if self.token == "/":
                self.step()
                divisor = self.integer()
                if divisor == 0:
                    self.fail("an exponent that does not divide by zero")
                value /= divisor
            if self.token != ")":
                self.fail(")")
            self.step()
        return value

    def integer(self) -> int:
        if not self.token.isdecimal() or int(self.token) > MAX_EXPONENT:
            self.fail(f"a whole exponent up to {MAX_EXPONENT}")
        return int(self.step())

    def scale_power(self, scale: Fraction, exponent: Fraction) -> Fraction:
        bits = max(scale.numerator.bit_length(), scale.denominator.bit_length())
        if bits * abs(exponent) > MAX_BITS:
            self.too_large()
        power = scale**exponent.numerator
        if exponent.denominator == 1:
            return power
        # Only a root that is rational keeps the scale exact.
        root = Fraction(math.isqrt(power.numerator), math.isqrt(power.denominator))
        if power != 1 and (exponent.denominator != 2 or root**2 != power):
            self.fail("a root whose scale is a rational number")
        return root

    def check(self, scale: Fraction, dimension: Dimension) -> None:
        bits = max(scale.numerator.bit_length(), scale.denominator.bit_length())
        if bits > MAX_BITS or any(
            not -MAX_EXPONENT <= power <= MAX_EXPONENT for _, power in dimension.exponents
        ):
            self.too_large()

    def too_large(self) -> NoReturn:
        what = f"{cut(self.text.strip())} is no unit of this world: an exponent or its scale is too large"
        raise FaultError("E225", 0, what)


def _unit_tokens(text: str) -> Iterator[tuple[str, int]]:
    at = 0
    end = len(text.rstrip())
    while at < end:
        found = _TOKEN.match(text, at)
        if found is None:
            skipped = len(text[at:]) - len(text[at:].lstrip())
            character = text[at + skipped]
            expected = "names joined by * and /, with exponents such as ^2"
            raise FaultError("E222", at + skipped, "a unit", expected=expected, got=repr(character))
        yield _SAME.get(found.group(1), found.group(1)), found.start(1)
        at = found.end()
    yield "", end
