"""Every constant that can decide an answer has a reason, which the manual lists."""

from __future__ import annotations

import json
import sys
from importlib import import_module
from pathlib import Path

import pytest

from tests.topologies import ROOT


@pytest.fixture
def generate(monkeypatch: pytest.MonkeyPatch) -> object:
    """Return the module that writes the generated pages of the manual."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    yield import_module("generate")
    sys.modules.pop("generate", None)


def test_every_constant_has_a_reason(generate: object) -> None:
    files = [path for name in generate.DECIDING for path in (ROOT / "runtime" / name).rglob("*.py")]  # type: ignore[attr-defined]
    found = [(path.name, *row) for path in files for row in generate.constants(path)]  # type: ignore[attr-defined]
    assert len(found) > 300
    assert not [row for row in found if not row[-1]]


def test_the_named_tests_and_constants_exist(generate: object) -> None:
    tests = json.loads(generate.TESTS_OF_THRESHOLDS.read_text(encoding="utf-8"))  # type: ignore[attr-defined]
    keys = {
        generate.threshold_key(path, names)  # type: ignore[attr-defined]
        for package in generate.DECIDING  # type: ignore[attr-defined]
        for path in (ROOT / "runtime" / package).rglob("*.py")
        for names, *_ in generate.constants(path)  # type: ignore[attr-defined]
    }
    assert not set(tests) - keys, "constants that are gone"
    for test in filter(None, tests.values()):
        file, *_, function = test.split("::")
        assert f"def {function}(" in (ROOT / file).read_text(encoding="utf-8"), test


def test_the_reason_is_that_of_the_line_or_of_the_block(generate: object, tmp_path: Path) -> None:
    module = tmp_path / "module.py"
    module.write_text(
        "# The first and the second.\nFIRST, SECOND = 1, 2e-3\nTHIRD = 2**10  # of its own\nFOURTH = -1\n\n"
        "FIFTH = 1\nTEXT = 'no number'\nFLAG = True\n"
    )
    assert list(generate.constants(module)) == [  # type: ignore[attr-defined]
        ("FIRST, SECOND", "1, 2e-3", "The first and the second."),
        ("THIRD", "2**10", "of its own"),
        ("FOURTH", "-1", "The first and the second."),
        ("FIFTH", "1", ""),
    ]
