"""The links of a topology: communication graph, delay and channel of each.

Takes: a part of the section `links`, and its entry. Gives: `read_link`, a `LinkDeclaration`;
`ChannelDeclaration`; `without_range`; `PROBABILITY`.
Guarantees: delays are 0 or more, probabilities lie from 0 to 1; graph, delays and channel match the existing
peers; an entry without effect is refused.
Does not: handle channel contents, or draw random losses (see the runtime).

The loss model is netem's `gemodel p [r [1-h [1-k]]]` (tc-netem(8), after Gilbert and Elliott): a link in its
good state loses a packet with probability 1-k, a link in its bad state with probability 1-h; after each
packet a good link turns bad with probability p, a bad link good with probability r. Its defaults are netem's,
r = 1-p, 1-h = 1 and 1-k = 0, which make losses independent: `loss: 2 %` is `loss: {p: 2 %}`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Graph
from apc.compiler.components.component import Component, Named, Reference
from apc.compiler.components.component import NumberParameter as Parameter
from apc.compiler.components.parts import PartEntry
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.language.dimensions import DIMENSIONLESS
from apc.compiler.language.grammar import parse_expression
from apc.compiler.language.recordings import read_trace
from apc.compiler.language.units import Unit
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar, Sequence
from apc.compiler.source.reading import MappingReader, brief, fault, form, text_of
from apc.compiler.topology.graphs import COMPLETE, DelayDeclaration, read_delays, read_graph
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.topology_parameters import NamedNumbers

EFFECTIVE = (
    "delay",
    "order",
    "jitter",
    "distribution",
    "reorder",
    "on_loss",
)  # the numbers and options of a link
# The probabilities of netem's loss model, in netem's order.
PROBABILITIES = {
    "p": "probability that a good link turns bad after a packet",
    "r": "probability that a bad link turns good after a packet",
    "1-h": "probability that a bad link loses a packet",
    "1-k": "probability that a good link loses a packet",
}
_NUMBER = re.compile(r"\d+(\.\d+)?")
LOSS_EXAMPLE = "loss: {p: 1 %, r: 25 %}"
_EXAMPLES = {"loss": "loss: 2 %", "jitter": "jitter: 2 ms", "trace": "trace: delays.csv"}
# The declaration of each probability of a link's loss model.
PROBABILITY = Parameter(
    name="probability",
    unit=Unit("%", Fraction(1, 100), DIMENSIONLESS),
    default=None,
    minimum=Fraction(0),
    exclusive_minimum=False,
    maximum=Fraction(1),
    divided=False,
    words=(),
    description="",
    location=SourceLocation("probability"),
)

# The default of each key, and the key that it modifies: without that key it is invalid.
_WORDS = {
    "distribution": ("uniform", ("jitter",)),
    "reorder": ("newest", ("jitter", "trace")),
    "on_loss": ("hold", ("loss", "trace")),
}


@dataclass(frozen=True, slots=True, eq=False)
class ChannelDeclaration:
    """The channel of an unreliable link.

    `loss` has the names and values of p, r, 1-h and 1-k, or is empty; `jitter` is None on a link without
    jitter. `trace` (n,) has recorded delays in seconds, infinite for a lost packet, or is None.
    """

    loss: Named[ScalarValue]
    jitter: ScalarValue | None
    distribution: str
    reorder: str
    on_loss: str
    trace: NDArray[np.float64] | None

    @property
    def loses_all(self) -> bool:
        """Whether every packet is lost, in the stationary state of the link or in its trace."""
        if self.trace is not None:
            return bool(np.all(np.isinf(self.trace)))
        if not self.loss:
            return False
        p, r, bad_loss, good_loss = (value.number for _, value in self.loss)
        share_bad = p / (p + r) if p + r else 0
        return share_bad * bad_loss + (1 - share_bad) * good_loss == 1

    @property
    def remarks(self) -> tuple[str, ...]:
        """The properties of the channel, each as a text."""
        lines = []
        if self.loss:
            p, r, bad_loss, good_loss = (value.number for _, value in self.loss)
            four = zip(PROBABILITIES, self.loss, strict=True)
            shares = (f"{key} {float(100 * value.number):.6g} %" for key, (_, value) in four)
            independent = r == 1 - p and bad_loss == 1 and good_loss == 0
            model = f"Gilbert–Elliott loss: {', '.join(shares)}"
            lines.append(f"independent loss {float(100 * p):.6g} %" if independent else model)
        if self.jitter is not None:
            lines.append(f"jitter {float(1000 * self.jitter.number):.6g} ms, {self.distribution}")
        if self.trace is not None:
            lines.append(f"a recorded trace of {self.trace.size} packets")
        newest = "sent last" if self.reorder == "newest" else "that arrived last"
        missing = "holds the previous value" if self.on_loss == "hold" else "sets the force to zero"
        return (*lines, f"uses the packet {newest}, {missing} on loss")


@dataclass(frozen=True, slots=True)
class LinkDeclaration:
    """A link: communication graph, delay, and `channel` (None for a reliable link).

    `order` states whether a packet takes the values "before" or "after" the ticks at its instant. `within`
    has the ends of a range of delays in seconds, with its middle as `delay`; None for a single delay.
    """

    name: str
    clock: str
    delay: ScalarValue
    within: tuple[Fraction, Fraction] | None
    graph: Graph
    delays: tuple[DelayDeclaration, ...]
    channel: ChannelDeclaration | None
    order: str
    location: SourceLocation


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


def read_link(part: PartInstance, entry: PartEntry, numbers: NamedNumbers) -> LinkDeclaration:
    """Return the declaration of a link: graph, delays and channel, read from its entry.

    Parameters
    ----------
    part, entry
        The link as a part, and its entry.
    numbers
        The named numbers: groups of peers, reader of delays and files, collector of errors.

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
    graph, delays = COMPLETE, tuple[DelayDeclaration, ...]()
    if "graph" in nodes:
        with numbers.mistakes:
            graph = read_graph(nodes["graph"], numbers)
    if "delays" in nodes:
        with numbers.mistakes:
            delays = read_delays(nodes["delays"], numbers)
    text = f"{part.name} is a {component.name}, not a link:"
    # A link's component may declare only items that have an effect on a link.
    effective = {*EFFECTIVE, *(name for name, role in roles.items() if role != "link")}
    declared = [item.name for item in (*component.variables, *component.parameters)]
    without_effect = [name for name in (*dict(component.connectors), *declared) if name not in effective]
    without_effect += ["equations"] * bool(component.equations or component.inner)
    if without_effect:
        raise fault("E210", part.location, f"{text} a link has no {without_effect[0]}", fix="type: Link")
    channel, delay_range = _read_channel(part, nodes, numbers), None
    if isinstance(node := nodes.get("delay"), Sequence):
        if channel is not None and (channel.jitter or channel.trace is not None):
            message = f"{part.name} has a range of delays, which can't be combined with jitter or a trace"
            raise fault("E262", node.location, message)
        ends = _range(node, part.name, component, numbers)
        delay_range = ends[0].number, ends[1].number
        delay = ScalarValue((delay_range[0] + delay_range[1]) / 2, ends[0].dimension, None, node.location)
    if clock is None or delay is None:
        raise AlreadyReportedError
    order = dict(part.options).get("order", "before")
    return LinkDeclaration(part.name, clock, delay, delay_range, graph, delays, channel, order, part.location)


