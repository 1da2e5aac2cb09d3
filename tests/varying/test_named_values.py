"""A parameter with named values, such as a side: the names set it, and no other value is valid."""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from apc.__main__ import run
from apc.app.sliders import sliders_of
from apc.parameter_values.overrides import apply, parse_override
from apc.studies.grid import parse_axis
from tests.topologies import ONE_MASS, compiled, messages_of, replaced

SECTIONS = (
    "clocks: {tick: 1 ms}\ncouplers:\n"
    "  wall: {type: VirtualWall, flange: device, position: 10 mm, stiffness: 1000 N/m, clock: tick}\n"
)
TEXT = ONE_MASS + SECTIONS
NAMES = "left (1) or right (-1)"
FIXES = "Try: wall.side=left, or wall.side=right"


def written(value: str) -> str:
    return replaced(TEXT, ("10 mm", f"10 mm, side: {value}"))


@pytest.fixture
def path(tmp_path: Path) -> str:
    target = tmp_path / "press.yaml"
    target.write_text(TEXT, encoding="utf-8")
    return str(target)


def verdict(value: str) -> tuple[str, float]:
    model = compiled(TEXT)
    compiled_model = apply(model, [parse_override(model, f"wall.side={value}")])
    result = apc.analyze(compiled_model)
    return result.verdict, result.spectral_radius


def test_a_name_sets_its_value() -> None:
    """On the right the device at 0 is in contact with the wall at 10 mm; on the left it is free."""
    assert verdict("right") == verdict("-1") != verdict("left") == verdict("1")


def test_a_sweep_takes_names() -> None:
    assert parse_axis(compiled(TEXT), "wall.side", "left, right").values == (1, -1)


@pytest.mark.parametrize("value", ["2", "0.5", "rigth"])
def test_no_other_value_is_set(value: str) -> None:
    expected = f"--set: E624 wall.side: expected {NAMES}, got {value}. {FIXES}"
    assert messages_of(verdict, value) == [expected]


@pytest.mark.parametrize(("value", "code"), [("2", "E207"), ("rigth", "E206")])
def test_no_other_value_is_compiled(value: str, code: str) -> None:
    (message,) = messages_of(compiled, written(value))
    fixes = "Try: side: left, or side: right"
    assert message.endswith(f": {code} side: expected {NAMES}, got {value}. {fixes}")
    assert compiled(written("right")).parameters == compiled(written("-1")).parameters


def test_a_dependent_value_is_checked() -> None:
    text = replaced(written("s"), ("masses:", "parameters: {s: 1}\nmasses:"))
    assert messages_of(compiled, text) == []
    (message,) = messages_of(compiled, replaced(text, ("s: 1", "s: 3")))
    assert f"E207 side: expected {NAMES}, got 3." in message


@pytest.mark.parametrize("words", [["critical", "wall.side"], ["analyze", "--box", "wall.side=-1:1"]])
def test_named_values_have_no_range(path: str, words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run([*words, path]) == 1
    assert f"E831 wall.side has no range: its values are {NAMES}." in capsys.readouterr().err


def test_named_values_have_no_slider() -> None:
    labels = {slider.label for slider in sliders_of(compiled(TEXT))}
    assert "wall.stiffness" in labels and "wall.side" not in labels
