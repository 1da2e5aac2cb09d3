"""The declarations of a component: equations, what it sends, variables and parameters; YAML to typed data.

Takes: the sections of a definition.
Gives: `read_equations`, `names_of_faulty`, `read_sends`, `read_variables`, `read_parameters`.
Guarantees: a number is in SI and of its declared unit's dimension; a fault is reported and its item left out;
a vector is declared as its entries, `x[1]`, `x[2]`.
Does not: look at how the declarations fit together (see `definitions`).
"""

from __future__ import annotations

import re
from fractions import Fraction

from apc.compiler.components.component import ROLES, Number, Option, Parameter, Reference, Variable
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.language.expression import Equation, Expr
from apc.compiler.language.grammar import parse_equation, parse_expression
from apc.compiler.language.units import Unit, parse_quantity, parse_unit, quantity
from apc.compiler.language.values import Value, text_place
from apc.compiler.language.vectors import SIZES
from apc.compiler.language.vectors import entries as vector_entries
from apc.compiler.source.nodes import Mapping, Node, Scalar, Sequence
from apc.compiler.source.reading import (
    add_unknown,
    brief,
    check_keys,
    entries,
    form,
    listed,
    read_mapping,
    read_name,
    read_text,
    whole_number,
)

Sends = tuple[tuple[str, Expr, str, Place], ...]
_DEFINES = re.compile(r"\s*([A-Za-z]\w*)\s*=", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\Z", re.ASCII)


def read_equations(node: Node | None, mistakes: Mistakes) -> tuple[Equation, ...]:
    """Read `equations: [a + b = c]`."""
    if node is None:
        return ()
    if not isinstance(node, Sequence):
        mistakes.add(
            "E203", node.place, "equations", expected="a list", got=form(node), hint="equations: [a + b = c]"
        )
        return ()
    found = []
    for item in node.items:
        text = read_text(item, "an equation", mistakes, hint="- a + b = c")
        if text is not None:
            try:
                found.append(parse_equation(text, text_place(item)))
            except ApcError as error:
                mistakes.take(error)
    return tuple(found)


def names_of_faulty(node: Node | None, read: tuple[Equation, ...]) -> set[str]:
    """Return the names that stand alone on the left of equations that couldn't be read.

    Parameters
    ----------
    node
        The section `equations`.
    read
        Those of its equations that were read.
    """
    items = node.items if isinstance(node, Sequence) else ()
    known = {equation.text for equation in read}
    texts = [item.text for item in items if isinstance(item, Scalar) and item.text not in known]
    return {found[1] for text in texts if (found := _DEFINES.match(text))}


def read_sends(node: Node | None, mistakes: Mistakes) -> Sends:
    """Read `sends: {x: sample(object.x)}` as (name, expression, its text, its place)."""
    found = []
    for key, value in entries(read_mapping(node, "sends", mistakes, hint="sends: {x: sample(object.x)}")):
        name = read_name(key, "what is sent", mistakes)
        text = read_text(value, key.text, mistakes, hint=f"{key.text}: sample(object.x)")
        if name is None or text is None:
            continue
        place = text_place(value)
        try:
            found.append((name, parse_expression(text, place), text, place))
        except ApcError as error:
            mistakes.take(error)
    return tuple(found)


def read_variables(node: Node | None, mistakes: Mistakes) -> tuple[Variable, ...]:
    """Read `variables: {x: {unit: m}}`, or a connector's potentials or flows."""
    found = []
    for key, value in entries(read_mapping(node, "variables", mistakes, hint="variables: {x: {unit: m}}")):
        name = read_name(key, "a variable", mistakes)
        meant = value.text if isinstance(value, Scalar) and _is_unit(value.text, value.place) else "…"
        body = read_mapping(value, key.text, mistakes, hint=f"{key.text}: {{unit: {meant}}}")
        if name is None or body is None:
            continue
        body = check_keys(body, ("unit", "size", "start", "limit", "about"), f"variable {name}", mistakes)
        unit, size = _unit(body, name, mistakes), _size(body, name, mistakes)
        starts = _entries(body.get("start"), "start", name, unit, size, mistakes)
        about = read_text(body.get("about"), "about", mistakes) or ""
        limit = read_text(body.get("limit"), "limit", mistakes, hint="limit: force_limit") or ""
        if unit is not None and size is not None:
            named = zip(vector_entries(name, size), starts, strict=True)
            found += [Variable(one, unit, start, about, key.place, limit) for one, start in named]
    return tuple(found)


def _is_unit(text: str, place: Place) -> bool:
    try:
        return bool(text.strip()) and parse_unit(text, place) is not None
    except ApcError:
        return False


def read_parameters(node: Node | None, mistakes: Mistakes) -> tuple[Parameter, ...]:
    """Read `parameters: {stiffness: {unit: N/m, min: 0}}`: numbers, options, tables and roles."""
    found: list[Parameter] = []
    hint = "parameters: {stiffness: {unit: N/m, min: 0}}"
    for key, value in entries(read_mapping(node, "parameters", mistakes, hint=hint)):
        name = read_name(key, "a parameter", mistakes)
        if name is None:
            continue
        parameter: Parameter | None
        if isinstance(value, Scalar):
            parameter = _reference(name, value, mistakes)
        else:
            body = read_mapping(value, f"parameter {name}", mistakes, hint=f"{name}: {{unit: N/m}}")
            if body is None:
                continue
            if body.get("table") is not None:
                parameter = _table(name, body, mistakes)
            elif _has_words(body):
                parameter = _option(name, body, mistakes)
            else:
                found += _numbers(name, body, mistakes)
                continue
        if parameter is not None:
            found.append(parameter)
    return tuple(found)


def _has_words(body: Mapping) -> bool:
    return isinstance(body.get("options"), Sequence)


def _reference(name: str, value: Scalar, mistakes: Mistakes) -> Reference | None:
    if value.text in ROLES:
        return Reference(name, value.text, "", value.place)
    mistakes.add(
        "E203",
        value.place,
        f"parameter {name}",
        expected=f"{', '.join(ROLES)}, or a mapping with its unit",
        got=brief(value.text) or "nothing",
        hint=f"{name}: {{unit: N/m, min: 0}}",
    )
    return None


def _option(name: str, body: Mapping, mistakes: Mistakes) -> Option | None:
    body = check_keys(body, ("options", "default", "about"), f"parameter {name}", mistakes)
    options = body.get("options")
    assert isinstance(options, Sequence)
    words = tuple(text for item in options.items if (text := read_text(item, "an option", mistakes)))
    default = read_text(body.get("default"), "default", mistakes)
    node = body.get("default")
    if default is not None and node is not None and default not in words:
        what = f"{name} has no option {brief(default)}"
        add_unknown("E206", node.place, what, default, words, mistakes)
    about = read_text(body.get("about"), "about", mistakes) or ""
    return Option(name, words, default, about, options.place)


def _table(name: str, body: Mapping, mistakes: Mistakes) -> Reference | None:
    """Read `{table: N}`: a file of numbers over time, in a unit of the same dimension."""
    body = check_keys(body, ("table", "about"), f"parameter {name}", mistakes)
    node = body.get("table")
    text = read_text(node, "table", mistakes, hint="table: N")
    about = read_text(body.get("about"), "about", mistakes) or ""
    if node is None or text is None:
        return None
    try:
        return Reference(name, "table", about, body.place, parse_unit(text, node.place))
    except ApcError as error:
        mistakes.take(error)
        return None


def _numbers(name: str, body: Mapping, mistakes: Mistakes) -> list[Number]:
    """Read a number's declaration, or a vector's, of which each entry is a number."""
    keys = ("unit", "size", "min", "above", "max", "default", "about", "shared", "options")
    body = check_keys(body, keys, f"parameter {name}", mistakes)
    unit, size = _unit(body, name, mistakes), _size(body, name, mistakes)
    shared = read_text(body.get("shared"), "shared", mistakes)
    node = body.get("shared")
    if shared not in (None, "divided", "whole") and node is not None:
        mistakes.add("E203", node.place, "shared", expected="divided or whole", got=brief(shared or ""))
    minimum = _declared(body.get("min"), name, unit, mistakes)
    above = _declared(body.get("above"), name, unit, mistakes)
    maximum = _declared(body.get("max"), name, unit, mistakes)
    words = []
    if size and (node := body.get("options")) is not None:
        mistakes.add(
            "E203", node.place, name, expected="a number, to have names for its values", got="a vector"
        )
    for key, value in entries(read_mapping(body.get("options"), "options", mistakes)):
        number = _declared(value, key.text, unit, mistakes)
        if number is not None:
            words.append((key.text, number))
    node = body.get("default")
    named = dict(words).get(node.text) if isinstance(node, Scalar) else None
    defaults = (named,) if named is not None else _entries(node, "default", name, unit, size, mistakes)
    about = read_text(body.get("about"), "about", mistakes) or ""
    if unit is None or size is None:
        return []
    least, most = above if above is not None else minimum, maximum
    found = [
        Number(
            one,
            unit,
            default,
            least,
            above is not None,
            most,
            shared == "divided",
            tuple(words),
            about,
            body.place,
        )
        for one, default in zip(vector_entries(name, size), defaults, strict=True)
    ]
    for one in found:
        _check_bounds(one, body, mistakes)
    return found


def _size(body: Mapping, name: str, mistakes: Mistakes) -> int | None:
    """Read `size: 2`: how many entries a vector has; 0 for a number, None for a fault."""
    node = body.get("size")
    if node is None:
        return 0
    size = whole_number(node)
    if size in SIZES:
        return size
    hint = f"{name}: {{unit: m, size: 2}}" if size != 1 else f"{name}: {{unit: m}}"
    mistakes.add("E203", node.place, f"the size of {name}", expected="2 or 3", got=form(node), hint=hint)
    return None


def _entries(
    node: Node | None, key: str, name: str, unit: Unit | None, size: int | None, mistakes: Mistakes
) -> tuple[Fraction | None, ...]:
    """Read the default or start of a number, or the list of a vector's."""
    if not size:
        return (_declared(node, name, unit, mistakes),) if size == 0 else ()
    found = None if node is None else listed(node, key, size, "0", mistakes)
    if found is None:
        return (None,) * size
    return tuple(_declared(one, name, unit, mistakes) for one in found)


def _check_bounds(number: Number, body: Mapping, mistakes: Mistakes) -> None:
    """Record two lower bounds, and a maximum, a default or a named value that is out of bounds."""
    above, maximum, default = body.get("above"), body.get("max"), body.get("default")
    if above is not None and body.get("min") is not None:
        mistakes.add("E203", above.place, number.name, expected="either min or above", got="both")
    options, named = body.get("options"), dict(number.words)
    words = entries(options if isinstance(options, Mapping) else None)
    given: list[tuple[str, Fraction | None, Node | None]]
    given = [(key.text, named.get(key.text), value) for key, value in words]
    given += [("the max", number.maximum, maximum), ("the default", number.default, default)]
    for what, value, node in given:
        if value is not None and node is not None:
            found = Value(value, number.unit.dimension, None, node.place)
            number.bounds.check(found, f"{what} of {number.name}", mistakes)


def _unit(body: Mapping, name: str, mistakes: Mistakes) -> Unit | None:
    node = body.get("unit")
    if node is None:
        mistakes.add(
            "E201",
            body.place,
            f"{name} has no unit",
            hint=f"{name}: {{unit: N/m}}  (unit: 1 when it has none)",
        )
        return None
    text = read_text(node, "unit", mistakes, hint="unit: N/m")
    if text is None:
        return None
    try:
        return parse_unit(text, node.place)
    except ApcError as error:
        mistakes.take(error)
        return None


def _declared(node: Node | None, name: str, unit: Unit | None, mistakes: Mistakes) -> Fraction | None:
    """Read a number of a declaration: bare, it is in the unit declared beside it."""
    text = read_text(node, name, mistakes)
    if node is None or text is None or unit is None:
        return None
    try:
        if _NUMBER.match(text):
            return parse_quantity(text, node.place).value * unit.scale
        return quantity(text, node.place, what=name, unit=unit.text).value
    except ApcError as error:
        mistakes.take(error)
        return None
