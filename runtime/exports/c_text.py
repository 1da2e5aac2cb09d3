"""What a peer computes, in plain C99.

Takes: a `CPeer`. Gives: `source`.
Guarantees: no allocation, no global that changes, nothing included but math.h; what happens at an instant is
computed by the functions that `simulate` evaluates, in their order and with their roundings.
Does not: compile or write files (see `code`), or join peers (see `scene_text`).

A peer goes from instant to instant: `send` says what goes out as an instant begins, `force` computes what is
due at it, `move` takes what the computer moves to the next; `tick` is all three. Between `send` and `force` a
packet that needs no time can still be heard.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from apc.compiler.plain import straight
from apc.compiler.weights import sum_weights
from apc.exports.c_names import CLOSE, OPEN, CPeer, block, comment, number, seconds, title
from apc.exports.peer import Instant, Line, Move, Peer, has_edge
from apc.simulation.machine import straight_lines
from apc.simulation.pairs import pair_function


def source(c: CPeer, include: str) -> str:
    """Return the code; `include` is the name of the header."""
    peer = c.peer
    kinds = tuple(dict.fromkeys(peer.instants))
    parts = [
        title(peer),
        f'#include "{include}"\n#include <math.h>\n',
        "/* Products and sums round one by one, as they are written. */",
        "#if defined(__clang__)\n#pragma STDC FP_CONTRACT OFF\n#endif\n",
        _parameters(c),
        _instants(c, kinds),
        *(_own(c, line) for line in peer.lines if line.sending >= 0),
        *(_tick(c, p) for p in sorted({p for one in kinds for p in one.ticks})),
        *(_move(c, place, one) for place, one in enumerate(peer.moves)),
        _begin(c),
        _times(c, kinds),
        _send(c, kinds),
        _force(c, kinds),
        _whole(c, kinds),
    ]
    return "\n".join(parts)


def _now(peer: Peer) -> str:
    """Return the time of an instant in seconds, rounded as `simulate` rounds it."""
    quantum = peer.schedule.quantum
    return f"(double)peer->quanta * {float(quantum.numerator)!r} / {float(quantum.denominator)!r}"


def _parameters(c: CPeer) -> str:
    units = {one.name: one.unit for one in c.peer.system.parameters}
    named = zip(c.peer.kind.parameters, c.parameters, c.peer.parameters.tolist(), strict=True)
    return "".join(
        f"#define P_{own} {number(value)} /* {comment(name)} [{comment(units.get(name, '1'))}] */\n"
        for name, own, value in named
    )


def _instants(c: CPeer, kinds: Sequence[Instant]) -> str:
    listed = ", ".join(str(kinds.index(one)) for one in c.peer.instants)
    what = f"static int {c.name}_kind(const {c.name} *peer)"
    if len(kinds) == 1:
        return f"{what} {OPEN}\n  (void)peer;\n  return 0;\n{CLOSE}\n"
    return f"""\
/* Which kind of instant the next one is. */
{what} {OPEN}
  static const short kinds[{len(c.peer.instants)}] = {OPEN}{listed}{CLOSE};
  return kinds[peer->instant];
{CLOSE}
"""


def _inputs(c: CPeer) -> dict[str, list[str]]:
    """Return what the arguments x, u and p of a function are called."""
    return {
        "x": [
            f"peer->{own}" if own else f"in->{c.measured[i]}" if i in c.measured else "NAN"
            for i, own in enumerate(c.states)
        ],
        "u": [f"peer->{own}" if own else "0.0" for own in c.acting],
        "p": [f"P_{own}" for own in c.parameters],
    }


def _own(c: CPeer, line: Line) -> str:
    """Return what the peer would send over a line now."""
    sending = c.peer.kind.sends[line.sending]
    function, inputs = straight(sending.send), _inputs(c)
    names, lines = straight_lines(function, [*inputs["x"], *inputs["u"], *inputs["p"], "t"])
    stores = [
        f"packet->{own} = {names[function.results[0][sending.channels.index(channel)]]};"
        for own, channel in zip(c.channels[line.link], line.channels, strict=True)
        if channel in sending.channels
    ]
    if line.missing:
        stores.append("packet->missing = 0;")
    packet = f"{c.name}_{c.lines[line.link]}"
    return f"""\
