"""The numbers of a scene by name, its groups, and who hears whom: all of a compiled model but its functions.

Takes: `Scene`, and the kinds once they are written. Gives: `Timings`, parameters, groups, links, clocks.
Guarantees: periods, phases and delays stay exact; what depends on a name has its formula.
Does not: write functions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from graphlib import TopologicalSorter

import numpy as np

from apc.compiler.compiled import (
    PEERS,
    Channel,
    Clock,
    Column,
    Formula,
    Group,
    Kind,
    Link,
    Loss,
    PairDelay,
    Parameter,
    Timing,
    count_of,
    group_count,
)
from apc.compiler.components.component import Number as NumberParameter
from apc.compiler.components.component import Variable
from apc.compiler.crowd import COUNT_ABOUT, heard_sums, with_heard
from apc.compiler.equations.clocks import HoldCrossing
from apc.compiler.equations.flatten import FlatKind
from apc.compiler.errors import ApcError, Mistake, Mistakes, Place
from apc.compiler.language.evaluation import evaluate, formula_of
from apc.compiler.language.expression import Expr, Name, Number, transform
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import Value, renamed
from apc.compiler.scene.channels import SceneChannel
from apc.compiler.scene.links import SceneLink
from apc.compiler.scene.scene import Scene, SceneGroup
from apc.compiler.words import enumerated

NO_DELAY = "no delay"
MOST_DEAF = 3  # names of peers that hear nobody in one message
LOSS_ABOUT = (
    "probability that a good link turns bad after a packet",
    "probability that a bad link turns good after a packet",
    "probability that a bad link loses a packet",
    "probability that a good link loses a packet",
)


def period_of(clock: str) -> str:
    """Return the name of a clock's period among timings and parameters."""
    return f"{clock}.period"


class Timings:
    """The periods, phases and delays that the model refers to, each once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._parts = {part.name: dict(part.values) for part in scene.parts}
        self._periods = {period_of(clock.name): clock.period for clock in scene.clocks}
        self._found: dict[str, Timing] = {}

    @property
    def found(self) -> tuple[Timing, ...]:
        """All timings in use, in the order of first use."""
        return tuple(self._found.values())

    def use(self, name: str, value: Value) -> str:
        """Register a timing and return its name."""
        self._found.setdefault(name, Timing(name, value.number, _formula(value.expression)))
        return name

    def delay(self, hold: HoldCrossing, kind: FlatKind) -> str:
        """Register the delay of a hold: none, a parameter of a part, or an expression over such."""
        expression = hold.delay
        own = {name: (group, value) for name, group, value in kind.delays}
        if isinstance(expression, Number) and expression.value == 0:
            self._found.setdefault(NO_DELAY, Timing(NO_DELAY, Fraction(0)))
            return NO_DELAY
        if isinstance(expression, Name):
            return self._parameter(".".join(expression.parts), own)
        named: list[str] = []

        def register(node: Expr) -> Expr | None:
            if isinstance(node, Name) and node.parts != (PEERS,):
                named.append(self._parameter(".".join(node.parts), own))
                return Name(tuple(named[-1].split(".")))
            return None

        tree = transform(expression, register)
        number = Fraction(evaluate(tree, self._number, place=Place(self.scene.name)))
        name = f"delay of {hold.variable}" + (f" at {kind.name}" if own else "")
        self._found.setdefault(name, Timing(name, number, formula_of(tree)))
        return name

    def _parameter(self, name: str, own: dict[str, tuple[str, Value]]) -> str:
        """Register a delay parameter, under the group's name if it sets its own."""
        if name in self._periods:
            return self.use(name, self._periods[name])
        if name not in own:
            part, _, parameter = name.rpartition(".")
            return self.use(name, self._parts[part][parameter])
        group, value = own[name]
        if value.expression is None:
            return self.use(f"{group}.{name}", value)

        def whole(parts: tuple[str, ...]) -> tuple[str, ...]:
            """Return what a group's own number depends on: its own as well, if it has one of that name."""
            other = ".".join(parts)
            return tuple(self._parameter(other, own).split(".")) if other in own else parts

        return self.use(f"{group}.{name}", replace(value, expression=renamed(value.expression, whole)))

    def _number(self, parts: tuple[str, ...]) -> Fraction:
        return Fraction(self.scene.peers) if parts == (PEERS,) else self._found[".".join(parts)].value


