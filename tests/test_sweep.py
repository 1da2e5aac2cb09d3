"""Sweeps: the rows are the analyses, whoever computes them; interrupted, nothing is lost or done twice."""

from __future__ import annotations

import errno
import json
import math
import os
import pty
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.analysis.analysis import Analysis
from apc.compiler import seal
from apc.compiler.errors import ApcError
from apc.compiler.files import unwritable
from apc.processes import model_bytes
from apc.sweeps import store as sweep_store
from apc.sweeps import sweep as sweep_module
from apc.sweeps.sweep import Sweep, sweep
from apc.sweeps.work import Work, compute_part
from tests.sweeping import CHEAP, alive, children, parts, start, start_waiting, wait_for_parts
from tests.topologies import AVERAGE, ONE_MASS, compiled, told

MODEL = compiled(CHEAP)
OVER = {"it.stiffness": "100 N/m:7000 N/m:20", "tick.period": "1,2 ms", "it.damping": "0:2 N*s/m:5"}
WORDS = [word for name, values in OVER.items() for word in ("--over", f"{name}={values}")]


def small(**given: object) -> Sweep:
    return sweep(MODEL, OVER, **given)  # type: ignore[arg-type] # the tests know what they give


def test_every_row_is_the_analysis_of_its_point() -> None:
    found = sweep(compiled(AVERAGE), {"contact.stiffness": "500,4000 N/m", "lan.delay": "0,8 ms"}, jobs=1)
    assert found.headings == (
        *("contact.stiffness [N/m]", "lan.delay [s]", "verdict", "spectral_radius"),
        *("spectral_radius_error", "rigid_modes", "frequency [Hz]", "damping_ratio", "message"),
    )
    points = [(500, "0 s"), (500, "8 ms"), (4000, "0 s"), (4000, "8 ms")]
    for place, (stiffness, delay) in enumerate(points):
        values = {"contact.stiffness": f"{stiffness} N/m", "lan.delay": delay}
        expected: Analysis = apc.analyze(compiled(AVERAGE), set=values)
        row = [column[place] for column in found.columns]
        assert row[:2] == [stiffness, 0.008 if delay == "8 ms" else 0]
        leading = expected.modes[0]
        verdict, radius, error, rigid, frequency, damping, message = row[2:]
        assert (verdict, rigid, message) == (expected.verdict, expected.rigid_modes, "")
        assert abs(radius - expected.spectral_radius) <= error + expected.spectral_radius_error
        assert error <= 2 * expected.spectral_radius_error
        assert (frequency, damping) == pytest.approx((leading.frequency_hz, leading.damping_ratio), 1e-12)
    assert found.points == 4
    assert sum(count for _, count in found.verdicts) == 4


def test_a_walls_verdict_turns_at_its_known_limit() -> None:
    # m = 0.1 kg, b = 5 N·s/m, T = 1 ms, T_d = 1 ms: unstable from K = 3378.939 N/m on.
    model = apc.set_parameters(MODEL, {"it.delay": "1 ms"})
    found = sweep(model, {"it.stiffness": "3378.9,3378.98 N/m"}, jobs=1)
    assert list(found.column("verdict")) == ["stable", "unstable"]


def test_the_rows_do_not_depend_on_who_computes_them(tmp_path: Path) -> None:
    one, two = tmp_path / "1.csv", tmp_path / "2.csv"
    small(out=one, jobs=1)
    small(out=two, jobs=2)
    assert one.read_bytes() == two.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["1.csv", "2.csv"]


def test_a_part_does_not_depend_on_the_parts_computed_before() -> None:
    work = Work(model_bytes(MODEL), "analyze", small(jobs=1).grid, 20)
    forward = [compute_part(work, part) for part in range(work.parts)]
    backward = [compute_part(work, part) for part in reversed(range(work.parts))]
    for one, other in zip(forward, reversed(backward), strict=True):
        assert (one.part, one.versions) == (other.part, other.versions)
        for cells, again in zip(one.cells, other.cells, strict=True):
            np.testing.assert_array_equal(cells, again)


