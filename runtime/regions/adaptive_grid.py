"""Location of a boundary in a rectangle: a grid, refined where a component may be hidden.

Takes: a function that returns the logarithms of the largest eigenvalue magnitudes at many points of the unit
square at once.
Gives: `Survey`, `survey`; `just_inside`; `blurred`.
Guarantees: a cell is divided, down to the finest size, if its corners have different verdicts, or if by the
second differences around it a component may be hidden inside; all cells of a level form one batch. Crossings
of cells' edges are linked in the order that has the stable side on the left.
Does not: find a component inside one cell without an effect on the values around it, or locate a crossing on
an edge (see `boundary`).

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

# The factor on second differences to obtain bounds: the third derivative may increase them between samples.
CAUTION = 1.5

# Signs at the edges of the rectangle are evaluated at this distance inside: at a stiffness of exactly zero, a
# neutral mode has the eigenvalue 1, which is unrelated to nearby points.
INSIDE_RIM = 1e-9

# A magnitude closer to 1 than this is on no side: far above the rounding of a few dozen states.
UNSURE = 1e-11

# The relative positions in a cell at which its envelope is evaluated.
_INNER = np.array([0.125, 0.375, 0.625, 0.875])

# The largest number of halvings of a coarse cell.
HALVINGS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """The crossings of the boundary with cells' edges, in order, the stable side on the left.

    A crossing is a part of a cell's edge from a `stable` to an `unstable` point (k, 2); `log_radius` (k, 2)
    is the log of the spectral radius at both. `chains` are lists of indices of crossings, `closed` states
    whether each chain is a closed curve. `corners` is the stability of the rectangle's corners (0, 0), (1,
    0), (0, 1), (1, 1). `cell` is the side of the coarse cells, `finest` that of the smallest cells evaluated.
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
    """Return the error E905 for a boundary that cannot be located, as a mode is marginal to rounding."""
    message = "in a part of the rectangle the spectral radius equals 1 within rounding"
    return ApcError(
        Diagnostic("E905", SourceLocation("region"), message, advice="add damping, or use wider ranges")
    )


def survey(log_magnitudes: Callable[[Floats], Floats], *, cells: int) -> Survey:
    """Return the crossings of the boundary with the edges of an adaptive grid of cells, linked to chains.

    Parameters
    ----------
    log_magnitudes
        The logarithms (k, m) of the m largest magnitudes at points (k, 2), descending.
    cells
        The number of coarse cells along each side.

    Raises
    ------
    ApcError
        E905 a coarse cell with a largest magnitude of 1 to rounding: signs would be rounding noise.
    """
    lattice = _Lattice(log_magnitudes, cells)
    step = 2**HALVINGS
    axis = np.arange(cells + 1) * step
    grid = lattice.sample([(int(i), int(j)) for j in axis for i in axis]).reshape(cells + 1, cells + 1, -1)
    undecided = np.abs(grid[..., 0]) <= UNSURE
    if (undecided[1:, 1:] & undecided[1:, :-1] & undecided[:-1, 1:] & undecided[:-1, :-1]).any():
        raise blurred()
    suspect = _may_hide_component(grid[None])[0]
    leaves = {(int(i) * step, int(j) * step): step for j, i in np.argwhere(~suspect)}
    divided = [(int(i) * step, int(j) * step, step) for j, i in np.argwhere(suspect)]
    while True:
        while divided:
            leaves, divided = _divide(lattice, leaves, divided)
        crossings_of = {corner: _crossings(lattice, corner, size) for corner, size in leaves.items()}
        # A cell with more than one piece of the boundary is divided, down to the finest size.
        with_several_pieces = [
            corner for corner, size in leaves.items() if size > 1 and len(crossings_of[corner]) > 2
        ]
        if not with_several_pieces:
            return _linked_survey(lattice, leaves, crossings_of, cells)
        divided = [(*corner, leaves.pop(corner)) for corner in with_several_pieces]


def just_inside(points: Floats) -> Floats:
    """Return points at a distance of at least `INSIDE_RIM` from the edges of the unit square (k, 2)."""
    return np.clip(points, INSIDE_RIM, 1 - INSIDE_RIM)


