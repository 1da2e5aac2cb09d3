"""The finished parts of a sweep on disk, so that nothing is computed twice.

Takes: the target of a sweep, a description of the sweep, cells as they come.
Gives: `Parts`, `open_parts`, `remove_parts`.
Guarantees: a part is there whole or not at all, whatever moment the process is killed at; a damaged part, or
one of another sweep, counts as not there; one process at a time works on a target; no folder is touched that
`apc sweep` did not make, and no file in it but its own.
Does not: compute, or write the target.

Beside `results.csv` stands the folder `results.csv.parts`:

    manifest.json   that `apc sweep` made the folder, and for which sweep: model, axes, versions
    lock            held by the process at work, freed by the system when it ends, however it ends
    part-7.npz      the SHA-256 of the rest of the file, a line; the cells of part 7, with the sweep's digest
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.files import RefusedError, read_file, unwritable, write_file
from apc.compiler.frozen import dataclass
from apc.sweeps.quantities import Cells

SUFFIX = ".parts"
_MANIFEST = "manifest.json"
_LOCK = "lock"
_MARK = {"made by": "apc sweep"}  # in the manifest
_LARGEST = 1 << 30  # bytes of a manifest, which holds the values of all axes, or of a part
_OWN = re.compile(rf"({_LOCK}|part-[0-9]+\.npz)\Z")
_HALF = re.compile(rf"\.({re.escape(_MANIFEST)}|part-[0-9]+\.npz)\.\w+\Z")  # what a killed process had begun


@dataclass(frozen=True, slots=True)
class Parts:
    """The folder of parts of the sweep of this digest; see `open_parts`."""

    folder: Path
    sweep: str

    def write(self, part: int, cells: Cells) -> None:
        """Keep the cells of a part. Raises ApcError E601 if they can't be written."""
        body = _packed(cells, self.sweep, part)
        digest = hashlib.sha256(body).hexdigest().encode()
        write_file(self._path(part), lambda path: _fill(path, digest + b"\n" + body))

    def read(self, part: int) -> Cells | None:
        """Return the cells of a part, or None if it is damaged, another sweep's or isn't there."""
        try:
            digest, _, body = read_file(self._path(part), _LARGEST).partition(b"\n")
        except RefusedError:
            return None
        if hashlib.sha256(body).hexdigest().encode() != digest:
            return None
        found = np.load(io.BytesIO(body))
        if (str(found["sweep"]), int(found["part"])) != (self.sweep, part):
            return None
        return _unpacked(found)

    def there(self) -> set[int]:
        """Return the numbers of the parts that have a file, damaged or not."""
        names = (path.stem.removeprefix("part-") for path in self.folder.glob("part-*.npz"))
        return {int(name) for name in names if name.isdecimal()}

    def _path(self, part: int) -> Path:
        return self.folder / f"part-{part}.npz"


def _packed(cells: Cells, sweep: str, part: int) -> bytes:
    """Return columns as the bytes of an NPZ file: each text once, and of a cell its place, −1 of none."""
    texts = {None: -1}
    codes = [
        [texts.setdefault(cell, len(texts) - 1) for cell in column.tolist()]
        for column in cells
        if column.dtype == object
    ]
    file = io.BytesIO()
    np.savez(
        file,
        is_text=np.array([column.dtype == object for column in cells]),
        numbers=np.array([column for column in cells if column.dtype != object]),
        codes=np.array(codes, dtype=np.int32),
        texts=np.array([text for text in texts if text is not None], dtype=np.str_),
        sweep=np.array(sweep),
        part=np.array(part),
    )
    return file.getvalue()