def used_links(
    scene: Scene, kinds: Sequence[Kind], timings: Timings
) -> tuple[list[Link], list[tuple[str, str]]]:
    """Return the links over which something is heard, and those left out with the reason.

    Parameters
    ----------
    scene, kinds
        All links, and who hears over which.
    timings
        Takes the delays of the links that are used.
    """
    heard = {receive.link for kind in kinds for clock in kind.clocks for receive in clock.receives}
    links, dropped = [], []
    for link in scene.links:
        if link.name in heard:
            links.append(_link(link, timings))
        else:
            dropped.append((link.name, "nobody hears what it would carry"))
    return links, dropped


def check_channels(scene: Scene, kinds: Sequence[Kind]) -> None:
    """Refuse a link over which some peers send what others don't: who hears it would hear them send nothing.

    Raises
    ------
    ApcError
        E215 for each such link.
    """
    mistakes = Mistakes()
    for link in scene.links:
        sent = {kind.name: one.channels for kind in kinds for one in kind.sends if one.link == link.name}
        every = dict.fromkeys(channel for channels in sent.values() for channel in channels)
        missing = [(name, one) for one in every for name, channels in sent.items() if one not in channels]
        if missing:
            name, channel = missing[0]
            what = f"{channel} travels over {link.name}, and those of {name} send other values over it"
            hint = "a link of its own for what only some groups send"
            mistakes.add("E215", link.place, what, hint=hint)
    mistakes.raise_if_any()


def check_heard(scene: Scene, kinds: Mapping[str, Kind]) -> None:
    """Refuse a graph, given arc by arc, that leaves a peer deaf which takes a mean, maximum or minimum.

    Parameters
    ----------
    scene
        The scene.
    kinds
        The kind of each group, by its name.

    Raises
    ------
    ApcError
        E801 for each such link.
    """
    mistakes = Mistakes()
    counts = [group.count for group in scene.groups]
    for link in scene.links:
        if link.graph.shape != "arcs":
            continue  # on any other everybody hears somebody
        taken = [_taken(kinds[group.name], link.name) for group in scene.groups]
        sends = [any(one.link == link.name for one in kinds[group.name].sends) for group in scene.groups]
        senders, receivers = link.graph.arcs.T
        deaf = np.repeat([bool(one) for one in taken], counts)
        deaf[receivers[np.repeat(sends, counts)[senders]]] = False
        if deaf.any():
            starts = np.cumsum([0, *counts])
            alone = [
                group.name
                for group, start in zip(scene.groups, starts, strict=False)
                if deaf[start : start + group.count].all()
            ]
            places = np.flatnonzero(deaf).tolist()
            owners = (np.searchsorted(starts, places, "right") - 1).tolist()
            names = [
                f"{scene.groups[owner].name}[{place - starts[owner] + 1}]"
                for place, owner in zip(places[:MOST_DEAF], owners, strict=False)
            ]
            if len(places) > MOST_DEAF:
                names.append(f"{len(places) - MOST_DEAF} more")
            hear = f"{enumerated(names)} {'hears' if len(places) == 1 else 'hear'} nobody over {link.name}"
            what = f"{hear}: there is no {taken[owners[0]]} over nobody"
            others = [group.name for group in scene.groups if group.name not in alone]
            hint = f"an arc to {'each' if len(places) > 1 else names[0]} in its graph"
            if alone and others:
                hint += f", or at: [{', '.join(others)}] in what uses {link.name}"
            mistakes.add("E801", link.place, what, hint=hint)
    mistakes.raise_if_any()


def _taken(kind: Kind, link: str) -> str:
    """Return what a kind takes over those it hears over a link that is nothing over nobody, if anything."""
    found = (one.operator for clock in kind.clocks for one in clock.receives if one.link == link)
    return next((one for one in found if one in ("mean", "max", "min")), "")


def _link(link: SceneLink, timings: Timings) -> Link:
    delays = tuple(
        PairDelay(
            pair.sender,
            pair.receiver,
            timings.use(f"{link.name}.delays.{pair.sender}.{pair.receiver}", pair.delay),
        )
        for pair in link.delays
    )
    delay = timings.use(f"{link.name}.delay", link.delay)
    channel = None if link.channel is None else _channel(link.name, link.channel, timings)
    return Link(link.name, link.clock, delay, link.graph, delays, channel)


