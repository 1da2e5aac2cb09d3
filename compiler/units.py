"""Units and quantities: text to exact SI numbers, and SI numbers to text.

Takes: the text of a unit (`N*s/m`) or of a quantity (`500 N/m`), and where it stands.
Gives: `Unit`, `Quantity` and `Dimension`, and their text.
Guarantees: values are exact rationals (0.1 kg is 1/10; an angle in degrees uses π to 50 digits); the cost of
a text is bounded; pint, which knows what every unit is, is imported when the first rare unit is read.
Does not: know which quantity wants which unit, or check expressions (see `dimensions`).

The grammar of a unit, and of a quantity:

    unit     = power {("*" | "·" | "/") power}          left to right: N/m*s is (N/m)*s
    power    = (name | "1" | "(" unit ")") ["^" ["-"] integer | "^(" ["-"] integer ["/" integer] ")"]
    quantity = number ["/" number] [unit]
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import Any, NoReturn

from apc.compiler.errors import ApcError, Mistake, Place, nearest
from apc.compiler.source import place_in

MAX_LENGTH = 200  # characters of a quantity
MAX_EXPONENT = 9  # of a unit: m^9
MAX_NUMBER_EXPONENT = 300  # of 1e300: still a float
MAX_BITS = 4096  # of a unit's scale; 10^300 has 997


@dataclass(frozen=True, slots=True)
class Dimension:
    """A product of powers of SI base units, sorted by name and without zeros; the radian is the number 1."""

    exponents: tuple[tuple[str, Fraction | int], ...]

    def multiply(self, other: Dimension) -> Dimension:
        """Return the dimension of a product."""
        return _dimension((*self.exponents, *other.exponents))

    def divide(self, other: Dimension) -> Dimension:
        """Return the dimension of a quotient."""
        return self.multiply(other.power(-1))

    def power(self, exponent: Fraction | int) -> Dimension:
        """Return the dimension of a power."""
        return _dimension(tuple((base, power * exponent) for base, power in self.exponents))


def _dimension(factors: tuple[tuple[str, Fraction | int], ...]) -> Dimension:
    total: dict[str, Fraction | int] = {}
    for base, power in factors:
        total[base] = total.get(base, 0) + power
    return Dimension(tuple((base, total[base]) for base in sorted(total) if total[base]))


DIMENSIONLESS = Dimension(())


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit as written; a value in it times `scale` is the value in SI."""

    text: str
    scale: Fraction
    dimension: Dimension


@dataclass(frozen=True, slots=True)
class Quantity:
    """`value` in SI; `unit` as written, `NO_UNIT` when there was none; `text` as written."""

    value: Fraction
    unit: Unit
    text: str


NO_UNIT = Unit("1", Fraction(1), DIMENSIONLESS)


def parse_unit(text: str, place: Place) -> Unit:
    """Read a unit; `1` is the unit of a plain number.

    Raises
    ------
    ApcError
        E222 not the text of a unit, E223 no such unit, E224 a unit with an offset or a logarithm,
        E225 an exponent or scale that is too large.
    """
    try:
        return _unit(text)
    except _FaultError as fault:
        raise fault.placed(text, place) from None


def parse_quantity(text: str, place: Place) -> Quantity:
    """Read a number and its unit, if it has one.

    Raises
    ------
    ApcError
        E221 not the text of a quantity, E226 a number that is too large; and those of `parse_unit`.
    """
    try:
        return _quantity(text)
    except _FaultError as fault:
        raise fault.placed(text, place) from None


def quantity(text: str, place: Place, *, what: str, unit: str) -> Quantity:
    """Read a quantity that has to fit a unit.

    Parameters
    ----------
    text
        The quantity as written.
    place
        Where it stands.
    what
        The name it is given to, for messages.
    unit
        A unit that fits; `1` for a plain number.

    Raises
    ------
    ApcError
        E204 a unit that does not fit, or none; and those of `parse_quantity`.
    """
    wanted = parse_unit(unit, place)
    named = "a plain number" if wanted.text == "1" else unit
    try:
        found = _quantity(text)
    except _FaultError as fault:
        if fault.code == "E221" and not fault.hint:
            example = "1" if wanted.text == "1" else f"1 {unit}"
            got = _cut(text) or "nothing"
            raise ApcError(Mistake("E221", place, what, named, got, f"{what}: {example}")) from None
        raise fault.placed(text, place) from None
    if found.unit.dimension == wanted.dimension and (
        found.unit != NO_UNIT or wanted.dimension == DIMENSIONLESS
    ):
        return found
    number = _QUANTITY_START.match(text.strip())
    assert number is not None
    got, right = _cut(text.strip()), unit
    if found.unit == NO_UNIT:
        got += " (no unit)"
    elif (confused := _confused(found.unit, wanted.dimension)) is not None:
        name, right = confused
        got += f" ({name} is {_spelled(name)}: case matters)"
    hint = f"{what}: {number.group().strip()}" + ("" if wanted.text == "1" else f" {right}")
    raise ApcError(Mistake("E204", place, what, named, got, hint))


