"""How unreliable a link is, as its entry says it: lost packets, jitter, a recorded trace.

Takes: the YAML nodes of a link's `loss` and `trace`, its `jitter` and words. Gives: `SceneChannel`,
`read_channel`, `PROBABILITY`.
Guarantees: probabilities lie from 0 to 1; nothing is said that has no effect.
Does not: draw a packet (see the runtime), or know how late a reliable packet is.

The loss model is netem's `gemodel p [r [1-h [1-k]]]` (tc-netem(8), after Gilbert and Elliott): a link in its
good state loses a packet with the probability 1-k and one in its bad state with 1-h; after each packet a good
one turns bad with the probability p, a bad one good with r. Its defaults are netem's, r = 1-p, 1-h = 1 and
1-k = 0, which make losses independent: `loss: 2 %` is `loss: {p: 2 %}`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.components.component import Number as Parameter
from apc.compiler.errors import Mistakes, Place
from apc.compiler.language.dimensions import DIMENSIONLESS
from apc.compiler.language.expression import Binary, Name, Number
from apc.compiler.language.recordings import read_trace
from apc.compiler.language.tables import NamedFiles
from apc.compiler.language.units import Unit
from apc.compiler.language.values import Value
from apc.compiler.source.nodes import Mapping as MappingNode
from apc.compiler.source.nodes import Node, Scalar
from apc.compiler.source.reading import brief, check_keys, read_text

PROBABILITIES = ("p", "r", "1-h", "1-k")  # netem's names, in netem's order
LOSS_EXAMPLE = "loss: {p: 1 %, r: 25 %}"
_EXAMPLES = {"loss": "loss: 2 %", "jitter": "jitter: 2 ms", "trace": "trace: delays.csv"}
# What a number of a link's losses is, where one is read.
PROBABILITY = Parameter(
    name="probability",
    unit=Unit("%", Fraction(1, 100), DIMENSIONLESS),
    default=None,
    minimum=Fraction(0),
    open_minimum=False,
    maximum=Fraction(1),
    divided=False,
    words=(),
    about="",
    place=Place("probability"),
)

# What each word is about: it says nothing on a link that has none of them.
_ABOUT = {"distribution": ("jitter",), "reorder": ("jitter", "trace"), "on_loss": ("loss", "trace")}


@dataclass(frozen=True, slots=True, eq=False)
class SceneChannel:
    """What makes a link unreliable.

    `loss` has the names and values of p, r, 1-h and 1-k, or is empty; `jitter` is None on a link without.
    `trace` (n,) holds recorded delays in seconds, infinite for a lost packet, or is None.
    """

    loss: tuple[tuple[str, Value], ...]
    jitter: Value | None
    distribution: str
    reorder: str
    on_loss: str
    trace: NDArray[np.float64] | None

    @property
    def told(self) -> tuple[str, ...]:
        """What it is, in words."""
        lines = []
        if self.loss:
            p, r, one_minus_h, one_minus_k = (float(100 * value.number) for _, value in self.loss)
            lines.append(f"loss: p {p:.6g} %, r {r:.6g} %, 1-h {one_minus_h:.6g} %, 1-k {one_minus_k:.6g} %")
        if self.jitter is not None:
            lines.append(f"jitter {float(1000 * self.jitter.number):.6g} ms, {self.distribution}")
        if self.trace is not None:
            lines.append(f"a recorded trace of {self.trace.size} packets")
        newest = "sent last" if self.reorder == "newest" else "that arrived last"
        missing = "a lost one changes nothing" if self.on_loss == "hold" else "a lost one exerts no force"
        return (*lines, f"the packet {newest} counts; {missing}")


def read_channel(
    link: str,
    body: MappingNode,
    nodes: Mapping[str, Node | None],
    jitter: Value | None,
    words: Mapping[str, str],
    read_number: Callable[[Node, str], Value | None],
    files: NamedFiles,
) -> SceneChannel | None:
    """Read what makes a link unreliable; None when its entry says nothing of the kind.

    Parameters
    ----------
    link, body
        The link's name and entry.
    nodes
        Its nodes of the roles loss, trace and delays, and of its jitter, where they are given.
    jitter
        The value of its jitter, given or by default.
    words
        Its words: distribution, reorder, on_loss.
    read_number
        Reads a number without a unit, or an expression for one.
    files
        Reads a trace, and takes what is at fault.
    """
    mistakes = files.mistakes
    given = {key for key in ("loss", "jitter", "trace") if nodes.get(key) is not None}
    _check_words(link, body, given, mistakes)
    if not given:
        return None
    trace = nodes.get("trace")
    for key in ("loss", "jitter", "delays") if trace is not None else ():
        if (other := nodes.get(key)) is not None:
            what = f"{link} has a trace, which says when every packet arrives: it can't have {key} as well"
            mistakes.add("E262", other.place, what)
    return SceneChannel(
        _loss(link, nodes.get("loss"), read_number, mistakes),
        jitter if "jitter" in given else None,
        words.get("distribution", "uniform"),
        words.get("reorder", "newest"),
        words.get("on_loss", "hold"),
        None if trace is None else _trace(trace, files),
    )


def _check_words(link: str, body: MappingNode, given: set[str], mistakes: Mistakes) -> None:
    """Record a word about something that the link hasn't got."""
    for word, about in _ABOUT.items():
        node = body.get(word)
        if node is not None and not given.intersection(about):
            what = f"{link} says {word} but has no {' or '.join(about)} that this would be about"
            mistakes.add("E262", node.place, what, hint=_EXAMPLES[about[0]])


