"""A page of scenes: what each is, its picture, its topology and its verdict.

Takes: topology files. Gives: `gallery_page`.
Guarantees: one HTML document that loads nothing; pictures as of `apc show`, verdicts as of `apc analyze`.
Does not: write it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from apc.answer import answer
from apc.compiler.pipeline import compile_topology
from apc.compiler.view.listing import diagram_of
from apc.present.graph import graph_picture
from apc.present.pages import page

_COMMENTS = re.compile(r"(^#.*\n)|[ \t]+#.*$", re.MULTILINE)


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
