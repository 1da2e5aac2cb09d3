"""Sweeps: the rows are the analyses, whoever computes them; interrupted, nothing is lost or done twice."""

from __future__ import annotations

import io
import json
import math
import os
import pty
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler import signing
from apc.studies.resumable_sweep import Sweep, sweep
from tests.sweeping import CHEAP, alive, children, parts, start, start_waiting, wait_for_parts
from tests.topologies import AVERAGE, ONE_MASS, TOPOLOGIES, compiled, messages_of

WALL = compiled(CHEAP)
MODEL = compiled(ONE_MASS)  # the cheapest of topologies, for what is about files and processes
OVER = {"device.mass": "1 kg:2 kg:26", "device.damping": "1,2,3,4,5 N*s/m"}
WORDS = [word for name, values in OVER.items() for word in ("--over", f"{name}={values}")]


def small(**given: object) -> Sweep:
    return sweep(MODEL, OVER, **given)  # type: ignore[arg-type] # the tests know what they give


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the file of a sweep that was left alone."""
    path = tmp_path_factory.mktemp("whole") / "r.csv"
    small(out=path, jobs=1)
    return path.read_bytes()


def interrupted(target: Path, points: int = 128) -> list[Path]:
    """Begin a sweep of a target, end it when so many points are done, and return the parts that are kept."""

    def stop(done: int, _: int) -> None:
        if done >= points:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        small(out=target, jobs=1, progress=stop)
    folder = target.with_name(f"{target.name}.parts")
    return [folder / name for name in sorted(parts(target))]


# ---- the rows ----


def test_the_text_has_the_range_of_the_results_and_the_points_of_each_verdict() -> None:
    """The limits are those of an analysis of each point alone."""
    found = apc.sweep(
        compiled(AVERAGE), {"device.mass": "0.1,0.2 kg"}, of="critical:coordination.stiffness", jobs=1
    )
    limits = [
        apc.critical(
            apc.set_parameters(compiled(AVERAGE), {"device.mass": mass}), "coordination.stiffness"
        ).value
        for mass in ("0.1 kg", "0.2 kg")
    ]
    assert f"  value [N/m]: {min(limits):.6g} to {max(limits):.6g}\n" in str(found)
    assert str(found).endswith("  points  verdict\n       2  stable below the value")


def test_every_row_is_the_analysis_of_its_point() -> None:
    found = apc.sweep(compiled(AVERAGE), {"contact.stiffness": "500,4000 N/m", "lan.delay": "0,8 ms"}, jobs=1)
    assert found.headings == (
        *("contact.stiffness [N/m]", "lan.delay [s]", "verdict", "spectral_radius"),
        *("spectral_radius_error", "rigid_modes", "frequency [Hz]", "damping_ratio", "message"),
    )
    points = [(500, 0), (500, 8), (4000, 0), (4000, 8)]  # the last axis turns fastest
    for place, (stiffness, delay) in enumerate(points):
        settings = {"contact.stiffness": f"{stiffness} N/m", "lan.delay": f"{delay} ms"}
        expected = apc.analyze(compiled(AVERAGE), params=settings)
        row = [column[place] for column in found.columns]
        assert row[:2] == [stiffness, delay / 1000]
        verdict, radius, error, rigid, frequency, damping, message = row[2:]
        assert (verdict, rigid, message) == (expected.verdict, expected.rigid_modes, "")
        assert abs(radius - expected.spectral_radius) <= error + expected.spectral_radius_error
        assert error <= 2 * expected.spectral_radius_error
        leading = expected.modes[0]
        assert (frequency, damping) == pytest.approx((leading.frequency_hz, leading.damping_ratio), 1e-12)
    assert found.points == 4 and sum(count for _, count in found.verdicts) == 4


def test_a_walls_verdict_turns_at_its_known_limit_and_searches_and_mean_squares_are_swept() -> None:
    # m = 0.1 kg, b = 5 N·s/m, T = 1 ms: 3378.939 N/m at a delay of 1 ms, to the digits printed.
    found = apc.sweep(WALL, {"it.stiffness": "3378.9,3378.98 N/m"}, jobs=1, params={"it.delay": "1 ms"})
    assert list(found.column("verdict")) == ["stable", "unstable"]
    found = apc.sweep(WALL, {"it.delay": "0,1 ms"}, of="critical:it.stiffness", jobs=1)
    assert found.headings[1:] == ("verdict", "value [N/m]", "error [N/m]", "crossings", "proof", "message")
    values = found.column("value [N/m]")
    assert values[1] == pytest.approx(3378.939, abs=5e-4) and values[0] > values[1]
    assert found.column("error [N/m]")[1] < 1e-6
    assert list(found.column("verdict")) == ["stable below the value"] * 2
    model = apc.compile(TOPOLOGIES / "lossy-average.yaml")
    [error] = apc.sweep(model, {"lan.loss": "20 %"}, jobs=1).column("mean_square_radius_error")
    decided = apc.mean_square_stability(model, params={"lan.loss": "20 %"})
    assert decided is not None and error == decided.error < 1e-6


@pytest.mark.whole
def test_the_rows_do_not_depend_on_who_computes_them_or_in_which_order(tmp_path: Path, whole: bytes) -> None:
    small(out=tmp_path / "2.csv", jobs=2)
    assert (tmp_path / "2.csv").read_bytes() == whole
    assert [path.name for path in tmp_path.iterdir()] == ["2.csv"]
    forward, backward = (sweep(WALL, {"tick.period": text}, jobs=1) for text in ("1,2 ms", "2,1 ms"))
    for one, other in zip(forward.columns, backward.columns, strict=True):
        assert one.tolist() == other.tolist()[::-1] or all(np.isnan(one))


def test_a_point_at_fault_says_why_and_the_sweep_goes_on(tmp_path: Path) -> None:
    # A phase beyond the clock's period is no fault of either value, only of the two together.
    text = CHEAP.replace("tick: 1 ms", "tick: {period: 1 ms, phase: 0 ms}")
    target = tmp_path / "r.csv"
    found = sweep(compiled(text), {"tick.phase": "0,1.5 ms", "tick.period": "1,2 ms"}, out=target, jobs=1)
    assert list(found.column("verdict")) == ["stable", "stable", "error: E625", "stable"]
    assert math.isnan(found.column("spectral_radius")[2])
    message = "tick.phase: expected less than the clock's period, got 1.5 ms."
    assert found.column("message").tolist() == ["", "", message, ""]
    assert target.read_text(encoding="utf-8").splitlines()[3] == f'0.0015,0.001,error: E625,,,,,,"{message}"'
    assert f"at 1 of them: {message}" in str(found)


@pytest.mark.whole
def test_files_and_tables_hold_the_rows_that_are_held_without_them(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    held = small(jobs=1)
    for suffix in ("csv", "parquet"):
        found = small(out=tmp_path / f"r.{suffix}", jobs=1)
        assert found.verdicts == held.verdicts
        assert str(found).splitlines()[1:] == str(held).splitlines()[1:]
        for heading, one, other in zip(held.headings, found.columns, held.columns, strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)
            np.testing.assert_array_equal(found.column(heading), other)
    table = parquet.read_table(tmp_path / "r.parquet")
    assert table.column_names == list(held.headings)
    about = json.loads(table.schema.metadata[b"apc"])
    assert about["parameters"]["device.mass"] == 2
    assert set(about["versions"]) >= {"apc", "numpy", "casadi"}


# ---- the values ----


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("100 N/m:300 N/m:3", [100, 200, 300]),
        ("100:300 N/m:3", [100, 200, 300]),
        ("0 N/m:1 N/mm", [100 * step for step in range(11)]),
        ("0 N/m:1 N/m:4", [0, Fraction(1, 3), Fraction(2, 3), 1]),
        ("1 N/m:100 N/m:3:log", [1, 10, 100]),
        ("300 N/m, 100 N/m", [300, 100]),
        ("0,8 N/m", [0, 8]),
        ("1.5 kN/m", [1500]),
    ],
)
def test_a_range_or_list_gives_exact_values(text: str, values: list[Fraction]) -> None:
    found = apc.sweep(WALL, {"it.stiffness": text}, jobs=1)
    assert found.column("it.stiffness [N/m]").tolist() == [float(one) for one in values]


def test_numbers_in_si_stay_exact_and_may_stand_with_quantities() -> None:
    found = apc.sweep(WALL, {"it.stiffness": [Fraction(1000, 3), 0.1, "2 N/mm"]}, jobs=1)
    assert found.grid.axes[0].values == (Fraction(1000, 3), Fraction(1, 10), 2000)


FORM = "--over contact.stiffness='100 N/m:3000 N/m:30'"
RANGE = "E881 range of contact.stiffness: expected "
MANY = "E883 sweep: expected at most 10,000,000 points, got "


@pytest.mark.parametrize(
    ("over", "message"),
    [
        ({}, f"E883 no parameter is swept. Try: {FORM}"),
        (
            {"contact.stiffness": "3 N/m:1 N/m"},
            f"{RANGE}the lower end first, got 3 N/m to 1 N/m. Try: contact.stiffness=1 N/m:3 N/m",
        ),
        (
            {"contact.stiffness": "3:1 N/m:4:log"},
            f"{RANGE}the lower end first, got 3 to 1 N/m. Try: contact.stiffness=1 N/m:3 N/m:4:log",
        ),
        ({"contact.stiffness": "1 N/m:9 N/m:0"}, f"{RANGE}2 values or more, got 0. Try: {FORM}"),
        ({"contact.stiffness": "1 N/m:9 N/m:"}, f"{RANGE}2 values or more, got nothing. Try: {FORM}"),
        (
            {"contact.stiffness": "1 N/m:2 N/m:3:4"},
            f"{RANGE}LOW:HIGH:COUNT or LOW:HIGH:COUNT:log, got 1 N/m:2 N/m:3:4. Try: {FORM}",
        ),
        (
            {"contact.stiffness": "0 N/m:9 N/m:3:log"},
            f"{RANGE}a lower end above 0 for a logarithmic range, got 0 N/m. "
            "Try: contact.stiffness=0.09 N/m:9 N/m:3:log",
        ),
        (
            {"contact.stiffness": "5 N/m, 1 N/m, 5 N/m"},
            "E881 list of contact.stiffness: expected different values, got 5 N/m twice. "
            "Try: contact.stiffness=5 N/m, 1 N/m",
        ),
        (
            {"contact.stiffness": "1 kg:2 Kg:11:log"},
            "E204 contact.stiffness: expected N/m, got 1 kg. Try: contact.stiffness=1 N/m:2 N/m:11:log",
        ),
        (
            {"user.count": "2.5:10"},
            "E881 range of user.count: expected whole numbers, got 2.5 to 10. Try: user.count=3:10",
        ),
        ({"user.device.mass": "-1 kg:1 kg"}, "E624 user.device.mass: expected more than 0 kg, got -1 kg."),
        (
            {"contact.stiffness": "1,2 N/m", "couplers.contact.stiffness": "3,4 N/m"},
            "E883 contact.stiffness is swept twice.",
        ),
        (
            {"contact.stiffness": []},
            f"E881 list of contact.stiffness: expected 1 value or more, got nothing. Try: {FORM}",
        ),
        (
            {"contact.stiffness": [3.0, "5 N"]},
            "E204 contact.stiffness: expected N/m, got 5 N. Try: contact.stiffness=3 N/m,5 N/m",
        ),
        (
            {"contact.stiffness": [3.0, "5"]},
            "E204 contact.stiffness: expected N/m, got 5 (no unit). Try: contact.stiffness=5 N/m",
        ),
        # Before any value is built, which would take seconds and gigabytes.
        (
            {"contact.stiffness": "0 N/m:1 N/m:1000000", "device.mass": "1 kg:2 kg:1000000:log"},
            f"{MANY}1,000,000 × 1,000,000 = 1,000,000,000,000.",
        ),
        ({"contact.stiffness": "0:1 N/m:99999999"}, f"{MANY}99,999,999."),
        ({"contact.stiffness": "0:1 N/m:" + "9" * 5000}, MANY),
    ],
)
def test_a_faulty_axis_gets_one_clear_message(over: dict[str, str], message: str) -> None:
    (got,) = messages_of(lambda: apc.sweep(compiled(AVERAGE), over))
    assert got == f"sweep: {message}" or (message == MANY and got.startswith(f"sweep: {MANY}"))


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"of": "critical:it.stiffness"},
            "sweep: E884 it.stiffness is swept, so its critical value is undefined",
        ),
        (
            {"of": "analyse"},
            "sweep: E884 analyse is not a quantity of a sweep (analyze, critical). Try: analyze",
        ),
        ({"of": ""}, "sweep: E884 an empty name is not a quantity of a sweep (analyze, critical)."),
        ({"of": "analyze:x"}, "sweep: E884 analyze: expected no parameter, got x. Try: --of analyze"),
        ({"of": "critical"}, "sweep: E884 critical: expected a parameter, got nothing. Try: --of critical:"),
        ({"of": "critical:it.dampin"}, "sweep: E622 it.dampin is not a parameter of wall. Try: it.damping"),
        (
            {"out": Path("r.txt")},
            'r.txt: E878 suffix of out: expected one of .csv, .parquet, got .txt. Try: out="r.csv"',
        ),
        ({"jobs": 0}, "sweep: E889 number of processes: expected 1 or more, got 0."),
    ],
)
def test_a_faulty_wish_is_told_before_anything_is_computed(given: dict[str, object], message: str) -> None:
    (got,) = messages_of(lambda: sweep(WALL, {"it.stiffness": "1,2 N/m"}, **given))  # type: ignore[arg-type] # faulty
    assert got.startswith(message)


# ---- what is kept on the way ----


def forged(path: Path) -> bytes:
    """Return arrays that say that all is stable, under the first line of a part."""
    file = io.BytesIO()
    np.savez(file, verdict=np.full(64, "stable"), numbers=np.zeros((64, 5)), texts=np.array([None]))
    return path.read_bytes().partition(b"\n")[0] + b"\n" + file.getvalue()


DAMAGES: dict[str, Callable[[Path], object]] = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-5]),
    "begun": lambda path: path.write_bytes(path.read_bytes()[:40]),
    "emptied": lambda path: path.write_bytes(b""),
    "changed": lambda path: path.write_bytes(path.read_bytes().replace(b"stable", b"Stable", 1)),
    "longer": lambda path: path.write_bytes(path.read_bytes() + b"\0"),
    "of other numbers": lambda path: path.write_bytes(forged(path)),
    "without its first line": lambda path: path.write_bytes(path.read_bytes().partition(b"\n")[2]),
    "another part": lambda path: path.write_bytes(min(path.parent.glob("part-*")).read_bytes()),
    "something else": lambda path: path.write_bytes(b"thesis"),
    "a link to another file": lambda path: (path.unlink(), path.symlink_to(path.parent.parent / "own")),
    "a link to what never ends": lambda path: (path.unlink(), path.symlink_to("/dev/zero")),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_part_that_is_not_as_it_was_written_is_computed_again(
    damage: str, tmp_path: Path, whole: bytes
) -> None:
    target = tmp_path / "r.csv"
    [_, last] = interrupted(target)
    (tmp_path / "own").write_text("mine", encoding="utf-8")
    DAMAGES[damage](last)
    found = small(out=target, jobs=1)
    repeated = "part 1 was damaged or written by another user and is computed again"
    assert found.notes == (repeated, "64 points were computed before")
    assert target.read_bytes() == whole and not last.parent.exists()
    assert (tmp_path / "own").read_text(encoding="utf-8") == "mine"


@pytest.mark.whole
def test_what_another_user_computed_is_computed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: bytes
) -> None:
    target = tmp_path / "r.csv"
    with monkeypatch.context() as theirs:
        theirs.setattr(signing, "_folder", lambda: tmp_path / "theirs")
        assert len(interrupted(target, 130)) == 3
    found = small(out=target, jobs=1)
    assert not any("already" in note for note in found.notes) and target.read_bytes() == whole


@pytest.mark.whole
def test_without_a_place_for_a_secret_a_process_takes_up_what_it_wrote_itself(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(signing, "_folder", lambda: tmp_path / "file" / "cache")
    interrupted(tmp_path / "r.csv")
    assert small(out=tmp_path / "r.csv", jobs=1).notes == ("128 points were computed before",)


@pytest.mark.whole
def test_sweeps_of_one_target_and_what_others_put_beside_leave_each_other_alone(tmp_path: Path) -> None:
    target = tmp_path / "r.csv"
    stored = interrupted(target)
    notes = [stored[0].parent / name for name in ("notes.txt", ".hidden", "part-x", "manifest.json")]
    for path in notes:
        path.write_text("mine", encoding="utf-8")
    other = sweep(MODEL, {"device.mass": "1 kg:2 kg:20"}, out=target, jobs=1)
    assert not other.notes and other.points == 20
    assert set(stored) < set(stored[0].parent.iterdir())
    assert small(out=target, jobs=1).notes == ("128 points were computed before",)
    assert sorted(stored[0].parent.iterdir()) == sorted(notes)
    assert {path.read_text() for path in notes} == {"mine"}


@pytest.mark.parametrize("peer_type", ["file", "link"])
def test_what_is_no_folder_in_its_place_is_refused_and_stays(tmp_path: Path, peer_type: str) -> None:
    folder = tmp_path / "w.csv.parts"
    (tmp_path / "other").mkdir()
    folder.write_text("thesis", encoding="utf-8") if peer_type == "file" else folder.symlink_to("other")
    (message,) = messages_of(lambda: small(out=tmp_path / "w.csv", jobs=1))
    assert message.startswith(f"{folder}: E885 already exists and is not a folder")
    assert list((tmp_path / "other").iterdir()) == []


@pytest.mark.whole
def test_two_processes_may_do_the_same_sweep(tmp_path: Path, whole: bytes) -> None:
    target = tmp_path / "r.csv"

    def done_by_another(done: int, points: int) -> None:
        if done == points:  # the other one has written the target, and removes the parts
            shutil.rmtree(tmp_path / "r.csv.parts")

    small(out=target, jobs=1, progress=done_by_another)
    assert target.read_bytes() == whole


def test_a_full_disk_keeps_what_is_finished(tmp_path: Path, whole: bytes) -> None:
    """No file may be larger than ten bytes from the third part on."""
    target = tmp_path / "r.csv"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(done: int, _: int) -> None:
        if done >= 128:
            resource.setrlimit(resource.RLIMIT_FSIZE, (10, before[1]))

    try:
        (message,) = messages_of(lambda: small(out=target, jobs=1, progress=fill))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert message.endswith("E601 can't be written: File too large.")
    assert len(parts(target)) == 2 and not target.exists()
    assert small(out=target, jobs=1).notes == ("128 points were computed before",)
    assert target.read_bytes() == whole


# ---- the command, in processes of its own ----


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in (("wall", CHEAP), ("mass", ONE_MASS)):
        (tmp_path / f"{name}.yaml").write_text(text, encoding="utf-8")
        assert run(["compile", str(tmp_path / f"{name}.yaml")]) == 0
    return tmp_path


LONG = ("mass.apc", "--over", "device.mass=1 kg:2 kg:125", "--over", "device.damping=1,2,3,4 N*s/m")


@pytest.mark.whole
def test_killed_three_times_it_gives_the_file_of_one_left_alone(folder: Path) -> None:
    left_alone = start(folder, *LONG, "--out", "alone.csv", "--jobs", "1")
    target = folder / "r.csv"
    before: dict[str, tuple[int, int]] = {}
    for kill in range(3):
        jobs = "1" if kill else "2"  # it may change from run to run
        running = start_waiting(folder, 1 + kill, *LONG, "--out", "r.csv", "--jobs", jobs)
        wait_for_parts(running, target, len(before) + 1 + kill)
        workers = children(running.pid)
        running.kill()
        running.communicate()
        now = parts(target)
        assert before.items() <= now.items(), "a finished part was computed or written again"
        assert len(now) == len(before) + 1 + kill
        before = now
        while any(alive(pid) for pid in workers):  # for ever, if one outlives the process that started it
            time.sleep(0.01)
    last = start(folder, *LONG, "--out", "r.csv", "--jobs", "1")
    out, err = last.communicate()
    assert (last.returncode, err) == (0, "")
    assert f"note: {64 * len(before):,} points were computed before" in out
    assert left_alone.communicate()[1] == ""
    assert target.read_bytes() == (folder / "alone.csv").read_bytes()
    assert len(target.read_text(encoding="utf-8").splitlines()) == 501
    assert not (folder / "r.csv.parts").exists()


@pytest.mark.whole
def test_an_interrupt_ends_with_what_is_done_and_says_how_to_go_on(folder: Path) -> None:
    target = folder / "r.csv"
    running = start_waiting(folder, 2, *LONG, "--out", "r.csv", "--jobs", "2")
    wait_for_parts(running, target, 2)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate()
    assert (running.returncode, out) == (130, "")
    first, second = (line for line in err.splitlines() if line)
    assert first.endswith(" of 500 points are stored in r.csv.parts; the same command resumes the sweep")
    assert second == "stopped"
    assert not target.exists() and len(parts(target)) == 2


@pytest.mark.whole
def test_a_terminal_sees_progress_and_a_file_does_not(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    master, slave = pty.openpty()
    command = [sys.executable, "-m", "apc", "sweep", "mass.apc", *WORDS, "--out", "r.csv", "--jobs", "1"]
    with subprocess.Popen(command, cwd=folder, stderr=slave, stdout=subprocess.PIPE, text=True):
        os.close(slave)
        observed = b""
        while chunk := _read(master):
            observed += chunk
    os.close(master)
    assert b"130 of 130 points" in observed
    monkeypatch.chdir(folder)
    capsys.readouterr()
    assert run(["sweep", "mass.apc", *WORDS, "--out", "s.csv", "--jobs", "1", "--json"]) == 0
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert (document["points"], document["out"], err) == (130, "s.csv", "")
    assert sum(document["verdicts"].values()) == 130
    assert (folder / "r.csv").read_bytes() == (folder / "s.csv").read_bytes()


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 65536)
    except OSError:  # Linux says so when the other end has closed
        return b""
