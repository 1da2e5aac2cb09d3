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
from typing import Protocol, TypeVar

from apc.compiler.components.component import (
    RESERVED,
    Component,
    Connector,
    Inner,
    Parameter,
    Reference,
    Variable,
)
from apc.compiler.components.component_check import ComponentNames, check_balance
from apc.compiler.components.declarations import (
    names_of_faulty,
    read_equations,
    read_parameters,
    read_sends,
    read_variables,
)
from apc.compiler.components.parts import MOST_PARTS, Scope, read_count, read_entry
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.language.dimensions import DIMENSIONLESS, Dimension
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import PEERS
from apc.compiler.language.vectors import entries as elements
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.reading import (
    add_unknown,
    brief,
    check_keys,
    entries,
    form,
    read_mapping,
    read_name,
    read_text,
    whole_number,
)
from apc.compiler.source.source import Source
from apc.compiler.words import counted

COMPONENT_KEYS = (
    "component",
    "about",
    "source",
    "peers",
    "extends",
    "connectors",
    "parameters",
    "variables",
    "parts",
    "connect",
    "sends",
    "equations",
)
DEEPEST = 10  # levels of parts inside parts


def read_connector(source: Source) -> Connector:
    """Read a connector definition. Raises ApcError with all its mistakes."""
    mistakes = Mistakes()
    root = read_mapping(source.root, "a connector definition", mistakes)
    mistakes.raise_if_any()
    assert root is not None
    root = check_keys(root, ("connector", "about", "source", "potentials", "flows"), "a connector", mistakes)
    potentials = read_variables(root.get("potentials"), mistakes)
    flows = read_variables(root.get("flows"), mistakes)
    name = read_text(root.get("connector"), "connector", mistakes) or ""
    about = read_text(root.get("about"), "about", mistakes) or ""
    _check_limits((*potentials, *flows), None, mistakes)
    mistakes.raise_if_any()
    if len(potentials) != len(flows):
        what = (
            f"{name} is unbalanced: {counted(len(potentials), 'potential')} for {counted(len(flows), 'flow')}"
        )
        hint = "a flow for each potential, of its size"
        mistakes.add("E501", root.place, what, hint=hint)
    mistakes.raise_if_any()
    return Connector(name, about, potentials, flows)


class Definitions(Protocol):
    """Where a definition finds the others it names."""

    @property
    def component_names(self) -> tuple[str, ...]:
        """The names of the components that can be asked for."""

    @property
    def names(self) -> tuple[str, ...]:
        """Everything that can be asked for."""

    def component(self, name: str) -> Component | None:
        """Return a component, or None if there is no such name."""

    def connector(self, name: str) -> Connector | None:
        """Return a connector type, or None if there is no such name."""


def read_component(source: Source, library: Definitions) -> Component:
    """Read and check a component definition. Raises ApcError with all its mistakes."""
    mistakes = Mistakes()
    root = read_mapping(source.root, "a component definition", mistakes)
    mistakes.raise_if_any()
    assert root is not None
    root = check_keys(root, COMPONENT_KEYS, "a component", mistakes)
    # An equation that can't be read hides no mistake of the others.
    unread = Mistakes()
    draft = _read_declarations(root, library, mistakes, unread)
    sends = read_sends(root.get("sends"), unread)
    if mistakes:
        unread.pass_on(mistakes)
    mistakes.raise_if_any()
    names = ComponentNames(draft, names_of_faulty(root.get("equations"), draft.equations))
    locals_, found = names.infer_locals(sends), names.infer_sends(sends, mistakes)
    component = replace(draft, locals=(*draft.locals, *locals_), sends=(*draft.sends, *found))
    if not mistakes:
        component = names.check(component, mistakes)
    unread.pass_on(mistakes)
    mistakes.raise_if_any()
    check_balance(component, mistakes)
    mistakes.raise_if_any()
    return component


