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

from apc.compiler.wording import counted, known_digits, with_unit, wrapped
from apc.output.formatting import (
    MEANT,
    Lines,
    Plain,
    headed,
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
from apc.output.pictures import COLOURS, MOST, new_figure, notes_below, prefixed
from apc.support.tables import Row, TableColumn, Tabled

if TYPE_CHECKING:
    from apc.studies.comparison import Scheme, SchemeComparison
    from apc.studies.critical_values import Critical

NONE = "–"
DIGITS = 6  # number of transparency values, at most

# The varied parameters, and the headings of their columns.
VARIED = ("stiffness", "delay", "loss")

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
    ("spectral radius per frame", "analysis.spectral_radius"),
    ("settling time, 2 % [s]", "analysis.settling_s"),
    ("impedance at 1 Hz [N·s/m]", "transparency.impedance.0"),
    ("impedance at 10 Hz [N·s/m]", "transparency.impedance.1"),
    ("operations per tick", "effort.operations"),
    ("numbers sent per second", "effort.sent"),
)
REACHES = (
    ("largest stable stiffness [N/m]", "stiffness", 1.0),
    ("largest stable delay [ms]", "delay", 1e3),
    ("largest stable loss [%]", "loss", 1e2),
)


def comparison_text(comparison: SchemeComparison) -> Lines:
    """Yield the output of `apc compare`: tables of stability, limits, impedance and cost, notes last."""
    schemes = comparison.schemes
    feet: dict[str, int] = {}
    yield f"Comparison of {counted(len(schemes), 'scheme')}"
    yield ""
    yield from table(
        [
            ("", "scheme", "peers"),
            *((str(index), scheme.topology, f"{scheme.peers:,}") for index, scheme in enumerate(schemes, 1)),
        ],
        "<<>",
    )
    verdicts = [_verdict(scheme, feet) for scheme in schemes]
    yield from _scheme_table("Stability", ("verdict", "radius per frame", "settling time"), verdicts)
    if any(scheme.linearized for scheme in schemes):
        rows = [_in_time(scheme, feet) for scheme in schemes]
        yield from _scheme_table("Simulation", ("verdict", "duration"), rows)
    limits = [
        (str(index), key, *_limit_cells(scheme, key, feet))
        for key in VARIED
        for index, scheme in enumerate(schemes, 1)
    ]
    yield from headed("Stability limits", table([("", "limit of", "stable up to", "parameter"), *limits]))
    impedances = [_impedance_cells(scheme, feet) for scheme in schemes]
    yield from _scheme_table("Impedance", ("at 1 Hz", "at 10 Hz", "device"), impedances)
    headings = ("computation per tick", "sent per peer", "sent in total")
    yield from _scheme_table("Cost", headings, [_cost_cells(scheme) for scheme in schemes])
    texts = (*_meant(comparison), *comparison.limitations, *comparison.notes)
    if feet or texts:
        yield ""
    for text, number in feet.items():
        yield from wrapped(text, f"  [{number}] ", "      ")
    yield from notes(*texts)


def _scheme_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> Lines:
    """Yield a titled table with a row for each scheme, numbered."""
    numbered = [("", *headings), *((str(index), *row) for index, row in enumerate(rows, 1))]
    return headed(title, (line for line in table(numbered, later=5) if line))


def _marked(cell: str, texts: Iterable[str], feet: dict[str, int]) -> str:
    """Return a cell with the numbers of its footnotes, each text once: "– [1]"."""
    marks = [f"[{feet.setdefault(text, len(feet) + 1)}]" for text in texts if text]
    return " ".join([cell, *marks])


def _cost_cells(scheme: Scheme) -> tuple[str, ...]:
    """Return the operations per tick, and the numbers sent per second by one peer and by all peers."""
    effort = scheme.effort
    clock = f" of {effort.clock}" if effort.clock else ""
    sent = (f"{number:,.6g} numbers/s" for number in (effort.sent, effort.sent_by_all))
    return f"{counted(effort.operations, 'operation', ',d')}{clock}", *sent


def _meant(comparison: SchemeComparison) -> Iterator[str]:
    """Yield the stability criterion, if it is not the decay of motions."""
    if any(scheme.passive for scheme in comparison.schemes):
        yield MEANT["passive"]
    elif any(reached(scheme, f"{key}.criterion") in MEANT for scheme in comparison.schemes for key in VARIED):
        yield "criterion for unreliable links: mean-square stability over the lossy network"


