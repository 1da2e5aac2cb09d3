"""NAME.apc: the compiled model on disk.

Takes: `Model`.
Gives: `save`, `opened`: to and from a file; `encoded`, `decoded`: to and from bytes; `model_of`, the bytes of
a model alone.
Guarantees: a file is written completely or not at all; equal models give equal bytes. Functions are in
CasADi's serialization, which can contain calls of commands: only files written by this user's apc may be
read.
Does not: check the author of a file, or changes of the topology (see `cache`).
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import msgspec
import numpy as np

from apc.compiler.cache import Archive, Origin, packed
from apc.compiler.compiled import Model
from apc.compiler.files import write_bytes
from apc.compiler.timings import part


@part("save")
def save(model: Model, path: Path, *, compiled: bool = False) -> None:
    """Write a model to a file. Raises ApcError if the file can't be written.

    `compiled` is whether the model is the unchanged result of compiling its texts.
    """
    write_bytes(path, packed(model.origin, model_of(model), compiled=compiled))


def model_of(model: Model) -> bytes:
    """Return the bytes of a model without its source texts."""
    return encoded(replace(model, origin=Origin(model.origin.topology)))


def opened(archive: Archive) -> Model:
    """Return the model in a file that has a valid seal of this user."""
    assert archive.sealed
    return replace(decoded(archive.model), origin=archive.origin)


def encoded(model: Model) -> bytes:
    """Return a model as bytes."""
    return msgspec.msgpack.encode(model, enc_hook=_plain)


def decoded(model: bytes) -> Model:
    """Return the model from bytes written by `encoded`."""
    return msgspec.msgpack.decode(model, type=Model, dec_hook=_decode)


def _plain(value: Any) -> Any:
    """Return a value of a model as plain data for msgpack."""
    match value:
        case Fraction():
            return str(value)
        case np.ndarray():
            return value.dtype.str, value.shape, value.tobytes()
        case casadi.Function():
            return value.serialize()
    raise NotImplementedError(type(value))


def _decode(type_: Any, value: Any) -> Any:
    """Return a value of a model from plain data."""
    if type_ is Fraction:
        return Fraction(value)
    if type_ is casadi.Function:
        return casadi.Function.deserialize(value)
    dtype, shape, numbers = value
    return np.frombuffer(numbers, dtype).reshape(shape)
