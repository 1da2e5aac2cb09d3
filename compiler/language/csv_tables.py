"""Tables in CSV files: columns with their units in the headings.

Takes: a path. Gives: `read_table`, a `Table` in SI of `CsvColumn`s; `open_table`, `parse_headings`,
`read_bytes`, for files whose cells are not all numbers; `NamedFiles`.
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
from apc.compiler.files import FileReader, InputFile, RefusedError
from apc.compiler.language.units import NO_UNIT, Unit, parse_unit
from apc.compiler.number_parsing import plain_float
from apc.compiler.source.reading import brief, fault

MAX_BYTES = 1 << 26  # 64 MiB: about eight million numbers, read in a few seconds
PACKED = ".gz"  # the suffix of files compressed by gzip
MOST_COLUMNS = 1000  # more than the parameters of a topology that differ between peers
MOST_MISTAKES = 20  # of one table, as every row of a wrong column has one
_EXAMPLE = "device.mass [kg]"
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_.\[\]]*\Z")
# The last bracket has the unit; brackets before it have the index of a vector entry or an array element.
_HEADING = re.compile(r"(?P<name>[^\[\]]*(\[[0-9]+\][^\[\]]*)*?)(\[(?P<unit>[^\[\]]*)\])?\Z")

Headings = tuple[tuple[str, Unit, SourceLocation], ...]  # name, unit and location


F = TypeVar("F")


@dataclass(frozen=True, slots=True)
class NamedFiles:
    """The files that a topology names: their `folder`, the `names` of the files read, and all `mistakes`."""

    folder: Path
    mistakes: Mistakes
    reader: FileReader
    names: set[str] = field(default_factory=set)

    def read(self, name: str, read: Callable[[InputFile], F]) -> F | None:
        """Return the result of `read` for a file; None if the file is invalid, with its errors recorded."""
        with self.mistakes:
            result = read(InputFile(self.folder / name, self.reader))
            self.names.add(name)
            return result
        return None


@dataclass(frozen=True, slots=True, eq=False)
class CsvColumn:
    """A column of a table: name and unit of its heading, and its numbers (rows,) in SI units."""

    name: str
    unit: Unit
    numbers: NDArray[np.float64]
    location: SourceLocation


@dataclass(frozen=True, slots=True)
class Table:
    """The columns of a CSV file. `lines` are the line numbers of its rows."""

    file: str
    columns: tuple[CsvColumn, ...]
    lines: tuple[int, ...]

    @property
    def rows(self) -> int:
        """The number of rows below the headings."""
        return len(self.columns[0].numbers) if self.columns else 0


def read_table(file: InputFile, named_at: SourceLocation, example: str = _EXAMPLE) -> Table:
    """Return the table in a CSV file of numbers below headings such as `device.mass [kg]`.

    Parameters
    ----------
    file
        The file.
    named_at
        The location of its reference, for a file that cannot be read.
    example
        A heading, for messages.

    Raises
    ------
    ApcError
        E701 the file cannot be read, E702 a heading is invalid, E703 a row or cell is invalid.
    """
    with open_table(file, named_at, example=example) as opened:
        headings = opened.headings
        cells, lines = opened.numbers(
            range(len(headings)), [plain_float] * len(headings), "cell", "a finite number"
        )
    numbers = cells.reshape(len(lines), len(headings))
    columns = tuple(
        CsvColumn(name, unit, numbers[:, i] * float(unit.scale), location)
        for i, (name, unit, location) in enumerate(headings)
    )
    return Table(opened.file, columns, lines)


@dataclass(frozen=True, slots=True)
class CsvReader:
    """An open CSV file: its headings (name, unit and location) and a reader of its `rows`."""

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
        """Return the numbers of some columns as one array, row by row, and the line number of each row.

        Parameters
        ----------
        columns
            The zero-based column indices.
        readers
            For each column, a function that returns the number in a cell or raises ValueError.
        subject, expected
            The name and the expected contents of a cell, for messages.
        empty_too
            Whether rows with only empty cells are read; a line without characters is never a row.

        Raises
        ------
        ApcError
            E703 a row or cell is invalid, or there is no row.
        """
        mistakes, numbers, lines, faulty = Mistakes(), array("d"), array("q"), set[int]()
        begin = self.rows.line_num + 1
        for cells in self.rows:
            # A cell in quotes may have several lines.
            location, begin = SourceLocation(self.file, begin, 1), self.rows.line_num + 1
            filled = len(cells) > 1 or (cells and not cells[0].isspace())
            if not (filled if empty_too else any(map(str.strip, cells))):
                continue
            lines.append(location.line)
            if len(cells) != len(self.headings):
                reason = f"row: expected {len(self.headings)} cells, one for each heading, got {len(cells)}"
                advice = "separate cells by commas, not semicolons" if ";" in "".join(cells) else ""
                mistakes.add("E703", location, reason, advice=advice)
                faulty.add(location.line)
                if advice:
                    break
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
def open_table(
    file: InputFile, named_at: SourceLocation, known: Collection[str] = (), example: str = _EXAMPLE
) -> Iterator[CsvReader]:
    """Open a CSV file, read its headings, and yield a reader of its rows.

    Parameters
    ----------
    file, named_at
        As for `read_table`.
    known
        Names that are valid headings without a unit.
    example
        A heading, for messages.

    Raises
    ------
    ApcError
        E701 the file cannot be read, E702 the headings are invalid, E703 the rows are not CSV. Errors of the
        `with` body are raised unchanged, except for a file that does not begin as a table: the only error is
        E702, as its text may be private.
    """
    data, name = read_bytes(file, named_at), str(file.path)
    rows = csv.reader(io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig"))
    first: list[str] = []
    try:
        first = next(rows, [])
        yield CsvReader(name, parse_headings(first, name, example), rows)
    except csv.Error as error:
        raise fault("E703", SourceLocation(name, rows.line_num or 1, 1), f"invalid CSV: {error}") from None
    except ApcError:
        if not any(map(str.strip, first)) or _is_table(first, known):
            raise
        separator = next((mark for mark in ";\t" if len(first) == 1 and mark in first[0]), "")
        if separator:
            got = {";": "semicolons", "\t": "tabs"}[separator]
            raise fault(
                "E702", SourceLocation(name, 1, 1), "separator", "commas", got, advice="save it with commas"
            ) from None
        expected = "a name and its unit in each heading"
        raise fault("E702", SourceLocation(name, 1, 1), "table", expected, fix=example) from None


def _is_table(headings: list[str], texts: Collection[str]) -> bool:
    """Return whether headings are those of a table: one name with a unit or in `texts`, or several names."""
    parts = [_name_and_unit(heading) for heading in headings]
    return any(name in texts or (unit and _NAME.match(name)) for name, unit in parts) or (
        len(parts) > 1 and all(_NAME.match(name) and unit is None for name, unit in parts)
    )


def read_bytes(file: InputFile, named_at: SourceLocation, *, any_text: bool = False) -> bytes:
    """Return the bytes of a file, decompressed if its suffix is .gz.

    Raises
    ------
    ApcError
        E701 the file cannot be read, or is not UTF-8 text, unless `any_text`.
    """
    try:
        data = file.read(MAX_BYTES)
        if file.path.suffix.lower() == PACKED:
            with gzip.open(io.BytesIO(data)) as packed:
                data = packed.read(MAX_BYTES + 1)
        if len(data) <= MAX_BYTES:
            if not any_text:
                # At once, so that the offset in an error is from the start of the file.
                data.decode("utf-8-sig")
            return data
        message = f"{file.path.name} is larger than {MAX_BYTES >> 20} MiB when unpacked"
    except RefusedError as refused:
        message = f"the table {file.path} {refused.words}"
    except UnicodeDecodeError as error:
        message = f"{file.path.name} is not UTF-8 text (byte {error.start})"
    except (OSError, EOFError, zlib.error):
        message = f"{file.path.name} is not a complete gzip file"
    raise fault("E701", named_at, message)


def parse_headings(texts: list[str], file: str, example: str) -> Headings:
    """Return name, unit and location of each heading. Raises ApcError (E702) for invalid headings."""
    location = SourceLocation(file, 1, 1)
    if not any(text.strip() for text in texts):
        raise fault("E702", location, "the table has no headings", fix=example)
    if len(texts) > MOST_COLUMNS:
        message = f"table: expected at most {MOST_COLUMNS} columns, got {len(texts)}"
        raise fault("E702", location, message, advice="use several groups, each with a table")
    mistakes = Mistakes()
    result: dict[str, tuple[str, Unit, SourceLocation]] = {}
    for text in texts:
        name, written = _name_and_unit(text)
        unit = NO_UNIT
        if not name:
            expected, got = "a name and its unit", brief(text) or "nothing"
            mistakes.add("E702", location, "heading", expected=expected, got=got, fix=example)
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


def _name_and_unit(heading: str) -> tuple[str, str | None]:
    """Return the name and the unit of a heading: unit None if it has none, an empty name if it is invalid."""
    result = _HEADING.match(heading.strip())
    if result is None:
        return "", None
    unit = result["unit"]
    return result["name"].strip(), None if unit is None else unit.strip()
