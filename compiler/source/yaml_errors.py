"""Errors of PyYAML in standard words: one sentence at the location of the error.

Takes: an error of either of PyYAML's parsers, and the lines of the text. Gives: `not_yaml`, a `Diagnostic`;
`with_colon`.
Guarantees: E109, whatever the error; the text of PyYAML where we have no better one.
Does not: read YAML.
"""

from __future__ import annotations

import re

import yaml

from apc.compiler.errors import Diagnostic, SourceLocation
from apc.compiler.source.nodes import Lines

NO_COLON = "a key stands here without its colon and a space"
AMONG_KEYS = "this line is an item of a list, and stands among keys"
# A key and its value, without a colon or the space after it.
_KEY_ONLY = re.compile(r"([A-Za-z]\w*)(?:\s*[=:]\s*|\s+)(\S.*)|([A-Za-z]\w*)")
_OPENED = re.compile(r"([A-Za-z]\w*)\s*\{")  # `device {mass: 1 kg`, whose bracket is part of a text

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
    ("could not find expected ':'", NO_COLON, ""),
    ("flow mapping", "this { is never closed, or a comma is missing behind it", ""),
    ("flow sequence", "this [ is never closed, or a comma is missing behind it", ""),
    ("block mapping", "this line is indented differently from the keys it belongs to", ""),
    ("block collection", "this line is indented differently from the items it belongs to", ""),
    ("block sequence", "this line is indented differently from the items it belongs to", ""),
)


# The problems whose place is that of the context: what is open, or broken, begins there.
_OF_CONTEXT = (
    "unexpected end of stream",
    "quoted scalar",
    "<document start>",
    "flow mapping",
    "flow sequence",
)

# A line that is a key with its value, which nothing can belong to.
_KEY_AND_VALUE = re.compile(r"[^\s:{}\[\]'\"]+: +[^\s|>&]")

# The text before a bracket, and its contents with the rest of the text.
_TEXT = re.compile(r"[^\s,:{}\[\]'\"][^,:{}\[\]'\"]*\Z")
_BRACKET = re.compile(r"[\[{][^{}\[\]]*[\]}][^,:{}\[\]]*")


def with_colon(text: str) -> str:
    """Return a line that lacks the colon behind its key as it was meant; an empty text if it has no key."""
    result = _KEY_ONLY.fullmatch(text.strip())
    if result is None:
        return ""
    return f"{result[1]}: {result[2]}" if result[1] else ""


def _line_above(line: int, lines: Lines) -> int:
    """Return the line above one that isn't empty or a comment, -1 if there is none."""
    above = line - 1
    while above >= 0 and (not lines.lines[above].strip() or lines.lines[above].lstrip().startswith("#")):
        above -= 1
    return above


def _without_colon(line: int, lines: Lines) -> Diagnostic | None:
    """Return the mistake of a line whose key has no colon; None if it has one."""
    text, location = _code(line, lines)
    match = _KEY_ONLY.fullmatch(text)
    if bracket := _OPENED.match(text):
        text = f"{bracket[1]} {text[bracket.end() - 1 :]}"
    elif match is None or ": " in text or text.endswith(":") or text.startswith("- "):
        return None
    return Diagnostic("E109", location, NO_COLON, hint=with_colon(text) or f"{text}:")


def _item_among_keys(line: int, lines: Lines) -> Diagnostic | None:
    """Return the error of a line that is a list item among keys; None otherwise."""
    text, location = _code(line, lines)
    return Diagnostic("E109", location, AMONG_KEYS, hint=text[2:].strip()) if text.startswith("- ") else None


def _indented_further(line: int, lines: Lines) -> Diagnostic | None:
    """Return the mistake of a line that is indented further than the one above, whose key has a value."""
    (text, location), (above, at) = (_code(number, lines) for number in (line, _line_above(line, lines)))
    if not (_KEY_AND_VALUE.match(text) and _KEY_AND_VALUE.match(above)) or location.column <= at.column:
        return None
    message = f"this line is indented by {location.column - 1} spaces, the one above it by {at.column - 1}"
    return Diagnostic("E109", location, message, hint=f"{' ' * (at.column - 1)}{text}")


def _code(line: int, lines: Lines) -> tuple[str, SourceLocation]:
    """Return a line without its indent and comment, and where it starts; an empty text where none is."""
    text = lines.lines[line].partition(" #")[0] if 0 <= line < len(lines.lines) else ""
    return text.strip(), lines.location(line, len(text) - len(text.lstrip()))


def not_yaml(error: yaml.MarkedYAMLError, lines: Lines) -> Diagnostic:
    """Rewrite PyYAML's error as one sentence at the place that has to change."""
    mark = error.problem_mark or error.context_mark
    assert mark is not None, error
    location = lines.of(mark)
    rest = location.source_line[location.column - 1 :]
    indent = location.source_line[: len(location.source_line) - len(location.source_line.lstrip())]
    if "\t" in indent or rest.startswith("\t"):
        return Diagnostic(
            "E109", location, "a tab indents this line, and YAML allows spaces only", hint="spaces"
        )
    if "cannot start any token" in (error.problem or ""):
        quoted = f"'{rest.strip()[:40]}'"
        return Diagnostic("E109", location, f"a text starting with {rest[:1]} needs quotes", hint=quoted)
    problem = f"{error.problem}; {error.context}"
    before = _TEXT.search(location.source_line[: location.column - 1])
    bracket = _BRACKET.match(rest)
    if before and bracket and "expected ','" in problem:  # x[1], {1, 0} or chain[1:2] between { and }
        text = before[0] + bracket[0].rstrip()
        where = location.shifted(-len(before[0]))
        return Diagnostic("E109", where, f"a text with {rest[0]} in it needs quotes here", hint=f'"{text}"')
    opening, above = (error.context_mark or mark).line, _line_above(mark.line, lines)
    slips = {
        "mapping values": (
            *((_without_colon, mark.line), (_without_colon, above)),
            (_indented_further, mark.line),
        ),
        "could not find expected ':'": ((_without_colon, opening),),
        "block": ((_item_among_keys, mark.line), (_item_among_keys, opening), (_without_colon, above)),
    }
    for part in slips:
        for slip, line in slips[part] if part in problem else ():
            if (mistake := slip(line, lines)) is not None:
                return mistake
    for part, sentence, hint in _PROBLEMS:
        if part in problem:
            if error.context_mark and part in _OF_CONTEXT:
                location = lines.of(error.context_mark)
            return Diagnostic("E109", location, sentence, hint=hint)
    return Diagnostic("E109", location, f"this is not YAML: {error.problem}")
