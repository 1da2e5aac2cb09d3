"""The motion of a topology is what its events make of it: each tick, packet and force at its own time.

A `Link` brings each packet after its delay; forces act when they are due; between events the motion is exact.
"""

from __future__ import annotations

import json
from fractions import Fraction

import numpy as np
import pytest

from apc.compiler.compiled import Model
from apc.compiler.pipeline import compile_topology
from apc.parameter_values.overrides import apply, parse_override
from apc.simulation.c_compiler import compiler
from apc.simulation.output_blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from apc.simulation.trajectory import Trajectory, simulate
from tests.fifty_digits.truth import exact_course
from tests.schemes import experiment
from tests.sites import MS, alone, paper
from tests.topologies import AVERAGE, MESH, ONE_MASS, TOPOLOGIES, compiled, replaced

MOVED = "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm], cube.x: [2 mm, 0 mm, 1 mm]}}"


def users(trajectory: Trajectory, n: int) -> np.ndarray:
    """Return the rows as (rows, users, [x, v, x_O, v_O, F_C, F_T])."""
    stored = [i for i, one in enumerate(trajectory.signals) if not one.local.endswith(" acting")]
    return trajectory.values[:, stored].reshape(len(trajectory.time), n, 6)


def topology_file(name: str) -> str:
    return (TOPOLOGIES / name).read_text(encoding="utf-8").partition("\n")[2]


@pytest.mark.parametrize(
    ("name", "operator", "tolerance"), [("average", "mean", 1e-11), ("mesh", "sum", 1e-9)]
)
def test_the_papers_experiment_is_what_stepping_it_by_hand_gives(
    name: str, operator: str, tolerance: float
) -> None:
    # The mesh shakes: each contact made or lost multiplies the roundings.
    length = Fraction(4, 5)
    found = simulate(compiled(topology_file(f"experiment-{name}.yaml")), duration=length, jit=False)
    expected = experiment(operator, 801)
    expected[:, 0, 4] *= -1  # a push is positive on either side
    assert found.time.tolist() == [tick / 1000 for tick in range(801)]
    assert np.abs(users(found, 3) - expected).max() < tolerance


def check_followed(model: Model, duration: Fraction) -> None:
    """Check a run against the course that the independent engine follows in balls."""
    followed = exact_course(model, duration)
    assert not isinstance(followed, str), followed
    names, rows = followed
    found = simulate(model, duration=duration, signals=names, jit=False)
    assert [one.name for one in found.signals] == [*names]
    assert np.ptp(rows, axis=0).max() > 1e-4
    assert np.abs(found.values - rows).max() < 1e-12 * max(1.0, np.abs(rows).max())


@pytest.mark.few(6)
@pytest.mark.parametrize(
    ("comp", "comm"),
    [
        ("0 ms", "0 ms"),  # heard at the very tick it is sent
        ("1 ms", "8 ms"),
        ("0.3 ms", "2.5 ms"),  # within the frame, between ticks
        ("2.25 ms", "21 ms"),  # over more than one tick, and over frames
        ("9 ms", "0.001 ms"),
    ],
)
@pytest.mark.parametrize("graph", ["complete", "ring", "star"])
@pytest.mark.parametrize("text", [AVERAGE, MESH], ids=["mean", "sum"])
def test_delays_of_any_length_act_when_they_should(text: str, graph: str, comp: str, comm: str) -> None:
    """Packets on their way hold the senders' start values; forces before the first tick are zero."""
    starts = "[10 mm, 0 mm, -5 mm, 7 mm]"
    four = f"{{set: {{device.x: {starts}, cube.x: [2 mm, 0 mm, 1 mm, -3 mm]}}}}"
    text = replaced(text, ("{count: 3}", four), ("delay: 8 ms}", f"delay: {comm}, graph: {graph}}}"))
    text = text.replace("delay: 1 ms", f"delay: {comp}")
    text = text.replace("stiffness: 500 N/m", "stiffness: 200 N/m, damping: 1 N*s/m")
    text = text.replace("stiffness: 1000 N/m,", "stiffness: 300 N/m, damping: 0.5 N*s/m,")
    check_followed(compiled(text), Fraction(1, 20))


@pytest.mark.few(2)
@pytest.mark.parametrize("topology", ["mixed-clocks", "users-table", "star-lecture"])
def test_groups_tables_and_clocks_are_followed(topology: str) -> None:
    model = compile_topology(TOPOLOGIES / f"{topology}.yaml")
    group = model.groups[0].name
    check_followed(apply(model, [parse_override(model, f"{group}.device.x=10 mm")]), Fraction(1, 20))


