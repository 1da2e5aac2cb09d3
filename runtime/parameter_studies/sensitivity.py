"""Sensitivities of the spectral radius: its derivative with respect to every parameter.

Takes: a `Model`.
Gives: `Sensitivity`, `Sensitivities`, `sensitivities`, `network_sensitivities`; `varied`, `not_varied`,
`of_channels`.
Guarantees: the derivative is that of the dominant mode, without rigid modes, accurate to rounding amplified
by neighbouring eigenvalues; each name can be set; where several eigenvalues share the radius, there is one
row for each of them and no common gradient.
Does not: vary times, or the number of peers; bound the error of a derivative, which decides no verdict.

For a simple eigenvalue, M v = λ v and w M = λ w,   dλ = w dM v / (w v),   d|λ| = Re(λ̄ dλ)/|λ|. A cluster of
equal eigenvalues with a full set of vectors moves as the eigenvalues of W dM V, W V = 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze, lifted_groups, prepare_at_start
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.compiler.wording import counted
from apc.eigen.eigenpairs import driving_parts, eigenpairs
from apc.eigen.modes import split
from apc.eigen.spectrum import solve_spectrum
from apc.frame.display_units import DisplayUnit
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.parameter_names import ParameterRef, named_times, parameter_of, unit_of, value_now
from apc.network.nominal_criterion import channel_numbers
from apc.parameter_studies.evaluator import evaluator, free_parameters
from apc.parameter_studies.stability_criteria import MEAN_SQUARE, NOMINAL, RadiusEvaluator
from apc.result import Result
from apc.threads import single_threaded

if TYPE_CHECKING:
    from apc.mean_square.mean_square_stability import StabilityMeasure

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Complexes = NDArray[np.complex128]

# Eigenvalues whose magnitudes differ by less than this may be equal within the rounding of their matrices:
# all of them are taken to share the radius.
SHARED = 1e-10

# Eigenvalues nearer to one another than this, relatively, are one cluster: rounding mixes their vectors by a
# ten-millionth or more. Where the vectors of such a cluster are worse conditioned than `SOUND`, it may be
# part of a larger cluster that rounding split.
EQUAL, CLOSE, SOUND = 1e-9, 1e-7, 1e6

# A cluster of vectors worse conditioned than this has no meaningful derivative.
WORST = 1e8

# The relative change of a parameter in the test whether removed rigid modes stay rigid.
ALONGSIDE = 2.0**-10

# The limit of parameters varied over a network: at some ten milliseconds a value they take a minute.
MOST_VARIED = 60

# The name of the second-moment growth in results.
MOMENTS = "second moments"

LOCATION = SourceLocation("sensitivities")


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """The sensitivity of one eigenvalue of largest magnitude to one parameter.

    `derivative` is d|λ|/dp in 1/unit; `relative` is p·d|λ|/dp, the change of the radius for a change of the
    parameter by its own size. `mode` counts the eigenvalues that share the radius, from 0.
    """

    parameter: str
    unit: str
    value: float
    derivative: float
    relative: float
    mode: int


@dataclass(frozen=True, slots=True)
class Sensitivities(Result):
    """All derivatives, the largest first, and their eigenvalues.

    `active` are the eigenvalues that share the radius, each named by its system: more than one at a crossing,
    where the radius itself has only one-sided derivatives, the extremes of theirs. `note` states this case,
    or why there is none.
    """

    shown_by = "parameter_studies_output:sensitivities"

    radius: float
    active: tuple[tuple[complex, str], ...]
    rows: tuple[Sensitivity, ...]
    note: str


@part("sensitivities")
def sensitivities(system: Model, *, prepared: Prepared | None = None) -> Sensitivities:
    """Return the derivative of the spectral radius with respect to every settable parameter.

    Parameters
    ----------
    system
        The compiled model, with the values at which to differentiate.
    prepared
        From `numeric_model.prepare`, of this model with any values.

    Raises
    ------
    ApcError
        As `analysis.lifted_groups`.

    Notes
    -----
    A motion that is rigid at a parameter of 0 only is not rigid where that parameter varies: it is
    differentiated separately.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        free, prepared = varied(system), prepared or prepare(system)
        start = prepare_at_start(system, prepared, free)
        if start is None:
            return _singly(system, prepared, free)
        systems = split(*lifted_groups(system, prepared=start))
        most = solve_spectrum(systems, in_balls=False).spectral_radius + SHARED

        @cache
        def clusters_of(*together: ParameterRef) -> list[_Cluster] | None:
            return _clusters(system, together, start)

        def parameter_refs(*together: ParameterRef) -> bool:
            """Return whether a mode that is rigid at the present values is not rigid where these vary."""
            return any(np.abs(cluster.values).max() > most for cluster in clusters_of(*together) or ())

        zero = [item for item in free if not parameter_of(system, item).value]
        rest = [item for item in free if item not in zero]
        loose = [free for free in zero if parameter_refs(free)]
        loose += [free for free in rest if parameter_refs(free)] if parameter_refs(*rest) else []
        listed = [
            [free for free in rest if free not in loose],
            *([free] for free in zero if free not in loose),
        ]
        rows: list[Sensitivity] = []
        clusters: list[_Cluster] = []
        notes, untied = [], [free.label for free in loose]
        for together in listed:
            result = clusters_of(*together)
            if result is None and together[0] in zero:  # other modes are rigid next to it
                untied.append(together[0].label)
                continue
            if result is None:  # equations have edges, where differences fail
                return _singly(system, prepared, free)
            clusters, first = clusters or result, 0
            for cluster in result:
                if not cluster.condition < WORST:
                    continue
                for column, local in enumerate(together):
                    if cluster.still[column]:
                        rows += _rows(system, local, cluster, column, first)
                    else:
                        untied.append(local.label)
                first += len(cluster.values)
    radius = max((float(np.abs(cluster.values).max()) for cluster in clusters), default=0.0)
    if not clusters:
        return Sensitivities(0.0, (), (), "nothing moves: there is no eigenvalue")
    if not radius:  # e^(λT) underflows
        note = "what moves it most: nothing, as every motion dies out to 0 within a frame"
        return Sensitivities(0.0, (), (), note)
    notes += [_defective(cluster) for cluster in clusters if not cluster.condition < WORST]
    active = tuple(
        (complex(value), cluster.name)
        for cluster in clusters
        if cluster.condition < WORST
        for value in cluster.values
    )
    if len(active) > 1:
        notes.append(f"{len(active)} eigenvalues share the radius: the largest of their changes decides")
    if untied:
        names = dict.fromkeys(untied)
        are = "are" if len(names) > 1 else "is"
        notes.append(f"{', '.join(names)} would move what was left out, and {are} not among these")
    if not rows and not notes:
        why = "no derivative is finite" if free else "there is no parameter to vary"
        notes.append(f"what moves it most: not known: {why}")
    rows.sort(key=lambda row: (-abs(row.relative), row.parameter, row.mode))
    return Sensitivities(radius, active, tuple(rows), "; ".join(notes))


