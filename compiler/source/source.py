"""A file, or its bytes, to the YAML nodes in it.

Takes: a path, or bytes.
Gives: `read_source`, `parse_source`: a `Source`, the text and its tree of nodes.
Guarantees: a regular file of bounded size (see `files`), UTF-8 without control characters, one YAML document.
Does not: know what a topology is, or what any key means.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.files import RefusedError, read_file
from apc.compiler.source.compose import compose
from apc.compiler.source.nodes import MAX_BYTES, Lines, Node


@dataclass(frozen=True, slots=True)
class Source:
    """A text that was read: `file` is its name in messages."""

    file: str
    path: Path | None
    text: str
    root: Node


def read_source(path: Path, *, shown: str | None = None) -> Source:
    """Read a YAML file.

    Parameters
    ----------
    path
        The file.
    shown
        Its name in messages; the path as given by default.

    Raises
    ------
    ApcError
        E101 no such file, E102 a folder, E103 not readable, E104 not a regular file;
        and those of `parse_source`.
    """
    file = str(path) if shown is None else shown
    try:
        data = read_file(path, MAX_BYTES)
    except RefusedError as refused:
        raise ApcError(_not_read(path, SourceLocation(file), refused)) from None
    return parse_source(data, file=file, path=path)


def _not_read(path: Path, location: SourceLocation, refused: RefusedError) -> Diagnostic:
    match refused.why:
        case "missing":
            return Diagnostic("E101", location, _missing(path))
        case "folder" | "special":
            code = "E102" if refused.why == "folder" else "E104"
            return Diagnostic(code, location, "this", "a YAML file", refused.words.removeprefix("is "))
        case "large":
            return _too_large(location)
    return Diagnostic("E103", location, f"this file {refused.words}")


def _too_large(location: SourceLocation) -> Diagnostic:
    message = f"this file is larger than {MAX_BYTES} bytes, the most a YAML file may have here"
    return Diagnostic("E105", location, message)


def parse_source(data: bytes, *, file: str, path: Path | None = None) -> Source:
    """Parse the bytes of a YAML file.

    Parameters
    ----------
    data
        UTF-8, with or without a byte order mark; lines end with LF, CRLF or CR.
    file
        The name shown in messages.
    path
        The path of the file, if any.

    Raises
    ------
    ApcError
        E105 too large, E106 not UTF-8, E107 control character, E108 empty, E109 not YAML,
        E110 several documents, E111 a key twice, E112 a key that is no name, E113 a tag,
        E114 an alias without end or without anchor, E115 nested too deep, E116 a merge key,
        E117 too many nodes.
    """
    if len(data) > MAX_BYTES:
        raise ApcError(_too_large(SourceLocation(file)))
    text = _decode(data, file)
    lines = Lines(file, text)
    _refuse_control_characters(text, lines)
    root = compose(text, lines)
    return Source(file, path, text, root)


def _missing(path: Path) -> str:
    """Return the message for a missing file, with the nearest name in its folder."""
    folder = path.parent
    try:
        known = sorted(entry.name for entry in folder.iterdir())
    except OSError:
        return f"there is no folder {str(folder)!r}"
    close = nearest(path.name, known)
    return (
        f"there is no such file; did you mean {str(folder / close)!r}?" if close else "there is no such file"
    )


def _decode(data: bytes, file: str) -> str:
    """Return the text without its byte order mark, or report the byte that is not UTF-8."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # With a mark in front, Python counts from behind it.
        start = error.start + (len(data) - len(error.object))
        before = re.split(rb"\r\n|\n|\r", data[:start])
        line, column = len(before), len(before[-1].decode("utf-8-sig", "replace")) + 1
        got = f"byte 0x{data[start]:02x} at offset {start}"
        raise ApcError(
            Diagnostic("E106", SourceLocation(file, line, column), "a YAML file", "UTF-8 text", got)
        ) from None


# YAML's line breaks beyond LF and CR (U+0085, U+2028, U+2029) show in few editors: refused with the rest.
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")


def _refuse_control_characters(text: str, lines: Lines) -> None:
    """Raise E107 for the first character that no editor shows."""
    if (search := _CONTROL.search(text)) is None:
        return
    before = re.split(r"\r\n|\n|\r", text[: search.start()])
    character = search.group()
    name = unicodedata.name(character, "a control character")
    got = f"U+{ord(character):04X} ({name})" + (", as in a binary file" if character == "\0" else "")
    location = lines.location(len(before) - 1, len(before[-1]))
    raise ApcError(Diagnostic("E107", location, "a YAML file", "visible text", got))