static void {packet}_own(const {c.name} *peer, const {c.name}_in *in, {packet} *packet) {OPEN}
  const double t = {_now(c.peer)};
  (void)in;
  (void)t;
{block([*lines, *stores])}{CLOSE}
"""


def _tick(c: CPeer, p: int) -> str:
    """Return what a clock partition computes at a tick."""
    peer, partition = c.peer, c.peer.kind.clocks[p]
    function, inputs = straight(partition.tick), _inputs(c)
    body: list[str] = []
    gaps = {
        partition.receives[place].link
        for place, channels in enumerate(peer.channels[p])
        if channels and peer.line(partition.receives[place].link).missing
    }
    for link in sorted(gaps):
        packet = f"{c.name}_{c.lines[link]}"
        body += [f"{packet} own_{c.lines[link]};", f"{packet}_own(peer, in, &own_{c.lines[link]});"]
    for place, channels in enumerate(peer.channels[p]):
        body += _receive(c, p, place, channels)
    arguments = [
        *inputs["x"],
        *inputs["u"],
        *(f"peer->{c.outputs[p][o]}" for o in partition.memories),
        *(f"r{place}" for place in range(len(partition.receives))),
        *inputs["p"],
        "t",
    ]
    names, lines = straight_lines(function, arguments)
    stores = []
    for o, value in enumerate(function.results[0]):
        if (p, o) in c.late:
            own, kept = c.late[p, o]
            if kept > 1:
                stores.append(f"for (int k = {kept - 1}; k > 0; k--) peer->{own}[k] = peer->{own}[k - 1];")
            stores.append(f"peer->{own}[0] = {names[value]};")
        stores.append(f"peer->{c.outputs[p][o]} = {names[value]};")
    return f"""\
/* A tick of {comment(partition.clock)}. */
static void {c.name}_tick_{p}({c.name} *peer, const {c.name}_in *in, double t) {OPEN}
  (void)in;
  (void)t;
{block([*body, *lines, *stores])}{CLOSE}
"""


def _receive(c: CPeer, p: int, place: int, channels: Sequence[int]) -> list[str]:
    """Return the lines that make up what a receive hears."""
    peer, receive = c.peer, c.peer.kind.clocks[p].receives[place]
    if not channels or not peer.line(receive.link).senders:
        return [f"const double r{place} = 0.0;", f"(void)r{place};"]
    line, total = peer.line(receive.link), f"r{place}"
    own, count = c.lines[line.link], len(line.senders)
    joined, mean = receive.operator in ("max", "min"), receive.operator == "mean"
    edge = has_edge(peer.kind, p, place)
    weights = np.array([one.weight for one in line.senders])
    divided = mean and line.complete and not edge
    if mean and not divided:
        weights = weights / sum_weights(np.zeros(count, np.int64), weights, 1).floats[0]
    lines, weight = [f"double {total} = {'NAN' if joined else '0.0'};"], ""
    if not joined and (weights != 1).any():
        listed = ", ".join(map(number, weights.tolist()))
        lines = [f"static const double weights_{place}[{count}] = {OPEN}{listed}{CLOSE};", *lines]
        weight = f"weights_{place}[k] * "
    packet = f"in->{own}[k]"
    names = [c.channels[line.link][channel] for channel in channels]
    lines.append(f"for (int k = 0; k < {count}; k++) {OPEN}")
    value = f"{packet}.{names[0]}"
    if edge:
        lines += [f"  {one}" for one in _look(c, p, place, packet, names, line)]
        value = "value"
    elif line.missing:
        value = f"({packet}.missing ? own_{own}.{names[0]} : {value})"
    if joined:
        lines.append(f"  {total} = f{receive.operator}({total}, {value});")
    else:
        lines.append(f"  {total} += {weight}{value};")
    lines.append(CLOSE)
    if divided:
        lines.append(f"{total} /= {float(count)!r};")
    return lines


def _look(c: CPeer, p: int, place: int, packet: str, names: Sequence[str], line: Line) -> list[str]:
    """Return the lines that make `value` of one sender's packet."""
    pair, own = pair_function(c.peer.kind, p, place)
    function, inputs = straight(pair), _inputs(c)
    memories = [f"peer->{c.outputs[p][o]}" for o in c.peer.kind.clocks[p].memories]
    every = [*inputs["x"], *inputs["u"], *memories, *inputs["p"]]
    missing = f"{packet}.missing"
    heard = [f"({missing} ? 0.0 : {packet}.{name})" if line.missing else f"{packet}.{name}" for name in names]
    arguments = [*(every[row] for row in own), *heard, missing if line.missing else "0.0", "t"]
    found, lines = straight_lines(function, arguments)
    return [*lines, f"const double value = {found[function.results[0][0]]};"]