def _read_channel(
    part: PartInstance, nodes: Mapping[str, Node], numbers: NamedNumbers
) -> ChannelDeclaration | None:
    """Return the channel of an unreliable link; None if its entry has no loss, jitter and trace.

    Parameters
    ----------
    part
        The link.
    nodes
        The nodes of the entry by key; loss, trace and delays by their role instead of their key.
    numbers
        The named numbers: reader of probabilities and traces, collector of errors.
    """
    link, mistakes, words = part.name, numbers.mistakes, dict(part.options)
    given = _EXAMPLES.keys() & nodes
    for word, (_, description) in _WORDS.items():
        if word in nodes and not given.intersection(description):
            message = f"{word} has no effect without {' or '.join(description)}"
            mistakes.add("E262", nodes[word].location, message, fix=_EXAMPLES[description[0]])
    if not given:
        return None
    loss: Named[ScalarValue] = ()
    trace = None
    if "loss" in nodes:
        with mistakes:
            loss = _loss(link, nodes["loss"], numbers)
    if "trace" in nodes:
        location = nodes["trace"].location
        for key in ("loss", "jitter", "delays"):
            if key in nodes:
                message = f"{link} has a trace, which can't be combined with"
                mistakes.add("E262", nodes[key].location, f"{message} {key}")
        with mistakes:
            text = text_of(nodes["trace"], "trace", _EXAMPLES["trace"])
            trace = numbers.files.read(text, partial(read_trace, named_at=location))
    jitter = dict(part.values).get("jitter") if "jitter" in given else None
    distribution, reorder, on_loss = (words.get(word, default) for word, (default, _) in _WORDS.items())
    delays = None if trace is None else trace.delays
    return ChannelDeclaration(loss, jitter, distribution, reorder, on_loss, delays)


