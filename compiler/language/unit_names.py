"""What the name of a unit stands for.

Takes: a name such as `ms`. Gives: `look_up`, its scale and dimension; `spelled`, its long name; `turning`,
whether a unit counts cycles or radians; `COMMON`.
Guarantees: exact scales (an angle in degrees uses π to 50 digits); no unit that is out of use in mechanics is
taken for one that is meant; the units that scenes are written in are known here; pint, which knows what every
unit is, is imported when the first rare one is read.
Does not: know the grammar of units (see `unit_grammar`).
"""

from __future__ import annotations

import re
from fractions import Fraction
from functools import lru_cache
from typing import Any

from apc.compiler.errors import nearest
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension, product
from apc.compiler.language.unit_grammar import NAME, Factor, FaultError
from apc.compiler.words import cut

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
COMMON = (
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

# The units there are, by pint's names: those of SI with its prefixes, and what is used beside them. A grain
# or a dram, which pint knows as well, is a slip of whoever means a gram.
_PREFIXED = (
    *("meter", "gram", "second", "ampere", "kelvin", "mole", "candela", "newton", "pascal", "joule", "watt"),
    *("volt", "coulomb", "farad", "ohm", "siemens", "weber", "tesla", "henry", "hertz", "radian"),
    *("lumen", "lux", "liter", "bar"),
)
_ALONE = (
    *("minute", "hour", "day", "degree", "arcminute", "arcsecond", "turn", "percent", "permille", "ppm"),
    *("revolutions_per_minute", "revolutions_per_second", "inch", "foot", "yard", "mil", "thou", "micron"),
    *("metric_ton", "pound", "ounce", "slug", "force_pound", "force_ounce", "force_gram", "force_kilogram"),
    *("pound_force_per_square_inch", "standard_gravity"),
)
_PREFIXES = ("", "pico", "nano", "micro", "milli", "centi", "deci", "hecto", "kilo", "mega", "giga", "tera")
_LONG = ("hecto", "kilo", "mega", "giga", "tera")  # no prefix of a second
_ANGLES = ("rad", "radian", "degree", "arcminute", "arcsecond", "turn", "_per_minute", "_per_second")


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


def _is_in_use(name: str) -> bool:
    """Return whether a name that pint knows is of a unit that is written in mechanics."""
    if name == "°":
        return True
    prefix, unit, _ = _registry().parse_unit_name(name)[0]
    if unit in _PREFIXED:
        return prefix in _PREFIXES and not (unit == "second" and prefix in _LONG)
    return not prefix and unit in _ALONE


@lru_cache(maxsize=1024)
def turning(text: str) -> str:
    """Return whether a unit counts cycles ("Hz") or radians ("rad"); an empty text if it tells of neither."""
    for name in NAME.findall(text):
        long = name if name in _OF_HAPTICS else spelled(name)
        if long.endswith(("Hz", "hertz")):
            return "Hz"
        if long.endswith(_ANGLES):
            return "rad"
    return ""


def spelled(name: str) -> str:
    """Return the long name of a unit, as pint has it: `megasiemens` for MS."""
    return _full_name(name) or name


@lru_cache(maxsize=1024)
def _scaled(name: str) -> Factor | None:
    """Return scale and dimension of one name, or None when a value in it is no multiple of an SI unit."""
    registry = _registry()
    units = registry.UnitsContainer({spelled(name): 1})
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
    return scale, product(tuple(factors))


def _of_haptics() -> dict[str, Factor]:
    """Return the units that scenes are written in; pint says the same of each, and need not be loaded."""
    newton = (("kg", 1), ("m", 1), ("s", -2))
    units: dict[str, tuple[tuple[tuple[str, Fraction | int], ...], Fraction]] = {
        "m": ((("m", 1),), Fraction(1)),
        "s": ((("s", 1),), Fraction(1)),
        "g": ((("kg", 1),), Fraction(1, 1000)),
        "N": (newton, Fraction(1)),
        "Hz": ((("s", -1),), Fraction(1)),
        "J": ((("kg", 1), ("m", 2), ("s", -2)), Fraction(1)),
        "W": ((("kg", 1), ("m", 2), ("s", -3)), Fraction(1)),
        "A": ((("A", 1),), Fraction(1)),
        "V": ((("A", -1), ("kg", 1), ("m", 2), ("s", -3)), Fraction(1)),
        "rad": ((), Fraction(1)),
    }
    prefixes = {"": Fraction(1), "m": Fraction(1, 1000), "k": Fraction(1000), "u": Fraction(1, 10**6)}
    prefixed = {
        prefix + name: (factor * scale, Dimension(exponents))
        for name, (exponents, scale) in units.items()
        for prefix, factor in prefixes.items()
        if prefix + name != "ks"
    }
    return {"%": (Fraction(1, 100), DIMENSIONLESS), **prefixed}


_OF_HAPTICS = _of_haptics()


def look_up(name: str, offset: int) -> Factor:
    """Return the scale and dimension of a name that stands at `offset` of its text.

    Raises
    ------
    FaultError
        E223 no such unit, E224 a value in it is no multiple of an SI unit.
    """
    if name in _OF_HAPTICS:
        return _OF_HAPTICS[name]
    if len(name) > 40 or _full_name(name) is None:
        hint = _proposal(name)
        raise FaultError("E223", offset, f"there is no unit {cut(name)}", hint=hint)
    factor = _scaled(name)
    if factor is None:
        what = f"{name} ({spelled(name)}) is no multiple of an SI unit"
        raise FaultError("E224", offset, what, hint="K" if "degree_" in spelled(name) else "")
    if not _is_in_use(name):
        raise FaultError("E223", offset, *_instead(name, factor[1]))
    return factor


def _instead(name: str, dimension: Dimension) -> tuple[str, str, str, str]:
    """Return what is told of a unit that is out of use: words, and the unit that was probably meant."""
    like = [other for other in COMMON if look_up(other, 0)[1] == dimension]
    told = f"; there are {', '.join(like[:3])}" if like else ""
    what = f"there is no unit {name} here: {spelled(name).replace('_', ' ')} is out of use{told}"
    alike = [other for other in like if other.lower() == name.lower()]
    alike += [other for other in like if name.lower().startswith(other)]
    return what, "", "", next(iter(alike), "")


def _proposal(name: str) -> str:
    """Return what was probably meant: another case, an exponent, a product, or the nearest common name."""
    for other in COMMON:
        if other.lower() == name.lower():
            return other
    if (power := re.fullmatch(r"([^\W\d_]+)([2-9])", name)) and power.group(1) in COMMON:
        return f"{power.group(1)}^{power.group(2)}"
    for at in range(1, len(name)):
        if name[:at] in COMMON and name[at:] in COMMON:
            return f"{name[:at]}*{name[at:]}"
    return nearest(name, COMMON)
