"""Trajectory files, written block by block: CSV, Parquet, MAT, NPZ.

Takes: the blocks of a simulation. Gives: `Recording`, `open_recording`, `SUFFIXES`.
Guarantees: files appear complete or not at all (see `files`). An interrupted run, also by a full disk, leaves
a readable file of the finished part; its name is NAME.partial.csv etc. if a file of the name existed. Memory
does not grow with the duration, except for MAT and NPZ, which need each variable in one piece; oversized
variables are refused.
Does not: compute, or write table formats (see `tables`).

Every file has its provenance: in the schema's metadata (Parquet), the variable `provenance` (MAT, NPZ), or a
separate file NAME.csv.json, as the first line of a table must be its headings.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import Temporary, begin_file, drop_file, finish_file, is_special, partial_name
from apc.output.simulation_output import provenance_json
from apc.simulation.output_blocks import OutputBlock
from apc.simulation.simulation import Simulation
from apc.simulation.trajectory import provenance_of
from apc.support.memory import refuse_beyond
from apc.support.suffixes import check_suffix
from apc.support.tables import ENDS, LETTER, WRITERS, TableColumn, TableWriter

Floats = NDArray[np.float64]

PROVENANCE = "provenance"
LARGEST_MAT = 2**31 - 2**20  # bytes: a variable of a MAT-file of version 5 is less than 2 GiB
# Bytes of a column and of a cell of the block that is written; what Parquet takes of a column, and of each
# block in it; a cell that waits for its file to be written in one piece.
COLUMN, CELL, IN_PARQUET, WAITING = 2000, 150, (24_000, 500), 32
LABEL = 256  # bytes of a name with its unit in a MAT- or NPZ-file, without the letters themselves


class Arrays(TableWriter):
    """A file of `time`, `values` (rows, signals), `names`, `units` and the provenance; abstract.

    They are written in one piece: the rows wait in the memory, and room is kept for them on the disk.
    """

    def __init__(self, path: Path, columns: Sequence[TableColumn], description: tuple[str, str]) -> None:
        super().__init__(path, columns, description)
        self.blocks: list[Floats] = []
        longest = max(len(column.name) + len(column.unit) for column in columns)
        self.end = (
            ENDS + 2 * LABEL * len(columns) + LETTER * (2 * longest * len(columns) + len(description[1]))
        )

    def write(self, cells: Sequence[Any], count: int) -> None:
        """Reserve space for a number of rows, including the buffered ones."""
        numbers = 8 * (self.whole_rows + count) * len(self.columns)
        self.keep(self.end + numbers + numbers // 1000)  # zlib adds 0.03 % at most
        self.blocks.append(np.stack(cells, axis=1))

    def finish(self) -> None:
        """Write all variables."""
        time, values = np.hsplit(np.concatenate(self.blocks), [1])
        names, units = ([getattr(column, which) for column in self.columns[1:]] for which in ("name", "unit"))
        self.save(
            {
                "time": time,
                "values": values,
                "names": names,
                "units": units,
                self.description[0]: self.description[1],
            }
        )
        self.cut()

    @abstractmethod
    def save(self, variables: dict[str, Any]) -> None:
        """Write the variables: `time` (rows, 1), `values` (rows, signals), lists of texts and a text."""


class Npz(Arrays):
    """Arrays as NumPy's `load` reads them, `time` (rows,)."""

    def save(self, variables: dict[str, Any]) -> None:
        """Write an archive that is not packed."""
        variables["time"] = variables["time"][:, 0]
        np.savez(self.file, **variables)


class Mat(Arrays):
    """A MAT-file of version 5; `names` and `units` are cell arrays."""

    def write(self, cells: Sequence[Any], count: int) -> None:
        """Reserve space for a number of rows. Raises OSError if a variable is too large for the format."""
        if 8 * (self.whole_rows + count) * max(1, len(self.columns) - 1) > LARGEST_MAT:
            raise OSError(0, "a variable of a MAT-file holds less than 2 GiB; .npz and .parquet hold more")
        super().write(cells, count)

    def save(self, variables: dict[str, Any]) -> None:
        """Write the file, packed."""
        from scipy.io import savemat

        for name in ("names", "units"):
            variables[name] = np.array(variables[name], dtype=object).reshape(-1, 1)
        savemat(self.file, variables, do_compression=True)


