"""A peer in plain C99: a header, its code, and a driver that runs it.

Takes: a `Peer`. Gives: `CPeer`, `c_peer`; `header`, `source`, `driver`; `identifier`, `number`, `in_order`.
Guarantees: no allocation, no global that changes, nothing included but math.h; what happens at an instant is
computed by the functions that `simulate` evaluates, in their order and with their roundings; the text says of
every member what it is, in which unit.
Does not: compile or write files (see `writing_c`), or join peers (see `scene_text`).

A peer goes from instant to instant: `send` says what goes out as an instant begins, `force` computes what is
due at it, `move` takes what the computer moves to the next; `tick` is all three. Between `send` and `force` a
packet that needs no time can still be heard.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from apc.compiler.frozen import dataclass
from apc.compiler.plain import straight
from apc.compiler.weights import sum_weights
from apc.distribution import program_version
from apc.exports.peer import Instant, Line, Move, Peer, has_edge
from apc.simulation.machine import straight_lines
from apc.simulation.pairs import pair_function

WORDS = frozenset(
    [
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
        "float",
        "for",
        "goto",
        "if",
        "inline",
        "int",
        "long",
        "register",
        "restrict",
        "return",
        "short",
        "signed",
        "sizeof",
        "static",
        "struct",
        "switch",
        "typedef",
        "union",
        "unsigned",
        "void",
        "volatile",
        "while",
        "main",
        "quanta",
        "instant",
        "missing",
        "y0",
        "y1",
        "yn",
        "j0",
        "j1",
        "jn",
        "gamma",
    ]
)
OPEN, CLOSE = "{", "}"


def identifier(name: str) -> str:
    """Return a name as C has it: letters, digits and _, no word of the language."""
    found = re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_") or "n"
    return f"n{found}" if found[0].isdigit() else f"{found}_" if found in WORDS else found


def in_order(names: Iterable[str], taken: Iterable[str] = ()) -> tuple[str, ...]:
    """Return names as C has them, each another."""
    used, found = set(taken), []
    for name in names:
        base = one = identifier(name)
        count = 1
        while one in used:
            count += 1
            one = f"{base}_{count}"
        used.add(one)
        found.append(one)
    return tuple(found)


def number(value: float) -> str:
    """Return a finite number such that a compiler reads the very same double."""
    text = repr(float(value))
    return f"({text})" if text.startswith("-") else text


@dataclass(frozen=True, slots=True, eq=False)
class CPeer:
    """The names that a peer's parts have in C.

    `name` begins the name of everything outside; `states`, `outputs` (by partition), `acting` (by hold) are
    members of its memory, "" where there is none; `late` are those that keep what was computed, by
    (partition, output), with how many. `lines` are what each line is called, `channels` what of it.
    """

    peer: Peer
    name: str
    states: tuple[str, ...]
    measured: Mapping[int, str]
    outputs: tuple[tuple[str, ...], ...]
    acting: tuple[str, ...]
    late: Mapping[tuple[int, int], tuple[str, int]]
    forces: tuple[str, ...]
    lines: Mapping[str, str]
    channels: Mapping[str, tuple[str, ...]]
    parameters: tuple[str, ...]


def c_peer(peer: Peer, name: str = "") -> CPeer:
    """Name the parts of a peer; what it is called itself follows from its name in the scene if not given."""
    kind = peer.kind
    ticking = {p for one in peer.instants for p in one.ticks}
    acted = {act.hold for one in peer.instants for act in one.acts}
    lags: dict[tuple[int, int], int] = {}
    for act in (act for one in peer.instants for act in one.acts):
        key = act.partition, act.output
        lags[key] = max(lags.get(key, 0), act.lag)
    inside = [place for place in range(len(kind.states)) if place not in peer.outside]
    members = [
        *(kind.states[place].name for place in inside),
        *(one for p in sorted(ticking) for one in kind.clocks[p].outputs),
        *(f"{kind.holds[h].name} acting" for h in sorted(acted)),
    ]
    # A value remembered from the start must not act before it is computed, and so has a place of its own.
    kept = sorted(key for key, lag in lags.items() if lag or key[1] in kind.clocks[key[0]].memories)
    members += [f"{kind.clocks[p].outputs[o]} late" for p, o in kept]
    named = iter(in_order(members))
    states = ["" if place in peer.outside else next(named) for place in range(len(kind.states))]
    outputs = [
        tuple(next(named) for _ in partition.outputs) if p in ticking else ("",) * len(partition.outputs)
        for p, partition in enumerate(kind.clocks)
    ]
    acting = [next(named) if h in acted else "" for h in range(len(kind.holds))]
    late = {key: (next(named), lags[key] + 1) for key in kept}
    lines = in_order(line.link for line in peer.lines)
    measured = in_order((kind.states[place].name for place in peer.measured), lines)
    forces = in_order((one.name for one in peer.forces), [*lines, *(f"{line}_sent" for line in lines)])
    return CPeer(
        peer=peer,
        name=name or identifier(peer.name),
        states=tuple(states),
        measured=dict(zip(peer.measured, measured, strict=True)),
        outputs=tuple(outputs),
        acting=tuple(acting),
        late=late,
        forces=forces,
        lines=dict(zip((line.link for line in peer.lines), lines, strict=True)),
        channels={line.link: in_order(line.channels) for line in peer.lines},
        parameters=in_order(kind.parameters),
    )


# ---- the header


def header(c: CPeer) -> str:
    """Return the header: what goes in and out of a peer, its memory, and what it does."""
    peer, name, guard = c.peer, c.name, f"{c.name.upper()}_H"
    packets = "\n".join(_packet(c, line) for line in peer.lines)
    return f"""\
{_title(peer)}
#ifndef {guard}
#define {guard}

