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

import sympy
from apc.compiler.blocks import Assignment, ImplicitBlock, Residual, Step, assigned, solve_blocks
from apc.compiler.clocks import (
    CONTINUOUS,
    ClockedKind,
    ClockedSystem,
    HoldCrossing,
    PreviousCrossing,
    ReceiveCrossing,
)
from apc.compiler.errors import Mistakes, Place
from apc.compiler.expression import Name
from apc.compiler.flatten import FlatEquation
from apc.compiler.index import Jet, Jets, JumpError, reduce_index, report_jump
from apc.compiler.scene import Scene
from apc.compiler.symbolic import symbol, to_sympy
from apc.compiler.units import format_dimension

__all__ = [
    "ImplicitBlock",
    "SortedKind",
    "SortedPartition",
    "SortedSend",
    "SortedSystem",
    "sort",
    "sort_kind",
]


@dataclass(frozen=True, slots=True)
class SortedPartition:
    """The unknowns of one clock (or the continuous ones), in the order in which they can be computed.

    A step is a pair of a name and the expression that gives it, or the `ImplicitBlock` of a nonlinear loop.
    """

    clock: str
    assignments: tuple[Step, ...]

    @property
    def definitions(self) -> dict[sympy.Symbol, sympy.Expr | ImplicitBlock]:
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
    expression: sympy.Expr


@dataclass(frozen=True, slots=True)
class SortedKind:
    """A kind of peer as explicit equations. `aliases` are unknowns that equal ± another, or zero."""

    clocked: ClockedKind
    states: tuple[str, ...]
    aliases: tuple[Assignment, ...]
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


def sort(clocked: ClockedSystem) -> SortedSystem:
    """Sort and solve every partition. Raises ApcError naming the equations and unknowns left over."""
    mistakes = Mistakes()
    nonzero = _positive_parameters(clocked.scene)
    kinds = tuple(sort_kind(kind, mistakes, nonzero=nonzero) for kind in clocked.kinds)
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


def sort_kind(kind: ClockedKind, mistakes: Mistakes, *, nonzero: Collection[str] = ()) -> SortedKind:
    """Sort and solve one kind.

    Mistakes: E502, E503, E507 to E509 as in `solve_blocks` and `reduce_index`; E510 a state has no start
    value. When there are any, the value returned is not whole.
    """
    continuous = kind.partitions[0]
    assert continuous.clock == CONTINUOUS
    jets = Jets(continuous.variables, (hold.symbol for hold in kind.holds))
    started = {variable.name for variable in kind.flat.variables if variable.start}
    divisors = [symbol(name) for name in nonzero]
    where = "the continuous equations"

    residuals = _residuals(continuous.equations, jets.differentiate, mistakes)
    origin = continuous.equations[0].place if continuous.equations else Place("topology")
    read = [FlatEquation(Name((s.symbol,)), s.expression, s.clock, s.clock, origin) for s in kind.samples] + [
        FlatEquation(Name((s.name,)), s.expression, s.link, None, s.place) for s in kind.sends
    ]
    values = [_right_side(equation, jets, mistakes) for equation in read]

    aliases = _Aliases(jets, continuous.variables, started)
    residuals = aliases.remove(residuals)
    values = [aliases.substitute(value) for value in values]
    # A derivative that is only sampled or sent has to be computed too: it gets an equation of its own.
    probes = _probes(read, values, jets)
    names = [*aliases.kept(), *probes]
    reduced = reduce_index([*residuals, *probes.values()], names, started, jets, where, mistakes)
    steps: tuple[Step, ...] = ()
    states: tuple[str, ...] = ()
    if reduced is not None:
        found = solve_blocks(reduced.residuals, reduced.unknowns, where, mistakes, nonzero=divisors)
        steps = tuple(step for step in found if probes.keys().isdisjoint(assigned(step)))
        states = tuple(s.name for s in reduced.states)
        _check_starts(states, started, reduced.residuals, mistakes)

    partitions = [SortedPartition(CONTINUOUS, steps)]
    for clock in kind.partitions[1:]:
        own = _residuals(clock.equations, _no_derivative, mistakes)
        unknowns = [symbol(name) for name in clock.variables]
        where = f"the equations of clock {clock.clock}"
        found = solve_blocks(own, unknowns, where, mistakes, nonzero=divisors)
        partitions.append(SortedPartition(clock.clock, found))
    sampled, sent = values[: len(kind.samples)], values[len(kind.samples) :]
    return SortedKind(
        kind,
        states,
        aliases.assignments(),
        tuple(partitions),
        tuple((s.symbol, s.clock, value) for s, value in zip(kind.samples, sampled, strict=True)),
        kind.holds,
        kind.previous,
        kind.receives,
        tuple(
            SortedSend(send.name, send.link, format_dimension(send.dimension), value)
            for send, value in zip(kind.sends, sent, strict=True)
        ),
    )


def _residuals(
    equations: Iterable[FlatEquation],
    differentiate: Callable[[sympy.Expr], sympy.Expr],
    mistakes: Mistakes,
) -> list[Residual]:
    found = []
    for equation in equations:
        try:
            difference = to_sympy(equation.left, differentiate) - to_sympy(equation.right, differentiate)
        except JumpError as jump:
            report_jump(Residual(sympy.S.Zero, equation), jump, mistakes)
            difference = sympy.S.Zero
        found.append(Residual(difference, equation))
    return found