def _read_declarations(
    root: Mapping, library: Definitions, mistakes: Mistakes, unread: Mistakes
) -> Component:
    """Read everything but what has to be inferred; what the component extends comes first.

    `unread` takes the mistakes of equations.
    """
    title = root.get("component")
    name = (read_name(title, "a component", mistakes) if isinstance(title, Scalar) else None) or "?"
    base = _base(root.get("extends"), library, mistakes)
    connectors, grips = _connectors(root.get("connectors"), library, mistakes)
    parameters = read_parameters(root.get("parameters"), mistakes)
    variables = read_variables(root.get("variables"), mistakes)
    equations = read_equations(root.get("equations"), unread)
    about = read_text(root.get("about"), "about", mistakes) or ""
    cited = read_text(root.get("source"), "source", mistakes) or ""
    place = title.place if title is not None else root.place
    peers = _peers(root.get("peers"), mistakes)
    _check_distinct(connectors, parameters, variables, mistakes)
    if base is None:
        draft = Component(
            name,
            about,
            cited,
            connectors,
            parameters,
            variables,
            (),
            (),
            equations,
            (),
            (),
            place,
            grips,
            peers,
        )
    else:
        draft = replace(
            base,
            name=name,
            about=about,
            source=cited,
            connectors=(*base.connectors, *connectors),
            parameters=_overridden(base.parameters, parameters, mistakes),
            variables=_overridden(base.variables, variables, mistakes),
            equations=(*base.equations, *equations),
            place=place,
            grips=(*base.grips, *grips),
            peers=peers or base.peers,
        )
    _check_limits(draft.variables, draft, mistakes)
    if root.get("parts") is None and root.get("connect") is None:
        return draft
    inner, passed = _read_inner(root, draft, library, mistakes)
    return replace(draft, inner=(*draft.inner, *inner), passed=(*draft.passed, *passed))


def _check_limits(variables: Iterable[Variable], within: Component | None, mistakes: Mistakes) -> None:
    """Record limits of variables that are no number of the same dimension of the component around."""
    numbers = {one.name: one.unit.dimension for one in (within.numbers if within else ())}
    for variable in variables:
        if not variable.limit:
            continue
        if variable.limit not in numbers:
            what = f"the limit of {variable.name} is {brief(variable.limit)}, which is no number here"
            add_unknown("E206", variable.place, what, variable.limit, list(numbers), mistakes)
        elif numbers[variable.limit] != variable.unit.dimension:
            got = f"{variable.limit} in {format_dimension(numbers[variable.limit])}"
            expected = f"a parameter in {format_dimension(variable.unit.dimension)}"
            what = f"the limit of {variable.name}"
            mistakes.add("E204", variable.place, what, expected=expected, got=got)


def _peers(node: Node | None, mistakes: Mistakes) -> int:
    """Read `peers: 2`: for how many peers a component that follows others is; 0 for any number."""
    if node is None:
        return 0
    found = whole_number(node)
    if found is not None and found >= 2:
        return found
    mistakes.add(
        "E203", node.place, "peers", expected="a whole number from 2 on", got=form(node), hint="peers: 2"
    )
    return 0


def _base(node: Node | None, library: Definitions, mistakes: Mistakes) -> Component | None:
    hint = "extends: Mass"
    text = read_text(node, "extends", mistakes, hint=hint)
    return None if node is None or text is None else _found(text, node.place, library, mistakes, hint)


def _found(name: str, place: Place, library: Definitions, mistakes: Mistakes, hint: str) -> Component | None:
    try:
        component = library.component(name)
    except ApcError as error:
        mistakes.take(error)
        return None
    if component is None and name in library.names:
        mistakes.add("E206", place, f"{name} is a connector type, not a component", hint=hint)
    elif component is None:
        known = library.component_names
        add_unknown("E206", place, f"there is no component {brief(name)}", name, known, mistakes)
    return component


