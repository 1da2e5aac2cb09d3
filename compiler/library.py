"""Component and connector definitions: YAML text to typed data, checked once per component.

Takes: YAML sources of a library folder. Gives: `Library`, which hands out `Component`s by name.
Guarantees: every name in an equation is declared, every equation's units agree, and a component has as
many equations as it must have; a component that breaks this is never handed out.
Does not: know any topology, or which component is used where.

A component is locally balanced in Modelica's sense (Modelica Language Specification 3.6, section 4.8): it
gives one equation for each of its variables and one for each flow of its connectors; the connections of a
scene give the rest.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from apc.compiler.dimensions import ANY, SECOND, check_equation, dimension_of
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.expression import (
    Call,
    Compare,
    Equation,
    Expr,
    Name,
    parse_equation,
    parse_expression,
    transform,
    walk,
)
from apc.compiler.expression import Number as Literal
from apc.compiler.reading import (
    add_unknown,
    brief,
    check_keys,
    entries,
    form,
    read_mapping,
    read_name,
    read_text,
)
from apc.compiler.source import (
    Mapping,
    Node,
    Scalar,
    Sequence,
    Source,
    parse_source,
    place_in,
    read_source,
)
from apc.compiler.units import DIMENSIONLESS, Dimension, Unit, parse_quantity, parse_unit, quantity

REFERENCES = ("clock", "link")
RESERVED = frozenset({"peers", "others", "time", "ground", "type", "at", "shared", "count"})
_TRUE = Compare("==", Literal(Fraction(1)), Literal(Fraction(1)))
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\Z")


@dataclass(frozen=True, slots=True)
class Variable:
    """A variable of a component or connector; `start` is None for one that needs no start value."""

    name: str
    unit: Unit
    start: Fraction | None
    about: str
    place: Place


@dataclass(frozen=True, slots=True)
class Connector:
    """A connector type: potentials are equal where connectors meet, flows sum to zero."""

    name: str
    about: str
    potentials: tuple[Variable, ...]
    flows: tuple[Variable, ...]


@dataclass(frozen=True, slots=True)
class Number:
    """A parameter that is a number, in SI; with `divided`, a shared part divides it among the peers.

    `words` gives names to values, such as left: -1.
    """

    name: str
    unit: Unit
    default: Fraction | None
    minimum: Fraction | None
    open_minimum: bool
    maximum: Fraction | None
    divided: bool
    words: tuple[tuple[str, Fraction], ...]
    about: str
    place: Place


@dataclass(frozen=True, slots=True)
class Option:
    """A parameter that is a word, decided when the scene is compiled."""

    name: str
    words: tuple[str, ...]
    default: str | None
    about: str
    place: Place


@dataclass(frozen=True, slots=True)
class Reference:
    """A parameter that names a clock or a link of the scene; `target` says which of the two."""

    name: str
    target: str
    about: str
    place: Place


Parameter = Number | Option | Reference


@dataclass(frozen=True, slots=True)
class Send:
    """A value that a component sends to the other peers over its link."""

    name: str
    expression: Expr
    text: str
    place: Place
    unit_dimension: Dimension


@dataclass(frozen=True, slots=True)
class Component:
    """A component, whole: what it declares and its equations, in its own names.

    `locals` are names that stand alone on the left of an equation without being declared; they take the
    dimension of the right-hand side.
    """

    name: str
    about: str
    source: str
    connectors: tuple[tuple[str, Connector], ...]
    parameters: tuple[Parameter, ...]
    variables: tuple[Variable, ...]
    locals: tuple[tuple[str, Dimension], ...]
    sends: tuple[Send, ...]
    equations: tuple[Equation, ...]
    place: Place

    def parameter(self, name: str) -> Parameter | None:
        """Return the parameter of this name, or None."""
        return next((parameter for parameter in self.parameters if parameter.name == name), None)

    def variable(self, name: str) -> Variable | None:
        """Return the declared variable of this name, or None."""
        return next((variable for variable in self.variables if variable.name == name), None)

    @property
    def hears_others(self) -> bool:
        """Whether an equation reads the other peers."""
        return any(
            isinstance(node, Name) and node.parts[0] == "others"
            for equation in self.equations
            for side in (equation.left, equation.right)
            for node in walk(side)
        )


class Library:
    """Hands out components by name, each read and checked when it is first asked for.

    Folders are searched in order; the built-in library comes last. In the built-in library a component's
    file has its name in kebab case, so that a scene reads only the files it needs.
    """

    def __init__(self, folders: tuple[Path, ...] = ()) -> None:
        self._sources: dict[str, Source] = {}
        self._texts: dict[str, str] = {}
        self._components: dict[str, Component] = {}
        self._connectors: dict[str, Connector] = {}
        self._files: dict[str, Path] = {}
        for path in _builtin_files():
            self._files["".join(word.capitalize() for word in path.stem.split("-"))] = path
        for folder in folders:
            for path in sorted(folder.rglob("*.yaml")):
                source = read_source(path)
                name = _title(source)
                if name:
                    self._files[name] = path
                    self._sources[name] = source

    @property
    def names(self) -> tuple[str, ...]:
        """The names of everything that can be asked for."""
        return tuple(sorted(self._files))

    @property
    def component_names(self) -> tuple[str, ...]:
        """The names of the components among them."""
        return tuple(name for name in self.names if _is_definition(self._source(name), "component"))

    @property
    def texts(self) -> tuple[tuple[str, str], ...]:
        """The name and SHA-256 of each text handed out so far."""
        return tuple(sorted(self._texts.items()))

    def component(self, name: str) -> Component | None:
        """Return a component, or None if there is no such name. Raises ApcError if its text is at fault."""
        if name not in self._files:
            return None
        if name not in self._components:
            source = self._source(name)
            if not _is_definition(source, "component"):
                return None
            self._components[name] = read_component(source, self)
        return self._components[name]

    def connector(self, name: str) -> Connector | None:
        """Return a connector type, or None if there is no such name."""
        if name not in self._files:
            return None
        if name not in self._connectors:
            source = self._source(name)
            if not _is_definition(source, "connector"):
                return None
            self._connectors[name] = read_connector(source)
        return self._connectors[name]

    def _source(self, name: str) -> Source:
        if name not in self._sources:
            path = self._files[name]
            self._sources[name] = parse_source(path.read_bytes(), file=path.name, path=path)
        self._texts[name] = self._sources[name].digest
        return self._sources[name]


@functools.cache
def _builtin_files() -> tuple[Path, ...]:
    root = Path(__file__).resolve().parent
    # Beside the compiler in a checkout and in an installed package alike.
    models = root.parent / "models"
    return tuple(
        path for path in sorted(models.rglob("*.yaml")) if "scenes" not in path.relative_to(models).parts
    )


def _title(source: Source) -> str | None:
    if isinstance(source.root, Mapping):
        for kind in ("component", "connector"):
            node = source.root.get(kind)
            if isinstance(node, Scalar):
                return node.text
    return None


def _is_definition(source: Source, kind: str) -> bool:
    return isinstance(source.root, Mapping) and source.root.get(kind) is not None


def read_connector(source: Source) -> Connector:
    """Read a connector definition. Raises ApcError with all its mistakes."""
    mistakes = Mistakes()
    root = read_mapping(source.root, "a connector definition", mistakes)
    mistakes.raise_if_any()
    assert root is not None
    root = check_keys(root, ("connector", "about", "source", "potentials", "flows"), "a connector", mistakes)
    potentials = _variables(root.get("potentials"), mistakes)
    flows = _variables(root.get("flows"), mistakes)
    name = read_text(root.get("connector"), "connector", mistakes) or ""
    about = read_text(root.get("about"), "about", mistakes) or ""
    mistakes.raise_if_any()
    return Connector(name, about, potentials, flows)


COMPONENT_KEYS = (
    "component",
    "about",
    "source",
    "connectors",
    "parameters",
    "variables",
    "sends",
    "equations",
)


def read_component(source: Source, library: Library) -> Component:
    """Read and check a component definition. Raises ApcError with all its mistakes."""
    mistakes = Mistakes()
    root = read_mapping(source.root, "a component definition", mistakes)
    mistakes.raise_if_any()
    assert root is not None
    root = check_keys(root, COMPONENT_KEYS, "a component", mistakes)
    title = root.get("component")
    name = read_name(title, "a component", mistakes) if isinstance(title, Scalar) else None
    connectors = _connectors(root.get("connectors"), library, mistakes)
    parameters = _parameters(root.get("parameters"), mistakes)
    variables = _variables(root.get("variables"), mistakes)
    equations = _equations(root.get("equations"), mistakes)
    sends = _sends(root.get("sends"), mistakes)
    about = read_text(root.get("about"), "about", mistakes) or ""
    cited = read_text(root.get("source"), "source", mistakes) or ""
    _check_distinct(connectors, parameters, variables, mistakes)
    mistakes.raise_if_any()
    assert name is not None
    place = title.place if title is not None else root.place
    draft = Component(name, about, cited, connectors, parameters, variables, (), (), equations, place)
    scope = _Scope(draft, sends)
    component = Component(
        name,
        about,
        cited,
        connectors,
        parameters,
        variables,
        scope.infer_locals(mistakes),
        scope.infer_sends(mistakes),
        equations,
        place,
    )
    mistakes.raise_if_any()
    scope.check(mistakes)
    mistakes.raise_if_any()
    _check_balance(component, mistakes)
    mistakes.raise_if_any()
    return component


class _Scope:
    """Resolves a component's names to dimensions, and finds the locals on the way."""

    def __init__(self, component: Component, sends: tuple[tuple[str, Expr, str, Place], ...]) -> None:
        self.component = component
        self.sends = sends
        self.dimensions: dict[tuple[str, ...], Dimension | None] = {
            ("peers",): DIMENSIONLESS,
            ("time",): SECOND,
        }
        for variable in component.variables:
            self.dimensions[(variable.name,)] = variable.unit.dimension
        for parameter in component.parameters:
            if isinstance(parameter, Number):
                self.dimensions[(parameter.name,)] = parameter.unit.dimension
                for word, _ in parameter.words:
                    self.dimensions.setdefault((word,), parameter.unit.dimension)
        for name, connector in component.connectors:
            for variable in (*connector.potentials, *connector.flows):
                self.dimensions[(name, variable.name)] = variable.unit.dimension

    def infer_sends(self, mistakes: Mistakes) -> tuple[Send, ...]:
        """Return the sends with the dimension of what they send."""
        found = []
        for name, expression, text, place in self.sends:
            dimension = self._dimension(expression, text, place, mistakes)
            found.append(Send(name, expression, text, place, _known(dimension)))
        return tuple(found)

    def infer_locals(self, mistakes: Mistakes) -> tuple[tuple[str, Dimension], ...]:
        """Return the undeclared names that stand alone on the left of an equation."""
        for name, expression, text, place in self.sends:
            self.dimensions[("others", name)] = self._dimension(expression, text, place, Mistakes())
        found: list[tuple[str, Dimension]] = []
        for equation in self.component.equations:
            left = equation.left
            if isinstance(left, Name) and len(left.parts) == 1 and left.parts not in self.dimensions:
                # An unknown name on the right is reported once, by `check`; a local may still be undecided.
                dimension = self._dimension(equation.right, equation.text, equation.place, Mistakes())
                self.dimensions[left.parts] = dimension
                found.append((left.parts[0], _known(dimension)))
        return tuple(found)

    def check(self, mistakes: Mistakes) -> None:
        """Check the names, then the units, of every equation."""
        for equation in self.component.equations:
            unknown = False
            left, right = self._decided(equation.left), self._decided(equation.right)
            for side in (left, right):
                unknown |= self._check_names(side, equation.text, equation.place, mistakes)
            if not unknown:
                try:
                    check_equation(
                        Equation(left, right, equation.text, equation.place),
                        lambda name: self.dimensions.get(name.parts),
                    )
                except ApcError as error:
                    mistakes.take(error)

    def _decided(self, expression: Expr) -> Expr:
        """Return the expression with each test of an option replaced by a true statement.

        Both branches of such a test are checked; the words of an option have no dimension.
        """
        options = {
            parameter.name: parameter
            for parameter in self.component.parameters
            if isinstance(parameter, Option)
        }
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
                known = sorted(".".join(parts) for parts in self.dimensions)
                what = f"{self.component.name} has no {brief(shown)}"
                add_unknown("E303", place_in(place, text, node.start), what, shown, known, mistakes)
        return wrong


