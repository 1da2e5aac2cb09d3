"""Batch analyses: verdict, spectral radius with its bound, and the motion of the dominant mode.

Takes: a `Model`, and values of some of its parameters and times.
Gives: `SweptParameter`, `BatchResult`; `ManyAnalyses`, `many_analyses`, `by_matrices`; `Analyses`,
`analyze_many`.
Guarantees: the results of `analysis.analyze` at each point, within the bounds: points at which the matrices
are undecided, or less accurate than an analysis, are analysed separately.
Does not: compute all modes, or distribute work among processes (see `resumable_sweep`).

Points with equal times and numbers of peers have the same schedules, and one `BatchEvaluator`; the matrices
come with their bounds (`BatchEvaluator.bounded`), the largest eigenvalue with its own (`spectrum.enclosure`),
and the turns of its mode are counted along its own motion (`lifting.phase_unwrapping`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from fractions import Fraction
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze, near_start
from apc.analysis.method_selection import make_plan
from apc.compiler.compiled import Model, Parameter
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.lifting.data_age import linear_subsystems
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.linearization.evaluation_errors import finite_equations
from apc.network.nominal_criterion import limitations, refuse_channel_number
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, find, notes_for_all_groups, unit_of
from apc.parameter_values.parameters import ResolvedNumbers, resolve, scope_of
from apc.result import Result
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.rigid_modes import classify_neutral_modes
from apc.spectrum.spectrum import (
    combine_verdicts,
)
from apc.studies.dominant_eigenvalue import DrivingPart, dominant_at, parts_of
from apc.studies.evaluator import generic, parameters_suffice
from apc.studies.evaluator_choice import EvaluatorKind, kind_for_parameter
from apc.studies.frame_matrices import BatchEvaluator, batch_evaluator
from apc.support.state_limits import BATCH_STATES
from apc.support.threads import single_threaded
from apc.verdict import StabilityVerdict

if TYPE_CHECKING:
    import pandas

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Truths = NDArray[np.bool_]

LOCATION = SourceLocation("analyze_many")

# The verdict text of a point with invalid parameter values.
FAULT = "error: "

# The numbers of points and of entries whose matrices are computed together: the intermediate arrays then stay
# in the processor's cache, and their memory is reused.
TOGETHER, ENTRIES = 2048, 112 * 2**10

# An error bound above the median by this factor is recomputed by an analysis of its point, unless more than
# this share of all points have such a bound.
WIDER, RARE = 4.0, 0.01

# The smallest number of points worth an evaluator, which takes as long to prepare as one analysis.
FEWEST = 3

# Cached sets of parameters with dependents.
MOST_RESOLVED = 4096

# Cached evaluators: for later points of the same times, and for the next call.
CACHE_SIZE, STORED_ON = 64, 8

# The limit of loops of a model, such as a ring's eigenvalues, beyond which each point is analysed separately.
MOST_LOOPS = 128


@dataclass(frozen=True, slots=True, eq=False)
class SweptParameter:
    """A parameter or time that varies, with its values in SI: as floats (v,), and exactly by index."""

    free: ParameterRef
    numbers: Floats
    exact: Callable[[int], Fraction]

    def override(self, index: int) -> Override:
        """Return the override to the value of this index."""
        return Override(self.free, self.exact(index))


@dataclass(frozen=True, slots=True, eq=False)
class BatchResult:
    """The results of analyses at k points; a failed point has the verdict `error: ` with the code.

    Missing numbers are NaN; `rigid_modes` is −1 at a failed point.
    """

    verdict: NDArray[Any]  # str
    spectral_radius: Floats
    spectral_radius_error: Floats
    rigid_modes: Integers
    frequency_hz: Floats
    damping_ratio: Floats
    message: NDArray[Any]  # str

    @classmethod
    def empty(cls, count: int) -> BatchResult:
        """Return rows of missing results, to be filled in."""
        radius, error, frequency, damping = np.full((4, count), np.nan)
        verdict, message = np.full((2, count), "", dtype=object)
        return cls(verdict, radius, error, np.full(count, -1), frequency, damping, message)


@dataclass(frozen=True, slots=True)
class _DependencyGroup:
    """Varied parameters, by their columns, with the names of all parameters that depend on them.

    No other parameter depends on both these and other varied parameters.
    """

    columns: tuple[int, ...]
    names: frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class _SharedMatrices:
    """The data shared by all points with the same times and numbers of peers.

    `model` is the model with these, `evaluator` returns its matrices, `parts` are their strongly connected
    parts. `reaching` are the varied parameters with dependents. `rigid` and `drifts` are the numbers of rigid
    modes and of drifts. `resolved` are cached parameters, None for invalid values.
    """

    model: Model
    evaluator: BatchEvaluator
    columns: tuple[int, ...]  # the index of each free parameter among the varied ones
    reaching: tuple[_DependencyGroup, ...]
    rigid: int
    drifts: int
    bounds: tuple[tuple[int, Parameter], ...]  # the varied parameters with their limits, by column
    patterns: tuple[Truths, ...]  # possible nonzeros of each system's matrix
    parts: tuple[DrivingPart, ...]
    resolved: dict[tuple[Override, ...], ResolvedNumbers | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ManyAnalyses:
    """The prepared analyses of one model over its varied parameters, for any number of evaluations.

    `schedule_columns` are the indices of the varied parameters that change the schedule: times and numbers of
    peers. `shared_matrices` are the matrices shared by the points with equal values of these.
    """

    numeric: NumericModel
    varied: tuple[SweptParameter, ...]
    schedule_columns: tuple[int, ...]
    shared_matrices: dict[tuple[int, ...], _SharedMatrices | None] = field(default_factory=dict)

    def at(self, indices: Integers) -> BatchResult:
        """Return the results at points, given by the indices (k, m) of the varied parameters' values."""
        rows = BatchResult.empty(len(indices))
        still_open = np.ones(len(indices), dtype=np.bool_)
        if len(indices):
            timings, timing_of = np.unique(
                indices[:, list(self.schedule_columns)], axis=0, return_inverse=True
            )
            for number, timing in enumerate(timings.tolist()):
                points = np.flatnonzero(timing_of.ravel() == number)
                shared = self._shared_at(tuple(timing), len(points))
                if shared is not None:
                    still_open[points] = ~_fill_results(shared, self.varied, indices, points, rows)
        for point in np.flatnonzero(still_open).tolist():
            self._analyze_single(indices[point], point, rows)
        return rows

    def _shared_at(self, timing: tuple[int, ...], count: int) -> _SharedMatrices | None:
        """Return the data shared by points of these times, None if each point is analysed separately."""
        if count < FEWEST:  # independent of earlier calls: the same points have the same bits each time
            return None
        if timing not in self.shared_matrices:
            while len(self.shared_matrices) >= CACHE_SIZE:
                self.shared_matrices.pop(next(iter(self.shared_matrices)))
            overrides = tuple(
                self.varied[column].override(index)
                for column, index in zip(self.schedule_columns, timing, strict=True)
            )
            free = tuple(varied.free for varied in self.varied)
            self.shared_matrices[timing] = _shared_matrices(
                self.numeric, free, self.schedule_columns, overrides
            )
        return self.shared_matrices[timing]

    def _analyze_single(self, indices: Integers, row: int, rows: BatchResult) -> None:
        """Write the result of one point, from its own analysis."""
        try:
            overrides = [
                varied.override(index) for varied, index in zip(self.varied, indices.tolist(), strict=True)
            ]
            analysis: Analysis = analyze(self.numeric.at(apply(self.numeric.model, overrides)))
        except ApcError as error:
            first = error.mistakes[0]
            rows.verdict[row], rows.message[row] = FAULT + first.code, first.sentence
            return
        rows.verdict[row] = analysis.verdict
        rows.spectral_radius[row] = analysis.spectral_radius
        rows.spectral_radius_error[row] = analysis.spectral_radius_error
        rows.rigid_modes[row] = analysis.rigid_modes
        if analysis.modes:
            rows.frequency_hz[row] = analysis.modes[0].frequency_hz
            rows.damping_ratio[row] = analysis.modes[0].damping_ratio


