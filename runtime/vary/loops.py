"""Loops with long delays over values of some parameters: their sites' frames, without a packet.

Takes: a `CompiledSystem` and what varies.
Gives: `LoopEvaluator`, `loop_evaluator`, `LoopSheet`; `proved_in_loop`.
Guarantees: nothing here grows with the length of a delay.
Does not: build a matrix of a whole system (see `batch`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.eigen.bordered import Logarithm, Wires, bordered, logarithm, side_by_side, wires_of
from apc.eigen.closing import Loop, without_packets
from apc.eigen.peer_group import PeerGroup
from apc.eigen.rigid import find_rigid_modes
from apc.frame.exchange import Exchange
from apc.frame.lift import FrameMap
from apc.frame.names import Free
from apc.large.determinant_spectrum import frequency_of
from apc.vary.batch import STEP, BatchEvaluator, batch_evaluator, lifted_here
from apc.vary.bracket import Bracket
from apc.vary.counting import bracket_of_loop
from apc.vary.crossings import Root, Scan
from apc.vary.plane import cross, over_all
from apc.vary.wiring import site_key

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class LoopEvaluator:
    """The loops of a scene over its free parameters.

    `family` gives the maps of the sites, and has no matrix. `wires` are those of each loop, and `rigid` how
    often 1 is an eigenvalue of it at every value.
    """

    family: BatchEvaluator
    loops: tuple[Loop, ...]
    wires: tuple[Wires, ...]
    rigid: tuple[int, ...]

    def maps(self, place: int, values: Floats, along: Floats) -> tuple[FrameMap, FrameMap]:
        """Return a loop's sites as one, at values (k, m), and the derivatives along directions (k, m)."""
        lifted = self.family.lifted(values + (STEP * 1j) * along)
        both = side_by_side([lifted[site_key(group)] for group in self.loops[place].sites])

        def whole(block: Complexes) -> Complexes:
            return np.broadcast_to(block, (len(values), *block.shape[-2:]))

        return both.mapped(lambda one: whole(one).real), both.mapped(lambda one: whole(one).imag / STEP)

    def slopes(self, values: Floats, along: Floats) -> list[tuple[Floats, Floats]]:
        """Return each loop's matrices (k, n, n) without its delays, and their derivatives along (k, m)."""
        found = []
        for place, wires in enumerate(self.wires):
            maps, slopes = self.maps(place, values, along)
            both = maps.mapped(lambda one, slope: one + (STEP * 1j) * slope, slopes)
            weight = wires.weights.sum(axis=0)
            sent = np.linalg.solve(np.eye(both.s.shape[-2]) - both.d @ weight, both.s)
            matrix = both.p + both.q @ (weight @ sent)
            found.append((matrix.real.copy(), matrix.imag / STEP))
        return found

    def scan(self, points: Floats, least: float, base: Floats, column: int, *, first: bool = False) -> Scan:
        """Find the crossings along a line, see `plane.cross`.

        Parameters
        ----------
        points, least, first
            As there.
        base, column
            Where the line is (m,), and which of the parameters varies along it.
        """
        sheets = [LoopSheet(self, place, base, column) for place in range(len(self.loops))]
        return cross(sheets, points, least, first=first)

    def proved(
        self, root: Root, point: Callable[[float], Sequence[float]], *, low: float, high: float
    ) -> tuple[Bracket | None, float]:
        """Return a bracket of a root on a line, if one is found, and the frequency there in Hz.

        Parameters
        ----------
        root
            The root.
        point
            Gives the point (m,) of a value.
        low, high
            No bracket reaches beyond these.
        """
        loops = functools.cache(lambda value: self.loop_at(point(value), root.system))
        return proved_in_loop(root, loops, self.rigid[root.system], low=low, high=high)

    def loop_at(self, value: Sequence[float], place: int) -> Loop:
        """Return a loop at one point (m,), its sites lifted with bounds on their errors."""
        return lifted_here(self.family.with_sites([self.loops[place]], value))[0]


def proved_in_loop(
    root: Root, loops: Callable[[float], Loop], rigid: int, *, low: float, high: float
) -> tuple[Bracket | None, float]:
    """Return a bracket of a root of a loop, if one is found, and the frequency there in Hz.

    Parameters
    ----------
    root, loops, rigid, low, high
        As for `counting.bracket_of_loop`.
    """
    held = bracket_of_loop(root, loops, rigid, low=low, high=high)
    return held, frequency_of(loops(root.value), root.eigenvalue)


@dataclass(frozen=True, slots=True, eq=False)
class LoopSheet:
    """One loop of an evaluator along a line through its values: a `plane.LineSheet`."""

    evaluator: LoopEvaluator
    place: int
    base: Floats
    column: int

    @property
    def states(self) -> int:
        """How many zeros it has, less what its packets make of them."""
        return sum(group.lifted.p.shape[-1] for group in self.evaluator.loops[self.place].sites)

    @property
    def longest(self) -> int:
        """The longest delay in frames."""
        return max(self.evaluator.wires[self.place].lags, default=0)

    def at(self, values: Floats, rows: Integers, points: Complexes) -> Logarithm:
        """Return the logarithm of F at points (z,), each at the value (k,) of its row (z,)."""
        along = np.zeros((len(values), len(self.base)))
        along[:, self.column] = 1.0
        level = np.repeat(self.base[None], len(values), axis=0)
        level[:, self.column] = values
        maps, slopes = self.evaluator.maps(self.place, level, along)
        wires, rigid = self.evaluator.wires[self.place], self.evaluator.rigid[self.place]
        loops, moved = bordered(maps, wires.weights), bordered(slopes, wires.weights, unit=0.0)
        return logarithm(loops, moved, np.array(wires.lags, dtype=np.intp), rows, points, rigid)

    def over(self, values: Floats, points: Complexes) -> Logarithm:
        """Return the logarithm of F (k, z) at all values (k,) and points (z,)."""
        return over_all(self, values, points)

    def alone(self, values: Floats) -> Complexes:
        """Return the eigenvalues (k, n) of sites hearing nothing at values (k,), NaN at one of no meaning."""
        level = np.repeat(self.base[None], len(values), axis=0)
        level[:, self.column] = values
        maps, _ = self.evaluator.maps(self.place, level, np.zeros(level.shape))
        found = np.full(maps.p.shape[:-1], np.nan, np.complex128)
        sound = np.isfinite(maps.p).all(axis=(1, 2))
        found[sound] = np.linalg.eigvals(maps.p[sound])
        return found


def loop_evaluator(
    system: CompiledSystem,
    free: Sequence[Free],
    groups: Sequence[PeerGroup],
    loops: Sequence[Loop],
    exchange: Exchange,
) -> LoopEvaluator:
    """Prepare loops for many values of some parameters.

    Parameters
    ----------
    system
        The compiled scene.
    free
        The parameters that vary.
    groups, loops, exchange
        The scene's peers at a point that stands for all, from `analysis.lifted_groups`, and their loops.
    """
    return LoopEvaluator(
        family=batch_evaluator(system, free, groups, exchange, matrices=False),
        loops=tuple(loops),
        wires=tuple(wires_of(loop.sites, loop.coupling, loop.doubts) for loop in loops),
        rigid=tuple(
            find_rigid_modes(without_packets(loop), with_drifts=False).directions.shape[1] for loop in loops
        ),
    )
