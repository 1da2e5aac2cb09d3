"""Errors of PyYAML in standard words: one sentence at the location of the error.

Takes: an error of either of PyYAML's parsers, and the lines of the text. Gives: `not_yaml`, a `Diagnostic`;
`with_colon`.
Guarantees: the code is always E109; the text is that of PyYAML if there is no better one.
Does not: read YAML.
"""

from __future__ import annotations

import re
from dataclasses import replace

import yaml

from apc.compiler.errors import Diagnostic, SourceLocation
from apc.compiler.source.nodes import Lines

NO_COLON = "expected a colon and a space after this key"
AMONG_KEYS = "expected a key of the mapping, got a list item (-)"
# A key and its value, without a colon or the space after it.
_KEY_ONLY = re.compile(r"([A-Za-z]\w*)(?:\s*[=:]\s*|\s+)(\S.*)|([A-Za-z]\w*)")
_OPENED = re.compile(
    r"([A-Za-z]\w*)\s*\{"
)  # `device {mass: 1 kg`, whose bracket YAML reads as part of a text

# Part of the problem or context of PyYAML's error, in either of its two parsers -> sentence and fix.
_PROBLEMS: tuple[tuple[str, str, str], ...] = (
    ("unexpected end of stream", "this quote is not closed", ""),
    (
        "quoted scalar",
        "invalid quoted text: wrong indentation of a line, or an unknown escape",
        "",
    ),
    (
        "mapping values are not allowed",
        "unexpected ': ': the line above is incomplete, or the text needs quotes",
        "key: 'text: with a colon'",
    ),
    (
        "<document start>",
        "unexpected line: wrong indentation, or an unmatched closing bracket",
        "",
    ),
    ("node content", "expected a value or a closing bracket", ""),
    ("could not find expected ':'", NO_COLON, ""),
    ("flow mapping", "this { is not closed, or a comma is missing after it", ""),
    ("flow sequence", "this [ is not closed, or a comma is missing after it", ""),
    ("block mapping", "this line is indented differently from the keys it belongs to", ""),
    ("block collection", "this line is indented differently from the items it belongs to", ""),
    ("block sequence", "this line is indented differently from the items it belongs to", ""),
)


# The problems located at the context: the start of the unclosed or broken item.
_OF_CONTEXT = (
    "unexpected end of stream",
    "quoted scalar",
    "<document start>",
    "flow mapping",
    "flow sequence",
)

# A line with a key and its value, which can have no subordinate lines.
_KEY_AND_VALUE = re.compile(r"[^\s:{}\[\]'\"]+: +[^\s|>&]")

# The last word of a text, which is behind a space.
_LAST_WORD = re.compile(r"(?<=\s)[A-Za-z]\w*(\.\w+)*\Z")

# The text before a bracket, and its contents with the rest of the text.
_TEXT = re.compile(r"[^\s,:{}\[\]'\"][^,:{}\[\]'\"]*\Z")
_BRACKET = re.compile(r"[\[{][^{}\[\]]*[\]}][^,:{}\[\]]*")


def with_colon(text: str) -> str:
    """Return a line with the missing colon after its key; empty if the line has no key."""
    result = _KEY_ONLY.fullmatch(text.strip())
    if result is None:
        return ""
    return f"{result[1]}: {result[2]}" if result[1] else ""


def _line_above(line: int, lines: Lines) -> int:
    """Return the index of the previous line that isn't empty or a comment, -1 if there is none."""
    above = line - 1
    while above >= 0 and (not lines.lines[above].strip() or lines.lines[above].lstrip().startswith("#")):
        above -= 1
    return above


def _missing_colon_error(line: int, lines: Lines) -> Diagnostic | None:
    """Return the error of a line whose key has no colon; None for other lines."""
    text, location = _without_comment(line, lines)
    match = _KEY_ONLY.fullmatch(text)
    if bracket := _OPENED.match(text):
        text = f"{bracket[1]} {text[bracket.end() - 1 :]}"
    elif match is None or ": " in text or text.endswith(":") or text.startswith("- "):
        return None
    return Diagnostic("E109", location, NO_COLON, fix=with_colon(text) or f"{text}:")


def _item_among_keys_error(line: int, lines: Lines) -> Diagnostic | None:
    """Return the error of a line that is a list item among keys; None for other lines."""
    text, location = _without_comment(line, lines)
    return Diagnostic("E109", location, AMONG_KEYS, fix=text[2:].strip()) if text.startswith("- ") else None


