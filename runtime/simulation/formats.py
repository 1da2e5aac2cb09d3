"""The formats of a trajectory's file: CSV, Parquet, MAT, NPZ.

Takes: an empty file, the signals, what made them, and then rows, block by block.
Gives: `Writer`, `WRITERS`.
Guarantees: a block is in the file whole or not at all; before a block is written, room is kept on the disk
for it and for the file's end, so that on a full disk the blocks before it can still be finished. Except for
MAT, whose format holds each variable in one piece, memory does not grow with the duration.
Does not: name the file, or say what went wrong (see `recording`).
"""

from __future__ import annotations

import contextlib
import io
import os
import tempfile
import zipfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from apc.optional import need
from apc.simulation.signals import Signal

Floats = NDArray[np.float64]

TIME = "time [s]"
LARGEST_MAT = 2**31 - 2**20  # bytes: a variable of a MAT-file of version 5 is less than 2 GiB
COPIED = 2**20  # bytes at a time

# Room for what is written besides numbers, in bytes; upper bounds, which the tests hold against the files.
LABEL = 256  # a name with its unit in a MAT- or NPZ-file, without the letters themselves
LETTER = 4  # of a text, in the encoding that takes most (UTF-32, in NPZ)
ENDS = 2**14  # headers and directories, of any format
# Of Parquet: a column in the schema (measured 76, and 3 a letter of its name, which stands there twice, once
# in base 64); of each block its note in the footer (measured 104, and the name) and its page headers (98).
COLUMN, NOTE, HEADERS = 256, 256, 256
# A block of Parquet is at most a dictionary of all its values and a place in it for each (PLAIN_DICTIONARY,
# places of at most 18 bits), or the values themselves; Snappy adds at most a sixth to either.
SWOLLEN = 2


class Writer(ABC):
    """One format, abstract. `whole_rows` are in the file for good; `beside` is the text of a file beside it.

    `rows` raises OSError when there is no room: of these rows none is in the file then, and `finish` still
    ends it after those before.
    """

    beside = ""

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        self.path, self.signals, self.provenance = path, signals, provenance
        self.file: BinaryIO = path.open("w+b")
        self.whole_rows = 0
        self._kept = 0

    @abstractmethod
    def rows(self, time: Floats, values: Floats) -> None:
        """Write some rows."""

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


class _Csv(Writer):
    """Headings with units, then a line a row; numbers in the shortest decimals that give them back."""

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        super().__init__(path, signals, provenance)
        self.beside = provenance + "\n"
        headings = [TIME, *(one.heading for one in signals)]
        self.file.write((",".join(headings) + "\n").encode())
        self.file.flush()
        self.whole = self.file.tell()

    def rows(self, time: Floats, values: Floats) -> None:
        table = np.column_stack([time, values]).tolist()
        text = "".join(f"{','.join(map(repr, row))}\n" for row in table).encode()
        self.keep(self.whole + len(text))
        self.file.seek(self.whole)
        self.file.write(text)
        self.file.flush()
        self.whole += len(text)
        self.whole_rows += len(table)

    def finish(self) -> None:
        self.file.seek(self.whole)
        self.cut()


class _Parquet(Writer):
    """A row group a block; columns are named like headings, `provenance` is in the schema's metadata."""

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        super().__init__(path, signals, provenance)
        self.arrow = need("pyarrow", "data")
        parquet = need("pyarrow.parquet", "data")
        names = [TIME, *(one.heading for one in signals)]
        fields = [(name, self.arrow.float64()) for name in names]
        self.schema = self.arrow.schema(fields, metadata={"provenance": provenance})
        self.table_writer = parquet.ParquetWriter(self.file, self.schema)
        letters = len("".join(names).encode())
        self.note = NOTE * len(names) + letters  # of each block, in the footer
        self.end = ENDS + COLUMN * len(names) + LETTER * (letters + len(provenance.encode()))
        self.written = True

    def rows(self, time: Floats, values: Floats) -> None:
        if not self.written:
            raise OSError(0, "half a row group can't be written on")
        columns = 1 + values.shape[1]
        block = (SWOLLEN * 8 * len(time) + HEADERS) * columns
        self.keep(self.file.tell() + block + self.end + self.note)
        arrays = [self.arrow.array(time), *(self.arrow.array(column) for column in values.T)]
        self.written = False
        self.table_writer.write_table(self.arrow.Table.from_arrays(arrays, schema=self.schema))
        self.written = True
        self.end += self.note
        self.whole_rows += len(time)

    def finish(self) -> None:
        if not self.written:
            raise OSError(0, "half a row group can't be read")
        self.table_writer.close()
        self.cut()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self.table_writer.close()  # or it would try to when it is forgotten
        super().close()


