"""What a scene is made of, as text for a person to read: what `apc show` tells.

Takes: a topology's path.
Gives: `show_text` and `show_document` (for JSON), `show_dot`, `show_svg`, `show_page`.
Guarantees: `show_text` has at most 80 columns wherever a name allows it; the same topology gives the same
bytes.
Does not: analyse, or compute anything new.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

from apc.compiler.compiled import CompiledSystem, Kind
from apc.compiler.equations.clocks import ClockedSystem
from apc.compiler.equations.flatten import FlatKind, FlatSystem
from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.structure import SortedKind, SortedSystem
from apc.compiler.equations.terms import text_of
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.multiples import common_multiple
from apc.compiler.pipeline import each_stage, run_stages
from apc.compiler.scene.scene import Scene
from apc.compiler.view.diagram import Diagram, build_diagram, draw_dot, one_of, seconds
from apc.compiler.view.picture import place
from apc.compiler.view.stages import step_lines
from apc.compiler.view.svg import Picture, draw_svg
from apc.compiler.words import counted, wrapped

PAIRWISE = ("max", "min")


def show_dot(path: Path) -> str:
    """Return the graph of a topology in Graphviz's language."""
    return draw_dot(_diagram(path))


def show_svg(path: Path) -> str:
    """Return the graph of a topology as a picture, an SVG document."""
    return draw_svg(show_page(path))


def show_page(path: Path) -> Picture:
    """Return the graph of a topology as marks on a page."""
    return place(_diagram(path))


def show_text(path: Path) -> str:
    """Return graph, equations and schedule of a topology as text."""
    scene, flat, _, ordered, compiled = _stages(path)
    diagram = build_diagram(scene)
    lines = [diagram.title, *wrapped(diagram.about)]
    lines += ["", "GRAPH", *_graph_lines(diagram)]
    for flat_kind, sorted_kind in zip(flat.kinds, ordered.kinds, strict=True):
        of = f" of {flat_kind.name}" if len(flat.kinds) > 1 else ""
        lines += ["", f"EQUATIONS{of}", *_equation_lines(flat_kind)]
        lines += ["", f"COMPUTED{of}", *_computed_lines(sorted_kind)]
    lines += ["", "SCHEDULE", *_schedule_lines(schedule(compiled))]
    return "\n".join(lines)