def test_a_sweep_becomes_a_pandas_table() -> None:
    pytest.importorskip("pandas")
    table = small(jobs=1).to_dataframe()
    assert table.shape == (200, 10)
    assert table["it.stiffness [N/m]"].iloc[-1] == 7000
    assert (table["verdict"] == "unstable").sum() == dict(small(jobs=1).verdicts)["unstable"]


def test_a_point_at_fault_says_why_and_the_sweep_goes_on(tmp_path: Path) -> None:
    # A phase beyond the clock's period is no fault of either value, only of the two together.
    text = CHEAP.replace("tick: 1 ms", "tick: {period: 1 ms, phase: 0 ms}")
    target = tmp_path / "r.csv"
    found = sweep(compiled(text), {"tick.phase": "0,1.5 ms", "tick.period": "1,2 ms"}, out=target, jobs=1)
    assert list(found.column("verdict")) == ["stable", "stable", "error: E625", "stable"]
    assert math.isnan(found.column("spectral_radius")[2])
    message = "tick.phase wants less than the clock's period, got 0.0015 s."
    assert found.column("message").tolist() == ["", "", message, ""]
    assert target.read_text(encoding="utf-8").splitlines()[3] == f'0.0015,0.001,error: E625,,,,,,"{message}"'
    assert f"at 1 of them: {message}" in str(found)


