"""The quantities that a sweep can compute at each point.

Takes: a `Model` and a name such as `analyze` or `critical:coordination.stiffness`.
Gives: `SweepQuantity`, `QUANTITIES`, `find_quantity`, `error_row`; `BEGINNINGS`, `by_criterion`.
Guarantees: data common to all points is prepared once; a row does not depend on the parts computed before; a
point with an error is a row with its message; numbers that are not finite are missing in a row.
Does not: choose points, or store results.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.parameter_values.overrides import apply
from apc.parameter_values.parameter_names import find, unit_of
from apc.spectrum.spectrum import finite
from apc.studies.batch_analysis import (
    FAULT,
    ManyAnalyses,
    SweptParameter,
    by_matrices,
    many_analyses,
)
from apc.studies.grid import Grid
from apc.studies.stability_criteria import MEAN_SQUARE, NOMINAL, PASSIVE
from apc.support.tables import Row, TableColumn

LOCATION = SourceLocation("sweep")

# The prefix of a quantity's name for each criterion other than the nominal one.
BEGINNINGS = {MEAN_SQUARE: "in mean square: ", PASSIVE: "with passive hands: "}

Cells = tuple[NDArray[Any], ...]

VERDICT = TableColumn("verdict", "", "text")
MESSAGE = TableColumn("message", "", "text")


@dataclass(frozen=True, slots=True)
class SweepQuantity:
    """A quantity of a sweep: `cells` returns its values at some points of a grid, one array per column.

    Columns of numbers and counts are float arrays, NaN where missing; columns of texts are object arrays. The
    first column is the verdict, the last a message, empty unless the point has an error. `quick` states that
    a point takes little time, so that a part has many points.
    """

    columns: tuple[TableColumn, ...]
    cells: Callable[[Grid, Sequence[int]], Cells]
    quick: bool = False


def find_quantity(model: Model, text: str) -> SweepQuantity:
    """Return the quantity of a name, prepared for evaluation at any values of a model.

    Parameters
    ----------
    model
        The compiled model.
    text
        `NAME`, or `NAME:ARGUMENT` for a quantity with an argument.

    Raises
    ------
    ApcError
        E884 an unknown quantity; the errors of the quantity's argument.
    """
    criterion = next(
        (candidate for candidate, prefix in BEGINNINGS.items() if text.startswith(prefix)), NOMINAL
    )
    text = text.removeprefix(BEGINNINGS.get(criterion, ""))
    name, _, argument = text.partition(":")
    constructor = QUANTITIES.get(name.strip())
    if constructor is None:
        message = f"{name[:80] or 'an empty name'} is not a quantity of a sweep ({', '.join(QUANTITIES)})"
        raise ApcError(Diagnostic("E884", LOCATION, message, fix=nearest(name, QUANTITIES)))
    return constructor(model, argument.strip(), criterion)


def by_criterion(text: str, criterion: str) -> str:
    """Return the name of a quantity with the prefix of a criterion."""
    return BEGINNINGS.get(criterion, "") + text


def error_row(columns: tuple[TableColumn, ...], error: ApcError) -> Row:
    """Return the row of a point with an error: the error's code as its verdict, and the message."""
    first = error.mistakes[0]
    return (FAULT + first.code, *(None for _ in columns[1:-1]), first.sentence)


def _analyze(model: Model, argument: str, criterion: str) -> SweepQuantity:
    """Return the quantity with the verdict and the spectral radius, or the number of a scalar criterion."""
    if argument:
        raise ApcError(Diagnostic("E884", LOCATION, "analyze", "no parameter", argument[:80], "--of analyze"))
    evaluated = {MEAN_SQUARE: _stability_measure, NOMINAL: _spectral_radius, PASSIVE: _passive}
    return evaluated[criterion](model)


def _spectral_radius(model: Model) -> SweepQuantity:
    """Return the quantity with the verdict, the spectral radius, and frequency and damping of the
    dominant mode.
    """
    columns = (
        VERDICT,
        TableColumn("spectral_radius", "", "number"),
        TableColumn("spectral_radius_error", "", "number"),
        TableColumn("rigid_modes", "", "count"),
        TableColumn("frequency", "Hz", "number"),
        TableColumn("damping_ratio", "", "number"),
        MESSAGE,
    )
    prepared_analyses: list[tuple[Grid, ManyAnalyses]] = []

    def cells(grid: Grid, points: Sequence[int]) -> Cells:
        """Return the columns at some points of a grid, by batch analyses."""
        if not prepared_analyses or prepared_analyses[0][0] is not grid:
            varied = [
                SweptParameter(axis.free, np.array([float(value) for value in axis.values]), exact)
                for axis in grid.axes
                for exact in [axis.values.__getitem__]
            ]
            prepared_analyses[:] = [(grid, many_analyses(model, varied))]
        rows = prepared_analyses[0][1].at(grid.indices(points))
        return (
            rows.verdict,
            *map(_finite, (rows.spectral_radius, rows.spectral_radius_error)),
            np.where(rows.rigid_modes < 0, np.nan, rows.rigid_modes),
            *map(_finite, (rows.frequency_hz, rows.damping_ratio)),
            rows.message,
        )

    return SweepQuantity(columns, cells, by_matrices(model))


