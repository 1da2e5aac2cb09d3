"""The value of any stage as text for a person to read.

Takes: the value of a stage. Gives: text, one fact a line.
Guarantees: the same value gives the same text.
Does not: compute anything new.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import singledispatch
from typing import Any

import casadi
import sympy

from apc.compiler.clocks import ClockedSystem
from apc.compiler.compiled import CompiledSystem
from apc.compiler.expression import format_expression
from apc.compiler.flatten import FlatKind, FlatSystem
from apc.compiler.scene import Scene, Value
from apc.compiler.source import Mapping, Node, Scalar, Source
from apc.compiler.structure import SortedSystem
from apc.compiler.units import format_dimension, format_si


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
    lines += [
        f"clock {c.name}: every {_quantity(c.period)}, first at {_quantity(c.phase)}" for c in scene.clocks
    ]
    lines += [f"parameter {name} = {_quantity(value)}" for name, value in scene.parameters]
    for group in scene.groups:
        lines.append(f"group {group.name}: {group.count} peers")
        lines += [f"  {name} = {_quantity(value)}" for name, value in group.values]
    for part in scene.parts:
        shared = ", shared" if part.shared else ""
        lines.append(
            f"{part.section} {part.name}: {part.component.name}{shared}, at {', '.join(part.groups)}"
        )
        lines += [f"  {name} = {_quantity(value)}" for name, value in (*part.values, *part.starts)]
        lines += [f"  {name} = {word}" for name, word in (*part.options, *part.references)]
        lines += [f"  {own} joins {other}.{its}" for own, other, its in part.connections]
    return "\n".join(lines)


def _quantity(value: Value) -> str:
    number = format_si(float(value.number), value.dimension)
    return f"{value.expression} = {number}" if value.expression else number


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
        lines += [f"  receive on {r.clock} over {r.link}: {r.operator} of {r.send}" for r in kind.receives]
        lines += [f"  send over {s.link}: {s.name} = {format_expression(s.expression)}" for s in kind.sends]
    return "\n".join(lines)


@describe.register
def _(system: SortedSystem) -> str:
    lines = []
    for kind in system.kinds:
        lines.append(f"kind {kind.clocked.flat.name}: states {', '.join(kind.states)}")
        lines += [f"  alias {name} = {_plain(expression)}" for name, expression in kind.aliases]
        for partition in kind.partitions:
            lines.append(f"  {partition.clock}:")
            lines += [f"    {name} := {_plain(expression)}" for name, expression in partition.assignments]
        lines += [f"  {name} := {_plain(expression)}" for name, _, expression in kind.samples]
        lines += [f"  send over {s.link}: {s.name} := {_plain(s.expression)}" for s in kind.sends]
    return "\n".join(lines)


def _plain(expression: sympy.Expr) -> str:
    return str(sympy.sstr(expression, order="lex"))


@describe.register
def _(system: CompiledSystem) -> str:
    lines = [f"{system.name}: {system.about}"]
    lines += [f"timing {t.name} = {t.value} s" for t in system.timings]
    lines += [f"parameter {p.name} = {p.value:.12g} {p.unit}" for p in system.parameters]
    for kind in system.kinds:
        lines.append(f"kind {kind.name}")
        lines += _function_lines(kind.derivative, [f"der({state.name})" for state in kind.states])
        for clock in kind.clocks:
            lines += _function_lines(clock.tick, clock.outputs)
        for send in kind.sends:
            lines += _function_lines(send.send, send.channels)
    lines += [f"dropped {name}: {reason}" for name, reason in system.dropped]
    return "\n".join(lines)


def _function_lines(function: Any, names: Iterable[str]) -> Iterator[str]:
    yield f"  {function}"
    values = function(*function.sx_in())
    yield from (f"    {name} = {casadi.SX(values[row])}" for row, name in enumerate(names))
