"""Tables in CSV files: columns with their units in the headings.

Takes: a path. Gives: `read_table`, a `Table` in SI of `CsvColumn`s; `open_table`, `read_bytes`, for files
with other cells than numbers; `NamedFiles`.
Guarantees: every cell is a finite number, or an error names its file, line and column. The text of a file
that is not a table is never printed, as it may be private. A number takes eight bytes.
Does not: interpret columns.
"""

from __future__ import annotations

import csv
import gzip
import io
import re
import zlib
from array import array
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistakes, SourceLocation
from apc.compiler.files import RefusedError, read_file
from apc.compiler.language.units import NO_UNIT, Unit, parse_unit
from apc.compiler.number_parsing import plain_float
from apc.compiler.source.reading import brief, fault

MAX_BYTES = 1 << 26  # 64 MiB: some eight million numbers, read in a few seconds
PACKED = ".gz"  # the suffix of files that gzip packed
MOST_COLUMNS = 1000  # more than a topology has parameters that differ from peer to peer
MOST_MISTAKES = 20  # of one table; a wrong column has as many as rows
_EXAMPLE = "device.mass [kg]"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.\[\]]*\Z")
# The last bracket holds the unit; those before it, the index of an entry or of an element.
_HEADING = re.compile(r"(?P<name>[^\[\]]*(\[[0-9]+\][^\[\]]*)*?)(\[(?P<unit>[^\[\]]*)\])?\Z")

Headings = tuple[tuple[str, Unit, SourceLocation], ...]  # name, unit and location


F = TypeVar("F")


@dataclass(frozen=True, slots=True)
class NamedFiles:
    """The files a topology names, of a `folder`: the `names` of those read, and all `mistakes`."""

    folder: Path
    mistakes: Mistakes
    names: set[str] = field(default_factory=set)

    def read(self, name: str, reader: Callable[[Path], F]) -> F | None:
        """Return the result of reading a file; None if invalid, with its errors collected."""
        with self.mistakes:
            result = reader(self.folder / name)
            self.names.add(name)
            return result
        return None


@dataclass(frozen=True, slots=True, eq=False)
class CsvColumn:
    """A column: name and unit of its heading, its numbers in SI (rows,)."""

    name: str
    unit: Unit
    numbers: NDArray[np.float64]
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class Table:
    """A complete CSV file. `lines` are the line numbers of its rows."""

    file: str
    columns: tuple[CsvColumn, ...]
    lines: tuple[int, ...]

    @property
    def rows(self) -> int:
        """The number of rows below the headings."""
        return len(self.columns[0].numbers) if self.columns else 0


def read_table(path: Path, named_at: SourceLocation) -> Table:
    """Read a CSV file of numbers below headings such as `device.mass [kg]`.

    Parameters
    ----------
    path
        The file.
    named_at
        The location of its reference, for a file that cannot be read.

    Raises
    ------
    ApcError
        E701 it can't be read, E702 a heading, E703 a row or cell is at fault.
    """
    with open_table(path, named_at) as opened:
        headings = opened.headings
        cells, lines = opened.numbers(
            range(len(headings)), [plain_float] * len(headings), "a cell", "a finite number"
        )
    numbers = cells.reshape(len(lines), len(headings))
    columns = tuple(
        CsvColumn(name, unit, numbers[:, i] * float(unit.scale), location)
        for i, (name, unit, location) in enumerate(headings)
    )
    return Table(opened.file, columns, lines)


@dataclass(frozen=True, slots=True)
class CsvReader:
    """A CSV file whose headings are read, each a name, a unit and a place; `rows` are the rest."""

    file: str
    headings: Headings
    rows: Any  # a reader of the module csv, whose type has no public name

    def numbers(
        self,
        columns: Sequence[int],
        readers: Sequence[Callable[[str], float]],
        subject: str,
        expected: str,
        *,
        empty_too: bool = False,
    ) -> tuple[NDArray[np.float64], tuple[int, ...]]:
        """Return the numbers of some columns, row after row, and the line that each row begins in.

        Parameters
        ----------
        columns
            The zero-based column indices.
        readers
            For each column, a function that returns the number in a cell or raises ValueError.
        subject, expected
            The name and the expected contents of a cell, for messages.
        empty_too
            Read rows whose cells are all empty, too; a line without a character is no row.

        Raises
        ------
        ApcError
            E703 a row or cell is at fault, or there is none.
        """
        mistakes, numbers, lines, faulty = Mistakes(), array("d"), array("q"), set[int]()
        begin = self.rows.line_num + 1
        for cells in self.rows:
            # A cell in quotes may go over several lines.
            location, begin = SourceLocation(self.file, begin, 1), self.rows.line_num + 1
            filled = len(cells) > 1 or (cells and not cells[0].isspace())
            if not (filled if empty_too else any(map(str.strip, cells))):
                continue
            lines.append(location.line)
            if len(cells) != len(self.headings):
                reason = f"the row has {len(cells)} cells and there are {len(self.headings)} headings"
                mistakes.add("E703", location, reason)
                faulty.add(location.line)
            else:
                for column, number in zip(columns, readers, strict=True):
                    try:
                        numbers.append(number(cells[column]))
                    except ValueError:
                        at = location.shifted(sum(len(cell) + 1 for cell in cells[:column]))
                        got = brief(cells[column]) or "nothing"
                        mistakes.add("E703", at, subject, expected=expected, got=got)
                        faulty.add(location.line)
            if len(faulty) >= MOST_MISTAKES:
                break
        mistakes.raise_if_any()
        if not lines:
            raise fault("E703", SourceLocation(self.file, 2, 1), "the table has headings but no rows")
        return np.frombuffer(numbers, dtype=np.float64), tuple(lines)