def _why(scheme: Scheme, key: str) -> tuple[str, ...]:
    """Return the reasons why a result of a scheme is missing, empty if it is there."""
    return tuple(text for name, text in scheme.missing if name == key)


def _verdict(scheme: Scheme, feet: dict[str, int]) -> tuple[str, str, str]:
    """Return the verdict, the spectral radius with its footnotes, and the settling time."""
    if scheme.analysis is None:
        return scheme.verdict, _marked(NONE, [scheme.refused], feet), NONE
    texts = list(_why(scheme, "verdict"))
    if scheme.network is not None and scheme.network.mean_square_radius is not None:
        root, error = math.sqrt(scheme.network.mean_square_radius), scheme.network.error or 0.0
        grown = radius_text(root, error / (2 * root) if root else error)
        texts.append(
            "spectral radius and settling time are those of the nominal network; the square root of the "
            f"second-moment growth is {grown} per frame"
        )
    if scheme.passive is not None:
        texts.append("the spectral radius is that with free devices")
    verdict = scheme.verdict + (", linearized" if scheme.analysis.linearized else "")
    analysis = scheme.analysis
    radius = radius_text(analysis.spectral_radius, analysis.spectral_radius_error, analysis.radius_excess)
    settling = NONE if analysis.settling_s is None else quantity(analysis.settling_s, "s", 3)
    return verdict, _marked(radius, texts, feet), settling


def _in_time(scheme: Scheme, feet: dict[str, int]) -> tuple[str, str]:
    """Return the verdict of a simulation, where that of an analysis is of a linearization."""
    if scheme.analysis is None:
        return NONE, NONE
    if not scheme.linearized:
        return "not required: the topology is linear", ""
    if scheme.simulated is None:
        return _marked(NONE, _why(scheme, "simulated"), feet), NONE
    summary = scheme.simulated.summary
    text = str(summary.verdict)
    if summary.settled is not None:
        text += f", settling time {summary.settled:.3g} s"
    elif summary.stopped_at is not None:
        text += f" at {summary.stopped_at:.3g} s"
    return text, f"{summary.end:g} s"


def _limit_cells(scheme: Scheme, key: str, feet: dict[str, int]) -> tuple[str, str]:
    """Return how far a scheme is stable in the parameter `key` of `VARIED`, and that parameter's name."""
    critical: Critical | None = getattr(scheme, key)
    if critical is None:
        return _marked(NONE, _why(scheme, key), feet), NONE
    remarks = []
    if len(critical.crossings) > 1:
        remarks.append(
            f"{counted(len(critical.crossings), 'critical value')}: apc critical {critical.parameter}"
        )
    if critical.groups:
        remarks.append("varied as one value for all groups, whose values differ")
    return _marked(_critical_text(critical), remarks, feet), critical.parameter


def _critical_text(critical: Critical) -> str:
    """Return in words how far a model is stable."""
    if critical.value is None:
        assert critical.verdict is not None
        if not critical.has_effect:
            return f"{critical.verdict.word} at every value"
        if critical.verdict.stable:
            return f"no limit up to {quantity(critical.searched_to[1], critical.unit)}"
        return f"{critical.verdict.word} at {span(*critical.searched_to, critical.unit)}"
    value = uncertain(critical.value, critical.error or 0.0, critical.unit).removesuffix(", exact")
    return value if critical.stable_side == "below" else f"{value} (stable above)"


def _impedance_cells(scheme: Scheme, feet: dict[str, int]) -> tuple[str, str, str]:
    """Return the impedances at 1 Hz and 10 Hz as magnitude and angle, and the device.

    A missing result is a dash with a footnote; `feet` are the numbers of the footnotes by their texts.
    """
    if scheme.transparency is None:
        return _marked(NONE, _why(scheme, "transparency"), feet), NONE, NONE
    cells = []
    for value, bound in zip(
        scheme.transparency.impedance.tolist(), scheme.transparency.bound.tolist(), strict=True
    ):
        # The bound is relative.
        magnitude = known_digits(abs(value), abs(value) * bound, DIGITS)
        cells.append(f"{magnitude} N*s/m, {np.degrees(np.angle(value)):.2f}°")
    return cells[0], cells[1], scheme.transparency.at


