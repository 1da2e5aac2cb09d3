"""Compiled systems that are changed by hand: the scene of Rakhsha and Constantinescu, one number alone."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from apc.compiler.compiled import (
    Column,
    CompiledSystem,
    Graph,
    Group,
    PairDelay,
    Receive,
    Timing,
)
from apc.compiler.components.library import Library
from tests.bruteforce import Scene
from tests.topologies import compiled
from tests.truths import text_of

MS = Fraction(1, 1000)
COMPLETE = Graph("complete", np.zeros((0, 2), np.int64), np.zeros(0))


def paper(operator: str = "mean", **values: Any) -> CompiledSystem:
    """Return the paper's system for equal users, compiled; the values are those of `bruteforce.Scene`."""
    scene = Scene(operator, **values)
    return compiled(text_of(scene).replace("topology: stepped", "topology: paper"))


def linked(
    system: CompiledSystem,
    graph: str | Sequence[tuple[int, int, float]] = "complete",
    *,
    delays: Mapping[tuple[str, str], Fraction] | None = None,
) -> CompiledSystem:
    """Return the system with a graph, in words or as (sender, receiver, weight), and delays of pairs."""
    [link] = system.links
    if isinstance(graph, str):
        shape = Graph(graph, COMPLETE.arcs, COMPLETE.weights)
    else:
        arcs = np.array([arc[:2] for arc in graph], np.int64).reshape(-1, 2)
        shape = Graph("arcs", arcs, np.array([arc[2] for arc in graph], np.float64))
    timed = [
        (PairDelay(a, b, f"lan.delay {a} {b}"), Timing(f"lan.delay {a} {b}", value))
        for (a, b), value in (delays or {}).items()
    ]
    return replace(
        system,
        links=(replace(link, graph=shape, delays=tuple(pair for pair, _ in timed)),),
        timings=(*system.timings, *(timing for _, timing in timed)),
    )


def columned(system: CompiledSystem, **columns: Sequence[float]) -> CompiledSystem:
    """Return the system, of one group, with parameters that differ from peer to peer (`device__mass=…`)."""
    [group] = system.groups
    listed = tuple(
        Column(name.replace("__", "."), np.array(values, np.float64)) for name, values in columns.items()
    )
    return replace(system, groups=(replace(group, columns=listed),))


def edged(system: CompiledSystem, operator: str = "sum", *, cubic: float = 0.0) -> CompiledSystem:
    """Return the system with F_T an operator over the others of K_T d + B_T ḋ + cubic d³, d to each other."""
    [kind] = system.kinds
    [partition] = kind.clocks
    x, p, t = casadi.SX.sym("x", 4), casadi.SX.sym("p", len(kind.parameters)), casadi.SX.sym("t")
    u, m, s, r = (casadi.SX.sym(name, size) for name, size in (("u", 2), ("m", 0), ("s", 2), ("r", 1)))
    named = dict(zip(kind.parameters, casadi.vertsplit(p), strict=True))
    apart = x[2] - s[0]
    pull = named["coordination.stiffness"] * apart + named["coordination.damping"] * (x[3] - s[1])
    if cubic:
        pull += cubic * apart**3
    edge = casadi.Function("edge", [x, u, m, s, p, t], [pull])
    contact = partition.tick(x, u, m, casadi.SX.zeros(2), p, t)[0]
    clock = replace(
        partition,
        receives=(Receive("pull", operator, "lan", 0, edge),),
        tick=casadi.Function("tick", [x, u, m, r, p, t], [casadi.vertcat(contact, r[0])]),
    )
    return replace(system, kinds=(replace(kind, clocks=(clock,)),))


def alone(rate: str, *ticks: str, variables: str = "", delay: str = "0 s") -> CompiledSystem:
    """Return one peer without network: 1 s·der(x) = rate; what `ticks` say each millisecond, as `it.x`."""
    clock = ", clock: clock, delay: {unit: s, default: 0 s}" if ticks else ""
    part = (
        "component: Alone\nabout: A number that moves by itself.\n"
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


def grouped(system: CompiledSystem, *groups: tuple[str, int, dict[str, float]]) -> CompiledSystem:
    """Return the system with other groups: (name, count, parameter values of its own)."""
    of_name = {parameter.name: parameter for parameter in system.parameters}
    total = sum(count for _, count, _ in groups)
    heard = tuple(replace(one, value=total - 1.0, exact=None) for one in system.groups[0].values)
    return replace(
        system,
        parameters=tuple(
            replace(p, value=float(total), exact=None) if p.name == "peers" else p
            for p in system.parameters
            if p.name != "user.count"
        ),
        groups=tuple(
            Group(
                name,
                count,
                0,
                (*heard, *(replace(of_name[key], value=value, exact=None) for key, value in own.items())),
            )
            for name, count, own in groups
        ),
    )
