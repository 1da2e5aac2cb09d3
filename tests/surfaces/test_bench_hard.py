"""The hard cases: each has a truth, each bound holds it, and a bound that doesn't is seen."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from apc.__main__ import run
from apc.analysis.analysis import Analysis, analyze
from apc.benchmark.hard import HardReport, compare, run_hard_cases
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from tests.hard.truths import HERE, TRUTHS, truth_of

NAMES = sorted(path.stem for path in HERE.glob("*.yaml"))


def _truths() -> dict[str, dict[str, object]]:
    return dict(json.loads(TRUTHS.read_text(encoding="utf-8")))


def test_every_scene_has_its_truth_and_says_where_it_comes_from_and_what_is_hard() -> None:
    assert sorted(_truths()) == NAMES
    for name in NAMES:
        text = (HERE / f"{name}.yaml").read_text(encoding="utf-8")
        assert f"topology: {name}\nabout: " in text
        assert "\n# From: " in text


@pytest.mark.parametrize("name", NAMES)
def test_a_hard_case_gets_the_right_verdict_and_a_bound_that_holds(name: str) -> None:
    system = compile_topology(HERE / f"{name}.yaml")
    case = compare(system, analyze(system), _truths()[name], 0.0, name)
    assert case.failed == ""
    assert case.verdict == _truths()[name]["verdict"], "none of these is left undecided"
    assert math.isfinite(case.bound)


@pytest.mark.parametrize("name", ["coasting", "stiff-contact", "two-clusters", "million-peers"])
def test_the_stored_truth_is_what_its_script_computes(name: str) -> None:
    assert truth_of(compile_topology(HERE / f"{name}.yaml")) == _truths()[name]


def _folder(tmp_path: Path, **changes: object) -> Path:
    """Return a folder of one scene, its truth changed."""
    shutil.copy(HERE / "tiny-device.yaml", tmp_path)
    truth = _truths()["tiny-device"] | changes
    (tmp_path / "truths.json").write_text(json.dumps({"tiny-device": truth}), encoding="utf-8")
    return tmp_path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spectral_radius": "0.968810016486"}, "the bound does not hold"),
        ({"verdict": "stable"}, "the verdict is wrong: stable"),
        ({"rigid_modes": 0}, "0 rigid modes, not 1"),
    ],
)
def test_a_case_that_is_wrong_fails(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: dict[str, object], message: str
) -> None:
    folder = _folder(tmp_path, **changes)
    assert run(["bench", "--hard", str(folder)]) == 1
    printed = capsys.readouterr()
    assert f"FAILED tiny-device: {message}" in printed.out
    assert "E922 not every hard case came out right: tiny-device" in printed.err


def test_no_bound_and_no_verdict_fail_and_are_counted(tmp_path: Path) -> None:
    def shy(system: CompiledSystem) -> Analysis:
        return replace(analyze(system), spectral_radius_error=math.inf, stable=None, verdict="undecided: …")

    found = run_hard_cases(_folder(tmp_path), solve=shy, repeats=1)
    [case] = found.failures
    assert case.failed == (
        "the bound says nothing; the verdict is left open: stable up to a common translation"
    )
    assert "1 of 1 scene failed; 1 left open, 1 without a bound" in str(found)
    assert found.to_dict()["undecided"] == found.to_dict()["unbounded"] == ["tiny-device"]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_number_that_is_none_fails(tmp_path: Path, value: float) -> None:
    def silent(system: CompiledSystem) -> Analysis:
        return replace(analyze(system), spectral_radius=value)

    def unsure(system: CompiledSystem) -> Analysis:
        return replace(analyze(system), spectral_radius_error=value)

    folder = _folder(tmp_path)
    assert run_hard_cases(folder, solve=silent, repeats=1).cases[0].failed == "there is no spectral radius"
    assert run_hard_cases(folder, solve=unsure, repeats=1).cases[0].failed == "the bound says nothing"


def test_the_report_fits_a_terminal(tmp_path: Path) -> None:
    (tmp_path / "other.yaml").write_text("topology: other\n", encoding="utf-8")
    found: HardReport = run_hard_cases(_folder(tmp_path), repeats=1)
    text = str(found)
    assert max(map(len, text.splitlines())) <= 80 + len(str(tmp_path))
    assert "every bound holds; every verdict is right" in text
    assert "stable*: stable up to a common translation" in text
    assert "other.yaml has no truth beside it: left out" in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist"),
        ("{", "is not JSON"),
        ("[]", "the truths wants spectral_radius"),
        ('{"a": {"spectral_radius": "much"}}', "a wants spectral_radius"),
        (
            '{"a": {"spectral_radius": "1/0", "rigid_modes": 1, "verdict": "stable"}}',
            "a wants spectral_radius",
        ),
        ('{"a": {"spectral_radius": "1", "rigid_modes": "one", "verdict": "stable"}}', "a wants spectral"),
        ("{}", "holds no topology whose truth is known"),
    ],
)
def test_truths_that_are_none_are_refused(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "truths.json").write_text(text, encoding="utf-8")
    with pytest.raises(ApcError, match=message) as raised:
        run_hard_cases(tmp_path)
    assert "Write: --hard tests/hard" not in str(raised.value)
    assert raised.value.mistakes[0].code == "E920"
