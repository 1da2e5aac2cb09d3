"""A diagram as text for Graphviz.

Takes: `Diagram`. Gives: `draw_dot`.
Guarantees: the same diagram gives the same text.
Does not: place anything: Graphviz does.
"""

from __future__ import annotations

from apc.compiler.components.parts import GROUND
from apc.compiler.view.diagram import Diagram, one_of
from apc.compiler.words import counted

_SHAPES = {"mass": "box", "coupler": "box", "hand": "cds", "ground": "underline", "joint": "point"}


def draw_dot(diagram: Diagram) -> str:
    """Return a diagram in Graphviz's language."""
    title = diagram.title if not diagram.about else f"{diagram.title}\n{diagram.about}"
    lines = [
        f"digraph {_quoted(diagram.title)} {{",
        "  rankdir=LR",
        '  node [fontname="Helvetica", fontsize=10]',
        "  edge [dir=none]",
        f'  label={_quoted(title)}; labelloc=t; fontname="Helvetica"',
        "  subgraph cluster_peer {",
        f"    label={_quoted(one_of(diagram))}; style=rounded",
    ]
    for node in diagram.nodes:
        text = "\n".join((node.name, *node.lines, *([f"clock {node.clock}"] if node.clock else [])))
        label = "ground" if node.role == GROUND else text
        style = ', style="filled", fillcolor="#e8eff8"' if node.role == "mass" else ""
        lines.append(f"    {_quoted(node.name)} [label={_quoted(label)}, shape={_SHAPES[node.role]}{style}]")
    lines += [f"    {_quoted(one)} -> {_quoted(two)}" for one, two in diagram.joints]
    lines.append("  }")
    for net in diagram.nets:
        text = "\n".join((net.name, f"graph {net.shape}", *net.lines))
        lines.append(f"  {_quoted(net.name)} [label={_quoted(text)}, shape=ellipse, style=dashed]")
        for crowd in diagram.crowds:
            lines.append(
                f"  {_quoted(net.name)} -> {_quoted(f'peers {crowd.name}')} [dir=both, style=dashed]"
            )
    for node in diagram.nodes:
        lines += [
            f"  {_quoted(node.name)} -> {_quoted(link)} [dir=both, style=dashed]" for link in node.links
        ]
    for crowd in diagram.crowds:
        text = "\n".join((f"{crowd.name}: {counted(crowd.count, 'peer')}", *crowd.settings))
        lines.append(f"  {_quoted(f'peers {crowd.name}')} [label={_quoted(text)}, shape=box3d]")
    return "\n".join([*lines, "}"])


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
    return f'"{escaped}"'
