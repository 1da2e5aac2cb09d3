"""How fast a scene settles almost surely: its growth per frame over an endless course of luck, estimated.

Takes: a `CompiledSystem` whose links lose packets, whose receivers hold what they heard last.
Gives: `AlmostSure`, `almost_sure`, `unplayed`; `every_channel`, `Chance`, `exponent`.
Guarantees: equal seeds give equal numbers. The interval is of independent courses, each of which begins and
ends at a frame of its own once directions have settled, so that it holds what a norm's choice makes of both
ends, O(1/T).
Does not: prove; play more peers than fit in one matrix.

With x_T = A_T ⋯ A_1 x_0 the exponent is lim log‖x_T‖ / T, the same for almost all luck (Furstenberg and
Kesten, 1960). Where directions x/‖x‖ are distributed as they will stay, the mean of log‖x_{k+1}‖ − log‖x_k‖
is the exponent itself, at every k and in any norm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import Loop
from apc.eigen.enclosure import enclose_eigenvalues
from apc.eigen.modes import dense_loop
from apc.frame.radius import RADII, radius_of, value_of
from apc.moments.held import Ear, HeldLoop, held_loop, held_scene, lossy_rows
from apc.moments.memory import is_memoryless
from apc.network.channel import ChannelLaw, channel_law

Floats = NDArray[np.float64]

# States of all peers and their channels in one matrix: ten equal peers of the paper's.
MOST_STATES = 180

# Courses, and the frames that count in each. Long ones rather than many: what directions still drift by after
# they settled counts once in each.
COURSES, FRAMES = 64, 16_384

# Parts of a course that go before: for directions to settle, and by which courses differ.
SETTLING, APART = 1 / 16, 1 / 32

# Frames from one look at a norm to the next, in which nothing under- or overflows.
STRIDE = 8

# Frames whose luck is drawn at once.
BATCH = 32

# The normal distribution's quantile for 95 % on both sides together.
NORMAL = 1.959963984540054


@dataclass(frozen=True, slots=True)
class AlmostSure:
    """The exponent per frame (log of the growth), and the 95 % confidence interval it is in."""

    exponent: float
    interval: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Chance:
    """What channels lose: by which `law` the ears `ears` of one way from peer to peer do, all together."""

    law: ChannelLaw
    ears: tuple[int, ...]


def unplayed(system: CompiledSystem, prepared: Prepared) -> str:
    """Say why a scene's exponent is not estimated, "" where it is.

    Parameters
    ----------
    system, prepared
        As for `almost_sure`.
    """
    found = every_channel(system, prepared)
    return found if isinstance(found, str) else ""


def almost_sure(system: CompiledSystem, prepared: Prepared, *, seed: int = 0) -> AlmostSure | None:
    """Estimate a scene's growth per frame over one endless course of luck, None where it is `unplayed`.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `analysis.prepare`, of this system with any numbers.
    seed
        Of the luck.
    """
    found = every_channel(system, prepared)
    return None if isinstance(found, str) else exponent(*found, seed=seed)


def every_channel(system: CompiledSystem, prepared: Prepared) -> tuple[HeldLoop, list[Chance]] | str:
    """Put a whole scene in one loop, every channel by itself, or say why not.

    Parameters
    ----------
    system, prepared
        As for `almost_sure`.
    """
    scene = held_scene(system, prepared)
    if isinstance(scene, str):
        return scene
    peers = scene.exchange.peers
    if peers > MOST_STATES:
        return f"{peers:,} peers don't fit in one matrix of {MOST_STATES} states"
    loop = dense_loop(scene.groups, scene.exchange)
    ears, ways = _ears(loop, scene.lossy)
    states = sum(len(site.lifted.z_names) for site in loop.sites) + len(ears)
    if states > MOST_STATES:
        return f"{peers:,} peers and their channels have {states:,} states, and {MOST_STATES} are the most"
    held = held_loop(loop, ears, scene.lossy)
    if held is None:
        return "a packet follows from another one of its frame"
    of_way: dict[tuple[str, int, int], list[int]] = {}
    for place, way in enumerate(ways):
        of_way.setdefault(way, []).append(place)
    timings = {timing.name: timing.value for timing in system.timings}
    laws = {
        link.name: channel_law(system, link, timings[link.delay])
        for link in system.links
        if link.channel is not None
    }
    return held, [Chance(laws[link], tuple(places)) for (link, *_), places in of_way.items()]


def _ears(loop: Loop, lossy: frozenset[str]) -> tuple[list[Ear], list[tuple[str, int, int]]]:
    """Return an ear for each number that a peer hears of another one, and its (link, receiver, sender)."""
    ears, ways = [], []
    for g, receiver in enumerate(loop.sites):
        rows = lossy_rows(receiver, lossy)
        for h, sender in enumerate(loop.sites):
            for row, sent in enumerate(sender.schedule.sent):
                weights = {
                    (g, line): loop.coupling[one.way][g][h]
                    for line, one in rows
                    if one.sent == sent and loop.coupling[one.way][g][h]
                }
                if weights:
                    ears.append(Ear(weights, h, row))
                    ways.append((sent.link, g, h))
    return ears, ways


def exponent(
    held: HeldLoop,
    chances: Sequence[Chance],
    *,
    seed: int = 0,
    courses: int = COURSES,
    frames: int = FRAMES,
) -> AlmostSure:
    """Estimate what a loop grows by in a frame, almost surely, its channels losing packets by chance.

    Parameters
    ----------
    held
        The loop.
    chances
        Which of its ears lose packets together, and by what law.
    seed
        Of the luck.
    courses, frames
        How many independent courses, and how many frames of each count.
    """
    if all(chance.law.mean_loss in (0, 1) for chance in chances):
        return _without_chance(held, chances)
    f, g, s, e = (value_of(one) for one in (held.f, held.g, held.s, held.e))
    n = len(f)
    luck = np.random.Generator(np.random.Philox(seed))
    draws = _Losses(chances, len(s), courses, luck)
    # Everything lost, and what is heard on top of it.
    both = np.concatenate([f + g @ e, s - e])
    x, weights = luck.standard_normal((n, courses)), np.ones((n, 1))
    settling, apart = math.ceil(SETTLING * frames), math.ceil(APART * frames)
    starts = settling + luck.integers(0, apart, courses)
    looks = {
        settling,
        *range(0, settling + apart + frames, STRIDE),
        *starts.tolist(),
        *(starts + frames).tolist(),
    }
    total, begun, ended = np.zeros(courses), np.zeros(courses), np.zeros(courses)
    for frame, heard in enumerate(draws.take(settling + apart + frames)):
        if frame in looks:
            if frame == settling:  # a norm in which all coordinates are of one size
                spread = np.sqrt((x**2).mean(axis=1))
                weights = 1 / np.maximum(spread, np.finfo(np.float64).eps * spread.max())[:, None]
            size = np.sqrt(((weights * x) ** 2).sum(axis=0))
            if not size.all():  # nothing is left
                return AlmostSure(-math.inf, (-math.inf, -math.inf))
            x /= size
            total += np.log(size)
            begun = np.where(starts == frame, total, begun)
            ended = np.where(starts + frames == frame, total, ended)
        moved = both @ x
        x = moved[:n] + g @ (moved[n:] * heard)
    found = (ended - begun) / frames
    middle = float(found.mean())
    half = _quantile(courses - 1) * float(found.std(ddof=1)) / math.sqrt(courses)
    return AlmostSure(middle, (middle - half, middle + half))


def _without_chance(held: HeldLoop, chances: Sequence[Chance]) -> AlmostSure:
    """Return the exponent where every channel loses all packets or none: the log of a spectral radius."""
    rows = held.s.copy()
    for chance in chances:
        if chance.law.mean_loss:
            rows[:, list(chance.ears)] = held.e[:, list(chance.ears)]
    matrix = RADII.add(held.f, RADII.multiply(held.g, rows))
    pairs, found = enclose_eigenvalues(value_of(matrix), radius_of(matrix))
    radius = float(np.abs(pairs.values).max(initial=0.0))
    low, middle, high = (math.log(one) if one else -math.inf for one in (found.low, radius, found.high))
    return AlmostSure(middle, (min(low, middle), max(middle, high)))


class _Losses:
    """The packets of some channels, frame by frame: which are heard, in many courses at once."""

    def __init__(self, chances: Sequence[Chance], ears: int, courses: int, luck: np.random.Generator) -> None:
        """Start in each channel's stationary state.

        Parameters
        ----------
        chances
            What each way from peer to peer loses.
        ears
            How many ears there are.
        courses
            How many courses.
        luck
            Gives the numbers to draw.
        """
        self._luck, self._shape = luck, (len(chances), courses)
        self._of_ear = np.zeros(ears, np.intp)
        for place, chance in enumerate(chances):
            self._of_ear[list(chance.ears)] = place
        self._bursts = any(not is_memoryless(chance.law) for chance in chances)

        def column(of: Callable[[ChannelLaw], float]) -> Floats:
            return np.array([of(chance.law) for chance in chances]).reshape(-1, 1)

        self._mean = column(lambda law: law.mean_loss)
        self._p, self._r = column(lambda law: law.p), column(lambda law: law.r)
        self._in_bad, self._in_good = column(lambda law: law.one_minus_h), column(lambda law: law.one_minus_k)
        if self._bursts:
            self._bad = luck.random(self._shape) < column(lambda law: law.bad)

    def take(self, count: int) -> Iterator[Floats]:
        """Give, frame by frame, 1 for each ear and course that hears and 0 where a packet is lost."""
        for first in range(0, count, BATCH):
            drawn = self._luck.random((min(BATCH, count - first), 1 + self._bursts, *self._shape))
            if not self._bursts:
                yield from (drawn[:, 0] >= self._mean)[:, self._of_ear].astype(np.float64)
                continue
            for loss, change in drawn:
                lost = loss < np.where(self._bad, self._in_bad, self._in_good)
                self._bad = np.where(self._bad, change >= self._r, change < self._p)
                yield (~lost)[self._of_ear].astype(np.float64)


def _quantile(freedom: int) -> float:
    """Return Student's quantile for 95 % on both sides, of ten or more (Abramowitz and Stegun, 26.7.5)."""
    z = NORMAL
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