def _finite(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return numbers with NaN in place of infinite ones."""
    return np.where(np.isfinite(numbers), numbers, np.nan)


def _stability_measure(model: Model) -> SweepQuantity:
    """Return the quantity with the mean-square verdict and the growth factor of second moments per frame."""
    from apc.lifting.numeric_model import numeric_model  # the nominal quantities need none of it
    from apc.mean_square.mean_square_stability import mean_square_growth, verdict_of

    columns = (
        VERDICT,
        TableColumn("mean_square_radius", "", "number"),
        TableColumn("mean_square_radius_error", "", "number"),
        MESSAGE,
    )
    numeric = numeric_model(model)

    def evaluate(changed: Model) -> Row:
        """Return the row of one model."""
        with np.errstate(all="ignore"):
            result = mean_square_growth(numeric.at(changed))
        error = max(result.high - result.radius, result.radius - result.low)
        return (verdict_of(result), finite(result.radius), finite(error), result.why or result.note)

    return SweepQuantity(columns, _pointwise(model, columns, evaluate))


def _passive(model: Model) -> SweepQuantity:
    """Return the quantity with the verdict over every passive hand, and the reserve of each device's
    damping.
    """
    from apc.haptics.absolute_stability import absolute_stability  # the nominal quantities need none of it
    from apc.lifting.numeric_model import numeric_model

    columns = (
        VERDICT,
        TableColumn("spare_damping", "N*s/m", "number"),
        TableColumn("spare_damping_error", "N*s/m", "number"),
        TableColumn("frequency", "Hz", "number"),
        MESSAGE,
    )

    def evaluate(changed: Model) -> Row:
        """Return the row of one model."""
        result = absolute_stability(numeric_model(changed))
        worst = result.worst_mode
        if worst is None or worst.more is None or worst.error is None:
            return (result.verdict, None, None, None, result.why or "not passive at any damping")
        return (
            result.verdict,
            finite(-worst.more),
            finite(worst.error),
            finite(worst.frequency_hz or 0.0),
            "",
        )

    return SweepQuantity(columns, _pointwise(model, columns, evaluate))


def _pointwise(
    model: Model, columns: tuple[TableColumn, ...], evaluate: Callable[[Model], Row]
) -> Callable[[Grid, Sequence[int]], Cells]:
    """Return the function that evaluates points of a grid one by one."""

    def cells(grid: Grid, points: Sequence[int]) -> Cells:
        """Return the columns at some points of a grid, with a row of the error at a failed point."""
        rows = []
        for point in points:
            try:
                rows.append(evaluate(apply(model, grid.overrides(point))))
            except ApcError as error:
                rows.append(error_row(columns, error))
        kinds = [object if column.kind == "text" else np.float64 for column in columns]  # None is NaN
        return tuple(
            np.array(column_values, dtype=kind)
            for column_values, kind in zip(zip(*rows, strict=True), kinds, strict=True)
        )

    return cells


def _critical(model: Model, argument: str, criterion: str) -> SweepQuantity:
    """Return the quantity with the critical value of one parameter, its error, and the stable side."""
    from apc.studies.critical_values import critical  # a sweep of verdicts needs none of it

    if not argument:
        form = "--of critical:coordination.stiffness"
        raise ApcError(Diagnostic("E884", LOCATION, "critical", "a parameter", "nothing", form))
    unit = unit_of(model, find(model, argument, LOCATION).name)
    unit_text = "" if unit == "1" else unit
    columns = (
        VERDICT,
        TableColumn("value", unit_text, "number"),
        TableColumn("error", unit_text, "number"),
        TableColumn("crossings", "", "count"),
        TableColumn("proof", "", "text"),
        MESSAGE,
    )

    def evaluate(changed: Model) -> Row:
        """Return the row of one model."""
        result = critical(changed, argument, criterion=criterion)
        if result.value is None or result.error is None:
            return (str(result.verdict), None, None, 0, None, "")
        verdict = f"stable {result.stable_side} the value"
        proof = next(crossing.proof for crossing in result.crossings if crossing.value == result.value)
        return (verdict, finite(result.value), finite(result.error), len(result.crossings), str(proof), "")

    return SweepQuantity(columns, _pointwise(model, columns, evaluate))


QUANTITIES: Mapping[str, Callable[[Model, str, str], SweepQuantity]] = {
    "analyze": _analyze,
    "critical": _critical,
}
