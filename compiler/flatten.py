"""A scene to equations: per kind of peer, the scalar equations after connection.

Takes: `Scene`. Gives: `FlatSystem`.
Guarantees: peers of one structure share one `FlatKind`, whatever their numbers and their count; every name
is whole (`contact.a.x`); potentials that meet are equal, flows that meet sum to zero; options are decided.
Does not: put a number in the place of a parameter, or look at clocks beyond naming them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.errors import Mistakes, Place
from apc.compiler.expression import (
    Binary,
    Call,
    Conditional,
    Expr,
    Name,
    Number,
    format_expression,
    transform,
)
from apc.compiler.library import Component, Option, Reference, option_test
from apc.compiler.library import Number as NumberParameter
from apc.compiler.scene import Part, Scene
from apc.compiler.units import Dimension

PEERS = Name(("peers",))
OTHERS = "others"


@dataclass(frozen=True, slots=True)
class FlatVariable:
    """A scalar unknown of one site; `start` says whether it has a start value, a parameter of its name."""

    name: str
    dimension: Dimension
    start: bool


@dataclass(frozen=True, slots=True)
class FlatEquation:
    """`left = right` in whole names, from a part or a connection; `clock` is the clock its part names."""

    left: Expr
    right: Expr
    origin: str
    clock: str | None
    place: Place

    @property
    def text(self) -> str:
        """The equation as text."""
        return f"{format_expression(self.left)} = {format_expression(self.right)}"


@dataclass(frozen=True, slots=True)
class FlatSend:
    """What a part sends to the other peers over a link, sampled at the ticks of the link's clock."""

    name: str
    link: str
    expression: Expr
    dimension: Dimension
    place: Place


@dataclass(frozen=True, slots=True)
class FlatKind:
    """The equations of all peers of one structure."""

    name: str
    groups: tuple[str, ...]
    parts: tuple[str, ...]
    variables: tuple[FlatVariable, ...]
    equations: tuple[FlatEquation, ...]
    sends: tuple[FlatSend, ...]


@dataclass(frozen=True, slots=True)
class FlatSystem:
    """The scene as equations; every group of peers belongs to one kind."""

    scene: Scene
    kinds: tuple[FlatKind, ...]


def flatten(scene: Scene) -> FlatSystem:
    """Write out the equations of every kind. Raises ApcError with every mistake found on the way."""
    mistakes = Mistakes()
    structures: dict[tuple[str, ...], list[str]] = {}
    for group in scene.groups:
        present = tuple(part.name for part in scene.parts if group.name in part.groups)
        structures.setdefault(present, []).append(group.name)
    kinds = tuple(
        _flatten_kind(scene, present, tuple(groups), mistakes) for present, groups in structures.items()
    )
    mistakes.raise_if_any()
    return FlatSystem(scene, kinds)


def _flatten_kind(
    scene: Scene, present: tuple[str, ...], groups: tuple[str, ...], mistakes: Mistakes
) -> FlatKind:
    # A link is no part of a site: it lies between sites.
    parts = [scene.part(name) for name in present if scene.part(name).section != "links"]
    variables: list[FlatVariable] = []
    equations: list[FlatEquation] = []
    sends: list[FlatSend] = []
    for part in parts:
        instance = _Instance(part, mistakes)
        variables += instance.variables()
        equations += instance.equations()
        sends += instance.sends()
    equations += _connections(parts, mistakes)
    name = " and ".join(groups)
    return FlatKind(
        name, groups, tuple(part.name for part in parts), tuple(variables), tuple(equations), tuple(sends)
    )


