"""NAME.apc: the compiled model on disk.

Takes: `Model`.
Gives: `save`, `opened`: to and from a file; `encoded`, `decoded`: to and from bytes; `model_of`, the bytes of
a model alone.
Guarantees: written whole or not at all; equal models give equal bytes. Functions are in CasADi's own
serialization, which can hold commands to call: only what this user's apc wrote may be read here.
Does not: ask who wrote a file, or whether the topology has changed since (see `cache`).
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
def save(system: Model, path: Path, *, compiled: bool = False) -> None:
    """Write a model; `compiled` if it is as its texts compile now. Raises ApcError if it can't be written."""
    write_bytes(path, packed(system.origin, model_of(system), compiled=compiled))


def model_of(system: Model) -> bytes:
    """Return a model without the texts that it was made from."""
    return encoded(replace(system, origin=Origin(system.origin.topology)))


def opened(archive: Archive) -> Model:
    """Return the model of a file that this user's apc has sealed."""
    assert archive.sealed
    return replace(decoded(archive.model), origin=archive.origin)


def encoded(system: Model) -> bytes:
    """Return a model as bytes."""
    return msgspec.msgpack.encode(system, enc_hook=_plain)


def decoded(model: bytes) -> Model:
    """Return the model of bytes that `encoded` gave."""
    return msgspec.msgpack.decode(model, type=Model, dec_hook=_decode)


def _plain(value: Any) -> Any:
    match value:
        case Fraction():
            return str(value)
        case np.ndarray():
            return value.dtype.str, value.shape, value.tobytes()
        case casadi.Function():
            return value.serialize()
    raise NotImplementedError(type(value))


def _decode(requested: Any, value: Any) -> Any:
    if requested is Fraction:
        return Fraction(value)
    if requested is casadi.Function:
        return casadi.Function.deserialize(value)
    peer_type, shape, numbers = value
    return np.frombuffer(numbers, peer_type).reshape(shape)
