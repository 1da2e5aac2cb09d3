"""`trajectory`, `summary`, `signals` and their presentation: what a person gets of a simulation."""

from __future__ import annotations

import json
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.compiler.errors import ApcError
from apc.present.simulation import save_picture, thinned
from apc.simulation.trajectory import Trajectory, simulate
from tests.topologies import AVERAGE, ONE_MASS, SCENES, compiled, replaced, told

AVERAGE_RUN = simulate(compiled((SCENES / "experiment-average.yaml").read_text(encoding="utf-8")))
MESH_RUN = simulate(compiled((SCENES / "experiment-mesh.yaml").read_text(encoding="utf-8")))


def test_the_mean_settles_and_the_mesh_shakes() -> None:
    assert AVERAGE_RUN.summary.verdict == "settles"
    assert AVERAGE_RUN.summary.settled is not None
    assert AVERAGE_RUN.summary.settled < 1.5
    assert MESH_RUN.summary.verdict == "shakes"
    assert MESH_RUN.summary.swing is not None
    assert MESH_RUN.summary.swing[1] > 1e-3


def test_a_summary_fits_the_terminal_and_says_what_was_seen() -> None:
    for found in (AVERAGE_RUN, MESH_RUN):
        text = str(found)
        assert all(len(line) <= 80 for line in text.splitlines())
        name, size, at = found.summary.largest_force or ("", 0.0, 0.0)
        assert size == np.abs(found[name]).max()
        assert np.abs(found[name])[found.time == at] == size
        assert name in text
    assert str(AVERAGE_RUN).startswith("experiment-average: settles\n\n  From 0.8")


def test_copies_differ_at_rest_by_what_holds_the_pushing_apart() -> None:
    # At rest 4 N = K_T (x_left − x_right), as the left pair stands at one place.
    [(name, apart)] = AVERAGE_RUN.summary.copies
    assert name == "cube.x"
    assert apart == pytest.approx(4 / 2000, rel=1e-2)


def test_without_damping_the_kinetic_energy_is_the_work_of_the_couplers() -> None:
    start = "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm], cube.v: 0.1 m/s}}"
    text = AVERAGE.replace("damping: 5 N*s/m", "damping: 0 N*s/m")
    text = replaced(text, ("{count: 3}", start)).replace("stiffness: 1000", "stiffness: 100")
    found = simulate(compiled(text), duration=Fraction(16, 100))
    kinetic = [
        0.5 * mass * (found[f"user[{i}].{part}.v"][row] ** 2)
        for row in (0, -1)
        for part, mass in (("device", 0.1), ("cube", 0.2))
        for i in (1, 2, 3)
    ]
    put_in = sum(work for _, work in found.summary.work)
    assert abs(put_in) > 1e-3
    assert put_in == pytest.approx(sum(kinetic[6:]) - sum(kinetic[:6]), rel=1e-12)


def test_a_mass_that_is_pushed_moves_on_and_one_that_stops_settles() -> None:
    hand = "hands: {{hand: {{type: {}, flange: device, force: 1 N{}}}}}\n"
    arm = "{type: SpringDamperArm, flange: device, stiffness: 10 N/m, damping: 5 N*s/m}"
    arm = f"couplers: {{arm: {arm}}}\n"
    for text, verdict in (
        (hand.format("ConstantForce", ""), "moves on"),
        (hand.format("ConstantForce", "") + arm, "settles"),
    ):
        found = simulate(compiled(ONE_MASS + text), duration=Fraction(10))
        assert found.summary.verdict == verdict
    assert found.time[1] == 0.001, "where nothing ticks there is a row a millisecond"


def test_a_verdict_on_no_position_or_on_some_says_so() -> None:
    text = AVERAGE.replace("{count: 3}", "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm]}}")
    none = simulate(compiled(text), duration=Fraction(1), signals=["*.v"])
    assert none.summary.verdict == "not judged"
    assert "No position was recorded" in str(none)
    one = simulate(compiled(text), duration=Fraction(1), signals=["user[1].cube.x"])
    assert "on every recorded position stays" in str(one)
    still = simulate(compiled(AVERAGE), duration=Fraction(1), signals=["user[1].cube.x"])
    assert "No recorded position moves." in str(still)


def test_the_swing_that_is_told_is_the_largest_of_its_unit_not_the_first() -> None:
    """A light device beside a heavy cube swings most, whatever share of its own way each makes."""
    start = "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm]}}"
    text = AVERAGE.replace("{count: 3}", start).replace("stiffness: 1000", "stiffness: 2500")
    text = text.replace("device: {mass", "zero: {mass: 9 kg, damping: 5 N*s/m}\n  device: {mass")
    tie = "  tie: {type: SpringDamper, a: zero, b: device, stiffness: 1 N/m}\n  contact:"
    found = simulate(compiled(text.replace("  contact:", tie)), duration=Fraction(1)).summary
    assert found.verdict == "shakes"
    assert found.swing is not None
    largest = max(found.extents, key=lambda one: (one.unit == "m") * (one.high - one.low))
    assert found.swing[0] == largest.name


def test_columns_are_found_by_name_and_have_units() -> None:
    headings = [one.heading for one in AVERAGE_RUN.signals]
    assert headings[:3] == ["right[1].device.x [m]", "right[1].device.v [m/s]", "right[1].cube.x [m]"]
    assert "left[2].contact.push [N]" in headings
    assert AVERAGE_RUN["left[2].device.x"][0] == -0.03
    with pytest.raises(KeyError):
        AVERAGE_RUN["left[3].device.x"]


