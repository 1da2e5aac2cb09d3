"""The contents of a topology as text for the user: the output of `apc show`.

Takes: a topology's path.
Gives: `show_text` and `show_document` (for JSON); `diagram_of`.
Guarantees: `show_text` has at most 80 columns unless a name is longer; the output is reproducible to the
byte.
Does not: analyze, or compute new values.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

from apc.compiler.compiled import Model
from apc.compiler.equations.causalization import SortedPeerType
from apc.compiler.equations.clocks import ClockedPeerType
from apc.compiler.equations.flatten import FlatPeerType
from apc.compiler.equations.solution import Assignment, ImplicitBlock
from apc.compiler.equations.terms import text_of
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.multiples import common_multiple
from apc.compiler.pipeline import each_stage, run_stages
from apc.compiler.topology.topology import Topology
from apc.compiler.view.diagram import Diagram, build_diagram, node_of, seconds, shape_of
from apc.compiler.view.stages import describe
from apc.compiler.wording import wrapped

PAIRWISE = ("max", "min")


def show_text(path: Path) -> str:
    """Return graph, equations and schedule of a topology as text."""
    stages: dict[str, Any] = dict(each_stage(path))
    topology: Topology = stages["topology"]
    lines = [topology.name, *wrapped(topology.description)]
    lines += ["", f"GRAPH of {node_of(topology)}", *_graph_lines(build_diagram(topology))]
    for title, stage in (("EQUATIONS", "flat"), ("COMPUTED", "sorted")):
        lines += ["", title]
        for line in describe(stages[stage]).splitlines():
            indent = " " * (2 + len(line) - len(line.lstrip()))
            lines += wrapped(line, indent, indent + "    ")
    return "\n".join([*lines, "", "SCHEDULE", *_schedule_lines(schedule(stages["compiled"]))])


def show_document(path: Path) -> dict[str, Any]:
    """Return graph, equations and schedule of a topology as plain data."""
    stages: dict[str, Any] = dict(each_stage(path))
    topology, compiled = stages["topology"], stages["compiled"]
    diagram = build_diagram(topology)
    peer_types = zip(
        stages["flat"].peer_types, stages["clocked"].peer_types, stages["sorted"].peer_types, strict=True
    )
    return {
        "topology": topology.name,
        "description": topology.description,
        "peers": topology.peers,
        "graph": {
            "boxes": [asdict(box) for box in diagram.boxes],
            "edges": [asdict(edge) for edge in diagram.edges],
            "links": [
                {"name": k.name, "clock": k.clock, "shape": shape_of(k), "arcs": k.graph.arcs.tolist()}
                for k in topology.links
            ],
            "groups": [{"name": group.name, "count": group.count} for group in topology.groups],
        },
        "kinds": [_peer_type_document(*peer_type) for peer_type in peer_types],
        "schedule": schedule(compiled),
        "dropped": [{"name": name, "reason": reason} for name, reason in compiled.dropped],
    }


def _peer_type_document(
    flat: FlatPeerType, clocked: ClockedPeerType, ordered: SortedPeerType
) -> dict[str, Any]:
    """Return the equations of the peers of one structure, as they are written and as they are computed."""
    return {
        "name": flat.name,
        "groups": flat.groups,
        "unknowns": [{"name": v.name, "unit": format_dimension(v.dimension)} for v in flat.variables],
        "equations": [{"equation": e.text, "origin": e.origin} for e in flat.equations],
        "partitions": [
            {"clock": p.clock, "variables": p.variables, "equations": [e.text for e in p.equations]}
            for p in clocked.partitions
        ],
        "states": ordered.states,
        "aliases": _computed(ordered.aliases),
        "computed": [
            {"clock": p.clock, "steps": [*map(_step_document, p.assignments)]} for p in ordered.partitions
        ],
        "sent": [{"name": s.name, "link": s.link, "is": text_of(s.expression)} for s in ordered.sends],
    }


def _step_document(step: Assignment | ImplicitBlock) -> dict[str, Any]:
    if not isinstance(step, ImplicitBlock):
        return {"name": step[0], "is": str(step[1])}
    inner, zero = _computed(step.inner), [str(residual) for residual in step.residuals]
    return {"loop": step.unknowns, "guess": step.tearing, "inner": inner, "zero": zero}


def _computed(values: Iterable[Assignment]) -> list[dict[str, str]]:
    return [{"name": name, "is": text_of(value)} for name, value in values]


def diagram_of(path: Path) -> Diagram:
    """Return the graph of a topology."""
    topology = run_stages(path, until="topology")
    assert isinstance(topology, Topology)
    return build_diagram(topology)


def _graph_lines(diagram: Diagram) -> Iterator[str]:
    """Yield each part, link and group, with its connections."""
    titles = {box.key: box.lines[0] for box in diagram.boxes}
    for box in diagram.boxes:
        ticks = [f"at each tick of {box.clock}"] if box.clock and box.role != "link" else []
        description = ", ".join((*box.lines[1:], *ticks))
        yield from wrapped(": ".join(filter(None, (box.lines[0], description))), "  ", "    ")
        ends = ({edge.item, edge.two} for edge in diagram.edges)
        joined = ", ".join(titles[other] for pair in ends if box.key in pair for other in pair - {box.key})
        yield from wrapped(f"joined to {joined}" if joined else "", "    ", "      ")


# ---- the schedule ----


def schedule(system: Model) -> dict[str, Any]:
    """Return the events of one frame: clocks, holds, links, and received values; times in seconds.

    `in_flight` is the largest number of a sender's packets in transit; the newest delivered one has the age
    `age_s` between its arrival and that of the next.
    """
    timings = {timing.name: timing.value for timing in system.timings}
    periods = {clock.name: timings[clock.period] for clock in system.clocks}
    frame = common_multiple(periods.values()) if periods else None
    return {
        "frame_s": None if frame is None else float(frame),
        "clocks": [
            {
                "clock": clock.name,
                "period_s": float(periods[clock.name]),
                "first_s": float(timings[clock.phase]),
                "ticks": int(frame / periods[clock.name]) if frame is not None else 0,
                "computes": [
                    *dict.fromkeys(
                        name
                        for peer_type in system.peer_types
                        for item in peer_type.clocks
                        if item.clock == clock.name
                        for name in item.outputs
                    )
                ],
                "sends": [link.name for link in system.links if link.clock == clock.name],
            }
            for clock in system.clocks
        ],
        "holds": [
            {
                "kind": peer_type.name,
                "hold": hold.name,
                "clock": hold.clock,
                "delay_s": float(timings[hold.delay]),
                "held_s": float(periods[hold.clock]),
            }
            for peer_type in system.peer_types
            for hold in peer_type.holds
        ],
        "links": [
            {
                "link": link.name,
                "from": sender,
                "to": receiver,
                "sends": [
                    *dict.fromkeys(
                        name
                        for peer_type in system.peer_types
                        for send in peer_type.sends
                        if send.link == link.name
                        for name in send.channels
                    )
                ],
                "period_s": float(periods[link.clock]),
                "delay_s": float(timings[delay]),
                "on_the_way": math.ceil(timings[delay] / periods[link.clock]),
                "age_s": [float(timings[delay]), float(timings[delay] + periods[link.clock])],
            }
            for link in system.links
            for sender, receiver, delay in (
                ("", "", link.delay),
                *((pair.sender, pair.receiver, pair.delay) for pair in link.delays),
            )
        ],
        "receives": [
            {
                "kind": peer_type.name,
                "receive": receive.name,
                "clock": clock.clock,
                "link": receive.link,
                "pairwise": receive.edge is not None or receive.operator in PAIRWISE,
            }
            for peer_type in system.peer_types
            for clock in peer_type.clocks
            for receive in clock.receives
        ],
    }


def _schedule_lines(facts: dict[str, Any]) -> Iterator[str]:
    """Yield clocks, holds, links and receives, each with its description; empty sections are omitted."""
    frame, *tables = facts.values()
    if frame is None:
        yield "  No clock ticks: everything is continuous."
        return
    yield f"  frame of {seconds(Fraction(frame))}, after which every clock stands as before"
    for row in chain(*tables):
        texts = (_shown(key, value) for key, value in row.items() if value)
        yield from wrapped(", ".join(texts), "  ", "    ")


def _shown(key: str, value: Any) -> str:
    """Return a fact as text, times with their unit; one that holds needs no more than its name."""
    name, texts = key.removesuffix("_s").replace("_", " "), value if isinstance(value, list) else [value]
    if value is True:
        return name
    if key.endswith("_s"):
        return f"{name} {' to '.join(seconds(Fraction(text)) for text in texts)}"
    return f"{name} {' and '.join(map(str, texts))}"
