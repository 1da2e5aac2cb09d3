"""Trajectories as files, written as they come: CSV, Parquet, MAT, NPZ.

Takes: the blocks of a simulation. Gives: `Recording`, `open_recording`, `SUFFIXES`.
Guarantees: a file is there whole or not at all (see `files`); of a run that is cut short, by whatever it
be or as the disk is full, what was done is kept in a file that can be read: NAME.partial.csv and so on, where
a file of the name was there before. Except for MAT, whose format holds each variable in one piece, memory
does not grow with the duration.
Does not: compute, or know how a table is written (see `tables`).

Every file says what made it: in the schema's metadata (Parquet), the variable `provenance` (MAT, NPZ), or
beside it in NAME.csv.json, as a table's first line has to be its headings.
"""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import begin_file, drop_file, finish_file, is_special, partial_name
from apc.memory import refuse_beyond
from apc.present.simulation import provenance_json
from apc.simulation.blocks import Block
from apc.simulation.simulation import Simulation
from apc.simulation.trajectory import provenance_of
from apc.suffixes import check_suffix
from apc.tables import COPIED, ENDS, LETTER, WRITERS, Column, Writer, keep_room

Floats = NDArray[np.float64]

PROVENANCE = "provenance"
LARGEST_MAT = 2**31 - 2**20  # bytes: a variable of a MAT-file of version 5 is less than 2 GiB
# Bytes of a column and of a cell of the block that is written; what Parquet takes of a column, and of each
# block in it; a cell that waits for its MAT-file to be written.
COLUMN, CELL, IN_PARQUET, IN_MAT = 2000, 150, (24_000, 500), 32
LABEL = 256  # bytes of a name with its unit in a MAT- or NPZ-file, without the letters themselves


class Npz(Writer):
    """Arrays `values` (rows, signals), `time`, `names`, `units`, and what made them.

    An archive has a member's check sum in front of it, and an array its number of rows. So the values are
    written where they belong, behind a gap for both, and written over with themselves as the archive is
    made: it takes no more room than its own. The times wait in an unnamed file.
    """

    def __init__(self, path: Path, columns: Sequence[Column], about: tuple[str, str]) -> None:
        super().__init__(path, columns, about)
        self.times = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115 -- closed when it has been copied
        self.gap = self._gap()
        names = [one.name for one in columns]
        letters = sum(len(one.name) + len(one.unit) for one in columns)
        self.end = ENDS + LETTER * (len(about[1]) + 2 * max(map(len, names)) * len(names) + letters)

    def write(self, cells: Sequence[Any], count: int) -> None:
        """Keep room for so many rows, then write them."""
        before, after = self.whole_rows, self.whole_rows + count
        width = 8 * (len(self.columns) - 1)
        self.keep(self.gap + after * (width + 8) + self.end)
        keep_room(self.times, 8 * before, 8 * after)
        time, values = _apart(cells)
        for file, begin, array in (
            (self.times, 8 * before, time),
            (self.file, self.gap + width * before, values),
        ):
            file.seek(begin)
            file.write(np.ascontiguousarray(array, dtype="<f8").tobytes())
            file.flush()

    def finish(self) -> None:
        """Put an archive around the values."""
        self.file.seek(0)
        with self.path.open("rb") as itself, zipfile.ZipFile(self.file, "w", zipfile.ZIP_STORED) as archive:
            itself.seek(self.gap)
            self._member(archive, "values", itself, (self.whole_rows, len(self.columns) - 1))
            self.times.seek(0)
            self._member(archive, "time", self.times, (self.whole_rows,))
            for name, texts in _labels(self).items():
                buffer = io.BytesIO()
                np.save(buffer, np.array(texts, dtype=np.str_), allow_pickle=False)
                archive.writestr(f"{name}.npy", buffer.getvalue())
        self.cut()
        self.times.close()

    def close(self) -> None:
        """Close the files as they are."""
        super().close()
        self.times.close()

    def _gap(self) -> int:
        """Return where the values begin; NumPy leaves room for any number of rows in an array's header."""
        buffer = io.BytesIO()
        with (
            zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive,
            archive.open("values.npy", "w", force_zip64=True) as member,
        ):
            _array_header(member, (0, len(self.columns) - 1))
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


