"""Claims about `apc.runtime.threads`."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from apc.runtime.threads import single_threaded


def _threads() -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info()]


def test_one_thread_inside_and_the_old_number_after() -> None:
    np.eye(2) @ np.eye(2)
    before = _threads()
    with single_threaded():
        assert set(_threads()) <= {1}
        with single_threaded():
            assert set(_threads()) <= {1}
        assert set(_threads()) <= {1}
    assert _threads() == before


def test_the_old_number_is_back_after_an_error() -> None:
    before = _threads()
    with pytest.raises(ZeroDivisionError), single_threaded():
        _ = 1 / 0
    assert _threads() == before
