"""What a receiver goes on with of one sender, when packets get lost or come late by chance.

Takes: a channel's law whose packets are independent of each other, when packets are sent and ticks hear.
Gives: `ReceiverMemory`, `memory_of`; `arrives`, `is_memoryless`.
Guarantees: as few numbers from frame to frame as ticks still to come can differ in.
Does not: know what is sent, or who hears it (see `mean_loops`); serve states that last (bursts), or a packet
that is overtaken and counts all the same.

Of a packet sent at s a tick at t has heard with probability π(t − s), and then goes on with it unless a later
one is heard. So a tick to come is described by the value it would hear if nothing more were sent, and each
packet enters once, when it is sent, with one draw of when it arrives:

    E_t⁺ = I_t q + (1 − I_t) E_t,    E[I_t] = π(t − s),    E[I_t I_u] = π(min(t, u) − s)

Ticks of which all packets sent so far are equally likely to be heard, and together, share one value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.frame.radius import UNIT, value_of
from apc.frame.taylor import arithmetic_of, entrywise
from apc.network.channel import LATEST, PARETO_SHAPE, ChannelLaw

Floats = NDArray[np.float64]

# A bad state after which the next is no likelier than after a good one: p + r = 1 up to rounding.
SAME_CHANCE = 1e-15

# Roundings of a probability, relative to 1: those of its law's numbers and of erfc or a power.
CHANCE_ROUNDINGS = 8

# Of a quotient of times by a jitter, which is a float: the latest packets of a table arrive all at once.
ROUNDED = 4e-16


@dataclass(frozen=True, slots=True, eq=False)
class ReceiverMemory:
    """The values that ticks hear: of this frame, and of those to come, `old` and `chances` by value.

    Value e of those there are once all packets of a frame are sent was `old[e]` before it, one of `count`
    kept from the frames before; slot k's packet takes its place with probability `chances[e, k]`, known to
    within `doubts[e, k]` and its rounding; over a cell of m parameters it moves by `moves[:, e, k]` from the
    middle to the upper side of each, all chances by the same share of them. `heard` says which value a tick
    (clock, index) hears; `kept` which values are kept for the next frame, in order.
    """

    old: NDArray[np.intp]  # (n_e,)
    chances: Floats  # (n_e, slots)
    doubts: Floats  # (n_e, slots)
    moves: Floats  # (m, n_e, slots)
    heard: Mapping[tuple[str, int], int]
    kept: NDArray[np.intp]  # (count,)

    @property
    def count(self) -> int:
        """How many values are kept from frame to frame."""
        return len(self.kept)

    @property
    def slots(self) -> int:
        """How many packets are sent in a frame."""
        return int(self.chances.shape[1])

    def uncertain(self, slot: int) -> NDArray[np.intp]:
        """Return the values of which it is open whether a slot's packet takes their place."""
        own = self.chances[:, slot]
        return np.flatnonzero((own > 0) & (own < 1))

    def chance(self, slot: int) -> Floats:
        """Return the chances (2 + m, n) of a slot's uncertain values, with their radii and over a cell."""
        place = self.uncertain(slot)
        own, off = self.chances[place, slot], self.doubts[place, slot] + CHANCE_ROUNDINGS * UNIT
        return np.concatenate([np.stack([own, off]), self.moves[:, place, slot]])

    def spread(self, slot: int) -> Floats:
        """Return the covariance (2 + m, n, n) of whether a slot's packet takes the place of uncertain values.

        With its radius, and over a cell: min(π, ϖ) − π ϖ of two chances, which one is the smaller being the
        same all over the cell.
        """
        chance = self.chance(slot)
        rows, columns = chance[..., :, None], chance[..., None, :]
        least = np.where(value_of(rows) <= value_of(columns), rows, columns)
        return np.asarray(arithmetic_of(least).subtract(least, entrywise(rows, columns)))


def is_memoryless(law: ChannelLaw) -> bool:
    """Say whether packets get lost independently of each other."""
    return abs(law.p + law.r - 1) <= SAME_CHANCE or law.one_minus_h == law.one_minus_k or law.p == 0


