"""Several peers in one C text, and the packets between them; or one peer that hears from outside.

Takes: `Peer`s, when they send, how late each hears each. Gives: `CScene`, `c_scene`, `one_peer`;
`scene_source`; `Variable`.
Guarantees: time counts in whole quanta; of what happens at once all sends come first, then what is heard,
then ticks, as everywhere; a value is looked at as it is just before an instant's ticks, as in a row of
`simulate`.
Does not: know how a simulator calls it (see `fmu`).

What a scene remembers is one struct, `model`, that can be copied: no pointer is in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from apc.exports.c_names import CLOSE, OPEN, CPeer, c_peer, identifier, in_order, number
from apc.exports.chance_text import Chance, chance_begin, chance_of, chance_source, chance_types
from apc.exports.peer import MOST_HEARD, Line, first_packet, group_of, lines_of, peer_of, refused, sites_of
from apc.simulation.machine import luck_text
from apc.simulation.settings import Method
from apc.simulation.signals import LocalSignal
from apc.simulation.simulation import Plan

MOST_WAYS = 20_000  # from peer to peer in one text: each is a number of a table


@dataclass(frozen=True, slots=True)
class Variable:
    """What can be looked at: its name as `simulate` has it, unit, and the member of `model` that holds it.

    `given` says that it comes from outside, and is `start` until something does; `flag` that it is 0 or 1.
    """

    name: str
    unit: str
    member: str
    given: bool = False
    flag: bool = False
    start: float = 0.0


@dataclass(frozen=True, slots=True)
class Way:
    """A link in a scene: its period, phase and the channels of its packets.

    `ring` packets of each peer are kept; `start` (peers, channels) is what is heard before the first arrives;
    `chance` is None where every packet takes its delay.
    """

    name: str
    period: int
    phase: int
    channels: tuple[str, ...]
    ring: int
    start: tuple[tuple[float, ...], ...]
    chance: Chance | None


@dataclass(frozen=True, slots=True, eq=False)
class CScene:
    """A scene in C. Of each of `peers`, `site` is its place among `codes`, `place` among those of its site.

    `delays` are those of each (code, link), (peers of the code, senders), in quanta; `senders` likewise the
    numbers of those heard. Without `ways` what is heard comes from outside.
    """

    name: str
    quantum: Fraction
    codes: tuple[CPeer, ...]
    peers: tuple[tuple[int, int], ...]
    ways: tuple[Way, ...]
    senders: dict[tuple[int, str], tuple[tuple[int, ...], ...]]
    delays: dict[tuple[int, str], tuple[tuple[int, ...], ...]]
    variables: tuple[Variable, ...]


def one_peer(plan: Plan, peer: int, method: Method) -> CScene:
    """Return one peer, its device with it, that hears from outside. Raises ApcError as `peer_of`."""
    found = peer_of(plan, peer, method)
    code = c_peer(found)
    variables = []
    for line in found.lines:
        for k, sender in enumerate(line.senders):
            begin = f"in0[0].{code.lines[line.link]}[{k}]"
            own = _channels(code, line, begin)
            variables += [
                Variable(f"{line.link}.{sender.name}.{name}", unit, member, given=True, start=start)
                for (name, unit, member), start in zip(own, sender.start, strict=True)
            ]
            if line.missing:
                name = f"{line.link}.{sender.name}.missing"
                variables.append(Variable(name, "1", f"{begin}.missing", given=True, flag=True))
    for line in found.lines:
        if line.sending >= 0:
            own = _channels(code, line, f"out0[0].{code.lines[line.link]}")
            variables += [Variable(f"{line.link}.{name}", unit, member) for name, unit, member in own]
    variables += [Variable(one.name, one.unit, f"peer0[0].{_member(code, one)}") for one in found.signals]
    quantum = found.schedule.quantum
    return CScene(code.name, quantum, (code,), ((0, 0),), (), {}, {}, tuple(variables))


def c_scene(plan: Plan, method: Method) -> CScene:
    """Return a whole scene.

    Raises
    ------
    ApcError
        E960 it has more ways than fit a text; and as `peer_of`, `chance_of`.
    """
    system, exchange = plan.system, plan.exchange
    first = sites_of(plan)
    sites = tuple(dict.fromkeys(first))
    total = exchange.peers * (exchange.peers - 1) if any(map(exchange.is_complete, exchange.links)) else 0
    if max(total, exchange.peers) > MOST_WAYS:
        what = f"{exchange.peers:,} peers hear each other on {total:,} ways; {MOST_WAYS:,} fit a text of C"
        alone = f'--peer "{exchange.peer_name(0)}"' if exchange.peers <= MOST_HEARD else "fewer peers"
        raise refused(system, what, alone)
    names = in_order(exchange.peer_name(one) for one in sites)
    codes = tuple(c_peer(peer_of(plan, one, method), name) for one, name in zip(sites, names, strict=True))
    places = [0] * len(sites)
    peers = []
    for one in first:
        site = sites.index(one)
        peers.append((site, places[site]))
        places[site] += 1
    quantum = codes[0].peer.schedule.quantum
    timings = plan.numbers.timings
    heard: dict[tuple[int, str], list[tuple[int, ...]]] = {}
    delays: dict[tuple[int, str], list[tuple[int, ...]]] = {}
    used: dict[str, dict[str, None]] = {}
    latest: dict[str, int] = {}
    for peer, (site, _) in enumerate(peers):
        group = group_of(plan, peer)
        for line in lines_of(plan, peer)[0]:
            used.setdefault(line.link, {}).update(dict.fromkeys(line.channels))
            if not line.senders:
                continue
            own = tuple(one.peer for one in line.senders)
            late = tuple(
                int(timings[exchange.delay(line.link, group_of(plan, one), group)] / quantum) for one in own
            )
            heard.setdefault((site, line.link), []).append(own)
            delays.setdefault((site, line.link), []).append(late)
            latest[line.link] = max(latest.get(line.link, 0), *late)
    clocks = {one.name: one for one in system.clocks}
    ways = []
    for link, channels in used.items():
        clock = clocks[exchange.links[link].clock]
        period = int(timings[clock.period] / quantum)
        start = tuple(first_packet(plan, link, peer, tuple(channels)) for peer in range(exchange.peers))
        chance = chance_of(plan, link, quantum)
        ring = max(latest.get(link, 0) // period + 2, chance.kept + 1 if chance else 0)
        phase = int(timings[clock.phase] / quantum)
        ways.append(Way(link, period, phase, tuple(channels), ring, start, chance))
    variables = tuple(
        Variable(
            f"{exchange.peer_name(peer)}.{one.name}",
            one.unit,
            f"peer{site}[{place}].{_member(codes[site], one)}",
        )
        for peer, (site, place) in enumerate(peers)
        for one in codes[site].peer.signals
    )
    return CScene(
        name=identifier(system.name),
        quantum=quantum,
        codes=codes,
        peers=tuple(peers),
        ways=tuple(ways),
        senders={key: tuple(rows) for key, rows in heard.items()},
        delays={key: tuple(rows) for key, rows in delays.items()},
        variables=variables,
    )


def _channels(code: CPeer, line: Line, begin: str) -> list[tuple[str, str, str]]:
    listed = zip(line.channels, line.units, code.channels[line.link], strict=True)
    return [(name, unit, f"{begin}.{own}") for name, unit, own in listed]


def _member(code: CPeer, signal: LocalSignal) -> str:
    """Return what holds a signal of a peer."""
    match signal.role:
        case "state":
            return code.states[signal.place[0]]
        case "output":
            return code.outputs[signal.place[0]][signal.place[1]]
        case _:
            return code.acting[signal.place[0]]


def scene_source(scene: CScene) -> str:
    """Return the text that plays a scene; the peers' codes are in texts of their own.

    It has `static void begin(model *m)` and `static void run(model *m, long long until)`, which goes until an
    instant has come and what is sent at it has gone out.
    """
    counts = [sum(site == one for site, _ in scene.peers) for one in range(len(scene.codes))]
    ways = [f"sent_{one}" for one in in_order(way.name for way in scene.ways)]
    includes = "\n".join(f'#include "{code.name}.h"' for code in scene.codes)
    members, begin, at, move, send, force = [], [], [], [], [], []
    for s, (code, count) in enumerate(zip(scene.codes, counts, strict=True)):
        name = code.name
        members += [
            f"{name} peer{s}[{count}];",
            f"{name}_in in{s}[{count}];",
            f"{name}_out out{s}[{count}];",
            f"int stage{s}[{count}]; /* at an instant: 0 come, 1 what it sends has gone out, 2 done */",
        ]
        every = f"for (int i = 0; i < {count}; i++)"
        begin += [
            f"{every} {OPEN}",
            f"  {name}_start(&m->peer{s}[i]);",
            f"  {name}_unheard(&m->in{s}[i]);",
            f"  m->stage{s}[i] = 0;",
            CLOSE,
        ]
        at += [
            f"{every} {OPEN}",
            f"  const {name} *p = &m->peer{s}[i];",
            f"  const long long next = m->stage{s}[i] == 2 ? {name}_next(p) : p->quanta;",
            "  if (next < at) at = next;",
            CLOSE,
        ]
        move += [
            f"{every}",
            f"  if (m->stage{s}[i] == 2 && {name}_next(&m->peer{s}[i]) == at) {OPEN}",
            f"    {name}_move(&m->peer{s}[i]);",
            f"    m->stage{s}[i] = 0;",
            f"  {CLOSE}",
        ]
        send += [
            f"{every}",
            f"  if (m->stage{s}[i] == 0 && m->peer{s}[i].quanta == at) {OPEN}",
            f"    {name}_send(&m->peer{s}[i], &m->in{s}[i], &m->out{s}[i]);",
            *(f"    {one}" for one in _posted(scene, s, ways)),
            f"    m->stage{s}[i] = 1;",
            f"  {CLOSE}",
        ]
        force += [
            f"{every}",
            f"  if (m->stage{s}[i] == 1 && m->peer{s}[i].quanta == at) {OPEN}",
            *([f"    hear{s}(m, i, at);"] if scene.ways else []),
            f"    {name}_force(&m->peer{s}[i], &m->in{s}[i], &m->out{s}[i]);",
            f"    m->stage{s}[i] = 2;",
            f"  {CLOSE}",
        ]
    for own, way in zip(ways, scene.ways, strict=True):
        members.append(
            f"double {own}[{way.ring}][{len(scene.peers)}][{len(way.channels)}]; /* the newest packets */"
        )
        if way.chance is not None:
            members.append(f"{own}_way ways_{own}[{len(way.chance.ways)}];")
            begin += chance_begin(way.chance, own, len(way.channels))
    tables = [_tables(own, way) for own, way in zip(ways, scene.ways, strict=True)]
    hears = [_hears(scene, s, ways) for s in range(len(scene.codes))] if scene.ways else []
    types = "".join(
        chance_types(way.chance, own, len(way.channels))
        for own, way in zip(ways, scene.ways, strict=True)
        if way.chance is not None
    )
    return f"""\
{includes}
#include <limits.h>
{_luck(scene)}{types}
typedef struct {OPEN}
{_lines(members)}{CLOSE} model;

