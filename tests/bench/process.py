"""What a person waits for: whole processes, their memory, growth, imports: `python -m tests.bench.process`.

A time is the median of a few runs, from the start of the process to its end, after one that compiles Python's
own files; memory is the most it held. This program loads nothing large itself, as a process begins as a copy.
"""

from __future__ import annotations

import math
import os
import re
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from apc.benchmark.timing import spread_of, waited
from tests.bench.growing import SCENES, equations, flat, kinds, lossy, plain, row, table
from tests.bench.judge import Judge, parser_of

RUNS = 7
SCENE, STAR = "three-users-average", "client-server"
# Seconds of a processor.
TARGETS = {"help": 0.1, "compile": 0.4, "compile star": 0.4, "unchanged": 0.15, "analyze": 0.25}
COMMANDS = (
    ("import apc", ("-c", "import apc")),
    ("help", ("-m", "apc", "--help")),
    ("compile", ("-m", "apc", "compile", "--force", f"{SCENE}.yaml")),
    ("compile star", ("-m", "apc", "compile", "--force", f"{STAR}.yaml")),
    ("unchanged", ("-m", "apc", "compile", f"{SCENE}.yaml")),
    ("analyze", ("-m", "apc", "analyze", f"{SCENE}.apc")),
    ("simulate", ("-m", "apc", "simulate", "--duration", "1 s", f"{SCENE}.apc")),
    ("feel", ("-m", "apc", "feel", f"{SCENE}.apc")),
    ("region", ("-m", "apc", "region", f"{SCENE}.apc")),
)
# What grows, over two decades: how many of it, and how many may take how many seconds of a processor in
# `compile` and in `analyze` beyond those of the smallest.
Target = tuple[int, tuple[float, float]]
GROWTH: tuple[tuple[str, Callable[[int, Path], str], tuple[int, ...], Target], ...] = (
    ("equations", equations, (10, 30, 100, 300, 1000), (1000, (1.0, 3.0))),
    ("masses in a row", row, (4, 12, 40, 120, 400), (400, (2.0, 3.0))),
    ("kinds", kinds, (1, 2, 4, 8, 16, 32, 100), (32, (0.1, 0.1))),
)
# What one command is asked for more of: how many, the scene of so many, and the command's words.
Scene, Words = Callable[[int, Path], str], Callable[[int], tuple[str, ...]]
AMOUNTS: tuple[tuple[str, tuple[int, ...], Scene, Words], ...] = (
    ("equal peers", (30, 300, 3000, 30_000), flat, lambda number: ("analyze", "scene.apc")),
    ("different peers", (1000, 10_000, 100_000), table, lambda number: ("analyze", "scene.apc")),
    (
        "frames of delay",
        (1, 3, 10, 30, 100, 300),
        plain,
        lambda number: (
            *("critical", "coordination.stiffness", "scene.apc"),
            *("--set", f"lan.delay={8 * number} ms"),
        ),
    ),
    (
        "points",
        (1000, 10_000, 100_000),
        plain,
        lambda number: (
            *("sweep", "scene.apc", "--jobs", "1", "--out", "points.parquet"),
            *("--over", "contact.stiffness=10 N/m:3000 N/m:100"),
            *("--over", f"coordination.stiffness=10 N/m:3000 N/m:{number // 100}"),
        ),
    ),
    (
        "runs",
        (10, 100, 1000),
        lossy,
        lambda number: ("simulate", "scene.apc", "--duration", "1 s", "--runs", f"{number}"),
    ),
)
MOST_PACKAGES = 8  # listed
LINE = re.compile(r"import time:\s+(\d+) \|\s+\d+ \|\s+(\S+)")


