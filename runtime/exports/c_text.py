"""A peer in plain C99: its header, what it computes, and a program that runs it.

Takes: a `Peer`. Gives: `header`, `source`, `driver`; `memory`, `number`, `filled`.
Guarantees: no allocation, no global that changes, nothing included but math.h; what happens at an instant is
computed by the functions that `simulate` evaluates, in their order and with their roundings; a number is read
as the very same double; nothing in a comment ends it.
Does not: compile or write files (see `code`), or join peers (see `scene_text`).

A peer goes from instant to instant: `send` says what goes out as an instant begins, `force` computes what is
due at it, `move` takes what the computer moves to the next; `tick` is all three. Between `send` and `force` a
packet that needs no time can still be heard. What stands in every text is in `peer.h`, `peer.c` and
`peer_test.c` beside this module, with $names for what differs.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import accumulate
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from apc.compiler.plain import straight
from apc.compiler.weights import sum_weights
from apc.distribution import program_version
from apc.exports.peer_step import Line, Move, Peer, has_edge
from apc.exports.words import identifier, unique
from apc.simulation.machine import straight_lines
from apc.simulation.pairs import pair_function
from apc.simulation.signals import LocalSignal, ticking_partitions


def filled(file: str, /, **values: object) -> str:
    """Return the text of a file beside this module with values in the place of its $names."""
    text = Path(__file__).with_name(file).read_text(encoding="utf-8")
    return Template(text).substitute(values)


def number(value: float) -> str:
    """Return a number such that a compiler reads the very same double."""
    text = "INFINITY" if math.isinf(value) else repr(float(value))
    return f"({text})" if text.startswith("-") else text


def row(values: Iterable[object]) -> str:
    """Return what stands between the braces of an array, which has at least one entry."""
    return ", ".join(map(str, values)) or "0"


def block(lines: Iterable[str], indent: int = 2) -> str:
    """Return lines with their ends, indented."""
    return "".join(f"{' ' * indent}{line}\n" for line in lines)


def comment(text: str) -> str:
    """Return a text that can stand in a comment of C."""
    shown = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    return shown.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def memory(peer: Peer, signal: LocalSignal) -> str:
    """Return the member of a peer's memory that holds a signal."""
    if signal.role == "output":
        return _output(peer, *signal.place)
    return f"{'x' if signal.role == 'state' else 'u'}[{signal.place[0]}]"


def parameter_units(peer: Peer) -> dict[str, str]:
    """Return the unit of each of a peer's parameters."""
    known = {parameter.name: parameter.unit for parameter in peer.system.parameters}
    return {name: known.get(name, "1") for name in peer.kind.parameters}


def _output(peer: Peer, partition: int, output: int) -> str:
    first = [*accumulate((len(clock.outputs) for clock in peer.kind.clocks), initial=0)]
    return f"y[{first[partition] + output}]"


def _title(peer: Peer) -> str:
    """Return the comment that a text begins with."""
    system, clocks = peer.system, {partition.clock for partition in peer.kind.clocks}
    texts = [f"     {comment(digest)}  {comment(path)}" for path, digest in system.origin.digests]
    timings = {timing.name: float(timing.value) for timing in system.timings}
    periods = [
        f"{comment(clock.name)} every {timings[clock.period]!r} s"
        for clock in system.clocks
        if clock.name in clocks
    ]
    made = f"{comment(peer.name)} of {comment(system.name)}, written by apc {program_version()}"
    return "\n".join([f"/* {made}. {', '.join(periods)}.", "   Made from (SHA-256):", *texts]) + " */"


# ---- the header

_Member = tuple[str, str]  # its declaration, and what it is


def _members(listed: Sequence[_Member]) -> str:
    rows = listed or [("char none", "nothing")]
    width = max(len(declared) for declared, _ in rows) + 1
    return "\n".join(f"  {declared + ';':<{width}} /* {comment(what)} */" for declared, what in rows)


