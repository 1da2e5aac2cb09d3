"""Whether a scene is stable for every delay of its links in a range: all whole numbers of frames at once.

Takes: a `CompiledSystem` and a parameter or timing that reaches nothing but how late packets are.
Gives: `LateStretch`, `late_stretches`.
Guarantees: stretches join on without a gap; within one, nothing depends on the delay.
Does not: vary what is held late, or what a force depends on (see `delays`).

Packets that are a frame later are heard as those were, a frame of theirs older: the sites' frames are the
same, and only the exponents of ζ differ. One lifting serves for all delays that differ by whole frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.bordered import Bordered, Logarithm, bordered, logarithm, side_by_side, wires_of
from apc.eigen.closing import Loop, without_packets
from apc.eigen.modes import arrange
from apc.eigen.rigid import find_rigid_modes
from apc.frame.names import Free
from apc.frame.parameters import resolve
from apc.vary.delays import INSIDE, system_with_delay, timing_slopes
from apc.vary.plane import count_beyond

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]

# Delays of one lifting that are looked at together: the longest at most so many times the shortest.
OCTAVE = 2


@dataclass(frozen=True, slots=True)
class LateStretch:
    """Delays between `low` and `high` seconds; `stable` is None where an eigenvalue is on the circle."""

    low: Fraction
    high: Fraction
    stable: bool | None


@dataclass(frozen=True, slots=True, eq=False)
class _LateSheet:
    """A loop whose packets are some frames later, the values: a `plane.Sheet`.

    `lags` (l,) are those of the packets when they are not, `late` (l,) says which of them are.
    """

    loop: Bordered
    lags: Integers
    late: Integers
    rigid: int
    longest: int

    @property
    def states(self) -> int:
        """How many zeros it has, less what its packets make of them."""
        return self.loop.states

    def at(self, values: Floats, rows: Integers, points: Complexes) -> Logarithm:
        """Return the logarithm of F at points (z,), each so many frames late as the value (k,) of its row."""
        lags = self.lags + values[rows, None].astype(np.int64) * self.late
        return logarithm(self.loop, None, lags, np.zeros(len(rows), dtype=np.intp), points, self.rigid)

    def over(self, values: Floats, points: Complexes) -> Logarithm:
        """Return the logarithm of F (k, z) at all values (k,) and points (z,).

        M = A + ζ^(−m) [0 B] when packets are m frames late: det M = det A det(1 + ζ^(−m) K), K the rows of
        A⁻¹ B over what is sent.
        """
        loop, n_z = self.loop, self.loop.states
        n, n_s = loop.fixed.shape[-1], loop.fixed.shape[-1] - n_z
        place = np.arange(n_z)
        prompt, turned = np.zeros((2, len(points), n, n), np.complex128)
        late, late_turned = np.zeros((2, len(points), n, n_s), np.complex128)
        prompt += loop.fixed[0]
        prompt[:, place, place] += points[:, None]
        turned[:, place, place] = 1j * points[:, None]
        for lag, is_late, heard in zip(self.lags.tolist(), self.late.tolist(), loop.heard[:, 0], strict=True):
            part = points[:, None, None] ** -lag * heard
            (late if is_late else prompt[:, :, n_z:])[...] += part
            (late_turned if is_late else turned[:, :, n_z:])[...] -= 1j * lag * part
        sign, size = np.linalg.slogdet(prompt)
        inverse = np.linalg.inv(prompt)
        sent = inverse @ late
        back = sent[:, n_z:]
        back_turned = inverse[:, n_z:] @ (late_turned - turned @ sent)
        base = size + 1j * np.angle(sign) - self.rigid * np.log(1 - 1 / points)
        slope = np.einsum("zij,zji->z", inverse, turned) - self.rigid * 1j / (points - 1)
        value, turning = np.zeros((2, len(values), len(points)), np.complex128)
        for row, frames in enumerate(values.tolist()):
            power = points[:, None, None] ** -int(frames)
            matrix = np.eye(n_s) + power * back
            moved = power * (back_turned - 1j * frames * back)
            sign, size = np.linalg.slogdet(matrix)
            value[row] = base + size + 1j * np.angle(sign)
            turning[row] = slope + np.trace(np.linalg.solve(matrix, moved), axis1=1, axis2=2)
        return Logarithm(value, turning, np.zeros_like(value))


def late_stretches(
    system: CompiledSystem,
    free: Free,
    low: Fraction,
    high: Fraction,
    prepared: Prepared,
    following: Callable[[Fraction], Fraction],
) -> list[LateStretch] | None:
    """Return the stretches of a range and whether each is stable, None where more than lags may change.

    Parameters
    ----------
    system, free
        The compiled scene and what varies.
    low, high
        Between which values.
    prepared
        From `analysis.prepare`; all sites as their parameters say.
    following
        From `delays.borders`.
    """
    step = _whole_frame(system, free, prepared)
    if step is None:
        return None
    borders = [low]
    while borders[-1] < high:
        borders.append(following(borders[-1]))
    pieces = list(itertools.pairwise(borders))
    alike: dict[tuple[Fraction, Fraction], list[int]] = {}
    for place, (start, end) in enumerate(pieces):
        alike.setdefault((start % step, end - start), []).append(place)
    stable: dict[int, bool | None] = {}
    for (start, width), places in alike.items():
        inside = system_with_delay(system, free, start + INSIDE[0] * width)
        loops = arrange(*lifted_groups(inside, prepared=prepared)).loops
        frames = np.array([int(pieces[place][0] // step) for place in places], dtype=np.float64)
        beyond = sum(_beyond(loop, _moving(system, free), frames) for loop in loops)
        for place, count in zip(places, np.broadcast_to(beyond, frames.shape).tolist(), strict=True):
            stable[place] = None if np.isnan(count) else count == 0
    return [LateStretch(*piece, stable[place]) for place, piece in enumerate(pieces)]


def _moving(system: CompiledSystem, free: Free) -> frozenset[str]:
    """Return the timings that follow what varies."""
    return frozenset(name for name, slope in timing_slopes(system, free).items() if slope)


def _whole_frame(system: CompiledSystem, free: Free, prepared: Prepared) -> Fraction | None:
    """Return by how much a value makes packets a frame later, None where it does more than that, or less."""
    slopes = timing_slopes(system, free)
    moving = {name for name, slope in slopes.items() if slope}
    held = {hold.delay for kind in system.kinds for hold in kind.holds}
    if moving & held or len({slopes[name] for name in moving}) != 1:
        return None
    (slope,) = {slopes[name] for name in moving}
    if slope < 0:
        return None
    here, there = (
        resolve(system_with_delay(system, free, value)).parameters for value in (Fraction(1), Fraction(2))
    )
    if not all(np.array_equal(*pair) for pair in zip(here, there, strict=True)):
        return None
    return prepared.schedules[0].frame_s / slope


def _beyond(loop: Loop, moving: frozenset[str], frames: Floats) -> Floats:
    """Return how many eigenvalues of a loop are beyond the circle when packets are some frames later (k,)."""
    kept = [
        frozenset(way for way in loop.coupling if (way.delay in moving) == late) for late in (False, True)
    ]
    parts = [wires_of(loop.sites, loop.coupling, loop.doubts, only=ways.__contains__) for ways in kept]
    lags = np.array([lag for part in parts for lag in part.lags], dtype=np.intp)
    late = np.repeat([0, 1], [len(part.lags) for part in parts])
    maps = side_by_side([group.lifted for group in loop.sites]).mapped(lambda one: one[None])
    matrix = bordered(maps, np.concatenate([part.weights for part in parts]))
    rigid = find_rigid_modes(without_packets(loop)).directions.shape[1]
    found = np.zeros(len(frames))
    left = np.ones(len(frames), dtype=bool)
    while left.any():
        most = float(frames[left].max())
        some = left & (frames * OCTAVE >= most)
        longest = int(max((lags + late * int(most)).max(initial=0), 0))
        sheet = _LateSheet(matrix, lags, late, rigid, longest)
        found[some] = count_beyond(sheet, frames[some])
        left &= ~some
    return found
