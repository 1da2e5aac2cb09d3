"""What a person waits for: whole processes, their memory and imports: `python -m tests.bench.process`.

A time is the median of a few runs, from the start of the process to its end, after one that compiles Python's
own files; memory is the most it held. This program loads nothing large itself, as a process begins as a copy.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

SCENES = Path(__file__).resolve().parents[2] / "models" / "scenes"
RUNS = 7
SCENE = "three-users-average"
TARGETS = {"compile": 1.2, "analyze": 0.5}  # seconds, on two cores
COMMANDS = (
    ("import apc", ("-c", "import apc")),
    ("compile", ("-m", "apc", "compile", "--force", f"{SCENE}.yaml")),
    ("analyze", ("-m", "apc", "analyze", f"{SCENE}.apc")),
    ("simulate", ("-m", "apc", "simulate", "--duration", "1 s", f"{SCENE}.apc")),
)
MOST_PACKAGES = 8  # listed
LINE = re.compile(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)")


def once(words: tuple[str, ...], folder: Path) -> tuple[float, float, int]:
    """Return the seconds, those of a processor, and the most bytes of one process."""
    began = time.perf_counter()
    command = [sys.executable, *words]
    process = subprocess.Popen(command, cwd=folder, env=_environment(folder), stdout=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - began
    process.returncode = os.waitstatus_to_exitcode(status)
    assert process.returncode == 0, words
    return seconds, used.ru_utime + used.ru_stime, used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def imports(words: tuple[str, ...], folder: Path) -> Counter[str]:
    """Return the microseconds that importing each package takes, its own and nothing below it."""
    command = [sys.executable, "-X", "importtime", *words]
    ran = subprocess.run(
        command, cwd=folder, env=_environment(folder), capture_output=True, text=True, check=True
    )
    found: Counter[str] = Counter()
    for line in ran.stderr.splitlines():
        if match := LINE.match(line):
            found[match[2].partition(".")[0]] += int(match[1])
    return found


def _environment(folder: Path) -> dict[str, str]:
    """Return an environment in which Python keeps its compiled files, as where apc is installed."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"PYTHONPYCACHEPREFIX": str(folder / "python")}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench.process", description=__doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    runs = parser.parse_args().runs
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(SCENES / f"{SCENE}.yaml", folder)
        print(f"{'process':<12} {'median':>9} {'spread':>9} {'processor':>10} {'memory':>9}   target")
        for title, words in COMMANDS:
            measured = [once(words, folder) for _ in range(runs + 1)][1:]
            times = sorted(seconds for seconds, _, _ in measured)
            busy = statistics.median(seconds for _, seconds, _ in measured)
            memory = max(size for _, _, size in measured) / 2**20
            target = f"{TARGETS[title]:g} s" if title in TARGETS else ""
            print(
                f"{title:<12} {statistics.median(times):7.3f} s {(times[-1] - times[0]) / 2:7.3f} s "
                f"{busy:8.3f} s "
                f"{memory:5.0f} MiB   {target}".rstrip()
            )
        for title, words in COMMANDS[1:]:
            found = imports(words, folder)
            listed = ", ".join(f"{one} {size / 1e3:.0f} ms" for one, size in found.most_common(MOST_PACKAGES))
            print(f"\nimports of {title}: {sum(found.values()) / 1e3:.0f} ms in all\n  {listed}")


if __name__ == "__main__":
    main()
