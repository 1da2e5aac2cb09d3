"""The evaluator of a system's matrices over some of its parameters, whatever kind of scene it is.

Takes: a `CompiledSystem` and the parameters that vary.
Gives: `evaluator`, `evaluator_of_many`, `PointEvaluator`; `Asked`; `many_packets`;
`free_parameters`, `reaches_time`, `reaches_count`, `overrides_at`.
Guarantees: peers that are alike at some values only are kept apart.
Does not: vary times (see `delays`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import CompiledSystem, Group, Parameter, group_count
from apc.compiler.errors import ApcError, Mistake, Place
from apc.eigen.closing import ClosedSystem
from apc.eigen.modes import split
from apc.eigen.peers import PeerGroup, states_of
from apc.eigen.relative import relative_bounded, relative_coordinates
from apc.eigen.rigid import RigidModes, find_rigid_modes
from apc.frame.exchange import Exchange
from apc.frame.instance import Prepared, prepare
from apc.frame.names import Free, is_named, parameter_of
from apc.frame.overrides import Override, apply
from apc.frame.parameters import free_rows, scope_of
from apc.frame.radius import UNIT
from apc.vary.batch import BatchEvaluator, Evaluator, batch_evaluator
from apc.vary.wiring import wire

Floats = NDArray[np.float64]
Places = NDArray[np.intp]
Truths = NDArray[np.bool_]

# What each free parameter is moved by, relatively, where peers are told apart: no other number of a scene
# agrees with such a value by accident. The next one is moved by a little more.
GENERIC = Fraction(1, 1024) + Fraction(1, 65537)

# The step of a central difference, relative to the value: the cube root of the unit roundoff, which balances
# what is cut off against rounding (both near 1e-10).
DIFFERENCE = 2.0**-17


# What CasADi's evaluation of a site's Jacobians at its start rounds, in units of UNIT: each entry is a few
# dozen operations, and an exponential makes no more of it than the entry is large.
JACOBIAN_ROUNDINGS = 64

# An eigenvalue left this near to 1 asks for the exact search for drifts: a pair at 1 is scattered by rounding
# to the square root of 1e-15, and ten times that.
DRIFT = 1e-6

# States of one system beyond which no range of values is looked at: a hundred matrices and more are held at a
# time, each with the vectors of its eigenvalues. Of 250 states a range takes ten seconds and half a GB.
MOST_STATES = 300

# Evaluators kept for the next question of the same parameters: another range of theirs, say.
KEPT = 8

# So many sets of motions that are free somewhere are told apart; points beyond go alone.
MOST_ALIKE = 8

# The blocks of a point that has no matrix.
NOTHING = [(np.full((1, 1), np.nan), np.full((1, 1), np.nan))]


@dataclass(frozen=True, slots=True, eq=False)
class PointEvaluator:
    """An `Evaluator` of a scene that is linearized at its start: every point goes the ordinary way.

    All closed systems are blocks of one matrix, filled up with zeros where a point has fewer states than
    another. Derivatives are central differences, right to about 1e-10.

    `start`, where there is one, is from `analysis.prepare_at_start`: points at which the same motions are
    free are taken together then, by one of `alike`, with exact derivatives; the others go alone.
    """

    system: CompiledSystem
    free: tuple[Free, ...]
    prepared: Prepared
    start: Prepared | None = None
    alike: list[BatchEvaluator] = field(default_factory=list)

    @property
    def names(self) -> tuple[str, ...]:
        """One name: all systems are blocks of one matrix."""
        return ("all systems",)

    @property
    def same_shape(self) -> bool:
        """A point may have other states than the next."""
        return False

    def states(self) -> int:
        """Return how many states the largest closed system has, with the scene's own numbers."""
        systems = split(*lifted_groups(self.system, prepared=self.prepared))
        return max((len(system.matrix) for system in systems), default=0)

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the reduced frame matrices of all systems as blocks (k, n, n) at values (k, m).

        All of a matrix is NaN where there is none: below a parameter's minimum, say.
        """
        which, listed = self._alike(values)
        for row in np.flatnonzero(which < 0).tolist():
            listed[row] = self._blocks(values[row])
        return (_filled_up(listed),)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the matrices (k, n, n) and their derivatives along directions (k, m).

        At the end of what a parameter may be, or of where the same motions are free, the derivative is that
        of the parabola through two points further inside; NaN where there is none.
        """
        which, _ = self._alike(values)
        matrices: list[list[Floats]] = [[] for _ in values]
        slopes: list[list[Floats]] = [[] for _ in values]
        for place in range(-1, len(self.alike)):
            rows = np.flatnonzero(which == place)
            if len(rows):
                those = self._differences if place < 0 else self.alike[place].slopes
                for result, slope in those(values[rows], along[rows]):
                    _put_in(matrices, rows, result)
                    _put_in(slopes, rows, slope)
        return ((_filled_up(matrices), _filled_up(slopes)),)

    def _differences(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the matrices and derivatives of `slopes` of points that go alone."""
        scale = np.where(values == 0, 1.0, np.maximum(np.abs(values), 1e-6))  # 0 has none: its unit's
        step = DIFFERENCE * np.where(along != 0, scale, np.inf).min(axis=1) / np.abs(along).max(axis=1)
        moved = step[:, None] * along
        points = np.concatenate([values, values - moved, values + moved])
        blocks = [self._blocks(value) for value in points]
        closed_system, before, after = np.split(_filled_up(blocks), 3)
        slope = (after - before) / (2 * step[:, None, None])
        shapes = [[len(values) for values in block] for block in blocks]
        count = len(values)
        for row in range(count):
            if shapes[row] == shapes[count + row] == shapes[2 * count + row]:
                continue
            slope[row] = np.nan
            way = 1.0 if shapes[row] == shapes[2 * count + row] else -1.0
            inside = [self._blocks(value) for value in values[row] + way * np.outer([1.0, 2.0], moved[row])]
            if all([len(values) for values in listed] == shapes[row] for listed in inside):
                _, second, third = _filled_up([blocks[row], *inside])
                size = len(second)
                slope[row] = 0.0
                slope[row, :size, :size] = (
                    way * (4 * second - 3 * closed_system[row, :size, :size] - third) / (2 * step[row])
                )
        return ((closed_system, slope),)

    def closed_at(self, value: Sequence[float]) -> tuple[ClosedSystem, ...]:
        """Return the closed systems at one point (m,), as an analysis has them."""
        overrides = overrides_at(self.system, self.free, value)
        return split(*lifted_groups(apply(self.system, overrides), prepared=self.prepared))

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, n, n) on the errors of the matrices at values (k, m), entry by entry."""
        return (_filled_up_pairs([self._bounded(value) for value in values])[1],)

    def _alike(self, values: Floats) -> tuple[Places, list[list[Floats]]]:
        """Return which of `alike` takes each point (k,), −1 where none does, and the matrices of each.

        A point is taken where the motions left out are free and no other is: no eigenvalue is next to 1.
        """
        which = np.full(len(values), -1)
        listed: list[list[Floats]] = [[] for _ in values]
        if self.start is None:
            return which, listed
        still: Truths = np.asarray(np.isfinite(values).all(axis=1))
        place = 0
        while still.any() and place < MOST_ALIKE:
            rows = np.flatnonzero(still)
            if place == len(self.alike):
                still[rows[0]] = False  # whatever comes of it, it is not tried again
                try:
                    self.alike.append(_around(self, values[rows[0]], self.start))
                except ApcError:
                    continue
            blocks = self.alike[place].matrices(values[rows])
            sure = np.all([_is_apart(block) for block in blocks], axis=0)
            which[rows[sure]], still[rows[sure]] = place, False
            for block in blocks:
                _put_in(listed, rows[sure], block[sure])
            place += 1
        return which, listed

    def _blocks(self, value: Floats) -> list[Floats]:
        """Return each system's matrix in relative coordinates at a point (m,); NaN where there is none."""
        return [matrix for matrix, _ in self._bounded(value)]

    def _bounded(self, value: Floats) -> list[tuple[Floats, Floats]]:
        """Return each system's matrix in relative coordinates with a bound on its error; NaN for none."""
        if not np.isfinite(value).all():  # a search along a boundary that has lost it
            return NOTHING
        try:
            systems = self.closed_at(value.tolist())
        except ApcError:
            return NOTHING
        pairs = []
        for system in systems:
            free = find_rigid_modes(system, with_drifts=False)
            reduced = _reduced(system, free)
            if not np.isfinite(reduced[0]).all():
                return NOTHING
            if free.names and np.abs(np.linalg.eigvals(reduced[0]) - 1).min(initial=np.inf) < DRIFT:
                reduced = _reduced(system, find_rigid_modes(system))
            pairs.append(reduced)
        return pairs


def _put_in(listed: list[list[Floats]], rows: Places, blocks: Floats) -> None:
    """Add the blocks (r, n, n) of some of the points to the lists of these."""
    for row, matrix in zip(rows.tolist(), blocks, strict=True):
        listed[row].append(matrix)


def _around(source: PointEvaluator, value: Floats, start: Prepared) -> BatchEvaluator:
    """Return what serves the points at which the same motions are free as at one (m,)."""
    at = apply(source.system, overrides_at(source.system, source.free, value.tolist()))
    evaluator = batch_evaluator(at, source.free, *Asked.of(at, source.free, start).lifted_anywhere())
    return replace(evaluator, wirings=tuple(map(wire, evaluator.closed)))  # none that serve other points, too


def _is_apart(matrices: Floats) -> Truths:
    """Say of each matrix (k, n, n) whether it is one, and no eigenvalue is next to 1."""
    sure: Truths = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    values = np.linalg.eigvals(np.where(sure[:, None, None], matrices, 0.0))
    return np.asarray(sure & (np.abs(values - 1).min(axis=1, initial=np.inf) >= DRIFT))


def _filled_up(blocks: Sequence[Sequence[Floats]]) -> Floats:
    """Return the blocks of each point as one matrix (k, n, n), all of it NaN where a block is."""
    size = max((sum(len(values) for values in block) for block in blocks), default=0)
    result = np.zeros((len(blocks), size, size))
    for matrix, listed in zip(result, blocks, strict=True):
        if not all(np.isfinite(values).all() for values in listed):
            matrix[:] = np.nan
            continue
        start = 0
        for values in listed:
            rows = slice(start, start + len(values))
            matrix[rows, rows] = values
            start = rows.stop
    return result


def _reduced(system: ClosedSystem, free: RigidModes) -> tuple[Floats, Floats]:
    """Return the frame matrix of the coordinates relative to the rigid motions; its error."""
    error = system.error + (JACOBIAN_ROUNDINGS * UNIT) * np.abs(system.matrix)
    return relative_bounded(system.matrix, error, relative_coordinates(free.basis))


def _filled_up_pairs(pairs: Sequence[Sequence[tuple[Floats, Floats]]]) -> tuple[Floats, Floats]:
    """Return the matrices of each point as one (k, n, n), and their errors."""
    matrices, errors = ([[pair[place] for pair in item] for item in pairs] for place in (0, 1))
    return _filled_up(matrices), _filled_up(errors)


def evaluator(system: CompiledSystem, free: Sequence[Free], *, prepared: Prepared | None = None) -> Evaluator:
    """Prepare a system for many values of some of its parameters.

    Parameters
    ----------
    system
        The compiled scene; all other parameters keep its numbers.
    free
        The parameters that vary; none of them may reach a time (see `reaches_time`).
    prepared
        From `instance.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        As `analysis.lifted_groups`.
    """
    return _evaluator(Asked.of(system, free, prepared or prepare(system)))


@dataclass(frozen=True, slots=True)
class Asked:
    """All that an evaluator follows from; `known` are the identities of the Jacobians in `prepared`."""

    system: CompiledSystem
    free: tuple[Free, ...]
    known: tuple[int, ...]
    order: tuple[str, ...]
    prepared: Prepared = field(compare=False)

    @classmethod
    def of(cls, system: CompiledSystem, free: Sequence[Free], prepared: Prepared) -> Asked:
        """Return what is asked of a scene, from `instance.prepare`, over parameters that vary."""
        return cls(system, tuple(free), tuple(map(id, prepared.jacobians)), prepared.order, prepared)

    @property
    def parameters_suffice(self) -> bool:
        """Whether numbers alone say how all peers move, wherever they are."""
        used = [self.prepared.jacobians[group.kind] for group in self.system.groups]
        return all(site.parameters_suffice for site in used)

    def lifted_anywhere(self) -> tuple[tuple[PeerGroup, ...], Exchange]:
        """Return the peers in groups, alike where they are so at every value, and what they exchange."""
        return lifted_groups(generic(self.system, self.free), prepared=self.prepared)


@lru_cache(maxsize=KEPT)
def _evaluator(of: Asked) -> Evaluator:
    """Prepare a system, see `evaluator`."""
    if not of.parameters_suffice:
        lifted_groups(of.system, prepared=of.prepared)  # what is refused at every value is refused here
        return PointEvaluator(of.system, of.free, of.prepared)
    return batch_evaluator(of.system, of.free, *of.lifted_anywhere())


def many_packets(system: CompiledSystem, prepared: Prepared) -> bool:
    """Say whether packets on their way are most of a scene's states: an analysis leaves them out."""
    packets = max(sum(schedule.depths) for schedule in prepared.schedules)
    used = zip(prepared.schedules, system.groups, strict=True)
    return packets > max(states_of(schedule, prepared.jacobians[group.kind]) for schedule, group in used) / 2


def evaluator_of_many(
    system: CompiledSystem, free: Sequence[Free], place: Place, *, prepared: Prepared
) -> Evaluator:
    """Return `evaluator`, for work that takes a hundred points and more.

    Parameters
    ----------
    system, free, prepared
        As for `evaluator`.
    place
        Where that was asked for, for messages.

    Raises
    ------
    ApcError
        E804 a system of more than `MOST_STATES` states; and those of `evaluator`.
    """
    hint = "apc sweep, which analyses value by value"
    try:
        result = evaluator(system, free, prepared=prepared)
        states = result.states()
    except ApcError as error:  # an analysis has methods that spare the matrix, a range of values has none
        raise ApcError(
            [
                replace(mistake, hint=hint) if "--method" in mistake.hint else mistake
                for mistake in error.mistakes
            ]
        ) from None
    if states > MOST_STATES:
        what = (
            f"a range of values is looked at in hundreds of matrices, here of {states:,} states; "
            f"{MOST_STATES:,} are the most"
        )
        raise ApcError(Mistake("E804", place, what, hint=hint))
    return result


def generic(system: CompiledSystem, free: Sequence[Free]) -> CompiledSystem:
    """Return the system with meaningless values for what is free: peers alike there are so everywhere."""
    overrides = []
    for place, item in enumerate(free):
        value = Fraction(parameter_of(system, item).value)
        share = GENERIC * Fraction(place + 3, 3)
        overrides.append(Override(item, value * (1 + share) if value else share))
    unbounded = replace(
        system,
        parameters=tuple(_unbounded(parameter) for parameter in system.parameters),
        groups=tuple(
            replace(group, values=tuple(_unbounded(parameter) for parameter in group.values))
            for group in system.groups
        ),
    )
    return apply(unbounded, overrides)


def _unbounded(parameter: Parameter) -> Parameter:
    return replace(parameter, minimum=None, open_minimum=False, maximum=None)


def free_parameters(system: CompiledSystem) -> list[Free]:
    """Return the parameters that follow from no other, set no time and count nobody, each as it can be set.

    A parameter is everybody's where no group has a value of its own; else it is that of each group it
    reaches, as everybody's would set the groups' own as well. What is given to a group peer by peer, or as
    an expression, has no one value there and is left out.
    """
    frees = []
    shaping = scope_of(system).needed(
        [*(timing.name for timing in system.timings), *(group_count(group.name) for group in system.groups)]
    )
    for parameter in system.parameters:
        if parameter.formula is not None or not is_named(parameter.name) or parameter.name in shaping:
            continue
        several = {
            group.name: any(column.name == parameter.name for column in group.columns)
            or any(value.name == parameter.name and value.formula for value in group.values)
            for group in system.groups
        }
        own = any(value.name == parameter.name for group in system.groups for value in group.values)
        if not own and not any(several.values()):
            frees.append(Free(parameter.name))
            continue
        frees += [
            Free(parameter.name, group.name)
            for group in system.groups
            if not several[group.name] and _reaches(system, group, parameter.name)
        ]
    return frees


def _reaches(system: CompiledSystem, group: Group, name: str) -> bool:
    """Say whether a parameter's value in a group enters the group's equations."""
    values = {Free(name, group.name): np.array([float(GENERIC), float(2 * GENERIC)])}
    with np.errstate(all="ignore"):
        return len(free_rows(system, group, 0, values)) > 1


def overrides_at(system: CompiledSystem, free: Sequence[Free], value: Sequence[float]) -> list[Override]:
    """Return what sets parameters to a point (m,); of a number of peers, to the nearest whole number."""
    return [
        Override(item, Fraction(round(number) if reaches_count(system, item) else float(number)))
        for item, number in zip(free, value, strict=True)
    ]


def reaches_count(system: CompiledSystem, free: Free) -> bool:
    """Say whether the number of peers of some group is, or depends on, this parameter."""
    return free.name in scope_of(system).needed([group_count(group.name) for group in system.groups])


def reaches_time(system: CompiledSystem, free: Free) -> bool:
    """Say whether a period, phase or delay is, or depends on, this parameter."""
    if any(timing.name == free.name for timing in system.timings):
        return True
    return free.name in scope_of(system).needed([timing.name for timing in system.timings])
