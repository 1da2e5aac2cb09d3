"""The quantities that a sweep can compute at each point.

Takes: a `Model` and a name such as `analyze` or `critical:coordination.stiffness`.
Gives: `SweepQuantity`, `QUANTITIES`, `find_quantity`, `faulty`; `BEGINNINGS`, `by_criterion`.
Guarantees: data common to all points are prepared once; a row does not depend on the parts computed before; a
point that can't be computed is a row that says why; a number that isn't finite is left out of a row.
Does not: choose points, or hold results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.eigen.spectrum import finite
from apc.frame.overrides import apply
from apc.frame.parameter_names import find, unit_of
from apc.parameter_studies.batch_analysis import (
    FAULT,
    ManyAnalyses,
    SweptParameter,
    by_matrices,
    many_analyses,
)
from apc.parameter_studies.stability_criteria import MEAN_SQUARE, NOMINAL, PASSIVE
from apc.sweeps.grid import Grid
from apc.tables import Row, TableColumn

LOCATION = SourceLocation("sweep")

# How the name of a quantity begins that is by another criterion than the nominal one.
BEGINNINGS = {MEAN_SQUARE: "in mean square: ", PASSIVE: "with passive hands: "}

Cells = tuple[NDArray[Any], ...]

VERDICT = TableColumn("verdict", "", "text")
MESSAGE = TableColumn("message", "", "text")


@dataclass(frozen=True, slots=True)
class SweepQuantity:
    """A result of every point: `cells` gives those of some points of a grid, an array for each of `columns`.

    Of numbers and counts it is one of floats, NaN where a point has none; of texts one of objects. The first
    column is the verdict, the last a message, empty but where a point is at fault. `quick` says that a point
    takes next to no time, so that many make a part of the work.
    """

    columns: tuple[TableColumn, ...]
    cells: Callable[[Grid, Sequence[int]], Cells]
    quick: bool = False


def find_quantity(system: Model, text: str) -> SweepQuantity:
    """Return the quantity a text names, ready to be evaluated with any numbers of the system.

    Parameters
    ----------
    system
        The topology whose points are to be computed.
    text
        `NAME`, or `NAME:ARGUMENT` where the quantity takes one.

    Raises
    ------
    ApcError
        E884 no such quantity; the errors of the quantity's own argument.
    """
    criterion = next((item for item, start in BEGINNINGS.items() if text.startswith(start)), NOMINAL)
    text = text.removeprefix(BEGINNINGS.get(criterion, ""))
    name, _, argument = text.partition(":")
    make = QUANTITIES.get(name.strip())
    if make is None:
        message = f"{name[:80] or 'an empty name'} is nothing a sweep computes ({', '.join(QUANTITIES)})"
        raise ApcError(Diagnostic("E884", LOCATION, message, hint=nearest(name, QUANTITIES)))
    if criterion != NOMINAL:
        make = _SCALAR_CRITERIA[criterion, name.strip()]
    return make(system, argument.strip())


def by_criterion(text: str, criterion: str) -> str:
    """Return the name of a quantity by a criterion."""
    return BEGINNINGS.get(criterion, "") + text


def faulty(columns: tuple[TableColumn, ...], error: ApcError) -> Row:
    """Return the row of a point at fault: the message's code as its verdict, and the message."""
    first = error.mistakes[0]
    return (FAULT + first.code, *(None for _ in columns[1:-1]), first.sentence)


def _analyze(system: Model, argument: str) -> SweepQuantity:
    """Return the verdict, the spectral radius, and how the leading mode moves."""
    if argument:
        raise ApcError(Diagnostic("E884", LOCATION, "analyze", "no parameter", argument[:80], "--of analyze"))
    columns = (
        VERDICT,
        TableColumn("spectral_radius", "", "number"),
        TableColumn("spectral_radius_error", "", "number"),
        TableColumn("rigid_modes", "", "count"),
        TableColumn("frequency", "Hz", "number"),
        TableColumn("damping_ratio", "", "number"),
        MESSAGE,
    )
    made: list[tuple[Grid, ManyAnalyses]] = []

    def cells(grid: Grid, points: Sequence[int]) -> Cells:
        if not made or made[0][0] is not grid:
            varied = [
                SweptParameter(axis.free, np.array([float(value) for value in axis.values]), exact)
                for axis in grid.axes
                for exact in [axis.values.__getitem__]
            ]
            made[:] = [(grid, many_analyses(system, varied))]
        rows = made[0][1].at(grid.indices(points))
        return (
            rows.verdict,
            *map(_finite, (rows.spectral_radius, rows.spectral_radius_error)),
            np.where(rows.rigid_modes < 0, np.nan, rows.rigid_modes),
            *map(_finite, (rows.frequency_hz, rows.damping_ratio)),
            rows.message,
        )

    return SweepQuantity(columns, cells, by_matrices(system))


