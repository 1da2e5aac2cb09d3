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
from apc.exports.identifiers import prefixed
from apc.exports.peer_step import ExportedPeer, Move, PeerLink, has_edge
from apc.exports.texts import filled, number
from apc.simulation.compiled_engine import straight_lines
from apc.simulation.pairwise import pair_function
from apc.simulation.signals import LocalSignal, ticking_partitions
from apc.support.distribution import program_version


def memory(peer: ExportedPeer, signal: LocalSignal) -> str:
    """Return the member of a peer's C struct that stores a signal."""
    if signal.role == "output":
        return _output(peer, *signal.index)
    return f"{'x' if signal.role == 'state' else 'u'}[{signal.index[0]}]"


def parameter_units(peer: ExportedPeer) -> dict[str, str]:
    """Return the unit of each of a peer's parameters, by name."""
    units = {parameter.name: parameter.unit for parameter in peer.model.parameters}
    return {name: units.get(name, "1") for name in peer.peer_type.parameters}


def _output(peer: ExportedPeer, partition: int, output: int) -> str:
    """Return the member of a peer's C struct that stores an output of a clock partition."""
    first = [*accumulate((len(clock.outputs) for clock in peer.peer_type.clocks), initial=0)]
    return f"y[{first[partition] + output}]"


def _filled(file: str, peer: ExportedPeer, **values: object) -> str:
    """Return one of a peer's texts from a template, with the data of its title."""
    model, clocks = peer.model, {partition.clock for partition in peer.peer_type.clocks}
    timings = {timing.name: float(timing.value) for timing in model.timings}
    periods = [(clock.name, timings[clock.period]) for clock in model.clocks if clock.name in clocks]
    shared = {"peer": peer, "name": peer.identifier, "periods": periods, "version": program_version()}
    return filled(file, **shared, **values)


def header(peer: ExportedPeer) -> str:
    """Return the C header of a peer: inputs, outputs, memory and functions."""
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
        stored=_stored_count(peer),
    )


def _stored_count(peer: ExportedPeer) -> int:
    """Return the number of stored values of each hold."""
    return 1 + max((act.lag for instant in peer.instants for act in instant.acts), default=0)


def source(peer: ExportedPeer, include: str) -> str:
    """Return the C code of a peer; `include` is the name of the header."""
    peer_type, distinct_instants = peer.peer_type, tuple(dict.fromkeys(peer.instants))
    names = _parameters(peer)
    outputs = [
        dict(zip(partition.memories, values, strict=True)).get(o, 0.0)
        for partition, values in zip(peer_type.clocks, peer.memories, strict=True)
        for o in range(len(partition.outputs))
    ]

    def computed(function: Any, p: int | None = None) -> tuple[list[str], list[str]]:
        """Return the lines and the values of a send, or of the tick of a partition."""
        received = (
            []
            if p is None
            else [*_memories(peer, p), *(f"r{k}" for k in range(len(peer_type.clocks[p].receives)))]
        )
        return _computed(function, [*_state_arguments(peer), *received, *names, "t"])

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
        peer_types=distinct_instants,
        peer_type_of=[*map(distinct_instants.index, peer.instants)],
        lengths=[peer.moves[instant.move].quanta for instant in distinct_instants],
        over={line.sending: line.name for line in peer.sending},
        ticking=ticking_partitions(peer.schedule),
        computed=computed,
        received=lambda p: _received(peer, p),
        moved=lambda move: _transition_lines(peer, move),
        member=lambda p, o: _output(peer, p, o),
        stored=_stored_count(peer),
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
    """Return a sum of factors times their operands, as C text."""
    return " + ".join(f"{number(value)} * {factor}" for value, factor in terms) or "0.0"


def _parameters(peer: ExportedPeer) -> list[str]:
    """Return the C names of a peer's parameters."""
    names = [*prefixed("PARAMETER", peer.peer_type.parameters)]
    for k, index in enumerate(peer.settable):
        names[index] = f"peer->p[{k}]"
    return names


