"""Peers in real time: `apc run` does what is simulated, a device outside is measured, mistakes are told."""

from __future__ import annotations

import json
import multiprocessing
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
from concurrent.futures import Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apc.__main__ import run
from apc.compiler.errors import ApcError, Diagnostic
from apc.output.realtime_output import ticks_text
from apc.realtime.device import device_function
from apc.realtime.peer_run import run_of
from apc.realtime.run_comparison import Ticks
from apc.realtime.run_folder import read_run
from apc.realtime.start import LocalRun, RunPart, run_all
from apc.support.processes import Workers
from tests.surfaces.wire import Other, Wire, loop_at, send_packets
from tests.topologies import AVERAGE, compiled, replaced

MOVING = replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: 3 mm}}"))

DIGEST = bytes(32)


@pytest.fixture(autouse=True)
def no_claims(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave this process as it is: a peer's own keeps all memory, collects none, and goes before others."""
    monkeypatch.setattr("apc.realtime.start.claim", tuple)


def test_all_peers_of_a_topology_do_what_is_simulated_with_the_packets_they_heard(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each in a process of its own: every signal at every tick, to the last bits; some packets are lost."""
    monkeypatch.chdir(tmp_path)
    text = replaced(
        MOVING,
        ("three-users-average", f"{tmp_path}/of/another/folder"),  # a title, which is any text
        ("{count: 3,", "{count: 2,"),
        ("delay: 8 ms}", "delay: 8 ms, loss: 20 %}"),
    )
    Path("three.yaml").write_text(text, encoding="utf-8")
    assert run(["run", "--duration", "1 s", "--emulate", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["why_not"] == ""
    assert max(far for far, _ in reported["differences"].values()) <= 1e-9
    assert reported["differences"]["N"][1] > 0.1
    assert len(reported["arcs"]) == 2
    for arc in reported["arcs"]:
        assert 0.01 < arc["came"]["lost"]["share"] < 0.45  # of 125, of which 20 % are lost: 6 deviations
        assert arc["came"]["shortest"] >= 0.008
    assert [one.name for one in read_run(Path("three.run")).peers] == ["user[1]", "user[2]"]
    assert run(["compare", "three.run"]) == 0
    out = capsys.readouterr().out
    assert "delay and loss of the links were emulated at the sender" in out
    assert "unit  max difference  max value\n" in out
    Path("three.run/user-1.npz").write_bytes(b"PK")
    assert run(["compare", "three.run"]) == 1
    assert "E973" in capsys.readouterr().err


def test_a_device_outside_is_measured_and_pushed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wall of clay at 2 mm: its position is what is recorded, its force what the contact's spring says."""
    reported: dict[int, float] = {}

    def device(time: float, force: float | None) -> float:
        if force is not None:
            reported[round(time * 1000)] = force
        return 0.002

    wire = Wire(monkeypatch)
    loop = loop_at(wire, compiled(MOVING), DIGEST, b"", device=device)
    others = [Other(wire, number, DIGEST, b"") for number in (1, 2)]
    loop.meet(60)
    send_packets(loop, others, 0.001)
    loop.run()
    record = run_of(loop, DIGEST, ())
    column = {name.removeprefix("user[1]."): at for at, name in enumerate(record.signals)}
    assert (record.values[1:, column["device.x"]] == 0.002).all()
    assert (record.values[2:, column["device.v"]] == 0).all()
    acting = record.values[:, column["contact.f acting"]]
    assert np.ptp(acting) > 1e-3
    # What acts from tick k on is recorded at tick k + 1, as it was just before that.
    for tick in range(len(acting) - 1):
        assert reported[tick] == pytest.approx(-acting[tick + 1], abs=1e-12)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_device_may_be_in_c(tmp_path: Path) -> None:
    text = "double apc_device(double time, const double *force) { return force ? -*force : 2 * time; }"
    (tmp_path / "d.c").write_text(text, encoding="utf-8")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", "d.so", "d.c"], cwd=tmp_path, check=True)
    device = device_function(tmp_path / "d.so")
    assert device(1.5, None) == 3.0
    assert device(1.5, 0.25) == -0.25
    with pytest.raises(ApcError, match="E976"):
        device_function(tmp_path / "d.txt")


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise OSError('gone')", "raised OSError at 0.05 s: gone"),
        ("return None", "returned None as position at 0.05 s"),
        ("return '1'", "returned '1' as position at 0.05 s"),
    ],
)
def test_a_device_that_fails_ends_the_loop_and_what_was_done_is_kept(
    fault: str, message: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    text = f"def device(time, force):\n    if time >= 0.05:\n        {fault}\n    return 0.002\n"
    (tmp_path / "device.py").write_text(text, encoding="utf-8")
    device = device_function(tmp_path / "device.py")
    loop = loop_at(Wire(monkeypatch), compiled(MOVING), DIGEST, b"", device=device)
    loop.begins = 1  # long ago: every tick is late
    loop.run()
    assert message in str(loop.trouble)
    assert run_of(loop, DIGEST, ()).time[-1] == pytest.approx(0.047)  # of whole frames


def test_a_loop_that_is_told_to_end_ends_however_late_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    stop, end = multiprocessing.Pipe(duplex=False)
    loop = loop_at(Wire(monkeypatch), compiled(MOVING), DIGEST, b"", stop=stop)
    loop.begins = 1
    end.close()
    loop.run()
    assert loop.stopped
    assert loop.trouble is None


@pytest.mark.whole
def test_what_cant_be_played_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("three.yaml").write_text(MOVING, encoding="utf-8")
    used = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    used.bind(("127.0.0.1", 0))
    port = used.getsockname()[1]
    other = ["--to", "user[2]=127.0.0.1:1", "--to", "user[3]=127.0.0.1:2"]
    Path("own").mkdir()
    Path("own/thesis.txt").write_text("mine", encoding="utf-8")
    Path("short.txt").write_text("abc", encoding="utf-8")
    Path("short.txt").chmod(0o600)
    Path("open to all.txt").write_text("sixteen bytes or more", encoding="utf-8")
    Path("open to all.txt").chmod(0o604)
    there = sorted(str(one) for one in Path().rglob("*"))
    text = (Path(__file__).parent / "play.txt").read_text(encoding="utf-8")
    text = text.replace("$OTHER", shlex.join(other)).replace("$PORT", str(port))
    for line in text.splitlines():
        words, _, message = line.partition(" → ")
        assert run(["run", "three.yaml", "--duration", "1 s", *shlex.split(words)]) == 1, words
        assert message in " ".join(capsys.readouterr().err.split()), words
    assert Path("own/thesis.txt").read_text(encoding="utf-8") == "mine"
    assert sorted(str(one) for one in Path().rglob("*")) == there  # nothing is begun
    Path("empty").mkdir()
    assert run(["compare", "empty"]) == 1
    assert "E973" in capsys.readouterr().err
    alone = replaced(MOVING, ("{count: 3,", "{count: 65,"))
    Path("many.yaml").write_text(alone, encoding="utf-8")
    assert run(["run", "many.yaml", "--duration", "1 s"]) == 1
    assert "E975 65 peers need as many processes; the limit is 64." in capsys.readouterr().err
    used.close()


def test_a_peer_that_is_lost_or_silent_takes_nothing_of_the_others_along(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One ends at once with what it did, one is killed, one does not end when all are told to."""
    whole = run_of(loop_at(Wire(monkeypatch), compiled(MOVING), DIGEST, b"", "1"), DIGEST, ())
    ended: dict[str, Future[RunPart]] = {f"user[{at}]": Future() for at in (1, 2, 3)}
    ended["user[1]"].set_result(RunPart(whole))
    ended["user[2]"].set_exception(BrokenProcessPool())

    def workers(
        compute: object, shared: object, jobs: int, lost: Diagnostic
    ) -> nullcontext[Workers[str, RunPart]]:
        assert jobs == 1
        return nullcontext(Workers(ended.__getitem__, 2, lambda _: ApcError(lost)))

    waits = iter([wait, None, wait])  # Ctrl-C when both have ended

    def waiting(*given: Any, **how: Any) -> Any:
        if (now := next(waits)) is None:
            raise KeyboardInterrupt
        return now(*given, **how)

    monkeypatch.setattr("apc.realtime.start.local_processes", workers)
    monkeypatch.setattr("apc.realtime.start.wait", waiting)
    monkeypatch.setattr("apc.realtime.start.TO_END", 0.0)
    parts = run_all(compiled(MOVING), LocalRun(Fraction(1), b"", emulate=False, seed=None, patience=1.0))
    assert [one.run for one in parts if one.run] == [whole]
    assert [str(one.trouble) for one in parts if one.trouble] == [
        "user[2]: E975 peer process exited unexpectedly; its recording is lost.",
        "user[3]: E975 did not exit within 0 s and was terminated; its recording is lost.",
    ]


# It says sooner that it is at work.
PLAY = """
import sys
from apc.__main__ import main
from apc.cli import progress
if __name__ == "__main__":
    progress.QUIET = 4.0
    sys.exit(main())
"""


def command(folder: Path, *words: str) -> subprocess.Popen[str]:
    (folder / "apc_play.py").write_text(PLAY, encoding="utf-8")  # a file: processes it starts read it again
    return subprocess.Popen(
        [sys.executable, "apc_play.py", "run", "three.yaml", *words],
        cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


@pytest.mark.whole
def test_ctrl_c_ends_a_peer_and_what_it_did_is_kept(tmp_path: Path) -> None:
    """While it waits for others nothing is written; while it plays, alone or all, what was done is."""
    (tmp_path / "three.yaml").write_text(replaced(MOVING, ("{count: 3,", "{count: 2,")), encoding="utf-8")
    nobody = ("--peer", "user[1]", "--to", "user[2]=127.0.0.1:1", "--duration", "9 s", "--out", "no.run")
    waiting = command(tmp_path, *nobody, "--wait", "600 s")
    playing = command(tmp_path, "--duration", "600 s", "--out", "all.run")
    for _ in range(600):  # both print when they have been at work for so long
        if select.select([playing.stderr], [], [], 1.0)[0]:
            break
    for one in (waiting, playing):
        one.send_signal(signal.SIGINT)
    assert "stopped" in waiting.communicate(timeout=240)[1]
    assert waiting.returncode == 130
    assert not (tmp_path / "no.run").exists()
    reported = playing.communicate(timeout=240)
    if playing.returncode != 130:  # the topology had begun
        assert playing.returncode == 0, reported[1]
        assert "stopped before the end" in reported[0]
        assert all(one.stopped for one in read_run(tmp_path / "all.run").peers)


def test_each_heading_is_above_its_column() -> None:
    ticks = Ticks("left[1]", 2000, (1e-5, 2e-5, 3e-5, 4e-5), (1e-4, 2e-4, 3e-4, 4e-4), 0.0, False, (), {})
    lines = list(ticks_text([ticks]))
    for title, (subject, heading, row) in (
        ("Delay of ticks", (lines[1], *lines[3:5])),
        ("Computing time of ticks", (lines[6], *lines[8:10])),
    ):
        assert subject == title and heading.split()[0] == "peer"
        assert row.split()[:2] == ["left[1]", "2,000"]
        assert heading.index("ticks") + len("ticks") == row.index("2,000") + len("2,000")
        assert len(heading) == len(row)  # the numbers end where their headings do
