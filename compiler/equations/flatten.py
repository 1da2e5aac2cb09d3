"""Flattening of a topology: per peer type, the scalar equations after connection.

Takes: `Topology`. Gives: `flatten`, a `FlatSystem`; `flatten_single`, for one component. `FlatPeerType`,
`FlatVariable`, `FlatEquation`, `FlatSend`; `SampleCrossing`, `HoldCrossing`, `PreviousCrossing`,
`ReceiveCrossing`.
Guarantees: peers with the same structure share one `FlatPeerType`, independent of parameter values and
counts. Names are qualified (`contact.a.x`). Connected potentials are equal, connected flows sum to zero.
Options are resolved. Values pass between continuous time, clocks and peers only through a named crossing.
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
CONNECTION = "connection"  # the origin of an equation that belongs to no part

# The functions without memory.
POINTWISE = frozenset(("max", "min", "abs", "sign", "sqrt", "floor", "atan2", *SMOOTH, *LEVELS))
REDUCTIONS = ("mean", "sum", "max", "min", "count")


@dataclass(frozen=True, slots=True)
class FlatVariable:
    """A scalar unknown of one subsystem; `declared` is its declaration in a component, None if undeclared."""

    name: str
    dimension: Dimension
    declared: ComponentVariable | None = None

    @property
    def start(self) -> bool:
        """Whether the variable has a start value, a parameter with the name of the variable."""
        return self.declared is not None and self.declared.start is not None

    @property
    def limit(self) -> str:
        """The parameter of the part that bounds the absolute value; empty if there is none."""
        return "" if self.declared is None else self.declared.limit


@dataclass(frozen=True, slots=True)
class FlatEquation:
    """An equation `left = right` with qualified names, from a part or a connection.

    `clock` is the part's clock.

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
    """A value of a part sent over a link, sampled at the ticks of the link's clock."""

    name: str
    link: str
    expression: Expr
    dimension: Dimension
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class SampleCrossing:
    """The sample of a continuous expression at t⁻ of a clock's tick.

    In clocked equations the sample is represented by `symbol`.
    """

    symbol: str
    clock: str
    expression: Expr


@dataclass(frozen=True, slots=True)
class HoldCrossing:
    """The zero-order hold of a clocked variable; `symbol` represents it in continuous equations.

    A value is held from its tick + `delay` on. `shown` is the held expression as text; `clock` is empty until
    determined.
    """

    symbol: str
    variable: str
    delay: Expr
    shown: str
    location: SourceLocation
    clock: str = ""


@dataclass(frozen=True, slots=True)
class PreviousCrossing:
    """The value of a clocked variable at the previous tick of its clock, represented by `symbol`."""

    symbol: str
    variable: str
    location: SourceLocation
    clock: str = ""


@dataclass(frozen=True, slots=True)
class ReceiveCrossing:
    """A reduction over the other peers whose packets are received over `link`, represented by `symbol`.

    `operator` is applied to the values of `argument` for all other peers. In `argument`, the names `others.…`
    are the values sent by a peer, `previous(others.…)` the values received at the previous tick, and
    `RECEIVED_AGE` the age of its packet.
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
    """The equations of all peers with the same structure.

    `delays` are computational delays set by the only group of this peer type: (qualified name, value).
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
    """The equations of a topology; every group of peers belongs to one peer type."""

    topology: Topology
    peer_types: tuple[FlatPeerType, ...]


def flatten(topology: Topology, *, linear: bool = False) -> FlatSystem:
    """Return the equations of every peer type; with `linear` the equations of a linear analysis.

    Groups with the same parts and options have one peer type, unless they set a delay. Raises
    ApcError with all errors.
    """
    mistakes = Mistakes(topology.names)
    structures: dict[object, list[GroupDeclaration]] = {}
    for group in topology.groups:
        structure = tuple(
            (part.name, part.component.name) for part in topology.parts if group.name in part.groups
        )
        structures.setdefault((structure, tuple(sorted(group.words))), []).append(group)
    peer_types = []
    for groups in structures.values():
        representative = groups[0]
        parts = [
            _with_words(part, dict(representative.words))
            for part in topology.parts
            if representative.name in part.groups
        ]
        peer_type = _flat_peer_type("", parts, mistakes, linear=linear)
        connections = connection_equations(parts, [group.name for group in groups], mistakes)
        equations = (
            FlatEquation(left, right, CONNECTION, None, location) for left, right, location in connections
        )
        peer_type = replace(peer_type, equations=(*peer_type.equations, *equations))
        delays = _delay_names(peer_type)
        # Each peer type has one schedule: a group that sets a delay becomes a peer type of its own.
        members_by_delay: dict[str, tuple[list[str], Named[ScalarValue]]] = {}
        for group in groups:
            for name in delays.intersection(name for name, _ in group.columns):
                message = f"{name} must be equal for all peers of a group"
                mistakes.add("E211", group.location, message, advice="define a separate group for each delay")
            delay_settings = tuple(setting for setting in group.values if setting[0] in delays)
            members_by_delay.setdefault(group.name if delay_settings else "", ([], delay_settings))[0].append(
                group.name
            )
        for members, delay_settings in members_by_delay.values():
            peer_types.append(
                replace(peer_type, name=" and ".join(members), groups=tuple(members), delays=delay_settings)
            )
    mistakes.raise_if_any()
    return FlatSystem(topology, tuple(peer_types))