class _Instance:
    """One part: its component's text in whole names."""

    def __init__(self, part: Part, mistakes: Mistakes) -> None:
        self.part = part
        self.component: Component = part.component
        self.mistakes = mistakes
        self.clock = part.reference("clock")
        self.link = part.reference("link")
        self.options = {p.name: p for p in self.component.parameters if isinstance(p, Option)}
        self.chosen = dict(part.options)
        self.references = dict(part.references)
        self.roles = {p.name for p in self.component.parameters if isinstance(p, Reference)}
        self.words = {
            word: value
            for p in self.component.parameters
            if isinstance(p, NumberParameter)
            for word, value in p.words
        }
        self.divided = {
            p.name for p in self.component.parameters if isinstance(p, NumberParameter) and p.divided
        }

    def variables(self) -> Iterator[FlatVariable]:
        for variable in self.component.variables:
            yield FlatVariable(
                self._whole(variable.name), variable.unit.dimension, variable.start is not None
            )
        for name, dimension in self.component.locals:
            yield FlatVariable(self._whole(name), dimension, False)
        for name, connector in self.component.connectors:
            for variable in (*connector.potentials, *connector.flows):
                yield FlatVariable(self._whole(name, variable.name), variable.unit.dimension, False)

    def equations(self) -> Iterator[FlatEquation]:
        for equation in self.component.equations:
            left = self._qualified(equation.left, equation.place, self.clock)
            right = self._qualified(equation.right, equation.place, self.clock)
            yield FlatEquation(left, right, self.part.name, self.clock, equation.place)

    def sends(self) -> Iterator[FlatSend]:
        for send in self.component.sends:
            if self.link is None:
                what = f"{self.component.name} sends {send.name} but has no parameter that names one link"
                self.mistakes.add("E504", send.place, what, hint="parameters: {link: link}")
                continue
            expression = self._qualified(send.expression, send.place, self.link)
            yield FlatSend(self._whole(send.name), self.link, expression, send.unit_dimension, send.place)

    def _whole(self, *parts: str) -> str:
        return ".".join((self.part.name, *parts))

    def _qualified(self, expression: Expr, place: Place, clock: str | None) -> Expr:
        def replace(node: Expr) -> Expr | None:
            if isinstance(node, Conditional):
                return self._decided(node, place, clock)
            if isinstance(node, Call) and node.function == "sample":
                return self._sample(node, place, clock)
            if isinstance(node, Name):
                return self._name(node)
            return None

        return transform(expression, replace)

    def _decided(self, node: Conditional, place: Place, clock: str | None) -> Expr | None:
        test = option_test(node.condition, self.options)
        if test is None:
            return None
        option, word = test
        equal = self.chosen[option.name] == word
        holds = equal == (getattr(node.condition, "operator", "==") == "==")
        return self._qualified(node.then if holds else node.otherwise, place, clock)

    def _sample(self, node: Call, place: Place, clock: str | None) -> Expr:
        argument = self._qualified(node.arguments[0], place, clock)
        if len(node.arguments) == 2:
            named = node.arguments[1]
            if isinstance(named, Name) and named.parts[0] in self.roles:
                clock = self.references[named.parts[0]]
            else:
                self.mistakes.add(
                    "E504",
                    place.shifted(named.start),
                    "the second argument of sample",
                    expected="a parameter of this component that is a clock",
                    got=format_expression(named),
                )
        if clock is None:
            what = f"{self.component.name} samples but has no parameter that names one clock"
            self.mistakes.add("E504", place.shifted(node.start), what, hint="parameters: {clock: clock}")
            clock = "?"
        return Call("sample", (argument, Name((clock,))))

    def _name(self, node: Name) -> Expr:
        head = node.parts[0]
        if node.parts in (("peers",), ("time",)):
            return Name(node.parts)
        if head == OTHERS:
            return Name((OTHERS, self.part.name, *node.parts[1:]))
        if len(node.parts) == 1 and head in self.words and self.component.parameter(head) is None:
            return Number(self.words[head])
        whole = Name((self.part.name, *node.parts))
        if self.part.shared and len(node.parts) == 1 and head in self.divided:
            return Binary("/", whole, PEERS)
        return whole


def _connections(parts: list[Part], mistakes: Mistakes) -> Iterator[FlatEquation]:
    """Yield, for each set of connectors that meet: potentials equal in a chain, flows summing to zero."""
    here = {part.name: part for part in parts}
    sets: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for part in parts:
        for connector, _ in part.component.connectors:
            sets[(part.name, connector)] = [(part.name, connector)]
    for part in parts:
        for connector, other, its_connector in part.connections:
            if other not in here:
                what = f"{part.name} is at groups where {other}, which it joins, is not"
                mistakes.add(
                    "E210", part.place, what, hint=f"at: the same groups at both {part.name} and {other}"
                )
                continue
            one, two = sets[(part.name, connector)], sets[(other, its_connector)]
            if one is not two:
                # The part joined to comes first, so that a set reads from the mass outwards.
                two.extend(one)
                for member in one:
                    sets[member] = two
    seen: set[int] = set()
    for members in sets.values():
        if id(members) in seen:
            continue
        seen.add(id(members))
        first_part, first_connector = members[0]
        type_ = dict(here[first_part].component.connectors)[first_connector]
        place = here[members[-1][0]].place
        for variable in type_.potentials:
            first = Name((*members[0], variable.name))
            for member in members[1:]:
                yield FlatEquation(Name((*member, variable.name)), first, "connection", None, place)
        for variable in type_.flows:
            total: Expr = Name((*members[0], variable.name))
            for member in members[1:]:
                total = Binary("+", total, Name((*member, variable.name)))
            yield FlatEquation(total, Number(Fraction(0)), "connection", None, place)