def varied(system: Model) -> list[ParameterRef]:
    """Return the free parameters except start values and parameters of unreliable links."""
    starts = {state.start for peer_type in system.peer_types for state in peer_type.states}
    starts |= {
        start for peer_type in system.peer_types for clock in peer_type.clocks for start in clock.starts
    }
    excluded = starts | channel_numbers(system)
    return [free for free in free_parameters(system) if free.name not in excluded]


def _singly(system: Model, prepared: Prepared, free: Sequence[ParameterRef]) -> Sensitivities:
    """Return the derivatives of a model's spectral radius by differences of analyses."""
    now = analyze(system, prepared=prepared)
    if not now.modes:
        return Sensitivities(0.0, (), (), "nothing moves: there is no eigenvalue")
    most = now.spectral_radius - SHARED
    upper = (mode for mode in now.modes if mode.eigenvalue.imag >= -mode.error)  # one of a conjugate pair
    active = tuple((mode.eigenvalue, mode.family) for mode in upper if abs(mode.eigenvalue) >= most)
    if len(active) > 1:
        note = f"{len(active)} eigenvalues share the radius, which has no derivative there"
        return Sensitivities(now.spectral_radius, active, (), note)
    return _by_differences(system, prepared, free, NOMINAL, now.spectral_radius, active)


