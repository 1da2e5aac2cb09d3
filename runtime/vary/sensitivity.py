"""What moves the spectral radius most: its derivative with respect to every parameter.

Takes: a `Model`.
Gives: `Sensitivity`, `Sensitivities`, `sensitivities`, `network_sensitivities`; `varied`, `not_varied`,
`of_channels`.
Guarantees: the derivative is that of the motion that decides, whatever is rigid left out, to rounding, which
an eigenvalue nearby makes worse; each name can be set as it stands; where several eigenvalues share the
radius, one row for each of them and no gradient that belongs to none.
Does not: vary times, or the number of peers; bound the error of a derivative: it decides nothing.

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
from apc.compiler.words import counted
from apc.eigen.eigenpairs import driving_parts, eigenpairs
from apc.eigen.modes import split
from apc.eigen.spectrum import solve_spectrum
from apc.frame.display_units import DisplayUnit
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.names import ParameterRef, named_times, parameter_of, unit_of, value_now
from apc.network.nominal import channel_numbers
from apc.result import Result
from apc.threads import single_threaded
from apc.vary.evaluator import evaluator, free_parameters
from apc.vary.growth import MEAN_SQUARE, NOMINAL, RadiusEvaluator

if TYPE_CHECKING:
    from apc.moments.network_verdict import StabilityMeasure

Floats = NDArray[np.float64]
Places = NDArray[np.intp]
Complexes = NDArray[np.complex128]

# Eigenvalues whose magnitudes differ by less than this may be one within the rounding of their matrices:
# they are all said to share the radius.
SHARED = 1e-10

# Eigenvalues nearer to one another than this, relatively, are one cluster: rounding mixes their vectors by a
# ten-millionth or more. Where even the vectors of such a cluster are worse conditioned than `SOUND`, it may
# be part of one that rounding split, as the root of it.
EQUAL, CLOSE, SOUND = 1e-9, 1e-7, 1e6

# A cluster of vectors worse conditioned than this has no derivative worth the name.
WORST = 1e8

# How far, relatively, a parameter is moved to see whether what was left out as rigid stays so.
BESIDE = 2.0**-10

# More numbers than this are not varied over a network: at some ten milliseconds a value they take a minute.
MOST_VARIED = 60

# What grows in mean square is called so.
MOMENTS = "second moments"

PLACE = SourceLocation("sensitivities")


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """How one of the eigenvalues that make the spectral radius follows one parameter.

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
    """All derivatives, those that move most first, and the eigenvalues they belong to.

    `active` are the eigenvalues that share the radius, each named by its system: more than one at a crossing,
    where the radius itself has no derivative but the largest of theirs on either side. `note` says so, or why
    there is none.
    """

    shown_by = "vary_output:sensitivities"

    radius: float
    active: tuple[tuple[complex, str], ...]
    rows: tuple[Sensitivity, ...]
    note: str


