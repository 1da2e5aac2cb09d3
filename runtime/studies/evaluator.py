"""Construction of the evaluator of a model's matrices over some parameters, for any kind of model.

Takes: a `NumericModel` and the parameters that vary.
Gives: `evaluator`, `evaluator_of_many`, `PiecewiseEvaluator`; `parameters_suffice`;
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

from apc.analysis.analysis import lifted_classes
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Group, Model, Parameter, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, is_named, parameter_of, times_of
from apc.parameter_values.parameters import free_rows, scope_of
from apc.spectrum.interconnection import ClosedLoop
from apc.spectrum.modes import split
from apc.spectrum.peer_classes import MATRIX, PeerClass, states_of
from apc.studies.frame_matrices import BatchEvaluator, batch_evaluator
from apc.studies.loop_structure import loop_structure, reduced
from apc.studies.timing_values import nearest_period
from apc.support.state_limits import SEARCH_STATES
from apc.timing.communication_graph import CommunicationGraph

Floats = NDArray[np.float64]

# The relative change of the first free parameter when peers are compared; the changes of further ones are
# larger. No other parameter has such a value by accident.
GENERIC = Fraction(1, 1024) + Fraction(1, 65537)

# Rounding of CasADi's evaluation of a subsystem's Jacobians at its start, in units of UNIT: each entry is a
# few dozen operations, and exponentials do not amplify it beyond the entry.
JACOBIAN_ROUNDINGS = 64

# Distance of an eigenvalue from 1 below which drifts are searched exactly: ten times the scatter of a pair at
# 1 by rounding, the square root of 1e-15.
DRIFT = 1e-6

# The limit of sets of rigid modes with a separate evaluator; points with other rigid modes are analysed one
# by one.
MOST_SHARED = 8

# Cached evaluators for later calls with the same parameters, over another range for example.
CACHE_SIZE = 8


@dataclass(frozen=True, slots=True, eq=False)
class JoinedEvaluator:
    """A `MatrixSource` of several models over the same parameters: the matrices of all `sources`, in
    sequence.
    """

    model: Model
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
        """Return the closed systems at one point (m,) with error bounds, as in an analysis."""
        return tuple(closed for source in self.sources for closed in source.closed_at(value))


@dataclass(frozen=True, slots=True, eq=False)
class PiecewiseEvaluator:
    """A `MatrixSource` of a model whose rigid modes differ between values.

    Points with the same rigid modes share one evaluator of `shared`; a point near a change is evaluated
    separately, without a slope. All closed systems are blocks of one matrix (`size`, `size`), padded with
    zeros.
    """

    numeric: NumericModel  # from `analysis.prepare_at_start`
    free: tuple[ParameterRef, ...]
    size: int
    shared: list[BatchEvaluator] = field(default_factory=list)

    @property
    def model(self) -> Model:
        """The compiled model."""
        return self.numeric.model

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the matrices of all systems as blocks (k, n, n) at values (k, m), NaN if undefined."""
        return (self.slopes(values, np.zeros_like(values))[0][0],)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the matrices (k, n, n) and derivatives along directions (k, m), NaN for separate points."""
        matrices, slopes = np.full((2, len(values), self.size, self.size), np.nan)
        remaining, index = np.flatnonzero(np.isfinite(values).all(axis=1)), 0
        while len(remaining) and index < MOST_SHARED:
            if index == len(self.shared):
                self.shared.append(self._evaluator_around(values[remaining[0]]))
            pairs = self.shared[index].slopes(values[remaining], along[remaining])
            certain = np.all([_has_no_drift_candidate(matrix) for matrix, _ in pairs], axis=0)
            for result, blocks in zip((matrices, slopes), zip(*pairs, strict=True), strict=True):
                result[remaining[certain]] = self._block_diagonal([block[certain] for block in blocks])
            remaining, index = remaining[~certain], index + 1
        for row in remaining.tolist():
            with contextlib.suppress(ApcError):
                overrides = overrides_at(self.model, self.free, values[row].tolist())
                separate_blocks = _relative_matrices(self.numeric.at(apply(self.model, overrides)))
                matrices[row] = self._block_diagonal([block[None] for block in separate_blocks])[0]
        return ((matrices, slopes),)

    def errors(self, values: Floats) -> tuple[Floats, ...]:
        """Return bounds on the errors of the matrices (k, n, n) from CasADi's evaluation."""
        return (JACOBIAN_ROUNDINGS * UNIT_ROUNDOFF * np.abs(np.nan_to_num(self.matrices(values)[0])),)

    def _evaluator_around(self, value: Floats) -> BatchEvaluator:
        """Return the evaluator of the points with the same rigid modes as the point `value` (m,)."""
        model_at_value = apply(self.model, overrides_at(self.model, self.free, value.tolist()))
        result = batch_evaluator(
            model_at_value,
            self.free,
            *_lifted_anywhere(self.numeric.at(model_at_value), self.free),
        )
        return replace(
            result, wirings=tuple(map(loop_structure, result.closed))
        )  # none valid at other points, too

    def _block_diagonal(self, blocks: Sequence[Floats]) -> Floats:
        """Return block-diagonal matrices (k, size, size) of blocks (k, n, n).

        A matrix with an entry that is not finite is NaN throughout.
        """
        result = np.zeros((len(blocks[0]), self.size, self.size))
        start = 0
        for block in blocks:
            rows = slice(start, start := start + block.shape[1])
            result[:, rows, rows] = block
        result[~np.isfinite(result).all(axis=(1, 2))] = np.nan
        return result


