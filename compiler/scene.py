"""A topology file to a scene: typed, every quantity in SI, every name resolved.

Takes: the YAML source of a topology and a library. Gives: `Scene`.
Guarantees: parts, clocks, links, parameters and connections that are named exist; quantities have the unit
their parameter wants and lie within its bounds; all mistakes of the file are reported together.
Does not: look into a component's equations.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.dimensions import ANY, SECOND, dimension_of
from apc.compiler.errors import ApcError, Mistakes, Place
from apc.compiler.expression import Expr, Name, evaluate, parse_expression, walk
from apc.compiler.library import (
    Component,
    Library,
    Number,
    Option,
    Reference,
    numbers,
    text_place,
    unknown_component,
)
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
from apc.compiler.source import Mapping, Node, Scalar, Sequence, Source, place_in
from apc.compiler.units import DIMENSIONLESS, Dimension, format_dimension, format_si, parse_quantity, quantity

SECTIONS = ("masses", "couplers", "links", "hands")
KEYS = ("topology", "about", "clocks", "parameters", "peers", *SECTIONS, "experiment", "studies")
DEFAULT_TYPES = {"masses": "Mass", "links": "Link"}
LARGEST_COUNT = 10**9
# A quantity starts with a number; what follows is nothing, a unit, or a ratio such as 1/90 s. An operator
# behind the number makes it an expression.
_QUANTITY = re.compile(
    r"[+-]?\s*(\d|\.\d)[\d.]*([eE][+-]?\d+)?(\s*/\s*\d[\d.]*)?\s*([^\W\d_].*|[°%µΩ].*)?\Z", re.DOTALL
)
_WORD_NUMBER = re.compile(r"[+-]?\.?(nan|inf|infinity)\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Value:
    """A number given in the file, in SI; `expression` is its text when it depends on other parameters."""

    number: Fraction
    dimension: Dimension
    expression: str | None
    place: Place


@dataclass(frozen=True, slots=True)
class SceneClock:
    """Ticks at `phase + k*period`, in seconds."""

    name: str
    period: Value
    phase: Value


@dataclass(frozen=True, slots=True)
class Part:
    """An instance of a component at every peer of `groups`.

    `values` holds a value for every number the component declares, `options` and `references` a word for
    every option and reference, `starts` the start values given here; `connections` join a connector of this
    part to (part, connector).
    """

    name: str
    section: str
    component: Component
    values: tuple[tuple[str, Value], ...]
    options: tuple[tuple[str, str], ...]
    references: tuple[tuple[str, str], ...]
    starts: tuple[tuple[str, Value], ...]
    connections: tuple[tuple[str, str, str], ...]
    shared: bool
    groups: tuple[str, ...]
    place: Place

    def reference(self, target: str) -> str | None:
        """Return the clock or link this part names, when it names exactly one."""
        roles = {p.name for p in self.component.parameters if isinstance(p, Reference) and p.target == target}
        named = [word for role, word in self.references if role in roles]
        return named[0] if len(named) == 1 else None


@dataclass(frozen=True, slots=True)
class PeerGroup:
    """`count` peers; `values` are its own settings, by full name such as `contact.stiffness`."""

    name: str
    count: int
    values: tuple[tuple[str, Value], ...]
    place: Place


@dataclass(frozen=True, slots=True)
class Axis:
    """A range of a parameter, in SI, for a study."""

    parameter: str
    low: Fraction
    high: Fraction


@dataclass(frozen=True, slots=True)
class Scene:
    """A topology, whole."""

    name: str
    about: str
    clocks: tuple[SceneClock, ...]
    parameters: tuple[tuple[str, Value], ...]
    groups: tuple[PeerGroup, ...]
    parts: tuple[Part, ...]
    duration: Fraction | None
    seed: int
    region: tuple[Axis, ...]
    place: Place

    @property
    def peers(self) -> int:
        """The number of peers."""
        return sum(group.count for group in self.groups)

    def part(self, name: str) -> Part:
        """Return the part of this name."""
        return next(part for part in self.parts if part.name == name)


def build_scene(source: Source, library: Library) -> Scene:
    """Read a topology. Raises ApcError with every mistake of the file."""
    reader = _Reader(source, library)
    scene = reader.read()
    reader.mistakes.raise_if_any()
    assert scene is not None
    return scene


class _Reader:
    """The state of one reading: what is known so far, and the mistakes."""

    def __init__(self, source: Source, library: Library) -> None:
        self.library = library
        self.mistakes = Mistakes()
        self.source = source
        self.clocks: dict[str, SceneClock] = {}
        self.parameters: dict[str, Value] = {}
        self.bodies: dict[str, tuple[str, Mapping, Component, Place]] = {}
        self.groups: dict[str, int] = {}
        self.faulty: set[str] = set()  # parts that are there but can't be read: reported once, there
        self.missing: set[str] = set()  # sections that are named but not there: reported once

    def read(self) -> Scene | None:
        mistakes = self.mistakes
        root = read_mapping(self.source.root, "a topology", mistakes, hint="topology: my-scene")
        if root is None:
            return None
        root = check_keys(root, KEYS, "a topology", mistakes)
        name = self._required(root, "topology", "topology: my-scene")
        title = read_text(name, "topology", mistakes, hint="topology: my-scene") or ""
        about = read_text(root.get("about"), "about", mistakes) or ""
        peers = self._required(root, "peers", "peers: {user: {count: 3}}")
        group_bodies = self._read_counts(peers)
        if self._required(root, "masses", "masses: {device: {mass: 0.1 kg}}") is None:
            self.missing.add("masses")
        self._read_parameters(root.get("parameters"))
        self._read_clocks(root.get("clocks"))
        for section in SECTIONS:
            self._read_section(section, root.get(section))
        parts = tuple(
            part
            for part_name, (section, body, component, place) in self.bodies.items()
            if (part := self._read_part(part_name, section, body, component, place, root)) is not None
        )
        groups = self._read_groups(group_bodies)
        duration, seed = self._read_experiment(root.get("experiment"))
        region = self._read_studies(root.get("studies"))
        clocks = tuple(self.clocks.values())
        given = tuple(self.parameters.items())
        return Scene(title, about, clocks, given, groups, parts, duration, seed, region, root.place)

    def _required(self, root: Mapping, key: str, hint: str) -> Node | None:
        node = root.get(key)
        if node is None:
            self.mistakes.add(
                "E201",
                root.place,
                f"the topology has no {key}" + ("" if key == "topology" else " section"),
                hint=hint,
            )
        return node

    # ---- values ----

    def _value(
        self,
        node: Node | None,
        what: str,
        dimension: Dimension,
        unit: str,
        *,
        words: Collection[tuple[str, Fraction]] = (),
    ) -> Value | None:
        """Read a quantity, a word that stands for a number, or an expression over the parameters."""
        text = read_text(node, what, self.mistakes, hint=f"{what}: 1 {unit}")
        if node is None or text is None:
            return None
        named = dict(words)
        if text in named:
            return Value(named[text], dimension, None, node.place)
        try:
            if _QUANTITY.match(text) or _WORD_NUMBER.match(text):
                return Value(
                    quantity(text, node.place, what=what, unit=unit).value, dimension, None, node.place
                )
            return self._expression(text, text_place(node), what, dimension, unit)
        except ApcError as error:
            self.mistakes.take(error)
            return None

    def _expression(self, text: str, place: Place, what: str, dimension: Dimension, unit: str) -> Value:
        expression = parse_expression(text, place)
        self._check_names(expression, text, place, what)
        found = dimension_of(expression, self._dimension_of_name, text, place)
        if found not in (None, ANY, dimension) and any(isinstance(n, Name) for n in walk(expression)):
            hint = f"{what}: 1 {unit}"
            mistakes = Mistakes()
            got = f"{brief(text)}, which is in {format_dimension(found or dimension)}"
            mistakes.add("E204", place, what, expected=unit, got=got, hint=hint)
            mistakes.raise_if_any()
        number = evaluate(expression, self._number_of_name, place=place)
        return Value(Fraction(number), dimension, text, place)

    def _check_names(self, expression: Expr, text: str, place: Place, what: str) -> None:
        mistakes = Mistakes()
        for node in walk(expression):
            if isinstance(node, Name) and node.parts[0] not in self.parameters and node.parts != ("peers",):
                shown = ".".join(node.parts)
                known = ("peers", *self.parameters)
                told = f"{what} names {brief(shown)}, which is no parameter of this topology"
                add_unknown("E206", place_in(place, text, node.start), told, shown, known, mistakes)
        mistakes.raise_if_any()

    def _dimension_of_name(self, name: Name) -> Dimension | None:
        if name.parts == ("peers",):
            return DIMENSIONLESS
        return self.parameters[name.parts[0]].dimension

    def _number_of_name(self, parts: tuple[str, ...]) -> Fraction:
        if parts == ("peers",):
            return Fraction(sum(self.groups.values()))
        return self.parameters[parts[0]].number

    def _time(self, node: Node | None, what: str) -> Value | None:
        """Read a duration; a rate in Hz counts as its reciprocal."""
        if isinstance(node, Scalar) and node.text.rstrip().endswith("Hz"):
            rate = self._value(node, what, SECOND.power(Fraction(-1)), "Hz")
            if rate is None:
                return None
            if rate.number == 0:
                self.mistakes.add(
                    "E207", node.place, what, expected="a rate above 0 Hz", got=brief(node.text)
                )
                return None
            return Value(1 / rate.number, SECOND, None, rate.place)
        return self._value(node, what, SECOND, "s")

    # ---- sections ----

    def _read_counts(self, node: Node | None) -> list[tuple[str, Mapping]]:
        bodies = []
        hint = "peers: {user: {count: 3}}"
        section = read_mapping(node, "peers", self.mistakes, hint=hint)
        if section is not None and not section.entries:
            self.mistakes.add("E201", section.place, "peers names no group", hint=hint)
        for key, value in entries(section):
            name = read_name(key, "a group of peers", self.mistakes)
            body = read_mapping(value, key.text, self.mistakes, hint=f"{key.text}: {{count: 3}}")
            if name is None or body is None:
                continue
            body = check_keys(body, ("count", "set"), f"group {name}", self.mistakes)
            count = self._read_count(body, name)
            if count is not None:
                self.groups[name] = count
                bodies.append((name, body))
        return bodies

    def _read_count(self, body: Mapping, name: str) -> int | None:
        node = body.get("count")
        if node is None:
            self.mistakes.add("E201", body.place, f"group {name} has no count", hint="count: 3")
            return None
        if (
            isinstance(node, Scalar)
            and node.plain
            and isinstance(node.value, int)
            and not isinstance(node.value, bool)
            and 1 <= node.value <= LARGEST_COUNT
        ):
            return node.value
        self.mistakes.add(
            "E208",
            node.place,
            "count",
            expected=f"a whole number from 1 to {LARGEST_COUNT}",
            got=form(node),
            hint="count: 3",
        )
        return None

    def _read_parameters(self, node: Node | None) -> None:
        section = read_mapping(node, "parameters", self.mistakes, hint="parameters: {kt: 2000 N/m}")
        waiting: dict[str, tuple[str, Place]] = {}
        for key, value in entries(section):
            name = read_name(key, "a parameter", self.mistakes)
            text = read_text(value, key.text, self.mistakes, hint=f"{key.text}: 2000 N/m")
            if name is None or text is None:
                continue
            if name in ("peers", "time", "others", "ground"):
                self.mistakes.add("E205", key.place, f"{name} is a word of the language and can't be a name")
            elif _QUANTITY.match(text) or _WORD_NUMBER.match(text):
                try:
                    found = parse_quantity(text, value.place)
                    self.parameters[name] = Value(found.value, found.unit.dimension, None, value.place)
                except ApcError as error:
                    self.mistakes.take(error)
            else:
                waiting[name] = (text, text_place(value))
        self._resolve_parameters(waiting)

    def _resolve_parameters(self, waiting: dict[str, tuple[str, Place]]) -> None:
        """Evaluate parameters that depend on parameters, in the order in which they can be known."""
        trees: dict[str, Expr] = {}
        for name, (text, place) in waiting.items():
            try:
                trees[name] = parse_expression(text, place)
            except ApcError as error:
                self.mistakes.take(error)
        while trees:
            ready = [name for name, tree in trees.items() if not self._needs(tree, trees)]
            if not ready:
                chain = _cycle({name: self._needs(tree, trees) for name, tree in trees.items()})
                self.mistakes.add(
                    "E209", waiting[chain[0]][1], f"parameters depend in a circle: {' → '.join(chain)}"
                )
                return
            for name in ready:
                tree = trees.pop(name)
                text, place = waiting[name]
                try:
                    self._check_names(tree, text, place, name)
                    dimension = dimension_of(tree, self._dimension_of_name, text, place)
                    number = Fraction(evaluate(tree, self._number_of_name, place=place))
                    self.parameters[name] = Value(
                        number, DIMENSIONLESS if dimension in (None, ANY) else dimension, text, place
                    )
                except ApcError as error:
                    self.mistakes.take(error)

    @staticmethod
    def _needs(tree: Expr, waiting: Collection[str]) -> list[str]:
        return [node.parts[0] for node in walk(tree) if isinstance(node, Name) and node.parts[0] in waiting]

    def _read_clocks(self, node: Node | None) -> None:
        section = read_mapping(node, "clocks", self.mistakes, hint="clocks: {haptic: 1 ms}")
        for key, value in entries(section):
            name = read_name(key, "a clock", self.mistakes)
            if name is None:
                continue
            phase: Value | None = Value(Fraction(0), SECOND, None, value.place)
            if isinstance(value, Mapping):
                body = check_keys(value, ("period", "phase"), f"clock {name}", self.mistakes)
                period = self._time(body.get("period"), "period")
                if body.get("period") is None:
                    self.mistakes.add("E201", body.place, f"clock {name} has no period", hint="period: 1 ms")
                if body.get("phase") is not None:
                    phase = self._time(body.get("phase"), "phase")
            else:
                period = self._time(value, name)
            if period is None or phase is None:
                continue
            if period.number <= 0:
                self.mistakes.add(
                    "E207",
                    period.place,
                    f"the period of clock {name}",
                    expected="more than 0 s",
                    got=_shown(period),
                    hint=f"{name}: 1 ms",
                )
            elif not 0 <= phase.number < period.number:
                self.mistakes.add(
                    "E207",
                    phase.place,
                    f"the phase of clock {name}",
                    expected="0 s or more and less than its period",
                    got=_shown(phase),
                )
            else:
                self.clocks[name] = SceneClock(name, period, phase)

    def _read_section(self, section: str, node: Node | None) -> None:
        """Collect the parts of a section and their components, so that names can be resolved."""
        example = {"masses": "device: {mass: 0.1 kg}", "links": "lan: {clock: network}"}
        hint = f"{section}: {{{example.get(section, 'name: {type: …}')}}}"
        for key, value in entries(read_mapping(node, section, self.mistakes, hint=hint)):
            name = read_name(key, f"a part of {section}", self.mistakes)
            body = read_mapping(
                value, key.text, self.mistakes, hint=example.get(section, f"{key.text}: {{type: …}}")
            )
            if name is not None:
                self.faulty.add(name)  # until it has been read
            if name is None or body is None:
                continue
            if name in self.bodies or name in self.clocks or name in self.parameters or name in self.groups:
                self.mistakes.add("E205", key.place, f"the name {name} is used twice in this topology")
                continue
            type_node = body.get("type")
            type_name = (
                DEFAULT_TYPES.get(section)
                if type_node is None
                else read_text(type_node, "type", self.mistakes)
            )
            if type_node is None and type_name is None:
                self.mistakes.add("E201", key.place, f"{name} has no type", hint="type: SampledSpringDamper")
            if type_name is None:
                continue
            try:
                component = self.library.component(type_name)
            except ApcError as error:
                self.mistakes.take(error)
                continue
            if component is None:
                place = type_node.place if type_node is not None else key.place
                unknown_component(place, type_name, self.library, self.mistakes)
                continue
            self.bodies[name] = (section, body, component, key.place)
            self.faulty.discard(name)

    def _read_part(
        self, name: str, section: str, body: Mapping, component: Component, place: Place, root: Mapping
    ) -> Part | None:
        connectors = dict(component.connectors)
        names = [p.name for p in component.parameters]
        variables = [v.name for v in component.variables if v.start is not None]
        allowed = ("type", "at", "shared", *connectors, *names, *variables)
        body = check_keys(body, allowed, f"{name} ({component.name})", self.mistakes)
        values: list[tuple[str, Value]] = []
        options: list[tuple[str, str]] = []
        references: list[tuple[str, str]] = []
        for parameter in component.parameters:
            node = body.get(parameter.name)
            if isinstance(parameter, Number):
                value = self._number(name, parameter, node, place)
                if value is not None:
                    values.append((parameter.name, value))
            elif isinstance(parameter, Option):
                word = self._option(name, parameter, node, place)
                if word is not None:
                    options.append((parameter.name, word))
            else:
                target = self._reference(name, parameter, node, place, root)
                if target is not None:
                    references.append((parameter.name, target))
        starts = [
            (variable.name, value)
            for variable in component.variables
            if variable.start is not None
            and (
                value := self._value(
                    body.get(variable.name), variable.name, variable.unit.dimension, variable.unit.text
                )
            )
        ]
        connections = [
            found
            for connector, type_ in component.connectors
            if (found := self._connection(name, connector, type_.name, body.get(connector), section, place))
        ]
        shared = self._shared(name, component, body.get("shared"))
        groups = self._groups_of(name, body.get("at"))
        peers = sum(self.groups.get(group, 0) for group in groups)
        if component.hears_others and peers == 1:
            self.mistakes.add(
                "E208",
                place,
                f"{name} ({component.name}) follows the other peers and",
                expected="at least 2 peers",
                got="1",
                hint="count: 2",
            )
        return Part(
            name,
            section,
            component,
            tuple(values),
            tuple(options),
            tuple(references),
            tuple(starts),
            tuple(connections),
            shared,
            groups,
            place,
        )

    def _number(self, part: str, parameter: Number, node: Node | None, place: Place) -> Value | None:
        dimension = parameter.unit.dimension
        if node is None:
            if parameter.default is not None:
                return Value(parameter.default, dimension, None, place)
            hint = f"{parameter.name}: 1 {parameter.unit.text}"
            self.mistakes.add("E201", place, f"{part} has no {parameter.name}", hint=hint)
            return None
        value = self._value(node, parameter.name, dimension, parameter.unit.text, words=parameter.words)
        if value is not None:
            self._check_bounds(parameter, value)
        return value

    def _check_bounds(self, parameter: Number, value: Value) -> None:
        unit = parameter.unit.text
        number = value.number / parameter.unit.scale
        minimum, maximum = parameter.minimum, parameter.maximum
        expected = ""
        if minimum is not None and (
            value.number < minimum or (parameter.open_minimum and value.number == minimum)
        ):
            least = _plain(minimum / parameter.unit.scale)
            expected = f"more than {least} {unit}" if parameter.open_minimum else f"{least} {unit} or more"
        elif maximum is not None and value.number > maximum:
            expected = f"{_plain(maximum / parameter.unit.scale)} {unit} or less"
        if expected:
            self.mistakes.add(
                "E207", value.place, parameter.name, expected=expected, got=f"{_plain(number)} {unit}"
            )

    def _option(self, part: str, parameter: Option, node: Node | None, place: Place) -> str | None:
        if node is None:
            if parameter.default is None:
                hint = f"{parameter.name}: {parameter.words[0]}"
                self.mistakes.add("E201", place, f"{part} has no {parameter.name}", hint=hint)
            return parameter.default
        word = read_text(node, parameter.name, self.mistakes, hint=f"{parameter.name}: {parameter.words[0]}")
        if word is None or word in parameter.words:
            return word
        self.mistakes.add(
            "E206",
            node.place,
            parameter.name,
            expected=" or ".join(parameter.words),
            got=brief(word),
            hint=f"{parameter.name}: {parameter.default or parameter.words[0]}",
        )
        return None

    def _reference(
        self, part: str, parameter: Reference, node: Node | None, place: Place, root: Mapping
    ) -> str | None:
        known: Collection[str] = (
            self.clocks
            if parameter.target == "clock"
            else [n for n, b in self.bodies.items() if b[0] == "links"]
        )
        section = parameter.target + "s"
        if node is None:
            hint = f"{parameter.name}: {next(iter(known), 'name')}"
            self.mistakes.add("E201", place, f"{part} has no {parameter.name}", hint=hint)
            return None
        word = read_text(node, parameter.name, self.mistakes)
        if word is None or word in known:
            return word
        if root.get(section) is None:
            if section not in self.missing:
                self.missing.add(section)
                example = "1 ms" if section == "clocks" else "{clock: network}"
                self._required(root, section, f"{section}: {{{brief(word)}: {example}}}")
        elif not self._may_be_in(root.get(section), word):  # a faulty clock or link was reported there
            what = f"{part} names {parameter.target} {brief(word)}, which isn't in {section}"
            add_unknown("E206", node.place, what, word, list(known), self.mistakes)
        return None

    @staticmethod
    def _may_be_in(section: Node | None, word: str) -> bool:
        return not isinstance(section, Mapping) or section.get(word) is not None

    def _connection(
        self, part: str, connector: str, type_name: str, node: Node | None, section: str, place: Place
    ) -> tuple[str, str, str] | None:
        if node is None:
            if section != "masses":
                candidates = [n for n, b in self.bodies.items() if b[0] == "masses"]
                hint = f"{connector}: {candidates[0] if candidates else 'device'}"
                self.mistakes.add(
                    "E210", place, f"{part} does not say what its {connector} is joined to", hint=hint
                )
            return None
        text = read_text(node, connector, self.mistakes, hint=f"{connector}: device")
        if text is None:
            return None
        other, _, its_connector = text.partition(".")
        if other in self.faulty:
            return None
        if other not in self.bodies:
            if "masses" in self.missing:
                return None  # one missing section is one mistake
            what = f"{part} joins its {connector} to {brief(other)}, which is no part of this topology"
            add_unknown("E206", node.place, what, other, [n for n in self.bodies if n != part], self.mistakes)
            return None
        component = self.bodies[other][2]
        fitting = [name for name, type_ in component.connectors if type_.name == type_name]
        if its_connector in fitting:
            return connector, other, its_connector
        if not its_connector and len(fitting) == 1:
            return connector, other, fitting[0]
        if its_connector:
            what = f"{other} ({component.name}) has no {type_name} called {brief(its_connector)}"
            add_unknown("E206", node.place, what, its_connector, fitting, self.mistakes)
        elif fitting:
            self.mistakes.add(
                "E210",
                node.place,
                f"{other} ({component.name}) has {len(fitting)} connectors of type {type_name}",
                hint=f"{connector}: {other}.{fitting[0]}",
            )
        else:
            self.mistakes.add(
                "E210",
                node.place,
                f"{other} ({component.name}) has no connector of type {type_name} to join {connector} to",
            )
        return None

    def _shared(self, name: str, component: Component, node: Node | None) -> bool:
        if node is None:
            return False
        if not (isinstance(node, Scalar) and node.plain and isinstance(node.value, bool)):
            self.mistakes.add(
                "E203", node.place, "shared", expected="true or false", got=form(node), hint="shared: true"
            )
            return False
        if node.value and not any(parameter.divided for parameter in numbers(component)):
            self.mistakes.add(
                "E210", node.place, f"{name} can't be shared: nothing of a {component.name} is divided"
            )
        return node.value

    def _groups_of(self, name: str, node: Node | None) -> tuple[str, ...]:
        if node is None:
            return tuple(self.groups)
        if not isinstance(node, Sequence):
            self.mistakes.add(
                "E203", node.place, "at", expected="a list of groups", got=form(node), hint="at: [user]"
            )
            return ()
        found = []
        for item in node.items:
            group = read_text(item, "a group", self.mistakes)
            if group in self.groups:
                found.append(group)
            elif group is not None:
                what = f"{name} is at {brief(group)}, which is no group of peers"
                add_unknown("E206", item.place, what, group, list(self.groups), self.mistakes)
        return tuple(found)

    def _read_groups(self, bodies: list[tuple[str, Mapping]]) -> tuple[PeerGroup, ...]:
        found = []
        for name, body in bodies:
            values = []
            section = read_mapping(body.get("set"), "set", self.mistakes, hint="set: {device.mass: 0.2 kg}")
            for key, node in entries(section):
                value = self._setting(key, node)
                if value is not None:
                    values.append((key.text, value))
            found.append(PeerGroup(name, self.groups[name], tuple(values), body.place))
        return tuple(found)

    def _setting(self, key: Scalar, node: Node) -> Value | None:
        part, _, name = key.text.partition(".")
        known = [f"{p}.{n}" for p, body in self.bodies.items() for n in _settable(body[2])]
        if part in self.faulty:
            return None
        if key.text not in known:
            what = f"set names {brief(key.text)}, which is no parameter or variable of a part"
            add_unknown("E206", key.place, what, key.text, known, self.mistakes)
            return None
        component = self.bodies[part][2]
        parameter = component.parameter(name)
        if isinstance(parameter, Number):
            value = self._value(
                node, key.text, parameter.unit.dimension, parameter.unit.text, words=parameter.words
            )
            if value is not None:
                self._check_bounds(parameter, value)
            return value
        variable = component.variable(name)
        assert variable is not None
        return self._value(node, key.text, variable.unit.dimension, variable.unit.text)

    def _read_experiment(self, node: Node | None) -> tuple[Fraction | None, int]:
        section = read_mapping(node, "experiment", self.mistakes, hint="experiment: {duration: 3 s}")
        if section is None:
            return None, 0
        section = check_keys(section, ("duration", "seed"), "experiment", self.mistakes)
        duration = self._time(section.get("duration"), "duration")
        if duration is not None and duration.number <= 0:
            self.mistakes.add(
                "E207", duration.place, "duration", expected="more than 0 s", got=_shown(duration)
            )
        seed = section.get("seed")
        number = 0
        if isinstance(seed, Scalar) and isinstance(seed.value, int) and 0 <= seed.value < 2**63:
            number = int(seed.value)
        elif seed is not None:
            self.mistakes.add(
                "E203", seed.place, "seed", expected="a whole number, 0 or more", got=form(seed)
            )
        return (duration.number if duration is not None else None), number

    def _read_studies(self, node: Node | None) -> tuple[Axis, ...]:
        section = read_mapping(node, "studies", self.mistakes)
        if section is None:
            return ()
        section = check_keys(section, ("region",), "studies", self.mistakes)
        region = read_mapping(section.get("region"), "region", self.mistakes)
        if region is None:
            return ()
        region = check_keys(region, ("x", "y"), "region", self.mistakes)
        return tuple(axis for key in ("x", "y") if (axis := self._axis(key, region.get(key))) is not None)

    def _axis(self, key: str, node: Node | None) -> Axis | None:
        hint = f"{key}: {{contact.stiffness: [0 N/m, 5000 N/m]}}"
        body = read_mapping(node, key, self.mistakes, hint=hint)
        if body is None or len(body.entries) != 1:
            if body is not None:
                self.mistakes.add("E203", body.place, key, expected="one parameter and its range", hint=hint)
            return None
        name, span = body.entries[0]
        if not (isinstance(span, Sequence) and len(span.items) == 2):
            self.mistakes.add(
                "E203", span.place, name.text, expected="a list of two values", got=form(span), hint=hint
            )
            return None
        low, high = (self._setting(name, item) for item in span.items)
        if low is None or high is None:
            return None
        if low.number >= high.number:
            self.mistakes.add(
                "E207",
                span.place,
                f"the range of {name.text}",
                expected="its lower end first",
                got=f"{_shown(low)} to {_shown(high)}",
            )
            return None
        return Axis(name.text, low.number, high.number)


def _settable(component: Component) -> list[str]:
    return [p.name for p in numbers(component)] + [v.name for v in component.variables if v.start is not None]


def _shown(value: Value) -> str:
    return format_si(float(value.number), value.dimension)


def _plain(number: Fraction) -> str:
    return f"{float(number):.12g}"


def _cycle(needs: dict[str, list[str]]) -> list[str]:
    """Return a circle in a graph in which every node needs another, its first node repeated at the end."""
    path: list[str] = []
    name = next(iter(needs))
    while name not in path:
        path.append(name)
        name = needs[name][0]
    return [*path[path.index(name) :], name]
