"""Every figure by one command: `python -m tests.bench` writes README.md beside it.

The page begins with one table of what other programs take for the same work, from the rows that the parts
print (`tests.bench.judge`): nothing in it is typed, and a part that isn't run keeps its rows.

`--quick` takes smaller runs of each, `--only NAME` one or more of them, and keeps the rest of the page. It
ends with code 1 if a part did, which is when a number is wrong; with `--strict` also when a time is missed.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

from apc.benchmark.speed_and_error import machine
from tests.bench.judge import HEAD, NOISE, ROW, elapsed

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PAGE = HERE / "README.md"
ALONGSIDE = "Beside other programs"
AVERAGE = "models/topologies/three-users-average.yaml"

# The sections of the page by their names: the title, and the words after `python -m`.
PARTS = {
    "process": ("Whole processes", "tests.bench.process"),
    "bench": ("Speed against error on the paper's topology", f"apc bench {AVERAGE}"),
    "hard": ("Hard cases", "apc bench --hard tests/hard"),
    "growth": ("Cost against size", "tests.bench.growth --out tests/bench/growth.svg"),
    "scale": ("More peers", f"apc bench {AVERAGE} --scale 3,30,300,3000,30000,1e6"),
    "random_topologies": ("Random topologies", "tests.bench.random_topologies"),
    "random_scans": ("Random scans", "tests.bench.random_scans"),
    "comparison": ("Other programs", "tests.bench.comparison"),
    "work_precision": ("Methods of simulation", "tests.bench.work_precision"),
    "play": ("Peers in real time", "tests.bench.play"),
    "simulate": ("Simulation", "tests.bench.simulate"),
    "hands": ("Hands", "tests.bench.hands"),
    "tuning": ("Gains that do best", "tests.bench.tuning"),
}


def run(title: str, words: str) -> tuple[str, list[str], int]:
    """Return a section of the page, the rows of other programs, and the code its program ended with."""
    command = [sys.executable, "-m", *words.split()]
    load = os.getloadavg()[0]
    used, ran = elapsed(
        lambda: subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    )
    shown = words if words.startswith("apc") else f"python -m {words}"
    lines = ran.stdout.splitlines()
    rows = [f"{line} {title} |" for line in lines if line.startswith(ROW) and line != HEAD]
    reported = "\n".join(line for line in lines if not line.startswith(ROW)).replace("\n\n\n", "\n\n")
    text = "\n\n".join(printed for printed in (reported.rstrip(), ran.stderr.rstrip()) if printed)
    end = f"\n\nIt ended with code {ran.returncode}." if ran.returncode else ""
    how = f"{datetime.now(tz=UTC).date()}, {used:.0f} s, load {load:.0f}"
    picture = words.partition("--out tests/bench/")[2].partition(" ")[0]
    drawn = f"\n![{title}]({picture})\n" if picture else ""
    return f"## {title}\n\n`{shown}` ({how})\n\n```text\n{text}\n```{end}\n{drawn}", rows, ran.returncode


def main() -> None:
    """Run the parts and write the page."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller runs")
    parser.add_argument("--strict", action="store_true", help="a missed target of time is a failure too")
    parser.add_argument("--only", action="append", choices=PARTS, help="may be repeated")
    given = parser.parse_args()
    before = {}
    if given.only and PAGE.is_file():
        parts = PAGE.read_text(encoding="utf-8").split("\n## ")[1:]
        before = {part.partition("\n")[0]: f"## {part.rstrip()}\n" for part in parts}
    rows_before = [line for line in before.pop(ALONGSIDE, "").splitlines() if line.startswith(ROW)]
    found, rows, failed = [], [], []
    for name, (title, words) in PARTS.items():
        if given.only and name not in given.only:
            found += [before[title]] if title in before else []
            rows += [row for row in rows_before if row.endswith(f"| {title} |")]
            continue
        if not words.startswith("apc"):
            words += " --quick" * given.quick + " --strict" * given.strict
        text, new, code = run(title, words)
        rows += new
        found.append(text)
        failed += [name] if code else []
        print(text, flush=True)
    where = "\n".join(f"| {name} | {value} |" for name, value in machine().items() if value)
    rule = "|---" * HEAD.count(" | ") + "|---|---|"
    head = (
        "# Figures\n\nSpeed against error, as last measured. This makes them again and writes this page:\n\n"
        "    python -m tests.bench\n\n"
        "Smaller runs: `--quick`. One part: `--only hard`. Each part says how it was run, when, and the\n"
        "load before it: how many processes wanted a core. A target is kept, missed, or near: missed by\n"
        f"at most a factor of {NOISE:g}, as two runs may differ. `--strict` fails on a missed one.\n"
        f"Measured on:\n\n| | |\n|---|---|\n{where}\n\n## {ALONGSIDE}\n\n"
        "Processor time of one core, both of a row measured in one run of the part named last. An error is\n"
        "the true one; after `≤` stands the most it may be, apc's own bound where it gives one.\n"
        f"Below 1 apc is the faster.\n\n{HEAD} measured in |\n{rule}\n"
    )
    PAGE.write_text(head + "\n".join([*rows, "", *found]), encoding="utf-8")
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