@part("sensitivities")
def sensitivities(system: Model, *, prepared: Prepared | None = None) -> Sensitivities:
    """Differentiate the spectral radius with respect to every parameter, as each can be set.

    Parameters
    ----------
    system
        The compiled scene, with the numbers at which to differentiate.
    prepared
        From `instance.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        As `analysis.lifted_groups`.

    Notes
    -----
    What a number of 0 leaves free is rigid in the scene as it is, and no longer where that number varies: it
    is differentiated by itself.
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

        def frees(*together: ParameterRef) -> bool:
            """Say whether something that is rigid in the scene as it is moves where these vary."""
            return any(np.abs(cluster.values).max() > most for cluster in clusters_of(*together) or ())

        zero = [item for item in free if not parameter_of(system, item).value]
        rest = [item for item in free if item not in zero]
        loose = [free for free in zero if frees(free)]
        loose += [free for free in rest if frees(free)] if frees(*rest) else []
        listed = [
            [free for free in rest if free not in loose],
            *([free] for free in zero if free not in loose),
        ]
        rows: list[Sensitivity] = []
        clusters: list[_Cluster] = []
        notes, untied = [], [free.label for free in loose]
        for together in listed:
            result = clusters_of(*together)
            if result is None and together[0] in zero:  # other motions are free beside it
                untied.append(together[0].label)
                continue
            if result is None:  # equations have edges, which differences step over
                return _singly(system, prepared, free)
            clusters, first = clusters or result, 0
            for cluster in result:
                if not cluster.condition < WORST:
                    continue
                for column, own in enumerate(together):
                    if cluster.still[column]:
                        rows += _rows(system, own, cluster, column, first)
                    else:
                        untied.append(own.label)
                first += len(cluster.values)
    radius = max((float(np.abs(cluster.values).max()) for cluster in clusters), default=0.0)
    if not clusters:
        return Sensitivities(0.0, (), (), "nothing moves: there is no eigenvalue")
    if not radius:  # e^(λT) is below every float
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
    """Return the free parameters that are no start values, and no numbers of unreliable links."""
    starts = {state.start for kind in system.kinds for state in kind.states}
    starts |= {start for kind in system.kinds for clock in kind.clocks for start in clock.starts}
    kept_out = starts | channel_numbers(system)
    return [free for free in free_parameters(system) if free.name not in kept_out]


def _singly(system: Model, prepared: Prepared, free: Sequence[ParameterRef]) -> Sensitivities:
    """Return the derivatives of a scene's spectral radius by differences of analyses."""
    now = analyze(system, prepared=prepared)
    if not now.modes:
        return Sensitivities(0.0, (), (), "nothing moves: there is no eigenvalue")
    most = now.spectral_radius - SHARED
    upper = (mode for mode in now.modes if mode.eigenvalue.imag >= -mode.error)  # of a conjugate pair one
    active = tuple((mode.eigenvalue, mode.shape) for mode in upper if abs(mode.eigenvalue) >= most)
    if len(active) > 1:
        note = f"{len(active)} eigenvalues share the radius, which has no derivative there"
        return Sensitivities(now.spectral_radius, active, (), note)
    return _by_differences(system, prepared, free, NOMINAL, now.spectral_radius, active)


def network_sensitivities(system: Model, prepared: Prepared) -> Sensitivities:
    """Differentiate what second moments grow by with respect to every parameter, and what links lose by.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    """
    with (
        part("sensitivities"),
        single_threaded(),
        finite_equations(system.origin.topology),
        np.errstate(all="ignore"),
    ):
        from apc.moments.network_verdict import growth  # most scenes have an ideal network

        free = [*varied(system), *of_channels(system)]
        now = growth(system, prepared)
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
    """Return the derivatives of a radius of a criterion, as differences along each parameter's value."""
    rows, without = [], []
    for item in free:
        present = value_now(system, item)
        along = present or 1.0  # 0 has no size: its unit's
        try:
            ((number, slope),) = RadiusEvaluator(system, (item,), prepared, PLACE, criterion).slopes(
                np.array([[present]]), np.array([[along]])
            )
        except ApcError:  # not even so near can it be judged
            number = slope = np.full((1, 1, 1), np.nan)
        # Of the root of what grows the derivative of the square is wanted.
        rate = slope.item() * (2 * number.item() if criterion == MEAN_SQUARE else 1.0) / along
        if math.isfinite(rate):
            rows.append(Sensitivity(item.label, unit_of(system, item.name), present, rate, rate * present, 0))
        else:
            without.append(item.label)
    rows.sort(key=lambda row: (-abs(row.relative), row.parameter))
    note = "by differences" + (f"; not differentiated: {', '.join(without)}" if without else "")
    return Sensitivities(radius, active, tuple(rows), note)


def not_varied(count: int, growth: StabilityMeasure) -> str:
    """Return why a scene is not looked at over its network at many values of so many numbers, "" if it is."""
    if count > MOST_VARIED:
        return f"over this network, {count} numbers take too long to vary (apc critical varies one)"
    if growth.why:
        return f"over the network, the scene is not judged: {growth.why}"
    if not growth.quick:
        return (
            "over this network, to judge one value takes long (apc critical looks at those of one parameter)"
        )
    return ""


def of_channels(system: Model) -> list[ParameterRef]:
    """Return what links lose and delay packets by, where it follows from nothing else."""
    numbers = channel_numbers(system)
    times = [ParameterRef(timing.name) for timing in named_times(system) if timing.formula is None]
    return [free for free in (*free_parameters(system), *times) if free.name in numbers]


