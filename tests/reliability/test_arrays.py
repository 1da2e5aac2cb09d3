"""`npz`: arrays come back as NumPy wrote them; anything else is refused before it is unpacked."""

from __future__ import annotations

import io
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from apc.support.npz import DamageError, read_arrays
from tests.fuzz.models import zipped

KINDS = {"time": ("<f8", 1), "packets[0-9]": ("<i8", 2), "missing": ("|b1", 2), "record": ("|u1", 1)}
WHOLE = {
    "time": np.array([0.0, np.nan, -0.0]),
    "packets0": np.arange(6).reshape(2, 3),
    "missing": np.array([[True], [False]]),
    "record": np.zeros(0, np.uint8),
}


def saved(save: Callable[..., None] = np.savez_compressed, **given: Any) -> bytes:
    file = io.BytesIO()
    save(file, **given)
    return file.getvalue()


def member(value: Any) -> bytes:
    file = io.BytesIO()
    np.save(file, value)
    return file.getvalue()


def refused(data: bytes, most: int = 1 << 20) -> str:
    with pytest.raises(DamageError) as caught:
        read_arrays(data, KINDS, most)
    return str(caught.value)


@pytest.mark.whole
@given(
    arrays.arrays(np.float64, st.tuples(st.integers(0, 40))),
    arrays.arrays(np.int64, st.tuples(st.integers(0, 9), st.integers(0, 9))),
    st.booleans(),
    st.sampled_from([np.savez, np.savez_compressed]),
)
def test_what_numpy_wrote_is_read(one: Any, two: Any, turned: bool, save: Callable[..., None]) -> None:
    two = np.asfortranarray(two) if turned else two
    found = read_arrays(saved(save, time=one, packets7=two), KINDS, 1 << 20)
    assert found.keys() == {"time", "packets7"}
    np.testing.assert_array_equal(found["time"].view(np.int64), one.view(np.int64))
    np.testing.assert_array_equal(found["packets7"], two)


@given(st.integers(0, 10**6), st.integers(1, 255))
def test_a_byte_changed_is_refused_or_of_no_account(place: int, change: int) -> None:
    data = bytearray(saved(**WHOLE))
    data[place % len(data)] ^= change
    try:
        found = read_arrays(bytes(data), KINDS, 1 << 20)
    except DamageError:
        return
    for name, value in found.items():  # a date, say, of which nothing depends
        np.testing.assert_array_equal(value, WHOLE[name])


@given(st.binary(max_size=200))
def test_what_is_no_archive_is_refused(data: bytes) -> None:
    assert refused(data) == "it is not a NumPy archive"


HEAD = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (%b), }\n"


@pytest.mark.parametrize(
    ("members", "why"),
    [
        ({"time.npy": member(np.zeros(3, np.float32))}, "its time is not an array of <f8"),
        ({"time.npy": member(np.zeros(3, ">f8"))}, "its time is not an array of <f8"),
        ({"time.npy": member(np.array([None]))}, "its time is not an array of <f8"),
        ({"time.npy": member(np.zeros(3, [("x", "<f8")]))}, "its time is not an array of <f8"),
        ({"time.npy": member(np.zeros((3, 1)))}, "its time has 2 dimensions, not 1"),
        ({"time.npy": member(np.zeros(()))}, "its time has 0 dimensions, not 1"),
        ({"time.npy": member(np.zeros(3))[:-1]}, "its time is not an array of <f8"),
        ({"time.npy": HEAD % b"999999999999999,"}, "its time is not an array of <f8"),
        ({"time.npy": HEAD % b"-1,"}, "its time is not an array of <f8"),
        ({"time.npy": HEAD % b"__import__('os'),"}, "its time is not an array of <f8"),
        ({"time.npy": HEAD % (b"9," * 10_000)}, "its time is not an array of <f8"),
        ({"time.npy": b""}, "its time is not an array of <f8"),
        (
            {"missing.npy": member(np.zeros((1, 1), np.bool_))[:-1] + b"\2"},
            "its missing contains values other",
        ),
        ({"time": member(np.zeros(3))}, "it contains unexpected entries"),
        ({"../time.npy": member(np.zeros(3))}, "it contains unexpected entries"),
        ({"packets10.npy": member(np.zeros((3, 1), int))}, "it contains unexpected entries"),
    ],
)
def test_an_array_that_was_not_asked_for_is_refused(members: dict[str, bytes], why: str) -> None:
    assert refused(zipped(members)).startswith(why)


def test_nothing_is_unpacked_that_is_larger_or_called_otherwise_than_asked_for() -> None:
    tracemalloc.start()
    try:
        large = saved(time=np.zeros(1 << 22), told=np.zeros(1 << 25, np.uint8))
        other = zipped({"other.npy": bytes(1 << 26)})
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        assert refused(large) == "it unpacks to more than 1 MiB"
        assert refused(other, 1 << 28) == "it contains unexpected entries"
        assert tracemalloc.get_traced_memory()[1] - before < 1 << 22
    finally:
        tracemalloc.stop()
