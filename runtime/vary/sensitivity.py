"""What moves the spectral radius most: its derivative with respect to every parameter.

Takes: a `CompiledSystem`.
Gives: `Sensitivity`, `Sensitivities`, `sensitivities`, `sensitivity_report`.
Guarantees: all parameters as one batch, exact to rounding; where several eigenvalues share the radius, one
row for each of them and no gradient that belongs to none.
Does not: vary times, or the number of peers.

For a simple eigenvalue, M v = λ v and w M = λ w,   dλ = w dM v / (w v),   d|λ| = Re(λ̄ dλ)/|λ|. A cluster of
equal eigenvalues with a full set of vectors moves as the eigenvalues of W dM V, W V = 1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.compiler.words import with_unit, wrapped
from apc.runtime.analysis.analysis import Prepared, prepare
from apc.runtime.frame.discretize import UNIT
from apc.runtime.frame.names import Free, parameter_of
from apc.runtime.network.nominal import channel_numbers
from apc.runtime.threads import single_threaded
from apc.runtime.trouble import finite_equations
from apc.runtime.vary.batch import BatchEvaluator, Evaluator, matrix_errors
from apc.runtime.vary.evaluator import DIFFERENCE, evaluator, free_parameters, keeps_size

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Eigenvalues whose magnitudes differ by less than this may be one within the rounding of their matrices:
# they are all said to share the radius.
SHARED = 1e-10

# Eigenvalues nearer to one another than this are one cluster, whose vectors are hardly several.
CLOSE = 1e-7

# A cluster of vectors worse conditioned than this has no derivative worth the name.
WORST = 1e8

# Rows of the table.
SHOWN = 6

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
class Sensitivities:
    """All derivatives, those that move most first, and the eigenvalues they belong to.

    `active` are the eigenvalues that share the radius, each named by its system: more than one at a crossing,
    where the radius itself has no derivative but the largest of theirs on either side. `note` says so, or why
    there is none.
    """

    radius: float
    active: tuple[tuple[complex, str], ...]
    rows: tuple[Sensitivity, ...]
    note: str

    def __str__(self) -> str:
        """Return the table of what moves the radius most."""
        return sensitivity_report(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the derivatives as plain data, ready for JSON."""
        return {
            "spectral_radius": self.radius,
            "active": [
                {"eigenvalue": [value.real, value.imag], "system": name} for value, name in self.active
            ],
            "derivatives": [
                {
                    "parameter": row.parameter,
                    "unit": row.unit,
                    "value": row.value,
                    "derivative": row.derivative,
                    "relative": row.relative,
                    "error": row.error,
                    "mode": row.mode,
                }
                for row in self.rows
            ],
            "note": self.note,
        }


