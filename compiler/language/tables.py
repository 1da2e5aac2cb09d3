"""Tables in CSV files: columns with their units in the headings.

Takes: a path. Gives: `Table`, in SI; `open_rows` and `read_headings`, for files not all of numbers.
Guarantees: every cell is a finite number, or a mistake names its file, line and column.
Does not: know what a column means.
"""

from __future__ import annotations

import csv
import hashlib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Mistakes, Place
from apc.compiler.language.units import NO_UNIT, Unit, parse_unit
from apc.compiler.source.reading import brief

MAX_BYTES = 1 << 28  # 256 MiB: some ten million numbers
MOST_MISTAKES = 20  # of one table; a wrong column has as many as rows
_HEADING = re.compile(r"\s*(?P<name>[^\[\]]*?)\s*(\[\s*(?P<unit>[^\[\]]*?)\s*\])?\s*\Z")


class Reader(Protocol):
    """A reader of the module `csv`, whose type has no public name."""

    @property
    def line_num(self) -> int:
        """The line read last."""

    def __iter__(self) -> Iterator[list[str]]: ...

    def __next__(self) -> list[str]: ...


@dataclass(frozen=True, slots=True)
class Column:
    """A column: name and unit of its heading, its numbers in SI (rows,)."""

    name: str
    unit: Unit
    numbers: NDArray[np.float64]
    place: Place


@dataclass(frozen=True, slots=True)
class Table:
    """A CSV file, whole. `lines` are the lines its rows stand in, `digest` the SHA-256 of its bytes."""

    file: str
    columns: tuple[Column, ...]
    lines: tuple[int, ...]
    digest: str

    @property
    def rows(self) -> int:
        """The number of rows below the headings."""
        return len(self.columns[0].numbers) if self.columns else 0


def read_table(path: Path, named_at: Place) -> Table:
    """Read a CSV file of numbers below headings such as `device.mass [kg]`.

    Parameters
    ----------
    path
        The file.
    named_at
        Where the topology names it, for a file that can't be read.

    Raises
    ------
    ApcError
        E701 it can't be read, E702 a heading, E703 a row or cell is at fault.
    """
    reader, digest = open_rows(path, named_at)
    file = str(path)
    mistakes = Mistakes()
    try:
        names = read_headings(reader, file, mistakes)
        mistakes.raise_if_any()
        rows, lines = _rows(reader, len(names), file, mistakes)
    except csv.Error as error:
        raise ApcError(Mistake("E703", Place(file, reader.line_num or 1, 1), f"is no CSV: {error}")) from None
    mistakes.raise_if_any()
    if not rows:
        raise ApcError(Mistake("E703", Place(file, 2, 1), "the table has headings but no rows"))
    numbers = np.array(rows, dtype=np.float64)
    columns = tuple(
        Column(name, unit, numbers[:, i] * float(unit.scale), place)
        for i, (name, unit, place) in enumerate(names)
    )
    return Table(file, columns, tuple(lines), digest)


def open_rows(path: Path, named_at: Place) -> tuple[Reader, str]:
    """Return a file's rows of cells, and the SHA-256 of its bytes."""
    data = _bytes(path, named_at)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ApcError(
            Mistake("E701", named_at, f"{path.name} is not UTF-8 text (byte {error.start})")
        ) from None
    return csv.reader(text.splitlines()), hashlib.sha256(data).hexdigest()


def read_headings(reader: Reader, file: str, mistakes: Mistakes) -> list[tuple[str, Unit, Place]]:
    """Return the name, unit and place of every heading, such as `device.mass [kg]`.

    Parameters
    ----------
    reader
        The rows of the file, none of them read yet.
    file
        Its name in messages.
    mistakes
        Takes E702 for a heading at fault.

    Raises
    ------
    ApcError
        E702 there are no headings.
    """
    headings = next(reader, [])
    if not any(heading.strip() for heading in headings):
        raise ApcError(
            Mistake("E702", Place(file, 1, 1), "the table has no headings", hint="device.mass [kg]")
        )
    return [_heading(heading, file, headings[:i], mistakes) for i, heading in enumerate(headings)]


def _bytes(path: Path, named_at: Place) -> bytes:
    try:
        if not path.is_file():
            reason = "is a folder" if path.is_dir() else "does not exist"
            raise ApcError(Mistake("E701", named_at, f"the table {path} {reason}"))
        if path.stat().st_size > MAX_BYTES:
            raise ApcError(
                Mistake("E701", named_at, f"the table {path} is larger than {MAX_BYTES >> 20} MiB")
            )
        return path.read_bytes()
    except OSError as error:
        raise ApcError(
            Mistake("E701", named_at, f"the table {path} can't be read: {error.strerror}")
        ) from None


def _heading(text: str, file: str, before: list[str], mistakes: Mistakes) -> tuple[str, Unit, Place]:
    place = Place(file, 1, sum(len(other) + 1 for other in before) + 1)
    found = _HEADING.match(text)
    if found is None or not found["name"]:
        mistakes.add(
            "E702",
            place,
            "a heading",
            expected="a name and its unit",
            got=brief(text) or "nothing",
            hint="device.mass [kg]",
        )
        return "", NO_UNIT, place
    name = found["name"]
    if any((other := _HEADING.match(one)) and other["name"] == name for one in before):
        mistakes.add("E702", place, f"the heading {brief(name)} is used twice")
    try:
        unit = parse_unit(found["unit"], place) if found["unit"] else NO_UNIT
    except ApcError as error:
        mistakes.take(error)
        unit = NO_UNIT
    return name, unit, place


def _rows(reader: Reader, width: int, file: str, mistakes: Mistakes) -> tuple[list[list[float]], list[int]]:
    rows: list[list[float]] = []
    lines: list[int] = []
    found = 0
    for cells in reader:
        if not cells or not any(cell.strip() for cell in cells):
            continue
        line = reader.line_num
        if len(cells) != width:
            what = f"the row has {len(cells)} cells and there are {width} headings"
            mistakes.add("E703", Place(file, line, 1), what)
            found += 1
        else:
            try:
                row = [float(cell) for cell in cells]
                if all(map(math.isfinite, row)):
                    rows.append(row)
                    lines.append(line)
                    continue
            except ValueError:
                pass
            _add_bad_cells(cells, file, line, mistakes)
            found += 1
        if found >= MOST_MISTAKES:
            break
    return rows, lines


def _add_bad_cells(cells: list[str], file: str, line: int, mistakes: Mistakes) -> None:
    column = 1
    for cell in cells:
        try:
            fine = math.isfinite(float(cell))
        except ValueError:
            fine = False
        if not fine:
            mistakes.add(
                "E703",
                Place(file, line, column),
                "a cell",
                expected="a finite number",
                got=brief(cell) or "nothing",
            )
        column += len(cell) + 1
