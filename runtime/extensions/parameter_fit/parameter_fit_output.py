"""Output of parameters fitted to a recording.

Takes: a `ParameterFit`. Gives: its text, table and picture.
Guarantees: every line fits 80 columns where its words allow it; limitations follow the estimates.
Does not: compute.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apc.compiler.wording import counted, wrapped
from apc.output.formatting import Lines, axis_label, labelled, notes, quantity, span, table
from apc.output.pictures import COLOURS, new_figure
from apc.support.tables import Row, TableColumn

if TYPE_CHECKING:
    from apc.extensions.parameter_fit.parameter_estimation import ParameterFit


def parameter_fit_text(fit: ParameterFit) -> Lines:
    """Yield the estimates, their correlation, the residuals, and limitations."""
    file = Path(fit.recording).name
    yield from wrapped(
        f"{fit.topology}: {counted(len(fit.parameters), 'parameter')} fitted to {file}", "", "  "
    )
    yield ""
    rows = [("parameter", "estimate", "standard error", "95 % interval")]
    for item in fit.parameters:
        error = quantity(item.standard_error, item.unit, 3)
        rows.append((item.name, quantity(item.value, item.unit), error, span(*item.interval, item.unit)))
    yield from table(rows)
    if len(fit.parameters) > 1:
        numbers = [f"({index + 1})" for index in range(len(fit.parameters))]
        yield from ("", "Correlation of the estimates", "")
        pairs = zip(fit.parameters, numbers, fit.correlation, strict=True)
        cells = [(f"{n} {item.name}", *(f"{value:.3f}" for value in row)) for item, n, row in pairs]
        yield from table([("", *numbers), *cells], "<" + ">" * len(numbers))
    yield from ("", "Residuals", "")
    tests = [("signal", "rms", "Ljung-Box test")]
    for signal in fit.residuals:
        probability = f"p = {signal.probability:.3g}, {counted(signal.lags, 'lag')}"
        if math.isnan(signal.probability):
            probability = "rounding errors"
        tests.append((signal.signal, quantity(signal.rms, signal.unit, 3), probability))
    yield from table(tests)
    yield ""
    compared = f"{fit.samples:,} of {counted(fit.rows, 'row', ',')} until {fit.duration:.6g} s"
    forces = ", ".join(fit.forces) or "those of the topology"
    yield from labelled(("compared", compared), ("forces", forces), ("simulations", f"{fit.evaluations}"))
    yield from notes(*_limitations(fit))


def _limitations(fit: ParameterFit) -> Iterator[str]:
    """Yield the limitations of a fit."""
    for item in fit.parameters:
        if item.at_end:
            yield f"{item.name} is at an end of its range: the standard errors are not valid"
        elif item.interval[0] < item.low or item.interval[1] > item.high:
            yield f"{item.name}: the 95 % interval exceeds the range, so the recording determines it poorly"
    colored = [signal.signal for signal in fit.residuals if signal.used and not signal.white]
    if colored:
        yield (
            f"the residuals of {', '.join(colored)} are correlated: the topology does not explain the "
            "motion, or the noise is not white; the standard errors are then not valid"
        )
    if unused := [signal.signal for signal in fit.residuals if not signal.used]:
        yield f"no free parameter has an effect on {', '.join(unused)}"
    if fit.samples < fit.rows:
        yield "only rows at ticks of the fastest clock are compared"
    if fit.start:
        yield f"time 0 of the topology is the first row, at {fit.start:.9g} s of the recording"


def parameter_fit_rows(fit: ParameterFit) -> tuple[list[TableColumn], list[Row], dict[str, Any]]:
    """Return the columns and rows of the estimates in SI, and their provenance."""
    names = ("estimate", "standard error", "lower 95 %", "upper 95 %")
    columns = [TableColumn("parameter", "", "text"), TableColumn("unit", "", "text")]
    columns += [TableColumn(name, "") for name in names]
    rows: list[Row] = [
        (item.name, str(item.unit), item.value, item.standard_error, *item.interval)
        for item in fit.parameters
    ]
    return columns, rows, {"topology": fit.topology, "recording": fit.recording}


def parameter_fit_picture(fit: ParameterFit, ax: Any = None) -> Any:
    """Draw the residuals of each signal over time in a new Figure, or relative to their rms in given Axes."""
    residuals = fit.measured - fit.fitted
    if ax is not None:
        for signal, column in zip(fit.residuals, residuals.T, strict=True):
            ax.plot(fit.time, column / (signal.rms or 1.0), ".", markersize=2, label=signal.signal)
        ax.set(xlabel="time [s]", ylabel="residual / rms")
        ax.legend(fontsize=8)
        return ax
    figure = new_figure((6.4, 1.2 + 1.4 * len(fit.residuals)))
    panels = figure.subplots(len(fit.residuals), 1, sharex=True, squeeze=False)[:, 0]
    for panel, signal, column in zip(panels, fit.residuals, residuals.T, strict=True):
        panel.plot(fit.time, column, ".", markersize=2, color=COLOURS[1])
        panel.axhline(0, linewidth=0.6, color=COLOURS[0])
        panel.set_ylabel(axis_label("residual", signal.unit))
        panel.set_title(signal.signal, fontsize=9)
        panel.grid(linewidth=0.4, alpha=0.5)
    panels[-1].set_xlabel("time [s]")
    return figure
