"""What a person gets of a run: what was seen in words, rows and columns by name, and what is refused."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.compiler.errors import ApcError
from apc.simulation.initial_velocity import initial_velocity
from apc.simulation.settings import DEFAULT, Method, Settings, check_step, parse_method
from apc.simulation.simulation import MOST_ROWS, check_length, prepare, size_note
from apc.simulation.trajectory import Trajectory, simulate
from tests.sites import edged
from tests.topologies import AVERAGE, ONE_MASS, TOPOLOGIES, compiled, messages_of, replaced

MS = Fraction(1, 1000)
AVERAGE_RUN, MESH_RUN = (
    simulate(compiled((TOPOLOGIES / f"experiment-{name}.yaml").read_text(encoding="utf-8")), jit=False)
    for name in ("average", "mesh")
)

# ---- what was seen ----


def test_the_average_decays_and_the_mesh_oscillates() -> None:
    average, mesh = AVERAGE_RUN.summary, MESH_RUN.summary
    assert (average.verdict, mesh.verdict) == ("decays", "oscillates")
    assert mesh.fit is not None and mesh.fit.oscillation is not None
    crests = mesh.fit.oscillation
    tail = MESH_RUN[mesh.oscillating][MESH_RUN.time > 0.8 * MESH_RUN.time[-1]]
    turns = np.count_nonzero(np.diff(np.sign(np.diff(tail))))
    assert crests.frequency == pytest.approx(turns / 2 / 0.6, abs=crests.error + 1)
    assert crests.size == pytest.approx(np.ptp(tail), rel=0.1) and crests.size > 1e-3
    assert str(AVERAGE_RUN).startswith(
        "experiment-average: decays\n\n  Every position converges to a constant value."
    )


def settling_time(found: Trajectory) -> float:
    """Return the time of the last sample outside ±5 % of its own range around its last value, as in a CSV."""
    last = 0.0
    for one in found.signals:
        if one.role == "state" and one.unit == "m":
            x = found[one.name]
            outside = np.flatnonzero(np.abs(x - x[-1]) > 0.05 * (x.max() - x.min()))
            last = max(last, float(found.time[outside[-1]]) if len(outside) else 0.0)
    return last


@pytest.mark.parametrize("seconds", ["1", "3/2", "2", "7/2"])
def test_the_settling_time_is_that_of_the_rows(seconds: str) -> None:
    text = AVERAGE.replace("{count: 3}", "{count: 3, set: {device.x: [10 mm, 0 mm, -1 mm]}}")
    found = simulate(compiled(text.replace("1000 N/m", "300 N/m")), duration=Fraction(seconds), jit=False)
    truth = settling_time(found)
    assert found.summary.verdict == "decays" and found.summary.settled_error == 0
    assert found.summary.settled == (truth if truth <= 0.9 * float(Fraction(seconds)) else None)


# m x'' + d x' + k x = 0 with the wall of a sampled spring behind it: eigenvalues from the frame's matrix.
SLOW = """\
topology: slow
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 0.1 kg, damping: DAMPING N*s/m, x: 1 mm}
couplers:
  spring: {type: SampledSpringDamper, a: device, b: ground, stiffness: STIFFNESS N/m, clock: haptic}
"""


def eigenvalue(damping: float, stiffness: float) -> complex:
    """Return s of the slower pair of x'' = −(d/m) x' − (k/m) x(kT): the exact transition of 1 ms."""
    step, pace = 1e-3, damping / 0.1
    decay = np.exp(-pace * step)
    through = (1 - decay) / pace
    push = stiffness / damping * (step - through), stiffness / 0.1 * through
    matrix = np.array([[1 - push[0], through], [-push[1], decay]])
    values = np.linalg.eigvals(matrix).astype(complex)
    return complex(np.log(values[np.argmax(np.abs(values))]) / step)


