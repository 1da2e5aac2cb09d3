"""A scene to equations: per kind of peer, the scalar equations after connection.

Takes: `Scene`. Gives: `FlatSystem`.
Guarantees: peers of one structure share one `FlatKind`, whatever their numbers and their count; every name
is whole (`contact.a.x`); potentials that meet are equal, flows that meet sum to zero; options are decided.
Does not: put a number in the place of a parameter, or look at clocks beyond naming them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import count

from apc.compiler.components.component import OTHERS, Component, Option, Reference, Send, option_test
from apc.compiler.components.component import Number as NumberParameter
from apc.compiler.components.component_check import ComponentNames
from apc.compiler.equations.connections import connection_equations
from apc.compiler.errors import Mistakes, Place, place_in
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import (
    INTERVAL,
    SMOOTH,
    Binary,
    Call,
    Conditional,
    Equation,
    Expr,
    Name,
    Number,
    format_expression,
    names,
    transform,
    walk,
)
from apc.compiler.language.values import Value
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.scene.groups import SceneGroup
from apc.compiler.scene.instances import Part
from apc.compiler.scene.scene import Scene

PEERS = Name(("peers",))

CONNECTION = "connection"  # where an equation comes from that is no part's

_HELD = "held"  # with a number behind it, the name of an expression that is held

# The functions whose value hangs on those of their arguments at the same moment, and on nothing else.
POINTWISE = frozenset(("max", "min", "abs", "sign", "sqrt", "floor", "atan2", *SMOOTH))


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
    """The equations of all peers of one structure.

    `delays` are computational delays that these groups set for themselves: (whole name, group, value).
    """

    name: str
    groups: tuple[str, ...]
    delays: tuple[tuple[str, str, Value], ...]
    parts: tuple[str, ...]
    variables: tuple[FlatVariable, ...]
    equations: tuple[FlatEquation, ...]
    sends: tuple[FlatSend, ...]


@dataclass(frozen=True, slots=True)
class FlatSystem:
    """The scene as equations; every group of peers belongs to one kind."""

    scene: Scene
    kinds: tuple[FlatKind, ...]


def is_made(name: str) -> bool:
    """Return whether a name is of the form of those given to expressions that are held."""
    return name.startswith(_HELD) and name.removeprefix(_HELD).isdecimal()


def flatten(scene: Scene) -> FlatSystem:
    """Write out the equations of every kind. Raises ApcError with every mistake found on the way."""
    mistakes = Mistakes(scene.names)
    delays = _delay_names(scene)
    structures: dict[object, list[SceneGroup]] = {}
    for group in scene.groups:
        structures.setdefault(_structure(scene, group, delays), []).append(group)
    kinds = tuple(_flatten_kind(scene, groups, delays, mistakes) for groups in structures.values())
    mistakes.raise_if_any()
    return FlatSystem(scene, kinds)


def _structure(scene: Scene, group: SceneGroup, delays: set[str]) -> object:
    """Return what must be equal for two groups to share their equations: parts and words.

    A group with a delay of its own shares with nobody: the schedule is a kind's, and each such delay can be
    changed without the other groups'.
    """
    present = tuple(part.name for part in scene.parts if group.name in part.groups)
    own = any(name in delays for name, _ in group.values)
    return present, tuple(sorted(group.words)), group.name if own else None


def _delay_names(scene: Scene) -> set[str]:
    """Return the numbers of parts that a hold's delay is or depends on: of the schedule, not of equations."""
    found: set[str] = set()
    for part in scene.parts:
        component = part.component
        sides = [side for equation in component.equations for side in (equation.left, equation.right)]
        for expression in (*sides, *(send.expression for send in component.sends)):
            for node in walk(expression):
                if isinstance(node, Call) and node.function == "hold":
                    for delay in node.arguments[1:]:
                        found |= {f"{part.name}.{name.parts[0]}" for name in names(delay)}
    for part in reversed(scene.parts):  # what an inner part's number depends on is a number of an outer part
        for name, value in part.values:
            if f"{part.name}.{name}" in found and value.expression is not None:
                found |= {".".join(node.parts) for node in names(value.expression)}
    return found


