"""Sensitivities of the spectral radius: its derivative with respect to every parameter.

Takes: a `NumericModel`.
Gives: `Sensitivity`, `Sensitivities`, `sensitivities`, `network_sensitivities`; `varied`, `not_varied`,
`channel_parameters`.
Guarantees: the derivative is that of the dominant mode, without rigid modes, accurate to rounding amplified
by neighbouring eigenvalues; each name is settable. If several eigenvalues share the radius, each has its own
rows, and there is no common gradient.
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

from apc.analysis.analysis import Analysis, analyze, prepare_at_start
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.compiler.wording import counted
from apc.lifting.numeric_model import NumericModel
from apc.linearization.evaluation_errors import evaluating
from apc.network.nominal_criterion import channel_numbers
from apc.parameter_values.display_units import DisplayUnit
from apc.parameter_values.parameter_names import ParameterRef, named_times, parameter_of, unit_of, value_now
from apc.parameter_values.parameters import scope_of
from apc.result import Result
from apc.spectrum.eigenpairs import driving_parts, eigenpairs
from apc.studies.evaluator import evaluator, free_parameters
from apc.studies.evaluator_choice import radius_evaluator
from apc.studies.stability_criteria import MEAN_SQUARE, NOMINAL

if TYPE_CHECKING:
    from apc.mean_square.mean_square_stability import StabilityMeasure

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Complexes = NDArray[np.complex128]

# Eigenvalues whose magnitudes differ by less than this may be equal within the rounding of their matrices:
# they are treated as sharing the radius.
SHARED = 1e-10

# Eigenvalues with relative distances below this form one cluster: rounding mixes their vectors by 1e-7 or
# more. If the vectors of a cluster are worse conditioned than `SOUND`, it may be part of a larger cluster
# that rounding has split.
EQUAL, CLOSE, SOUND = 1e-9, 1e-7, 1e6

# A cluster of vectors worse conditioned than this has no meaningful derivative.
WORST = 1e8

# The relative change of a parameter in the test whether removed rigid modes stay rigid.
ALONGSIDE = 2.0**-10

# The limit of parameters varied over a network: at some ten milliseconds per value they take a minute.
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
    """All sensitivities, the largest first, and the eigenvalues of largest magnitude.

    `active` are the eigenvalues that share the radius, each with the name of its system: more than one at a
    crossing of eigenvalues, where the radius has one-sided derivatives only, the extremes of theirs. `note`
    describes this case, or the reason if there is no sensitivity.
    """

    shown_by = "margins_output:sensitivities"

    radius: float
    active: tuple[tuple[complex, str], ...]
    rows: tuple[Sensitivity, ...]
    note: str


@part("sensitivities")
def sensitivities(numeric: NumericModel, *, analysis: Analysis | None = None) -> Sensitivities:
    """Return the derivative of the spectral radius with respect to every settable parameter.

    Parameters
    ----------
    numeric
        The model with the parameter values at which to differentiate.
    analysis
        The analysis at these values, if already computed.

    Raises
    ------
    ApcError
        As for `analysis.analyze`.

    Notes
    -----
    A parameter of 0 is varied separately: a mode that is rigid at this value is not rigid when it varies.
    """
    model = numeric.model
    with evaluating(model):
        parameter_refs = varied(model)
        start = prepare_at_start(numeric, parameter_refs)
        now = analysis or analyze(numeric)
        if start is None:
            return _by_analyses(numeric, parameter_refs, now)
        largest = now.spectral_radius + SHARED

        @cache
        def clusters_of(*parameters: ParameterRef) -> list[_Cluster] | None:
            """Return the dominant eigenvalues with derivatives along these parameters, cached."""
            return _clusters(start, parameters)

        def breaks_rigid_mode(*parameters: ParameterRef) -> bool:
            """Return whether a mode that is rigid at the present values is not rigid if these
            parameters vary.
            """
            return any(np.abs(cluster.values).max() > largest for cluster in clusters_of(*parameters) or ())

        zero_parameters = [
            parameter_ref for parameter_ref in parameter_refs if not parameter_of(model, parameter_ref).value
        ]
        nonzero = [parameter_ref for parameter_ref in parameter_refs if parameter_ref not in zero_parameters]
        breaking = [parameter_ref for parameter_ref in zero_parameters if breaks_rigid_mode(parameter_ref)]
        breaking += (
            [parameter_ref for parameter_ref in nonzero if breaks_rigid_mode(parameter_ref)]
            if breaks_rigid_mode(*nonzero)
            else []
        )
        parameter_sets = [
            [parameter_ref for parameter_ref in nonzero if parameter_ref not in breaking],
            *([parameter_ref] for parameter_ref in zero_parameters if parameter_ref not in breaking),
        ]
        rows: list[Sensitivity] = []
        clusters: list[_Cluster] = []
        excluded = [parameter_ref.label for parameter_ref in breaking]
        for parameters in parameter_sets:
            parameter_clusters = clusters_of(*parameters)
            if (
                parameter_clusters is None and parameters[0] in zero_parameters
            ):  # other modes are rigid at neighbouring values
                excluded.append(parameters[0].label)
                continue
            if parameter_clusters is None:  # nonsmooth equations: no derivative
                return _by_analyses(numeric, parameter_refs, now)
            clusters, first_rank = clusters or parameter_clusters, 0
            for cluster in parameter_clusters:
                if not cluster.condition < WORST:
                    continue
                for column, parameter in enumerate(parameters):
                    if cluster.still[column]:
                        rows += _cluster_rows(model, parameter, cluster, column, first_rank)
                    else:
                        excluded.append(parameter.label)
                first_rank += len(cluster.values)
    return _sensitivities_of(rows, clusters, excluded, has_parameters=bool(parameter_refs))


def _sensitivities_of(
    rows: Sequence[Sensitivity],
    clusters: Sequence[_Cluster],
    excluded: Sequence[str],
    *,
    has_parameters: bool,
) -> Sensitivities:
    """Return the sensitivities in order, with the active eigenvalues and the notes.

    Parameters
    ----------
    rows, clusters
        The sensitivities, and the dominant eigenvalues.
    excluded
        The labels of parameters on which excluded modes depend.
    has_parameters
        Whether there is a parameter to vary.
    """
    radius = max((float(np.abs(cluster.values).max()) for cluster in clusters), default=0.0)
    if not clusters:
        return Sensitivities(0.0, (), (), "the topology has no motion, so there is no eigenvalue")
    if not radius:  # e^(λT) underflows
        note = "no parameter has an effect: all motions decay to 0 within a frame"
        return Sensitivities(0.0, (), (), note)
    notes = [_defective_note(cluster) for cluster in clusters if not cluster.condition < WORST]
    active = tuple(
        (complex(value), cluster.name)
        for cluster in clusters
        if cluster.condition < WORST
        for value in cluster.values
    )
    if len(active) > 1:
        notes.append(f"{len(active)} eigenvalues have the largest magnitude; their largest change decides")
    if excluded:
        names = ", ".join(dict.fromkeys(excluded))
        notes.append(f"the excluded modes depend on {names}, so their sensitivities are not computed")
    if not rows and not notes:
        why = "no derivative is finite" if has_parameters else "there is no parameter to vary"
        notes.append(f"sensitivities unknown: {why}")
    rows = sorted(rows, key=lambda row: (-abs(row.relative), row.parameter, row.mode))
    return Sensitivities(radius, active, tuple(rows), "; ".join(notes))


def varied(model: Model) -> list[ParameterRef]:
    """Return the free parameters that vary continuously.

    Start values and parameters of unreliable links are left out.
    """
    starts = {state.start for peer_type in model.peer_types for state in peer_type.states}
    starts |= {
        start for peer_type in model.peer_types for clock in peer_type.clocks for start in clock.starts
    }
    excluded = starts | channel_numbers(model)
    excluded |= {parameter.name for parameter in model.parameters if parameter.choices}
    return [parameter_ref for parameter_ref in free_parameters(model) if parameter_ref.name not in excluded]


def _by_analyses(
    numeric: NumericModel, parameter_refs: Sequence[ParameterRef], now: Analysis
) -> Sensitivities:
    """Return the sensitivities of a model's spectral radius, by differences of analyses."""
    if not now.modes:
        return Sensitivities(0.0, (), (), "the topology has no motion, so there is no eigenvalue")
    least_magnitude = now.spectral_radius - SHARED
    upper = (mode for mode in now.modes if mode.eigenvalue.imag >= -mode.error)  # one of a conjugate pair
    active = tuple(
        (mode.eigenvalue, mode.family) for mode in upper if abs(mode.eigenvalue) >= least_magnitude
    )
    if len(active) > 1:
        note = f"{len(active)} eigenvalues have the largest magnitude, so it has no derivative"
        return Sensitivities(now.spectral_radius, active, (), note)
    return _finite_differences(numeric, parameter_refs, NOMINAL, now.spectral_radius, active)