@pytest.mark.few(4)
@pytest.mark.parametrize("seconds", ["1/4", "1", "2", "4", "12"])
@pytest.mark.parametrize(
    ("damping", "stiffness"), [(0.5, 900.0), (0.46, 900.0), (0.44, 900.0), (3.0, 50.0), (8.0, 40.0)]
)
def test_rate_and_frequency_are_those_of_the_eigenvalue_for_any_duration(
    damping: float, stiffness: float, seconds: str
) -> None:
    """Near d = kT/2 = 0.45 N·s/m the motion decays or grows within tens of seconds."""
    truth = eigenvalue(damping, stiffness)
    text = SLOW.replace("DAMPING", repr(damping)).replace("STIFFNESS", repr(stiffness))
    found = simulate(compiled(text), duration=Fraction(seconds), jit=False).summary
    assert found.verdict == ("decays" if truth.real < 0 else "diverges")
    assert found.fit is not None and abs(found.fit.rate - truth.real) <= found.fit.error
    assert found.fit.error < 1e-3 * abs(truth.real)
    crests = found.fit.oscillation
    assert (crests is not None) == (truth.imag != 0)
    if crests is not None:
        off = abs(crests.frequency - abs(truth.imag) / (2 * np.pi))
        assert off <= crests.error < 1e-3 * crests.frequency


@pytest.mark.parametrize(
    ("hand", "verdict", "until"),
    [
        ("StepForce, flange: device, force: 1 N, start: 10 ms", "decays", 0.01),
        ("StepForce, flange: device, force: 1 N, start: 1.95 s", "driven", 1.95),
        ("RampForce, flange: device, force: 1 N, rise: 5 s", "driven", 2.0),
        ("SineForce, flange: device, force: 1 N, frequency: 3 Hz", "driven", 2.0),
        ("SineForce, flange: device, force: 0 N, frequency: 3 Hz", "decays", 0.0),
        ("ConstantForce, flange: device, force: 1 N", "decays", 0.0),
    ],
)
def test_a_force_that_changes_until_the_end_drives_the_motion(hand: str, verdict: str, until: float) -> None:
    text = SLOW.replace("DAMPING", "2").replace("STIFFNESS", "900") + f"hands: {{hand: {{type: {hand}}}}}\n"
    found = simulate(compiled(text), duration=Fraction(2), jit=False).summary
    assert found.verdict == verdict
    assert found.driven_until == pytest.approx(until, abs=2 / 1024)
    if verdict == "decays":  # free from the last change on
        truth = eigenvalue(2, 900)
        assert found.fit is not None and abs(found.fit.rate - truth.real) <= found.fit.error < 1e-3


@pytest.mark.parametrize(("damping", "verdict"), [(0.46, "driven"), (0.44, "diverges")])
def test_a_driven_motion_of_an_unstable_linear_topology_diverges(damping: float, verdict: str) -> None:
    assert (eigenvalue(damping, 900.0).real < 0) is (verdict == "driven")
    text = SLOW.replace("DAMPING", repr(damping)).replace("STIFFNESS", "900.0")
    text += "hands: {hand: {type: SineForce, flange: device, force: 1 N, frequency: 3 Hz}}\n"
    found = simulate(compiled(text), duration=Fraction(2), jit=False).summary
    assert found.verdict == verdict
    assert ("growth time constant" in found.reason) is (verdict == "diverges")


@pytest.mark.parametrize("name", ["three-users-predicted", "two-users-dead-reckoning"])
def test_the_age_of_a_packet_is_no_force_that_changes_with_time(name: str) -> None:
    model, _ = initial_velocity(apc.compile(TOPOLOGIES / f"{name}.yaml"))
    found = simulate(model, duration=Fraction(1), jit=False).summary
    assert (found.verdict, found.driven_until) == ("decays", 0.0)