def _loss(
    link: str, node: Node | None, read_number: Callable[[Node, str], Value | None], mistakes: Mistakes
) -> tuple[tuple[str, Value], ...]:
    """Read a probability, or a mapping of netem's four."""
    if node is None:
        return ()
    name = f"{link}.loss"
    if not isinstance(node, MappingNode):
        p = _probability(node, "loss", read_number, mistakes)
        return () if p is None else _completed(name, name, {"p": p})
    node = check_keys(node, PROBABILITIES, f"the loss of {link}", mistakes)
    if node.get("p") is None:
        mistakes.add("E201", node.place, f"the loss of {link} has no p", hint=LOSS_EXAMPLE)
    found = {}
    for key in PROBABILITIES:
        value = node.get(key)
        number = None if value is None else _probability(value, key, read_number, mistakes)
        if number is not None:
            found[key] = number
    return _completed(name, f"{name}.p", found) if "p" in found else ()


def _completed(name: str, name_p: str, given: Mapping[str, Value]) -> tuple[tuple[str, Value], ...]:
    """Return all four probabilities with their names, those not given as netem has them."""
    p = given["p"]
    rest = Binary("-", Number(Fraction(1)), Name(tuple(name_p.split("."))))
    defaults = {
        "r": Value(1 - p.number, DIMENSIONLESS, rest, p.place),
        "1-h": Value(Fraction(1), DIMENSIONLESS, None, p.place),
        "1-k": Value(Fraction(0), DIMENSIONLESS, None, p.place),
    }
    others = ((f"{name}.{key}", given.get(key, default)) for key, default in defaults.items())
    return ((name_p, p), *others)


def _probability(
    node: Node, what: str, read_number: Callable[[Node, str], Value | None], mistakes: Mistakes
) -> Value | None:
    value = read_number(node, what)
    if value is None or 0 <= value.number <= 1:
        return value
    got = brief(node.text) if isinstance(node, Scalar) else str(value)
    bare = isinstance(node, Scalar) and isinstance(node.value, int | float) and 1 < value.number <= 100
    hint = f"{what}: {got} %" if bare else ""
    mistakes.add("E261", value.place, what, expected="a probability, 0 % to 100 %", got=got, hint=hint)
    return None


def _trace(node: Node, files: NamedFiles) -> NDArray[np.float64] | None:
    text = read_text(node, "trace", files.mistakes, hint=_EXAMPLES["trace"])
    trace = None if text is None else files.read(text, lambda path: read_trace(path, node.place))
    return None if trace is None else trace.delays
