"""Claims about `apc.support.processes`: processes end when they are let go, and a lost one is told."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import pytest

from apc.benchmark.scale import scale
from apc.compiler.errors import ApcError
from apc.simulation.monte_carlo import simulate_many
from apc.simulation.settings import Settings
from apc.studies.grid import build_grid, parse_axis
from apc.studies.resumable_sweep import LOST, sweep
from apc.studies.work import Work, compute_part
from apc.support.processes import local_processes, model_bytes
from tests.sweeping import CHEAP, alive, children, parts
from tests.topologies import AVERAGE, compiled, replaced

MODEL = compiled(CHEAP)
LOSSY = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 10 %}"))
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


def test_processes_end_at_once_whatever_they_do() -> None:
    before = set(workers_of_mine())
    with local_processes(compute_part, LONG, 2, LOST) as workers:
        futures = [workers.submit(part) for part in range(LONG.parts)]
        os.kill((set(workers_of_mine()) - before).pop(), signal.SIGSTOP)  # it can't even be told
    assert all(future.cancelled() or future.exception() is not None for future in futures)
    assert set(workers_of_mine()) <= before


# All that start processes, in one that was itself started elsewhere.
STARTING = """\
import sys
from apc.__main__ import run
from apc.app.worker_process import SectionWorker
from apc.app.sections import Task
from apc.inputs.open_model import open_topology
from apc.support.processes import model_bytes

if __name__ == "__main__":
    over = ["--over", "contact.stiffness=1 N/m:2 N/m:130"]
    ran = [run(["sweep", "topology.yaml", *over, "--jobs", "2", "--out", "r.csv"])]
    if sys.argv[1:] == ["sweep"]:
        raise SystemExit(any(ran))
    ran += [
        run(["simulate", "lossy.yaml", "--duration", "40 ms", "--runs", "80", "--jobs", "2"]),
        run(["bench", "topology.yaml", "--scale", "3,4"]),
        run(["run", "topology.yaml", "--duration", "40 ms"]),
    ]
    model = model_bytes(open_topology("topology.yaml", ()))
    desk = SectionWorker(model, ("motion",), lambda call, _: call(), lambda *_: None)
    desk.submit(Task("motion", (), None))
    desk.close()
    raise SystemExit(any(ran))
"""


@pytest.mark.whole
@pytest.mark.parametrize("what", ["sweep", pytest.param("all", marks=pytest.mark.whole)])
def test_no_process_that_is_started_runs_what_lies_beside_a_topology(what: str, tmp_path: Path) -> None:
    script, folder = tmp_path / "script.py", tmp_path / "folder"
    script.write_text(STARTING, encoding="utf-8")
    folder.mkdir()
    (folder / "topology.yaml").write_text(AVERAGE, encoding="utf-8")
    (folder / "lossy.yaml").write_text(LOSSY, encoding="utf-8")
    for name in (*sys.stdlib_module_names, "apc", "casadi", "numpy", "scipy"):
        (folder / f"{name}.py").write_text(f"open('{name}.ran', 'w')\n", encoding="utf-8")
    ran = subprocess.run(
        [sys.executable, script, what], cwd=folder, capture_output=True, text=True, check=False
    )
    assert sorted(path.name for path in folder.glob("*.ran")) == []
    assert ran.returncode == 0, ran.stderr


@pytest.mark.whole
def test_a_process_stopped_from_outside_is_told_and_finished_parts_are_kept(tmp_path: Path) -> None:
    if not Path("/proc/self/task").is_dir():
        pytest.skip("this system does not tell which processes one has started")
    before = set(workers_of_mine())

    def stop(done: int, points: int) -> None:
        if done:
            for pid in set(workers_of_mine()) - before:
                os.kill(pid, signal.SIGKILL)

    with pytest.raises(ApcError, match="E889 a worker process exited unexpectedly"):
        sweep(MODEL, {"it.stiffness": "1 N/m:9 kN/m:1000"}, out=tmp_path / "r.csv", jobs=2, progress=stop)
    assert 1 <= len(parts(tmp_path / "r.csv")) < 16


@pytest.mark.whole
def test_an_interrupt_ends_the_processes_at_once_and_keeps_the_runs_that_are_done() -> None:
    before = set(workers_of_mine())

    def stop(_: int) -> None:
        raise KeyboardInterrupt

    settings = Settings(Fraction(1, 10), jit=False)
    found = simulate_many(compiled(LOSSY), settings, runs=400, jobs=2, progress=stop)
    assert found.interrupted and 0 < len(found.runs) < 400
    assert set(workers_of_mine()) <= before


@pytest.mark.whole
def test_a_number_of_peers_whose_process_is_lost_is_refused_and_the_others_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "topology.yaml").write_text(AVERAGE, encoding="utf-8")
    monkeypatch.setattr("apc.benchmark.scale._measure", _lost_at_four)
    found = scale(tmp_path / "topology.yaml", [4, 5])
    assert list(found.rows) == [5]
    assert found.refused == ((4, "the measuring process exited unexpectedly: stopped, or out of memory"),)


def _lost_at_four(_: Path, count: int) -> int:
    if count == 4:
        os.kill(os.getpid(), signal.SIGKILL)
    return count


def test_one_part_alone_is_computed_without_starting_a_process() -> None:
    before = set(workers_of_mine())
    found = sweep(MODEL, {"it.stiffness": "1,2 N/m"}, jobs=8)
    assert found.points == 2
    assert set(workers_of_mine()) == before
    assert compute_part(WORK, 0).versions == compute_part(WORK, 1).versions
