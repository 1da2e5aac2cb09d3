"""Pages of HTML, filled in by Jinja: `page.html` is what all have, `report.html` and `gallery.html` the rest.

Takes: the name of a template and what stands in it.
Gives: `page`, `inert`; `gallery_page` of topologies: pictures as of `apc show`, verdicts as of `apc analyze`.
Guarantees: a page loads nothing; what is put into it is text and never markup, but for pictures and JSON.
Does not: write it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from apc.answer import answer
from apc.compiler.pipeline import compile_topology
from apc.compiler.view.listing import diagram_of
from apc.present.graph import graph_picture
from apc.present.pictures import svg_image

_COMMENTS = re.compile(r"(^#.*\n)|[ \t]+#.*$", re.MULTILINE)


def page(template: str, **fields: Any) -> str:
    """Return a page; in its template `image(figure, title)` is a picture.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    every = Environment(loader=PackageLoader("apc.present", ""), autoescape=True, undefined=StrictUndefined)
    return every.get_template(template).render(
        **fields, image=lambda figure, title: Markup(svg_image(figure, title))
    )


def inert(text: str) -> Markup:
    """Return JSON that stands in a page as it is: no tag begins in it."""
    return Markup(text.replace("<", "\\u003c"))


def gallery_page(topologies: Sequence[Path]) -> str:
    """Return a page of scenes in a row.

    Parameters
    ----------
    topologies
        Their files.

    Raises
    ------
    ApcError
        Their mistakes.
    """
    return page("gallery.html", scenes=[_scene(path) for path in topologies])


def _scene(path: Path) -> dict[str, Any]:
    """Return what the page says of a scene."""
    system = compile_topology(path)
    return {
        "name": path.stem,
        "about": system.about,
        "figure": graph_picture(diagram_of(path)),
        "verdict": str(answer(system, margins=False)).partition("\n\n")[0],
        "text": _COMMENTS.sub("", path.read_text(encoding="utf-8")),
    }
