"""A result in a notebook: its text, and its picture where it has one.

Takes: a `Result`. Gives: `html_of`.
Guarantees: what a scene says is text and never markup; without matplotlib the text alone is shown.
Does not: compute, or need a notebook.
"""

from __future__ import annotations

from html import escape
from typing import Any

from apc.compiler.errors import ApcError
from apc.present.pictures import svg_image


def html_of(found: Any) -> str:
    """Return a result as HTML: its text, and its picture as an image."""
    text = f"<pre>{escape(str(found))}</pre>"
    if not (found.pictured and hasattr(found, "plot")):
        return text
    try:
        return text + svg_image(found.plot().figure, repr(found))
    except ApcError:
        return text