def _delay_names(peer_type: FlatPeerType) -> set[str]:
    """Return the numbers of parts that the delay of a hold depends on: these determine the schedule."""
    delays = [crossing.delay for crossing in peer_type.crossings if isinstance(crossing, HoldCrossing)]
    texts = {format_expression(name) for delay in delays for name in names(delay)}
    for part in reversed(peer_type.parts):  # a number of an inner part depends on numbers of the outer part
        for name, value in part.values:
            if f"{part.name}.{name}" in texts and value.expression is not None:
                texts.update(map(format_expression, names(value.expression)))
    return texts


def flatten_single(component: Component, location: SourceLocation, mistakes: Mistakes) -> FlatPeerType:
    """Return the equations of one component, with its own names of clocks and links and the first word of
    each option.

    Equations of inner parts are omitted.
    """
    options = tuple((p.name, p.words[0]) for p in component.parameters if isinstance(p, Option))
    references = tuple((p.name, p.name) for p in component.parameters if isinstance(p, Reference))
    part = PartInstance(
        component.name, "", component, (), options, references, (), (), (), False, (), location
    )
    return _flat_peer_type(component.name, [part], mistakes)


def _with_words(part: PartInstance, words: Mapping[str, str]) -> PartInstance:
    """Return a part with the options, clocks and links that a group of peers sets."""

    def with_settings(named: Named[str]) -> Named[str]:
        """Return the words of the part, replaced by the words of the group."""
        return tuple((name, words.get(f"{part.name}.{name}", word)) for name, word in named)

    return replace(part, options=with_settings(part.options), references=with_settings(part.references))


def _flat_peer_type(
    name: str, parts: Sequence[PartInstance], mistakes: Mistakes, *, linear: bool = False
) -> FlatPeerType:
    """Return the equations of parts as a peer type, without the connections of the parts.

    Parameters
    ----------
    name, parts
        The name of the peer type, and its parts.
    mistakes
        The collector of errors.
    linear
        Whether the equations of a linear analysis are used instead.
    """
    variables: list[FlatVariable] = []
    equations: list[FlatEquation] = []
    sends: list[FlatSend] = []
    crossings: dict[str, Crossing] = {}
    for part in parts:
        writer, component = _PartWriter(part, crossings, mistakes), part.component
        declared: list[tuple[str, Dimension, ComponentVariable | None]] = [
            *((variable.name, variable.unit.dimension, variable) for variable in component.variables),
            *((undeclared, dimension, None) for undeclared, dimension in component.locals),
            *(
                (f"{connector}.{variable.name}", variable.unit.dimension, None)
                for connector, type_ in component.connectors
                if connector not in writer.passed  # otherwise the inner part has these variables
                for variable in (*type_.potentials, *type_.flows)
            ),
        ]
        variables += [
            FlatVariable(f"{part.name}.{own_name}", unit, variable) for own_name, unit, variable in declared
        ]
        for equation in component.linear_equations if linear else component.equations:
            left, right = (writer.written(item, equation) for item in (equation.left, equation.right))
            equations.append(FlatEquation(left, right, part.name, writer.clock, equation.location, equation))
        for send in component.sends:
            if writer.link is None:
                message = f"{component.name} sends {send.name} but has no link parameter"
                mistakes.add("E504", send.location, message, advice="add link: link to its parameters")
                continue
            expression = writer.written(transform(send.expression, _unsampled), send)
            qualified_name = f"{part.name}.{send.name}"
            sends.append(FlatSend(qualified_name, writer.link, expression, send.dimension, send.location))
        variables += [variable for variable, _ in writer.held]
        equations += [equation for _, equation in writer.held]
    unknowns, crossing_list = tuple(variables), tuple(crossings.values())
    return FlatPeerType(name, (), (), tuple(parts), unknowns, tuple(equations), crossing_list, tuple(sends))


