"""Compiled systems written by hand: the scene of Rakhsha and Constantinescu, as compiled."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np

from apc.compiler.compiled import (
    Clock,
    ClockPartition,
    Column,
    CompiledSystem,
    Graph,
    Group,
    Hold,
    Kind,
    Link,
    Origin,
    PairDelay,
    Parameter,
    Receive,
    SendPartition,
    State,
    Timing,
)
from apc.compiler.errors import Place
from apc.compiler.functions.exchange import followers_of
from apc.compiler.language.evaluation import formula_of
from apc.compiler.language.grammar import parse_expression

NAMES = (
    "device.mass",
    "device.damping",
    "cube.mass",
    "cube.damping",
    "contact.stiffness",
    "contact.damping",
    "coordination.stiffness",
    "coordination.damping",
    "hand.force",
    "device.x.start",
    "cube.x.start",
    "zero",
    "peers",
)
UNITS = ("kg", "N*s/m", "kg", "N*s/m", "N/m", "N*s/m", "N/m", "N*s/m", "N", "m", "m", "1", "1")
STATES = (
    State("device.x", "m", "device.x.start"),
    State("device.v", "m/s", "zero"),
    State("cube.x", "m", "cube.x.start"),
    State("cube.v", "m/s", "zero"),
)
MS = Fraction(1, 1000)
COMPLETE = Graph("complete", np.zeros((0, 2), np.int64), np.zeros(0))


def user(operator: str = "mean", *, own_delay: bool = False) -> Kind:
    """Build the kind of one user: device, its cube copy, contact between them, coordination to the others.

    F_C = K_C (x − x_O) + B_C (v − v_O) acts on the cube, −F_C on the device. F_T pulls the cube back:
    K_T (x_O − mean of the others) for "mean", K_T ((peers − 1) x_O − sum of the others) for "sum"; the same
    with B_T and velocities. With `own_delay` the two parts of F_T are held apart, the heard one at once.
    """
    x, p, t = casadi.SX.sym("x", 4), casadi.SX.sym("p", len(NAMES)), casadi.SX.sym("t")
    r, m = casadi.SX.sym("r", 2), casadi.SX.sym("m", 0)
    named = dict(zip(NAMES, casadi.vertsplit(p), strict=True))
    u = casadi.SX.sym("u", 3 if own_delay else 2)
    own_weight = 1 if operator == "mean" else named["peers"] - 1
    k_t, b_t = named["coordination.stiffness"], named["coordination.damping"]
    contact = named["contact.stiffness"] * (x[0] - x[2]) + named["contact.damping"] * (x[1] - x[3])
    own = k_t * own_weight * x[2] + b_t * own_weight * x[3]
    heard = -k_t * r[0] - b_t * r[1]

    pull = u[1] + u[2] if own_delay else u[1]
    derivative = casadi.vertcat(
        x[1],
        (named["hand.force"] - u[0] - named["device.damping"] * x[1]) / named["device.mass"],
        x[3],
        (u[0] - pull - named["cube.damping"] * x[3]) / named["cube.mass"],
    )
    outputs = casadi.vertcat(contact, own, heard) if own_delay else casadi.vertcat(contact, own + heard)
    names = (
        ("contact.f", "coordination.own", "coordination.heard")
        if own_delay
        else ("contact.f", "coordination.f")
    )
    delays = ("contact.delay", "coordination.delay", "none")
    return Kind(
        name="user",
        states=STATES,
        holds=tuple(Hold(name, "haptic", row, delays[row]) for row, name in enumerate(names)),
        parameters=NAMES,
        derivative=casadi.Function("derivative", [x, u, p, t], [derivative]),
        clocks=(
            ClockPartition(
                clock="haptic",
                outputs=names,
                units=("N",) * len(names),
                memories=(),
                starts=(),
                receives=(
                    Receive("coordination.others.x", operator, "lan", 0),
                    Receive("coordination.others.v", operator, "lan", 1),
                ),
                tick=casadi.Function("tick", [x, u, m, r, p, t], [outputs]),
            ),
        ),
        sends=(
            SendPartition(
                link="lan",
                channels=("coordination.x", "coordination.v"),
                units=("m", "m/s"),
                send=casadi.Function("send", [x, u, p, t], [x[2:4]]),
            ),
        ),
    )


def paper(
    operator: str = "mean",
    *,
    peers: int = 3,
    kt: float = 500.0,
    bt: float = 0.0,
    kc: float = 1000.0,
    bc: float = 0.0,
    cube: float = 0.2,
    comp: Fraction = MS,
    comm: Fraction = 8 * MS,
    own_delay: bool = False,
    haptic: Fraction = MS,
    network: Fraction = 8 * MS,
    haptic_phase: Fraction = Fraction(0),
    network_phase: Fraction = Fraction(0),
) -> CompiledSystem:
    """Build the paper's system for equal users; `cube` is the mass of one copy."""
    values = (0.1, 5.0, cube, 5.0, kc, bc, kt, bt, 0.0, 0.0, 0.0, 0.0, float(peers))
    minima = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, None, None, None, None, None)
    return CompiledSystem(
        name="paper",
        about="Users move a shared cube.",
        clocks=(
            Clock("haptic", "haptic.period", "haptic.phase"),
            Clock("network", "network.period", "network.phase"),
        ),
        links=(Link("lan", "network", "lan.delay", COMPLETE, ()),),
        timings=(
            Timing("haptic.period", haptic),
            Timing("haptic.phase", haptic_phase),
            Timing("network.period", network),
            Timing("network.phase", network_phase),
            Timing("contact.delay", comp),
            Timing("coordination.delay", comp),
            Timing("lan.delay", comm),
            Timing("none", Fraction(0)),
        ),
        parameters=tuple(
            Parameter(name, unit, value, minimum=minimum, open_minimum=name.endswith(".mass"))
            for name, unit, value, minimum in zip(NAMES, UNITS, values, minima, strict=True)
        ),
        kinds=(user(operator, own_delay=own_delay),),
        groups=(Group("user", peers, 0),),
        dropped=(),
        origin=Origin("paper.yaml", ()),
    )


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
    x, p, t = casadi.SX.sym("x", 4), casadi.SX.sym("p", len(NAMES)), casadi.SX.sym("t")
    u, m, s, r = (casadi.SX.sym(name, size) for name, size in (("u", 2), ("m", 0), ("s", 2), ("r", 1)))
    named = dict(zip(NAMES, casadi.vertsplit(p), strict=True))
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


