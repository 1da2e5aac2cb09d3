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

from collections.abc import Callable, Collection, Iterable, Sequence, Set
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
from apc.compiler.equations.derivatives import Derivatives
from apc.compiler.equations.flatten import FlatEquation
from apc.compiler.equations.index import reduce_index, report_no_derivative
from apc.compiler.equations.residuals import SCENE, Residual, report_no_number
from apc.compiler.equations.solution import Assignment, ImplicitBlock, Step, assigned
from apc.compiler.equations.symbolic import is_no_number, no_derivative, to_term
from apc.compiler.equations.terms import ZERO, NoDerivativeError, Symbol, Term, symbol
from apc.compiler.equations.zero_test import NOTHING_VANISHES, Given, Vanishing
from apc.compiler.errors import Mistakes
from apc.compiler.language.expression import Expr, Name, names
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
        sort_kind(kind, mistakes, nonzero=nonzero, vanishes=Vanishing(_numbers(clocked.scene, kind)))
        for kind in clocked.kinds
    )
    mistakes.raise_if_any()
    return SortedSystem(clocked.scene, kinds)


def _positive_parameters(scene: Scene) -> list[str]:
    """Return the parameters that no number can make zero: they are safe to divide by."""
    return ["peers"] + [
        f"{part.name}.{declared.name}"
        for part in scene.parts
        for declared in part.component.parameters
        if getattr(declared, "open_minimum", False) and getattr(declared, "minimum", None) == 0
    ]


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


def sort_kind(
    kind: ClockedKind,
    mistakes: Mistakes,
    *,
    nonzero: Collection[str] = (),
    vanishes: Vanishing = NOTHING_VANISHES,
) -> SortedKind:
    """Sort and solve one kind; when there are mistakes, the value returned is not whole.

    Parameters
    ----------
    kind
        A kind of peer, partitioned by clock.
    mistakes
        Takes E502, E503, E508, E509 and E511 as in `solve_blocks` and `reduce_index`, and E510 a state has no
        start value.
    nonzero
        Parameters that no number can make zero.
    vanishes
        Whether an expression is zero with the scene's numbers; what is divided by must not be.
    """
    divisors = [symbol(name) for name in nonzero]
    continuous = _sort_continuous(kind, divisors, vanishes, mistakes)
    partitions = [SortedPartition(CONTINUOUS, continuous.steps)]
    for clock in kind.partitions[1:]:
        own = _residuals(clock.equations, no_derivative, mistakes)
        if len(own) < len(clock.equations):
            continue
        unknowns = [symbol(name) for name in clock.variables]
        where = f"the equations of clock {clock.clock}"
        place = next((one.place for one in (*clock.equations, *kind.flat.equations)), SCENE)
        found = solve_blocks(own, unknowns, where, mistakes, nonzero=divisors, vanishes=vanishes, place=place)
        partitions.append(SortedPartition(clock.clock, found))
    return SortedKind(
        kind,
        continuous.states,
        continuous.aliases,
        tuple(partitions),
        tuple((s.symbol, s.clock, e) for s, e in zip(kind.samples, continuous.sampled, strict=False)),
        kind.holds,
        kind.previous,
        kind.receives,
        tuple(
            SortedSend(send.name, send.link, format_dimension(send.dimension), expression)
            for send, expression in zip(kind.sends, continuous.sent, strict=False)
        ),
    )


@dataclass(frozen=True, slots=True)
class _Continuous:
    """The continuous partition, and what is sampled and sent of it."""

    states: tuple[str, ...] = ()
    aliases: tuple[Assignment, ...] = ()
    steps: tuple[Step, ...] = ()
    sampled: tuple[Term, ...] = ()
    sent: tuple[Term, ...] = ()


