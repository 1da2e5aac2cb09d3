"""Conversion of units and quantities to exact SI numbers.

Takes: a text (`N*s/m`, `500 N/m`), and its location. Gives: `Unit`, `Quantity`; `parse_unit`,
`parse_quantity`, and `quantity`, which must match a unit; `COMMON`; `TABULATED`, `unit_by_pint`.
Guarantees: values are exact rationals (0.1 kg is 1/10, an angle in degrees uses π to 50 digits); the cost of
parsing is bounded; a unit that is not in units.txt, such as the grain, is not accepted.
Does not: determine the units of parameters, or check expressions (see `unit_check`).

A quantity is `number ["/" number] [unit]`; unit.lark is the grammar of a unit, Pint defines the names of
units.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache, lru_cache
from itertools import product
from pathlib import Path
from typing import Any, NoReturn

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
MOST_CASED = 6  # names of a unit that are compared with the common ones in another case

# Units with scale, dimension and angle unit, as Pint defines them; Pint is imported for other units only.
TABULATED = """
1 1 1
% 1/100 1
m 1 m
mm 1/1000 m
um 1/1000000 m
s 1 s
ms 1/1000 s
us 1/1000000 s
min 60 s
kg 1 kg
g 1/1000 kg
N 1 kg*m*s^-2
mN 1/1000 kg*m*s^-2
kN 1000 kg*m*s^-2
J 1 kg*m^2*s^-2
N/m 1 kg*s^-2
N/mm 1000 kg*s^-2
kN/m 1000 kg*s^-2
N*s/m 1 kg*s^-1
m/s 1 m*s^-1
mm/s 1/1000 m*s^-1
m/s^2 1 m*s^-2
N*m 1 kg*m^2*s^-2
N*m/rad 1 kg*m^2*s^-2 rad
N*m*s/rad 1 kg*m^2*s^-1 rad
N*m*s 1 kg*m^2*s^-1
rad 1 1 rad
rad/s 1 s^-1 rad
Hz 1 s^-1 Hz
kHz 1000 s^-1 Hz
1/s 1 s^-1
1/m 1 m^-1
kg*m^2 1 kg*m^2
N/m^(3/2) 1 kg*m^-1/2*s^-2
N*s/m^(5/2) 1 kg*m^-3/2*s^-1
A 1 A
K 1 K
mol 1 mol
cd 1 cd
N*s 1 kg*m*s^-1
N/m^2 1 kg*m^-1*s^-2
N*s^2/m^2 1 kg*m^-1
N*s/m^2 1 kg*m^-1*s^-1
N/s 1 kg*m*s^-3
m/N 1 kg^-1*s^2
m/s^3 1 m*s^-3
m^2 1 m^2
m^3 1 m^3
1/s^2 1 s^-2
W 1 kg*m^2*s^-3
V 1 A^-1*kg*m^2*s^-3
N*m/A 1 A^-1*kg*m^2*s^-2
rad/s^2 1 s^-2 rad
"""

# Common units, which are proposed for a misspelled name or a name in the wrong case.
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
_LONG = ("hecto", "kilo", "mega", "giga", "tera")  # prefixes that are invalid for the second
NAME = re.compile(r"[^\W\d_²³][^\W²³]*|[%°]")  # as in the grammar
_NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_QUANTITY_START = re.compile(rf"\s*[+-]?{_NUMBER}(?:\s*/\s*{_NUMBER})?")
_EXPONENT = re.compile(r"\^-?[0-9]+|\*\*-?[0-9]+|[²³]")
_EXAMPLES = "; use a unit such as "  # before the units of the quantity of an unsupported unit
_NOT_FINITE = re.compile(r"[+-]?\.?(nan|inf|infinity)\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit as written; the value in SI units is the value in this unit times `scale`."""

    text: str
    scale: Fraction
    dimension: Dimension


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity: `value` in SI units, `unit` as written, and `number`, the text of the number.

    `unit` is `NO_UNIT` if there is none.
    """

    value: Fraction
    unit: Unit
    number: str


NO_UNIT = Unit("1", Fraction(1), DIMENSIONLESS)


def parse_unit(text: str, location: SourceLocation) -> Unit:
    """Return the unit of a text; `1` is the unit of a plain number.

    Raises
    ------
    ApcError
        E222 a text that is not a unit, E223 an unknown unit, E224 a unit with an offset or a logarithm,
        E225 an exponent or scale that is too large.
    """
    with placing(text, location):
        return _unit(text)


def parse_quantity(text: str, location: SourceLocation) -> Quantity:
    """Return the quantity of a text: a number with or without a unit.

    Raises
    ------
    ApcError
        E221 a text that is not a quantity, E226 a number that is too large; and the errors of `parse_unit`.
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
    """Return the quantity of a text, whose unit must have the dimension of a given unit.

    Parameters
    ----------
    text
        The quantity as written.
    location
        The location of the text.
    subject
        The name of the quantity, for messages.
    unit
        A unit of the required dimension; `1` for a plain number.
    before
        Text before the value in a fix; the name and a colon by default.
    one_fix
        Whether the fix is a single quantity.

    Raises
    ------
    ApcError
        E204 a wrong or missing unit; and the errors of `parse_quantity`.
    """
    requested = parse_unit(unit, location)
    named = "a plain number" if unit == "1" else unit
    if before is None:  # an entry of a list, such as x[2], has no key of its own
        before = "" if subject.endswith("]") else f"{subject}: "
    try:
        parsed = parse_quantity(text, location)
    except ApcError as error:
        [mistake] = error.mistakes
        single_name = not set("*/^") & set(text)  # the unit is a single name
        if single_name and _EXAMPLES in mistake.message:
            message, _, examples = mistake.message.partition(_EXAMPLES)
            if not _is_of(re.split(", | or ", examples)[0], requested.dimension):  # of another quantity
                mistake = replace(mistake, message=message, expected=named)
                error = ApcError(mistake)
        elif single_name and mistake.code in ("E223", "E224") and not (mistake.expected or mistake.fix):
            error = ApcError(mistake := replace(mistake, expected=named))
        if mistake.code in ("E223", "E224"):
            if cased := _in_usual_case(text, requested.dimension):
                names = zip(NAME.findall(text), NAME.findall(cased), strict=True)
                changed = [new for old, new in names if old != new]
                if location.line and len(changed) == 1:
                    raise ApcError(replace(mistake, fix=changed[0])) from None
                raise ApcError(replace(mistake, location=location, fix=f"{before}{cased}")) from None
            if cased := _in_usual_case(text, requested.dimension.power(-1)):  # a rate instead of a time
                try:
                    quantity(cased, location, subject=subject, unit=unit, before=before, one_fix=one_fix)
                except ApcError as reciprocal:
                    fix = reciprocal.mistakes[0].fix
                    raise ApcError(replace(mistake, location=location, fix=fix)) from None
        if mistake.code in ("E223", "E224") and mistake.fix:
            fix = unit if single_name and not _is_of(mistake.fix, requested.dimension) else mistake.fix
            if not location.line:  # a command-line option: the fix is the entire value
                fix = f"{before}{text.strip().replace(mistake.subject, fix)}"
            raise ApcError(replace(mistake, fix=fix)) from None
        if mistake.code == "E221" and not mistake.expected and not mistake.fix:  # a division by zero
            raise ApcError(replace(mistake, message=f"{subject}: {mistake.message}")) from None
        if mistake.code != "E221" or mistake.fix:
            raise error from None
        example, got = f"{before}1 {unit}".removesuffix(" 1"), cut(text) or "nothing"
        expected = named
        if _NOT_FINITE.match(text.strip()):  # no finite number is more probable than another
            expected, example = "a finite number" if unit == "1" else f"a finite number in {unit}", ""
        raise ApcError(Diagnostic("E221", location, subject, expected, got, example)) from None
    actual, due = parsed.unit.dimension, requested.dimension
    got, right = cut(text.strip()), unit
    if actual == due:
        if not actual.clashes(due):
            return parsed
        # 20 Hz are 125.66 rad/s.
        turns = TURN if due.turning == "rad" else 1 / TURN
        same = f"{float(parsed.value * turns / requested.scale):.9g} {unit}"
        got += f", which is {same}"
        fix = f"{before}{same}" + f", or {before}{parsed.number} {unit}" * (not one_fix)
    else:
        if parsed.unit == NO_UNIT:
            got += " (no unit)"
        else:
            right, slip = _corrected_unit(parsed.unit, requested)
            got += f" ({slip} is {_long_name(slip)}: case matters)" if slip else ""
        fix = f"{before}{parsed.number} {right}".removesuffix(" 1") if right else ""
        # A rate instead of a time or the reverse; a rate in radians has no unique period.
        if actual == due.power(-1) and actual.turning != "rad" and parsed.value:
            fix = f"{before}{float(1 / (parsed.value * requested.scale)):.9g} {unit}"
    raise ApcError(Diagnostic("E204", location, subject, named, got, fix))