def _unpacked(found: Mapping[str, NDArray[Any]]) -> Cells:
    """Return the columns of `_packed`."""
    numbers, codes = iter(found["numbers"]), iter(found["codes"])
    texts = np.array([*found["texts"].tolist(), None], dtype=object)
    return tuple(texts[next(codes)] if text else next(numbers) for text in found["is_text"].tolist())


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
        E601 the folder can't be written; E885 it is no folder of `apc sweep`'s or holds parts of another
        sweep, or a process works on it.
    """
    folder = target.with_name(target.name + SUFFIX)
    whole = json.dumps({**_MARK, **description}, indent=1)
    _remove(_finished(target))  # what a process left that was killed while it tidied up
    lock = _locked(folder, whole)
    try:
        _check(folder, target, json.loads(whole))
        for path in folder.iterdir():
            if _HALF.match(path.name):
                path.unlink(missing_ok=True)
        yield Parts(folder, hashlib.sha256(whole.encode()).hexdigest())
    finally:
        if not any(folder.glob("part-*.npz")) and _is_current(lock, folder / _LOCK):
            _remove(folder)  # nothing came of it
        lock.close()


def remove_parts(target: Path) -> None:
    """Remove the parts of a sweep that is done. They go at once, or the target would look unfinished."""
    folder = target.with_name(target.name + SUFFIX)
    done = _finished(target)
    _remove(done)
    if os.path.lexists(done):  # somebody else's
        _remove(folder)
        return
    try:
        folder.rename(done)
    except OSError as error:
        raise unwritable(folder, error) from error
    _remove(done)


def _finished(target: Path) -> Path:
    return target.with_name(f".{target.name}.finished")


def _remove(folder: Path) -> None:
    """Remove a folder that `apc sweep` made, but for what others put into it."""
    if _manifest(folder) is None:
        return
    with suppress(OSError):
        for path in folder.iterdir():
            if _OWN.match(path.name) or _HALF.match(path.name):
                path.unlink(missing_ok=True)
        (folder / _MANIFEST).unlink()  # last, as it says whose the folder is
        folder.rmdir()


def _manifest(folder: Path) -> dict[str, Any] | None:
    """Return what a folder says it was made for, None if `apc sweep` did not make it."""
    try:
        if folder.is_symlink() or not folder.is_dir():
            return None
        found = json.loads(read_file(folder / _MANIFEST, _LARGEST))
    except (RefusedError, OSError, ValueError):
        return None
    return found if isinstance(found, dict) and found.items() >= _MARK.items() else None


def _fill(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def _check(folder: Path, target: Path, mine: Mapping[str, Any]) -> None:
    """Refuse a folder that is another sweep's."""
    theirs = _manifest(folder)
    if theirs is None:
        raise _foreign(folder, target)
    if theirs != mine:
        different = [key for key in {**mine, **theirs} if theirs.get(key) != mine.get(key)]
        what = f"holds unfinished work of another sweep: different are its {', '.join(different)}"
        hint = f"another --out than {target}, or delete that folder"
        raise ApcError(Mistake("E885", Place(str(folder)), what, hint=hint))


def _foreign(folder: Path, target: Path) -> ApcError:
    what = "is there and was not made by apc sweep, which keeps its parts in a folder of that name"
    return ApcError(Mistake("E885", Place(str(folder)), what, hint=f"another --out than {target}"))


def _locked(folder: Path, manifest: str) -> IO[bytes]:
    """Make the folder if there is none, and return its lock, held."""
    target = folder.with_name(folder.name.removesuffix(SUFFIX))
    try:
        while True:
            if not os.path.lexists(folder):
                _make(folder, manifest)
            if _manifest(folder) is None:
                if not os.path.lexists(folder):
                    continue  # the process that held it was done and removed it
                raise _foreign(folder, target)
            try:
                lock = (folder / _LOCK).open("ab")
            except FileNotFoundError:
                continue
            if not _try_lock(lock):
                lock.close()
                what = "is being worked on by another process; wait for it, or choose another --out"
                raise ApcError(Mistake("E885", Place(str(folder)), what))
            if _is_current(lock, folder / _LOCK):
                return lock
            lock.close()  # between opening and locking it was removed
    except OSError as error:
        raise unwritable(folder, error) from error


def _make(folder: Path, manifest: str) -> None:
    """Make the folder with its manifest in it, at once; if another process has just made it, leave that."""
    with tempfile.TemporaryDirectory(prefix=f".{folder.name[:64]}.", dir=folder.parent) as name:
        made = Path(name) / "made"
        made.mkdir()
        _fill(made / _MANIFEST, f"{manifest}\n".encode())
        try:
            made.rename(folder)
        except OSError:
            if not os.path.lexists(folder):
                raise


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