@dataclass(frozen=True, slots=True, eq=False)
class _Cluster:
    """Eigenvalues (c,) that are one within rounding, of the closed system of this name.

    `rates` (m, c, c) are W M' V for each of m parameters, W V = 1; `still` (m,) says which leave alone what
    is rigid. `condition` is that of the vectors.
    """

    name: str
    values: Complexes
    rates: Complexes
    still: NDArray[np.bool_]
    condition: float


def _rows(system: Model, free: ParameterRef, cluster: _Cluster, column: int, first: int) -> list[Sensitivity]:
    """Return how the magnitudes of a cluster follow one parameter, the fastest first."""
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
    """Say which eigenvalues have no derivative."""
    size, many = float(np.abs(cluster.values).max()), len(cluster.values) > 1
    what = f"{counted(len(cluster.values), 'eigenvalue')} of {cluster.name} at magnitude {size:.6g}"
    return f"{what} {'share' if many else 'shares'} one motion: there the radius has no derivative"


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
    beside = family.matrices(here + np.diag(BESIDE * np.where(here == 0, 1.0, here))) if free else ()
    still = np.ones(len(free), dtype=np.bool_)
    for values in beside:
        still &= np.isfinite(values).all(axis=(1, 2))
    result = []
    names = (closed_system.name for closed_system in family.closed)
    for name, (matrix, slopes) in zip(names, pairs, strict=True):
        if not matrix.shape[1]:
            continue
        clusters = _of_system(name, matrix[0], slopes[: len(free)], still)
        if not all(
            cluster.condition < WORST for cluster in clusters
        ):  # peers in a chain share eigenvalues, no motion
            clusters = []
            for states in _alone(matrix[0], slopes):
                block = np.index_exp[..., states[:, None], states]
                clusters += _of_system(name, matrix[0][block], slopes[block][: len(free)], still)
        result += clusters
    sizes = [float(np.abs(item.values).max()) for item in result]
    least = max(sizes, default=0.0) - SHARED * max(1.0, *sizes, 0.0)
    kept = [item for item, size in zip(result, sizes, strict=True) if size >= least]
    return sorted(kept, key=lambda item: -float(np.abs(item.values).max()))


def _alone(matrix: Floats, slopes: Floats) -> list[Places]:
    """Return the states that drive each other in a matrix (n, n) of slopes (m, n, n), equal blocks once.

    Each block has eigenvalues of its own; without any all states are one.
    """
    driving = (matrix != 0) | (slopes != 0).any(axis=0)
    both = np.concatenate([matrix[None], slopes])
    own = {both[:, part[:, None], part].tobytes(): part for part in reversed(driving_parts(driving))}
    return list(own.values()) or [np.arange(len(matrix))]


def _of_system(name: str, matrix: Floats, slopes: Floats, still: NDArray[np.bool_]) -> list[_Cluster]:
    """Return the largest eigenvalues of a matrix (n, n), and what its slopes (m, n, n) do to them."""
    pairs = eigenpairs(matrix)
    sizes = np.abs(pairs.values)
    least = sizes.max() - SHARED * max(1.0, sizes.max()) - 2 * CLOSE * max(sizes.max(), CLOSE)
    left_over = sizes >= least
    result = []
    for place in np.argsort(-sizes, kind="stable").tolist():
        if not left_over[place] or pairs.values[place].imag < 0:
            continue
        value = pairs.values[place]
        for reach in (EQUAL, CLOSE):
            near = np.flatnonzero(
                left_over & (np.abs(pairs.values - value) <= reach * max(abs(value), CLOSE))
            )
            own = pairs.at(near)
            product = own.left @ own.right
            size = float(np.linalg.svd(product, compute_uv=False)[-1])
            norms = float(np.linalg.norm(own.left, 2) * np.linalg.norm(own.right, 2))
            condition = norms / size if size > 0 else np.inf
            if condition < SOUND:
                break
        left_over[near] = False
        rates = np.zeros((len(slopes), len(near), len(near)), np.complex128)
        if condition < WORST:
            rates = np.asarray(np.linalg.solve(product, own.left) @ slopes @ own.right, np.complex128)
        result.append(_Cluster(name, own.values, rates, still, condition))
    return result