def _finite(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(numbers), numbers, np.nan)


def _stability_measure(system: Model, argument: str) -> SweepQuantity:
    """Return the verdict in mean square and the growth factor of second moments per frame."""
    from apc.frame.numeric_model import prepare  # the nominal quantities need none of it
    from apc.mean_square.mean_square_stability import mean_square_growth, verdict_of

    if argument:
        raise ApcError(Diagnostic("E884", LOCATION, "analyze", "no parameter", argument[:80], "--of analyze"))
    columns = (
        VERDICT,
        TableColumn("mean_square_radius", "", "number"),
        TableColumn("mean_square_radius_error", "", "number"),
        MESSAGE,
    )
    prepared = prepare(system)

    def evaluate(changed: Model) -> Row:
        with np.errstate(all="ignore"):
            result = mean_square_growth(changed, prepared)
        error = max(result.high - result.radius, result.radius - result.low)
        return (verdict_of(result), finite(result.radius), finite(error), result.why or result.note)

    return SweepQuantity(columns, _pointwise(system, columns, evaluate))


def _passive(system: Model, argument: str) -> SweepQuantity:
    """Return the verdict with every passive hand, and how much damping of each device could be spared."""
    from apc.haptics.absolute_stability import absolute_stability  # the nominal quantities need none of it

    if argument:
        raise ApcError(Diagnostic("E884", LOCATION, "analyze", "no parameter", argument[:80], "--of analyze"))
    columns = (
        VERDICT,
        TableColumn("spare_damping", "N*s/m", "number"),
        TableColumn("spare_damping_error", "N*s/m", "number"),
        TableColumn("frequency", "Hz", "number"),
        MESSAGE,
    )

    def evaluate(changed: Model) -> Row:
        hands = absolute_stability(changed)
        worst = hands.worst_mode
        if worst is None or worst.more is None or worst.error is None:
            return (hands.verdict, None, None, None, hands.why or "no damping is enough")
        return (
            hands.verdict,
            finite(-worst.more),
            finite(worst.error),
            finite(worst.frequency_hz or 0.0),
            "",
        )

    return SweepQuantity(columns, _pointwise(system, columns, evaluate))


def _critical_by(criterion: str) -> Callable[[Model, str], SweepQuantity]:
    return lambda system, argument: _critical(system, argument, criterion)


def _pointwise(
    system: Model, columns: tuple[TableColumn, ...], evaluate: Callable[[Model], Row]
) -> Callable[[Grid, Sequence[int]], Cells]:
    """Return a function that evaluates points of a grid, one by one."""

    def cells(grid: Grid, points: Sequence[int]) -> Cells:
        rows = []
        for point in points:
            try:
                rows.append(evaluate(apply(system, grid.overrides(point))))
            except ApcError as error:
                rows.append(faulty(columns, error))
        kinds = [object if column.kind == "text" else np.float64 for column in columns]  # None is NaN
        return tuple(
            np.array(local, dtype=kind) for local, kind in zip(zip(*rows, strict=True), kinds, strict=True)
        )

    return cells


def _critical(system: Model, argument: str, criterion: str = "nominal") -> SweepQuantity:
    """Return the value at which the verdict changes with one parameter, and on which side it is stable."""
    from apc.parameter_studies.critical_values import critical  # a sweep of verdicts needs none of it

    if not argument:
        form = "--of critical:coordination.stiffness"
        raise ApcError(Diagnostic("E884", LOCATION, "critical", "a parameter", "nothing", form))
    unit = unit_of(system, find(system, argument, LOCATION).name)
    shown = "" if unit == "1" else unit
    columns = (
        VERDICT,
        TableColumn("value", shown, "number"),
        TableColumn("error", shown, "number"),
        TableColumn("crossings", "", "count"),
        TableColumn("proof", "", "text"),
        MESSAGE,
    )

    def evaluate(changed: Model) -> Row:
        result = critical(changed, argument, criterion=criterion)
        if result.value is None or result.error is None:
            return (str(result.verdict), None, None, 0, None, "")
        verdict = f"stable {result.stable_side} the value"
        proof = next(crossing.proof for crossing in result.crossings if crossing.value == result.value)
        return (verdict, finite(result.value), finite(result.error), len(result.crossings), str(proof), "")

    return SweepQuantity(columns, _pointwise(system, columns, evaluate))


QUANTITIES: Mapping[str, Callable[[Model, str], SweepQuantity]] = {
    "analyze": _analyze,
    "critical": _critical,
}

_SCALAR_CRITERIA: Mapping[tuple[str, str], Callable[[Model, str], SweepQuantity]] = {
    (MEAN_SQUARE, "analyze"): _stability_measure,
    (MEAN_SQUARE, "critical"): _critical_by(MEAN_SQUARE),
    (PASSIVE, "analyze"): _passive,
    (PASSIVE, "critical"): _critical_by(PASSIVE),
}
