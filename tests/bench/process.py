"""What a person waits for: whole processes and their memory: `python -m tests.bench.process`.

A time is that of a processor, from the start of the process to its end, after one that compiles Python's own
files; memory is the most it held. This program loads nothing large itself, as a process begins as a copy.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from apc.benchmark.timing import spread_of
from tests.bench.judge import Judge, elapsed, parser_of

TOPOLOGIES = Path(__file__).resolve().parents[2] / "models" / "topologies"
RUNS = 7
TOPOLOGY, STAR = "three-users-average", "client-server"
# A command and its target in seconds.
COMMANDS: tuple[tuple[str, str, float | None], ...] = (
    ("import apc", "-c import%apc", None),
    ("help", "-m apc --help", 0.1),
    ("compile", f"-m apc compile --force {TOPOLOGY}.yaml", 0.4),
    ("compile star", f"-m apc compile --force {STAR}.yaml", 0.4),
    ("unchanged", f"-m apc compile {TOPOLOGY}.yaml", 0.15),
    ("analyze", f"-m apc analyze {TOPOLOGY}.apc", 0.25),
    ("simulate", f"-m apc simulate --duration 1s {TOPOLOGY}.apc", None),
    ("transparency", f"-m apc transparency {TOPOLOGY}.apc", None),
    ("region", f"-m apc region {TOPOLOGY}.apc", None),
)


def _environment(folder: Path) -> dict[str, str]:
    """Return an environment in which Python keeps its compiled files, as where apc is installed."""
    stored = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return stored | {"PYTHONPYCACHEPREFIX": str(folder / "python")}


def once(words: str, folder: Path, where: Path | None = None) -> tuple[float, float, float, str]:
    """Return the seconds, those of a processor, the most MiB of one process, and what it prints."""
    command = [sys.executable, *(word.replace("%", " ") for word in words.split())]
    environment = _environment(folder)

    def run() -> tuple[bytes, int, resource.struct_rusage]:
        process = subprocess.Popen(command, cwd=where or folder, env=environment, stdout=subprocess.PIPE)
        assert process.stdout is not None
        printed = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        return printed, process.returncode, used

    seconds, (printed, code, used) = elapsed(run)
    assert code == 0, words
    scale = 2.0**20 if sys.platform == "darwin" else 2.0**10
    return seconds, used.ru_utime + used.ru_stime, used.ru_maxrss / scale, printed.decode()


def commands(judge: Judge, folder: Path, runs: int) -> None:
    """Print a line a command."""
    for topology in (TOPOLOGY, STAR):
        shutil.copy(TOPOLOGIES / f"{topology}.yaml", folder)
    print(f"{'process':<12} {'median':>9} {'spread':>9} {'processor':>10} {'memory':>9}   target")
    for title, words, most in COMMANDS:
        rows = [once(words, folder) for _ in range(runs + 1)][1:]
        times, busy, memory, _ = zip(*rows, strict=True)
        used = statistics.median(busy)
        target = "" if most is None else f"   {most:g} s {judge.in_time(title, used, most)}"
        spread = f"{statistics.median(times):7.3f} s {spread_of(list(times)):7.3f} s"
        print(f"{title:<12} {spread} {used:8.3f} s {max(memory):5.0f} MiB{target}")


def main() -> None:
    """Print the tables."""
    parser = parser_of("process", __doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    given: argparse.Namespace = parser.parse_args()
    judge = Judge(given.strict)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        commands(judge, folder, given.runs)
    judge.end()


if __name__ == "__main__":
    main()
