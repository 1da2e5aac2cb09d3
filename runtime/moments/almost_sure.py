"""How fast a scene settles almost surely: its growth per frame over an endless course of luck, estimated.

Takes: a `CompiledSystem` whose links lose packets, whose receivers hold what they heard last.
Gives: `AlmostSure`, `almost_sure`.
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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from apc.compiler.compiled import CompiledSystem
from apc.eigen.enclosure import enclose_eigenvalues
from apc.frame.instance import Prepared
from apc.frame.radius import RADII, radius_of, value_of
from apc.moments.held import Chance, HeldLoop, every_channel, held_scene

Floats = NDArray[np.float64]

# States of all peers and their channels in one matrix: ten equal peers of the paper's.
MOST_STATES = 180

# Courses, and the frames that count in each. Long ones rather than many: what directions still drift by after
# they settled counts once in each.
COURSES, FRAMES = 64, 16_384

# Parts of a course that go before: for directions to settle, and by which courses differ.
SETTLING, SPREAD = 1 / 16, 1 / 32

# Frames from one look at a norm to the next, in which nothing under- or overflows.
STRIDE = 8

# The quantile of 95 % on both sides together.
QUANTILE = 0.975


@dataclass(frozen=True, slots=True)
class AlmostSure:
    """The exponent per frame (log of the growth), and the 95 % confidence interval it is in."""

    exponent: float
    interval: tuple[float, float]


def almost_sure(system: CompiledSystem, prepared: Prepared, *, seed: int = 0) -> AlmostSure:
    """Estimate a scene's growth per frame over one endless course of luck.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to analyse.
    prepared
        From `instance.prepare`, of this system with any numbers.
    seed
        Of the luck.
    """
    held, chances = every_channel(system, held_scene(system, prepared), MOST_STATES)
    held = held.relative()
    if all(chance.law.mean_loss in (0, 1) for chance in chances):
        return _without_chance(held, chances)
    f, g, s, e = (value_of(values) for values in (held.f, held.g, held.s, held.e))
    n = len(f)
    luck = np.random.Generator(np.random.Philox(seed))
    # Everything lost, and what is heard on top of it.
    both = np.concatenate([f + g @ e, s - e])
    x, weights = luck.standard_normal((n, COURSES)), np.ones((n, 1))
    settling, spread = math.ceil(SETTLING * FRAMES), math.ceil(SPREAD * FRAMES)
    starts = settling + luck.integers(0, spread, COURSES)
    looks = {
        settling,
        *range(0, settling + spread + FRAMES, STRIDE),
        *starts.tolist(),
        *(starts + FRAMES).tolist(),
    }
    total, begun, ended = np.zeros((3, COURSES))
    for frame, heard in enumerate(_heard(chances, len(s), COURSES, settling + spread + FRAMES, luck)):
        if frame in looks:
            if frame == settling:  # a norm in which all coordinates are of one size
                sizes = np.sqrt((x**2).mean(axis=1))
                weights = 1 / np.maximum(sizes, np.finfo(np.float64).eps * sizes.max())[:, None]
            size = np.sqrt(((weights * x) ** 2).sum(axis=0))
            if not size.all():  # nothing is left
                return AlmostSure(-math.inf, (-math.inf, -math.inf))
            x /= size
            total += np.log(size)
            begun = np.where(starts == frame, total, begun)
            ended = np.where(starts + FRAMES == frame, total, ended)
        moved = both @ x
        x = moved[:n] + g @ (moved[n:] * heard)
    values = (ended - begun) / FRAMES
    middle = float(values.mean())
    half = float(stdtrit(COURSES - 1, QUANTILE)) * float(values.std(ddof=1)) / math.sqrt(COURSES)
    return AlmostSure(middle, (middle - half, middle + half))


def _without_chance(held: HeldLoop, chances: Sequence[Chance]) -> AlmostSure:
    """Return the exponent where every channel loses all packets or none: the log of a spectral radius."""
    rows = held.s.copy()
    for chance in chances:
        if chance.law.mean_loss:
            rows[:, list(chance.ears)] = held.e[:, list(chance.ears)]
    matrix = RADII.add(held.f, RADII.multiply(held.g, rows))
    pairs, enclosure = enclose_eigenvalues(value_of(matrix), radius_of(matrix))
    radius = float(np.abs(pairs.values).max(initial=0.0))
    low, middle, high = (
        math.log(item) if item else -math.inf for item in (enclosure.low, radius, enclosure.high)
    )
    return AlmostSure(middle, (min(low, middle), max(middle, high)))


def _heard(
    chances: Sequence[Chance], ears: int, courses: int, frames: int, luck: np.random.Generator
) -> Iterator[Floats]:
    """Give, frame by frame, 1 for each ear and course that hears and 0 where a packet is lost.

    Each channel starts in its stationary state.
    """
    of_ear = np.zeros(ears, np.intp)
    for place, chance in enumerate(chances):
        of_ear[list(chance.ears)] = place
    laws = [chance.law for chance in chances]
    p, r, share = (np.array([[getattr(law, name)] for law in laws]) for name in ("p", "r", "bad"))
    in_bad, in_good = (np.array([[getattr(law, f"one_minus_{name}")] for law in laws]) for name in "hk")
    bad = luck.random((len(laws), courses)) < share
    for _ in range(frames):
        loss, change = luck.random((2, len(laws), courses))
        lost = loss < np.where(bad, in_bad, in_good)
        bad = np.where(bad, change >= r, change < p)
        yield (~lost)[of_ear].astype(np.float64)