def _state_arguments(peer: ExportedPeer) -> list[str]:
    """Return the C names of the arguments x and u of a function."""
    x = [f"peer->x[{i}]" for i in range(len(peer.peer_type.states))]
    for i in peer.outside:
        x[i] = f"in->{peer.measured[i]}" if i in peer.measured else "NAN"
    return [*x, *(f"peer->u[{h}]" for h in range(len(peer.peer_type.holds)))]


def _memories(peer: ExportedPeer, p: int) -> list[str]:
    """Return the C names of the stored outputs of a clock partition."""
    return [f"peer->{_output(peer, p, o)}" for o in peer.peer_type.clocks[p].memories]


def _computed(function: Any, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the C lines that evaluate a function, and the names of its values."""
    plain_function = straight(function)
    names, lines = straight_lines(plain_function, arguments)
    return lines, [names[index] for index in plain_function.results[0]]


def _received(peer: ExportedPeer, p: int) -> tuple[list[PeerLink], list[dict[str, Any]]]:
    """Return the links whose own packet a partition's tick needs, and the data of its receives."""
    receives, lines = peer.peer_type.clocks[p].receives, {line.link: line for line in peer.lines}
    received = [_received_item(peer, p, index) for index in range(len(receives))]
    read = sorted({receives[index].link for index in range(len(receives)) if (p, index) in peer.channels})
    return [lines[link] for link in read if lines[link].missing], received


def _received_item(peer: ExportedPeer, p: int, index: int) -> dict[str, Any]:
    """Return the data of a receive: its link, C lines, value of sender k, weights and reduction."""
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
        all_arguments = [*_state_arguments(peer), *_memories(peer, p), *_parameters(peer)]
        lines, (value,) = _computed(function, [*(all_arguments[i] for i in numbers), *received, missing, "t"])
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


def _transition_lines(peer: ExportedPeer, move: Move) -> tuple[list[str], dict[int, str]]:
    """Return the C lines of the computer's states after a duration, and the names of the new states."""
    arguments_of_states, count = _state_arguments(peer), len(peer.start)
    exact = [i for i in range(count) if i not in peer.outside and i not in move.flowing]
    columns = [k for k in range(move.matrix.shape[1]) if k not in peer.outside]
    factors = [*arguments_of_states, "1.0"]
    lines = [
        f"const double x{i} = {_sum((row[k], factors[k]) for k in columns if row[k])};"
        for i, row in zip(exact, move.matrix[exact].tolist(), strict=True)
    ]
    stores = {i: f"x{i}" for i in exact}
    if move.flow is not None:
        arguments = [
            *(arguments_of_states[i] for i in move.flowing),
            *arguments_of_states[count:],
            *_parameters(peer),
            "t",
        ]
        flow_lines, values = _computed(move.flow, arguments)
        lines += flow_lines
        stores |= zip(move.flowing, values, strict=True)
    return lines, stores


def driver(peer: ExportedPeer, include: str) -> str:
    """Return a C program that reads a peer's measured and received values by instant, and prints its outputs.

    With a number N the program executes N instants with the start values as received packets, and prints the
    time of one instant. Printed digits round-trip to the same doubles.
    """
    read = [("%lf", member, peer.peer_type.states[i].name) for i, member in peer.measured.items()]
    for line in peer.lines:
        for k, sender in enumerate(line.senders):
            sender_member, label = f"{line.name}[{k}]", f"{line.link} {sender.name}"
            read += [
                ("%lf", f"{sender_member}.{entry.member}", f"{label} {entry.name}") for entry in line.packet
            ]
            read += [("%d", f"{sender_member}.missing", f"{label} missing")] if line.missing else []
    printed = [("%.17g", f"out.{member}", force.name) for member, force in peer.forces.items()]
    for line in peer.sending:
        printed.append(("%d", f"out.sent_{line.name}", f"{line.link} sent"))
        member = f"out.{line.name}"
        printed += [
            ("%.17g", f"{member}.{entry.member}", f"{line.link} {entry.name}") for entry in line.packet
        ]
    printed += [
        ("%.17g", f"peer.{memory(peer, signal)}", signal.name)
        for signal in peer.signals
        if signal.role == "output"
    ]
    return _filled("peer_test.c", peer, include=include, read=read, shown=printed)