def _known(dimension: Dimension | None) -> Dimension:
    """Return a dimension that was inferred; what fits every dimension, such as 0, has none."""
    return DIMENSIONLESS if dimension in (None, ANY) else dimension


def option_test(node: Expr, options: dict[str, Option]) -> tuple[Option, str] | None:
    """Return the option and the word that a comparison such as `delays == all` is about."""
    if (
        isinstance(node, Compare)
        and node.operator in ("==", "!=")
        and isinstance(node.left, Name)
        and isinstance(node.right, Name)
        and len(node.left.parts) == len(node.right.parts) == 1
    ):
        option = options.get(node.left.parts[0])
        if option is not None and node.right.parts[0] in option.words:
            return option, node.right.parts[0]
    return None


def _check_balance(component: Component, mistakes: Mistakes) -> None:
    flows = [f"{name}.{flow.name}" for name, connector in component.connectors for flow in connector.flows]
    unknowns = [variable.name for variable in component.variables]
    unknowns += [name for name, _ in component.locals] + flows
    if len(component.equations) == len(unknowns):
        return
    mistakes.add(
        "E501",
        component.place,
        f"{component.name} is unbalanced: {_counted(len(component.equations), 'equation')} for "
        f"{_counted(len(unknowns), 'unknown')} ({', '.join(unknowns) or 'none'})",
        hint="one equation for each variable and one for each flow of a connector",
    )


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" + ("" if number == 1 else "s")


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


