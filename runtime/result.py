"""The base class of results: data for further computation, with functions for output.

Takes: nothing. Gives: `Result`, `PlotStyle`.
Guarantees: a result has only the name of its output functions, which are imported on first use. In a
notebook a result is shown as its text and picture, elsewhere as one line.
Does not: format output (see `output`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, ClassVar, TypedDict

from apc.support.optional import need


class PlotStyle(TypedDict, total=False):
    """The style of a picture: `size` (width, height) in inches, `labels`, `style`, `notes`.

    `labels` replaces texts of the picture; `style` is a style sheet of matplotlib, several, or settings by
    name; `notes` states whether notes are printed below the figure (default: true).
    """

    size: tuple[float, float]
    labels: Mapping[str, str]
    style: str | Sequence[str] | Mapping[str, Any]
    notes: bool


class Result:
    """A result (abstract base class).

    The module in `shown_by`, of `apc.output` or by its full name, has a function for each form of output,
    such as `critical_text`, which yields lines, and `critical_picture`. The document is made of the fields
    (`formatting.record`), unless there is a function such as `critical_document`.
    """

    __slots__ = ()
    shown_by: ClassVar[str]
    pictured: ClassVar[bool] = True  # whether a notebook shows the picture, if there is one

    def __init_subclass__(cls) -> None:
        """Set the short repr of every result, as `dataclass` does not replace an existing one."""
        if "__repr__" not in vars(cls):
            cls.__repr__ = Result.__repr__  # type: ignore[method-assign]

    def __repr__(self) -> str:
        """Return a one-line representation: the type, and the start of the text."""
        first = next((line.strip() for line in str(self).splitlines() if line.strip()), "")
        return f"<{type(self).__name__} {first}>"

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        """Return the representations for a notebook: the text, and as HTML the text with its picture."""
        html: str = import_module("apc.output.pictures").html_of(self)
        return {"text/plain": str(self), "text/html": html}

    def __str__(self) -> str:
        """Return the result as text of at most 80 columns."""
        return "\n".join(self._shown("text")).rstrip()

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data, ready for JSON."""
        document: dict[str, Any] = self._shown("document")
        return document

    def _plotted(self, *arguments: Any, style: PlotStyle) -> Any:
        """Return the picture in the given style, a matplotlib Figure or Axes."""
        if not style:  # a search of all texts takes as long as to draw them
            return self._shown("picture", *arguments)
        written, labels = need("matplotlib.text", "plot").Text, style.get("labels", {})
        with need("matplotlib.style", "plot").context(style.get("style", [])):
            plotted = self._shown("picture", *arguments)
        if "size" in style:
            plotted.figure.set_size_inches(*style["size"])
        for text in plotted.figure.findobj(written):
            hidden = text.get_gid() == "notes" and not style.get("notes", True)
            text.set_text("" if hidden else labels.get(text.get_text(), text.get_text()))
        return plotted

    def _shown(self, form: str, *arguments: Any) -> Any:
        """Return the result in a form of output: "text", "picture", "document" or "table".

        It is made by the function of `shown_by` for this form. Without such a function, a document is made of
        the fields, and a table of `rows` (see `pictures.table_of`).
        """
        module, _, name = self.shown_by.partition(":")
        output_module: Any = import_module(module if "." in module else f"apc.output.{module}")
        if hasattr(output_module, f"{name}_{form}"):
            return getattr(output_module, f"{name}_{form}")(self, *arguments)
        default_module, default_function = {
            "document": ("formatting", "record"),
            "table": ("pictures", "table_of"),
        }[form]
        return getattr(import_module(f"apc.output.{default_module}"), default_function)(self)
