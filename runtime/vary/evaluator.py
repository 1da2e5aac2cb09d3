"""The evaluator of a system's matrices over some of its parameters, whatever kind of scene it is.

Takes: a `Model` and the parameters that vary.
Gives: `evaluator`, `evaluator_of_many`, `PiecewiseEvaluator`; `parameters_suffice`, `EvaluatorKey`;
`many_packets`; `closed_at`, `leading_in_floats`; `free_parameters`, `reaches_time`, `reaches_count`,
`overrides_at`.
Guarantees: peers that are alike at some values only are kept apart.
Does not: vary times (see `delays`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import lifted_groups
from apc.analysis.sides import sides
from apc.compiler.compiled import Group, Model, Parameter, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.closing import ClosedLoop
from apc.eigen.modes import split
from apc.eigen.peers import MATRIX, PeerClass, states_of
from apc.frame.exchange import CommunicationGraph
from apc.frame.instance import Prepared
from apc.frame.names import ParameterRef, is_named, parameter_of, times_of
from apc.frame.overrides import Override, apply
from apc.frame.parameters import free_rows, scope_of
from apc.frame.radius import UNIT
from apc.vary.batch import BatchEvaluator, batch_evaluator
from apc.vary.timing_values import nearest_period
from apc.vary.wiring import reduced, wire

Floats = NDArray[np.float64]

# What each free parameter is moved by, relatively, where peers are told apart: no other number of a scene
# agrees with such a value by accident. The next one is moved by a little more.
GENERIC = Fraction(1, 1024) + Fraction(1, 65537)

# What CasADi's evaluation of a site's Jacobians at its start rounds, in units of UNIT: each entry is a few
# dozen operations, and an exponential makes no more of it than the entry is large.
JACOBIAN_ROUNDINGS = 64

# An eigenvalue left this near to 1 asks for the exact search for drifts: a pair at 1 is scattered by rounding
# to the square root of 1e-15, and ten times that.
DRIFT = 1e-6

# So many sets of motions that are free somewhere are told apart; points beyond go alone.
MOST_ALIKE = 8

# States of one system beyond which no range of values is looked at: a hundred matrices and more are held at a
# time, each with the vectors of its eigenvalues. Of 250 states a range takes ten seconds and half a GB.
MOST_STATES = 300

# Evaluators kept for the next question of the same parameters: another range of theirs, say.
KEPT = 8


@dataclass(frozen=True, slots=True, eq=False)
class JoinedEvaluator:
    """A `MatrixSource` of several models over the same parameters: the matrices of all, one after another."""

    system: Model
    free: tuple[ParameterRef, ...]
    sources: tuple[BatchEvaluator, ...]

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return each system's reduced frame matrices (k, n, n) at values (k, m)."""
        return tuple(matrix for source in self.sources for matrix in source.matrices(values))

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return each system's matrices (k, n, n) and their derivatives along directions (k, m)."""
        return tuple(pair for source in self.sources for pair in source.slopes(values, along))

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds (k, n, n) on the errors of the matrices at values (k, m), entry by entry."""
        return tuple(error for source in self.sources for error in source.errors(values))

    def closed_at(self, value: Sequence[float]) -> tuple[ClosedLoop, ...]:
        """Return the closed systems at one point (m,), as an analysis has them."""
        return tuple(closed for source in self.sources for closed in source.closed_at(value))


@dataclass(frozen=True, slots=True, eq=False)
class PiecewiseEvaluator:
    """A `MatrixSource` of a scene in which at some values other motions are free than at others.

    Points at which the same are free are taken together by one of `alike`; a point next to where that
    changes goes alone, and has no slope. All closed systems are blocks of one matrix (`size`, `size`), filled
    up with zeros.
    """

    system: Model
    free: tuple[ParameterRef, ...]
    prepared: Prepared  # from `analysis.prepare_at_start`
    size: int
    alike: list[BatchEvaluator] = field(default_factory=list)

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the matrices of all systems as blocks (k, n, n) at values (k, m), NaN for none."""
        return (self.slopes(values, np.zeros_like(values))[0][0],)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the matrices (k, n, n) and their derivatives along directions (k, m), NaN where alone."""
        matrices, slopes = np.full((2, len(values), self.size, self.size), np.nan)
        rest, place = np.flatnonzero(np.isfinite(values).all(axis=1)), 0
        while len(rest) and place < MOST_ALIKE:
            if place == len(self.alike):
                self.alike.append(self._around(values[rest[0]]))
            pairs = self.alike[place].slopes(values[rest], along[rest])
            sure = np.all([_is_apart(matrix) for matrix, _ in pairs], axis=0)
            for result, blocks in zip((matrices, slopes), zip(*pairs, strict=True), strict=True):
                result[rest[sure]] = self._filled([block[sure] for block in blocks])
            rest, place = rest[~sure], place + 1
        for row in rest.tolist():
            with contextlib.suppress(ApcError):
                overrides = overrides_at(self.system, self.free, values[row].tolist())
                alone = _relative(apply(self.system, overrides), self.prepared)
                matrices[row] = self._filled([block[None] for block in alone])[0]
        return ((matrices, slopes),)

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return how far the matrices (k, n, n) are off by what CasADi's evaluation rounds."""
        return (JACOBIAN_ROUNDINGS * UNIT * np.abs(np.nan_to_num(self.matrices(values)[0])),)

    def _around(self, value: Floats) -> BatchEvaluator:
        """Return what serves the points at which the same motions are free as at one (m,)."""
        at = apply(self.system, overrides_at(self.system, self.free, value.tolist()))
        result = batch_evaluator(
            at, self.free, *EvaluatorKey.of(at, self.free, self.prepared).lifted_anywhere()
        )
        return replace(result, wirings=tuple(map(wire, result.closed)))  # none that serve other points, too

    def _filled(self, blocks: Sequence[Floats]) -> Floats:
        """Return the blocks (k, n, n) of each point as one matrix, NaN where one is."""
        result = np.zeros((len(blocks[0]), self.size, self.size))
        start = 0
        for block in blocks:
            rows = slice(start, start := start + block.shape[1])
            result[:, rows, rows] = block
        result[~np.isfinite(result).all(axis=(1, 2))] = np.nan
        return result