def _indent_error(line: int, lines: Lines) -> Diagnostic | None:
    """Return the error of a line with a larger indent than the previous key with a value.

    The result is None for other lines.
    """
    (text, location), (above, at) = (
        _without_comment(number, lines) for number in (line, _line_above(line, lines))
    )
    if not (_KEY_AND_VALUE.match(text) and _KEY_AND_VALUE.match(above)) or location.column <= at.column:
        return None
    message = f"this line is indented by {location.column - 1} spaces, the one above it by {at.column - 1}"
    return Diagnostic("E109", location, message, fix=f"{' ' * (at.column - 1)}{text}")


def _missing_comma_error(location: SourceLocation) -> Diagnostic | None:
    """Return the error of a missing comma in front of an entry: `{a: 1 b: 2}`.

    `location` is that of the entry, or of the colon of its key. The result is None for an entry that starts
    its line, which may follow a bracket that is not closed.
    """
    before, rest = (
        location.source_line[: location.column - 1],
        location.source_line[location.column - 1 :],
    )
    if rest.startswith(":"):
        match = _LAST_WORD.search(before)
        before, entry = (before[: match.start()], match[0]) if match else ("", "")
    else:
        match = re.match(r"[\w.]+|['\"-]", rest)
        entry = match[0] if match else ""
    if not entry or not before.strip() or before.rstrip()[-1] in "{[,:-":
        return None
    place = replace(location, column=len(before.rstrip()) + 1)
    return Diagnostic("E109", place, f"expected a comma before {entry}", fix=f", {entry}")


def _without_comment(line: int, lines: Lines) -> tuple[str, SourceLocation]:
    """Return the text of a line without indent and comment, and its location.

    The text is empty if there is no such line.
    """
    text = lines.lines[line].partition(" #")[0] if 0 <= line < len(lines.lines) else ""
    return text.strip(), lines.location(line, len(text) - len(text.lstrip()))


def not_yaml(error: yaml.MarkedYAMLError, lines: Lines) -> Diagnostic:
    """Return a PyYAML error as one sentence, located at the text to change."""
    mark = error.problem_mark or error.context_mark
    assert mark is not None, error
    location = lines.of(mark)
    rest = location.source_line[location.column - 1 :]
    indent = location.source_line[: len(location.source_line) - len(location.source_line.lstrip())]
    if "\t" in indent or rest.startswith("\t"):
        return Diagnostic("E109", location, "indentation: expected spaces, got a tab")
    if "cannot start any token" in (error.problem or ""):
        quoted = f"'{rest.strip()[:40]}'"
        return Diagnostic("E109", location, f"text that starts with {rest[:1]} needs quotes", fix=quoted)
    problem = f"{error.problem}; {error.context}"
    before = _TEXT.search(location.source_line[: location.column - 1])
    bracket = _BRACKET.match(rest)
    if before and bracket and "expected ','" in problem:  # x[1], {1, 0} or chain[1:2] between { and }
        text = before[0] + bracket[0].rstrip()
        where = location.shifted(-len(before[0]))
        return Diagnostic("E109", where, f"text with {rest[0]} needs quotes here", fix=f'"{text}"')
    if "expected ','" in problem and (mistake := _missing_comma_error(location)) is not None:
        return mistake
    opening, above = (error.context_mark or mark).line, _line_above(mark.line, lines)
    causes = {
        "mapping values": (
            *((_missing_colon_error, mark.line), (_missing_colon_error, above)),
            (_indent_error, mark.line),
        ),
        "could not find expected ':'": ((_missing_colon_error, opening),),
        "block": (
            (_item_among_keys_error, mark.line),
            (_item_among_keys_error, opening),
            (_missing_colon_error, above),
        ),
    }
    for part in causes:
        for cause, line in causes[part] if part in problem else ():
            if (mistake := cause(line, lines)) is not None:
                return mistake
    for part, sentence, fix in _PROBLEMS:
        if part in problem:
            if error.context_mark and part in _OF_CONTEXT:
                location = lines.of(error.context_mark)
            return Diagnostic("E109", location, sentence, fix=fix)
    return Diagnostic("E109", location, f"invalid YAML: {error.problem}")