def network_sensitivities(numeric: NumericModel) -> Sensitivities:
    """Return the sensitivities of the second-moment growth to parameters, and to losses of links.

    The result is empty, with the reason in its note, where one analysis takes too long.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    """
    model = numeric.model
    with part("sensitivities"), evaluating(model):
        from apc.mean_square.mean_square_stability import (
            mean_square_growth,  # most models have an ideal network
        )

        parameter_refs = [*varied(model), *channel_parameters(model)]
        growth = mean_square_growth(numeric)
        if reason := not_varied(len(parameter_refs), growth):
            return Sensitivities(0.0, (), (), f"sensitivities not computed: {reason}")
        active = ((complex(growth.radius), MOMENTS),)
        return _finite_differences(numeric, parameter_refs, MEAN_SQUARE, growth.radius, active)


def _finite_differences(
    numeric: NumericModel,
    parameter_refs: Sequence[ParameterRef],
    criterion: str,
    radius: float,
    active: tuple[tuple[complex, str], ...],
) -> Sensitivities:
    """Return the sensitivities of a criterion's radius, by differences along each parameter.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    parameter_refs, criterion
        The parameters that vary, and the stability criterion.
    radius, active
        The radius at the present values, and its eigenvalues with the names of their systems.
    """
    model = numeric.model
    channels = channel_numbers(model)
    together = [parameter_ref for parameter_ref in parameter_refs if parameter_ref.name not in channels]
    rates = dict(zip(together, _rates_of_change(numeric, together, criterion), strict=True))
    rows, not_differentiated = [], []
    for parameter_ref in parameter_refs:
        present = value_now(model, parameter_ref)
        if parameter_ref not in rates:
            (rates[parameter_ref],) = _rates_of_change(numeric, [parameter_ref], criterion)
        if math.isfinite(rate := rates[parameter_ref]):
            unit = unit_of(model, parameter_ref.name)
            rows.append(Sensitivity(parameter_ref.label, unit, present, rate, rate * present, 0))
        else:
            not_differentiated.append(parameter_ref.label)
    rows.sort(key=lambda row: (-abs(row.relative), row.parameter))
    note = "computed by finite differences" + (
        f"; not differentiated: {', '.join(not_differentiated)}" if not_differentiated else ""
    )
    return Sensitivities(radius, active, tuple(rows), note)


