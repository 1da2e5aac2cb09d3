"""Error messages for invalid input.

Takes: nothing.
Gives: `SourceLocation` and `location_in`, `Diagnostic`, `ApcError` and the collector `Mistakes`; `visible`,
`nearest`, `equally_near`.
Guarantees: the errors of one file are reported together, in file order, each once. Control characters are
escaped.
Does not: print, or decide exit codes.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

SHOWN = 75  # characters of a source line, so that it fits a terminal of 80 with its indent

# A fix longer than this number of characters is not read to its end: the error is printed alone.
LONGEST_FIX = 400


@dataclass(frozen=True, slots=True, order=True)
class SourceLocation:
    """A position in a text file; `line` and `column` count from 1, 0 means the file as a whole."""

    file: str
    line: int = 0
    column: int = 0
    source_line: str = ""

    def __str__(self) -> str:
        """Return `file:line:column`, or the file alone when no line is known."""
        file = visible(self.file.replace("\n", "\\n"))
        return f"{file}:{self.line}:{self.column}" if self.line else file

    def shifted(self, columns: int) -> SourceLocation:
        """Return the place `columns` further right on the same line."""
        return replace(self, column=self.column + columns)


def visible(text: str) -> str:
    """Return a text without control characters: unprintable ones are escaped as in JSON, `\\u001b`.

    Line breaks, tabs and spaces are kept, so a JSON document stays valid.
    """
    return "".join(
        c
        if c.isprintable() or c in "\n\t" or unicodedata.category(c) == "Zs"
        else re.sub("(....)", r"\\u\1", c.encode("utf-16-be", "surrogatepass").hex())
        for c in text
    )


def location_in(location: SourceLocation, text: str, offset: int) -> SourceLocation:
    """Return the place of character `offset` of a text that starts at `location`.

    A text folded from several lines, or one with escapes, differs from the source line: then the start of the
    text is returned.
    """
    start = location.column - 1
    if location.source_line and not location.source_line.startswith(text[:offset], max(start, 0)):
        return location
    return location.shifted(offset)


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One error in the input: its subject, the expected and the actual value, a fix or advice.

    It reads `LOCATION: CODE MESSAGE: expected EXPECTED, got GOT. ADVICE. Try: FIX`; empty parts are left out.
    `fix` is text that can be pasted at the location (alternatives separated by `, or `), `advice` a sentence.
    `subject` is the name of the unit, part or number at fault; it is for decisions and is not printed.
    """

    code: str
    location: SourceLocation
    message: str
    expected: str = ""
    got: str = ""
    fix: str = ""
    advice: str = ""
    subject: str = field(default="", compare=False, repr=False)

    def __str__(self) -> str:
        """Return the message with the source line and a caret under the place."""
        text = f"{self.location}: {self.code} {self.sentence}"
        line = self.location.source_line.rstrip("\n")
        if not (self.location.line and line.strip()):
            return text
        # A long line is shown around its fault only; a tab or control character would move the caret.
        start = max(0, min(self.location.column - 1 - SHOWN // 2, len(line) - SHOWN))
        shown = "".join(c if c.isprintable() else " " for c in line[start : start + SHOWN])
        return f"{text}\n    {shown}\n    {' ' * (self.location.column - 1 - start)}^"

    @property
    def sentence(self) -> str:
        """The message without location, code and source line."""
        text = self.message
        if self.expected:
            text += f": expected {self.expected}"
        if self.got:
            text += f", got {self.got}"
        text = _ended(text)
        if self.advice:
            text += f" {_ended(self.advice[0].upper() + self.advice[1:])}"
        if 0 < len(self.fix) <= LONGEST_FIX:
            text += f" Try: {self.fix}"
        return _in_single_line(text)

    @property
    def reason(self) -> str:
        """The description of the error, without fix and advice."""
        return replace(self, fix="", advice="").sentence


def _ended(text: str) -> str:
    """Return a sentence with a full stop unless it has a final mark."""
    return text if text.endswith((".", "?", "!")) else f"{text}."


def _in_single_line(text: str) -> str:
    """Return a text on one line, also with quoted line breaks."""
    return visible(re.sub(r"\s", " ", text))


class ApcError(Exception):
    """The input is invalid. `mistakes` holds at least one `Diagnostic`, in file order."""

    def __init__(self, mistakes: Iterable[Diagnostic] | Diagnostic) -> None:
        result = (mistakes,) if isinstance(mistakes, Diagnostic) else tuple(mistakes)
        assert result, "an ApcError names at least one mistake"
        self.mistakes = result
        super().__init__("\n".join(str(mistake) for mistake in result))


class Mistakes:
    """Collects mistakes so that a file's faults are reported together.

    `names` are those of parts and groups: what differs by one of them alone, of one code at one place,
    is one mistake. A component's text is at fault once, however many parts are of it.
    """

    def __init__(self, names: Iterable[str] = ()) -> None:
        self.names = tuple(names)
        self._result: dict[Diagnostic, None] = {}

    def add(
        self,
        code: str,
        location: SourceLocation,
        message: str,
        *,
        expected: str = "",
        got: str = "",
        fix: str = "",
        advice: str = "",
        subject: str = "",
    ) -> None:
        """Record one mistake; the same mistake twice counts once.

        Parameters
        ----------
        code, location, message, expected, got, fix, advice, subject
            The fields of `Diagnostic`.
        """
        self._result[Diagnostic(code, location, message, expected, got, fix, advice, subject)] = None

    def take(self, error: ApcError) -> None:
        """Record every mistake of an error raised further down."""
        self._result |= dict.fromkeys(error.mistakes)

    def __enter__(self) -> None:
        """Collect the errors raised within: `with mistakes:`."""

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> bool:
        """Record an `ApcError`, and go on behind the block."""
        if isinstance(error, ApcError):
            self.take(error)
        return isinstance(error, ApcError)

    def __bool__(self) -> bool:
        return bool(self._result)

    def pass_on(self, other: Mistakes) -> None:
        """Record all of these with others."""
        other._result |= self._result

    @property
    def result(self) -> tuple[Diagnostic, ...]:
        """All mistakes in file order."""
        any_name = "|".join(map(re.escape, self.names)) or "(?!)"  # without names, nothing
        named = re.compile(rf"(?<!\w)({any_name})(?!\w)")
        once = {
            (mistake.location, mistake.code, named.sub("…", mistake.sentence)): mistake
            for mistake in reversed(self._result)
        }
        return tuple(sorted(once.values(), key=lambda mistake: (mistake.location, mistake.code)))

    def raise_if_any(self) -> None:
        """Raise `ApcError` with all mistakes, if there is one."""
        if self._result:
            raise ApcError(self.result)


FEW_NAMES = 50  # that are compared with a misspelt one in full


def nearest(name: str, texts: Iterable[str], *, similarity: float = 0.6) -> str:
    """Return the known name closest to a misspelt one, or an empty string when none is close.

    Parameters
    ----------
    name, texts
        The name as written, and the known names.
    similarity
        The smallest similarity of two names, from 0 to 1: short names have more random similarity.
    """
    import difflib  # for a mistake only

    name, known = name[:200], list(texts)
    if len(known) > FEW_NAMES:  # difflib takes a tenth of a millisecond a name
        known.sort(key=lambda text: -_at_location(name, text))
    close = difflib.get_close_matches(name, known[:FEW_NAMES], n=1, cutoff=similarity)
    return close[0] if close else ""


def equally_near(name: str, close: str, texts: Iterable[str]) -> list[str]:
    """Return the names of the length of `close`, the nearest to a misspelt one, that are as near as it is:
    at most three.
    """
    import difflib  # for a mistake only

    def likeness(text: str) -> float:
        """Return the similarity of a known name and the misspelt one, from 0 to 1."""
        return difflib.SequenceMatcher(None, text, name[:200]).ratio()

    if not close:
        return []
    others = [*dict.fromkeys(text for text in texts if len(text) == len(close))][:FEW_NAMES]
    equal = [text for text in others if likeness(text) == likeness(close)][:3]
    return equal if close in equal else [close]


def _at_location(name: str, text: str) -> int:
    """Return the number of characters that two names have in common at the same distance from either end."""
    forwards, backwards = zip(name, text, strict=False), zip(name[::-1], text[::-1], strict=False)
    return sum(item == other for pairs in (forwards, backwards) for item, other in pairs)
