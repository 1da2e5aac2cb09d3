"""Many analyses at once: the verdict, the spectral radius with its bound, and how the leading mode moves.

Takes: a `Model`, and values of some of its parameters and times.
Gives: `SweptParameter`, `BatchResult`; `ManyAnalyses`, `many_analyses`, `by_matrices`; `Analyses`,
`analyze_many`.
Guarantees: what `analysis.analyze` gives at each point, to the bounds: what the matrices of many points
leave open, or say of it less than an analysis would, has an analysis of its own.
Does not: give all modes, or share out work among processes (see `sweeps`).

Points whose times and numbers of peers are the same have the same schedules, and one `BatchEvaluator`; the
matrices come with their bounds (`BatchEvaluator.bounded`), the largest eigenvalue with its own
(`eigen.enclosure`), and the turns of its mode are counted along its own motion (`frame.course`).
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
from apc.analysis.plan import make_plan
from apc.compiler.compiled import Model, Parameter
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.eigen.peers import PeerClass
from apc.eigen.rigid import what_stands
from apc.eigen.spectrum import (
    judge,
)
from apc.frame.ages import linear_sites
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, instance, prepare
from apc.frame.names import ParameterRef, find, notes_for_all_groups, unit_of
from apc.frame.overrides import Override, apply
from apc.frame.parameters import ResolvedNumbers, resolve, scope_of
from apc.network.nominal import left_out, refuse_channel_number
from apc.result import Result
from apc.threads import single_threaded
from apc.vary.batch import BatchEvaluator, batch_evaluator
from apc.vary.evaluator import EvaluatorKey, generic, reaches_count, reaches_time
from apc.vary.leading import DrivingPart, leading, parts_of
from apc.verdict import StabilityVerdict

if TYPE_CHECKING:
    import pandas

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Truths = NDArray[np.bool_]

PLACE = SourceLocation("analyze_many")

# What stands in the verdict's place of a point whose numbers can't be computed with.
FAULT = "error: "

# Points whose matrices are made together, and their entries: what they are made of then stays in the cache of
# a processor, and is not given back to the system and fetched anew each time.
TOGETHER, ENTRIES = 2048, 112 * 2**10

# A bound that is so many times as wide as most is made anew, by an analysis of its point, unless more than
# this share of all are.
WIDER, RARE = 4.0, 0.01

# An evaluator takes as long to prepare as one analysis: for fewer points it isn't.
FEWEST = 3

# Sets of numbers kept that others follow from.
MOST_RESOLVED = 4096

# Evaluators kept for the next points of the same times, those of them kept for the next call, and states of a
# system that is worth one.
KEPT, KEPT_ON, MOST_STATES = 64, 8, 120

# Loops of a scene, as of a ring's eigenvalues, beyond which each point is analysed by itself.
MOST_LOOPS = 128


@dataclass(frozen=True, slots=True, eq=False)
class SweptParameter:
    """A parameter or time that varies, and its values in SI: as floats (v,), and exactly by their places."""

    free: ParameterRef
    numbers: Floats
    exact: Callable[[int], Fraction]

    def override(self, place: int) -> Override:
        """Return what sets it to one of its values."""
        return Override(self.free, self.exact(place))


@dataclass(frozen=True, slots=True, eq=False)
class BatchResult:
    """What analyses give at k points; of a point at fault the verdict is `error: ` and the message's code.

    Numbers are NaN where there is none; `rigid_modes` is −1 at a point at fault.
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
        """Return so many rows that say nothing yet."""
        radius, error, frequency, damping = np.full((4, count), np.nan)
        verdict, message = np.full((2, count), "", dtype=object)
        return cls(verdict, radius, error, np.full(count, -1), frequency, damping, message)


@dataclass(frozen=True, slots=True)
class _Reaching:
    """Varied numbers, by their columns, from which others follow: the names of these and their own.

    No other number of a scene follows from both these and what varies besides.
    """

    columns: tuple[int, ...]
    names: frozenset[str]


