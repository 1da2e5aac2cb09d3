"""The scenes: each compiles and checks itself; those of the paper get the paper's verdicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import apc
from apc.analysis.selfcheck import check_frame
from apc.compiler.pipeline import compile_topology, run_stages
from apc.compiler.scene.scene import Scene
from tests.topologies import SCENES, compiled, replaced

COMMON = "stable up to a common translation"
# Verdict and rigid modes of the scenes on a complete graph; at their start values, where they are not linear.
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


def path_of(name: str) -> Path:
    return SCENES / f"{name}.yaml"


def scene_of(name: str) -> Scene:
    found = run_stages(path_of(name), until="scene")
    assert isinstance(found, Scene)
    return found


@pytest.mark.parametrize("name", sorted(path.stem for path in SCENES.glob("*.yaml")))
def test_every_scene_compiles_and_needs_all_it_names(name: str) -> None:
    system = compile_topology(path_of(name))
    assert system.about
    assert system.name == (name if name != "template" else "my-scene")
    assert system.dropped == ()


@pytest.mark.parametrize("name", VERDICTS)
def test_every_scene_of_a_complete_graph_checks_itself_and_is_analysed(name: str) -> None:
    system = compile_topology(path_of(name))
    check_frame(system)  # raises when the two roads differ
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


def test_the_experiment_starts_without_contact_and_with_balanced_hands() -> None:
    scene = scene_of("experiment-average")
    assert scene.experiment.duration == 3
    values = [
        (group.count, {name: float(value.number) for name, value in group.values}) for group in scene.groups
    ]
    assert sum(count * own["hand.force"] for count, own in values) == 0
    half_width = dict(scene.part("contact").values)["half_width"].number
    for _, own in values:
        assert own["contact.side"] * own["device.x"] < -half_width, "each outside, on its own side"


def test_the_experiments_differ_in_their_coordination_only() -> None:
    average, mesh = (
        path_of(f"experiment-{name}").read_text(encoding="utf-8").splitlines() for name in ("average", "mesh")
    )
    apart = [(one, two) for one, two in zip(average, mesh, strict=True) if one != two]
    assert [one.split(":")[0].strip() for one, _ in apart] == ["topology", "about", "coordination"]
    assert apart[2][0].replace("AveragePosition", "FullMesh") == apart[2][1]


def test_the_ring_and_the_star_stay_words() -> None:
    for name, shape in (("ring-of-eight", "ring"), ("star-lecture", "star")):
        (link,) = compile_topology(path_of(name)).links
        assert (link.graph.shape, len(link.graph.arcs)) == (shape, 0)


def test_the_teacher_is_the_centre_of_the_star() -> None:
    first = scene_of("star-lecture").groups[0]
    assert (first.name, first.count) == ("teacher", 1)


def test_mixed_clocks_has_a_slow_user_whose_packets_take_longer() -> None:
    system = compile_topology(path_of("mixed-clocks"))
    assert [[clock.clock for clock in kind.clocks] for kind in system.kinds] == [["haptic"], ["slow"]]
    exact = {timing.name: float(timing.value) for timing in system.timings}
    (link,) = system.links
    assert [(pair.sender, pair.receiver, exact[pair.delay]) for pair in link.delays] == [
        ("near", "far", 0.04),
        ("far", "near", 0.04),
    ]
    assert [exact[hold.delay] for kind in system.kinds for hold in kind.holds] == [0.001, 0.001, 0.002, 0.002]


def test_users_table_gives_each_user_a_row() -> None:
    system = compile_topology(path_of("users-table"))
    (group,) = system.groups
    assert group.count == 5
    columns = {column.name: column.values for column in group.columns}
    np.testing.assert_allclose(columns["device.mass"], [0.1, 0.12, 0.08, 0.25, 0.1], rtol=1e-15)
    np.testing.assert_allclose(columns["arm.position"], [0, -0.005, 0.005, 0.01, -0.01], rtol=1e-15)
    assert any(name.endswith("users.csv") for name, _ in system.origin.texts), "its digest is kept"
