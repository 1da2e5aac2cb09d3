"""Arrays from a file in NumPy's format NPZ, whoever wrote it.

Takes: the bytes of a file, the arrays that may be in it. Gives: `read_arrays`.
Guarantees: nothing is unpickled, or unpacked before its names and sizes are known to be those asked for; an
array has the type and the number of dimensions asked for, and as many numbers as it says.
Does not: open files (see `files.read_file`), or know what the numbers mean.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.cache import DAMAGE, DamageError, unzipped

# How NumPy begins an array of numbers in a file (format 1.0): type, order, shape. NumPy's own reader of it
# warns of what is nearly one, and raises what its parser does: here either it is one or it is not.
_HEAD = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '([<|][a-z][0-9]{1,2})', 'fortran_order': (False|True), "
    rb"'shape': \(((?:[0-9]{1,15}, ?)*(?:[0-9]{1,15})?)\), \} *\n",
    re.DOTALL,
)


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
        members = unzipped(data, most, names)
    except DamageError:
        raise
    except DAMAGE:
        raise DamageError("it is no archive of arrays as NumPy writes them") from None
    found = {}
    for member, content in members.items():
        name = member.removesuffix(".npy")
        kind = next(kind for pattern, kind in expected.items() if re.fullmatch(pattern, name))
        found[name] = _array(name, content, *kind)
    return found


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