def _connectors(node: Node | None, library: Library, mistakes: Mistakes) -> tuple[tuple[str, Connector], ...]:
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


def _equations(node: Node | None, mistakes: Mistakes) -> tuple[Equation, ...]:
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


def text_place(node: Node) -> Place:
    """Return where a scalar's text starts: behind the opening quote, if it has one."""
    quoted = isinstance(node, Scalar) and not node.plain
    return node.place.shifted(1) if quoted else node.place


def _sends(node: Node | None, mistakes: Mistakes) -> tuple[tuple[str, Expr, str, Place], ...]:
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


def _variables(node: Node | None, mistakes: Mistakes) -> tuple[Variable, ...]:
    found = []
    for key, value in entries(read_mapping(node, "variables", mistakes, hint="variables: {x: {unit: m}}")):
        name = read_name(key, "a variable", mistakes)
        body = read_mapping(value, key.text, mistakes, hint=f"{key.text}: {{unit: m}}")
        if name is None or body is None:
            continue
        body = check_keys(body, ("unit", "start", "about"), f"variable {name}", mistakes)
        unit = _unit(body, name, mistakes)
        start = _declared(body.get("start"), name, unit, mistakes)
        about = read_text(body.get("about"), "about", mistakes) or ""
        if unit is not None:
            found.append(Variable(name, unit, start, about, key.place))
    return tuple(found)


