"""Tables of named columns as files, written as their rows come: CSV or Parquet, by the suffix.

Takes: columns, and rows block by block.
Gives: `TableColumn`, `Row`, `Tabled`, `TableWriter` and `WRITERS` of the formats; `check_table_path`,
`write_table`, `read_table`, `blocks_of`, `keep_room`.
Guarantees: a block is in the file whole or not at all; before a block is written, room is kept on the disk
for it and for the file's end, so that on a full disk the blocks before it can still be finished. The same
rows give the same bytes; numbers keep every digit; an empty cell is empty, never NaN; at most a block of rows
is held at a time.
Does not: compute, or say what a table is of.
"""

from __future__ import annotations

import contextlib
import csv
import importlib
import io
import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import check_target, write_file
from apc.distribution import install_line
from apc.optional import need
from apc.suffixes import check_suffix

Cell = float | int | bool | str | None
Row = tuple[Cell, ...]

# Rows of a row group: PyArrow's readers take groups of this order at a time, and it fits any memory.
BLOCK = 65_536
METADATA = "apc"  # the name of what made a table, in a Parquet file's own metadata
COPIED = 2**20  # bytes at a time

# Room for what is written besides numbers, in bytes; upper bounds, which the tests hold against the files.
LETTER = 4  # of a text, in the encoding that takes most (UTF-32, in NPZ)
ENDS = 2**14  # headers and directories, of any format
# Of Parquet: a column in the schema (measured 76, and 3 a letter of its name, which stands there twice, once
# in base 64); of each block its note in the footer (measured 104, and the name) and its page headers (98).
COLUMN, NOTE, HEADERS = 256, 256, 256
# A block of Parquet is at most a dictionary of all its values and a place in it for each (PLAIN_DICTIONARY,
# places of at most 18 bits), or the values themselves; Snappy adds at most a sixth to either.
SWOLLEN = 2


@dataclass(frozen=True, slots=True)
class TableColumn:
    """A column of a table: `kind` says what its cells are, if they are anything at all."""

    name: str
    unit: str = ""
    kind: Literal["number", "count", "text"] = "number"

    @property
    def heading(self) -> str:
        """The column's heading: name, and unit if it has one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


# What a table is made of: its columns, its rows, and what a file says of how it was made.
Tabled = tuple[list[TableColumn], Iterator[Row], dict[str, Any]]


class TableWriter(ABC):
    """One format, abstract. `about` is the name and the text of what made the table.

    `whole_rows` are in the file for good. `rows` raises OSError when there is no room: of these rows none is
    in the file then, and `finish` still ends it after those before. `plain` says that the format has no place
    for `about`.
    """

    plain: ClassVar[bool] = False

    def __init__(self, path: Path, columns: Sequence[TableColumn], about: tuple[str, str]) -> None:
        self.path, self.columns, self.about = path, columns, about
        self.file: BinaryIO = path.open("w+b")
        self.whole_rows = 0
        self._kept = 0

    def rows(self, cells: Sequence[Any]) -> None:
        """Write some rows, given as columns: arrays, their NaN empty cells, or sequences of cells."""
        count = len(cells[0])
        self.write(cells, count)
        self.whole_rows += count

    @abstractmethod
    def write(self, cells: Sequence[Any], count: int) -> None:
        """Keep room for so many rows, then write them."""

    @abstractmethod
    def finish(self) -> None:
        """Write what comes last, and close the file."""

    def close(self) -> None:
        """Close the file as it is."""
        with contextlib.suppress(OSError):  # what is still in its buffer, on a full disk
            self.file.close()

    def keep(self, size: int) -> None:
        """Make sure that the file can grow to so many bytes. Raises OSError if it can't."""
        if size > self._kept:
            keep_room(self.file, self._kept, size)
            self._kept = size

    def cut(self) -> None:
        """Give back the room that the file does not need, and close it."""
        self.file.truncate()
        self.file.close()


