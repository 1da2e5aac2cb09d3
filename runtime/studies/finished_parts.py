"""The finished parts of a sweep on disk, for a later continuation.

Takes: the target of a sweep, a description of the sweep, the cells of each part. Gives: `SweepParts`,
`open_parts`.
Guarantees: a part is stored completely or not at all, also if the process is killed; a part that is damaged,
or was not written by this user's apc for this sweep, counts as missing; other files in the folder are
unchanged.
Does not: compute, or write the target.

The folder of `results.csv` is `results.csv.parts`, next to it. Each finished part has a file named `part-7-`
and the beginning of the sweep's digest: a line with its seal (see `seal`), then its cells as an NPZ.
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
from apc.studies.quantities import Cells
from apc.support.npz import read_arrays

SUFFIX = ".parts"
_LARGEST = 1 << 28  # bytes of a part, which has ten thousand points at most
_ARRAYS = {"is_text": ("|b1", 1), "numbers": ("<f8", 2), "codes": ("<i4", 2), "texts": ("|u1", 1)}
_LOCAL = os.urandom(32)  # key of seals for this process only, if the user has no stored key


@dataclass(frozen=True, slots=True)
class SweepParts:
    """The folder of parts of the sweep of this digest; see `open_parts`."""

    folder: Path
    sweep: str

    def write(self, part: int, cells: Cells) -> None:
        """Store the cells of a part; ApcError E601 if they cannot be written."""
        body = _to_npz(cells)
        content = self._seal(part, body) + b"\n" + body
        try:
            self.folder.mkdir(exist_ok=True)
            unlink_link(self._path(part))
            if is_special(self._path(part)):  # for example a pipe without a reader
                self._path(part).unlink()
            write_bytes(self._path(part), content)
        except OSError as error:
            raise unwritable(self.folder, error) from error
        except ApcError:
            self._remove_empty_folder()
            raise

    def read(self, part: int) -> Cells | None:
        """Return the cells of a part, None if the part is missing, damaged, or of another user."""
        try:
            text, _, body = read_file(self._path(part), _LARGEST).partition(b"\n")
        except RefusedError:
            return None
        if not hmac.compare_digest(text, self._seal(part, body)):
            return None
        return _from_npz(read_arrays(body, _ARRAYS, _LARGEST))

    def finished(self) -> set[int]:
        """Return the indices of the parts that have a file, damaged or not; ApcError E601 if unreadable."""
        try:
            file_names = [path.name for path in self.folder.iterdir()]
        except FileNotFoundError:
            return set()
        except OSError as error:
            raise unwritable(self.folder, error) from error
        matches = (re.fullmatch(self._path("([0-9]{1,9})").name, name) for name in file_names)
        return {int(name[1]) for name in matches if name}

    def remove(self) -> None:
        """Remove the files of all parts and the folder; ApcError E601 if they cannot be removed."""
        for part in self.finished():
            try:
                self._path(part).unlink(missing_ok=True)
            except OSError as error:
                raise unwritable(self._path(part), error) from error
        self._remove_empty_folder()

    def _remove_empty_folder(self) -> None:
        """Remove the folder if it is empty."""
        with suppress(OSError):
            self.folder.rmdir()

    def _path(self, part: int | str) -> Path:
        """Return the path of a part's file."""
        return self.folder / f"part-{part}-{self.sweep[:16]}"

    def _seal(self, part: int, body: bytes) -> bytes:
        """Return the seal of a part's content."""
        content = f"sweep {self.sweep} {part}\n".encode() + body
        return (seal(content) or hmac.digest(_LOCAL, content, "sha256").hex()).encode()


def _to_npz(cells: Cells) -> bytes:
    """Return columns as the bytes of an NPZ file: each text once, text cells as indices, −1 for none."""
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


def _from_npz(result: Mapping[str, NDArray[Any]]) -> Cells:
    """Return the columns of an NPZ file written by `_to_npz`."""
    numbers, codes = iter(result["numbers"]), iter(result["codes"])
    texts = np.array([*json.loads(result["texts"].tobytes()), None], dtype=object)
    return tuple(texts[next(codes)] if text else next(numbers) for text in result["is_text"].tolist())


def open_parts(target: Path, description: Mapping[str, Any]) -> SweepParts:
    """Return the storage of a sweep's parts, with the parts finished earlier.

    Parameters
    ----------
    target
        The target file of the sweep; its parts are in a folder next to it.
    description
        The description of the sweep, as plain data of JSON; another description is another sweep.

    Raises
    ------
    ApcError
        E885 the folder's name is that of a file or link.
    """
    folder = target.with_name(target.name + SUFFIX)
    if os.path.lexists(folder) and (folder.is_symlink() or not folder.is_dir()):
        message = "already exists and is not a folder; apc sweep stores its parts there"
        advice = f"choose another --out than {target}"
        raise ApcError(Diagnostic("E885", SourceLocation(str(folder)), message, advice=advice))
    return SweepParts(folder, hashlib.sha256(json.dumps(description).encode()).hexdigest())
