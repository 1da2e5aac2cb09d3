"""Packets that get lost or come late by chance, in C.

Takes: a link's law, who hears whom over it.
Gives: `Chance`, `chance_of`; what they are in C: `chance_types`, `chance_begin`, `chance_source`.
Guarantees: the luck of each packet is the one that `simulate` draws, from the scene's seed, and so is the
packet in effect at every tick.
Does not: send or hear (see `scene_text`).

What goes on a way is kept until it has come: then it is in effect if it was sent after what is (or came after
it, as the link says), and what got lost is missed from when it should have come.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction

from apc.exports.c_names import CLOSE, OPEN, number
from apc.exports.peer import group_of, lines_of
from apc.network.channel import luck_key
from apc.network.timetable import Luck, luck_of
from apc.simulation.simulation import Plan


@dataclass(frozen=True, slots=True, eq=False)
class Chance:
    """What chance does to a link's packets: `luck`, and the key of it; up to `kept` of each way are kept.

    `ways` are (sender, receiver), those of a receiver in the order in which it hears them; `delays` are
    theirs in s, `nominal` in quanta.
    """

    luck: Luck
    key: tuple[int, int]
    kept: int
    ways: tuple[tuple[int, int], ...]
    delays: tuple[float, ...]
    nominal: tuple[int, ...]


def chance_of(plan: Plan, link: str, quantum: Fraction) -> Chance | None:
    """Return what chance does to a link's packets, None if nothing.

    Parameters
    ----------
    plan
        What the peers of the scene do in a frame.
    link
        The link.
    quantum
        In s.

    Raises
    ------
    ApcError
        As `luck_of`.
    """
    exchange, timings = plan.exchange, plan.numbers.timings
    lucks = [
        (luck_of(plan.system, timings, exchange, route, quantum), route)
        for route in plan.routes
        if route.link == link
    ]
    if not lucks:
        return None
    ways = [
        (sender.peer, peer)
        for peer in range(exchange.peers)
        for line in lines_of(plan, peer)[0]
        if line.link == link
        for sender in line.senders
    ]
    groups = [(group_of(plan, sender), group_of(plan, peer)) for sender, peer in ways]
    late = [timings[exchange.delay(link, *pair)] for pair in groups]
    return Chance(
        luck=lucks[0][0],
        key=luck_key(link, plan.system.experiment.seed, 0),
        kept=max(luck.kept(route) for luck, route in lucks),
        ways=tuple(ways),
        delays=tuple(float(one) for one in late),
        nominal=tuple(int(one / quantum) for one in late),
    )


def _row(values: Iterable[object]) -> str:
    return f"{OPEN}{', '.join(map(str, values))}{CLOSE}"


def chance_types(chance: Chance, own: str, channels: int) -> str:
    """Return the type `OWN_way`: what is remembered of a way; `own` is what the link's packets are called."""
    return f"""\
typedef struct {OPEN}
  long long due, number; /* when it is there, in 2^-20 quanta, and which it is */
  int state;             /* 0 there is none, 1 it comes, 2 it is lost */
{CLOSE} {own}_coming;

typedef struct {OPEN}
  double held[{channels}]; /* what is in effect */
  long long effective, gap, arrived; /* its number; the newest that is missed; when it came */
  int bad;
  {own}_coming coming[{chance.kept}];
{CLOSE} {own}_way;

"""


def chance_begin(chance: Chance, own: str, channels: int) -> list[str]:
    """Return the lines that begin it, before any packet: at an instant before 0 `packet_…` gives starts."""
    return [
        f"for (int w = 0; w < {len(chance.ways)}; w++) {OPEN}",
        f"  {own}_way *way = &m->ways_{own}[w];",
        f"  const double *first = packet_{own}(m, -1, {own}_senders[w]);",
        f"  for (int k = 0; k < {channels}; k++) way->held[k] = first[k];",
        f"  for (int k = 0; k < {chance.kept}; k++) way->coming[k].state = 0;",
        "  way->effective = way->gap = way->arrived = -1;",
        "  way->bad = 0;",
        CLOSE,
    ]


