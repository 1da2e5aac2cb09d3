"""Component and connector definitions: YAML text to typed data, checked once per component.

Takes: the YAML source of a definition, and the library it stands in. Gives: `Component`, `Connector`.
Guarantees: what a definition extends and contains is there and read before it; a component that isn't sound
(see `component_check`) is never handed out.
Does not: know any topology, or which component is used where.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import replace
from typing import TypeVar

from apc.compiler.components.component import (
    RESERVED,
    Component,
    Connector,
    Inner,
    Joined,
    Named,
    Parameter,
    Reference,
    Variable,
)
from apc.compiler.components.component_check import ComponentNames, check_balance
from apc.compiler.components.declarations import (
    read_equations,
    read_parameters,
    read_sends,
    read_variables,
)
from apc.compiler.components.parts import MOST_PARTS, Definitions, Parts, Scope, component_named, read_entry
from apc.compiler.errors import Mistakes
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import PEERS
from apc.compiler.language.vectors import entries as elements
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.reading import (
    Body,
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
    *("parts", "connect", "sends", "equations"),
)
DEEPEST = 10  # levels of parts inside parts


def read_connector(source: Source) -> Connector:
    """Read a connector definition. Raises ApcError with all its mistakes."""
    mistakes = Mistakes()
    root = Body(mapping_of(source.root, "a connector definition"), CONNECTOR, "a connector", mistakes)
    name, about = root.text("connector"), root.text("about")
    potentials, flows = (read_variables(root, key) for key in ("potentials", "flows"))
    _check_limits((*potentials, *flows), None, mistakes)
    mistakes.raise_if_any()
    if len(potentials) != len(flows):
        numbers = f"{counted(len(potentials), 'potential')} for {counted(len(flows), 'flow')}"
        hint = "a flow for each potential, of its size"
        raise fault("E501", root.place, f"{name} is unbalanced: {numbers}", hint=hint)
    return Connector(name, about, potentials, flows)


def read_component(source: Source, library: Definitions) -> Component:
    """Read and check a component definition. Raises ApcError with all its mistakes."""
    mistakes, unread = Mistakes(), Mistakes()  # an equation that can't be read hides no mistake of the others
    root = Body(mapping_of(source.root, "a component definition"), COMPONENT, "a component", mistakes)
    equations, undefined = read_equations(root, unread)
    draft = _read_declarations(root, library, mistakes)
    draft = replace(draft, equations=(*draft.equations, *equations))
    sends = read_sends(root, unread)
    if mistakes:
        unread.pass_on(mistakes)
    mistakes.raise_if_any()
    component = ComponentNames(draft, undefined).completed(sends, mistakes)
    unread.pass_on(mistakes)
    mistakes.raise_if_any()
    check_balance(component)
    return component


def _read_declarations(root: Body, library: Definitions, mistakes: Mistakes) -> Component:
    """Read everything but equations and sends; what the component extends comes first."""
    title, name = root.nodes["component"], "?"
    with mistakes:
        name = name_of(title, "a component") if isinstance(title, Scalar) else name
    place = title.place
    about, cited = root.text("about"), root.text("source")
    base = Component("", "", "", place)
    base = root.read("extends", lambda node, key: _base(node, key, library), base)
    connectors, grips = _connectors(root, library, mistakes)
    parameters, variables = read_parameters(root), read_variables(root)
    _check_distinct(connectors, parameters, variables, mistakes)
    draft = replace(
        base,
        name=name,
        about=about,
        source=cited,
        connectors=(*base.connectors, *connectors),
        parameters=_overridden(base.parameters, parameters, mistakes),
        variables=_overridden(base.variables, variables, mistakes),
        place=place,
        grips=(*base.grips, *grips),
        peers=root.read("peers", _peers, base.peers),
    )
    _check_limits(draft.variables, draft, mistakes)
    inner, passed = _read_inner(root, draft, library, mistakes)
    return replace(draft, inner=(*draft.inner, *inner), passed=(*draft.passed, *passed))


def _check_limits(variables: Iterable[Variable], within: Component | None, mistakes: Mistakes) -> None:
    """Record limits of variables that are no number of the same dimension of the component around."""
    numbers = {one.name: one.unit.dimension for one in (within.numbers if within else ())}
    for variable in variables:
        limit, due = variable.limit, variable.unit.dimension
        what = f"the limit of {variable.name}"
        if limit and limit not in numbers:
            what = f"{what} is {brief(limit)}, which is no number here"
            mistakes.take(unknown("E206", variable.place, what, limit, numbers))
        elif limit and numbers[limit] != due:
            got = f"{limit} in {format_dimension(numbers[limit])}"
            expected = f"a parameter in {format_dimension(due)}"
            mistakes.add("E204", variable.place, what, expected=expected, got=got)


def _peers(node: Node, what: str) -> int:
    """Read `peers: 2`: for how many peers a component that follows others is."""
    count = whole_number(node)
    if count is None or count < 2:
        raise fault("E203", node.place, what, "a whole number from 2 on", form(node), "peers: 2")
    return count


def _base(node: Node, key: str, library: Definitions) -> Component:
    hint = "extends: Mass"
    return component_named(text_of(node, key, hint), node.place, library, hint)


Declared = TypeVar("Declared", bound=Parameter | Variable)


def _overridden(
    base: tuple[Declared, ...], own: tuple[Declared, ...], mistakes: Mistakes
) -> tuple[Declared, ...]:
    """Return the inherited declarations, those declared again replaced in their place, then the new ones."""
    merged = {item.name: item for item in base}
    sizes, mine = (Counter(whole_and_index(item.name)[0] for item in items) for items in (base, own))
    for item in own:
        name, index = whole_and_index(item.name)
        same = mine[name] == sizes[name] and item.name in merged
        if name in sizes and index <= 1 and not same:
            before = "a number" if name in merged else f"a vector of {sizes[name]}"
            what = f"{name} is {before} in what this component extends"
            mistakes.add("E205", item.place, what, hint="another name")
    return tuple((merged | {item.name: item for item in own}).values())


def _read_inner(
    root: Body, outer: Component, library: Definitions, mistakes: Mistakes
) -> tuple[tuple[Inner, ...], Joined]:
    """Read the parts inside a component and the connectors it passes on to them."""
    parts = Parts(library, mistakes)
    parts.read("parts", root)
    dimensions: dict[tuple[str, ...], Dimension] = {(p.name,): p.unit.dimension for p in outer.numbers}
    dimensions[PEERS] = DIMENSIONLESS

    def references(role: str, _: str) -> Collection[str]:
        return [p.name for p in outer.parameters if isinstance(p, Reference) and p.role == role]

    names, whole = [".".join(name) for name in dimensions], f"the parts of {outer.name}"
    scope = Scope(lambda parts: dimensions.get(parts), names, references, parts, whole, outer=outer)
    inner = tuple(
        Inner(name, part.component, read_entry(part, scope, mistakes, index), part.place)
        for part in parts.entries.values()
        for index, name in enumerate(elements(part.name, part.count or 0), 1)
    )
    hint = "fewer components around one another"
    if any(part.component.depth >= DEEPEST for part in inner):
        what = f"the parts of {outer.name} stand inside one another more than {DEEPEST} deep"
        mistakes.add("E216", outer.place, what, hint=hint)
    if (size := outer.size + sum(part.component.size for part in inner)) > MOST_PARTS:
        holds = f"{outer.name} holds {size:,} parts, those inside parts included"
        what = f"{holds}, and {MOST_PARTS} are the most"
        mistakes.add("E216", outer.place, what, hint=f"fewer parts, or {hint}")
    passed = [
        (theirs, part.name, own)
        for part in inner
        for own, other, theirs in part.entry.connections
        if not other
    ]
    return inner, (*passed, *_read_connect(root, outer, inner, parts.faulty))


def _read_connect(root: Body, outer: Component, inner: Collection[Inner], faulty: Collection[str]) -> Joined:
    """Read `connect: {flange: tip.flange}`: connectors of the component that are those of an inner part."""
    found = []
    own = dict(outer.connectors)
    known = [f"{part.name}.{name}" for part in inner for name, _ in part.component.connectors]
    for key, value in root.section("connect", "{flange: tip.flange}"):
        with root.mistakes:
            text = text_of(value, key.text, f"{key.text}: tip.flange")
            part, _, connector = text.partition(".")
            if part.partition("[")[0] in faulty:
                continue
            what = "connect names {}, which is no connector of"
            name = among(key.text, own, key.place, f"{what} this component")
            among(text, known, value.place, f"{what} an inner part")
            found.append((name, part, connector))
    return tuple(found)


def _check_distinct(
    connectors: Iterable[tuple[str, Connector]],
    parameters: Iterable[Parameter],
    variables: Iterable[Variable],
    mistakes: Mistakes,
) -> None:
    seen = {name for name, _ in connectors}
    for item in (*parameters, *variables):
        name, index = whole_and_index(item.name)
        if index <= 1 and name in seen:
            mistakes.add("E205", item.place, f"the name {name} is used twice in this component")
        if index <= 1 and name in RESERVED:
            mistakes.add("E205", item.place, f"{name} is a word of the language and can't be a name")
        seen.add(name)


def _connectors(
    root: Body, library: Definitions, mistakes: Mistakes
) -> tuple[Named[Connector], tuple[str, ...]]:
    """Read `connectors: {flange: Flange, grip: {type: Flange, for: hands}}`, and which are for hands."""
    found, grips = [], []
    for key, value in root.section("connectors", "{flange: Flange}"):
        with mistakes:
            name = name_of(key, "a connector")
            kind = value
            if isinstance(value, Mapping):
                body = Body(value, ("type", "for"), f"connector {name}", mistakes)
                if body.text("for", "for: hands") != "hands":
                    meant = body.nodes.get("for")
                    got, place = ("nothing", value.place) if meant is None else (form(meant), meant.place)
                    hint = f"{name}: {{type: Flange, for: hands}}"
                    mistakes.add("E203", place, f"what {name} is for", expected="hands", got=got, hint=hint)
                kind = body.nodes.get("type", value)
                grips.append(name)
            text = text_of(kind, name, f"{name}: Flange")
            connector = library.connector(text)
            if connector is None:
                known = [known for known in library.names if library.connector(known)]
                raise unknown("E206", kind.place, f"there is no connector type {brief(text)}", text, known)
            found.append((name, connector))
    return tuple(found), tuple(grips)
