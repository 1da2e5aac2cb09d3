"""The value of any stage before the last as text for a person to read: what `apc compile --until` prints.

Takes: the value of a stage. Gives: `describe`.
Guarantees: the same topology gives the same bytes.
Does not: compute anything new.
"""

from __future__ import annotations

from collections.abc import Iterator

from apc.compiler.equations.clocks import ClockedSystem
from apc.compiler.equations.flatten import FlatSend, FlatSystem
from apc.compiler.equations.solution import Assignment, ImplicitBlock
from apc.compiler.equations.structure import SortedSystem
from apc.compiler.equations.terms import text_of
from apc.compiler.language.expression import format_expression
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.scene.scene import Topology
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.source import Source
from apc.compiler.view.diagram import build_diagram


def describe(value: Source | Topology | FlatSystem | ClockedSystem | SortedSystem) -> str:
    """Return the value of a stage as text."""
    match value:
        case Source():
            lines = _nodes(value.root, "")
        case Topology():
            lines = _scene(value)
        case FlatSystem():
            lines = _flat(value)
        case ClockedSystem():
            lines = _clocked(value)
        case SortedSystem():
            lines = _sorted(value)
    return "\n".join(lines)


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


def _scene(scene: Topology) -> Iterator[str]:
    yield f"topology {scene.name}: {scene.about}"
    yield from (f"clock {c.name}: every {c.period}, first at {c.phase}" for c in scene.clocks)
    for name, value in scene.parameters:
        expression = f"{format_expression(value.expression)} = " if value.expression else ""
        yield f"parameter {name} = {expression}{value}"
    diagram = build_diagram(scene)
    for box in diagram.boxes:
        yield "\n  ".join((f"{box.role} {box.lines[0]}", *box.lines[1:]))
    yield from (f"{edge.one} joins {edge.two}" for edge in diagram.edges if not edge.sent)


def _flat(flat: FlatSystem) -> Iterator[str]:
    for kind in flat.kinds:
        yield f"kind {kind.name}: {len(kind.equations)} equations, {len(kind.variables)} unknowns"
        yield from (f"  unknown {v.name} [{format_dimension(v.dimension)}]" for v in kind.variables)
        yield from (f"  {e.text}    # {e.origin}" for e in kind.equations)
        yield from map(_sent, kind.sends)


def _sent(send: FlatSend) -> str:
    return f"  send over {send.link}: {send.name} = {format_expression(send.expression)}"


def _clocked(clocked: ClockedSystem) -> Iterator[str]:
    for kind in clocked.kinds:
        yield f"kind {kind.flat.name}"
        for partition in kind.partitions:
            yield f"  {partition.clock}: {', '.join(partition.variables)}"
            yield from (f"    {equation.text}" for equation in partition.equations)
        yield from (f"  sample on {s.clock}: {format_expression(s.expression)}" for s in kind.samples)
        for h in kind.holds:
            yield f"  hold of {h.clock}: {h.variable}, after {format_expression(h.delay)} s"
        yield from (f"  previous on {p.clock}: {p.variable}" for p in kind.previous)
        for r in kind.receives:
            yield f"  receive on {r.clock} over {r.link}: {r.operator} of {format_expression(r.argument)}"
        yield from map(_sent, kind.flat.sends)


def _sorted(system: SortedSystem) -> Iterator[str]:
    for kind in system.kinds:
        yield f"kind {kind.clocked.flat.name}: states {', '.join(kind.states)}"
        yield from (f"  alias {name} = {text_of(expression)}" for name, expression in kind.aliases)
        for partition in kind.partitions:
            yield f"  {partition.clock}:"
            for step in partition.assignments:
                yield from _step(step)
        yield from (f"  {name} := {text_of(expression)}" for name, expression in kind.samples)
        yield from (f"  send over {s.link}: {s.name} := {text_of(s.expression)}" for s in kind.sends)


def _step(step: Assignment | ImplicitBlock) -> Iterator[str]:
    """Yield an assignment, or a nonlinear loop: its chain, then what is computed on the way round."""
    if not isinstance(step, ImplicitBlock):
        yield f"    {step[0]} := {text_of(step[1])}"
        return
    yield f"    loop {step.chain}"
    yield from (f"      guess {name}" for name in step.tearing)
    yield from (f"      {name} := {text_of(expression)}" for name, expression in step.inner)
    yield from (f"      until 0 = {text_of(expression)}" for expression in step.residuals)