def _confused(unit: Unit, wanted: Dimension) -> tuple[str, str] | None:
    """Return a name of the unit that fits in another case, and the unit written with it: MS for ms."""
    for name in _NAME.findall(unit.text):
        for other in _COMMON:
            if other != name and other.lower() == name.lower():
                text = unit.text.replace(name, other)
                if _unit(text).dimension == wanted:
                    return name, text
    return None


# Units with a name or a usual form, looked up by dimension; the first form of a dimension wins.
_FORMS = (
    *("1", "kg", "m", "s", "A", "K", "mol", "cd"),
    *("N", "N/m", "N*s/m", "N*s", "N*m", "N/m^2", "N*s^2/m^2", "N*s/m^2", "N*m*s", "N/s", "m/N"),
    *("m/s", "m/s^2", "m/s^3", "m^2", "m^3", "1/s", "1/s^2", "1/m", "W", "V", "N*m/A", "kg*m^2"),
)


def format_dimension(dimension: Dimension) -> str:
    """Return the dimension as an SI unit `parse_unit` reads: `N*s/m`, `1`, or a product of base units."""
    known = _forms().get(dimension)
    return known if known is not None else _product(dimension)


@lru_cache(maxsize=1)
def _forms() -> dict[Dimension, str]:
    """Return the usual form of each dimension of `_FORMS`, read without a registry."""
    return {_UnitParser(text, _derived).parse()[1]: text for text in reversed(_FORMS)}


def _product(dimension: Dimension) -> str:
    above = [_powered(base, power) for base, power in dimension.exponents if power > 0]
    below = [_powered(base, -power) for base, power in dimension.exponents if power < 0]
    text = "*".join(above) or "1"
    if not below:
        return text
    return f"{text}/{below[0]}" if len(below) == 1 else f"{text}/({'*'.join(below)})"


def _powered(base: str, power: Fraction | int) -> str:
    if power == 1:
        return base
    return f"{base}^{power}" if Fraction(power).denominator == 1 else f"{base}^({power})"


def format_si(value: float, unit: Dimension | Unit) -> str:
    """Return an SI value with its SI unit: `500 N/m`; six digits, and no unit for a plain number."""
    text = format_dimension(unit.dimension if isinstance(unit, Unit) else unit)
    return f"{value:.6g}" if text == "1" else f"{value:.6g} {text}"


# The derived units of `_FORMS` in base units, so that formatting needs no registry.
_DERIVED = {
    "N": Dimension((("kg", 1), ("m", 1), ("s", -2))),
    "W": Dimension((("kg", 1), ("m", 2), ("s", -3))),
    "V": Dimension((("A", -1), ("kg", 1), ("m", 2), ("s", -3))),
}


def _derived(name: str, offset: int) -> tuple[Fraction, Dimension]:
    """Look a name of `_FORMS` up."""
    return Fraction(1), _DERIVED.get(name, Dimension(((name, 1),)))


_BASES = {
    "gram": "kg",
    "meter": "m",
    "second": "s",
    "ampere": "A",
    "kelvin": "K",
    "mole": "mol",
    "candela": "cd",
    "radian": "",  # a ratio of two lengths: the number 1
}

# What a scene is likely to use: proposed for a misspelt name, and told apart by case.
_COMMON = (
    *("N", "mN", "kN", "kg", "g", "m", "mm", "cm", "um", "s", "ms", "us", "min", "Hz", "kHz", "rad", "deg"),
    *("A", "mA", "V", "W", "kW", "J", "K", "Pa", "mol", "cd", "lb", "inch", "ft", "kgf", "rpm", "percent"),
    *(
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
    ),
)

_NUMBER = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_QUANTITY_START = re.compile(rf"\s*[+-]?{_NUMBER}(?:\s*/\s*{_NUMBER})?")
_WORD = r"[^\W\d_²³][^\W²³]*|[%°]"  # Python counts ² among the letters of a word
_NAME = re.compile(_WORD)
_TOKEN = re.compile(rf"\s*(\*\*|[*·⋅/^()+-]|[0-9]+|{_WORD}|[²³])")
_SAME = {"**": "^", "·": "*", "⋅": "*"}
_NOT_FINITE = re.compile(r"[+-]?\.?(nan|inf|infinity)\b", re.IGNORECASE)