def show_document(path: Path) -> dict[str, Any]:
    """Return graph, equations and schedule of a topology as plain data."""
    scene, flat, clocked, ordered, compiled = _stages(path)
    diagram = build_diagram(scene)
    return {
        "topology": diagram.title,
        "about": diagram.about,
        "peers": diagram.peers,
        "graph": _graph_document(diagram),
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
                "aliases": [{"name": name, "is": text_of(value)} for name, value in three.aliases],
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


def _diagram(path: Path) -> Diagram:
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


# ---- the graph ----


def _graph_lines(diagram: Diagram) -> Iterator[str]:
    yield f"  {one_of(diagram)}"
    meets: dict[str, list[str]] = {node.name: [] for node in diagram.nodes}
    for one, two in diagram.joints:
        meets[one].append(two)
        meets[two].append(one)
    for node in diagram.nodes:
        if node.role in ("ground", "joint"):
            continue
        text = f"{node.name}: {', '.join(node.lines) or node.role}"
        if node.clock:
            text += f", at each tick of {node.clock}"
        yield from wrapped(text, "    ", "      ")
        if node.role != "mass" and meets[node.name]:
            ends = ["ground" if name.startswith("ground of ") else name for name in meets[node.name]]
            yield from wrapped(f"joins {' and '.join(ends)}", "      ", "        ")
        if node.links:
            yield from wrapped(f"hears the others over {', '.join(node.links)}", "      ", "        ")
    for node in diagram.nodes:
        if node.role == "joint":
            yield from wrapped(f"rigidly joined: {node.name}", "    ", "      ")
    for net in diagram.nets:
        shape = f"{counted(len(net.pairs), 'arc')}" if net.shape == "arcs" else f"{net.shape} graph"
        yield from wrapped(f"{net.name}: {shape}, {', '.join(net.lines)}", "  ", "    ")
    for crowd in diagram.crowds:
        own = f"; {', '.join(crowd.settings)}" if crowd.settings else ""
        yield from wrapped(f"{crowd.name}: {counted(crowd.count, 'peer')}{own}", "  ", "    ")


def _graph_document(diagram: Diagram) -> dict[str, Any]:
    return {
        "parts": [
            {"name": n.name, "role": n.role, "about": list(n.lines), "clock": n.clock, "links": list(n.links)}
            for n in diagram.nodes
        ],
        "joints": [list(pair) for pair in diagram.joints],
        "links": [
            {
                "name": net.name,
                "clock": net.clock,
                "graph": net.shape,
                "arcs": [list(pair) for pair in net.pairs],
                "about": list(net.lines),
            }
            for net in diagram.nets
        ],
        "groups": [
            {"name": crowd.name, "count": crowd.count, "settings": list(crowd.settings)}
            for crowd in diagram.crowds
        ],
    }


# ---- the equations ----


def _equation_lines(kind: FlatKind) -> Iterator[str]:
    numbers = counted(len(kind.equations), "equation"), counted(len(kind.variables), "unknown")
    yield f"  {numbers[0]}, {numbers[1]}"
    origins = dict.fromkeys(equation.origin for equation in kind.equations)
    for origin in origins:
        yield f"  {'connections' if origin == 'connection' else origin}"
        for equation in kind.equations:
            if equation.origin == origin:
                yield from wrapped(equation.text, "    ", "        ")


def _computed_lines(kind: SortedKind) -> Iterator[str]:
    """Yield what each clock computes, in order, samples and sends included."""
    yield from wrapped(f"states: {', '.join(kind.states) or 'none'}", "  ", "    ")
    samples = {clock: [(n, e) for n, its, e in kind.samples if its == clock] for _, clock, _ in kind.samples}
    for partition in kind.partitions:
        yield f"  {partition.clock}" if partition.clock == "continuous" else f"  tick of {partition.clock}"
        for name, expression in samples.get(partition.clock, []):
            yield from wrapped(f"{name} := {text_of(expression)}", "    ", "        ")
        for step in partition.assignments:
            for line in step_lines(step):
                indent = line[: len(line) - len(line.lstrip())]
                yield from wrapped(line.lstrip(), indent, indent + "    ")
    for send in kind.sends:
        yield from wrapped(
            f"sent over {send.link}: {send.name} := {text_of(send.expression)}", "  ", "      "
        )
    pairs = {name: text_of(value) for name, value in kind.aliases}
    if pairs:
        yield "  the same as another"
        yield from wrapped(", ".join(f"{name} = {value}" for name, value in pairs.items()), "    ", "    ")


def _step_document(step: Any) -> dict[str, Any]:
    if not isinstance(step, ImplicitBlock):
        return {"name": step[0], "is": text_of(step[1])}
    return {
        "loop": list(step.unknowns),
        "guess": list(step.tearing),
        "inner": [{"name": name, "is": text_of(value)} for name, value in step.inner],
        "zero": [text_of(residual) for residual in step.residuals],
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
    if facts["frame_s"] is None:
        yield "  No clock ticks: everything is continuous."
        return
    yield f"  frame of {_time(facts['frame_s'])}, after which every clock stands as before"
    for clock in facts["clocks"]:
        first = f", first at {_time(clock['first_s'])}" if clock["first_s"] else ""
        text = f"{clock['clock']} ticks every {_time(clock['period_s'])}{first}"
        text += f", {_times(clock['ticks'])} a frame"
        doing = []
        if clock["sends"]:
            doing.append(f"packets leave over {', '.join(clock['sends'])}")
        if clock["computes"]:
            doing.append(f"each peer computes {', '.join(clock['computes'])}")
        yield from wrapped(f"{text}: {'; '.join(doing)}", "  ", "    ")
    several = len({hold["kind"] for hold in facts["holds"]}) > 1
    for hold in facts["holds"]:
        at = f" at {hold['kind']}" if several else ""
        start = f"from {_time(hold['delay_s'])} after its tick" if hold["delay_s"] else "from its tick"
        text = f"{hold['hold']}{at} acts {start}, held for {_time(hold['held_s'])} until the next one acts"
        yield from wrapped(text, "  ", "    ")
    for link in facts["links"]:
        between = f" from {link['from']} to {link['to']}" if link["from"] else ""
        when = f"{_time(link['delay_s'])} later" if link["delay_s"] else "at once"
        text = (
            f"{link['link']}{between}: a packet ({', '.join(link['sends'])}) every {_time(link['period_s'])}"
        )
        text += f", available {when}; {_on_the_way(link['on_the_way'])} of each sender on the way"
        youngest, oldest = link["age_s"]
        text += f"; the newest one heard is {_time(youngest)} to {_time(oldest)} old"
        yield from wrapped(text, "  ", "    ")
    several = len({one["kind"] for one in facts["receives"]}) > 1
    for one in facts["receives"]:
        at = f" at {one['kind']}" if several else ""
        text = f"{one['receive']}{at}: heard at each tick of {one['clock']} over {one['link']}"
        text += "; one evaluation a pair of peers" if one["pairwise"] else ""
        yield from wrapped(text, "  ", "    ")


def _on_the_way(number: int) -> str:
    return "none" if number == 0 else counted(number, "packet")


def _times(number: int) -> str:
    return "once" if number == 1 else f"{number} times"


def _time(number: float) -> str:
    return seconds(Fraction(number))
