"""Which equation computes which unknown, in which order, and how each block of them is solved.

Takes: equations as residuals, and the unknowns. Gives: `match_columns`, `leftovers`, `strong_components`,
`solve_blocks` and its steps: assignments and `ImplicitBlock`s.
Guarantees: every unknown is assigned once, from what was assigned before; linear blocks come out explicit.
Does not: differentiate anything (see `index`), or know of states and clocks.

Matching by augmenting paths (Kuhn's algorithm), blocks by strongly connected components (Tarjan, SIAM J.
Comput. 1972), what is left over by the coarse decomposition of Dulmage and Mendelsohn (1958); the usual way
of Modelica compilers (Cellier and Kofman, Continuous System Simulation, ch. 7).
"""

from __future__ import annotations

import heapq
from collections.abc import Collection, Iterable, Sequence, Set
from dataclasses import dataclass

import sympy

from apc.compiler.errors import Mistakes, Place
from apc.compiler.flatten import FlatEquation
from apc.compiler.symbolic import NOTHING_VANISHES, LinearForm, Vanishing, ZeroTest, linear_form, symbol
from apc.compiler.words import counted

Assignment = tuple[str, sympy.Expr]
# An entry of an eliminated block with more nodes than this gets a name of its own: substituted into one
# another, the entries of a chain of a thousand equations would grow without end.
LARGEST_ENTRY = 40
MOST_LISTED = 8  # equations or unknowns in one message


@dataclass(frozen=True, slots=True)
class Residual:
    """An equation as `expression = 0`, with its origin for messages."""

    expression: sympy.Expr
    equation: FlatEquation

    @property
    def shown(self) -> str:
        """The equation as the user wrote it, and where it comes from."""
        return f"`{self.equation.text}` ({self.equation.origin})"


@dataclass(frozen=True, slots=True)
class ImplicitBlock:
    """A nonlinear loop: find the `tearing` unknowns that make every residual zero.

    `inner` computes the other unknowns, in this order, from the tearing unknowns. Unknowns keep the order of
    the model's; `equations` are the loop's, as text.
    """

    unknowns: tuple[str, ...]
    tearing: tuple[str, ...]
    inner: tuple[Assignment, ...]
    residuals: tuple[sympy.Expr, ...]  # as many as tearing unknowns
    equations: tuple[str, ...]

    @property
    def free_symbols(self) -> set[sympy.Symbol]:
        """The symbols the block's solution depends on."""
        found = {s for e in (*self.residuals, *(e for _, e in self.inner)) for s in e.free_symbols}
        return found - {symbol(name) for name in self.unknowns}

    @property
    def chain(self) -> str:
        """The loop as text: `a → b → a`."""
        return " → ".join((*self.unknowns, self.unknowns[0]))


Step = Assignment | ImplicitBlock


def assigned(step: Step) -> tuple[str, ...]:
    """Return the names a step gives a value."""
    return step.unknowns if isinstance(step, ImplicitBlock) else (step[0],)


def solve_blocks(
    residuals: Sequence[Residual],
    unknowns: Sequence[sympy.Symbol],
    where: str,
    mistakes: Mistakes,
    *,
    nonzero: Collection[sympy.Symbol] = (),
    vanishes: Vanishing = NOTHING_VANISHES,
) -> tuple[Step, ...]:
    """Match, sort and solve.

    Parameters
    ----------
    residuals, unknowns
        As many equations as unknowns; a mistake if not.
    where
        What to call the equations in a message: "the continuous equations".
    mistakes
        Takes E502 equations or unknowns left over, E503 a loop without an unknown to solve for, E511 linear
        equations that depend on each other.
    nonzero
        Parameters that no number can make zero; divisors stay when all others are zero, where possible.
    vanishes
        Whether an expression is zero with the scene's numbers; what is divided by must not be.
    """
    columns = {unknown: j for j, unknown in enumerate(unknowns)}
    incidence = [sorted(columns[s] for s in r.expression.free_symbols & columns.keys()) for r in residuals]
    match = match_columns(incidence, len(unknowns))
    if len(residuals) != len(unknowns) or None in match:
        report_singular(residuals, [u.name for u in unknowns], incidence, match, where, mistakes)
        return ()
    computes = {row: column for column, row in enumerate(match) if row is not None}
    # Row i computes column computes[i]; it needs the rows that compute its other unknowns.
    needs = [
        [row for j in columns_of if (row := match[j]) is not None and row != i]
        for i, columns_of in enumerate(incidence)
    ]
    solver = _Solver(where, mistakes, frozenset(nonzero), vanishes)
    steps: list[Step] = []
    for block in strong_components(needs):
        rows = sorted(block)
        own = [unknowns[column] for column in sorted(computes[row] for row in rows)]
        steps += solver.solve([residuals[row] for row in rows], own)
    return tuple(steps)


# ---- solution of one block ----


