"""The channels of unreliable links: loss, jitter and recorded delays.

Takes: the YAML nodes of a link's entry, or of a pair of groups. Gives: `ChannelDeclaration`; `read_channel`,
that of a link; `read_pair_channel`, that of a pair; `keys_of_pairs`; `PROBABILITIES`, `PROBABILITY`.
Guarantees: probabilities lie from 0 to 1; an entry without effect is refused.
Does not: draw random losses (see the runtime).

The loss model is netem's `gemodel p [r [1-h [1-k]]]` (tc-netem(8), after Gilbert and Elliott): a link in its
good state loses a packet with probability 1-k, a link in its bad state with probability 1-h; after each
packet a good link turns bad with probability p, a bad link good with probability r. Its defaults are netem's,
r = 1-p, 1-h = 1 and 1-k = 0, which make losses independent: `loss: 2 %` is `loss: {p: 2 %}`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.compiler.components.component import Component, Named, Option
from apc.compiler.components.component import NumberParameter as Parameter
from apc.compiler.components.parts import read_option
from apc.compiler.errors import ApcError, Mistakes, SourceLocation
from apc.compiler.language.dimensions import DIMENSIONLESS
from apc.compiler.language.grammar import parse_expression
from apc.compiler.language.recordings import read_trace
from apc.compiler.language.units import Unit
from apc.compiler.language.values import AlreadyReportedError, ScalarValue
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import MappingReader, brief, fault, text_of
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.topology_parameters import NamedNumbers

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

    `loss` has the names and values of p, r, 1-h and 1-k, or is empty; `jitter` has its name and value, None
    without jitter. `trace` (n,) has recorded delays in seconds, infinite for a lost packet, or is None.
    """

    loss: Named[ScalarValue]
    jitter: tuple[str, ScalarValue] | None
    distribution: str
    reorder: str
    on_loss: str
    trace: NDArray[np.float64] | None

    @property
    def reliable(self) -> bool:
        """Whether every packet arrives after the nominal delay."""
        return not self.loss and self.jitter is None and self.trace is None

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
            lines.append(f"jitter {float(1000 * self.jitter[1].number):.6g} ms, {self.distribution}")
        if self.trace is not None:
            lines.append(f"a recorded trace of {self.trace.size} packets")
        newest = "sent last" if self.reorder == "newest" else "that arrived last"
        missing = "holds the previous value" if self.on_loss == "hold" else "sets the force to zero"
        return (*lines, f"uses the packet {newest}, {missing} on loss")


def keys_of_pairs(node: Node | None) -> set[str]:
    """Return the keys of all pairs of groups in the node of `pairs`."""
    bodies = [value for _, value in _entries(node)]
    values = [value for body in bodies for _, value in _entries(body)]
    return {key.text for value in values for key, _ in _entries(value)}


def _entries(node: Node | None) -> tuple[tuple[Scalar, Node], ...]:
    """Return the entries of a mapping; none of another node."""
    return node.entries if isinstance(node, MappingNode) else ()


def _refuse_without_effect(
    nodes: Mapping[str, Node],
    given: Collection[str],
    mistakes: Mistakes,
    keys: Collection[str] = _EXAMPLES,
) -> None:
    """Record an error (E262) for each option of a channel that modifies none of the given keys.

    `keys` are the keys that can be written.
    """
    for word, (_, every) in _WORDS.items():
        modified = [key for key in every if key in keys]
        if word in nodes and not set(modified).intersection(given):
            message = f"{word} has no effect without {' or '.join(modified)}"
            mistakes.add("E262", nodes[word].location, message, fix=_EXAMPLES[modified[0]])


def read_channel(part: PartInstance, nodes: Mapping[str, Node], numbers: NamedNumbers) -> ChannelDeclaration:
    """Return the channel of a link, which may be reliable.

    Parameters
    ----------
    part
        The link.
    nodes
        The nodes of the entry by key; graph, pairs, loss and trace by their role instead of their key.
    numbers
        The named numbers: reader of probabilities and traces, collector of errors.
    """
    link, mistakes, words = part.name, numbers.mistakes, dict(part.options)
    _refuse_without_effect(nodes, nodes.keys() | keys_of_pairs(nodes.get("pairs")), mistakes)
    loss: Named[ScalarValue] = ()
    trace = None
    if "loss" in nodes:
        with mistakes:
            loss = _loss(link, nodes["loss"], numbers)
    if "trace" in nodes:
        location = nodes["trace"].location
        for key in ("loss", "jitter", "delays", "pairs"):
            if key in nodes:
                message = f"{link} has a trace, which can't be combined with"
                mistakes.add("E262", nodes[key].location, f"{message} {key}")
        with mistakes:
            text = text_of(nodes["trace"], "trace", _EXAMPLES["trace"])
            trace = numbers.files.read(text, partial(read_trace, named_at=location))
    jitter = dict(part.values).get("jitter") if "jitter" in nodes else None
    distribution, reorder, on_loss = (words.get(word, default) for word, (default, _) in _WORDS.items())
    named_jitter = None if jitter is None else (f"{link}.jitter", jitter)
    delays = None if trace is None else trace.delays
    return ChannelDeclaration(loss, named_jitter, distribution, reorder, on_loss, delays)


def read_pair_channel(
    name: str, body: MappingReader, component: Component, link: ChannelDeclaration, numbers: NamedNumbers
) -> ChannelDeclaration | None:
    """Return the channel of a pair of groups; None if the pair has that of the link.

    Parameters
    ----------
    name, body
        The name of the pair for parameters, such as `lan.pairs.left.right`, and its mapping.
    component, link
        The component and the channel of the link, which the pair completes.
    numbers
        The named numbers: reader of probabilities, collector of errors.
    """
    given = {*body.nodes, *["loss"] * bool(link.loss), *["jitter"] * bool(link.jitter)}
    _refuse_without_effect(body.nodes, given, numbers.mistakes, keys=("loss", "jitter"))
    channel = link
    if loss := body.read("loss", lambda node, _: _loss(name, node, numbers), ()):
        channel = replace(channel, loss=loss)
    declared = component.parameter("jitter")
    if isinstance(declared, Parameter):
        jitter = body.read("jitter", partial(numbers.read_for, item=declared), None)
        channel = channel if jitter is None else replace(channel, jitter=(f"{name}.jitter", jitter))
    words = {"distribution": channel.distribution, "on_loss": channel.on_loss}
    for key, word in words.items():
        option = component.parameter(key)
        if isinstance(option, Option):
            words[key] = body.read(key, partial(_option, item=option), word)
    if channel is link and body.nodes.keys().isdisjoint(words):
        return None
    return replace(channel, distribution=words["distribution"], on_loss=words["on_loss"])


def _option(node: Node, _: str, item: Option) -> str:
    """Return the word of an option; raises ApcError for an unknown word."""
    return read_option(node, item)


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
