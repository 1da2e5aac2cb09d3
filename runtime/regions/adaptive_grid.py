"""Location of a boundary in a rectangle: a grid, refined where it may hide a component.

Takes: a function that returns the logarithms of the largest eigenvalue magnitudes at many points of the unit
square at once.
Gives: `Survey`, `survey`; `just_inside`; `blurred`.
Guarantees: every cell whose corners disagree, and every cell that could, by the second differences measured
around it, hide a component, is divided, all cells of a level as one batch, down to the finest size; every
crossing of a cell's edge is linked to the one that follows it with the stable side on its left.
Does not: find a component that lies inside one cell and leaves no trace in the values around it, nor locate a
crossing on its edge (see `boundary`).

Between the corners of a cell of size h a smooth g differs from its bilinear interpolant by at most ½ (D_x
s(1−s) + D_y t(1−t)), 0 ≤ s, t ≤ 1, where D_x = h² max|g_xx|; second differences approximate D_x, D_y.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

Floats = NDArray[np.float64]
Node = tuple[int, int]  # lattice coordinates
Edge = tuple[Node, Node]  # the stable node first

# Measured second differences are multiplied by this before they count as bounds: the third derivative may
# raise them between the samples.
CAUTION = 1.5

# Signs at the edges of the rectangle are evaluated at this distance inside: at a stiffness of exactly zero, a
# neutral mode has the eigenvalue 1, which is unrelated to nearby points.
INSIDE_RIM = 1e-9

# A magnitude nearer to 1 than this has no sign: far above the rounding of a few dozen states.
UNSURE = 1e-11

# The distance inside a cell at which its envelope is evaluated.
_INNER = np.array([0.125, 0.375, 0.625, 0.875])

# A cell is divided into four until its corners determine the boundary within it; the finest is this many
# halvings of the coarse cell.
HALVINGS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """The crossings and their order, the stable side on the left.

    A crossing is a stretch of a cell's edge from a `stable` to an `unstable` point (k, 2); `log_radius` (k,
    2) is the log of the spectral radius at both. `chains` are lists of crossings by number, `closed` is
    whether each returns to its first. `corners` is the stability of the rectangle's corners (0, 0), (1, 0),
    (0, 1), (1, 1). `cell` is the side of the coarse cells, `finest` that of the smallest cells evaluated.
    """

    stable: Floats
    unstable: Floats
    log_radius: Floats
    chains: tuple[tuple[int, ...], ...]
    closed: tuple[bool, ...]
    corners: tuple[bool, bool, bool, bool]
    cell: float
    finest: float


def blurred() -> ApcError:
    """Return the refusal of a boundary that rounding puts anywhere."""
    message = "in part of the rectangle some motion neither grows nor dies out, as far as floats can tell"
    return ApcError(
        Diagnostic("E905", SourceLocation("region"), message, hint="some damping, or wider ranges")
    )


def survey(log_magnitudes: Callable[[Floats], Floats], *, cells: int) -> Survey:
    """Find the crossings of the boundary with the cells' edges, and link them.

    Parameters
    ----------
    log_magnitudes
        The logarithms (k, m) of the m largest magnitudes at points (k, 2), descending.
    cells
        Coarse cells along each side.

    Raises
    ------
    ApcError
        E905 a coarse cell in which the largest magnitude is 1 to rounding: signs would be noise there.
    """
    lattice = _Lattice(log_magnitudes, cells)
    step = 2**HALVINGS
    axis = np.arange(cells + 1) * step
    grid = lattice.sample([(int(i), int(j)) for j in axis for i in axis]).reshape(cells + 1, cells + 1, -1)
    unsure = np.abs(grid[..., 0]) <= UNSURE
    if (unsure[1:, 1:] & unsure[1:, :-1] & unsure[:-1, 1:] & unsure[:-1, :-1]).any():
        raise blurred()
    suspect = _suspect(grid[None])[0]
    leaves = {(int(i) * step, int(j) * step): step for j, i in np.argwhere(~suspect)}
    divided = [(int(i) * step, int(j) * step, step) for j, i in np.argwhere(suspect)]
    while True:
        while divided:
            leaves, divided = _divide(lattice, leaves, divided)
        changes = {corner: _changes(lattice, corner, size) for corner, size in leaves.items()}
        # A cell that more than one piece of the boundary crosses is divided, if it can be.
        tangled = [corner for corner, size in leaves.items() if size > 1 and len(changes[corner]) > 2]
        if not tangled:
            return _linked(lattice, leaves, changes, cells)
        divided = [(*corner, leaves.pop(corner)) for corner in tangled]


def just_inside(points: Floats) -> Floats:
    """Return points a hair inside the unit square, as the survey samples them."""
    return np.clip(points, INSIDE_RIM, 1 - INSIDE_RIM)


class _Lattice:
    """The samples up to now, by lattice coordinates."""

    def __init__(self, function: Callable[[Floats], Floats], cells: int) -> None:
        self.function = function
        self.cells = cells
        self.side = cells * 2**HALVINGS
        self.values: dict[Node, Floats] = {}

    def point(self, nodes: Iterable[Node]) -> Floats:
        """Return the coordinates of nodes in the unit square (k, 2), just inside its edges."""
        return just_inside(np.array(list(nodes), np.float64) / self.side)

    def sample(self, nodes: Iterable[Node]) -> Floats:
        """Return the values at nodes (k, m), computing those that are new in one batch."""
        listed = list(nodes)
        new = [node for node in dict.fromkeys(listed) if node not in self.values]
        if new:
            self.values |= zip(new, self.function(self.point(new)), strict=True)
        return np.array([self.values[node] for node in listed])

    def stable(self, node: Node) -> bool:
        """Return whether a sampled node is stable."""
        return bool(self.values[node][0] < 0)

    def along(self, a: Node, b: Node) -> Iterator[Node]:
        """Yield the sampled nodes from a, included, to b, excluded, on a straight edge."""
        middle = ((a[0] + b[0]) // 2, (a[1] + b[1]) // 2)
        if max(abs(a[0] - b[0]), abs(a[1] - b[1])) > 1 and middle in self.values:
            yield from self.along(a, middle)
            yield from self.along(middle, b)
        else:
            yield a

    def around(self, corner: Node, size: int) -> list[Node]:
        """Return the sampled nodes of a cell's rim, counter-clockwise."""
        i, j = corner
        ring = [(i, j), (i + size, j), (i + size, j + size), (i, j + size), (i, j)]
        return [node for a, b in pairwise(ring) for node in self.along(a, b)]


