"""Common functions of pictures: formats, and writing of figures.

Takes: a matplotlib Figure and a path.
Gives: `COLOURS`, `LINES`, `colours_of`, `new_figure`, `legend_below`, `short_legend`, `notes_below`,
`prefixed`, `scale_ticks`; `FORMATS`, `RESULTS`, `check_picture`, `write_figure`, `write_picture`,
`write_result`, `table_of`, `svg_text`, `svg_image`, `html_of`.
Guarantees: the same figure gives the same bytes; a file is there whole or not at all; text in an SVG is text.
Does not: draw, or need a display.

matplotlib is loaded when something is drawn and not before.
"""

from __future__ import annotations

import base64
import io
import re
import textwrap
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from apc.compiler.errors import ApcError
from apc.compiler.files import check_target, write_file, write_text
from apc.compiler.timings import part
from apc.output.formatting import capitalized, json_text
from apc.parameter_values.display_units import as_shown
from apc.support.distribution import program_version
from apc.support.optional import need
from apc.support.suffixes import check_suffix
from apc.support.tables import SUFFIXES, blocks_of, check_table_path, write_table

if TYPE_CHECKING:
    import pandas

    from apc.result import Result

FORMATS = (".png", ".svg", ".pdf")
RESULTS = (*SUFFIXES, ".json")  # what a result that has a picture can be written as, too
DPI = 150
MOST_ENTRIES = 6  # of a legend
NOTES = "notes"  # the group of the notes below a figure, which can be omitted
PREFIXES = {-6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}
LEAST, MOST = 0.5, 1e4  # largest number of an axis: its tick labels are then between 0.1 and 10,000
SVG = {"svg.hashsalt": "apc", "svg.fonttype": "none"}  # the same names inside it; text is text

