"""Flattening of a topology: per peer type, the scalar equations after connection.

Takes: `Topology`. Gives: `flatten`, a `FlatSystem`; `flatten_single`, for one component. `FlatPeerType`,
`FlatVariable`, `FlatEquation`, `FlatSend`; `SampleCrossing`, `HoldCrossing`, `PreviousCrossing`,
`ReceiveCrossing`.
Guarantees: peers of one structure share one `FlatPeerType`, independent of parameter values and counts. Names
are qualified (`contact.a.x`). Connected potentials are equal, connected flows sum to zero. Options are
resolved. Values cross between continuous time, clocks and peers only through a named crossing.
Does not: substitute parameter values, or assign clocks (see `clocks`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count, islice

from apc.compiler.compiled import count_of
from apc.compiler.components.component import (
    OTHERS,
    Component,
    ComponentVariable,
    Named,
    Option,
    Reference,
    SentValue,
    option_test,
)
from apc.compiler.components.component_check import TRUE, ComponentNames
from apc.compiler.equations.connections import ZERO, connection_equations
from apc.compiler.errors import Mistakes, SourceLocation, location_in
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import (
    INTERVAL,
    LEVELS,
    SMOOTH,
    Call,
    Equation,
    Expr,
    Name,
    NumberLiteral,
    format_expression,
    names,
    transform,
    walk,
)
from apc.compiler.language.values import ScalarValue
from apc.compiler.topology.groups import GroupDeclaration
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.topology import Topology

RECEIVED_AGE = f"{OTHERS}.age"  # argument of a reduction; no send has this name: sends are qualified
CONNECTION = "connection"  # where an equation comes from that is no part's

# The functions that depend only on the present values of their arguments.
POINTWISE = frozenset(("max", "min", "abs", "sign", "sqrt", "floor", "atan2", *SMOOTH, *LEVELS))
REDUCTIONS = ("mean", "sum", "max", "min", "count")


@dataclass(frozen=True, slots=True)
class FlatVariable:
    """A scalar unknown of one subsystem; `declared` is a component's declaration of it, if there is one."""

    name: str
    dimension: Dimension
    declared: ComponentVariable | None = None

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
    location: SourceLocation
    written: Equation | None = None

    @property
    def text(self) -> str:
        """The equation as text."""
        return f"{format_expression(self.left)} = {format_expression(self.right)}"


@dataclass(frozen=True, slots=True)
class FlatSend:
    """A part's sent values over a link, sampled at the ticks of the link's clock."""

    name: str
    link: str
    expression: Expr
    dimension: Dimension
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class SampleCrossing:
    """`symbol` represents, in a clocked equation, a continuous expression at t⁻ of the clock's tick."""

    symbol: str
    clock: str
    expression: Expr


@dataclass(frozen=True, slots=True)
class HoldCrossing:
    """`symbol` represents, in a continuous equation, a clocked variable, held from its tick + `delay` on.

    `shown` is the held expression as text; `clock` is empty until determined.
    """

    symbol: str
    variable: str
    delay: Expr
    shown: str
    location: SourceLocation
    clock: str = ""


@dataclass(frozen=True, slots=True)
class PreviousCrossing:
    """`symbol` represents a clocked variable's value at the previous tick of its clock."""

    symbol: str
    variable: str
    location: SourceLocation
    clock: str = ""


@dataclass(frozen=True, slots=True)
class ReceiveCrossing:
    """`symbol` represents, at a tick, a reduction over the other peers received over `link`.

    It runs over the value that `argument` has for each of them, in which the names `others.…` are the values
    sent by that peer, `previous(others.…)` those received at the previous tick, and `RECEIVED_AGE` its
    packet's age.
    """

    symbol: str
    operator: str
    argument: Expr
    link: str
    location: SourceLocation
    clock: str = ""


Crossing = SampleCrossing | HoldCrossing | PreviousCrossing | ReceiveCrossing


@dataclass(frozen=True, slots=True)
class FlatPeerType:
    """The equations of all peers of one structure.

    `delays` are computational delays that its only group sets for itself: (whole name, value).
    """

    name: str
    groups: tuple[str, ...]
    delays: Named[ScalarValue]
    parts: tuple[PartInstance, ...]
    variables: tuple[FlatVariable, ...]
    equations: tuple[FlatEquation, ...]
    crossings: tuple[Crossing, ...]
    sends: tuple[FlatSend, ...]


@dataclass(frozen=True, slots=True)
class FlatSystem:
    """The topology as equations; every group of peers belongs to one peer type."""

    topology: Topology
    peer_types: tuple[FlatPeerType, ...]


