"""A link whose delay changes from packet to packet: a bound by which a scene stays stable whatever it does.

Takes: a `CompiledSystem` and a range of the delay of one of its links.
Gives: `small_gain`, `unstable_delays`.
Guarantees: with a gain below 1 the scene is exponentially stable however the delays of each way from peer to
peer change within the range, the newest packet that has arrived being heard; proved, with every rounding
bounded. Delays that come again and again are proved to make it unstable.
Does not: decide what lies between the two.

Let q[k] be what is sent, d[k] = q[k] − q[k−1], and let a tick hear, in the place of the packet that it hears
at the middle of the range, one that is at most a packets newer or b older. What it hears is off by a sum of
as many d, and over all frames, by Cauchy and Schwarz, this is an operator of norm at most √(a² + b²),
whatever the delays (Kao and Lincoln, Simple stability criteria for systems with time-varying delays,
Automatica 40, 2004). What peer i hears is off by r_i = Σ_j W_ij w_ij, ‖r‖ ≤ ‖|W|‖₂ √(a² + b²) ‖d‖ over all
peers for each of J ticks of a frame, and by the small gain theorem the scene is stable if

    ‖d ← r √(a² + b²)‖∞ ‖|W|‖₂ √J < 1
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Channel, CompiledSystem
from apc.eigen.closing import Feedback, Loop, close, feedback_of, lay_out_loop
from apc.eigen.dissipation import peak_gain, proves_gain
from apc.eigen.modes import loops_at_right_angles
from apc.eigen.relative import relative, relative_coordinates, relative_rows, with_doubt
from apc.eigen.rigid import find_rigid_modes
from apc.frame.instance import prepare
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.frame.radius import RADII, value_of
from apc.frame.schedule import Selected
from apc.moments.crowd import Hearing, build_hearing, instants
from apc.moments.held import held_scene
from apc.moments.traces import heard_packets, hearing_packets, trace_radius
from apc.moments.unserved import UnservedError
from apc.moments.worst import MOST_STATES, Ratios, Sizes, ratios_of, weight_of

Matrix = NDArray[Any]

# What a link whose packets come late is like: the newest that has arrived is heard, until there is another.
HOLDING = Channel(None, None, "uniform", "newest", "hold", None)

# Packets in a row that are tried, of the least delay and then of the largest.
LONGEST = 8

# A gain is proved to be below so much more than it is: rounding takes a part of what lies between.
ABOVE = 1 + 1e-3


@dataclass(frozen=True, slots=True)
class _Heard:
    """The packet that each tick hears at the middle of the range, and the packets it may be off by."""

    hearing: Hearing
    middle: Mapping[Selected, int]
    spread: Mapping[Selected, float]  # √(a² + b²)


def small_gain(system: CompiledSystem, delay: Free, low: Fraction, high: Fraction) -> float:
    """Return the left side of the small gain theorem, proved from above; infinite if the middle is unstable.

    Parameters
    ----------
    system
        The compiled scene.
    delay
        The delay of a link, or of some pairs of its peers.
    low, high
        The range of it, in seconds.

    Raises
    ------
    UnservedError
        What stands in the way of a bound.
    """
    middle = apply(system, [Override(delay, (low + high) / 2)])
    (link,) = (
        link for link in system.links if delay.name in (link.delay, *(pair.delay for pair in link.delays))
    )
    if any(
        receive.age or receive.before
        for kind in system.kinds
        for clock in kind.clocks
        for receive in clock.receives
    ):
        raise UnservedError("receivers ask how old packets are, or for the packet before")
    links = tuple(replace(item, channel=HOLDING) if item is link else item for item in middle.links)
    held = held_scene(unreliable := replace(middle, links=links), prepare(unreliable))
    loops = loops_at_right_angles(held.hearing.groups, held.hearing.exchange, MOST_STATES)
    if isinstance(loops, str):
        raise UnservedError(loops)
    ratios = ratios_of(loops[0].sites, held.lossy)
    weight, sizes = weight_of(loops, held.lossy)
    heard = _heard(middle, delay, low, high)
    apart = loops_at_right_angles(heard.hearing.groups, heard.hearing.exchange, MOST_STATES)
    assert not isinstance(apart, str), "the same peers"
    return max(_gain(loop, heard, ratios, sizes) for loop in apart) * weight


def unstable_delays(
    system: CompiledSystem, delay: Free, low: Fraction, high: Fraction
) -> tuple[int, int] | None:
    """Return how many packets take the least delay, and how many then the largest, and so on, unstably.

    Parameters
    ----------
    system, delay, low, high
        As for `small_gain`; None where no such delays of at most `LONGEST` packets are proved unstable.
    """
    turns = ((first, total - first) for total in range(2, LONGEST + 1) for first in range(1, total))
    for first, then in turns:
        trace = np.array([float(low)] * first + [float(high)] * then)
        channel = replace(HOLDING, trace=trace)
        links = tuple(
            replace(link, channel=channel) if link.delay == delay.name else link for link in system.links
        )
        recorded = replace(system, links=links)
        if links != system.links and trace_radius(recorded, prepare(recorded)).low > 1:
            return first, then
    return None


def _heard(middle: CompiledSystem, delay: Free, low: Fraction, high: Fraction) -> _Heard:
    """Return what each tick hears at the middle of a range, and how far from it at the ends."""
    hearing = build_hearing(middle, prepare(middle))
    times = {clock.name: instants(hearing, clock) for clock in middle.clocks}
    links = {link.name: link for link in middle.links}
    numbers, spread = {}, {}
    for row in chain.from_iterable(hearing.rows.values()):
        link, now = links[row.way.link], hearing.timings[row.way.delay]
        ends = (low, high) if row.way.delay == delay.name else (now, now)
        newest, number, oldest = (
            heard_packets(link, number, times[link.clock], times[row.clock][row.tick], hearing)[0]
            for number in (ends[0], now, ends[1])
        )
        numbers[row], spread[row] = number, math.hypot(newest - number, number - oldest)
    return _Heard(hearing, numbers, spread)


def _gain(loop: Loop, heard: _Heard, ratios: Ratios, sizes: Sizes) -> float:
    """Return ‖d ← r √(a² + b²)‖∞ √J of a loop, proved from above."""
    rows = heard.hearing.of(loop)
    slots = dict.fromkeys((sent.link for site in loop.sites for sent in site.schedule.sent), 1)
    packets = [heard.middle[row] for listed in rows for row in listed]
    depth = dict.fromkeys(slots, max(1, -min(packets, default=0)))
    now = hearing_packets(loop, rows, iter(packets), depth, slots)
    layout = lay_out_loop(now)
    if (n := len(layout.names)) > MOST_STATES:
        raise UnservedError(f"peers make one system of {n:,} states, and {MOST_STATES} are the most")

    def size(site: int, link: str) -> float:
        return math.sqrt(loop.sites[site].count) * sizes.get((link, loop.sites[site].name), 1.0)

    used = [
        (g, line, row)
        for g, (site, listed) in enumerate(zip(now.sites, rows, strict=True))
        for line, row in enumerate(listed)
        if heard.spread[row]
        and any(value_of(block)[:, line].any() for block in (site.lifted.q, site.lifted.d))
    ]
    # Of several numbers that are heard as one, that which counts once is what the others add to.
    entering = [
        (g, line, heard.spread[row] / size(g, row.way.link))
        for g, line, row in used
        if ratios.get((row.way.link, row.channel), 1) == 1
    ]
    feedback = []
    for g, hears in enumerate(feedback_of(now, layout)):
        before = np.concatenate([hears.before, np.zeros((*hears.before.shape[:2], len(entering)))], axis=-1)
        for place, (site, line, share) in enumerate(entering):
            if site == g:
                before[:, line, n + place] = share, 8 * np.finfo(float).eps * share
        feedback.append(Feedback(hears.now, before))
    closed = close([site.lifted for site in now.sites], feedback, layout, numbers=RADII)
    before = np.zeros_like(closed.sent)
    senders = [
        (h, row, sent) for h, site in enumerate(now.sites) for row, sent in enumerate(site.schedule.sent)
    ]
    places = {(packet.site, packet.row, packet.lag): place for packet, place in layout.places.items()}
    for line, (h, row, _) in enumerate(senders):
        before[0, line, places[h, row, 1]] = 1.0
    change = RADII.subtract(closed.sent, before)
    combined: dict[tuple[int, str, str], Matrix] = {}
    for line, (h, _, sent) in enumerate(senders):
        if any((row.way.link, row.channel) == (sent.link, sent.channel) for *_, row in used):
            ratio = ratios.get((sent.link, sent.channel))
            number = (h, sent.link, sent.channel if ratio is None else "")
            by = float(ratio or 1) * size(h, sent.link)
            weighing = combined.setdefault(number, np.zeros((2, len(senders))))
            weighing[:, line] = by, 8 * np.finfo(float).eps * abs(by)
    if not entering or not combined:
        return 0.0
    at = with_doubt(relative_coordinates(find_rigid_modes(now, with_drifts=False).basis))
    a = relative(closed.matrix[..., :n], at, RADII)
    b = relative_rows(closed.matrix[..., n:], at, RADII)
    output = RADII.multiply(np.stack(list(combined.values()), axis=1), change)
    c, d = output[..., :n][..., at.rest], output[..., n:]
    gain = peak_gain(*map(value_of, (a, b, c, d)))[0] * ABOVE
    if not math.isfinite(gain) or not proves_gain(a, b, c, d, gain):
        return math.inf
    together = [
        sum(site == g and rows[g][line].way == way for site, line, _ in entering)
        for g, listed in enumerate(rows)
        for way in {row.way for row in listed}
    ]
    return gain * math.sqrt(max(together)) * ABOVE
