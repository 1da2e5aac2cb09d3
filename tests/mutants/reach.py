"""Which test runs which line, by a run under coverage; and a run of chosen tests in a chosen order."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest


class Watch:
    """A plugin that notes for each test its duration and the lines of the product it ran.

    What a cache or a fixture of the session ran, for the first test that asked, is noted of that test only.
    """

    def __init__(self, coverage: Any) -> None:
        self.coverage = coverage
        self.durations: dict[str, float] = {}
        self.failed: set[str] = set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.add(report.nodeid)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        self.coverage.switch_context(item.nodeid)
        begun = time.process_time()
        try:
            return (yield)
        finally:
            self.durations[item.nodeid] = time.process_time() - begun


class Chosen:
    """A plugin that runs the tests it was given and no others, in their order."""

    def __init__(self, names: list[str]) -> None:
        self.order = {name: place for place, name in enumerate(names)}

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = sorted(
            (item for item in items if item.nodeid in self.order), key=lambda item: self.order[item.nodeid]
        )


def watched(root: Path, out: Path, words: list[str]) -> int:
    """Run pytest with these words in this process; write which test ran which line to `out` as JSON."""
    import coverage

    measured = coverage.Coverage(
        data_file=None, source=[str(root / name) for name in ("compiler", "runtime")], config_file=False
    )
    watch = Watch(measured)
    measured.start()
    code = pytest.main(["-n", "0", "-q", "-p", "no:cacheprovider", *words], plugins=[watch])
    measured.stop()
    data = measured.get_data()
    # A test that fails on the unchanged product can't catch anything.
    names = [name for name in watch.durations if name not in watch.failed]
    number = {name: place for place, name in enumerate(names)}
    lines: dict[str, dict[int, list[int]]] = {}
    for file in data.measured_files():
        by_line = data.contexts_by_lineno(file)
        lines[str(Path(file).relative_to(root))] = {
            line: [number[name] for name in sorted(contexts) if name in number]
            for line, contexts in by_line.items()
        }
    stored = {"tests": names, "durations": [watch.durations[name] for name in names], "lines": lines}
    out.write_text(json.dumps(stored), encoding="utf-8")
    return int(code)


def chosen(names_file: Path, words: list[str]) -> int:
    """Run the tests listed in a file, the first failure ending it; return pytest's exit code."""
    names = json.loads(names_file.read_text(encoding="utf-8"))
    files = list(dict.fromkeys(name.partition("::")[0] for name in names))
    return int(
        pytest.main(
            [
                "-n",
                "0",
                "-q",
                "-x",
                "--no-header",
                "-p",
                "no:cacheprovider",
                "--hypothesis-seed=1",
                *words,
                *files,
            ],
            plugins=[Chosen(names)],
        )
    )


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    if what == "watched":
        sys.exit(watched(Path(rest[0]), Path(rest[1]), rest[2:]))
    sys.exit(chosen(Path(rest[0]), rest[1:]))