def flatten(topology: Topology, *, linear: bool = False) -> FlatSystem:
    """Write the equations of every peer type; `linear` those of a linear analysis.

    Raises ApcError with all errors found.
    """
    mistakes = Mistakes(topology.names)
    structures: dict[object, list[GroupDeclaration]] = {}
    for group in topology.groups:
        present = tuple(
            (part.name, part.component.name) for part in topology.parts if group.name in part.groups
        )
        structures.setdefault((present, tuple(sorted(group.words))), []).append(group)
    peer_types = []
    for groups in structures.values():
        first = groups[0]
        parts = [_with_words(part, dict(first.words)) for part in topology.parts if first.name in part.groups]
        peer_type = _flat_peer_type("", parts, mistakes, linear=linear)
        joints = connection_equations(parts, mistakes)
        equations = (
            FlatEquation(left, right, CONNECTION, None, location) for left, right, location in joints
        )
        peer_type = replace(peer_type, equations=(*peer_type.equations, *equations))
        delays = _delay_names(peer_type)
        # The schedule is a peer type's: a group that sets a delay can have it changed without the others'.
        sharing: dict[str, tuple[list[str], Named[ScalarValue]]] = {}
        for group in groups:
            for name in delays.intersection(name for name, _ in group.columns):
                message = f"{name} can't differ from peer to peer within a group"
                mistakes.add("E211", group.location, message, hint="a group of its own for each delay")
            pairs = tuple(setting for setting in group.values if setting[0] in delays)
            sharing.setdefault(group.name if pairs else "", ([], pairs))[0].append(group.name)
        for members, pairs in sharing.values():
            peer_types.append(
                replace(peer_type, name=" and ".join(members), groups=tuple(members), delays=pairs)
            )
    mistakes.raise_if_any()
    return FlatSystem(topology, tuple(peer_types))


def _delay_names(peer_type: FlatPeerType) -> set[str]:
    """Return the numbers of parts that a hold's delay is or depends on: of the schedule, not of equations."""
    delays = [crossing.delay for crossing in peer_type.crossings if isinstance(crossing, HoldCrossing)]
    texts = {format_expression(name) for delay in delays for name in names(delay)}
    for part in reversed(
        peer_type.parts
    ):  # what an inner part's number depends on is a number of an outer part
        for name, value in part.values:
            if f"{part.name}.{name}" in texts and value.expression is not None:
                texts.update(map(format_expression, names(value.expression)))
    return texts


def flatten_single(component: Component, location: SourceLocation, mistakes: Mistakes) -> FlatPeerType:
    """Write the equations of a component: clocks and links by local names, options by their first word.

    Equations of inner parts are omitted.
    """
    options = tuple((p.name, p.words[0]) for p in component.parameters if isinstance(p, Option))
    references = tuple((p.name, p.name) for p in component.parameters if isinstance(p, Reference))
    part = PartInstance(
        component.name, "", component, (), options, references, (), (), (), False, (), location
    )
    return _flat_peer_type(component.name, [part], mistakes)


def _with_words(part: PartInstance, words: Mapping[str, str]) -> PartInstance:
    """Return a part with the options, clocks and links that a group of peers sets for itself."""

    def declared(named: Named[str]) -> Named[str]:
        return tuple((name, words.get(f"{part.name}.{name}", word)) for name, word in named)

    return replace(part, options=declared(part.options), references=declared(part.references))


def _flat_peer_type(
    name: str, parts: Sequence[PartInstance], mistakes: Mistakes, *, linear: bool = False
) -> FlatPeerType:
    """Write out parts, without their connections."""
    variables: list[FlatVariable] = []
    equations: list[FlatEquation] = []
    sends: list[FlatSend] = []
    crossings: dict[str, Crossing] = {}
    for part in parts:
        writer, component = _PartWriter(part, crossings, mistakes), part.component
        declared: list[tuple[str, Dimension, ComponentVariable | None]] = [
            *((variable.name, variable.unit.dimension, variable) for variable in component.variables),
            *((local, dimension, None) for local, dimension in component.locals),
            *(
                (f"{connector}.{variable.name}", variable.unit.dimension, None)
                for connector, type_ in component.connectors
                if connector not in writer.passed  # else it is the inner part's
                for variable in (*type_.potentials, *type_.flows)
            ),
        ]
        variables += [
            FlatVariable(f"{part.name}.{related}", unit, variable) for related, unit, variable in declared
        ]
        for equation in component.linear_equations if linear else component.equations:
            left, right = (writer.written(item, equation) for item in (equation.left, equation.right))
            equations.append(FlatEquation(left, right, part.name, writer.clock, equation.location, equation))
        for send in component.sends:
            if writer.link is None:
                message = f"{component.name} sends {send.name} but has no parameter that names one link"
                mistakes.add("E504", send.location, message, hint="parameters: {link: link}")
                continue
            expression = writer.written(transform(send.expression, _unsampled), send)
            whole = f"{part.name}.{send.name}"
            sends.append(FlatSend(whole, writer.link, expression, send.dimension, send.location))
        variables += [variable for variable, _ in writer.held]
        equations += [equation for _, equation in writer.held]
    unknowns, listed = tuple(variables), tuple(crossings.values())
    return FlatPeerType(name, (), (), tuple(parts), unknowns, tuple(equations), listed, tuple(sends))


