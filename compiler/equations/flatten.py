"""A scene to equations: per kind of peer, the scalar equations after connection.

Takes: `Scene`. Gives: `FlatSystem`.
Guarantees: peers of one structure share one `FlatKind`, whatever their numbers and their count; every name
is whole (`contact.a.x`); potentials that meet are equal, flows that meet sum to zero; options are decided; a
value crosses between what is continuous, clocks and peers only through a named crossing.
Does not: put a number in the place of a parameter, or find out what belongs to which clock (see `clocks`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, islice

from apc.compiler.compiled import count_of
from apc.compiler.components.component import (
    OTHERS,
    Component,
    Option,
    Reference,
    Send,
    Variable,
    option_test,
)
from apc.compiler.components.component_check import ComponentNames
from apc.compiler.equations.connections import ZERO, connection_equations
from apc.compiler.errors import Mistakes, Place, place_in
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import (
    FUNCTIONS,
    INTERVAL,
    LEVELS,
    SMOOTH,
    Call,
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

HEARD_AGE = f"{OTHERS}.age"  # in what a reduction runs over; no send has this name, as a part's stands before
CONNECTION = "connection"  # where an equation comes from that is no part's

# What hangs on the values of its arguments at the same moment, and on nothing else.
POINTWISE = frozenset(("max", "min", "abs", "sign", "sqrt", "floor", "atan2", *SMOOTH, *LEVELS))
REDUCTIONS = ("mean", "sum", "max", "min", "count")


@dataclass(frozen=True, slots=True)
class FlatVariable:
    """A scalar unknown of one site; `declared` is a component's declaration of it, if there is one."""

    name: str
    dimension: Dimension
    declared: Variable | None = None

    @property
    def start(self) -> bool:
        """Whether it has a start value, a parameter of its name."""
        return self.declared is not None and self.declared.start is not None

    @property
    def limit(self) -> str:
        """The parameter of its part that its size should stay within, empty if there is none."""
        return "" if self.declared is None else self.declared.limit


@dataclass(frozen=True, slots=True)
class FlatEquation:
    """`left = right` in whole names, from a part or a connection; `clock` is the clock its part names.

    `written` is the component's equation, None for a connection.
    """

    left: Expr
    right: Expr
    origin: str
    clock: str | None
    place: Place
    written: Equation | None = None

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
class SampleCrossing:
    """`symbol` stands in a clocked equation for a continuous expression, taken at t⁻ of the clock's tick."""

    symbol: str
    clock: str
    expression: Expr


@dataclass(frozen=True, slots=True)
class HoldCrossing:
    """`symbol` stands in a continuous equation for a clocked variable, held from its tick + `delay` on.

    `shown` is what is held, as text; `clock` is empty until the variable's is known.
    """

    symbol: str
    variable: str
    delay: Expr
    shown: str
    place: Place
    clock: str = ""


@dataclass(frozen=True, slots=True)
class PreviousCrossing:
    """`symbol` stands for a clocked variable's value at the previous tick of its clock."""

    symbol: str
    variable: str
    place: Place
    clock: str = ""


@dataclass(frozen=True, slots=True)
class ReceiveCrossing:
    """`symbol` stands, at a tick, for a reduction over the other peers that are heard over `link`.

    It runs over the value that `argument` has for each of them, in which the names `others.…` are what that
    peer sent, `previous(others.…)` what was heard of it a tick before, and `HEARD_AGE` its packet's age.
    """

    symbol: str
    operator: str
    argument: Expr
    link: str
    place: Place
    clock: str = ""


Crossing = SampleCrossing | HoldCrossing | PreviousCrossing | ReceiveCrossing


@dataclass(frozen=True, slots=True)
class FlatKind:
    """The equations of all peers of one structure.

    `delays` are computational delays that its only group sets for itself: (whole name, value).
    """

    name: str
    groups: tuple[str, ...]
    delays: tuple[tuple[str, Value], ...]
    parts: tuple[Part, ...]
    variables: tuple[FlatVariable, ...]
    equations: tuple[FlatEquation, ...]
    crossings: tuple[Crossing, ...]
    sends: tuple[FlatSend, ...]


@dataclass(frozen=True, slots=True)
class FlatSystem:
    """The scene as equations; every group of peers belongs to one kind."""

    scene: Scene
    kinds: tuple[FlatKind, ...]


