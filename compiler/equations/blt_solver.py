"""Assignment of equations to unknowns, their order of evaluation, and the solution of each block.

Takes: equations as residuals, and the unknowns. Gives: `solve_blocks`: assignments and `ImplicitBlock`s;
`balanced`, the blocks alone.
Guarantees: every unknown is assigned once, from earlier assignments; linear blocks come out explicit.
Does not: differentiate anything (see `index`), or handle states and clocks.

Matched and sorted by `matching`, as usual in Modelica compilers (Cellier and Kofman, Continuous System
Simulation, ch. 7); a block of linear equations is solved by `elimination`. A nonlinear loop is left to an
iteration over few unknowns, from which the others follow one by one: it is torn (Elmqvist and Otter, Methods
for tearing systems of equations in object-oriented modeling, 1994).
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

# A loop of more guesses isn't asked whether it has one solution, nor more pieces of it between its corners.
MOST_GUESSES, MOST_PIECES = 3, 64
T = TypeVar("T")


def solve_blocks(
    residuals: Sequence[Residual], unknowns: Sequence[Symbol], problem: Problem
) -> tuple[Step, ...]:
    """Match, sort and solve.

    Parameters
    ----------
    residuals, unknowns
        As many equations as unknowns.
    problem
        Collects E503 a loop without an unknown to solve for, E511 linear equations that depend on each other,
        E512 a constant that is no number.

    Raises
    ------
    ApcError
        E502 equations or unknowns left over.
    """
    known = frozenset(unknowns)
    held = [residual.expression.free_symbols & known for residual in residuals]
    steps: list[Step] = []
    for rows, local in balanced(residuals, held, unknowns, problem):
        block = [residuals[row] for row in rows]
        with problem.mistakes:
            solved = _solved(block, local, problem)
            parts = [step.expressions if isinstance(step, ImplicitBlock) else step[1:] for step in solved]
            if any(is_no_number(expression) for part in parts for expression in part):
                raise problem.no_number(block)  # what was divided may cancel
            steps += solved
    return tuple(steps)


def balanced(
    residuals: Sequence[Residual], held: Sequence[Collection[T]], unknowns: Sequence[T], problem: Problem
) -> list[Block[T]]:
    """Return the strongly connected blocks, in order, of equations solved for their unknowns.

    Parameters
    ----------
    residuals
        The equations.
    held, unknowns
        As `match` takes them; unknowns are shown by their text.
    problem
        The names of the equations.

    Raises
    ------
    ApcError
        E502 which equations and which unknowns are too many.
    """
    left_over, over, under, blocks = match(held, unknowns)
    if not (left_over or under[1]):
        return blocks
    parts = []
    (too_many, theirs), (holding, open_) = (
        ([residuals[i] for i in rows], [*map(str, some)]) for rows, some in (over, under)
    )
    if too_many:
        only = f"only {counted(len(theirs), 'unknown')} ({listed(theirs)})" if theirs else "no unknown"
        verb = "holds" if len(too_many) == 1 else "hold"
        parts.append(f"{counted(len(too_many), 'equation')} {verb} {only}: {listed(too_many)}")
    if open_:
        by = f"only {counted(len(holding), 'equation')}, {listed(holding)}" if holding else "no equation"
        has = "has" if len(open_) == 1 else "have"
        parts.append(f"{counted(len(open_), 'unknown')} ({listed(open_)}) {has} {by}")
    message = f"{problem.where} can't be solved: {'; and '.join(parts)}"
    raise problem.fault("E502", [residuals[i] for i in left_over] or residuals, message)


def _solved(block: Sequence[Residual], unknowns: Sequence[Symbol], problem: Problem) -> Sequence[Step]:
    """Return the solution of one block, explicit if linear."""
    known = frozenset(unknowns)
    linear = [form for residual in block if (form := linear_form(residual.expression, known)) is not None]
    if len(linear) == len(block):
        steps, free = eliminate(linear, unknowns, problem.divisors)
        if free:
            message = f"depend on each other and don't determine {listed([item.name for item in free])}"
            raise problem.fault("E511", block, f"{problem.where} {message}: {listed(block)}")
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
        message = f"{problem.where} {fault}: {loop.chain}, by {listed(block)}"
        raise problem.fault("E503", block, message)
    return (loop,)


def _torn(block: Sequence[Residual], unknowns: Sequence[Symbol], divisors: Divisors) -> ImplicitBlock:
    """Tear a block: a heuristic for few iteration variables, from which the others follow one by one.

    When no equation computes an unknown, the open unknown in most of the open equations is torn, of several
    the one that fewest of them could compute. A computed unknown is linear in its equation, with a factor
    that is free of the loop's unknowns and isn't zero for all values.
    """
    members = frozenset(unknowns)
    holds = [residual.expression.free_symbols & members for residual in block]

    @functools.cache
    def solved(i: int, unknown: Symbol) -> Term | None:
        """Return an unknown from an equation, None if it cannot be determined."""
        form = linear_form(block[i].expression, {unknown})
        factor = form[0].get(unknown, ZERO) if form else ZERO
        if form is None or factor.free_symbols & members or divisors.is_zero(factor):
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
        ready = next((pair for pair in single if solved(*pair) is not None), None)
        if ready is None:
            torn.append(max(remaining, key=gain))
            del remaining[torn[-1]]
        else:
            inner.append((ready[1].name, solved(*ready)))
            del left[ready[0]], remaining[ready[1]]
    names, guesses = (tuple(item.name for item in some) for some in (unknowns, torn))
    return ImplicitBlock(names, guesses, tuple(inner), tuple(block[i].expression for i in left))


def _is_open(residuals: Sequence[Term], guesses: Sequence[Symbol], divisors: Divisors) -> bool:
    """Return whether between corners the residuals don't depend on the guesses, or only on some."""
    if len(guesses) > MOST_GUESSES:
        return False
    try:
        slopes = sympy.Matrix([[slope(residual, guess) for guess in guesses] for residual in residuals])
    except NoDerivativeError:
        return False
    with dotprodsimp(False):  # which would expand it
        pieces = islice(_pieces(slopes.det(method="laplace")), MOST_PIECES)
    return any(divisors.is_zero(piece) or divisors.vanishes(piece) for piece in pieces)


def _pieces(term: Term) -> Iterator[Term]:
    """Yield the smooth pieces of a term, one for each choice of branches and signs."""
    node = next((item for item in sympy.preorder_traversal(term) if isinstance(item, If | sympy.sign)), None)
    if node is None:
        yield term
    else:
        for branch in node.args[1:] if isinstance(node, If) else (ONE, -ONE):
            yield from _pieces(term.xreplace({node: branch}))
