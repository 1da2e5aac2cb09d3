"""Texts of C, XML and Python from the templates in this folder, by Jinja2.

Takes: the name of a template, its data. Gives: `filled`; `number`, `quoted`.
Guarantees: numbers round-trip to the same double. No text ends a comment early. An undefined name in a
template is an error.
Does not: interpret texts.

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
    """Return the text of a template with its names replaced by values."""
    return _templates().get_template(file).render(values)


@functools.cache
def _templates() -> Environment:
    """Return the environment of Jinja2 with this folder's templates and filters, cached."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        variable_start_string="${",
        variable_end_string="}",
        line_statement_prefix="%",
        keep_trailing_newline=True,
        undefined=StrictUndefined,
        autoescape=False,  # the texts are not HTML
    )
    environment.filters |= {"number": number, "comment": comment, "row": row, "members": _members}
    environment.filters |= {
        "attribute": quoteattr,
        "json": json.dumps,
        "fill": textwrap.fill,
        "quotable": quotable,
    }
    environment.filters |= {"line": line_of, "quoted": quoted}
    return environment


def number(value: float) -> str:
    """Return the text of a number that a C compiler reads as the same double."""
    text = "INFINITY" if math.isinf(value) else repr(float(value))
    return f"({text})" if text.startswith("-") else text


def row(values: Iterable[Any]) -> str:
    """Return the elements of an array initializer, with at least one entry."""
    return ", ".join(number(value) if isinstance(value, float) else str(value) for value in values) or "0"


def comment(text: str) -> str:
    """Return a text that is safe within a C comment."""
    shown = "".join(c if c.isascii() and c.isprintable() else "?" for c in text)
    return shown.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")


def line_of(text: str) -> str:
    """Return a text on one line, with a space for each unprintable character."""
    return "".join(item if item.isprintable() else " " for item in text)


def quoted(text: str) -> str:
    """Return a text as a string literal of Modelica."""
    escaped = line_of(text).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


def quotable(text: str) -> str:
    """Return a text that is safe within a Python string literal."""
    return text.replace("\\", "/").replace('"', "'")


def _members(text: str) -> str:
    """Return the members of a C structure, given as lines `declaration | description`."""
    rows = [line.split(" | ", 1) for line in text.strip("\n").split("\n") if line]
    rows = rows or [["char none", "nothing"]]
    width = max(len(declared) for declared, _ in rows) + 1
    return "".join(f"  {declared + ';':<{width}} /* {comment(subject)} */\n" for declared, subject in rows)