{"".join(tables)}{"".join(hears)}static void begin(model *m) {OPEN}
{_lines(begin)}{CLOSE}

static void run(model *m, long long until) {OPEN}
  for (;;) {OPEN}
    long long at = LLONG_MAX;
{_lines(at, 4)}    if (at > until) return;
{_lines(move, 4)}{_lines(send, 4)}    if (at == until) return;
{_lines(force, 4)}  {CLOSE}
{CLOSE}
"""


def _luck(scene: CScene) -> str:
    """Return what the luck of packets is made of, if there is any."""
    if all(way.chance is None for way in scene.ways):
        return ""
    return f"#include <math.h>\n#include <stdint.h>\n\ntypedef int64_t whole;\n{luck_text()}"


def _lines(listed: Sequence[str], indent: int = 2) -> str:
    return "".join(f"{' ' * indent}{one}\n" for one in listed)


def _tables(own: str, way: Way) -> str:
    """Return what is heard of everybody before a packet arrives, and which packet is the newest."""
    rows = ",\n".join(f"    {OPEN}{', '.join(map(number, row))}{CLOSE}" for row in way.start)
    return f"""\
/* The number of the newest packet that was sent until an instant: below 0 there is none. */
static long long newest_{own}(long long at) {OPEN}
  return at < {way.phase} ? -1 : (at - {way.phase}) / {way.period};
{CLOSE}

