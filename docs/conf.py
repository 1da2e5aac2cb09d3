"""Configuration of the manual: `python -m sphinx docs docs/_build/html` builds it, without a network."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
from generate import write_pages
from sphinx.application import Sphinx

import apc

project = "apc"
author = "the apc authors"
copyright = "2026, the apc authors"
version = release = apc.__version__
extensions = [
    "myst_nb",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx_click",
    "sphinx-mathjax-offline",
    "sphinxcontrib.bibtex",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = "apc"
html_static_path = ["_static"]
html_css_files = ["manual.css"]
html_theme_options = {"top_of_page_buttons": []}
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # notebooks have stored outputs, which the tests compare
numpydoc_show_class_members = False
numpydoc_xref_param_type = False
autodoc_typehints = "none"
autodoc_member_order = "bysource"
bibtex_bibfiles = ["sources.bib"]
bibtex_default_style = "unsrt"
suppress_warnings = ["mystnb.unknown_mime_type"]


def escape_asterisks(_app: object, _context: object, lines: list[str]) -> None:
    """Escape the asterisks of units in help texts, such as N*s/m; reStructuredText reads emphasis."""
    lines[:] = [line.replace("*", r"\*") for line in lines]


def setup(app: Sphinx) -> None:
    """Connect the handlers of events."""
    for part in ("description", "options", "arguments", "epilog"):
        app.connect(f"sphinx-click-process-{part}", escape_asterisks)


write_pages(Path(__file__).parent)
