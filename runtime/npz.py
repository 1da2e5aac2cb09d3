"""Arrays from a file in NumPy's format NPZ, whoever wrote it.

Takes: the bytes of a file, the arrays that may be in it.
Gives: `read_arrays`; `DamageError`.
Guarantees: nothing is unpickled, or unpacked before its names and sizes are known to be those asked for; an
array has the type and the number of dimensions asked for.
Does not: open files (see `files.read_file`), or know what the numbers mean.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray


class DamageError(ValueError):
    """The description of an invalid file, for the user."""


def read_arrays(data: bytes, expected: Mapping[str, tuple[str, int]], most: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name.

    Parameters
    ----------
    data
        The file.
    expected
        The allowed contents: by a pattern of names, the type, as "<f8", and the number of dimensions.
    most
        The largest unpacked size in bytes.

    Raises
    ------
    DamageError
        The error text.
    """
    try:
        archive = NpzFile(io.BytesIO(data), allow_pickle=False)
        members = archive.zip.infolist()  # type: ignore[union-attr] # it is None when closed
    except Exception:  # of NumPy's, of zipfile's, of what unpacks, of what reads a header
        raise DamageError("it is no archive of arrays as NumPy writes them") from None
    if sum(member.file_size for member in members) > most:
        raise DamageError(f"it unpacks to more than {most >> 20} MiB")
    result = {}
    for member in members:
        name, suffix = member.filename[:-4], member.filename[-4:]
        kind = next((kind for pattern, kind in expected.items() if re.fullmatch(pattern, name)), None)
        if kind is None or suffix != ".npy":
            raise DamageError("it holds what does not belong there")
        result[name] = _array(archive, name, *kind)
    return result


def _array(archive: NpzFile, name: str, kind: str, dimensions: int) -> NDArray[Any]:
    """Return the array of a member of a file."""
    try:
        values = archive[name]
    except Exception:
        values = None
    if not isinstance(values, np.ndarray) or values.dtype.str != kind:
        raise DamageError(f"its {name} is no array of {kind}")
    if values.ndim != dimensions:
        raise DamageError(f"its {name} has {values.ndim} dimensions, not {dimensions}")
    if kind == "|b1" and values.view(np.uint8).max(initial=0) > 1:
        raise DamageError(f"its {name} holds what is neither yes nor no")
    return values