def _in_usual_case(text: str, dimension: Dimension) -> str:
    """Return a quantity whose unit has the dimension if its names are those of common units in another case.

    The result is empty if there is no such unit.
    """
    start = _QUANTITY_START.match(text)
    if start is None:
        return ""
    number, unit = text[: start.end()], text[start.end() :]
    names = NAME.findall(unit)
    if len(names) > MOST_CASED:
        return ""
    by_name = [[name, *(other for other in COMMON if other.lower() == name.lower())] for name in names]
    for chosen in product(*by_name):
        spelled = iter(chosen)
        candidate = NAME.sub(lambda _: next(spelled), unit)  # noqa: B023 -- called at once
        if _is_of(candidate, dimension):
            return f"{number}{candidate}".strip()
    return ""


def _corrected_unit(unit: Unit, required: Unit) -> tuple[str, str]:
    """Return the unit that was probably intended, and the misspelled name in it.

    The result has two empty texts if there is none.

    The candidates have the required dimension: the unit with a name in another case (MS for ms), with one
    exponent removed, or with one letter more. The last candidate is the required unit, if it has the same
    scale: 5 N/m is not proposed for 5 N/mm^2, which is a million times more. The second text is empty if no
    name differs only in case.
    """
    text = unit.text
    others = [(name, other) for name in NAME.findall(text) for other in COMMON if other != name]
    texts = [(text.replace(name, other), name) for name, other in others if other.lower() == name.lower()]
    texts += [(text[: match.start()] + text[match.end() :], "") for match in _EXPONENT.finditer(text)]
    longer = ((name, other) for name, other in others if other[:-1] == name)
    texts += [(re.sub(rf"\b{re.escape(name)}\b", other, text), "") for name, other in longer]
    candidates = (candidate for candidate in texts if _is_of(candidate[0], required.dimension))
    return next(candidates, (required.text if unit.scale == required.scale else "", ""))


