"""The receiver memory for one sender, with packets lost or delayed at random.

Takes: a channel's law whose packets are independent of each other, the times of sending and of the receiving
ticks.
Gives: `ReceiverMemory`, `memory_of`; `arrives`, `is_memoryless`.
Guarantees: the smallest number of stored values that distinguishes future ticks.
Does not: handle packet contents or receivers (see `mean_dynamics`); support channels with memory (bursts), or
reordered packets that take effect.

A packet sent at s has arrived by a tick at t with probability π(t − s), and then stays in effect unless a
later one arrives. A future tick is therefore described by the value in effect if no more packets were sent.
Each packet enters once, at its sending, with one random arrival time:

    E_t⁺ = I_t q + (1 − I_t) E_t,    E[I_t] = π(t − s),    E[I_t I_u] = π(min(t, u) − s)

Ticks of which all packets sent so far have equal and fully dependent arrivals share one value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF, value_of
from apc.lifting.taylor_models import arithmetic_of, entrywise
from apc.network.channel import LATEST, PARETO_SHAPE, ChannelLaw

Floats = NDArray[np.float64]

# A bad state after which the next is no likelier than after a good one: p + r = 1 up to rounding.
SAME_CHANCE = 1e-15

# Roundings of a probability, relative to 1: those of its law's numbers and of erfc or a power.
CHANCE_ROUNDINGS = 8

# The relative rounding of a quotient of times by a jitter, which is a float.
ROUNDED = 4e-16


@dataclass(frozen=True, slots=True, eq=False)
class ReceiverMemory:
    """The values in effect at ticks of this frame and of later ones; `old` and `chances` by value.

    Value e after all packets of a frame is `old[e]` before the frame, one of `count` stored from earlier
    frames. The packet of slot k replaces it with probability `chances[e, k]`, known within `uncertainties[e,
    k]` and its rounding. Over a cell of m parameters it changes by `moves[:, e, k]` from the center to the
    upper side of each, all probabilities in proportion. `received` is the index of the value in effect at a
    tick (clock, index); `stored` are the indices of the values stored for the next frame, in order.
    """

    old: NDArray[np.intp]  # (n_e,)
    chances: Floats  # (n_e, slots)
    uncertainties: Floats  # (n_e, slots)
    moves: Floats  # (m, n_e, slots)
    received: Mapping[tuple[str, int], int]
    stored: NDArray[np.intp]  # (count,)

    @property
    def count(self) -> int:
        """The number of values stored from frame to frame."""
        return len(self.stored)

    @property
    def slots(self) -> int:
        """The number of packets sent in a frame."""
        return int(self.chances.shape[1])

    def uncertain(self, slot: int) -> NDArray[np.intp]:
        """Return the indices of the values that a slot's packet replaces with a probability between
        0 and 1.
        """
        slot_chances = self.chances[:, slot]
        return np.flatnonzero((slot_chances > 0) & (slot_chances < 1))

    def chance(self, slot: int) -> Floats:
        """Return the probabilities (2 + m, n) with which a slot's packet replaces its uncertain values."""
        index = self.uncertain(slot)
        chances, error_bound = (
            self.chances[index, slot],
            self.uncertainties[index, slot] + CHANCE_ROUNDINGS * UNIT_ROUNDOFF,
        )
        return np.concatenate([np.stack([chances, error_bound]), self.moves[:, index, slot]])

    def replacement_covariance(self, slot: int) -> Floats:
        """Return the covariance (2 + m, n, n) of a slot's packet replacing each of its uncertain values.

        The first entry is the value, the second its error radius, the others its changes over a cell of m
        parameters. A packet that has arrived by an early tick has arrived by a later one: for probabilities π
        and ϖ the covariance is min(π, ϖ) − π ϖ. The smaller probability is the same at all points of the
        cell.
        """
        probabilities = self.chance(slot)
        rows, columns = probabilities[..., :, None], probabilities[..., None, :]
        joint = np.where(value_of(rows) <= value_of(columns), rows, columns)
        return np.asarray(arithmetic_of(joint).subtract(joint, entrywise(rows, columns)))


def is_memoryless(law: ChannelLaw) -> bool:
    """Return whether the packet losses of a channel are independent."""
    return abs(law.p + law.r - 1) <= SAME_CHANCE or law.one_minus_h == law.one_minus_k or law.p == 0