def flatten(scene: Scene) -> FlatSystem:
    """Write out the equations of every kind. Raises ApcError with every mistake found on the way."""
    mistakes = Mistakes(scene.names)
    structures: dict[object, list[SceneGroup]] = {}
    for group in scene.groups:
        present = tuple(part.name for part in scene.parts if group.name in part.groups)
        structures.setdefault((present, tuple(sorted(group.words))), []).append(group)
    kinds = []
    for groups in structures.values():
        first = groups[0]
        parts = [_with_words(part, first.words) for part in scene.parts if first.name in part.groups]
        kind = _flat_kind("", parts, mistakes)
        joints = connection_equations(parts, mistakes)
        equations = (FlatEquation(left, right, CONNECTION, None, place) for left, right, place in joints)
        kind = replace(kind, equations=(*kind.equations, *equations))
        delays = _delay_names(kind)
        sharing: dict[str, list[SceneGroup]] = {}
        for group in groups:
            for name in delays.intersection(name for name, _ in group.columns):
                what = f"{name} can't differ from peer to peer within a group"
                mistakes.add("E211", group.place, what, hint="a group of its own for each delay")
            # The schedule is a kind's: a group that sets a delay can have it changed without the others'.
            alone = any(name in delays for name, _ in group.values)
            sharing.setdefault(group.name if alone else "", []).append(group)
        for sharers in sharing.values():
            members = tuple(group.name for group in sharers)
            settings = tuple((name, value) for name, value in sharers[0].values if name in delays)
            kinds.append(replace(kind, name=" and ".join(members), groups=members, delays=settings))
    mistakes.raise_if_any()
    return FlatSystem(scene, tuple(kinds))


def _delay_names(kind: FlatKind) -> set[str]:
    """Return the numbers of parts that a hold's delay is or depends on: of the schedule, not of equations."""
    delays = [one.delay for one in kind.crossings if isinstance(one, HoldCrossing)]
    found = {".".join(name.parts) for delay in delays for name in names(delay)}
    for part in reversed(kind.parts):  # what an inner part's number depends on is a number of an outer part
        for name, value in part.values:
            if f"{part.name}.{name}" in found and value.expression is not None:
                found |= {".".join(node.parts) for node in names(value.expression)}
    return found


def flatten_alone(component: Component, place: Place, mistakes: Mistakes) -> FlatKind:
    """Write out a component by itself: a clock or link has the name it has there, an option its first word.

    What parts inside give is not written.
    """
    options = tuple((p.name, p.words[0]) for p in component.parameters if isinstance(p, Option))
    references = tuple((p.name, p.name) for p in component.parameters if isinstance(p, Reference))
    part = Part(component.name, "", component, (), options, references, (), (), (), False, (), place)
    return _flat_kind(component.name, [part], mistakes)


def _with_words(part: Part, words: Sequence[tuple[str, str]]) -> Part:
    """Return a part with the options, clocks and links that a group of peers sets for itself."""
    split = ((name.rpartition("."), word) for name, word in words)
    own = {name: word for (owner, _, name), word in split if owner == part.name}
    options, references = dict(part.options) | own, dict(part.references) | own
    return replace(part, options=tuple(options.items()), references=tuple(references.items()))


def _flat_kind(name: str, parts: Sequence[Part], mistakes: Mistakes) -> FlatKind:
    """Write out parts, without their connections."""
    variables: list[FlatVariable] = []
    equations: list[FlatEquation] = []
    sends: list[FlatSend] = []
    crossings: dict[str, Crossing] = {}
    for part in parts:
        writer = _PartWriter(part, crossings, mistakes)
        component, clock = part.component, part.reference("clock")
        variables += [
            FlatVariable(f"{part.name}.{one.name}", one.unit.dimension, one) for one in component.variables
        ]
        variables += [FlatVariable(f"{part.name}.{local}", its) for local, its in component.locals]
        variables += [
            FlatVariable(f"{part.name}.{connector}.{one.name}", one.unit.dimension)
            for connector, type_ in component.connectors
            if connector not in writer.passed  # else it is the inner part's
            for one in (*type_.potentials, *type_.flows)
        ]
        for equation in component.equations:
            left, right = (writer.qualified(one, equation, clock) for one in (equation.left, equation.right))
            equations.append(FlatEquation(left, right, part.name, clock, equation.place, equation))
        for send in component.sends:
            if (link := part.reference("link")) is None:
                what = f"{component.name} sends {send.name} but has no parameter that names one link"
                mistakes.add("E504", send.place, what, hint="parameters: {link: link}")
                continue
            expression = writer.qualified(transform(send.expression, _unsampled), send, clock)
            sends.append(FlatSend(f"{part.name}.{send.name}", link, expression, send.dimension, send.place))
        variables += writer.held_variables
        equations += writer.held_equations
    unknowns, listed = tuple(variables), tuple(crossings.values())
    return FlatKind(name, (), (), tuple(parts), unknowns, tuple(equations), listed, tuple(sends))


