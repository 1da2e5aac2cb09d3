"""HTML pages by Jinja: `page.html` is the common frame, `report.html` and `gallery.html` the contents.

Takes: the name of a template and its contents.
Gives: `page`, `inert`; `gallery_page` of topologies: pictures as of `apc show`, verdicts as of `apc analyze`.
Guarantees: a page loads no resources; inserted values are escaped text, except for pictures and JSON.
Does not: write it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from apc.analysis_report import answer
from apc.compiler.view.diagram import diagram_of
from apc.output.graph import graph_picture
from apc.output.pictures import svg_image

_COMMENTS = re.compile(r"(^#.*\n)|[ \t]+#.*$", re.MULTILINE)


def page(template: str, **fields: Any) -> str:
    """Return a page; in its template `image(figure, title)` is a picture.

    Raises
    ------
    ApcError
        E875 matplotlib is not installed.
    """
    every = Environment(loader=PackageLoader("apc.output", ""), autoescape=True, undefined=StrictUndefined)
    return every.get_template(template).render(
        **fields, image=lambda figure, title: Markup(svg_image(figure, title))
    )


def inert(text: str) -> Markup:
    """Return JSON that is safe within a page: it contains no tags."""
    return Markup(text.replace("<", "\\u003c"))


def gallery_page(topologies: Sequence[Path]) -> str:
    """Return a page of models in a row.

    Parameters
    ----------
    topologies
        Their files.

    Raises
    ------
    ApcError
        Their mistakes.
    """
    return page("gallery.html", topologies=[_topology(path) for path in topologies])


def _topology(path: Path) -> dict[str, Any]:
    """Return the page's text for a model."""
    from apc.compiler.pipeline import compile_topology  # it imports algebra, which a report does not need

    model = compile_topology(path)
    return {
        "name": path.stem,
        "description": model.description,
        "figure": graph_picture(diagram_of(path)),
        "verdict": str(answer(model, margins=False)).partition("\n\n")[0],
        "text": _COMMENTS.sub("", path.read_text(encoding="utf-8")),
    }
