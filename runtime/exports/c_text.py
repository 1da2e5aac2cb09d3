"""A peer in plain C99: its header, what it computes, and a program that runs it.

Takes: a `ExportedPeer`. Gives: `header`, `source`, `driver`; `memory`, `parameter_units`.
Guarantees: no allocation, no global that changes, nothing included but math.h; what happens at an instant is
computed by the functions that `simulate` evaluates, in their order and with their roundings; a number is read
as the very same double; nothing in a comment ends it.
Does not: compile or write files (see `code`), or join peers (see `scene_text`).

A peer goes from instant to instant: `send` says what goes out as an instant begins, `force` computes what is
due at it, `move` takes what the computer moves to the next; `tick` is all three. Between `send` and `force` a
packet that needs no time can still be heard. The texts are the templates `peer.h`, `peer.c` and `peer_test.c`
beside this module.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import accumulate
from typing import Any

import numpy as np

from apc.compiler.plain import straight
from apc.compiler.weights import sum_weights
from apc.distribution import program_version
from apc.exports.identifiers import prefixed
from apc.exports.peer_step import ExportedPeer, Move, PeerLink, has_edge
from apc.exports.texts import filled, number
from apc.simulation.machine import straight_lines
from apc.simulation.pairs import pair_function
from apc.simulation.signals import LocalSignal, ticking_partitions


def memory(peer: ExportedPeer, signal: LocalSignal) -> str:
    """Return the member of a peer's memory that holds a signal."""
    if signal.role == "output":
        return _output(peer, *signal.place)
    return f"{'x' if signal.role == 'state' else 'u'}[{signal.place[0]}]"


def parameter_units(peer: ExportedPeer) -> dict[str, str]:
    """Return the unit of each of a peer's parameters."""
    known = {parameter.name: parameter.unit for parameter in peer.system.parameters}
    return {name: known.get(name, "1") for name in peer.kind.parameters}


def _output(peer: ExportedPeer, partition: int, output: int) -> str:
    first = [*accumulate((len(clock.outputs) for clock in peer.kind.clocks), initial=0)]
    return f"y[{first[partition] + output}]"


def _filled(file: str, peer: ExportedPeer, **values: object) -> str:
    """Return one of a peer's texts, its title with it."""
    system, clocks = peer.system, {partition.clock for partition in peer.kind.clocks}
    timings = {timing.name: float(timing.value) for timing in system.timings}
    periods = [(clock.name, timings[clock.period]) for clock in system.clocks if clock.name in clocks]
    shared = {"peer": peer, "name": peer.identifier, "periods": periods, "version": program_version()}
    return filled(file, **shared, **values)


def header(peer: ExportedPeer) -> str:
    """Return the header: what goes in and out of a peer, its memory, and what it does."""
    kind, units = peer.kind, parameter_units(peer)
    named = [(kind.parameters[place], units[kind.parameters[place]]) for place in peer.settable]
    return _filled(
        "peer.h",
        peer,
        states=kind.states,
        inside=[
            f"{state.name} [{state.unit}]" if i not in peer.outside else "-"
            for i, state in enumerate(kind.states)
        ],
        holds=kind.holds,
        computed=[
            f"{output} [{unit}]"
            for clock in kind.clocks
            for output, unit in zip(clock.outputs, clock.units, strict=True)
        ],
        settings=[f"{own} [{unit}]" for own, unit in named],
        kept=_kept(peer),
    )


def _kept(peer: ExportedPeer) -> int:
    """Return how many computed values of each hold are remembered."""
    return 1 + max((act.lag for instant in peer.instants for act in instant.acts), default=0)


def source(peer: ExportedPeer, include: str) -> str:
    """Return the code; `include` is the name of the header."""
    kind, kinds = peer.kind, tuple(dict.fromkeys(peer.instants))
    names = _parameters(peer)
    outputs = [
        dict(zip(partition.memories, values, strict=True)).get(o, 0.0)
        for partition, values in zip(kind.clocks, peer.memories, strict=True)
        for o in range(len(partition.outputs))
    ]

    def computed(function: Any, p: int | None = None) -> tuple[list[str], list[str]]:
        """Return what computes a send, or the tick of a partition."""
        heard = (
            []
            if p is None
            else [*_memories(peer, p), *(f"r{k}" for k in range(len(kind.clocks[p].receives)))]
        )
        return _computed(function, [*_moving(peer), *heard, *names, "t"])

    return _filled(
        "peer.c",
        peer,
        include=include,
        quantum=peer.schedule.quantum,
        constants=[
            item
            for item in zip(names, kind.parameters, peer.parameters.tolist(), strict=True)
            if item[0].startswith("PARAMETER_")
        ],
        units=parameter_units(peer),
        kinds=kinds,
        kind_of=[*map(kinds.index, peer.instants)],
        lengths=[peer.moves[kind.move].quanta for kind in kinds],
        over={line.sending: line.name for line in peer.sending},
        ticking=ticking_partitions(peer.schedule),
        computed=computed,
        heard=lambda p: _heard(peer, p),
        moved=lambda move: _moved(peer, move),
        member=lambda p, o: _output(peer, p, o),
        kept=_kept(peer),
        forces=[
            (own, _sum((factor, f"peer->u[{hold}]") for hold, factor in force.terms))
            for own, force in peer.forces.items()
        ],
        starts=[0.0 if i in peer.outside else value for i, value in enumerate(peer.start)],
        outputs=outputs,
        zeros=[0 for _ in kind.holds],
        late=["{0}" for _ in kind.holds or "0"],
        settings=[float(peer.parameters[place]) for place in peer.settable],
    )


