"""Find for each threshold of the product a test that fails where the threshold is another.

    python -m tests.mutants.thresholds --reach FILE [--seconds 8] [--within runtime/lifting]

Each constant of the page "Thresholds" is multiplied and divided by ten in a process of its own, and the tests
that ran a line which uses it are run there, the quickest first. The first that fails is written to
`thresholds.json` beside this file, "" where all pass. Constants that stand in the file are not tried again.
FILE is that of `python -m tests.mutants --reach FILE`.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import importlib
import json
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

from tests.mutants.copies import ROOT

FOUND = Path(__file__).with_name("thresholds.json")
FACTOR, MOST_TESTS, LIMIT_S = 10, 150, 40


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.mutants.thresholds", description=__doc__)
    parser.add_argument("--reach", type=Path, required=True, help="file of which test runs which line")
    parser.add_argument("--seconds", type=float, default=8.0, help="of tests for each constant")
    parser.add_argument("--within", default="", help="only files whose path begins so")
    requested = parser.parse_args()
    known = json.loads(requested.reach.read_text(encoding="utf-8"))
    plugin = Thresholds(known, requested.seconds, requested.within)
    return int(pytest.main(["-n", "0", "-q", "-s", "-p", "no:cacheprovider"], plugins=[plugin]))


class Thresholds:
    """A plugin that tries each constant with the tests that use it, in place of a run of all tests."""

    def __init__(self, known: dict[str, Any], seconds: float, within: str) -> None:
        self.known, self.seconds, self.within = known, seconds, within

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items = {item.nodeid: item for item in session.items}
        found = json.loads(FOUND.read_text(encoding="utf-8")) if FOUND.is_file() else {}
        for key, path, names in thresholds():
            if key in found or not str(path).startswith(self.within):
                continue
            used = uses(path, names)
            tests = [items[name] for name in reaching(self.known, used, self.seconds) if name in items]
            failed = fixing(tests, used, path, names)
            found[key] = failed.partition("[")[0]
            print(f"{key}: {found[key] or 'none'} ({len(tests)} tests)", flush=True)
            FOUND.write_text(json.dumps(found, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        return True


def thresholds() -> Iterator[tuple[str, Path, str]]:
    """Yield the key, the path and the names of each constant of the page; caches are left out."""
    sys.path.insert(0, str(ROOT / "docs"))
    generate = importlib.import_module("generate")
    for package in generate.DECIDING:
        for path in sorted((ROOT / "runtime" / package).rglob("*.py")):
            for names, _, _ in generate.constants(path):
                if names != "CACHE_SIZE":
                    yield generate.threshold_key(path, names), path.relative_to(ROOT), names


def uses(path: Path, names: str) -> dict[str, set[int]]:
    """Return the lines that use a constant, by file: in its own module, and in those that import it."""
    wanted, module = set(names.split(", ")), path.stem
    lines: dict[str, set[int]] = {}
    for file in sorted((ROOT / "runtime").rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if not any(name in text for name in wanted):
            continue
        tree, relative = ast.parse(text), file.relative_to(ROOT)
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


def reaching(known: dict[str, Any], used: dict[str, set[int]], seconds: float) -> list[str]:
    """Return the tests that ran one of these lines, the quickest first, up to a total duration."""
    places = {
        place
        for file, lines in used.items()
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


def fixing(tests: Sequence[pytest.Item], used: dict[str, set[int]], path: Path, names: str) -> str:
    """Return the first test that fails with a constant multiplied or divided, and passes without, or ""."""
    for factor in (FACTOR, 1 / FACTOR):
        failed = failing(tests, used, path, names, factor)
        alone = [item for item in tests if item.nodeid == failed]
        if failed and not failing(alone, used, path, names, 1):
            return failed
    return ""


def failing(
    tests: Sequence[pytest.Item], used: dict[str, set[int]], path: Path, names: str, factor: float
) -> str:
    """Return the first test that fails with a constant multiplied by a factor, "" if none does in time."""
    if not tests:
        return ""
    reader, writer = os.pipe()
    process = os.fork()
    if not process:
        with contextlib.suppress(BaseException):
            signal.alarm(LIMIT_S)
            silent = os.open(os.devnull, os.O_WRONLY)
            os.dup2(silent, 1)
            os.dup2(silent, 2)
            change([*used, str(path)], names, factor)
            for item in tests:
                if any(report.failed for report in runtestprotocol(item, log=False, nextitem=None)):
                    os.write(writer, item.nodeid.encode())
                    break
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as answer:
        failed = answer.read().decode()
    os.waitpid(process, 0)
    return failed


def change(files: Sequence[str], names: str, factor: float) -> None:
    """Multiply a constant by a factor in the modules that have it."""
    for file in files:
        module = importlib.import_module(".".join(("apc", *Path(file).with_suffix("").parts[1:])))
        for name in names.split(", "):
            if hasattr(module, name):
                setattr(module, name, multiplied(getattr(module, name), factor))


def multiplied(value: Any, factor: float) -> Any:
    """Return a number or a tuple of numbers multiplied; whole numbers stay whole, and 0 is the factor."""
    if isinstance(value, tuple):
        return tuple(multiplied(item, factor) for item in value)
    product = value * factor if value else factor
    if isinstance(value, int):
        product = max(round(product), 1) if value >= 0 else min(round(product), -1)
    return product


if __name__ == "__main__":
    sys.exit(main())
