"""The links of a topology: communication graph, delay and channel of each.

Takes: a part of the section `links`, and its entry. Gives: `read_link`, a `LinkDeclaration`;
`ChannelDeclaration`; `without_range`; `PROBABILITY`.
Guarantees: delays are 0 or more, probabilities lie from 0 to 1; graph, delays and channel match the existing
peers; an entry without effect is refused.
Does not: handle channel contents, or draw random losses (see the runtime).

The loss model is netem's `gemodel p [r [1-h [1-k]]]` (tc-netem(8), after Gilbert and Elliott): a link in its
good state loses a packet with the probability 1-k and one in its bad state with 1-h; after each packet a good
one turns bad with the probability p, a bad one good with r. Its defaults are netem's, r = 1-p, 1-h = 1 and
1-k = 0, which make losses independent: `loss: 2 %` is `loss: {p: 2 %}`.
"""

from __future__ import annotations

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
from apc.compiler.errors import SourceLocation
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

OBEYED = ("delay", "jitter", "distribution", "reorder", "on_loss")  # a link's numbers and words
# Those of netem, in its order.
PROBABILITIES = {
    "p": "probability that a good link turns bad after a packet",
    "r": "probability that a bad link turns good after a packet",
    "1-h": "probability that a bad link loses a packet",
    "1-k": "probability that a good link loses a packet",
}
LOSS_EXAMPLE = "loss: {p: 1 %, r: 25 %}"
_EXAMPLES = {"loss": "loss: 2 %", "jitter": "jitter: 2 ms", "trace": "trace: delays.csv"}
# The declaration by which each number of a link's losses is read.
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

    `loss` has the names and values of p, r, 1-h and 1-k, or is empty; `jitter` is None on a link without.
    `trace` (n,) holds recorded delays in seconds, infinite for a lost packet, or is None.
    """

    loss: Named[ScalarValue]
    jitter: ScalarValue | None
    distribution: str
    reorder: str
    on_loss: str
    trace: NDArray[np.float64] | None

    @property
    def remarks(self) -> tuple[str, ...]:
        """The channel in words."""
        lines = []
        if self.loss:
            four = zip(PROBABILITIES, self.loss, strict=True)
            shares = (f"{key} {float(100 * value.number):.6g} %" for key, (_, value) in four)
            lines.append(f"loss: {', '.join(shares)}")
        if self.jitter is not None:
            lines.append(f"jitter {float(1000 * self.jitter.number):.6g} ms, {self.distribution}")
        if self.trace is not None:
            lines.append(f"a recorded trace of {self.trace.size} packets")
        newest = "sent last" if self.reorder == "newest" else "that arrived last"
        missing = "a lost one changes nothing" if self.on_loss == "hold" else "a lost one exerts no force"
        return (*lines, f"the packet {newest} counts; {missing}")


@dataclass(frozen=True, slots=True)
class LinkDeclaration:
    """A link: communication graph, delay and `channel` (None for a reliable one).

    `within` are the ends of a range of delays, whose middle `delay` is, in seconds; None for one delay.
    """

    name: str
    clock: str
    delay: ScalarValue
    within: tuple[Fraction, Fraction] | None
    graph: Graph
    delays: tuple[DelayDeclaration, ...]
    channel: ChannelDeclaration | None
    location: SourceLocation


def without_range(entry: PartEntry) -> PartEntry:
    """Return an entry without its delay, if that is a range, which `read_link` reads."""
    body = entry.body
    if entry.section != "links" or not isinstance(body.get("delay"), Sequence):
        return entry
    rest = tuple((key, node) for key, node in body.entries if key.text != "delay")
    return replace(entry, body=replace(body, entries=rest))


def _range(
    node: Sequence, link: str, component: Component, numbers: NamedNumbers
) -> tuple[ScalarValue, ScalarValue]:
    """Read `[20 ms, 60 ms]`, the ends of a range of delays."""
    declared = component.parameter("delay")
    assert isinstance(declared, Parameter), "a link has a delay"
    if len(node.items) != 2:
        expected, hint = "one delay or a list of two", "delay: [20 ms, 60 ms]"
        raise fault("E203", node.location, "delay", expected, form(node), hint)
    low, high = (numbers.read_for(item, "delay", declared) for item in node.items)
    if low.number >= high.number:
        message = f"the range of {link}.delay"
        first, last = (item.text if isinstance(item, Scalar) else "" for item in node.items)
        hint = f"delay: [{last}, {first}]" if low.number > high.number else f"delay: {first}"
        raise fault("E207", node.location, message, "its lower end first", f"{first} to {last}", hint)
    if low.expression is not None or high.expression is not None:
        raise fault(
            "E203", node.location, "a range of delays", "two quantities", form(node), "[20 ms, 60 ms]"
        )
    return low, high


def read_link(part: PartInstance, entry: PartEntry, numbers: NamedNumbers) -> LinkDeclaration:
    """Read the structured keys of a link's entry.

    Parameters
    ----------
    part, entry
        The link as a part, and its entry.
    numbers
        Reads delays, probabilities and files.

    Raises
    ------
    ApcError
        E210 it is not a link; no error if its clock or delay is invalid, which was reported.
    """
    component, clock, delay = part.component, part.reference("clock"), dict(part.values).get("delay")
    roles = {p.name: p.role for p in component.parameters if isinstance(p, Reference)}
    given = ((p.name, entry.body.get(p.name)) for p in component.parameters)
    nodes = {roles.get(name, name): node for name, node in given if node is not None}
    graph, delays = COMPLETE, tuple[DelayDeclaration, ...]()
    if "graph" in nodes:
        with numbers.mistakes:
            graph = read_graph(nodes["graph"], numbers)
    if "delays" in nodes:
        with numbers.mistakes:
            delays = read_delays(nodes["delays"], numbers)
    text = f"{part.name} is a {component.name}, which is no link:"
    if "clock" not in roles.values() or component.parameter("delay") is None:
        raise fault("E210", part.location, f"{text} it has no clock and delay", hint="type: Link")
    # Of a link's component nothing may be declared that no link obeys.
    obeyed = {*OBEYED, *(name for name, role in roles.items() if role != "link")}
    declared = [item.name for item in (*component.variables, *component.parameters)]
    idle = [name for name in (*dict(component.connectors), *declared) if name not in obeyed]
    idle += ["equations"] * bool(component.equations or component.inner)
    if idle:
        raise fault("E210", part.location, f"{text} a link has no {idle[0]}", hint="type: Link")
    channel, within = _read_channel(part, nodes, numbers), None
    if isinstance(node := nodes.get("delay"), Sequence):
        if channel is not None and (channel.jitter or channel.trace is not None):
            message = f"{part.name} has a range of delays: it can't have jitter or a trace as well"
            raise fault("E262", node.location, message)
        ends = _range(node, part.name, component, numbers)
        within = ends[0].number, ends[1].number
        delay = ScalarValue((within[0] + within[1]) / 2, ends[0].dimension, None, node.location)
    if clock is None or delay is None:
        raise AlreadyReportedError
    return LinkDeclaration(part.name, clock, delay, within, graph, delays, channel, part.location)


def _read_channel(
    part: PartInstance, nodes: Mapping[str, Node], numbers: NamedNumbers
) -> ChannelDeclaration | None:
    """Read the channel of an unreliable link; None if its entry has no such key.

    Parameters
    ----------
    part
        The link.
    nodes
        The nodes of its entry by key, its loss, trace and delays by their roles.
    numbers
        Reads probabilities and a trace.
    """
    link, mistakes, words = part.name, numbers.mistakes, dict(part.options)
    given = _EXAMPLES.keys() & nodes
    for word, (_, description) in _WORDS.items():
        if word in nodes and not given.intersection(description):
            message = f"{link} says {word} but has no {' or '.join(description)} that this would be about"
            mistakes.add("E262", nodes[word].location, message, hint=_EXAMPLES[description[0]])
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
                message = f"{link} has a trace, which says when every packet arrives: it can't have"
                mistakes.add("E262", nodes[key].location, f"{message} {key} as well")
        with mistakes:
            text = text_of(nodes["trace"], "trace", _EXAMPLES["trace"])
            trace = numbers.files.read(text, partial(read_trace, named_at=location))
    jitter = dict(part.values).get("jitter") if "jitter" in given else None
    distribution, reorder, on_loss = (words.get(word, default) for word, (default, _) in _WORDS.items())
    delays = None if trace is None else trace.delays
    return ChannelDeclaration(loss, jitter, distribution, reorder, on_loss, delays)


def _loss(link: str, node: Node, numbers: NamedNumbers) -> Named[ScalarValue]:
    """Read a probability, or a mapping of netem's four; return all by their whole names.

    Those that are not given are as netem has them, none is known without p.
    """
    name = name_p = f"{link}.loss"
    given: dict[str, ScalarValue | None] = {}
    if isinstance(node, MappingNode):
        name_p += ".p"
        body = MappingReader(node, PROBABILITIES, f"the loss of {link}", numbers.mistakes)
        given = {key: body.read(key, partial(_probability, numbers=numbers), None) for key in PROBABILITIES}
        if "p" not in body.nodes:
            raise fault("E201", node.location, f"the loss of {link} has no p", hint=LOSS_EXAMPLE)
    else:
        given["p"] = _probability(node, "loss", numbers)
    if (p := given["p"]) is None:
        return ()
    rest = parse_expression(f"1 - {name_p}", p.location)
    typical = {"r": (1 - p.number, rest), "1-h": (Fraction(1), None), "1-k": (Fraction(0), None)}
    others = (
        (f"{name}.{key}", given.get(key) or ScalarValue(number, DIMENSIONLESS, expression, p.location))
        for key, (number, expression) in typical.items()
    )
    return ((name_p, p), *others)


def _probability(node: Node, subject: str, numbers: NamedNumbers) -> ScalarValue:
    value = numbers.read(node, subject, DIMENSIONLESS, "%")
    if 0 <= value.number <= 1:
        return value
    got = brief(node.text) if isinstance(node, Scalar) else ""
    bare = isinstance(node, Scalar) and isinstance(node.value, int | float) and 1 < value.number <= 100
    hint = f"{subject}: {got} %" if bare else ""
    raise fault("E261", value.location, subject, "a probability, 0 % to 100 %", got, hint)