def header(peer: Peer) -> str:
    """Return the header: what goes in and out of a peer, its memory, and what it does."""
    kind, name, states = peer.kind, peer.identifier, peer.kind.states
    heard = [(f"double {own}", f"{states[i].name} [{states[i].unit}]") for i, own in peer.measured.items()]
    sent = [
        (f"double {own}", f"the force on {force.name.rpartition('.')[0]} [N]")
        for own, force in peer.forces.items()
    ]
    packets = ""
    for line in peer.lines:
        rows = [(f"double {entry.member}", f"{entry.name} [{entry.unit}]") for entry in line.packet]
        if line.missing:
            rows.append(("int missing", "1: it is late, and what this peer would send stands in for it"))
        type_ = f"{name}_{line.name}"
        packets += f"/* A packet of {comment(line.link)}. */\n"
        packets += f"typedef struct {{\n{_members(rows)}\n}} {type_};\n\n"
        if line.senders:
            names = ", ".join(one.name for one in line.senders[:8])
            more = ", ..." if len(line.senders) > 8 else ""
            heard.append(
                (f"{type_} {line.name}[{len(line.senders)}]", f"the newest packets of {names}{more}")
            )
        if line.sending >= 0:
            sent.append((f"{type_} {line.name}", "what it sends"))
            sent.append((f"int {line.name}_sent", "whether it does now"))
    holds = [hold.name for hold in kind.holds]
    computed = [
        one for partition in kind.clocks for one in zip(partition.outputs, partition.units, strict=True)
    ]
    units = parameter_units(peer)
    settings = [f"{own} [{units[own]}]" for own in (kind.parameters[place] for place in peer.settable)]
    inside = [(one.name, one.unit) if i not in peer.outside else ("", "") for i, one in enumerate(states)]
    listed = [
        (
            f"double x[{len(inside) or 1}]",
            ", ".join(f"{own} [{unit}]" if own else "-" for own, unit in inside),
        ),
        (f"double y[{len(computed) or 1}]", ", ".join(f"{own} [{unit}]" for own, unit in computed)),
        (f"double u[{len(holds) or 1}]", f"what acts of {', '.join(holds)}"),
        (f"double late[{len(holds) or 1}][{_kept(peer)}]", "what was computed of these, the newest first"),
        (f"double p[{len(settings) or 1}]", f"parameters that ticks read: {', '.join(settings)}"),
    ]
    return filled(
        "peer.h",
        title=_title(peer),
        guard=f"{name.upper()}_H",
        name=name,
        packets=packets.rstrip("\n") + "\n",
        heard=_members(heard),
        sent=_members(sent),
        quantum=repr(float(peer.schedule.quantum)),
        instants=len(peer.instants),
        memory=_members(listed),
    )


def _kept(peer: Peer) -> int:
    """Return how many computed values of each hold are remembered."""
    return 1 + max((act.lag for instant in peer.instants for act in instant.acts), default=0)


# ---- what it computes


def source(peer: Peer, include: str) -> str:
    """Return the code; `include` is the name of the header."""
    kind, name = peer.kind, peer.identifier
    kinds = tuple(dict.fromkeys(peer.instants))
    units = parameter_units(peer)
    named = zip(_parameters(peer), kind.parameters, peer.parameters.tolist(), strict=True)
    over = {line.sending: line.name for line in peer.sending}
    begin = [
        dict(zip(partition.memories, values, strict=True)).get(o, 0.0)
        for partition, values in zip(kind.clocks, peer.memories, strict=True)
        for o in range(len(partition.outputs))
    ]
    unheard = [
        f"in->{line.name}[{k}].{one.member} = {number(value)};"
        for line in peer.lines
        for k, sender in enumerate(line.senders)
        for one, value in zip(line.packet, sender.start, strict=True)
    ]
    unheard += [
        f"for (int k = 0; k < {len(line.senders)}; k++) in->{line.name}[k].missing = 0;"
        for line in peer.lines
        if line.missing
    ]
    sends = [
        [
            text
            for own in (over[partition] for partition in one.sends)
            for text in (f"{name}_{own}_own(peer, in, &out->{own});", f"out->{own}_sent = 1;")
        ]
        for one in kinds
    ]
    ticks = [
        [
            *(f"{name}_tick_{p}(peer, in, t);" for p in one.ticks),
            *(f"peer->u[{act.hold}] = peer->late[{act.hold}][{act.lag}];" for act in one.acts),
        ]
        for one in kinds
    ]
    forces = []
    for own, force in peer.forces.items():
        terms = [f"{number(factor)} * peer->u[{h}]" for h, factor in force.terms]
        forces.append(f"out->{own} = {' + '.join(terms) or '0.0'};")
    functions = [_own(peer, line) for line in peer.sending]
    functions += [_tick(peer, p) for p in ticking_partitions(peer.schedule)]
    functions += [_move(peer, place, move) for place, move in enumerate(peer.moves)]
    return filled(
        "peer.c",
        title=_title(peer),
        include=include,
        name=name,
        parameters="".join(
            f"#define {own} {number(value)} /* {comment(label)} [{comment(units[label])}] */\n"
            for own, label, value in named
            if own.startswith("P_")
        ),
        instants=len(peer.instants),
        kinds=row(map(kinds.index, peer.instants)),
        numerator=repr(float(peer.schedule.quantum.numerator)),
        denominator=repr(float(peer.schedule.quantum.denominator)),
        functions="\n".join(functions),
        states=row(number(0.0 if i in peer.outside else value) for i, value in enumerate(peer.start)),
        outputs=row(map(number, begin)),
        holds=row("0" for _ in kind.holds),
        late=row("{0}" for _ in kind.holds or "0"),
        settings=row(number(peer.parameters[place]) for place in peer.settable),
        unheard=block(unheard),
        lengths=row(peer.moves[one.move].quanta for one in kinds),
        unsent=block(f"out->{own}_sent = 0;" for own in over.values()),
        sends=_cases(sends),
        ticks=_cases(ticks),
        forces=block(forces),
        moves=_cases([f"{name}_move_{one.move}(peer);"] for one in kinds),
    )