class Mat(Writer):
    """Variables `time`, `values` (rows, signals), cell arrays `names` and `units`, and what made them."""

    def __init__(self, path: Path, columns: Sequence[Column], about: tuple[str, str]) -> None:
        super().__init__(path, columns, about)
        self.blocks: list[tuple[Floats, Floats]] = []
        letters = sum(len(one.name) + len(one.unit) for one in columns) + len(about[1])
        self.end = ENDS + 2 * LABEL * len(columns) + LETTER * letters

    def write(self, cells: Sequence[Any], count: int) -> None:
        """Keep room for so many rows, and for the others that wait to be written with them."""
        after = self.whole_rows + count
        if 8 * after * max(1, len(self.columns) - 1) > LARGEST_MAT:
            raise OSError(0, "a variable of a MAT-file holds less than 2 GiB; .npz and .parquet hold more")
        numbers = 8 * after * len(self.columns)
        self.keep(self.end + numbers + numbers // 1000)  # zlib adds 0.03 % at most
        self.blocks.append(_apart(cells))

    def finish(self) -> None:
        """Write all variables."""
        from scipy.io import savemat

        labels = _labels(self)
        cells = {name: np.array(labels[name], dtype=object) for name in ("names", "units")}
        variables = {
            "time": np.concatenate([time for time, _ in self.blocks])[:, None],
            "values": np.concatenate([values for _, values in self.blocks]),
            self.about[0]: self.about[1],
            **{name: one.reshape(-1, 1) for name, one in cells.items()},
        }
        savemat(self.file, variables, do_compression=True)
        self.cut()


def _apart(cells: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return the first column (k,) and the others (k, n)."""
    time, *others = cells
    return time, np.stack(others, axis=1) if others else np.empty((len(time), 0))


def _labels(writer: Writer) -> dict[str, Any]:
    """Return what the values are, and what made them."""
    signals = writer.columns[1:]
    labels = {"names": [one.name for one in signals], "units": [one.unit for one in signals]}
    return {**labels, writer.about[0]: writer.about[1]}


FORMATS = WRITERS | {".mat": Mat, ".npz": Npz}
SUFFIXES = tuple(FORMATS)


class Recording:
    """A file being written. `take` each block, then `close`; `path`, which appears then, says where.

    When no more can be written, as the disk is full, `take` raises ApcError (E879) and the file is closed
    with what was written until then; without a row there is none.
    """

    def __init__(self, path: Path, simulation: Simulation) -> None:
        self.path = path
        self._until = 0.0  # seconds, the last row's time
        self._open = True
        self._files: dict[Path, str] = {}  # temporary, and what its name adds to that of the file
        about = provenance_json(provenance_of(simulation))
        columns = [Column("time", "s"), *(Column(one.name, one.unit) for one in simulation.signals)]
        try:
            temporary = self._temporary("")
            self._writer = FORMATS[check_suffix(path, SUFFIXES, "--out")](
                temporary, columns, (PROVENANCE, about)
            )
            if self._writer.plain and not is_special(path):  # now, while there is room
                beside = self._temporary(".json")
                beside.write_text(about + "\n", encoding="utf-8")
        except (OSError, ValueError) as error:
            self._away()
            raise self._failed(error) from error
        except ApcError:  # a library is missing
            self._away()
            raise

    def take(self, block: Block) -> None:
        """Write one block: all of it, or as many of its rows as there is room for."""
        done, step = 0, len(block.time)
        while done < len(block.time):
            some = slice(done, done + step)
            try:
                self._writer.rows([block.time[some], *block.values[some].T])
            except OSError as error:
                if step == 1:
                    raise self._rescued(error) from error
                step //= 2
            else:
                self._until = float(block.time[some][-1])
                done += step

    def close(self, *, partial: bool = False) -> None:
        """Finish the file and give it its name; `partial` if not all is in it. Raises ApcError (E879).

        Without a row there is no file, and once closed it stays so.
        """
        if not self._writer.whole_rows:
            self.discard()
        if not self._open:
            return
        try:
            self._finish(partial)
        except OSError as error:
            self.discard()
            raise self._failed(error) from error

    def discard(self) -> None:
        """Leave no trace."""
        if self._open:
            self._open = False
            self._writer.close()
            self._away()

    def _temporary(self, added: str) -> Path:
        temporary = begin_file(self._place(added))
        self._files[temporary] = added
        return temporary

    def _place(self, added: str) -> Path:
        return self.path.with_name(f"{self.path.name}{added}")

    def _away(self) -> None:
        while self._files:
            drop_file(self._files.popitem()[0])

    def _finish(self, partial: bool) -> None:
        self._writer.finish()
        if partial:
            self.path = partial_name(self.path)
        for temporary, added in [*self._files.items()]:
            finish_file(temporary, self._place(added))
            del self._files[temporary]
        self._open = False

    def _rescued(self, error: OSError) -> ApcError:
        """Keep what was written before the disk was full."""
        rows = self._writer.whole_rows
        try:
            self.close(partial=True)
        except ApcError as failed:
            return failed
        if not rows:
            return self._failed(error)
        what = f"holds the first {rows} rows only, up to {self._until:.9g} s: {_reason(error)}"
        return ApcError(Mistake("E879", Place(str(self.path)), what))

    def _failed(self, error: OSError | ValueError) -> ApcError:
        return ApcError(Mistake("E879", Place(str(self.path)), f"can't be written: {_reason(error)}"))


def open_recording(path: Path, simulation: Simulation) -> Recording:
    """Begin a file, its format chosen by the suffix.

    Raises
    ------
    ApcError
        E876 it would not fit the memory, E878 no such format, E879 it can't be written, E875 a library it
        needs is not installed.
    """
    suffix, columns = check_suffix(path, SUFFIXES, "--out"), len(simulation.signals) + 1
    block = min(simulation.rows, simulation.length * len(simulation.marks))
    each = COLUMN + CELL * block
    if suffix == ".mat":
        each += IN_MAT * simulation.rows
    elif suffix == ".parquet":
        each += IN_PARQUET[0] + IN_PARQUET[1] * -(-simulation.rows // block)
    needed, what = columns * each, f"{simulation.rows:,} rows of {columns:,} columns in {path.name}"
    refuse_beyond(needed, "E876", Place(simulation.system.origin.topology), what, "fewer --signals")
    return Recording(path, simulation)


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else "") or str(error)
