"""Component and connector definitions: YAML text to typed data, checked once per component.

Takes: the YAML source of a definition, and the library it stands in. Gives: `Component`, `Connector`.
Guarantees: every name in an equation is declared, every equation's units agree, and a component has as
many equations as it must have; a component that breaks this is never handed out.
Does not: know any topology, or which component is used where.

A component is locally balanced in Modelica's sense (Modelica Language Specification 3.6, section 4.8): it
gives one equation for each of its variables and one for each flow of its connectors; the connections of a
scene give the rest.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Protocol, TypeVar

from apc.compiler.component import (
    OTHERS,
    Component,
    Connector,
    Inner,
    Option,
    Parameter,
    Reference,
    Send,
    Variable,
    option_test,
)
from apc.compiler.declarations import Sends, read_equations, read_parameters, read_sends, read_variables
from apc.compiler.dimensions import ANY, SECOND, check_equation, dimension_of
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.expression import (
    FUNCTIONS,
    KEYWORDS,
    Call,
    Compare,
    Equation,
    Expr,
    Name,
    format_expression,
    names,
    transform,
    walk,
)
from apc.compiler.expression import Number as Literal
from apc.compiler.parts import Scope, read_entry
from apc.compiler.reading import (
    add_unknown,
    brief,
    check_keys,
    entries,
    read_mapping,
    read_name,
    read_text,
)
from apc.compiler.source import Mapping, Node, Scalar, Source, place_in
from apc.compiler.units import DIMENSIONLESS, Dimension
from apc.compiler.values import PEERS
from apc.compiler.words import counted

COMPONENT_KEYS = (
    "component",
    "about",
    "source",
    "extends",
    "connectors",
    "parameters",
    "variables",
    "parts",
    "connect",
    "sends",
    "equations",
)
RESERVED = frozenset(
    {"peers", "others", "time", "ground", "type", "at", "shared", "set", *FUNCTIONS, *KEYWORDS}
)
DEEPEST = 10  # levels of parts inside parts
_TRUE = Compare("==", Literal(Fraction(1)), Literal(Fraction(1)))


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
    draft = _read_declarations(root, library, mistakes)
    mistakes.raise_if_any()
    names = _Names(draft)
    sends = read_sends(root.get("sends"), mistakes)
    locals_, found = names.infer_locals(sends), names.infer_sends(sends, mistakes)
    component = replace(draft, locals=(*draft.locals, *locals_), sends=(*draft.sends, *found))
    mistakes.raise_if_any()
    names.check(component, mistakes)
    mistakes.raise_if_any()
    _check_balance(component, mistakes)
    mistakes.raise_if_any()
    return component


def _read_declarations(root: Mapping, library: Definitions, mistakes: Mistakes) -> Component:
    """Read everything but what has to be inferred; what the component extends comes first."""
    title = root.get("component")
    name = (read_name(title, "a component", mistakes) if isinstance(title, Scalar) else None) or "?"
    base = _base(root.get("extends"), library, mistakes)
    connectors = _connectors(root.get("connectors"), library, mistakes)
    parameters = read_parameters(root.get("parameters"), mistakes)
    variables = read_variables(root.get("variables"), mistakes)
    equations = read_equations(root.get("equations"), mistakes)
    about = read_text(root.get("about"), "about", mistakes) or ""
    cited = read_text(root.get("source"), "source", mistakes) or ""
    place = title.place if title is not None else root.place
    _check_distinct(connectors, parameters, variables, mistakes)
    if base is None:
        draft = Component(
            name, about, cited, connectors, parameters, variables, (), (), equations, (), (), place
        )
    else:
        draft = replace(
            base,
            name=name,
            about=about,
            source=cited,
            connectors=(*base.connectors, *connectors),
            parameters=_overridden(base.parameters, parameters),
            variables=_overridden(base.variables, variables),
            equations=(*base.equations, *equations),
            place=place,
        )
    if root.get("parts") is None and root.get("connect") is None:
        return draft
    inner, passed = _read_inner(root, draft, library, mistakes)
    return replace(draft, inner=(*draft.inner, *inner), passed=(*draft.passed, *passed))


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


Declared = TypeVar("Declared", bound=_Named)


def _overridden(base: tuple[Declared, ...], own: tuple[Declared, ...]) -> tuple[Declared, ...]:
    """Return the inherited declarations, those declared again replaced in their place, then the new ones."""
    merged = {item.name: item for item in base}
    merged.update({item.name: item for item in own})
    return tuple(merged.values())


def _read_inner(
    root: Mapping, outer: Component, library: Definitions, mistakes: Mistakes
) -> tuple[tuple[Inner, ...], tuple[tuple[str, str, str], ...]]:
    """Read the parts inside a component and the connectors it passes on to them."""
    bodies: dict[str, tuple[Mapping, Component, Place]] = {}
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
    dimensions: dict[tuple[str, ...], Dimension] = {(p.name,): p.unit.dimension for p in outer.numbers}
    dimensions[PEERS] = DIMENSIONLESS

    def references(role: str, word: str, place: Place) -> Collection[str]:
        return [p.name for p in outer.parameters if isinstance(p, Reference) and p.role == role]

    scope = Scope(
        dimension=lambda parts: dimensions.get(parts),
        names=[".".join(parts) for parts in dimensions],
        references=references,
        parts={name: component for name, (_, component, _) in bodies.items()},
        counts={},
        faulty=faulty,
        whole=f"the parts of {outer.name}",
        outer=outer,
    )
    inner = []
    for name, (body, component, place) in bodies.items():
        free = [connector for connector, _ in component.connectors]
        entry = read_entry(name, body, component, place, scope, mistakes, free_connectors=free)
        inner.append(Inner(name, component, entry, place))
    deepest = max((component.depth for _, component, _ in bodies.values()), default=0)
    if deepest >= DEEPEST:  # each level may double the parts
        what = f"the parts of {outer.name} stand inside one another more than {DEEPEST} deep"
        mistakes.add("E216", outer.place, what, hint="fewer components around one another")
    passed = [
        (theirs, part.name, own)
        for part in inner
        for own, other, theirs in part.entry.connections
        if not other
    ]
    passed += _read_connect(root.get("connect"), outer, bodies, mistakes)
    return tuple(inner), tuple(passed)


def _read_connect(
    node: Node | None,
    outer: Component,
    bodies: dict[str, tuple[Mapping, Component, Place]],
    mistakes: Mistakes,
) -> list[tuple[str, str, str]]:
    """Read `connect: {flange: tip.flange}`: connectors of the component that are those of an inner part."""
    found = []
    own = dict(outer.connectors)
    known = [f"{p}.{c}" for p, (_, component, _) in bodies.items() for c, _ in component.connectors]
    hint = "connect: {flange: tip.flange}"
    for key, value in entries(read_mapping(node, "connect", mistakes, hint=hint)):
        text = read_text(value, key.text, mistakes, hint=f"{key.text}: tip.flange")
        if text is None:
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


class _Names:
    """Resolves a component's names to dimensions, and finds the locals on the way."""

    def __init__(self, component: Component) -> None:
        self.component = component
        self.dimensions: dict[tuple[str, ...], Dimension | None] = {PEERS: DIMENSIONLESS, ("time",): SECOND}
        self.dimensions.update(dict(visible_names(component)))
        for parameter in component.numbers:
            self.dimensions[(parameter.name,)] = parameter.unit.dimension
            for word, _ in parameter.words:
                self.dimensions.setdefault((word,), parameter.unit.dimension)
        passed = {connector for connector, _, _ in component.passed}
        for name, connector in component.connectors:
            if name not in passed:
                for flow in connector.flows:
                    self.dimensions[(name, flow.name)] = flow.unit.dimension
        self.dimensions[(OTHERS,)] = DIMENSIONLESS  # for count(others)
        for send in component.sends:
            self.dimensions[(OTHERS, send.name)] = send.dimension
        for table in component.parameters:
            if isinstance(table, Reference) and table.role == "table" and table.unit is not None:
                self.dimensions[(table.name,)] = table.unit.dimension

    def infer_sends(self, sends: Sends, mistakes: Mistakes) -> tuple[Send, ...]:
        """Return the sends with the dimension of what they send."""
        return tuple(
            Send(name, expression, text, place, _known(self._dimension(expression, text, place, mistakes)))
            for name, expression, text, place in sends
        )

    def infer_locals(self, sends: Sends) -> tuple[tuple[str, Dimension], ...]:
        """Return the undeclared names that stand alone on the left of an equation."""
        for name, expression, text, place in sends:
            self.dimensions[(OTHERS, name)] = self._dimension(expression, text, place, Mistakes())
        found: list[tuple[str, Dimension]] = []
        for equation in self.component.equations:
            left = equation.left
            if isinstance(left, Name) and len(left.parts) == 1 and left.parts not in self.dimensions:
                # An unknown name on the right is reported once, by `check`; a local may still be undecided.
                dimension = self._dimension(equation.right, equation.text, equation.place, Mistakes())
                self.dimensions[left.parts] = dimension
                found.append((left.parts[0], _known(dimension)))
        return tuple(found)

    def check(self, component: Component, mistakes: Mistakes) -> None:
        """Check the names, then the units, of every equation."""
        for equation in component.equations:
            unknown = False
            left, right = self._decided(equation.left), self._decided(equation.right)
            for side in (left, right):
                unknown |= self._check_names(side, equation.text, equation.place, mistakes)
                unknown |= self._check_reductions(side, equation.text, equation.place, mistakes)
            if not unknown:
                try:
                    check_equation(
                        Equation(left, right, equation.text, equation.place),
                        lambda name: self.dimensions.get(name.parts),
                    )
                except ApcError as error:
                    mistakes.take(error)

    def _check_reductions(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> bool:
        """Record a reduction that doesn't run over the other peers."""
        wrong = False
        for node in walk(expression):
            if not isinstance(node, Call) or any(name.parts[0] == OTHERS for name in names(node)):
                continue
            if node.function in ("mean", "sum", "count"):
                what, expected = f"{node.function} runs over the other peers and", "others.x in it"
            elif node.function in ("max", "min") and len(node.arguments) == 1:
                what, expected = node.function, "two values, or one of the other peers"
            else:
                continue
            wrong = True
            hint = "count(others)" if node.function == "count" else f"{node.function}(others.x)"
            where, got = place_in(place, text, node.start), format_expression(node)
            mistakes.add("E506", where, what, expected=expected, got=got, hint=hint)
        return wrong

    def _decided(self, expression: Expr) -> Expr:
        """Return the expression with each test of an option replaced by a true statement.

        Both branches of such a test are checked; the words of an option have no dimension.
        """
        options = {p.name: p for p in self.component.parameters if isinstance(p, Option)}
        return transform(expression, lambda node: _TRUE if option_test(node, options) else None)

    def _dimension(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> Dimension | None:
        expression = self._decided(expression)
        if self._check_names(expression, text, place, mistakes):
            return None
        try:
            return dimension_of(expression, lambda name: self.dimensions.get(name.parts), text, place)
        except ApcError as error:
            mistakes.take(error)
            return None

    def _check_names(self, expression: Expr, text: str, place: Place, mistakes: Mistakes) -> bool:
        wrong = False
        for node in walk(expression):
            if isinstance(node, Name) and node.parts not in self.dimensions:
                wrong = True
                shown = ".".join(node.parts)
                if node.parts[0] == OTHERS:
                    what = f"{self.component.name} sends nothing called {brief('.'.join(node.parts[1:]))}"
                    mistakes.add(
                        "E303", place_in(place, text, node.start), what, hint="sends: {x: sample(object.x)}"
                    )
                    continue
                known = sorted(".".join(parts) for parts in self.dimensions)
                what = f"{self.component.name} has no {brief(shown)}"
                add_unknown("E303", place_in(place, text, node.start), what, shown, known, mistakes)
        return wrong


def visible_names(component: Component) -> Iterator[tuple[tuple[str, ...], Dimension]]:
    """Yield what may be named of a component from outside: its variables and its connectors' potentials."""
    for variable in component.variables:
        yield (variable.name,), variable.unit.dimension
    for name, dimension in component.locals:
        yield (name,), dimension
    for name, connector in component.connectors:
        for potential in connector.potentials:
            yield (name, potential.name), potential.unit.dimension
    for inner in component.inner:
        for path, dimension in visible_names(inner.component):
            yield (inner.name, *path), dimension


def _known(dimension: Dimension | None) -> Dimension:
    """Return a dimension that was inferred; what fits every dimension, such as 0, has none."""
    return DIMENSIONLESS if dimension in (None, ANY) else dimension


def _check_balance(component: Component, mistakes: Mistakes) -> None:
    passed = {connector for connector, _, _ in component.passed}
    flows = [
        f"{name}.{flow.name}"
        for name, connector in component.connectors
        if name not in passed
        for flow in connector.flows
    ]
    unknowns = [variable.name for variable in component.variables]
    unknowns += [name for name, _ in component.locals] + flows
    if len(component.equations) == len(unknowns):
        return
    mistakes.add(
        "E501",
        component.place,
        f"{component.name} is unbalanced: {counted(len(component.equations), 'equation')} for "
        f"{counted(len(unknowns), 'unknown')} ({', '.join(unknowns) or 'none'})",
        hint="one equation for each variable and one for each flow of a connector",
    )


def _check_distinct(
    connectors: tuple[tuple[str, Connector], ...],
    parameters: tuple[Parameter, ...],
    variables: tuple[Variable, ...],
    mistakes: Mistakes,
) -> None:
    seen = {name for name, _ in connectors}
    for item in (*parameters, *variables):
        if item.name in seen:
            mistakes.add("E205", item.place, f"the name {item.name} is used twice in this component")
        if item.name in RESERVED:
            mistakes.add("E205", item.place, f"{item.name} is a word of the language and can't be a name")
        seen.add(item.name)


def _connectors(
    node: Node | None, library: Definitions, mistakes: Mistakes
) -> tuple[tuple[str, Connector], ...]:
    found = []
    for key, value in entries(
        read_mapping(node, "connectors", mistakes, hint="connectors: {flange: Flange}")
    ):
        name = read_name(key, "a connector", mistakes)
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
    return tuple(found)