class _Lattice:
    """The samples of the function, by integer lattice coordinates."""

    def __init__(self, function: Callable[[Floats], Floats], cells: int) -> None:
        self.function = function
        self.cells = cells
        self.side = cells * 2**HALVINGS
        self.values: dict[Node, Floats] = {}

    def point(self, nodes: Iterable[Node]) -> Floats:
        """Return the coordinates of nodes in the unit square (k, 2), just inside its edges."""
        return just_inside(np.array(list(nodes), np.float64) / self.side)

    def sample(self, nodes: Iterable[Node]) -> Floats:
        """Return the values at nodes (k, m); new ones are computed in one batch."""
        node_list = list(nodes)
        new = [node for node in dict.fromkeys(node_list) if node not in self.values]
        if new:
            self.values |= zip(new, self.function(self.point(new)), strict=True)
        return np.array([self.values[node] for node in node_list])

    def stable(self, node: Node) -> bool:
        """Return whether a sampled node is stable."""
        return bool(self.values[node][0] < 0)

    def along(self, a: Node, b: Node) -> Iterator[Node]:
        """Yield the sampled nodes of a straight edge from a, included, to b, excluded."""
        middle = ((a[0] + b[0]) // 2, (a[1] + b[1]) // 2)
        if max(abs(a[0] - b[0]), abs(a[1] - b[1])) > 1 and middle in self.values:
            yield from self.along(a, middle)
            yield from self.along(middle, b)
        else:
            yield a

    def rim_of(self, corner: Node, size: int) -> list[Node]:
        """Return the sampled nodes on a cell's rim, counter-clockwise."""
        i, j = corner
        ring = [(i, j), (i + size, j), (i + size, j + size), (i, j + size), (i, j)]
        return [node for a, b in pairwise(ring) for node in self.along(a, b)]


def _divide(
    lattice: _Lattice, leaves: dict[Node, int], divided: list[tuple[int, int, int]]
) -> tuple[dict[Node, int], list[tuple[int, int, int]]]:
    """Return all undivided cells after a division of some cells into four, and the new cells to
    divide again.
    """
    halves = [(i, j, size // 2) for i, j, size in divided]
    nodes = [(i + a * h, j + b * h) for i, j, h in halves for b in range(3) for a in range(3)]
    blocks = lattice.sample(nodes).reshape(len(halves), 3, 3, -1)
    to_divide = []
    for (i, j, h), suspect in zip(halves, _may_hide_component(blocks), strict=True):
        for b in range(2):
            for a in range(2):
                corner = (i + a * h, j + b * h)
                if suspect[b, a] and h > 1:
                    to_divide.append((*corner, h))
                else:
                    leaves[corner] = h
    return leaves, to_divide


def _may_hide_component(values: Floats) -> NDArray[np.bool_]:
    """Return whether each cell of grids of nodes (g, n + 1, m + 1, branches), rows y, may hide a component.

    With stable corners: if a branch may exceed zero inside. With unstable corners: if the first branch may
    fall below zero inside. With different corners: if the boundary crosses all edges, or the second
    differences exceed the differences.
    """
    along_x = CAUTION * _second_differences(
        values, axis=2
    )  # (g, n + 1, m, branches): at the ends of each cell
    along_y = CAUTION * _second_differences(values, axis=1)
    x = np.stack([along_x[:, :-1], along_x[:, 1:]])
    y = np.stack([along_y[:, :, :-1], along_y[:, :, 1:]])
    lower, upper = values[:, :-1], values[:, 1:]
    corners = np.stack([lower[:, :, :-1], lower[:, :, 1:], upper[:, :, :-1], upper[:, :, 1:]])
    second_sum = x.max(axis=0) + y.max(axis=0)
    top, first = corners[..., 0], second_sum[..., 0]
    is_stable = top < 0
    stable, unstable = is_stable.all(axis=0), ~is_stable.any(axis=0)
    span = top.max(axis=0) - top.min(axis=0)
    crossed = (is_stable[0] == is_stable[3]) & (is_stable[1] == is_stable[2]) & (is_stable[0] != is_stable[1])
    suspect: NDArray[np.bool_] = ~stable & ~unstable & (crossed | (first > 2 * span))
    # At most 1/8 of both second differences: the envelope is evaluated only if that reaches zero.
    rising = stable & (corners.max(axis=0) + second_sum / 8 >= 0).any(axis=-1)
    sinking = unstable & (top.min(axis=0) - first / 8 <= 0)
    for evaluated_at, sign, branches in ((rising, 1.0, slice(None)), (sinking, -1.0, slice(0, 1))):
        if evaluated_at.any():
            cell_corners, local_x, local_y = (array[:, evaluated_at, branches] for array in (corners, x, y))
            suspect[evaluated_at] = (_envelope(sign * cell_corners, local_x, local_y) >= 0).any(
                axis=(0, 1, 3)
            )
    return suspect


def _envelope(corners: Floats, along_x: Floats, along_y: Floats) -> Floats:
    """Return an upper bound (4, 4, cells, branches) of each branch at points inside cells.

    Parameters
    ----------
    corners
        The values at (0, 0), (1, 0), (0, 1), (1, 1), (4, cells, branches).
    along_x
        Bounds of the second differences along x at the lower and upper edge (2, cells, branches).
    along_y
        Bounds of the second differences along y at the left and right edge (2, cells, branches).
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


def _second_differences(values: Floats, *, axis: int) -> Floats:
    """Return for each cell along an axis the larger of the second differences at its two ends."""
    along_first = np.moveaxis(values, axis, 0)
    differences = np.abs(along_first[2:] - 2 * along_first[1:-1] + along_first[:-2])
    differences = np.concatenate([differences[:1], differences, differences[-1:]])
    return np.moveaxis(np.maximum(differences[:-1], differences[1:]), 0, axis)


def _crossings(lattice: _Lattice, corner: Node, size: int) -> list[tuple[Edge, bool]]:
    """Return the crossed parts of a cell's rim, counter-clockwise, each with whether it leaves the
    stable side.
    """
    ring = lattice.rim_of(corner, size)
    pairs = []
    for a, b in zip(ring, [*ring[1:], ring[0]], strict=True):
        if lattice.stable(a) != lattice.stable(b):
            leaving = lattice.stable(a)
            pairs.append(((a, b) if leaving else (b, a), leaving))
    return pairs


def _linked_survey(
    lattice: _Lattice,
    leaves: Mapping[Node, int],
    crossings_of_cells: Mapping[Node, list[tuple[Edge, bool]]],
    cells: int,
) -> Survey:
    """Return the survey, with the crossings of all cells linked to chains.

    A piece of the boundary, with the stable side on its left, enters a cell where the rim (counter-clockwise)
    leaves the stable side, and exits where the rim returns to it.
    """
    follows: dict[Edge, Edge] = {}
    for corner, size in sorted(leaves.items()):
        changes = crossings_of_cells[corner]
        # Two pieces in a finest cell with a stable middle: each cuts off an unstable corner, and exits at the
        # next crossing of the rim. Otherwise a piece exits at the previous crossing.
        step = 1 if len(changes) > 2 and _centre_is_stable(lattice, corner, size) else -1
        for index, (edge, leaving) in enumerate(changes):
            if leaving:
                follows[edge] = changes[(index + step) % len(changes)][0]
    index_of = {edge: index for index, edge in enumerate(dict.fromkeys([*follows, *follows.values()]))}
    entered = set(follows.values())
    starts = [edge for edge in follows if edge not in entered]
    chains, closed = [], []
    for start in [*starts, *follows]:
        if start not in follows:
            continue
        chain = [start]
        while chain[-1] in follows:
            chain.append(follows.pop(chain[-1]))
        is_closed = chain[-1] == start
        chains.append(tuple(index_of[edge] for edge in (chain[:-1] if is_closed else chain)))
        closed.append(is_closed)
    side = lattice.side
    ends = np.array(list(index_of), np.float64).reshape(-1, 2, 2) / side
    growth = [[lattice.values[node][0] for node in edge] for edge in index_of]
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
