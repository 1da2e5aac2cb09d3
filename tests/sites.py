"""Compiled topologies out of numbers: the paper's, with pairs that look at each other, and one number
alone.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from apc.compiler.compiled import Model
from apc.compiler.components.component_library import Library
from tests.bruteforce import TopologySource
from tests.topologies import compiled, replaced
from tests.truths import text_of

MS = Fraction(1, 1000)


def paper(operator: str = "mean", **values: Any) -> Model:
    """Return the paper's system for equal users, compiled; the values are those of
    `bruteforce.TopologySource`.
    """
    topology = TopologySource(operator, **values)
    return compiled(text_of(topology).replace("topology: stepped", "topology: paper"))


EDGE = """\
component: Edge
description: Looks at each other one by itself.
connectors: {object: Flange}
sends: {x: sample(object.x), v: sample(der(object.x))}
parameters:
  stiffness: {unit: N/m}
  damping: {unit: N*s/m}
  cubic: {unit: N/m^3, default: 0}
  clock: clock
  link: link
  delay: {unit: s}
equations:
  - x = sample(object.x)
  - v = sample(der(object.x))
  - pull = OPERATOR(stiffness*(x - others.x) + damping*(v - others.v) + cubic*(x - others.x)^3)
  - object.f = hold(pull, delay)
"""


def edged(operator: str, starts: Sequence[float], *, cubic: float = 0.0, **values: Any) -> Model:
    """Return the paper's system with F_T an operator over K_T d + B_T ḋ + cubic d³, d to each other user."""
    text = replaced(
        text_of(TopologySource(peers=len(starts), **values)),
        ("type: AveragePosition", f"type: Edge, cubic: {cubic!r} N/m^3"),
        (", delays: all", ""),
        (f"{{count: {len(starts)}}}", f"{{set: {{cube.x: [{', '.join(f'{x!r} m' for x in starts)}]}}}}"),
    )
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "edge.yaml").write_text(EDGE.replace("OPERATOR", operator), encoding="utf-8")
        return compiled(text, Library((Path(folder),)))


def alone(rate: str, *ticks: str, variables: str = "", delay: str = "0 s") -> Model:
    """Return one peer without network: 1 s·der(x) = rate; what `ticks` say each millisecond, as `it.x`."""
    clock = ", clock: clock, delay: {unit: s, default: 0 s}" if ticks else ""
    part = (
        "component: Alone\ndescription: A number that moves by itself.\n"
        f"parameters: {{T: {{unit: s, default: 1 s}}{clock}}}\n"
        f"variables: {{x: {{unit: 1, start: 0}}{variables}}}\n"
        f"equations: {[f'T*der(x) = {rate}', *ticks]}\n"
    )
    ticking = f", clock: haptic, delay: {delay}" if ticks else ""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "alone.yaml").write_text(part, encoding="utf-8")
        return compiled(
            "topology: alone\nclocks: {haptic: 1 ms}\npeers: {peer: {count: 1}}\n"
            f"masses: {{it: {{type: Alone{ticking}}}}}\n",
            Library((Path(folder),)),
        )