def test_what_stands_in_a_file_is_read_from_there_and_not_held(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    held = small(jobs=1)
    for suffix in ("csv", "parquet"):
        found = small(out=tmp_path / f"r.{suffix}", jobs=1)
        assert found.held is None and (found.verdicts, str(found)[-200:]) == (held.verdicts, str(held)[-200:])
        for heading, one, other in zip(held.headings, found.columns, held.columns, strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
            np.testing.assert_array_equal(found.column(heading), other)


def test_the_rows_of_many_parts_make_whole_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, target = tmp_path / "whole.csv", tmp_path / "blocks.csv"
    small(out=whole, jobs=1)
    monkeypatch.setattr(sweep_module, "BLOCK", 50)  # parts have 64 points, the last one fewer
    blocks = []
    write = sweep_module.write_table

    def watched(path: Path, listed: Any, given: Any, about: Any) -> None:
        write(path, listed, (blocks.append(len(one[0])) or one for one in given), about)

    monkeypatch.setattr(sweep_module, "write_table", watched)
    small(out=target, jobs=1)
    assert blocks == [50, 50, 50, 50]
    assert target.read_bytes() == whole.read_bytes()


def test_parquet_and_dataframe_hold_the_same_rows(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    found = small(out=tmp_path / "r.parquet", jobs=1)
    table = parquet.read_table(tmp_path / "r.parquet")
    assert table.column_names == list(found.headings)
    assert table.column("spectral_radius").to_pylist() == found.column("spectral_radius").tolist()
    about = json.loads(table.schema.metadata[b"apc"])
    assert about == found.made_of
    assert about["parameters"]["device.mass"] == 0.1
    assert set(about["versions"]) >= {"apc", "numpy", "casadi"}


def test_damaged_parts_are_computed_again_and_named(tmp_path: Path) -> None:
    whole, target = tmp_path / "whole.csv", tmp_path / "r.csv"
    small(out=whole, jobs=1)

    def stop(done: int, points: int) -> None:
        if done >= 128:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        small(out=target, jobs=1, progress=stop)
    [_, last] = sorted(parts(target))
    (tmp_path / "r.csv.parts" / last).write_bytes(b"not mine")
    found = small(out=target, jobs=1)
    again = "part 1 was damaged, or written by somebody else, and is computed again"
    assert found.notes == (again, "64 points were there already")
    assert target.read_bytes() == whole.read_bytes()


def test_what_somebody_else_says_of_a_sweep_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Somebody hands a folder on, in which all is said to be stable."""
    whole, target = tmp_path / "whole.csv", tmp_path / "r.csv"
    small(out=whole, jobs=1)
    write = sweep_store.Parts.write

    def say_stable(self: sweep_store.Parts, part: int, cells: Any) -> None:
        write(self, part, (np.full(len(cells[0]), "stable", dtype=object), *cells[1:]))

    def stop(done: int, points: int) -> None:
        if done == points:
            raise KeyboardInterrupt

    with monkeypatch.context() as theirs, pytest.raises(KeyboardInterrupt):
        theirs.setattr(seal, "_folder", lambda: tmp_path / "theirs")
        theirs.setattr(sweep_store.Parts, "write", say_stable)
        small(out=target, jobs=1, progress=stop)
    assert len(parts(target)) == 4
    assert "unstable" in dict(small(out=target, jobs=1).verdicts)
    assert target.read_bytes() == whole.read_bytes()


def test_two_processes_may_do_the_same_sweep(tmp_path: Path) -> None:
    whole, target = tmp_path / "whole.csv", tmp_path / "r.csv"
    small(out=whole, jobs=1)

    def done_by_another(done: int, points: int) -> None:
        if done == points:  # the other one has written the target, and removes the parts
            shutil.rmtree(tmp_path / "r.csv.parts")

    small(out=target, jobs=1, progress=done_by_another)
    assert target.read_bytes() == whole.read_bytes()


def test_a_full_disk_keeps_what_is_finished(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "r.csv"
    write = sweep_store.write_bytes
    written: list[Path] = []

    def full(path: Path, content: bytes) -> None:
        written.append(path)
        if len(written) > 2:
            raise unwritable(path, OSError(errno.ENOSPC, "No space left on device"))
        write(path, content)

    monkeypatch.setattr(sweep_store, "write_bytes", full)
    with pytest.raises(ApcError, match="E601 can't be written: No space left on device"):
        small(out=target, jobs=1)
    assert len(parts(target)) == 2
    monkeypatch.undo()
    assert small(out=target, jobs=1).notes == ("128 points were there already",)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"of": "critical:it.stiffness"},
            "sweep: E884 it.stiffness is swept: there is nothing to look for",
        ),
        ({"of": "analyse"}, "sweep: E884 analyse is nothing a sweep computes (analyze"),
        (
            {"out": Path("r.txt")},
            'r.txt: E878 the suffix of out wants one of .csv, .parquet, got .txt. Write: out="r.csv"',
        ),
        ({"jobs": 0}, "sweep: E889 the number of processes wants 1 or more, got 0."),
    ],
)
def test_a_faulty_wish_is_told_before_anything_is_computed(given: dict[str, object], message: str) -> None:
    (got,) = told(lambda: small(**given))
    assert got.startswith(message)


# --- the command, in processes of its own


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("wall", CHEAP), ("mass", ONE_MASS)):
        (tmp_path / f"{name}.yaml").write_text(text, encoding="utf-8")
        assert run(["compile", str(tmp_path / f"{name}.yaml")]) == 0
    return tmp_path


# A mass alone: the cheapest of scenes, as these are about processes.
MANY = ("--over", "device.mass=1 kg:2 kg:250", "--over", "device.damping=1,2,3,4 N*s/m")


def test_killed_three_times_it_gives_the_file_of_one_left_alone(folder: Path) -> None:
    left_alone = start(folder, "mass.apc", *MANY, "--out", "alone.csv", "--jobs", "1")
    target = folder / "r.csv"
    before: dict[str, tuple[int, int]] = {}
    for kill in range(3):
        jobs = "1" if kill else "2"  # it may change from run to run
        running = start_waiting(folder, 3 + kill, "mass.apc", *MANY, "--out", "r.csv", "--jobs", jobs)
        wait_for_parts(running, target, len(before) + 3 + kill)
        workers = children(running.pid)
        running.kill()
        running.communicate()
        now = parts(target)
        assert before.items() <= now.items(), "a finished part was computed or written again"
        assert len(now) == len(before) + 3 + kill
        before = now
        while any(alive(pid) for pid in workers):  # for ever, if one outlives the process that started it
            time.sleep(0.01)
    last = start(folder, "mass.apc", *MANY, "--out", "r.csv", "--jobs", "1")
    out, err = last.communicate()
    assert (last.returncode, err) == (0, "")
    assert f"note: {64 * len(before):,} points were there already" in out
    assert left_alone.communicate()[1] == ""
    assert target.read_bytes() == (folder / "alone.csv").read_bytes()
    assert len(target.read_text(encoding="utf-8").splitlines()) == 1001
    assert not (folder / "r.csv.parts").exists()


def test_an_interrupt_ends_with_what_is_done_and_says_how_to_go_on(folder: Path) -> None:
    target = folder / "r.csv"
    running = start_waiting(folder, 2, "mass.apc", *MANY, "--out", "r.csv", "--jobs", "2")
    wait_for_parts(running, target, 2)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate()
    assert (running.returncode, out) == (130, "")
    first, second = (line for line in err.splitlines() if line)
    assert first.endswith(" of 1,000 points are kept in r.csv.parts; the same command takes up from there")
    assert second == "stopped"
    assert not target.exists()
    assert len(parts(target)) == 2
    other = start(folder, "mass.apc", *MANY[:2], "--out", "r.csv")
    assert other.communicate()[1] == ""
    assert other.returncode == 0
    assert len(target.read_text(encoding="utf-8").splitlines()) == 251
    assert len(parts(target)) == 2, "those of the first one wait for it"


def test_a_terminal_sees_progress_and_a_file_does_not(folder: Path) -> None:
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "apc", "sweep", "wall.apc", *WORDS, "--out", "r.csv", "--jobs", "1"]
    with subprocess.Popen(command, cwd=folder, stderr=slave, stdout=subprocess.PIPE, text=True):
        os.close(slave)
        seen = b""
        while chunk := _read(master):
            seen += chunk
    os.close(master)
    assert b"200 of 200 points" in seen
    quiet = start(folder, "wall.apc", *WORDS, "--out", "s.csv", "--jobs", "1", "--json")
    out, err = quiet.communicate()
    assert err == ""
    document = json.loads(out)
    assert (document["points"], document["out"]) == (200, "s.csv")
    assert sum(document["verdicts"].values()) == 200
    assert (folder / "r.csv").read_bytes() == (folder / "s.csv").read_bytes()


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 65536)
    except OSError:  # Linux says so when the other end has closed
        return b""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--over", "it.stiffness", "--out", "r.csv"),
            "sweep: E880 --over wants PATH=VALUES, got it.stiffness.",
        ),
        (
            ("--over", "it.stiffness=1,2 N/m", "--over", "it.stiffness=3,4 N/m", "--out", "r.csv"),
            "sweep: E883 it.stiffness is swept twice.",
        ),
        (
            ("--over", "it.stifness=1,2 N/m", "--out", "r.csv"),
            "sweep: E622 it.stifness is no parameter of wall. Write: it.stiffness",
        ),
        (
            ("--over", "it.stiffness=1,2 N/m", "--out", "nowhere/r.csv", "--jobs", "1"),
            "nowhere/r.csv: E601 can't be written: No such file or directory.",
        ),
    ],
)
def test_bad_input_gets_one_message_and_leaves_nothing(
    folder: Path,
    words: tuple[str, ...],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    capsys.readouterr()
    assert run(["sweep", "wall.apc", *words]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(message)
    assert len(err.splitlines()) == 1
    assert sorted(path.name for path in folder.iterdir()) == [
        *("mass.apc", "mass.yaml", "wall.apc", "wall.yaml")
    ]
