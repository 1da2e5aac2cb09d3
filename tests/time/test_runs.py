"""What a person gets of a run: what was seen in words, rows and columns by name, and what is refused."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.compiler.errors import ApcError
from apc.simulation.settings import DEFAULT, Method, Settings, check_step, parse_method
from apc.simulation.simulation import MOST_ROWS, check_length, prepare, size_note
from apc.simulation.trajectory import Trajectory, simulate
from tests.sites import edged
from tests.topologies import AVERAGE, ONE_MASS, SCENES, compiled, replaced, told

MS = Fraction(1, 1000)
AVERAGE_RUN, MESH_RUN = (
    simulate(compiled((SCENES / f"experiment-{name}.yaml").read_text(encoding="utf-8")), jit=False)
    for name in ("average", "mesh")
)

# ---- what was seen ----


def test_the_mean_settles_and_the_mesh_shakes() -> None:
    """As told, and as found row by row.

    Within 5 % of the largest range among the peers for good; how it swings in the last fifth, turn by turn.
    """
    average, mesh = AVERAGE_RUN.summary, MESH_RUN.summary
    assert (average.verdict, mesh.verdict) == ("settles", "shakes")
    assert average.settled is not None and mesh.swing is not None
    left = 0.0
    for part in ("device.x", "cube.x"):
        x = np.array([AVERAGE_RUN[one.name] for one in AVERAGE_RUN.signals if one.local == part])
        away = np.abs(x - x[:, -1:]) > 0.05 * np.ptp(x, axis=1).max()
        left = max(left, float(AVERAGE_RUN.time[np.flatnonzero(away.any(axis=0))[-1]]))
    assert left <= average.settled <= left + 0.006, "looked at in some five hundred parts"
    name, size, rate = mesh.swing
    tail = MESH_RUN[name][MESH_RUN.time > 0.8 * MESH_RUN.time[-1]]
    assert size == pytest.approx(np.ptp(tail), rel=0.02) and size > 1e-3
    turns = np.count_nonzero(np.diff(np.sign(np.diff(tail))))
    assert rate == pytest.approx(turns / 2 / 0.6, rel=0.03)
    assert str(AVERAGE_RUN).startswith("experiment-average: settles\n\n  From 8")


@pytest.mark.parametrize("found", [AVERAGE_RUN, MESH_RUN], ids=["average", "mesh"])
def test_a_summary_fits_the_terminal_and_says_what_was_seen(found: Trajectory) -> None:
    assert all(len(line) <= 80 for line in str(found).splitlines())
    name, size, at = found.summary.largest_force or ("", 0.0, 0.0)
    forces = [one.name for one in found.signals if one.unit == "N"]
    assert size == np.abs(found[name]).max() == max(np.abs(found[one]).max() for one in forces)
    assert np.abs(found[name])[found.time == at] == size
    assert name in str(found)


def test_copies_differ_at_rest_by_what_holds_the_pushing_apart() -> None:
    # At rest 4 N = K_T (x_left − x_right), as the left pair stands at one place.
    [(name, apart)] = AVERAGE_RUN.summary.copies
    assert (name, apart) == ("cube.x", pytest.approx(4 / 2000, rel=1e-2))


@pytest.mark.parametrize("arm", [False, True])
def test_a_mass_that_is_pushed_moves_on_and_one_that_stops_settles(arm: bool) -> None:
    text = ONE_MASS + "hands: {hand: {type: ConstantForce, flange: device, force: 1 N}}\n"
    if arm:
        text += (
            "couplers:\n  arm: {type: SpringDamperArm, flange: device, stiffness: 10 N/m, damping: 5 N*s/m}\n"
        )
    found = simulate(compiled(text), duration=Fraction(10), jit=False)
    assert found.summary.verdict == ("settles" if arm else "moves on")
    assert found.time[1] == 0.001, "where nothing ticks there is a row a millisecond"


# ---- rows and columns ----


@pytest.mark.parametrize("delay", ["0 ms", "0.5 ms", "3 ms"])
def test_a_force_that_acts_later_has_a_column_of_when_it_acts(delay: str) -> None:
    text = AVERAGE.replace("delay: 1 ms", f"delay: {delay}")
    found = simulate(compiled(text), duration=MS, signals=["user[1].*"], jit=False)
    forces = ["contact.f", "coordination.f"]
    late = [] if delay == "0 ms" else [f"{name} acting" for name in forces]
    states = ["device.x", "device.v", "cube.x", "cube.v"]
    assert [one.local for one in found.signals] == [*states, *forces, *late]
    roles = ["state"] * 4 + ["output"] * 2 + ["hold"] * len(late)
    assert [one.role for one in found.signals] == roles


@pytest.mark.whole
def test_pandas_and_xarray_hold_the_same_numbers() -> None:
    pytest.importorskip("pandas")
    pytest.importorskip("xarray")
    frame, data = AVERAGE_RUN.to_dataframe(), AVERAGE_RUN.to_xarray()
    assert frame.index.name == "time [s]"
    assert (frame["left[2].cube.x [m]"].to_numpy() == AVERAGE_RUN["left[2].cube.x"]).all()
    assert data["left[2].cube.x"].attrs == {"units": "m"}
    assert (data["left[2].cube.x"].to_numpy() == AVERAGE_RUN["left[2].cube.x"]).all()


@pytest.mark.parametrize(
    ("patterns", "names"),
    [
        (["cube.x"], ["left[1].cube.x", "left[2].cube.x", "right[1].cube.x"]),
        (["left[2].cube.*"], ["left[2].cube.x", "left[2].cube.v"]),
        (["right*.v"], ["right[1].device.v", "right[1].cube.v"]),
        (["right[1].device.x", "left[1].cube.?"], ["left[1].cube.x", "left[1].cube.v", "right[1].device.x"]),
    ],
)
def test_signals_are_chosen_by_pattern_and_are_those_of_a_whole_run(
    patterns: list[str], names: list[str]
) -> None:
    system = compiled(
        replaced(AVERAGE, ("user: {count: 3}", "left: {count: 2, set: {cube.x: 1 cm}}\n  right: {count: 1}"))
    )
    found, whole = (
        simulate(system, duration=Fraction(1, 20), signals=asked, jit=False) for asked in (patterns, [])
    )
    assert [one.name for one in found.signals] == names
    for name in names:
        assert np.abs(found[name] - whole[name]).max() < 1e-15


def test_the_public_function_plays_a_file_with_other_numbers(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(AVERAGE, encoding="utf-8")
    asked = {"user.device.x": "2 mm"}
    found = apc.simulate(path, duration="4 ms", set=asked, signals=["device.x"], jit=False)
    assert isinstance(found, apc.Trajectory)
    assert found.values.shape == (5, 3)
    assert (found.values[0] == 0.002).all()
    assert found.to_dict()["provenance"]["parameters"]["user.device.x"] == {"value": 0.002, "unit": "m"}


# ---- what is asked, and what is refused ----


KINDS = "E910 the method wants one of exact, rk4, semi-implicit, cvodes,"
RANGE = "E912 the relative tolerance of cvodes wants a number from 1e-12 to 0.01,"


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("exact", Method("exact")),
        ("rk4:0.1 ms", Method("rk4", step=MS / 10)),
        ("rk4:250us", Method("rk4", step=MS / 4)),
        (" semi-implicit : 1 ms", Method("semi-implicit", step=MS)),
        ("cvodes:1e-8", Method("cvodes", tolerance=1e-8)),
        ("rk5:1 ms", f"{KINDS} got rk5:1 ms. Write: rk4:0.1ms"),
        ("", f"{KINDS} got nothing. Write: exact"),
        ("exact:1 ms", "E910 the method wants exact alone, which has no step, got exact:1 ms. Write: exact"),
        ("rk4", "E911 rk4 wants a step, got none. Write: rk4:0.1ms"),
        ("rk4:0 ms", "E911 the step of rk4 wants more than 0 s, got 0 ms. Write: rk4:0.1ms"),
        ("rk4:0.1", "E204 the step of rk4 wants s, got 0.1 (no unit). Write: rk4:0.1ms"),
        ("cvodes:7", f"{RANGE} got 7. Write: cvodes:1e-10"),
        ("cvodes:nan", f"{RANGE} got nan. Write: cvodes:1e-10"),
    ],
)
def test_a_method_is_read_with_its_step_exact_or_refused_in_one_line(text: str, meant: Method | str) -> None:
    if isinstance(meant, Method):
        assert parse_method(text) == meant
    else:
        assert told(parse_method, text) == [f"--method: {meant}"]


def test_a_step_that_the_scene_has_no_room_for_is_refused() -> None:
    system = compiled(AVERAGE)
    assert told(check_step, system, Method("rk4", step=2 * MS), MS, MS) == [
        "scene.yaml: E913 the step of rk4 wants at most the period of the fastest clock, 1 ms, "
        "got 2 ms. Write: --method rk4:1ms"
    ]
    [said] = told(check_step, system, Method("rk4", step=MS / 10**7), MS, MS)
    assert said.startswith("scene.yaml: E913 the step of rk4 wants at least 1e-06 ms,")
    for method in (Method("rk4", step=MS), DEFAULT):
        check_step(system, method, MS, MS)


def test_a_run_is_as_long_as_is_said_and_no_longer_than_anyone_waits() -> None:
    system = compiled(AVERAGE)
    assert told(simulate, system) == [
        "scene.yaml: E877 the scene says no duration. Write: experiment: {duration: 3 s}  "
        '(or --duration "3 s")'
    ]
    with pytest.raises(ApcError, match=r"E877 the duration wants more than 0 s, got -1 s"):
        simulate(system, duration=Fraction(-1))
    longest = MOST_ROWS * MS  # a row a tick
    check_length(system, longest)
    check_length(system, longest / 10, runs=10)
    wanted = r'E915 the duration wants at most 1e\+06 s: .* Write: --duration "1e\+06 s"'
    with pytest.raises(ApcError, match=wanted):
        check_length(system, longest + 1)
    with pytest.raises(ApcError, match=r"at most 100000 s in each of 10 runs: .*got 200000 s"):
        check_length(system, longest / 5, runs=10)
    long, short = (prepare(system, Settings(Fraction(one), jit=False)) for one in (10_000, 1))
    assert size_note(short, decimal=True) == ""
    assert size_note(long, decimal=False) == "will hold 10,000,000 rows of 25 columns, about 2 GB"
    assert size_note(long, decimal=True) == "will hold 10,000,000 rows of 25 columns, about 5 GB"


def test_what_cant_be_simulated_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    crossley = replaced(
        AVERAGE,
        ("SampledSpringDamper", "HuntCrossleyContact"),
        ("1000 N/m, clock: haptic, delay: 1 ms", "1000 N/m^(3/2)"),
    ).partition("studies:")[0]
    with pytest.raises(ApcError, match=r"E870 the motion of device\.v, cube\.v is not linear .* contact:"):
        simulate(compiled(crossley), duration=Fraction(1), method=Method("exact"))
    with pytest.raises(ApcError, match=r"E873 no signal fits 'cub\.x'; .* Write: --signals cube\.x"):
        simulate(compiled(AVERAGE), duration=Fraction(1), signals=["cub.x"])
    with pytest.raises(ApcError, match="E874"):
        simulate(compiled(replaced(AVERAGE, ("count: 3", "count: 1000000000"))), duration=Fraction(1))
    monkeypatch.setattr("apc.memory.free_memory", lambda: 8e9)
    with pytest.raises(ApcError, match="E874 10,000 peers"):
        prepare(edged("sum", [0.0] * 10_000), Settings(Fraction(1)))


@pytest.mark.whole
def test_a_verdict_on_no_position_or_on_some_says_so() -> None:
    text = AVERAGE.replace("{count: 3}", "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm]}}")
    none = simulate(compiled(text), duration=Fraction(1), signals=["*.v"])
    assert none.summary.verdict == "not judged"
    assert "No position was recorded" in str(none)
    one = simulate(compiled(text), duration=Fraction(1), signals=["user[1].cube.x"])
    assert "on every recorded position stays" in str(one)
    still = simulate(compiled(AVERAGE), duration=Fraction(1), signals=["user[1].cube.x"])
    assert "No recorded position moves." in str(still)


@pytest.mark.whole
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