MOVING = replaced(AVERAGE, ("{count: 3}", MOVED))
LIMITED = replaced(MESH, ("{count: 3}", MOVED), ("type: FullMesh", "type: SaturatedMesh, limit: 1 N"))


@pytest.mark.whole
@pytest.mark.parametrize(
    "text",
    [
        topology_file("experiment-average.yaml"),
        replaced(
            MOVING, ("delay: 8 ms}", "delay: 8 ms, loss: {p: 10 %, r: 30 %}, jitter: 9 ms, graph: ring}")
        ),
        replaced(LIMITED, ("delay: 8 ms}", "delay: 8 ms, loss: 20 %, on_loss: zero, graph: star}")),
    ],
    ids=["experiment", "bursts", "pairs"],
)
def test_machine_code_and_the_virtual_machine_give_the_same(text: str) -> None:
    model = compiled(text)
    assert compiler() is None or prepare(model, Settings(Fraction(1))).library is not None
    one, two = (simulate(model, jit=jit, duration=Fraction(1, 4)) for jit in (True, False))
    assert np.ptp(one.values, axis=0).max() > 1e-2
    assert np.abs(one.values - two.values).max() < 1e-12


def test_a_clock_with_a_phase_ticks_late_and_the_first_row_is_at_time_0() -> None:
    model = paper(haptic_phase=Fraction(1, 4000))
    found = simulate(model, duration=3 * MS, jit=False)
    assert found.time.tolist() == [0.0, 0.00025, 0.00125, 0.00225]


def test_what_is_remembered_starts_at_its_start_value_and_acts_as_zero_before_it_is_computed() -> None:
    # y counts up by one a tick from its start value; what is held is y, late by one tick and a half.
    count = ", f: {unit: 1, start: 0}"
    model = alone("hold(f, delay)", "f = previous(f) + 1", variables=count, delay="1.5 ms")
    found = simulate(model, duration=5 * MS, jit=False)
    assert found["peer[1].it.f"].tolist() == [0, 1, 2, 3, 4, 5]
    assert found["peer[1].it.f acting"].tolist() == [0, 0, 1, 2, 3, 4]
    expected = np.array([0, 0, 0.5, 2, 4.5, 8]) * 1e-3
    assert found["peer[1].it.x"] == pytest.approx(expected, abs=1e-18)


def test_a_long_run_comes_in_blocks_of_bounded_size_tick_by_tick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("apc.simulation.simulation.CHUNK", 2**13)
    ready = prepare(compiled(AVERAGE), Settings(Fraction(10_005, 10_000), jit=False))
    played = list(blocks(ready))
    assert len(played) > 2
    assert max(block.values.size for block in played) <= 2**13
    assert np.concatenate([block.time for block in played]).tolist() == [k / 1000 for k in range(1_001)]


def test_what_diverges_is_kept_while_it_is_finite() -> None:
    text = replaced(AVERAGE, ("{count: 3}", MOVED), ("stiffness: 500 N/m", "stiffness: 50 kN/m"))
    found = simulate(compiled(text), duration=Fraction(10), jit=False)
    assert np.isfinite(found.values).all()
    assert found.summary.verdict == "diverges"
    assert found.summary.stopped in [one.name for one in found.signals]
    assert found.summary.stopped_at is not None
    assert found.time[-1] == pytest.approx(found.summary.stopped_at - 0.001)
    assert np.abs(found.values[-1]).max() > 1e290
    # Forces times speeds leave the range of floats halfway: that ends no document.
    json.dumps(found.to_dict(), allow_nan=False)


def test_many_different_peers_move_as_each_by_itself() -> None:
    """Masses over nine decades: where a motion dies out at once, floats would not be enough."""
    masses = np.geomspace(1e-6, 1e3, 300)
    listed = ", ".join(f"{float(mass)!r} kg" for mass in masses)
    own = f"{{count: {len(masses)}, set: {{device.v: 1 m/s, device.mass: [{listed}]}}}}"
    text = replaced(ONE_MASS, ("{count: 1}", own)) + "clocks: {haptic: 7 ms}\n"
    found = simulate(compiled(text), duration=Fraction(7, 10), signals=["*.x"], jit=False)
    expected = -masses / 3 * np.expm1(-3 * found.time[:, None] / masses)
    np.testing.assert_allclose(found.values, expected, rtol=1e-12)
