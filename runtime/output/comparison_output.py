"""A comparison as text, plain data, table and picture: one panel per quantity, one bar per scheme.

Takes: a `SchemeComparison`. Gives: its text, document, rows and picture.
Guarantees: limitations come first; an empty cell has a footnote with the reason; lines have at most 80
columns. In the picture bars of one scheme have one colour and hatch in every panel, to be distinct without
color. A bar without an end in the searched range is marked ">"; an unavailable value is a dash.
Does not: compute, or need a display.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from apc.compiler.wording import counted, known_digits, wrapped
from apc.output.formatting import (
    MEANT,
    Lines,
    Plain,
    notes,
    picked,
    quantity,
    radius_text,
    reached,
    record,
    span,
    table,
    uncertain,
)
from apc.output.pictures import COLOURS, new_figure
from apc.tables import Row, TableColumn, Tabled

if TYPE_CHECKING:
    from apc.comparison.comparison import Scheme, SchemeComparison
    from apc.parameter_studies.critical_values import Critical

NONE = "–"
DIGITS = 6  # number of transparency values, at most

# The varied parameters, and the headings of their columns.
VARIED = (
    ("stiffness", "largest stable stiffness"),
    ("delay", "delay that breaks it"),
    ("loss", "loss that breaks it"),
)

# How bars are hatched: as 7 colours and 8 hatches have no common divisor, the first 56 schemes all differ.
HATCHES = ("", "////", "\\\\\\\\", "||||", "xxxx", "----", "....", "oooo")
ABREAST = 3  # panels in a row
PANEL, BAR = 2.4, 0.28  # inches: the width of a panel, the height of a bar
FURTHER = 4.0  # times the longest bar that ends, to which one that does not is drawn at most
LABEL = 24  # letters of a scheme's name in a line

LETTERS: dict[str, Any] = {
    "textcoords": "offset points",
    "va": "center",
    "fontsize": 8,
    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1, "alpha": 0.85},
}
BOUNDARY = 1.0  # the spectral radius from which on a motion grows

# The panels: title, and where in a scheme the number is; how many of its units what is varied is drawn in.
NUMBERS = (
    ("spectral radius a frame", "analysis.spectral_radius"),
    ("settles within 2 % in (s)", "analysis.settling_s"),
    ("felt at 1 Hz (N·s/m)", "transparency.impedance.0"),
    ("felt at 10 Hz (N·s/m)", "transparency.impedance.1"),
    ("operations a tick", "effort.operations"),
    ("numbers sent a second", "effort.sent"),
)
REACHES = (
    ("largest stable stiffness (N/m)", "stiffness", 1.0),
    ("delay that breaks it (ms)", "delay", 1e3),
    ("loss that breaks it (%)", "loss", 1e2),
)


def comparison_text(comparison: SchemeComparison) -> Lines:
    """Yield the output of `apc compare`: a table for each quantity, a line for each scheme."""
    schemes = comparison.schemes
    feet: dict[str, int] = {}
    yield counted(len(schemes), "scheme") + " side by side" * (len(schemes) > 1)
    yield from notes(
        *_meant(comparison), *comparison.limitations, *(f"note: {text}" for text in comparison.notes)
    )
    tables: list[tuple[tuple[str, ...], Iterable[tuple[str, ...]]]] = [
        (("",), [(f"{scheme.topology}, {counted(scheme.peers, 'peer', ',d')}",) for scheme in schemes]),
        (("verdict", "spectral radius a frame"), [_verdict(scheme, feet) for scheme in schemes]),
    ]
    if any(scheme.linearized for scheme in schemes):
        tables.append((("in time", "played"), [_in_time(scheme, feet) for scheme in schemes]))
    for key, heading in VARIED:
        tables.append(((heading, "of"), [_varied(scheme, key, feet) for scheme in schemes]))
    tables.append(
        (("felt at 1 Hz", "at 10 Hz", "of the hand at"), [_transparency(scheme, feet) for scheme in schemes])
    )
    tables.append((("work a tick", "a peer sends at most", "all send"), map(_costs, schemes)))
    for headings, cells in tables:
        rows = [("", *headings), *((str(index), *row) for index, row in enumerate(cells, 1))]
        yield ""
        yield from filter(None, table(rows, later=5))
    if feet:
        yield ""
    for text, number in feet.items():
        yield from wrapped(text, f"  [{number}] ", "      ")


def _marked(cell: str, texts: Iterable[str], feet: dict[str, int]) -> str:
    """Return a cell with the numbers of its footnotes, each text once: "– [1]"."""
    marks = [f"[{feet.setdefault(text, len(feet) + 1)}]" for text in texts if text]
    return " ".join([cell, *marks])


def _costs(scheme: Scheme) -> tuple[str, ...]:
    effort = scheme.effort
    clock = f" of {effort.clock}" if effort.clock else ""
    sent = (f"{number:,.6g} a second" for number in (effort.sent, effort.sent_by_all))
    return f"{counted(effort.operations, 'operation', ',d')}{clock}", *sent


def _meant(comparison: SchemeComparison) -> Iterator[str]:
    """Yield the stability criterion, if it is not the decay of motions."""
    if any(scheme.passive for scheme in comparison.schemes):
        yield MEANT["passive"]
    elif any(
        reached(scheme, f"{key}.criterion") in MEANT for scheme in comparison.schemes for key, _ in VARIED
    ):
        yield f"of a link that is, or becomes, unreliable: {MEANT['mean-square']}"


def _why(scheme: Scheme, key: str) -> tuple[str, ...]:
    return tuple(text for name, text in scheme.missing if name == key)


def _verdict(scheme: Scheme, feet: dict[str, int]) -> tuple[str, str]:
    if scheme.analysis is None:
        return scheme.verdict, _marked(NONE, [scheme.refused], feet)
    texts = list(_why(scheme, "verdict"))
    if scheme.network is not None and scheme.network.mean_square_radius is not None:
        root, error = math.sqrt(scheme.network.mean_square_radius), scheme.network.error or 0.0
        grown = radius_text(root, error / (2 * root) if root else error)
        texts.append(
            "the radius is that with every packet on time; "
            f"mean squares are multiplied by {grown} squared a frame"
        )
    if scheme.passive is not None:
        texts.append("the radius is that with free hands")
    verdict = scheme.verdict + (", linearized" if scheme.analysis.linearized else "")
    analysis = scheme.analysis
    radius = radius_text(analysis.spectral_radius, analysis.spectral_radius_error, analysis.radius_excess)
    return verdict, _marked(radius, texts, feet)


def _in_time(scheme: Scheme, feet: dict[str, int]) -> tuple[str, str]:
    """Return the verdict of a simulation, where that of an analysis is of a linearization."""
    if scheme.analysis is None:
        return NONE, NONE
    if not scheme.linearized:
        return "as its verdict says: it is linear", ""
    if scheme.simulated is None:
        return _marked(NONE, _why(scheme, "simulated"), feet), NONE
    summary = scheme.simulated.summary
    text = str(summary.verdict)
    if summary.settled is not None:
        text += f", settling time {summary.settled:.3g} s"
    elif summary.stopped_at is not None:
        text += f" at {summary.stopped_at:.3g} s"
    return text, f"{summary.end:g} s"


def _varied(scheme: Scheme, key: str, feet: dict[str, int]) -> tuple[str, str]:
    critical: Critical | None = getattr(scheme, key)
    if critical is None:
        return _marked(NONE, _why(scheme, key), feet), NONE
    remarks = []
    if len(critical.crossings) > 1:
        remarks.append(
            f"{counted(len(critical.crossings), 'crossing')} in all: apc critical {critical.parameter}"
        )
    if critical.groups:
        remarks.append("one value for all groups, which differ in the topology")
    return _marked(_reach(critical), remarks, feet), critical.parameter


def _reach(critical: Critical) -> str:
    """Return in words how far a model is stable."""
    if critical.value is None:
        assert critical.verdict is not None
        if not critical.has_effect:
            return f"{critical.verdict.word} whatever it is"
        if critical.verdict.stable:
            return f"none up to {quantity(critical.searched_to[1], critical.unit)}"
        return f"{critical.verdict.word} from {span(*critical.searched_to, critical.unit)}"
    value = uncertain(critical.value, critical.error or 0.0, critical.unit).removesuffix(", exact")
    return value if critical.stable_side == "below" else f"{value}, stable above it"


def _transparency(scheme: Scheme, feet: dict[str, int]) -> tuple[str, str, str]:
    if scheme.transparency is None:
        return _marked(NONE, _why(scheme, "transparency"), feet), NONE, NONE
    cells = []
    for value, bound in zip(
        scheme.transparency.impedance.tolist(), scheme.transparency.bound.tolist(), strict=True
    ):
        size = known_digits(abs(value), abs(value) * bound, DIGITS)
        cells.append(f"{size} N*s/m, {np.degrees(np.angle(value)):.2f}°")
    return cells[0], cells[1], scheme.transparency.at


def comparison_document(comparison: SchemeComparison) -> Plain:
    """Return the same as plain data, in SI: each part as the JSON of its command."""
    return {"schemes": [_document(scheme) for scheme in comparison.schemes], "notes": list(comparison.notes)}


def _document(scheme: Scheme) -> Plain:
    return record(
        scheme, {**picked(scheme, "verdict", "stable", "limitations"), "missing": dict(scheme.missing)}
    )


def comparison_rows(comparison: SchemeComparison) -> Tabled:
    """Return the columns of a table of schemes, one row per scheme, and the limitations."""
    limitations = {scheme.topology: list(scheme.limitations) for scheme in comparison.schemes}
    columns = [column for column, _ in COLUMNS]
    return (
        columns,
        map(_row, comparison.schemes),
        {"limitations": limitations, "notes": list(comparison.notes)},
    )


def _varied_columns(key: str, unit: str) -> list[tuple[TableColumn, str]]:
    """Return the columns of the varied parameters, and the searched range."""
    words = ("parameter", "stable side", "verdict")
    numbers = (("", "value"), (" error", "error"), (" scanned to", "searched_to.1"))
    first, *others = (
        (TableColumn(f"{key} {word}", kind="text"), f"{key}.{word.replace(' ', '_')}") for word in words
    )
    value, error, scanned = ((TableColumn(key + name, unit), f"{key}.{index}") for name, index in numbers)
    return [first, value, error, others[0], scanned, others[1]]


# The columns of a table of schemes, and the field of each.
COLUMNS: list[tuple[TableColumn, str]] = [
    (TableColumn("topology", kind="text"), "topology"),
    (TableColumn("peers", kind="count"), "peers"),
    (TableColumn("verdict", kind="text"), "verdict"),
    (TableColumn("in time", kind="text"), "simulated.summary.verdict"),
    (TableColumn("frame", "s"), "analysis.frame_s"),
    (TableColumn("spectral radius"), "analysis.spectral_radius"),
    (TableColumn("spectral radius error"), "analysis.spectral_radius_error"),
    (TableColumn("mean square radius"), "network.mean_square_radius"),
    *_varied_columns("stiffness", "N/m"),
    *_varied_columns("delay", "s"),
    *_varied_columns("loss", ""),
    (TableColumn("felt at", kind="text"), "transparency.at"),
    (TableColumn("impedance at 1 Hz real", "N*s/m"), "transparency.impedance.0.real"),
    (TableColumn("impedance at 1 Hz imaginary", "N*s/m"), "transparency.impedance.0.imag"),
    (TableColumn("impedance at 10 Hz real", "N*s/m"), "transparency.impedance.1.real"),
    (TableColumn("impedance at 10 Hz imaginary", "N*s/m"), "transparency.impedance.1.imag"),
    (TableColumn("operations a tick", kind="count"), "effort.operations"),
    (TableColumn("numbers sent", "1/s"), "effort.sent"),
    (TableColumn("numbers sent by all", "1/s"), "effort.sent_by_all"),
    (TableColumn("missing", kind="text"), ""),
]


def _row(scheme: Scheme) -> Row:
    """Return a row of the table."""
    missing = "; ".join(f"{key}: {text}" for key, text in scheme.missing) or scheme.refused or None
    cells = (reached(scheme, path) for _, path in COLUMNS if path)
    return *(
        float(cell) if isinstance(cell, float) else None if cell == "" else cell for cell in cells
    ), missing


@dataclass(frozen=True, slots=True)
class _Bar:
    """A bar with a text at its end; `further` is whether it continues beyond the searched range."""

    length: float
    text: str
    further: bool = False


def comparison_picture(comparison: SchemeComparison) -> Any:
    """Plot all schemes for comparison; return the matplotlib Figure.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    schemes = comparison.schemes
    panels = [(title, [_number(reached(scheme, path)) for scheme in schemes]) for title, path in NUMBERS]
    reaches = [
        (title, [_reach_bar(getattr(scheme, key), scale) for scheme in schemes])
        for title, key, scale in REACHES
    ]
    panels[2:2] = reaches
    rows = -(-len(panels) // ABREAST)
    names = [
        "\n".join(textwrap.wrap(f"{index}  {scheme.topology}", LABEL))
        for index, scheme in enumerate(schemes, 1)
    ]
    size = (PANEL * ABREAST + 1.4, (0.9 + BAR * 1.25 * len(names)) * rows + 0.5)
    figure = new_figure(size)
    axes = figure.subplots(rows, ABREAST, squeeze=False, sharey=True).ravel()
    for ax, (title, bars) in zip(axes, panels, strict=True):
        _draw(ax, title, bars)
    axes[0].set_yticks(range(len(names)), names, fontsize=8)
    axes[0].invert_yaxis()
    axes[0].axvline(BOUNDARY, color="0.4", linewidth=0.8, linestyle=(0, (3, 2)))
    for index, scheme in enumerate(schemes):
        axes[0].annotate(_verdict_text(scheme), (0, index), (4, 0), **LETTERS)
    lines = [
        line for text in (*comparison.limitations, *comparison.notes) for line in textwrap.wrap(text, 110)
    ]
    figure.suptitle("\n".join(lines), fontsize=8.5)
    return figure


def _number(value: complex | None) -> _Bar:
    return _Bar(0.0, NONE) if value is None else _Bar(abs(value), f"{abs(value):.4g}")


def _reach_bar(critical: Critical | None, scale: float) -> _Bar:
    """Return the stable range of a scheme: up to a crossing, or beyond the searched range."""
    if critical is not None and critical.value is not None and critical.stable_side == "below":
        return _Bar(scale * critical.value, f"{scale * critical.value:.4g}")
    verdict = None if critical is None else critical.verdict
    if critical is not None and verdict is not None and verdict.stable:
        return _Bar(scale * critical.searched_to[1], f"> {scale * critical.searched_to[1]:.4g}", further=True)
    return _Bar(0.0, verdict.word if verdict is not None and verdict.stable is False else NONE)


def _draw(ax: Any, title: str, bars: Sequence[_Bar]) -> None:
    """Draw one quantity of all schemes."""
    ax.set_title(title, fontsize=8.5)
    ax.tick_params(labelsize=8)
    ax.tick_params(axis="y", length=0)
    ax.spines[["top", "right"]].set_visible(False)
    # A range without a limit may be a thousand times as large, and would compress the others.
    most = FURTHER * max((bar.length for bar in bars if not bar.further), default=0.0)
    lengths = [min(bar.length, most or bar.length) if bar.further else bar.length for bar in bars]
    edges = [COLOURS[index % len(COLOURS)] for index in range(len(bars))]
    hatches = [HATCHES[index % len(HATCHES)] for index in range(len(bars))]
    faces = ["white" if hatch else edge for hatch, edge in zip(hatches, edges, strict=True)]
    style = {"color": faces, "edgecolor": edges, "hatch": hatches, "linewidth": 0.8}
    plotted = ax.barh(range(len(bars)), lengths, height=0.6, **style)
    ax.bar_label(plotted, [bar.text for bar in bars], padding=4, fontsize=8, bbox=LETTERS["bbox"])
    ax.set(xlim=(0, 1.3 * max(lengths) or 1.0), ylim=(-0.6, len(bars) - 0.4))
    ax.locator_params(axis="x", nbins=4)


def _verdict_text(scheme: Scheme) -> str:
    """Return the text for an unstable scheme, and for the simulation of a nonlinear one."""
    if scheme.analysis is None:
        return scheme.verdict
    printed = [] if scheme.stable else ["unstable" if scheme.stable is False else "undecided"]
    printed += [] if scheme.simulated is None else [f"{scheme.simulated.summary.verdict} in time"]
    return ", ".join(printed)
