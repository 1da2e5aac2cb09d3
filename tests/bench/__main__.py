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
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from apc.benchmark.bench import machine
from apc.benchmark.timing import waited
from tests.bench.judge import HEAD, NOISE, ROW

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PAGE = HERE / "README.md"
BESIDE = "Beside other programs"
AVERAGE = "models/scenes/three-users-average.yaml"


@dataclass(frozen=True)
class Part:
    """A section of the page: its title, the words after `python -m`; `timed` by --quick and --strict."""

    name: str
    title: str
    words: tuple[str, ...]
    timed: bool = True

    def command(self, quick: bool, strict: bool = False) -> tuple[str, ...]:
        """Return the words after `python -m`."""
        judged = self.timed and self.words[0] != "apc"
        return self.words + (("--quick",) * quick + ("--strict",) * strict) * judged


def _bench(name: str, title: str, *words: str) -> Part:
    return Part(name, title, ("apc", "bench", *words), timed=False)


TITLES = {
    "random_scenes": "Random scenes",
    "random_scans": "Random scans",
    "comparison": "Other programs",
    "work_precision": "Methods of simulation",
    "play": "Peers in real time",
    "simulate": "Simulation",
    "critical": "Critical values",
    "region": "Regions",
    "network": "Unreliable networks",
    "hands": "Hands",
    "sweep": "Sweeps",
}
PARTS = (
    Part("process", "Whole processes", ("tests.bench.process",)),
    _bench("bench", "Speed against error on the paper's scene", AVERAGE),
    _bench("hard", "Hard cases", "--hard", "tests/hard"),
    _bench("scale", "More peers", AVERAGE, "--scale", "3,30,300,3000,30000,1e6"),
    *(Part(name, title, (f"tests.bench.{name}",)) for name, title in TITLES.items()),
)


def run(part: Part, quick: bool, strict: bool = False) -> tuple[str, list[str], int]:
    """Return a section of the page, the rows of other programs, and the code its program ended with."""
    words = part.command(quick, strict)
    load = f", load {os.getloadavg()[0]:.0f}" if hasattr(os, "getloadavg") else ""
    taken, ran = waited(
        lambda: subprocess.run(
            [sys.executable, "-m", *words], cwd=ROOT, capture_output=True, text=True, check=False
        )
    )
    shown = " ".join(words if words[0] == "apc" else ("python", "-m", *words))
    lines = ran.stdout.splitlines()
    rows = [f"{line} {part.title} |" for line in lines if line.startswith(ROW) and line != HEAD]
    told = "\n".join(line for line in lines if not line.startswith(ROW)).replace("\n\n\n", "\n\n")
    text = "\n\n".join(said for said in (told.rstrip(), ran.stderr.rstrip()) if said)
    end = "" if ran.returncode == 0 else f"\n\nIt ended with code {ran.returncode}."
    day = datetime.now(tz=UTC).date().isoformat()
    page = f"## {part.title}\n\n`{shown}` ({day}, {taken:.0f} s{load})\n\n```text\n{text}\n```{end}\n"
    return page, rows, ran.returncode


def sections(page: str) -> dict[str, str]:
    """Return the sections of a page by their titles."""
    parts = page.split("\n## ")[1:]
    return {part.partition("\n")[0]: f"## {part.rstrip()}\n" for part in parts}


def beside(rows: list[str]) -> str:
    """Return the section of what other programs take."""
    about = (
        "Processor time of one core, both of a row measured in one run of the part named last. An error is\n"
        "the true one; after `≤` stands the most it may be, apc's own bound where it gives one.\n"
        "Below 1 apc is the faster."
    )
    rule = "|---" * HEAD.count(" | ") + "|---|---|"
    return "\n".join([f"## {BESIDE}", "", about, "", f"{HEAD} measured in |", rule, *rows, ""])


def main() -> None:
    """Run the parts and write the page."""
    parser = argparse.ArgumentParser(prog="python -m tests.bench", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="smaller runs")
    parser.add_argument("--strict", action="store_true", help="a missed target of time is a failure too")
    names = [part.name for part in PARTS]
    parser.add_argument("--only", action="append", choices=names, help="may be repeated")
    given = parser.parse_args()
    before = sections(PAGE.read_text(encoding="utf-8")) if given.only and PAGE.is_file() else {}
    rows_before = [line for line in before.pop(BESIDE, "").splitlines() if line.startswith(ROW)]
    found, rows, failed = [], [], []
    for part in PARTS:
        if given.only and part.name not in given.only:
            found += [before[part.title]] if part.title in before else []
            rows += [row for row in rows_before if row.endswith(f"| {part.title} |")]
            continue
        text, new, code = run(part, given.quick, given.strict)
        rows += new
        found.append(text)
        failed += [part.name] if code else []
        print(text, flush=True)
    where = "\n".join(f"| {name} | {value} |" for name, value in machine().items() if value)
    head = (
        "# Figures\n\nSpeed against error, as last measured. This makes them again and writes this page:\n\n"
        "    python -m tests.bench\n\n"
        "Smaller runs: `--quick`. One part: `--only hard`. Each part says how it was run, when, and the\n"
        "load before it: how many processes wanted a core. A target is kept, missed, or near: missed by\n"
        f"at most a factor of {NOISE:g}, as two runs may differ. `--strict` fails on a missed one.\n"
        "Measured on:\n\n"
        f"| | |\n|---|---|\n{where}\n"
    )
    PAGE.write_text("\n".join([head, beside(rows), *found]), encoding="utf-8")
    if failed:
        raise SystemExit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
