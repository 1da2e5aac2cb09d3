"""What a peer's parts are called in C, and the pieces its texts have in common.

Takes: a `Peer`. Gives: `CPeer`, `c_peer`; `identifier`, `in_order`, `number`; `title`, `comment`, `seconds`,
`block`.
Guarantees: no two parts of a peer have one name, and none has a word of the language; a number is read as the
very same double; nothing in a comment ends it.
Does not: write what a peer does (see `c_header`, `c_text`, `c_driver`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from apc.distribution import program_version
from apc.exports.peer import Peer

# Words of the language, and names of its library and of the texts, that no part may have.
TAKEN = """
auto break case char const continue default do double else enum extern float for goto if inline int long
register restrict return short signed sizeof static struct switch typedef union unsigned void volatile while
main quanta instant missing y0 y1 yn j0 j1 jn gamma
"""
WORDS = frozenset(TAKEN.split())
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


def title(peer: Peer) -> str:
    """Return the comment that a text begins with."""
    made_of = peer.system.origin.digests
    texts = "\n".join(f"     {comment(digest)}  {comment(path)}" for path, digest in made_of)
    clocks = {partition.clock for partition in peer.kind.clocks}
    timings = {one.name: one.value for one in peer.system.timings}
    periods = ", ".join(
        f"{comment(one.name)} every {float(timings[one.period])!r} s"
        for one in peer.system.clocks
        if one.name in clocks
    )
    return f"""\
/* {comment(peer.name)} of {comment(peer.system.name)}, written by apc {program_version()}. {periods}.
   Made from (SHA-256):
{texts} */"""


def comment(text: str) -> str:
    """Return a text that can stand in a comment of C."""
    shown = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    return shown.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def seconds(peer: Peer, quanta: int) -> str:
    """Return so many quanta in s."""
    return repr(float(quanta * peer.schedule.quantum))


def block(lines: Sequence[str], indent: str = "  ") -> str:
    """Return lines with their ends, indented."""
    return "".join(f"{indent}{line}\n" for line in lines)