def _cases(bodies: Iterable[Sequence[str]]) -> str:
    """Return what is done at each kind of instant."""
    return "".join(f"  case {k}:\n{block([*body, 'break;'], 4)}" for k, body in enumerate(bodies))


def _parameters(peer: Peer) -> list[str]:
    names = [f"P_{own}" for own in unique(map(identifier, peer.kind.parameters))]
    for k, place in enumerate(peer.settable):
        names[place] = f"peer->p[{k}]"
    return names


def _moving(peer: Peer) -> list[str]:
    """Return what the arguments x and u of a function are called."""
    x = [f"peer->x[{i}]" for i in range(len(peer.kind.states))]
    for i in peer.outside:
        x[i] = f"in->{peer.measured[i]}" if i in peer.measured else "NAN"
    return [*x, *(f"peer->u[{h}]" for h in range(len(peer.kind.holds)))]


def _memories(peer: Peer, p: int) -> list[str]:
    return [f"peer->{_output(peer, p, o)}" for o in peer.kind.clocks[p].memories]


def _computed(function: Any, arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the lines of C that compute a function of some arguments, and the names of its values."""
    plain = straight(function)
    names, lines = straight_lines(plain, arguments)
    return lines, [names[place] for place in plain.results[0]]


def _own(peer: Peer, line: Line) -> str:
    """Return what the peer would send over a line now."""
    sending, name = peer.kind.sends[line.sending], f"{peer.identifier}_{line.name}"
    lines, values = _computed(sending.send, [*_moving(peer), *_parameters(peer), "t"])
    sent = dict(zip(sending.channels, values, strict=True))
    lines += [f"packet->{entry.member} = {sent[entry.name]};" for entry in line.packet if entry.name in sent]
    lines += ["packet->missing = 0;"] if line.missing else []
    return f"""\
static void {name}_own(const {peer.identifier} *peer, const {peer.identifier}_in *in, {name} *packet) {{
  const double t = {peer.identifier}_now(peer);
  (void)in;
  (void)t;
{block(lines)}}}
"""


def _tick(peer: Peer, p: int) -> str:
    """Return what a clock partition computes at a tick."""
    partition, name = peer.kind.clocks[p], peer.identifier
    body: list[str] = []
    read = [place for place in range(len(partition.receives)) if (p, place) in peer.channels]
    lines = {link: peer.line(link) for link in sorted({partition.receives[place].link for place in read})}
    for line in lines.values():
        if line.missing:
            own = f"own_{line.name}"
            body += [f"{name}_{line.name} {own};", f"{name}_{line.name}_own(peer, in, &{own});"]
    for place in range(len(partition.receives)):
        body += _receive(peer, p, place)
    receives = [f"r{place}" for place in range(len(partition.receives))]
    arguments = [*_moving(peer), *_memories(peer, p), *receives, *_parameters(peer), "t"]
    computed, values = _computed(partition.tick, arguments)
    stores = [f"peer->{_output(peer, p, o)} = {value};" for o, value in enumerate(values)]
    for h, hold in enumerate(peer.kind.holds):
        if hold.clock == partition.clock:
            late = f"peer->late[{h}]"
            stores.append(f"for (int k = {_kept(peer) - 1}; k > 0; k--) {late}[k] = {late}[k - 1];")
            stores.append(f"{late}[0] = peer->{_output(peer, p, hold.output)};")
    return f"""\
/* A tick of {comment(partition.clock)}. */
static void {name}_tick_{p}({name} *peer, const {name}_in *in, double t) {{
  (void)in;
  (void)t;
{block([*body, *computed, *stores])}}}
"""


def _receive(peer: Peer, p: int, place: int) -> list[str]:
    """Return the lines that make up what a receive hears."""
    receive, total = peer.kind.clocks[p].receives[place], f"r{place}"
    line = peer.line(receive.link) if (p, place) in peer.channels else None
    if line is None or not line.senders:
        return [f"const double {total} = 0.0;", f"(void){total};"]
    names = [line.packet[channel].member for channel in peer.channels[p, place]]
    count, packet = len(line.senders), f"in->{line.name}[k]"
    mean, edge = receive.operator == "mean", has_edge(peer.kind, p, place)
    looked: list[str] = []
    value = f"{packet}.{names[0]}"
    if edge:
        looked, value = _look(peer, p, place, line, names)
    elif line.missing:
        value = f"({packet}.missing ? own_{line.name}.{names[0]} : {value})"
    loop = f"for (int k = 0; k < {count}; k++) {{"
    if receive.operator in ("max", "min"):
        larger = f"  {total} = f{receive.operator}({total}, {value});"
        return [f"double {total} = NAN;", loop, *looked, larger, "}"]
    weights = np.array([sender.weight for sender in line.senders])
    divided = mean and line.complete and not edge
    if mean and not divided:
        weights = weights / float(sum_weights(np.zeros(count, np.int64), weights, 1)[0])
    return [
        f"static const double weights_{place}[{count}] = {{{row(map(number, weights.tolist()))}}};",
        f"double {total} = 0.0;",
        *(loop, *looked, f"  {total} += weights_{place}[k] * {value};", "}"),
        *([f"{total} /= {float(count)!r};"] if divided else []),
    ]


def _look(peer: Peer, p: int, place: int, line: Line, names: Sequence[str]) -> tuple[list[str], str]:
    """Return the lines that look at one sender's packet, and what they make of it."""
    pair, own = pair_function(peer.kind, p, place)
    packet = f"in->{line.name}[k]"
    every = [*_moving(peer), *_memories(peer, p), *_parameters(peer)]
    missing = f"{packet}.missing" if line.missing else "0.0"
    heard = [f"({missing} ? 0.0 : {packet}.{name})" if line.missing else f"{packet}.{name}" for name in names]
    lines, (value,) = _computed(pair, [*(every[i] for i in own), *heard, missing, "t"])
    return [f"  {one}" for one in lines], value


def _move(peer: Peer, place: int, move: Move) -> str:
    """Return what moves the computer's states over a length of time."""
    moving, name = _moving(peer), peer.identifier
    exact = [i for i in range(len(peer.start)) if i not in peer.outside and i not in move.flowing]
    lines, stores = [], {}
    for i in exact:
        terms = [
            f"{number(value)} * {factor}"
            for j, (value, factor) in enumerate(zip(move.matrix[i].tolist(), [*moving, "1.0"], strict=True))
            if value and j not in peer.outside
        ]
        lines.append(f"const double x{i} = {' + '.join(terms) or '0.0'};")
        stores[i] = f"x{i}"
    if move.flow is not None:
        flowing = [moving[i] for i in move.flowing]
        arguments = [*flowing, *moving[len(peer.start) :], *_parameters(peer), "t"]
        more, values = _computed(move.flow, arguments)
        lines += more
        stores |= zip(move.flowing, values, strict=True)
    return f"""\
/* What this computer moves, over {float(move.quanta * peer.schedule.quantum)!r} s. */
static void {name}_move_{place}({name} *peer) {{
  const double t = {name}_now(peer);
  (void)t;
{block([*lines, *(f"peer->x[{i}] = {value};" for i, value in stores.items())])}}}
"""


# ---- a program


def driver(peer: Peer, include: str) -> str:
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
        shown.append(("%d", f"out.{line.name}_sent", f"{line.link} sent"))
        own = f"out.{line.name}"
        shown += [("%.17g", f"{own}.{entry.member}", f"{line.link} {entry.name}") for entry in line.packet]
    shown += [
        ("%.17g", f"peer.{memory(peer, signal)}", signal.name)
        for signal in peer.signals
        if signal.role == "output"
    ]
    tests = [f'scanf("{form}", &in.{own}) == 1' for form, own, _ in read]
    return filled(
        "peer_test.c",
        title=_title(peer),
        include=include,
        name=peer.identifier,
        reads=comment(", ".join(label for *_, label in read)) or "a line of any text",
        prints=comment(", ".join(label for *_, label in shown)),
        condition=" &&\n      ".join(tests) or '!feof(stdin) && scanf("%*[^\\n]") != EOF && getchar() != EOF',
        shown=block((f'printf(" {form}", {value});' for form, value, _ in shown), 4),
    )
