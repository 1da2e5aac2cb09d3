"""The declarations of a component: equations, what it sends, variables and parameters; YAML to typed data.

Takes: the body of a definition.
Gives: `read_equations`, `read_sends`, `read_variables`, `read_parameters`, `declared_once`.
Guarantees: a number is in SI and of its declared unit's dimension; a fault is reported and its item left out;
a vector is declared as its entries, `x[1]`, `x[2]`.
Does not: look at how the declarations fit together (see `definitions`).
"""

from __future__ import annotations

import re
from fractions import Fraction
from functools import partial

from apc.compiler.components.component import ROLES, Number, Option, Parameter, Reference, Variable
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.language.expression import Equation, Expr
from apc.compiler.language.grammar import parse_equation, parse_expression
from apc.compiler.language.units import Unit, parse_quantity, parse_unit, quantity
from apc.compiler.language.values import AlreadyReportedError, Bounds, Value, text_place
from apc.compiler.language.vectors import SIZES
from apc.compiler.language.vectors import entries as names_of
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import (
    Body,
    brief,
    fault,
    form,
    list_of,
    mapping_of,
    name_of,
    text_of,
    unknown,
    whole_number,
)

Written = tuple[Expr, str, Place]  # an expression, its text, and where it starts
VARIABLE = ("unit", "size", "start", "limit", "about")
NUMBER = ("unit", "size", "min", "above", "max", "default", "about", "shared", "options")
OPTION = ("options", "default", "about")
TABLE = ("table", "about")
_DEFINES = re.compile(r"\s*([A-Za-z]\w*)\s*=", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\Z", re.ASCII)


def read_equations(root: Body, mistakes: Mistakes) -> tuple[tuple[Equation, ...], set[str]]:
    """Read `equations: [a + b = c]`.

    Parameters
    ----------
    root
        The definition.
    mistakes
        Takes those of equations, which hide no mistake of the others.

    Returns
    -------
    The equations, and the names that stand alone on the left of those that couldn't be read.
    """
    node = root.nodes.get("equations")
    found, undefined = [], set()
    if not isinstance(node, Sequence | None):
        hint = "equations: [a + b = c]"
        mistakes.add("E203", node.place, "equations", expected="a list", got=form(node), hint=hint)
    for item in node.items if isinstance(node, Sequence) else ():
        with mistakes:
            text = text_of(item, "an equation", "- a + b = c")
            defined = _DEFINES.findall(text)[:1] if _DEFINES.match(text) else []
            undefined.update(defined)
            found.append(parse_equation(text, text_place(item)))
            undefined.difference_update(defined)
    return tuple(found), undefined


def read_sends(root: Body, mistakes: Mistakes) -> dict[str, Written]:
    """Read `sends: {x: sample(object.x)}`."""
    found = {}
    for key, value in root.section("sends", "{x: sample(object.x)}"):
        with mistakes:
            name = name_of(key, "what is sent")
            text = text_of(value, name, f"{name}: sample(object.x)")
            place = text_place(value)
            found[name] = parse_expression(text, place), text, place
    return found


def read_variables(root: Body, section: str = "variables") -> tuple[Variable, ...]:
    """Read `variables: {x: {unit: m}}`, or a connector's potentials or flows."""
    found: list[Variable] = []
    for key, value in root.section(section, "{x: {unit: m}}"):
        with root.mistakes:
            name = name_of(key, "a variable")
            meant = value.text if isinstance(value, Scalar) and _is_unit(value.text) else "…"
            node = mapping_of(value, name, f"{name}: {{unit: {meant}}}")
            body = Body(node, VARIABLE, f"variable {name}", root.mistakes)
            about, limit = body.text("about"), body.text("limit", "limit: force_limit")
            unit, size = _unit_and_size(body, name)
            starts = _entries_of(body, "start", name, unit, size)
            for one, start in zip(names_of(name, size), starts, strict=True):
                found.append(Variable(one, unit, start, about, key.place, limit))
    return tuple(found)


def _is_unit(text: str) -> bool:
    try:
        return bool(text.strip()) and parse_unit(text, Place("")) is not None
    except ApcError:
        return False


def read_parameters(root: Body) -> tuple[Parameter, ...]:
    """Read `parameters: {stiffness: {unit: N/m, min: 0}}`: numbers, options, tables and roles."""
    found: list[Parameter] = []
    for key, value in root.section("parameters", "{stiffness: {unit: N/m, min: 0}}"):
        with root.mistakes:
            name = name_of(key, "a parameter")
            what = f"parameter {name}"
            if isinstance(value, Scalar):
                if value.text not in ROLES:
                    expected = f"{', '.join(ROLES)}, or a mapping with its unit"
                    hint = f"{name}: {{unit: N/m, min: 0}}"
                    raise fault("E203", value.place, what, expected, brief(value.text) or "nothing", hint)
                found.append(Reference(name, value.text, "", value.place))
                continue
            node = mapping_of(value, what, f"{name}: {{unit: N/m}}")
            options = node.get("options")
            if (table := node.get("table")) is not None:
                body = Body(node, TABLE, what, root.mistakes)
                unit = parse_unit(text_of(table, "table", "table: N"), table.place)
                found.append(Reference(name, "table", body.text("about"), node.place, unit))
            elif isinstance(options, Sequence):
                found.append(_option(name, options, Body(node, OPTION, what, root.mistakes)))
            else:
                found += _numbers(name, Body(node, NUMBER, what, root.mistakes))
    return tuple(found)


def _option(name: str, options: Sequence, body: Body) -> Option:
    words = []
    for item in options.items:
        with body.mistakes:
            words.append(text_of(item, "an option"))
    default, node = body.text("default"), body.nodes.get("default")
    if default and node is not None and default not in words:
        what = f"{name} has no option {brief(default)}"
        body.mistakes.take(unknown("E206", node.place, what, default, words))
    return Option(name, tuple(words), default or None, body.text("about"), options.place)


def _numbers(name: str, body: Body) -> list[Number]:
    """Read a number's declaration, or a vector's, of which each entry is a number."""
    about, shared, nodes = body.text("about"), body.text("shared"), body.nodes
    if shared not in ("", "divided", "whole"):
        wrong = fault("E203", nodes["shared"].place, "shared", "divided or whole", brief(shared))
        body.mistakes.take(wrong)
    unit, size = _unit_and_size(body, name)

    def number(node: Node, _: str) -> Fraction:
        return _number(node, name, unit)

    minimum, above, most = (body.read(key, number, None) for key in ("min", "above", "max"))
    options, default = nodes.get("options"), nodes.get("default")
    if size and options is not None:
        raise fault("E203", options.place, name, "a number, to have names for its values", "a vector")
    if minimum is not None and above is not None:
        body.mistakes.add("E203", nodes["above"].place, name, expected="either min or above", got="both")
    first = names_of(name, size)[0]
    least = minimum if above is None else above
    bounds = Bounds(unit.text, unit.scale, least, above is not None, most)

    def within(value: Fraction, node: Node, what: str) -> Fraction:
        """Return a number of the declaration itself, which has to lie within its bounds."""
        bounds.check(Value(value, unit.dimension, None, node.place), what, body.mistakes)
        return value

    if most is not None:
        within(most, nodes["max"], f"the max of {first}")
    words: dict[str, Fraction] = {}
    for key, node in () if options is None else mapping_of(options, "options").entries:
        with body.mistakes:
            value = _number(node, key.text, unit)
            words[key.text] = within(value, node, f"{key.text} of {first}")
    if isinstance(default, Scalar) and default.text in words:
        defaults: list[Fraction | None] = [words[default.text]]
    else:
        defaults = _entries_of(body, "default", name, unit, size)
    found = []
    for one, start in zip(names_of(name, size), defaults, strict=True):
        if start is not None and default is not None:
            within(start, default, f"the default of {one}")
        divided, named = shared == "divided", tuple(words.items())
        limits = least, above is not None, most
        found.append(Number(one, unit, start, *limits, divided, named, about, body.place))
    return found


def _unit_and_size(body: Body, name: str) -> tuple[Unit, int]:
    """Read the unit that a declaration must have, and `size: 2`, the entries of a vector; 0 for a number."""
    unit = body.read("unit", _unit, None)
    size = body.read("size", partial(_size, name=name), 0)
    if unit is None and "unit" not in body.nodes:
        hint = f"{name}: {{unit: N/m}}  (unit: 1 when it has none)"
        raise fault("E201", body.place, f"{name} has no unit", hint=hint)
    if unit is None:
        raise AlreadyReportedError
    return unit, size


def _unit(node: Node, what: str) -> Unit:
    return parse_unit(text_of(node, what, "unit: N/m"), node.place)


def _size(node: Node, what: str, name: str) -> int:
    size = whole_number(node)
    if size in SIZES:
        return size
    hint = f"{name}: {{unit: m, {what}: 2}}" if size != 1 else f"{name}: {{unit: m}}"
    raise fault("E203", node.place, f"the {what} of {name}", "2 or 3", form(node), hint)


def _entries_of(body: Body, key: str, name: str, unit: Unit, size: int) -> list[Fraction | None]:
    """Read the default or start of a number, or the list of a vector's; None of one that isn't given."""

    def read(node: Node, _: str) -> list[Fraction | None]:
        nodes = list_of(node, key, size, "0") if size else (node,)
        return [_number(one, name, unit) for one in nodes]

    return body.read(key, read, [None] * max(size, 1))


def _number(node: Node, what: str, unit: Unit) -> Fraction:
    """Read a number of a declaration: bare, it is in the unit declared beside it."""
    text = text_of(node, what)
    if _NUMBER.match(text):
        return parse_quantity(text, node.place).value * unit.scale
    return quantity(text, node.place, what=what, unit=unit.text).value