class _Solver:
    """Solves blocks; keeps what they share: the zero test, and where mistakes go."""

    def __init__(
        self, where: str, mistakes: Mistakes, nonzero: Set[sympy.Symbol], vanishes: Vanishing
    ) -> None:
        self.where = where
        self.vanishes = vanishes
        self.mistakes = mistakes
        self.is_zero = ZeroTest()
        self.can_vanish = ZeroTest(nonzero)

    def solve(self, block: Sequence[Residual], unknowns: Sequence[sympy.Symbol]) -> list[Step]:
        known = frozenset(unknowns)
        forms = [linear_form(residual.expression, known) for residual in block]
        if any(form is None for form in forms):
            return self._tear(block, unknowns)
        linear = [form for form in forms if form is not None]
        if len(block) > 1:
            return self._eliminate(block, unknowns, linear)
        [(coefficients, rest)] = linear
        coefficient = coefficients[unknowns[0]]
        if self.is_zero(coefficient) or self.vanishes(coefficient):
            self._report_dependent(block, unknowns)
            return []
        return [(unknowns[0].name, -rest / coefficient)]

    def _report_dependent(self, block: Iterable[Residual], unknowns: Sequence[sympy.Symbol]) -> None:
        block = list(block)
        what = (
            f"{self.where} depend on each other and don't determine {_some([u.name for u in unknowns])}: "
            f"{_some([residual.shown for residual in block])}"
        )
        self.mistakes.add("E511", block[0].equation.place, what)

    # ---- linear ----

    def _eliminate(
        self, block: Sequence[Residual], unknowns: Sequence[sympy.Symbol], forms: Sequence[LinearForm]
    ) -> list[Step]:
        """Solve by Gaussian elimination with sparse rows; later pivots are assigned first.

        The next pivot is one that stays when every parameter that may be zero is, if there is one; of these
        the one that fills in least (Markowitz 1957), and of several a number. Sizes are not known here.
        """
        place = {unknown: j for j, unknown in enumerate(unknowns)}
        rows = [
            {place[u]: c for u, c in coefficients.items() if not self.is_zero(c)} for coefficients, _ in forms
        ]
        right = [-rest for _, rest in forms]
        holders: list[set[int]] = [set() for _ in unknowns]
        for i, row in enumerate(rows):
            for j in row:
                holders[j].add(i)
        named: list[Step] = []

        def name(entry: sympy.Expr) -> sympy.Expr:
            if not _is_long(entry):
                return entry
            short = symbol(f"{unknowns[0].name} by elimination {len(named) + 1}")
            self.is_zero.define(short, entry)
            self.can_vanish.define(short, entry)
            self.vanishes.define(short, entry)
            named.append((short.name, entry))
            return short

        def cost(i: int, j: int) -> tuple[bool, bool, int, bool, int, int]:
            entry, fill = rows[i][j], (len(rows[i]) - 1) * (len(holders[j]) - 1)
            return self.vanishes(entry), self.can_vanish(entry), fill, not entry.is_Number, i, j

        heap = [cost(i, j) for i, row in enumerate(rows) for j in row]
        heapq.heapify(heap)
        pivots: list[tuple[int, int]] = []
        used: set[int] = set()
        while heap:
            entry = heapq.heappop(heap)
            i, j = entry[-2:]
            if i in used or i not in holders[j]:
                continue
            if (current := cost(i, j)) > entry:
                heapq.heappush(heap, current)  # the pattern has filled in since
                continue
            if current[0]:
                break  # with these numbers there is nothing left to divide by
            pivots.append((i, j))
            used.add(i)
            for column in rows[i]:
                holders[column].discard(i)
            for other in sorted(holders[j]):
                factor = name(rows[other].pop(j) / rows[i][j])
                for column, value in rows[i].items():
                    if column == j:
                        continue
                    left = name(rows[other].get(column, sympy.S.Zero) - factor * value)
                    if self.is_zero(left):
                        rows[other].pop(column, None)
                        holders[column].discard(other)
                    else:
                        rows[other][column] = left
                        holders[column].add(other)
                        heapq.heappush(heap, cost(other, column))
                right[other] = name(right[other] - factor * right[i])
            holders[j].clear()
        if len(pivots) < len(unknowns):
            free = [u for j, u in enumerate(unknowns) if j not in {column for _, column in pivots}]
            self._report_dependent(block, free)
            return []
        solved: list[Step] = []
        for i, j in reversed(pivots):
            others = sympy.Add(
                *(value * unknowns[column] for column, value in rows[i].items() if column != j)
            )
            solved.append((unknowns[j].name, (right[i] - others) / rows[i][j]))
        return named + solved

    # ---- nonlinear ----

    def _tear(self, block: Sequence[Residual], unknowns: Sequence[sympy.Symbol]) -> list[Step]:
        """Guess as few unknowns as simply found, so that the others follow one by one.

        An equation whose only open unknown stands in it linearly, with a factor free of the loop's unknowns,
        computes it. When there is none, the open unknown in most of the open equations is torn, of
        several the one that fewest of them could compute.
        """
        members = frozenset(unknowns)
        held = [set(residual.expression.free_symbols & members) for residual in block]
        standing: dict[sympy.Symbol, list[int]] = {u: [] for u in unknowns}
        for i, these in enumerate(held):
            for u in these:
                standing[u].append(i)
        ready = [i for i, these in enumerate(held) if len(these) == 1]
        left = dict.fromkeys(range(len(block)))
        free = dict.fromkeys(unknowns)
        inner: list[Assignment] = []
        torn: list[sympy.Symbol] = []

        def solvable(coefficient: sympy.Expr) -> bool:
            return members.isdisjoint(coefficient.free_symbols) and not self.is_zero(coefficient)

        computable: dict[sympy.Symbol, set[int]] = {u: set() for u in unknowns}
        for i, residual in enumerate(block):
            for u in held[i]:
                form = linear_form(residual.expression, frozenset((u,)))
                if form is not None and solvable(form[0][u]):
                    computable[u].add(i)

        def gain(unknown: sympy.Symbol) -> tuple[int, int]:
            rows = [i for i in standing[unknown] if i in left]
            return len(rows), -sum(i in computable[unknown] for i in rows)

        def close(unknown: sympy.Symbol) -> None:
            del free[unknown]
            for i in standing[unknown]:
                held[i].discard(unknown)
                if i in left and len(held[i]) == 1:
                    ready.append(i)

        while free:
            while ready:
                i = ready.pop(0)
                if i not in left or len(held[i]) != 1:
                    continue
                [unknown] = held[i]
                if i not in computable[unknown]:
                    continue
                form = linear_form(block[i].expression, frozenset((unknown,)))
                assert form is not None
                inner.append((unknown.name, -form[1] / form[0][unknown]))
                del left[i]
                close(unknown)
            if free:
                tear = max(free, key=gain)
                torn.append(tear)
                close(tear)
        assert len(left) == len(torn), "a matched block has as many equations as unknowns"
        names, texts = tuple(u.name for u in unknowns), tuple(residual.shown for residual in block)
        residuals = tuple(block[i].expression for i in left)
        made = ImplicitBlock(names, tuple(u.name for u in torn), tuple(inner), residuals, texts)
        if not all(_moves(residual, inner) for residual in residuals):
            what = (
                f"{self.where} hold a loop without an unknown left to solve for: {made.chain}, "
                f"by {_some(texts)}"
            )
            self.mistakes.add("E503", block[0].equation.place, what)
            return []
        return [made]


