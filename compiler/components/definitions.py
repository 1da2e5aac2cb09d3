"""Component and connector definitions: YAML text to typed data, checked once per component.

Takes: the YAML source of a definition, and the library it stands in. Gives: `Component`, `Connector`.
Guarantees: what a definition extends and contains is there and read before it; a component that isn't sound
(see `component_check`) is never handed out.
Does not: know any topology, or which component is used where.
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
from apc.compiler.words import counted

CONNECTOR = ("connector", "about", "source", "potentials", "flows")
COMPONENT = (
    *("component", "about", "source", "peers", "extends", "connectors", "parameters", "variables"),
    *("parts", "connect", "sends", "equations", "linearized", "symbols"),
)
DEEPEST = 10  # levels of parts inside parts


def read_connector(source: Source) -> Connector:
    """Read a connector definition. Raises ApcError with all its mistakes."""
    mistakes = Mistakes()
    root = MappingReader(
        mapping_of(source.root, "a connector definition"), CONNECTOR, "a connector", mistakes
    )
    name, about = root.text("connector"), root.text("about")
    potentials, flows = (read_variables(root, key) for key in ("potentials", "flows"))
    _check_limits((*potentials, *flows), (), mistakes)
    mistakes.raise_if_any()
    if len(potentials) != len(flows):
        numbers = f"{counted(len(potentials), 'potential')} for {counted(len(flows), 'flow')}"
        hint = "a flow for each potential, of its size"
        raise fault("E501", root.place, f"{name} is unbalanced: {numbers}", hint=hint)
    return Connector(name, about, potentials, flows)


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
    """Read `symbols: {K: stiffness}`: the parameters that play symbols of published conditions."""
    names = {parameter.name: None for parameter in component.parameters}

    def read(key: Scalar, value: Node) -> tuple[str, str]:
        symbol = among(key.text, dict.fromkeys(SYMBOLS), key.place, "symbols names {}, which is no symbol")
        name = text_of(value, key.text, "K: stiffness")
        return symbol, among(name, names, value.place, f"{symbol} names {{}}, which is no parameter")

    return tuple(root.each("symbols", "{K: stiffness}", read))


def _read_declarations(root: MappingReader, library: Definitions, mistakes: Mistakes) -> Component:
    """Read everything but equations and sends; what the component extends comes first."""
    title = root.nodes["component"]
    assert isinstance(title, Scalar)  # or the library would not know it
    with mistakes:
        name_of(title, "a component")
    about, cited, hint = root.text("about"), root.text("source"), "extends: Mass"
    base = root.read(
        "extends",
        lambda node, key: component_named(text_of(node, key, hint), node.place, library, hint),
        Component("", "", "", title.place),
    )
    connectors = _connectors(root, library)
    parameters, variables = read_parameters(root), read_variables(root)
    seen = {name for name, _, _ in connectors}
    for declared in (by_vector(parameters), by_vector(variables)):
        for own, (first, *_) in declared.items():
            if own in seen:
                mistakes.add("E205", first.place, f"the name {own} is used twice in this component")
            if own in RESERVED:
                mistakes.add("E205", first.place, f"{own} is a word of the language and can't be a name")
            seen.add(own)
    draft = replace(
        base,
        name=title.text,
        about=about,
        source=cited,
        connectors=(*base.connectors, *((own, kind) for own, kind, _ in connectors)),
        parameters=_overridden(base.parameters, parameters, mistakes),
        variables=_overridden(base.variables, variables, mistakes),
        place=title.place,
        grips=(*base.grips, *(own for own, _, for_hands in connectors if for_hands)),
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
        limit, due, what = variable.limit, variable.unit.dimension, f"the limit of {variable.name}"
        if limit and limit not in known:
            what += f" is {brief(limit)}, which is no number here"
            mistakes.take(unknown("E206", variable.place, what, limit, known))
        elif limit and known[limit] != due:
            got = f"{limit} in {format_dimension(known[limit])}"
            expected = f"a parameter in {format_dimension(due)}"
            mistakes.add("E204", variable.place, what, expected=expected, got=got)


def _peers(node: Node, what: str) -> int:
    """Read `peers: 2`: for how many peers a component that follows others is."""
    if (count := whole_number(node) or 0) >= 2:
        return count
    raise fault("E203", node.place, what, "a whole number from 2 on", form(node), "peers: 2")


Declared = TypeVar("Declared", bound=Parameter | ComponentVariable)


def _overridden(
    base: tuple[Declared, ...], own: tuple[Declared, ...], mistakes: Mistakes
) -> tuple[Declared, ...]:
    """Return the inherited declarations, those declared again replaced in their place, then the new ones."""
    inherited = by_vector(base)
    for name, items in by_vector(own).items():
        before = [text.name for text in inherited.get(name, items)]
        if before != [item.name for item in items]:
            size = "a number" if before == [name] else f"a vector of {len(before)}"
            what = f"{name} is {size} in what this component extends"
            mistakes.add("E205", items[0].place, what, hint="another name")
    return tuple({item.name: item for item in (*base, *own)}.values())


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
        Inner(name, part.component, read_entry(part, scope, mistakes, index), part.place)
        for part in parts.entries.values()
        for index, name in enumerate(elements(part.name, part.count or 0), 1)
    ]
    passed = [
        (theirs, part.name, own)
        for part in inner
        for own, other, theirs in part.entry.connections
        if not other
    ]
    known = [f"{part.name}.{name}" for part in inner for name, _ in part.component.connectors]
    for key, value in root.section("connect", "{flange: tip.flange}"):
        with mistakes:  # connectors of the component that are those of an inner part
            text = text_of(value, key.text, f"{key.text}: tip.flange")
            part, _, connector = text.partition(".")
            if part.partition("[")[0] not in parts.faulty:
                what = "connect names {}, which is no connector of"
                name = among(key.text, dict(outer.connectors), key.place, f"{what} this component")
                among(text, known, value.place, f"{what} an inner part")
                passed.append((name, part, connector))
    component = replace(outer, inner=(*outer.inner, *inner), passed=(*outer.passed, *passed))
    hint = "fewer components around one another"
    if component.depth > DEEPEST:
        what = f"the parts of {outer.name} stand inside one another more than {DEEPEST} deep"
        mistakes.add("E216", outer.place, what, hint=hint)
    if component.size > MOST_PARTS:
        what = f"{outer.name} holds {component.size:,} parts, those inside parts included, and {MOST_PARTS}"
        mistakes.add("E216", outer.place, f"{what} are the most", hint=f"fewer parts, or {hint}")
    return component


def _connectors(root: MappingReader, library: Definitions) -> list[tuple[str, Connector, bool]]:
    """Read `connectors: {flange: Flange, grip: {type: Flange, for: hands}}`, each with whether it is that."""

    def read(key: Scalar, value: Node) -> tuple[str, Connector, bool]:
        name, kind, for_hands = name_of(key, "a connector"), value, isinstance(value, Mapping)
        if isinstance(value, Mapping):
            body = MappingReader(value, ("type", "for"), f"connector {name}", root.mistakes)
            if body.text("for", "for: hands") != "hands":
                meant = body.nodes.get("for")
                got, place = ("nothing", value.place) if meant is None else (form(meant), meant.place)
                hint = f"{name}: {{type: Flange, for: hands}}"
                root.mistakes.take(fault("E203", place, f"what {name} is for", "hands", got, hint))
            kind = body.nodes.get("type", value)
        text = text_of(kind, name, f"{name}: Flange")
        connector = library.connector(text)
        if connector is None:
            known = [name for name in library.names if library.connector(name)]
            raise unknown("E206", kind.place, f"there is no connector type {brief(text)}", text, known)
        return name, connector, for_hands

    return root.each("connectors", "{flange: Flange}", read)
