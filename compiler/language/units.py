"""Conversion of units and quantities to exact SI numbers.

Takes: a text (`N*s/m`, `500 N/m`), and its location. Gives: `Unit`, `Quantity`; `parse_unit`,
`parse_quantity`, and `quantity`, which must match a unit; `COMMON`.
Guarantees: values are exact rationals (0.1 kg is 1/10, an angle in degrees uses π to 50 digits); the cost of
a text is bounded; a unit that is not in units.txt, such as the grain, is not accepted.
Does not: define units of parameters, or check expressions (see `unit_check`).

A quantity is `number ["/" number] [unit]`; unit.lark is the grammar of a unit, Pint defines its names.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, NoReturn

import pint
from lark import Token
from lark.exceptions import UnexpectedCharacters, UnexpectedToken

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.language.expression import PI
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

TURN = 2 * PI  # a cycle in radians
MAX_LENGTH = 200  # characters of a quantity
MAX_EXPONENT = 9  # of a unit: m^9

# Common units: suggested for a misspelt name, and distinguished by case.
COMMON = (
    "N",
    "mN",
    "kN",
    "kg",
    "g",
    "m",
    "mm",
    "cm",
    "um",
    "s",
    "ms",
    "us",
    "min",
    "Hz",
    "kHz",
    "rad",
    "deg",
    "A",
    "mA",
    "V",
    "W",
    "kW",
    "J",
    "K",
    "Pa",
    "mol",
    "cd",
    "lb",
    "inch",
    "ft",
    "kgf",
    "rpm",
    "percent",
    "newton",
    "meter",
    "second",
    "gram",
    "kilogram",
    "hertz",
    "radian",
    "degree",
    "millisecond",
    "millimeter",
)
_BASES = {
    "[mass]": "kg",
    "[length]": "m",
    "[time]": "s",
    "[current]": "A",
    "[temperature]": "K",
    "[substance]": "mol",
    "[luminosity]": "cd",
}
_ANGLES = ("radian", "degree", "arcminute", "arcsecond", "turn", "_per_minute", "_per_second")
_LONG = ("hecto", "kilo", "mega", "giga", "tera")  # no prefix of a second
NAME = re.compile(r"[^\W\d_²³][^\W²³]*|[%°]")  # as in the grammar
_NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_QUANTITY_START = re.compile(rf"\s*[+-]?{_NUMBER}(?:\s*/\s*{_NUMBER})?")
_EXPONENT = re.compile(r"\^-?[0-9]+|\*\*-?[0-9]+|[²³]")
_NOT_FINITE = re.compile(r"[+-]?\.?(nan|inf|infinity)\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit as written; a value in it times `scale` is the value in SI."""

    text: str
    scale: Fraction
    dimension: Dimension


@dataclass(frozen=True, slots=True)
class Quantity:
    """`value` in SI; `unit` as written, `NO_UNIT` when there was none; `number` as written, without it."""

    value: Fraction
    unit: Unit
    number: str


NO_UNIT = Unit("1", Fraction(1), DIMENSIONLESS)


def parse_unit(text: str, location: SourceLocation) -> Unit:
    """Read a unit; `1` is the unit of a plain number.

    Raises
    ------
    ApcError
        E222 not the text of a unit, E223 no such unit, E224 a unit with an offset or a logarithm,
        E225 an exponent or scale that is too large.
    """
    with placing(text, location):
        return _unit(text)


def parse_quantity(text: str, location: SourceLocation) -> Quantity:
    """Read a number and its unit, if it has one.

    Raises
    ------
    ApcError
        E221 not the text of a quantity, E226 a number that is too large; and those of `parse_unit`.
    """
    with placing(text, location):
        return _quantity(text)


