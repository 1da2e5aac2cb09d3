"""Processes that compute parts: they end when they are let go, and a lost one is told."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from apc.compiler.errors import ApcError
from apc.sweeps.grid import build_grid, parse_axis
from apc.sweeps.local import cores, local_processes, this_process
from apc.sweeps.sweep import sweep
from apc.sweeps.work import Work, compute_part, model_bytes
from tests.sweeping import CHEAP, alive, children, parts
from tests.topologies import compiled

MODEL = compiled(CHEAP)
WORK = Work(
    model_bytes(MODEL), "analyze", build_grid([parse_axis(MODEL, "it.stiffness", "1 N/m:9 kN/m:60")]), 10
)


# Parts that take minutes each.
LONG = Work(
    model_bytes(MODEL),
    "analyze",
    build_grid(
        [
            parse_axis(MODEL, "it.stiffness", "1 N/m:9 kN/m:1000"),
            parse_axis(MODEL, "device.mass", "1 kg:2 kg:900"),
        ]
    ),
    150_000,
)


def workers_of_mine() -> list[int]:
    """Return the processes this one has started, but for the one that Python itself keeps."""
    found = [pid for pid in children(os.getpid()) if alive(pid)]
    return [pid for pid in found if b"resource_tracker" not in Path(f"/proc/{pid}/cmdline").read_bytes()]


def test_processes_compute_what_this_one_computes() -> None:
    here = this_process(WORK)
    with local_processes(WORK, 2) as workers:
        futures = [workers.submit(part) for part in range(WORK.parts)]
        assert [future.result() for future in futures] == [here.submit(p).result() for p in range(WORK.parts)]
    assert [len(WORK.points_of(part)) for part in range(WORK.parts)] == [10] * 6


def test_processes_end_at_once_whatever_they_do() -> None:
    before = set(workers_of_mine())
    with local_processes(LONG, 2) as workers:
        futures = [workers.submit(part) for part in range(LONG.parts)]
    assert all(future.cancelled() or future.exception() is not None for future in futures)
    assert set(workers_of_mine()) <= before


def test_a_process_stopped_from_outside_is_told_and_finished_parts_are_kept(tmp_path: Path) -> None:
    if not Path("/proc/self/task").is_dir():
        pytest.skip("this system does not tell which processes one has started")
    before = set(workers_of_mine())

    def stop(done: int, points: int) -> None:
        if done:
            for pid in set(workers_of_mine()) - before:
                os.kill(pid, signal.SIGKILL)

    with pytest.raises(ApcError, match="E889 a process that computed ended without a word"):
        sweep(MODEL, {"it.stiffness": "1 N/m:9 kN/m:1000"}, out=tmp_path / "r.csv", jobs=2, progress=stop)
    assert 1 <= len(parts(tmp_path / "r.csv")) < 16


def test_at_least_one_core_is_there() -> None:
    assert 1 <= cores() <= (os.cpu_count() or 1)


def test_one_part_alone_is_computed_without_starting_a_process() -> None:
    before = set(workers_of_mine())
    found = sweep(MODEL, {"it.stiffness": "1,2 N/m"}, jobs=8)
    assert found.points == 2
    assert set(workers_of_mine()) == before
    assert compute_part(WORK, 0).versions == compute_part(WORK, 1).versions
