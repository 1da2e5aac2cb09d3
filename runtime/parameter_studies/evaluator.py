"""Construction of the evaluator of a model's matrices over some parameters, for any kind of model.

Takes: a `Model` and the parameters that vary.
Gives: `evaluator`, `evaluator_of_many`, `PiecewiseEvaluator`; `parameters_suffice`, `EvaluatorKey`;
`many_packets`; `closed_at`, `dominant_in_floats`; `free_parameters`, `reaches_time`, `reaches_count`,
`overrides_at`; `JoinedEvaluator`, `generic`.
Guarantees: peers that are equal at some values only are separate classes.
Does not: vary times (see `delay_segments`).
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
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Group, Model, Parameter, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.interconnection import ClosedLoop
from apc.eigen.modes import split
from apc.eigen.peer_classes import MATRIX, PeerClass, states_of
from apc.frame.communication_graph import CommunicationGraph
from apc.frame.interval_arithmetic import UNIT_ROUNDOFF
from apc.frame.numeric_model import Prepared
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, is_named, parameter_of, times_of
from apc.frame.parameters import free_rows, scope_of
from apc.parameter_studies.frame_matrices import BatchEvaluator, batch_evaluator
from apc.parameter_studies.loop_structure import loop_structure, reduced
from apc.parameter_studies.timing_values import nearest_period

Floats = NDArray[np.float64]

# The relative change of each free parameter when peers are compared: no other parameter has such a value by
# accident. The next one is changed by a little more.
GENERIC = Fraction(1, 1024) + Fraction(1, 65537)

# Rounding of CasADi's evaluation of a subsystem's Jacobians at its start, in units of UNIT: each entry is a
# few dozen operations, and exponentials do not amplify it beyond the entry.
JACOBIAN_ROUNDINGS = 64

# Distance of an eigenvalue from 1 that requires the exact search for drifts: rounding scatters a pair at 1 by
# the square root of 1e-15; this is ten times that.
DRIFT = 1e-6

# The limit of sets of rigid modes with an evaluator of their own; points of other sets are analysed
# separately.
MOST_SHARED = 8

# The limit of states of one system for a range of values: a hundred matrices and more are stored at a time,
# each with the vectors of its eigenvalues. For 250 states a range takes ten seconds and half a GB.
MOST_STATES = 300

# Cached evaluators for later calls with the same parameters, over another range for example.
CACHE_SIZE = 8


@dataclass(frozen=True, slots=True, eq=False)
class JoinedEvaluator:
    """A `MatrixSource` of several models over the same parameters: the matrices of all, concatenated."""

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
        """Return the closed systems at one point (m,), as in an analysis."""
        return tuple(closed for source in self.sources for closed in source.closed_at(value))


@dataclass(frozen=True, slots=True, eq=False)
class PiecewiseEvaluator:
    """A `MatrixSource` of a model whose rigid modes differ between values.

    Points with the same rigid modes share one of `shared`; a point next to a change is evaluated separately,
    without a slope. All closed systems are blocks of one matrix (`size`, `size`), padded with zeros.
    """

    system: Model
    free: tuple[ParameterRef, ...]
    prepared: Prepared  # from `analysis.prepare_at_start`
    size: int
    shared: list[BatchEvaluator] = field(default_factory=list)

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the matrices of all systems as blocks (k, n, n) at values (k, m), NaN if undefined."""
        return (self.slopes(values, np.zeros_like(values))[0][0],)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the matrices (k, n, n) and derivatives along directions (k, m), NaN for separate points."""
        matrices, slopes = np.full((2, len(values), self.size, self.size), np.nan)
        rest, index = np.flatnonzero(np.isfinite(values).all(axis=1)), 0
        while len(rest) and index < MOST_SHARED:
            if index == len(self.shared):
                self.shared.append(self._around(values[rest[0]]))
            pairs = self.shared[index].slopes(values[rest], along[rest])
            sure = np.all([_is_separate(matrix) for matrix, _ in pairs], axis=0)
            for result, blocks in zip((matrices, slopes), zip(*pairs, strict=True), strict=True):
                result[rest[sure]] = self._filled([block[sure] for block in blocks])
            rest, index = rest[~sure], index + 1
        for row in rest.tolist():
            with contextlib.suppress(ApcError):
                overrides = overrides_at(self.system, self.free, values[row].tolist())
                alone = _relative(apply(self.system, overrides), self.prepared)
                matrices[row] = self._filled([block[None] for block in alone])[0]
        return ((matrices, slopes),)

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds on the errors of the matrices (k, n, n) from CasADi's evaluation."""
        return (JACOBIAN_ROUNDINGS * UNIT_ROUNDOFF * np.abs(np.nan_to_num(self.matrices(values)[0])),)

    def _around(self, value: Floats) -> BatchEvaluator:
        """Return the evaluator of the points with the same rigid modes as one point (m,)."""
        at = apply(self.system, overrides_at(self.system, self.free, value.tolist()))
        result = batch_evaluator(
            at, self.free, *EvaluatorKey.of(at, self.free, self.prepared).lifted_anywhere()
        )
        return replace(
            result, wirings=tuple(map(loop_structure, result.closed))
        )  # none valid at other points, too

    def _filled(self, blocks: Sequence[Floats]) -> Floats:
        """Return the blocks (k, n, n) of each point as one matrix, NaN where one is."""
        result = np.zeros((len(blocks[0]), self.size, self.size))
        start = 0
        for block in blocks:
            rows = slice(start, start := start + block.shape[1])
            result[:, rows, rows] = block
        result[~np.isfinite(result).all(axis=(1, 2))] = np.nan
        return result


