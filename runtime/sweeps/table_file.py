"""Tables of mixed columns as files: CSV or Parquet, by the suffix.

Takes: headings, kinds of columns, and rows as they come. Gives: `check_table_path`, `write_table`.
Guarantees: written whole or not at all; the same rows give the same bytes, however they were cut into blocks;
numbers keep every digit; an empty cell is empty, never NaN; at most a block of rows is held at a time.
Does not: compute.
"""

from __future__ import annotations

import csv
import importlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import check_target, write_file
from apc.distribution import install_line
from apc.suffixes import check_suffix
from apc.sweeps.quantities import Cell, Row

SUFFIXES = (".csv", ".parquet")
# Rows of a row group: PyArrow's readers take groups of this order at a time, and it fits any memory.
BLOCK = 65_536
METADATA = b"apc"  # the key of what made a table, in a Parquet file's own metadata


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
            raise ApcError(Mistake("E887", Place(str(path)), what, hint=hint)) from None
    check_target(path)


def write_table(
    path: Path,
    headings: Sequence[str],
    kinds: Sequence[str],
    rows: Iterable[Row],
    metadata: Mapping[str, Any],
) -> None:
    """Write a table.

    Parameters
    ----------
    path
        The file; its suffix says the format, see `check_suffix`.
    headings, kinds
        Of each column; a kind is "number", "count" or "text".
    rows
        The rows, read once; each as long as the headings. None is an empty cell.
    metadata
        What made the table; kept in a Parquet file, left out of a CSV file, which stays plain.

    Raises
    ------
    ApcError
        E601 the file can't be written.
    """
    if check_suffix(path, SUFFIXES, "out=") == ".csv":
        write_file(path, lambda temporary: _write_csv(temporary, headings, rows))
    else:
        write_file(path, _parquet_writer(headings, kinds, rows, metadata))


def _write_csv(path: Path, headings: Sequence[str], rows: Iterable[Row]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(headings)
        writer.writerows(["" if cell is None else _text(cell) for cell in row] for row in rows)


def _text(cell: Cell) -> str:
    return repr(cell) if isinstance(cell, float) else str(cell)


def _parquet_writer(
    headings: Sequence[str], kinds: Sequence[str], rows: Iterable[Row], metadata: Mapping[str, Any]
) -> Callable[[Path], None]:
    import pyarrow
    from pyarrow import parquet

    types = {"number": pyarrow.float64(), "count": pyarrow.int64(), "text": pyarrow.string()}
    fields = [pyarrow.field(name, types[kind]) for name, kind in zip(headings, kinds, strict=True)]
    about = json.dumps(metadata, ensure_ascii=False, sort_keys=True).encode()
    schema = pyarrow.schema(fields, metadata={METADATA: about})

    def write(path: Path) -> None:
        with parquet.ParquetWriter(path, schema) as file:
            for block in _blocks(rows):
                columns = [
                    pyarrow.array([row[place] for row in block], type=field.type)
                    for place, field in enumerate(fields)
                ]
                file.write_table(pyarrow.Table.from_arrays(columns, schema=schema))

    return write


def _blocks(rows: Iterable[Row]) -> Iterator[list[Row]]:
    every = iter(rows)
    while block := list(islice(every, BLOCK)):
        yield block