@contextmanager
def open_table(path: Path, named_at: SourceLocation, known: Collection[str] = ()) -> Iterator[CsvReader]:
    """Open a CSV file and read its headings.

    Parameters
    ----------
    path, named_at
        As for `read_table`.
    known
        Names that are valid headings without a unit.

    Raises
    ------
    ApcError
        E701 it cannot be read, E702 its headings; E703 its rows are not CSV. Errors of the body are passed
        on, except for a file that does not begin as a table: only that is reported, as its text may be
        private.
    """
    data = read_bytes(path, named_at)
    file = str(path)
    rows = csv.reader(io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig"))
    first: list[str] = []
    try:
        first = next(rows, [])
        yield CsvReader(file, _headings(first, file), rows)
    except csv.Error as error:
        raise fault("E703", SourceLocation(file, rows.line_num or 1, 1), f"is no CSV: {error}") from None
    except ApcError:
        if not any(map(str.strip, first)) or _is_table(first, known):
            raise
        expected = "a name and its unit in each heading"
        raise fault("E702", SourceLocation(file, 1, 1), "a table", expected, hint=_EXAMPLE) from None


def _is_table(headings: list[str], texts: Collection[str]) -> bool:
    """Return whether a line is the first of a table: a heading has its unit, or there are several names."""
    parts = [_parts(heading) for heading in headings]
    return any(name in texts or (unit and _NAME.match(name)) for name, unit in parts) or (
        len(parts) > 1 and all(_NAME.match(name) and unit is None for name, unit in parts)
    )


def read_bytes(path: Path, named_at: SourceLocation, *, any_text: bool = False) -> bytes:
    """Return a file's bytes, unpacked if it is called .gz.

    Raises
    ------
    ApcError
        E701 it can't be read, or isn't UTF-8 text all of it, unless any text will do.
    """
    try:
        data = read_file(path, MAX_BYTES)
        if path.suffix.lower() == PACKED:
            with gzip.open(io.BytesIO(data)) as packed:
                data = packed.read(MAX_BYTES + 1)
        if len(data) <= MAX_BYTES:
            if not any_text:
                data.decode("utf-8-sig")  # all of it: what decodes piece by piece counts from where it is
            return data
        message = f"{path.name} unpacks to more than {MAX_BYTES >> 20} MiB"
    except RefusedError as refused:
        message = f"the table {path} {refused.words}"
    except UnicodeDecodeError as error:
        message = f"{path.name} is not UTF-8 text (byte {error.start})"
    except (OSError, EOFError, zlib.error):
        message = f"{path.name} is no whole gzip file"
    raise fault("E701", named_at, message)


def _headings(texts: list[str], file: str) -> Headings:
    location = SourceLocation(file, 1, 1)
    if not any(text.strip() for text in texts):
        raise fault("E702", location, "the table has no headings", hint=_EXAMPLE)
    if len(texts) > MOST_COLUMNS:
        message = f"the table has {len(texts)} columns, and {MOST_COLUMNS} are the most"
        raise fault("E702", location, message, hint="several groups, each with a table")
    mistakes = Mistakes()
    result: dict[str, tuple[str, Unit, SourceLocation]] = {}
    for text in texts:
        name, written = _parts(text)
        unit = NO_UNIT
        if not name:
            expected, got = "a name and its unit", brief(text) or "nothing"
            mistakes.add("E702", location, "a heading", expected=expected, got=got, hint=_EXAMPLE)
        try:
            unit = parse_unit(written, location) if written else NO_UNIT
        except ApcError as error:
            mistakes.take(error)
        if name in result:
            mistakes.add("E702", location, f"the heading {brief(name)} is used twice")
        result[name] = (name, unit, location)
        location = location.shifted(len(text) + 1)
    mistakes.raise_if_any()
    return tuple(result.values())


def _parts(heading: str) -> tuple[str, str | None]:
    """Return the name and the unit of a heading, None if it has none; no name if it is no heading."""
    result = _HEADING.match(heading.strip())
    if result is None:
        return "", None
    unit = result["unit"]
    return result["name"].strip(), None if unit is None else unit.strip()