{packets}
/* What a peer measures and hears. All numbers are in SI units. */
typedef struct {OPEN}
{_members(_heard_members(c))}
{CLOSE} {name}_in;

/* What it puts out: forces on what moves outside, and what it sends. */
typedef struct {OPEN}
{_members(_sent_members(c))}
{CLOSE} {name}_out;

/* All that it remembers. */
typedef struct {OPEN}
  long long quanta; /* when its next instant is, in units of {_seconds(peer, 1)} s */
  int instant;      /* which of the {len(peer.instants)} of a frame */
{_members(_memory_members(c))}
{CLOSE} {name};

/* Begin at time 0, when nothing is computed yet. */
void {name}_start({name} *peer);

/* Hear of everybody what stands for packets that have not arrived yet: where they start. */
void {name}_unheard({name}_in *in);

/* The time of its next instant, in s. */
double {name}_time(const {name} *peer);

/* The time of the instant after that, in quanta. */
long long {name}_next(const {name} *peer);

/* What is sent at this instant: where a member "..._sent" is 1, a packet goes out. */
void {name}_send(const {name} *peer, const {name}_in *in, {name}_out *out);

/* Compute what is due at this instant, of what is measured and heard now. */
void {name}_force({name} *peer, const {name}_in *in, {name}_out *out);

/* Go to the next instant: what this computer moves moves. */
void {name}_move({name} *peer);

/* All of one instant: send, force, move. Call it at {name}_time. */
void {name}_tick({name} *peer, const {name}_in *in, {name}_out *out);

#endif
"""


def _title(peer: Peer) -> str:
    """Return the comment that a text begins with."""
    texts = "\n".join(
        f"     {_comment(digest)}  {_comment(path)}" for path, digest in peer.system.origin.texts
    )
    clocks = {partition.clock for partition in peer.kind.clocks}
    timings = {one.name: one.value for one in peer.system.timings}
    periods = ", ".join(
        f"{_comment(one.name)} every {float(timings[one.period])!r} s"
        for one in peer.system.clocks
        if one.name in clocks
    )
    return f"""\
/* {_comment(peer.name)} of {_comment(peer.system.name)}, written by apc {program_version()}. {periods}.
   Made from (SHA-256):
{texts} */"""


def _comment(text: str) -> str:
    """Return a text that can stand in a comment of C."""
    shown = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    return shown.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


_Member = tuple[str, str]  # its declaration, and what it is


def _members(listed: Sequence[_Member]) -> str:
    rows = [*listed] or [("char none", "nothing")]
    width = max(len(declared) for declared, _ in rows) + 1
    return "\n".join(f"  {declared + ';':<{width}} /* {_comment(told)} */" for declared, told in rows)


def _packet(c: CPeer, line: Line) -> str:
    rows = [
        (f"double {own}", f"{name} [{unit}]")
        for own, name, unit in zip(c.channels[line.link], line.channels, line.units, strict=True)
    ]
    if line.missing:
        rows.append(("int missing", "1: it is late, and what this peer would send stands in for it"))
    return f"""\