def _rates_of_change(
    numeric: NumericModel, parameter_refs: Sequence[ParameterRef], criterion: str
) -> list[float]:
    """Return the derivatives of a criterion's value, in SI; NaN where a neighbouring value has no verdict."""
    if not parameter_refs:
        return []
    present = np.array([value_now(numeric.model, parameter_ref) for parameter_ref in parameter_refs])
    scales = np.where(present, present, 1.0)  # for 0, the unit of the parameter
    try:
        evaluator = radius_evaluator(numeric, tuple(parameter_refs), LOCATION, criterion)
        ((values, slopes),) = evaluator.slopes(np.tile(present, (len(present), 1)), np.diag(scales))
    except ApcError:
        if len(parameter_refs) == 1:
            return [math.nan]
        return [
            rate
            for parameter_ref in parameter_refs
            for rate in _rates_of_change(numeric, [parameter_ref], criterion)
        ]
    # The derivative of the square, as the radius is the root of the growth.
    factors = 2 * values.ravel() if criterion == MEAN_SQUARE else np.ones(len(present))
    rates: list[float] = (slopes.ravel() * factors / scales).tolist()
    return rates


def not_varied(count: int, growth: StabilityMeasure) -> str:
    """Return the reason why parameters are not varied over a model's network, "" if they are."""
    if count > MOST_VARIED:
        return f"{count} parameters take too long over this network (use apc critical for one parameter)"
    if growth.why:
        return f"the mean-square verdict is not available: {growth.why}"
    if not growth.quick:
        return "one mean-square analysis takes long (use apc critical for one parameter)"
    return ""


