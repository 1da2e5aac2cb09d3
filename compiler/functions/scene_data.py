"""The numbers of a scene by name, its groups, and who hears whom: all of a compiled model but its functions.

Takes: `Topology`, and the kinds once they are written. Gives: `Timings`, parameters, groups, links, clocks.
Guarantees: periods, phases and delays stay exact; what depends on a name has its formula.
Does not: write functions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from graphlib import TopologicalSorter
from itertools import islice

import numpy as np

from apc.compiler.compiled import (
    PEERS,
    Channel,
    Clock,
    Formula,
    Group,
    Link,
    Loss,
    PairDelay,
    Parameter,
    PeerColumn,
    PeerType,
    Timing,
    count_of,
    group_count,
)
from apc.compiler.components.component import ComponentVariable
from apc.compiler.components.component import NumberParameter as NumberParameter
from apc.compiler.equations.connections import ZERO
from apc.compiler.equations.flatten import FlatPeerType, HoldCrossing
from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND
from apc.compiler.language.evaluation import evaluate, formula_of
from apc.compiler.language.expression import Expr, Name, format_expression
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import ScalarValue, renamed
from apc.compiler.peer_counts import COUNT_ABOUT, heard_sums, with_heard
from apc.compiler.scene.groups import SceneGroup
from apc.compiler.scene.links import PROBABILITIES
from apc.compiler.scene.scene import Topology
from apc.compiler.words import enumerated

NO_DELAY = "no delay"
Path = tuple[str, ...]  # a name, between its dots


class Timings:
    """The periods, phases and delays that the model refers to, each once."""

    def __init__(self, scene: Topology) -> None:
        self.scene = scene
        self._values = {f"{clock.name}.period": clock.period for clock in scene.clocks}
        self._values |= {f"{part.name}.{name}": value for part in scene.parts for name, value in part.values}
        self._found: dict[str, Timing] = {}

    @property
    def found(self) -> tuple[Timing, ...]:
        """All timings in use, in the order of first use."""
        return tuple(self._found.values())

    def use(self, name: str, value: ScalarValue) -> str:
        """Register a timing and return its name."""
        self._found.setdefault(name, Timing(name, value.number, _formula(value.expression)))
        return name

    def delay(self, hold: HoldCrossing, kind: FlatPeerType) -> str:
        """Register the delay of a hold: none, a parameter of a part, or an expression over such."""
        if hold.delay == ZERO:
            return self.use(NO_DELAY, ScalarValue(ZERO.value, SECOND, None, SourceLocation("")))

        def number(parts: Path) -> Fraction:
            return Fraction(self.scene.peers) if parts == (PEERS,) else self._found[".".join(parts)].value

        tree = renamed(hold.delay, lambda parts: parts if parts == (PEERS,) else self._parameter(parts, kind))
        if isinstance(tree, Name):
            return format_expression(tree)
        value = Fraction(evaluate(tree, number, SourceLocation(self.scene.name)))
        name = f"delay of {hold.variable}" + (f" at {kind.name}" if kind.delays else "")
        return self.use(name, ScalarValue(value, SECOND, tree, hold.place))

    def _parameter(self, parts: Path, kind: FlatPeerType) -> Path:
        """Register a delay parameter, under the group's name if it sets its own; return its name's parts.

        What a group's own number depends on is its own as well, if it has one of that name.
        """
        name, own = ".".join(parts), dict(kind.delays)
        if name not in own:
            self.use(name, self._values[name])
            return parts
        tree = own[name].expression
        if tree is not None:
            tree = renamed(
                tree, lambda texts: self._parameter(texts, kind) if ".".join(texts) in own else texts
            )
        return tuple(self.use(f"{kind.groups[0]}.{name}", replace(own[name], expression=tree)).split("."))


def used_links(scene: Topology, kinds: Sequence[PeerType], timings: Timings) -> tuple[Link, ...]:
    """Return the links over which something is heard.

    Parameters
    ----------
    scene, kinds
        All links, and who hears over which.
    timings
        Takes the delays of the links that are used.
    """
    heard = {receive.link for kind in kinds for clock in kind.clocks for receive in clock.receives}
    links = []
    for link in (link for link in scene.links if link.name in heard):
        pairs = ((delay, f"{link.name}.delays.{delay.sender}.{delay.receiver}") for delay in link.delays)
        delays = tuple(
            PairDelay(scene_delay.sender, scene_delay.receiver, timings.use(name, scene_delay.delay))
            for scene_delay, name in pairs
        )
        delay, channel, its = timings.use(f"{link.name}.delay", link.delay), None, link.channel
        if its is not None:
            loss = Loss(*(name for name, _ in its.loss)) if its.loss else None
            jitter = None if its.jitter is None else timings.use(f"{link.name}.jitter", its.jitter)
            channel = Channel(loss, jitter, its.distribution, its.reorder, its.on_loss, its.trace)
        links.append(Link(link.name, link.clock, delay, link.graph, delays, channel))
    return tuple(links)


def used_clocks(
    scene: Topology, kinds: Sequence[PeerType], links: Sequence[Link], timings: Timings
) -> tuple[Clock, ...]:
    """Return the clocks that something ticks with.

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
    return tuple(
        Clock(
            clock.name,
            timings.use(f"{clock.name}.period", clock.period),
            timings.use(f"{clock.name}.phase", clock.phase),
            clock.period.place.line,
            clock.period.place.column,
        )
        for clock in scene.clocks
        if clock.name in used
    )