/* A packet of {_comment(line.link)}. */
typedef struct {OPEN}
{_members(rows)}
{CLOSE} {c.name}_{c.lines[line.link]};
"""


def _heard_members(c: CPeer) -> list[_Member]:
    states = c.peer.kind.states
    rows = [(f"double {own}", f"{states[i].name} [{states[i].unit}]") for i, own in c.measured.items()]
    for line in c.peer.lines:
        if line.senders:
            own, names = c.lines[line.link], ", ".join(one.name for one in line.senders[:8])
            more = ", …" if len(line.senders) > 8 else ""
            told = f"the newest packets of {names}{more.replace('…', '...')}"
            rows.append((f"{c.name}_{own} {own}[{len(line.senders)}]", told))
    return rows


def _sent_members(c: CPeer) -> list[_Member]:
    rows = [
        (f"double {own}", f"the force on {force.name.rpartition('.')[0]} [N]")
        for own, force in zip(c.forces, c.peer.forces, strict=True)
    ]
    for line in c.peer.lines:
        if line.sending >= 0:
            own = c.lines[line.link]
            rows += [(f"{c.name}_{own} {own}", "what it sends"), (f"int {own}_sent", "whether it does now")]
    return rows


def _memory_members(c: CPeer) -> list[_Member]:
    kind = c.peer.kind
    rows = [
        (f"double {own}", f"{one.name} [{one.unit}]")
        for own, one in zip(c.states, kind.states, strict=True)
        if own
    ]
    for names, partition in zip(c.outputs, kind.clocks, strict=True):
        rows += [
            (f"double {own}", f"{name} [{unit}], computed at ticks of {partition.clock}")
            for own, name, unit in zip(names, partition.outputs, partition.units, strict=True)
            if own
        ]
    rows += [
        (f"double {own}", f"what acts of {hold.name}")
        for own, hold in zip(c.acting, kind.holds, strict=True)
        if own
    ]
    rows += [
        (f"double {own}[{kept}]", f"{kind.clocks[p].outputs[o]}, the newest first")
        for (p, o), (own, kept) in c.late.items()
    ]
    return rows


# ---- the code


def source(c: CPeer, include: str) -> str:
    """Return the code; `include` is the name of the header."""
    peer = c.peer
    kinds = tuple(dict.fromkeys(peer.instants))
    parts = [
        _title(peer),
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


def _seconds(peer: Peer, quanta: int) -> str:
    return repr(float(quanta * peer.schedule.quantum))


def _now(peer: Peer) -> str:
    """Return the time of an instant in seconds, rounded as `simulate` rounds it."""
    quantum = peer.schedule.quantum
    return f"(double)peer->quanta * {float(quantum.numerator)!r} / {float(quantum.denominator)!r}"


def _parameters(c: CPeer) -> str:
    units = {one.name: one.unit for one in c.peer.system.parameters}
    named = zip(c.peer.kind.parameters, c.parameters, c.peer.parameters.tolist(), strict=True)
    return "".join(
        f"#define P_{own} {number(value)} /* {_comment(name)} [{_comment(units.get(name, '1'))}] */\n"
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


def _block(lines: Sequence[str], indent: str = "  ") -> str:
    return "".join(f"{indent}{line}\n" for line in lines)


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
{_block([*lines, *stores])}{CLOSE}
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
/* A tick of {_comment(partition.clock)}. */
static void {c.name}_tick_{p}({c.name} *peer, const {c.name}_in *in, double t) {OPEN}
  (void)in;
  (void)t;
{_block([*body, *lines, *stores])}{CLOSE}
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
/* What this computer moves, over {_seconds(peer, move.quanta)} s. */
static void {c.name}_move_{place}({c.name} *peer) {OPEN}
  const double t = {_now(peer)};
  (void)t;
{_block([*lines, *stores])}{CLOSE}
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
{_block(lines)}{CLOSE}

void {c.name}_unheard({c.name}_in *in) {OPEN}
{_block(silent)}{CLOSE}
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
{_block([*lines, *_switch(c, cases)])}{CLOSE}
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
{_block(["(void)in;", "(void)out;", "(void)t;", *_switch(c, cases), *forces])}{CLOSE}
"""