def test_a_motion_that_does_not_excite_the_unstable_mode_is_not_determined() -> None:
    """Equal start values excite the common mode alone; the difference is unstable (see `analyze`)."""
    text = AVERAGE.replace("stiffness: 500", "stiffness: 1500").replace(
        "{count: 3}", "{count: 3, set: {device.v: 0.1 m/s}}"
    )
    model = compiled(text)
    assert apc.analyze(model).stable is False
    found = simulate(model, duration=Fraction(1, 2), jit=False)
    assert found.summary.verdict == "not determined"
    assert "apc analyze: unstable, growth time constant" in " ".join(str(found).split())


def test_numbers_of_any_size_grow() -> None:
    text = AVERAGE.replace("stiffness: 500", "stiffness: 3000").replace(
        "{count: 3}", "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm]}}"
    )
    for seconds in (1, 3):
        found = simulate(compiled(text), duration=Fraction(seconds), jit=False)
        assert found.summary.verdict == "diverges"


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
def test_a_mass_that_is_pushed_drifts_and_one_on_a_spring_decays(arm: bool) -> None:
    text = ONE_MASS + "hands: {hand: {type: ConstantForce, flange: device, force: 1 N}}\n"
    if arm:
        text += (
            "couplers:\n  arm: {type: SpringDamperArm, flange: device, stiffness: 10 N/m, damping: 5 N*s/m}\n"
        )
    found = simulate(compiled(text), duration=Fraction(10), jit=False)
    assert found.summary.verdict == ("decays" if arm else "drifts")
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
    model = compiled(
        replaced(AVERAGE, ("user: {count: 3}", "left: {count: 2, set: {cube.x: 1 cm}}\n  right: {count: 1}"))
    )
    found, whole = (
        simulate(model, duration=Fraction(1, 20), signals=requested, jit=False)
        for requested in (patterns, [])
    )
    assert [one.name for one in found.signals] == names
    for name in names:
        assert np.abs(found[name] - whole[name]).max() < 1e-15


def test_the_public_function_plays_a_file_with_other_numbers(tmp_path: Path) -> None:
    path = tmp_path / "topology.yaml"
    path.write_text(AVERAGE, encoding="utf-8")
    requested = {"user.device.x": "2 mm"}
    found = apc.simulate(path, duration="4 ms", params=requested, signals=["device.x"], jit=False)
    assert isinstance(found, apc.Trajectory)
    assert found.values.shape == (5, 3)
    assert (found.values[0] == 0.002).all()
    assert found.to_dict()["provenance"]["parameters"]["user.device.x"] == {"value": 0.002, "unit": "m"}


# ---- what is asked, and what is refused ----


KINDS = "E910 method: expected one of exact, rk4, semi-implicit, cvodes,"
RANGE = "E912 relative tolerance of cvodes: expected a number from 1e-12 to 0.01,"


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("exact", Method("exact")),
        ("rk4:0.1 ms", Method("rk4", step=MS / 10)),
        ("rk4:250us", Method("rk4", step=MS / 4)),
        (" semi-implicit : 1 ms", Method("semi-implicit", step=MS)),
        ("cvodes:1e-8", Method("cvodes", tolerance=1e-8)),
        ("rk5:1 ms", f"{KINDS} got rk5:1 ms. Try: rk4:0.1ms"),
        ("", f"{KINDS} got nothing. Try: exact"),
        ("exact:1 ms", "E910 method: expected exact without a step, got exact:1 ms. Try: exact"),
        ("rk4", "E911 rk4: expected a step, got none. Try: rk4:0.1ms"),
        ("rk4:0 ms", "E911 step of rk4: expected more than 0 s, got 0 ms. Try: rk4:0.1ms"),
        ("rk4:0.1", "E204 step of rk4: expected s, got 0.1 (no unit). Try: rk4:0.1ms"),
        ("cvodes:7", f"{RANGE} got 7. Try: cvodes:1e-10"),
        ("cvodes:nan", f"{RANGE} got nan. Try: cvodes:1e-10"),
    ],
)
def test_a_method_is_read_with_its_step_exact_or_refused_in_one_line(text: str, meant: Method | str) -> None:
    if isinstance(meant, Method):
        assert parse_method(text) == meant
    else:
        assert messages_of(parse_method, text) == [f"--method: {meant}"]


