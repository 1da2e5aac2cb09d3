"""What a person waits for: whole processes and their memory: `python -m tests.bench.process`.

A time is that of a processor, from the start of the process to its end, after one that compiles Python's own
files; memory is the most it held. A target is a multiple of the time of the imports that every analysis
needs, measured in the same run. The error is the bound that the command prints, relative to its value. With
`--other PYTHON`, the same commands of another version run in turn. This program loads nothing large itself,
as a process begins as a copy.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.bench.judge import Judge, elapsed, parser_of

TOPOLOGIES = Path(__file__).resolve().parents[2] / "models" / "topologies"
RUNS = 5
TOPOLOGY, LOSSY = "three-users-average", "lossy-average"
# Topologies that are made here: a line of 100 packets between two different devices, and 200 different
# groups.
LINE, GROUPS = "line", "groups"
GAINS = "contact.stiffness=10%N/m:3000%N/m", "coordination.stiffness=10%N/m:3000%N/m"
REGION = f"-m apc region --json --x {GAINS[0]} --y {GAINS[1]}"
SWEEP = "--over coordination.stiffness=100%N/m:3000%N/m:100 --over contact.stiffness=100%N/m:3000%N/m:100"
LATE = "--set lan.delay=2.4%s --set contact.stiffness=0%N/m"
IMPORTS = "imports"
# A command, its target as a multiple of the imports, and the fields of its error and value in JSON.
COMMANDS: tuple[tuple[str, str, float | None, tuple[str, ...]], ...] = (
    (IMPORTS, "-c import%numpy,scipy.linalg,casadi,yaml,click", None, ()),
    ("help", "-m apc --help", None, ()),
    ("compile", f"-m apc compile --force {TOPOLOGY}.yaml", 3, ()),
    ("analyze", f"-m apc analyze --json {TOPOLOGY}.apc", 1.9, ("spectral_radius_error", "spectral_radius")),
    ("analyze, lossy", f"-m apc analyze {LOSSY}.apc", 4.8, ()),
    ("analyze, 200 groups", f"-m apc analyze {GROUPS}.apc", 9.7, ()),
    ("analyze, passive, 100 ms", f"-m apc analyze --hands passive {LINE}.apc", 16, ()),
    ("sweep, 10,000 points", f"-m apc sweep {SWEEP} --out sweep.csv {TOPOLOGY}.apc", 4, ()),
    ("region", f"{REGION} {TOPOLOGY}.apc", 3.2, ("stable_area_error", "stable_area")),
    ("region, lossy", f"{REGION} {LOSSY}.apc", 16, ("stable_area_error", "stable_area")),
    (
        "critical, 300 frames",
        f"-m apc critical --json coordination.stiffness {LATE} {TOPOLOGY}.apc",
        8,
        ("error", "value"),
    ),
    ("transparency", f"-m apc transparency {TOPOLOGY}.apc", 3.9, ()),
    (
        "tune",
        "-m apc tune --free coordination.stiffness=10%N/m:5000%N/m --maximize coordination.stiffness "
        f"--over user.count=2:10 --over device.mass=0.08%kg:0.12%kg {TOPOLOGY}.apc",
        6.5,
        (),
    ),
    ("report", f"-m apc report --out report.html {TOPOLOGY}.yaml", 7.9, ()),
    ("simulate", f"-m apc simulate --duration 1%s {TOPOLOGY}.apc", None, ()),
)


def _environment(folder: Path) -> dict[str, str]:
    """Return an environment in which Python keeps its compiled files, as where apc is installed."""
    stored = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return stored | {"PYTHONPYCACHEPREFIX": str(folder / "python")}


def once(words: str, folder: Path, python: str = sys.executable) -> tuple[float, float, float, str]:
    """Return the seconds, those of a processor, the most MiB of one process, and what it prints."""
    command = [python, *(word.replace("%", " ") for word in words.split())]
    environment = _environment(folder)

    def run() -> tuple[bytes, int, resource.struct_rusage]:
        process = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE)
        assert process.stdout is not None
        printed = process.stdout.read()
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        return printed, process.returncode, used

    seconds, (printed, code, used) = elapsed(run)
    assert code == 0, words
    scale = 2.0**20 if sys.platform == "darwin" else 2.0**10
    (folder / "sweep.csv").unlink(missing_ok=True)
    return seconds, used.ru_utime + used.ru_stime, used.ru_maxrss / scale, printed.decode()


def write_topologies(folder: Path, python: str) -> None:
    """Write and compile the topologies of the commands."""
    for topology in (TOPOLOGY, LOSSY):
        shutil.copy(TOPOLOGIES / f"{topology}.yaml", folder)
    pair = (TOPOLOGIES / "teleoperation-pair.yaml").read_text(encoding="utf-8")
    slow, fast = "clock: network, delay: 100 ms", "clock: haptic, delay: 100 ms"
    assert slow in pair
    (folder / f"{LINE}.yaml").write_text(pair.replace(slow, fast), encoding="utf-8")
    peers = "".join(
        f"  user{number}: {{count: 1, set: {{device.mass: {0.1 + number / 1000:g} kg}}}}\n"
        for number in range(200)
    )
    (folder / f"{GROUPS}.yaml").write_text(
        f"topology: {GROUPS}\nclocks: {{haptic: 1 ms, network: 8 ms}}\npeers:\n{peers}"
        "masses: {device: {mass: 0.1 kg, damping: 1 N*s/m}}\n"
        "couplers:\n"
        "  pull: {type: AveragePosition, object: device, stiffness: 200 N/m, clock: haptic, link: lan}\n"
        "links: {lan: {clock: network, delay: 8 ms}}\n",
        encoding="utf-8",
    )
    for topology in (TOPOLOGY, LOSSY, LINE, GROUPS):
        once(f"-m apc compile {topology}.yaml", folder, python)


def relative_error(printed: str, fields: tuple[str, ...]) -> str:
    """Return the error that a command prints, relative to its value; empty without fields."""
    if not fields:
        return ""
    reported = json.loads(printed)
    error, value = (float(reported[name]) for name in fields)
    return f"{error / abs(value):.0e}"


def commands(judge: Judge, folder: Path, runs: int, other: str | None) -> None:
    """Print a line a command: least and median processor time, and the same of another version."""
    pythons = {sys.executable: folder / "here"} | ({other: folder / "other"} if other else {})
    for python, where in pythons.items():
        where.mkdir()
        write_topologies(where, python)
    beside = f" {'other':>9} {'ratio':>6}" if other else ""
    print(f"{'process':<25} {'least':>9} {'median':>9} {'error':>7} {'memory':>9}{beside}   times imports")
    imports = 0.0
    for title, words, most, fields in COMMANDS:
        rows: dict[str, list[tuple[float, float, float, str]]] = {python: [] for python in pythons}
        for _ in range(runs + 1):
            for python, where in pythons.items():
                rows[python].append(once(words, where, python))
        busy = {python: [row[1] for row in found[1:]] for python, found in rows.items()}
        least, median = min(busy[sys.executable]), statistics.median(busy[sys.executable])
        imports = imports or median
        *_, memory, printed = rows[sys.executable][-1]
        beside = (
            f" {statistics.median(busy[other]):7.3f} s {median / statistics.median(busy[other]):6.2f}"
            if other
            else ""
        )
        ratio = median / imports
        target = "" if most is None else f" of {most:g} {judge.in_time(title, ratio, most)}"
        error = relative_error(printed, fields)
        figures = f"{least:7.3f} s {median:7.3f} s {error:>7} {memory:5.0f} MiB{beside}"
        print(f"{title:<25} {figures}   {ratio:.1f}{target}", flush=True)


def main() -> None:
    """Print the tables."""
    parser = parser_of("process", __doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--other", help="the Python of an environment with another version of apc")
    given: argparse.Namespace = parser.parse_args()
    judge = Judge(given.strict)
    with tempfile.TemporaryDirectory() as name:
        commands(judge, Path(name), 1 if given.quick else given.runs, given.other)
    judge.end()


if __name__ == "__main__":
    main()
