"""The finished parts of a sweep on disk, so that nothing is computed twice.

Takes: the target of a sweep, a description of the sweep, rows as they come.
Gives: `Parts`, `open_parts`, `remove_parts`.
Guarantees: a part is there whole or not at all, whatever moment the process is killed at; a damaged part
counts as not there; parts of another sweep are never mixed in; one process at a time works on a target.
Does not: compute, or write the target.

Beside `results.csv` stands the folder `results.csv.parts`:

    lock            held by the process at work, freed by the system when it ends, however it ends
    manifest.json   what the sweep is: model, axes, versions
    part-7.json     the SHA-256 of the rest of the file, a line; and the rows of part 7
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import write_file
from apc.runtime.sweep.quantities import Row

SUFFIX = ".parts"
_MANIFEST = "manifest.json"
_LOCK = "lock"


@dataclass(frozen=True, slots=True)
class Parts:
    """The folder of parts of one sweep; see `open_parts`."""

    folder: Path

    def write(self, part: int, rows: tuple[Row, ...]) -> None:
        """Keep the rows of a part. Raises ApcError E601 if they can't be written."""
        body = json.dumps({"part": part, "rows": rows}, ensure_ascii=False, allow_nan=False).encode()
        digest = hashlib.sha256(body).hexdigest().encode()
        write_file(self._path(part), lambda path: _fill(path, digest + b"\n" + body))

    def read(self, part: int) -> tuple[Row, ...] | None:
        """Return the rows of a part, or None if the part is damaged or isn't there."""
        try:
            digest, _, body = self._path(part).read_bytes().partition(b"\n")
        except OSError:
            return None
        if hashlib.sha256(body).hexdigest().encode() != digest:
            return None
        document = json.loads(body)
        return tuple(tuple(row) for row in document["rows"]) if document["part"] == part else None

    def there(self) -> set[int]:
        """Return the numbers of the parts that have a file, damaged or not."""
        names = (path.stem.removeprefix("part-") for path in self.folder.glob("part-*.json"))
        return {int(name) for name in names if name.isdecimal()}

    def _path(self, part: int) -> Path:
        return self.folder / f"part-{part}.json"


@contextmanager
def open_parts(target: Path, description: Mapping[str, Any]) -> Iterator[Parts]:
    """Hold the parts of a sweep, those finished before included.

    Parameters
    ----------
    target
        The file the sweep is to end in; its parts stand in a folder beside it.
    description
        What the sweep is, as plain data of JSON: another description is another sweep.

    Raises
    ------
    ApcError
        E601 the folder can't be written; E885 it holds parts of another sweep, or a process works on it.
    """
    folder = target.with_name(target.name + SUFFIX)
    _remove(_finished(target))  # what a process left that was killed while it tidied up
    lock = _locked(folder)
    try:
        _claim(folder, target, description)
        for path in folder.glob(".*"):  # files of which a killed process had written a part
            path.unlink(missing_ok=True)
        yield Parts(folder)
    finally:
        if not any(folder.glob("part-*.json")) and _is_current(lock, folder / _LOCK):
            _remove(folder)  # nothing came of it
        lock.close()


def remove_parts(target: Path) -> None:
    """Remove the parts of a sweep that is done. They go at once, or the target would look unfinished."""
    folder = target.with_name(target.name + SUFFIX)
    done = _finished(target)
    _remove(done)
    try:
        folder.rename(done)
    except OSError as error:
        raise _unwritable(folder, error) from error
    _remove(done)


def _finished(target: Path) -> Path:
    return target.with_name(f".{target.name}.finished")


def _remove(folder: Path) -> None:
    if folder.is_dir():
        shutil.rmtree(folder, ignore_errors=True)


def _fill(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def _claim(folder: Path, target: Path, description: Mapping[str, Any]) -> None:
    """Write what the sweep is, or check that the parts there are this sweep's."""
    manifest = folder / _MANIFEST
    mine = json.loads(json.dumps(description))
    try:
        theirs = json.loads(manifest.read_bytes())
    except FileNotFoundError:
        text = json.dumps(description, ensure_ascii=False, indent=1)
        write_file(manifest, lambda path: _fill(path, f"{text}\n".encode()))
        return
    except OSError as error:
        raise _unwritable(folder, error) from error
    except ValueError:
        theirs = {}
    if theirs != mine:
        different = [key for key in mine if not isinstance(theirs, dict) or theirs.get(key) != mine[key]]
        what = f"holds unfinished work of another sweep: different are its {', '.join(different)}"
        hint = f"another --out than {target}, or delete that folder"
        raise ApcError(Mistake("E885", Place(str(folder)), what, hint=hint))


def _locked(folder: Path) -> IO[bytes]:
    """Make the folder and return its lock, held."""
    try:
        while True:
            folder.mkdir(exist_ok=True)
            lock = (folder / _LOCK).open("ab")
            if not _try_lock(lock):
                lock.close()
                what = "is being worked on by another process; wait for it, or choose another --out"
                raise ApcError(Mistake("E885", Place(str(folder)), what))
            if _is_current(lock, folder / _LOCK):
                return lock
            lock.close()  # between opening and locking, the process that held it was done and removed it
    except OSError as error:
        raise _unwritable(folder, error) from error


def _is_current(lock: IO[bytes], path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(lock.fileno()), path.stat())
    except FileNotFoundError:
        return False


def _try_lock(lock: IO[bytes]) -> bool:
    """Lock an open file if nobody else holds it; the system frees it with the process."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(lock.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        return False
    return True


def _unwritable(folder: Path, error: OSError) -> ApcError:
    return ApcError(Mistake("E601", Place(str(folder)), f"can't be written: {error.strerror or error}"))