def test_a_step_that_the_topology_has_no_room_for_is_refused() -> None:
    model = compiled(AVERAGE)
    assert messages_of(check_step, model, Method("rk4", step=2 * MS), MS, MS) == [
        "topology.yaml: E913 step of rk4: expected at most the period of the fastest clock, 1 ms, "
        "got 2 ms. Try: --method rk4:1ms"
    ]
    [printed] = messages_of(check_step, model, Method("rk4", step=MS / 10**7), MS, MS)
    assert printed.startswith("topology.yaml: E913 step of rk4: expected at least 1e-06 ms,")
    for method in (Method("rk4", step=MS), DEFAULT):
        check_step(model, method, MS, MS)


def test_a_run_is_as_long_as_is_said_and_no_longer_than_anyone_waits() -> None:
    model = compiled(AVERAGE)
    assert messages_of(simulate, model) == [
        "topology.yaml: E877 the topology has no duration. Try: experiment: {duration: 3 s}, "
        'or --duration "3 s"'
    ]
    with pytest.raises(ApcError, match=r"E877 duration: expected more than 0 s, got -1 s"):
        simulate(model, duration=Fraction(-1))
    longest = MOST_ROWS * MS  # a row a tick
    check_length(model, longest)
    check_length(model, longest / 10, runs=10)
    requested = r'E915 duration: expected at most 1e\+06 s .* Try: --duration "1e\+06 s"'
    with pytest.raises(ApcError, match=requested):
        check_length(model, longest + 1)
    with pytest.raises(ApcError, match=r"at most 100000 s in each of 10 runs .*got 200000 s"):
        check_length(model, longest / 5, runs=10)
    long, short = (prepare(model, Settings(Fraction(one), jit=False)) for one in (10_000, 1))
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
    with pytest.raises(ApcError, match=r"E873 no signal matches 'cub\.x'; .* Try: --signals cube\.x"):
        simulate(compiled(AVERAGE), duration=Fraction(1), signals=["cub.x"])
    with pytest.raises(ApcError, match="E874"):
        simulate(compiled(replaced(AVERAGE, ("count: 3", "count: 1000000000"))), duration=Fraction(1))
    monkeypatch.setattr("apc.support.memory.free_memory", lambda: 8e9)
    with pytest.raises(ApcError, match="E874 10,000 peers"):
        prepare(edged("sum", [0.0] * 10_000), Settings(Fraction(1)))


@pytest.mark.whole
def test_a_verdict_on_no_position_or_on_some_says_so() -> None:
    text = AVERAGE.replace("{count: 3}", "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm]}}")
    none = simulate(compiled(text), duration=Fraction(1), signals=["*.v"])
    assert none.summary.verdict == "not determined"
    assert "no position was recorded" in str(none)
    still = simulate(compiled(AVERAGE), duration=Fraction(1), signals=["user[1].cube.x"])
    assert "No recorded position changes." in str(still)


@pytest.mark.whole
def test_the_oscillation_that_is_reported_is_the_largest_of_its_unit_not_the_first() -> None:
    """A light device beside a heavy cube moves most, whatever share of its own range each makes."""
    start = "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm]}}"
    text = AVERAGE.replace("{count: 3}", start).replace("stiffness: 1000", "stiffness: 2500")
    text = text.replace("device: {mass", "zero: {mass: 9 kg, damping: 5 N*s/m}\n  device: {mass")
    tie = "  tie: {type: SpringDamper, a: zero, b: device, stiffness: 1 N/m}\n  contact:"
    found = simulate(compiled(text.replace("  contact:", tie)), duration=Fraction(1)).summary
    assert found.verdict == "diverges"
    largest = max(found.extents, key=lambda one: (one.unit == "m") * (one.high - one.low))
    assert found.oscillating == largest.name
