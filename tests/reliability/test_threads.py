"""Claims about `apc.support.threads`."""

from __future__ import annotations

import os
import re
import subprocess
import sys

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from apc.support.threads import POOLS, single_threaded, start_single_threaded
from tests.topologies import ROOT


def _threads() -> list[int]:
    return [pool["num_threads"] for pool in threadpool_info()]


def test_one_thread_inside_and_the_old_number_after() -> None:
    np.eye(2) @ np.eye(2)
    before = _threads()
    with single_threaded():
        assert set(_threads()) <= {1}
        with pytest.raises(ZeroDivisionError), single_threaded():
            assert set(_threads()) <= {1}
            _ = 1 / 0
        assert set(_threads()) <= {1}
    assert _threads() == before, "after an error as well"


def _begun(environment: dict[str, str]) -> str:
    """Start a process as a command does; return its numbers of threads and what its environment says."""
    code = (
        "import os\n"
        "from apc.support.threads import POOLS, start_single_threaded\n"
        "start_single_threaded()\n"
        "import numpy, threadpoolctl\n"
        "print({p['num_threads'] for p in threadpoolctl.threadpool_info()}, end=' ')\n"
        "print([os.environ.get(name) for name in POOLS])"
    )
    stored = {name: value for name, value in os.environ.items() if name not in POOLS}
    run = [sys.executable, "-c", code]
    return subprocess.run(run, env=stored | environment, capture_output=True, text=True, check=True).stdout


def test_a_command_of_small_matrices_makes_no_threads() -> None:
    assert _begun({}).strip() == "{1} ['1', '1', '1']"


def test_the_environment_stays_once_the_libraries_are_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in POOLS:
        monkeypatch.delenv(name, raising=False)
    start_single_threaded()
    assert not set(POOLS) & os.environ.keys()


def test_what_brings_a_pool_is_loaded_where_it_is_limited() -> None:
    """Blocks of one thread are entered before a large topology asks for SciPy's linear algebra."""
    for path in (ROOT / "runtime").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"import scipy\.(sparse\.)?linalg|from scipy\.(sparse\.)?linalg", text), path