def arrives(law: ChannelLaw, delay: Fraction, elapsed: Fraction, *, strictly: bool = False) -> float:
    """Return the probability that a packet has arrived so many seconds after it was sent.

    Parameters
    ----------
    law
        The channel's, memoryless.
    delay
        Its nominal delay in seconds, exactly.
    elapsed
        Seconds since it was sent.
    strictly
        Whether what arrives just then counts as not arrived.
    """
    kept = 1 - law.mean_loss
    if elapsed < 0 or (strictly and elapsed == 0):
        return 0.0
    if not law.jitter:
        return kept if elapsed > delay or (elapsed == delay and not strictly) else 0.0
    late = float((elapsed - delay) / Fraction(law.jitter))
    if late >= LATEST[law.distribution] * (1 - ROUNDED):
        return kept
    match law.distribution:
        case "uniform":
            share = (late + 1) / 2
        case "normal":
            share = math.erfc(-late / math.sqrt(2)) / 2
        case _:
            offset = PARETO_SHAPE / (PARETO_SHAPE - 1)
            tail = late * 3 / 4 + offset  # as `channel.deviates`, turned around
            share = 1 - tail**-PARETO_SHAPE if tail > 1 else 0.0
    return kept * min(max(share, 0.0), 1.0)


def memory_of(
    law: ChannelLaw,
    delay: Fraction,
    sent: Sequence[Fraction],
    ticks: Mapping[tuple[str, int], Fraction],
    frame: Fraction,
    *,
    strictly: bool = False,
    lost: tuple[float, ...] = (0.0,),
) -> ReceiverMemory:
    """Describe what ticks hear of one sender.

    Parameters
    ----------
    law, delay
        As for `arrives`.
    sent, ticks
        When packets are sent in a frame, and when each tick (clock, index) that hears is, in seconds.
    frame
        The length of a frame, in seconds.
    strictly
        Whether a tick misses what arrives just then.
    lost
        How far the share of packets that get lost may be off; over a cell of parameters, after it, how much
        it changes from the middle to the upper side of each.
    """
    assert law.trace is None, "recorded delays leave nothing to chance"
    ahead = math.ceil(max(Fraction(law.longest), delay) / frame) + 2
    unit = math.lcm(*(number.denominator for number in (frame, *sent, *ticks.values())))
    length, starts = int(frame * unit), [int(number * unit) for number in reversed(sent)]
    chance: dict[int, float] = {}

    def described(time: int) -> tuple[float, ...]:
        """Return how likely a tick hears each packet, the newest first, of this frame and those before."""
        values = []
        for back in range(ahead + 1):
            for start in starts:
                elapsed = time - start + back * length
                if elapsed not in chance:
                    chance[elapsed] = arrives(law, delay, Fraction(elapsed, unit), strictly=strictly)
                values.append(chance[elapsed])
        return tuple(values)

    slots, instants = len(sent), sorted({int(tick * unit) for tick in ticks.values()})
    keys: dict[tuple[float, ...], int] = {}
    of_time: dict[int, int] = {}
    later: list[int] = []
    for number in range(ahead + 1):
        for time in instants:
            place = keys.setdefault(described(time + number * length), len(keys))
            if number:
                later.append(place)
            else:
                of_time[time] = place
    numbers = list(dict.fromkeys(later))
    # A value kept is called by what is known of it a frame later: of no packet of that frame yet.
    listed = list(keys)
    known = {listed[place][: len(listed[place]) - slots]: number for number, place in enumerate(numbers)}
    old = [known[key[slots:]] for key in listed]
    chances = np.array([key[:slots][::-1] for key in listed])
    doubt, *moves = (value / (1 - law.mean_loss) if value else 0.0 for value in lost)
    return ReceiverMemory(
        old=np.array(old, np.intp),
        chances=chances,
        doubts=chances * (doubt * (1 + 8 * UNIT) + 4 * UNIT * sum(map(abs, moves))),
        moves=np.array([chances * -move for move in moves]).reshape(len(moves), *chances.shape),
        heard={tick: of_time[int(time * unit)] for tick, time in ticks.items()},
        kept=np.array(numbers, np.intp),
    )
