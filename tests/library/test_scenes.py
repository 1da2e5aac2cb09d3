"""The scenes that come with the program: each compiles, and those of the paper get the paper's verdicts."""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from tests.topologies import SCENES, compiled, replaced

COMMON = "stable up to a common translation"
# Verdict and rigid modes at the start values; what the paper has stands in its section IV and Fig. 6.
VERDICTS = {
    "finger": ("stable", 0),
    "lifted-box": ("stable", 0),
    "lossy-average": (COMMON, 1),
    "mixed-clocks": (COMMON, 1),
    "template": (COMMON, 1),
    "three-users-average": (COMMON, 1),
    "three-users-predicted": (COMMON, 1),
    "three-users-scheduled": (COMMON, 1),
    "three-users-mesh": (COMMON, 1),
    "two-handed-tool": (COMMON, 3),  # and at each user the hands apart from each other
    "two-users-damped": (COMMON, 1),
    "two-users-filtered-waves": (COMMON, 1),
    "two-users-reported": (COMMON, 1),  # what is summed up drifts nowhere
    "two-users-waves": (COMMON, 2),  # positions drift apart
    "unlike-devices": (COMMON, 1),
    "users-table": ("stable", 0),
}
NAMES = sorted(path.stem for path in SCENES.glob("*.yaml"))


def path_of(name: str) -> Path:
    return SCENES / f"{name}.yaml"


@pytest.mark.parametrize("name", NAMES)
def test_every_scene_compiles_needs_all_it_names_and_has_its_verdict(name: str) -> None:
    system = apc.compile(path_of(name))
    assert system.about
    assert system.name == (name if name != "template" else "my-scene")
    assert system.dropped == ()
    if name in VERDICTS:
        result = apc.analyze(system)
        assert (result.verdict, result.rigid_modes) == VERDICTS[name]


@pytest.mark.parametrize(("name", "verdict"), [("average", COMMON), ("mesh", "unstable")])
def test_the_experiment_settles_for_the_average_and_shakes_for_the_mesh(name: str, verdict: str) -> None:
    """With all users in contact, as they are once they have pushed the cube together (the paper's Fig. 6)."""
    text = path_of(f"experiment-{name}").read_text(encoding="utf-8")
    touching = replaced(
        text, ("device.x: 30 mm", "device.x: 10 mm"), ("device.x: -30 mm", "device.x: -10 mm")
    )
    result = apc.analyze(compiled(touching))
    assert (result.verdict, result.rigid_modes, result.linearized) == (verdict, 1, True)


def test_users_table_gives_each_user_a_row() -> None:
    (group,) = apc.compile(path_of("users-table")).groups
    columns = {column.name: column.values.tolist() for column in group.columns}
    assert columns["device.mass"] == pytest.approx([0.1, 0.12, 0.08, 0.25, 0.1], rel=1e-15)
    assert columns["arm.position"] == pytest.approx([0, -0.005, 0.005, 0.01, -0.01], rel=1e-15)