class _FaultError(Exception):
    """A mistake that does not know yet where its text stands, so that results can be kept by text."""

    def __init__(
        self, code: str, offset: int, what: str, *, expected: str = "", got: str = "", hint: str = ""
    ) -> None:
        super().__init__(what)
        self.code, self.offset, self.what = code, offset, what
        self.expected, self.got, self.hint = expected, got, hint

    def placed(self, text: str, place: Place) -> ApcError:
        at = place_in(place, text, self.offset)
        return ApcError(Mistake(self.code, at, self.what, self.expected, self.got, self.hint))


def _cut(text: str) -> str:
    return text if len(text) <= 40 else text[:37] + "…"


@lru_cache(maxsize=4096)
def _quantity(text: str) -> Quantity:
    if len(text) > MAX_LENGTH:
        raise _FaultError(
            "E221", 0, "a quantity", expected=f"at most {MAX_LENGTH} characters", got=f"{len(text)}"
        )
    if _NOT_FINITE.match(text.strip()):
        raise _FaultError("E221", 0, "a quantity", expected="a finite number", got=_cut(text.strip()))
    found = _QUANTITY_START.match(text)
    if found is None:
        hint = text.strip().replace("−", "-") if text.strip().startswith("−") else ""
        got = _cut(text.strip()) or "nothing"
        raise _FaultError("E221", 0, "a quantity", expected="a number and its unit", got=got, hint=hint)
    value = _number(found.group(), len(found.group()) - len(found.group().lstrip()))
    rest = text[found.end() :]
    if re.match(r",[0-9]", rest):
        hint = f"{found.group().strip()}.{rest[1:].strip()}"
        raise _FaultError("E221", found.end(), "a number has a decimal point, not a comma", hint=_cut(hint))
    if re.match(r"\s*/", rest):
        hint = f"{found.group().strip()} 1{rest.strip()}"
        raise _FaultError(
            "E222", found.end(), "a unit", expected="something above the /", got="nothing", hint=hint
        )
    try:
        unit = _unit(rest) if rest.strip() else NO_UNIT
    except _FaultError as fault:
        fault.offset += found.end()
        raise
    return Quantity(_finite(value * unit.scale), unit, text)


def _number(text: str, offset: int) -> Fraction:
    """Return the exact value of a number or of a quotient of two."""
    above, _, below = text.strip().partition("/")
    values = []
    for part in filter(None, (above.strip(), below.strip())):
        mantissa, _, exponent = part.lower().partition("e")
        if exponent and abs(int(exponent)) > MAX_NUMBER_EXPONENT:
            limit = f"an exponent from -{MAX_NUMBER_EXPONENT} to {MAX_NUMBER_EXPONENT}"
            raise _FaultError("E226", offset, "a number", expected=limit, got=_cut(exponent))
        values.append(Fraction(mantissa) * Fraction(10) ** int(exponent or 0))
    if len(values) == 1:
        return values[0]
    if values[1] == 0:
        raise _FaultError("E221", offset, f"{_cut(text.strip())} divides by zero")
    return values[0] / values[1]


def _finite(value: Fraction) -> Fraction:
    try:
        rounded = float(value)
    except OverflowError:
        rounded = math.inf
    if math.isinf(rounded):
        raise _FaultError("E226", 0, "this quantity is too large for a number")
    return value


@lru_cache(maxsize=1024)
def _unit(text: str) -> Unit:
    if len(text) > MAX_LENGTH:
        raise _FaultError(
            "E222", 0, "a unit", expected=f"at most {MAX_LENGTH} characters", got=f"{len(text)}"
        )
    scale, dimension = _UnitParser(text, _look_up).parse()
    return Unit(text.strip(), scale, dimension)


_Factor = tuple[Fraction, Dimension]


class _UnitParser:
    """Recursive descent; the length of a unit bounds how deep its parentheses go."""

    def __init__(self, text: str, look_up: Callable[[str, int], _Factor]) -> None:
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
        raise _FaultError("E222", offset, "a unit", expected=expected, got=token or "its end", hint=hint)

    def parse(self) -> _Factor:
        factor = self.product()
        if self.token:
            text = self.text.strip()
            joined = re.sub(r"(\w)\s+(?=\w)", r"\1*", text)
            self.fail("* or / between two names", joined if joined != text else "")
        return factor

    def product(self) -> _Factor:
        scale, dimension = self.power()
        while self.token in ("*", "/"):
            divided = self.step() == "/"
            factor, other = self.power()
            scale = scale / factor if divided else scale * factor
            dimension = dimension.divide(other) if divided else dimension.multiply(other)
            self.check(scale, dimension)
        return scale, dimension

    def power(self) -> _Factor:
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

    def atom(self) -> _Factor:
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
        if not _NAME.fullmatch(token):
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
        what = f"{_cut(self.text.strip())} is no unit of this world: an exponent or its scale is too large"
        raise _FaultError("E225", 0, what)


