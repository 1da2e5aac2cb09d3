"""The language of topologies as a JSON Schema, so that an editor completes and checks while one types.

Takes: a `Library`. Gives: `topology_schema`, a JSON Schema document (draft 2020-12); `limits_of`,
`in_unit`, `is_required` of a declared parameter.
Guarantees: generated from what the compiler reads by, and the same library gives the same document; what
the compiler accepts fits it.
Does not: catch everything: names that refer to each other, and bounds in other units, stay the compiler's.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

from apc.compiler.compiled import LARGEST_COUNT
from apc.compiler.components.component import ROLES, Component, Number, Option, Parameter, Reference
from apc.compiler.components.library import Library
from apc.compiler.components.parts import DEFAULT_TYPES, LARGEST_ARRAY, PART_KEYS
from apc.compiler.errors import Place
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.units import Unit, parse_unit
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.scene.graphs import SHAPES
from apc.compiler.scene.groups import GROUP
from apc.compiler.scene.links import PROBABILITIES
from apc.compiler.scene.scene import REQUIRED, SECTIONS, TOPOLOGY
from apc.compiler.source.reading import IDENTIFIER

Schema = dict[str, Any]

DIALECT = "https://json-schema.org/draft/2020-12/schema"
# Any unit may be written; of these an editor can say at once that one does not fit, or propose one that does.
EVERYDAY_UNITS = (
    *("kg", "g", "mg", "m", "mm", "cm", "um", "s", "ms", "us", "min", "h", "Hz", "kHz"),
    *("N", "mN", "kN", "N/m", "N/mm", "kN/m", "N*s/m", "m/s", "mm/s", "rad", "deg"),
)
_NUMBER = r"[+-]?\s*(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?(\s*/\s*\d+\.?\d*)?"
_TARGET = r"^[A-Za-z]\w*(\[\d{1,6}(:\d{1,6})?\])?(\.[A-Za-z]\w*)?$"
_SETTING = r"^[A-Za-z]\w*(\[\d{1,6}\])?(\.[A-Za-z]\w*(\[\d{1,6}\])?)+$"
_NOWHERE = Place("schema")


def topology_schema(library: Library) -> Schema:
    """Return the schema of a topology whose parts are of the library's components."""
    components = [c for name in library.component_names if (c := library.component(name)) is not None]
    quantities = _Quantities()
    parts = {component.name: _part(component, quantities) for component in components}
    properties = {
        "topology": _string(),
        "about": _string(),
        "library": {"anyOf": [_string(), {"type": "array", "items": _string()}]},
        "clocks": _named({"$ref": "#/$defs/clock"}),
        "parameters": _named({"type": ["number", "string"]}),
        "peers": _named({"$ref": "#/$defs/group"}) | {"minProperties": 1},
        **{section: _section(section) for section in SECTIONS},
        "experiment": _object(
            {"duration": quantities.of(_unit("s")), "seed": {"type": "integer", "minimum": 0}}
        ),
        "studies": _object(
            {"region": _object({"x": {"$ref": "#/$defs/axis"}, "y": {"$ref": "#/$defs/axis"}})}
        ),
    }
    clock = quantities.of(_unit("s"), or_rate=True)
    definitions = {
        "name": {"type": "string", "pattern": _pattern(IDENTIFIER)},
        "joined": {"type": "string", "pattern": _TARGET, "examples": ["ground"]},
        "at": {"type": "array", "items": {"$ref": "#/$defs/name"}, "description": PART_KEYS["at"]},
        "count": {
            "type": "integer",
            "minimum": 1,
            "maximum": LARGEST_ARRAY,
            "description": PART_KEYS["count"],
        },
        "shared": {"type": "boolean", "description": PART_KEYS["shared"]},
        "clock": {"anyOf": [clock, _object({"period": clock, "phase": clock}, required=("period",))]},
        "group": _group(),
        "part": _by_type({name: {"$ref": f"#/$defs/{name}"} for name in parts}),
        "joined_part": _by_type(
            # A connector that another part names may be left out, but hardly all of them.
            {
                c.name: {"anyOf": [{"required": [name]} for name, _ in c.connectors]}
                for c in components
                if c.connectors
            }
        ),
        "graph": _graph(),
        "delays": _named(_named(quantities.of(_unit("s")))),
        "probability": _probability(),
        "loss": _loss(),
        "axis": {
            **_object({}),
            "additionalProperties": {
                "type": "array",
                "items": {"type": ["string", "number"]},
                "minItems": 2,
                "maxItems": 2,
            },
            "minProperties": 1,
            "maxProperties": 1,
        },
    }
    types = {"properties": {"type": {"enum": [component.name for component in components]}}}
    return {
        "$schema": DIALECT,
        "title": "A topology of apc",
        "type": "object",
        "properties": {key: {"description": TOPOLOGY[key], **schema} for key, schema in properties.items()},
        "required": list(REQUIRED),
        "additionalProperties": False,
        # Components of one's own are known to the compiler alone.
        "if": {"not": {"required": ["library"]}},
        "then": {"properties": {section: {"additionalProperties": types} for section in SECTIONS}},
        "$defs": {**definitions, **quantities.found, **parts},
    }


