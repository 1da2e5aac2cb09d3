"""The header of a peer in C: what goes in and out of it, what it remembers, and what can be asked of it.

Takes: a `CPeer`. Gives: `header`.
Guarantees: the text says of every member what it is, in which unit.
Does not: say how anything is computed (see `c_text`).
"""

from __future__ import annotations

from collections.abc import Sequence

from apc.exports.c_names import CLOSE, OPEN, CPeer, comment, seconds, title
from apc.exports.peer import Line


def header(c: CPeer) -> str:
    """Return the header: what goes in and out of a peer, its memory, and what it does."""
    peer, name, guard = c.peer, c.name, f"{c.name.upper()}_H"
    packets = "\n".join(_packet(c, line) for line in peer.lines)
    return f"""\
{title(peer)}
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
  long long quanta; /* when its next instant is, in units of {seconds(peer, 1)} s */
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


_Member = tuple[str, str]  # its declaration, and what it is


def _members(listed: Sequence[_Member]) -> str:
    rows = [*listed] or [("char none", "nothing")]
    width = max(len(declared) for declared, _ in rows) + 1
    return "\n".join(f"  {declared + ';':<{width}} /* {comment(told)} */" for declared, told in rows)


def _packet(c: CPeer, line: Line) -> str:
    rows = [
        (f"double {own}", f"{name} [{unit}]")
        for own, name, unit in zip(c.channels[line.link], line.channels, line.units, strict=True)
    ]
    if line.missing:
        rows.append(("int missing", "1: it is late, and what this peer would send stands in for it"))
    return f"""\
/* A packet of {comment(line.link)}. */
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