def _parameters(node: Node | None, mistakes: Mistakes) -> tuple[Parameter, ...]:
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
            parameter = _option(name, body, mistakes) if _has_words(body) else _number(name, body, mistakes)
        if parameter is not None:
            found.append(parameter)
    return tuple(found)


def _has_words(body: Mapping) -> bool:
    return isinstance(body.get("options"), Sequence)


def _reference(name: str, value: Scalar, mistakes: Mistakes) -> Reference | None:
    if value.text in REFERENCES:
        return Reference(name, value.text, "", value.place)
    mistakes.add(
        "E203",
        value.place,
        f"parameter {name}",
        expected="clock, link, or a mapping with its unit",
        got=brief(value.text) or "nothing",
        hint=f"{name}: {{unit: N/m, min: 0}}",
    )
    return None


def _option(name: str, body: Mapping, mistakes: Mistakes) -> Option | None:
    body = check_keys(body, ("options", "default", "about"), f"parameter {name}", mistakes)
    options = body.get("options")
    assert isinstance(options, Sequence)
    words = tuple(item.text for item in options.items if isinstance(item, Scalar))
    default = read_text(body.get("default"), "default", mistakes)
    node = body.get("default")
    if default is not None and node is not None and default not in words:
        what = f"{name} has no option {brief(default)}"
        add_unknown("E206", node.place, what, default, words, mistakes)
    about = read_text(body.get("about"), "about", mistakes) or ""
    return Option(name, words, default, about, options.place)


def _number(name: str, body: Mapping, mistakes: Mistakes) -> Number | None:
    keys = ("unit", "min", "above", "max", "default", "about", "shared", "options")
    body = check_keys(body, keys, f"parameter {name}", mistakes)
    unit = _unit(body, name, mistakes)
    shared = read_text(body.get("shared"), "shared", mistakes)
    node = body.get("shared")
    if shared not in (None, "divided", "whole") and node is not None:
        mistakes.add("E203", node.place, "shared", expected="divided or whole", got=brief(shared or ""))
    default = _declared(body.get("default"), name, unit, mistakes)
    minimum = _declared(body.get("min"), name, unit, mistakes)
    above = _declared(body.get("above"), name, unit, mistakes)
    maximum = _declared(body.get("max"), name, unit, mistakes)
    words = []
    for key, value in entries(read_mapping(body.get("options"), "options", mistakes)):
        number = _declared(value, key.text, unit, mistakes)
        if number is not None:
            words.append((key.text, number))
    about = read_text(body.get("about"), "about", mistakes) or ""
    if unit is None:
        return None
    return Number(
        name,
        unit,
        default,
        above if above is not None else minimum,
        above is not None,
        maximum,
        shared == "divided",
        tuple(words),
        about,
        body.place,
    )


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


def unknown_component(place: Place, name: str, library: Library, mistakes: Mistakes) -> None:
    """Record that no component has this name."""
    add_unknown(
        "E206", place, f"there is no component {brief(name)}", name, library.component_names, mistakes
    )


def numbers(component: Component) -> Iterator[Number]:
    """Yield the parameters of a component that are numbers."""
    for parameter in component.parameters:
        if isinstance(parameter, Number):
            yield parameter


def calls(expression: Expr, *functions: str) -> Iterator[Call]:
    """Yield the calls of the named functions in an expression."""
    for node in walk(expression):
        if isinstance(node, Call) and node.function in functions:
            yield node
