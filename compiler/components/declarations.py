"""The declarations of a component: equations, sends, variables and parameters; YAML to typed data.

Takes: the body of a definition.
Gives: `read_equations`, `read_linearized`, `read_sends`, `read_variables`, `read_parameters`.
Guarantees: a number is in SI units and has the dimension of its declared unit; an invalid item is reported
and omitted; a vector is declared as its entries, `x[1]`, `x[2]`.
Does not: check the declarations against each other (see `definitions`).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from collections.abc import Sequence as Several
from contextlib import suppress
from dataclasses import replace
from fractions import Fraction
from functools import partial
from itertools import chain

from apc.compiler.components.component import (
    ROLES,
    ComponentVariable,
    Linearized,
    Named,
    NumberParameter,
    Option,
    Parameter,
    Reference,
    SentValue,
)
from apc.compiler.errors import ApcError, Mistakes, SourceLocation, nearest
from apc.compiler.language.constants import check_constants
from apc.compiler.language.dimensions import DIMENSIONLESS
from apc.compiler.language.expression import Equation
from apc.compiler.language.grammar import parse_equation, parse_expression
from apc.compiler.language.units import Unit, parse_quantity, parse_unit, quantity
from apc.compiler.language.values import AlreadyReportedError, ScalarValue, text_location
from apc.compiler.language.vectors import SIZES
from apc.compiler.language.vectors import entries as names_of
from apc.compiler.source.nodes import Mapping as NodeMapping
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import (
    MappingReader,
    among,
    brief,
    fault,
    form,
    list_of,
    mapping_of,
    name_of,
    text_of,
    whole_number,
)

VARIABLE = ("unit", "size", "start", "limit", "description")
NUMBER = ("unit", "size", "min", "exclusive_min", "max", "default", "description", "shared", "options")
OPTION = ("options", "default", "description")
TABLE = ("table", "description")
_DEFINES = re.compile(r"\A\s*([A-Za-z]\w*)\s*=", re.ASCII)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\Z", re.ASCII)


def read_equations(root: MappingReader, mistakes: Mistakes) -> tuple[tuple[Equation, ...], set[str]]:
    """Return the equations of the section `equations: [a + b = c]`, and the names defined by invalid
    equations.

    Parameters
    ----------
    root
        The definition.
    mistakes
        The collector of the errors of equations, separate from other errors.

    Returns
    -------
    The equations, and the names on the left side of equations that cannot be parsed.
    """
    equations, undefined = list[Equation](), set[str]()
    for item in root.read("equations", _items, ()):
        with mistakes:
            text = text_of(item, "equation", "- a + b = c")
            defined = _DEFINES.findall(text)
            undefined.update(defined)
            equations.append(_equation(text, text_location(item)))
            undefined.difference_update(defined)
    return tuple(equations), undefined


def read_linearized(root: MappingReader, mistakes: Mistakes) -> Linearized | None:
    """Return the equations of a linear analysis, None if the section is missing.

    The section is `linearized: {equations: [f = b*v], valid: speeds above the threshold}`, a list of
    equations, or one equation.

    Parameters
    ----------
    root
        The definition.
    mistakes
        The collector of the errors of equations.
    """
    node = root.nodes.get("linearized")
    if node is None:
        return None
    valid, items = "", tuple[Node, ...]((node,))
    if isinstance(node, NodeMapping):
        body = MappingReader(node, ("equations", "valid"), "linearized", root.mistakes)
        valid, items = body.text("valid"), body.read("equations", _items, ())
    elif isinstance(node, Sequence):
        items = node.items
    equations = []
    if not items:
        example = "linearized: a = b"
        mistakes.take(fault("E203", node.location, "linearized", "at least one equation", "none", example))
    for item in items:
        with mistakes:
            text = text_of(item, "equation", "linearized: a = b")
            equations.append(_equation(text, text_location(item)))
    return Linearized(tuple(equations), valid)


def _equation(text: str, location: SourceLocation) -> Equation:
    """Return the equation that a text states.

    Raises ApcError for invalid syntax or a constant that is too long.
    """
    equation = parse_equation(text, location)
    for side in (equation.left, equation.right):
        check_constants(side, text, location)
    return equation


def _items(node: Node, subject: str) -> tuple[Node, ...]:
    """Return the items of a list node. Raises ApcError for another node."""
    if isinstance(node, Sequence):
        return node.items
    raise fault("E203", node.location, subject, "a list, such as [a + b = c]", form(node))


def read_sends(root: MappingReader, mistakes: Mistakes) -> tuple[SentValue, ...]:
    """Return the sent values of the section `sends: {x: sample(object.x)}`, with provisional dimensions."""
    sends = []
    for key, value in root.section("sends", "{x: sample(object.x)}"):
        with mistakes:
            name = name_of(key, "what is sent")
            text, location = text_of(value, name, f"{name}: sample(object.x)"), text_location(value)
            expression = parse_expression(text, location)
            check_constants(expression, text, location)
            sends.append(SentValue(name, expression, text, location, DIMENSIONLESS))
    return tuple(sends)


def read_variables(root: MappingReader, section: str = "variables") -> tuple[ComponentVariable, ...]:
    """Return the variables of the section `variables: {x: {unit: m}}`, or a connector's potentials
    or flows.
    """

    def read(key: Scalar, value: Node) -> list[ComponentVariable]:
        """Return the variable of one entry; a vector as its entries."""
        name = name_of(key, "a variable")
        meant = value.text if isinstance(value, Scalar) and _is_unit(value.text) else "…"
        node = mapping_of(value, name, f"{name}: {{unit: {meant}}}")
        body = MappingReader(node, VARIABLE, f"variable {name}", root.mistakes)
        description, limit = body.text("description"), body.text("limit", "limit: force_limit")
        unit, size = _unit_and_size(body, name)
        starts = _named_values(body, "start", name, unit, size)
        return [
            ComponentVariable(text, unit, start, description, key.location, limit) for text, start in starts
        ]

    return tuple(chain(*root.each(section, "{x: {unit: m}}", read)))


def _is_unit(text: str) -> bool:
    """Return whether a text is a valid unit."""
    with suppress(ApcError):
        return bool(text.strip() and parse_unit(text, SourceLocation("")))
    return False


def read_parameters(root: MappingReader) -> tuple[Parameter, ...]:
    """Return the parameters of the section `parameters: {stiffness: {unit: N/m, min: 0}}`."""

    def read(key: Scalar, value: Node) -> Several[Parameter]:
        """Return the number, option, table or reference of one entry; a vector as its entries."""
        name = name_of(key, "a parameter")
        message = f"parameter {name}"
        if isinstance(value, Scalar):
            if value.text in ROLES:
                return [Reference(name, value.text, "", value.location)]
            expected = f"{', '.join(ROLES)}, or a mapping such as {{unit: N/m, min: 0}}"
            got, role = brief(value.text) or "nothing", nearest(value.text, ROLES)
            raise fault("E203", value.location, message, expected, got, role and f"{name}: {role}")
        node = mapping_of(value, message, f"{name}: {{unit: N/m}}")
        if (table := node.get("table")) is not None:
            body = MappingReader(node, TABLE, message, root.mistakes)
            unit = _unit(table, "table", "table: N")
            return [Reference(name, "table", body.text("description"), node.location, unit)]
        if isinstance(options := node.get("options"), Sequence):
            return [_option(name, options, MappingReader(node, OPTION, message, root.mistakes))]
        return _numbers(name, MappingReader(node, NUMBER, message, root.mistakes))

    return tuple(chain(*root.each("parameters", "{stiffness: {unit: N/m, min: 0}}", read)))


def _option(name: str, options: Sequence, body: MappingReader) -> Option:
    """Return the declaration of an option; `options` are its words."""
    words = []
    for item in options.items:
        with body.mistakes:
            words.append(text_of(item, "option"))

    def known(node: Node, key: str) -> str:
        """Return the default, one of the words of the option."""
        return among(text_of(node, key), words, node.location, f"{name}: unknown option {{}}")

    return Option(
        name, tuple(words), body.read("default", known, None), body.text("description"), options.location
    )


def _numbers(name: str, body: MappingReader) -> list[NumberParameter]:
    """Return the declaration of a number, or of each entry of a vector."""
    description, shared, nodes, mistakes = (
        body.text("description"),
        body.text("shared"),
        body.nodes,
        body.mistakes,
    )
    if shared not in ("", "divided", "whole"):
        mistakes.take(fault("E203", nodes["shared"].location, "shared", "divided or whole", brief(shared)))
    unit, size = _unit_and_size(body, name)
    minimum, above, most = (
        body.read(key, lambda node, key: _number(node, key, unit), None)
        for key in ("min", "exclusive_min", "max")
    )
    if size and "options" in nodes:
        location = nodes["options"].location
        raise fault("E203", location, f"{name}: a parameter with options can't have a size")
    if minimum is not None and above is not None:
        mistakes.add(
            "E203", nodes["exclusive_min"].location, name, expected="min or exclusive_min", got="both"
        )
    least = minimum if above is None else above
    first, *_ = names_of(name, size)
    template = NumberParameter(
        first, unit, None, least, above is not None, most, shared == "divided", (), description, body.location
    )

    def check(number: Fraction | None, node: Node | None, subject: str) -> None:
        """Record a number of the declaration that violates the bounds of the declaration."""
        if number is not None and node is not None:
            template.bounds.check(ScalarValue(number, unit.dimension, None, node.location), subject, mistakes)

    check(most, nodes.get("max"), f"max of {first}")
    words: dict[str, Fraction] = {}
    for key, node in mapping_of(nodes["options"], "options").entries if "options" in nodes else ():
        with mistakes:
            words[key.text] = _number(node, key.text, unit)
            check(words[key.text], node, f"option {key.text} of {first}")
    template = replace(template, words=tuple(words.items()))
    defaults = _named_values(body, "default", name, unit, size, words)
    for text, default in defaults:
        check(default, nodes.get("default"), f"default of {text}")
    return [replace(template, name=text, default=default) for text, default in defaults]


def _unit_and_size(body: MappingReader, name: str) -> tuple[Unit, int]:
    """Return the unit of a declaration, and its `size`: the number of entries of a vector, 0 for a number."""
    unit = body.read("unit", _unit, None)
    size = body.read("size", partial(_size, name=name, unit=unit.text if unit else "1"), 0)
    if unit is None and "unit" not in body.nodes:
        advice = "add unit, such as unit: N/m, or unit: 1 for a plain number"
        raise fault("E201", body.location, f"{name} has no unit", advice=advice)
    if unit is None:
        raise AlreadyReportedError
    return unit, size


def _unit(node: Node, subject: str, fix: str = "unit: N/m") -> Unit:
    """Return the unit named by a node."""
    return parse_unit(text_of(node, subject, fix), node.location)


def _size(node: Node, subject: str, name: str, unit: str) -> int:
    """Return the number of entries of a vector, 2 or 3; `unit` is the unit in messages."""
    size = whole_number(node)
    if size in SIZES:
        return size
    fix = f"{name}: {{unit: {unit}, {subject}: 2}}" if size != 1 else f"{name}: {{unit: {unit}}}"
    raise fault("E203", node.location, f"{subject} of {name}", "2 or 3", form(node), fix)


def _named_values(
    body: MappingReader,
    key: str,
    name: str,
    unit: Unit,
    size: int,
    words: Mapping[str, Fraction] | None = None,
) -> Named[Fraction | None]:
    """Return the `default` or `start` of a declaration by name, each entry of a vector by its own name.

    Parameters
    ----------
    body
        The declaration.
    key
        The key, `default` or `start`.
    name, unit, size
        The name, the unit, and the number of entries of a vector, 0 for a number.
    words
        Words that represent numbers, with their values.

    Returns
    -------
    The names with their values in SI units; None for a missing value.
    """

    def read(node: Node, _: str) -> list[Fraction | None]:
        """Return the values of the key, in SI units."""
        if not size and isinstance(node, Sequence) and len(node.items) in SIZES:
            advice = f"add size: {len(node.items)} to {name} for a vector"
            raise fault("E203", node.location, key, "a single value", form(node), advice=advice)
        nodes = list_of(node, key, size, "0") if size else (node,)
        subjects = names_of(key, size) if size else (key,)
        return [_number(*pair, unit, words) for pair in zip(nodes, subjects, strict=True)]

    entry_names = names_of(name, size)
    values = body.read(key, read, [None] * len(entry_names))
    return tuple(zip(entry_names, values, strict=True))


def _number(node: Node, subject: str, unit: Unit, words: Mapping[str, Fraction] | None = None) -> Fraction:
    """Return a number of a declaration in SI units: a plain number in the declared unit, a quantity, or
    a word.

    `words` has the values of the words.
    """
    text = text_of(node, subject)
    if words and text in words:
        return words[text]
    if _NUMBER.match(text):
        return parse_quantity(text, node.location).value * unit.scale
    return quantity(text, node.location, subject=subject, unit=unit.text).value