def _is_separate(matrices: Floats) -> NDArray[np.bool_]:
    """Return for each matrix (k, n, n) whether it is finite, with no eigenvalue near 1."""
    sure = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    values = np.linalg.eigvals(np.where(sure[:, None, None], matrices, 0.0))
    return np.asarray(sure & (np.abs(values - 1).min(axis=1, initial=np.inf) >= DRIFT))


def evaluator(system: Model, free: Sequence[ParameterRef], *, prepared: Prepared) -> BatchEvaluator:
    """Return the evaluator of a model over parameters that determine the motion of all peers.

    Parameters
    ----------
    system
        The compiled model; all other parameters keep its values.
    free
        The parameters that vary; none of them may affect a time (see `reaches_time`).
    prepared
        From `numeric_model.prepare` or `analysis.prepare_at_start`, of this model with any values.

    Raises
    ------
    ApcError
        As `analysis.lifted_groups`.
    """
    return _evaluator(EvaluatorKey.of(system, free, prepared))


@dataclass(frozen=True, slots=True)
class EvaluatorKey:
    """The data that determines an evaluator; `known` are the identities of the Jacobians in `prepared`."""

    system: Model
    free: tuple[ParameterRef, ...]
    known: tuple[int, ...]
    order: tuple[str, ...]
    prepared: Prepared = field(compare=False)

    @classmethod
    def of(cls, system: Model, free: Sequence[ParameterRef], prepared: Prepared) -> EvaluatorKey:
        """Return the key of an evaluator, from `numeric_model.prepare` and the parameters that vary."""
        return cls(system, tuple(free), tuple(map(id, prepared.jacobians)), prepared.order, prepared)

    def lifted_anywhere(self) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
        """Return the peers in classes, equal at every value of the parameters, and their links."""
        return lifted_groups(generic(self.system, self.free), prepared=self.prepared)


@lru_cache(maxsize=CACHE_SIZE)
def _evaluator(of: EvaluatorKey) -> BatchEvaluator:
    """Return the evaluator, see `evaluator`."""
    return batch_evaluator(of.system, of.free, *of.lifted_anywhere())


def parameters_suffice(system: Model, prepared: Prepared) -> bool:
    """Return whether parameters alone determine the motion of all peers, for any start values."""
    return all(prepared.jacobians[group.peer_type].parameters_suffice for group in system.groups)


def closed_at(
    system: Model, free: Sequence[ParameterRef], prepared: Prepared, value: Sequence[float]
) -> tuple[ClosedLoop, ...]:
    """Return the closed systems at one point (m,), as in an analysis."""
    changed = apply(system, overrides_at(system, free, value))
    return tuple(
        closed
        for side in sides(changed, prepared)
        for closed in split(*lifted_groups(side.system, prepared=side.prepared))
    )


def _relative(system: Model, prepared: Prepared) -> list[Floats]:
    """Return the relative-coordinate matrices of a model's closed systems; NaN if undefined."""
    systems = split(*lifted_groups(system, prepared=prepared))
    return [reduced(loop_structure(closed), closed.matrix[None], 1)[0] for closed in systems]


