"""A peer in plain C99: header, source, and a driver program.

Takes: an `ExportedPeer`. Gives: `header`, `source`, `driver`; `memory`, `parameter_units`.
Guarantees: no allocation, no global that changes, nothing included but math.h; each instant is computed by
the functions that `simulate` evaluates, in their order and with their roundings. Numbers round-trip to the
same double; no text ends a comment early.
Does not: compile or write files (see `code`), or join peers (see `topology_text`).

A peer advances from instant to instant: `send` returns the packets at the start of an instant, `force`
computes the values due, `move` integrates to the next instant; `tick` is all three. A packet without delay
can be received between `send` and `force`. The templates are `peer.h`, `peer.c` and `peer_test.c` in this
folder.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import Any

import numpy as np

from apc.compiler.expression_data import straight
from apc.compiler.weights import sum_weights
from apc.distribution import program_version
from apc.exports.identifiers import prefixed
from apc.exports.peer_step import ExportedPeer, Move, PeerLink, has_edge
from apc.exports.texts import filled, number
from apc.simulation.compiled_engine import straight_lines
from apc.simulation.pairwise import pair_function
from apc.simulation.signals import LocalSignal, ticking_partitions


def memory(peer: ExportedPeer, signal: LocalSignal) -> str:
    """Return the member of a peer's memory that holds a signal."""
    if signal.role == "output":
        return _output(peer, *signal.index)
    return f"{'x' if signal.role == 'state' else 'u'}[{signal.index[0]}]"


def parameter_units(peer: ExportedPeer) -> dict[str, str]:
    """Return the unit of each of a peer's parameters."""
    known = {parameter.name: parameter.unit for parameter in peer.system.parameters}
    return {name: known.get(name, "1") for name in peer.peer_type.parameters}


def _output(peer: ExportedPeer, partition: int, output: int) -> str:
    first = [*accumulate((len(clock.outputs) for clock in peer.peer_type.clocks), initial=0)]
    return f"y[{first[partition] + output}]"


def _filled(file: str, peer: ExportedPeer, **values: object) -> str:
    """Return one of a peer's texts, its title with it."""
    system, clocks = peer.system, {partition.clock for partition in peer.peer_type.clocks}
    timings = {timing.name: float(timing.value) for timing in system.timings}
    periods = [(clock.name, timings[clock.period]) for clock in system.clocks if clock.name in clocks]
    shared = {"peer": peer, "name": peer.identifier, "periods": periods, "version": program_version()}
    return filled(file, **shared, **values)


def header(peer: ExportedPeer) -> str:
    """Return the header: the inputs, outputs, memory and functions of a peer."""
    peer_type, units = peer.peer_type, parameter_units(peer)
    settings = [(peer_type.parameters[index], units[peer_type.parameters[index]]) for index in peer.settable]
    return _filled(
        "peer.h",
        peer,
        states=peer_type.states,
        inside=[
            f"{state.name} [{state.unit}]" if i not in peer.outside else "-"
            for i, state in enumerate(peer_type.states)
        ],
        holds=peer_type.holds,
        computed=[
            f"{output} [{unit}]"
            for clock in peer_type.clocks
            for output, unit in zip(clock.outputs, clock.units, strict=True)
        ],
        settings=[f"{parameter} [{unit}]" for parameter, unit in settings],
        stored=_stored(peer),
    )


def _stored(peer: ExportedPeer) -> int:
    """Return the number of stored values of each hold."""
    return 1 + max((act.lag for instant in peer.instants for act in instant.acts), default=0)


def source(peer: ExportedPeer, include: str) -> str:
    """Return the code; `include` is the name of the header."""
    peer_type, peer_types = peer.peer_type, tuple(dict.fromkeys(peer.instants))
    names = _parameters(peer)
    outputs = [
        dict(zip(partition.memories, values, strict=True)).get(o, 0.0)
        for partition, values in zip(peer_type.clocks, peer.memories, strict=True)
        for o in range(len(partition.outputs))
    ]

    def computed(function: Any, p: int | None = None) -> tuple[list[str], list[str]]:
        """Return the code of a send, or of the tick of a partition."""
        received = (
            []
            if p is None
            else [*_memories(peer, p), *(f"r{k}" for k in range(len(peer_type.clocks[p].receives)))]
        )
        return _computed(function, [*_moving(peer), *received, *names, "t"])

    return _filled(
        "peer.c",
        peer,
        include=include,
        quantum=peer.schedule.quantum,
        constants=[
            item
            for item in zip(names, peer_type.parameters, peer.parameters.tolist(), strict=True)
            if item[0].startswith("PARAMETER_")
        ],
        units=parameter_units(peer),
        peer_types=peer_types,
        peer_type_of=[*map(peer_types.index, peer.instants)],
        lengths=[peer.moves[peer_type.move].quanta for peer_type in peer_types],
        over={line.sending: line.name for line in peer.sending},
        ticking=ticking_partitions(peer.schedule),
        computed=computed,
        received=lambda p: _received(peer, p),
        moved=lambda move: _moved(peer, move),
        member=lambda p, o: _output(peer, p, o),
        stored=_stored(peer),
        forces=[
            (local, _sum((factor, f"peer->u[{hold}]") for hold, factor in force.terms))
            for local, force in peer.forces.items()
        ],
        starts=[0.0 if i in peer.outside else value for i, value in enumerate(peer.start)],
        outputs=outputs,
        zeros=[0 for _ in peer_type.holds],
        late=["{0}" for _ in peer_type.holds or "0"],
        settings=[float(peer.parameters[index]) for index in peer.settable],
    )