def keep_room(file: BinaryIO, begin: int, end: int) -> None:
    """Take the disk's room for these bytes of a file. Raises OSError if there is none."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), begin, end - begin)
        return
    place = file.tell()
    file.seek(begin)
    for at in range(begin, end, COPIED):
        file.write(bytes(min(COPIED, end - at)))
    file.flush()
    file.seek(place)


class Csv(TableWriter):
    """Headings with units, then a line a row; numbers in the shortest decimals that give them back."""

    plain = True

    def __init__(self, path: Path, columns: Sequence[TableColumn], about: tuple[str, str]) -> None:
        super().__init__(path, columns, about)
        self.file.write(_lines([[column.heading for column in columns]]))
        self.file.flush()
        self.whole = self.file.tell()

    def write(self, cells: Sequence[Any], count: int) -> None:
        """Keep room for so many rows, then write them."""
        columns = [_listed(cell) if isinstance(cell, np.ndarray) else cell for cell in cells]
        text = _lines(zip(*columns, strict=True))
        self.keep(self.whole + len(text))
        self.file.seek(self.whole)
        self.file.write(text)
        self.file.flush()
        self.whole += len(text)

    def finish(self) -> None:
        """Close the file."""
        self.file.seek(self.whole)
        self.cut()


def _listed(numbers: NDArray[Any]) -> list[Cell]:
    """Return an array as cells, NaN as an empty one."""
    cells = numbers
    if numbers.dtype.kind == "f" and np.isnan(numbers).any():
        cells = numbers.astype(object)
        cells[np.isnan(numbers)] = None
    result: list[Cell] = cells.tolist()
    return result


def _lines(rows: Iterable[Sequence[Cell]]) -> bytes:
    buffer = io.StringIO(newline="")
    csv.writer(buffer, lineterminator="\n").writerows(rows)  # a float as `repr` says it, None as nothing
    return buffer.getvalue().encode()


class Parquet(TableWriter):
    """A row group a block; columns are named like headings, `about` is in the schema's metadata."""

    def __init__(self, path: Path, columns: Sequence[TableColumn], about: tuple[str, str]) -> None:
        super().__init__(path, columns, about)
        self.arrow = need("pyarrow", "data")
        parquet = need("pyarrow.parquet", "data")
        types = {"number": self.arrow.float64(), "count": self.arrow.int64(), "text": self.arrow.string()}
        names = [column.heading for column in columns]
        fields = [
            self.arrow.field(name, types[column.kind]) for name, column in zip(names, columns, strict=True)
        ]
        self.schema = self.arrow.schema(fields, metadata=dict([about]))
        self.table_writer = parquet.ParquetWriter(self.file, self.schema)
        letters = len("".join(names).encode())
        self.note = NOTE * len(names) + letters  # of each block, in the footer
        self.end = ENDS + COLUMN * len(names) + LETTER * (letters + len(about[1].encode()))
        self.written = True

    def write(self, cells: Sequence[Any], count: int) -> None:
        """Keep room for so many rows, then write them."""
        if not self.written:
            raise OSError(0, "half a row group can't be written on")
        types = [item.type for item in self.schema]
        pairs = zip(cells, types, strict=True)
        arrays = [self.arrow.array(item, type=kind, from_pandas=True) for item, kind in pairs]  # NaN is empty
        block = SWOLLEN * sum(max(8 * count, array.nbytes) for array in arrays) + HEADERS * len(arrays)
        self.keep(self.file.tell() + block + self.end + self.note)
        self.written = False
        self.table_writer.write_table(self.arrow.Table.from_arrays(arrays, schema=self.schema))
        self.written = True
        self.end += self.note

    def finish(self) -> None:
        """Write the footer, and close the file."""
        if not self.written:
            raise OSError(0, "half a row group can't be read")
        self.table_writer.close()
        self.cut()

    def close(self) -> None:
        """Close the file as it is."""
        with contextlib.suppress(OSError):
            self.table_writer.close()  # or it would try to when it is forgotten
        super().close()


WRITERS: dict[str, Callable[[Path, Sequence[TableColumn], tuple[str, str]], TableWriter]] = {
    ".csv": Csv,
    ".parquet": Parquet,
}
SUFFIXES = tuple(WRITERS)


def check_table_path(path: Path, option: str) -> None:
    """Raise ApcError if no table can be written where an option says.

    E878 the suffix, E887 a library that is missing, E601 the place.
    """
    if check_suffix(path, SUFFIXES, option) == ".parquet":
        try:
            importlib.import_module("pyarrow.parquet")
        except ImportError:
            what = "is a Parquet file, which needs pyarrow; without it, the name can end in .csv"
            hint = install_line("data")
            raise ApcError(Diagnostic("E887", SourceLocation(str(path)), what, hint=hint)) from None
    check_target(path)


def write_table(
    path: Path, columns: Sequence[TableColumn], blocks: Iterable[Sequence[Any]], about: Mapping[str, Any]
) -> None:
    """Write a table.

    Parameters
    ----------
    path
        The file; its suffix says the format, see `check_suffix`.
    columns
        What its columns are.
    blocks
        Some rows at a time, read once, as columns: see `TableWriter.rows`, `blocks_of`.
    about
        What made the table; kept in a Parquet file, left out of a CSV file, which stays plain.

    Raises
    ------
    ApcError
        E601 the file can't be written.
    """
    suffix = check_suffix(path, SUFFIXES, "out=")
    made = json.dumps(about, ensure_ascii=False, sort_keys=True)

    def write(temporary: Path) -> None:
        writer = WRITERS[suffix](temporary, columns, (METADATA, made))
        try:
            for block in blocks:
                writer.rows(block)
            writer.finish()
        finally:
            writer.close()

    write_file(path, write)


def read_table(path: Path, columns: Sequence[TableColumn]) -> tuple[NDArray[Any], ...]:
    """Return columns of a table that `write_table` wrote, as floats, NaN where nothing is, or as objects."""
    if path.suffix == ".parquet":
        parquet = need("pyarrow.parquet", "data")
        table = parquet.read_table(path, columns=[column.heading for column in columns])
        cells = [table.column(column.heading).to_pylist() for column in columns]
    else:
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.reader(file)
            heading = next(lines)
            places = [heading.index(column.heading) for column in columns]
            rows = [[row[place] for place in places] for row in lines]
        read = {"number": float, "count": int, "text": str}
        cells = [
            [read[column.kind](row[place]) if row[place] or column.kind == "text" else None for row in rows]
            for place, column in enumerate(columns)
        ]
    return tuple(
        np.array(cell, dtype=np.float64 if column.kind == "number" else object)
        for column, cell in zip(columns, cells, strict=True)
    )


def blocks_of(rows: Iterable[Row]) -> Iterator[list[tuple[Cell, ...]]]:
    """Yield rows as blocks of columns."""
    every = iter(rows)
    while block := list(islice(every, BLOCK)):
        yield list(zip(*block, strict=True))
