"""Trajectories as files, written as they come: CSV, Parquet, MAT, NPZ.

Takes: the blocks of a simulation. Gives: `Recording`, `open_recording`, `SUFFIXES`.
Guarantees: a file is there whole or not at all: a temporary beside the target, then a rename; of a run
that is cut short, what was done is kept in a file that can be read. When the disk is full that holds for
CSV; the other formats need their end, and room for it. Except for MAT, whose format holds each variable in
one piece, memory does not grow with the duration.
Does not: compute.

Every file says what made it: in the schema's metadata (Parquet), the variable `provenance` (MAT, NPZ), or
beside it in NAME.csv.json, as a table's first line has to be its headings.
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

from apc.compiler.errors import ApcError, Mistake, Place
from apc.runtime.signals import Signal
from apc.runtime.simulation import Block, Simulation
from apc.runtime.trajectory import need, provenance_of

Floats = NDArray[np.float64]

SUFFIXES = (".csv", ".parquet", ".mat", ".npz")
TIME = "time [s]"
LARGEST_MAT = 2**31 - 2**20  # bytes: a variable of a MAT-file of version 5 is less than 2 GiB
COPIED = 2**20  # bytes at a time


class Recording:
    """A file being written. `take` each block, then `close`; `path` appears when it is closed.

    When no more can be written, as the disk is full, `take` raises ApcError (E879) and the file is closed:
    with what was written until then where the format allows it, or away.
    """

    def __init__(self, path: Path, simulation: Simulation) -> None:
        self.path = path
        self._rows = 0
        self._open = True
        try:
            handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
            os.close(handle)
            self._temporary = Path(name)
            provenance = provenance_of(simulation).to_json()
            self._writer = _WRITERS[path.suffix.lower()](self._temporary, simulation.signals, provenance)
        except OSError as error:
            raise self._failed(error) from error
        except ApcError:  # a library is missing
            self._temporary.unlink(missing_ok=True)
            raise

    def take(self, block: Block) -> None:
        """Write one block."""
        try:
            self._writer.rows(block.time, block.values)
            self._rows += len(block.time)
        except OSError as error:
            raise self._rescued(error) from error

    def close(self) -> None:
        """Finish the file and give it its name. Raises ApcError (E879) if it can't be.

        Without a row there is no file, and once closed it stays so.
        """
        if not self._rows:
            self.discard()
        if not self._open:
            return
        self._open = False
        try:
            self._writer.finish()
            self._name()
        except OSError as error:
            self._temporary.unlink(missing_ok=True)
            raise self._failed(error) from error

    def discard(self) -> None:
        """Leave no trace."""
        if self._open:
            self._open = False
            self._writer.file.close()
            self._temporary.unlink(missing_ok=True)

    def _name(self) -> None:
        mask = os.umask(0)
        os.umask(mask)
        self._temporary.chmod(0o666 & ~mask)
        self._temporary.replace(self.path)
        if isinstance(self._writer, _Csv):
            from apc.compiler.store import write_atomically

            text = self._writer.provenance + "\n"
            write_atomically(
                self.path.with_name(f"{self.path.name}.json"), lambda path: _write_text(path, text)
            )

    def _rescued(self, error: OSError) -> ApcError:
        """Keep what was written before the disk was full, if that can be done."""
        self._open = False
        reason = error.strerror or str(error)
        try:
            self._writer.rescue()
            self._name()
        except (OSError, ApcError):
            self._temporary.unlink(missing_ok=True)
            return self._failed(error)
        what = f"holds the first {self._writer.whole_rows} rows only: {reason}"
        return ApcError(Mistake("E879", Place(str(self.path)), what))

    def _failed(self, error: OSError) -> ApcError:
        reason = error.strerror or str(error)
        return ApcError(Mistake("E879", Place(str(self.path)), f"can't be written: {reason}"))


def open_recording(path: Path, simulation: Simulation) -> Recording:
    """Begin a file, its format chosen by the suffix.

    Raises
    ------
    ApcError
        E878 no such format, E879 it can't be written, E875 a library it needs is not installed.
    """
    if path.suffix.lower() not in SUFFIXES:
        expected = f"one of {', '.join(SUFFIXES)}"
        what, got = "the suffix of --out", path.suffix or "none"
        raise ApcError(Mistake("E878", Place(str(path)), what, expected, got, f"{path.stem}.csv"))
    return Recording(path, simulation)


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


class _Writer(ABC):
    """One format, abstract. `whole_rows` are in the file for good."""

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        self.path, self.signals, self.provenance = path, signals, provenance
        self.file: BinaryIO = path.open("w+b")
        self.whole_rows = 0

    @abstractmethod
    def rows(self, time: Floats, values: Floats) -> None:
        """Write some rows."""

    @abstractmethod
    def finish(self) -> None:
        """Write what comes last, and close the file."""

    def rescue(self) -> None:
        """Make of a file that could not be written on one that can be read, and close it."""
        self.file.close()
        raise OSError("a file of this format can't be read without its end")


class _Csv(_Writer):
    """Headings with units, then a line a row; numbers in the shortest decimals that give them back."""

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        super().__init__(path, signals, provenance)
        headings = [TIME, *(one.heading for one in signals)]
        self.file.write((",".join(headings) + "\n").encode())
        self.file.flush()
        self.whole = self.file.tell()

    def rows(self, time: Floats, values: Floats) -> None:
        table = np.column_stack([time, values]).tolist()
        self.file.write("".join(f"{','.join(map(repr, row))}\n" for row in table).encode())
        self.file.flush()
        self.whole = self.file.tell()
        self.whole_rows += len(table)

    def finish(self) -> None:
        self.file.close()

    def rescue(self) -> None:
        with contextlib.suppress(OSError):  # what is still in the buffer can't be written any more
            self.file.close()
        os.truncate(self.path, self.whole)  # half a line is worse than none


class _Parquet(_Writer):
    """A row group a block; columns are named like headings, `provenance` is in the schema's metadata."""

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        super().__init__(path, signals, provenance)
        self.arrow = need("pyarrow", "data")
        parquet = need("pyarrow.parquet", "data")
        names = [TIME, *(one.heading for one in signals)]
        fields = [(name, self.arrow.float64()) for name in names]
        self.schema = self.arrow.schema(fields, metadata={"provenance": provenance})
        self.table_writer = parquet.ParquetWriter(self.file, self.schema)

    def rows(self, time: Floats, values: Floats) -> None:
        columns = [self.arrow.array(time), *(self.arrow.array(column) for column in values.T)]
        self.table_writer.write_table(self.arrow.Table.from_arrays(columns, schema=self.schema))
        self.whole_rows += len(time)

    def finish(self) -> None:
        self.table_writer.close()
        self.file.close()


