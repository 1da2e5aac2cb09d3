"""Which row may be matched to which column: matchings, what they leave over, and the order they imply.

Takes: the incidence of a sparse square system, and graphs, as lists of integers.
Gives: `match_columns`, `leftovers`, `strong_components`.
Guarantees: nothing recurses; the same input gives the same matching.
Does not: know what a row or a column stands for.

Matching by augmenting paths (Kuhn's algorithm), blocks by strongly connected components (Tarjan, SIAM J.
Comput. 1972), what is left over by the coarse decomposition of Dulmage and Mendelsohn (1958); the usual way
of Modelica compilers (Cellier and Kofman, Continuous System Simulation, ch. 7).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

# ---- matching ----


def match_columns(incidence: Sequence[Sequence[int]], columns: int) -> list[int | None]:
    """Return for each column the row matched to it, or None; as many as can be matched.

    Parameters
    ----------
    incidence
        For each row, the columns it may be matched to.
    columns
        The number of columns.
    """
    match: list[int | None] = [None] * columns
    held: dict[int, int] = {}
    for start in range(len(incidence)):
        _augment(start, incidence, match, held)
    return match


def _augment(
    start: int, incidence: Sequence[Sequence[int]], match: list[int | None], held: dict[int, int]
) -> None:
    """Try to match one more row, moving matched rows aside: breadth first, so that depth is no limit."""
    came_from: dict[int, int] = {}
    queue = [start]
    for row in queue:
        for column in incidence[row]:
            if column in came_from:
                continue
            came_from[column] = row
            owner = match[column]
            if owner is None:
                while True:
                    row = came_from[column]
                    match[column], before = row, held.get(row)
                    held[row] = column
                    if row == start:
                        return
                    assert before is not None
                    column = before
            queue.append(owner)


@dataclass(frozen=True, slots=True)
class Leftovers:
    """The parts of a system that has no perfect matching (Dulmage and Mendelsohn 1958).

    More equations than unknowns in the over-determined part, fewer in the under-determined one.
    """

    over_rows: tuple[int, ...]
    over_columns: tuple[int, ...]
    under_rows: tuple[int, ...]
    under_columns: tuple[int, ...]


def leftovers(incidence: Sequence[Sequence[int]], match: Sequence[int | None]) -> Leftovers:
    """Return what alternating paths reach from the rows and from the columns that are not matched."""
    held = {row: column for column, row in enumerate(match) if row is not None}
    rows = [row for row in range(len(incidence)) if row not in held]
    reached_columns: dict[int, None] = {}
    seen = set(rows)
    for row in rows:
        for column in incidence[row]:
            reached_columns[column] = None
            owner = match[column]
            assert owner is not None, "a matching that can't grow"
            if owner not in seen:
                seen.add(owner)
                rows.append(owner)
    over = (tuple(sorted(rows)), tuple(sorted(reached_columns)))
    holders: list[list[int]] = [[] for _ in match]
    for row, columns in enumerate(incidence):
        for column in columns:
            holders[column].append(row)
    free = [column for column, row in enumerate(match) if row is None]
    reached_rows: dict[int, None] = {}
    for column in free:
        for row in holders[column]:
            if row not in reached_rows:
                reached_rows[row] = None
                if held[row] not in free:
                    free.append(held[row])
    return Leftovers(*over, tuple(sorted(reached_rows)), tuple(sorted(free)))


def strong_components(needs: Sequence[Iterable[int]]) -> list[list[int]]:
    """Return the strongly connected components of a graph, each after all it needs (Tarjan, iterative)."""
    order: dict[int, int] = {}
    low: dict[int, int] = {}
    on_stack: set[int] = set()
    stack: list[int] = []
    found: list[list[int]] = []
    for root in range(len(needs)):
        if root in order:
            continue
        work = [(root, iter(needs[root]))]
        while work:
            node, rest = work[-1]
            if node not in order:
                order[node] = low[node] = len(order)
                stack.append(node)
                on_stack.add(node)
            for following in rest:
                if following not in order:
                    work.append((following, iter(needs[following])))
                    break
                if following in on_stack:
                    low[node] = min(low[node], order[following])
            else:
                work.pop()
                if work:
                    parent = work[-1][0]
                    low[parent] = min(low[parent], low[node])
                if low[node] == order[node]:
                    cut = stack.index(node)
                    found.append(stack[cut:])
                    on_stack.difference_update(stack[cut:])
                    del stack[cut:]
    return found