def _flatten_kind(scene: Scene, groups: list[SceneGroup], delays: set[str], mistakes: Mistakes) -> FlatKind:
    first = groups[0]
    words = dict(first.words)
    parts = [part for part in scene.parts if first.name in part.groups]
    variables: list[FlatVariable] = []
    equations: list[FlatEquation] = []
    sends: list[FlatSend] = []
    for part in parts:
        instance = _Instance(part, words, mistakes)
        variables += instance.variables()
        equations += instance.equations()
        sends += instance.sends()
        variables += instance.held_variables
        equations += instance.held_equations
    equations += [
        FlatEquation(left, right, CONNECTION, None, place)
        for left, right, place in connection_equations(parts, mistakes)
    ]
    for group in groups:
        for name, _ in group.columns:
            if name in delays:
                what = f"{name} can't differ from peer to peer within a group"
                mistakes.add("E211", group.place, what, hint="a group of its own for each delay")
    own = tuple((name, first.name, value) for name, value in first.values if name in delays)
    return FlatKind(
        " and ".join(group.name for group in groups),
        tuple(group.name for group in groups),
        own,
        tuple(part.name for part in parts),
        tuple(variables),
        tuple(equations),
        tuple(sends),
    )


def _is_linear_reduction(call: Call) -> bool:
    """Return whether a mean or sum of the others says nothing of ages."""
    return call.function in ("mean", "sum") and not any(
        isinstance(node, Call) and node.function == "age" for node in walk(call)
    )


def flatten_alone(component: Component, place: Place, mistakes: Mistakes) -> FlatKind:
    """Write out a component by itself: a clock or link has the name it has there, an option its first word.

    What parts inside give is not written.
    """
    options = tuple((p.name, p.words[0]) for p in component.parameters if isinstance(p, Option))
    references = tuple((p.name, p.name) for p in component.parameters if isinstance(p, Reference))
    part = Part(component.name, "", component, (), options, references, (), (), (), False, (), place)
    instance = _Instance(part, {}, mistakes)
    equations, sends = tuple(instance.equations()), tuple(instance.sends())
    variables = (*instance.variables(), *instance.held_variables)
    return FlatKind(
        component.name, (), (), (part.name,), variables, (*equations, *instance.held_equations), sends
    )


def _as_written(expression: Expr, text: str) -> Expr:
    """Return an entry of an expression between vectors as it stands in the text: without its index."""

    def whole(node: Expr) -> Expr | None:
        if isinstance(node, Name):
            return Name((*node.parts[:-1], whole_and_index(node.parts[-1])[0]))
        return None

    return expression if format_expression(expression) in text else transform(expression, whole)


