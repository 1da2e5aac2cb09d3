"""No command takes more memory than there is: what is known beforehand is refused, the rest ends in words."""

from __future__ import annotations

import re
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import pytest

from apc.compiler.errors import ApcError
from apc.simulation.trajectory import simulate
from apc.support import memory
from tests.commands import Cli, folder, write
from tests.topologies import AVERAGE, compiled, replaced

LOSSY = replaced(AVERAGE, ("delay: 8 ms}", "delay: 8 ms, loss: 2 %}"))
SHORT = "simulate topology.yaml --duration 16ms"


@pytest.mark.parametrize(
    ("text", "words", "needs"),
    [
        (AVERAGE, "analyze topology.yaml", "E804 2 systems of up to 8 states need about .* kB"),
        (
            AVERAGE,
            "analyze topology.yaml --method determinant",
            "E804 2 determinants of 2 different peers need about .* kB",
        ),
        (AVERAGE, SHORT, "E874 3 peers with .* numbers in a frame need about .* kB"),
        (LOSSY, f"{SHORT} --runs 400", "E876 400 runs need about 120 kB"),
        (
            AVERAGE,
            "sweep topology.yaml --out a.csv --over coordination.stiffness=0N/m:900N/m:1000",
            "E883 1,000 points of 8 columns need about .* kB",
        ),
    ],
)
def test_what_would_not_fit_is_refused_with_what_it_needs_and_what_there_is(
    monkeypatch: pytest.MonkeyPatch, cli: Cli, text: str, words: str, needs: str
) -> None:
    write("topology.yaml", text)
    _leave(monkeypatch, 1000)
    ran = cli(words)
    assert ran.code == 1 and re.search(rf"{needs} of memory, but 1 kB are free\. ", ran.err), ran.err


@pytest.mark.few(2)
@pytest.mark.parametrize("suffix", ["csv", "npz", "mat", "parquet"])
def test_a_file_that_would_not_fit_while_it_is_written_is_refused_and_not_begun(
    monkeypatch: pytest.MonkeyPatch, cli: Cli, suffix: str
) -> None:
    write("topology.yaml", AVERAGE)
    _leave(monkeypatch, 100_000)
    ran = cli(f"{SHORT} --out=a.{suffix}")
    assert ran.code == 1
    needs = rf"E876 24 rows of 25 columns in a\.{suffix} need about \d+ kB of memory, but 100 kB are free"
    assert re.search(rf"{needs}\. Record fewer --signals", ran.err)
    assert folder() == ["topology.yaml"]


def test_packets_that_would_not_fit_while_they_are_on_their_way_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    channel = "delay: 20 s, loss: 2 %, jitter: 3 ms, reorder: all}"
    late = replaced(AVERAGE, ("count: 3", "count: 40"), ("delay: 8 ms}", channel))
    _leave(monkeypatch, 2e7)
    # 100 bytes a packet, 200 a way: within 20 s and the jitter 2,500 are sent, and three frames more kept.
    needs = r"E892 3,904,680 packets stored for 1,560 directed connections of the unreliable "
    needs += r"link lan need about 391 MB"
    with pytest.raises(ApcError, match=needs):
        simulate(compiled(late), duration=Fraction(1))


def test_rows_that_would_not_fit_are_refused_before_they_are_played(monkeypatch: pytest.MonkeyPatch) -> None:
    _leave(monkeypatch, 1e9)
    with pytest.raises(ApcError, match=r"E876 24 signals over 10000 s need about 3\.84 GB of memory"):
        simulate(compiled(AVERAGE), duration=Fraction(10_000))


def test_the_least_of_what_machine_groups_and_limits_leave_is_free(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    files = {
        "meminfo": "MemTotal: 9000 kB\nMemAvailable:    8000 kB\nSwapFree: 1000 kB\n",
        "self/cgroup": "9:name=systemd:/\n4:memory:/one/two\n0::/three\n",
        "self/status": "VmSize: 900 kB\nVmData:\t  400 kB\n",
        "memory/one/memory.limit_in_bytes": "5000000",
        "memory/one/memory.usage_in_bytes": "1000000",
        "memory/one/memory.stat": "cache 7\ninactive_file 100000\n",
        "three/memory.max": "max\n",
        "three/memory.current": "5\n",
        "memory.max": "4200000\n",
        "memory.current": "1200000\n",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    for name, place in (("CGROUPS", ""), ("PROCESS", "self"), ("MACHINE", "meminfo")):
        monkeypatch.setattr(memory, name, tmp_path / place)
    monkeypatch.setattr(memory, "_process_limit_memory", lambda: iter(()))
    assert memory.free_memory() == 3_000_000
    (tmp_path / "memory.max").unlink()
    assert memory.free_memory() == 4_100_000
    (tmp_path / "self/cgroup").unlink()
    assert memory.free_memory() == 9000 * 1024
    monkeypatch.setattr(memory, "_process_limit_memory", lambda: iter((2e6,)))
    assert memory.free_memory() == 2_000_000


@pytest.mark.parametrize("lack", [MemoryError(), RuntimeError("Error in Function::map: std::bad_alloc")])
def test_what_no_estimate_foresaw_ends_in_words(
    monkeypatch: pytest.MonkeyPatch, cli: Cli, lack: Exception
) -> None:
    def compile_topology(_: Path) -> None:
        raise lack

    write("topology.yaml", AVERAGE)
    monkeypatch.setattr("apc.compiler.pipeline.compile_topology", compile_topology)
    _leave(monkeypatch, 1e9)
    assert cli("check topology.yaml") == (
        1,
        "",
        "apc check: E820 out of memory. "
        "Reduce the number of different peers or states, or shorten the time.\n",
    )


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is Linux's")
def test_a_process_is_told_before_the_system_would_end_it() -> None:
    code = (
        "from apc.support import memory\nimport numpy\n"
        "memory._machine_memory = lambda: 2.0**28\nmemory.hold_to_memory()\n"
        "assert memory.free_memory() <= 2**28\n"
        "numpy.ones(2**24)\n"
        "try:\n    numpy.ones(2**26)\nexcept MemoryError as error:\n    assert memory.is_lack(error)\n"
        "else:\n    raise AssertionError\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def _leave(monkeypatch: pytest.MonkeyPatch, size: float) -> None:
    """Leave so many bytes free, however many this machine has."""
    monkeypatch.setattr(memory, "free_memory", lambda: size)
    monkeypatch.setattr(memory, "SMALL", 0)