def network_sensitivities(system: Model, prepared: Prepared) -> Sensitivities:
    """Return derivatives of second-moment growth with respect to parameters, and losses of links.

    Parameters
    ----------
    system, prepared
        The compiled model, and the result of `numeric_model.prepare` for it.
    """
    with (
        part("sensitivities"),
        single_threaded(),
        finite_equations(system.origin.topology),
        np.errstate(all="ignore"),
    ):
        from apc.mean_square.mean_square_stability import (
            mean_square_growth,  # most models have an ideal network
        )

        free = [*varied(system), *of_channels(system)]
        now = mean_square_growth(system, prepared)
        if why := not_varied(len(free), now):
            return Sensitivities(0.0, (), (), f"what moves it most: not looked for: {why}")
        active = ((complex(now.radius), MOMENTS),)
        return _by_differences(system, prepared, free, MEAN_SQUARE, now.radius, active)


def _by_differences(
    system: Model,
    prepared: Prepared,
    free: Sequence[ParameterRef],
    criterion: str,
    radius: float,
    active: tuple[tuple[complex, str], ...],
) -> Sensitivities:
    """Return the derivatives of a criterion's radius, as differences along each parameter."""
    rows, without = [], []
    for item in free:
        present = value_now(system, item)
        along = present or 1.0  # 0 has no size: the unit instead
        try:
            ((number, slope),) = RadiusEvaluator(system, (item,), prepared, LOCATION, criterion).slopes(
                np.array([[present]]), np.array([[along]])
            )
        except ApcError:  # no verdict even this near
            number = slope = np.full((1, 1, 1), np.nan)
        # The derivative of the square, as the radius is the root of the growth.
        rate = slope.item() * (2 * number.item() if criterion == MEAN_SQUARE else 1.0) / along
        if math.isfinite(rate):
            rows.append(Sensitivity(item.label, unit_of(system, item.name), present, rate, rate * present, 0))
        else:
            without.append(item.label)
    rows.sort(key=lambda row: (-abs(row.relative), row.parameter))
    note = "by differences" + (f"; not differentiated: {', '.join(without)}" if without else "")
    return Sensitivities(radius, active, tuple(rows), note)


def not_varied(count: int, growth: StabilityMeasure) -> str:
    """Return why a model is not evaluated at many values over its network, "" if it is."""
    if count > MOST_VARIED:
        return f"over this network, {count} numbers take too long to vary (apc critical varies one)"
    if growth.why:
        return f"over the network, the topology is not judged: {growth.why}"
    if not growth.quick:
        return (
            "over this network, to judge one value takes long (apc critical looks at those of one parameter)"
        )
    return ""


def of_channels(system: Model) -> list[ParameterRef]:
    """Return the independent loss and jitter parameters of links."""
    numbers = channel_numbers(system)
    times = [ParameterRef(timing.name) for timing in named_times(system) if timing.formula is None]
    return [free for free in (*free_parameters(system), *times) if free.name in numbers]


@dataclass(frozen=True, slots=True, eq=False)
class _Cluster:
    """Eigenvalues (c,) that are equal within rounding, of the closed system of this name.

    `rates` (m, c, c) are W M' V for each of m parameters, W V = 1; `still` (m,) states for which of them
    rigid modes stay rigid. `condition` is that of the vectors.
    """

    name: str
    values: Complexes
    rates: Complexes
    still: NDArray[np.bool_]
    condition: float


def _rows(system: Model, free: ParameterRef, cluster: _Cluster, column: int, first: int) -> list[Sensitivity]:
    """Return the derivatives of a cluster's magnitudes with respect to one parameter, the largest first."""
    parameter = parameter_of(system, free)
    moves = np.linalg.eigvals(cluster.rates[column])
    growth = np.sort((cluster.values.conj() * moves).real / np.abs(cluster.values))[::-1]
    return [
        Sensitivity(
            parameter=free.label,
            unit=DisplayUnit.of(parameter),
            value=parameter.value,
            derivative=rate,
            relative=rate * parameter.value,
            mode=first + number,
        )
        for number, rate in enumerate(growth.tolist())
        if np.isfinite(rate)
    ]