def _sum(terms: Iterable[tuple[float, str]]) -> str:
    """Return the sum of numbers times what they are of."""
    return " + ".join(f"{number(value)} * {factor}" for value, factor in terms) or "0.0"


def _parameters(peer: ExportedPeer) -> list[str]:
    names = [*prefixed("PARAMETER", peer.kind.parameters)]
    for k, place in enumerate(peer.settable):
        names[place] = f"peer->p[{k}]"
    return names


def _moving(peer: ExportedPeer) -> list[str]:
    """Return what the arguments x and u of a function are called."""
    x = [f"peer->x[{i}]" for i in range(len(peer.kind.states))]
    for i in peer.outside:
        x[i] = f"in->{peer.measured[i]}" if i in peer.measured else "NAN"
    return [*x, *(f"peer->u[{h}]" for h in range(len(peer.kind.holds)))]


def _memories(peer: ExportedPeer, p: int) -> list[str]:
    return [f"peer->{_output(peer, p, o)}" for o in peer.kind.clocks[p].memories]


def _computed(function: Any, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the lines of C that compute a function of some arguments, and the names of its values."""
    plain = straight(function)
    names, lines = straight_lines(plain, arguments)
    return lines, [names[place] for place in plain.results[0]]


def _heard(peer: ExportedPeer, p: int) -> tuple[list[PeerLink], list[dict[str, Any]]]:
    """Return of which lines a partition's tick needs the peer's own packet, and what its receives hear."""
    receives, lines = peer.kind.clocks[p].receives, {line.link: line for line in peer.lines}
    heard = [_received(peer, p, place) for place in range(len(receives))]
    read = sorted({receives[place].link for place in range(len(receives)) if (p, place) in peer.channels})
    return [lines[link] for link in read if lines[link].missing], heard


def _received(peer: ExportedPeer, p: int, place: int) -> dict[str, Any]:
    """Return what a receive makes of its senders: lines of C, the value of sender k, how these are joined."""
    receive = peer.kind.clocks[p].receives[place]
    line = peer.line(receive.link) if (p, place) in peer.channels else None
    if line is None or not line.senders:
        return {"line": None}
    names = [line.packet[channel].member for channel in peer.channels[p, place]]
    mean, edge = receive.operator == "mean", has_edge(peer.kind, p, place)
    packet, lines = f"in->{line.name}[k]", list[str]()
    value = f"{packet}.{names[0]}"
    if edge:
        function, numbers = pair_function(peer.kind, p, place)
        missing = f"{packet}.missing" if line.missing else "0.0"
        heard = [
            f"({missing} ? 0.0 : {packet}.{name})" if line.missing else f"{packet}.{name}" for name in names
        ]
        every = [*_moving(peer), *_memories(peer, p), *_parameters(peer)]
        lines, (value,) = _computed(function, [*(every[i] for i in numbers), *heard, missing, "t"])
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
    """Return the lines of C that move the computer's states for a while, and what each state is then."""
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
    """Return a program that reads what a peer measures and hears, a row an instant, and prints what it does.

    With a number N it does N instants of what is heard at the start, and prints the time of one. It prints in
    digits that say the very same doubles.
    """
    read = [("%lf", own, peer.kind.states[i].name) for i, own in peer.measured.items()]
    for line in peer.lines:
        for k, sender in enumerate(line.senders):
            begin, label = f"{line.name}[{k}]", f"{line.link} {sender.name}"
            read += [("%lf", f"{begin}.{entry.member}", f"{label} {entry.name}") for entry in line.packet]
            read += [("%d", f"{begin}.missing", f"{label} missing")] if line.missing else []
    shown = [("%.17g", f"out.{own}", force.name) for own, force in peer.forces.items()]
    for line in peer.sending:
        shown.append(("%d", f"out.sent_{line.name}", f"{line.link} sent"))
        own = f"out.{line.name}"
        shown += [("%.17g", f"{own}.{entry.member}", f"{line.link} {entry.name}") for entry in line.packet]
    shown += [
        ("%.17g", f"peer.{memory(peer, signal)}", signal.name)
        for signal in peer.signals
        if signal.role == "output"
    ]
    return _filled("peer_test.c", peer, include=include, read=read, shown=shown)
