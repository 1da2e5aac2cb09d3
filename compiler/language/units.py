"""The text of a unit or of a quantity to exact SI numbers.

Takes: a text (`N*s/m`, `500 N/m`), and where it stands.
Gives: `Unit`, `Quantity`; `parse_unit`, `parse_quantity`, and `quantity`, which has to fit a unit.
Guarantees: values are exact rationals (0.1 kg is 1/10); the cost of a text is bounded.
Does not: know which quantity wants which unit, or check expressions (see `unit_check`).

The grammar of a quantity, whose unit is that of `unit_grammar`:

    quantity = number ["/" number] [unit]
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import lru_cache

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.language.expression import PI
from apc.compiler.language.unit_grammar import NAME, FaultError, parse_factor
from apc.compiler.language.unit_names import COMMON, look_up, spelled, turning
from apc.compiler.words import cut

TURN = 2 * PI  # a cycle in radians
MAX_LENGTH = 200  # characters of a quantity
MAX_NUMBER_EXPONENT = 300  # of 1e300: still a float

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
    except FaultError as fault:
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
    except FaultError as fault:
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
    except FaultError as fault:
        if fault.code == "E221" and not fault.hint:
            example = "1" if wanted.text == "1" else f"1 {unit}"
            got = cut(text) or "nothing"
            raise ApcError(Mistake("E221", place, what, named, got, f"{what}: {example}")) from None
        raise fault.placed(text, place) from None
    if found.unit.dimension == wanted.dimension and (
        found.unit != NO_UNIT or wanted.dimension == DIMENSIONLESS
    ):
        if found.unit.dimension.clashes(wanted.dimension):
            raise ApcError(_other_turning(found, wanted, place, what))
        return found
    number = _QUANTITY_START.match(text.strip())
    assert number is not None
    got, right = cut(text.strip()), unit
    if found.unit == NO_UNIT:
        got += " (no unit)"
    elif (confused := _confused(found.unit, wanted.dimension)) is not None:
        name, right = confused
        got += f" ({name} is {spelled(name)}: case matters)"
    else:
        right = _meant(found.unit, wanted)
    shown = number.group().strip()
    hint = f"{what}: {shown} {right}".removesuffix(" 1") if right else ""
    raise ApcError(Mistake("E204", place, what, named, got, hint))


def _meant(unit: Unit, wanted: Unit) -> str:
    """Return a unit of the dimension that is wanted in which the number as written may be meant.

    That is the unit without one of its exponents, or with a letter more, or failing that the one that is
    wanted, if a value in it is as large: 5 N/mm^2 are not proposed as 5 N/m, a millionth of it.
    """
    texts = [unit.text[: one.start()] + unit.text[one.end() :] for one in _EXPONENT.finditer(unit.text)]
    for name in NAME.findall(unit.text):
        longer = (other for other in COMMON if other.startswith(name) and len(other) == len(name) + 1)
        texts += [re.sub(rf"\b{re.escape(name)}\b", other, unit.text) for other in longer]
    fitting = (text for text in texts if _is_of(text, wanted.dimension))
    return next(fitting, wanted.text if unit.scale == wanted.scale else "")


def _other_turning(found: Quantity, wanted: Unit, place: Place, what: str) -> Mistake:
    """Return what is told of cycles where radians are due, or the reverse: 20 Hz are 125.66 rad/s."""
    number = _QUANTITY_START.match(found.text.strip())
    assert number is not None
    turns = TURN if wanted.dimension.turning == "rad" else 1 / TURN
    same = f"{float(found.value * turns / wanted.scale):.9g} {wanted.text}"
    got = f"{cut(found.text.strip())}, which is {same}"
    hint = f"{what}: {same}, or {what}: {number.group().strip()} {wanted.text}"
    return Mistake("E204", place, what, wanted.text, got, hint)


def _confused(unit: Unit, wanted: Dimension) -> tuple[str, str] | None:
    """Return a name of the unit that fits in another case, and the unit written with it: MS for ms."""
    for name in NAME.findall(unit.text):
        for other in COMMON:
            if other != name and other.lower() == name.lower():
                text = unit.text.replace(name, other)
                if _is_of(text, wanted):
                    return name, text
    return None


def _is_of(text: str, wanted: Dimension) -> bool:
    """Say whether a text is a unit of a dimension; made from another unit it may be none, as a root of mm."""
    try:
        return _unit(text).dimension == wanted
    except FaultError:
        return False


@lru_cache(maxsize=4096)
def _quantity(text: str) -> Quantity:
    if len(text) > MAX_LENGTH:
        raise FaultError(
            "E221", 0, "a quantity", expected=f"at most {MAX_LENGTH} characters", got=f"{len(text)}"
        )
    if _NOT_FINITE.match(text.strip()):
        raise FaultError("E221", 0, "a quantity", expected="a finite number", got=cut(text.strip()))
    found = _QUANTITY_START.match(text)
    if found is None:
        hint = text.strip().replace("−", "-") if text.strip().startswith("−") else ""
        got = cut(text.strip()) or "nothing"
        raise FaultError("E221", 0, "a quantity", expected="a number and its unit", got=got, hint=hint)
    value = _number(found.group(), len(found.group()) - len(found.group().lstrip()))
    rest = text[found.end() :]
    if re.match(r",[0-9]", rest):
        hint = f"{found.group().strip()}.{rest[1:].strip()}"
        raise FaultError("E221", found.end(), "a number has a decimal point, not a comma", hint=cut(hint))
    if re.match(r"\s*/", rest):
        hint = f"{found.group().strip()} 1{rest.strip()}"
        raise FaultError(
            "E222", found.end(), "a unit", expected="something above the /", got="nothing", hint=hint
        )
    try:
        unit = _unit(rest) if rest.strip() else NO_UNIT
    except FaultError as fault:
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
            raise FaultError("E226", offset, "a number", expected=limit, got=cut(exponent))
        values.append(Fraction(mantissa) * Fraction(10) ** int(exponent or 0))
    if len(values) == 1:
        return values[0]
    if values[1] == 0:
        raise FaultError("E221", offset, f"{cut(text.strip())} divides by zero")
    return values[0] / values[1]


def _finite(value: Fraction) -> Fraction:
    try:
        rounded = float(value)
    except OverflowError:
        rounded = math.inf
    if math.isinf(rounded):
        raise FaultError("E226", 0, "this quantity is too large for a number")
    return value


@lru_cache(maxsize=1024)
def _unit(text: str) -> Unit:
    if len(text) > MAX_LENGTH:
        raise FaultError("E222", 0, "a unit", expected=f"at most {MAX_LENGTH} characters", got=f"{len(text)}")
    scale, dimension = parse_factor(text, look_up)
    return Unit(text.strip(), scale, replace(dimension, turning=turning(text)))
