"""Forces that change with time, in balls: against integrals in closed form."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import mpmath
import numpy as np
import pytest

from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.eigen.balls import precision
from apc.simulation.blocks import blocks
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from tests.fifty_digits.events import refusal
from tests.fifty_digits.truth import Truth, exact_course, spectral_truth
from tests.topologies import SCENES, compiled, library

MASS, DAMPING = 0.25, 2.0  # kg, N·s/m: numbers of a few bits, so that text and closed form mean the same

SCENE = """
topology: pushed
clocks: {haptic: 4 ms}
peers: {user: {count: 1, set: {device.x: 0.5 m, device.v: 0.125 m/s}}}
masses:
  device: {mass: 0.25 kg, damping: 2 N*s/m}
couplers:
  idle: {type: SampledSpringDamper, a: device, b: ground, stiffness: 0 N/m, clock: haptic}
hands:
  push: {flange: device, PUSH}
"""


def pushed(push: str, folder: Path) -> CompiledSystem:
    """Compile the scene with a force, the files it names in a folder."""
    path = folder / "pushed.yaml"
    path.write_text(SCENE.replace("PUSH", push), encoding="utf-8")
    return compile_topology(path)


def by_quadrature(force: Callable[[Any], Any], edges: list[float], end: Fraction) -> tuple[Any, Any]:
    """Return x and v of the damped mass at `end`, from the convolution with its response to a force."""
    with mpmath.workdps(40):
        t, rate = mpmath.mpf(end.numerator) / end.denominator, mpmath.mpf(DAMPING) / MASS
        panels = sorted({mpmath.mpf(0), t, *(mpmath.mpf(e) for e in edges if e < t)})
        fading = lambda s: mpmath.exp(-rate * (t - s))  # noqa: E731 -- a name for a formula
        v = mpmath.mpf("0.125") * fading(0) + mpmath.quad(lambda s: force(s) * fading(s), panels) / MASS
        x = mpmath.mpf("0.5") + mpmath.mpf("0.125") * (1 - fading(0)) / rate
        x += mpmath.quad(lambda s: force(s) * (1 - fading(s)), panels) / DAMPING
        return x, v


TABLE = "time [s],force [N]\n0.0,0\n0.0625,2\n0.078125,-1\n0.125,-1\n"
PUSHES: dict[str, tuple[str, Callable[[Any], Any], list[float]]] = {
    "a step between two ticks": (
        "type: StepForce, force: 3 N, start: 0.03125 s",
        lambda t: 3 * (t > mpmath.mpf("0.03125")),
        [0.03125],
    ),
    "a ramp with both corners between ticks": (
        "type: RampForce, force: 2 N, start: 0.015625 s, rise: 0.0625 s",
        lambda t: (
            2 * min(mpmath.mpf(1), max(mpmath.mpf(0), (t - mpmath.mpf("0.015625")) / mpmath.mpf("0.0625")))
        ),
        [0.015625, 0.078125],
    ),
    "a sine": (
        "type: SineForce, force: 2 N, frequency: 8 Hz, phase: 0.5 rad",
        lambda t: 2 * mpmath.sin(2 * mpmath.mpf(3.141592653589793) * 8 * t + mpmath.mpf("0.5")),
        [],
    ),
    "a sine of many turns a tick": (
        "type: SineForce, force: 2 N, frequency: 512 Hz",
        lambda t: 2 * mpmath.sin(2 * mpmath.mpf(3.141592653589793) * 512 * t),
        [k / 512 for k in range(1, 9)],
    ),
    "a table": (
        "type: TableForce, force: push.csv",
        lambda t: mpmath.mpf(
            2 * t * 16 if t < 0.0625 else 2 - 192 * (t - mpmath.mpf("0.0625")) if t < 0.078125 else -1
        ),
        [0.0625, 0.078125, 0.125],
    ),
}


@pytest.mark.parametrize("what", PUSHES)
def test_a_force_of_time_moves_a_mass_as_its_integral_says(what: str, tmp_path: Path) -> None:
    words, force, edges = PUSHES[what]
    (tmp_path / "push.csv").write_text(TABLE, encoding="utf-8")
    end = Fraction(2, 125) if "turns" in what else Fraction(1, 10)
    found = exact_course(pushed(words, tmp_path), end)
    assert not isinstance(found, str), found
    names, rows = found
    assert names == ("user[1].device.x", "user[1].device.v")
    for row in (0, 2, 4, len(rows) - 1):
        expected = [float(value) for value in by_quadrature(force, edges, Fraction(row, 250))]
        np.testing.assert_array_max_ulp(rows[row], np.array(expected), maxulp=1)


def test_the_scene_whose_force_grows_is_followed_and_the_default_is_exact_on_it() -> None:
    """Two roads: balls from tick to tick, and the simulation's rules of Gauss and Legendre."""
    system = compile_topology(SCENES / "finger.yaml")
    followed = exact_course(system, Fraction(1, 10))
    assert not isinstance(followed, str), followed
    names, rows = followed
    ready = prepare(system, Settings(Fraction(1, 10)), signals=names)
    assert ready.how == "exact"
    assert tuple(signal.name for signal in ready.signals) == names
    played = np.concatenate([block.values for block in blocks(ready)])
    assert np.all(np.abs(played - rows).max(axis=0) <= 1e-13 * np.abs(rows).max(axis=0))