def _unsampled(node: Expr) -> Expr | None:
    """Take the samples off what is sent: it is evaluated at the link's tick as a whole."""
    if isinstance(node, Call) and node.function == "sample":
        return transform(node.arguments[0], _unsampled)
    return node if isinstance(node, Call) and node.function == "hold" else None


def _as_written(expression: Expr, text: str) -> Expr:
    """Return an entry of an expression between vectors as it stands in the text: without its index."""

    def whole(node: Expr) -> Expr | None:
        if isinstance(node, Name):
            return Name((*node.parts[:-1], whole_and_index(node.parts[-1])[0]))
        return None

    return expression if format_expression(expression) in text else transform(expression, whole)


class _PartWriter:
    """Writes a component's expressions in whole names, with a symbol in the place of each crossing.

    An expression that is held gets a variable and an equation of its own.
    """

    def __init__(self, part: Part, crossings: dict[str, Crossing], mistakes: Mistakes) -> None:
        self.part = part
        self.crossings = crossings
        self.mistakes = mistakes
        self.references = dict(part.references)
        self.passed = {connector: inner for connector, *inner in part.component.passed}
        self.names = ComponentNames(part.component)
        self.held_variables: list[FlatVariable] = []
        self.held_equations: list[FlatEquation] = []

    def qualified(
        self, expression: Expr, where: Equation | Send, clock: str | None, *, heard: bool = False
    ) -> Expr:
        """Return an expression in whole names.

        Parameters
        ----------
        expression
            In the component's own names.
        where
            What it stands in.
        clock
            The clock that the part names, if it is one.
        heard
            Whether it stands in a reduction, where alone the others can be named.
        """
        options = {p.name: p for p in self.part.component.parameters if isinstance(p, Option)}

        def decided(node: Expr) -> Expr | None:
            match node:
                case Call("if", (Call(relation) as condition, then, otherwise)):
                    if test := option_test(condition, options):
                        holds = dict(self.part.options)[test[0].name] == test[1]
                        return transform(then if holds == (relation == "==") else otherwise, decided)
            return None

        def whole(node: Expr) -> Expr | None:
            if isinstance(node, Name):
                return self._name(node) if heard or node.parts[0] != OTHERS else self._each(node, where)
            if not isinstance(node, Call) or node.function not in FUNCTIONS:
                return None
            of = node.arguments[0]
            reads = any(name.parts[0] == OTHERS for name in names(node))
            if reads and node.function in REDUCTIONS and len(node.arguments) == 1:
                return self._receive(node, where, clock)
            if reads and node.function in ("age", "previous") and isinstance(of, Name):
                symbol = Name((format_expression(Call(node.function, (self._name(of),))),))
                return symbol if heard else self._each(node, where)
            if node.function == "sample":
                return self._sample(node, where, clock)
            if node.function == "hold":
                return self._hold(node, where, clock)
            if node.function in ("previous", "initial"):
                before = self._before(node, where)
                return before or transform(transform(of, partial(self._moved_back, node, where)), whole)
            return None

        return transform(transform(expression, decided), whole)

    def _each(self, node: Name | Call, where: Equation | Send) -> Expr:
        """Report what is of each other peer outside of a reduction."""
        shown = f"others.{next(names(node)).parts[-1]}"
        shown = f"{node.function}({shown})" if isinstance(node, Call) else shown
        what = f"{shown} of {self.part.name} is a value of each other peer, and one is due here"
        self.mistakes.add("E506", where.place, what, hint=f"mean({shown}), or sum, max, min")
        return ZERO

    def _receive(self, call: Call, where: Equation | Send, clock: str | None) -> Expr:
        """Return the symbol of a reduction, or the parameter of a site that counts who is heard."""
        link, component = self.part.reference("link"), self.part.component
        if call.function == "count":
            if not component.sends:
                what = "count(others) counts those that are heard, and this component sends nothing"
                self.mistakes.add("E506", where.place, what, hint="sends: {x: sample(object.x)}")
            return Name((count_of(link or ""),))
        argument = self.qualified(call.arguments[0], where, clock, heard=True)
        symbol = format_expression(Call(call.function, (argument,)))
        crossing = ReceiveCrossing(symbol, call.function, argument, link or "", where.place)
        return self._crossed(crossing)

    def _crossed(self, crossing: Crossing) -> Name:
        self.crossings.setdefault(crossing.symbol, crossing)
        return Name((crossing.symbol,))

    def _before(self, call: Call, where: Equation | Send) -> Expr | None:
        """Return the symbol of a variable's value before, or at the start; None of any other expression."""
        of = call.arguments[0]
        if not isinstance(of, Name) or of.parts not in self.names.variables:
            return None
        variable = format_expression(self._name(of))
        crossing = PreviousCrossing(f"{call.function}({variable})", variable, where.place)
        return self._crossed(crossing) if call.function == "previous" else Name((crossing.symbol,))

    def _moved_back(self, call: Call, where: Equation | Send, node: Expr) -> Expr | None:
        """Return a node of what is asked for as it was before, or at the start, as the call says."""
        if isinstance(node, Name):
            heard = node.parts[0] == OTHERS and call.function == "previous"
            if heard or node.parts in self.names.variables:
                return Call(call.function, (node,))
            if node.parts[0] not in ("time", OTHERS):
                return node  # a parameter, the same at all times
        elif isinstance(node, Call) and call.function == "previous" and node.function in ("mean", "sum"):
            if not any(isinstance(one, Call) and one.function == "age" for one in walk(node)):
                return None  # of what was heard before
        elif not isinstance(node, Call) or node.function in POINTWISE:
            return None
        name = next(one for n in count(1) if (one := f"y{n}",) not in self.names.dimensions)
        shown, place = format_expression(node), place_in(where.place, where.text, node.start)
        hint = f"{name} = {shown}, and {name}: {{unit: …, start: 0}} among the variables"
        what = f"{shown} inside {call.function}"
        self.mistakes.add("E505", place, what, expected="a variable", hint=hint)
        return ZERO

    def _hold(self, node: Call, where: Equation | Send, clock: str | None) -> Expr:
        """Give an expression that is held a variable, which a clock of this part computes."""
        held, *delay = node.arguments
        dimension = self.names.dimension_of_held(held, where.text, where.place)
        variable = shown = self.qualified(held, where, clock)
        if dimension is not None:
            taken = {name for (name, *_) in self.names.variables}
            free = (f"held{n}" for n in count(1) if f"held{n}" not in taken)
            name = next(islice(free, len(self.held_variables), None))
            variable = Name((*self.part.name.split("."), name))
            self.held_variables.append(FlatVariable(format_expression(variable), dimension))
            self.held_equations.append(FlatEquation(variable, shown, self.part.name, clock, where.place))
        for moving in (name for one in delay for name in names(one)):
            if moving.parts in self.names.variables or moving.parts[0] in ("time", OTHERS):
                place = place_in(where.place, where.text, moving.start)
                what, got = "the delay of a hold", format_expression(moving)
                self.mistakes.add("E505", place, what, expected="parameters only", got=got)
        call = Call("hold", (variable, *(self.qualified(one, where, clock) for one in delay)))
        name, after = format_expression(variable), (*call.arguments[1:], ZERO)[0]
        symbol, what = format_expression(call), format_expression(shown)
        return self._crossed(HoldCrossing(symbol, name, after, what, where.place))

    def _sample(self, node: Call, where: Equation | Send, clock: str | None) -> Expr:
        argument = self.qualified(node.arguments[0], where, clock)
        parameters = self.part.component.parameters
        clocks = sorted(p.name for p in parameters if isinstance(p, Reference) and p.role == "clock")
        for named in node.arguments[1:]:
            if isinstance(named, Name) and named.parts[0] in clocks:
                clock = self.references[named.parts[0]]
            else:
                place = place_in(where.place, where.text, named.start)
                what, expected = (
                    "the second argument of sample",
                    "a parameter of this component that is a clock",
                )
                self.mistakes.add("E504", place, what, expected=expected, got=format_expression(named))
        if clock is None:
            what = f"{self.part.component.name} samples but has no parameter that names one clock"
            place, hint = place_in(where.place, where.text, node.start), "parameters: {clock: clock}"
            if clocks:
                what = f"{self.part.component.name} samples, and has clocks {', '.join(clocks)}"
                own = _as_written(node.arguments[0], where.text)
                hint = format_expression(Call("sample", (own, Name((clocks[0],)))))
            self.mistakes.add("E504", place, what, hint=hint)
        symbol = format_expression(Call("sample", (argument, Name((clock or "?",)))))
        return self._crossed(SampleCrossing(symbol, clock or "?", argument))

    def _name(self, node: Name) -> Expr:
        head, *rest = node.parts
        part = self.part.name.split(".")
        if head.startswith(INTERVAL):
            return Name((self.references[head.removeprefix(INTERVAL)[:-1]], "period"))
        if head == OTHERS:
            return Name((OTHERS, *part, *rest))
        if rest:
            return Name((*part, *self.passed.get(head, (head,)), *rest))
        component = self.part.component
        words = {word: value for one in component.numbers for word, value in one.words}
        if head in ("peers", "time"):
            return node
        if head in words and component.parameter(head) is None:
            return Number(words[head])
        whole = Name((*part, head))
        divided = self.part.shared and any(one.divided for one in component.numbers if one.name == head)
        return Call("/", (whole, Name(("peers",)))) if divided else whole
