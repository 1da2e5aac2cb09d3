"""What PyYAML complains of, in our words: one sentence at the place that has to change.

Takes: an error of either of PyYAML's parsers, and the lines of the text. Gives: `not_yaml`, a `Mistake`.
Guarantees: E109, whatever the error; the text of PyYAML where we have no better one.
Does not: read YAML.
"""

from __future__ import annotations

import re

import yaml

from apc.compiler.errors import Mistake, Place
from apc.compiler.source.nodes import Lines

# Part of PyYAML's problem, or of what it was doing, in either of its two parsers -> our sentence and hint.
_PROBLEMS: tuple[tuple[str, str, str], ...] = (
    ("unexpected end of stream", "this quote is never closed", ""),
    (
        "quoted scalar",
        "this quoted text is broken: a line starts in the wrong place or an escape is unknown",
        "",
    ),
    (
        "mapping values are not allowed",
        "a ': ' cannot stand here: the line above ends wrongly, or the text needs quotes",
        "key: 'text: with a colon'",
    ),
    (
        "<document start>",
        "this line belongs to nothing above it: its indent or a closing bracket is wrong",
        "",
    ),
    ("node content", "a value or a closing bracket is missing here", ""),
    ("could not find expected ':'", "this line is neither 'key: value' nor '- item'", "key: value"),
    ("expected ',' or '}'", "this { is never closed, or a comma is missing behind it", ""),
    ("expected ',' or ']'", "this [ is never closed, or a comma is missing behind it", ""),
    ("flow mapping", "this { is never closed, or a comma is missing behind it", ""),
    ("flow sequence", "this [ is never closed, or a comma is missing behind it", ""),
    ("block mapping", "this line is indented differently from the keys it belongs to", ""),
    ("block collection", "this line is indented differently from the items it belongs to", ""),
    ("block sequence", "this line is indented differently from the items it belongs to", ""),
)


# What a bracket stands behind in a text, and what it holds with the rest of the text.
_TEXT = re.compile(r"[^\s,:{}\[\]'\"][^,:{}\[\]'\"]*\Z")
_BRACKET = re.compile(r"[\[{][^{}\[\]]*[\]}][^,:{}\[\]]*")


def not_yaml(error: yaml.MarkedYAMLError, lines: Lines) -> Mistake:
    """Rewrite PyYAML's error as one sentence at the place that has to change."""
    mark = error.problem_mark or error.context_mark
    if mark is None:
        return Mistake("E109", Place(lines.file), f"this is not YAML: {error.problem}")
    place = lines.of(mark)
    rest = place.source_line[place.column - 1 :]
    indent = place.source_line[: len(place.source_line) - len(place.source_line.lstrip())]
    if "\t" in indent or rest.startswith("\t"):
        return Mistake("E109", place, "a tab indents this line, and YAML allows spaces only", hint="spaces")
    if "cannot start any token" in (error.problem or ""):
        quoted = f"'{rest.strip()[:40]}'"
        return Mistake("E109", place, f"a text starting with {rest[:1]} needs quotes", hint=quoted)
    told = f"{error.problem}; {error.context}"
    before = _TEXT.search(place.source_line[: place.column - 1])
    bracket = _BRACKET.match(rest)
    if before and bracket and "expected ','" in told:  # x[1], {1, 0} or chain[1:2] between { and }
        text = before[0] + bracket[0].rstrip()
        where = place.shifted(-len(before[0]))
        return Mistake("E109", where, f"a text with {rest[0]} in it needs quotes here", hint=f'"{text}"')
    for part, sentence, hint in _PROBLEMS:
        if part in told:
            opened = sentence.startswith("this ") and error.context_mark is not None
            where = lines.of(error.context_mark) if opened and "indented" not in sentence else place
            return Mistake("E109", where, sentence, hint=hint)
    return Mistake("E109", place, f"this is not YAML: {error.problem}")