# Colours distinct in print and for colour-blind eyes (Okabe and Ito, 2008), without the yellow, which white
# paper swallows; and lines. As 7 and 8 have no common divisor, the first 56 pairs of them all differ.
COLOURS = ("#000000", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
LINES: tuple[Any, ...] = (
    "-",
    (0, (5, 2)),
    (0, (5, 1.5, 1, 1.5)),
    (0, (1, 1.2)),
    (0, (8, 2, 1, 1, 1, 2)),
    (0, (2.5, 1)),
    (0, (10, 3)),
    (0, (5, 1, 5, 1, 1, 1)),
)


def new_figure(size: tuple[float, float]) -> Any:
    """Return an empty matplotlib Figure of a size in inches, with room for all its labels.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    return need("matplotlib.figure", "plot").Figure(figsize=size, layout="constrained")


def legend_below(ax: Any, index: float = -0.14, ncols: int = 2) -> None:
    """Put the legend below an Axes, over nothing; `index` is in heights of the Axes, from its lower edge."""
    style = {"ncols": ncols, "fontsize": 8, "frameon": False}
    handles, labels = short_legend(*ax.get_legend_handles_labels())
    ax.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, index), **style)


def short_legend(handles: Sequence[Any], labels: Sequence[str], of: int = 0) -> tuple[list[Any], list[str]]:
    """Return the first entries of a legend, and an entry with the number of the others, of `of` in all."""
    left = max(len(labels), of) - MOST_ENTRIES
    if left <= 0:
        return list(handles), list(labels)
    empty = need("matplotlib.lines", "plot").Line2D([], [], linestyle="none")
    return [*handles[:MOST_ENTRIES], empty], [*labels[:MOST_ENTRIES], f"... and {left} more"]


def notes_below(figure: Any, texts: Sequence[str]) -> None:
    """Put notes below all panels of a figure, each once, wrapped to its width."""
    letters = int(13 * figure.get_figwidth())
    sentences = [capitalized(text) for text in dict.fromkeys(texts)]
    lines = [line for text in sentences for line in textwrap.wrap(text, letters)]
    if lines:
        style = {"x": 0.01, "ha": "left", "fontsize": 7.5, "color": "0.3", "gid": NOTES}
        figure.supxlabel("\n".join(lines), **style)


def prefixed(largest: float, unit: str) -> tuple[float, str]:
    """Return the factor from SI to the unit of an axis, and that unit.

    The unit is that of the topology, or the SI unit with a prefix, such that `largest`, the largest magnitude
    on the axis, is at most 10,000 and its tick labels are not below 0.1.
    """
    exact, shown = as_shown(largest, unit)
    factor = float(exact)
    if not largest or LEAST <= largest * factor <= MOST or shown in ("1", "%"):
        return factor, shown
    base, size = (("g", 1e3) if unit.startswith("kg") else (unit[:1], 1.0)) if unit else ("", 1.0)
    if not base.isalpha():
        return factor, shown
    fitting = [power for power in PREFIXES if LEAST <= largest * size / 10.0**power <= MOST]
    if not fitting:
        return factor, shown
    power = min(fitting, key=abs)
    rest = unit[2:] if unit.startswith("kg") else unit[1:]
    return size / 10.0**power, f"{PREFIXES[power]}{base}{rest}"


def scale_ticks(axis: Any, low: float, high: float, factor: float) -> None:
    """Label an axis of data in SI, from `low` to `high`, in a unit that is `factor` times as many."""
    ticker = need("matplotlib.ticker", "plot")
    values = ticker.MaxNLocator(6, steps=[1, 2, 2.5, 5, 10]).tick_values(low * factor, high * factor) / factor
    margin = (high - low) * 1e-9
    axis.set_major_locator(ticker.FixedLocator([v for v in values if low - margin <= v <= high + margin]))
    axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value * factor:.6g}"))


def colours_of(count: int) -> list[Any]:
    """Return `count` different colors: the first ten of the style sheet, or a rainbow's."""
    if count <= 10:
        return [f"C{index}" for index in range(count)]
    rainbow = need("matplotlib", "plot").colormaps["turbo"]
    return [rainbow(0.03 + 0.94 * index / (count - 1)) for index in range(count)]


def check_picture(path: Path, option: str = "--plot", more: Sequence[str] = ()) -> str:
    """Refuse a file that is not a picture, or has a suffix of `more`; return its suffix.

    Raises
    ------
    ApcError
        E601 the place, E878 the suffix, E887 or E875 a library that is missing.
    """
    check_target(path)
    suffix = check_suffix(path, (*FORMATS, *more), option)
    if suffix in SUFFIXES:
        check_table_path(path, option)
    if suffix in FORMATS:
        need("matplotlib", "plot")
    return suffix


def svg_text(figure: Any) -> str:
    """Return a matplotlib Figure as an SVG element, for a page."""
    matplotlib = need("matplotlib", "plot")
    canvas, written = need("matplotlib.backends.backend_svg", "plot").FigureCanvasSVG(figure), io.StringIO()
    with matplotlib.rc_context(SVG):  # `savefig` draws a figure a second time to arrange it
        canvas.print_svg(written, metadata={"Date": None, "Creator": None})
    plotted = written.getvalue()
    return re.sub(r"<metadata>.*?</metadata>", "", plotted[plotted.index("<svg") :], flags=re.DOTALL)


def svg_image(figure: Any, title: str) -> str:
    """Return a matplotlib Figure as an image of a page, so that no name in it meets one outside."""
    image = base64.b64encode(svg_text(figure).encode("utf-8")).decode("ascii")
    return f'<img alt="{escape(title)}" src="data:image/svg+xml;base64,{image}">'


@part("draw")
def write_picture(draw: Callable[[], Any], path: Path) -> None:
    """Write a matplotlib Figure, or the Figure of an Axes, as `write_figure` does."""
    write_figure(draw().figure, path)


def write_figure(figure: Any, path: Path) -> None:
    """Write a matplotlib Figure, its format chosen by the suffix; the same figure gives the same bytes."""
    matplotlib = need("matplotlib", "plot")
    date = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}  # none in the file
    suffix = check_suffix(path, FORMATS, "--plot")

    def write(temporary: Path) -> None:
        with matplotlib.rc_context(SVG):
            figure.savefig(temporary, format=suffix[1:], dpi=DPI, metadata=date.get(suffix))

    write_file(path, write)


def write_result(path: Path, result: Result, draw: Callable[[], Any]) -> None:
    """Write a result as a picture, a table or JSON, by the suffix.

    Parameters
    ----------
    path
        The file.
    result
        The result; its table is made of the `rows` that its module has: see `table_of`.
    draw
        Makes its picture, a matplotlib Figure or Axes.

    Raises
    ------
    ApcError
        As `check_picture`.
    """
    suffix = check_picture(path, "--out", RESULTS)
    if suffix in FORMATS:
        write_picture(draw, path)
    elif suffix in SUFFIXES:
        columns, cells, made = result._shown("rows")
        write_table(path, columns, blocks_of(cells), {"apc": program_version(), **made})
    else:
        write_text(path, json_text(result.to_dict()))


def table_of(result: Result) -> pandas.DataFrame:
    """Return the rows of a result as a pandas table.

    `NAME_rows` in the result's module gives its columns, its rows, and the provenance for a file.
    """
    columns, rows, _ = result._shown("rows")
    return need("pandas", "data").DataFrame(list(rows), columns=[column.heading for column in columns])


def html_of(result: Any) -> str:
    """Return a result for a notebook: its text, and its picture as an image where matplotlib is there."""
    text = f"<pre>{escape(str(result))}</pre>"
    if not (result.pictured and hasattr(result, "plot")):
        return text
    try:
        return text + svg_image(result.plot().figure, repr(result))
    except ApcError:
        return text
