"""Find for each threshold of the product a test that fails where the threshold is another.

    python -m tests.mutants.thresholds --reach FILE [--seconds 10] [--within runtime/lifting]

Each constant of the page "Thresholds" is multiplied and divided by ten in a copy of this checkout, and the
tests that ran a line which uses it are run, the quickest first. The first that fails is written to
`thresholds.json` beside this file, "" where all pass. Constants that stand in the file are not tried again.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import queue
import re
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from tests.mutants.copies import ROOT, product_copy, run_tests

FOUND = Path(__file__).with_name("thresholds.json")
FACTOR = 10
MOST_TESTS = 60


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants.thresholds", description=__doc__)
    parser.add_argument("--reach", type=Path, required=True, help="file of who runs what: read, or written")
    parser.add_argument("--seconds", type=float, default=10.0, help="of unchanged tests a constant")
    parser.add_argument("--within", default="", help="only files whose path begins so")
    parser.add_argument("--jobs", type=int, default=1)
    requested = parser.parse_args()
    found = json.loads(FOUND.read_text(encoding="utf-8")) if FOUND.is_file() else {}
    wanted = {
        key: (path, names) for key, path, names in thresholds() if str(path).startswith(requested.within)
    }
    with tempfile.TemporaryDirectory() as folder:
        copies: queue.Queue[Path] = queue.Queue()
        for place in range(requested.jobs):
            copies.put(product_copy(Path(folder) / str(place)))
        if not requested.reach.exists():
            copy = copies.get()
            run_tests(copy, ["watched", str(copy), str(requested.reach.resolve())], limit=None)
            copies.put(copy)
        known = json.loads(requested.reach.read_text(encoding="utf-8"))

        def tried(key: str) -> str:
            path, names = wanted[key]
            copy = copies.get()
            try:
                return failing(copy, path, names, reaching(known, path, names, requested.seconds))
            finally:
                copies.put(copy)

        keys = [key for key in wanted if key not in found]
        with ThreadPoolExecutor(requested.jobs) as pool:
            for key, test in zip(keys, pool.map(tried, keys), strict=True):
                print(f"{key}: {test or 'none'}", flush=True)
                found[key] = test
                FOUND.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def thresholds() -> Iterator[tuple[str, Path, str]]:
    """Yield the key, the path and the names of each constant of the page; caches are left out."""
    sys.path.insert(0, str(ROOT / "docs"))
    generate = importlib.import_module("generate")
    for package in generate.DECIDING:
        for path in sorted((ROOT / "runtime" / package).rglob("*.py")):
            for names, _, _ in generate.constants(path):
                if names != "CACHE_SIZE":
                    yield generate.threshold_key(path, names), path.relative_to(ROOT), names


def changed(text: str, names: str, factor: float) -> str:
    """Return a module's text with the numbers of a constant multiplied."""
    for node in ast.parse(text).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).strip("()") == names:
            break
    else:
        raise KeyError(names)
    scaled = _multiplied(node.value, factor)
    lines = text.splitlines(keepends=True)
    return "".join(
        [
            *lines[: node.lineno - 1],
            f"{names} = {ast.unparse(scaled)}\n",
            *lines[node.end_lineno or node.lineno :],
        ]
    )


def _multiplied(node: ast.expr, factor: float) -> ast.expr:
    """Return a number, or a tuple of numbers, multiplied; a whole number stays whole, and 0 is the factor."""
    if isinstance(node, ast.Tuple):
        return ast.Tuple([_multiplied(item, factor) for item in node.elts], ast.Load())
    number = eval(ast.unparse(node))  # numbers alone: see `constants` of docs/generate.py
    product = number * factor if number else factor
    if isinstance(number, int):
        product = max(round(product), 1) if number >= 0 else min(round(product), -1)
    return ast.parse(repr(product), mode="eval").body


def uses(path: Path, names: str) -> dict[str, set[int]]:
    """Return the lines that use a constant, by file: in its own module, and in those that import it."""
    wanted, module = set(names.split(", ")), path.stem
    lines: dict[str, set[int]] = {}
    for file in sorted((ROOT / "runtime").rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        relative = file.relative_to(ROOT)
        here = wanted if relative == path else set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").rpartition(".")[2] == module:
                here = here | {alias.name for alias in node.names if alias.name in wanted}
        used = {
            node.lineno
            for node in ast.walk(tree)
            if isinstance(node, ast.Name) and node.id in here and isinstance(node.ctx, ast.Load)
        }
        if used:
            lines[str(relative)] = used
    return lines


def reaching(known: dict[str, Any], path: Path, names: str, seconds: float) -> list[str]:
    """Return the tests that ran a line which uses a constant, the quickest first, up to a total duration."""
    places = {
        place
        for file, lines in uses(path, names).items()
        for line in lines
        for place in known["lines"].get(file, {}).get(str(line), ())
    }
    tests, cost = [], 0.0
    for place in sorted(places, key=lambda place: known["durations"][place])[:MOST_TESTS]:
        cost += known["durations"][place]
        if tests and cost > seconds:
            break
        tests.append(known["tests"][place])
    return tests


def failing(copy: Path, path: Path, names: str, tests: list[str]) -> str:
    """Return the first test that fails with a constant multiplied or divided, "" if none does."""
    if not tests:
        return ""
    file = copy / path
    text = file.read_text(encoding="utf-8")
    (copy / "names.json").write_text(json.dumps(tests), encoding="utf-8")
    try:
        for factor in (FACTOR, 1 / FACTOR):
            file.write_text(changed(text, names, factor), encoding="utf-8")
            if run_tests(copy, ["chosen", str(copy / "names.json")], limit=180) != 0:
                log = (copy / "log.txt").read_text(encoding="utf-8")
                if match := re.search(r"^(?:FAILED|ERROR) (\S+?)(?:\[| - |$)", log, re.MULTILINE):
                    return match.group(1)
    finally:
        file.write_text(text, encoding="utf-8")
    return ""


if __name__ == "__main__":
    main()
