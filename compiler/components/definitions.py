"""Component and connector definitions: YAML text to typed data, checked once per component.

Takes: the YAML source of a definition, and its library. Gives: `read_component`, a `Component`;
`read_connector`, a `Connector`.
Guarantees: the definitions that a component extends and contains exist and are read first. An invalid
component (see `component_check`) is never returned.
Does not: depend on a topology or on the use of components.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import TypeVar

from apc.compiler.components.component import (
    RESERVED,
    SYMBOLS,
    Component,
    ComponentVariable,
    Connector,
    Inner,
    NumberParameter,
    Parameter,
    Reference,
)
from apc.compiler.components.component_check import ComponentNames, check_balance
from apc.compiler.components.declarations import (
    read_equations,
    read_linearized,
    read_parameters,
    read_sends,
    read_variables,
)
from apc.compiler.components.parts import (
    MOST_PARTS,
    Definitions,
    EntryScope,
    PartEntries,
    component_named,
    joining_of,
    read_entry,
)
from apc.compiler.errors import Mistakes
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import PEERS
from apc.compiler.language.vectors import by_vector
from apc.compiler.language.vectors import entries as elements
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.reading import (
    MappingReader,
    among,
    brief,
    fault,
    first_use,
    form,
    mapping_of,
    name_of,
    text_of,
    unknown,
    whole_number,
)
from apc.compiler.source.source import Source
from apc.compiler.wording import counted

CONNECTOR = ("connector", "description", "source", "potentials", "flows")
COMPONENT = (
    *("component", "description", "source", "peers", "extends", "connectors", "parameters", "variables"),
    *("parts", "connect", "sends", "equations", "linearized", "symbols", "joining"),
)
DEEPEST = 10  # levels of parts inside parts


def read_connector(source: Source) -> Connector:
    """Return the connector type defined by a source. Raises ApcError with all mistakes of the definition."""
    mistakes = Mistakes()
    root = MappingReader(mapping_of(source.root, "connector definition"), CONNECTOR, "a connector", mistakes)
    name, description = root.text("connector"), root.text("description")
    potentials, flows = (read_variables(root, key) for key in ("potentials", "flows"))
    _check_limits((*potentials, *flows), (), mistakes)
    mistakes.raise_if_any()
    if len(potentials) != len(flows):
        numbers = f"{counted(len(potentials), 'potential')} for {counted(len(flows), 'flow')}"
        advice = "declare a flow of the same size for each potential"
        raise fault("E501", root.location, f"{name} is unbalanced: {numbers}", advice=advice)
    return Connector(name, description, potentials, flows)


def read_component(source: Source, library: Definitions) -> Component:
    """Return the checked component defined by a source.

    Raises ApcError with all mistakes of the definition.
    """
    # Errors of equations are collected separately, so that they hide no errors of declarations.
    mistakes, equation_mistakes = Mistakes(), Mistakes()
    root = MappingReader(
        mapping_of(source.root, "a component definition"), COMPONENT, "a component", mistakes
    )
    equations, undefined = read_equations(root, equation_mistakes)
    draft = _read_declarations(root, library, mistakes)
    linearized = read_linearized(root, equation_mistakes) or draft.linearized
    symbols = _symbols(root, draft) or draft.symbols
    draft = replace(draft, equations=(*draft.equations, *equations), linearized=linearized, symbols=symbols)
    sends = read_sends(root, equation_mistakes)
    if mistakes:
        equation_mistakes.pass_on(mistakes)
    mistakes.raise_if_any()
    component = ComponentNames(draft, undefined).completed(sends, mistakes)
    equation_mistakes.pass_on(mistakes)
    mistakes.raise_if_any()
    check_balance(component)
    return component


def _symbols(root: MappingReader, component: Component) -> tuple[tuple[str, str], ...]:
    """Return the symbols of published wall conditions with their parameters, from `symbols: {K:
    stiffness}`.
    """
    names = {parameter.name: None for parameter in component.parameters}

    def read(key: Scalar, value: Node) -> tuple[str, str]:
        """Return one symbol and its parameter."""
        symbol = among(key.text, dict.fromkeys(SYMBOLS), key.location, "symbols: unknown symbol {}")
        name = text_of(value, key.text, "K: stiffness")
        return symbol, among(name, names, value.location, f"{symbol}: unknown parameter {{}}")

    return tuple(root.each("symbols", "{K: stiffness}", read))


def _read_declarations(root: MappingReader, library: Definitions, mistakes: Mistakes) -> Component:
    """Return a component with all declarations, without its own equations and sends.

    The declarations of the extended component come first.
    """
    title = root.nodes["component"]
    assert isinstance(title, Scalar)  # otherwise the library would not have found the definition
    with mistakes:
        name_of(title, "a component")
    description, cited, fix = root.text("description"), root.text("source"), "extends: Mass"
    base = root.read(
        "extends",
        lambda node, key: component_named(text_of(node, key, fix), node.location, library, fix),
        Component("", "", "", title.location),
    )
    connectors = _connectors(root, library)
    parameters, variables = read_parameters(root), read_variables(root)
    body = root.nodes.get("connectors")
    locations = {key.text: key.location for key, _ in body.entries} if isinstance(body, Mapping) else {}
    used_names = {name: first_use("a connector", locations[name]) for name, _, _ in connectors}
    declarations = ("a parameter", by_vector(parameters)), ("a variable", by_vector(variables))
    for kind, declared in declarations:
        for local, (first, *_) in declared.items():
            if local in used_names:
                message = f"{local} is already the name of {used_names[local]}"
                mistakes.add("E205", first.location, message)
            if local in RESERVED:
                mistakes.add("E205", first.location, f"{local} is a reserved word and can't be a name")
            used_names[local] = first_use(kind, first.location)
    draft = replace(
        base,
        name=title.text,
        description=description,
        source=cited,
        connectors=(*base.connectors, *((connector, kind) for connector, kind, _ in connectors)),
        parameters=_overridden(base.parameters, parameters, mistakes),
        variables=_overridden(base.variables, variables, mistakes),
        location=title.location,
        grips=(*base.grips, *(connector for connector, _, for_hands in connectors if for_hands)),
        peers=root.read("peers", _required_peers, base.peers),
        joining=root.read("joining", joining_of, base.joining),
    )
    _check_limits(draft.variables, draft.numbers, mistakes)
    return _with_inner_parts(root, draft, library, mistakes)


def _check_limits(
    variables: Iterable[ComponentVariable], numbers: Iterable[NumberParameter], mistakes: Mistakes
) -> None:
    """Record variables whose limit is not a number parameter of the same dimension."""
    known = {number.name: number.unit.dimension for number in numbers}
    for variable in variables:
        limit, due, message = variable.limit, variable.unit.dimension, f"limit of {variable.name}"
        if limit and limit not in known:
            message += f": unknown parameter {brief(limit)}"
            mistakes.take(unknown("E206", variable.location, message, limit, known))
        elif limit and known[limit] != due:
            got = f"{limit} in {format_dimension(known[limit])}"
            expected = f"a parameter in {format_dimension(due)}"
            mistakes.add("E204", variable.location, message, expected=expected, got=got)


def _required_peers(node: Node, subject: str) -> int:
    """Return the required number of peers of a component that receives from other peers, from `peers: 2`."""
    if (count := whole_number(node) or 0) >= 2:
        return count
    raise fault("E203", node.location, subject, "a whole number, 2 or more", form(node), "peers: 2")


Declared = TypeVar("Declared", bound=Parameter | ComponentVariable)


def _overridden(
    base: tuple[Declared, ...], declared: tuple[Declared, ...], mistakes: Mistakes
) -> tuple[Declared, ...]:
    """Return the declarations of a component: the inherited ones, then the new ones.

    A declaration in `declared` replaces the inherited declaration with the same name.
    """
    inherited = by_vector(base)
    for name, items in by_vector(declared).items():
        before = [text.name for text in inherited.get(name, items)]
        if before != [item.name for item in items]:
            size = "a number" if before == [name] else f"a vector of {len(before)}"
            message = f"{name} is already {size} in the extended component"
            mistakes.add("E205", items[0].location, message, advice="choose another name")
    return tuple({item.name: item for item in (*base, *declared)}.values())


def _with_inner_parts(
    root: MappingReader, outer: Component, library: Definitions, mistakes: Mistakes
) -> Component:
    """Return a component with its inner parts, and its connectors that belong to an inner part."""
    parts = PartEntries(library, mistakes)
    parts.read("parts", root)
    dimensions: dict[tuple[str, ...], Dimension] = {(p.name,): p.unit.dimension for p in outer.numbers}
    dimensions[PEERS] = DIMENSIONLESS

    def references(role: str, _: str) -> Collection[str]:
        """Return the parameters of the outer component with a role: clocks, links or tables."""
        return [p.name for p in outer.parameters if isinstance(p, Reference) and p.role == role]

    names = [".".join(name) for name in dimensions]
    scope = EntryScope(dimensions.get, names, references, parts, outer=outer)
    inner = [
        Inner(name, part.component, read_entry(part, scope, mistakes, index), part.location)
        for part in parts.entries.values()
        for index, name in enumerate(elements(part.name, part.count or 0), 1)
    ]
    passed = [
        (outer_connector, part.name, connector)
        for part in inner
        for connector, target, outer_connector in part.entry.connections
        if not target
    ]
    known = [f"{part.name}.{name}" for part in inner for name, _ in part.component.connectors]
    for key, value in root.section("connect", "{flange: tip.flange}"):
        with mistakes:  # connectors of the component that belong to an inner part
            text = text_of(value, key.text, f"{key.text}: tip.flange")
            part, _, connector = text.partition(".")
            if part.partition("[")[0] not in parts.faulty:
                message = "connect: {} is not a connector of"
                name = among(key.text, dict(outer.connectors), key.location, f"{message} this component")
                among(text, known, value.location, f"{message} an inner part")
                passed.append((name, part, connector))
    component = replace(outer, inner=(*outer.inner, *inner), passed=(*outer.passed, *passed))
    advice = "reduce the nesting of components"
    if component.depth > DEEPEST:
        message = f"the parts of {outer.name} are nested more than {DEEPEST} levels deep"
        mistakes.add("E216", outer.location, message, advice=advice)
    if component.size > MOST_PARTS:
        message = (
            f"{outer.name}: expected at most {MOST_PARTS} parts, inner parts included, got {component.size:,}"
        )
        mistakes.add("E216", outer.location, message, advice="reduce the number of parts")
    return component


def _connectors(root: MappingReader, library: Definitions) -> list[tuple[str, Connector, bool]]:
    """Return the connectors with their types, and whether each is for hands.

    The section is `connectors: {flange: Flange, grip: {type: Flange, for: hands}}`.
    """

    def read(key: Scalar, value: Node) -> tuple[str, Connector, bool]:
        """Return the name of one connector, its type, and whether it is for hands."""
        name, kind, for_hands = name_of(key, "a connector"), value, isinstance(value, Mapping)
        if isinstance(value, Mapping):
            body = MappingReader(value, ("type", "for"), f"connector {name}", root.mistakes)
            if body.text("for", "for: hands") != "hands":
                meant = body.nodes.get("for")
                got, location = (
                    ("nothing", value.location) if meant is None else (form(meant), meant.location)
                )
                fix = f"{name}: {{type: Flange, for: hands}}"
                root.mistakes.take(fault("E203", location, f"'for' of {name}", "hands", got, fix))
            kind = body.nodes.get("type", value)
        text = text_of(kind, name, f"{name}: Flange")
        connector = library.connector(text)
        if connector is None:
            known = [name for name in library.names if library.connector(name)]
            raise unknown("E206", kind.location, f"unknown connector type {brief(text)}", text, known)
        return name, connector, for_hands

    return root.each("connectors", "{flange: Flange}", read)
