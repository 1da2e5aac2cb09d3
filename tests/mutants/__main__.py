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
import tempfile
from collections import Counter
from pathlib import Path

from tests.mutants.copies import ROOT, product_copy, run_tests
from tests.mutants.sites import Mutant, draw


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
            copies.put(product_copy(Path(folder) / str(place)))
        reach = requested.reach or Path(folder) / "reach.json"
        if not reach.exists():
            copy = copies.get()
            run_tests(copy, ["watched", str(copy), str(reach.resolve()), *words], limit=None)
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
        code = run_tests(copy, ["chosen", str(copy / "names.json"), *words], limit=60 + 10 * cost)
    finally:
        path.write_text(text, encoding="utf-8")
    return "survived" if code == 0 else "caught"


def _line(mutant: Mutant) -> str:
    change = f"{' '.join(mutant.before.split())} -> {' '.join(mutant.after.split())}"
    return change if len(change) <= 160 else change[:157] + "..."


if __name__ == "__main__":
    main()
