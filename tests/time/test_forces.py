"""Forces that change with time move a mass to rounding, wherever they bend, jump and switch.

Against the convolution with the response to a force, by quadrature in 30 digits.
"""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest

import apc
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.simulation.trajectory import simulate
from tests.topologies import ONE_MASS, replaced

MASS, DAMPING = 0.25, 2.0  # kg, N·s/m: numbers of a few bits, so that text and closed form mean the same
TOPOLOGY = """
topology: pushed
library: ./
clocks: {haptic: 4 ms}
peers: {user: {count: 1, set: {device.x: 0.5 m, device.v: 0.125 m/s}}}
masses:
  device: {mass: 0.25 kg, damping: 2 N*s/m}
couplers:
  idle: {type: SampledSpringDamper, a: device, b: ground, stiffness: 0 N/m, clock: haptic}
hands:
  push: {flange: device, PUSH}
"""
TABLE = "time [s],force [N]\n0.0,0\n0.0625,2\n0.078125,-1\n0.125,-1\n"
OWN = (
    "component: NAME\ndescription: Pushes.\nconnectors: {flange: Flange}\nparameters: "
    "{f: {unit: N, default: 1 N},"
    " T: {unit: s, default: 1 s}}\nequations:\n  - flange.f = -f*(LAW)\n"
)
LAWS = {
    "Powers": "sqrt(time/T) + (time/T)^2.5 + exp(-time/T) + log(1 + time/T)/(1 + time/T) + cos(40*time/T)",
    "Choices": "if time < 0.03125*T or (time > 0.0625*T and not time > 0.078125*T) then max(time/T, 0.015625)"
    " else min(abs(time/T - 0.05078125), sign(time/T - 0.0546875)/16)",
    "Tap": "if time < 0.0429*T then 0 else if time < 0.043*T then 100 else 0",
    "Steps": "floor(64*time/T)/8",
}


def choices(t: Any) -> Any:
    if t < 0.03125 or 0.0625 < t <= 0.078125:
        return max(t, mpmath.mpf("0.015625"))
    return min(abs(t - mpmath.mpf("0.05078125")), mpmath.sign(t - mpmath.mpf("0.0546875")) / 16)


# What pushes, its force in N over seconds, and where it bends or jumps.
PUSHES: dict[str, tuple[str, Callable[[Any], Any], list[float]]] = {
    "a constant": ("type: ConstantForce, force: 3 N", lambda t: 3, []),
    "a step at a tick": ("type: StepForce, force: 3 N, start: 32 ms", lambda t: 3 * (t > 0.032), [0.032]),
    "a step between two ticks": (
        "type: StepForce, force: 3 N, start: 0.03125 s", lambda t: 3 * (t > 0.03125), [0.03125]),
    "a ramp with both corners between ticks": (
        "type: RampForce, force: 2 N, start: 0.015625 s, rise: 0.0625 s",
        lambda t: 2 * min(mpmath.mpf(1), max(mpmath.mpf(0), (t - mpmath.mpf("0.015625")) * 16)),
        [0.015625, 0.078125]),
    "a sine": (
        "type: SineForce, force: 2 N, frequency: 8 Hz, phase: 0.5 rad",
        lambda t: 2 * mpmath.sin(2 * mpmath.mpf(3.141592653589793) * 8 * t + mpmath.mpf("0.5")),
        [0.03125, 0.0625]),
    "a sine of many turns a tick": (
        "type: SineForce, force: 2 N, frequency: 512 Hz",
        lambda t: 2 * mpmath.sin(2 * mpmath.mpf(3.141592653589793) * 512 * t),
        [k / 512 for k in range(1, 12)]),
    "a table": (
        "type: TableForce, force: push.csv",
        lambda t: mpmath.mpf(32 * t if t < 0.0625 else max(2 - 192 * (t - mpmath.mpf("0.0625")), -1)),
        [0.0625, 0.078125, 0.125]),
    "powers and functions": (
        "type: Powers",
        lambda t: mpmath.sqrt(t) + t**2.5 + mpmath.exp(-t) + mpmath.log(1 + t) / (1 + t) + mpmath.cos(40 * t),
        [1e-6, 1e-4, 1e-3, 1e-2]),
    "choices": ("type: Choices", choices, [k / 256 for k in range(1, 26)]),
    "a tap within a tick": (
        "type: Tap", lambda t: 100 * (mpmath.mpf(0.0429) <= t < mpmath.mpf(0.043)), [0.0429, 0.043]),
    "steps of a staircase": (
        "type: Steps", lambda t: mpmath.floor(64 * t) / 8, [k / 64 for k in range(1, 7)]),
}  # fmt: skip