def channel_parameters(model: Model) -> list[ParameterRef]:
    """Return the independent loss and jitter parameters of links.

    Of a link with independent losses, `loss: 2 %`, the probabilities of bursts are left out.
    """
    holder, numbers = scope_of(model).holder, set(channel_numbers(model))
    for loss in (channel.loss for link in model.links for channel in link.channels):
        if loss is not None and holder[loss.r].formula is not None:
            numbers -= {loss.one_minus_h, loss.one_minus_k}
    times = [ParameterRef(timing.name) for timing in named_times(model) if timing.formula is None]
    return [
        parameter_ref for parameter_ref in (*free_parameters(model), *times) if parameter_ref.name in numbers
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Cluster:
    """Eigenvalues (c,) of the closed system of this name that are equal within rounding, with derivatives.

    `rates` (m, c, c) are W M' V for each of m parameters, W V = 1; `still` (m,) states for which parameters
    the rigid modes stay rigid. `condition` is the condition of the eigenvectors.
    """

    name: str
    values: Complexes
    rates: Complexes
    still: NDArray[np.bool_]
    condition: float


def _cluster_rows(
    model: Model, parameter_ref: ParameterRef, cluster: _Cluster, column: int, first_rank: int
) -> list[Sensitivity]:
    """Return the sensitivities of a cluster's magnitudes to one parameter, the largest first.

    `column` is the index of the parameter in the cluster's derivatives, `first_rank` the number of
    eigenvalues before the cluster.
    """
    parameter = parameter_of(model, parameter_ref)
    derivatives = np.linalg.eigvals(cluster.rates[column])
    growth = np.sort((cluster.values.conj() * derivatives).real / np.abs(cluster.values))[::-1]
    return [
        Sensitivity(
            parameter=parameter_ref.label,
            unit=DisplayUnit.of(parameter),
            value=parameter.value,
            derivative=rate,
            relative=rate * parameter.value,
            mode=first_rank + rank,
        )
        for rank, rate in enumerate(growth.tolist())
        if np.isfinite(rate)
    ]


def _defective_note(cluster: _Cluster) -> str:
    """Return a note on eigenvalues without a derivative, as they share eigenvectors."""
    size, many = float(np.abs(cluster.values).max()), len(cluster.values) > 1
    message = f"{counted(len(cluster.values), 'eigenvalue')} of {cluster.name} at magnitude {size:.6g}"
    return f"{message} {'have' if many else 'has'} a common eigenvector, so the radius has no derivative"


def _clusters(numeric: NumericModel, parameter_refs: Sequence[ParameterRef]) -> list[_Cluster] | None:
    """Return the eigenvalues that share the spectral radius, one of each pair, the largest first.

    None if there is no matrix, or no derivative of it.
    """
    batch_evaluator = evaluator(numeric, parameter_refs)
    values_now = np.array(
        [parameter_of(numeric.model, parameter_ref).value for parameter_ref in parameter_refs]
    )
    unit = np.eye(len(parameter_refs))
    pairs = batch_evaluator.slopes(
        np.repeat(values_now[None], max(len(parameter_refs), 1), axis=0),
        unit if parameter_refs else np.zeros((1, 0)),
    )
    if not all(np.isfinite(matrix).all() and np.isfinite(slopes).all() for matrix, slopes in pairs):
        return None
    neighbouring = (
        batch_evaluator.matrices(values_now + np.diag(ALONGSIDE * np.where(values_now == 0, 1.0, values_now)))
        if parameter_refs
        else ()
    )
    stays_rigid = np.ones(len(parameter_refs), dtype=np.bool_)
    for values in neighbouring:
        stays_rigid &= np.isfinite(values).all(axis=(1, 2))
    result = []
    names = (closed_system.name for closed_system in batch_evaluator.closed)
    for name, (matrix, slopes) in zip(names, pairs, strict=True):
        if not matrix.shape[1]:
            continue
        clusters = _clusters_of_matrix(name, matrix[0], slopes[: len(parameter_refs)], stays_rigid)
        if not all(
            cluster.condition < WORST for cluster in clusters
        ):  # decoupled peers share eigenvalues, not modes
            clusters = []
            for states in _distinct_blocks(matrix[0], slopes):
                block = np.index_exp[..., states[:, None], states]
                clusters += _clusters_of_matrix(
                    name, matrix[0][block], slopes[block][: len(parameter_refs)], stays_rigid
                )
        result += clusters
    sizes = [float(np.abs(cluster.values).max()) for cluster in result]
    least = max(sizes, default=0.0) - SHARED * max(1.0, *sizes, 0.0)
    largest = [cluster for cluster, size in zip(result, sizes, strict=True) if size >= least]
    return sorted(largest, key=lambda cluster: -float(np.abs(cluster.values).max()))


def _distinct_blocks(matrix: Floats, slopes: Floats) -> list[Indices]:
    """Return the strongly connected states of a matrix (n, n) with slopes (m, n, n), equal blocks once.

    The eigenvalues are those of the blocks; without blocks, all states form one.
    """
    nonzero = (matrix != 0) | (slopes != 0).any(axis=0)
    stacked = np.concatenate([matrix[None], slopes])
    state_sets = {
        stacked[:, part[:, None], part].tobytes(): part for part in reversed(driving_parts(nonzero))
    }
    return list(state_sets.values()) or [np.arange(len(matrix))]


def _clusters_of_matrix(
    name: str, matrix: Floats, slopes: Floats, still: NDArray[np.bool_]
) -> list[_Cluster]:
    """Return the largest eigenvalues of a matrix (n, n) in clusters, with their derivatives.

    Parameters
    ----------
    name, matrix
        The name of the closed system, and its matrix.
    slopes, still
        The derivatives of the matrix (m, n, n), and whether the rigid modes are the same at a neighbouring
        value of each parameter (m,).
    """
    pairs = eigenpairs(matrix)
    sizes = np.abs(pairs.values)
    smallest = sizes.max() - SHARED * max(1.0, sizes.max()) - 2 * CLOSE * max(sizes.max(), CLOSE)
    remaining = sizes >= smallest
    clusters = []
    for index in np.argsort(-sizes, kind="stable").tolist():
        if not remaining[index] or pairs.values[index].imag < 0:
            continue
        value = pairs.values[index]
        for tolerance in (EQUAL, CLOSE):
            members = np.flatnonzero(
                remaining & (np.abs(pairs.values - value) <= tolerance * max(abs(value), CLOSE))
            )
            member_pairs = pairs.at(members)
            product = member_pairs.left @ member_pairs.right
            size = float(np.linalg.svd(product, compute_uv=False)[-1])
            norms = float(np.linalg.norm(member_pairs.left, 2) * np.linalg.norm(member_pairs.right, 2))
            condition = norms / size if size > 0 else np.inf
            if condition < SOUND:
                break
        remaining[members] = False
        rates = np.zeros((len(slopes), len(members), len(members)), np.complex128)
        if condition < WORST:
            rates = np.asarray(
                np.linalg.solve(product, member_pairs.left) @ slopes @ member_pairs.right, np.complex128
            )
        clusters.append(_Cluster(name, member_pairs.values, rates, still, condition))
    return clusters
