"""What moves the spectral radius most: its derivative with respect to every parameter.

Takes: a `CompiledSystem`.
Gives: `Sensitivity`, `Sensitivities`, `sensitivities`; `varied`.
Guarantees: the derivative is that of the motion that decides, whatever is rigid left out, with a bound on its
error; each name can be set as it stands; where several eigenvalues share the radius, one row for each of them
and no gradient that belongs to none.
Does not: vary times, or the number of peers.

For a simple eigenvalue, M v = λ v and w M = λ w,   dλ = w dM v / (w v),   d|λ| = Re(λ̄ dλ)/|λ|. A cluster of
equal eigenvalues with a full set of vectors moves as the eigenvalues of W dM V, W V = 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, prepare, prepare_at_start
from apc.compiler.compiled import CompiledSystem
from apc.compiler.timings import part
from apc.compiler.words import counted
from apc.eigen.eigenpairs import Eigenpairs, eigenpairs
from apc.eigen.relative import relative_bounded, relative_coordinates
from apc.finite_equations import finite_equations
from apc.frame.discretize import UNIT
from apc.frame.names import Free, parameter_of
from apc.network.nominal import channel_numbers
from apc.result import Result
from apc.threads import single_threaded
from apc.vary.evaluator import PointEvaluator, evaluator, free_parameters
from apc.vary.slopes import Moved, Slopes, Through, moved_systems

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Eigenvalues whose magnitudes differ by less than this may be one within the rounding of their matrices:
# they are all said to share the radius.
SHARED = 1e-10

# Eigenvalues nearer to one another than this are one cluster, whose vectors are hardly several.
CLOSE = 1e-7

# A cluster of vectors worse conditioned than this has no derivative worth the name.
WORST = 1e8

NO_MATRIX = "what moves it most: not looked for: the present values have no frame matrix of their own"


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """How one of the eigenvalues that make the spectral radius follows one parameter.

    `derivative` is d|λ|/dp in 1/unit, right to `error`; `relative` is p·d|λ|/dp, the change of the radius for
    a change of the parameter by its own size. `mode` counts the eigenvalues that share the radius, from 0.
    """

    parameter: str
    unit: str
    value: float
    derivative: float
    relative: float
    error: float
    mode: int


@dataclass(frozen=True, slots=True)
class Sensitivities(Result):
    """All derivatives, those that move most first, and the eigenvalues they belong to.

    `active` are the eigenvalues that share the radius, each named by its system: more than one at a crossing,
    where the radius itself has no derivative but the largest of theirs on either side. `note` says so, or why
    there is none.
    """

    shown_by = "vary:sensitivities"

    radius: float
    active: tuple[tuple[complex, str], ...]
    rows: tuple[Sensitivity, ...]
    note: str


@part("sensitivities")
def sensitivities(system: CompiledSystem, *, prepared: Prepared | None = None) -> Sensitivities:
    """Differentiate the spectral radius with respect to every parameter, as each can be set.

    Parameters
    ----------
    system
        The compiled scene, with the numbers at which to differentiate.
    prepared
        From `analysis.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        As `analysis.lifted_groups`.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        free, prepared = varied(system), prepared or prepare(system)
        here = np.array([parameter_of(system, one).value for one in free])
        family = evaluator(system, free, prepared=prepare_at_start(system, prepared) or prepared)
        if not isinstance(family, PointEvaluator):
            moved = moved_systems(family, here)
            if _is_known(moved):
                return _differentiate(system, free, moved)
            family = evaluator(system, free, prepared=prepared)  # equations have edges that points step over
        moved = (
            _by_points(family, here) if isinstance(family, PointEvaluator) else moved_systems(family, here)
        )
        return _differentiate(system, free, moved)


def _is_known(listed: Sequence[Moved]) -> bool:
    """Say whether all matrices and their derivatives could be had."""
    return all(
        np.isfinite(one.matrix).all() and all(np.isfinite(way.slopes.matrices).all() for way in one.through)
        for one in listed
    )


def varied(system: CompiledSystem) -> list[Free]:
    """Return the free parameters that are no start values, and no numbers of unreliable links."""
    starts = {state.start for kind in system.kinds for state in kind.states}
    starts |= {start for kind in system.kinds for one in kind.clocks for start in one.starts}
    kept_out = starts | channel_numbers(system)
    return [one for one in free_parameters(system) if one.name not in kept_out]


def _by_points(family: PointEvaluator, here: Floats) -> list[Moved]:
    """Return what moves how in a scene that is linearized anew at every point: all systems as one."""
    matrix, error, slopes, slope_errors = family.differences(here)
    names = [one.name for one in family.closed_at(here.tolist())]
    name = names[0] if len(names) == 1 else "all systems"
    unit, exact = np.eye(len(matrix)), np.zeros(matrix.shape)
    whole = Through(Slopes(np.arange(len(here)), slopes, slope_errors), unit, exact, unit, exact)
    return [Moved(name, matrix, error, (whole,), np.zeros((len(matrix), 0)))]


def _differentiate(system: CompiledSystem, free: Sequence[Free], listed: Sequence[Moved]) -> Sensitivities:
    if not all(np.isfinite(one.matrix).all() for one in listed):
        return Sensitivities(0.0, (), (), NO_MATRIX)
    clusters = [cluster for one in listed for cluster in _clusters(one)]
    if not clusters:
        return Sensitivities(0.0, (), (), "nothing moves: there is no eigenvalue")
    radius = max(float(np.abs(one.values).max()) for one in clusters)
    if not radius:  # e^(λT) is below every float
        return Sensitivities(
            0.0, (), (), "what moves it most: nothing, as every motion dies out to 0 within a frame"
        )
    leading = [
        one
        for one in clusters
        if np.abs(one.values).max() >= radius - SHARED * max(1.0, radius) - np.ptp(np.abs(one.values))
    ]
    leading.sort(key=lambda one: -float(np.abs(one.values).max()))
    rows: list[Sensitivity] = []
    active: list[tuple[complex, str]] = []
    notes, untied = [], dict[str, None]()
    for one in leading:
        try:
            rates = list(_rates(one, len(free))) if one.condition < WORST else None
        except np.linalg.LinAlgError:  # nothing tells it from another eigenvalue
            rates = None
        if rates is None:
            notes.append(_defective(one))
            continue
        first = len(active)
        active += [(complex(value), one.moved.name) for value in one.values]
        rounded = 16 * len(one.moved.matrix) * UNIT * float(np.abs(one.values).max())
        for number, (growth, doubt) in enumerate(rates):
            parameter = parameter_of(system, free[number])
            if growth is None:
                untied[free[number].label] = None
                continue
            # A change by all of the value that is less than the matrix is rounded by can't be told.
            doubt += rounded / abs(parameter.value) if parameter.value else 0.0
            rows += [
                Sensitivity(
                    free[number].label,
                    parameter.unit,
                    parameter.value,
                    float(rate),
                    float(rate) * parameter.value,
                    doubt,
                    first + k,
                )
                for k, rate in enumerate(np.sort(growth)[::-1])
                if np.isfinite(rate) and np.isfinite(doubt)
            ]
    if len(active) > 1:
        notes.append(f"{len(active)} eigenvalues share the radius: the largest of their changes decides")
    if untied:
        are = "are" if len(untied) > 1 else "is"
        notes.append(f"{', '.join(untied)} would move what was left out, and {are} not among these")
    if not rows and not notes:
        why = "no derivative is finite" if free else "there is no parameter to vary"
        notes.append(f"what moves it most: not told: {why}")
    rows.sort(key=lambda row: (-abs(row.relative), row.parameter, row.mode))
    return Sensitivities(radius, tuple(active), tuple(rows), "; ".join(notes))


def _defective(one: _Cluster) -> str:
    """Say which eigenvalues have no derivative."""
    size, many = float(np.abs(one.values).max()), len(one.values) > 1
    what = f"{counted(len(one.values), 'eigenvalue')} of {one.moved.name} at magnitude {size:.6g}"
    return f"{what} {'share' if many else 'shares'} one motion: there the radius has no derivative"


@dataclass(frozen=True, slots=True, eq=False)
class _Cluster:
    """Eigenvalues (c,) that are one within rounding, of a system without its rigid motions V.

    `right` (n, c) and `left` (c, n) are their vectors, W X = 1, over the whole state: right ones up to
    multiples of V, left ones with W V = 0. `condition` is theirs.
    """

    moved: Moved
    values: Complexes
    right: Complexes
    left: Complexes
    condition: float


def _clusters(moved: Moved) -> list[_Cluster]:
    """Return the largest eigenvalues, of each pair one, those that are one within rounding together."""
    at = relative_coordinates(moved.rigid)
    held, rest, weights = at.held, at.rest, at.weights
    matrix, error = relative_bounded(moved.matrix, moved.error, at)
    if not len(matrix):
        return []
    size = error + (8 * len(matrix) * UNIT) * np.abs(matrix)
    pairs = eigenpairs(matrix)
    values = pairs.values
    largest = float(np.abs(values).max())
    clusters = []
    least = largest - SHARED * max(1.0, largest) - 2 * CLOSE * max(largest, CLOSE)
    seen = (values.imag < 0) | (np.abs(values) < least)
    for place in np.argsort(-np.abs(values), kind="stable"):
        if seen[place]:
            continue
        near = np.flatnonzero(np.abs(values - values[place]) <= CLOSE * max(abs(values[place]), CLOSE))
        if len(near) > 1 and _resolved(pairs.at(near), size):
            near = np.array([place])
        seen[near] = True
        rows, columns = pairs.left[near], pairs.right[:, near]
        product = rows @ columns
        least = float(np.linalg.svd(product, compute_uv=False)[-1])
        condition = (
            float(np.linalg.norm(rows, 2) * np.linalg.norm(columns, 2) / least) if least > 0 else np.inf
        )
        rows = np.linalg.solve(product, rows).astype(np.complex128) if condition < WORST else rows
        whole, covector = np.zeros((2, len(moved.matrix), len(near)), np.complex128)
        whole[rest], covector[rest], covector[held] = columns, rows.T, -(rows @ weights).T
        clusters.append(_Cluster(moved, values[near], whole, covector.T, condition))
    return clusters


def _resolved(near: Eigenpairs, size: Floats) -> bool:
    """Say whether eigenvalues near to one another differ by more than the errors of all of them."""
    off = near.errors(size)
    apart = np.abs(near.values[:, None] - near.values) + np.diag(np.full(len(near.values), np.inf))
    return bool((apart > 4 * (off[:, None] + off)).all())


def _rates(one: _Cluster, count: int) -> Iterator[tuple[Floats | None, float]]:
    """Yield for each of so many parameters how fast the magnitudes (c,) grow with it, and their error.

    None for a parameter that moves a rigid motion: what was left out would be a motion like any other then.

    Notes
    -----
    A matrix off by E, its eigenvectors by residuals r and l, turns them by S (E X + r) and (W E + l) S, S the
    resolvent at λ without the cluster: W dM X changes by W dM S (E X + r) + (W E + l) S dM X, to first order.
    """
    moved, w, x = one.moved, one.left, one.right
    n, c = x.shape
    slopes = _slopes(one, count)
    middle = complex(one.values.mean())
    # The rigid motions are left out as the cluster is: W V = 0.
    span, dual = np.hstack([x, moved.rigid]), np.vstack([w, moved.rigid.T])
    bordered = np.block([[middle * np.eye(n) - moved.matrix, span], [dual, np.zeros((len(dual),) * 2)]])
    own = w @ moved.matrix @ x
    whole = moved.error + (8 * n * UNIT) * np.abs(moved.matrix)
    right_off = whole @ np.abs(x) + np.abs(_without(moved.matrix @ x - x @ own, moved.rigid))
    left_off = np.abs(w) @ whole + np.abs(w @ moved.matrix - own @ w)
    pushed, pulled = slopes.pushed.reshape(n, -1), np.moveaxis(slopes.pulled, 2, 0).reshape(n, -1)
    nothing = np.zeros((len(bordered) - n, pushed.shape[1]))
    turned = np.linalg.solve(bordered, np.vstack([pushed, nothing]))[:n].reshape(n, -1, c)
    weighed = np.linalg.solve(bordered.T, np.vstack([pulled, nothing]))[:n].reshape(n, -1, c)
    doubt = slopes.doubt + np.abs(np.moveaxis(weighed, 0, 2)) @ right_off
    doubt += left_off @ np.abs(np.moveaxis(turned, 0, 1))
    shift = float((np.abs(w) @ whole @ np.abs(x)).max())
    scale = float(np.abs(one.values).max())
    for place, rate in enumerate(slopes.rates):
        if not slopes.known[place]:
            yield np.full(c, np.nan), np.nan
            continue
        if not slopes.still[place]:
            yield None, np.nan
            continue
        moves = np.linalg.eigvals(rate) if c > 1 else rate[0]
        growth = (one.values.conj() * moves).real / np.abs(one.values)
        yield growth, 2 * float(doubt[place].sum()) + 2 * float(np.abs(rate).sum()) * shift / scale


@dataclass(frozen=True, slots=True, eq=False)
class _ClusterSlopes:
    """What m parameters do to a cluster: W dM X (m, c, c) and its rounding, dM X (n, m, c), W dM (m, c, n).

    `known` says which derivatives there are, `still` which of them leave the rigid motions alone.
    """

    rates: Complexes
    doubt: Floats
    pushed: Complexes
    pulled: Complexes
    known: NDArray[np.bool_]
    still: NDArray[np.bool_]


def _slopes(one: _Cluster, count: int) -> _ClusterSlopes:
    """Return what each of so many parameters does to a cluster, through the sites it stands in."""
    moved, w, x, rigid = one.moved, one.left, one.right, one.moved.rigid
    n, c = x.shape
    rates, doubt = np.zeros((count, c, c), np.complex128), np.zeros((count, c, c))
    pushed, pulled = np.zeros((n, count, c), np.complex128), np.zeros((count, c, n), np.complex128)
    known = np.ones(count, dtype=np.bool_)
    drift, drift_off = np.zeros((2, count, n, rigid.shape[1]))
    heavy, large, still = np.abs(w), np.abs(x), np.abs(rigid)
    for way in moved.through:
        places, within = way.slopes.places, way.slopes.matrices
        finite = np.asarray(np.isfinite(within).all(axis=(1, 2)))
        known[places] &= finite
        within = np.where(finite[:, None, None], within, 0.0)
        size = np.abs(within)
        off = np.where(finite[:, None, None], way.slopes.errors, 0.0)
        off = off + 4 * (sum(within.shape[1:]) + 2) * UNIT * size
        out, into = np.abs(way.outward), np.abs(way.inward)
        out_off = way.outward_error + 4 * (n + 2) * UNIT * out
        into_off = way.inward_error + 4 * (n + 2) * UNIT * into
        heard, felt = way.inward @ x, w @ way.outward
        ahead, behind = within @ heard, felt @ within
        rates[places] += felt @ ahead
        pushed[:, places] += np.moveaxis(way.outward @ ahead, 0, 1)
        pulled[places] += behind @ way.inward
        felt_size, heard_size = np.abs(felt), np.abs(heard)
        doubt[places] += felt_size @ (off @ heard_size + size @ (into_off @ large))
        doubt[places] += (heavy @ out_off) @ (size @ heard_size)
        if rigid.shape[1]:
            along = into @ still
            drift[places] += way.outward @ (within @ (way.inward @ rigid))
            drift_off[places] += out @ (off @ along + size @ (into_off @ still)) + out_off @ (size @ along)
    stays = np.asarray((np.abs(drift) <= drift_off).all(axis=(1, 2)))
    return _ClusterSlopes(rates, doubt, pushed, pulled, known, stays)


def _without(vectors: Complexes, rigid: Floats) -> Complexes:
    """Return what of vectors is no rigid motion (of orthonormal ones)."""
    return vectors - rigid @ (rigid.T @ vectors)