def _unsampled(node: Expr) -> Expr | None:
    """Remove the samples from a send: it is evaluated entirely at the link's tick."""
    match node:
        case Call("sample", (argument, *_)):
            return transform(argument, _unsampled)
        case Call("hold"):
            return node
    return None


class _PartWriter:
    """Writes a component's expressions with qualified names, and a symbol for each crossing.

    A held expression gets a separate variable and equation; `where` is the present location.
    """

    def __init__(self, part: PartInstance, crossings: dict[str, Crossing], mistakes: Mistakes) -> None:
        self.part, self.crossings, self.mistakes = part, crossings, mistakes
        self.clock, self.link = part.reference("clock"), part.reference("link")
        self.references = dict(part.references)
        self.passed = {connector: inner for connector, *inner in part.component.passed}
        self.names = ComponentNames(part.component)
        self.held: list[tuple[FlatVariable, FlatEquation]] = []
        self.where: Equation | SentValue

    def written(self, expression: Expr, where: Equation | SentValue) -> Expr:
        """Return an expression of a part's equation or send, with qualified names."""
        self.where = where
        return self._whole(expression)

    def _whole(self, expression: Expr, *, received: bool = False) -> Expr:
        """Return an expression with qualified names; names of others are allowed for `received` only."""

        def whole(node: Expr) -> Expr | None:
            reads = isinstance(node, Name | Call) and any(name.parts[0] == OTHERS for name in names(node))
            match node:
                case Name():
                    return self._name(node) if received or not reads else self._each(node)
                case Call(function, (argument,)) if reads and function in REDUCTIONS:
                    return self._receive(function, argument)
                case Call("age" | "previous", (Name() as of,)) if reads:
                    return Name((self._called(node, of),)) if received else self._each(node)
                case Call("sample"):
                    return self._sample(node)
                case Call("hold"):
                    return self._hold(*node.arguments)
                case Call("initial", (Name() as of,)) if of.parts in self.names.variables:
                    return Name((self._called(node, of),))
                case Call("previous", (Name() as of,)) if of.parts in self.names.variables:
                    variable = format_expression(self._name(of))
                    return self._crossed(
                        PreviousCrossing(self._called(node, of), variable, self.where.location)
                    )
                case Call("previous" | "initial", (of,)):
                    return transform(transform(of, partial(self._moved_back, node.function)), whole)
            return None

        return transform(transform(expression, self._decided), whole)

    def _decided(self, node: Expr) -> Expr | None:
        """Return the branch of a condition on an option, or whether a comparison of one holds."""
        match node:
            case Call("if", (condition, then, otherwise)) if (holds := self._holds(condition)) is not None:
                return transform(then if holds else otherwise, self._decided)
        holds = self._holds(node)
        return None if holds is None else TRUE if holds else Call("not", (TRUE,))

    def _holds(self, node: Expr) -> bool | None:
        """Return whether a comparison of an option with a word holds; None for other expressions."""
        test = option_test(node, self.names.options)
        if test is None or not isinstance(node, Call):
            return None
        return (dict(self.part.options)[test[0].name] == test[1]) == (node.function == "==")

    def _called(self, call: Call, of: Name) -> str:
        return f"{call.function}({format_expression(self._name(of))})"

    def _crossed(self, crossing: Crossing) -> Name:
        self.crossings.setdefault(crossing.symbol, crossing)
        return Name((crossing.symbol,))

    def _report(
        self, code: str, node: Expr, message: str, *, expected: str = "", got: str = "", hint: str = ""
    ) -> None:
        location = location_in(self.where.location, self.where.text, node.start)
        self.mistakes.add(code, location, message, expected=expected, got=got, hint=hint)

    def _each(self, node: Name | Call) -> Expr:
        """Report values of other peers outside of a reduction."""
        shown = format_expression(node)
        message = f"{shown} of {self.part.name} is a value of each other peer, and one is due here"
        self._report("E506", node, message, hint=f"mean({shown}), or sum, max, min")
        return ZERO

    def _receive(self, function: str, argument: Expr) -> Expr:
        """Return the symbol of a reduction, or the parameter of a subsystem that counts its senders."""
        link = self.link or ""
        if function == "count":
            if not self.part.component.sends:
                message = "count(others) counts those that are heard, and this component sends nothing"
                self.mistakes.add("E506", self.where.location, message, hint="sends: {x: sample(object.x)}")
            return Name((count_of(link),))
        of = self._whole(argument, received=True)
        symbol = format_expression(Call(function, (of,)))
        return self._crossed(ReceiveCrossing(symbol, function, of, link, self.where.location))

    def _moved_back(self, function: str, node: Expr) -> Expr | None:
        """Return the node of a previous or start value, according to the function."""
        back = function == "previous"
        if isinstance(node, Name):
            head = node.parts[0]
            if node.parts in self.names.variables or (head == OTHERS and back):
                return Call(function, (node,))
            if head not in ("time", OTHERS):
                return node  # a parameter, the same at all times
        elif not isinstance(node, Call) or node.function in POINTWISE:
            return None
        elif (back and node.function in ("mean", "sum")) and not any(
            isinstance(call, Call) and call.function == "age" for call in walk(node)
        ):
            return None  # of previously received values
        name = next(text for n in count(1) if (text := f"y{n}",) not in self.names.dimensions)
        shown = format_expression(node)
        hint = f"{name} = {shown}, and {name}: {{unit: …, start: 0}} among the variables"
        self._report("E505", node, f"{shown} inside {function}", expected="a variable", hint=hint)
        return ZERO

    def _hold(self, held: Expr, *delay: Expr) -> Expr:
        """Give an expression that is held a variable, which a clock of this part computes."""
        where = self.where
        dimension = self.names.dimension_of_held(held, where.text, where.location)
        variable = shown = self._whole(held)
        if dimension is not None:
            used = {name for (name, *_) in self.names.variables}
            free = (text for n in count(1) if (text := f"held{n}") not in used)
            variable = Name((*self.part.name.split("."), next(islice(free, len(self.held), None))))
            equation = FlatEquation(variable, shown, self.part.name, self.clock, where.location)
            self.held.append((FlatVariable(format_expression(variable), dimension), equation))
        for moving in (name for item in delay for name in names(item)):
            if moving.parts in self.names.variables or moving.parts[0] in ("time", OTHERS):
                subject, got = "the delay of a hold", format_expression(moving)
                self._report("E505", moving, subject, expected="parameters only", got=got)
        call = Call("hold", (variable, *map(self._whole, delay)))
        name, symbol, text = map(format_expression, (variable, call, shown))
        return self._crossed(HoldCrossing(symbol, name, (*call.arguments[1:], ZERO)[0], text, where.location))

    def _sample(self, node: Call) -> Expr:
        argument, clock = self._whole(node.arguments[0]), self.clock
        component = self.part.component
        roles = {p.name: p.role for p in component.parameters if isinstance(p, Reference)}
        clocks = sorted(name for name, role in roles.items() if role == "clock")
        for named in node.arguments[1:]:
            if (name := format_expression(named)) in clocks:
                clock = self.references[name]
            else:
                message, expected = (
                    "the second argument of sample",
                    "a parameter of this component that is a clock",
                )
                self._report("E504", named, message, expected=expected, got=name)
        if clock is None:
            message = f"{component.name} samples but has no parameter that names one clock"
            hint = "parameters: {clock: clock}"
            if clocks:
                message = f"{component.name} samples, and has clocks {', '.join(clocks)}"
                written = self.where.text[node.arguments[0].start : node.arguments[0].end]
                hint = f"sample({written}, {clocks[0]})"
            self._report("E504", node, message, hint=hint)
        clock = clock or "?"
        symbol = format_expression(Call("sample", (argument, Name((clock,)))))
        return self._crossed(SampleCrossing(symbol, clock, argument))

    def _name(self, node: Name) -> Expr:
        head, *rest = node.parts
        part, component = self.part.name.split("."), self.part.component
        if head.startswith(INTERVAL):
            return Name((self.references[head.removeprefix(INTERVAL)[:-1]], "period"))
        if head == OTHERS:
            return Name((OTHERS, *part, *rest))
        if rest:
            return Name((*part, *self.passed.get(head, (head,)), *rest))
        if head in ("peers", "time"):
            return node
        declared, whole = component.parameter(head), Name((*part, head))
        words = {word: value for number in component.numbers for word, value in number.words}
        if head in words and declared is None:
            return NumberLiteral(words[head])
        divided = self.part.shared and getattr(declared, "divided", False)
        return Call("/", (whole, Name(("peers",)))) if divided else whole
