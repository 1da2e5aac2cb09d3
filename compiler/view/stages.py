"""The value of any stage before the last as text for a person to read: what `apc compile --until` prints.

Takes: the value of a stage. Gives: `describe`; `step_lines`, of what is computed.
Guarantees: the same topology gives the same bytes.
Does not: compute anything new.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import singledispatch

from apc.compiler.equations.clocks import ClockedSystem
from apc.compiler.equations.flatten import FlatKind, FlatSystem
from apc.compiler.equations.solution import Assignment, ImplicitBlock
from apc.compiler.equations.structure import SortedSystem
from apc.compiler.equations.terms import text_of
from apc.compiler.language.expression import format_expression
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.scene.scene import Scene
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.source import Source
from apc.compiler.view.diagram import build_diagram


def step_lines(step: Assignment | ImplicitBlock) -> Iterator[str]:
    """Yield an assignment, or a nonlinear loop: its chain, then what is computed on the way round."""
    if not isinstance(step, ImplicitBlock):
        yield f"    {step[0]} := {text_of(step[1])}"
        return
    yield f"    loop {step.chain}"
    yield from (f"      guess {name}" for name in step.tearing)
    yield from (f"      {name} := {text_of(expression)}" for name, expression in step.inner)
    yield from (f"      until 0 = {text_of(expression)}" for expression in step.residuals)


@singledispatch
def describe(value: object) -> str:
    """Return the value of a stage as text."""
    raise AssertionError(f"{type(value).__name__} is no stage's value")


@describe.register
def _(source: Source) -> str:
    return "\n".join(_nodes(source.root, ""))


def _nodes(node: Node, indent: str) -> Iterator[str]:
    place = f"{node.place.line}:{node.place.column}"
    if isinstance(node, Scalar):
        yield f"{indent}{node.text!r}  ({type(node.value).__name__}, {place})"
    elif isinstance(node, Mapping):
        for key, value in node.entries:
            yield f"{indent}{key.text}:  ({key.place.line}:{key.place.column})"
            yield from _nodes(value, indent + "  ")
    else:
        for item in node.items:
            yield f"{indent}-  ({place})"
            yield from _nodes(item, indent + "  ")


@describe.register
def _(scene: Scene) -> str:
    lines = [f"topology {scene.name}: {scene.about}"]
    lines += [f"clock {c.name}: every {c.period}, first at {c.phase}" for c in scene.clocks]
    for name, value in scene.parameters:
        expression = f"{format_expression(value.expression)} = " if value.expression else ""
        lines.append(f"parameter {name} = {expression}{value}")
    diagram = build_diagram(scene)
    for box in diagram.boxes:
        lines += [f"{box.role} {box.lines[0]}", *(f"  {line}" for line in box.lines[1:])]
    lines += [f"{edge.one} joins {edge.two}" for edge in diagram.edges if not edge.sent]
    return "\n".join(lines)


@describe.register
def _(flat: FlatSystem) -> str:
    return "\n".join(line for kind in flat.kinds for line in _flat_kind(kind))


def _flat_kind(kind: FlatKind) -> Iterator[str]:
    yield f"kind {kind.name}: {len(kind.equations)} equations, {len(kind.variables)} unknowns"
    yield from (f"  unknown {v.name} [{format_dimension(v.dimension)}]" for v in kind.variables)
    yield from (f"  {e.text}    # {e.origin}" for e in kind.equations)
    yield from (f"  send over {s.link}: {s.name} = {format_expression(s.expression)}" for s in kind.sends)


@describe.register
def _(clocked: ClockedSystem) -> str:
    lines = []
    for kind in clocked.kinds:
        lines.append(f"kind {kind.flat.name}")
        for partition in kind.partitions:
            lines.append(f"  {partition.clock}: {', '.join(partition.variables)}")
            lines += [f"    {equation.text}" for equation in partition.equations]
        lines += [f"  sample on {s.clock}: {format_expression(s.expression)}" for s in kind.samples]
        lines += [
            f"  hold of {h.clock}: {h.variable}, after {format_expression(h.delay)} s" for h in kind.holds
        ]
        lines += [f"  previous on {p.clock}: {p.variable}" for p in kind.previous]
        lines += [
            f"  receive on {r.clock} over {r.link}: {r.operator} of {format_expression(r.argument)}"
            for r in kind.receives
        ]
        lines += [
            f"  send over {s.link}: {s.name} = {format_expression(s.expression)}" for s in kind.flat.sends
        ]
    return "\n".join(lines)


@describe.register
def _(system: SortedSystem) -> str:
    lines = []
    for kind in system.kinds:
        lines.append(f"kind {kind.clocked.flat.name}: states {', '.join(kind.states)}")
        lines += [f"  alias {name} = {text_of(expression)}" for name, expression in kind.aliases]
        for partition in kind.partitions:
            lines.append(f"  {partition.clock}:")
            lines += [line for step in partition.assignments for line in step_lines(step)]
        lines += [f"  {name} := {text_of(expression)}" for name, expression in kind.samples]
        lines += [f"  send over {s.link}: {s.name} := {text_of(s.expression)}" for s in kind.sends]
    return "\n".join(lines)
