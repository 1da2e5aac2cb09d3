"""What a scene is made of, as text for a person to read: what `apc show` tells.

Takes: a topology's path.
Gives: `show_text` and `show_document` (for JSON); `diagram_of`.
Guarantees: `show_text` has at most 80 columns wherever a name allows it; the same topology gives the same
bytes.
Does not: analyse, or compute anything new.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from fractions import Fraction
from pathlib import Path
from typing import Any

from apc.compiler.compiled import CompiledSystem, Kind
from apc.compiler.equations.clocks import ClockedSystem
from apc.compiler.equations.flatten import FlatSystem
from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.structure import SortedSystem
from apc.compiler.equations.terms import text_of
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.multiples import common_multiple
from apc.compiler.pipeline import each_stage, run_stages
from apc.compiler.scene.scene import Scene
from apc.compiler.view.diagram import Diagram, boxes_of, build_diagram, edges_of, one_of, seconds
from apc.compiler.view.stages import describe
from apc.compiler.words import wrapped

PAIRWISE = ("max", "min")


def show_text(path: Path) -> str:
    """Return graph, equations and schedule of a topology as text."""
    scene, flat, _, ordered, compiled = _stages(path)
    diagram = build_diagram(scene)
    lines = [diagram.title, *wrapped(diagram.about)]
    lines += ["", f"GRAPH of {one_of(diagram)}", *_graph_lines(diagram)]
    lines += ["", "EQUATIONS", *_stage_lines(flat), "", "COMPUTED", *_stage_lines(ordered)]
    lines += ["", "SCHEDULE", *_schedule_lines(schedule(compiled))]
    return "\n".join(lines)


def _stage_lines(value: FlatSystem | SortedSystem) -> Iterator[str]:
    for line in describe(value).splitlines():
        indent = " " * (2 + len(line) - len(line.lstrip()))
        yield from wrapped(line, indent, indent + "    ")


def show_document(path: Path) -> dict[str, Any]:
    """Return graph, equations and schedule of a topology as plain data."""
    scene, flat, clocked, ordered, compiled = _stages(path)
    diagram = build_diagram(scene)
    whole = asdict(diagram)
    return {
        "topology": diagram.title,
        "about": diagram.about,
        "peers": diagram.peers,
        "graph": {key: whole[key] for key in ("parts", "joints", "links", "groups")},
        "kinds": [
            {
                "name": one.name,
                "groups": list(one.groups),
                "unknowns": [{"name": v.name, "unit": format_dimension(v.dimension)} for v in one.variables],
                "equations": [{"equation": e.text, "origin": e.origin} for e in one.equations],
                "partitions": [
                    {
                        "clock": p.clock,
                        "variables": list(p.variables),
                        "equations": [e.text for e in p.equations],
                    }
                    for p in two.partitions
                ],
                "states": list(three.states),
                "aliases": [{"name": name, "is": str(value)} for name, value in three.aliases],
                "computed": [
                    {"clock": p.clock, "steps": [_step_document(step) for step in p.assignments]}
                    for p in three.partitions
                ],
                "sent": [{"name": s.name, "link": s.link, "is": text_of(s.expression)} for s in three.sends],
            }
            for one, two, three in zip(flat.kinds, clocked.kinds, ordered.kinds, strict=True)
        ],
        "schedule": schedule(compiled),
        "dropped": [{"name": name, "reason": reason} for name, reason in compiled.dropped],
    }


def diagram_of(path: Path) -> Diagram:
    """Return the graph of a topology."""
    scene = run_stages(path, until="scene")
    assert isinstance(scene, Scene)
    return build_diagram(scene)


def _stages(path: Path) -> tuple[Scene, FlatSystem, ClockedSystem, SortedSystem, CompiledSystem]:
    values = [value for stage, value in each_stage(path) if stage != "source"]
    scene, flat, clocked, ordered, compiled = values
    assert isinstance(scene, Scene)
    assert isinstance(flat, FlatSystem)
    assert isinstance(clocked, ClockedSystem)
    assert isinstance(ordered, SortedSystem)
    assert isinstance(compiled, CompiledSystem)
    return scene, flat, clocked, ordered, compiled


def _graph_lines(diagram: Diagram) -> Iterator[str]:
    """Yield each part, link and group, and what it is joined to."""
    boxes = {box.key: box for box in boxes_of(diagram)}
    joined: dict[str, list[str]] = {key: [] for key in boxes}
    for edge in edges_of(diagram):
        joined[edge.one].append(boxes[edge.two].lines[0])
        joined[edge.two].append(boxes[edge.one].lines[0])
    for box in boxes.values():
        ticks = [f"at each tick of {box.clock}"] if box.clock and box.role != "link" else []
        about = ", ".join((*box.lines[1:], *ticks))
        yield from wrapped(f"{box.lines[0]}: {about}" if about else box.lines[0], "  ", "    ")
        if joined[box.key]:
            yield from wrapped(f"joined to {', '.join(joined[box.key])}", "    ", "      ")


def _step_document(step: Any) -> dict[str, Any]:
    if not isinstance(step, ImplicitBlock):
        return {"name": step[0], "is": str(step[1])}
    return {
        "loop": list(step.unknowns),
        "guess": list(step.tearing),
        "inner": [{"name": name, "is": str(value)} for name, value in step.inner],
        "zero": [str(residual) for residual in step.residuals],
    }


# ---- the schedule ----


def schedule(system: CompiledSystem) -> dict[str, Any]:
    """Return what happens in one frame: clocks, holds, links, and what is heard; times in seconds.

    `on_the_way` is the largest number of a sender's packets that have left and not arrived; the newest one
    delivered is `age_s` old, from its arrival to that of the next.
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
                "computes": _computed_at(system.kinds, clock.name),
                "sends": [link.name for link in system.links if link.clock == clock.name],
            }
            for clock in system.clocks
        ],
        "holds": [
            {
                "kind": kind.name,
                "hold": hold.name,
                "clock": hold.clock,
                "delay_s": float(timings[hold.delay]),
                "held_s": float(periods[hold.clock]),
            }
            for kind in system.kinds
            for hold in kind.holds
        ],
        "links": [
            {
                "link": link.name,
                "from": sender,
                "to": receiver,
                "sends": _sent_over(system.kinds, link.name),
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
                "kind": kind.name,
                "receive": receive.name,
                "clock": clock.clock,
                "link": receive.link,
                "pairwise": receive.edge is not None or receive.operator in PAIRWISE,
            }
            for kind in system.kinds
            for clock in kind.clocks
            for receive in clock.receives
        ],
    }


