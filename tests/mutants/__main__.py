"""Draw mutants of the product and say which of them the tests catch.

    python -m tests.mutants --count 300 --seed 1 [--whole] [--within runtime/lifting]

Each mutant is tried in a copy of this checkout, with the tests of every file of which a test ran the changed
line, those that ran it first, the quickest before the others, for at most `--seconds` of what they took
unchanged. A test that fails, or that takes ten times that long, has caught it.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import json
import os
import queue
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

from tests.mutants.sites import Mutant, draw

ROOT = Path(__file__).resolve().parents[2]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("--count", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--whole", action="store_true", help="the tests of `pytest --whole`")
    parser.add_argument("--within", default="", help="only files whose path begins so")
    parser.add_argument("--seconds", type=float, default=40.0, help="of unchanged tests a mutant")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--reach", type=Path, help="file of who runs what: read, or written if missing")
    requested = parser.parse_args()
    drawn = draw(ROOT, requested.count, requested.seed, requested.within)
    words = ["--whole"] if requested.whole else []
    with tempfile.TemporaryDirectory() as folder:
        copies: queue.Queue[Path] = queue.Queue()
        for place in range(requested.jobs):
            copies.put(_copy(Path(folder) / str(place)))
        reach = requested.reach or Path(folder) / "reach.json"
        if not reach.exists():
            copy = copies.get()
            _run(copy, ["watched", str(copy), str(reach.resolve()), *words], limit=None)
            copies.put(copy)
        known = json.loads(reach.read_text(encoding="utf-8"))

        def tried(mutant: Mutant) -> str:
            names, cost = _concerned(mutant, known, requested.seconds)
            if not names:
                return "not reached"
            copy = copies.get()
            try:
                return _fate(copy, mutant, names, cost, words)
            finally:
                copies.put(copy)

        with concurrent.futures.ThreadPoolExecutor(requested.jobs) as pool:
            fates = []
            for mutant, fate in zip(drawn, pool.map(tried, drawn), strict=True):
                fates.append(fate)
                print(f"{fate:12s} {mutant.path}:{mutant.line} {mutant.kind}: {_line(mutant)}", flush=True)
    counted = Counter(fates)
    print(f"{len(drawn)} mutants: " + ", ".join(f"{count} {fate}" for fate, count in sorted(counted.items())))


def _copy(folder: Path) -> Path:
    """Copy the product and the tests, and lay `lib/apc` out as the package is installed."""
    keep = shutil.ignore_patterns("__pycache__", "*.apc")
    for name in ("compiler", "runtime", "models", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=keep)
    for name in ("pyproject.toml", "setup.py", "README.md", "CHANGELOG.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / name)
    package = folder / "lib" / "apc"
    package.mkdir(parents=True)
    for path in (folder / "runtime").iterdir():
        (package / path.name).symlink_to(path)
    for name in ("compiler", "models"):
        (package / name).symlink_to(folder / name)
    return folder


def _run(copy: Path, words: list[str], limit: float | None) -> int | None:
    """Return the exit code of a run of tests in a copy, or None if it was stopped at the limit (s)."""
    environment = os.environ | {
        "PYTHONPATH": str(copy / "lib"),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "TMPDIR": str(copy / "tmp"),
    }
    (copy / "tmp").mkdir(exist_ok=True)
    command = [sys.executable, str(copy / "tests" / "mutants" / "reach.py"), *words]
    with (copy / "log.txt").open("w") as log:
        process = subprocess.Popen(
            command, cwd=copy, env=environment, stdout=log, stderr=log, start_new_session=True
        )
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None
        finally:
            if process.poll() is None:
                os.killpg(process.pid, 9)
                process.wait()
            shutil.rmtree(copy / "tmp", ignore_errors=True)


def _concerned(mutant: Mutant, known: dict[str, object], seconds: float) -> tuple[list[str], float]:
    """Return the tests to run, in order, and how long (s) they take unchanged."""
    tests, durations, lines = known["tests"], known["durations"], known["lines"]
    assert isinstance(tests, list) and isinstance(durations, list) and isinstance(lines, dict)
    there = lines.get(mutant.path, {})
    reached = set(there.get(str(mutant.line), ()))
    files = {tests[place].partition("::")[0] for place in reached}
    alongside = {place for place, name in enumerate(tests) if name.partition("::")[0] in files} - reached
    names, cost = [], 0.0
    for group in (reached, alongside):
        for place in sorted(group, key=lambda place: durations[place]):
            if names and cost + durations[place] > seconds:
                return names, cost
            names.append(tests[place])
            cost += durations[place]
    return names, cost


def _fate(copy: Path, mutant: Mutant, names: list[str], cost: float, words: list[str]) -> str:
    """Return whether the tests catch the mutant: `caught` or `survived`."""
    path = copy / mutant.path
    text = path.read_text(encoding="utf-8")
    (copy / "names.json").write_text(json.dumps(names), encoding="utf-8")
    path.write_text(mutant.applied(text), encoding="utf-8")
    try:
        code = _run(copy, ["chosen", str(copy / "names.json"), *words], limit=60 + 10 * cost)
    finally:
        path.write_text(text, encoding="utf-8")
    return "survived" if code == 0 else "caught"


def _line(mutant: Mutant) -> str:
    change = f"{' '.join(mutant.before.split())} -> {' '.join(mutant.after.split())}"
    return change if len(change) <= 160 else change[:157] + "..."


if __name__ == "__main__":
    main()