def chance_source(chance: Chance, own: str, channels: int, ring: int) -> str:
    """Return what draws the luck of packets as they go out, and what brings them in effect.

    Parameters
    ----------
    chance
        Of the link.
    own
        What its packets are called.
    channels, ring
        How many numbers a packet has, and how many packets of a peer are kept.
    """
    luck, law, count = chance.luck, chance.luck.law, len(chance.ways)
    drawn = [
        "double u[4], late = delays[w];",
        f"if (number == 0) {OPEN}",
        f"  chances(1, key[0], key + 1, 1, {own}_senders + w, {own}_receivers + w, &u);",
        f"  way->bad = u[0] < {number(law.bad)};",
        CLOSE,
        f"chances(1, key[0], key + 1, number + 2, {own}_senders + w, {own}_receivers + w, &u);",
        f"int lost = u[1] < (way->bad ? {number(law.one_minus_h)} : {number(law.one_minus_k)});",
        f"way->bad = way->bad ? u[0] < 1 - {number(law.r)} : u[0] < {number(law.p)};",
    ]
    if law.jitter:
        drawn.append(f"late += {number(law.jitter)} * deviate({law.distribution.upper()}, u[2], u[3]);")
        drawn.append("if (late < 0) late = 0;")
    if law.trace is not None:
        trace = _row("INFINITY" if one == float("inf") else number(one) for one in law.trace.tolist())
        drawn = [
            f"static const double trace[{law.trace.size}] = {trace};",
            f"double late = trace[number % {law.trace.size}];",
            "int lost = 0;",
        ]
    unused = "".join(f"  (void){one};\n" for one in ("key", "chances", "deviate", "delays"))
    wins = "one->number > way->effective"
    if not luck.newest:
        wins = f"one->due > way->arrived || (one->due == way->arrived && {wins})"
    body = "".join(f"    {one}\n" for one in drawn)
    return f"""\
static const whole {own}_senders[{count}] = {_row(sender for sender, _ in chance.ways)};
static const whole {own}_receivers[{count}] = {_row(receiver for _, receiver in chance.ways)};

/* A packet goes out on all ways of its sender. */
static void draw_{own}(model *m, int sender, long long number) {OPEN}
  static const uint64_t key[2] = {_row(f"{one}u" for one in chance.key)};
  static const double delays[{count}] = {_row(map(number, chance.delays))};
  static const long long nominal[{count}] = {_row(chance.nominal)};
{unused}  for (int w = 0; w < {count}; w++) {OPEN}
    {own}_way *way = &m->ways_{own}[w];
    {own}_coming *one = &way->coming[number % {chance.kept}];
    if ({own}_senders[w] != sender) continue;
{body}    late /= {number(float(luck.quantum))};
    lost |= !(late < LONGEST);
    const long long fine = lost ? nominal[w] * ONE : (long long)rint(late * ONE);
    one->due = ({luck.phase} + number * {luck.period}) * ONE + fine;
    one->number = number;
    one->state = 1 + lost;
  {CLOSE}
{CLOSE}

/* What has come on a way is in effect, and what should have is missed. */
static void arrive_{own}(model *m, int w, long long at) {OPEN}
  {own}_way *way = &m->ways_{own}[w];
  for (int k = 0; k < {chance.kept}; k++) {OPEN}
    {own}_coming *one = &way->coming[k];
    if (!one->state || one->due > at * ONE) continue;
    if (one->state == 2) {OPEN}
      if (one->number > way->gap) way->gap = one->number;
    {CLOSE} else if ({wins}) {OPEN}
      way->effective = one->number;
      way->arrived = one->due;
      for (int c = 0; c < {channels}; c++)
        way->held[c] = m->{own}[one->number % {ring}][{own}_senders[w]][c];
    {CLOSE}
    one->state = 0;
  {CLOSE}
{CLOSE}

"""
