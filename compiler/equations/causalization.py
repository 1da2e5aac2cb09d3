"""Causalization: alias elimination, index reduction, matching, sorting and solution of each partition.

Takes: `ClockedSystem`. Gives: `sort`, a `SortedSystem` of `SortedPeerType`s: assignments in the order in
which they can be computed, with nonlinear loops as `ImplicitBlock`s.
Guarantees: every unknown of a partition is assigned once, from states, crossings, parameters and unknowns
assigned before it.
Does not: substitute parameter values, or drop unused variables.

Rigidly coupled variables have one state: of the variables with a start value, the first one. The start values
of the other variables are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from operator import itemgetter

from apc.compiler.equations.aliases import Aliases
from apc.compiler.equations.blt_solver import solve_blocks
from apc.compiler.equations.clocks import CONTINUOUS, ClockedPeerType, ClockedSystem, Partition
from apc.compiler.equations.derivatives import DifferentiatedNames
from apc.compiler.equations.divisor_test import Divisors, Given
from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.index import IndexReduction
from apc.compiler.equations.linear_decomposition import PeerReduction, linear_decomposition
from apc.compiler.equations.solution import Assignment, Definition, ImplicitBlock, Problem, Residual, Step
from apc.compiler.equations.terms import (
    ZERO,
    NoDerivativeError,
    Symbol,
    Term,
    derivative,
    is_no_number,
    symbol,
    to_term,
)
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.expression import Name, format_expression, names
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import AlreadyReportedError
from apc.compiler.topology.topology import Topology


@dataclass(frozen=True, slots=True)
class SortedPartition:
    """The unknowns of one clock (or the continuous unknowns), in the order in which they can be computed.

    A step is a pair of a name and the expression of its value, or the `ImplicitBlock` of a nonlinear loop.
    """

    clock: str
    assignments: tuple[Step, ...]


@dataclass(frozen=True, slots=True)
class SortedSend:
    """A value sent over a link, as an expression in continuous unknowns."""

    name: str
    link: str
    unit: str
    expression: Term


@dataclass(frozen=True, slots=True)
class SortedPeerType:
    """A peer type as explicit equations.

    `aliases` are unknowns that equal another unknown, its negative, or zero. `partitions` are the steps of
    each clock, first of the continuous unknowns; `samples` and `sends` are expressions in continuous
    unknowns; `receives` are the reductions over received values.
    """

    clocked: ClockedPeerType
    states: tuple[str, ...]
    aliases: tuple[Assignment, ...]
    partitions: tuple[SortedPartition, ...]
    samples: tuple[Assignment, ...]
    receives: tuple[PeerReduction, ...]
    sends: tuple[SortedSend, ...]

    @property
    def definitions(self) -> dict[Symbol, Definition]:
        """The definition of each unknown and each sample: a term or an implicit block."""
        result: dict[str, Definition] = {}
        for step in (step for part in self.partitions for step in part.assignments):
            result |= dict.fromkeys(step.unknowns, step) if isinstance(step, ImplicitBlock) else dict([step])
        return {symbol(name): item for name, item in (result | dict((*self.aliases, *self.samples))).items()}


@dataclass(frozen=True, slots=True)
class SortedSystem:
    """The topology as explicit equations."""

    topology: Topology
    peer_types: tuple[SortedPeerType, ...]


def sort(clocked: ClockedSystem) -> SortedSystem:
    """Return the explicit equations of all peer types, partition by partition.

    Raises ApcError with all errors, such as unmatched equations and unknowns.
    """
    topology = clocked.topology
    mistakes = Mistakes(topology.names)
    peer_types = []
    for peer_type in clocked.peer_types:
        nonzero = {symbol("peers")} | {  # the parameters that must be positive
            symbol(f"{part.name}.{declared.name}")
            for part in peer_type.flat.parts
            for declared in part.component.numbers
            if declared.exclusive_minimum and declared.minimum == 0
        }
        with mistakes:
            peer_types.append(
                _sorted_peer_type(peer_type, Divisors(nonzero, _numbers(topology, peer_type)), mistakes)
            )
    mistakes.raise_if_any()
    return SortedSystem(topology, tuple(peer_types))


def _numbers(topology: Topology, peer_type: ClockedPeerType) -> list[dict[Symbol, Given]]:
    """Return the numbers of each group of a peer type: one value, or one per peer, or an expression.

    An expression is used for a number that depends on a number with one value per peer.
    """
    common = {f"{part.name}.{name}": value for part in topology.parts for name, value in part.values}
    result = []
    for group in (group for group in topology.groups if group.name in peer_type.flat.groups):
        varying: dict[str, Given] = dict(group.columns)
        numbers: dict[str, Given] = {"peers": Fraction(topology.peers)}
        for name, value in (common | dict(group.values)).items():
            numbers[name] = value.number
            # A number inside a part that depends on a number with one value per peer has one value per peer
            # too.
            used = () if value.expression is None else map(format_expression, names(value.expression))
            if value.expression is not None and not varying.keys().isdisjoint(used):
                varying.setdefault(name, to_term(value.expression))
        result.append({symbol(name): number for name, number in (numbers | varying).items()})
    return result


def _sorted_peer_type(peer_type: ClockedPeerType, divisors: Divisors, mistakes: Mistakes) -> SortedPeerType:
    """Return the explicit equations of a peer type.

    Raises ApcError with the errors of the continuous equations; the errors of clocked equations are added to
    `mistakes`.
    """

    def problem(where: str, part: Partition) -> Problem:
        """Return the context of the equations of one partition, named `where` in messages."""
        location = next(
            (equation.location for equation in (*part.equations, *peer_type.flat.equations)),
            SourceLocation("topology"),
        )
        return Problem(where, location, divisors, mistakes)

    received: dict[str, PeerReduction] = {}
    reductions: dict[Symbol, Term] = {}
    for crossing in peer_type.receives:
        reductions[symbol(crossing.symbol)], parts = linear_decomposition(crossing, mistakes)
        received |= {part.symbol: part for part in parts if part.symbol not in received}
    partitions = []
    for part in peer_type.partitions[1:]:
        clock_problem = problem(f"the equations of clock {part.clock}", part)
        with mistakes:
            equation_sides = zip(part.equations, _sides(part.equations, None, clock_problem), strict=True)
            residuals = [
                Residual((left - right).xreplace(reductions), flat_equation)
                for flat_equation, (left, right) in equation_sides
            ]
            cancelled = _cancelled(residuals, part, lambda term: {s.name for s in term.free_symbols})
            clock_problem = replace(clock_problem, cancelled=cancelled)
            steps = solve_blocks(residuals, [symbol(name) for name in part.variables], clock_problem)
            partitions.append(SortedPartition(part.clock, steps))
    states, aliases, steps, read = _sorted_continuous(
        peer_type, problem("the continuous equations", peer_type.partitions[0])
    )
    samples = zip((sample.symbol for sample in peer_type.samples), read, strict=False)
    sends = zip(peer_type.flat.sends, read[len(peer_type.samples) :], strict=True)
    return SortedPeerType(
        peer_type,
        states,
        aliases,
        (SortedPartition(CONTINUOUS, steps), *partitions),
        tuple(samples),
        tuple(received.values()),
        tuple(
            SortedSend(flat_send.name, flat_send.link, format_dimension(flat_send.dimension), it)
            for flat_send, it in sends
        ),
    )


def _sorted_continuous(
    peer_type: ClockedPeerType, problem: Problem
) -> tuple[tuple[str, ...], tuple[Assignment, ...], tuple[Step, ...], list[Term]]:
    """Return the equations of the continuous partition in the order in which they can be computed.

    Returns
    -------
    tuple of str
        The states.
    tuple of Assignment
        The eliminated variables, each as a term in the retained ones.
    tuple of Step
        The steps that compute the derivatives of the states and the other unknowns.
    list of Term
        The sampled values, then the sent values.

    Raises
    ------
    ApcError
        The equations cannot be solved.
    """
    variables, equations = peer_type.partitions[0].variables, peer_type.partitions[0].equations
    started = {variable.name for variable in peer_type.flat.variables if variable.start}
    time_varying = DifferentiatedNames(dict.fromkeys(variables), {hold.symbol for hold in peer_type.holds})
    # Sampled and sent values, each as an equation `sample(x) = x`, for messages.
    where = problem.location
    read_equations = [
        FlatEquation(Name((s.symbol,)), s.expression, s.clock, s.clock, where) for s in peer_type.samples
    ]
    read_equations += [
        FlatEquation(Name((s.name,)), s.expression, s.link, None, s.location) for s in peer_type.flat.sends
    ]
    sides = _sides((*equations, *read_equations), time_varying.differentiate, problem)
    aliases = Aliases(time_varying, started)
    residuals = [
        Residual(left - right, equation) for equation, (left, right) in zip(equations, sides, strict=False)
    ]
    cancelled = _cancelled(
        residuals,
        peer_type.partitions[0],
        lambda term: {name for name, _ in time_varying.derivatives(term).values()},
    )
    problem = replace(problem, cancelled=cancelled)
    residuals = aliases.remove(residuals)
    values = zip(read_equations, sides[len(equations) :], strict=True)
    read_residuals = [
        Residual(aliases.substitute(value), flat_equation) for flat_equation, (_, value) in values
    ]
    if invalid := [
        residual for residual in (*residuals, *read_residuals) if is_no_number(residual.expression)
    ]:
        raise problem.no_number(invalid)
    # A derivative with a variable name, or one that is sampled or sent, is required even if no equation has
    # it.
    required = [
        *aliases.named_derivatives,
        *(
            required_derivative
            for residual in read_residuals
            for required_derivative in time_varying.derivatives(residual.expression).values()
        ),
    ]
    orders = {name: 0 for name in variables if name not in aliases.replacements} | dict(
        sorted(required, key=itemgetter(1))
    )
    reduction = IndexReduction(residuals, orders, time_varying, problem)
    solving, unknowns, differentiated = reduction.reduced({*map(aliases.value, started)})
    states = tuple(aliases.shown(s).name for s in differentiated)
    for state in (state for state in states if state not in started):
        holder = next((equation for equation in equations if f"der({state})" in equation.text), equations[0])
        message = f"the state {state} (by `{holder.text}` of {holder.origin}) has no start value"
        advice = f"add start: 0 to the variable {state.rpartition('.')[2]}"
        if state.startswith("der("):
            advice = f"write {state} = v and add start: 0 to the variable v"
        problem.mistakes.add("E510", holder.location, message, advice=advice)
    shown = [Residual(aliases.shown(residual.expression), residual.equation) for residual in solving]
    steps = solve_blocks(shown, [aliases.shown(s) for s in unknowns], problem)
    # The derivative of a state with a variable name has the value of this variable: known at first if it is a
    # state, else after the step that computes it.
    integrals = {
        alias: aliases.shown(derivative(x, order - 1)).name
        for (x, order), alias in aliases.named_derivatives.items()
    }
    rates = [(f"der({x})", symbol(alias)) for alias, x in integrals.items() if x in states]
    state_rates = [rate for rate in rates if rate[1].name in states]
    steps = (*state_rates, *steps, *(rate for rate in rates if rate not in state_rates))
    return (
        states,
        aliases.assignments(),
        steps,
        [aliases.shown(residual.expression) for residual in read_residuals],
    )


def _cancelled(
    residuals: Sequence[Residual], part: Partition, unknowns_of: Callable[[Term], set[str]]
) -> dict[str, FlatEquation]:
    """Return the unknowns of a partition that are in the text of an equation, but not in its residual.

    `unknowns_of` returns the names of the unknowns in a term.
    """
    unknowns = {*part.variables}
    result: dict[str, FlatEquation] = {}
    for residual in residuals:
        sides = (residual.equation.left, residual.equation.right)
        written = {format_expression(name) for side in sides for name in names(side)}
        for name in sorted(written & unknowns - unknowns_of(residual.expression)):
            result.setdefault(name, residual.equation)
    return result


def _sides(
    equations: Sequence[FlatEquation], differentiate: Callable[[Term], Term] | None, problem: Problem
) -> list[tuple[Term, Term]]:
    """Return both sides of each equation as terms.

    `differentiate` returns the time derivative of a term, None if `der` cannot occur. Raises errors for
    derivatives and constants that do not exist.
    """
    pairs = []
    for equation in equations:
        with problem.mistakes:
            try:
                sides = (to_term(equation.left, differentiate), to_term(equation.right, differentiate))
            except NoDerivativeError as missing:
                raise problem.no_derivative(Residual(ZERO, equation), missing) from missing
            if any(map(is_no_number, sides)):
                raise problem.no_number([Residual(ZERO, equation)])
            pairs.append(sides)
    if len(pairs) < len(equations):
        raise AlreadyReportedError
    return pairs