def test_a_scene_in_which_nothing_ticks_is_followed(tmp_path: Path) -> None:
    scene = SCENE.replace("clocks: {haptic: 4 ms}\n", "").replace("PUSH", PUSHES["a sine"][0])
    head, _, rest = scene.partition("couplers:")
    path = tmp_path / "still.yaml"
    path.write_text(head + "hands:" + rest.partition("hands:")[2], encoding="utf-8")
    found = exact_course(compile_topology(path), Fraction(1, 20))
    assert not isinstance(found, str), found
    expected = [float(value) for value in by_quadrature(PUSHES["a sine"][1], [], Fraction(1, 20))]
    np.testing.assert_array_max_ulp(found[1][50], np.array(expected), maxulp=1)


def test_what_is_pushed_has_the_eigenvalue_of_what_is_not(tmp_path: Path) -> None:
    """e^(−b T/m) of a tick: the functions of time are no matter of stability."""
    found = spectral_truth(pushed(PUSHES["a sine"][0], tmp_path))
    assert isinstance(found, Truth)
    with precision(600):
        expected = (flint.arb(-DAMPING) * flint.arb(flint.fmpq(1, 250)) / flint.arb(MASS)).exp()
        assert float(abs(found.radius - expected)) < 1e-50


COMPONENT = (
    "component: Own\nabout: Pushes.\nconnectors: {flange: Flange}\nparameters:\n"
    "  f: {unit: N, default: 1 N}\n  k: {unit: N/m, default: 1 N/m}\n  w: {unit: rad/s, default: 1 rad/s}\n"
    "  T: {unit: s, default: 1 s}\nequations:\n  - flange.f = "
)


@pytest.mark.parametrize(
    ("force", "reason"),
    [
        ("f*abs(sin(w*time))", "a force on user switches by what is not linear in time"),
        ("f*(time/T)**2.5", "a force on user holds a power that is not whole, or a step"),
        ("k*flange.x*time/T", "between its ticks user is not linear"),
    ],
)
def test_a_force_that_cannot_be_followed_says_why(tmp_path: Path, force: str, reason: str) -> None:
    own = library(tmp_path, COMPONENT + force + "\n")
    system = compiled(SCENE.replace("PUSH", "type: Own"), own)
    assert refusal(system, in_time=True) == reason
    if "linear in time" in reason:
        assert refusal(system, in_time=False) == ""