def _channel(link: str, channel: SceneChannel, timings: Timings) -> Channel:
    return Channel(
        Loss(*(name for name, _ in channel.loss)) if channel.loss else None,
        None if channel.jitter is None else timings.use(f"{link}.jitter", channel.jitter),
        channel.distribution,
        channel.reorder,
        channel.on_loss,
        channel.trace,
    )


def used_clocks(
    scene: Scene, kinds: Sequence[Kind], links: Sequence[Link], timings: Timings
) -> tuple[list[Clock], list[tuple[str, str]]]:
    """Return the clocks that something ticks with, and those left out with the reason.

    Parameters
    ----------
    scene
        The scene, all of its clocks.
    kinds, links
        What ticks.
    timings
        Takes the periods and phases that are used.
    """
    used = {link.clock for link in links} | {clock.clock for kind in kinds for clock in kind.clocks}
    clocks, dropped = [], []
    for clock in scene.clocks:
        if clock.name in used:
            period = timings.use(period_of(clock.name), clock.period)
            phase, place = timings.use(f"{clock.name}.phase", clock.phase), clock.period.place
            clocks.append(Clock(clock.name, period, phase, place.line, place.column))
        else:
            dropped.append((clock.name, "nothing ticks with it"))
    return clocks, dropped


def compiled_groups(
    scene: Scene, kinds: Sequence[Kind], kind_of: Mapping[str, int], links: Sequence[Link], timings: Timings
) -> tuple[Group, ...]:
    """Return the groups, with how many peers each hears: a setting that is a timing follows that timing.

    Parameters
    ----------
    scene
        The scene.
    kinds, kind_of
        The kinds of peers, and the place among them of each group's.
    links
        The links that are used.
    timings
        What is in the schedule.

    Raises
    ------
    ApcError
        E215 a graph some of whose peers send nothing.
    """
    exact = {timing.name for timing in timings.found}
    found = []
    for group in scene.groups:
        values = []
        for name, value in group.values:
            timing = (group.name, *name.split("."))
            own = replace(value, expression=Name(timing)) if ".".join(timing) in exact else value
            values.append(compiled_parameter(scene, name, own))
        columns = tuple(Column(name, numbers) for name, numbers in group.columns)
        found.append(Group(group.name, group.count, kind_of[group.name], tuple(values), columns))
    for link in links:
        silent = [
            group.name
            for group in found
            if not any(sending.link == link.name for sending in kinds[group.kind].sends)
        ]
        counted = any(count_of(link.name) in kind.parameters for kind in kinds)
        if silent and counted and link.graph.shape != "complete":
            place = next(part.place for part in scene.links if part.name == link.name)
            what = f"the graph of {link.name} joins all peers, and those of {silent[0]} send nothing over it"
            raise ApcError(Mistake("E215", place, what))
    return with_heard(found, kinds, links)


def with_rounded(scene: Scene, kind: Kind, links: Sequence[Link]) -> Kind:
    """Return a kind that knows which counts of peers heard are rounded.

    Raises
    ------
    ApcError
        E217 sums of weights that differ and are one in floats.
    """
    rounded = []
    for link in links:
        if count_of(link.name) in kind.parameters and link.graph.shape == "arcs":
            values = heard_sums(link, scene.peers).values
            if len(set(map(float, values))) < len(values):
                place = next(part.place for part in scene.links if part.name == link.name)
                what = f"what two peers hear over {link.name} adds up to sums that doubles can't tell apart"
                raise ApcError(Mistake("E217", place, what, hint="weights of at most 15 digits"))
            if any(Fraction(float(value)) != value for value in values):
                rounded.append((kind.parameters.index(count_of(link.name)), tuple(sorted(values))))
    return replace(kind, rounded=tuple(rounded))


def compiled_parameter(scene: Scene, name: str, value: Value) -> Parameter:
    """Return a number of the scene as a parameter, with its unit, bounds and what it is about.

    Parameters
    ----------
    scene
        Knows what the component of a part declares.
    name
        The whole name: `contact.stiffness`, or that of a named number, which has no bounds.
    value
        The number, in SI.
    """
    unit = format_dimension(value.dimension)
    number, formula = float(value.number), _formula(value.expression)
    part, _, own = name.rpartition(".")
    if not part:
        return Parameter(name, unit, number, formula, exact=value.number)
    component = scene.part(part).component
    declared = component.parameter(own)
    if isinstance(declared, NumberParameter):
        return Parameter(
            name,
            unit,
            number,
            formula,
            None if declared.minimum is None else float(declared.minimum),
            declared.open_minimum,
            None if declared.maximum is None else float(declared.maximum),
            declared.about,
            value.number,
        )
    variable = component.variable(own)
    assert variable is not None
    return _start_value(name, value, variable)


