"""How a topology begins, drawn from its equations alone, and how a run went, drawn from its rows."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.markers import MarkerStyle
from scipy.spatial.transform import Rotation

import apc
from apc.compiler.compiled import Model
from apc.output.object_shapes import heading, views_of
from apc.output.pictures import write_picture
from apc.output.simulation_output import paths_of
from apc.output.still_picture import _bar, draw_actors
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, library, replaced

pytest.importorskip("matplotlib")


def topology(name: str) -> Model:
    return compiled((TOPOLOGIES / f"{name}.yaml").read_text(encoding="utf-8").partition("\n")[2])


def test_every_peer_has_a_row_and_the_rest_is_counted(tmp_path: Path) -> None:
    drawn = draw_actors(topology("experiment-average"))[0].axes[0]
    assert [one.get_text() for one in drawn.get_yticklabels()] == ["right[1]", "left[1]", "left[2]"]
    assert len(drawn.patches) == 3
    many = draw_actors(compiled(replaced(AVERAGE, ("count: 3", "count: 1000"))))[0]
    assert many.get_suptitle() == "three-users-average: initial state (988 more peers not drawn)"
    write_picture(lambda: draw_actors(topology("experiment-average"))[0], tmp_path / "still.svg")
    assert (tmp_path / "still.svg").read_text(encoding="utf-8").startswith("<?xml")


# ---- in a plane ----

PUCK = """\
topology: puck
clocks: {tick: 1 ms}
peers: {user: {count: 3, set: {device.x: [[-30 mm, 10 mm], [30 mm, 5 mm], [0 mm, -40 mm]]}}}
masses:
  device: {type: PlanarMass, mass: 0.1 kg}
  puck: {type: PlanarMass, mass: 0.6 kg, x: [2 mm, 3 mm]}
couplers:
  contact: {type: DiscContact, a: device, b: puck, radius: 20 mm, stiffness: 1000 N/m, clock: tick}
  post: {type: DiscContact, a: puck, b: peg.b, radius: 12 mm, stiffness: 9 N/m, damping: 3 N*s/m, clock: tick}
  peg: {type: Peg, b: post.b, at_: [70 mm, -50 mm]}
  rim: {type: LineContact, flange: puck, normal: [3, 4], point: [-4 cm, -4 cm], stiffness: 9 N/m, clock: tick}
"""
PEG = """\
component: Peg
description: A fixed point of a plane.
connectors: {b: PlanarFlange}
parameters: {at_: {unit: m, size: 2}}
equations: ["b.x = at_"]
"""


def test_every_peer_has_a_plane_of_its_own_to_one_scale(tmp_path: Path) -> None:
    model = compiled(PUCK, library(tmp_path, PEG))
    axes = draw_actors(model)[0].axes
    assert [one.get_title() for one in axes] == ["user[1]", "user[2]", "user[3]"]
    assert len({(one.get_xlim(), one.get_ylim()) for one in axes}) == 1
    (left, right), (low, high) = axes[0].get_xlim(), axes[0].get_ylim()
    assert right - left == pytest.approx(high - low)
    assert left < -30 < 82 < right
    assert low < -62 < 23 < high


def test_a_held_body_reaches_to_its_grasp_point_and_a_line_joins_it_to_the_device() -> None:
    """The beam is held at 0.3 m from its middle, at the left end by one user, at the right by the other."""
    model = topology("carried-beam")
    arms = [view.contacts for view in views_of(model)]
    assert [[(one.holder, one.held) for one in contacts] for contacts in arms] == [[("device", "beam")]] * 2
    assert np.allclose([contacts[0].arm for contacts in arms], [(-0.3, 0), (0.3, 0)], rtol=0, atol=1e-9)
    _, _, lines = draw_actors(model)
    for line, place in zip(lines, (-300, 300), strict=True):
        assert np.allclose(line.line.get_xydata(), [(place, 0)] * 2, rtol=0, atol=1e-6)
        line.held.move([10.0, 20.0], math.pi / 2)
        line.draw()
        assert np.allclose(line.line.get_xydata(), [(place, 0), (10, 20 + place)], rtol=0, atol=1e-6)
        box = line.held.artists[-1]
        assert box.get_width() == pytest.approx(600)
    turned = replaced(
        (TOPOLOGIES / "carried-beam.yaml").read_text(encoding="utf-8").partition("\n")[2],
        ("beam:   {type: PlanarBody,", "beam:   {type: PlanarBody, angle: 0.7 rad,"),
    )
    arms = [view.contacts for view in views_of(compiled(turned))]
    assert np.allclose([contacts[0].arm for contacts in arms], [(-0.3, 0), (0.3, 0)], rtol=0, atol=1e-9)


def test_what_turns_has_a_bar_along_its_axis_and_what_does_not_none() -> None:
    device, beam = sorted(draw_actors(topology("carried-beam"))[1][:2], key=lambda one: one.turning)
    assert (device.turning, beam.turning, len(device.artists)) == ((), ("left[1].beam.angle",), 1)
    vectors = np.random.default_rng(1).uniform(-2, 2, (9, 3))  # turned by up to 3.4 rad, half its tangent
    size = np.linalg.norm(vectors, axis=1, keepdims=True)
    x, y, _ = Rotation.from_rotvec(vectors).apply([1, 0, 0]).T
    assert heading(2 * vectors / size * np.tan(size / 2)) == pytest.approx(np.arctan2(y, x))
    mark = MarkerStyle(_bar(math.pi / 3))
    ends = mark.get_transform().transform(mark.get_path().vertices)
    assert {round(math.degrees(math.atan2(y, x))) for x, y in ends if x or y} == {60, -120}


def test_a_run_in_a_plane_is_drawn_as_paths_as_well(tmp_path: Path) -> None:
    run = apc.simulate(compiled(PUCK, library(tmp_path, PEG)), duration="5 ms", jit=False)
    pairs = paths_of(run.signals)
    assert [tuple(run.signals[one].local for one in pair) for pair in pairs[:2]] == [
        ("device.x[1]", "device.x[2]"),
        ("puck.x[1]", "puck.x[2]"),
    ]
    assert len(pairs) == 6
    *_, plane = run.plot().axes
    assert plane.get_ylabel() == "path: x[2] [mm]"
    assert [one.get_text() for one in plane.get_legend().get_texts()][:2] == [
        "user[1].device.x",
        "user[1].puck.x",
    ]
    assert plane.lines[0].get_xdata().tolist() == pytest.approx((1e3 * run.values[:, pairs[0][0]]).tolist())


# ---- a run ----

RUN = apc.simulate(TOPOLOGIES / "experiment-mesh.yaml", duration="0.5 s", jit=False)


@pytest.mark.whole
@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_a_picture_is_written_and_the_same_run_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    one, two = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    write_picture(RUN.plot, one)
    write_picture(RUN.plot, two)
    assert one.stat().st_size > 5_000
    assert one.read_bytes() == two.read_bytes()


def test_a_picture_has_a_panel_a_quantity_and_no_label_over_another() -> None:
    figure = RUN.plot()
    assert [ax.get_ylabel() for ax in figure.axes] == ["position [mm]", "velocity [m/s]", "force [N]"]
    figure.draw_without_rendering()
    boxes = [ax.get_legend().get_window_extent() for ax in figure.axes]
    boxes += [ax.yaxis.label.get_window_extent() for ax in figure.axes]
    boxes += [ax.get_window_extent() for ax in figure.axes]
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1 + 1
