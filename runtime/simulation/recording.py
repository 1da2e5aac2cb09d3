"""Trajectories as files, written as they come: CSV, Parquet, MAT, NPZ.

Takes: the blocks of a simulation. Gives: `Recording`, `open_recording`, `SUFFIXES`.
Guarantees: a file is there whole or not at all (see `files`); of a run that is cut short, by whatever it
be or as the disk is full, what was done is kept in a file that can be read: NAME.partial.csv and so on, where
a file of the name was there before.
Does not: compute, or know how a format is written (see `formats`).

Every file says what made it: in the schema's metadata (Parquet), the variable `provenance` (MAT, NPZ), or
beside it in NAME.csv.json, as a table's first line has to be its headings.
"""

from __future__ import annotations

from pathlib import Path

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import begin_file, drop_file, finish_file, is_special, partial_name
from apc.simulation.blocks import Block
from apc.simulation.formats import WRITERS
from apc.simulation.simulation import Simulation
from apc.simulation.trajectory import provenance_of
from apc.suffixes import check_suffix

SUFFIXES = tuple(WRITERS)


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
        provenance = provenance_of(simulation).to_json()
        try:
            temporary = self._temporary("")
            self._writer = WRITERS[check_suffix(path, SUFFIXES, "--out")](
                temporary, simulation.signals, provenance
            )
            if self._writer.beside and not is_special(path):  # now, while there is room
                beside = self._temporary(".json")
                beside.write_text(self._writer.beside, encoding="utf-8")
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
                self._writer.rows(block.time[some], block.values[some])
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
        for temporary in self._files:
            drop_file(temporary)

    def _finish(self, partial: bool) -> None:
        self._writer.finish()
        if partial:
            self.path = partial_name(self.path)
        for temporary, added in self._files.items():
            finish_file(temporary, self._place(added))
        self._away()
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
        E878 no such format, E879 it can't be written, E875 a library it needs is not installed.
    """
    return Recording(path, simulation)


def _reason(error: OSError | ValueError) -> str:
    return (error.strerror if isinstance(error, OSError) else "") or str(error)