def _right_side(equation: FlatEquation, jets: Jets, mistakes: Mistakes) -> sympy.Expr:
    try:
        return to_sympy(equation.right, jets.differentiate)
    except JumpError as jump:
        report_jump(Residual(sympy.S.Zero, equation), jump, mistakes)
        return sympy.S.Zero


def _no_derivative(expression: sympy.Expr) -> sympy.Expr:
    raise AssertionError("der stands in continuous equations only")


def _probes(read: Sequence[FlatEquation], values: Sequence[sympy.Expr], jets: Jets) -> dict[str, Residual]:
    """Return, for each derivative that is read, the equation `sampled der(x) = der(x)`, by its unknown."""
    probes: dict[str, Residual] = {}
    for equation, value in zip(read, values, strict=True):
        for derivative, (_, order) in jets.jets(value).items():
            name = f"sampled {derivative}"
            if order and name not in probes:
                probes[name] = Residual(jets.symbol(name, 0) - derivative, equation)
    return probes


def _check_starts(
    states: Iterable[str], started: Set[str], residuals: Sequence[Residual], mistakes: Mistakes
) -> None:
    for state in states:
        if state in started:
            continue
        holder = next(r for r in residuals if symbol(f"der({state})") in r.expression.free_symbols)
        if state.startswith("der("):
            what = f"{state} is a state of its own in {holder.shown} and has no start value"
            hint = f"a variable with a start value for it: {state} = v"
        else:
            what = f"{state} is a state, by {holder.shown}, and has no start value"
            hint = f"{state.rpartition('.')[2]}: {{…, start: …}}"
        mistakes.add("E510", holder.equation.place, what, hint=hint)


# ---- aliases ----


class _Aliases:
    """The equations a = b, a = -b and a = 0 between unknowns taken out, and what stands for what.

    Of two, the one with a start value stays; then the one a component declares, not the connector's:
    `device.x`, not `device.flange.x`; then the one named first. Where der(x) = v, v also stands for der(x)
    in all other equations, so that masses with one position are seen to have one velocity.
    """

    def __init__(self, jets: Jets, names: Sequence[str], started: Set[str]) -> None:
        self.jets = jets
        self.names = names
        self.rank = {name: (name not in started, name.count("."), j) for j, name in enumerate(names)}
        self.parent: dict[str, tuple[str, int]] = {}  # name -> ± another; sign 0: zero
        self.velocity: dict[str, tuple[str, int, int]] = {}  # x -> v, ±1, the row that says der(x) = ±v

    def kept(self) -> list[str]:
        """Return the names that stand for themselves."""
        return [name for name in self.names if name not in self.parent]

    def assignments(self) -> tuple[Assignment, ...]:
        """Return what each of the other names stands for."""
        return tuple((name, self._value(name, 0, "")) for name in self.names if name in self.parent)

    def substitute(self, expression: sympy.Expr, but: str = "") -> sympy.Expr:
        """Return the expression in the names kept; der(`but`) stays as it is."""
        jets = self.jets.jets(expression)
        return expression.xreplace({s: self._value(name, order, but) for s, (name, order) in jets.items()})

    def remove(self, residuals: Sequence[Residual]) -> list[Residual]:
        """Take the alias equations out, pass by pass until none is left; return the others, rewritten."""
        rows = dict(enumerate(residuals))
        changed = True
        while changed:
            changed = False
            for row, residual in list(rows.items()):
                own = next((x for x, (_, _, said) in self.velocity.items() if said == row), "")
                expression = self.substitute(residual.expression, own)
                rows[row] = Residual(expression, residual.equation)
                match self._pair(expression):
                    case ((one, 0), (two, 0), sign):
                        self._join(one, two, sign)
                        del rows[row]
                        changed = True
                    case ((x, 1), (v, 0), sign) | ((v, 0), (x, 1), sign) if (
                        not own and x not in self.velocity
                    ):
                        self.velocity[x] = (v, sign, row)
                        changed = True
        return list(rows.values())

    def _pair(self, expression: sympy.Expr) -> tuple[Jet, Jet, int] | None:
        """Return a, b and the sign of a = ±b; for a = 0, a twice and the sign 0; else None."""
        jets = self.jets.jets(expression)
        terms = [term.as_coeff_Mul() for term in sympy.Add.make_args(expression)]
        if not 1 <= len(terms) <= 2 or any(s not in jets for _, s in terms):
            return None
        (factor, one), (other_factor, two) = terms[0], terms[-1]
        if len(terms) == 1:
            return jets[one], jets[one], 0
        if abs(factor) != abs(other_factor):
            return None
        return jets[one], jets[two], -1 if factor == other_factor else 1

    def _join(self, one: str, two: str, sign: int) -> None:
        goes, stays = (one, two) if self.rank[one] >= self.rank[two] else (two, one)
        self.parent[goes] = (stays, sign)
        if goes not in self.velocity:
            return
        # With der(goes) = ±v and goes = ±stays, v is der(stays) up to a sign, unless that has one already:
        # then its row is an equation like any other, between two velocities.
        v, v_sign, row = self.velocity.pop(goes)
        if sign and stays not in self.velocity:
            self.velocity[stays] = (v, v_sign * sign, row)

    def _value(self, name: str, order: int, but: str) -> sympy.Expr:
        sign = 1
        while True:
            if name in self.parent:
                name, its_sign = self.parent[name]
            elif order and name in self.velocity and name != but:
                name, its_sign, _ = self.velocity[name]
                order -= 1
            else:
                return sign * self.jets.symbol(name, order)
            sign *= its_sign
            if not sign:
                return sympy.S.Zero