FORMATS = WRITERS | {".mat": Mat, ".npz": Npz}
SUFFIXES = tuple(FORMATS)


class Recording:
    """A file being written. `take` each block, then `close`; `path` is its final location.

    On a write error, such as a full disk, `take` raises ApcError (E879), and the file is closed with the rows
    written until then; without rows there is no file.
    """

    def __init__(self, path: Path, simulation: Simulation) -> None:
        self.path = path
        self._until = 0.0  # seconds, the last row's time
        self._files: dict[Temporary, str] = {}  # temporary, and what its name adds to that of the file
        description = provenance_json(provenance_of(simulation))
        columns = [
            TableColumn("time", "s"),
            *(TableColumn(signal.name, signal.unit) for signal in simulation.signals),
        ]
        try:
            make = FORMATS[check_suffix(path, SUFFIXES, "--out")]
            self._writer = make(self._temporary(""), columns, (PROVENANCE, description))
            if self._writer.plain and not is_special(path):  # now, while there is room
                self._temporary(".json").write_text(description + "\n", encoding="utf-8")
        except (OSError, ValueError) as error:
            self._drop()
            raise self._failed(error) from error
        except ApcError:  # a library is missing
            self._drop()
            raise

    @property
    def rows(self) -> int:
        """The number of completely written rows."""
        return self._writer.whole_rows

    def take(self, block: OutputBlock) -> None:
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
        """Finish the file and give it its name; without a written row, delete it.

        `partial` states that blocks are missing: the name is then NAME.partial.csv etc. Later calls have no
        effect. Raises ApcError (E879) if the file cannot be written.
        """
        if not self._writer.whole_rows:
            self.discard()
        if not self._files:
            return
        try:
            self._writer.finish()
            if partial:
                self.path = partial_name(self.path)
            for temporary, suffix in [*self._files.items()]:
                finish_file(temporary, self._part_path(suffix))
                del self._files[temporary]
        except OSError as error:
            self.discard()
            raise self._failed(error) from error

    def discard(self) -> None:
        """Leave no trace of a file that is not closed."""
        if self._files:
            self._writer.close()
            self._drop()

    def _temporary(self, added: str) -> Path:
        temporary = begin_file(self._part_path(added))
        self._files[temporary] = added
        return temporary.path

    def _part_path(self, added: str) -> Path:
        return self.path.with_name(f"{self.path.name}{added}")

    def _drop(self) -> None:
        while self._files:
            drop_file(self._files.popitem()[0])

    def _rescued(self, error: OSError) -> ApcError:
        """Keep the rows written before the disk was full."""
        rows = self._writer.whole_rows
        try:
            self.close(partial=True)
        except ApcError as failed:
            return failed
        message = f"holds the first {rows} rows only, up to {self._until:.9g} s: {_reason(error)}"
        return (
            ApcError(Diagnostic("E879", SourceLocation(str(self.path)), message))
            if rows
            else self._failed(error)
        )

    def _failed(self, error: OSError | ValueError) -> ApcError:
        return ApcError(
            Diagnostic("E879", SourceLocation(str(self.path)), f"can't be written: {_reason(error)}")
        )


def open_recording(path: Path, simulation: Simulation) -> Recording:
    """Return an open recording of a simulation; the suffix selects the file format.

    Raises
    ------
    ApcError
        E876 the file needs too much memory, E878 unknown format, E879 it can't be written, E875 a required
        library is not installed.
    """
    suffix, columns = check_suffix(path, SUFFIXES, "--out"), len(simulation.signals) + 1
    block = min(simulation.rows, simulation.length * len(simulation.sample_times))
    each = COLUMN + CELL * block
    if suffix in (".mat", ".npz"):
        each += WAITING * simulation.rows
    elif suffix == ".parquet":
        each += IN_PARQUET[0] + IN_PARQUET[1] * -(-simulation.rows // block)
    needed, contents = columns * each, f"{simulation.rows:,} rows of {columns:,} columns in {path.name}"
    refuse_beyond(
        needed, "E876", SourceLocation(simulation.model.origin.topology), contents, "record fewer --signals"
    )
    return Recording(path, simulation)


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else "") or str(error)