static const double *packet_{own}(const model *m, long long at, int sender) {OPEN}
  static const double start[{len(way.start)}][{len(way.channels)}] = {OPEN}
{rows}
  {CLOSE};
  const long long number = newest_{own}(at);
  return number < 0 ? start[sender] : m->{own}[number % {way.ring}][sender];
{CLOSE}

{chance_source(way.chance, own, len(way.channels), way.ring) if way.chance is not None else ""}"""


def _posted(scene: CScene, site: int, ways: Sequence[str]) -> list[str]:
    """Return the lines that keep what a peer sends."""
    code, found = scene.codes[site], []
    for own, way in zip(ways, scene.ways, strict=True):
        line = next((one for one in code.peer.lines if one.link == way.name and one.sending >= 0), None)
        if line is None:
            continue
        numbers = ", ".join(str(peer) for peer, (one, _) in enumerate(scene.peers) if one == site)
        count = sum(one == site for one, _ in scene.peers)
        mine, names = code.lines[way.name], dict(zip(line.channels, code.channels[way.name], strict=True))
        found += [
            f"if (m->out{site}[i].{mine}_sent) {OPEN}",
            f"  static const int number[{count}] = {OPEN}{numbers}{CLOSE};",
            f"  double *to = m->{own}[newest_{own}(at) % {way.ring}][number[i]];",
            *(
                f"  to[{k}] = m->out{site}[i].{mine}.{names[channel]};"
                for k, channel in enumerate(way.channels)
                if channel in names
            ),
            *([f"  draw_{own}(m, number[i], newest_{own}(at));"] if way.chance is not None else []),
            CLOSE,
        ]
    return found


def _hears(scene: CScene, site: int, ways: Sequence[str]) -> str:
    """Return what brings the newest packets that have arrived to a peer."""
    code, body = scene.codes[site], []
    for own, way in zip(ways, scene.ways, strict=True):
        heard, late = (one.get((site, way.name), ()) for one in (scene.senders, scene.delays))
        if not heard:
            continue
        line, mine = code.peer.line(way.name), code.lines[way.name]
        count, width = len(heard), len(heard[0])
        if way.chance is not None:
            body += _arrives(scene, site, own, way, way.chance)
            continue
        for what, type_, table in (("senders", "int", heard), ("delays", "long long", late)):
            rows = ", ".join(f"{OPEN}{', '.join(map(str, row))}{CLOSE}" for row in table)
            body.append(f"static const {type_} {what}_{own}[{count}][{width}] = {OPEN}{rows}{CLOSE};")
        body.append(f"for (int k = 0; k < {width}; k++) {OPEN}")
        packet = f"packet_{own}(m, at - delays_{own}[i][k], senders_{own}[i][k])"
        body.append(f"  const double *newest = {packet};")
        body += [
            f"  m->in{site}[i].{mine}[k].{name} = newest[{way.channels.index(channel)}];"
            for channel, name in zip(line.channels, code.channels[way.name], strict=True)
        ]
        body.append(CLOSE)
    unused = [] if body else ["(void)m;", "(void)i;", "(void)at;"]
    return f"""\