def test_pandas_and_xarray_hold_the_same_numbers() -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    frame = AVERAGE_RUN.to_dataframe()
    assert frame.index.name == "time [s]"
    assert (frame["left[2].cube.x [m]"].to_numpy() == AVERAGE_RUN["left[2].cube.x"]).all()
    data = AVERAGE_RUN.to_xarray()
    assert data["left[2].cube.x"].attrs == {"units": "m"}
    assert (data["left[2].cube.x"].to_numpy() == AVERAGE_RUN["left[2].cube.x"]).all()


@pytest.mark.parametrize(
    ("patterns", "names"),
    [
        (["cube.x"], ["user[1].cube.x", "user[2].cube.x", "user[3].cube.x"]),
        (["user[2].cube.*"], ["user[2].cube.x", "user[2].cube.v"]),
        (["user[3].device.x", "user[1].cube.?"], ["user[1].cube.x", "user[1].cube.v", "user[3].device.x"]),
    ],
)
def test_signals_are_chosen_by_pattern(patterns: list[str], names: list[str]) -> None:
    found = simulate(compiled(AVERAGE), duration=Fraction(1, 100), signals=patterns)
    assert [one.name for one in found.signals] == names


def test_a_pattern_that_fits_nothing_is_told_with_the_nearest_name() -> None:
    with pytest.raises(ApcError, match=r"E873 no signal fits 'cub\.x'; .* Write: --signals cube\.x"):
        simulate(compiled(AVERAGE), duration=Fraction(1), signals=["cub.x"])


def test_a_duration_has_to_be_known_and_positive() -> None:
    def run(duration: Fraction | None) -> Trajectory:
        return simulate(compiled(AVERAGE), duration=duration)

    assert [one.split()[1] for one in told(run, None)] == ["E877"]
    assert told(run, Fraction(-1)) == ["scene.yaml: E877 the duration wants more than 0 s, got -1 s."]


@pytest.mark.parametrize("suffix", [".png", ".svg", ".pdf"])
def test_a_picture_is_written_and_the_same_run_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("matplotlib")
    one, two = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    save_picture(AVERAGE_RUN, one)
    save_picture(AVERAGE_RUN, two)
    assert one.stat().st_size > 10_000
    assert one.read_bytes() == two.read_bytes()


def test_a_picture_has_a_panel_a_quantity_and_no_label_over_another() -> None:
    pytest.importorskip("matplotlib")
    figure = AVERAGE_RUN.plot()
    assert [ax.get_ylabel() for ax in figure.axes] == ["position [mm]", "velocity [m/s]", "force [N]"]
    figure.draw_without_rendering()
    boxes = [ax.get_legend().get_window_extent() for ax in figure.axes]
    boxes += [ax.yaxis.label.get_window_extent() for ax in figure.axes]
    boxes += [ax.get_window_extent() for ax in figure.axes]
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i])
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1 + 1


def test_signals_of_one_unit_can_be_drawn_into_ones_own_axes() -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    two = replaced(
        AVERAGE, ("user: {count: 3}", "one: {count: 1, set: {cube.x: 1 mm}}\n  others: {count: 2}")
    )
    found = simulate(compiled(two), duration=Fraction(1, 100), signals=["cube.x"])
    assert found.plot(ax) is ax.figure
    assert len(ax.lines) == 2, "curves that are the same are one"


def test_a_thinned_curve_keeps_every_peak() -> None:
    time, values = np.arange(10**5) / 1000, np.zeros(10**5)
    values[[17, 54321, 99_998]] = [3.0, -2.0, 1.0]
    t, v = thinned(time, values)
    assert len(t) < 5000
    assert {3.0, -2.0, 1.0} <= set(v)
    assert (np.diff(t) > 0).all()


def test_the_public_function_plays_a_file_with_other_numbers(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(AVERAGE, encoding="utf-8")
    found = apc.simulate(
        path, duration="4 ms", set={"user.device.x": "2 mm"}, signals=["device.x"], jit=False
    )
    assert isinstance(found, apc.Trajectory)
    assert found.values.shape == (5, 3)
    assert (found.values[0] == 0.002).all()
    assert found.to_dict()["provenance"]["parameters"]["user.device.x"] == {"value": 0.002, "unit": "m"}


def test_playing_a_compiled_model_needs_no_algebra_units_or_pictures(tmp_path: Path) -> None:
    text = (SCENES / "experiment-mesh.yaml").read_text(encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(text, encoding="utf-8")

    def run(words: str) -> str:
        code = f"import sys\nfrom apc.__main__ import run\nassert run({words.split()!r}) == 0\n"
        code += "print(*sys.modules, file=sys.stderr)"
        ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
        assert ran.returncode == 0, ran.stderr
        return ran.stderr

    run("compile")
    heavy = {"sympy", "pint", "matplotlib", "pandas", "pyarrow", "scipy.io"}
    assert not heavy & set(run("simulate scene.apc --json").split())


def test_a_motion_without_bound_is_told_without_nan() -> None:
    """Forces times speeds leave the range of floats halfway: that ends neither the run nor the document."""
    groups = "  a: {count: 1, set: {device.x: 1 mm}}\n  b: {count: 2}\n"
    text = replaced(AVERAGE, ("  user: {count: 3}\n", groups), ("stiffness: 500 N/m", "stiffness: 9000 N/m"))
    found = simulate(compiled(text), duration=Fraction(40), jit=False)
    assert found.summary.verdict == "diverges"
    assert found.summary.stopped_at is not None
    assert found.summary.stopped_at > 15  # half of it is when the work leaves the range
    json.dumps(found.to_dict(), allow_nan=False)