def alone(
    derivative: Callable[..., Any] | None = None,
    tick: Callable[..., Any] | None = None,
    *,
    outputs: tuple[str, ...] = ("f",),
    memories: tuple[int, ...] = (),
    delay: Fraction = Fraction(0),
) -> CompiledSystem:
    """Build one peer without network: dx/dt = derivative(x, u); each ms y = tick(x, u, m), y[0] acts."""
    x, p, t = casadi.SX.sym("x"), casadi.SX.sym("p", 1), casadi.SX.sym("t")
    u = casadi.SX.sym("u", 1 if tick else 0)
    m, r = casadi.SX.sym("m", len(memories)), casadi.SX.sym("r", 0)
    rate = derivative(x, u) if derivative else -x
    partition = ClockPartition(
        clock="haptic",
        outputs=outputs,
        units=("N",) * len(outputs),
        memories=memories,
        starts=("zero",) * len(memories),
        receives=(),
        tick=casadi.Function("tick", [x, u, m, r, p, t], [tick(x, u, m) if tick else casadi.SX(0, 1)]),
    )
    kind = Kind(
        name="alone",
        states=(State("x", "m", "zero"),),
        holds=(Hold("f", "haptic", 0, "delay"),) if tick else (),
        parameters=("zero",),
        derivative=casadi.Function("derivative", [x, u, p, t], [rate]),
        clocks=(partition,) if tick else (),
        sends=(),
    )
    timings = (Timing("period", MS), Timing("phase", Fraction(0)), Timing("delay", delay))
    return CompiledSystem(
        name="alone",
        about="One peer.",
        clocks=(Clock("haptic", "period", "phase"),) if tick else (),
        links=(),
        timings=timings,
        parameters=(Parameter("zero", "1", 0.0),),
        kinds=(kind,),
        groups=(Group("peer", 1, 0),),
        dropped=(),
        origin=Origin("alone.yaml", ()),
    )


def grouped(system: CompiledSystem, *groups: tuple[str, int, dict[str, float]]) -> CompiledSystem:
    """Return the system with other groups: (name, count, parameter values of its own)."""
    of_name = {parameter.name: parameter for parameter in system.parameters}
    total = float(sum(count for _, count, _ in groups))
    return replace(
        system,
        parameters=tuple(replace(p, value=total) if p.name == "peers" else p for p in system.parameters),
        groups=tuple(
            Group(name, count, 0, tuple(replace(of_name[key], value=value) for key, value in own.items()))
            for name, count, own in groups
        ),
    )


def derived(system: CompiledSystem, **expressions: str) -> CompiledSystem:
    """Add the parameters kt and wait, and expressions over them for parameters and timings."""
    formulas = {
        key.replace("__", "."): formula_of(parse_expression(text, Place("a.yaml", 1, 1, text)))
        for key, text in expressions.items()
    }
    parameters = (
        Parameter("kt", "N/m", 500.0),
        Parameter("wait", "s", 0.008),
        *(replace(p, formula=formulas.get(p.name)) for p in system.parameters),
    )
    timings = tuple(replace(t, formula=formulas.get(t.name)) for t in system.timings)
    followers = followers_of(parameters, timings, system.groups)
    return replace(system, parameters=parameters, timings=timings, followers=followers)
