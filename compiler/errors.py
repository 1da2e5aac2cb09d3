"""What a user is told when the input is at fault.

Takes: nothing. Gives: `SourceLocation` and `place_in`, `Diagnostic`, `ApcError` and the collector `Mistakes`;
`visible`.
Guarantees: mistakes of one file come out together, in file order, each once; no control character is
told as it is.
Does not: print, or decide exit codes.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

SHOWN = 75  # characters of a source line, so that it fits a terminal of 80 with its indent

# A line to write that is longer than this is not read to its end: what is wrong is said alone.
LONGEST_HINT = 400


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
    """Return a text in which no character acts on a terminal: what isn't printed stands as JSON's `\\u001b`.

    Line breaks, tabs and spaces stay. So a JSON document stays one.
    """
    return "".join(
        c
        if c.isprintable() or c in "\n\t" or unicodedata.category(c) == "Zs"
        else re.sub("(....)", r"\\u\1", c.encode("utf-16-be", "surrogatepass").hex())
        for c in text
    )


def place_in(place: SourceLocation, text: str, offset: int) -> SourceLocation:
    """Return the place of character `offset` of a text that starts at `place`.

    A text folded from several lines, or one with escapes, does not stand in the source line as it is: then
    the start of the text is the best place we know.
    """
    start = place.column - 1
    if place.source_line and not place.source_line.startswith(text[:offset], max(start, 0)):
        return place
    return place.shifted(offset)


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One fault in the input: what it is about, what was got, what was expected, the line to write.

    It reads `PLACE: CODE WHAT wants EXPECTED, got GOT. Write: HINT`; `expected`, `got` and `hint`
    may be empty, and then their part of the sentence is left out. `subject` is the name of the unit, part or
    number at fault, for decisions: no text has it.
    """

    code: str
    place: SourceLocation
    what: str
    expected: str = ""
    got: str = ""
    hint: str = ""
    subject: str = field(default="", compare=False, repr=False)

    def __str__(self) -> str:
        """Return the message with the source line and a caret under the place."""
        text = f"{self.place}: {self.code} {self.sentence}"
        line = self.place.source_line.rstrip("\n")
        if not (self.place.line and line.strip()):
            return text
        # A long line is shown around its fault only; a tab or control character would move the caret.
        start = max(0, min(self.place.column - 1 - SHOWN // 2, len(line) - SHOWN))
        shown = "".join(c if c.isprintable() else " " for c in line[start : start + SHOWN])
        return f"{text}\n    {shown}\n    {' ' * (self.place.column - 1 - start)}^"

    @property
    def sentence(self) -> str:
        """The message without place, code and source line."""
        text = self.what
        if self.expected:
            text += f" wants {self.expected}"
        if self.got:
            text += f", got {self.got}" if self.expected else f" {self.got}"
        if not text.endswith((".", "?", "!")):
            text += "."
        if 0 < len(self.hint) <= LONGEST_HINT:
            text += f" Write: {self.hint}"
        return _in_one_line(text)

    @property
    def reason(self) -> str:
        """What is wrong, without what to write in its place."""
        return replace(self, hint="").sentence


def _in_one_line(text: str) -> str:
    """Return a text in one line, whatever it quotes."""
    return visible(re.sub(r"\s", " ", text))


class ApcError(Exception):
    """The input is at fault. `mistakes` holds at least one `Diagnostic`, in file order."""

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
        self._found: dict[Diagnostic, None] = {}

    def add(
        self,
        code: str,
        place: SourceLocation,
        what: str,
        *,
        expected: str = "",
        got: str = "",
        hint: str = "",
        subject: str = "",
    ) -> None:
        """Record one mistake; the same mistake twice counts once.

        Parameters
        ----------
        code, place, what, expected, got, hint, subject
            As `Diagnostic` has them.
        """
        self._found[Diagnostic(code, place, what, expected, got, hint, subject)] = None

    def take(self, error: ApcError) -> None:
        """Record every mistake of an error raised further down."""
        self._found |= dict.fromkeys(error.mistakes)

    def __enter__(self) -> None:
        """Take what is raised within: `with mistakes:`."""

    def __exit__(self, kind: object, error: BaseException | None, _: object) -> bool:
        """Record an `ApcError`, and go on behind the block."""
        if isinstance(error, ApcError):
            self.take(error)
        return isinstance(error, ApcError)

    def __bool__(self) -> bool:
        return bool(self._found)

    def pass_on(self, other: Mistakes) -> None:
        """Record all of these with others."""
        other._found |= self._found

    @property
    def found(self) -> tuple[Diagnostic, ...]:
        """All mistakes in file order."""
        any_name = "|".join(map(re.escape, self.names)) or "(?!)"  # without names, nothing
        named = re.compile(rf"(?<!\w)({any_name})(?!\w)")
        once = {
            (mistake.place, mistake.code, named.sub("…", mistake.sentence)): mistake
            for mistake in reversed(self._found)
        }
        return tuple(sorted(once.values(), key=lambda mistake: (mistake.place, mistake.code)))

    def raise_if_any(self) -> None:
        """Raise `ApcError` with all mistakes, if there is one."""
        if self._found:
            raise ApcError(self.found)


FEW_NAMES = 50  # that are compared with a misspelt one in full


def nearest(name: str, texts: Iterable[str], *, alike: float = 0.6) -> str:
    """Return the known name closest to a misspelt one, or an empty string when none is close.

    Parameters
    ----------
    name, texts
        The name as written, and those there are.
    alike
        How alike two names must be, from 0 to 1: what short names share by chance is more.
    """
    import difflib  # for a mistake only

    name, known = name[:200], list(texts)
    if len(known) > FEW_NAMES:  # difflib takes a tenth of a millisecond a name
        known.sort(key=lambda text: -_in_place(name, text))
    close = difflib.get_close_matches(name, known[:FEW_NAMES], n=1, cutoff=alike)
    return close[0] if close else ""


def _in_place(name: str, text: str) -> int:
    """Return how many characters two names have in common at the same distance from either end."""
    forwards, backwards = zip(name, text, strict=False), zip(name[::-1], text[::-1], strict=False)
    return sum(one == other for pairs in (forwards, backwards) for one, other in pairs)
