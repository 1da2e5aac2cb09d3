"""The links of a topology: who hears whom over each, how late, and how unreliably.

Takes: a part of the section `links`, and its entry. Gives: `SceneLink`, `read_link`.
Guarantees: delays are 0 or more; graph, delays and channel fit the peers there are.
Does not: know what is sent.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from apc.compiler.compiled import Graph
from apc.compiler.components.component import Reference
from apc.compiler.components.parts import PartEntry
from apc.compiler.errors import Place
from apc.compiler.language.tables import NamedFiles
from apc.compiler.language.values import Value
from apc.compiler.scene.channels import SceneChannel, read_channel
from apc.compiler.scene.graphs import COMPLETE, SceneDelay, read_delays, read_graph
from apc.compiler.scene.instances import Part
from apc.compiler.scene.named_numbers import NamedNumbers
from apc.compiler.source.reading import fault

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
    part: Part, entry: PartEntry, counts: Mapping[str, int], numbers: NamedNumbers, files: NamedFiles
) -> SceneLink | None:
    """Read what a link's entry says beyond numbers and words.

    Parameters
    ----------
    part, entry
        The link as a part, and its entry.
    counts
        How many peers each group has.
    numbers
        Reads delays and probabilities.
    files
        Reads tables and traces.

    Returns
    -------
    None if its clock or delay is at fault, which was reported.

    Raises
    ------
    ApcError
        E210 it is no link.
    """
    component, clock, delay = part.component, part.reference("clock"), dict(part.values).get("delay")
    roles = {p.name: p.role for p in component.parameters if isinstance(p, Reference)}
    nodes = {roles.get(key.text, key.text): node for key, node in entry.body.entries}
    graph, delays = COMPLETE, tuple[SceneDelay, ...]()
    if "graph" in roles.values() and "graph" in nodes:
        with numbers.mistakes:
            graph = read_graph(nodes["graph"], counts, files)
    if "delays" in roles.values() and "delays" in nodes:
        with numbers.mistakes:
            delays = read_delays(nodes["delays"], counts, numbers)
    told = f"{part.name} is a {component.name}, which is no link:"
    if "clock" not in roles.values() or component.parameter("delay") is None:
        raise fault("E210", part.place, f"{told} it has no clock and delay", hint="type: Link")
    # Of a link's component nothing may be declared that no link obeys.
    idle = [name for name, _ in component.connectors]
    idle += [
        one.name for one in (*component.variables, *component.parameters) if one.name not in (*OBEYED, *roles)
    ]
    idle += [name for name, role in roles.items() if role == "link"]
    idle += ["equations"] * bool(component.equations or component.inner)
    if idle:
        raise fault("E210", part.place, f"{told} a link has no {idle[0]}", hint="type: Link")
    channel = read_channel(part.name, nodes, dict(part.values), dict(part.options), numbers, files)
    if clock is None or delay is None:
        return None
    return SceneLink(part.name, clock, delay, graph, delays, channel, part.place)
