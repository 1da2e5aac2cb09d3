"""Each partition balanced, aliases removed, index reduced, matched and sorted into blocks, blocks solved.

Takes: `ClockedSystem`. Gives: `SortedSystem`: assignments in the order in which they can be computed, and
nonlinear loops as `ImplicitBlock`s among them.
Guarantees: every unknown of a partition is assigned once, from states, crossings, parameters and unknowns
assigned before it.
Does not: put in numbers, or drop what nobody reads.

Variables joined rigidly are one state. The start value that counts is that of the state kept: of the
variables with a start value the one named first; those of the others are not looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from operator import itemgetter

from apc.compiler.equations.aliases import Aliases
from apc.compiler.equations.blocks import solve_blocks
from apc.compiler.equations.clocks import CONTINUOUS, ClockedPeerType, ClockedSystem, Partition
from apc.compiler.equations.derivatives import DifferentiatedNames
from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.index import IndexReduction
from apc.compiler.equations.reductions import PeerReduction, taken_apart
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
from apc.compiler.equations.zero_test import Divisors, Given
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.expression import Name, format_expression, names
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.values import AlreadyReportedError
from apc.compiler.scene.scene import Topology


@dataclass(frozen=True, slots=True)
class SortedPartition:
    """The unknowns of one clock (or the continuous ones), in the order in which they can be computed.

    A step is a pair of a name and the expression that gives it, or the `ImplicitBlock` of a nonlinear loop.
    """

    clock: str
    assignments: tuple[Step, ...]


@dataclass(frozen=True, slots=True)
class SortedSend:
    """What is sent over a link, as an expression in continuous unknowns."""

    name: str
    link: str
    unit: str
    expression: Term


@dataclass(frozen=True, slots=True)
class SortedPeerType:
    """A kind of peer as explicit equations. `aliases` are unknowns that equal ± another, or zero."""

    clocked: ClockedPeerType
    states: tuple[str, ...]
    aliases: tuple[Assignment, ...]
    partitions: tuple[SortedPartition, ...]
    samples: tuple[Assignment, ...]
    receives: tuple[PeerReduction, ...]
    sends: tuple[SortedSend, ...]

    @property
    def definitions(self) -> dict[Symbol, Definition]:
        """What gives each unknown and each sample its value."""
        result: dict[str, Definition] = {}
        for step in (step for part in self.partitions for step in part.assignments):
            result |= dict.fromkeys(step.unknowns, step) if isinstance(step, ImplicitBlock) else dict([step])
        return {symbol(name): item for name, item in (result | dict((*self.aliases, *self.samples))).items()}


@dataclass(frozen=True, slots=True)
class SortedSystem:
    """The scene as explicit equations."""

    scene: Topology
    kinds: tuple[SortedPeerType, ...]


def sort(clocked: ClockedSystem) -> SortedSystem:
    """Sort and solve every partition. Raises ApcError naming the equations and unknowns left over."""
    scene = clocked.scene
    mistakes = Mistakes(scene.names)
    kinds = []
    for kind in clocked.kinds:
        nonzero = {symbol("peers")} | {  # the parameters that no number can make zero
            symbol(f"{part.name}.{declared.name}")
            for part in kind.flat.parts
            for declared in part.component.numbers
            if declared.open_minimum and declared.minimum == 0
        }
        with mistakes:
            kinds.append(_sorted(kind, Divisors(nonzero, _numbers(scene, kind)), mistakes))
    mistakes.raise_if_any()
    return SortedSystem(scene, tuple(kinds))


def _numbers(scene: Topology, kind: ClockedPeerType) -> list[dict[Symbol, Given]]:
    """Return the numbers of each group of a kind, those that differ from peer to peer as they do."""
    common = {f"{part.name}.{name}": value for part in scene.parts for name, value in part.values}
    result = []
    for group in (group for group in scene.groups if group.name in kind.flat.groups):
        varying: dict[str, Given] = dict(group.columns)
        numbers: dict[str, Given] = {"peers": Fraction(scene.peers)}
        for name, value in (common | dict(group.values)).items():
            numbers[name] = value.number
            # Inside a part, what depends on a number that differs from peer to peer does so too.
            used = () if value.expression is None else map(format_expression, names(value.expression))
            if value.expression is not None and not varying.keys().isdisjoint(used):
                varying.setdefault(name, to_term(value.expression))
        result.append({symbol(name): number for name, number in (numbers | varying).items()})
    return result


def _sorted(kind: ClockedPeerType, divisors: Divisors, mistakes: Mistakes) -> SortedPeerType:
    """Sort and solve a kind. Raises ApcError with what stands in the way of the continuous equations."""

    def problem(where: str, part: Partition) -> Problem:
        place = next(
            (equation.place for equation in (*part.equations, *kind.flat.equations)),
            SourceLocation("topology"),
        )
        return Problem(where, place, divisors, mistakes)

    heard: dict[str, PeerReduction] = {}
    reductions: dict[Symbol, Term] = {}
    for crossing in kind.receives:
        reductions[symbol(crossing.symbol)], parts = taken_apart(crossing, mistakes)
        heard |= {part.symbol: part for part in parts if part.symbol not in heard}
    partitions = []
    for part in kind.partitions[1:]:
        its = problem(f"the equations of clock {part.clock}", part)
        with mistakes:
            equal = zip(part.equations, _sides(part.equations, None, its), strict=True)
            residuals = [
                Residual((left - right).xreplace(reductions), flat_equation)
                for flat_equation, (left, right) in equal
            ]
            steps = solve_blocks(residuals, [symbol(name) for name in part.variables], its)
            partitions.append(SortedPartition(part.clock, steps))
    states, aliases, steps, read = _sorted_continuous(
        kind, problem("the continuous equations", kind.partitions[0])
    )
    samples = zip((sample.symbol for sample in kind.samples), read, strict=False)
    sends = zip(kind.flat.sends, read[len(kind.samples) :], strict=True)
    return SortedPeerType(
        kind,
        states,
        aliases,
        (SortedPartition(CONTINUOUS, steps), *partitions),
        tuple(samples),
        tuple(heard.values()),
        tuple(
            SortedSend(flat_send.name, flat_send.link, format_dimension(flat_send.dimension), it)
            for flat_send, it in sends
        ),
    )


def _sorted_continuous(
    kind: ClockedPeerType, problem: Problem
) -> tuple[tuple[str, ...], tuple[Assignment, ...], tuple[Step, ...], list[Term]]:
    """Return states, aliases, steps, and what is sampled and sent. Raises ApcError where there is no way."""
    variables, equations = kind.partitions[0].variables, kind.partitions[0].equations
    started = {variable.name for variable in kind.flat.variables if variable.start}
    moving = DifferentiatedNames(dict.fromkeys(variables), {hold.symbol for hold in kind.holds})
    # What is read, each as an equation of its own, `sample(x) = x`, for messages.
    where = problem.place
    reads = [FlatEquation(Name((s.symbol,)), s.expression, s.clock, s.clock, where) for s in kind.samples]
    reads += [FlatEquation(Name((s.name,)), s.expression, s.link, None, s.place) for s in kind.flat.sends]
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
    asked = [
        *aliases.velocities,
        *(it for residual in read for it in moving.derivatives(residual.expression).values()),
    ]
    orders = {name: 0 for name in variables if name not in aliases.stands} | dict(
        sorted(asked, key=itemgetter(1))
    )
    reduction = IndexReduction(residuals, orders, moving, problem)
    solving, unknowns, differentiated = reduction.reduced({*map(aliases.value, started)})
    states = tuple(aliases.shown(s).name for s in differentiated)
    for state in (state for state in states if state not in started):
        holder = next((equation for equation in equations if f"der({state})" in equation.text), equations[0])
        what = f"{state} is a state, by `{holder.text}` ({holder.origin}), and has no start value"
        hint = f"{state.rpartition('.')[2]}: {{…, start: …}}"
        if state.startswith("der("):
            hint = f"{state} = v, with a start value for v"
        problem.mistakes.add("E510", holder.place, what, hint=hint)
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