def _move(c: CPeer, place: int, move: Move) -> str:
    """Return what moves the computer's states over a length of time."""
    peer = c.peer
    own = [i for i, name in enumerate(c.states) if name]
    columns = [*(f"peer->{name}" if name else "" for name in (*c.states, *c.acting)), "1"]
    lines: list[str] = []
    stores: list[str] = []
    for row in own:
        if row in move.flowing:
            continue
        terms = [
            f"{number(value)} * {column}" if column != "1" else number(value)
            for value, column in zip(move.matrix[row].tolist(), columns, strict=True)
            if value and column
        ]
        lines.append(f"const double x{row} = {' + '.join(terms) or '0.0'};")
        stores.append(f"peer->{c.states[row]} = x{row};")
    if move.flow is not None:
        function, inputs = straight(move.flow), _inputs(c)
        arguments = [*(inputs["x"][row] for row in move.flowing), *inputs["u"], *inputs["p"], "t"]
        names, more = straight_lines(function, arguments)
        lines += more
        stores += [
            f"peer->{c.states[row]} = {names[value]};"
            for row, value in zip(move.flowing, function.results[0], strict=True)
        ]
    return f"""\
/* What this computer moves, over {seconds(peer, move.quanta)} s. */
static void {c.name}_move_{place}({c.name} *peer) {OPEN}
  const double t = {_now(peer)};
  (void)t;
{block([*lines, *stores])}{CLOSE}
"""


def _begin(c: CPeer) -> str:
    """Return what sets everything to where it starts."""
    peer = c.peer
    values: dict[str, float] = {own: peer.start[i] for i, own in enumerate(c.states) if own}
    for p, partition in enumerate(peer.kind.clocks):
        started = dict(zip(partition.memories, peer.memories[p], strict=True))
        values |= {own: started.get(o, 0.0) for o, own in enumerate(c.outputs[p]) if own}
    values |= dict.fromkeys((own for own in c.acting if own), 0.0)
    lines = ["peer->quanta = 0;", "peer->instant = 0;"]
    lines += [f"peer->{own} = {number(value)};" for own, value in values.items()]
    lines += [f"for (int k = 0; k < {kept}; k++) peer->{own}[k] = 0.0;" for own, kept in c.late.values()]
    silent = ["(void)in;"]
    for line in peer.lines:
        for k, sender in enumerate(line.senders):
            silent += [
                f"in->{c.lines[line.link]}[{k}].{own} = {number(value)};"
                for own, value in zip(c.channels[line.link], sender.start, strict=True)
            ]
            silent += [f"in->{c.lines[line.link]}[{k}].missing = 0;"] if line.missing else []
    return f"""\
void {c.name}_start({c.name} *peer) {OPEN}
{block(lines)}{CLOSE}

void {c.name}_unheard({c.name}_in *in) {OPEN}
{block(silent)}{CLOSE}
"""