class _Npz(_Writer):
    """Arrays `time`, `values` (rows, signals), `names`, `units`, `provenance`.

    The rows go to an unnamed file first: an array's header says how many there are.
    """

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        super().__init__(path, signals, provenance)
        self.columns = [
            tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115 -- closed when it has been copied
            for _ in ("time", "values")
        ]

    def rows(self, time: Floats, values: Floats) -> None:
        for file, array in zip(self.columns, (time, values), strict=True):
            file.write(np.ascontiguousarray(array, dtype="<f8").tobytes())
            file.flush()
        self.whole_rows += len(time)

    def finish(self) -> None:
        with zipfile.ZipFile(self.file, "w", zipfile.ZIP_STORED) as archive:
            sizes = ((self.whole_rows,), (self.whole_rows, len(self.signals)))
            for name, file, shape in zip(("time", "values"), self.columns, sizes, strict=True):
                self._member(archive, name, file, shape)
            for name, texts in _labels(self.signals, self.provenance).items():
                buffer = io.BytesIO()
                np.save(buffer, np.array(texts, dtype=np.str_), allow_pickle=False)
                archive.writestr(f"{name}.npy", buffer.getvalue())
        self.file.close()

    @staticmethod
    def _member(archive: zipfile.ZipFile, name: str, file: BinaryIO, shape: tuple[int, ...]) -> None:
        header = {"descr": "<f8", "fortran_order": False, "shape": shape}
        left = 8 * int(np.prod(shape))
        file.seek(0)
        with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(member, header)
            while left:
                piece = file.read(min(COPIED, left))
                member.write(piece)
                left -= len(piece)
        file.close()


class _Mat(_Writer):
    """Variables `time`, `values` (rows, signals), cell arrays `names` and `units`, `provenance`."""

    def __init__(self, path: Path, signals: Sequence[Signal], provenance: str) -> None:
        super().__init__(path, signals, provenance)
        self.time: list[Floats] = []
        self.values: list[Floats] = []

    def rows(self, time: Floats, values: Floats) -> None:
        if 8 * (self.whole_rows + len(time)) * max(1, len(self.signals)) > LARGEST_MAT:
            raise OSError(0, "a variable of a MAT-file holds less than 2 GiB; .npz and .parquet hold more")
        self.time.append(time)
        self.values.append(values)
        self.whole_rows += len(time)

    def finish(self) -> None:
        from scipy.io import savemat

        labels = _labels(self.signals, self.provenance)
        cells = {name: np.array(labels[name], dtype=object) for name in ("names", "units")}
        variables = {
            "time": np.concatenate(self.time)[:, None],
            "values": np.concatenate(self.values),
            "provenance": self.provenance,
            **{name: one.reshape(-1, 1) for name, one in cells.items()},
        }
        savemat(self.file, variables, do_compression=True)
        self.file.close()


def _labels(signals: Sequence[Signal], provenance: str) -> dict[str, Any]:
    return {
        "names": [one.name for one in signals],
        "units": [one.unit for one in signals],
        "provenance": provenance,
    }


_WRITERS: dict[str, Callable[[Path, Sequence[Signal], str], _Writer]] = {
    ".csv": _Csv,
    ".parquet": _Parquet,
    ".mat": _Mat,
    ".npz": _Npz,
}