def quantity(
    text: str,
    location: SourceLocation,
    *,
    subject: str,
    unit: str,
    before: str | None = None,
    one_fix: bool = False,
) -> Quantity:
    """Read a quantity that must match a unit.

    Parameters
    ----------
    text
        The quantity as written.
    location
        Its location.
    subject
        Its name, for messages.
    unit
        A valid unit; `1` for a plain number.
    before
        Text before the value in a fix; the name and a colon by default.
    one_fix
        Whether the fix is a single quantity.

    Raises
    ------
    ApcError
        E204 a unit that does not fit, or none; and those of `parse_quantity`.
    """
    requested = parse_unit(unit, location)
    named = "a plain number" if unit == "1" else unit
    before = f"{subject}: " if before is None else before
    try:
        parsed = parse_quantity(text, location)
    except ApcError as error:
        [mistake] = error.mistakes
        alone = not set("*/^") & set(text)  # it is all there is of the unit
        if mistake.code == "E223" and mistake.hint:
            meant = unit if alone and not _is_of(mistake.hint, requested.dimension) else mistake.hint
            if not location.line:  # of an option, whose value is written anew
                meant = f"{before}{text.strip().replace(mistake.subject, meant)}"
            raise ApcError(replace(mistake, hint=meant)) from None
        if mistake.code != "E221" or mistake.hint:
            raise
        example = f"{before}1 {unit}".removesuffix(" 1")
        raise ApcError(
            Diagnostic("E221", location, subject, named, cut(text) or "nothing", example)
        ) from None
    actual, due = parsed.unit.dimension, requested.dimension
    got, right = cut(text.strip()), unit
    if actual == due:
        if not actual.clashes(due):
            return parsed
        # 20 Hz are 125.66 rad/s.
        turns = TURN if due.turning == "rad" else 1 / TURN
        same = f"{float(parsed.value * turns / requested.scale):.9g} {unit}"
        got += f", which is {same}"
        hint = f"{before}{same}" + f", or {before}{parsed.number} {unit}" * (not one_fix)
    else:
        if parsed.unit == NO_UNIT:
            got += " (no unit)"
        else:
            right, slip = _meant(parsed.unit, requested)
            got += f" ({slip} is {_long_name(slip)}: case matters)" if slip else ""
        hint = f"{before}{parsed.number} {right}".removesuffix(" 1") if right else ""
        # A rate in the place of a time, or the other way round; radians don't say how long a turn takes.
        if actual == due.power(-1) and actual.turning != "rad" and parsed.value:
            hint = f"{before}{float(1 / (parsed.value * requested.scale)):.9g} {unit}"
    raise ApcError(Diagnostic("E204", location, subject, named, got, hint))


def _meant(unit: Unit, requested: Unit) -> tuple[str, str]:
    """Return a unit of the dimension that is wanted in which the number as written may be meant.

    That is the unit with a name in another case, which is returned as well, MS for ms; without one of its
    exponents, or with a letter more; or failing that the one that is wanted, if a value in it is as large:
    5 N/mm^2 are not proposed as 5 N/m, a millionth of it.
    """
    text = unit.text
    others = [(name, other) for name in NAME.findall(text) for other in COMMON if other != name]
    texts = [(text.replace(name, other), name) for name, other in others if other.lower() == name.lower()]
    texts += [(text[: match.start()] + text[match.end() :], "") for match in _EXPONENT.finditer(text)]
    longer = ((name, other) for name, other in others if other[:-1] == name)
    texts += [(re.sub(rf"\b{re.escape(name)}\b", other, text), "") for name, other in longer]
    fitting = (candidate for candidate in texts if _is_of(candidate[0], requested.dimension))
    return next(fitting, (requested.text if unit.scale == requested.scale else "", ""))


def _is_of(text: str, dimension: Dimension) -> bool:
    """Return whether a text is a unit of a dimension; False if it cannot be read as a unit."""
    try:
        return _unit(text).dimension == dimension
    except ParseError:
        return False