def arrives(law: ChannelLaw, delay: Fraction, elapsed: Fraction, *, strictly: bool = False) -> float:
    """Return the probability that a packet has arrived `elapsed` seconds after its sending.

    Parameters
    ----------
    law
        The channel law, memoryless.
    delay
        The nominal delay in seconds, exact.
    elapsed
        Seconds since the packet was sent.
    strictly
        Whether a simultaneous arrival counts as not arrived.
    """
    most = 1 - law.mean_loss
    if elapsed < 0 or (strictly and elapsed == 0):
        return 0.0
    if not law.jitter:
        return most if elapsed > delay or (elapsed == delay and not strictly) else 0.0
    late = float((elapsed - delay) / Fraction(law.jitter))
    if late >= LATEST[law.distribution] * (1 - ROUNDED):
        return most
    match law.distribution:
        case "uniform":
            share = (late + 1) / 2
        case "normal":
            share = math.erfc(-late / math.sqrt(2)) / 2
        case _:
            offset = PARETO_SHAPE / (PARETO_SHAPE - 1)
            tail = late * 3 / 4 + offset  # as `channel.deviates`, turned around
            share = 1 - tail**-PARETO_SHAPE if tail > 1 else 0.0
    return most * min(max(share, 0.0), 1.0)


def memory_of(
    law: ChannelLaw,
    delay: Fraction,
    sent: Sequence[Fraction],
    ticks: Mapping[tuple[str, int], Fraction],
    frame: Fraction,
    *,
    strictly: bool = False,
    after: bool = False,
    lost: tuple[float, ...] = (0.0,),
) -> ReceiverMemory:
    """Return the receiver memory for one sender.

    Parameters
    ----------
    law, delay
        As for `arrives`.
    sent, ticks
        The sending times within a frame, and the time of each receiving tick (clock, index), in seconds.
    frame
        The length of a frame, in seconds.
    strictly
        Whether a tick misses a simultaneous arrival.
    after
        Whether a packet is sent after the ticks at its instant, which miss it.
    lost
        The error bound of the loss probability; over a cell of parameters, then its changes from the center
        to the upper side of each.
    """
    assert law.trace is None, "recorded delays leave nothing to chance"
    frames_ahead = math.ceil(max(Fraction(law.longest), delay) / frame) + 2
    unit = math.lcm(*(number.denominator for number in (frame, *sent, *ticks.values())))
    length, starts = int(frame * unit), [int(number * unit) for number in reversed(sent)]
    chance: dict[int, float] = {}

    def probabilities(time: int) -> tuple[float, ...]:
        """Return the probability that a tick has received each packet, newest first, of all frames."""
        values = []
        for frames_back in range(frames_ahead + 1):
            for start in starts:
                elapsed = time - start + frames_back * length
                if elapsed not in chance:
                    arrived = arrives(law, delay, Fraction(elapsed, unit), strictly=strictly)
                    chance[elapsed] = 0.0 if after and not elapsed else arrived
                values.append(chance[elapsed])
        return tuple(values)

    slots, instants = len(sent), sorted({int(tick * unit) for tick in ticks.values()})
    keys: dict[tuple[float, ...], int] = {}
    index_by_time: dict[int, int] = {}
    later: list[int] = []
    for number in range(frames_ahead + 1):
        for time in instants:
            index = keys.setdefault(probabilities(time + number * length), len(keys))
            if number:
                later.append(index)
            else:
                index_by_time[time] = index
    numbers = list(dict.fromkeys(later))
    # A stored value is identified by the probabilities of all packets except those of the next frame.
    histories = list(keys)
    number_by_history = {
        histories[index][: len(histories[index]) - slots]: number for number, index in enumerate(numbers)
    }
    old = [number_by_history[key[slots:]] for key in histories]
    chances = np.array([key[:slots][::-1] for key in histories])
    uncertainty, *moves = (value / (1 - law.mean_loss) if value else 0.0 for value in lost)
    return ReceiverMemory(
        old=np.array(old, np.intp),
        chances=chances,
        uncertainties=chances
        * (uncertainty * (1 + 8 * UNIT_ROUNDOFF) + 4 * UNIT_ROUNDOFF * sum(map(abs, moves))),
        moves=np.array([chances * -move for move in moves]).reshape(len(moves), *chances.shape),
        received={tick: index_by_time[int(time * unit)] for tick, time in ticks.items()},
        stored=np.array(numbers, np.intp),
    )
