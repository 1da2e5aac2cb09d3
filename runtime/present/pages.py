"""Pages of HTML, filled in by Jinja: `page.html` is what all have, `report.html` and `gallery.html` the rest.

Takes: the name of a template and what stands in it.
Gives: `page`, `inert`.
Guarantees: a page loads nothing; what is put into it is text and never markup, but for pictures and JSON.
Does not: write it.
"""

from __future__ import annotations

from typing import Any

from apc.optional import need
from apc.present.pictures import svg_image


def page(template: str, **told: Any) -> str:
    """Return a page; in its template `image(figure, title)` is a picture.

    Raises
    ------
    ApcError
        E875 Jinja or matplotlib is not installed.
    """
    jinja = need("jinja2", "plot")
    markup = need("markupsafe", "plot").Markup
    every = jinja.Environment(
        loader=jinja.PackageLoader("apc.present", ""), autoescape=True, undefined=jinja.StrictUndefined
    )
    filled: str = every.get_template(template).render(
        **told, image=lambda figure, title: markup(svg_image(figure, title))
    )
    return filled


def inert(text: str) -> Any:
    """Return JSON that stands in a page as it is: no tag begins in it."""
    return need("markupsafe", "plot").Markup(text.replace("<", "\\u003c"))
