"""A flat or steep element counts by what its component declares for linear analyses, and is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import apc
from tests.language.own import component
from tests.topologies import compiled, library, messages_of

# A device of 0.1 kg against a wall that is computed every ms.
WALL = """\
topology: wall
clocks: {{haptic: 1 ms}}
peers: {{user: {{count: 1}}}}
masses:
  device: {{mass: 0.1 kg, damping: {damping}, x: 0.2 mm}}
couplers:{more}
  wall: {{type: VirtualWall, flange: {flange}, stiffness: {stiffness}, clock: haptic, x: 0.2 mm}}
"""
ENCODER = "\n  encoder: {type: EncoderQuantization, flange: device, resolution: 0.05 mm}"
FRICTION = (
    "\n  friction: {type: CoulombViscousFriction, a: device, b: ground, coulomb: 0.5 N, viscous: 0.3 N*s/m,"
    " threshold: 1 mm/s}"
)


def wall(more: str = "", *, stiffness: str = "900 N/m", damping: str = "0.5 N*s/m") -> apc.Model:
    flange = "encoder.measured" if "encoder" in more else "device"
    return compiled(WALL.format(damping=damping, more=more, flange=flange, stiffness=stiffness))


def test_a_wall_behind_an_encoder_is_the_wall_without_it() -> None:
    plain, behind = wall(), wall(ENCODER)
    assert apc.analyze(behind).spectral_radius == pytest.approx(apc.analyze(plain).spectral_radius, abs=1e-14)
    for stiffness, passive in (("990 N/m", True), ("1010 N/m", False)):  # b > K T/2, b = 0.5, T = 1 ms
        found = apc.absolute_stability(wall(ENCODER, stiffness=stiffness))
        assert found.stable is passive
        assert found.linearized
    (line,) = [text for text in apc.analyze(behind).limitations if "encoder" in text]
    assert "measured.x = flange.x" in line
    assert "apc simulate" in line


def test_dry_friction_is_no_viscous_damping() -> None:
    """0.5 N at a threshold of 1 mm/s would be 500 N·s/m."""
    damped = wall(damping="0.8 N*s/m")
    rubbing = wall(FRICTION)
    assert apc.analyze(rubbing).spectral_radius == pytest.approx(
        apc.analyze(damped).spectral_radius, abs=1e-14
    )
    assert apc.absolute_stability(wall(FRICTION, stiffness="1590 N/m")).stable is True  # 2 b/T, b = 0.8 N·s/m
    assert apc.absolute_stability(wall(FRICTION, stiffness="1610 N/m")).stable is False


@pytest.mark.parametrize("hands", ["clamped", "held", "StylusArmForward"])
def test_hands_meet_the_same_replacement(hands: str) -> None:
    with_encoder, without = (apc.with_hands(model, hands) for model in (wall(ENCODER), wall()))
    one, other = apc.analyze(with_encoder), apc.analyze(without)
    assert one.spectral_radius == pytest.approx(other.spectral_radius, abs=1e-13)


def test_a_simulation_sees_whole_steps() -> None:
    """The force of the wall, 45 mN a step of 0.05 mm at 900 N/m, is a whole number of steps."""
    run = apc.simulate(wall(ENCODER), duration=0.05)
    steps = np.asarray(run["user[1].wall.push"]) / (900 * 0.05e-3)
    assert np.allclose(steps, np.round(steps), atol=1e-9)
    assert len(set(np.round(steps))) > 1


@pytest.mark.parametrize(
    ("linearized", "words"),
    [
        ("linearized: f = K*x", "E303"),
        ("linearized: y = K*flange.x", "E303"),
        ("linearized: flange.v = 0", "E303"),
        ("linearized: f = F*flange.x", "E401"),
        ("linearized: {equation: f = 0}", "E202"),
        ("linearized: {equations: f = 0}", "E203"),
        ("linearized: F = f", "E514"),
        ("linearized: []", "E203"),
        ("linearized: {equations: [], valid: all}", "E203"),
        ("linearized: [f = F*flange.x/L, f = F*flange.x/L]", "E514"),
    ],
)
def test_a_replacement_that_does_not_fit_is_refused_at_its_place(
    linearized: str, words: str, tmp_path: Path
) -> None:
    text = component("f = F*tanh(flange.x/L)", "flange.f = f", variables="f=N") + linearized + "\n"
    topology = WALL.format(
        damping="1 N*s/m", flange="device", stiffness="1 N/m", more="\n  own: {type: Own, flange: device}"
    )
    lines = messages_of(compiled, topology, library(tmp_path, text))
    assert any(words in line and "part0.yaml" in line for line in lines), lines


def test_an_equation_that_is_flat_and_has_no_replacement_is_named(tmp_path: Path) -> None:
    text = component("f = K*L*floor(sample(flange.x)/L*10)", "flange.f = hold(f)", variables="f=N")
    topology = WALL.format(
        damping="1 N*s/m",
        flange="device",
        stiffness="1 N/m",
        more="\n  own: {type: Own, flange: device, clock: haptic}",
    )
    found = apc.analyze(compiled(topology, library(tmp_path, text)))
    assert any("own.f is constant between jumps" in line for line in found.limitations)