def _is_of(text: str, dimension: Dimension) -> bool:
    """Return whether a text is a unit of the dimension; False for an invalid unit."""
    try:
        return _unit(text).dimension == dimension
    except ParseError:
        return False


@lru_cache(maxsize=4096)
def _quantity(text: str) -> Quantity:
    """Return the quantity of a text, cached. Raises ParseError."""
    if len(text) > MAX_LENGTH:
        raise ParseError("E221", 0, "quantity", f"at most {MAX_LENGTH} characters", f"{len(text)}")
    match = _QUANTITY_START.match(text)
    if match is None:
        bare = text.strip()
        expected = "a finite number" if _NOT_FINITE.match(bare) else "a number and its unit"
        fix = bare.replace("−", "-") if bare.startswith("−") else ""
        raise ParseError("E221", 0, "quantity", expected, cut(bare) or "nothing", fix=fix)
    number, rest, end = match.group().strip(), text[match.end() :], match.end()
    if re.match(r",[0-9]", rest):
        fix = cut(f"{number}.{rest[1:].strip()}")
        raise ParseError("E221", end, "number: expected a decimal point, got a comma", fix=fix)
    value = _number(number, end - len(number))
    if re.match(r"\s*/", rest):
        fix = f"{number} 1{rest.strip()}"
        raise ParseError("E222", end, "unit", "a numerator before /", "none", fix=fix)
    try:
        unit = _unit(rest) if rest.strip() else NO_UNIT
        float(value * unit.scale)
    except ParseError as fault:
        fault.offset += end
        raise
    except OverflowError:
        raise ParseError("E226", 0, "the quantity is too large") from None
    return Quantity(value * unit.scale, unit, number)


def _number(text: str, offset: int) -> Fraction:
    """Return the exact value of a number or of a quotient of two numbers. Raises ParseError."""
    check_size(text, offset, "E226")
    numerator, _, denominator = text.partition("/")
    try:
        return Fraction(numerator) / Fraction(denominator or "1")
    except ZeroDivisionError:
        raise ParseError("E221", offset, f"division by zero in {cut(text)}") from None


@lru_cache(maxsize=1024)
def _unit(text: str) -> Unit:
    """Return the unit of a text, cached. Raises ParseError."""
    known = _tabulated_units().get(text.strip())
    return unit_by_pint(text) if known is None else known


