"""Texts of C, XML and Python from the templates beside this module, by Jinja2.

Takes: the name of a template, what it is of. Gives: `filled`; `number`, `quoted`.
Guarantees: a number is read as the very same double; nothing in a comment ends it; a name that a template
has and nobody gave is an error.
Does not: know what a text means.

A line of a template that begins with % is a statement of Jinja2, ${…} is an expression, and all else is
the text.
"""

from __future__ import annotations

import functools
import json
import math
import textwrap
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

from jinja2 import Environment, FileSystemLoader, StrictUndefined


def filled(file: str, /, **values: object) -> str:
    """Return the text of a template with values in the place of its names."""
    return _templates().get_template(file).render(values)


@functools.cache
def _templates() -> Environment:
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        variable_start_string="${",
        variable_end_string="}",
        line_statement_prefix="%",
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        autoescape=False,  # no text of it is read by a browser
    )
    made.filters |= {"number": number, "comment": comment, "row": row, "members": _members}
    made.filters |= {"attribute": quoteattr, "json": json.dumps, "fill": textwrap.fill, "quotable": quotable}
    made.filters |= {"line": line_of, "quoted": quoted}
    return made


def number(value: float) -> str:
    """Return a number such that a compiler reads the very same double."""
    text = "INFINITY" if math.isinf(value) else repr(float(value))
    return f"({text})" if text.startswith("-") else text


def row(values: Iterable[Any]) -> str:
    """Return what stands between the braces of an array, which has at least one entry."""
    return ", ".join(number(value) if isinstance(value, float) else str(value) for value in values) or "0"


def comment(text: str) -> str:
    """Return a text that can stand in a comment of C."""
    shown = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    return shown.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def line_of(text: str) -> str:
    """Return a text on one line."""
    return "".join(item if item.isprintable() else " " for item in text)


def quoted(text: str) -> str:
    """Return a text as Modelica writes it."""
    escaped = line_of(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def quotable(text: str) -> str:
    """Return a text that can't end the text of Python it stands in."""
    return text.replace("\\", "/").replace('"', "'")


def _members(text: str) -> str:
    """Return the members of a structure of C, given as lines `declaration | what it is`."""
    rows = [line.split(" | ", 1) for line in text.strip("\n").split("\n") if line]
    rows = rows or [["char none", "nothing"]]
    width = max(len(declared) for declared, _ in rows) + 1
    return "".join(f"  {declared + ';':<{width}} /* {comment(what)} */\n" for declared, what in rows)