def by_quadrature(
    force: Callable[[Any], Any],
    edges: list[float],
    end: Fraction,
    mass: float = MASS,
    damping: float = DAMPING,
) -> list[float]:
    """Return x and v of the damped mass at `end`, from the convolution with its response to a force."""
    with mpmath.workdps(30):
        t, rate = mpmath.mpf(end.numerator) / end.denominator, mpmath.mpf(damping) / mass
        panels = sorted({mpmath.mpf(0), t, *(mpmath.mpf(e) for e in edges if e < t)})

        def fading(s: Any) -> Any:
            return mpmath.exp(-rate * (t - s))

        v = mpmath.mpf("0.125") * fading(0) + mpmath.quad(lambda s: force(s) * fading(s), panels) / mass
        x = mpmath.mpf("0.5") + mpmath.mpf("0.125") * (1 - fading(0)) / rate
        x += mpmath.quad(lambda s: force(s) * (1 - fading(s)), panels) / damping
        return [float(x), float(v)]


def pushed(words: str, folder: Path, topology: str = TOPOLOGY) -> apc.Model:
    """Compile the topology with a force, the files it names in a folder."""
    (folder / "push.csv").write_text(TABLE, encoding="utf-8")
    for name, law in LAWS.items():
        text = OWN.replace("NAME", name).replace("LAW", law)
        (folder / f"{name}.yaml").write_text(text, encoding="utf-8")
    path = folder / "topology.txt"
    path.write_text(topology.replace("PUSH", words), encoding="utf-8")
    return compile_topology(path)


@pytest.mark.few(5)
@pytest.mark.parametrize("what", PUSHES)
def test_a_force_of_time_moves_a_mass_as_its_integral_says(what: str, tmp_path: Path) -> None:
    words, force, edges = PUSHES[what]
    model = pushed(words, tmp_path)
    length = Fraction(1, 10) if "many" not in what else Fraction(1, 50)
    found = simulate(model, duration=length, jit=False)
    assert found.provenance.method == "exact"
    for row in (8, 25) if "many" not in what else (1, 5):
        expected = by_quadrature(force, edges, Fraction(row, 250))
        assert found.values[row, :2] == pytest.approx(expected, rel=2e-14)


def test_a_topology_in_which_nothing_ticks_is_pushed_too(tmp_path: Path) -> None:
    words, force, edges = PUSHES["a sine"]
    topology = TOPOLOGY.replace("clocks: {haptic: 4 ms}\n", "")
    head, _, rest = topology.partition("couplers:")
    model = pushed(words, tmp_path, head + "hands:" + rest.partition("hands:")[2])
    expected = by_quadrature(force, edges, Fraction(1, 20))
    found = simulate(model, duration=Fraction(1, 20), jit=False)
    assert found.values[50] == pytest.approx(expected, rel=2e-14)


# A light device forgets a push within microseconds: what moves it is all but over before a tick is.
LATE = [(f"type: StepForce, force: 2 N, start: {at!r} s", lambda t, at=at: 2 * (t > at), [at])
        for at in (1e-9, 3.99999e-3)]  # fmt: skip


@pytest.mark.few(1)
@pytest.mark.parametrize("mass", [1e-3, 1e-6])
@pytest.mark.parametrize(("words", "force", "edges"), [*LATE, PUSHES["a sine"]])
def test_a_device_that_forgets_at_once_is_pushed_as_its_integral_says(
    words: str, force: Callable[[Any], Any], edges: list[float], mass: float, tmp_path: Path
) -> None:
    light = replaced(TOPOLOGY, ("mass: 0.25 kg, damping: 2 N*s/m", f"mass: {mass!r} kg, damping: 500 N*s/m"))
    found = simulate(pushed(words, tmp_path, light), duration=Fraction(1, 50), jit=False)
    for row in (1, 5):
        end = Fraction(row, 250)
        near = [float(end) - many * mass / 500 for many in (1, 10, 100)]
        expected = by_quadrature(force, [*edges, *near], end, mass=mass, damping=500.0)
        assert found.values[row, :2] == pytest.approx(expected, rel=1e-13)


