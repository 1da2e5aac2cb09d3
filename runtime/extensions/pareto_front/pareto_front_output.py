"""Output of Pareto fronts.

Takes: a `ParetoFront`. Gives: its text and picture.
Guarantees: every line fits 80 columns where its words allow it.
Does not: compute.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.wording import wrapped
from apc.output.formatting import (
    MEANT,
    Lines,
    axis_label,
    labelled,
    notes,
    quantity,
    table,
)
from apc.output.pictures import COLOURS, new_figure
from apc.output.tuning_output import TYPED

if TYPE_CHECKING:
    from apc.extensions.pareto_front.trade_off import ParetoFront


def pareto_front_text(front: ParetoFront) -> Lines:
    """Yield the designs as a table, those at the ends and at the knee named, in at most 80 columns."""
    best = "largest" if front.maximize else "smallest"
    yield from wrapped(
        f"{front.topology}: Pareto front, {best} {front.objective} for each bound on {front.tradeoff}",
        "",
        "  ",
    )
    yield from notes(MEANT.get(front.criterion, ""), *front.limitations, *front.notes)
    yield ""
    names_of = [name for name, _, _ in front.designs[0].gains]
    separation = front.objective not in names_of  # what is best is in no column of the gains
    heads = ["metric", best] if separation else [front.tradeoff]  # the title names both
    # An end is no knee. With a column of the objective there is no room for names.
    names = {} if separation else {front.knee: "knee", 0: "smallest metric", len(front.designs) - 1: best}
    rows = [(*heads, *names_of, "", "")]
    for index, design in enumerate(front.designs):
        gains = (quantity(value, unit, TYPED) for _, value, unit in design.gains)
        proved = "" if design.proved else "not proved"
        value = [quantity(design.value, front.unit, 4)] * separation
        rows.append(
            (
                quantity(design.transparency, front.tradeoff_unit, 5),
                *value,
                *gains,
                names.get(index, ""),
                proved,
            )
        )
    yield from table(rows)
    if separation:
        knee = quantity(front.designs[front.knee].transparency, front.tradeoff_unit, 5)
        yield from labelled(("knee", f"metric {knee}"))


def pareto_front_picture(front: ParetoFront, ax: Any = None) -> Any:
    """Draw the front, three designs named; return the matplotlib Axes."""
    ax = new_figure((5.2, 3.8)).subplots() if ax is None else ax
    x, y = (
        np.array([getattr(design, name) for design in front.designs]) for name in ("transparency", "value")
    )
    ax.plot(x, y, "o-", markersize=4, color=COLOURS[0])
    ax.set(
        xlabel=axis_label(front.tradeoff, front.tradeoff_unit), ylabel=axis_label(front.objective, front.unit)
    )
    ax.set_title(front.topology, fontsize=9)
    end = "largest" if front.maximize else "least"
    for index, name in {front.knee: "knee", 0: f"least {front.tradeoff}", len(x) - 1: end}.items():
        at = (float(x[index]), float(y[index]))
        last, falls = index == len(x) - 1, bool(y[0] > y[-1])
        # The name of the last design ends at it, the others begin at theirs, on the side without the curve.
        offset = (-6 if last else 6, 6 if falls != last else -12)
        alignment = "right" if last else "left"
        ax.annotate(name, at, xytext=offset, textcoords="offset points", ha=alignment, fontsize=8)
    ax.margins(0.12)  # room for the names
    ax.grid(linewidth=0.4, alpha=0.5)
    return ax
