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

from collections.abc import Callable, Iterable, Sequence, Set
from dataclasses import dataclass
from fractions import Fraction

from apc.compiler.equations.aliases import Aliases
from apc.compiler.equations.blocks import solve_blocks
from apc.compiler.equations.clock_inference import CONTINUOUS
from apc.compiler.equations.clocks import (
    ClockedKind,
    ClockedSystem,
    HoldCrossing,
    PreviousCrossing,
    ReceiveCrossing,
)
from apc.compiler.equations.derivatives import Moving, derivative
from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.index import IndexReduction
from apc.compiler.equations.residuals import SCENE, Residual, report_no_derivative, report_no_number
from apc.compiler.equations.solution import Assignment, ImplicitBlock, Step, assigned
from apc.compiler.equations.symbolic import is_no_number, no_derivative, to_term
from apc.compiler.equations.terms import ZERO, NoDerivativeError, Symbol, Term, symbol
from apc.compiler.equations.zero_test import Divisors, Given
from apc.compiler.errors import Mistakes, Place
from apc.compiler.language.expression import Name, names
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.scene.scene import Scene


@dataclass(frozen=True, slots=True)
class SortedPartition:
    """The unknowns of one clock (or the continuous ones), in the order in which they can be computed.

    A step is a pair of a name and the expression that gives it, or the `ImplicitBlock` of a nonlinear loop.
    """

    clock: str
    assignments: tuple[Step, ...]

    @property
    def definitions(self) -> dict[Symbol, Term | ImplicitBlock]:
        """What gives each unknown its value."""
        return {
            symbol(name): step if isinstance(step, ImplicitBlock) else step[1]
            for step in self.assignments
            for name in assigned(step)
        }


@dataclass(frozen=True, slots=True)
class SortedSend:
    """What is sent over a link, as an expression in continuous unknowns."""

    name: str
    link: str
    unit: str
    expression: Term


@dataclass(frozen=True, slots=True)
class SortedKind:
    """A kind of peer as explicit equations. `aliases` are unknowns that equal ± another, or zero."""

    clocked: ClockedKind
    states: tuple[str, ...]
    aliases: tuple[Assignment, ...]
    partitions: tuple[SortedPartition, ...]
    samples: tuple[tuple[str, str, Term], ...]  # (symbol, clock, expression)
    holds: tuple[HoldCrossing, ...]
    previous: tuple[PreviousCrossing, ...]
    receives: tuple[ReceiveCrossing, ...]
    sends: tuple[SortedSend, ...]


@dataclass(frozen=True, slots=True)
class SortedSystem:
    """The scene as explicit equations."""

    scene: Scene
    kinds: tuple[SortedKind, ...]


def sort(clocked: ClockedSystem) -> SortedSystem:
    """Sort and solve every partition. Raises ApcError naming the equations and unknowns left over."""
    mistakes = Mistakes(clocked.scene.names)
    nonzero = _positive_parameters(clocked.scene)
    kinds = tuple(
        sort_kind(kind, mistakes, Divisors(nonzero, _numbers(clocked.scene, kind))) for kind in clocked.kinds
    )
    mistakes.raise_if_any()
    return SortedSystem(clocked.scene, kinds)


def _positive_parameters(scene: Scene) -> set[Symbol]:
    """Return the parameters that no number can make zero: they are safe to divide by."""
    return {symbol("peers")} | {
        symbol(f"{part.name}.{declared.name}")
        for part in scene.parts
        for declared in part.component.parameters
        if getattr(declared, "open_minimum", False) and getattr(declared, "minimum", None) == 0
    }


def _numbers(scene: Scene, kind: ClockedKind) -> list[dict[Symbol, Given]]:
    """Return the numbers of each group of a kind, those that differ from peer to peer as they do."""
    common = {f"{part.name}.{name}": value for part in scene.parts for name, value in part.values}
    found = []
    for group in scene.groups:
        if group.name not in kind.flat.groups:
            continue
        columns: dict[str, Given] = dict(group.columns)
        numbers: dict[str, Given] = {"peers": Fraction(scene.peers)}
        for name, value in (common | dict(group.values)).items():
            numbers[name] = value.number
            if value.expression is None or name in columns:
                continue
            # Inside a part, what depends on a number that differs from peer to peer does so too.
            if any(".".join(node.parts) in columns for node in names(value.expression)):
                columns[name] = to_term(value.expression, no_derivative)
        found.append({symbol(name): number for name, number in (numbers | columns).items()})
    return found


def sort_kind(kind: ClockedKind, mistakes: Mistakes, divisors: Divisors | None = None) -> SortedKind:
    """Sort and solve one kind; when there are mistakes, the value returned is not whole.

    Parameters
    ----------
    kind
        A kind of peer, partitioned by clock.
    mistakes
        Takes E502, E503, E508, E509, E511 and E512 as in `solve_blocks` and `IndexReduction`, and E510 a
        state has no start value.
    divisors
        What may be divided by.
    """
    divisors = divisors or Divisors()
    continuous = _sort_continuous(kind, divisors, mistakes) or _Continuous()
    partitions = [SortedPartition(CONTINUOUS, continuous.steps)]
    for clock in kind.partitions[1:]:
        sides = _sides(clock.equations, no_derivative, mistakes)
        if sides is not None:
            residuals = _residuals(clock.equations, sides)
            unknowns = [symbol(name) for name in clock.variables]
            where, place = f"the equations of clock {clock.clock}", _place(kind, clock.equations)
            steps = solve_blocks(residuals, unknowns, where, mistakes, divisors, place)
            partitions.append(SortedPartition(clock.clock, steps))
    sent = continuous.read[len(kind.samples) :]
    return SortedKind(
        kind,
        continuous.states,
        continuous.aliases,
        tuple(partitions),
        tuple((s.symbol, s.clock, e) for s, e in zip(kind.samples, continuous.read, strict=False)),
        kind.holds,
        kind.previous,
        kind.receives,
        tuple(
            SortedSend(send.name, send.link, format_dimension(send.dimension), expression)
            for send, expression in zip(kind.sends, sent, strict=False)
        ),
    )