@lru_cache(maxsize=4096)
def _quantity(text: str) -> Quantity:
    if len(text) > MAX_LENGTH:
        raise ParseError("E221", 0, "a quantity", f"at most {MAX_LENGTH} characters", f"{len(text)}")
    match = _QUANTITY_START.match(text)
    if match is None:
        bare = text.strip()
        expected = "a finite number" if _NOT_FINITE.match(bare) else "a number and its unit"
        hint = bare.replace("−", "-") if bare.startswith("−") else ""
        raise ParseError("E221", 0, "a quantity", expected, cut(bare) or "nothing", hint=hint)
    number, rest, end = match.group().strip(), text[match.end() :], match.end()
    if re.match(r",[0-9]", rest):
        hint = cut(f"{number}.{rest[1:].strip()}")
        raise ParseError("E221", end, "a number has a decimal point, not a comma", hint=hint)
    value = _number(number, end - len(number))
    if re.match(r"\s*/", rest):
        hint = f"{number} 1{rest.strip()}"
        raise ParseError("E222", end, "a unit", "something above the /", "nothing", hint=hint)
    try:
        unit = _unit(rest) if rest.strip() else NO_UNIT
        float(value * unit.scale)
    except ParseError as fault:
        fault.offset += end
        raise
    except OverflowError:
        raise ParseError("E226", 0, "this quantity is too large for a number") from None
    return Quantity(value * unit.scale, unit, number)


def _number(text: str, offset: int) -> Fraction:
    """Return the exact value of a number or of a quotient of two."""
    check_size(text, offset, "E226")
    above, _, below = text.partition("/")
    try:
        return Fraction(above) / Fraction(below or "1")
    except ZeroDivisionError:
        raise ParseError("E221", offset, f"{cut(text)} divides by zero") from None


@lru_cache(maxsize=1024)
def _unit(text: str) -> Unit:
    """Return a unit: the product of its names according to Pint."""
    if len(text) > MAX_LENGTH:
        raise ParseError("E222", 0, "a unit", f"at most {MAX_LENGTH} characters", f"{len(text)}")
    try:
        powers = _grammar()(text, "unit")
    except UnexpectedCharacters as fault:
        expected = "names joined by * and /, with exponents such as ^2"
        raise ParseError("E222", fault.pos_in_stream, "a unit", expected, repr(fault.char)) from None
    except UnexpectedToken as fault:
        _refuse(text, fault)
    dimensions = registry().get_dimensionality(powers)
    if any(abs(power) > MAX_EXPONENT for power in (*powers.values(), *dimensions.values())):
        message = f"{cut(text.strip())} is no unit of this world: an exponent or its scale is too large"
        raise ParseError("E225", 0, message)
    # The square of the scale, so that the root of a square is exact; Pint's unit of mass is the gram.
    square, _ = registry().get_root_units(powers**2)
    square = square / Fraction(1000) ** (2 * dimensions["[mass]"])
    rational = Fraction(square)
    scale = Fraction(math.isqrt(rational.numerator), math.isqrt(rational.denominator))
    if isinstance(square, float) or scale**2 != square:
        expected = "a root whose scale is a rational number"
        raise ParseError("E222", len(text.rstrip()), "a unit", expected, "its end")
    exponents = tuple(sorted((_BASES[base], power) for base, power in dimensions.items()))
    return Unit(text.strip(), scale, Dimension(exponents, _turning(text)))


def _refuse(text: str, fault: UnexpectedToken) -> NoReturn:
    """Raise E222 for a character that cannot follow in a unit."""
    token, bare, hint = fault.token, text.strip(), ""
    if "NAME" in fault.expected:
        expected = "a name such as N, m or s"
    elif "$END" not in fault.expected and "NUMBER" in fault.expected:
        expected = f"a whole exponent up to {MAX_EXPONENT}"
    elif unclosed(fault.state.value_stack) >= 0:
        expected = ")"
    else:
        expected, joined = "* or / between two names", re.sub(r"(\w)\s+(?=\w)", r"\1*", bare)
        hint = joined if joined != bare and "+" not in bare else ""
    at = len(text.rstrip()) if token.type == "$END" else token
    got = {"$END": "its end", "POWER": "^"}.get(token.type, str(token))
    raise ParseError("E222", at, "a unit", expected, got, hint)


def _turning(text: str) -> str:
    """Return whether a unit counts cycles ("Hz") or radians ("rad"); an empty text if neither."""
    for name in map(_long_name, NAME.findall(text)):
        if name.endswith("hertz"):
            return "Hz"
        if name.endswith(_ANGLES):
            return "rad"
    return ""