def _is_apart(matrices: Floats) -> NDArray[np.bool_]:
    """Say of each matrix (k, n, n) whether it is one, and no eigenvalue is next to 1."""
    sure = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    values = np.linalg.eigvals(np.where(sure[:, None, None], matrices, 0.0))
    return np.asarray(sure & (np.abs(values - 1).min(axis=1, initial=np.inf) >= DRIFT))


def evaluator(system: Model, free: Sequence[ParameterRef], *, prepared: Prepared) -> BatchEvaluator:
    """Prepare a system for many values of some of its parameters, which say how all peers move.

    Parameters
    ----------
    system
        The compiled scene; all other parameters keep its numbers.
    free
        The parameters that vary; none of them may reach a time (see `reaches_time`).
    prepared
        From `instance.prepare` or `analysis.prepare_at_start`, of this system with any numbers.

    Raises
    ------
    ApcError
        As `analysis.lifted_groups`.
    """
    return _evaluator(EvaluatorKey.of(system, free, prepared))


@dataclass(frozen=True, slots=True)
class EvaluatorKey:
    """All that an evaluator follows from; `known` are the identities of the Jacobians in `prepared`."""

    system: Model
    free: tuple[ParameterRef, ...]
    known: tuple[int, ...]
    order: tuple[str, ...]
    prepared: Prepared = field(compare=False)

    @classmethod
    def of(cls, system: Model, free: Sequence[ParameterRef], prepared: Prepared) -> EvaluatorKey:
        """Return what is asked of a scene, from `instance.prepare`, over parameters that vary."""
        return cls(system, tuple(free), tuple(map(id, prepared.jacobians)), prepared.order, prepared)

    def lifted_anywhere(self) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
        """Return the peers in groups, alike where they are so at every value, and what they exchange."""
        return lifted_groups(generic(self.system, self.free), prepared=self.prepared)


@lru_cache(maxsize=KEPT)
def _evaluator(of: EvaluatorKey) -> BatchEvaluator:
    """Prepare a system, see `evaluator`."""
    return batch_evaluator(of.system, of.free, *of.lifted_anywhere())


