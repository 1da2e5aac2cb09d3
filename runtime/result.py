"""A result: data that other rooms compute with, and that a person can look at.

Takes: nothing. Gives: `Result`, `PlotStyle`.
Guarantees: data know the name of what shows them and nothing of it: it is imported when it is asked for. In a
notebook a result is its text and its picture, elsewhere a line.
Does not: show anything itself (see `output`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, ClassVar, TypedDict

from apc.optional import need


class PlotStyle(TypedDict, total=False):
    """The style of a picture: `size` (width, height) in inches, `labels`, `style`.

    `labels` replaces texts in it; `style` is a style sheet of matplotlib, several, or its settings by name.
    """

    size: tuple[float, float]
    labels: Mapping[str, str]
    style: str | Sequence[str] | Mapping[str, Any]


class Result:
    """A result, abstract.

    The module in `shown_by` has a function for each form of output, such as `critical_text`, which yields
    lines, and `critical_picture`. Its document is its fields (`formatting.record`), unless there is a
    `critical_document`.
    """

    __slots__ = ()
    shown_by: ClassVar[str]
    pictured: ClassVar[bool] = True  # in a notebook, where it has a picture

    def __init_subclass__(cls) -> None:
        """Give every result the short repr, which `dataclass` leaves to a class that has one."""
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
        """Return the picture, a matplotlib Figure or Axes, in the given style."""
        written, labels = need("matplotlib.text", "plot").Text, style.get("labels", {})
        with need("matplotlib.style", "plot").context(style.get("style", [])):
            plotted = self._shown("picture", *arguments)
        if "size" in style:
            plotted.figure.set_size_inches(*style["size"])
        for text in plotted.figure.findobj(written):
            text.set_text(labels.get(text.get_text(), text.get_text()))
        return plotted

    def _shown(self, form: str, *arguments: Any) -> Any:
        """Return the result in another form, as its module has it.

        Without one its document is made of its fields, and a table of its `rows`: see `pictures.table_of`.
        """
        module, _, name = self.shown_by.partition(":")
        forms: Any = import_module(f"apc.output.{module}")
        if hasattr(forms, f"{name}_{form}"):
            return getattr(forms, f"{name}_{form}")(self, *arguments)
        other, called = {"document": ("formatting", "record"), "table": ("pictures", "table_of")}[form]
        return getattr(import_module(f"apc.output.{other}"), called)(self)