def _divide(
    lattice: _Lattice, leaves: dict[Node, int], divided: list[tuple[int, int, int]]
) -> tuple[dict[Node, int], list[tuple[int, int, int]]]:
    """Divide cells into four each; return all leaves, and which of the new cells must be divided again."""
    halves = [(i, j, size // 2) for i, j, size in divided]
    nodes = [(i + a * h, j + b * h) for i, j, h in halves for b in range(3) for a in range(3)]
    blocks = lattice.sample(nodes).reshape(len(halves), 3, 3, -1)
    repeated = []
    for (i, j, h), suspect in zip(halves, _suspect(blocks), strict=True):
        for b in range(2):
            for a in range(2):
                corner = (i + a * h, j + b * h)
                if suspect[b, a] and h > 1:
                    repeated.append((*corner, h))
                else:
                    leaves[corner] = h
    return leaves, repeated


def _suspect(values: Floats) -> NDArray[np.bool_]:
    """Return whether each cell of grids of nodes (g, n + 1, m + 1, branches), rows y, may hide a component.

    A cell with stable corners hides something when a branch may rise above zero inside; one with unstable
    corners when the first branch may sink below zero; one whose corners disagree when the boundary passes
    through all of its edges, or bends more than it slopes.
    """
    along_x = CAUTION * _second(values, axis=2)  # (g, n + 1, m, branches): at the ends of each cell
    along_y = CAUTION * _second(values, axis=1)
    x = np.stack([along_x[:, :-1], along_x[:, 1:]])
    y = np.stack([along_y[:, :, :-1], along_y[:, :, 1:]])
    lower, upper = values[:, :-1], values[:, 1:]
    corners = np.stack([lower[:, :, :-1], lower[:, :, 1:], upper[:, :, :-1], upper[:, :, 1:]])
    bend = x.max(axis=0) + y.max(axis=0)
    top, first = corners[..., 0], bend[..., 0]
    below = top < 0
    stable, unstable = below.all(axis=0), ~below.any(axis=0)
    span = top.max(axis=0) - top.min(axis=0)
    crossed = (below[0] == below[3]) & (below[1] == below[2]) & (below[0] != below[1])
    suspect: NDArray[np.bool_] = ~stable & ~unstable & (crossed | (first > 2 * span))
    # At most 1/8 of both second differences: the envelope is evaluated only if that reaches zero.
    rising = stable & (corners.max(axis=0) + bend / 8 >= 0).any(axis=-1)
    sinking = unstable & (top.min(axis=0) - first / 8 <= 0)
    for evaluated_at, sign, branches in ((rising, 1.0, slice(None)), (sinking, -1.0, slice(0, 1))):
        if evaluated_at.any():
            four, local_x, local_y = (values[:, evaluated_at, branches] for values in (corners, x, y))
            suspect[evaluated_at] = (_envelope(sign * four, local_x, local_y) >= 0).any(axis=(0, 1, 3))
    return suspect


def _envelope(corners: Floats, along_x: Floats, along_y: Floats) -> Floats:
    """Return an upper bound of each branch on points inside cells (4, 4, cells, branches).

    Parameters
    ----------
    corners
        The values at (0, 0), (1, 0), (0, 1), (1, 1), (4, cells, branches).
    along_x
        Bounds of the second differences along x at the lower and upper edge (2, cells, branches).
    along_y
        The same along y at the left and right edge.
    """
    s = _INNER[None, :, None, None]
    t = _INNER[:, None, None, None]
    interpolant = (1 - t) * ((1 - s) * corners[0] + s * corners[1]) + t * (
        (1 - s) * corners[2] + s * corners[3]
    )
    x = (1 - t) * along_x[0] + t * along_x[1]
    y = (1 - s) * along_y[0] + s * along_y[1]
    bound: Floats = interpolant + 0.5 * (x * s * (1 - s) + y * t * (1 - t))
    return bound


def _second(values: Floats, *, axis: int) -> Floats:
    """Return for each cell along an axis the larger of the second differences at its two ends."""
    moved = np.moveaxis(values, axis, 0)
    bends = np.abs(moved[2:] - 2 * moved[1:-1] + moved[:-2])
    bends = np.concatenate([bends[:1], bends, bends[-1:]])
    return np.moveaxis(np.maximum(bends[:-1], bends[1:]), 0, axis)


def _changes(lattice: _Lattice, corner: Node, size: int) -> list[tuple[Edge, bool]]:
    """Return a cell's crossed stretches counter-clockwise, each with whether it leaves the stable side."""
    ring = lattice.around(corner, size)
    pairs = []
    for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
        if lattice.stable(a) != lattice.stable(b):
            leaving = lattice.stable(a)
            pairs.append(((a, b) if leaving else (b, a), leaving))
    return pairs


def _linked(
    lattice: _Lattice, leaves: Mapping[Node, int], every: Mapping[Node, list[tuple[Edge, bool]]], cells: int
) -> Survey:
    """Link the crossings of all leaves: with the stable side on the left, a piece of the boundary enters a
    cell where its rim, counter-clockwise, leaves the stable side, and goes where it comes back to it.
    """
    follows: dict[Edge, Edge] = {}
    for corner, size in sorted(leaves.items()):
        changes = every[corner]
        # Two pieces in a finest cell with a stable middle: each cuts off an unstable corner, its crossings
        # side by side, and so goes on at the next of the rim. Otherwise it goes to the one before.
        step = 1 if len(changes) > 2 and _centre_is_stable(lattice, corner, size) else -1
        for index, (edge, out) in enumerate(changes):
            if out:
                follows[edge] = changes[(index + step) % len(changes)][0]
    number = {edge: index for index, edge in enumerate(dict.fromkeys([*follows, *follows.values()]))}
    entered = set(follows.values())
    starts = [edge for edge in follows if edge not in entered]
    chains, closed = [], []
    for start in [*starts, *follows]:
        if start not in follows:
            continue
        chain = [start]
        while chain[-1] in follows:
            chain.append(follows.pop(chain[-1]))
        loop = chain[-1] == start
        chains.append(tuple(number[edge] for edge in (chain[:-1] if loop else chain)))
        closed.append(loop)
    side = lattice.side
    ends = np.array(list(number), np.float64).reshape(-1, 2, 2) / side
    growth = [[lattice.values[node][0] for node in edge] for edge in number]
    corners = ((0, 0), (side, 0), (0, side), (side, side))
    return Survey(
        stable=ends[:, 0],
        unstable=ends[:, 1],
        log_radius=np.array(growth).reshape(-1, 2),
        chains=tuple(chains),
        closed=tuple(closed),
        corners=tuple(lattice.stable(corner) for corner in corners),  # type: ignore[arg-type] # four of them
        cell=1 / cells,
        finest=min(leaves.values()) / side,
    )


def _centre_is_stable(lattice: _Lattice, corner: Node, size: int) -> bool:
    """Return whether the middle of a finest cell is stable."""
    middle = (np.array([corner]) + size / 2) / lattice.side
    return bool(lattice.function(middle)[0, 0] < 0)
