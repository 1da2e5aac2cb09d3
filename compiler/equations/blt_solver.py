"""Assignment of equations to unknowns, their order of evaluation, and the solution of each block.

Takes: equations as residuals, and the unknowns. Gives: `solve_blocks`: assignments and `ImplicitBlock`s;
`balanced`, the blocks alone.
Guarantees: every unknown is assigned once, from earlier assignments; linear blocks are solved explicitly.
Does not: differentiate anything (see `index`), or handle states and clocks.

Equations are matched and sorted by `matching`, as usual in Modelica compilers (Cellier and Kofman, Continuous
System Simulation, ch. 7); a block of linear equations is solved by `elimination`. A nonlinear loop is reduced
by tearing to an iteration over few unknowns, and the other unknowns are computed in sequence (Elmqvist and
Otter, Methods for tearing systems of equations in object-oriented modeling, 1994).
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Iterator, Sequence
from itertools import islice
from typing import TypeVar

import sympy
from sympy.matrices import dotprodsimp

from apc.compiler.equations.divisor_test import Divisors
from apc.compiler.equations.elimination import eliminate
from apc.compiler.equations.matching import Block, match
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
    ONE,
    ZERO,
    If,
    NoDerivativeError,
    Symbol,
    Term,
    is_no_number,
    linear_form,
    slope,
    symbol,
)
from apc.compiler.wording import counted

# Loops with more tearing unknowns, and further smooth pieces of a determinant, are not tested for unique
# solutions.
MOST_TEARING, MOST_PIECES = 3, 64
T = TypeVar("T")


def solve_blocks(
    residuals: Sequence[Residual], unknowns: Sequence[Symbol], problem: Problem
) -> tuple[Step, ...]:
    """Return the solution of equations, in order of evaluation: assignments and implicit blocks.

    Parameters
    ----------
    residuals, unknowns
        As many equations as unknowns.
    problem
        The test of divisors and the collector of errors: E503 a loop without an unknown to solve for, E511
        linearly dependent equations, E512 a constant that is not a number.

    Raises
    ------
    ApcError
        E502 unmatched equations or unknowns.
    """
    known = frozenset(unknowns)
    incidence = [residual.expression.free_symbols & known for residual in residuals]
    steps: list[Step] = []
    for rows, block_unknowns in balanced(residuals, incidence, unknowns, problem):
        block = [residuals[row] for row in rows]
        with problem.mistakes:
            solved = _block_solution(block, block_unknowns, problem)
            parts = [step.expressions if isinstance(step, ImplicitBlock) else step[1:] for step in solved]
            if any(is_no_number(expression) for part in parts for expression in part):
                raise problem.no_number(block)  # an undefined constant may result from the division
            steps += solved
    return tuple(steps)


def balanced(
    residuals: Sequence[Residual], held: Sequence[Collection[T]], unknowns: Sequence[T], problem: Problem
) -> list[Block[T]]:
    """Return the strongly connected blocks of equations and unknowns, in order of evaluation.

    Parameters
    ----------
    residuals
        The equations.
    held, unknowns
        The unknowns of each equation, and all unknowns, as in `match`; messages contain their texts.
    problem
        The context of the equations for messages.

    Raises
    ------
    ApcError
        E502 unmatched equations or unknowns.
    """
    unmatched_rows, over, under, blocks = match(held, unknowns)
    if not (unmatched_rows or under[1]):
        return blocks
    for name, equation in problem.cancelled.items():
        if name in map(str, under[1]):
            message = f"{name} cancels in `{equation.text}`, and no other equation determines it"
            raise problem.fault("E502", [Residual(ZERO, equation)], message)
    parts = []
    (too_many, theirs), (holding, open_) = (
        ([residuals[i] for i in rows], [*map(str, some)]) for rows, some in (over, under)
    )
    if too_many:
        only = f"only {counted(len(theirs), 'unknown')} ({listed(theirs)})" if theirs else "no unknown"
        verb = "contains" if len(too_many) == 1 else "contain"
        parts.append(f"{counted(len(too_many), 'equation')} {verb} {only}: {listed(too_many)}")
    if open_:
        by = f"only {counted(len(holding), 'equation')}, {listed(holding)}" if holding else "no equation"
        has = "has" if len(open_) == 1 else "have"
        parts.append(f"{counted(len(open_), 'unknown')} ({listed(open_)}) {has} {by}")
    message = f"{problem.where} can't be solved: {'; and '.join(parts)}"
    raise problem.fault("E502", [residuals[i] for i in unmatched_rows] or residuals, message)


def _block_solution(
    block: Sequence[Residual], unknowns: Sequence[Symbol], problem: Problem
) -> Sequence[Step]:
    """Return the solution of one block: assignments if all equations are linear, else an implicit block."""
    known = frozenset(unknowns)
    linear = [form for residual in block if (form := linear_form(residual.expression, known)) is not None]
    if len(linear) == len(block):
        steps, free = eliminate(linear, unknowns, problem.divisors)
        if free:
            message = f"are linearly dependent and do not determine {listed([item.name for item in free])}"
            raise problem.fault("E511", block, f"{problem.where} {message}: {listed(block)}")
        return steps
    loop = _tear(block, unknowns, problem.divisors)
    residuals = loop.residuals
    for name, value in reversed(loop.inner if len(loop.inner) <= MOST_LISTED else ()):
        residuals = tuple(residual.xreplace({symbol(name): value}) for residual in residuals)
    fault = ""
    if not all(residual.free_symbols for residual in residuals):
        fault = "contain an algebraic loop without an unknown"
    elif _is_open(residuals, [symbol(name) for name in loop.tearing], problem.divisors):
        fault = "contain a singular algebraic loop"
    if fault:
        message = f"{problem.where} {fault}: {loop.chain}, by {listed(block)}"
        raise problem.fault("E503", block, message)
    return (loop,)


def _tear(block: Sequence[Residual], unknowns: Sequence[Symbol], divisors: Divisors) -> ImplicitBlock:
    """Return a nonlinear block with few tearing unknowns, chosen by a heuristic, from which the others are
    computed.

    If no equation determines an unknown, the unknown in most of the remaining equations becomes a tearing
    unknown; of several the one that the fewest equations could determine. A computed unknown is linear in its
    equation, with a factor that contains no unknown of the block and isn't zero for all values.
    """
    members = frozenset(unknowns)
    incidence = [residual.expression.free_symbols & members for residual in block]

    @functools.cache
    def solved(i: int, unknown: Symbol) -> Term | None:
        """Return the value of an unknown by equation i, or None if the equation does not determine it."""
        form = linear_form(block[i].expression, {unknown})
        factor = form[0].get(unknown, ZERO) if form else ZERO
        if form is None or factor.free_symbols & members or divisors.is_zero(factor):
            return None
        return -form[1] / factor

    def gain(unknown: Symbol) -> tuple[int, int]:
        """Return the rank of a tearing unknown: number of its equations, minus the number that
        determine it.
        """
        rows = [i for i in open_rows if unknown in incidence[i]]
        return len(rows), -sum(solved(i, unknown) is not None for i in rows)

    open_rows, remaining = dict.fromkeys(range(len(block))), dict.fromkeys(unknowns)
    inner: list[Assignment] = []
    torn: list[Symbol] = []
    while remaining:
        single = ((i, *still) for i in open_rows if len(still := incidence[i] & remaining.keys()) == 1)
        ready = next((pair for pair in single if solved(*pair) is not None), None)
        if ready is None:
            torn.append(max(remaining, key=gain))
            del remaining[torn[-1]]
        else:
            inner.append((ready[1].name, solved(*ready)))
            del open_rows[ready[0]], remaining[ready[1]]
    names, tearing = (tuple(item.name for item in symbols) for symbols in (unknowns, torn))
    return ImplicitBlock(names, tearing, tuple(inner), tuple(block[i].expression for i in open_rows))


def _is_open(residuals: Sequence[Term], guesses: Sequence[Symbol], divisors: Divisors) -> bool:
    """Return whether a nonlinear block has no unique solution: its Jacobian is singular on a smooth piece.

    `guesses` are the tearing unknowns; False if there are too many or a derivative does not exist.
    """
    if len(guesses) > MOST_TEARING:
        return False
    try:
        slopes = sympy.Matrix([[slope(residual, guess) for guess in guesses] for residual in residuals])
    except NoDerivativeError:
        return False
    with dotprodsimp(False):  # the simplification would expand the determinant
        pieces = islice(_pieces(slopes.det(method="laplace")), MOST_PIECES)
    return any(divisors.is_zero(piece) or divisors.vanishes(piece) for piece in pieces)


def _pieces(term: Term) -> Iterator[Term]:
    """Yield the smooth pieces of a term: one for each choice of branches and signs."""
    node = next((item for item in sympy.preorder_traversal(term) if isinstance(item, If | sympy.sign)), None)
    if node is None:
        yield term
    else:
        for branch in node.args[1:] if isinstance(node, If) else (ONE, -ONE):
            yield from _pieces(term.xreplace({node: branch}))
