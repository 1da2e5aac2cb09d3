"""The links of a topology: who hears whom over each, how late, and how unreliably.

Takes: a part of the section `links`, and its entry. Gives: `SceneLink`, `read_link`.
Guarantees: delays are 0 or more; graph, delays and channel fit the peers there are.
Does not: know what is sent.
"""

from __future__ import annotations

from collections.abc import Mapping as MappingType
from dataclasses import dataclass

from apc.compiler.compiled import Graph
from apc.compiler.components.component import Reference
from apc.compiler.errors import Place
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND
from apc.compiler.language.tables import NamedFiles
from apc.compiler.language.values import Value
from apc.compiler.scene.channels import SceneChannel, read_channel
from apc.compiler.scene.graphs import COMPLETE, SceneDelay, read_graph, read_pairs
from apc.compiler.scene.instances import Part
from apc.compiler.scene.named_numbers import NamedNumbers
from apc.compiler.source.nodes import Mapping, Node

OBEYED = ("delay", "jitter", "distribution", "reorder", "on_loss")  # a link's numbers and words


@dataclass(frozen=True, slots=True)
class SceneLink:
    """Who hears whom over a link, how late, and how unreliably (`channel`, None for a reliable one)."""

    name: str
    clock: str
    delay: Value
    graph: Graph
    delays: tuple[SceneDelay, ...]
    channel: SceneChannel | None
    place: Place


def read_link(
    part: Part,
    body: Mapping,
    counts: MappingType[str, int],
    numbers: NamedNumbers,
    files: NamedFiles,
) -> SceneLink | None:
    """Read what a link's entry says beyond numbers and words.

    Parameters
    ----------
    part, body
        The link as a part, and its entry.
    counts
        How many peers each group has.
    numbers
        Reads the delays.
    files
        Reads tables and traces, and takes what is at fault.

    Returns
    -------
    None if it is no link, or its clock or delay is at fault.
    """
    values = dict(part.values)
    clock = part.reference("clock")
    roles = {p.role: p.name for p in part.component.parameters if isinstance(p, Reference)}
    graph = COMPLETE
    if "graph" in roles:
        graph = read_graph(body.get(roles["graph"]), counts, files)
    delays = _read_delays(body.get(roles["delays"]), counts, numbers) if "delays" in roles else ()
    if "clock" not in roles or part.component.parameter("delay") is None:
        what = f"{part.name} is a {part.component.name}, which is no link: it has no clock and delay"
        files.mistakes.add("E210", part.place, what, hint="type: Link")
        return None
    if idle := _idle(part):
        what = f"{part.name} is a {part.component.name}, which is no link: a link has no {idle}"
        files.mistakes.add("E210", part.place, what, hint="type: Link")
        return None
    channel = read_channel(
        part.name,
        body,
        {role: body.get(name) for role, name in roles.items()} | {"jitter": body.get("jitter")},
        values.get("jitter"),
        dict(part.options),
        lambda node, what: numbers.read(node, what, DIMENSIONLESS, "%"),
        files,
    )
    if clock is None or "delay" not in values:
        return None  # reported where it is
    return SceneLink(part.name, clock, values["delay"], graph, delays, channel, part.place)


def _idle(part: Part) -> str:
    """Return something that a link's component has and no link obeys, if there is such a thing."""
    component = part.component
    named = (*(name for name, _ in component.connectors), *(one.name for one in component.variables))
    named += tuple(p.name for p in component.parameters if isinstance(p, Reference) and p.role == "link")
    named += tuple(
        p.name for p in component.parameters if not isinstance(p, Reference) and p.name not in OBEYED
    )
    return next(iter((*named, *("equations" for _ in (*component.equations, *component.inner)))), "")


def _read_delays(
    node: Node | None, counts: MappingType[str, int], numbers: NamedNumbers
) -> tuple[SceneDelay, ...]:
    """Read the delays of pairs of groups that differ from the link's."""
    delays = []
    for sender, receiver, written in read_pairs(node, counts, numbers.mistakes):
        value = numbers.read(written, f"the delay from {sender} to {receiver}", SECOND, "ms")
        if value is not None and value.number < 0:
            numbers.mistakes.add("E207", value.place, "a delay", expected="0 s or more", got=str(value))
        elif value is not None:
            delays.append(SceneDelay(sender, receiver, value))
    return tuple(delays)