@pytest.mark.parametrize("what", ["a sine", "a ramp with both corners between ticks"])
def test_two_masses_on_a_spring_are_pushed_as_their_modes_are(what: str, tmp_path: Path) -> None:
    """Of equal masses the sum moves as a damped mass does, and the difference as one on a spring of 2 k."""
    words, force, edges = PUSHES[what]
    two = "  load: {mass: 0.25 kg, damping: 2 N*s/m}\ncouplers:\n"
    two += "  tie: {type: SpringDamper, a: device, b: load, stiffness: 300 N/m}\n"
    text = replaced(TOPOLOGY, ("couplers:\n", two), (", set: {device.x: 0.5 m, device.v: 0.125 m/s}", ""))
    found = simulate(pushed(words, tmp_path, text), duration=Fraction(1, 10), signals=["device.*"], jit=False)
    with mpmath.workdps(40):
        rate = mpmath.mpf(DAMPING) / MASS
        turn = mpmath.sqrt(2 * 300 / mpmath.mpf(MASS) - rate**2 / 4)

        def response(s: Any) -> tuple[Any, Any]:
            fading = mpmath.exp(-rate * s / 2)
            sine, cosine = mpmath.sin(turn * s), mpmath.cos(turn * s)
            x = (1 - fading**2) / DAMPING + fading * sine / (MASS * turn)
            v = (fading**2 + fading * (cosine - rate / (2 * turn) * sine)) / MASS
            return x / 2, v / 2

        for row in (3, 25):
            end = mpmath.mpf(row) / 250
            panels = sorted({mpmath.mpf(0), end, *(mpmath.mpf(e) for e in edges if e < end)})
            for place in (0, 1):

                def pull(s: Any, end: Any = end, place: int = place) -> Any:
                    return force(s) * response(end - s)[place]

                moved = float(mpmath.quad(pull, panels))
                assert found.values[row, place] == pytest.approx(moved, rel=1e-12, abs=1e-15)


def test_peers_are_pushed_for_long_each_by_its_own_force_one_of_them_by_none(tmp_path: Path) -> None:
    """m v' + b v = F sin(ω t + φ): what is left after 10 s is the response to the sine alone."""
    peers = "count: 3, set: {push.force: [0 N, 2 N, 1 N], push.frequency: [3 Hz, 4 Hz, 500 Hz]}"
    topology = replaced(TOPOLOGY, ("count: 1, set: {device.x: 0.5 m, device.v: 0.125 m/s}", peers))
    model = pushed("type: SineForce, force: 1 N, frequency: 1 Hz, phase: 0.5 rad", tmp_path, topology)
    found = simulate(model, duration=Fraction(10), signals=["*.v"], jit=False)
    for row in (2499, 2500):
        turn = 2 * np.pi * np.array([3, 4, 500])
        response = np.array([0, 2, 1]) / (1j * turn * MASS + DAMPING)
        expected = (response * np.exp(1j * (turn * found.time[row] + 0.5))).imag
        assert found.values[row] == pytest.approx(expected, rel=1e-9, abs=1e-14)


def test_a_force_that_changes_without_end_is_refused(tmp_path: Path) -> None:
    model = pushed("type: SineForce, force: 1 N, frequency: 1e9 Hz", tmp_path)
    with pytest.raises(ApcError, match=r"E871 a force changes too fast: .* more than 100 points"):
        simulate(model, duration=Fraction(1, 10), jit=False)


def test_a_long_table_is_followed_row_by_row_and_costs_no_operation_a_row(tmp_path: Path) -> None:
    generator = np.random.default_rng(4)
    text = f"{ONE_MASS}hands: {{hand: {{type: TableForce, flange: device, force: force.csv}}}}\n"
    (tmp_path / "topology.yaml").write_text(text, encoding="utf-8")
    lengths = []
    for count in (60, 1000):
        times = np.cumsum(generator.uniform(1e-4, 3e-3, count)) + 0.05
        forces = generator.normal(size=count)
        rows = "".join(f"{t!r},{f!r}\n" for t, f in zip(times.tolist(), forces.tolist(), strict=True))
        (tmp_path / "force.csv").write_text(f"time [s],force [N]\n{rows}", encoding="utf-8")
        model = compile_topology(tmp_path / "topology.yaml")
        [peer_type] = model.peer_types
        lengths.append(peer_type.derivative.n_instructions())
        found = simulate(model, duration=Fraction(1, 10), signals=["*.v"], jit=False)
        # m v' + b v = F, a line between rows: by quadrature on each of them.
        panels = np.unique(np.concatenate([[0.0], times[times < 0.1], [0.1]]))
        nodes, weights = np.polynomial.legendre.leggauss(8)
        at = panels[:-1, None] + np.diff(panels)[:, None] * (nodes + 1) / 2
        pushed = np.exp(-1.5 * (0.1 - at)) * np.interp(at, times, forces) / 2
        expected = (pushed @ weights * np.diff(panels) / 2).sum()
        assert found.values[-1, 0] == pytest.approx(expected, rel=1e-11, abs=1e-13)
    assert lengths[0] == lengths[1]
