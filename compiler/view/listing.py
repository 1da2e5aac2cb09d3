"""The contents of a topology as text for the user: the output of `apc show`.

Takes: a topology's path.
Gives: `show_text` and `show_document` (for JSON).
Guarantees: `show_text` has at most 80 columns unless a name is longer; the output is reproducible to the
byte.
Does not: analyze, or compute new values.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from fractions import Fraction
from itertools import chain, groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

from apc.compiler.compiled import Model
from apc.compiler.equations.causalization import SortedPeerType
from apc.compiler.equations.clocks import ClockedPeerType
from apc.compiler.equations.flatten import FlatPeerType, FlatSystem
from apc.compiler.equations.solution import Assignment, ImplicitBlock
from apc.compiler.equations.terms import text_of
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.multiples import common_multiple
from apc.compiler.peer_counts import clocks_in_use
from apc.compiler.pipeline import each_stage
from apc.compiler.topology.topology import Topology
from apc.compiler.view.diagram import Diagram, build_diagram, node_of, seconds, shape_of
from apc.compiler.view.stages import sent_text
from apc.compiler.wording import wrapped

PAIRWISE = ("max", "min")

# The labels of facts of the schedule that differ from their keys.
LABELS = {
    "kind": "peer type",
    "ticks": "ticks per frame",
    "on_the_way": "packets in transit",
    "age_s": "data age",
    "receive": "received",
}


def show_text(path: Path) -> str:
    """Return graph, equations and schedule of a topology as text."""
    stages: dict[str, Any] = dict(each_stage(path))
    topology: Topology = stages["topology"]
    lines = [topology.name, *wrapped(topology.description)]
    lines += ["", f"Graph of {node_of(topology)}", "", *_graph_lines(build_diagram(topology))]
    lines += _equation_lines(stages["flat"])
    return "\n".join([*lines, "", "Schedule", "", *_schedule_lines(schedule(stages["compiled"]))])


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
    flat: FlatPeerType, clocked: ClockedPeerType, sorted_type: SortedPeerType
) -> dict[str, Any]:
    """Return the equations of a peer type as plain data, as written and as computed."""
    return {
        "name": flat.name,
        "groups": flat.groups,
        "unknowns": [{"name": v.name, "unit": format_dimension(v.dimension)} for v in flat.variables],
        "equations": [{"equation": e.text, "origin": e.origin} for e in flat.equations],
        "partitions": [
            {"clock": p.clock, "variables": p.variables, "equations": [e.text for e in p.equations]}
            for p in clocked.partitions
        ],
        "states": sorted_type.states,
        "aliases": _computed(sorted_type.aliases),
        "computed": [
            {"clock": p.clock, "steps": [*map(_step_document, p.assignments)]} for p in sorted_type.partitions
        ],
        "sent": [{"name": s.name, "link": s.link, "is": text_of(s.expression)} for s in sorted_type.sends],
    }


def _step_document(step: Assignment | ImplicitBlock) -> dict[str, Any]:
    """Return an assignment or a nonlinear loop as plain data."""
    if not isinstance(step, ImplicitBlock):
        return {"name": step[0], "is": str(step[1])}
    inner, zero = _computed(step.inner), [str(residual) for residual in step.residuals]
    return {"loop": step.unknowns, "guess": step.tearing, "inner": inner, "zero": zero}


def _computed(values: Iterable[Assignment]) -> list[dict[str, str]]:
    """Return assignments as plain data."""
    return [{"name": name, "is": text_of(value)} for name, value in values]


def _graph_lines(diagram: Diagram) -> Iterator[str]:
    """Yield each part, link and group, with its clock and its connections."""
    titles = {box.key: box.lines[0] for box in diagram.boxes}
    for box in diagram.boxes:
        ticks = [f"clock {box.clock}"] if box.clock and box.role != "link" else []
        description = ", ".join((*box.lines[1:], *ticks))
        yield from wrapped(": ".join(filter(None, (box.lines[0], description))), "  ", "    ")
        ends = ({edge.item, edge.two} for edge in diagram.edges)
        joined = ", ".join(titles[other] for pair in ends if box.key in pair for other in pair - {box.key})
        yield from wrapped(f"connected to {joined}" if joined else "", "    ", "      ")


# ---- equations ----


def _equation_lines(flat: FlatSystem) -> Iterator[str]:
    """Yield the unknowns and equations of each peer type, by part; equal peer types are listed once."""
    listed: dict[tuple[object, ...], str] = {}
    for peer_type in flat.peer_types:
        sends = tuple((send.link, sent_text(send)) for send in peer_type.sends)
        equations = tuple((equation.origin, equation.text) for equation in peer_type.equations)
        first = listed.setdefault((equations, sends), peer_type.name)
        if first != peer_type.name:
            yield from ("", f"Equations of peer type {peer_type.name}: identical to those of {first}")
            continue
        count, unknowns = len(equations), len(peer_type.variables)
        yield from ("", f"Equations of peer type {peer_type.name}: {count} equations, {unknowns} unknowns")
        names: dict[str, list[str]] = {}
        for variable in peer_type.variables:
            names.setdefault(format_dimension(variable.dimension), []).append(variable.name)
        yield ""
        for unit, group in names.items():
            yield from wrapped(f"unknowns [{unit}]: {', '.join(group)}", "  ", "    ")
        yield ""
        titled = [*equations, *((f"packets over {link}", text) for link, text in sends)]
        for origin, rows in groupby(titled, key=itemgetter(0)):
            yield f"  {origin}"
            for _, text in rows:
                yield from wrapped(text, "    ", "        ")


# ---- the schedule ----


def schedule(model: Model) -> dict[str, Any]:
    """Return the events of one frame as plain data: clocks, holds, links and received values.

    Times are in seconds. `on_the_way` is the largest number of packets of one sender in transit; `age_s` has
    the age of the newest delivered packet at its arrival and at the arrival of the next.
    """
    timings = {timing.name: timing.value for timing in model.timings}
    periods = {clock.name: timings[clock.period] for clock in model.clocks}
    used = clocks_in_use(model)
    frame = common_multiple(periods[name] for name in used) if used else None
    return {
        "frame_s": None if frame is None else float(frame),
        "clocks": [
            {
                "clock": clock.name,
                "period_s": float(periods[clock.name]),
                "first_s": float(timings[clock.phase]),
                "ticks": int(frame / periods[clock.name]) if frame and clock.name in used else 0,
                "computes": [
                    *dict.fromkeys(
                        name
                        for peer_type in model.peer_types
                        for item in peer_type.clocks
                        if item.clock == clock.name
                        for name in item.outputs
                    )
                ],
                "sends": [link.name for link in model.links if clock.name in link.clocks],
            }
            for clock in model.clocks
        ],
        "holds": [
            {
                "kind": peer_type.name,
                "hold": hold.name,
                "clock": hold.clock,
                "delay_s": float(timings[hold.delay]),
                "held_s": float(periods[hold.clock]),
            }
            for peer_type in model.peer_types
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
                        for peer_type in model.peer_types
                        for send in peer_type.sends
                        if send.link == link.name
                        for name in send.channels
                    )
                ],
                "period_s": float(periods[clock]),
                "delay_s": float(timings[delay]),
                "on_the_way": math.ceil(timings[delay] / periods[clock]),
                "age_s": [float(timings[delay]), float(timings[delay] + periods[clock])],
            }
            for link in model.links
            for sender, receiver, delay, clock in (
                ("", "", link.delay, link.clock),
                *((pair.sender, pair.receiver, pair.delay, pair.clock or link.clock) for pair in link.pairs),
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
            for peer_type in model.peer_types
            for clock in peer_type.clocks
            for receive in clock.receives
        ],
    }


def _schedule_lines(facts: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of clocks, holds, links and received values."""
    frame, *tables = facts.values()
    if frame is None:
        yield "  no clocks: all equations are continuous"
        return
    yield f"  frame {seconds(Fraction(frame))} (least common multiple of the clock periods)"
    for row in chain(*tables):
        texts = (_shown(key, value) for key, value in row.items() if value)
        yield from wrapped(", ".join(texts), "  ", "    ")


def _shown(key: str, value: Any) -> str:
    """Return a fact of the schedule as text, times with their unit; a true fact as its name."""
    name, texts = LABELS.get(key, key.removesuffix("_s")), value if isinstance(value, list) else [value]
    if value is True:
        return name
    if key.endswith("_s"):
        return f"{name} {' to '.join(seconds(Fraction(text)) for text in texts)}"
    return f"{name} {' and '.join(map(str, texts))}"