def parameters_suffice(system: Model, prepared: Prepared) -> bool:
    """Say whether numbers alone say how all peers move, wherever they are."""
    return all(prepared.jacobians[group.kind].parameters_suffice for group in system.groups)


def closed_at(
    system: Model, free: Sequence[ParameterRef], prepared: Prepared, value: Sequence[float]
) -> tuple[ClosedLoop, ...]:
    """Return the closed systems at one point (m,), as an analysis has them."""
    changed = apply(system, overrides_at(system, free, value))
    return tuple(
        closed
        for side in sides(changed, prepared)
        for closed in split(*lifted_groups(side.system, prepared=side.prepared))
    )


def _relative(system: Model, prepared: Prepared) -> list[Floats]:
    """Return the matrices of a scene's closed systems, relative to what is rigid; NaN where there is none."""
    systems = split(*lifted_groups(system, prepared=prepared))
    return [reduced(wire(closed), closed.matrix[None], 1)[0] for closed in systems]


def leading_in_floats(system: Model, prepared: Prepared) -> complex:
    """Return the largest eigenvalue of a scene in floats, what is rigid left out, NaN if there is none."""
    matrices = [
        matrix for side in sides(system, prepared) for matrix in _relative(side.system, side.prepared)
    ]
    if not all(np.isfinite(matrix).all() for matrix in matrices):
        return complex(np.nan)
    values = np.concatenate([np.zeros(1), *map(np.linalg.eigvals, matrices)])
    return complex(values[np.argmax(np.abs(values))])


def many_packets(system: Model, prepared: Prepared) -> bool:
    """Say whether packets on their way are most of a scene's states: an analysis leaves them out."""
    packets = max(sum(schedule.depths) for schedule in prepared.schedules)
    used = zip(prepared.schedules, system.groups, strict=True)
    return packets > max(states_of(schedule, prepared.jacobians[group.kind]) for schedule, group in used) / 2


def evaluator_of_many(
    system: Model, free: Sequence[ParameterRef], place: SourceLocation, *, prepared: Prepared
) -> BatchEvaluator:
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
                replace(mistake, hint=hint) if mistake.subject == MATRIX else mistake
                for mistake in error.mistakes
            ]
        ) from None
    if states > MOST_STATES:
        what = (
            f"a range of values is looked at in hundreds of matrices, here of {states:,} states; "
            f"{MOST_STATES:,} are the most"
        )
        raise ApcError(Diagnostic("E804", place, what, hint=hint))
    return result


def generic(system: Model, free: Sequence[ParameterRef]) -> Model:
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


def free_parameters(system: Model) -> list[ParameterRef]:
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
            frees.append(ParameterRef(parameter.name))
            continue
        frees += [
            ParameterRef(parameter.name, group.name)
            for group in system.groups
            if not several[group.name] and _reaches(system, group, parameter.name)
        ]
    return frees


def _reaches(system: Model, group: Group, name: str) -> bool:
    """Say whether a parameter's value in a group enters the group's equations."""
    values = {ParameterRef(name, group.name): np.array([float(GENERIC), float(2 * GENERIC)])}
    with np.errstate(all="ignore"):
        return len(free_rows(system, group, 0, values)) > 1


def overrides_at(system: Model, free: Sequence[ParameterRef], value: Sequence[float]) -> list[Override]:
    """Return overrides to a point (m,): counts are rounded, periods become ones of short frames."""
    return [Override(item, _exact(system, item, number)) for item, number in zip(free, value, strict=True)]


def _exact(system: Model, free: ParameterRef, number: float) -> Fraction:
    if reaches_count(system, free):
        return Fraction(round(number))
    if reaches_time(system, free):
        return nearest_period(system, free, Fraction(number))
    return Fraction(number)


def reaches_count(system: Model, free: ParameterRef) -> bool:
    """Say whether the number of peers of some group is, or depends on, this parameter."""
    return free.name in scope_of(system).needed([group_count(group.name) for group in system.groups])


def reaches_time(system: Model, free: ParameterRef) -> bool:
    """Say whether a period, phase or delay is, or depends on, this parameter."""
    if times_of(system, free.name):
        return True
    return free.name in scope_of(system).needed([timing.name for timing in system.timings])
