"""The finished parts of a sweep on disk, so that nothing is computed twice.

Takes: the target of a sweep, a description of the sweep, cells as they come. Gives: `SweepParts`,
`open_parts`.
Guarantees: a part is there whole or not at all, whatever moment the process is killed at; what is damaged, or
was not written by this user's apc for this sweep, counts as not there; nothing else in the folder is touched.
Does not: compute, or write the target.

Beside `results.csv` stands the folder `results.csv.parts`. In it each finished part has a file, called
`part-7-` and the beginning of the sweep's digest: its seal, a line (see `seal`), and its cells as an NPZ.
"""

from __future__ import annotations

import hashlib
import hmac
import io
import json
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import RefusedError, is_special, read_file, unlink_link, unwritable, write_bytes
from apc.compiler.signing import seal
from apc.npz import read_arrays
from apc.sweeps.quantities import Cells

SUFFIX = ".parts"
_LARGEST = 1 << 28  # bytes of a part, which has ten thousand points at most
_ARRAYS = {"is_text": ("|b1", 1), "numbers": ("<f8", 2), "codes": ("<i4", 2), "texts": ("|u1", 1)}
_LOCAL = os.urandom(32)  # seals what this process alone takes up, where the user can have no secret


@dataclass(frozen=True, slots=True)
class SweepParts:
    """The folder of parts of the sweep of this digest; see `open_parts`."""

    folder: Path
    sweep: str

    def write(self, part: int, cells: Cells) -> None:
        """Keep the cells of a part. Raises ApcError E601 if they can't be written."""
        body = _packed(cells)
        content = self._seal(part, body) + b"\n" + body
        try:
            self.folder.mkdir(exist_ok=True)
            unlink_link(self._path(part))
            if is_special(self._path(part)):  # a pipe, say, which nobody reads
                self._path(part).unlink()
            write_bytes(self._path(part), content)
        except OSError as error:
            raise unwritable(self.folder, error) from error
        except ApcError:
            self._leave()
            raise

    def read(self, part: int) -> Cells | None:
        """Return the cells of a part, or None if it is damaged, not of this user's or isn't there."""
        try:
            text, _, body = read_file(self._path(part), _LARGEST).partition(b"\n")
        except RefusedError:
            return None
        if not hmac.compare_digest(text, self._seal(part, body)):
            return None
        return _unpacked(read_arrays(body, _ARRAYS, _LARGEST))

    def finished(self) -> set[int]:
        """Return the numbers of the parts that have a file, damaged or not. Raises ApcError E601."""
        try:
            listed = [path.name for path in self.folder.iterdir()]
        except FileNotFoundError:
            return set()
        except OSError as error:
            raise unwritable(self.folder, error) from error
        named = (re.fullmatch(self._path("([0-9]{1,9})").name, name) for name in listed)
        return {int(name[1]) for name in named if name}

    def remove(self) -> None:
        """Remove the parts, as the sweep is done. Raises ApcError E601 if they can't be."""
        for part in self.finished():
            try:
                self._path(part).unlink(missing_ok=True)
            except OSError as error:
                raise unwritable(self._path(part), error) from error
        self._leave()

    def _leave(self) -> None:
        """Remove the folder, unless there is something in it."""
        with suppress(OSError):
            self.folder.rmdir()

    def _path(self, part: int | str) -> Path:
        return self.folder / f"part-{part}-{self.sweep[:16]}"

    def _seal(self, part: int, body: bytes) -> bytes:
        content = f"sweep {self.sweep} {part}\n".encode() + body
        return (seal(content) or hmac.digest(_LOCAL, content, "sha256").hex()).encode()


def _packed(cells: Cells) -> bytes:
    """Return columns as the bytes of an NPZ file: each text once, and of a cell its place, −1 of none."""
    texts = {None: -1}
    codes = [
        [texts.setdefault(cell, len(texts) - 1) for cell in column.tolist()]
        for column in cells
        if column.dtype == object
    ]
    points = len(cells[0]) if cells else 0
    text = json.dumps([text for text in texts if text is not None]).encode()
    file = io.BytesIO()
    np.savez(
        file,
        is_text=np.array([column.dtype == object for column in cells], np.bool_),
        numbers=np.array([cell for cell in cells if cell.dtype != object], np.float64).reshape(-1, points),
        codes=np.array(codes, np.int32).reshape(-1, points),
        texts=np.frombuffer(text, np.uint8),
    )
    return file.getvalue()


def _unpacked(result: Mapping[str, NDArray[Any]]) -> Cells:
    """Return the columns of `_packed`."""
    numbers, codes = iter(result["numbers"]), iter(result["codes"])
    texts = np.array([*json.loads(result["texts"].tobytes()), None], dtype=object)
    return tuple(texts[next(codes)] if text else next(numbers) for text in result["is_text"].tolist())


def open_parts(target: Path, description: Mapping[str, Any]) -> SweepParts:
    """Return the parts of a sweep, those finished before included.

    Parameters
    ----------
    target
        The file the sweep is to end in; its parts stand in a folder beside it.
    description
        What the sweep is, as plain data of JSON: another description is another sweep.

    Raises
    ------
    ApcError
        E885 something else has the name of that folder.
    """
    folder = target.with_name(target.name + SUFFIX)
    if os.path.lexists(folder) and (folder.is_symlink() or not folder.is_dir()):
        message = "is there and is no folder, where apc sweep keeps its parts"
        raise ApcError(
            Diagnostic("E885", SourceLocation(str(folder)), message, hint=f"another --out than {target}")
        )
    return SweepParts(folder, hashlib.sha256(json.dumps(description).encode()).hexdigest())
