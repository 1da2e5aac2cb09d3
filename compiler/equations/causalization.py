"""Causalization: partitions balanced, aliases removed, index reduced, matched, sorted and solved.

Takes: `ClockedSystem`. Gives: `sort`, a `SortedSystem` of `SortedPeerType`s: assignments in the order in
which they can be computed, with nonlinear loops as `ImplicitBlock`s.
Guarantees: every unknown of a partition is assigned once, from states, crossings, parameters and unknowns
assigned before it.
Does not: substitute parameter values, or drop unused variables.

Variables joined rigidly are one state. The start value that counts is that of the state kept: of the
variables with a start value the one named first; those of the others are ignored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
    """The unknowns of one clock (or the continuous ones), in the order in which they can be computed.

    A step is a pair of a name and the expression that gives it, or the `ImplicitBlock` of a nonlinear loop.
    """

    clock: str
    assignments: tuple[Step, ...]


@dataclass(frozen=True, slots=True)
class SortedSend:
    """A send over a link, as an expression in continuous unknowns."""

    name: str
    link: str
    unit: str
    expression: Term


@dataclass(frozen=True, slots=True)
class SortedPeerType:
    """A peer type as explicit equations. `aliases` are unknowns that equal ± another, or zero."""

    clocked: ClockedPeerType
    states: tuple[str, ...]
    aliases: tuple[Assignment, ...]
    partitions: tuple[SortedPartition, ...]
    samples: tuple[Assignment, ...]
    receives: tuple[PeerReduction, ...]
    sends: tuple[SortedSend, ...]

    @property
    def definitions(self) -> dict[Symbol, Definition]:
        """The assignment of each unknown and each sample."""
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
    """Sort and solve every partition. Raises ApcError naming the equations and unknowns left over."""
    topology = clocked.topology
    mistakes = Mistakes(topology.names)
    peer_types = []
    for peer_type in clocked.peer_types:
        nonzero = {symbol("peers")} | {  # the parameters that no number can make zero
            symbol(f"{part.name}.{declared.name}")
            for part in peer_type.flat.parts
            for declared in part.component.numbers
            if declared.exclusive_minimum and declared.minimum == 0
        }
        with mistakes:
            peer_types.append(_sorted(peer_type, Divisors(nonzero, _numbers(topology, peer_type)), mistakes))
    mistakes.raise_if_any()
    return SortedSystem(topology, tuple(peer_types))


def _numbers(topology: Topology, peer_type: ClockedPeerType) -> list[dict[Symbol, Given]]:
    """Return the numbers of each group of a peer type, those that differ from peer to peer as they do."""
    common = {f"{part.name}.{name}": value for part in topology.parts for name, value in part.values}
    result = []
    for group in (group for group in topology.groups if group.name in peer_type.flat.groups):
        varying: dict[str, Given] = dict(group.columns)
        numbers: dict[str, Given] = {"peers": Fraction(topology.peers)}
        for name, value in (common | dict(group.values)).items():
            numbers[name] = value.number
            # Inside a part, what depends on a number that differs from peer to peer does so too.
            used = () if value.expression is None else map(format_expression, names(value.expression))
            if value.expression is not None and not varying.keys().isdisjoint(used):
                varying.setdefault(name, to_term(value.expression))
        result.append({symbol(name): number for name, number in (numbers | varying).items()})
    return result


def _sorted(peer_type: ClockedPeerType, divisors: Divisors, mistakes: Mistakes) -> SortedPeerType:
    """Sort and solve a peer type. Raises ApcError with the errors of the continuous equations."""

    def problem(where: str, part: Partition) -> Problem:
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
            equal = zip(part.equations, _sides(part.equations, None, clock_problem), strict=True)
            residuals = [
                Residual((left - right).xreplace(reductions), flat_equation)
                for flat_equation, (left, right) in equal
            ]
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
    """Return states, aliases, steps, sampled and sent values. Raises ApcError if impossible."""
    variables, equations = peer_type.partitions[0].variables, peer_type.partitions[0].equations
    started = {variable.name for variable in peer_type.flat.variables if variable.start}
    moving = DifferentiatedNames(dict.fromkeys(variables), {hold.symbol for hold in peer_type.holds})
    # What is read, each as an equation of its own, `sample(x) = x`, for messages.
    where = problem.location
    reads = [
        FlatEquation(Name((s.symbol,)), s.expression, s.clock, s.clock, where) for s in peer_type.samples
    ]
    reads += [
        FlatEquation(Name((s.name,)), s.expression, s.link, None, s.location) for s in peer_type.flat.sends
    ]
    sides = _sides((*equations, *reads), moving.differentiate, problem)
    aliases = Aliases(moving, started)
    residuals = aliases.remove(
        [Residual(left - right, equation) for equation, (left, right) in zip(equations, sides, strict=False)]
    )
    values = zip(reads, sides[len(equations) :], strict=True)
    read = [Residual(aliases.substitute(value), flat_equation) for flat_equation, (_, value) in values]
    if none := [residual for residual in (*residuals, *read) if is_no_number(residual.expression)]:
        raise problem.no_number(none)
    # A derivative that has a name of its own, or that is read, is asked for, even if no equation holds it.
    requested = [
        *aliases.velocities,
        *(it for residual in read for it in moving.derivatives(residual.expression).values()),
    ]
    orders = {name: 0 for name in variables if name not in aliases.replacements} | dict(
        sorted(requested, key=itemgetter(1))
    )
    reduction = IndexReduction(residuals, orders, moving, problem)
    solving, unknowns, differentiated = reduction.reduced({*map(aliases.value, started)})
    states = tuple(aliases.shown(s).name for s in differentiated)
    for state in (state for state in states if state not in started):
        holder = next((equation for equation in equations if f"der({state})" in equation.text), equations[0])
        message = f"{state} is a state, by `{holder.text}` ({holder.origin}), and has no start value"
        hint = f"{state.rpartition('.')[2]}: {{…, start: …}}"
        if state.startswith("der("):
            hint = f"{state} = v, with a start value for v"
        problem.mistakes.add("E510", holder.location, message, hint=hint)
    shown = [Residual(aliases.shown(residual.expression), residual.equation) for residual in solving]
    steps = solve_blocks(shown, [aliases.shown(s) for s in unknowns], problem)
    below = {v: aliases.shown(derivative(x, order - 1)).name for (x, order), v in aliases.velocities.items()}
    rates = [(f"der({x})", symbol(v)) for v, x in below.items() if x in states]
    pairs = [rate for rate in rates if rate[1].name in states]
    steps = (*pairs, *steps, *(rate for rate in rates if rate not in pairs))
    return states, aliases.assignments(), steps, [aliases.shown(residual.expression) for residual in read]


def _sides(
    equations: Sequence[FlatEquation], differentiate: Callable[[Term], Term] | None, problem: Problem
) -> list[tuple[Term, Term]]:
    """Return both sides of equations. Raises ApcError for derivatives and constants that do not exist."""
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