def _defective(cluster: _Cluster) -> str:
    """Return a note on the eigenvalues without a derivative."""
    size, many = float(np.abs(cluster.values).max()), len(cluster.values) > 1
    message = f"{counted(len(cluster.values), 'eigenvalue')} of {cluster.name} at magnitude {size:.6g}"
    return f"{message} {'share' if many else 'shares'} one motion: there the radius has no derivative"


def _clusters(system: Model, free: Sequence[ParameterRef], prepared: Prepared) -> list[_Cluster] | None:
    """Return the eigenvalues that share the spectral radius, of each pair one, the largest first.

    None where there is no matrix, or no derivative of it.
    """
    family = evaluator(system, free, prepared=prepared)
    here = np.array([parameter_of(system, item).value for item in free])
    unit = np.eye(len(free))
    pairs = family.slopes(
        np.repeat(here[None], max(len(free), 1), axis=0), unit if free else np.zeros((1, 0))
    )
    if not all(np.isfinite(matrix).all() and np.isfinite(slopes).all() for matrix, slopes in pairs):
        return None
    alongside = family.matrices(here + np.diag(ALONGSIDE * np.where(here == 0, 1.0, here))) if free else ()
    still = np.ones(len(free), dtype=np.bool_)
    for values in alongside:
        still &= np.isfinite(values).all(axis=(1, 2))
    result = []
    names = (closed_system.name for closed_system in family.closed)
    for name, (matrix, slopes) in zip(names, pairs, strict=True):
        if not matrix.shape[1]:
            continue
        clusters = _of_system(name, matrix[0], slopes[: len(free)], still)
        if not all(
            cluster.condition < WORST for cluster in clusters
        ):  # peers in a chain share eigenvalues, not modes
            clusters = []
            for states in _single(matrix[0], slopes):
                block = np.index_exp[..., states[:, None], states]
                clusters += _of_system(name, matrix[0][block], slopes[block][: len(free)], still)
        result += clusters
    sizes = [float(np.abs(item.values).max()) for item in result]
    least = max(sizes, default=0.0) - SHARED * max(1.0, *sizes, 0.0)
    stored = [item for item, size in zip(result, sizes, strict=True) if size >= least]
    return sorted(stored, key=lambda item: -float(np.abs(item.values).max()))


def _single(matrix: Floats, slopes: Floats) -> list[Indices]:
    """Return the strongly connected states of a matrix (n, n) with slopes (m, n, n), equal blocks once.

    Each block has eigenvalues of its own; without blocks all states are one.
    """
    driving = (matrix != 0) | (slopes != 0).any(axis=0)
    both = np.concatenate([matrix[None], slopes])
    local = {both[:, part[:, None], part].tobytes(): part for part in reversed(driving_parts(driving))}
    return list(local.values()) or [np.arange(len(matrix))]


def _of_system(name: str, matrix: Floats, slopes: Floats, still: NDArray[np.bool_]) -> list[_Cluster]:
    """Return the largest eigenvalues of a matrix (n, n), and their derivatives for slopes (m, n, n)."""
    pairs = eigenpairs(matrix)
    sizes = np.abs(pairs.values)
    least = sizes.max() - SHARED * max(1.0, sizes.max()) - 2 * CLOSE * max(sizes.max(), CLOSE)
    left_over = sizes >= least
    result = []
    for index in np.argsort(-sizes, kind="stable").tolist():
        if not left_over[index] or pairs.values[index].imag < 0:
            continue
        value = pairs.values[index]
        for reach in (EQUAL, CLOSE):
            near = np.flatnonzero(
                left_over & (np.abs(pairs.values - value) <= reach * max(abs(value), CLOSE))
            )
            local = pairs.at(near)
            product = local.left @ local.right
            size = float(np.linalg.svd(product, compute_uv=False)[-1])
            norms = float(np.linalg.norm(local.left, 2) * np.linalg.norm(local.right, 2))
            condition = norms / size if size > 0 else np.inf
            if condition < SOUND:
                break
        left_over[near] = False
        rates = np.zeros((len(slopes), len(near), len(near)), np.complex128)
        if condition < WORST:
            rates = np.asarray(np.linalg.solve(product, local.left) @ slopes @ local.right, np.complex128)
        result.append(_Cluster(name, local.values, rates, still, condition))
    return result