def dominant_in_floats(system: Model, prepared: Prepared) -> complex:
    """Return the largest eigenvalue of a model in floats, without rigid modes, NaN if undefined."""
    matrices = [
        matrix for side in sides(system, prepared) for matrix in _relative(side.system, side.prepared)
    ]
    if not all(np.isfinite(matrix).all() for matrix in matrices):
        return complex(np.nan)
    values = np.concatenate([np.zeros(1), *map(np.linalg.eigvals, matrices)])
    return complex(values[np.argmax(np.abs(values))])


def many_packets(system: Model, prepared: Prepared) -> bool:
    """Return whether most states of a model are packets in transit, which an analysis can eliminate."""
    packets = max(sum(schedule.depths) for schedule in prepared.schedules)
    used = zip(prepared.schedules, system.groups, strict=True)
    return (
        packets
        > max(states_of(schedule, prepared.jacobians[group.peer_type]) for schedule, group in used) / 2
    )


def evaluator_of_many(
    system: Model, free: Sequence[ParameterRef], location: SourceLocation, *, prepared: Prepared
) -> BatchEvaluator:
    """Return `evaluator`, for computations over a hundred points and more.

    Parameters
    ----------
    system, free, prepared
        As for `evaluator`.
    location
        The location of the request, for messages.

    Raises
    ------
    ApcError
        E804 a system of more than `MOST_STATES` states; and those of `evaluator`.
    """
    hint = "apc sweep, which analyses value by value"
    try:
        result = evaluator(system, free, prepared=prepared)
        states = result.states()
    except ApcError as error:  # an analysis has methods without the matrix, a range of values has none
        raise ApcError(
            [
                replace(mistake, hint=hint) if mistake.subject == MATRIX else mistake
                for mistake in error.mistakes
            ]
        ) from None
    if states > MOST_STATES:
        message = (
            f"a range of values is looked at in hundreds of matrices, here of {states:,} states; "
            f"{MOST_STATES:,} are the most"
        )
        raise ApcError(Diagnostic("E804", location, message, hint=hint))
    return result


def generic(system: Model, free: Sequence[ParameterRef]) -> Model:
    """Return the model with generic values of free parameters: peers equal there are equal everywhere."""
    overrides = []
    for index, item in enumerate(free):
        value = Fraction(parameter_of(system, item).value)
        share = GENERIC * Fraction(index + 3, 3)
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
    return replace(parameter, minimum=None, exclusive_minimum=False, maximum=None)


def free_parameters(system: Model) -> list[ParameterRef]:
    """Return the independent parameters that set no time and no count, each by its settable name.

    A parameter is common to all groups where no group has its own value; else there is one for each group it
    affects, as the common one would set the groups' own as well. A value given peer by peer, or as an
    expression, is no single value there and is left out.
    """
    parameter_refs = []
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
        local = any(value.name == parameter.name for group in system.groups for value in group.values)
        if not local and not any(several.values()):
            parameter_refs.append(ParameterRef(parameter.name))
            continue
        parameter_refs += [
            ParameterRef(parameter.name, group.name)
            for group in system.groups
            if not several[group.name] and _reaches(system, group, parameter.name)
        ]
    return parameter_refs


def _reaches(system: Model, group: Group, name: str) -> bool:
    """Return whether a parameter's value in a group enters the group's equations."""
    values = {ParameterRef(name, group.name): np.array([float(GENERIC), float(2 * GENERIC)])}
    with np.errstate(all="ignore"):
        return len(free_rows(system, group, 0, values)) > 1


def overrides_at(system: Model, free: Sequence[ParameterRef], value: Sequence[float]) -> list[Override]:
    """Return overrides to a point (m,): counts are rounded, periods become ones with short frames."""
    return [Override(item, _exact(system, item, number)) for item, number in zip(free, value, strict=True)]


def _exact(system: Model, free: ParameterRef, number: float) -> Fraction:
    if reaches_count(system, free):
        return Fraction(round(number))
    if reaches_time(system, free):
        return nearest_period(system, free, Fraction(number))
    return Fraction(number)


def reaches_count(system: Model, free: ParameterRef) -> bool:
    """Return whether the number of peers of some group is, or depends on, this parameter."""
    return free.name in scope_of(system).needed([group_count(group.name) for group in system.groups])


def reaches_time(system: Model, free: ParameterRef) -> bool:
    """Return whether a period, phase or delay is, or depends on, this parameter."""
    if times_of(system, free.name):
        return True
    return free.name in scope_of(system).needed([timing.name for timing in system.timings])