static void hear{site}(model *m, int i, long long at) {OPEN}
{_lines([*unused, *body])}{CLOSE}

"""


def _arrives(scene: CScene, site: int, own: str, way: Way, chance: Chance) -> list[str]:
    """Return the lines that bring what is in effect on a peer's ways to it."""
    code = scene.codes[site]
    line, mine = code.peer.line(way.name), code.lines[way.name]
    receivers = [receiver for _, receiver in chance.ways]
    first = [str(receivers.index(peer)) for peer, (one, _) in enumerate(scene.peers) if one == site]
    packet = f"m->in{site}[i].{mine}[k]"
    named = zip(line.channels, code.channels[way.name], strict=True)
    missing = f"  {packet}.missing = m->ways_{own}[w].gap > m->ways_{own}[w].effective;"
    return [
        f"static const int first_{own}[{len(first)}] = {OPEN}{', '.join(first)}{CLOSE};",
        f"for (int k = 0; k < {len(line.senders)}; k++) {OPEN}",
        f"  const int w = first_{own}[i] + k;",
        f"  arrive_{own}(m, w, at);",
        *(f"  {packet}.{name} = m->ways_{own}[w].held[{way.channels.index(one)}];" for one, name in named),
        *([missing] if line.missing else []),
        CLOSE,
    ]