def _times(c: CPeer, kinds: Sequence[Instant]) -> str:
    lengths = [c.peer.moves[one.move].quanta for one in kinds]
    listed = ", ".join(map(str, lengths))
    return f"""\
double {c.name}_time(const {c.name} *peer) {OPEN} return {_now(c.peer)}; {CLOSE}

long long {c.name}_next(const {c.name} *peer) {OPEN}
  static const long long lengths[{len(kinds)}] = {OPEN}{listed}{CLOSE};
  return peer->quanta + lengths[{c.name}_kind(peer)];
{CLOSE}
"""


def _switch(c: CPeer, cases: Sequence[Sequence[str]]) -> list[str]:
    """Return the lines that do what each kind of instant asks for."""
    alike: dict[tuple[str, ...], list[int]] = {}
    for place, case in enumerate(cases):
        alike.setdefault(tuple(case), []).append(place)
    if len(alike) == 1:
        return [*cases[0]]
    lines = [f"switch ({c.name}_kind(peer)) {OPEN}"]
    for body, places in alike.items():
        if body:
            lines += [
                *(f"  case {place}:" for place in places),
                *(f"    {one}" for one in body),
                "    break;",
            ]
    return [*lines, "  default:", "    break;", CLOSE]


def _send(c: CPeer, kinds: Sequence[Instant]) -> str:
    lines = ["(void)peer;", "(void)in;", "(void)out;"]
    sent = {line.sending: line for line in c.peer.lines if line.sending >= 0}
    lines += [f"out->{c.lines[line.link]}_sent = 0;" for line in sent.values()]
    cases = [
        [
            text
            for partition in one.sends
            for own in (c.lines[sent[partition].link],)
            for text in (f"{c.name}_{own}_own(peer, in, &out->{own});", f"out->{own}_sent = 1;")
        ]
        for one in kinds
    ]
    return f"""\
void {c.name}_send(const {c.name} *peer, const {c.name}_in *in, {c.name}_out *out) {OPEN}
{block([*lines, *_switch(c, cases)])}{CLOSE}
"""


def _force(c: CPeer, kinds: Sequence[Instant]) -> str:
    cases = []
    for one in kinds:
        case = [f"{c.name}_tick_{p}(peer, in, t);" for p in one.ticks]
        for act in one.acts:
            key = act.partition, act.output
            value = f"{c.late[key][0]}[{act.lag}]" if key in c.late else c.outputs[act.partition][act.output]
            case.append(f"peer->{c.acting[act.hold]} = peer->{value};")
        cases.append(case)
    forces = []
    for own, force in zip(c.forces, c.peer.forces, strict=True):
        terms = [
            ("" if factor == 1 else "-" if factor == -1 else f"{number(factor)} * ") + f"peer->{c.acting[h]}"
            for h, factor in force.terms
            if c.acting[h]
        ]
        forces.append(f"out->{own} = {' + '.join(terms) or '0.0'};")
    return f"""\
void {c.name}_force({c.name} *peer, const {c.name}_in *in, {c.name}_out *out) {OPEN}
  const double t = {_now(c.peer)};
{block(["(void)in;", "(void)out;", "(void)t;", *_switch(c, cases), *forces])}{CLOSE}
"""


def _whole(c: CPeer, kinds: Sequence[Instant]) -> str:
    moves = [[f"{c.name}_move_{one.move}(peer);"] for one in kinds]
    return f"""\
void {c.name}_move({c.name} *peer) {OPEN}
  const long long next = {c.name}_next(peer);
{block(_switch(c, moves))}  peer->quanta = next;
  peer->instant = (peer->instant + 1) % {len(c.peer.instants)};
{CLOSE}

void {c.name}_tick({c.name} *peer, const {c.name}_in *in, {c.name}_out *out) {OPEN}
  {c.name}_send(peer, in, out);
  {c.name}_force(peer, in, out);
  {c.name}_move(peer);
{CLOSE}
"""
