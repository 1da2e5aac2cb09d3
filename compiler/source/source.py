"""Reading of a YAML file or its bytes to nodes.

Takes: a path, or bytes.
Gives: `read_source`, `parse_source`: a `Source`, the text and its tree of nodes.
Guarantees: a regular file of bounded size (see `files`), UTF-8 without control characters, one YAML document.
Does not: interpret keys.
"""

from __future__ import annotations

import re
import unicodedata
from dataclasses import dataclass, field, replace
from pathlib import Path

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.files import FileReader, RefusedError
from apc.compiler.source.compose import compose
from apc.compiler.source.nodes import MAX_BYTES, Lines, Node


@dataclass(frozen=True, slots=True)
class Source:
    """A text with its tree of nodes: `file` is its name in messages, `reader` reads files that it names."""

    file: str
    path: Path | None
    text: str
    root: Node
    reader: FileReader = field(default_factory=FileReader)


def read_source(path: Path, reader: FileReader | None = None, *, shown: str | None = None) -> Source:
    """Return the text and nodes of a YAML file.

    Parameters
    ----------
    path
        The file.
    reader
        The reader of the compilation; by default a new one.
    shown
        The name of the file in messages; by default the path.

    Raises
    ------
    ApcError
        E101 a missing file, E102 a folder, E103 an unreadable file, E104 not a regular file;
        and the errors of `parse_source`.
    """
    file, reader = str(path) if shown is None else shown, reader or FileReader()
    try:
        data = reader.read(path, MAX_BYTES)
    except RefusedError as refused:
        raise ApcError(_not_read(path, SourceLocation(file), refused)) from None
    return replace(parse_source(data, file=file, path=path), reader=reader)


def _not_read(path: Path, location: SourceLocation, refused: RefusedError) -> Diagnostic:
    """Return the error of a file that could not be read."""
    match refused.why:
        case "missing":
            return Diagnostic("E101", location, _missing(path))
        case "folder" | "special":
            code = "E102" if refused.why == "folder" else "E104"
            return Diagnostic(code, location, "input", "a YAML file", refused.words.removeprefix("is "))
        case "large":
            return _too_large(location)
    return Diagnostic("E103", location, f"the file {refused.words}")


def _too_large(location: SourceLocation) -> Diagnostic:
    """Return the error E105 of a file that is too large."""
    message = f"the file is larger than {MAX_BYTES} bytes, the limit for a YAML file"
    return Diagnostic("E105", location, message)


def parse_source(data: bytes, *, file: str, path: Path | None = None) -> Source:
    """Return the text and nodes of the bytes of a YAML file.

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
        E105 too many bytes, E106 not UTF-8, E107 a control character; and the errors of `compose`, E108 to
        E117.
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
        return f"the folder {str(folder)!r} does not exist"
    close = nearest(path.name, known)
    return (
        f"the file does not exist; did you mean {str(folder / close)!r}?"
        if close
        else "the file does not exist"
    )


def _decode(data: bytes, file: str) -> str:
    """Return the text of UTF-8 bytes without byte order mark. Raises ApcError (E106) for an invalid byte."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        # If there is a byte order mark, Python's offset is relative to the byte after it.
        start = error.start + (len(data) - len(error.object))
        before = re.split(rb"\r\n|\n|\r", data[:start])
        line, column = len(before), len(before[-1].decode("utf-8-sig", "replace")) + 1
        got = f"byte 0x{data[start]:02x} at offset {start}"
        raise ApcError(
            Diagnostic("E106", SourceLocation(file, line, column), "file", "UTF-8 text", got)
        ) from None


# YAML's other line breaks (U+0085, U+2028, U+2029) are invisible in most editors, and are invalid too.
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")


def _refuse_control_characters(text: str, lines: Lines) -> None:
    """Raise ApcError (E107) for the first invisible character."""
    if (search := _CONTROL.search(text)) is None:
        return
    before = re.split(r"\r\n|\n|\r", text[: search.start()])
    character = search.group()
    name = unicodedata.name(character, "a control character")
    got = f"U+{ord(character):04X} ({name})" + (", as in a binary file" if character == "\0" else "")
    location = lines.location(len(before) - 1, len(before[-1]))
    raise ApcError(Diagnostic("E107", location, "file", "text without control characters", got))