@dataclass(frozen=True, slots=True, eq=False)
class _Family:
    """What all points of the same times share; `rigid` and `drifts` are those of the whole."""

    system: Model
    evaluator: BatchEvaluator
    columns: tuple[int, ...]  # which of the varied each free parameter is
    reaching: tuple[_Reaching, ...]
    rigid: int
    drifts: int
    bounds: tuple[tuple[int, Parameter], ...]  # the parameters that a varied one sets, by its column
    patterns: tuple[Truths, ...]  # which entries of each system's matrix may be other than 0
    parts: tuple[DrivingPart, ...]
    resolved: dict[tuple[Override, ...], ResolvedNumbers | None] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class ManyAnalyses:
    """The analyses of one scene at values of what varies; made ready once, asked any number of times."""

    system: Model
    varied: tuple[SweptParameter, ...]
    prepared: Prepared
    times: tuple[int, ...]
    families: dict[tuple[int, ...], _Family | None] = field(default_factory=dict)

    def at(self, places: Integers) -> BatchResult:
        """Return what the analyses of points give, whose values are at these places (k, m) of the varied."""
        rows = BatchResult.nothing(len(places))
        still_open = np.ones(len(places), dtype=np.bool_)
        if len(places):
            timings, which = np.unique(places[:, list(self.times)], axis=0, return_inverse=True)
            for number, timing in enumerate(timings.tolist()):
                some = np.flatnonzero(which.ravel() == number)
                family = self._family(tuple(timing), len(some))
                if family is not None:
                    still_open[some] = ~_filled(family, self.varied, places, some, rows)
        for point in np.flatnonzero(still_open).tolist():
            self._alone(places[point], point, rows)
        return rows

    def _family(self, timing: tuple[int, ...], count: int) -> _Family | None:
        """Return what points of these times share, None where each of them has an analysis of its own."""
        if count < FEWEST:  # whatever was asked before: the same points have the same bits each time
            return None
        if timing not in self.families:
            while len(self.families) >= KEPT:
                self.families.pop(next(iter(self.families)))
            given = tuple(
                self.varied[column].override(place) for column, place in zip(self.times, timing, strict=True)
            )
            asked = EvaluatorKey.of(self.system, [varied.free for varied in self.varied], self.prepared)
            self.families[timing] = _family(asked, self.times, given)
        return self.families[timing]

    def _alone(self, places: Integers, row: int, rows: BatchResult) -> None:
        """Analyse one point by itself."""
        try:
            overrides = [
                varied.override(place) for varied, place in zip(self.varied, places.tolist(), strict=True)
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
    """The answers of many analyses, arrays of the shape of the values.

    `parameters` names what varied, with its unit, and `values` holds its values in SI. The columns are
    those of `BatchResult`; `left_out` says what of the scene the answers do not look at.
    """

    shown_by = "vary_output:analyses"

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
    left_out: tuple[str, ...]

    @property
    def stable(self) -> Truths:
        """Where it is stable, up to a common motion or without; neither drifts, nor is left open."""
        return np.isin(self.verdict, [verdict for verdict in StabilityVerdict if verdict.stable])

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a pandas table, a row a point: the values first, then the answers."""
        table: pandas.DataFrame = self._shown("table")
        return table


def analyze_many(system: Model, values: Mapping[str, Any]) -> Analyses:
    """Analyse a scene at many values of some parameters and times.

    Parameters
    ----------
    system
        The compiled scene; its numbers hold for what is not given.
    values
        By the name of each parameter or time its values: an array in SI, or quantities such as "8 ms".
        Arrays of different shapes are broadcast against one another.

    Raises
    ------
    ApcError
        E622, E623 no such parameter; E896 a number of a network's; E881 no values, or none that can be.
    """
    if not values:
        what = "nothing varies"
        raise ApcError(Diagnostic("E883", PLACE, what, hint='{"contact.stiffness": [500.0, 1000.0]}'))
    frees, listed = [], []
    for name, given in values.items():
        free = find(system, name.strip(), PLACE, counts=True)
        if free in frees:
            raise ApcError(Diagnostic("E883", PLACE, f"{free.label} is given twice"))
        refuse_channel_number(system, free, PLACE)
        frees.append(free)
        listed.append(_numbers_of(system, free, given))
    try:
        arrays = np.broadcast_arrays(*listed)
    except ValueError:
        shapes = " and ".join(str(values.shape) for values in listed)
        what = f"values of the shapes {shapes} can't be broadcast against one another"
        raise ApcError(Diagnostic("E881", PLACE, what)) from None
    varied, places = [], []
    for free, array in zip(frees, arrays, strict=True):
        numbers, which = np.unique(array.ravel(), return_inverse=True)
        varied.append(SweptParameter(free, numbers, partial(_shortest, numbers)))
        places.append(which)
    rows = many_analyses(system, varied).at(np.stack(places, axis=1))
    shape = arrays[0].shape
    units = [unit_of(system, free.name) for free in frees]
    return Analyses(
        topology=system.name,
        parameters=tuple(
            free.label if unit == "1" else f"{free.label} [{unit}]"
            for free, unit in zip(frees, units, strict=True)
        ),
        values=tuple(arrays),
        **{field.name: getattr(rows, field.name).reshape(shape) for field in fields(rows)},
        left_out=(*near_start(system), *left_out(system, varied=frees), *notes_for_all_groups(system, frees)),
    )


def _numbers_of(system: Model, free: ParameterRef, given: Any) -> Floats:
    """Read the values of a parameter: numbers in SI, or quantities."""
    unit, what = unit_of(system, free.name), f"the values of {free.label}"
    array = np.asarray(given)
    if array.dtype.kind in "UO" and all(isinstance(item, str) for item in array.ravel().tolist()):
        # The language of quantities, which numbers never need.
        from apc.compiler.language.units import quantity

        read = [quantity(text, PLACE, what=free.label, unit=unit).value for text in array.ravel().tolist()]
        array = np.array([float(number) for number in read]).reshape(array.shape)
    if array.dtype.kind not in "fiu" or not array.size or not np.isfinite(array).all():
        expected = f"finite numbers, in {unit}" if unit != "1" else "finite numbers"
        raise ApcError(Diagnostic("E881", PLACE, what, expected, str(given)[:40]))
    return array.astype(np.float64)


def _shortest(numbers: Floats, place: int) -> Fraction:
    """Return a value as the shortest decimal that is this float: 8 ms are no 8.000000000000000167 ms."""
    return Fraction(repr(float(numbers[place])))


def by_matrices(system: Model) -> bool:
    """Say whether matrices of many points can be had at once: all follows from the parameters alone."""
    sites = linear_sites(system)
    return all(sites[group.kind].parameters_suffice for group in system.groups)


def many_analyses(system: Model, varied: Sequence[SweptParameter]) -> ManyAnalyses:
    """Make ready the analyses of a scene at many values.

    Parameters
    ----------
    system
        The compiled scene; its numbers hold for what does not vary.
    varied
        What varies.
    """
    times = tuple(
        column
        for column, item in enumerate(varied)
        if reaches_time(system, item.free) or reaches_count(system, item.free)
    )
    return ManyAnalyses(system, tuple(varied), prepare(system), times)


@lru_cache(maxsize=KEPT_ON)
def _family(of: EvaluatorKey, times: tuple[int, ...], given: tuple[Override, ...]) -> _Family | None:
    """Prepare the matrices for some times; None where an analysis of the scene is no matter of these."""
    system, prepared = of.system, of.prepared
    columns = tuple(column for column in range(len(of.free)) if column not in times)
    free = tuple(of.free[column] for column in columns)
    try:
        with finite_equations(system.origin.topology), np.errstate(all="ignore"):
            timed_system = apply(system, given)
            there = generic(timed_system, free)
            scene = instance(there, prepared)
            if not all(site.parameters_suffice for site in scene.sites):
                return None
            plan = make_plan(scene)
            if not plan.loops or len(plan.loops) > MOST_LOOPS or plan.method == "determinant":
                return None
            if max(loop.states for loop in plan.loops) > MOST_STATES:
                return None
            evaluator = batch_evaluator(timed_system, free, plan.groups, scene.exchange)
    except ApcError:
        return None  # each point tells
    rigid = drifts = 0
    for loop, wiring in zip(plan.loops, evaluator.wirings, strict=True):
        if wiring.moving or (wiring.rigid.names and what_stands(loop).unfelt):
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
    """Return the varied numbers from which any others follow, those together of which the same does."""
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
    family: _Family, varied: Sequence[SweptParameter], places: Integers, numbers: Integers, rows: BatchResult
) -> Truths:
    """Fill in what the matrices of some points decide, and say of each whether they do."""
    done = np.zeros(len(numbers), dtype=np.bool_)
    states = max(len(closed_system.layout.names) for closed_system in family.evaluator.closed)
    together = max(1, min(TOGETHER, ENTRIES // states**2))
    with single_threaded(), np.errstate(all="ignore"):
        for start in range(0, len(numbers), together):
            mine = slice(start, start + together)
            done[mine] = _decided(family, varied, places[numbers[mine]], numbers[mine], rows)
    return done


def _decided(
    family: _Family,
    varied: Sequence[SweptParameter],
    places: Integers,
    rows: Integers,
    result: BatchResult,
) -> Truths:
    """Do so for few points at a time."""
    allowed, vectors = _vectors(family, varied, places)
    systems = family.evaluator.bounded(vectors)
    for system, pattern in zip(systems, family.patterns, strict=True):
        # What is 0 at a value of no meaning is so at all; NaN and infinite are no matrices.
        size = np.abs(system.matrix) + system.error
        allowed &= np.isfinite(size.sum(axis=(1, 2)))
        if not pattern.all():
            allowed &= ~size[:, ~pattern].any(axis=1)
    some = np.flatnonzero(allowed)
    known = leading(family.evaluator, family.parts, [system.at(some) for system in systems], len(some))
    into = np.flatnonzero(known.certain)
    into = into[~_loose(known.error[into])]
    some = some[into]
    place, radius = rows[some], known.radius[into]
    result.verdict[place] = judge([True], family.rigid, family.drifts)[0]
    result.verdict[place[radius > 1]] = StabilityVerdict.UNSTABLE
    result.spectral_radius[place], result.spectral_radius_error[place] = radius, known.error[into]
    result.rigid_modes[place] = family.rigid
    result.frequency_hz[place], result.damping_ratio[place] = (
        known.frequency_hz[into],
        known.damping_ratio[into],
    )
    done = np.zeros(len(rows), dtype=np.bool_)
    done[some] = True
    return done


def _loose(error: Floats) -> Truths:
    """Return which points have far wider bounds (k,) than most: an analysis of each tells them as ever.

    Near an eigenvalue that is a double one what is shared with others no longer serves. Where many are wider
    that is not why.
    """
    wide = error > WIDER * np.median(error) if len(error) else np.zeros(0, dtype=np.bool_)
    return wide if wide.sum() <= RARE * len(error) else np.zeros(len(error), dtype=np.bool_)


def _vectors(
    family: _Family, varied: Sequence[SweptParameter], places: Integers
) -> tuple[Truths, Callable[[PeerClass], Floats]]:
    """Return which points may be, and what gives each group's parameters there (k, n_p), or (1, n_p).

    A number that follows from others is worked out as for an analysis, in rationals, once for all points that
    agree in what it follows from: over a grid of two such, once for each value of either.
    """
    numbers = {column: varied[column].numbers[places[:, column]] for column in family.columns}
    allowed = np.ones(len(places), dtype=np.bool_)
    for column, parameter in family.bounds:
        allowed &= _keeps_bounds(parameter, numbers[column])
    settled = []
    for some in family.reaching:
        different, which = np.unique(places[:, list(some.columns)], axis=0, return_inverse=True)
        there = [_resolved(family, varied, some, item) for item in different.tolist()]
        settled.append((some.names, there, which.ravel()))
        allowed &= np.array([numbers is not None for numbers in there])[which.ravel()]
    plain = sorted(
        set(family.columns).difference(*(some.columns for some in family.reaching)),
        key=lambda column: varied[column].free.group or "",
    )

    def vectors(group: PeerClass) -> Floats:
        place, peer = family.evaluator.first_peer(group)
        names, own = group.jacobians.kind.parameters, family.system.groups[place].name
        vectors = group.parameters[None]

        def put(where: list[int], values: Floats) -> None:
            nonlocal vectors
            if where:
                vectors = np.array(np.broadcast_to(vectors, (len(places), len(names))))
                vectors[:, where] = values

        for reached, there, which in settled:
            rows = [
                group.parameters if numbers is None else numbers.parameters[place][numbers.rows[place][peer]]
                for numbers in there
            ]
            where = [column for column, name in enumerate(names) if name in reached]
            put(where, np.array(rows)[:, where][which])
        for column in plain:  # a group's own value after that of everybody
            free = varied[column].free
            if free.name in names and free.group in (None, own):
                put([names.index(free.name)], numbers[column][:, None])
        return vectors

    return allowed, vectors


def _resolved(
    family: _Family, varied: Sequence[SweptParameter], reaching: _Reaching, places: Sequence[int]
) -> ResolvedNumbers | None:
    """Return the scene's numbers with what others follow from at these places; None if these may not be."""
    given = tuple(
        varied[column].override(place) for column, place in zip(reaching.columns, places, strict=True)
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
    """Say which values a parameter may have."""
    low = -np.inf if parameter.minimum is None else parameter.minimum
    high = np.inf if parameter.maximum is None else parameter.maximum
    above = values > low if parameter.open_minimum else values >= low
    return np.asarray(above & (values <= high))