def sensitivities(system: CompiledSystem, *, prepared: Prepared | None = None) -> Sensitivities:
    """Differentiate the spectral radius with respect to every parameter, and to every group's own.

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
    with single_threaded(), finite_equations(system.name), np.errstate(all="ignore"):
        free = _without_starts(system)
        prepared = prepared or prepare(system)
        family = evaluator(system, free, prepared=prepared)
        here = np.array([[parameter_of(system, one).value for one in free]])
        # What a stiffness of 0 leaves free is no relative motion of the scene as it is: it is not among those
        # that vary then, having no derivative there.
        matrices = family.matrices(here)
        if not here.all() and all(np.isfinite(one).all() for one in matrices) and keeps_size(matrices):
            free = [one for one, value in zip(free, here[0], strict=True) if value]
            family, here = evaluator(system, free, prepared=prepared), here[:, here[0] != 0]
        return _differentiate(system, family, free, here)


def _without_starts(system: CompiledSystem) -> list[Free]:
    """Return the free parameters that are no start values, and no numbers of unreliable links."""
    starts = {state.start for kind in system.kinds for state in kind.states}
    starts |= {start for kind in system.kinds for one in kind.clocks for start in one.starts}
    kept_out = starts | channel_numbers(system)
    return [one for one in free_parameters(system) if one.name not in kept_out]


def _differentiate(
    system: CompiledSystem, family: Evaluator, free: Sequence[Free], here: Floats
) -> Sensitivities:
    count = len(free)
    points = np.repeat(here, max(count, 1), axis=0)
    pairs = family.slopes(points, np.eye(count)) if count else [(m, m) for m in family.matrices(here)]
    errors = matrix_errors(family, here) if isinstance(family, BatchEvaluator) else None
    names = [one.name for one in family.closed_at(here[0].tolist())]
    if len(names) != len(pairs):  # all systems as blocks of one
        names = ["all systems"] * len(pairs)
    if not all(np.isfinite(matrix[0]).all() for matrix, _ in pairs):
        return Sensitivities(0.0, (), (), NO_MATRIX)
    clusters = [
        (place, cluster)
        for place, (matrix, _) in enumerate(pairs)
        if matrix.shape[1]
        for cluster in _clusters(matrix[0])
    ]
    if not clusters:
        return Sensitivities(0.0, (), (), "nothing moves: there is no eigenvalue")
    radius = max(float(np.abs(cluster[0]).max()) for _, cluster in clusters)
    leading = [
        (place, cluster)
        for place, cluster in clusters
        if float(np.abs(cluster[0]).max()) > radius - SHARED - _spread(cluster)
    ]
    rows: list[Sensitivity] = []
    active: list[tuple[complex, str]] = []
    notes = []
    for place, (values, right, left, condition) in leading:
        if not condition < WORST:
            notes.append(f"an eigenvalue of {names[place]} is defective: it has no derivative")
            continue
        error = np.zeros(()) if errors is None else errors[place][0]
        first = len(active)
        active += [(complex(value), names[place]) for value in values]
        for number, one in enumerate(free):
            matrix, slope = pairs[place][0][number], pairs[place][1][number]
            if not np.isfinite(slope).all():
                continue  # it can be moved neither way
            moved = left @ slope @ right
            rates = np.linalg.eigvals(moved) if len(values) > 1 else moved[0]
            growth = (values.conj() * rates).real / np.abs(values)
            doubt = _doubt(matrix, slope, error, right, left)
            if errors is None:
                doubt += DIFFERENCE**2 * float(np.abs(growth).max())
            parameter = parameter_of(system, one)
            rows += [
                Sensitivity(
                    one.label,
                    parameter.unit,
                    parameter.value,
                    float(rate),
                    float(rate) * parameter.value,
                    doubt,
                    first + k,
                )
                for k, rate in enumerate(np.sort(growth)[::-1])
            ]
    if len(active) > 1:
        notes.append(f"{len(active)} eigenvalues share the radius: the largest of their changes decides")
    rows.sort(key=lambda row: (-abs(row.relative), row.parameter, row.mode))
    return Sensitivities(radius, tuple(active), tuple(rows), "; ".join(notes))


# Digits of a change.
DIGITS = 3

# A cluster: eigenvalues (c,) of the upper half plane, vectors as columns (n, c) and rows (c, n) with W V = 1,
# and their condition.
_Cluster = tuple[Complexes, Complexes, Complexes, float]


def _clusters(matrix: Floats) -> list[_Cluster]:
    """Return the eigenvalues of the upper half plane, those that are one within rounding together."""
    values, right = (one.astype(np.complex128) for one in np.linalg.eig(matrix))
    found, left = np.linalg.eig(matrix.T)
    clusters = []
    seen = np.zeros(len(values), dtype=bool)
    for place in np.argsort(-np.abs(values), kind="stable"):
        if seen[place] or values[place].imag < 0:
            continue
        near = np.abs(values - values[place]) <= CLOSE * max(abs(values[place]), CLOSE)
        seen |= near
        rows = np.argsort(np.abs(found - values[place]), kind="stable")[: int(near.sum())]
        columns = right[:, near]
        w = left[:, rows].T.astype(np.complex128)
        product = w @ columns
        size = np.linalg.norm(w, 2) * np.linalg.norm(columns, 2)
        least = float(np.linalg.svd(product, compute_uv=False)[-1])
        condition = float(size / least) if least > 0 else np.inf
        if condition < WORST:
            w = np.linalg.solve(product, w).astype(np.complex128)
        clusters.append((values[near], columns, w, condition))
    return clusters


def _spread(cluster: _Cluster) -> float:
    """Return by how much rounding may split a cluster's magnitudes."""
    return float(np.ptp(np.abs(cluster[0])))


def _doubt(matrix: Floats, slope: Floats, error: Floats, right: Complexes, left: Complexes) -> float:
    """Estimate the error of a derivative: of the slope's rounding, and of vectors off by the matrix's.

    A matrix off by E turns the vectors by about |W| |E| |V| over the gaps between eigenvalues, which the
    condition stands for; the derivative changes by that times the slope.
    """
    size = np.abs(left) @ np.abs(slope) @ np.abs(right)
    whole = np.abs(matrix) * (8 * len(matrix) * UNIT) + error
    turned = float((np.abs(left) @ whole @ np.abs(right)).max())
    condition = float(np.linalg.norm(left, 2) * np.linalg.norm(right, 2))
    return float(size.max()) * (64 * len(matrix) * UNIT + condition * turned)


def sensitivity_report(found: Sensitivities) -> str:
    """Return the table "what moves it most", of at most 80 columns."""
    # Eigenvalues that share the radius often change alike, and then one row tells it.
    alike: dict[tuple[str, str], list[Sensitivity]] = {}
    for row in found.rows:
        off = row.error * abs(row.value)
        if abs(row.relative) > off:
            change = _change(row.relative / 100, off / 100)
            alike.setdefault((row.parameter, change), []).append(row)
    shown = list(alike.items())[:SHOWN]
    if not shown:
        note = found.note if len(found.active) < 2 else ""
        return "\n".join(wrapped(note or "no parameter moves the spectral radius", "  ", "    "))
    width = max(len(name) for (name, _), _ in shown)
    lines = ["  what moves it most" + " " * max(width - 16, 2) + "value            per percent"]
    for (name, change), rows in shown:
        some = ", ".join(str(row.mode + 1) for row in rows) if len(rows) < len(found.active) else ""
        value = with_unit(f"{rows[0].value:.6g}", rows[0].unit)
        lines.append(f"  {name:<{width}}  {value:<16} {change}{f'  mode {some}' if some else ''}")
    if found.note:
        lines += wrapped(found.note, "  ", "    ")
    return "\n".join(lines)


def _change(value: float, error: float) -> str:
    """Return a change to three digits, fewer where its error leaves them open."""
    known = math.floor(math.log10(abs(value) / error)) if error else DIGITS
    return f"{value:+.{min(max(known, 1), DIGITS) - 1}e}"