def _unsampled(node: Expr) -> Expr | None:
    """Return the argument of a sample, without samples inside: a sent value is evaluated at the
    link's tick.
    """
    match node:
        case Call("sample", (argument, *_)):
            return transform(argument, _unsampled)
        case Call("hold"):
            return node
    return None


class _PartWriter:
    """Returns a component's expressions with qualified names, and collects a symbol for each crossing.

    A held expression becomes a variable with an equation, in `held`; `where` is the current equation or sent
    value.
    """

    def __init__(self, part: PartInstance, crossings: dict[str, Crossing], mistakes: Mistakes) -> None:
        """Collect the clock, the link, the passed connectors and the names of a part."""
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
        return self._qualified(expression)

    def _qualified(self, expression: Expr, *, received: bool = False) -> Expr:
        """Return an expression with qualified names; `received` allows values of other peers."""

        def replacement(node: Expr) -> Expr | None:
            """Return the node with qualified names or the symbol of a crossing; None if the node remains."""
            reads = isinstance(node, Name | Call) and any(name.parts[0] == OTHERS for name in names(node))
            match node:
                case Name():
                    return self._name(node) if received or not reads else self._report_unreduced(node)
                case Call(function, (argument,)) if reads and function in REDUCTIONS:
                    return self._reduction(function, argument)
                case Call("age" | "previous", (Name() as name,)) if reads:
                    return Name((self._call_name(node, name),)) if received else self._report_unreduced(node)
                case Call("sample"):
                    return self._sample(node)
                case Call("hold"):
                    return self._hold(*node.arguments)
                case Call("initial", (Name() as name,)) if name.parts in self.names.variables:
                    return Name((self._call_name(node, name),))
                case Call("previous", (Name() as name,)) if name.parts in self.names.variables:
                    variable = format_expression(self._name(name))
                    return self._add_crossing(
                        PreviousCrossing(self._call_name(node, name), variable, self.where.location)
                    )
                case Call("previous" | "initial", (argument,)):
                    return transform(
                        transform(argument, partial(self._previous_or_initial, node.function)), replacement
                    )
            return None

        return transform(transform(expression, self._resolved_option), replacement)

    def _resolved_option(self, node: Expr) -> Expr | None:
        """Return the selected branch of a choice by an option, or the truth of a comparison.

        The result is None if the node remains.
        """
        match node:
            case Call("if", (condition, then, otherwise)) if (holds := self._holds(condition)) is not None:
                return transform(then if holds else otherwise, self._resolved_option)
        holds = self._holds(node)
        return None if holds is None else TRUE if holds else Call("not", (TRUE,))

    def _holds(self, node: Expr) -> bool | None:
        """Return whether a comparison of an option with a word is true; None for other expressions."""
        test = option_test(node, self.names.options)
        if test is None or not isinstance(node, Call):
            return None
        return (dict(self.part.options)[test[0].name] == test[1]) == (node.function == "==")

    def _call_name(self, call: Call, name: Name) -> str:
        """Return the symbol of a call such as `previous(x)`, with the qualified name."""
        return f"{call.function}({format_expression(self._name(name))})"

    def _add_crossing(self, crossing: Crossing) -> Name:
        """Store a crossing, and return the name that represents it."""
        self.crossings.setdefault(crossing.symbol, crossing)
        return Name((crossing.symbol,))

    def _report(
        self,
        code: str,
        node: Expr,
        message: str,
        *,
        expected: str = "",
        got: str = "",
        fix: str = "",
        advice: str = "",
    ) -> None:
        """Record an error located at a node of the current expression."""
        location = location_in(self.where.location, self.where.text, node.start)
        self.mistakes.add(code, location, message, expected=expected, got=got, fix=fix, advice=advice)

    def _report_unreduced(self, node: Name | Call) -> Expr:
        """Record the error E506 for values of the other peers outside of a reduction; return zero."""
        shown = format_expression(node)
        message = f"{shown} of {self.part.name}: expected one value, got one for each other peer"
        self._report(
            "E506", node, message, fix=f"mean({shown}), or sum({shown}), or max({shown}), or min({shown})"
        )
        return ZERO

    def _reduction(self, function: str, argument: Expr) -> Expr:
        """Return the symbol of a reduction over the other peers, or the parameter for the number of
        senders.
        """
        link = self.link or ""
        if function == "count":
            if not self.part.component.sends:
                message = "count(others) is the number of received peers, but this component does not send"
                fix = f"sends: {{x: sample({self.names.example_of('x')})}}"
                self.mistakes.add("E506", self.where.location, message, fix=fix)
            return Name((count_of(link),))
        operand = self._qualified(argument, received=True)
        symbol = format_expression(Call(function, (operand,)))
        return self._add_crossing(ReceiveCrossing(symbol, function, operand, link, self.where.location))

    def _previous_or_initial(self, function: str, node: Expr) -> Expr | None:
        """Return a node with its variables replaced by their previous or start values, according to
        `function`.

        Constants remain; None means that the arguments of the node are replaced.
        """
        is_previous = function == "previous"
        if isinstance(node, Name):
            head = node.parts[0]
            if node.parts in self.names.variables or (head == OTHERS and is_previous):
                return Call(function, (node,))
            if head not in ("time", OTHERS):
                return node  # a parameter, the same at all times
        elif not isinstance(node, Call) or node.function in POINTWISE:
            return None
        elif (is_previous and node.function in ("mean", "sum")) and not any(
            isinstance(call, Call) and call.function == "age" for call in walk(node)
        ):
            return None  # the reduction of previously received values
        name = next(text for n in count(1) if (text := f"y{n}",) not in self.names.dimensions)
        shown = format_expression(node)
        advice = f"add the equation {name} = {shown} and the variable {name}: {{unit: …, start: 0}}"
        self._report("E505", node, f"{shown} inside {function}", expected="a variable", advice=advice)
        return ZERO

    def _hold(self, held: Expr, *delay: Expr) -> Expr:
        """Return the symbol of a hold.

        A held expression becomes a variable computed at the ticks of the part's clock.
        """
        where = self.where
        dimension = self.names.dimension_of_held(held, where.text, where.location)
        variable = shown = self._qualified(held)
        if dimension is not None:
            used = {name for (name, *_) in self.names.variables}
            unused = (text for n in count(1) if (text := f"held{n}") not in used)
            variable = Name((*self.part.name.split("."), next(islice(unused, len(self.held), None))))
            equation = FlatEquation(variable, shown, self.part.name, self.clock, where.location)
            self.held.append((FlatVariable(format_expression(variable), dimension), equation))
        for moving in (name for item in delay for name in names(item)):
            if moving.parts in self.names.variables or moving.parts[0] in ("time", OTHERS):
                subject, got = "delay of hold", format_expression(moving)
                self._report("E505", moving, subject, expected="an expression in parameters", got=got)
        call = Call("hold", (variable, *map(self._qualified, delay)))
        name, symbol, text = map(format_expression, (variable, call, shown))
        return self._add_crossing(
            HoldCrossing(symbol, name, (*call.arguments[1:], ZERO)[0], text, where.location)
        )

    def _sample(self, node: Call) -> Expr:
        """Return the symbol of a sample at the ticks of a clock: the one named, else the only clock of
        the part.
        """
        argument, clock = self._qualified(node.arguments[0]), self.clock
        component = self.part.component
        roles = {p.name: p.role for p in component.parameters if isinstance(p, Reference)}
        clocks = sorted(name for name, role in roles.items() if role == "clock")
        for named in node.arguments[1:]:
            if (name := format_expression(named)) in clocks:
                clock = self.references[name]
            else:
                message, expected = (
                    "second argument of sample",
                    "a clock parameter of this component",
                )
                self._report("E504", named, message, expected=expected, got=name)
        if clock is None and len(node.arguments) == 1:
            message = f"{component.name} uses sample but has no clock parameter"
            fix, advice = "", "add clock: clock to its parameters"
            if clocks:
                message = (
                    f"{component.name} has several clocks ({', '.join(clocks)}); sample needs one of them"
                )
                written = self.where.text[node.arguments[0].start : node.arguments[0].end]
                fix, advice = f"sample({written}, {clocks[0]})", ""
            self._report("E504", node, message, fix=fix, advice=advice)
        clock = clock or "?"
        symbol = format_expression(Call("sample", (argument, Name((clock,)))))
        return self._add_crossing(SampleCrossing(symbol, clock, argument))

    def _name(self, node: Name) -> Expr:
        """Return a name with the part's name in front.

        The interval of a clock is its period, a divided parameter of a shared part is divided by the number
        of peers, and a word is replaced by its value.
        """
        head, *tail = node.parts
        part, component = self.part.name.split("."), self.part.component
        if head.startswith(INTERVAL):
            return Name((self.references[head.removeprefix(INTERVAL)[:-1]], "period"))
        if head == OTHERS:
            return Name((OTHERS, *part, *tail))
        if tail:
            return Name((*part, *self.passed.get(head, (head,)), *tail))
        if head in ("peers", "time"):
            return node
        declared, qualified = component.parameter(head), Name((*part, head))
        words = {word: value for number in component.numbers for word, value in number.words}
        if head in words and declared is None:
            return NumberLiteral(words[head])
        divided = self.part.shared and getattr(declared, "divided", False)
        return Call("/", (qualified, Name(("peers",)))) if divided else qualified