def _has_no_drift_candidate(matrices: Floats) -> NDArray[np.bool_]:
    """Return for each matrix (k, n, n) whether it is finite without an eigenvalue near 1."""
    certain = np.asarray(np.isfinite(matrices).all(axis=(1, 2)))
    values = np.linalg.eigvals(np.where(certain[:, None, None], matrices, 0.0))
    return np.asarray(certain & (np.abs(values - 1).min(axis=1, initial=np.inf) >= DRIFT))


def evaluator(numeric: NumericModel, parameter_refs: Sequence[ParameterRef]) -> BatchEvaluator:
    """Return the evaluator of a model's frame matrices over parameters that determine all motions.

    Parameters
    ----------
    numeric
        The model with its parameter values; all other parameters keep them.
    parameter_refs
        The parameters that vary; none of them may affect a time (see `reaches_time`).

    Raises
    ------
    ApcError
        As for `analysis.lifted_classes`.
    """
    return _evaluator(numeric, tuple(parameter_refs))


@lru_cache(maxsize=CACHE_SIZE)
def _evaluator(numeric: NumericModel, free: tuple[ParameterRef, ...]) -> BatchEvaluator:
    """Return the evaluator of a model over some parameters (see `evaluator`), cached."""
    return batch_evaluator(numeric.model, free, *_lifted_anywhere(numeric, free))


def _lifted_anywhere(
    numeric: NumericModel, free: Sequence[ParameterRef]
) -> tuple[tuple[PeerClass, ...], CommunicationGraph]:
    """Return the classes of peers that are equal at every value of the parameters, lifted, and the graph."""
    return lifted_classes(numeric.at(generic(numeric.model, free)))


def parameters_suffice(numeric: NumericModel) -> bool:
    """Return whether the parameters alone determine the motion of all peers, for any start values."""
    return all(subsystem.parameters_suffice for subsystem in numeric.subsystems)


def closed_at(
    numeric: NumericModel, parameter_refs: Sequence[ParameterRef], value: Sequence[float]
) -> tuple[ClosedLoop, ...]:
    """Return the closed systems at one point (m,) with error bounds, as in an analysis."""
    changed = apply(numeric.model, overrides_at(numeric.model, parameter_refs, value))
    return tuple(
        closed for side in sides(numeric.at(changed)) for closed in split(*lifted_classes(side.numeric))
    )


def _relative_matrices(numeric: NumericModel) -> list[Floats]:
    """Return the matrices of a model's closed systems in relative coordinates; NaN if undefined."""
    systems = split(*lifted_classes(numeric))
    return [reduced(loop_structure(closed), closed.matrix[None], 1)[0] for closed in systems]


def dominant_in_floats(numeric: NumericModel) -> complex:
    """Return the eigenvalue of largest magnitude in floats, without rigid modes; NaN if undefined."""
    matrices = [matrix for side in sides(numeric) for matrix in _relative_matrices(side.numeric)]
    if not all(np.isfinite(matrix).all() for matrix in matrices):
        return complex(np.nan)
    values = np.concatenate([np.zeros(1), *map(np.linalg.eigvals, matrices)])
    return complex(values[np.argmax(np.abs(values))])


def many_packets(numeric: NumericModel) -> bool:
    """Return whether most states of a model are packets in transit, which an analysis can eliminate."""
    packets = max(sum(schedule.depths) for schedule in numeric.schedules)
    return packets > max(map(states_of, numeric.schedules, numeric.subsystems)) / 2


