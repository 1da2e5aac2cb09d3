"""Which equation computes which unknown, in which order, and how each block of them is solved.

Takes: equations as residuals, and the unknowns. Gives: `solve_blocks`: assignments and `ImplicitBlock`s.
Guarantees: every unknown is assigned once, from what was assigned before; linear blocks come out explicit.
Does not: differentiate anything (see `index`), or know of states and clocks.

Matched and sorted by `matching`, the usual way of Modelica compilers (Cellier and Kofman, Continuous System
Simulation, ch. 7); a block of linear equations is solved by `elimination`. A nonlinear loop is left to an
iteration over few unknowns, from which the others follow one by one: it is torn (Elmqvist and Otter, Methods
for tearing systems of equations in object-oriented modeling, 1994).
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from math import prod

import sympy
from sympy.matrices import dotprodsimp

from apc.compiler.equations.elimination import eliminate
from apc.compiler.equations.matching import Incidence, alternating, match_columns, strong_components
from apc.compiler.equations.solution import (
    MOST_LISTED,
    Assignment,
    ImplicitBlock,
    Problem,
    Residual,
    Step,
    listed,
)
from apc.compiler.equations.terms import (
    Abs,
    If,
    Max,
    NoDerivativeError,
    Symbol,
    Term,
    is_no_number,
    linear_form,
    slope,
    symbol,
)
from apc.compiler.equations.zero_test import Divisors
from apc.compiler.words import counted

# A loop of more guesses isn't asked whether it has one solution, nor more pieces of it between its corners.
MOST_GUESSES, MOST_PIECES = 3, 64
BENT = (If, Max, Abs, sympy.Abs, sympy.sign, sympy.floor)


def solve_blocks(
    residuals: Sequence[Residual], unknowns: Sequence[Symbol], problem: Problem
) -> tuple[Step, ...]:
    """Match, sort and solve.

    Parameters
    ----------
    residuals, unknowns
        As many equations as unknowns; a mistake if not.
    problem
        Takes E502 equations or unknowns left over, E503 a loop without an unknown to solve for, E511 linear
        equations that depend on each other, E512 what is no number.
    """
    columns = {unknown: j for j, unknown in enumerate(unknowns)}
    incidence = [sorted(columns[s] for s in r.expression.free_symbols & columns.keys()) for r in residuals]
    match = match_columns(incidence, len(unknowns))
    if not len(residuals) == len(unknowns) == len(match):
        report_singular(residuals, [unknown.name for unknown in unknowns], incidence, match, problem)
        return ()
    column_of = {row: column for column, row in match.items()}
    # Row i needs the rows that compute its other unknowns.
    needs = [[match[j] for j in held if match[j] != i] for i, held in enumerate(incidence)]
    steps: list[Step] = []
    for rows in strong_components(needs):
        block = [residuals[row] for row in rows]
        solved = _solved(block, [unknowns[j] for j in sorted(column_of[row] for row in rows)], problem)
        parts = [one.expressions if isinstance(one, ImplicitBlock) else one[1:] for one in solved]
        if any(is_no_number(expression) for part in parts for expression in part):
            problem.report_no_number(block)  # what was divided may cancel
        else:
            steps += solved
    return tuple(steps)


def report_singular(
    residuals: Sequence[Residual],
    unknowns: Sequence[str],
    incidence: Incidence,
    match: Mapping[int, int],
    problem: Problem,
) -> None:
    """Add the mistake E502: which equations and which unknowns are too many.

    Parameters
    ----------
    residuals, unknowns
        The equations, and the names of what they are to give.
    incidence
        For each equation the places of its unknowns.
    match
        The unknowns that are given, each with its equation.
    problem
        Takes the mistake.
    """
    columns = {row: column for column, row in match.items()}
    holders = [[i for i, held in enumerate(incidence) if j in held] for j in range(len(unknowns))]
    unmatched = [i for i in range(len(residuals)) if i not in columns]
    over, over_columns = alternating(unmatched, incidence, match)
    free = [j for j in range(len(unknowns)) if j not in match]
    under_columns, under = alternating(free, holders, columns)
    parts = []
    if over:
        names = [unknowns[j] for j in over_columns]
        only = f"only {counted(len(names), 'unknown')} ({listed(names)})" if names else "no unknown"
        parts.append(f"{counted(len(over), 'equation')} hold {only}: {listed([residuals[i] for i in over])}")
    if under_columns:
        names = [unknowns[j] for j in under_columns]
        by = f"only {counted(len(under), 'equation')}, {listed([residuals[i] for i in under])}"
        has = f"{'has' if len(names) == 1 else 'have'} {by if under else 'no equation'}"
        parts.append(f"{counted(len(names), 'unknown')} ({listed(names)}) {has}")
    first = [residuals[i] for i in unmatched] or residuals
    problem.report("E502", first, f"{problem.where} can't be solved: {'; and '.join(parts)}")


def _solved(block: Sequence[Residual], unknowns: Sequence[Symbol], problem: Problem) -> Sequence[Step]:
    """Return what gives the unknowns of one block, explicit where it is linear in them."""
    known = frozenset(unknowns)
    forms = [linear_form(residual.expression, known) for residual in block]
    linear = [form for form in forms if form is not None]
    if len(linear) == len(forms):
        steps, free = eliminate(linear, unknowns, problem.divisors)
        if free:
            what = f"depend on each other and don't determine {listed([one.name for one in free])}"
            problem.report("E511", block, f"{problem.where} {what}: {listed(block)}")
        return steps
    loop = _torn(block, unknowns, problem.divisors)
    residuals = loop.residuals
    for name, value in reversed(loop.inner if len(loop.inner) <= MOST_LISTED else ()):
        residuals = tuple(residual.xreplace({symbol(name): value}) for residual in residuals)
    fault = ""
    if not all(residual.free_symbols for residual in residuals):
        fault = "hold a loop without an unknown left to solve for"
    elif _is_open(residuals, [symbol(name) for name in loop.tearing], problem.divisors):
        fault = "hold a loop that many values solve, or none"
    if fault:
        problem.report("E503", block, f"{problem.where} {fault}: {loop.chain}, by {listed(block)}")
    return () if fault else (loop,)


def _torn(block: Sequence[Residual], unknowns: Sequence[Symbol], divisors: Divisors) -> ImplicitBlock:
    """Guess as few unknowns as simply found, so that the others follow one by one.

    When no equation computes an unknown, the open unknown in most of the open equations is torn, of several
    the one that fewest of them could compute. What is computed stands linearly in its equation, with a factor
    that is free of the loop's unknowns and isn't zero for all values.
    """
    members = frozenset(unknowns)
    holds = [residual.expression.free_symbols & members for residual in block]

    @functools.cache
    def solved(i: int, unknown: Symbol) -> Term | None:
        """Return an unknown by an equation, None where it can't be told from that."""
        form = linear_form(block[i].expression, frozenset((unknown,)))
        factor = form and form[0].get(unknown)
        if not form or factor is None or factor.free_symbols & members or divisors.is_zero(factor):
            return None
        return -form[1] / factor

    def gain(unknown: Symbol) -> tuple[int, int]:
        rows = [i for i in left if unknown in holds[i]]
        return len(rows), -sum(solved(i, unknown) is not None for i in rows)

    left, remaining = dict.fromkeys(range(len(block))), dict.fromkeys(unknowns)
    inner: list[Assignment] = []
    torn: list[Symbol] = []
    while remaining:
        single = ((i, *still) for i in left if len(still := holds[i] & remaining.keys()) == 1)
        ready = next(((i, unknown) for i, unknown in single if solved(i, unknown) is not None), None)
        if ready is None:
            torn.append(max(remaining, key=gain))
            del remaining[torn[-1]]
        else:
            inner.append((ready[1].name, solved(*ready)))
            del left[ready[0]], remaining[ready[1]]
    names, guesses = (tuple(one.name for one in some) for some in (unknowns, torn))
    return ImplicitBlock(names, guesses, tuple(inner), tuple(block[i].expression for i in left))