@dataclass(frozen=True, slots=True)
class _Continuous:
    """The continuous partition, and what is sampled and sent of it."""

    states: tuple[str, ...] = ()
    aliases: tuple[Assignment, ...] = ()
    steps: tuple[Step, ...] = ()
    read: tuple[Term, ...] = ()


def _sort_continuous(kind: ClockedKind, divisors: Divisors, mistakes: Mistakes) -> _Continuous | None:
    partition = kind.partitions[0]
    assert partition.clock == CONTINUOUS
    where, place = "the continuous equations", _place(kind, partition.equations)
    variables = dict.fromkeys(partition.variables)
    moving = Moving(variables.keys(), {hold.symbol for hold in kind.holds})
    # What is read, each as an equation of its own, `sample(x) = x`, for messages.
    reads = [FlatEquation(Name((s.symbol,)), s.expression, s.clock, s.clock, place) for s in kind.samples]
    reads += [FlatEquation(Name((s.name,)), s.expression, s.link, None, s.place) for s in kind.sends]
    sides = _sides(partition.equations, moving.differentiate, mistakes)
    values = _sides(reads, moving.differentiate, mistakes)
    if sides is None or values is None:
        return None

    started = {variable.name for variable in kind.flat.variables if variable.start}
    aliases = Aliases(moving, partition.variables, started)
    residuals = aliases.remove(_residuals(partition.equations, sides))
    read = [Residual(aliases.substitute(value), at) for (_, value), at in zip(values, reads, strict=True)]
    if none := [one for one in (*residuals, *read) if is_no_number(one.expression)]:
        report_no_number(none, mistakes)
        return None
    # A derivative that has a name of its own, or that is read, is asked for, even if no equation holds it.
    asked = [*aliases.velocities, *(it for one in read for it in moving.derivatives(one.expression).values())]
    orders = {name: 0 for name in variables if name not in aliases.stands}
    for name, order in asked:
        orders[name] = max(orders[name], order)
    begun = {aliases.value(name) for name in started}
    reduction = IndexReduction(residuals, orders, moving, where, mistakes, divisors)
    reduced = reduction.reduced(begun, place)
    if reduced is None:
        return None
    states = tuple(aliases.shown(s).name for s in reduced.states)
    _check_starts(states, started, partition.equations, mistakes)
    solved = solve_blocks(
        [Residual(aliases.shown(one.expression), one.equation) for one in reduced.residuals],
        [aliases.shown(s) for s in reduced.unknowns],
        where,
        mistakes,
        divisors,
        place,
    )
    below = {v: aliases.shown(derivative(x, order - 1)).name for (x, order), v in aliases.velocities.items()}
    named = [(f"der({x})", symbol(v)) for v, x in below.items() if x in states]
    return _Continuous(
        states,
        aliases.assignments(),
        (
            *(step for step in named if step[1].name in states),
            *solved,
            *(step for step in named if step[1].name not in states),
        ),
        tuple(aliases.shown(one.expression) for one in read),
    )


def _place(kind: ClockedKind, equations: Sequence[FlatEquation]) -> Place:
    """Return where to point when nothing better is known."""
    return next((one.place for one in (*equations, *kind.flat.equations)), SCENE)


def _sides(
    equations: Sequence[FlatEquation], differentiate: Callable[[Term], Term], mistakes: Mistakes
) -> list[tuple[Term, Term]] | None:
    """Return both sides of equations; None where a derivative doesn't exist, or a constant is no number."""
    found = []
    for equation in equations:
        try:
            sides = (to_term(equation.left, differentiate), to_term(equation.right, differentiate))
        except NoDerivativeError as missing:
            report_no_derivative(Residual(ZERO, equation), missing, mistakes)
            continue
        if any(map(is_no_number, sides)):
            report_no_number([Residual(ZERO, equation)], mistakes)
        else:
            found.append(sides)
    return found if len(found) == len(equations) else None


def _residuals(equations: Sequence[FlatEquation], sides: Sequence[tuple[Term, Term]]) -> list[Residual]:
    return [Residual(left - right, one) for (left, right), one in zip(sides, equations, strict=True)]


def _check_starts(
    states: Iterable[str], started: Set[str], equations: Sequence[FlatEquation], mistakes: Mistakes
) -> None:
    for state in states:
        if state in started:
            continue
        holder = next((e for e in equations if f"der({state})" in e.text), equations[0])
        what = f"{state} is a state, by `{holder.text}` ({holder.origin}), and has no start value"
        hint = f"{state.rpartition('.')[2]}: {{…, start: …}}"
        if state.startswith("der("):
            hint = f"{state} = v, with a start value for v"
        mistakes.add("E510", holder.place, what, hint=hint)