class _Quantities:
    """The schemas of quantities, one a dimension."""

    def __init__(self) -> None:
        self.found: dict[str, Schema] = {}
        self._names: dict[tuple[Dimension, bool], str] = {}

    def of(self, unit: Unit, *, or_rate: bool = False) -> Schema:
        """Return a reference to the schema of quantities that fit a unit."""
        key = (unit.dimension, or_rate)
        if key not in self._names:
            plain = unit.text.replace("/", "_per_").replace("*", "_").replace("^", "")
            name = f"quantity_{'number' if unit.text == '1' else plain}{'_or_rate' if or_rate else ''}"
            self._names[key] = name
            self.found[name] = (
                _number_schema() if unit.text == "1" else _quantity_schema(unit, or_rate=or_rate)
            )
        return {"$ref": f"#/$defs/{self._names[key]}"}


def _probability() -> Schema:
    return {
        "type": ["number", "string"],
        "minimum": 0,
        "maximum": 1,
        "description": "a number from 0 to 1, a percentage, or an expression",
        "examples": ["2 %"],
    }


def _number_schema() -> Schema:
    return {"type": ["number", "string"], "description": "a number without a unit, or an expression"}


def _quantity_schema(unit: Unit, *, or_rate: bool) -> Schema:
    """Return the schema of a number with a unit, or of an expression: anything but a bare number.

    The pattern refuses a bare number, one with an everyday unit of another dimension, and a text without a
    letter.
    """
    dimensions = {text: _unit(text).dimension for text in EVERYDAY_UNITS}
    fits = {unit.dimension, unit.dimension.power(-1)} if or_rate else {unit.dimension}
    wrong = "|".join(re.escape(text) for text, d in dimensions.items() if d not in fits)
    right = [text for text, dimension in dimensions.items() if dimension in fits] or [unit.text]
    return {
        "type": "string",
        "pattern": rf"^(?!\s*{_NUMBER}\s*({wrong})?\s*$)[\s\S]*[A-Za-z°%µΩ]",
        "description": f"a number and its unit, such as 1 {unit.text}, or an expression",
        "examples": [f"1 {text}" for text in right],
    }


def _part(component: Component, quantities: _Quantities) -> Schema:
    """Return the schema of a part of a component, its connectors left optional."""
    properties: dict[str, Schema] = {
        "type": {"const": component.name},
        **{key: {"$ref": f"#/$defs/{key}"} for key in PART_KEYS},
    }
    for name, connector in component.connectors:
        about = f"the part, or its connector, that this {connector.name} is joined to"
        properties[name] = {"$ref": "#/$defs/joined", "description": about}
    entries: dict[str, list[Schema]] = {}
    for parameter in component.parameters:
        entries.setdefault(whole_and_index(parameter.name)[0], []).append(_parameter(parameter, quantities))
    for variable in component.variables:
        if variable.start is not None:
            name, _ = whole_and_index(variable.name)
            about = f"start value of the {variable.about or name}"
            entries.setdefault(name, []).append({**quantities.of(variable.unit), "description": about})
    properties |= {name: found[0] if len(found) == 1 else _vector(found) for name, found in entries.items()}
    required = [whole_and_index(p.name)[0] for p in component.parameters if is_required(p)]
    return {
        "description": component.about,
        **_object(properties, required=dict.fromkeys(required)),
    }


def _vector(entries: list[Schema]) -> Schema:
    """Return the schema of a list with a value for each entry of a vector."""
    size, about = len(entries), entries[0].get("description", "")
    return {
        "type": "array",
        "description": about,
        "prefixItems": entries,
        "minItems": size,
        "maxItems": size,
    }


def _parameter(parameter: Parameter, quantities: _Quantities) -> Schema:
    about = {"description": parameter.about} if parameter.about else {}
    if isinstance(parameter, Option):
        default = {} if parameter.default is None else {"default": parameter.default}
        return {"enum": list(parameter.words), **default, **about}
    if isinstance(parameter, Reference):
        role = parameter.role
        named = "name" if role in ("clock", "link") else role
        schema = _string() if role in ("trace", "table") else {"$ref": f"#/$defs/{named}"}
        return {**schema, "description": ROLES[role], **about}
    schema = quantities.of(parameter.unit)
    if parameter.words:
        schema = {"anyOf": [{"enum": [word for word, _ in parameter.words]}, schema]}
    told = about.get("description", "")
    return {**schema, "description": f"{told or parameter.name} [{parameter.unit.text}]{_bounds(parameter)}"}