def _moves(residual: sympy.Expr, inner: Sequence[Assignment]) -> bool:
    """Return whether a residual still holds a guess after the inner values are put in (when they are few)."""
    if len(inner) <= MOST_LISTED:
        for name, expression in reversed(inner):
            residual = residual.xreplace({symbol(name): expression})
    return bool(residual.free_symbols)


def _is_long(expression: sympy.Expr) -> bool:
    """Return whether an expression has more than `LARGEST_ENTRY` nodes."""
    return any(count >= LARGEST_ENTRY for count, _ in enumerate(sympy.preorder_traversal(expression)))


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


def report_singular(
    residuals: Sequence[Residual],
    unknowns: Sequence[str],
    incidence: Sequence[Sequence[int]],
    match: Sequence[int | None],
    where: str,
    mistakes: Mistakes,
) -> None:
    """Add the mistake E502: which equations and which unknowns are too many.

    Parameters
    ----------
    residuals, unknowns
        The equations, and the names of what they are to give.
    incidence
        For each equation the places of its unknowns.
    match
        For each unknown the equation that gives it, None where there is none.
    where
        Which partition that is, for the message.
    mistakes
        Takes the mistake.
    """
    found = leftovers(incidence, match)
    parts = []
    place = residuals[0].equation.place if residuals else Place("topology")
    if found.over_rows:
        place = next(r for i, r in enumerate(residuals) if i not in match).equation.place
        count = counted(len(found.over_columns), "unknown")
        named = [unknowns[j] for j in found.over_columns]
        held = f"hold only {count} ({_some(named)})" if named else "hold no unknown"
        parts.append(
            f"{counted(len(found.over_rows), 'equation')} {held}: "
            f"{_some([residuals[i].shown for i in found.over_rows])}"
        )
    if found.under_columns:
        count = counted(len(found.under_columns), "unknown")
        shown = [residuals[i].shown for i in found.under_rows]
        by = f"only {counted(len(shown), 'equation')}, {_some(shown)}" if shown else "no equation"
        parts.append(
            f"{count} ({_some([unknowns[j] for j in found.under_columns])}) "
            f"{'has' if len(found.under_columns) == 1 else 'have'} {by}"
        )
    mistakes.add("E502", place, f"{where} can't be solved: {'; and '.join(parts)}")


def _some(texts: Sequence[str]) -> str:
    """Join the first few texts and say how many more there are."""
    more = len(texts) - MOST_LISTED
    return ", ".join(texts[:MOST_LISTED]) + (f" and {more} more" if more > 0 else "")


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
