"""The result of a stage before the last as text: the output of `apc compile --until`.

Takes: the result of a stage. Gives: `describe`, `sent_text`.
Guarantees: the same topology gives the same bytes.
Does not: compute new values.
"""

from __future__ import annotations

from collections.abc import Iterator

from apc.compiler.equations.causalization import SortedSystem
from apc.compiler.equations.clocks import ClockedSystem
from apc.compiler.equations.flatten import FlatSend, FlatSystem
from apc.compiler.equations.solution import Assignment, ImplicitBlock
from apc.compiler.equations.terms import text_of
from apc.compiler.language.expression import format_expression
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.source.nodes import Mapping, Node, Scalar
from apc.compiler.source.source import Source
from apc.compiler.topology.topology import Topology
from apc.compiler.view.diagram import build_diagram


def describe(value: Source | Topology | FlatSystem | ClockedSystem | SortedSystem) -> str:
    """Return the text of the result of a stage."""
    match value:
        case Source():
            lines = _nodes(value.root, "")
        case Topology():
            lines = _topology(value)
        case FlatSystem():
            lines = _flat(value)
        case ClockedSystem():
            lines = _clocked(value)
        case SortedSystem():
            lines = _sorted(value)
    return "\n".join(lines)


def _nodes(node: Node, indent: str) -> Iterator[str]:
    """Yield the lines of a YAML node, with locations."""
    location = f"{node.location.line}:{node.location.column}"
    if isinstance(node, Scalar):
        yield f"{indent}{node.text!r}  ({type(node.value).__name__}, {location})"
    elif isinstance(node, Mapping):
        for key, value in node.entries:
            yield f"{indent}{key.text}:  ({key.location.line}:{key.location.column})"
            yield from _nodes(value, indent + "  ")
    else:
        for item in node.items:
            yield f"{indent}-  ({location})"
            yield from _nodes(item, indent + "  ")


def _topology(topology: Topology) -> Iterator[str]:
    """Yield the lines of a topology: clocks, parameters, parts and their connections."""
    yield f"topology {topology.name}: {topology.description}"
    yield from (f"clock {c.name}: every {c.period}, first at {c.phase}" for c in topology.clocks)
    for name, value in topology.parameters:
        expression = f"{format_expression(value.expression)} = " if value.expression else ""
        yield f"parameter {name} = {expression}{value}"
    diagram = build_diagram(topology)
    for box in diagram.boxes:
        yield "\n  ".join((f"{box.role} {box.lines[0]}", *box.lines[1:]))
    yield from (f"{edge.item} joins {edge.two}" for edge in diagram.edges if not edge.sent)


def _flat(flat: FlatSystem) -> Iterator[str]:
    """Yield the lines of flat equations, by peer type."""
    for peer_type in flat.peer_types:
        yield (
            f"kind {peer_type.name}: {len(peer_type.equations)} equations, {len(peer_type.variables)} "
            "unknowns"
        )
        yield from (f"  unknown {v.name} [{format_dimension(v.dimension)}]" for v in peer_type.variables)
        yield from (f"  {e.text}    # {e.origin}" for e in peer_type.equations)
        yield from (f"  send over {send.link}: {sent_text(send)}" for send in peer_type.sends)


def sent_text(send: FlatSend) -> str:
    """Return the equation of a sent value."""
    return f"{send.name} = {format_expression(send.expression)}"


def _clocked(clocked: ClockedSystem) -> Iterator[str]:
    """Yield the lines of partitions and crossings, by peer type."""
    for peer_type in clocked.peer_types:
        yield f"kind {peer_type.flat.name}"
        for partition in peer_type.partitions:
            yield f"  {partition.clock}: {', '.join(partition.variables)}"
            yield from (f"    {equation.text}" for equation in partition.equations)
        yield from (f"  sample on {s.clock}: {format_expression(s.expression)}" for s in peer_type.samples)
        for h in peer_type.holds:
            yield f"  hold of {h.clock}: {h.variable}, after {format_expression(h.delay)} s"
        yield from (f"  previous on {p.clock}: {p.variable}" for p in peer_type.previous)
        for r in peer_type.receives:
            yield f"  receive on {r.clock} over {r.link}: {r.operator} of {format_expression(r.argument)}"
        yield from (f"  send over {send.link}: {sent_text(send)}" for send in peer_type.flat.sends)


def _sorted(system: SortedSystem) -> Iterator[str]:
    """Yield the lines of explicit equations in order of evaluation, by peer type."""
    for peer_type in system.peer_types:
        yield f"kind {peer_type.clocked.flat.name}: states {', '.join(peer_type.states)}"
        yield from (f"  alias {name} = {text_of(expression)}" for name, expression in peer_type.aliases)
        for partition in peer_type.partitions:
            yield f"  {partition.clock}:"
            for step in partition.assignments:
                yield from _step(step)
        yield from (f"  {name} := {text_of(expression)}" for name, expression in peer_type.samples)
        yield from (f"  send over {s.link}: {s.name} := {text_of(s.expression)}" for s in peer_type.sends)


def _step(step: Assignment | ImplicitBlock) -> Iterator[str]:
    """Yield the lines of an assignment, or of a nonlinear loop: tearing unknowns, computed values and
    residuals.
    """
    if not isinstance(step, ImplicitBlock):
        yield f"    {step[0]} := {text_of(step[1])}"
        return
    yield f"    loop {step.chain}"
    yield from (f"      guess {name}" for name in step.tearing)
    yield from (f"      {name} := {text_of(expression)}" for name, expression in step.inner)
    yield from (f"      until 0 = {text_of(expression)}" for expression in step.residuals)