def _start_value(name: str, value: Value, variable: Variable) -> Parameter:
    """Return the start value of a variable as a parameter of this whole name."""
    unit, formula = format_dimension(value.dimension), _formula(value.expression)
    about = f"start value: {variable.about}"
    return Parameter(name, unit, float(value.number), formula, about=about, exact=value.number)


def all_parameters(scene: Scene, kinds: Sequence[Kind], links: Sequence[Link]) -> tuple[Parameter, ...]:
    """Return every parameter of the scene: named ones, each part's, start values in use, those of links.

    Parameters
    ----------
    scene
        Their values.
    kinds, links
        What is compiled: whose start values and counts are in use, and which links.
    """
    found = {name: compiled_parameter(scene, name, value) for name, value in scene.parameters}
    needed = {name for kind in kinds for name in kind.parameters}
    for part in scene.parts:
        for own, value in part.values:
            name = f"{part.name}.{own}"
            found[name] = compiled_parameter(scene, name, value)
        given = dict(part.starts)
        for variable in part.component.variables:
            name = f"{part.name}.{variable.name}"
            if name in needed and variable.start is not None:
                default = Value(variable.start, variable.unit.dimension, None, part.place)
                found[name] = _start_value(name, given.get(variable.name, default), variable)
    for link in scene.links:
        if count_of(link.name) in needed:  # every group has its own value
            name = count_of(link.name)
            found[name] = Parameter(name, "1", float(scene.peers - 1), about=COUNT_ABOUT)
        if link.channel is not None and any(used.name == link.name for used in links):
            found |= {
                name: Parameter(
                    name,
                    "1",
                    float(value.number),
                    _formula(value.expression),
                    minimum=0.0,
                    maximum=1.0,
                    about=about,
                    exact=value.number,
                )
                for (name, value), about in zip(link.channel.loss, LOSS_ABOUT, strict=False)
            }
    for clock in scene.clocks:
        if (name := period_of(clock.name)) in needed:  # by `interval`: the same number as the timing
            value, about = clock.period, f"from one tick of {clock.name} to the next"
            formula = _formula(value.expression)
            found[name] = Parameter(
                *(name, "s", float(value.number), formula, 0.0, True), about=about, exact=value.number
            )
    for group in scene.groups:
        name = group_count(group.name)
        formula = _formula(None if group.counted is None else group.counted.expression)
        exact = Fraction(group.count)
        about = f"number of peers of group {group.name}"
        most = _most_peers(scene, group)
        found[name] = Parameter(
            name, "1", float(exact), formula, minimum=1.0, maximum=most, about=about, exact=exact
        )
    found[PEERS] = Parameter(PEERS, "1", float(scene.peers), about="number of peers")
    return tuple(found.values())


def _most_peers(scene: Scene, group: SceneGroup) -> float | None:
    """Return how many peers a group can have, the others as they are, by the components that say so."""
    counts = {one.name: one.count for one in scene.groups}
    room = [
        part.component.peers - sum(counts[name] for name in part.groups if name != group.name)
        for part in scene.parts
        if part.component.peers and group.name in part.groups
    ]
    return float(min(room)) if room else None


def followers_of(
    parameters: Sequence[Parameter], timings: Sequence[Timing], groups: Sequence[Group]
) -> tuple[str, ...]:
    """Return the names of all numbers that follow from others, each behind what it follows from."""
    found: dict[str, dict[str, None]] = {}
    numbers: list[Parameter | Timing] = [*parameters, *timings]
    for one in (*numbers, *(value for group in groups for value in group.values)):
        if one.formula is not None:
            found.setdefault(one.name, {}).update(dict.fromkeys(one.formula.names))
    return tuple(name for name in TopologicalSorter(found).static_order() if name in found)


def _formula(expression: Expr | None) -> Formula | None:
    return None if expression is None else formula_of(expression)