def _is_open(residuals: Sequence[Term], guesses: Sequence[Symbol], divisors: Divisors) -> bool:
    """Return whether between corners the residuals don't depend on the guesses, or only on some."""
    bent = {node for one in residuals for node in one.atoms(*BENT)}
    pieces = min(MOST_PIECES, prod(len(_branches(node)) for node in bent))
    for number in range(pieces if len(guesses) <= MOST_GUESSES else 0):
        piece = _piece(residuals, number)
        try:
            slopes = sympy.Matrix([[slope(one, guess) for guess in guesses] for one in piece])
        except NoDerivativeError:
            continue
        with dotprodsimp(False):  # which would expand it
            determinant = slopes.det(method="laplace")
        if divisors.is_zero(determinant) or divisors.vanishes(determinant):
            return True
    return False


def _piece(residuals: Sequence[Term], number: int) -> list[Term]:
    """Return what residuals are between their corners and jumps, by the number of a choice of branches."""
    chosen: dict[Term, Term] = {}

    def choose(node: Term) -> Term:
        nonlocal number
        if node not in chosen:
            branches = _branches(node)
            number, digit = divmod(number, len(branches))
            chosen[node] = branches[digit]
        return chosen[node]

    return [one.replace(lambda node: isinstance(node, BENT), choose) for one in residuals]


def _branches(node: Term) -> tuple[Term, ...]:
    """Return what a node is on either side of its corners; what jumps is constant between jumps."""
    if isinstance(node, If | Max):
        return tuple(node.args[isinstance(node, If) :])
    is_size = isinstance(node, Abs | sympy.Abs)
    return (node.args[0], -node.args[0]) if is_size else (symbol(f"constant {node}"),)
