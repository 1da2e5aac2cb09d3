"""Arrays from a file in NumPy's format NPZ, whoever wrote it.

Takes: the bytes of a file, the arrays that may be in it. Gives: `read_arrays`.
Guarantees: nothing is unpickled, or unpacked before its names and sizes are known to be those asked for; an
array has the type and the number of dimensions asked for, and as many numbers as it says.
Does not: open files (see `files.read_file`), or know what the numbers mean.
"""

from __future__ import annotations

import io
import lzma
import math
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOST_LISTED = 2**22  # bytes of an archive's list of members: each takes ten times that of memory
# What zipfile and its decompressors raise at what isn't theirs.
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, struct.error, EOFError, NotImplementedError),
    *(ValueError, RuntimeError),
)
# How NumPy begins an array of numbers in a file (format 1.0): type, order, shape. NumPy's own reader of it
# warns of what is nearly one, and raises what its parser does: here either it is one or it is not.
_HEAD = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '([<|][a-z][0-9]{1,2})', 'fortran_order': (False|True), "
    rb"'shape': \(((?:[0-9]{1,15}, ?)*(?:[0-9]{1,15})?)\), \} *\n",
    re.DOTALL,
)


class DamageError(ValueError):
    """What is wrong with a file, for a person."""


def read_arrays(data: bytes, expected: Mapping[str, tuple[str, int]], most: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file by name.

    Parameters
    ----------
    data
        The file.
    expected
        What may be in it: by a pattern of names, the type, as "<f8", and the number of dimensions.
    most
        How many bytes all of it may unpack to.

    Raises
    ------
    DamageError
        What is wrong with it, in words.
    """
    names = re.compile("|".join(rf"(?:{pattern})\.npy" for pattern in expected))
    try:
        members = _unzipped(data, most, names)
    except DamageError:
        raise
    except _DAMAGE:
        raise DamageError("it is no archive of arrays as NumPy writes them") from None
    found = {}
    for member, content in members.items():
        name = member.removesuffix(".npy")
        kind = next(kind for pattern, kind in expected.items() if re.fullmatch(pattern, name))
        found[name] = _array(name, content, *kind)
    return found


def _unzipped(data: bytes, most: int, names: re.Pattern[str]) -> dict[str, bytes]:
    """Return the members of a ZIP archive.

    Parameters
    ----------
    data
        The archive.
    most
        How many bytes all of them may have.
    names
        What each must be called.

    Raises
    ------
    DamageError
        It unpacks to more, or a member is called otherwise.
    ValueError
        Or another of _DAMAGE: it is none, or holds a name twice.
    """
    _check_end(data)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        listed = archive.infolist()
        if any(one.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) for one in listed):
            raise ValueError("it is packed otherwise")
        if sum(one.file_size for one in listed) > most:
            raise DamageError(f"it unpacks to more than {most >> 20} MiB")
        if not all(names.fullmatch(one.filename) for one in listed):
            raise DamageError("it holds what does not belong there")
        if len({one.filename for one in listed}) < len(listed):
            raise ValueError("it holds a name twice")
        return {one.filename: _member(archive, one) for one in listed}


def _check_end(data: bytes) -> None:
    """Check that an archive ends where its file does, and that its list of members is no larger than said.

    The last bytes of a ZIP archive: a mark, four numbers of disks and members, how long the list is and where
    it begins, how long a comment. A longer form of the same may be pointed at before: no model needs it.
    """
    end = struct.Struct("<4s4H2LH")
    mark, *_, size, begin, comment = end.unpack(data[-end.size :])
    longer = data[-end.size - 20 :].startswith(b"PK\x06\x07")
    if mark != b"PK\x05\x06" or comment or longer or begin + size + end.size != len(data):
        raise ValueError("there is something else in it")
    if size > MOST_LISTED:
        raise DamageError(f"its list of members is larger than {MOST_LISTED >> 20} MiB")


def _member(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Return a member, no more of it than the archive's list says, whatever it would unpack to."""
    with archive.open(member) as stream:
        return stream.read(member.file_size)


def _array(name: str, content: bytes, kind: str, dimensions: int) -> NDArray[Any]:
    """Return the array of a member of a file."""
    head = _HEAD.match(content)
    if head is None or head[1].decode() != kind:
        raise DamageError(f"its {name} is no array of {kind}")
    shape = tuple(int(size) for size in re.findall(rb"[0-9]+", head[3]))
    numbers = memoryview(content)[head.end() :]
    if len(shape) != dimensions:
        raise DamageError(f"its {name} has {len(shape)} dimensions, not {dimensions}")
    if len(numbers) != math.prod(shape) * np.dtype(kind).itemsize:
        raise DamageError(f"its {name} holds more or less than it says")
    if kind == "|b1" and bytes(numbers).translate(None, b"\0\1"):
        raise DamageError(f"its {name} holds what is neither yes nor no")
    return np.frombuffer(numbers, kind).reshape(shape, order="F" if head[2] == b"True" else "C")