def once(words: tuple[str, ...], folder: Path, where: Path | None = None) -> tuple[float, float, int]:
    """Return the seconds, those of a processor, and the most bytes of one process, run in `where`."""
    command = [sys.executable, *words]

    def run() -> tuple[int, resource.struct_rusage]:
        process = subprocess.Popen(
            command, cwd=where or folder, env=_environment(folder), stdout=subprocess.DEVNULL
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        return process.returncode, used

    seconds, (code, used) = waited(run)
    assert code == 0, words
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


def print_growth(
    title: str,
    write: Callable[[int, Path], str],
    numbers: Sequence[int],
    targets: Target,
    judge: Judge,
    folder: Path,
) -> None:
    """Measure `compile` and `analyze` of ever larger scenes; judge one, and print the exponents.

    An exponent is that of the time beyond the smallest scene's, over the last step.
    """
    print(f"\n{title:>16}  {'compile':>17}  {'analyze':>17}   radius")
    rows = []
    for number in numbers:
        scene = folder / title.replace(" ", "-") / str(number)
        scene.mkdir(parents=True)
        (scene / "scene.yaml").write_text(write(number, scene), encoding="utf-8")
        model = str(scene / "scene.apc")
        commands = (("compile", "--force", str(scene / "scene.yaml")), ("analyze", model))
        measured = [once(("-m", "apc", *words), folder)[1:] for words in commands]
        told = subprocess.run(
            [sys.executable, "-m", "apc", "analyze", model],
            cwd=folder, env=_environment(folder), capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        radius = next(line.split("radius")[1] for line in told.splitlines() if "spectral radius" in line)
        rows.append([seconds for seconds, _ in measured])
        print(
            f"{number:>16}  "
            + "  ".join(f"{seconds:6.2f} s {size / 2**20:4.0f} MiB" for seconds, size in measured)
            + f" {radius}"
        )
    most, seconds = targets
    for place, (command, target) in enumerate(zip(("compile", "analyze"), seconds, strict=True)):
        times = [one[place] for one in rows]
        told = f"{command}: exponent {exponent_of(numbers, times):.1f}"
        if most in numbers:
            taken = times[numbers.index(most)] - times[0]
            judged = judge.in_time(f"{command}, {most} {title}", taken, target)
            told += f"; target of {most} {target:g} s beyond the first {judged}"
        print(told)


def exponent_of(numbers: Sequence[int], times: Sequence[float]) -> float:
    """Return the exponent of the time beyond the first, over the last step."""
    first, *_, before, last = times
    return math.log(max(last - first, 0.01) / max(before - first, 0.01)) / math.log(numbers[-1] / numbers[-2])


def print_amounts(
    title: str,
    numbers: Sequence[int],
    write: Scene,
    words: Words,
    folder: Path,
) -> None:
    """Measure a command that is asked for more and more of something, and print the exponent."""
    print(f"\n{title:>16}  {words(numbers[0])[0]:>17}")
    times = []
    for number in numbers:
        scene = folder / title.replace(" ", "-") / str(number)
        scene.mkdir(parents=True)
        (scene / "scene.yaml").write_text(write(number, scene), encoding="utf-8")
        once(("-m", "apc", "compile", "scene.yaml"), folder, scene)
        if not times:  # compiles Python's own files
            once(("-m", "apc", *words(number)), folder, scene)
        _, seconds, size = once(("-m", "apc", *words(number)), folder, scene)
        times.append(seconds)
        print(f"{number:>16}  {seconds:6.2f} s {size / 2**20:4.0f} MiB")
    print(f"exponent {exponent_of(numbers, times):.1f}")


def main() -> None:
    """Print the tables."""
    parser = parser_of("process", __doc__)
    parser.add_argument("--runs", type=int, default=RUNS)
    parser.add_argument("--quick", action="store_true", help="leave out the largest of what grows")
    given = parser.parse_args()
    judge = Judge(given.strict)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for scene in (SCENE, STAR):
            shutil.copy(SCENES / f"{scene}.yaml", folder)
        print(f"{'process':<12} {'median':>9} {'spread':>9} {'processor':>10} {'memory':>9}   target")
        for title, words in COMMANDS:
            measured = [once(words, folder) for _ in range(given.runs + 1)][1:]
            times = [seconds for seconds, _, _ in measured]
            busy = statistics.median(seconds for _, seconds, _ in measured)
            memory = max(size for _, _, size in measured) / 2**20
            median, target = statistics.median(times), ""
            if title in TARGETS:
                target = f"{TARGETS[title]:g} s {judge.in_time(title, busy, TARGETS[title])}"
            print(
                f"{title:<12} {median:7.3f} s {spread_of(times):7.3f} s "
                f"{busy:8.3f} s "
                f"{memory:5.0f} MiB   {target}".rstrip()
            )
        for title, words in COMMANDS[1:]:
            found = imports(words, folder)
            listed = ", ".join(f"{one} {size / 1e3:.0f} ms" for one, size in found.most_common(MOST_PACKAGES))
            print(f"\nimports of {title}: {sum(found.values()) / 1e3:.0f} ms in all\n  {listed}")
        for title, write, numbers, targets in GROWTH:
            some = numbers[:-1] if given.quick else numbers
            print_growth(title, write, some, targets, judge, folder)
        for title, numbers, write, command in AMOUNTS:
            print_amounts(title, numbers[:-1] if given.quick else numbers, write, command, folder)
    judge.end()


if __name__ == "__main__":
    main()
