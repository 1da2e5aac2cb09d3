"""Table files with named columns, written block by block: CSV or Parquet, by suffix.

Takes: columns, and rows block by block.
Gives: `TableColumn`, `Row`, `Tabled`, `TableWriter` and `WRITERS` of the formats; `check_table_path`,
`write_table`, `read_table`, `blocks_of`, `keep_room`.
Guarantees: a block is in the file completely or not at all. Before a block is written, disk space is reserved
for it and for the end of the file, so that on a full disk the file can be finished with the earlier blocks.
Output is reproducible to the byte; numbers are written with all digits; an empty cell is empty, never NaN; at
most one block of rows is in memory.
Does not: compute, or define columns.
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
from apc.support.distribution import install_line
from apc.support.optional import need
from apc.support.suffixes import check_suffix

Cell = float | int | bool | str | None
Row = tuple[Cell, ...]

# Rows of a block (a row group of Parquet): about the size that readers of PyArrow process at a time.
BLOCK = 65_536
METADATA = "apc"  # the key of the provenance in the metadata of a Parquet file
COPIED = 2**20  # bytes written at a time

# Upper bounds in bytes on the file contents other than numbers; tests compare them with files.
LETTER = 4  # a character of a text, in the longest encoding (UTF-32, in NPZ)
ENDS = 2**14  # headers and directories of all formats
# Overhead of Parquet: a column in the schema (measured 76, and 3 per letter of the name, which occurs twice,
# once in base 64); for each block the entry in the footer (measured 104, and the name) and the page headers
# (98).
COLUMN, NOTE, HEADERS = 256, 256, 256
# A block of Parquet has at most a dictionary of all values and an index of at most 18 bits for each
# (PLAIN_DICTIONARY), or the values themselves; Snappy adds at most a sixth to both.
SWOLLEN = 2


@dataclass(frozen=True, slots=True)
class TableColumn:
    """A column of a table: `kind` is the type of its cells, empty cells excepted."""

    name: str
    unit: str = ""
    kind: Literal["number", "count", "text"] = "number"

    @property
    def heading(self) -> str:
        """The heading of the column: the name, and the unit if there is one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name


# The parts of a table: its columns, its rows, and its provenance.
Tabled = tuple[list[TableColumn], Iterator[Row], dict[str, Any]]


class TableWriter(ABC):
    """The writer of one format (abstract base class).

    `description` is the key and the text of the provenance.

    `whole_rows` is the number of rows completely in the file. `rows` raises OSError without disk space: then
    none of these rows is in the file, and `finish` can still complete the file with the earlier rows. `plain`
    is whether the format cannot contain `description`.
    """

    plain: ClassVar[bool] = False

    def __init__(self, path: Path, columns: Sequence[TableColumn], description: tuple[str, str]) -> None:
        """Open the file for writing."""
        self.path, self.columns, self.description = path, columns, description
        self.file: BinaryIO = path.open("w+b")
        self.whole_rows = 0
        self._stored = 0

    def rows(self, cells: Sequence[Any]) -> None:
        """Write rows, given as columns: arrays, in which NaN is an empty cell, or sequences of cells."""
        count = len(cells[0])
        self.write(cells, count)
        self.whole_rows += count

    @abstractmethod
    def write(self, cells: Sequence[Any], count: int) -> None:
        """Reserve space for a block of rows, then write it."""

    @abstractmethod
    def finish(self) -> None:
        """Write the end of the file, and close it."""

    def close(self) -> None:
        """Close the file without changes."""
        with contextlib.suppress(OSError):  # the buffer may not be writable on a full disk
            self.file.close()

    def keep(self, size: int) -> None:
        """Reserve disk space for the file up to a size in bytes. Raises OSError if there is none."""
        if size > self._stored:
            keep_room(self.file, self._stored, size)
            self._stored = size

    def cut(self) -> None:
        """Release the reserved space that is not used, and close the file."""
        self.file.truncate()
        self.file.close()


