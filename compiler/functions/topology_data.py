"""Parameters, groups and communication graphs of a compiled model: all except its functions.

Takes: `Topology`, and the peer types with their functions. Gives: `Timings`; `used_links`, `check_links`,
`used_clocks`; `compiled_groups`; `all_parameters`, `followers_of`.
Guarantees: periods, phases and delays are exact; dependent values have their formulas.
Does not: build functions.
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
    GroupPair,
    Link,
    Loss,
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
from apc.compiler.peer_counts import COUNT_ABOUT, with_received
from apc.compiler.topology.channels import PROBABILITIES, ChannelDeclaration
from apc.compiler.topology.groups import GroupDeclaration
from apc.compiler.topology.topology import Topology
from apc.compiler.wording import enumerated

NO_DELAY = "no delay"
Path = tuple[str, ...]  # a name, split at its dots


class Timings:
    """The periods, phases and delays that the model refers to, without repetition."""

    def __init__(self, topology: Topology) -> None:
        self.topology = topology
        self._values = {f"{clock.name}.period": clock.period for clock in topology.clocks}
        self._values |= {
            f"{part.name}.{name}": value for part in topology.parts for name, value in part.values
        }
        self._result: dict[str, Timing] = {}

    @property
    def result(self) -> tuple[Timing, ...]:
        """All timings in use, in the order of first use."""
        return tuple(self._result.values())

    def use(self, name: str, value: ScalarValue) -> str:
        """Register a timing, and return its name."""
        self._result.setdefault(name, Timing(name, value.number, _formula(value.expression)))
        return name

    def delay(self, hold: HoldCrossing, peer_type: FlatPeerType) -> str:
        """Register the delay of a hold, and return its name: none, a parameter, or an expression over
        parameters.
        """
        if hold.delay == ZERO:
            return self.use(NO_DELAY, ScalarValue(ZERO.value, SECOND, None, SourceLocation("")))

        def number(parts: Path) -> Fraction:
            """Return the value of a name in the expression of a delay."""
            return Fraction(self.topology.peers) if parts == (PEERS,) else self._result[".".join(parts)].value

        tree = renamed(
            hold.delay, lambda parts: parts if parts == (PEERS,) else self._parameter(parts, peer_type)
        )
        if isinstance(tree, Name):
            return format_expression(tree)
        value = Fraction(evaluate(tree, number, SourceLocation(self.topology.name)))
        name = f"delay of {hold.variable}" + (f" at {peer_type.name}" if peer_type.delays else "")
        return self.use(name, ScalarValue(value, SECOND, tree, hold.location))

    def _parameter(self, parts: Path, peer_type: FlatPeerType) -> Path:
        """Register a delay parameter, and return its name, split at its dots.

        A delay set by the group of the peer type has the group's name in front, and so have the group's
        numbers it depends on.
        """
        name, group_delays = ".".join(parts), dict(peer_type.delays)
        if name not in group_delays:
            self.use(name, self._values[name])
            return parts
        tree = group_delays[name].expression
        if tree is not None:
            tree = renamed(
                tree,
                lambda texts: self._parameter(texts, peer_type) if ".".join(texts) in group_delays else texts,
            )
        return tuple(
            self.use(f"{peer_type.groups[0]}.{name}", replace(group_delays[name], expression=tree)).split(".")
        )


def used_links(topology: Topology, peer_types: Sequence[PeerType], timings: Timings) -> tuple[Link, ...]:
    """Return the links with at least one receiver.

    Parameters
    ----------
    topology, peer_types
        All links, and their receivers.
    timings
        The collection to which the delays of the links in use are added.
    """
    received = {
        receive.link for peer_type in peer_types for clock in peer_type.clocks for receive in clock.receives
    }
    links = []
    for link in (link for link in topology.links if link.name in received):
        pairs = tuple(
            GroupPair(
                pair.sender,
                pair.receiver,
                timings.use(pair.timing, pair.delay),
                _channel(pair.channel, timings),
                pair.clock,
            )
            for pair in link.pairs
        )
        delay, channel = timings.use(f"{link.name}.delay", link.delay), _channel(link.channel, timings)
        links.append(Link(link.name, link.clock, delay, link.graph, pairs, channel, link.order))
    return tuple(links)


def _channel(declared: ChannelDeclaration | None, timings: Timings) -> Channel | None:
    """Return the channel of a declaration, whose jitter is added to the timings in use; None without one."""
    if declared is None:
        return None
    loss = Loss(*(name for name, _ in declared.loss)) if declared.loss else None
    jitter = None if declared.jitter is None else timings.use(*declared.jitter)
    return Channel(loss, jitter, declared.distribution, declared.reorder, declared.on_loss, declared.trace)


def used_clocks(
    topology: Topology, peer_types: Sequence[PeerType], links: Sequence[Link], timings: Timings
) -> tuple[Clock, ...]:
    """Return the clocks of links and partitions in use.

    Parameters
    ----------
    topology
        The topology with all clocks.
    peer_types, links
        The peer types and links in use, which refer to clocks.
    timings
        The collection to which the periods and phases in use are added.
    """
    used = {clock for link in links for clock in link.clocks} | {
        clock.clock for peer_type in peer_types for clock in peer_type.clocks
    }
    return tuple(
        Clock(
            clock.name,
            timings.use(f"{clock.name}.period", clock.period),
            timings.use(f"{clock.name}.phase", clock.phase),
            clock.period.location.line,
            clock.period.location.column,
        )
        for clock in topology.clocks
        if clock.name in used
    )


def check_links(topology: Topology, peer_types: Sequence[PeerType], indices: Sequence[int]) -> None:
    """Raise ApcError for a link that cannot provide the values its receivers require.

    Parameters
    ----------
    topology, peer_types
        The links, and their senders and receivers.
    indices
        The index of each group's peer type.

    Raises
    ------
    ApcError
        E215 a link over which only some peers send a value: the values of the others would be missing. E801 a
        graph, given as arcs, without senders to a peer with a mean, maximum or minimum.
    """
    mistakes = Mistakes()
    for link in topology.links:
        sent = [
            (peer_type.name, send.channels)
            for peer_type in peer_types
            for send in peer_type.sends
            if send.link == link.name
        ]
        every = [channel for _, channels in sent for channel in channels]
        missing = (text for text in every if not all(text in channels for _, channels in sent))
        for channel in islice(missing, 1):
            senders = enumerated([name for name, channels in sent if channel in channels])
            message = (
                f"only the peers of {senders} send {channel} over {link.name}; all peers must send the same "
                "values over a link"
            )
            advice = f"use a separate link in {channel.rpartition('.')[0]}"
            mistakes.add("E215", link.location, message, advice=advice)
    mistakes.raise_if_any()
    groups, counts = topology.groups, [group.count for group in topology.groups]
    for link in (
        link for link in topology.links if link.graph.shape == "arcs"
    ):  # in other graphs all peers have senders
        owner = np.repeat(np.arange(len(groups)), counts)
        used = [_undefined_reduction(peer_types[index], link.name) for index in indices]
        sends = [any(send.link == link.name for send in peer_types[index].sends) for index in indices]
        senders, receivers = link.graph.arcs.T
        asking = np.flatnonzero(np.array(used, dtype=bool)[owner])
        deaf = np.setdiff1d(asking, receivers[np.array(sends)[owner[senders]]])
        if not deaf.size:
            continue
        first = [(int(owner[index]), index) for index in deaf[:3]]
        names = [f"{groups[k].name}[{index - sum(counts[:k]) + 1}]" for k, index in first]
        if len(deaf) > len(names):
            names.append(f"{len(deaf) - len(names)} more")
        receive = (
            f"{enumerated(names)} {'has' if len(deaf) == 1 else 'have'} no incoming connection over "
            f"{link.name}"
        )
        message = f"{receive}, so {used[first[0][0]]}() is undefined"
        advice = f"add an arc to {'each of them' if len(deaf) > 1 else names[0]}"
        receiving = np.bincount(owner[deaf], minlength=len(groups)) < counts
        if np.isin(deaf, senders).any():
            advice += ", or use a coupler with sum(), such as FullMesh"
        elif not receiving.all() and receiving.any():
            others = [group.name for group, receives in zip(groups, receiving, strict=True) if receives]
            advice += f", or use at: [{', '.join(others)}] in the couplers of {link.name}"
        mistakes.add("E801", link.location, message, advice=advice)
    mistakes.raise_if_any()


def _undefined_reduction(peer_type: PeerType, link: str) -> str:
    """Return the first `mean`, `max` or `min` of a peer type over a link: undefined without senders.

    The result is "" if there is none.
    """
    operators = (
        receive.operator for clock in peer_type.clocks for receive in clock.receives if receive.link == link
    )
    return next((text for text in operators if text in ("mean", "max", "min")), "")


def compiled_groups(
    topology: Topology,
    peer_types: Sequence[PeerType],
    indices: Sequence[int],
    links: Sequence[Link],
    timings: Timings,
) -> tuple[Group, ...]:
    """Return the compiled groups, with their numbers of senders.

    A group value that is also a timing is replaced by a reference to this timing.

    Parameters
    ----------
    topology
        The topology.
    peer_types, indices
        The peer types, and the index of each group's peer type.
    links
        The links in use.
    timings
        The timings of the schedule.

    Raises
    ------
    ApcError
        E215 some peers of a graph send nothing over its link.
    """
    exact = {timing.name for timing in timings.result}
    groups, declared = [], _declared(topology)
    for group, index in zip(topology.groups, indices, strict=True):
        values = []
        for name, value in group.values:
            timing = f"{group.name}.{name}"
            compiled = replace(value, expression=Name(tuple(timing.split(".")))) if timing in exact else value
            values.append(_of_part(name, compiled, declared))
        columns = tuple(PeerColumn(name, numbers) for name, numbers in group.columns)
        groups.append(Group(group.name, group.count, index, tuple(values), columns))
    for link in (link for link in topology.links if link.graph.shape != "complete"):
        sending = [any(send.link == link.name for send in peer_type.sends) for peer_type in peer_types]
        silent = [group.name for group in groups if not sending[group.peer_type]]
        if silent and any(count_of(link.name) in peer_type.parameters for peer_type in peer_types):
            message = (
                f"the graph of {link.name} connects all peers, but the peers of {silent[0]} do not send "
                "over it"
            )
            raise ApcError(Diagnostic("E215", link.location, message))
    return with_received(groups, peer_types, links)


# ---- numbers by name ----


def _named(
    name: str,
    value: ScalarValue,
    description: str = "",
    minimum: Fraction | float | None = None,
    maximum: Fraction | float | None = None,
    *,
    exclusive_minimum: bool = False,
) -> Parameter:
    """Return a number as a parameter of the model, with unit, formula, bounds and description."""
    unit, formula = format_dimension(value.dimension), _formula(value.expression)
    least, most = (None if item is None else float(item) for item in (minimum, maximum))
    return Parameter(
        name,
        unit,
        float(value.number),
        formula,
        least,
        exclusive_minimum,
        most,
        description=description,
        exact=value.number,
        display_unit=value.unit if value.unit != "1" else "",
    )


def _declared(topology: Topology) -> dict[str, NumberParameter | ComponentVariable]:
    """Return the declaration of each number and start value of the parts, by qualified name."""
    result: dict[str, NumberParameter | ComponentVariable] = {}
    for part in topology.parts:
        for declared in (part.component.variables, part.component.numbers):
            result |= {f"{part.name}.{item.name}": item for item in declared}
    return result


def _of_part(
    name: str, value: ScalarValue, all_declared: Mapping[str, NumberParameter | ComponentVariable]
) -> Parameter:
    """Return a parameter or start value of a part, with its bounds and its description."""
    declared = all_declared[name]
    if isinstance(declared, ComponentVariable):
        return _named(name, value, f"start value: {declared.description or name.rpartition('.')[2]}")
    least, most = declared.minimum, declared.maximum
    parameter = _named(
        name, value, declared.description, least, most, exclusive_minimum=declared.exclusive_minimum
    )
    return replace(parameter, choices=tuple((word, float(number)) for word, number in declared.words))


def all_parameters(
    topology: Topology, peer_types: Sequence[PeerType], links: Sequence[Link]
) -> tuple[Parameter, ...]:
    """Return every parameter of the topology.

    These are the named numbers, the numbers of parts, the start values in use, the probabilities of links,
    periods in equations, and numbers of peers and senders.

    Parameters
    ----------
    topology
        The topology, with the values.
    peer_types, links
        The compiled peer types, whose parameters are in use, and the links in use.
    """
    declared = _declared(topology)
    needed = {name for peer_type in peer_types for name in peer_type.parameters}
    used = {link.name for link in links}
    parameters = [_named(name, value) for name, value in topology.parameters]
    for part in topology.parts:
        numbers = dict(part.values) | {
            variable: value for variable, value in part.all_starts if f"{part.name}.{variable}" in needed
        }
        parameters += [
            _of_part(f"{part.name}.{number}", value, declared) for number, value in numbers.items()
        ]
    for link in topology.links:
        if count_of(link.name) in needed:  # every group has its own value
            parameters.append(
                Parameter(count_of(link.name), "1", float(topology.peers - 1), description=COUNT_ABOUT)
            )
        for channel in link.channels if link.name in used else ():
            probabilities = zip(channel.loss, PROBABILITIES.values(), strict=False)
            parameters += [_named(*number, description, 0, 1) for number, description in probabilities]
    for clock in topology.clocks:
        if (name := f"{clock.name}.period") in needed:  # used by `interval`: the same number as the timing
            description = f"period of clock {clock.name}"
            parameters.append(_named(name, clock.period, description, 0, exclusive_minimum=True))
    for group in topology.groups:
        expression = None if group.counted is None else group.counted.expression
        count = ScalarValue(Fraction(group.count), DIMENSIONLESS, expression, group.location)
        description, most = f"number of peers of group {group.name}", _most_peers(topology, group)
        parameters.append(_named(group_count(group.name), count, description, 1, most))
    parameters.append(Parameter(PEERS, "1", float(topology.peers), description="number of peers"))
    return tuple({parameter.name: parameter for parameter in parameters}.values())


def _most_peers(topology: Topology, group: GroupDeclaration) -> float | None:
    """Return the largest number of peers of a group that its components allow, the other groups unchanged.

    The result is None if the number is not limited.
    """
    counts = {other.name: other.count for other in topology.groups}
    limits = [
        part.component.peers - sum(counts[name] for name in part.groups if name != group.name)
        for part in topology.parts
        if part.component.peers and group.name in part.groups
    ]
    return float(min(limits)) if limits else None


def followers_of(
    parameters: Sequence[Parameter], timings: Sequence[Timing], groups: Sequence[Group]
) -> tuple[str, ...]:
    """Return the names of all dependent parameters and timings, each after its dependencies."""
    numbers: list[Parameter | Timing] = [*parameters, *timings]
    sorter, names = TopologicalSorter[str](), set[str]()
    for item in (*numbers, *(value for group in groups for value in group.values)):
        if item.formula is not None:
            sorter.add(item.name, *item.formula.names)
            names.add(item.name)
    return tuple(name for name in sorter.static_order() if name in names)


def _formula(expression: Expr | None) -> Formula | None:
    """Return the formula of an expression, or None."""
    return None if expression is None else formula_of(expression)
