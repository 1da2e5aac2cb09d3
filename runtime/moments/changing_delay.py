"""A link whose delay changes from packet to packet: a bound by which a scene stays stable whatever it does.

Takes: a `Model` and a range of the delay of one of its links.
Gives: `loop_gain`, `unstable_delays`.
Guarantees: with a gain below 1 the scene is exponentially stable however the delays of each way from peer to
peer change within the range, the newest packet that has arrived being heard; proved, with every rounding
bounded. Delays that come again and again are proved to make it unstable.
Does not: decide what lies between the two.

Let q[k] be what is sent, d[k] = q[k] − q[k−1], and let a tick hear, in the place of the packet that it hears
at the middle of the range, one that is at most a packets newer or b older. What it hears is off by a sum of
as many d, and over all frames, by Cauchy and Schwarz, this is an operator of norm at most √(a² + b²),
whatever the delays (Kao and Lincoln, Simple stability criteria for systems with time-varying delays,
Automatica 40, 2004), for each of J ticks of a frame. By the small gain theorem (see `small_gain`) the scene
is stable if

    ‖d ← r √(a² + b²)‖∞ ‖|W|‖₂ √J < 1
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from fractions import Fraction

import numpy as np

from apc.analysis.sides import sides
from apc.compiler.compiled import Channel, Model
from apc.eigen.modes import loops_at_right_angles
from apc.frame.instance import prepare
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.names import ParameterRef
from apc.frame.overrides import Override, apply
from apc.frame.radius import UNIT
from apc.moments.crowd import build_hearing
from apc.moments.frames import refuse_unheld
from apc.moments.small_gain import MOST_STATES, change_of_sent, felt_rows, ratios_of, weight_of
from apc.moments.traces import Packets, trace_radius
from apc.unserved import NotSupportedError

# What a link whose packets come late is like: the newest that has arrived is heard, until there is another.
HOLDING = Channel(None, None, "uniform", "newest", "hold", None)

# Packets in a row that are tried, of the least delay and then of the largest: all up to the first number, and
# up to the second those with a third, a half and two thirds of the least delay.
LONGEST, LONGER = 8, 12

# A gain is proved to be below so much more than it is: rounding takes a part of what lies between.
ABOVE = 1 + 1e-3


def loop_gain(system: Model, delay: ParameterRef, low: Fraction, high: Fraction) -> float:
    """Return the left side of the small gain theorem, proved from above; infinite if the middle is unstable.

    At a kink it is the largest of all sides.

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
    NotSupportedError
        What stands in the way of a bound.
    """
    return max(
        _loop_gain(side.system, side.prepared.jacobians, delay, low, high)
        for side in sides(system, prepare(system))
    )


def _loop_gain(
    system: Model,
    jacobians: tuple[SubsystemJacobians, ...],
    delay: ParameterRef,
    low: Fraction,
    high: Fraction,
) -> float:
    """Return `loop_gain` of one side of a kink."""
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
        raise NotSupportedError("receivers ask how old packets are, or for the packet before")
    links = tuple(replace(item, channel=HOLDING) if item is link else item for item in middle.links)
    changing = replace(middle, links=links)
    hearing = build_hearing(changing, prepare(changing, jacobians))
    refuse_unheld(changing, hearing)
    loops = loops_at_right_angles(hearing.groups, hearing.exchange, MOST_STATES)
    packets = Packets(changing, hearing)
    lossy = frozenset(link.name for link in links if link.channel is not None)
    ratios, (weight, sizes) = ratios_of(loops[0].sites, lossy), weight_of(loops, lossy)
    heard = {row: packets.heard(row)[0] for row in packets.rows}
    spread = {
        row: math.hypot(packets.heard(row, low)[0] - number, number - packets.heard(row, high)[0])
        for row, number in heard.items()
        if row.way.delay == delay.name
    }
    gains = []
    for loop in loops:
        now = packets.loop(loop, heard, packets.depths(heard.items(), 1))
        rows = hearing.of(loop)
        off = [
            (g, {line: 0}, spread[rows[g][line]])
            for g, site in enumerate(now.sites)
            for line, _ in felt_rows(site, link.name)
            if spread.get(rows[g][line])
        ]
        response = change_of_sent(now, off, ratios, sizes)
        gain = response.peak * ABOVE
        if not math.isfinite(gain) or not response.is_below(gain):
            return math.inf
        ticks = Counter(
            (g, rows[g][line].way, rows[g][line].channel) for g, lines, _ in off for line in lines
        )
        gains.append(gain * math.sqrt(max(ticks.values(), default=0)) * (1 + 8 * UNIT))
    return max(gains) * weight


def unstable_delays(
    system: Model, delay: ParameterRef, low: Fraction, high: Fraction
) -> tuple[int, int] | None:
    """Return how many packets take the least delay, and how many then the largest, and so on, unstably.

    Parameters
    ----------
    system, delay, low, high
        As for `loop_gain`; None where no such delays of at most `LONGER` packets are proved unstable.
    """
    turns = [(first, total - first) for total in range(2, LONGEST + 1) for first in range(1, total)]
    more = range(LONGEST + 1, LONGER + 1)
    turns += [(total * share // 6, total - total * share // 6) for total in more for share in (2, 3, 4)]
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