def evaluator_of_many(
    numeric: NumericModel, parameter_refs: Sequence[ParameterRef], location: SourceLocation
) -> BatchEvaluator:
    """Return the evaluator of a model (see `evaluator`) for computations over a hundred points or more.

    Parameters
    ----------
    numeric, parameter_refs
        As for `evaluator`.
    location
        The location of the request, for messages.

    Raises
    ------
    ApcError
        E804 a system of more than `SEARCH_STATES` states; and the errors of `evaluator`.
    """
    advice = "use apc sweep, which analyzes each value"
    try:
        result = evaluator(numeric, parameter_refs)
        states = result.states()
    except ApcError as error:  # only an analysis of one value has methods without the matrix
        raise ApcError(
            [
                replace(mistake, fix="", advice=advice) if mistake.subject == MATRIX else mistake
                for mistake in error.mistakes
            ]
        ) from None
    if states > SEARCH_STATES:
        message = (
            f"a search needs hundreds of matrices, here of {states:,} states; the limit is {SEARCH_STATES:,}"
        )
        raise ApcError(Diagnostic("E804", location, message, advice=advice))
    return result


def generic(model: Model, parameter_refs: Sequence[ParameterRef]) -> Model:
    """Return the model with generic values of the free parameters: peers equal there are equal at
    every value.
    """
    overrides = []
    for index, parameter_ref in enumerate(parameter_refs):
        value = Fraction(parameter_of(model, parameter_ref).value)
        change = GENERIC * Fraction(index + 3, 3)
        overrides.append(Override(parameter_ref, value * (1 + change) if value else change))
    unbounded = replace(
        model,
        parameters=tuple(_without_bounds(parameter) for parameter in model.parameters),
        groups=tuple(
            replace(group, values=tuple(_without_bounds(parameter) for parameter in group.values))
            for group in model.groups
        ),
    )
    return apply(unbounded, overrides)


def _without_bounds(parameter: Parameter) -> Parameter:
    """Return a parameter without limits on its value."""
    return replace(parameter, minimum=None, exclusive_minimum=False, maximum=None)


def free_parameters(model: Model) -> list[ParameterRef]:
    """Return the independent parameters that affect neither times nor counts, each by its settable name.

    A parameter is common to all groups if no group has its own value; otherwise there is one for each group
    that it affects, as a common value would replace the groups' own values. Values given peer by peer, or as
    an expression, are left out.
    """
    parameter_refs = []
    excluded = scope_of(model).needed(
        [*(timing.name for timing in model.timings), *(group_count(group.name) for group in model.groups)]
    )
    for parameter in model.parameters:
        if parameter.formula is not None or not is_named(parameter.name) or parameter.name in excluded:
            continue
        not_single = {
            group.name: any(column.name == parameter.name for column in group.columns)
            or any(value.name == parameter.name and value.formula for value in group.values)
            for group in model.groups
        }
        has_own_values = any(value.name == parameter.name for group in model.groups for value in group.values)
        if not has_own_values and not any(not_single.values()):
            parameter_refs.append(ParameterRef(parameter.name))
            continue
        parameter_refs += [
            ParameterRef(parameter.name, group.name)
            for group in model.groups
            if not not_single[group.name] and _affects_group(model, group, parameter.name)
        ]
    return parameter_refs


def _affects_group(model: Model, group: Group, name: str) -> bool:
    """Return whether a parameter's value in a group enters the group's equations."""
    values = {ParameterRef(name, group.name): np.array([float(GENERIC), float(2 * GENERIC)])}
    with np.errstate(all="ignore"):
        return len(free_rows(model, group, 0, values)) > 1


def overrides_at(
    model: Model, parameter_refs: Sequence[ParameterRef], value: Sequence[float]
) -> list[Override]:
    """Return the overrides to a point (m,).

    Counts are rounded, periods replaced by periods of short frames.
    """
    return [
        Override(parameter_ref, _valid_value(model, parameter_ref, number))
        for parameter_ref, number in zip(parameter_refs, value, strict=True)
    ]


def _valid_value(model: Model, parameter_ref: ParameterRef, number: float) -> Fraction:
    """Return the nearest valid value of a parameter: an integer count, or a period of short frames."""
    if reaches_count(model, parameter_ref):
        return Fraction(round(number))
    if reaches_time(model, parameter_ref):
        return nearest_period(model, parameter_ref, Fraction(number))
    return Fraction(number)


def reaches_count(model: Model, parameter_ref: ParameterRef) -> bool:
    """Return whether the number of peers of some group is, or depends on, this parameter."""
    return parameter_ref.name in scope_of(model).needed([group_count(group.name) for group in model.groups])


def reaches_time(model: Model, parameter_ref: ParameterRef) -> bool:
    """Return whether a period, phase or delay is, or depends on, this parameter."""
    if times_of(model, parameter_ref.name):
        return True
    return parameter_ref.name in scope_of(model).needed([timing.name for timing in model.timings])