@dataclass(frozen=True, slots=True, eq=False)
class Analyses(Result):
    """The results of many analyses, arrays of the shape of the values.

    `parameters` are the names of the varied parameters, with units, `values` their values in SI. The columns
    are those of `BatchResult`; `limitations` are the limitations of the results.
    """

    shown_by = "parameter_studies_output:analyses"

    topology: str
    parameters: tuple[str, ...]
    values: tuple[Floats, ...]
    verdict: NDArray[Any]  # str
    spectral_radius: Floats
    spectral_radius_error: Floats
    rigid_modes: Integers
    frequency_hz: Floats
    damping_ratio: Floats
    message: NDArray[Any]  # str
    limitations: tuple[str, ...]

    @property
    def stable(self) -> Truths:
        """Whether each point is stable, possibly up to common motions.

        It is False for drifts and undecided points.
        """
        return np.isin(self.verdict, [verdict for verdict in StabilityVerdict if verdict.stable])

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas table with one row per point: first the values, then the results."""
        table: pandas.DataFrame = self._shown("table")
        return table


def analyze_many(model: Model, values: Mapping[str, Any]) -> Analyses:
    """Return the analyses of a model at many values of some parameters and times.

    Parameters
    ----------
    model
        The compiled model; its values hold for all other parameters.
    values
        The values of each parameter or time by its name: an array in SI, or quantities such as "8 ms". Arrays
        of different shapes are broadcast against one another.

    Raises
    ------
    ApcError
        E622, E623 an unknown parameter; E896 a parameter of a network; E881 missing or invalid values; E883
        no parameter, or one given twice.
    """
    if not values:
        message = "no parameter is varied"
        raise ApcError(Diagnostic("E883", LOCATION, message, fix='{"contact.stiffness": [500.0, 1000.0]}'))
    parameter_refs, value_arrays = [], []
    for name, given in values.items():
        parameter_ref = find(model, name.strip(), LOCATION, counts=True)
        if parameter_ref in parameter_refs:
            raise ApcError(Diagnostic("E883", LOCATION, f"{parameter_ref.label} is given twice"))
        refuse_channel_number(model, parameter_ref, LOCATION)
        parameter_refs.append(parameter_ref)
        value_arrays.append(_values_in_si(model, parameter_ref, given))
    try:
        arrays = np.broadcast_arrays(*value_arrays)
    except ValueError:
        shapes = " and ".join(str(array.shape) for array in value_arrays)
        message = f"values of the shapes {shapes} can't be broadcast against one another"
        raise ApcError(Diagnostic("E881", LOCATION, message)) from None
    varied, indices = [], []
    for parameter_ref, array in zip(parameter_refs, arrays, strict=True):
        numbers, index_of = np.unique(array.ravel(), return_inverse=True)
        varied.append(SweptParameter(parameter_ref, numbers, partial(_shortest, numbers)))
        indices.append(index_of)
    rows = many_analyses(model, varied).at(np.stack(indices, axis=1))
    shape = arrays[0].shape
    units = [unit_of(model, parameter_ref.name) for parameter_ref in parameter_refs]
    return Analyses(
        topology=model.name,
        parameters=tuple(
            parameter_ref.label if unit == "1" else f"{parameter_ref.label} [{unit}]"
            for parameter_ref, unit in zip(parameter_refs, units, strict=True)
        ),
        values=tuple(arrays),
        **{field.name: getattr(rows, field.name).reshape(shape) for field in fields(rows)},
        limitations=(
            *near_start(numeric_model(model)),
            *limitations(model, varied=parameter_refs),
            *notes_for_all_groups(model, parameter_refs),
        ),
    )


def _values_in_si(model: Model, parameter_ref: ParameterRef, given: Any) -> Floats:
    """Return the values of a parameter in SI, from numbers in SI or texts of quantities."""
    unit, message = unit_of(model, parameter_ref.name), f"values of {parameter_ref.label}"
    array = np.asarray(given)
    if array.dtype.kind in "UO" and all(isinstance(item, str) for item in array.ravel().tolist()):
        # The language of quantities, which numbers never need.
        from apc.compiler.language.units import quantity

        read = [
            quantity(text, LOCATION, subject=parameter_ref.label, unit=unit).value
            for text in array.ravel().tolist()
        ]
        array = np.array([float(number) for number in read]).reshape(array.shape)
    if array.dtype.kind not in "fiu" or not array.size or not np.isfinite(array).all():
        expected = f"finite numbers, in {unit}" if unit != "1" else "finite numbers"
        raise ApcError(Diagnostic("E881", LOCATION, message, expected, str(given)[:40]))
    return array.astype(np.float64)


def _shortest(numbers: Floats, index: int) -> Fraction:
    """Return the shortest decimal that rounds to this float: 8 ms, not 8.000000000000000167 ms."""
    return Fraction(repr(float(numbers[index])))


def by_matrices(model: Model) -> bool:
    """Return whether the matrices of many points can be computed together, from the parameters alone."""
    subsystems = linear_subsystems(model)
    return all(subsystems[group.peer_type].parameters_suffice for group in model.groups)


def many_analyses(model: Model, varied: Sequence[SweptParameter]) -> ManyAnalyses:
    """Return the prepared analyses of a model for any values of some of its parameters.

    Parameters
    ----------
    model
        The compiled model; its values hold for parameters that do not vary.
    varied
        The parameters that vary.
    """
    schedule_columns = tuple(
        column
        for column, parameter in enumerate(varied)
        if kind_for_parameter(model, parameter.free) is not EvaluatorKind.MATRICES
    )
    return ManyAnalyses(numeric_model(model), tuple(varied), schedule_columns)


@lru_cache(maxsize=STORED_ON)
def _shared_matrices(
    numeric: NumericModel,
    free: tuple[ParameterRef, ...],
    times: tuple[int, ...],
    timing_overrides: tuple[Override, ...],
) -> _SharedMatrices | None:
    """Return the shared matrices for given values of the times, None if an analysis needs another method."""
    columns = tuple(column for column in range(len(free)) if column not in times)
    parameter_refs = tuple(free[column] for column in columns)
    try:
        with finite_equations(numeric.model), np.errstate(all="ignore"):
            timed_model = apply(numeric.model, timing_overrides)
            generic_model = numeric.at(generic(timed_model, parameter_refs))
            if not parameters_suffice(generic_model):
                return None
            plan = make_plan(generic_model)
            if not plan.loops or len(plan.loops) > MOST_LOOPS or plan.method == "determinant":
                return None
            if max(modal_system.states for modal_system in plan.loops) > BATCH_STATES:
                return None
            evaluator = batch_evaluator(
                timed_model, parameter_refs, plan.peer_classes, generic_model.comm_graph
            )
    except ApcError:
        return None  # each point reports its own error
    rigid = drifts = 0
    for modal_system, wiring in zip(plan.loops, evaluator.wirings, strict=True):
        if wiring.modes_vary or (wiring.rigid.names and classify_neutral_modes(modal_system).unobservable):
            return None
        rigid += modal_system.multiplicity * len(wiring.rigid.names)
        drifts += modal_system.multiplicity * wiring.rigid.drifts
    names = {item.name: column for column, item in zip(columns, parameter_refs, strict=True)}
    all_parameters = (
        *timed_model.parameters,
        *(value for group in timed_model.groups for value in group.values),
    )
    parts, patterns = parts_of(evaluator)
    return _SharedMatrices(
        model=timed_model,
        evaluator=evaluator,
        columns=columns,
        reaching=_dependency_groups(timed_model, columns, parameter_refs),
        rigid=rigid,
        drifts=drifts,
        bounds=tuple(
            (names[parameter.name], parameter) for parameter in all_parameters if parameter.name in names
        ),
        patterns=patterns,
        parts=parts,
    )


def _dependency_groups(
    model: Model, columns: Sequence[int], parameter_refs: Sequence[ParameterRef]
) -> tuple[_DependencyGroup, ...]:
    """Return the varied parameters with dependents, in groups with common dependents."""
    scopes = [scope_of(model), *(scope_of(model, group.values) for group in model.groups)]
    groups: list[_DependencyGroup] = []
    for column, item in zip(columns, parameter_refs, strict=True):
        dependents = [scope.follow({item.name: None}, lambda *_: None, lambda _: None) for scope in scopes]
        dependency = _DependencyGroup((column,), frozenset[str]().union(*dependents))
        if len(dependency.names) > 1:
            shared = [earlier for earlier in groups if earlier.names & dependency.names]
            merged = [*shared, dependency]
            groups = [earlier for earlier in groups if earlier not in shared]
            groups.append(
                _DependencyGroup(
                    tuple(column for earlier in merged for column in earlier.columns),
                    frozenset[str]().union(*(earlier.names for earlier in merged)),
                )
            )
    return tuple(groups)


def _fill_results(
    shared: _SharedMatrices,
    varied: Sequence[SweptParameter],
    indices: Integers,
    points: Integers,
    rows: BatchResult,
) -> Truths:
    """Write the results of the points that the matrices decide; return the mask of these points.

    Parameters
    ----------
    shared, varied
        The data shared by the points, and the varied parameters.
    indices, points
        The indices of the varied parameters' values at all points (k, m), and the points to compute.
    rows
        The results of all points, changed in place.
    """
    decided = np.zeros(len(points), dtype=np.bool_)
    states = max(len(closed_system.layout.names) for closed_system in shared.evaluator.closed)
    block_size = max(1, min(TOGETHER, ENTRIES // states**2))
    with single_threaded(), np.errstate(all="ignore"):
        for start in range(0, len(points), block_size):
            block = slice(start, start + block_size)
            decided[block] = _fill_block(shared, varied, indices[points[block]], points[block], rows)
    return decided


def _fill_block(
    shared: _SharedMatrices,
    varied: Sequence[SweptParameter],
    indices: Integers,
    points: Integers,
    results: BatchResult,
) -> Truths:
    """Write the results of one block of points that the matrices decide; return the mask of these points.

    Parameters
    ----------
    shared, varied
        The data shared by the points, and the varied parameters.
    indices, points
        The indices of the varied parameters' values at the points of the block, and these points.
    results
        The results of all points, changed in place.
    """
    allowed, vectors = _parameter_vectors(shared, varied, indices)
    valid, pairs = dominant_at(shared.evaluator, shared.parts, shared.patterns, vectors, allowed)
    certain = np.flatnonzero(pairs.certain)
    certain = certain[~_has_wide_bound(pairs.error[certain])]
    valid = valid[certain]
    points_decided, radius = points[valid], pairs.radius[certain]
    results.verdict[points_decided] = combine_verdicts([True], shared.rigid, shared.drifts)
    results.verdict[points_decided[radius > 1]] = StabilityVerdict.UNSTABLE
    results.spectral_radius[points_decided], results.spectral_radius_error[points_decided] = (
        radius,
        pairs.error[certain],
    )
    results.rigid_modes[points_decided] = shared.rigid
    results.frequency_hz[points_decided], results.damping_ratio[points_decided] = (
        pairs.frequency_hz[certain],
        pairs.damping_ratio[certain],
    )
    decided = np.zeros(len(points), dtype=np.bool_)
    decided[valid] = True
    return decided


def _has_wide_bound(error: Floats) -> Truths:
    """Return the mask of points (k,) whose error bounds are far wider than the median.

    An analysis recomputes these points: near a double eigenvalue the shared data is not accurate. If many
    bounds are wide the cause is another one, and no point is marked.
    """
    wide = error > WIDER * np.median(error) if len(error) else np.zeros(0, dtype=np.bool_)
    return wide if wide.sum() <= RARE * len(error) else np.zeros(len(error), dtype=np.bool_)


def _parameter_vectors(
    shared: _SharedMatrices, varied: Sequence[SweptParameter], indices: Integers
) -> tuple[Truths, Callable[[PeerClass], Floats]]:
    """Return which points are valid, and a function from a class to its parameters there (k, n_p) or
    (1, n_p).

    A dependent parameter is computed as in an analysis, in rationals, once for all points with equal
    independent parameters.
    """
    numbers = {column: varied[column].numbers[indices[:, column]] for column in shared.columns}
    allowed = np.ones(len(indices), dtype=np.bool_)
    for column, parameter in shared.bounds:
        allowed &= _is_within_bounds(parameter, numbers[column])
    dependent_values = []
    for dependency_group in shared.reaching:
        distinct, index_of = np.unique(
            indices[:, list(dependency_group.columns)], axis=0, return_inverse=True
        )
        resolved = [_resolved_values(shared, varied, dependency_group, item) for item in distinct.tolist()]
        dependent_values.append((dependency_group.names, resolved, index_of.ravel()))
        allowed &= np.array([numbers is not None for numbers in resolved])[index_of.ravel()]
    independent_columns = sorted(
        set(shared.columns).difference(*(dependency_group.columns for dependency_group in shared.reaching)),
        key=lambda column: varied[column].free.group or "",
    )

    def vectors(peer_class: PeerClass) -> Floats:
        """Return the parameters of a class at the points (k, n_p), or (1, n_p) if they are constant."""
        index, peer = shared.evaluator.first_peer(peer_class)
        names, group_name = peer_class.jacobians.peer_type.parameters, shared.model.groups[index].name
        vectors = peer_class.parameters[None]

        def set_columns(changed_columns: list[int], values: Floats) -> None:
            """Set some columns of the parameters."""
            nonlocal vectors
            if changed_columns:
                vectors = np.array(np.broadcast_to(vectors, (len(indices), len(names))))
                vectors[:, changed_columns] = values

        for reached, resolved, index_of in dependent_values:
            rows = [
                peer_class.parameters
                if numbers is None
                else numbers.parameters[index][numbers.rows[index][peer]]
                for numbers in resolved
            ]
            changed_columns = [column for column, name in enumerate(names) if name in reached]
            set_columns(changed_columns, np.array(rows)[:, changed_columns][index_of])
        for column in independent_columns:  # a group's own value after the common one
            parameter_ref = varied[column].free
            if parameter_ref.name in names and parameter_ref.group in (None, group_name):
                set_columns([names.index(parameter_ref.name)], numbers[column][:, None])
        return vectors

    return allowed, vectors


def _resolved_values(
    shared: _SharedMatrices,
    varied: Sequence[SweptParameter],
    dependency_group: _DependencyGroup,
    indices: Sequence[int],
) -> ResolvedNumbers | None:
    """Return the model's parameters with dependents, cached; None if the values are invalid.

    `indices` are those of the values of the group's varied parameters, in the order of its columns.
    """
    overrides = tuple(
        varied[column].override(index)
        for column, index in zip(dependency_group.columns, indices, strict=True)
    )
    if overrides not in shared.resolved:
        if len(shared.resolved) >= MOST_RESOLVED:
            shared.resolved.clear()
        try:
            shared.resolved[overrides] = resolve(apply(shared.model, overrides))
        except ApcError:
            shared.resolved[overrides] = None
    return shared.resolved[overrides]


def _is_within_bounds(parameter: Parameter, values: Floats) -> Truths:
    """Return the mask of values that are within a parameter's limits."""
    low = -np.inf if parameter.minimum is None else parameter.minimum
    high = np.inf if parameter.maximum is None else parameter.maximum
    above_minimum = values > low if parameter.exclusive_minimum else values >= low
    return np.asarray(above_minimum & (values <= high))
