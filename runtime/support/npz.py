"""Safe reading of arrays from a file in NumPy's format NPZ.

Takes: the bytes of a file, the arrays that may be in it.
Gives: `read_arrays`; `DamageError`.
Guarantees: nothing is unpickled, or decompressed before names and sizes are checked; an array has the
expected type and number of dimensions.
Does not: open files (see `files.read_file`), or interpret the numbers.
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
    """The file is invalid; the text is the reason."""


def read_arrays(data: bytes, expected: Mapping[str, tuple[str, int]], most: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name.

    Parameters
    ----------
    data
        The bytes of the file.
    expected
        The valid arrays, by a pattern of the name: the type, such as "<f8", and the number of dimensions.
    most
        The largest decompressed size in bytes.

    Raises
    ------
    DamageError
        The file is invalid.
    """
    try:
        archive = NpzFile(io.BytesIO(data), allow_pickle=False)
        members = archive.zip.infolist()  # type: ignore[union-attr] # it is None when closed
    except Exception:  # errors of NumPy, zipfile, decompression and header parsing
        raise DamageError("it is not a NumPy archive") from None
    if sum(member.file_size for member in members) > most:
        raise DamageError(f"it unpacks to more than {most >> 20} MiB")
    result = {}
    for member in members:
        name, suffix = member.filename[:-4], member.filename[-4:]
        kind = next((kind for pattern, kind in expected.items() if re.fullmatch(pattern, name)), None)
        if kind is None or suffix != ".npy":
            raise DamageError("it contains unexpected entries")
        result[name] = _array(archive, name, *kind)
    return result


def _array(archive: NpzFile, name: str, kind: str, dimensions: int) -> NDArray[Any]:
    """Return an array of a file. Raises DamageError for another type or number of dimensions."""
    try:
        values = archive[name]
    except Exception:
        values = None
    if not isinstance(values, np.ndarray) or values.dtype.str != kind:
        raise DamageError(f"its {name} is not an array of {kind}")
    if values.ndim != dimensions:
        raise DamageError(f"its {name} has {values.ndim} dimensions, not {dimensions}")
    if kind == "|b1" and values.view(np.uint8).max(initial=0) > 1:
        raise DamageError(f"its {name} contains values other than true and false")
    return values