def _sort_continuous(
    kind: ClockedKind, divisors: Sequence[Symbol], vanishes: Vanishing, mistakes: Mistakes
) -> _Continuous:
    partition = kind.partitions[0]
    assert partition.clock == CONTINUOUS
    where = "the continuous equations"
    held = [hold.symbol for hold in kind.holds]
    started = {variable.name for variable in kind.flat.variables if variable.start}
    place = next((one.place for one in (*partition.equations, *kind.flat.equations)), SCENE)
    # What is read, each as an equation of its own, `sample(x) = x`, for messages.
    reads = [FlatEquation(Name((s.symbol,)), s.expression, s.clock, s.clock, place) for s in kind.samples]
    reads += [FlatEquation(Name((s.name,)), s.expression, s.link, None, s.place) for s in kind.sends]
    derivatives = Derivatives(partition.variables, held)
    residuals = _residuals(partition.equations, derivatives.differentiate, mistakes)
    values = [_value(read, read.right, derivatives.differentiate, mistakes) for read in reads]
    if len(residuals) < len(partition.equations) or None in values:
        return _Continuous()

    aliases = Aliases(derivatives, partition.variables, started)
    residuals = aliases.remove(residuals)
    read_values = [aliases.substitute(value) for value in values if value is not None]
    put_in = [Residual(value, read) for value, read in zip(read_values, reads, strict=True)]
    if none := [one for one in (*residuals, *put_in) if is_no_number(one.expression)]:
        report_no_number([one.shown for one in none], none[0].equation.place, mistakes)
        return _Continuous()
    derivatives = derivatives.renamed(aliases.kept, aliases.velocities)
    probes = _probes(reads, read_values, derivatives)
    reduced = reduce_index(
        [*residuals, *probes.values()],
        derivatives.names,
        started,
        derivatives,
        where,
        mistakes,
        vanishes,
        place,
    )
    if reduced is None:
        return _Continuous()
    states = tuple(s.name for s in reduced.states)
    _check_starts(states, started, partition.equations, mistakes)
    named = tuple((f"der({x})", symbol(v)) for x, v in aliases.velocities.items() if x in states)
    solved = solve_blocks(
        reduced.residuals,
        reduced.unknowns,
        where,
        mistakes,
        nonzero=divisors,
        vanishes=vanishes,
        place=place,
    )
    return _Continuous(
        states,
        aliases.assignments,
        (
            *(step for step in named if step[1].name in states),
            *(step for step in solved if probes.keys().isdisjoint(assigned(step))),
            *(step for step in named if step[1].name not in states),
        ),
        tuple(read_values[: len(kind.samples)]),
        tuple(read_values[len(kind.samples) :]),
    )


def _residuals(
    equations: Sequence[FlatEquation],
    differentiate: Callable[[Term], Term],
    mistakes: Mistakes,
) -> list[Residual]:
    """Return the equations as residuals, without those whose derivatives don't exist."""
    found = []
    for equation in equations:
        left = _value(equation, equation.left, differentiate, mistakes)
        right = _value(equation, equation.right, differentiate, mistakes)
        if left is not None and right is not None:
            found.append(Residual(left - right, equation))
    return found


def _value(
    equation: FlatEquation,
    expression: Expr,
    differentiate: Callable[[Term], Term],
    mistakes: Mistakes,
) -> Term | None:
    try:
        value = to_term(expression, differentiate)
    except NoDerivativeError as missing:
        report_no_derivative(Residual(ZERO, equation), missing, mistakes)
        return None
    if is_no_number(value):
        report_no_number([Residual(value, equation).shown], equation.place, mistakes)
        return None
    return value


def _probes(
    reads: Sequence[FlatEquation], values: Sequence[Term], derivatives: Derivatives
) -> dict[str, Residual]:
    """Return, for each derivative that is sampled or sent, the equation `sampled der(x) = der(x)`.

    It makes sure that the derivative is computed, even if no other equation holds it.
    """
    probes: dict[str, Residual] = {}
    for read, value in zip(reads, values, strict=True):
        for derivative, (_, order) in derivatives.derivatives(value).items():
            name = f"sampled {derivative}"
            if order and name not in probes:
                probes[name] = Residual(derivatives.add(name) - derivative, read)
    return probes


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
