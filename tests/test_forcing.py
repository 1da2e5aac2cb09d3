"""`forcing`: hand forces that change with time are exact, wherever they switch."""

from __future__ import annotations

import itertools
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import flint
import mpmath
import numpy as np
import pytest

from apc.compiler.errors import ApcError
from apc.compiler.interpolation import Interpolation, function_of
from apc.compiler.pipeline import compile_topology
from apc.compiler.plain import plain, read_function
from apc.eigen.balls import precision
from apc.frame.exact import ROWS, evaluate_exact
from apc.frame.parameters import resolve
from apc.simulation import forcing as forcings
from apc.simulation.forcing import Forcing, SiteForcing, forcing_of, impulses
from apc.simulation.propagate import exact_rates, rates
from apc.simulation.quadrature import kernel_of
from apc.simulation.trajectory import simulate
from tests.fifty_digits.pushes import Push, impulse, push_of, switches
from tests.topologies import ONE_MASS, SCENES

CLOCK = "clocks: {haptic: 10 ms}\n"


def moved(tmp_path: Path, hand: str, duration: str = "1/2") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Simulate a mass of 2 kg with damping 3 N s/m under a hand, sampled every 10 ms; return t, x, v."""
    text = f"{ONE_MASS}{CLOCK}hands: {{hand: {{{hand}, flange: device}}}}\n"
    path = tmp_path / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    found = simulate(compile_topology(path), duration=Fraction(duration))
    return found.time, found["user[1].device.x"], found["user[1].device.v"]


def exact(force: Any, corners: list[float], t: float) -> tuple[float, float]:
    """Return x and v by quadrature in 30 digits."""
    with mpmath.workdps(30):
        edges = [mpmath.mpf(0), *(mpmath.mpf(c) for c in corners if c < t), mpmath.mpf(t)]
        b, m = mpmath.mpf(3), mpmath.mpf(2)
        v = mpmath.quad(lambda s: mpmath.exp(-b / m * (t - s)) / m * force(s), edges)
        x = mpmath.quad(lambda s: -mpmath.expm1(-b / m * (t - s)) / b * force(s), edges)
        return float(x), float(v)


@pytest.mark.parametrize(
    ("hand", "force", "corners"),
    [
        ("type: ConstantForce, force: 4 N", lambda s: 4, []),
        ("type: StepForce, force: 4 N, start: 123.4 ms", lambda s: 4 * (s >= mpmath.mpf("0.1234")), [0.1234]),
        ("type: StepForce, force: 4 N, start: 120 ms", lambda s: 4 * (s >= mpmath.mpf("0.12")), [0.12]),
        (
            "type: RampForce, force: 4 N, start: 101 ms, rise: 133 ms",
            lambda s: 4 * max(0, min(1, (s - mpmath.mpf("0.101")) / mpmath.mpf("0.133"))),
            [0.101, 0.234],
        ),
        (
            "type: SineForce, force: 4 N, frequency: 47 Hz, phase: 1 rad",
            lambda s: 4 * mpmath.sin(94 * mpmath.pi * s + 1),
            [0.02 * i for i in range(25)],
        ),
    ],
)
def test_a_force_over_time_is_integrated_to_rounding(
    tmp_path: Path, hand: str, force: Any, corners: list[float]
) -> None:
    time, x, v = moved(tmp_path, hand)
    for row in (5, 13, 24):
        expected = exact(force, corners, float(time[row]))
        assert (x[row], v[row]) == pytest.approx(expected, rel=2e-14, abs=1e-16)


def test_a_table_is_integrated_row_by_row(tmp_path: Path) -> None:
    (tmp_path / "push.csv").write_text("time [ms],force [N]\n3,0\n4.5,2\n17,-1\n33,5\n", encoding="utf-8")
    times, forces = [0.003, 0.0045, 0.017, 0.033], [0.0, 2.0, -1.0, 5.0]
    time, x, v = moved(tmp_path, "type: TableForce, force: push.csv", "1/10")

    def force(s: mpmath.mpf) -> mpmath.mpf:
        if s >= times[-1]:
            return forces[-1]
        for (a, f), (b, g) in zip(zip(times, forces), zip(times[1:], forces[1:])):  # noqa: B905 -- shifted
            if a <= s < b:
                return f + (g - f) * (s - a) / (mpmath.mpf(b) - a)
        return forces[0]

    for row in (1, 2, 3, 4, 10):
        assert (x[row], v[row]) == pytest.approx(exact(force, times, float(time[row])), rel=1e-13, abs=1e-17)


def test_a_pulse_within_one_interval_is_not_missed(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "tap.yaml").write_text(
        "component: Tap\nabout: A short push.\nsource: a test\nconnectors: {flange: Flange}\nparameters:\n"
        "  begin: {unit: s}\n  width: {unit: s}\n  force: {unit: N}\nequations:\n"
        "  - flange.f = if time < begin then 0 else if time < begin + width then -force else 0\n",
        encoding="utf-8",
    )
    tap = "{type: Tap, begin: 124.3 ms, width: 0.1 ms, force: 1 kN, flange: device}"
    path = tmp_path / "scene.yaml"
    path.write_text(f"{ONE_MASS}{CLOCK}library: ./parts\nhands: {{hand: {tap}}}\n", encoding="utf-8")
    found = simulate(compile_topology(path), duration=Fraction(1, 2))
    expected = exact(lambda s: 1000 * (0.1243 <= s < 0.1244), [0.1243, 0.1244], 0.5)
    assert found["user[1].device.x"][-1] == pytest.approx(expected[0], rel=1e-11)


IMPULSES = {
    "a slow sine": ("SineForce, force: 2 N, frequency: 3 Hz, phase: 0.3 rad", 1e-15),
    # Of 435 rad, a rounding is a change of the force by 5e-14.
    "a fast sine": ("SineForce, force: 2 N, frequency: 3456.7 Hz", 3e-13),
    "a ramp": ("RampForce, force: 2 N, start: 3.3 ms, rise: 11.123 ms", 2e-15),
    "a step within an interval": ("StepForce, force: 2 N, start: 3.3 ms", 2e-15),
    "a step at a tick": ("StepForce, force: 2 N, start: 3 ms", 2e-15),
    "a step just before a tick": ("StepForce, force: 2 N, start: 3.99999 ms", 2e-15),
    "a step just after the start": ("StepForce, force: 2 N, start: 1 ns", 2e-15),
}


DEVICES = {
    "mass: 0.1 kg, damping: 5 N*s/m": 0.0,
    # It forgets a push within 2 ns; a node of a quadrature is right to 1e-19 s, and there are many.
    "mass: 1 mg, damping: 500 N*s/m": 1e-13,
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("what", IMPULSES)
def test_an_impulse_is_that_of_ball_arithmetic(what: str, device: str, tmp_path: Path) -> None:
    hand, allowed = IMPULSES[what]
    text = (SCENES / "finger.yaml").read_text(encoding="utf-8")
    ramp = "type: RampForce, flange: device, force: 2 N, rise: 0.5 s"
    assert ramp in text
    text = text.replace(ramp, f"flange: device, type: {hand}")
    path = tmp_path / "scene.yaml"
    path.write_text(text.replace("mass: 0.1 kg, damping: 5 N*s/m", device), encoding="utf-8")
    system = compile_topology(path)
    [kind] = system.kinds
    vector = resolve(system).parameters[0][0]
    linear = rates(kind)
    tick, count = Fraction(1, 1000), 20
    a = exact_rates(linear, vector)[:, : len(kind.states)]
    forcing = forcing_of(linear)
    site = SiteForcing(forcing, vector, (kernel_of(a, forcing.pushed, tick),))
    found = impulses(site, np.arange(count) / 1000, np.zeros(count, np.int64))
    exact_a = flint.fmpq_mat(
        len(a), len(a), [flint.fmpq(*Fraction(one).as_integer_ratio()) for one in a.ravel()]
    )
    push = push_of(kind, [Fraction(float(one)) for one in vector], exact_a)
    assert push is not None
    expected = np.array([_in_balls(push, k * tick, tick) for k in range(count)])
    # Of what the force adds to each state in any of the intervals.
    off = np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)
    assert (off <= max(allowed, DEVICES[device])).all(), off


def _in_balls(push: Push, start: Fraction, length: Fraction) -> list[float]:
    """Return the impulse of an interval, piece by piece between its switches."""
    with precision(192):
        total = flint.arb_mat(push.a.nrows(), 1, [0] * push.a.nrows())
        edges = sorted({start, start + length, *switches(push, start, start + length)})
        for low, high in itertools.pairwise(edges):
            left = flint.fmpq(*(start + length - high).as_integer_ratio())
            added = flint.arb_mat(push.a.nrows(), 1, impulse(push, low, high - low))
            total += flint.arb_mat(push.a * left).exp() * added
        return [float(one.mid()) for one in total.entries()]


def test_a_force_that_crosses_zero_is_not_halved_in_vain(monkeypatch: pytest.MonkeyPatch) -> None:
    """What rounding an instant changes near a zero of a sine is no reason to look more closely."""
    p, t = casadi.SX.sym("p", 1), casadi.SX.sym("t")
    force = casadi.Function("force", [p, t], [casadi.sin(p * t)])
    drift = casadi.Function("drift", [p, t], [t * p * casadi.cos(p * t)])
    nothing = casadi.Function("switches", [p, t], [casadi.SX(0, 1)])
    tick = Fraction(1, 1000)
    kernel = kernel_of(np.array([[Fraction(-1)]]), [0], tick)
    # Half-way through these intervals the sine is 0, so that its impulse is next to nothing.
    starts = np.pi * np.arange(1, 200) / 20 - 0.0005
    site = SiteForcing(Forcing((0,), force, drift, nothing, affine=True), np.array([20.0]), (kernel,))
    monkeypatch.setattr(forcings, "panels", pytest.fail)
    found = impulses(site, starts, np.zeros(len(starts), np.int64))
    assert (np.abs(found) < 1e-8).all()


def test_a_force_that_changes_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(forcings, "MOST_HALVED", 1000)
    with pytest.raises(ApcError, match=r"E871 a force changes too fast: .* more than 1,000 places"):
        moved(tmp_path, "type: SineForce, force: 1 N, frequency: 1e9 Hz", "1/10")


def test_a_long_table_is_looked_up_and_evaluated_once_a_row_however_many_intervals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = np.random.default_rng(4)
    times = np.cumsum(generator.uniform(1e-4, 3e-3, 60)) + 2.0
    numbers = generator.normal(size=60)
    rows = "".join(
        f"{one!r},{other!r}\n" for one, other in zip(times.tolist(), numbers.tolist(), strict=True)
    )
    (tmp_path / "force.csv").write_text(f"time [s],force [N]\n{rows}", encoding="utf-8")
    text = f"{ONE_MASS}hands: {{hand: {{type: TableForce, flange: device, force: force.csv}}}}\n"
    (tmp_path / "scene.yaml").write_text(text, encoding="utf-8")
    system = compile_topology(tmp_path / "scene.yaml")
    seen: list[int] = []

    def counting(function: Any, parameters: Any, instants: Any) -> Any:
        seen.append(instants.size)
        return walked(function, parameters, instants)

    walked = forcings.at_instants
    monkeypatch.setattr(forcings, "at_instants", counting)
    simulate(system, duration=Fraction(3))
    assert sum(seen) <= len(times) + 3
    [kind] = system.kinds
    site = SiteForcing(forcing_of(rates(kind)), resolve(system).parameters[0][0], ())
    at = np.sort(generator.uniform(1.9, 2.3, (3, 200)))
    expected = np.interp(at, times, numbers) / 2
    assert np.abs(site.force(at)[0] - expected).max() <= 1e-13 * np.abs(expected).max()


def test_a_table_is_data_of_a_function_that_is_as_short_however_many_rows(tmp_path: Path) -> None:
    text = f"{ONE_MASS}hands: {{hand: {{type: TableForce, flange: device, force: force.csv}}}}\n"
    (tmp_path / "scene.yaml").write_text(text, encoding="utf-8")
    lengths = []
    for count in (2, 1000):
        times = np.arange(count) / 1000
        rows = "".join(f"{one!r},{one * one!r}\n" for one in times.tolist())
        (tmp_path / "force.csv").write_text(f"time [s],force [N]\n{rows}", encoding="utf-8")
        [kind] = compile_topology(tmp_path / "scene.yaml").kinds
        found = plain(kind.derivative)
        [table] = found.tables
        assert np.array_equal(table.times, times)
        assert plain(read_function(found.document()).build()).document() == found.document()
        lengths.append((len(found.operations), kind.derivative.n_instructions()))
        forcing = forcing_of(rates(kind))
        lengths[-1] += (forcing.line.n_instructions(), forcing.switches.numel_out(0))
    assert lengths[0] == lengths[1]


def test_every_way_to_evaluate_a_table_gives_its_lines_and_their_slopes() -> None:
    times, numbers = np.array([-1.0, 0.5, 0.75, 4.0]), np.array([2.0, -1.0, -1.0, 8.0])
    at = casadi.SX.sym("at")
    value = function_of(Interpolation(times, numbers))(2 * at)
    function = casadi.Function("f", [at], [casadi.vertcat(value, casadi.jacobian(value, at))])
    for one in (-3.0, -0.5, 0.0, 0.3, 1.25, 2.0, 7.0):
        piece = int(np.searchsorted(times, 2 * one, side="right"))
        slope = 2 * np.pad(np.diff(numbers) / np.diff(times), 1)[piece]
        expected = [float(np.interp(2 * one, times, numbers)), slope]
        walked = evaluate_exact(function, [[Fraction(one)]])[0]
        many = evaluate_exact(function, [[np.array([one])]], number=np.float64, rules=ROWS)[0]
        assert [float(each) for each in walked] == pytest.approx(expected)
        assert [float(each[0]) for each in many] == pytest.approx(expected)
        if 2 * one not in times:
            assert np.asarray(function(one)).ravel() == pytest.approx(expected)


@pytest.mark.parametrize(
    "rows",
    [
        [[0.0], [1.0]],
        [[0.0, 0.0], [1.0, 2.0]],
        [[0.0, 1.0], [1.0]],
        [[0.0, 1.0], [1.0, float("inf")]],
        [[0, 1], [1, 2]],
    ],
)
def test_a_file_whose_table_is_none_is_refused(rows: Any) -> None:
    at = casadi.SX.sym("at")
    table = function_of(Interpolation(np.array([0.0, 1.0]), np.array([1.0, 2.0])))
    document = plain(casadi.Function("f", [at], [table(at)])).document()
    read_function(document)
    with pytest.raises(ValueError):
        read_function({**document, "tables": [rows]})
