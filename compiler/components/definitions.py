"""Component and connector definitions: YAML text to typed data, checked once per component.

Takes: the YAML source of a definition, and its library. Gives: `read_component`, a `Component`;
`read_connector`, a `Connector`.
Guarantees: the definitions that it extends and contains exist and are read before it. An invalid component
(see `component_check`) is never returned.
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
    *("parts", "connect", "sends", "equations", "linearized", "symbols"),
)
DEEPEST = 10  # levels of parts inside parts


def read_connector(source: Source) -> Connector:
    """Read a connector definition. Raises ApcError with all its mistakes."""
    mistakes = Mistakes()
    root = MappingReader(
        mapping_of(source.root, "a connector definition"), CONNECTOR, "a connector", mistakes
    )
    name, description = root.text("connector"), root.text("description")
    potentials, flows = (read_variables(root, key) for key in ("potentials", "flows"))
    _check_limits((*potentials, *flows), (), mistakes)
    mistakes.raise_if_any()
    if len(potentials) != len(flows):
        numbers = f"{counted(len(potentials), 'potential')} for {counted(len(flows), 'flow')}"
        hint = "a flow for each potential, of its size"
        raise fault("E501", root.location, f"{name} is unbalanced: {numbers}", hint=hint)
    return Connector(name, description, potentials, flows)


def read_component(source: Source, library: Definitions) -> Component:
    """Read and check a component definition. Raises ApcError with all its mistakes."""
    mistakes, unread = Mistakes(), Mistakes()  # an equation that can't be read hides no mistake of the others
    root = MappingReader(
        mapping_of(source.root, "a component definition"), COMPONENT, "a component", mistakes
    )
    equations, undefined = read_equations(root, unread)
    draft = _read_declarations(root, library, mistakes)
    linearized = read_linearized(root, unread) or draft.linearized
    symbols = _symbols(root, draft) or draft.symbols
    draft = replace(draft, equations=(*draft.equations, *equations), linearized=linearized, symbols=symbols)
    sends = read_sends(root, unread)
    if mistakes:
        unread.pass_on(mistakes)
    mistakes.raise_if_any()
    component = ComponentNames(draft, undefined).completed(sends, mistakes)
    unread.pass_on(mistakes)
    mistakes.raise_if_any()
    check_balance(component)
    return component


def _symbols(root: MappingReader, component: Component) -> tuple[tuple[str, str], ...]:
    """Read `symbols: {K: stiffness}`: the parameters for the symbols of published conditions."""
    names = {parameter.name: None for parameter in component.parameters}

    def read(key: Scalar, value: Node) -> tuple[str, str]:
        symbol = among(key.text, dict.fromkeys(SYMBOLS), key.location, "symbols names {}, which is no symbol")
        name = text_of(value, key.text, "K: stiffness")
        return symbol, among(name, names, value.location, f"{symbol} names {{}}, which is no parameter")

    return tuple(root.each("symbols", "{K: stiffness}", read))


def _read_declarations(root: MappingReader, library: Definitions, mistakes: Mistakes) -> Component:
    """Read all except equations and sends; extended components come first."""
    title = root.nodes["component"]
    assert isinstance(title, Scalar)  # or the library would not know it
    with mistakes:
        name_of(title, "a component")
    description, cited, hint = root.text("description"), root.text("source"), "extends: Mass"
    base = root.read(
        "extends",
        lambda node, key: component_named(text_of(node, key, hint), node.location, library, hint),
        Component("", "", "", title.location),
    )
    connectors = _connectors(root, library)
    parameters, variables = read_parameters(root), read_variables(root)
    observed = {name for name, _, _ in connectors}
    for declared in (by_vector(parameters), by_vector(variables)):
        for local, (first, *_) in declared.items():
            if local in observed:
                mistakes.add("E205", first.location, f"the name {local} is used twice in this component")
            if local in RESERVED:
                mistakes.add("E205", first.location, f"{local} is a word of the language and can't be a name")
            observed.add(local)
    draft = replace(
        base,
        name=title.text,
        description=description,
        source=cited,
        connectors=(*base.connectors, *((local, kind) for local, kind, _ in connectors)),
        parameters=_overridden(base.parameters, parameters, mistakes),
        variables=_overridden(base.variables, variables, mistakes),
        location=title.location,
        grips=(*base.grips, *(local for local, _, for_hands in connectors if for_hands)),
        peers=root.read("peers", _peers, base.peers),
    )
    _check_limits(draft.variables, draft.numbers, mistakes)
    return _with_inner(root, draft, library, mistakes)


def _check_limits(
    variables: Iterable[ComponentVariable], numbers: Iterable[NumberParameter], mistakes: Mistakes
) -> None:
    """Record limits of variables that are no number of the same dimension of the component around."""
    known = {number.name: number.unit.dimension for number in numbers}
    for variable in variables:
        limit, due, message = variable.limit, variable.unit.dimension, f"the limit of {variable.name}"
        if limit and limit not in known:
            message += f" is {brief(limit)}, which is no number here"
            mistakes.take(unknown("E206", variable.location, message, limit, known))
        elif limit and known[limit] != due:
            got = f"{limit} in {format_dimension(known[limit])}"
            expected = f"a parameter in {format_dimension(due)}"
            mistakes.add("E204", variable.location, message, expected=expected, got=got)


def _peers(node: Node, subject: str) -> int:
    """Read `peers: 2`: for how many peers a component that follows others is."""
    if (count := whole_number(node) or 0) >= 2:
        return count
    raise fault("E203", node.location, subject, "a whole number from 2 on", form(node), "peers: 2")


Declared = TypeVar("Declared", bound=Parameter | ComponentVariable)


def _overridden(
    base: tuple[Declared, ...], local: tuple[Declared, ...], mistakes: Mistakes
) -> tuple[Declared, ...]:
    """Return the inherited declarations, those declared again replaced in their place, then the new ones."""
    inherited = by_vector(base)
    for name, items in by_vector(local).items():
        before = [text.name for text in inherited.get(name, items)]
        if before != [item.name for item in items]:
            size = "a number" if before == [name] else f"a vector of {len(before)}"
            message = f"{name} is {size} in what this component extends"
            mistakes.add("E205", items[0].location, message, hint="another name")
    return tuple({item.name: item for item in (*base, *local)}.values())


def _with_inner(root: MappingReader, outer: Component, library: Definitions, mistakes: Mistakes) -> Component:
    """Return a component with the parts inside it, and the connectors that it passes on to them."""
    parts = PartEntries(library, mistakes)
    parts.read("parts", root)
    dimensions: dict[tuple[str, ...], Dimension] = {(p.name,): p.unit.dimension for p in outer.numbers}
    dimensions[PEERS] = DIMENSIONLESS

    def references(role: str, _: str) -> Collection[str]:
        return [p.name for p in outer.parameters if isinstance(p, Reference) and p.role == role]

    names, whole = [".".join(name) for name in dimensions], f"the parts of {outer.name}"
    scope = EntryScope(dimensions.get, names, references, parts, whole, outer=outer)
    inner = [
        Inner(name, part.component, read_entry(part, scope, mistakes, index), part.location)
        for part in parts.entries.values()
        for index, name in enumerate(elements(part.name, part.count or 0), 1)
    ]
    passed = [
        (theirs, part.name, local)
        for part in inner
        for local, other, theirs in part.entry.connections
        if not other
    ]
    known = [f"{part.name}.{name}" for part in inner for name, _ in part.component.connectors]
    for key, value in root.section("connect", "{flange: tip.flange}"):
        with mistakes:  # connectors of the component that are those of an inner part
            text = text_of(value, key.text, f"{key.text}: tip.flange")
            part, _, connector = text.partition(".")
            if part.partition("[")[0] not in parts.faulty:
                message = "connect names {}, which is no connector of"
                name = among(key.text, dict(outer.connectors), key.location, f"{message} this component")
                among(text, known, value.location, f"{message} an inner part")
                passed.append((name, part, connector))
    component = replace(outer, inner=(*outer.inner, *inner), passed=(*outer.passed, *passed))
    hint = "fewer components around one another"
    if component.depth > DEEPEST:
        message = f"the parts of {outer.name} stand inside one another more than {DEEPEST} deep"
        mistakes.add("E216", outer.location, message, hint=hint)
    if component.size > MOST_PARTS:
        message = (
            f"{outer.name} holds {component.size:,} parts, those inside parts included, and {MOST_PARTS}"
        )
        mistakes.add("E216", outer.location, f"{message} are the most", hint=f"fewer parts, or {hint}")
    return component


def _connectors(root: MappingReader, library: Definitions) -> list[tuple[str, Connector, bool]]:
    """Read `connectors: {flange: Flange, grip: {type: Flange, for: hands}}`, each with whether it is that."""

    def read(key: Scalar, value: Node) -> tuple[str, Connector, bool]:
        name, kind, for_hands = name_of(key, "a connector"), value, isinstance(value, Mapping)
        if isinstance(value, Mapping):
            body = MappingReader(value, ("type", "for"), f"connector {name}", root.mistakes)
            if body.text("for", "for: hands") != "hands":
                meant = body.nodes.get("for")
                got, location = (
                    ("nothing", value.location) if meant is None else (form(meant), meant.location)
                )
                hint = f"{name}: {{type: Flange, for: hands}}"
                root.mistakes.take(fault("E203", location, f"what {name} is for", "hands", got, hint))
            kind = body.nodes.get("type", value)
        text = text_of(kind, name, f"{name}: Flange")
        connector = library.connector(text)
        if connector is None:
            known = [name for name in library.names if library.connector(name)]
            raise unknown("E206", kind.location, f"there is no connector type {brief(text)}", text, known)
        return name, connector, for_hands

    return root.each("connectors", "{flange: Flange}", read)