def keep_room(file: BinaryIO, begin: int, end: int) -> None:
    """Reserve disk space for a range of bytes of a file. Raises OSError if there is none."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file.fileno(), begin, end - begin)
        return
    index = file.tell()
    file.seek(begin)
    for offset in range(begin, end, COPIED):
        file.write(bytes(min(COPIED, end - offset)))
    file.flush()
    file.seek(index)


class Csv(TableWriter):
    """CSV: headings with units, then one line per row.

    Numbers are the shortest decimals that represent them exactly.
    """

    plain = True

    def __init__(self, path: Path, columns: Sequence[TableColumn], description: tuple[str, str]) -> None:
        """Open the file, and write the headings."""
        super().__init__(path, columns, description)
        self.file.write(_lines([[column.heading for column in columns]]))
        self.file.flush()
        self.whole = self.file.tell()

    def write(self, cells: Sequence[Any], count: int) -> None:
        """Reserve space for a block of rows, then write it."""
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
    """Return the cells of an array; NaN is an empty cell."""
    cells = numbers
    if numbers.dtype.kind == "f" and np.isnan(numbers).any():
        cells = numbers.astype(object)
        cells[np.isnan(numbers)] = None
    result: list[Cell] = cells.tolist()
    return result


def _lines(rows: Iterable[Sequence[Cell]]) -> bytes:
    """Return rows as the bytes of CSV lines."""
    buffer = io.StringIO(newline="")
    csv.writer(buffer, lineterminator="\n").writerows(rows)  # a float by `repr`, None as an empty cell
    return buffer.getvalue().encode()


class Parquet(TableWriter):
    """Parquet: one row group per block.

    Columns have the headings as names, `description` is in the metadata.
    """

    def __init__(self, path: Path, columns: Sequence[TableColumn], description: tuple[str, str]) -> None:
        """Open the file with a schema of the columns."""
        super().__init__(path, columns, description)
        self.arrow = need("pyarrow", "data")
        parquet = need("pyarrow.parquet", "data")
        types = {"number": self.arrow.float64(), "count": self.arrow.int64(), "text": self.arrow.string()}
        names = [column.heading for column in columns]
        fields = [
            self.arrow.field(name, types[column.kind]) for name, column in zip(names, columns, strict=True)
        ]
        self.schema = self.arrow.schema(fields, metadata=dict([description]))
        self.table_writer = parquet.ParquetWriter(self.file, self.schema)
        letters = len("".join(names).encode())
        self.note = NOTE * len(names) + letters  # bytes of each block in the footer
        self.end = ENDS + COLUMN * len(names) + LETTER * (letters + len(description[1].encode()))
        self.written = True

    def write(self, cells: Sequence[Any], count: int) -> None:
        """Reserve space for a block of rows, then write it."""
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
        """Close the file without changes."""
        with contextlib.suppress(OSError):
            self.table_writer.close()  # otherwise its destructor would close it
        super().close()


WRITERS: dict[str, Callable[[Path, Sequence[TableColumn], tuple[str, str]], TableWriter]] = {
    ".csv": Csv,
    ".parquet": Parquet,
}
SUFFIXES = tuple(WRITERS)


def check_table_path(path: Path, option: str) -> None:
    """Raise ApcError if no table can be written to the path of an option.

    The errors are E878 an unknown suffix, E887 a missing library, E601 an invalid path.
    """
    if check_suffix(path, SUFFIXES, option) == ".parquet":
        try:
            importlib.import_module("pyarrow.parquet")
        except ImportError:
            message = "is a Parquet file, which needs pyarrow; without it, the name can end in .csv"
            fix = install_line("data")
            raise ApcError(Diagnostic("E887", SourceLocation(str(path)), message, fix=fix)) from None
    check_target(path)


def write_table(
    path: Path,
    columns: Sequence[TableColumn],
    blocks: Iterable[Sequence[Any]],
    description: Mapping[str, Any],
) -> None:
    """Write a table to a file.

    Parameters
    ----------
    path
        The file; its suffix determines the format, see `check_suffix`.
    columns
        The columns of the table.
    blocks
        Blocks of rows, read once, as columns: see `TableWriter.rows`, `blocks_of`.
    description
        The provenance of the table; stored in a Parquet file, omitted from a CSV file.

    Raises
    ------
    ApcError
        E601 the file can't be written.
    """
    suffix = check_suffix(path, SUFFIXES, "out=")
    metadata = json.dumps(description, ensure_ascii=False, sort_keys=True)

    def write(temporary: Path) -> None:
        """Write the table to a temporary file."""
        writer = WRITERS[suffix](temporary, columns, (METADATA, metadata))
        try:
            for block in blocks:
                writer.rows(block)
            writer.finish()
        finally:
            writer.close()

    write_file(path, write)


def read_table(path: Path, columns: Sequence[TableColumn]) -> tuple[NDArray[Any], ...]:
    """Return columns of a table written by `write_table`.

    Numbers are floats, NaN for an empty cell; other columns are object arrays.
    """
    if path.suffix == ".parquet":
        parquet = need("pyarrow.parquet", "data")
        table = parquet.read_table(path, columns=[column.heading for column in columns])
        cells = [table.column(column.heading).to_pylist() for column in columns]
    else:
        with path.open(encoding="utf-8", newline="") as file:
            lines = csv.reader(file)
            heading = next(lines)
            indices = [heading.index(column.heading) for column in columns]
            rows = [[row[index] for index in indices] for row in lines]
        converters = {"number": float, "count": int, "text": str}
        cells = [
            [
                converters[column.kind](row[index]) if row[index] or column.kind == "text" else None
                for row in rows
            ]
            for index, column in enumerate(columns)
        ]
    return tuple(
        np.array(cell, dtype=np.float64 if column.kind == "number" else object)
        for column, cell in zip(columns, cells, strict=True)
    )


def blocks_of(rows: Iterable[Row]) -> Iterator[list[tuple[Cell, ...]]]:
    """Yield rows as blocks of at most `BLOCK` rows, each as a list of columns."""
    iterator = iter(rows)
    while block := list(islice(iterator, BLOCK)):
        yield list(zip(*block, strict=True))