def _unit_tokens(text: str) -> Iterator[tuple[str, int]]:
    at = 0
    end = len(text.rstrip())
    while at < end:
        found = _TOKEN.match(text, at)
        if found is None:
            skipped = len(text[at:]) - len(text[at:].lstrip())
            character = text[at + skipped]
            expected = "names joined by * and /, with exponents such as ^2"
            raise _FaultError("E222", at + skipped, "a unit", expected=expected, got=repr(character))
        yield _SAME.get(found.group(1), found.group(1)), found.start(1)
        at = found.end()
    yield "", end


@lru_cache(maxsize=1)
def _registry() -> Any:
    """Return pint's registry with exact numbers; it takes a third of a second to build."""
    import pint

    return pint.UnitRegistry(non_int_type=Fraction)


def _full_name(name: str) -> str | None:
    """Return pint's long name of a unit: `megasiemens` for MS; None when it knows none."""
    if name == "°":
        return "degree"
    found = _registry().parse_unit_name(name)
    # Nm is a yarn count to pint, and a slip for N*m to everyone else.
    names = [prefix + unit for prefix, unit, _ in found if unit != "number_meter"]
    return names[0] if names else None


def _spelled(name: str) -> str:
    return _full_name(name) or name


@lru_cache(maxsize=1024)
def _scaled(name: str) -> _Factor | None:
    """Return scale and dimension of one name, or None when a value in it is no multiple of an SI unit."""
    registry = _registry()
    units = registry.UnitsContainer({_spelled(name): 1})
    try:
        zero = registry.Quantity(Fraction(0), units).to_root_units().magnitude
        one = registry.Quantity(Fraction(1), units).to_root_units()
    except (TypeError, ValueError, ArithmeticError):  # pint takes the logarithm of a Fraction
        return None
    if zero != 0:
        return None
    scale, factors = Fraction(one.magnitude), []
    for base, power in one._units.items():
        if base not in _BASES:
            return None
        if base == "gram":
            scale /= Fraction(1000) ** int(power)
        if _BASES[base]:
            factors.append((_BASES[base], int(power) if power == int(power) else Fraction(power)))
    return scale, _dimension(tuple(factors))


def _of_haptics() -> dict[str, _Factor]:
    """Return the units that scenes are written in; pint says the same of each, and need not be loaded."""
    newton = (("kg", 1), ("m", 1), ("s", -2))
    units: dict[str, tuple[tuple[tuple[str, Fraction | int], ...], Fraction]] = {
        "m": ((("m", 1),), Fraction(1)),
        "s": ((("s", 1),), Fraction(1)),
        "g": ((("kg", 1),), Fraction(1, 1000)),
        "N": (newton, Fraction(1)),
        "Hz": ((("s", -1),), Fraction(1)),
    }
    prefixes = {"": Fraction(1), "m": Fraction(1, 1000), "k": Fraction(1000), "u": Fraction(1, 10**6)}
    return {
        prefix + name: (factor * scale, Dimension(exponents))
        for name, (exponents, scale) in units.items()
        for prefix, factor in prefixes.items()
    }


_OF_HAPTICS = _of_haptics()


def _look_up(name: str, offset: int) -> _Factor:
    if name in _OF_HAPTICS:
        return _OF_HAPTICS[name]
    if len(name) > 40 or _full_name(name) is None:
        hint = _proposal(name)
        raise _FaultError("E223", offset, f"there is no unit {_cut(name)}", hint=hint)
    factor = _scaled(name)
    if factor is None:
        what = f"{name} ({_spelled(name)}) is no multiple of an SI unit"
        raise _FaultError("E224", offset, what, hint="K" if "degree_" in _spelled(name) else "")
    return factor


def _proposal(name: str) -> str:
    """Return what was probably meant: another case, an exponent, a product, or the nearest common name."""
    for other in _COMMON:
        if other.lower() == name.lower():
            return other
    if (power := re.fullmatch(r"([^\W\d_]+)([2-9])", name)) and power.group(1) in _COMMON:
        return f"{power.group(1)}^{power.group(2)}"
    for cut in range(1, len(name)):
        if name[:cut] in _COMMON and name[cut:] in _COMMON:
            return f"{name[:cut]}*{name[cut:]}"
    return nearest(name, _COMMON)