def check_links(scene: Topology, kinds: Sequence[PeerType], places: Sequence[int]) -> None:
    """Refuse a link whose peers can't all hear what they ask for.

    Parameters
    ----------
    scene, kinds
        The links, and who sends and hears over them.
    places
        The place of the kind of each group.

    Raises
    ------
    ApcError
        E215 a link over which some peers send what others don't: who hears it would hear them send nothing.
        E801 a graph, given arc by arc, that leaves a peer deaf which takes a mean, maximum or minimum.
    """
    mistakes = Mistakes()
    for link in scene.links:
        sent = [(kind.name, send.channels) for kind in kinds for send in kind.sends if send.link == link.name]
        every = [channel for _, channels in sent for channel in channels]
        missing = ((name, text) for text in every for name, channels in sent if text not in channels)
        for name, channel in islice(missing, 1):
            what = f"{channel} travels over {link.name}, and those of {name} send other values over it"
            hint = "a link of its own for what only some groups send"
            mistakes.add("E215", link.place, what, hint=hint)
    mistakes.raise_if_any()
    groups, counts = scene.groups, [group.count for group in scene.groups]
    for link in (link for link in scene.links if link.graph.shape == "arcs"):  # else all hear somebody
        owner = np.repeat(np.arange(len(groups)), counts)
        taken = [_taken(kinds[place], link.name) for place in places]
        sends = [any(send.link == link.name for send in kinds[place].sends) for place in places]
        senders, receivers = link.graph.arcs.T
        asking = np.flatnonzero(np.array(taken, dtype=bool)[owner])
        deaf = np.setdiff1d(asking, receivers[np.array(sends)[owner[senders]]])
        if not deaf.size:
            continue
        first = [(int(owner[place]), place) for place in deaf[:3]]
        names = [f"{groups[k].name}[{place - sum(counts[:k]) + 1}]" for k, place in first]
        if len(deaf) > len(names):
            names.append(f"{len(deaf) - len(names)} more")
        hear = f"{enumerated(names)} {'hears' if len(deaf) == 1 else 'hear'} nobody over {link.name}"
        what = f"{hear}: there is no {taken[first[0][0]]} over nobody"
        hint = f"an arc to {'each' if len(deaf) > 1 else names[0]} in its graph"
        hearing = np.bincount(owner[deaf], minlength=len(groups)) < counts
        if not hearing.all() and hearing.any():
            others = [group.name for group, hears in zip(groups, hearing, strict=True) if hears]
            hint += f", or at: [{', '.join(others)}] in what uses {link.name}"
        mistakes.add("E801", link.place, what, hint=hint)
    mistakes.raise_if_any()


def _taken(kind: PeerType, link: str) -> str:
    """Return what a kind takes over those it hears over a link that is nothing over nobody, if anything."""
    operators = (
        receive.operator for clock in kind.clocks for receive in clock.receives if receive.link == link
    )
    return next((text for text in operators if text in ("mean", "max", "min")), "")