@cache
def _tabulated_units() -> dict[str, Unit]:
    """Return the units of the table by their texts."""
    result = {}
    for name, scale, factors, *turning in map(str.split, TABULATED.strip().splitlines()):
        powers = (factor.partition("^") for factor in factors.split("*") if factor != "1")
        exponents = tuple((base, Fraction(power or 1)) for base, _, power in powers)
        result[name] = Unit(name, Fraction(scale), Dimension(exponents, "".join(turning)))
    return result


def unit_by_pint(text: str) -> Unit:
    """Return the unit of a text by the grammar of units and Pint's definitions. Raises ParseError."""
    if len(text) > MAX_LENGTH:
        raise ParseError("E222", 0, "unit", f"at most {MAX_LENGTH} characters", f"{len(text)}")
    try:
        powers = _grammar()(text, "unit")
    except UnexpectedCharacters as fault:
        expected = "names joined by * and /, with exponents such as ^2"
        raise ParseError("E222", fault.pos_in_stream, "unit", expected, repr(fault.char)) from None
    except UnexpectedToken as fault:
        _refuse(text, fault)
    dimensions = registry().get_dimensionality(powers)
    if any(abs(power) > MAX_EXPONENT for power in (*powers.values(), *dimensions.values())):
        message = f"unit {cut(text.strip())}: an exponent or the factor to SI units is too large"
        raise ParseError("E225", 0, message)
    # The square of the scale, so that the root of a square is exact; Pint's unit of mass is the gram.
    square, _ = registry().get_root_units(powers**2)
    square = square / Fraction(1000) ** (2 * dimensions["[mass]"])
    rational = Fraction(square)
    scale = Fraction(math.isqrt(rational.numerator), math.isqrt(rational.denominator))
    if isinstance(square, float) or scale**2 != square:
        message = f"unit {cut(text.strip())}: its factor to SI units is irrational"
        raise ParseError("E222", len(text) - len(text.lstrip()), message)
    exponents = tuple(sorted((_BASES[base], power) for base, power in dimensions.items()))
    return Unit(text.strip(), scale, Dimension(exponents, _turning(text)))


def _refuse(text: str, fault: UnexpectedToken) -> NoReturn:
    """Raise ParseError (E222) for a token that cannot follow in a unit."""
    token, bare, fix = fault.token, text.strip(), ""
    if "NAME" in fault.expected:
        expected = "a name, such as N, m or s"
    elif "$END" not in fault.expected and "NUMBER" in fault.expected:
        expected = f"a whole exponent up to {MAX_EXPONENT}"
    elif unclosed(fault.state.value_stack) >= 0:
        expected = ")"
    else:
        expected, joined = "* or / between two unit names", re.sub(r"(\w)\s+(?=\w)", r"\1*", bare)
        fix = joined if joined != bare and "+" not in bare else ""
    at = len(text.rstrip()) if token.type == "$END" else token
    got = {"$END": "nothing", "POWER": "^"}.get(token.type, str(token))
    raise ParseError("E222", at, f"unit {cut(bare)}", expected, got, fix)


def _turning(text: str) -> str:
    """Return the angle unit that a unit contains: cycles ("Hz") or radians ("rad"); empty if none."""
    for name in map(_long_name, NAME.findall(text)):
        if name.endswith("hertz"):
            return "Hz"
        if name.endswith(_ANGLES):
            return "rad"
    return ""


class _Units(TREE):
    """The actions of the rules of unit.lark, which return Pint's products of powers of names."""

    def NAME(self, token: Token) -> Any:
        """Return the unit of a name."""
        return registry().UnitsContainer({_supported_name(token): Fraction(1)})

    def unity(self, parts: list[Token]) -> Any:
        """Return the unit 1. Raises ParseError for other numbers."""
        if parts[0] != "1":
            expected = "a name, such as N, m or s"
            raise ParseError("E222", parts[0], "unit", expected, str(parts[0]))
        return registry().UnitsContainer()

    def times(self, parts: list[Any]) -> Any:
        """Return a product of units."""
        return parts[0] * parts[2]

    def over(self, parts: list[Any]) -> Any:
        """Return a quotient of units."""
        return parts[0] / parts[1]

    def raised(self, parts: list[Any]) -> Any:
        """Return a power of a unit."""
        exponent = parts[-1]
        return parts[0] ** (Fraction(2 + "²³".index(exponent)) if token_type_of(exponent) else exponent)

    def exponent(self, parts: list[Token]) -> Fraction:
        """Return an exponent. Raises ParseError if it is too large or divides by zero."""
        for part in parts:
            if part.type == "NUMBER" and int(part) > MAX_EXPONENT:
                raise ParseError("E222", part, "exponent of a unit", f"at most {MAX_EXPONENT}", str(part))
        try:
            return exponent_of(parts)
        except ZeroDivisionError:
            message = "unit: division by zero in the exponent"
            raise ParseError("E222", parts[-1].end_pos, message) from None