def _computed_at(kinds: Iterable[Kind], clock: str) -> list[str]:
    outputs = (name for kind in kinds for part in kind.clocks if part.clock == clock for name in part.outputs)
    return list(dict.fromkeys(outputs))


def _sent_over(kinds: Iterable[Kind], link: str) -> list[str]:
    channels = (name for kind in kinds for part in kind.sends if part.link == link for name in part.channels)
    return list(dict.fromkeys(channels))


def _schedule_lines(facts: dict[str, Any]) -> Iterator[str]:
    """Yield clocks, holds, links and receives, each with what is said of it; what is nothing is left out."""
    if facts["frame_s"] is None:
        yield "  No clock ticks: everything is continuous."
        return
    yield f"  frame of {seconds(Fraction(facts['frame_s']))}, after which every clock stands as before"
    for row in (row for rows in facts.values() if isinstance(rows, list) for row in rows):
        told = (
            f"{key.removesuffix('_s').replace('_', ' ')} {_shown(key, row[key])}" for key in row if row[key]
        )
        yield from wrapped(", ".join(map(str.strip, told)), "  ", "    ")


def _shown(key: str, value: Any) -> str:
    """Return a fact as text; one that holds needs no more than its name."""
    if value is True:
        return ""
    if isinstance(value, list):
        return " to ".join(map(seconds, map(Fraction, value))) if key.endswith("_s") else " and ".join(value)
    return seconds(Fraction(value)) if key.endswith("_s") else str(value)