def _sum(terms: Iterable[tuple[float, str]]) -> str:
    """Return a sum of factors times their operands."""
    return " + ".join(f"{number(value)} * {factor}" for value, factor in terms) or "0.0"


def _parameters(peer: ExportedPeer) -> list[str]:
    names = [*prefixed("PARAMETER", peer.peer_type.parameters)]
    for k, index in enumerate(peer.settable):
        names[index] = f"peer->p[{k}]"
    return names


def _moving(peer: ExportedPeer) -> list[str]:
    """Return the C names of the arguments x and u of a function."""
    x = [f"peer->x[{i}]" for i in range(len(peer.peer_type.states))]
    for i in peer.outside:
        x[i] = f"in->{peer.measured[i]}" if i in peer.measured else "NAN"
    return [*x, *(f"peer->u[{h}]" for h in range(len(peer.peer_type.holds)))]


def _memories(peer: ExportedPeer, p: int) -> list[str]:
    return [f"peer->{_output(peer, p, o)}" for o in peer.peer_type.clocks[p].memories]


def _computed(function: Any, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the lines of C that compute a function of some arguments, and the names of its values."""
    plain = straight(function)
    names, lines = straight_lines(plain, arguments)
    return lines, [names[index] for index in plain.results[0]]


def _received(peer: ExportedPeer, p: int) -> tuple[list[PeerLink], list[dict[str, Any]]]:
    """Return the lines whose own packet a partition's tick needs, and the inputs of its receives."""
    receives, lines = peer.peer_type.clocks[p].receives, {line.link: line for line in peer.lines}
    received = [_received_item(peer, p, index) for index in range(len(receives))]
    read = sorted({receives[index].link for index in range(len(receives)) if (p, index) in peer.channels})
    return [lines[link] for link in read if lines[link].missing], received


def _received_item(peer: ExportedPeer, p: int, index: int) -> dict[str, Any]:
    """Return a receive's reduction: lines of C, the value of sender k, the combination of these."""
    receive = peer.peer_type.clocks[p].receives[index]
    line = peer.line(receive.link) if (p, index) in peer.channels else None
    if line is None or not line.senders:
        return {"line": None}
    names = [line.packet[channel].member for channel in peer.channels[p, index]]
    mean, edge = receive.operator == "mean", has_edge(peer.peer_type, p, index)
    packet, lines = f"in->{line.name}[k]", list[str]()
    value = f"{packet}.{names[0]}"
    if edge:
        function, numbers = pair_function(peer.peer_type, p, index)
        missing = f"{packet}.missing" if line.missing else "0.0"
        received = [
            f"({missing} ? 0.0 : {packet}.{name})" if line.missing else f"{packet}.{name}" for name in names
        ]
        every = [*_moving(peer), *_memories(peer, p), *_parameters(peer)]
        lines, (value,) = _computed(function, [*(every[i] for i in numbers), *received, missing, "t"])
    elif line.missing:
        value = f"({packet}.missing ? own_{line.name}.{names[0]} : {value})"
    weights = np.array([sender.weight for sender in line.senders])
    divided = mean and line.complete and not edge
    if mean and not divided:
        weights = weights / float(sum_weights(np.zeros(len(weights), np.int64), weights, 1)[0])
    extreme = receive.operator if receive.operator in ("max", "min") else ""
    return {
        "line": line,
        "lines": lines,
        "value": value,
        "weights": weights.tolist(),
        "divided": divided,
        "extreme": extreme,
    }


def _moved(peer: ExportedPeer, move: Move) -> tuple[list[str], dict[int, str]]:
    """Return the C statements that integrate the computer's states over a duration, and the new states."""
    moving, count = _moving(peer), len(peer.start)
    exact = [i for i in range(count) if i not in peer.outside and i not in move.flowing]
    moved = [k for k in range(move.matrix.shape[1]) if k not in peer.outside]
    factors = [*moving, "1.0"]
    lines = [
        f"const double x{i} = {_sum((row[k], factors[k]) for k in moved if row[k])};"
        for i, row in zip(exact, move.matrix[exact].tolist(), strict=True)
    ]
    stores = {i: f"x{i}" for i in exact}
    if move.flow is not None:
        arguments = [*(moving[i] for i in move.flowing), *moving[count:], *_parameters(peer), "t"]
        more, values = _computed(move.flow, arguments)
        lines += more
        stores |= zip(move.flowing, values, strict=True)
    return lines, stores


def driver(peer: ExportedPeer, include: str) -> str:
    """Return a program that reads a peer's measured and received values by instant, and prints its outputs.

    With a number N it executes N instants with the start values as received packets, and prints the time of
    one. Printed digits round-trip to the same doubles.
    """
    read = [("%lf", local, peer.peer_type.states[i].name) for i, local in peer.measured.items()]
    for line in peer.lines:
        for k, sender in enumerate(line.senders):
            begin, label = f"{line.name}[{k}]", f"{line.link} {sender.name}"
            read += [("%lf", f"{begin}.{entry.member}", f"{label} {entry.name}") for entry in line.packet]
            read += [("%d", f"{begin}.missing", f"{label} missing")] if line.missing else []
    shown = [("%.17g", f"out.{local}", force.name) for local, force in peer.forces.items()]
    for line in peer.sending:
        shown.append(("%d", f"out.sent_{line.name}", f"{line.link} sent"))
        local = f"out.{line.name}"
        shown += [("%.17g", f"{local}.{entry.member}", f"{line.link} {entry.name}") for entry in line.packet]
    shown += [
        ("%.17g", f"peer.{memory(peer, signal)}", signal.name)
        for signal in peer.signals
        if signal.role == "output"
    ]
    return _filled("peer_test.c", peer, include=include, read=read, shown=shown)