def _whole(c: CPeer, kinds: Sequence[Instant]) -> str:
    moves = [[f"{c.name}_move_{one.move}(peer);"] for one in kinds]
    return f"""\
void {c.name}_move({c.name} *peer) {OPEN}
  const long long next = {c.name}_next(peer);
{_block(_switch(c, moves))}  peer->quanta = next;
  peer->instant = (peer->instant + 1) % {len(c.peer.instants)};
{CLOSE}

void {c.name}_tick({c.name} *peer, const {c.name}_in *in, {c.name}_out *out) {OPEN}
  {c.name}_send(peer, in, out);
  {c.name}_force(peer, in, out);
  {c.name}_move(peer);
{CLOSE}
"""


# ---- the driver


def driver(c: CPeer, include: str) -> str:
    """Return a program that reads what a peer measures and hears, a row an instant, and prints what it does.

    With a number N it does N instants of what is heard at the start, and prints the time of one.
    """
    peer, name = c.peer, c.name
    read = [f"&in.{own}" for own in c.measured.values()]
    headings = [peer.kind.states[i].name for i in peer.measured]
    counts: list[str] = []
    for line in peer.lines:
        own = c.lines[line.link]
        for k, sender in enumerate(line.senders):
            read += [f"&in.{own}[{k}].{channel}" for channel in c.channels[line.link]]
            headings += [f"{line.link} {sender.name} {channel}" for channel in line.channels]
            if line.missing:
                counts.append(f"&in.{own}[{k}].missing")
                headings.append(f"{line.link} {sender.name} missing")
                read.append("")
    tests = [f'scanf("%d", {counts.pop(0)}) == 1' if not one else f'scanf("%lf", {one}) == 1' for one in read]
    condition = " &&\n      ".join(tests) or '!feof(stdin) && scanf("%*[^\\n]") != EOF && getchar() != EOF'
    shown = [("%.17g", f"out.{own}", force.name) for own, force in zip(c.forces, peer.forces, strict=True)]
    for line in (line for line in peer.lines if line.sending >= 0):
        own = c.lines[line.link]
        shown.append(("%d", f"out.{own}_sent", f"{line.link} sent"))
        shown += [
            ("%.17g", f"out.{own}.{channel}", f"{line.link} {told}")
            for channel, told in zip(c.channels[line.link], line.channels, strict=True)
        ]
    for names, partition in zip(c.outputs, peer.kind.clocks, strict=True):
        shown += [
            ("%.17g", f"peer.{own}", told) for own, told in zip(names, partition.outputs, strict=True) if own
        ]
    prints = [f'printf(" {form}", {value});' for form, value, _ in shown]
    return f"""\
{_title(peer)}
/* Reads, a row an instant: {_comment(", ".join(headings)) or "a line of any text"}.
   Prints: time, {_comment(", ".join(told for _, _, told in shown))}. */
#include "{include}"
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

int main(int count, char **words) {OPEN}
  {name} peer;
  {name}_in in = {OPEN}0{CLOSE};
  {name}_out out = {OPEN}0{CLOSE};
  {name}_start(&peer);
  {name}_unheard(&in);
  if (count > 1) {OPEN}
    const long ticks = atol(words[1]);
    const clock_t begin = clock();
    for (long k = 0; k < ticks; k++) {name}_tick(&peer, &in, &out);
    printf("%g s an instant\\n", (double)(clock() - begin) / CLOCKS_PER_SEC / (double)ticks);
    return 0;
  {CLOSE}
  while ({condition}) {OPEN}
    printf("%.17g", {name}_time(&peer));
    {name}_tick(&peer, &in, &out);
{_block(prints, "    ")}    printf("\\n");
    fflush(stdout);
  {CLOSE}
  return 0;
{CLOSE}
"""
