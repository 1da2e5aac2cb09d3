"""Each partition balanced, aliases removed, matched and sorted into blocks, linear blocks solved.

Takes: `ClockedSystem`. Gives: `SortedSystem`: assignments in the order in which they can be computed.
Guarantees: every unknown of a partition is assigned once, from states, crossings, parameters and unknowns
assigned before it.
Does not: put in numbers, or drop what nobody reads.

Matching by augmenting paths (Kuhn's algorithm), blocks by strongly connected components (Tarjan, SIAM J.
Comput. 1972); the usual way of Modelica compilers (Cellier and Kofman, Continuous System Simulation, ch. 7).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import sympy

from apc.compiler.clocks import (
    CONTINUOUS,
    ClockedKind,
    ClockedSystem,
    HoldCrossing,
    Partition,
    PreviousCrossing,
    ReceiveCrossing,
)
from apc.compiler.errors import Mistakes, Place
from apc.compiler.flatten import FlatEquation
from apc.compiler.scene import Scene
from apc.compiler.symbolic import derivative_symbol, is_opaque_in, symbol, to_sympy
from apc.compiler.units import format_dimension

Assignments = tuple[tuple[str, sympy.Expr], ...]


@dataclass(frozen=True, slots=True)
class SortedPartition:
    """The unknowns of one clock (or the continuous ones), each with the expression that gives it."""

    clock: str
    assignments: Assignments


@dataclass(frozen=True, slots=True)
class SortedSend:
    """What is sent over a link, as an expression in continuous unknowns."""

    name: str
    link: str
    unit: str
    expression: sympy.Expr


@dataclass(frozen=True, slots=True)
class SortedKind:
    """A kind of peer as explicit equations. `aliases` are unknowns that equal ± another, or zero."""

    clocked: ClockedKind
    states: tuple[str, ...]
    aliases: Assignments
    partitions: tuple[SortedPartition, ...]
    samples: tuple[tuple[str, str, sympy.Expr], ...]  # (symbol, clock, expression)
    holds: tuple[HoldCrossing, ...]
    previous: tuple[PreviousCrossing, ...]
    receives: tuple[ReceiveCrossing, ...]
    sends: tuple[SortedSend, ...]


@dataclass(frozen=True, slots=True)
class SortedSystem:
    """The scene as explicit equations."""

    scene: Scene
    kinds: tuple[SortedKind, ...]


@dataclass(frozen=True, slots=True)
class _Residual:
    """An equation as `expression = 0`, with its origin for messages."""

    expression: sympy.Expr
    equation: FlatEquation


def sort(clocked: ClockedSystem) -> SortedSystem:
    """Sort and solve every partition. Raises ApcError naming the equations and unknowns left over."""
    mistakes = Mistakes()
    kinds = tuple(_sort_kind(kind, mistakes) for kind in clocked.kinds)
    mistakes.raise_if_any()
    return SortedSystem(clocked.scene, kinds)


def _sort_kind(kind: ClockedKind, mistakes: Mistakes) -> SortedKind:
    continuous = kind.partitions[0]
    assert continuous.clock == CONTINUOUS
    variables = {symbol(name): name for name in continuous.variables}
    differentiate = _differentiator(set(variables))
    residuals = [_residual(equation, differentiate) for equation in continuous.equations]
    replaced, residuals = _remove_aliases(residuals, variables, continuous.variables)
    samples = [(s.symbol, s.clock, to_sympy(s.expression, differentiate)) for s in kind.samples]
    sends = [(send, to_sympy(send.expression, differentiate)) for send in kind.sends]
    replacements = _with_derivatives(replaced)
    read = [r.expression for r in residuals] + [e.xreplace(replacements) for _, _, e in samples]
    read += [e.xreplace(replacements) for _, e in sends]
    derivatives = {derivative_symbol(name): name for name in continuous.variables}
    differentiated = {
        derivatives[s] for expression in read for s in expression.free_symbols if s in derivatives
    }
    states = tuple(name for name in continuous.variables if name in differentiated)
    unknowns = [name for name in continuous.variables if symbol(name) not in replaced and name not in states]
    symbols = [derivative_symbol(name) for name in states] + [symbol(name) for name in unknowns]
    assignments = _solve(residuals, symbols, CONTINUOUS, continuous, mistakes)
    partitions = [SortedPartition(CONTINUOUS, assignments)]
    for clock in kind.partitions[1:]:
        own = [_residual(equation, _no_derivative) for equation in clock.equations]
        found = _solve(own, [symbol(name) for name in clock.variables], clock.clock, clock, mistakes)
        partitions.append(SortedPartition(clock.clock, found))
    units = {send.name: send.dimension for send in kind.sends}
    return SortedKind(
        kind,
        states,
        tuple((variables[s], e) for s, e in replaced.items()),
        tuple(partitions),
        tuple((s, c, e.xreplace(replacements)) for s, c, e in samples),
        kind.holds,
        kind.previous,
        kind.receives,
        tuple(
            SortedSend(send.name, send.link, format_dimension(units[send.name]), e.xreplace(replacements))
            for send, e in sends
        ),
    )


def _residual(equation: FlatEquation, differentiate: Callable[[sympy.Expr], sympy.Expr]) -> _Residual:
    left, right = to_sympy(equation.left, differentiate), to_sympy(equation.right, differentiate)
    return _Residual(left - right, equation)


def _differentiator(variables: set[sympy.Symbol]) -> Callable[[sympy.Expr], sympy.Expr]:
    """Return d/dt by the chain rule: variables have derivatives, parameters have none."""

    def differentiate(expression: sympy.Expr) -> sympy.Expr:
        total: sympy.Expr = sympy.diff(expression, symbol("time"))
        for variable in sorted(expression.free_symbols & variables, key=str):
            total += sympy.diff(expression, variable) * derivative_symbol(variable.name)
        return total

    return differentiate


def _no_derivative(expression: sympy.Expr) -> sympy.Expr:
    raise AssertionError("der stands in continuous equations only")


# ---- aliases ----


def _remove_aliases(
    residuals: Sequence[_Residual], variables: dict[sympy.Symbol, str], order: Sequence[str]
) -> tuple[dict[sympy.Symbol, sympy.Expr], list[_Residual]]:
    """Take out the equations a = b, a = -b and a = 0 between unknowns; return what stands for what.

    Of two, the variable a component declares stays and the connector's goes: `device.x`, not
    `device.flange.x`; otherwise the one named first stays.
    """
    rank = {symbol(name): (name.count("."), place) for place, name in enumerate(order)}
    replaced: dict[sympy.Symbol, sympy.Expr] = {}
    remaining: list[_Residual] = []

    def resolve(expression: sympy.Expr) -> sympy.Expr:
        while hits := expression.free_symbols & replaced.keys():
            expression = expression.xreplace({hit: replaced[hit] for hit in hits})
        return expression

    for residual in residuals:
        expression = residual.expression
        pair = _alias_pair(expression, variables)
        if pair is None:
            remaining.append(residual)
            continue
        expression = resolve(expression)
        pair = _alias_pair(expression, variables)
        if pair is None or not pair:
            remaining.append(_Residual(expression, residual.equation))
            continue
        goes = max(pair, key=lambda s: rank[s])
        coefficient = expression.coeff(goes)
        replaced[goes] = sympy.expand(-(expression - coefficient * goes) / coefficient)
    final = {name: resolve(expression) for name, expression in replaced.items()}
    table = _with_derivatives(final)
    return final, [_Residual(r.expression.xreplace(table), r.equation) for r in remaining]


def _alias_pair(
    expression: sympy.Expr, variables: dict[sympy.Symbol, str]
) -> tuple[sympy.Symbol, ...] | None:
    """Return the unknowns of ±a ± b or ±a, or None when the expression has another form."""
    terms = expression.as_ordered_terms() if expression.is_Add else [expression]
    if len(terms) > 2:
        return None
    found = []
    for term in terms:
        coefficient, rest = term.as_coeff_Mul()
        if abs(coefficient) != 1 or rest not in variables:
            return None
        found.append(rest)
    return tuple(found)


def _with_derivatives(replaced: dict[sympy.Symbol, sympy.Expr]) -> dict[sympy.Symbol, sympy.Expr]:
    """Return the replacements with those of the derivatives: der(a) = ±der(b) where a = ±b."""
    table = dict(replaced)
    for name, expression in replaced.items():
        derivatives = {s: derivative_symbol(s.name) for s in expression.free_symbols}
        table[derivative_symbol(name.name)] = expression.xreplace(derivatives)
    return table


# ---- matching, blocks, solution ----


def _solve(
    residuals: Sequence[_Residual],
    unknowns: Sequence[sympy.Symbol],
    clock: str,
    partition: Partition,
    mistakes: Mistakes,
) -> Assignments:
    columns = {unknown: j for j, unknown in enumerate(unknowns)}
    incidence = [
        [columns[s] for s in sorted(r.expression.free_symbols & columns.keys(), key=str)] for r in residuals
    ]
    match = match_columns(incidence, len(unknowns))
    matched_rows = {row for row in match if row is not None}
    left_rows = [i for i in range(len(residuals)) if i not in matched_rows]
    left_columns = [j for j, row in enumerate(match) if row is None]
    if left_rows or left_columns:
        _report_singular(residuals, unknowns, left_rows, left_columns, clock, mistakes)
        return ()
    row_to_column = {row: column for column, row in enumerate(match)}
    assert all(row is not None for row in match)
    # Row i computes column row_to_column[i]; it needs the rows that compute its other unknowns.
    needs = [
        [row for j in columns_of if (row := match[j]) is not None and row != i]
        for i, columns_of in enumerate(incidence)
    ]
    found: list[tuple[str, sympy.Expr]] = []
    for block in strong_components(needs):
        rows = sorted(block)
        own = [unknowns[row_to_column[row]] for row in rows]
        found += _solve_block([residuals[row] for row in rows], own, clock, mistakes)
    return tuple(found)


def _report_singular(
    residuals: Sequence[_Residual],
    unknowns: Sequence[sympy.Symbol],
    rows: Sequence[int],
    columns: Sequence[int],
    clock: str,
    mistakes: Mistakes,
) -> None:
    where = "the continuous equations" if clock == CONTINUOUS else f"the equations of clock {clock}"
    parts = []
    if columns:
        parts.append(f"no equation is left for {', '.join(unknowns[j].name for j in columns)}")
    if rows:
        texts = "; ".join(f"`{residuals[i].equation.text}` ({residuals[i].equation.origin})" for i in rows)
        parts.append(f"these have no unknown of their own: {texts}")
    place = residuals[rows[0]].equation.place if rows else _place_of(residuals)
    mistakes.add("E502", place, f"{where} can't be solved: {', and '.join(parts)}")


def _place_of(residuals: Sequence[_Residual]) -> Place:
    return residuals[0].equation.place if residuals else Place("topology")


def _solve_block(
    block: Sequence[_Residual], unknowns: Sequence[sympy.Symbol], clock: str, mistakes: Mistakes
) -> list[tuple[str, sympy.Expr]]:
    """Solve a linear block symbolically: one equation by division, several by LU."""
    nonlinear = [u for u in unknowns for r in block if _is_nonlinear(r.expression, u, unknowns)]
    if nonlinear:
        chain = " → ".join([u.name for u in unknowns] + [unknowns[0].name])
        texts = "; ".join(f"`{r.equation.text}`" for r in block)
        what = f"a nonlinear algebraic loop, which can't be solved here: {chain}, by {texts}"
        mistakes.add("E503", block[0].equation.place, what)
        return []
    if len(block) == 1:
        expression, unknown = block[0].expression, unknowns[0]
        coefficient = sympy.diff(expression, unknown)
        rest = expression.xreplace({unknown: sympy.Integer(0)})
        return [(unknown.name, -rest / coefficient)]
    matrix = sympy.Matrix([[sympy.diff(r.expression, u) for u in unknowns] for r in block])
    zero = {u: sympy.Integer(0) for u in unknowns}
    rest = sympy.Matrix([-r.expression.xreplace(zero) for r in block])
    solution = matrix.LUsolve(rest)
    return [(u.name, sympy.together(value)) for u, value in zip(unknowns, solution, strict=True)]


def _is_nonlinear(expression: sympy.Expr, unknown: sympy.Symbol, unknowns: Sequence[sympy.Symbol]) -> bool:
    if is_opaque_in(expression, unknown):
        return True
    return bool(sympy.diff(expression, unknown).free_symbols & set(unknowns))


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
    for start in range(len(incidence)):
        _augment(start, incidence, match)
    return match


def _augment(start: int, incidence: Sequence[Sequence[int]], match: list[int | None]) -> None:
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
                _flip(column, start, came_from, match)
                return
            queue.append(owner)


def _flip(column: int, start: int, came_from: dict[int, int], match: list[int | None]) -> None:
    held = {row: j for j, row in enumerate(match) if row is not None}
    while True:
        row = came_from[column]
        match[column] = row
        if row == start:
            return
        column = held[row]


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
