"""A page of scenes: what each is, its picture, its topology and its verdict.

Takes: topology files. Gives: `gallery_page`.
Guarantees: one HTML document that loads nothing; pictures as of `apc show`, verdicts as of `apc analyze`.
Does not: write it.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from pathlib import Path

from apc.answer import answer
from apc.compiler.pipeline import compile_topology
from apc.compiler.view.listing import diagram_of
from apc.present.graph import graph_picture
from apc.present.pictures import svg_image
from apc.present.report import POLICY, STYLE

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
    links = "".join(f'<a href="#{path.stem}">{escape(path.stem)}</a> ' for path in topologies)
    return "\n".join(
        [
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">',
            f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
            '<meta name="viewport" content="width=device-width, initial-scale=1">',
            f"<title>Scenes of apc</title><style>{STYLE}</style></head><body>",
            "<header><h1>Scenes of apc</h1><p>A scene is copied by <code>apc new --like NAME</code>.</p>",
            f"<nav>{links}</nav></header><main>",
            *map(_scene, topologies),
            "</main></body></html>",
        ]
    )


def _scene(path: Path) -> str:
    """Return the section of a scene."""
    diagram, system = diagram_of(path), compile_topology(path)
    verdict = str(answer(system, margins=False)).partition("\n\n")[0]
    text = _COMMENTS.sub("", path.read_text(encoding="utf-8"))
    return (
        f'<section id="{path.stem}"><h2>{escape(path.stem)}</h2><p>{escape(system.about)}</p>'
        f"<figure>{svg_image(graph_picture(diagram), system.name)}</figure>"
        f"<pre>{escape(verdict)}</pre><pre>{escape(text)}</pre></section>"
    )