class _Npz(Writer):
    """Arrays `values` (rows, signals), `time`, `names`, `units`, `provenance`.

    An archive has a member's check sum in front of it, and an array its number of rows. So the values are
    written where they belong, behind a gap for both, and written over with themselves as the archive is
    made: it takes no more room than its own. The times wait in an unnamed file.
    """

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        super().__init__(path, signals, provenance)
        self.times = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115 -- closed when it has been copied
        self.gap = self._gap()
        letters = sum(len(one.name) + len(one.unit) for one in signals)
        widest = max((len(one.name) for one in signals), default=0)
        self.end = ENDS + LETTER * (len(provenance) + 2 * widest * len(signals) + letters)

    def rows(self, time: Floats, values: Floats) -> None:
        before, after = self.whole_rows, self.whole_rows + len(time)
        width = 8 * len(self.signals)
        self.keep(self.gap + after * (width + 8) + self.end)
        keep_room(self.times, 8 * before, 8 * after)
        for file, begin, array in (
            (self.times, 8 * before, time),
            (self.file, self.gap + width * before, values),
        ):
            file.seek(begin)
            file.write(np.ascontiguousarray(array, dtype="<f8").tobytes())
            file.flush()
        self.whole_rows = after

    def finish(self) -> None:
        self.file.seek(0)
        with self.path.open("rb") as itself, zipfile.ZipFile(self.file, "w", zipfile.ZIP_STORED) as archive:
            itself.seek(self.gap)
            self._member(archive, "values", itself, (self.whole_rows, len(self.signals)))
            self.times.seek(0)
            self._member(archive, "time", self.times, (self.whole_rows,))
            for name, texts in _labels(self.signals, self.provenance).items():
                buffer = io.BytesIO()
                np.save(buffer, np.array(texts, dtype=np.str_), allow_pickle=False)
                archive.writestr(f"{name}.npy", buffer.getvalue())
        self.cut()
        self.times.close()

    def close(self) -> None:
        super().close()
        self.times.close()

    def _gap(self) -> int:
        """Return where the values begin; NumPy leaves room for any number of rows in an array's header."""
        buffer = io.BytesIO()
        with (
            zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive,
            archive.open("values.npy", "w", force_zip64=True) as member,
        ):
            _array_header(member, (0, len(self.signals)))
            return buffer.tell()

    def _member(self, archive: zipfile.ZipFile, name: str, file: BinaryIO, shape: tuple[int, ...]) -> None:
        left = 8 * int(np.prod(shape))
        with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
            _array_header(member, shape)
            assert file is self.times or self.file.tell() == self.gap, "the values would be moved"
            while left:
                piece = file.read(min(COPIED, left))
                member.write(piece)
                left -= len(piece)


def _array_header(file: Any, shape: tuple[int, ...]) -> None:
    header = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(file, header)


class _Mat(Writer):
    """Variables `time`, `values` (rows, signals), cell arrays `names` and `units`, `provenance`."""

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        super().__init__(path, signals, provenance)
        self.blocks: list[tuple[Floats, Floats]] = []
        letters = sum(len(one.name) + len(one.unit) for one in signals) + len(provenance)
        self.end = ENDS + 2 * LABEL * len(signals) + LETTER * letters

    def rows(self, time: Floats, values: Floats) -> None:
        after = self.whole_rows + len(time)
        if 8 * after * max(1, len(self.signals)) > LARGEST_MAT:
            raise OSError(0, "a variable of a MAT-file holds less than 2 GiB; .npz and .parquet hold more")
        numbers = 8 * after * (1 + len(self.signals))
        self.keep(self.end + numbers + numbers // 1000)  # zlib adds 0.03 % at most
        self.blocks.append((time, values))
        self.whole_rows = after

    def finish(self) -> None:
        from scipy.io import savemat

        labels = _labels(self.signals, self.provenance)
        cells = {name: np.array(labels[name], dtype=object) for name in ("names", "units")}
        variables = {
            "time": np.concatenate([time for time, _ in self.blocks])[:, None],
            "values": np.concatenate([values for _, values in self.blocks]),
            "provenance": self.provenance,
            **{name: one.reshape(-1, 1) for name, one in cells.items()},
        }
        savemat(self.file, variables, do_compression=True)
        self.cut()


def _labels(signals: Sequence[Signal], provenance: str) -> dict[str, Any]:
    return {
        "names": [one.name for one in signals],
        "units": [one.unit for one in signals],
        "provenance": provenance,
    }


WRITERS: dict[str, Callable[[Path, Sequence[Signal], str], Writer]] = {
    ".csv": _Csv,
    ".parquet": _Parquet,
    ".mat": _Mat,
    ".npz": _Npz,
}
