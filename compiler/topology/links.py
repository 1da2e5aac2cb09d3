"""The links of a topology: communication graph, delay and channel of each, and of pairs of groups.

Takes: a part of the section `links`, and its entry. Gives: `read_link`, a `LinkDeclaration`;
`PairDeclaration`; `without_range`.
Guarantees: delays are 0 or more; graph, pairs and channels match the existing peers; an entry without effect
is refused.
Does not: read channels (see `channels`) or graphs (see `graphs`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

from apc.compiler.compiled import Graph
from apc.compiler.components.component import Component, Reference
from apc.compiler.components.component import NumberParameter as Parameter
from apc.compiler.components.parts import EntryScope, PartEntry, read_reference
from apc.compiler.errors import SourceLocation
from apc.compiler.language.dimensions import SECOND
from apc.compiler.language.grammar import parse_expression
from apc.compiler.language.values import AlreadyReportedError, ScalarValue, is_quantity
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import MappingReader, fault, form, mapping_of
from apc.compiler.topology.channels import ChannelDeclaration, keys_of_pairs, read_channel, read_pair_channel
from apc.compiler.topology.graphs import COMPLETE, is_connected, read_graph, read_pairs
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.topology_parameters import NamedNumbers

# The numbers and options of a link.
EFFECTIVE = ("delay", "order", "jitter", "distribution", "reorder", "on_loss")
# The keys of a pair of groups: of a channel, all except `reorder` and `trace`.
PAIR = ("delay", "loss", "jitter", "distribution", "on_loss", "clock")


@dataclass(frozen=True, slots=True)
class PairDeclaration:
    """The packets of a link from the group `sender` to the group `receiver`.

    `timing` is the name of the delay; `channel` is None, and `clock` empty, for that of the link.
    """

    sender: str
    receiver: str
    timing: str
    delay: ScalarValue
    channel: ChannelDeclaration | None
    location: SourceLocation
    clock: str = ""


@dataclass(frozen=True, slots=True)
class LinkDeclaration:
    """A link: communication graph, delay, pairs of groups, and `channel` (None for a reliable link).

    `order` states whether a packet takes the values "before" or "after" the ticks at its instant. `within`
    has the ends of a range of delays in seconds, with its middle as `delay`; None for a single delay.
    """

    name: str
    clock: str
    delay: ScalarValue
    within: tuple[Fraction, Fraction] | None
    graph: Graph
    pairs: tuple[PairDeclaration, ...]
    channel: ChannelDeclaration | None
    order: str
    location: SourceLocation

    @property
    def channels(self) -> tuple[ChannelDeclaration, ...]:
        """The channels of the link and of its pairs; empty for a reliable link."""
        given = (self.channel, *(pair.channel for pair in self.pairs))
        return tuple(channel for channel in given if channel is not None)


def without_range(entry: PartEntry) -> PartEntry:
    """Return a link's entry without the key `delay` if the delay is a range, else the unchanged entry.

    The range is read by `read_link`.
    """
    body = entry.body
    if entry.section != "links" or not isinstance(body.get("delay"), Sequence):
        return entry
    other_entries = tuple((key, node) for key, node in body.entries if key.text != "delay")
    return replace(entry, body=replace(body, entries=other_entries))


def _range(
    node: Sequence, link: str, component: Component, numbers: NamedNumbers
) -> tuple[ScalarValue, ScalarValue]:
    """Return the ends of a range of delays `[20 ms, 60 ms]`, lower end first.

    Parameters
    ----------
    node, link
        The YAML list, and the name of the link for messages.
    component, numbers
        The component of the link, which declares the delay, and the reader of numbers.

    Raises
    ------
    ApcError
        The range is invalid.
    """
    declaration = component.parameter("delay")
    assert isinstance(declaration, Parameter), "a link has a delay"
    if len(node.items) != 2:
        expected, fix = "one value or [min, max]", "delay: [20 ms, 60 ms]"
        if len(node.items) == 1 and isinstance(only := node.items[0], Scalar):
            fix = f"delay: {only.text}"
        got = f"a list of {len(node.items)}"
        raise fault("E203", node.location, "delay", expected, got, fix)
    low, high = (numbers.read_for(item, "delay", declaration) for item in node.items)
    if low.number >= high.number:
        message = f"range of {link}.delay"
        low_text, high_text = (item.text if isinstance(item, Scalar) else "" for item in node.items)
        fix = f"delay: [{high_text}, {low_text}]" if low.number > high.number else f"delay: {low_text}"
        raise fault("E207", node.location, message, "the lower end first", f"{low_text} to {high_text}", fix)
    if low.expression is not None or high.expression is not None:
        raise fault("E203", node.location, "range of delays", "two quantities", form(node), "[20 ms, 60 ms]")
    return low, high


def read_link(
    part: PartInstance, entry: PartEntry, numbers: NamedNumbers, scope: EntryScope
) -> LinkDeclaration:
    """Return the declaration of a link: graph, delays and channel, read from its entry.

    Parameters
    ----------
    part, entry
        The link as a part, and its entry.
    numbers
        The named numbers: groups of peers, reader of delays and files, collector of errors.
    scope
        The names that the entry can refer to.

    Raises
    ------
    ApcError
        E210 the component is not a link. E262 a range of delays with jitter or a trace.
    AlreadyReportedError
        The clock or the delay is invalid, which was reported.
    """
    component, clock, delay = part.component, part.reference("clock"), dict(part.values).get("delay")
    roles = {p.name: p.role for p in component.parameters if isinstance(p, Reference)}
    entry_nodes = ((p.name, entry.body.get(p.name)) for p in component.parameters)
    nodes = {roles.get(name, name): node for name, node in entry_nodes if node is not None}
    graph = COMPLETE
    if "graph" in nodes:
        with numbers.mistakes:
            graph = read_graph(nodes["graph"], numbers)
    text = f"{part.name} is a {component.name}, not a link:"
    # A link's component may declare only items that have an effect on a link.
    effective = {*EFFECTIVE, *(name for name, role in roles.items() if role != "link")}
    declared = [item.name for item in (*component.variables, *component.parameters)]
    without_effect = [name for name in (*dict(component.connectors), *declared) if name not in effective]
    without_effect += ["equations"] * bool(component.equations or component.inner)
    if without_effect:
        raise fault("E210", part.location, f"{text} a link has no {without_effect[0]}", fix="type: Link")
    channel, delay_range = read_channel(part, nodes, numbers), None
    if isinstance(node := nodes.get("delay"), Sequence):
        if channel.jitter or channel.trace is not None or "jitter" in keys_of_pairs(nodes.get("pairs")):
            message = f"{part.name} has a range of delays, which can't be combined with jitter or a trace"
            raise fault("E262", node.location, message)
        ends = _range(node, part.name, component, numbers)
        delay_range = ends[0].number, ends[1].number
        delay = ScalarValue((delay_range[0] + delay_range[1]) / 2, ends[0].dimension, None, node.location)
    pairs = _PairReader(part, graph, delay, channel, numbers, scope).read(nodes)
    if clock is None or delay is None:
        raise AlreadyReportedError
    reliable = channel.reliable and all(pair.channel is None for pair in pairs)
    used_channel, order = None if reliable else channel, dict(part.options).get("order", "before")
    return LinkDeclaration(
        part.name, clock, delay, delay_range, graph, pairs, used_channel, order, part.location
    )


@dataclass(frozen=True, slots=True)
class _PairReader:
    """Reads the pairs of groups of a link, given its graph, delay (None if invalid) and channel.

    `scope` has the names of the clocks.
    """

    link: PartInstance
    graph: Graph
    delay: ScalarValue | None
    channel: ChannelDeclaration
    numbers: NamedNumbers
    scope: EntryScope

    def read(self, nodes: Mapping[str, Node]) -> tuple[PairDeclaration, ...]:
        """Return the pairs of the nodes of `delays` and `pairs`; mistakes are recorded."""
        declared: dict[tuple[str, str], PairDeclaration] = {}
        for key, value in (("delays", "12 ms"), ("pairs", "{delay: 12 ms, loss: 2 %}")):
            entries: list[tuple[str, str, Node]] = []
            if key in nodes:
                with self.numbers.mistakes:
                    entries = read_pairs(nodes[key], key, value, self.numbers)
            for sender, receiver, node in entries:
                with self.numbers.mistakes:
                    pair, link = f"{sender} to {receiver}", self.link.name
                    if (sender, receiver) in declared:
                        raise fault("E213", node.location, f"the pair {pair} of {link} is given twice")
                    if not is_connected(self.graph, sender, receiver, self.numbers.counts):
                        message = f"the graph of {link} has no arc from {sender} to {receiver}"
                        advice = "delete the pair, or add an arc"
                        raise fault("E213", node.location, message, advice=advice)
                    read = self._delay_only if key == "delays" else self._pair
                    declared[sender, receiver] = read(sender, receiver, node)
        return tuple(declared.values())

    def _delay_only(self, sender: str, receiver: str, node: Node) -> PairDeclaration:
        """Return a pair with its delay only."""
        timing = f"{self.link.name}.delays.{sender}.{receiver}"
        delay = self.numbers.read_for(node, receiver, self._declared_delay)
        return PairDeclaration(sender, receiver, timing, delay, None, node.location)

    def _pair(self, sender: str, receiver: str, node: Node) -> PairDeclaration:
        """Return a pair with its delay, which by default follows that of the link, channel and clock."""
        name, subject = f"{self.link.name}.pairs.{sender}.{receiver}", f"the pair {sender} to {receiver}"
        fix = f"{receiver}: {{loss: 2 %}}"
        if isinstance(node, Scalar) and is_quantity(node.text) and not node.text.endswith("%"):
            fix = f"{receiver}: {{delay: {node.text}}}"
        body = MappingReader(mapping_of(node, subject, fix), PAIR, subject, self.numbers.mistakes)
        if not body.nodes:
            raise fault("E201", node.location, f"{subject}: nothing is given", fix=fix)
        common = Fraction(0) if self.delay is None else self.delay.number
        following = parse_expression(f"{self.link.name}.delay", node.location)
        delay = body.read(
            "delay",
            partial(self.numbers.read_for, item=self._declared_delay),
            ScalarValue(common, SECOND, following, node.location),
        )
        channel = read_pair_channel(name, body, self.link.component, self.channel, self.numbers)
        clock = body.read(
            "clock", partial(read_reference, role="clock", subject=subject, scope=self.scope), ""
        )
        clock = "" if clock == self.link.reference("clock") else clock
        return PairDeclaration(sender, receiver, f"{name}.delay", delay, channel, node.location, clock)

    @property
    def _declared_delay(self) -> Parameter:
        """The declaration of the link's delay."""
        declared = self.link.component.parameter("delay")
        assert isinstance(declared, Parameter), "a link has a delay"
        return declared