def compiled_groups(
    scene: Topology, kinds: Sequence[PeerType], places: Sequence[int], links: Sequence[Link], timings: Timings
) -> tuple[Group, ...]:
    """Return the groups, with how many peers each hears: a setting that is a timing follows that timing.

    Parameters
    ----------
    scene
        The scene.
    kinds, places
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
    declared = _declared(scene)
    groups, declared = [], _declared(scene)
    for group, place in zip(scene.groups, places, strict=True):
        values = []
        for name, value in group.values:
            timing = f"{group.name}.{name}"
            own = replace(value, expression=Name(tuple(timing.split(".")))) if timing in exact else value
            values.append(_of_part(name, own, declared))
        columns = tuple(PeerColumn(name, numbers) for name, numbers in group.columns)
        groups.append(Group(group.name, group.count, place, tuple(values), columns))
    for link in (link for link in scene.links if link.graph.shape != "complete"):
        sending = [any(send.link == link.name for send in kind.sends) for kind in kinds]
        silent = [group.name for group in groups if not sending[group.kind]]
        if silent and any(count_of(link.name) in kind.parameters for kind in kinds):
            what = f"the graph of {link.name} joins all peers, and those of {silent[0]} send nothing over it"
            raise ApcError(Diagnostic("E215", link.place, what))
    return with_heard(groups, kinds, links)


def with_rounded(scene: Topology, kind: PeerType, links: Sequence[Link]) -> PeerType:
    """Return a kind that knows which counts of peers heard are rounded.

    Raises
    ------
    ApcError
        E217 sums of weights that differ and are one in floats.
    """
    places = {link.name: link.place for link in scene.links}
    rounded = []
    for link in links:
        if count_of(link.name) in kind.parameters and link.graph.shape == "arcs":
            values = set(heard_sums(link, scene.peers).tolist())
            if len(set(map(float, values))) < len(values):
                what = f"what two peers hear over {link.name} adds up to sums that doubles can't tell apart"
                raise ApcError(
                    Diagnostic("E217", places[link.name], what, hint="weights of at most 15 digits")
                )
            if any(Fraction(float(value)) != value for value in values):
                rounded.append((kind.parameters.index(count_of(link.name)), tuple(sorted(values))))
    return replace(kind, rounded=tuple(rounded))


# ---- numbers by name ----


def _named(
    name: str,
    value: ScalarValue,
    about: str = "",
    minimum: Fraction | float | None = None,
    maximum: Fraction | float | None = None,
    *,
    open_minimum: bool = False,
) -> Parameter:
    """Return a number as a parameter."""
    unit, formula = format_dimension(value.dimension), _formula(value.expression)
    least, most = (None if item is None else float(item) for item in (minimum, maximum))
    return Parameter(
        name,
        unit,
        float(value.number),
        formula,
        least,
        open_minimum,
        most,
        about=about,
        exact=value.number,
        display_unit=value.unit if value.unit != "1" else "",
    )


def _declared(scene: Topology) -> dict[str, NumberParameter | ComponentVariable]:
    """Return by whole name what declares each number and start value of the parts."""
    result: dict[str, NumberParameter | ComponentVariable] = {}
    for part in scene.parts:
        for declared in (part.component.variables, part.component.numbers):
            result |= {f"{part.name}.{item.name}": item for item in declared}
    return result


def _of_part(
    name: str, value: ScalarValue, all_declared: Mapping[str, NumberParameter | ComponentVariable]
) -> Parameter:
    """Return a number or start value of a part, with its bounds and what it is about."""
    declared = all_declared[name]
    if isinstance(declared, ComponentVariable):
        return _named(name, value, f"start value: {declared.about}")
    least, most = declared.minimum, declared.maximum
    return _named(name, value, declared.about, least, most, open_minimum=declared.open_minimum)


def all_parameters(
    scene: Topology, kinds: Sequence[PeerType], links: Sequence[Link]
) -> tuple[Parameter, ...]:
    """Return every parameter of the scene: named ones, each part's, start values in use, those of links.

    Parameters
    ----------
    scene
        Their values.
    kinds, links
        What is compiled: whose start values and counts are in use, and which links.
    """
    declared = _declared(scene)
    needed = {name for kind in kinds for name in kind.parameters}
    used = {link.name for link in links}
    parameters = [_named(name, value) for name, value in scene.parameters]
    for part in scene.parts:
        numbers = dict(part.values) | {
            own: value for own, value in part.all_starts if f"{part.name}.{own}" in needed
        }
        parameters += [_of_part(f"{part.name}.{own}", value, declared) for own, value in numbers.items()]
    for link in scene.links:
        if count_of(link.name) in needed:  # every group has its own value
            parameters.append(Parameter(count_of(link.name), "1", float(scene.peers - 1), about=COUNT_ABOUT))
        if link.channel is not None and link.name in used:
            probabilities = zip(link.channel.loss, PROBABILITIES.values(), strict=False)
            parameters += [_named(*number, about, 0, 1) for number, about in probabilities]
    for clock in scene.clocks:
        if (name := f"{clock.name}.period") in needed:  # by `interval`: the same number as the timing
            about = f"from one tick of {clock.name} to the next"
            parameters.append(_named(name, clock.period, about, 0, open_minimum=True))
    for group in scene.groups:
        expression = None if group.counted is None else group.counted.expression
        count = ScalarValue(Fraction(group.count), DIMENSIONLESS, expression, group.place)
        about, most = f"number of peers of group {group.name}", _most_peers(scene, group)
        parameters.append(_named(group_count(group.name), count, about, 1, most))
    parameters.append(Parameter(PEERS, "1", float(scene.peers), about="number of peers"))
    return tuple({parameter.name: parameter for parameter in parameters}.values())


def _most_peers(scene: Topology, group: SceneGroup) -> float | None:
    """Return how many peers a group can have, the others as they are, by the components that say so."""
    counts = {group.name: group.count for group in scene.groups}
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
    numbers: list[Parameter | Timing] = [*parameters, *timings]
    followed, names = TopologicalSorter[str](), set[str]()
    for item in (*numbers, *(value for group in groups for value in group.values)):
        if item.formula is not None:
            followed.add(item.name, *item.formula.names)
            names.add(item.name)
    return tuple(name for name in followed.static_order() if name in names)


def _formula(expression: Expr | None) -> Formula | None:
    return None if expression is None else formula_of(expression)