def _loss(link: str, node: Node, numbers: NamedNumbers) -> Named[ScalarValue]:
    """Return the probabilities p, r, 1-h and 1-k of a link by qualified name, from `2 %` or `{p: 1 %, r:
    25 %}`.

    Missing probabilities have netem's defaults; the result is empty if p is invalid. Raises ApcError if p is
    missing.
    """
    name = name_p = f"{link}.loss"
    given: dict[str, ScalarValue | None] = {}
    if isinstance(node, MappingNode):
        name_p += ".p"
        body = MappingReader(node, PROBABILITIES, f"loss of {link}", numbers.mistakes)
        given = {key: body.read(key, partial(_probability, numbers=numbers), None) for key in PROBABILITIES}
        if "p" not in body.nodes:
            raise fault("E201", node.location, f"the loss of {link} has no p", fix=LOSS_EXAMPLE)
    else:
        given["p"] = _probability(node, "loss", numbers)
    if (p := given["p"]) is None:
        return ()
    one_minus_p = parse_expression(f"1 - {name_p}", p.location)
    typical = {"r": (1 - p.number, one_minus_p), "1-h": (Fraction(1), None), "1-k": (Fraction(0), None)}
    others = (
        (f"{name}.{key}", given.get(key) or ScalarValue(number, DIMENSIONLESS, expression, p.location))
        for key, (number, expression) in typical.items()
    )
    return ((name_p, p), *others)


def _probability(node: Node, subject: str, numbers: NamedNumbers) -> ScalarValue:
    """Return a probability from 0 to 1; raises ApcError (E261) for other numbers."""
    expected, got = "a probability, 0 % to 100 %", brief(node.text) if isinstance(node, Scalar) else ""
    try:
        value = numbers.read(node, subject, DIMENSIONLESS, "%")
    except AlreadyReportedError:
        raise
    except ApcError as error:
        number = _NUMBER.match(got)
        fix = f"{subject}: {number[0]} %" if number and float(number[0]) <= 100 else ""
        raise ApcError(
            replace(mistake, expected=expected, fix=mistake.fix or fix)
            if mistake.expected == "%"
            else mistake
            for mistake in error.mistakes
        ) from None
    if 0 <= value.number <= 1:
        return value
    bare = isinstance(node, Scalar) and isinstance(node.value, int | float) and 1 < value.number <= 100
    fix = f"{subject}: {got} %" if bare else ""
    if value.unit and value.expression is None and -1 <= value.number < 0:
        fix = f"{subject}: {got.removeprefix('-')}"
    raise fault("E261", value.location, subject, expected, got, fix)