class _Instance:
    """One part: its component's text in whole names."""

    def __init__(self, part: Part, words: dict[str, str], mistakes: Mistakes) -> None:
        self.part = part
        self.component: Component = part.component
        self.mistakes = mistakes
        self.options = {p.name: p for p in self.component.parameters if isinstance(p, Option)}
        own = {
            name.rpartition(".")[2]: word
            for name, word in words.items()
            if name.rpartition(".")[0] == part.name
        }
        self.chosen = dict(part.options) | own
        self.references = dict(part.references) | {n: w for n, w in own.items() if n not in self.options}
        roles = {p.name: p.role for p in self.component.parameters if isinstance(p, Reference)}
        self.clocks = {name for name, role in roles.items() if role == "clock"}
        self.clock = self._only("clock", roles)
        self.link = self._only("link", roles)
        self.passed = {connector: (inner, its) for connector, inner, its in self.component.passed}
        self.words = {
            word: value
            for p in self.component.parameters
            if isinstance(p, NumberParameter)
            for word, value in p.words
        }
        self.divided = {
            p.name for p in self.component.parameters if isinstance(p, NumberParameter) and p.divided
        }
        self.names = ComponentNames(self.component)
        self.held_variables: list[FlatVariable] = []
        self.held_equations: list[FlatEquation] = []

    def _only(self, wanted: str, roles: dict[str, str]) -> str | None:
        """Return the clock or link that is named, when there is exactly one."""
        named = [
            self.references[name]
            for name, role in roles.items()
            if role == wanted and name in self.references
        ]
        return named[0] if len(named) == 1 else None

    def variables(self) -> Iterator[FlatVariable]:
        for variable in self.component.variables:
            yield FlatVariable(
                self._whole(variable.name), variable.unit.dimension, variable.start is not None
            )
        for name, dimension in self.component.locals:
            yield FlatVariable(self._whole(name), dimension, False)
        for name, connector in self.component.connectors:
            if name in self.passed:
                continue  # it is the inner part's
            for variable in (*connector.potentials, *connector.flows):
                yield FlatVariable(self._whole(name, variable.name), variable.unit.dimension, False)

    def equations(self) -> Iterator[FlatEquation]:
        for equation in self.component.equations:
            left = self._qualified(equation.left, equation, self.clock)
            right = self._qualified(equation.right, equation, self.clock)
            yield FlatEquation(left, right, self.part.name, self.clock, equation.place)

    def sends(self) -> Iterator[FlatSend]:
        for send in self.component.sends:
            if self.link is None:
                what = f"{self.component.name} sends {send.name} but has no parameter that names one link"
                self.mistakes.add("E504", send.place, what, hint="parameters: {link: link}")
                continue
            expression = self._qualified(send.expression, send, self.link)
            yield FlatSend(self._whole(send.name), self.link, expression, send.dimension, send.place)

    def _whole(self, *parts: str) -> str:
        return ".".join((self.part.name, *parts))

    def _qualified(self, expression: Expr, where: Equation | Send, clock: str | None) -> Expr:
        def whole(node: Expr) -> Expr | None:
            if isinstance(node, Conditional) and (branch := self._branch(node)) is not None:
                return self._qualified(branch, where, clock)
            if isinstance(node, Call) and node.function == "sample":
                return self._sample(node, where, clock)
            if isinstance(node, Call) and node.function == "hold":
                return self._hold(node, where, clock)
            if isinstance(node, Call) and node.function in ("previous", "initial"):
                return self._before(node, node.arguments[0], where)
            if isinstance(node, Name):
                return self._name(node)
            return None

        return transform(expression, whole)

    def _branch(self, node: Conditional) -> Expr | None:
        """Return the branch that an option decides for, None if the condition is no test of an option."""
        test = option_test(node.condition, self.options)
        if test is None:
            return None
        option, word = test
        equal = self.chosen[option.name] == word
        holds = equal == (getattr(node.condition, "operator", "==") == "==")
        return node.then if holds else node.otherwise

    def _before(self, call: Call, expression: Expr, where: Equation | Send) -> Expr:
        """Return an expression of what its variables were before, or at the start, as the call says."""

        def before(node: Expr) -> Expr | None:
            if isinstance(node, Conditional) and (branch := self._branch(node)) is not None:
                return self._before(call, branch, where)
            if isinstance(node, Name):
                if node.parts in self.names.variables:
                    return Call(call.function, (self._name(node),))
                if node.parts[0] == OTHERS and call.function == "previous":
                    return Call(call.function, (self._name(node),))
                if node.parts[0] not in ("time", OTHERS):
                    return self._name(node)  # a parameter, the same at all times
            elif isinstance(node, Call) and call.function == "previous" and _is_linear_reduction(node):
                return None  # of what was heard before
            elif not isinstance(node, Call) or node.function in POINTWISE:
                return None
            name = next(one for n in count(1) if (one := f"y{n}",) not in self.names.dimensions)
            shown, place = format_expression(node), place_in(where.place, where.text, node.start)
            hint = f"{name} = {shown}, and {name}: {{unit: …, start: 0}} among the variables"
            what = f"{shown} inside {call.function}"
            self.mistakes.add("E505", place, what, expected="a variable", hint=hint)
            return Number(Fraction(0))

        return transform(expression, before)

    def _hold(self, node: Call, where: Equation | Send, clock: str | None) -> Expr:
        """Give an expression that is held a variable of its own, which a clock of this part computes."""
        own = self.clock if isinstance(where, Send) else clock
        held, *delay = node.arguments
        dimension = self.names.dimension_of_held(held, where.text, where.place)
        qualified = self._qualified(held, where, own)
        if dimension is not None:
            taken = {name for (name, *_) in self.names.variables} | {
                variable.name.rpartition(".")[2] for variable in self.held_variables
            }
            name = next(one for n in count(1) if (one := f"{_HELD}{n}") not in taken)
            whole = self._whole(name)
            self.held_variables.append(FlatVariable(whole, dimension, False))
            symbol = Name((*self.part.name.split("."), name))
            self.held_equations.append(FlatEquation(symbol, qualified, self.part.name, own, where.place))
            qualified = symbol
        for moving in (name for one in delay for name in names(one)):
            if moving.parts in self.names.variables or moving.parts[0] in ("time", OTHERS):
                place = place_in(where.place, where.text, moving.start)
                what, got = "the delay of a hold", format_expression(moving)
                self.mistakes.add("E505", place, what, expected="parameters only", got=got)
        later = [self._qualified(one, where, own) for one in delay]
        return replace(node, arguments=(qualified, *later))

    def _sample(self, node: Call, where: Equation | Send, clock: str | None) -> Expr:
        argument = self._qualified(node.arguments[0], where, clock)
        if len(node.arguments) == 2:
            named = node.arguments[1]
            if isinstance(named, Name) and named.parts[0] in self.clocks:
                clock = self.references[named.parts[0]]
            else:
                self.mistakes.add(
                    "E504",
                    place_in(where.place, where.text, named.start),
                    "the second argument of sample",
                    expected="a parameter of this component that is a clock",
                    got=format_expression(named),
                )
        if clock is None:
            what = f"{self.component.name} samples but has no parameter that names one clock"
            place = place_in(where.place, where.text, node.start)
            hint = "parameters: {clock: clock}"
            if self.clocks:
                what = f"{self.component.name} samples, and has clocks {', '.join(sorted(self.clocks))}"
                own = _as_written(node.arguments[0], where.text)
                hint = format_expression(Call("sample", (own, Name((min(self.clocks),)))))
            self.mistakes.add("E504", place, what, hint=hint)
            clock = "?"
        return Call("sample", (argument, Name((clock,))))

    def _name(self, node: Name) -> Expr:
        head = node.parts[0]
        if head.startswith(INTERVAL):
            return Name((self.references[head.removeprefix(INTERVAL)[:-1]], "period"))
        if node.parts in (("peers",), ("time",)):
            return Name(node.parts)
        if any(table.name == head for table in self.part.tables) and len(node.parts) == 1:
            return Name((*self.part.name.split("."), head))
        if head == OTHERS:
            return Name((OTHERS, *self.part.name.split("."), *node.parts[1:]))
        if len(node.parts) == 1 and head in self.words and self.component.parameter(head) is None:
            return Number(self.words[head])
        if head in self.passed:
            inner, its = self.passed[head]
            node = Name((inner, its, *node.parts[1:]))
        whole = Name((*self.part.name.split("."), *node.parts))
        if self.part.shared and len(node.parts) == 1 and head in self.divided:
            return Binary("/", whole, PEERS)
        return whole
