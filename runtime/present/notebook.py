"""A result in a notebook: its text, and its picture where it has one.

Takes: a `Result`. Gives: `html_of`.
Guarantees: what a scene says is text and never markup; without matplotlib the text alone is shown.
Does not: compute, or need a notebook.
"""

from __future__ import annotations

import base64
from html import escape
from typing import Any

from apc.compiler.errors import ApcError
from apc.present.pictures import svg_text


def html_of(found: Any) -> str:
    """Return a result as HTML; a picture is an image of its own, so that no name in it meets another's."""
    text = f"<pre>{escape(str(found))}</pre>"
    if not (found.pictured and hasattr(found, "plot")):
        return text
    try:
        drawn = svg_text(found.plot().figure)
    except ApcError:
        return text
    image = base64.b64encode(drawn.encode("utf-8")).decode("ascii")
    return f'{text}<img alt="{escape(repr(found))}" src="data:image/svg+xml;base64,{image}">'