class _Units(TREE):
    """The actions of the rules of unit.lark: Pint's products of powers of names."""

    def NAME(self, token: Token) -> Any:
        return registry().UnitsContainer({_in_catalogue(token): Fraction(1)})

    def unity(self, parts: list[Token]) -> Any:
        if parts[0] != "1":
            expected = "a name such as N, m or s"
            raise ParseError("E222", parts[0], "a unit", expected, str(parts[0]))
        return registry().UnitsContainer()

    def times(self, parts: list[Any]) -> Any:
        return parts[0] * parts[2]

    def over(self, parts: list[Any]) -> Any:
        return parts[0] / parts[1]

    def raised(self, parts: list[Any]) -> Any:
        exponent = parts[-1]
        return parts[0] ** (Fraction(2 + "²³".index(exponent)) if token_type_of(exponent) else exponent)

    def exponent(self, parts: list[Token]) -> Fraction:
        for part in parts:
            if part.type == "NUMBER" and int(part) > MAX_EXPONENT:
                expected = f"a whole exponent up to {MAX_EXPONENT}"
                raise ParseError("E222", part, "a unit", expected, str(part))
        try:
            return exponent_of(parts)
        except ZeroDivisionError:
            expected = "an exponent that does not divide by zero"
            raise ParseError("E222", parts[-1].end_pos, "a unit", expected, ")") from None


@cache
def _grammar() -> Callable[[str, str], Any]:
    return parser("unit.lark", ["unit"], _Units())


@cache
def registry() -> Any:
    """Return Pint's registry of the units there are, with exact numbers."""
    return pint.UnitRegistry(str(Path(__file__).with_name("units.txt")), non_int_type=Fraction)


@cache
def _everything() -> Any:
    """Return Pint's registry of all its units, for messages: creation takes a third of a second."""
    return pint.UnitRegistry(non_int_type=Fraction)


def _long_name(name: str) -> str:
    """Return Pint's long name of a unit: `megasiemens` for MS; an empty text if there is none."""
    for prefix, unit, _ in registry().parse_unit_name(name)[:1]:
        prefixed = unit in registry().get_group("Prefixed").members
        if not prefix or (prefixed and not (unit == "second" and prefix in _LONG)):
            return str(registry().get_name(name))
    return ""


def _in_catalogue(name: Token) -> str:
    """Return the long name of a unit. Raises FaultError: E223 no such unit, E224 no multiple of SI."""
    if long_name := _long_name(name):
        return long_name
    every = _everything()
    # Nm is a yarn count to Pint, and a slip for N*m to everyone else.
    others = [(prefix, unit) for prefix, unit, _ in every.parse_unit_name(name) if unit != "number_meter"]
    if not others:
        raise ParseError("E223", name, f"there is no unit {cut(name)}", hint=_proposal(name), subject=name)
    (prefix, unit), *_ = others
    spelled = f"{prefix}{unit}".replace("_", " ")
    roots = every.get_root_units(unit)[1]._units
    if not every._units[unit].is_multiplicative or any(root not in registry() for root in roots):
        message = f"{name} ({prefix}{unit}) is no multiple of an SI unit"
        raise ParseError("E224", name, message, hint="K" if "degree_" in unit else "")
    dimension = every.get_dimensionality(unit)
    like = [other for other in COMMON if registry().get_dimensionality(other) == dimension]
    proposed = f"; there are {', '.join(like[:3])}" if like else ""
    message = f"there is no unit {name} here: {spelled} is not supported{proposed}"
    lower = name.lower()
    similar = (other for other in like if lower == other.lower() or lower.startswith(other))
    raise ParseError("E223", name, message, hint=next(similar, ""), subject=name)


def _proposal(name: str) -> str:
    """Return the probable intention: another case, an exponent, a product, or the nearest common name."""
    for other in COMMON:
        if other.lower() == name.lower():
            return other
    if (power := re.fullmatch(r"([^\W\d_]+)([2-9])", name)) and power.group(1) in COMMON:
        return f"{power.group(1)}^{power.group(2)}"
    for at in range(1, len(name)):
        if name[:at] in COMMON and name[at:] in COMMON:
            return f"{name[:at]}*{name[at:]}"
    return nearest(name, COMMON)
