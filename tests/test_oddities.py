"""What a topology seldom means is told by name, and nothing else is."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from apc.__main__ import run
from tests.topologies import AVERAGE, SCENES, compiled, replaced

UNSHARED = (
    "follows the other peers' by coordination and is not shared: its mass counts once a peer. "
    "Write: shared: true, or shared: false where each is a mass of its own"
)
# What is changed in the first scene, and the warnings that it then has.
ODD = [
    ((), []),
    ((("links:\n", "links:\n  wan: {clock: network}\n"),), ["15:3: W271 nobody uses the link wan."]),
    (
        (("masses:\n", "masses:\n  lone: {mass: 1 kg}\n"),),
        ["9:3: W272 lone is joined to nothing: no coupler, no hand and no other mass."],
    ),
    ((("masses:\n", "masses:\n  lone: {mass: 1 kg, flange: device}\n"),), []),
    ((("b: cube, ", "b: ground, "),), []),
    (
        (
            ("  user: {count: 3}", "  left: {count: 2}\n  right: {count: 2}"),
            ("b: cube, ", "b: cube, at: [left], "),
        ),
        ["10:3: W272 device of right is joined to nothing: no coupler, no hand and no other mass."],
    ),
    (
        (("object: cube", "object: device"),),
        [f"9:3: W274 device {UNSHARED}"],
    ),
    ((("object: cube", "object: device"), ("damping: 5 N*s/m}", "damping: 5 N*s/m, shared: false}")), []),
    (
        (("object: cube", "object: device"), ("a: device, b: cube", "a: ground, b: cube"),
         ("count: 3", "count: 3, set: {device.mass: 1 kg}")),
        ["10:3: W273 cube is shared, and nothing couples its copies."],
    ),
    (
        ((", shared: true", ""),),
        [f"10:3: W274 cube {UNSHARED}"],
    ),
]  # fmt: skip


@pytest.mark.parametrize(("pairs", "told"), ODD)
def test_what_is_seldom_meant_is_told_at_its_place(
    pairs: tuple[tuple[str, str], ...], told: list[str]
) -> None:
    assert compiled(replaced(AVERAGE, *pairs)).warnings == tuple(f"scene.yaml:{one}" for one in told)


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.yaml")), ids=lambda path: path.stem)
def test_no_scene_of_the_library_has_a_warning(path: Path) -> None:
    from apc.compiler.pipeline import run_stages
    from apc.compiler.scene.scene import Scene

    scene = run_stages(path, until="scene")
    assert isinstance(scene, Scene)
    assert scene.warnings == ()


def test_every_command_that_judges_says_a_warning_and_a_model_keeps_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(replaced(AVERAGE, ("links:\n", "links:\n  wan: {clock: network}\n")), encoding="utf-8")
    warning = "scene.yaml:15:3: W271 nobody uses the link wan."
    for words in (["check", str(path)], ["compile", str(path)], ["analyze", str(path.with_suffix(".apc"))]):
        assert run(words) == 0
        lines = capsys.readouterr().out.splitlines()
        assert f"  Warning: {warning}" in lines[:8]
    assert run(["analyze", "--json", str(path)]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == [warning]