def _bounds(parameter: Number) -> str:
    told = "".join(f", {limit}" for limit in limits_of(parameter))
    return (
        told if parameter.default is None else f"{told}, {in_unit(parameter, parameter.default)} if not given"
    )


def limits_of(parameter: Number) -> list[str]:
    """Return where a parameter's values must lie, in its unit."""
    low, high = parameter.minimum, parameter.maximum
    told = [] if low is None else [f"{'>' if parameter.open_minimum else '≥'} {in_unit(parameter, low)}"]
    return told if high is None else [*told, f"≤ {in_unit(parameter, high)}"]


def in_unit(parameter: Number, number: Any) -> str:
    """Return a number in SI as text, in the unit that a parameter declares."""
    return f"{float(number / parameter.unit.scale):.12g}"


def is_required(parameter: Parameter) -> bool:
    """Return whether a part must give a parameter itself."""
    if isinstance(parameter, Reference):
        return parameter.role in ("clock", "link", "table")
    return parameter.default is None


def _section(section: str) -> Schema:
    """Return the schema of a section of parts: which keys a part has follows from its type."""
    default = DEFAULT_TYPES.get(section)
    part: Schema = {
        "type": "object",
        "properties": {"type": {"type": "string", **({"default": default} if default else {})}},
        "required": [] if default else ["type"],
        "allOf": [{"$ref": "#/$defs/part"}],
    }
    if section != "masses":  # a mass need not be joined to anything
        part["allOf"].append({"$ref": "#/$defs/joined_part"})
    if default:
        part["allOf"].append({"if": {"not": {"required": ["type"]}}, "then": {"$ref": f"#/$defs/{default}"}})
    if section == "links":
        part["not"] = {"required": ["count"]}
    return _named(part)


def _by_type(choices: dict[str, Schema]) -> Schema:
    """Return the schema that asks of an object what the choice of its type asks."""
    return {
        "allOf": [
            {"if": {"properties": {"type": {"const": name}}, "required": ["type"]}, "then": schema}
            for name, schema in choices.items()
        ]
    }


def _group() -> Schema:
    value = {"type": ["string", "number"]}
    values = {"type": "array", "items": value}
    return {
        "anyOf": [{"required": [key]} for key in ("count", "set", "table")],
        **_object(
            {
                "count": {
                    "type": "integer",
                    "minimum": 1,
                    "maximum": LARGEST_COUNT,
                    "description": GROUP["count"],
                },
                "set": {
                    "type": "object",
                    "description": GROUP["set"],
                    "propertyNames": {"pattern": _SETTING},
                    "additionalProperties": {"anyOf": [value, values, {"type": "array", "items": values}]},
                },
                "table": {**_string(), "description": GROUP["table"]},
            }
        ),
    }


def _graph() -> Schema:
    peer = {"type": ["integer", "string"]}
    pair = {"type": "array", "prefixItems": [peer, peer, {"type": "number"}], "minItems": 2, "maxItems": 3}
    pairs = {"anyOf": [{"type": "array", "items": pair}, {"type": "string", "pattern": r"\.csv$"}]}
    either = {**_object({"edges": pairs, "arcs": pairs}), "minProperties": 1, "maxProperties": 1}
    return {"anyOf": [{"enum": list(SHAPES)}, either]}


def _loss() -> Schema:
    each = {
        name: {"$ref": "#/$defs/probability", "description": about} for name, about in PROBABILITIES.items()
    }
    return {"anyOf": [{"$ref": "#/$defs/probability"}, _object(each, required=["p"])]}


def _named(schema: Schema) -> Schema:
    """Return the schema of a mapping from names to what `schema` says."""
    return {"type": "object", "propertyNames": {"$ref": "#/$defs/name"}, "additionalProperties": schema}


def _object(properties: dict[str, Schema], *, required: Iterable[str] = ()) -> Schema:
    return {
        "type": "object",
        "properties": properties,
        "required": list(required),
        "additionalProperties": False,
    }


def _string() -> Schema:
    return {"type": "string", "minLength": 1}


def _pattern(compiled: re.Pattern[str]) -> str:
    return f"^{compiled.pattern.removesuffix(chr(92) + 'Z')}$"


def _unit(text: str) -> Unit:
    return parse_unit(text, _NOWHERE)
