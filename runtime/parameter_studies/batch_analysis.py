"""Batch analyses: verdict, spectral radius with its bound, and the motion of the dominant mode.

Takes: a `Model`, and values of some of its parameters and times.
Gives: `SweptParameter`, `BatchResult`; `ManyAnalyses`, `many_analyses`, `by_matrices`; `Analyses`,
`analyze_many`.
Guarantees: the results of `analysis.analyze` at each point, within the bounds: points that the matrices leave
undecided, or describe less accurately than an analysis, are analysed separately.
Does not: compute all modes, or distribute work among processes (see `sweeps`).

Points with equal times and numbers of peers have the same schedules, and one `BatchEvaluator`; the matrices
come with their bounds (`BatchEvaluator.bounded`), the largest eigenvalue with its own (`eigen.enclosure`),
and the turns of its mode are counted along its own motion (`frame.phase_unwrapping`).
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
from apc.eigen.peer_classes import PeerClass
from apc.eigen.rigid_modes import classify_neutral_modes
from apc.eigen.spectrum import (
    combine_verdicts,
)
from apc.frame.data_age import linear_subsystems
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import Prepared, instance, prepare
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, find, notes_for_all_groups, unit_of
from apc.frame.parameters import ResolvedNumbers, resolve, scope_of
from apc.network.nominal_criterion import limitations, refuse_channel_number
from apc.parameter_studies.dominant_eigenvalue import DrivingPart, dominant, parts_of
from apc.parameter_studies.evaluator import EvaluatorKey, generic, reaches_count, reaches_time
from apc.parameter_studies.frame_matrices import BatchEvaluator, batch_evaluator
from apc.result import Result
from apc.threads import single_threaded
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

# A bound wider than the median by this factor is recomputed by an analysis of its point, unless more than
# this share of all points have one.
WIDER, RARE = 4.0, 0.01

# The smallest number of points worth an evaluator, which takes as long to prepare as one analysis.
FEWEST = 3

# Cached sets of parameters with dependents.
MOST_RESOLVED = 4096

# Cached evaluators: for later points of the same times, for the next call, and the size of a system that is
# worth one.
CACHE_SIZE, STORED_ON, MOST_STATES = 64, 8, 120

# The limit of loops of a model, such as a ring's eigenvalues, beyond which each point is analysed separately.
MOST_LOOPS = 128


@dataclass(frozen=True, slots=True, eq=False)
class SweptParameter:
    """A parameter or time that varies, and its values in SI: as floats (v,), and exactly by index."""

    free: ParameterRef
    numbers: Floats
    exact: Callable[[int], Fraction]

    def override(self, index: int) -> Override:
        """Return the override for one of its values."""
        return Override(self.free, self.exact(index))


@dataclass(frozen=True, slots=True, eq=False)
class BatchResult:
    """The results of analyses at k points; a failed point has the verdict `error: ` with the code.

    Numbers are NaN where there is none; `rigid_modes` is −1 at a failed point.
    """

    verdict: NDArray[Any]  # str
    spectral_radius: Floats
    spectral_radius_error: Floats
    rigid_modes: Integers
    frequency_hz: Floats
    damping_ratio: Floats
    message: NDArray[Any]  # str

    @classmethod
    def nothing(cls, count: int) -> BatchResult:
        """Return rows without results yet."""
        radius, error, frequency, damping = np.full((4, count), np.nan)
        verdict, message = np.full((2, count), "", dtype=object)
        return cls(verdict, radius, error, np.full(count, -1), frequency, damping, message)


@dataclass(frozen=True, slots=True)
class _Reaching:
    """Varied parameters with dependents, by their columns: the names of both.

    No other parameter depends on both these and other varied parameters.
    """

    columns: tuple[int, ...]
    names: frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class _Family:
    """The data shared by all points of the same times; `rigid` and `drifts` are totals."""

    system: Model
    evaluator: BatchEvaluator
    columns: tuple[int, ...]  # the index in the varied of each free parameter
    reaching: tuple[_Reaching, ...]
    rigid: int
    drifts: int
    bounds: tuple[tuple[int, Parameter], ...]  # the parameters that a varied one sets, by its column
    patterns: tuple[Truths, ...]  # possible nonzeros of each system's matrix
    parts: tuple[DrivingPart, ...]
    resolved: dict[tuple[Override, ...], ResolvedNumbers | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ManyAnalyses:
    """The analyses of one model over its varied parameters; prepared once, evaluated any number of times."""

    system: Model
    varied: tuple[SweptParameter, ...]
    prepared: Prepared
    times: tuple[int, ...]
    families: dict[tuple[int, ...], _Family | None] = field(default_factory=dict)

    def at(self, indices: Integers) -> BatchResult:
        """Return the results of points, given by the indices (k, m) of the varied parameters' values."""
        rows = BatchResult.nothing(len(indices))
        still_open = np.ones(len(indices), dtype=np.bool_)
        if len(indices):
            timings, which = np.unique(indices[:, list(self.times)], axis=0, return_inverse=True)
            for number, timing in enumerate(timings.tolist()):
                some = np.flatnonzero(which.ravel() == number)
                family = self._family(tuple(timing), len(some))
                if family is not None:
                    still_open[some] = ~_filled(family, self.varied, indices, some, rows)
        for point in np.flatnonzero(still_open).tolist():
            self._single(indices[point], point, rows)
        return rows

    def _family(self, timing: tuple[int, ...], count: int) -> _Family | None:
        """Return the data shared by points of these times, None where each has an analysis of its own."""
        if count < FEWEST:  # independent of earlier calls: the same points have the same bits each time
            return None
        if timing not in self.families:
            while len(self.families) >= CACHE_SIZE:
                self.families.pop(next(iter(self.families)))
            given = tuple(
                self.varied[column].override(index) for column, index in zip(self.times, timing, strict=True)
            )
            requested = EvaluatorKey.of(self.system, [varied.free for varied in self.varied], self.prepared)
            self.families[timing] = _family(requested, self.times, given)
        return self.families[timing]

    def _single(self, indices: Integers, row: int, rows: BatchResult) -> None:
        """Analyse one point separately."""
        try:
            overrides = [
                varied.override(index) for varied, index in zip(self.varied, indices.tolist(), strict=True)
            ]
            analysis: Analysis = analyze(apply(self.system, overrides), prepared=self.prepared)
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

    `parameters` names the varied parameters, with units, and `values` holds their values in SI. The columns
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
        """Where it is stable, including up to common motions, without drifts and undecided points."""
        return np.isin(self.verdict, [verdict for verdict in StabilityVerdict if verdict.stable])

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas table, one row per point: the values first, then the results."""
        table: pandas.DataFrame = self._shown("table")
        return table


def analyze_many(system: Model, values: Mapping[str, Any]) -> Analyses:
    """Analyse a model at many values of some parameters and times.

    Parameters
    ----------
    system
        The compiled model; its values hold for all other parameters.
    values
        The values of each parameter or time by its name: an array in SI, or quantities such as "8 ms". Arrays
        of different shapes are broadcast against one another.

    Raises
    ------
    ApcError
        E622, E623 no such parameter; E896 a parameter of a network; E881 no values, or invalid ones.
    """
    if not values:
        message = "nothing varies"
        raise ApcError(Diagnostic("E883", LOCATION, message, hint='{"contact.stiffness": [500.0, 1000.0]}'))
    parameter_refs, listed = [], []
    for name, given in values.items():
        free = find(system, name.strip(), LOCATION, counts=True)
        if free in parameter_refs:
            raise ApcError(Diagnostic("E883", LOCATION, f"{free.label} is given twice"))
        refuse_channel_number(system, free, LOCATION)
        parameter_refs.append(free)
        listed.append(_numbers_of(system, free, given))
    try:
        arrays = np.broadcast_arrays(*listed)
    except ValueError:
        shapes = " and ".join(str(values.shape) for values in listed)
        message = f"values of the shapes {shapes} can't be broadcast against one another"
        raise ApcError(Diagnostic("E881", LOCATION, message)) from None
    varied, indices = [], []
    for free, array in zip(parameter_refs, arrays, strict=True):
        numbers, which = np.unique(array.ravel(), return_inverse=True)
        varied.append(SweptParameter(free, numbers, partial(_shortest, numbers)))
        indices.append(which)
    rows = many_analyses(system, varied).at(np.stack(indices, axis=1))
    shape = arrays[0].shape
    units = [unit_of(system, free.name) for free in parameter_refs]
    return Analyses(
        topology=system.name,
        parameters=tuple(
            free.label if unit == "1" else f"{free.label} [{unit}]"
            for free, unit in zip(parameter_refs, units, strict=True)
        ),
        values=tuple(arrays),
        **{field.name: getattr(rows, field.name).reshape(shape) for field in fields(rows)},
        limitations=(
            *near_start(system),
            *limitations(system, varied=parameter_refs),
            *notes_for_all_groups(system, parameter_refs),
        ),
    )


def _numbers_of(system: Model, free: ParameterRef, given: Any) -> Floats:
    """Return the values of a parameter from numbers in SI, or quantities."""
    unit, message = unit_of(system, free.name), f"the values of {free.label}"
    array = np.asarray(given)
    if array.dtype.kind in "UO" and all(isinstance(item, str) for item in array.ravel().tolist()):
        # The language of quantities, which numbers never need.
        from apc.compiler.language.units import quantity

        read = [
            quantity(text, LOCATION, subject=free.label, unit=unit).value for text in array.ravel().tolist()
        ]
        array = np.array([float(number) for number in read]).reshape(array.shape)
    if array.dtype.kind not in "fiu" or not array.size or not np.isfinite(array).all():
        expected = f"finite numbers, in {unit}" if unit != "1" else "finite numbers"
        raise ApcError(Diagnostic("E881", LOCATION, message, expected, str(given)[:40]))
    return array.astype(np.float64)


def _shortest(numbers: Floats, index: int) -> Fraction:
    """Return the shortest decimal that is this float: 8 ms, not 8.000000000000000167 ms."""
    return Fraction(repr(float(numbers[index])))


def by_matrices(system: Model) -> bool:
    """Return whether matrices of many points can be computed together, from the parameters alone."""
    subsystems = linear_subsystems(system)
    return all(subsystems[group.peer_type].parameters_suffice for group in system.groups)


def many_analyses(system: Model, varied: Sequence[SweptParameter]) -> ManyAnalyses:
    """Return the prepared analyses of a model at many values.

    Parameters
    ----------
    system
        The compiled model; its values hold for parameters that do not vary.
    varied
        The parameters that vary.
    """
    times = tuple(
        column
        for column, item in enumerate(varied)
        if reaches_time(system, item.free) or reaches_count(system, item.free)
    )
    return ManyAnalyses(system, tuple(varied), prepare(system), times)


@lru_cache(maxsize=STORED_ON)
def _family(of: EvaluatorKey, times: tuple[int, ...], given: tuple[Override, ...]) -> _Family | None:
    """Return the matrices for some times; None where an analysis needs another method."""
    system, prepared = of.system, of.prepared
    columns = tuple(column for column in range(len(of.free)) if column not in times)
    free = tuple(of.free[column] for column in columns)
    try:
        with finite_equations(system.origin.topology), np.errstate(all="ignore"):
            timed_system = apply(system, given)
            there = generic(timed_system, free)
            topology = instance(there, prepared)
            if not all(subsystem.parameters_suffice for subsystem in topology.subsystems):
                return None
            plan = make_plan(topology)
            if not plan.loops or len(plan.loops) > MOST_LOOPS or plan.method == "determinant":
                return None
            if max(loop.states for loop in plan.loops) > MOST_STATES:
                return None
            evaluator = batch_evaluator(timed_system, free, plan.groups, topology.exchange)
    except ApcError:
        return None  # each point reports its own
    rigid = drifts = 0
    for loop, wiring in zip(plan.loops, evaluator.wirings, strict=True):
        if wiring.moving or (wiring.rigid.names and classify_neutral_modes(loop).unobservable):
            return None
        rigid += loop.multiplicity * len(wiring.rigid.names)
        drifts += loop.multiplicity * wiring.rigid.drifts
    names = {item.name: column for column, item in zip(columns, free, strict=True)}
    every = (*timed_system.parameters, *(value for group in timed_system.groups for value in group.values))
    parts, patterns = parts_of(evaluator)
    return _Family(
        system=timed_system,
        evaluator=evaluator,
        columns=columns,
        reaching=_reaching(timed_system, columns, free),
        rigid=rigid,
        drifts=drifts,
        bounds=tuple((names[parameter.name], parameter) for parameter in every if parameter.name in names),
        patterns=patterns,
        parts=parts,
    )


def _reaching(system: Model, columns: Sequence[int], free: Sequence[ParameterRef]) -> tuple[_Reaching, ...]:
    """Return the varied parameters with dependents, grouped by common dependents."""
    scopes = [scope_of(system), *(scope_of(system, group.values) for group in system.groups)]
    reachings: list[_Reaching] = []
    for column, item in zip(columns, free, strict=True):
        reached = [scope.follow({item.name: None}, lambda *_: None, lambda _: None) for scope in scopes]
        mine = _Reaching((column,), frozenset[str]().union(*reached))
        if len(mine.names) > 1:
            shared = [other for other in reachings if other.names & mine.names]
            every = [*shared, mine]
            reachings = [other for other in reachings if other not in shared]
            reachings.append(
                _Reaching(
                    tuple(column for other in every for column in other.columns),
                    frozenset[str]().union(*(other.names for other in every)),
                )
            )
    return tuple(reachings)


def _filled(
    family: _Family, varied: Sequence[SweptParameter], indices: Integers, numbers: Integers, rows: BatchResult
) -> Truths:
    """Fill in the results that the matrices of some points decide, and return which they do."""
    done = np.zeros(len(numbers), dtype=np.bool_)
    states = max(len(closed_system.layout.names) for closed_system in family.evaluator.closed)
    together = max(1, min(TOGETHER, ENTRIES // states**2))
    with single_threaded(), np.errstate(all="ignore"):
        for start in range(0, len(numbers), together):
            mine = slice(start, start + together)
            done[mine] = _decided(family, varied, indices[numbers[mine]], numbers[mine], rows)
    return done


def _decided(
    family: _Family,
    varied: Sequence[SweptParameter],
    indices: Integers,
    rows: Integers,
    result: BatchResult,
) -> Truths:
    """Do the same for a block of points."""
    allowed, vectors = _vectors(family, varied, indices)
    systems = family.evaluator.bounded(vectors)
    for system, pattern in zip(systems, family.patterns, strict=True):
        # A zero at meaningless values is structural; NaN and infinite entries give no matrices.
        size = np.abs(system.matrix) + system.error
        allowed &= np.isfinite(size.sum(axis=(1, 2)))
        if not pattern.all():
            allowed &= ~size[:, ~pattern].any(axis=1)
    some = np.flatnonzero(allowed)
    known = dominant(family.evaluator, family.parts, [system.at(some) for system in systems], len(some))
    into = np.flatnonzero(known.certain)
    into = into[~_loose(known.error[into])]
    some = some[into]
    index, radius = rows[some], known.radius[into]
    result.verdict[index] = combine_verdicts([True], family.rigid, family.drifts)[0]
    result.verdict[index[radius > 1]] = StabilityVerdict.UNSTABLE
    result.spectral_radius[index], result.spectral_radius_error[index] = radius, known.error[into]
    result.rigid_modes[index] = family.rigid
    result.frequency_hz[index], result.damping_ratio[index] = (
        known.frequency_hz[into],
        known.damping_ratio[into],
    )
    done = np.zeros(len(rows), dtype=np.bool_)
    done[some] = True
    return done


def _loose(error: Floats) -> Truths:
    """Return the points with far wider bounds (k,) than the median, which an analysis recomputes.

    Near a double eigenvalue the shared data is not accurate. Where many bounds are wide there is another
    cause.
    """
    wide = error > WIDER * np.median(error) if len(error) else np.zeros(0, dtype=np.bool_)
    return wide if wide.sum() <= RARE * len(error) else np.zeros(len(error), dtype=np.bool_)


def _vectors(
    family: _Family, varied: Sequence[SweptParameter], indices: Integers
) -> tuple[Truths, Callable[[PeerClass], Floats]]:
    """Return which points are valid, and the parameters of each group there (k, n_p), or (1, n_p).

    A dependent parameter is computed as in an analysis, in rationals, once for all points that agree in its
    independents: over a grid of two such, once for each value of each.
    """
    numbers = {column: varied[column].numbers[indices[:, column]] for column in family.columns}
    allowed = np.ones(len(indices), dtype=np.bool_)
    for column, parameter in family.bounds:
        allowed &= _keeps_bounds(parameter, numbers[column])
    settled = []
    for some in family.reaching:
        different, which = np.unique(indices[:, list(some.columns)], axis=0, return_inverse=True)
        there = [_resolved(family, varied, some, item) for item in different.tolist()]
        settled.append((some.names, there, which.ravel()))
        allowed &= np.array([numbers is not None for numbers in there])[which.ravel()]
    plain = sorted(
        set(family.columns).difference(*(some.columns for some in family.reaching)),
        key=lambda column: varied[column].free.group or "",
    )

    def vectors(group: PeerClass) -> Floats:
        index, peer = family.evaluator.first_peer(group)
        names, local = group.jacobians.peer_type.parameters, family.system.groups[index].name
        vectors = group.parameters[None]

        def put(where: list[int], values: Floats) -> None:
            nonlocal vectors
            if where:
                vectors = np.array(np.broadcast_to(vectors, (len(indices), len(names))))
                vectors[:, where] = values

        for reached, there, which in settled:
            rows = [
                group.parameters if numbers is None else numbers.parameters[index][numbers.rows[index][peer]]
                for numbers in there
            ]
            where = [column for column, name in enumerate(names) if name in reached]
            put(where, np.array(rows)[:, where][which])
        for column in plain:  # a group's own value after the common one
            free = varied[column].free
            if free.name in names and free.group in (None, local):
                put([names.index(free.name)], numbers[column][:, None])
        return vectors

    return allowed, vectors


def _resolved(
    family: _Family, varied: Sequence[SweptParameter], reaching: _Reaching, indices: Sequence[int]
) -> ResolvedNumbers | None:
    """Return the model's parameters with dependents at these indices; None if the values are invalid."""
    given = tuple(
        varied[column].override(index) for column, index in zip(reaching.columns, indices, strict=True)
    )
    if given not in family.resolved:
        if len(family.resolved) >= MOST_RESOLVED:
            family.resolved.clear()
        try:
            family.resolved[given] = resolve(apply(family.system, given))
        except ApcError:
            family.resolved[given] = None
    return family.resolved[given]


def _keeps_bounds(parameter: Parameter, values: Floats) -> Truths:
    """Return which values a parameter may have."""
    low = -np.inf if parameter.minimum is None else parameter.minimum
    high = np.inf if parameter.maximum is None else parameter.maximum
    above = values > low if parameter.exclusive_minimum else values >= low
    return np.asarray(above & (values <= high))
