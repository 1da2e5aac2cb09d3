"""The language of topologies as a JSON Schema, for completion and checks in an editor.

Takes: a `LoadedLibrary`. Gives: `topology_schema`, a JSON Schema document (draft 2020-12); `limits_of`,
`in_unit`, `is_required` of a declared parameter.
Guarantees: every topology accepted by the compiler is valid; the same library gives the same document.
Does not: find all errors: references between names, and bounds in other units, are checked only by the
compiler.

The definitions that do not depend on components are in schema.yaml.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from apc.compiler.components.component import (
    Component,
    ComponentVariable,
    NumberParameter,
    Option,
    Parameter,
    Reference,
    Settable,
)
from apc.compiler.components.component_library import Library
from apc.compiler.components.parts import PART_KEYS
from apc.compiler.errors import SourceLocation
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.units import Unit, parse_unit
from apc.compiler.language.vectors import by_vector, whole_and_index
from apc.compiler.topology.topology import SECTIONS

Schema = dict[str, Any]

BASE = Path(__file__).with_suffix(".yaml")
# All units are valid; these can be checked and proposed by an editor.
EVERYDAY_UNITS = (
    *("kg", "g", "mg", "m", "mm", "cm", "um", "s", "ms", "us", "min", "h", "Hz", "kHz"),
    *("N", "mN", "kN", "N/m", "N/mm", "kN/m", "N*s/m", "m/s", "mm/s", "rad", "deg"),
)
_NUMBER = r"[+-]?\s*(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?(\s*/\s*\d+\.?\d*)?"


def topology_schema(library: Library) -> Schema:
    """Return the JSON Schema of topologies with the components of a library."""
    base: Schema = yaml.safe_load(BASE.read_text(encoding="utf-8"))
    components = [c for name in library.component_names if (c := library.component(name)) is not None]
    quantities: dict[str, Schema] = {}
    _quantity(parse_unit("s", SourceLocation("schema")), quantities)
    _quantity(parse_unit("s", SourceLocation("schema")), quantities, or_rate=True)
    parts = {component.name: _part(component, quantities) for component in components}
    connection_rules = {
        # A connector that another part names may be omitted, but at least one is required.
        c.name: {"anyOf": [{"required": [name]} for name, _ in c.connectors]}
        for c in components
        if c.connectors
    }
    of_parts = {
        "part": _by_type({name: {"$ref": f"#/$defs/{name}"} for name in parts}),
        "joined_part": _by_type(connection_rules),
    }
    types = {"properties": {"type": {"enum": list(parts)}}}
    return {
        **base,
        # A user's own components are not in the schema.
        "if": {"not": {"required": ["library"]}},
        "then": {"properties": {section: {"additionalProperties": types} for section in SECTIONS}},
        "$defs": {**base["$defs"], **of_parts, **quantities, **parts},
    }


def _by_type(choices: dict[str, Schema]) -> Schema:
    """Return a schema with a condition for each type of an object."""
    return {
        "allOf": [
            {"if": {"properties": {"type": {"const": name}}, "required": ["type"]}, "then": schema}
            for name, schema in choices.items()
        ]
    }


def _quantity(unit: Unit, quantities: dict[str, Schema], *, or_rate: bool = False) -> Schema:
    """Return a reference to the schema of quantities of a unit's dimension, added to `quantities` on
    first use.

    With `or_rate`, quantities of the reciprocal dimension are valid too.
    """
    dimension_text = format_dimension(unit.dimension).replace("*", "_").replace("/", "_per_")
    name = f"quantity_{re.sub(r'[^a-zA-Z0-9_]', '', dimension_text)}{'_or_rate' if or_rate else ''}"
    if name not in quantities and unit.text == "1":
        description = "a number without a unit, or an expression"
        quantities[name] = {"type": ["number", "string"], "description": description}
    elif name not in quantities:
        dimensions = {text: parse_unit(text, SourceLocation("schema")).dimension for text in EVERYDAY_UNITS}
        valid = {unit.dimension, unit.dimension.power(-1)} if or_rate else {unit.dimension}
        other_units = "|".join(re.escape(text) for text, d in dimensions.items() if d not in valid)
        right = [text for text, dimension in dimensions.items() if dimension in valid] or [unit.text]
        quantities[name] = {
            "type": "string",
            # No bare number, none with an everyday unit of another dimension, no text without a letter.
            "pattern": rf"^(?!\s*{_NUMBER}\s*({other_units})?\s*$)[\s\S]*[A-Za-z°%µΩ]",
            "description": f"a number and its unit, such as 1 {unit.text}, or an expression",
            "examples": [f"1 {text}" for text in right],
        }
    return {"$ref": f"#/$defs/{name}"}


def _part(component: Component, quantities: dict[str, Schema]) -> Schema:
    """Return the schema of a part with a component; its connectors are optional."""
    properties: dict[str, Schema] = {
        "type": {"const": component.name},
        **{key: {"$ref": f"#/$defs/{key}"} for key in PART_KEYS},
    }
    for name, connector in component.connectors:
        description = f"the part, or its connector, that this {connector.name} is joined to"
        properties[name] = {"$ref": "#/$defs/joined", "description": description}
    starts = (variable for variable in component.variables if variable.start is not None)
    for name, items in by_vector((*component.parameters, *starts)).items():
        schemas = [_settable(name, item, quantities) for item in items]
        size, description = len(schemas), schemas[0].get("description", "")
        vector = {"type": "array", "description": description, "prefixItems": schemas}
        properties[name] = schemas[0] if size == 1 else vector | {"minItems": size, "maxItems": size}
    if any(
        isinstance(parameter, Reference) and parameter.role == "delays" for parameter in component.parameters
    ):
        delay = properties["delay"]  # the delay of a link may be a range
        ends = {"type": "array", "prefixItems": [delay, delay], "minItems": 2, "maxItems": 2}
        properties["delay"] = {"anyOf": [delay, ends]}
    required = dict.fromkeys(whole_and_index(p.name)[0] for p in component.parameters if is_required(p))
    return {
        "description": component.description,
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


def _settable(name: str, parameter: Settable, quantities: dict[str, Schema]) -> Schema:
    """Return the schema of a parameter or a start value; `name` is its name, or the name of its vector."""
    if isinstance(parameter, ComponentVariable):
        description = f"start value of the {parameter.description or name}"
        return _quantity(parameter.unit, quantities) | {"description": description}
    if isinstance(parameter, Option):
        facts = {
            "enum": list(parameter.words),
            "default": parameter.default,
            "description": parameter.description,
        }
        return {key: fact for key, fact in facts.items() if fact}
    if isinstance(parameter, Reference):
        role = {"clock": "name"}.get(parameter.role, parameter.role)
        return {"$ref": f"#/$defs/{role}", "description": parameter.description or f"a {parameter.role}"}
    schema = _quantity(parameter.unit, quantities)
    if parameter.words:
        schema = {"anyOf": [{"enum": [word for word, _ in parameter.words]}, schema]}
    limits = [f"{parameter.description or parameter.name} [{parameter.unit.text}]", *limits_of(parameter)]
    limits += [] if is_required(parameter) else [f"{in_unit(parameter, parameter.default)} if not given"]
    return {**schema, "description": ", ".join(limits)}


def limits_of(parameter: NumberParameter) -> list[str]:
    """Return the range of a parameter's values, in its unit."""
    low, high = parameter.minimum, parameter.maximum
    limits = (
        [] if low is None else [f"{'>' if parameter.exclusive_minimum else '≥'} {in_unit(parameter, low)}"]
    )
    return limits if high is None else [*limits, f"≤ {in_unit(parameter, high)}"]


def in_unit(parameter: NumberParameter, number: Any) -> str:
    """Return the text of an SI number in the declared unit of a parameter."""
    return f"{float(number / parameter.unit.scale):.12g}"


def is_required(parameter: Parameter) -> bool:
    """Return whether the entry of a part must have a parameter."""
    if isinstance(parameter, Reference):
        return parameter.role in ("clock", "link", "table")
    return parameter.default is None