@cache
def _grammar() -> Callable[[str, str], Any]:
    """Return the parser of units."""
    return parser("unit.lark", ["unit"], _Units())


@cache
def registry() -> Any:
    """Return Pint's registry of the supported units, with exact numbers."""
    import pint  # takes as long as many analyses, and few units are not in the table

    return pint.UnitRegistry(str(Path(__file__).with_name("units.txt")), non_int_type=Fraction)


@cache
def _full_registry() -> Any:
    """Return Pint's registry of all its units, for messages; its creation takes a third of a second."""
    import pint

    return pint.UnitRegistry(non_int_type=Fraction)


def _long_name(name: str) -> str:
    """Return Pint's long name of a unit: `megasiemens` for MS; empty if the unit is not supported."""
    for prefix, unit, _ in registry().parse_unit_name(name)[:1]:
        prefixed = unit in registry().get_group("Prefixed").members
        if not prefix or (prefixed and not (unit == "second" and prefix in _LONG)):
            return str(registry().get_name(name))
    return ""


def _supported_name(name: Token) -> str:
    """Return the long name of a supported unit.

    Raises ParseError: E223 an unknown unit, E224 an unsupported unit.
    """
    if long_name := _long_name(name):
        return long_name
    every = _full_registry()
    # Nm is a yarn count in Pint; here it is a mistake for N*m.
    others = [(prefix, unit) for prefix, unit, _ in every.parse_unit_name(name) if unit != "number_meter"]
    if not others:
        message = f"unknown unit {_spelled(name)}"
        raise ParseError("E223", name, message, fix=_proposal(name), subject=name)
    (prefix, unit), *_ = others
    spelled = f"{prefix}{unit}".replace("_", " ")
    roots = every.get_root_units(unit)[1]._units
    if not every._units[unit].is_multiplicative or any(root not in registry() for root in roots):
        shown = f"unit {name}" + (f" ({spelled})" if spelled != name else "")
        message = f"{shown} is not supported"
        raise ParseError("E224", name, message, fix="K" if "degree_" in unit else "", subject=name)
    dimension = every.get_dimensionality(unit)
    like = [other for other in COMMON if registry().get_dimensionality(other) == dimension]
    *first, last = like[:3] or [""]
    proposed = _EXAMPLES + (f"{', '.join(first)} or {last}" if first else last) if like else ""
    spelled = f" ({spelled})" if spelled != name else ""
    message = f"unit {name}{spelled} is not supported{proposed}"
    lower = name.lower()
    similar = (other for other in like if lower == other.lower() or lower.startswith(other))
    raise ParseError("E223", name, message, fix=next(similar, ""), subject=name)


# Cyrillic letters of units, as in кг.
_CYRILLIC = str.maketrans("кгмсНКМГ", "kgmsNKMG")


def _spelled(name: str) -> str:
    """Return a name with its first letter that is not ASCII spelled out."""
    foreign = next((letter for letter in name if not letter.isascii()), "")
    described = unicodedata.name(foreign, "unnamed character") if foreign else ""
    return cut(name) + (f" (U+{ord(foreign):04X}, {described})" if foreign else "")


def _proposal(name: str) -> str:
    """Return the unit that was probably intended: another case, an exponent, a product, or the nearest
    common name.
    """
    if (latin := name.translate(_CYRILLIC)) in COMMON:
        return latin
    for other in COMMON:
        if other.lower() == name.lower():
            return other
    if (power := re.fullmatch(r"([^\W\d_]+)([2-9])", name)) and power.group(1) in COMMON:
        return f"{power.group(1)}^{power.group(2)}"
    for at in range(1, len(name)):
        if name[:at] in COMMON and name[at:] in COMMON:
            return f"{name[:at]}*{name[at:]}"
    return nearest(name, COMMON)