class _Named(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def place(self) -> Place: ...


Declared = TypeVar("Declared", bound=_Named)


def _overridden(
    base: tuple[Declared, ...], own: tuple[Declared, ...], mistakes: Mistakes
) -> tuple[Declared, ...]:
    """Return the inherited declarations, those declared again replaced in their place, then the new ones."""
    merged = {item.name: item for item in base}
    sizes = Counter(whole_and_index(item.name)[0] for item in base)
    mine = Counter(whole_and_index(item.name)[0] for item in own)
    for item in own:
        name, index = whole_and_index(item.name)
        same = mine[name] == sizes[name] and item.name in merged
        if name in sizes and index <= 1 and not same:
            before = "a number" if name in merged else f"a vector of {sizes[name]}"
            mistakes.add(
                "E205", item.place, f"{name} is {before} in what this component extends", hint="another name"
            )
    merged.update({item.name: item for item in own})
    return tuple(merged.values())


def _read_inner(
    root: Mapping, outer: Component, library: Definitions, mistakes: Mistakes
) -> tuple[tuple[Inner, ...], tuple[tuple[str, str, str], ...]]:
    """Read the parts inside a component and the connectors it passes on to them."""
    bodies: dict[str, tuple[Mapping, Component, Place]] = {}
    counts: dict[str, int] = {}
    faulty: set[str] = set()
    hint = "parts: {tip: {type: Mass}}"
    for key, value in entries(read_mapping(root.get("parts"), "parts", mistakes, hint=hint)):
        name = read_name(key, "a part", mistakes)
        body = read_mapping(value, key.text, mistakes, hint=f"{key.text}: {{type: Mass}}")
        faulty.add(key.text)
        component = None if name is None or body is None else read_type(key, body, None, library, mistakes)
        if name is not None and body is not None and component is not None:
            bodies[name] = (body, component, key.place)
            faulty.discard(name)
            if (count := read_count(name, body, mistakes)) is not None:
                counts[name] = count
    dimensions: dict[tuple[str, ...], Dimension] = {(p.name,): p.unit.dimension for p in outer.numbers}
    dimensions[PEERS] = DIMENSIONLESS

    def references(role: str, word: str, place: Place) -> Collection[str]:
        return [p.name for p in outer.parameters if isinstance(p, Reference) and p.role == role]

    scope = Scope(
        dimension=lambda parts: dimensions.get(parts),
        names=[".".join(parts) for parts in dimensions],
        references=references,
        parts={name: component for name, (_, component, _) in bodies.items()},
        counts=counts,
        faulty=faulty,
        whole=f"the parts of {outer.name}",
        outer=outer,
    )
    inner = []
    for name, (body, component, place) in bodies.items():
        free = [connector for connector, _ in component.connectors]
        count = counts.get(name)
        for index, one in enumerate(elements(name, count or 0), 1):
            entry = read_entry(
                name,
                body,
                component,
                place,
                scope,
                mistakes,
                more_keys=("count",),
                index=index,
                count=count,
                free_connectors=free,
            )
            inner.append(Inner(one, component, entry, place))
    deepest = max((component.depth for _, component, _ in bodies.values()), default=0)
    if deepest >= DEEPEST:
        what = f"the parts of {outer.name} stand inside one another more than {DEEPEST} deep"
        mistakes.add("E216", outer.place, what, hint="fewer components around one another")
    if (size := outer.size + sum(part.component.size for part in inner)) > MOST_PARTS:
        what = (
            f"{outer.name} holds {size:,} parts, those inside parts included, and {MOST_PARTS} are the most"
        )
        mistakes.add("E216", outer.place, what, hint="fewer parts, or fewer components around one another")
    passed = [
        (theirs, part.name, own)
        for part in inner
        for own, other, theirs in part.entry.connections
        if not other
    ]
    passed += _read_connect(root.get("connect"), outer, inner, faulty, mistakes)
    return tuple(inner), tuple(passed)


def _read_connect(
    node: Node | None,
    outer: Component,
    inner: Collection[Inner],
    faulty: Collection[str],
    mistakes: Mistakes,
) -> list[tuple[str, str, str]]:
    """Read `connect: {flange: tip.flange}`: connectors of the component that are those of an inner part."""
    found = []
    own = dict(outer.connectors)
    known = [f"{part.name}.{c}" for part in inner for c, _ in part.component.connectors]
    hint = "connect: {flange: tip.flange}"
    for key, value in entries(read_mapping(node, "connect", mistakes, hint=hint)):
        text = read_text(value, key.text, mistakes, hint=f"{key.text}: tip.flange")
        if text is None or text.partition(".")[0].partition("[")[0] in faulty:  # which is told of already
            continue
        if key.text not in own:
            what = f"connect names {brief(key.text)}, which is no connector of this component"
            add_unknown("E206", key.place, what, key.text, list(own), mistakes)
        elif text not in known:
            what = f"connect names {brief(text)}, which is no connector of an inner part"
            add_unknown("E206", value.place, what, text, known, mistakes)
        else:
            part, _, connector = text.partition(".")
            found.append((key.text, part, connector))
    return found


def read_type(
    key: Scalar,
    body: Mapping,
    default: str | None,
    library: Definitions,
    mistakes: Mistakes,
    *,
    example: str = "Mass",
) -> Component | None:
    """Return the component that a part's entry is of.

    Parameters
    ----------
    key, body
        The part's name and its entry.
    default
        The type that serves when the entry has none.
    library
        Where components are found.
    mistakes
        Takes E201 when there is no type, and what `library` says of one that can't be had.
    example
        A type to show in a message.
    """
    node = body.get("type")
    name = default if node is None else read_text(node, "type", mistakes, hint=f"type: {example}")
    if node is None and name is None:
        mistakes.add("E201", key.place, f"{key.text} has no type", hint=f"type: {example}")
    if name is None:
        return None
    place = node.place if node is not None else key.place
    return _found(name, place, library, mistakes, f"type: {example}")


def _check_distinct(
    connectors: tuple[tuple[str, Connector], ...],
    parameters: tuple[Parameter, ...],
    variables: tuple[Variable, ...],
    mistakes: Mistakes,
) -> None:
    seen = {name for name, _ in connectors}
    for item in (*parameters, *variables):
        name, index = whole_and_index(item.name)
        if index > 1:
            continue
        if name in seen:
            mistakes.add("E205", item.place, f"the name {name} is used twice in this component")
        if name in RESERVED:
            mistakes.add("E205", item.place, f"{name} is a word of the language and can't be a name")
        seen.add(name)


def _connectors(
    node: Node | None, library: Definitions, mistakes: Mistakes
) -> tuple[tuple[tuple[str, Connector], ...], tuple[str, ...]]:
    """Read `connectors: {flange: Flange, grip: {type: Flange, for: hands}}`, and which are for hands."""
    found, grips = [], []
    for key, value in entries(
        read_mapping(node, "connectors", mistakes, hint="connectors: {flange: Flange}")
    ):
        name = read_name(key, "a connector", mistakes)
        of_hands = isinstance(value, Mapping)
        if isinstance(value, Mapping):
            body = check_keys(value, ("type", "for"), f"connector {key.text}", mistakes)
            meant = body.get("for")
            if meant is None or read_text(meant, "for", mistakes, hint="for: hands") not in (None, "hands"):
                place = value.place if meant is None else meant.place
                got = "nothing" if meant is None else form(meant)
                hint = f"{key.text}: {{type: Flange, for: hands}}"
                mistakes.add("E203", place, f"what {key.text} is for", expected="hands", got=got, hint=hint)
            value = body.get("type") or body
        type_name = read_text(value, key.text, mistakes, hint=f"{key.text}: Flange")
        if name is None or type_name is None:
            continue
        connector = library.connector(type_name)
        if connector is None:
            what = f"there is no connector type {brief(type_name)}"
            known = [known for known in library.names if library.connector(known)]
            add_unknown("E206", value.place, what, type_name, known, mistakes)
        else:
            found.append((name, connector))
            grips += [name] if of_hands else []
    return tuple(found), tuple(grips)