def comparison_document(comparison: SchemeComparison) -> Plain:
    """Return the same as plain data, in SI: each part as the JSON of its command."""
    return {"schemes": [_document(scheme) for scheme in comparison.schemes], "notes": list(comparison.notes)}


def _document(scheme: Scheme) -> Plain:
    """Return the results of a scheme as plain data."""
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
    (TableColumn("impedance at", kind="text"), "transparency.at"),
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
    keys = {title: key for title, key, _ in REACHES}
    empty = [title for title, bars in panels if all(bar.text == NONE for bar in bars)]
    panels = [(title, bars) for title, bars in panels if title not in empty] or panels[:1]
    columns = min(ABREAST, len(panels))
    rows = -(-len(panels) // columns)
    names = [
        "\n".join(textwrap.wrap(f"{index}  {scheme.topology}", LABEL))
        for index, scheme in enumerate(schemes, 1)
    ]
    size = (PANEL * columns + 1.4, (0.9 + BAR * 1.25 * len(names)) * rows + 0.5)
    figure = new_figure(size)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for ax, (title, bars) in zip(axes, panels, strict=False):
        _draw(ax, title, bars, BOUNDARY if title == NUMBERS[0][0] else 0.0)
    for ax in axes[len(panels) :]:
        ax.set_axis_off()
    axes[0].set_yticks(range(len(names)), names, fontsize=8)
    axes[0].invert_yaxis()
    for index, scheme in enumerate(schemes):
        axes[0].annotate(_verdict_text(scheme), (0, index), (4, 0), **LETTERS)
    notes_below(
        figure,
        [
            *comparison.limitations,
            *comparison.notes,
            *(
                f"No panel for {title.partition(' [')[0]}: {_why_empty(schemes, keys[title])}"
                for title in empty
                if title in keys
            ),
        ],
    )
    return figure


def _why_empty(schemes: Sequence[Scheme], key: str) -> str:
    """Return the reasons why no scheme has a varied quantity, each once."""
    return "; ".join(dict.fromkeys(text for scheme in schemes for text in _why(scheme, key))) or "no result"


def _number(value: complex | None) -> _Bar:
    return _Bar(0.0, NONE) if value is None else _Bar(abs(value), f"{abs(value):.4g}")


def _reach_bar(critical: Critical | None, scale: float) -> _Bar:
    """Return the stable range of a scheme: up to a crossing, or beyond the searched range."""
    if critical is not None and critical.value is not None and critical.stable_side == "below":
        return _Bar(scale * critical.value, _readable(scale * critical.value, scale))
    verdict = None if critical is None else critical.verdict
    if critical is not None and verdict is not None and verdict.stable:
        end = scale * critical.searched_to[1]
        return _Bar(end, f"> {_readable(end, scale)}", further=True)
    return _Bar(0.0, verdict.word if verdict is not None and verdict.stable is False else NONE)


def _readable(number: float, scale: float) -> str:
    """Return a number in the unit of its panel; a large stiffness with its own unit."""
    factor, unit = prefixed(number, "N/m") if scale == 1 and number > MOST else (1.0, "1")
    return with_unit(f"{number * factor:.4g}", unit)


def _draw(ax: Any, title: str, bars: Sequence[_Bar], boundary: float) -> None:
    """Draw one quantity of all schemes, with a line at a boundary above 0, left of all numbers."""
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
    ax.barh(range(len(bars)), lengths, height=0.6, **style)
    if boundary:
        ax.axvline(boundary, color="0.4", linewidth=0.8, linestyle=(0, (3, 2)))
    for index, (bar, length) in enumerate(zip(bars, lengths, strict=True)):
        ax.annotate(bar.text, (max(length, boundary), index), (4, 0), **LETTERS)
    ax.set(xlim=(0, 1.4 * max([*lengths, boundary]) or 1.0), ylim=(-0.6, len(bars) - 0.4))
    ax.locator_params(axis="x", nbins=4)


def _verdict_text(scheme: Scheme) -> str:
    """Return the text for an unstable scheme, and for the simulation of a nonlinear one."""
    if scheme.analysis is None:
        return scheme.verdict
    printed = [] if scheme.stable else ["unstable" if scheme.stable is False else "undecided"]
    printed += [] if scheme.simulated is None else [f"{scheme.simulated.summary.verdict} in time"]
    return ", ".join(printed)
