"""Random scenes of `tests.bench.sensitivity_truth`, and scenes that are hard for a derivative."""

from __future__ import annotations

import random
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest

from apc.analysis.analysis import analyze
from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.frame.names import Free, find
from apc.frame.overrides import Override, apply, parse_override
from apc.vary.sensitivity import sensitivities
from tests.bench.sensitivity_truth import check_frequencies, check_sensitivities, run, scene
from tests.topologies import MESH, SCENES, compiled, library, replaced

NAMES = sorted(path.stem for path in SCENES.glob("*.yaml") if path.stem != "template")

CONTINUOUS_PI = """\
component: ContinuousPi
connectors: {a: Flange, b: Flange}
parameters: {kp: {unit: N/m}, ki: {unit: N/(m*s)}, leak: {unit: 1/s}}
variables: {i: {unit: m*s, start: 0 m*s}}
equations:
  - der(i) = a.x - b.x - leak*i
  - a.f = kp*(a.x - b.x) + ki*i
  - b.f = -a.f
"""
FILTER = """\
component: Filter
connectors: {a: Flange, b: Flange}
parameters: {gain: {unit: N/m}, a1: {unit: 1}, b0: {unit: 1}, clock: clock}
variables: {y: {unit: m, start: 0 m}, f: {unit: N}}
equations:
  - y = a1*previous(y) + b0*(sample(a.x) - sample(b.x))
  - f = gain*y
  - a.f = hold(f)
  - b.f = -a.f
"""
INTEGRATORS = """\
topology: integrators
clocks: {h0: 0.5 ms, h1: {period: 0.5 ms, phase: 0.45 ms}, net: {period: 3.5 ms, phase: 0.3 ms}}
peers:
  left: {count: 1, set: {cube.mass: 0.179 kg, coord.clock: h1}}
  right: {count: 2}
masses:
  device: {mass: 0.0352 kg, damping: 0.38 N*s/m}
  cube: {mass: 0.087 kg, damping: 0.846 N*s/m}
couplers:
  c: {type: ContinuousPi, a: device, b: cube, kp: 1490 N/m, ki: 10.5 N/(m*s), leak: 0 Hz}
  e: {type: Filter, at: [left], a: cube, b: ground, gain: 170 N/m, a1: -0.367, b0: 0.638, clock: h1}
  coord: {type: SaturatedMesh, object: cube, stiffness: 14.9 N/m, clock: h0, delay: 2 ms, link: l, limit: 2 N}
links:
  l: {clock: net, delay: 7 ms, delays: {right: {right: 0 s}}}
"""


def shipped(name: str) -> CompiledSystem:
    return compile_topology(SCENES / f"{name}.yaml")


@pytest.mark.few(1)
@pytest.mark.parametrize("seed", [3, 5])
def test_every_derivative_and_frequency_is_right_within_its_error(seed: int) -> None:
    assert run(3, seed=seed) == []


def test_what_is_wrong_is_seen() -> None:
    system = compiled(MESH)
    found = sensitivities(system)
    assert check_sensitivities(system, found) == ""
    first = replace(found.rows[0], derivative=found.rows[0].derivative + 2 * found.rows[0].error)
    assert "truth" in check_sensitivities(system, replace(found, rows=(first,)))
    analysis = analyze(system)
    assert check_frequencies(system, analysis) == ""
    (motion,) = analysis.modes[0].motion
    folded = replace(analysis.modes[0], motion=(replace(motion, frequency_hz=125 - motion.frequency_hz),))
    assert "Hz, truth" in check_frequencies(system, replace(analysis, modes=(folded,)))


def test_a_scene_linearized_at_its_start_states_errors_that_hold(tmp_path: Path) -> None:
    """Inside of its limits a saturated mesh is a mesh: the truth is that of the linear scene."""
    parts = library(tmp_path, CONTINUOUS_PI, FILTER)
    system = compiled(INTEGRATORS, parts)
    same = compiled(replaced(INTEGRATORS, ("SaturatedMesh", "FullMesh"), (", limit: 2 N", "")), parts)
    found = sensitivities(system)
    rows = tuple(row for row in found.rows if not row.parameter.endswith("limit"))
    assert check_sensitivities(system, replace(found, rows=rows), like=same) == ""
    # What moves the radius is told, and what can't be told from nothing is not.
    shown = [line.split()[0] for line in str(found).splitlines()[1:-1]]
    assert shown == ["c.kp", "c.ki"]


def changed_by_a_percent(system: CompiledSystem, every: int = 1) -> str:
    """Set the parameter of every so many rows 1 ‰ off, as `--set` does; compare the radius with its row."""
    found = sensitivities(system)
    radius = analyze(system).spectral_radius
    for name in [*dict.fromkeys(row.parameter for row in found.rows)][::every]:
        rows = [row for row in found.rows if row.parameter == name]
        if not rows[0].value:
            continue
        free = find(system, name)
        unit = "" if rows[0].unit == "1" else f" {rows[0].unit}"
        sides = []
        for share in (Fraction(-1, 1000), Fraction(1, 1000)):
            text = f"{name}={rows[0].value * (1 + float(share))!r}{unit}"
            override = parse_override(system, text)
            assert override.free == free
            sides.append(analyze(apply(system, [override])).spectral_radius)
        said = [row.relative for row in rows]
        # The largest of those that share the radius decides on either side.
        up, down = (sides[1] - radius) / 1e-3, (radius - sides[0]) / 1e-3
        middle = (up + down) / 2
        if len(found.active) > 1:
            off = max(abs(up - max(said)), abs(down - min(said)))
        else:
            off = abs(middle - said[0])
        if not off <= 2e-3 * max(map(abs, said)) + 2e-6 + abs(up - down):
            return f"{name}: {said}, but {down} and {up}"
    return ""


@pytest.mark.few(len(NAMES))
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("every", [3, 1])
def test_a_row_says_what_setting_its_name_does(name: str, every: int) -> None:
    assert changed_by_a_percent(shipped(name), every) == ""


def test_a_row_says_what_setting_its_name_does_on_random_scenes() -> None:
    generator = random.Random(17)
    for _ in range(3):
        text = scene(generator)
        assert changed_by_a_percent(compiled(text)) == "", text


def test_a_name_is_a_group_s_where_the_groups_differ() -> None:
    text = replaced(
        MESH,
        ("  user: {count: 3}", "  a: {count: 2}\n  b: {count: 1, set: {contact.stiffness: 300 N/m}}"),
    )
    names = {row.parameter for row in sensitivities(compiled(text)).rows}
    assert {"a.contact.stiffness", "b.contact.stiffness", "device.mass"} <= names
    assert not names & {"contact.stiffness", "a.device.mass"}


def test_the_number_of_peers_heard_is_no_parameter() -> None:
    found = sensitivities(compiled(MESH))
    assert not any("count" in row.parameter for row in found.rows)
    # It is that of the motion that decides, per percent: of a mesh, whose count makes it a mesh.
    rows = {row.parameter: row.relative / 100 for row in found.rows}
    assert rows["device.mass"] == pytest.approx(1.11e-3, rel=5e-3)
    assert rows["device.damping"] == pytest.approx(-7.98e-4, rel=1e-3)


def test_what_would_move_a_motion_left_out_is_named_and_not_differentiated(tmp_path: Path) -> None:
    """An integrator nobody reads stands still where its leak is 1, and nowhere else."""
    part = """\
component: Integrator
connectors: {a: Flange}
parameters: {kp: {unit: N/m}, ki: {unit: N/m}, leak: {unit: 1}, clock: clock}
variables: {s: {unit: m, start: 0 m}, f: {unit: N}}
equations:
  - s = leak*previous(s) + sample(a.x)
  - f = kp*sample(a.x) + ki*s
  - a.f = hold(f)
"""
    text = """\
topology: unread
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
couplers:
  p: {type: Integrator, a: device, kp: 100 N/m, ki: 0 N/m, leak: 1, clock: haptic}
"""
    system = compiled(text, library(tmp_path, part))
    found = sensitivities(system)
    assert found.note == "p.ki, p.leak would move what was left out, and are not among these"
    assert {row.parameter for row in found.rows} == {"device.mass", "device.damping", "p.kp"}
    assert check_sensitivities(system, found) == ""
    analysis = analyze(system)
    assert (analysis.verdict, analysis.rigid_modes, analysis.translations) == ("stable", 1, 0)
    assert analysis.unfelt == ("p.s",)
    assert "Nothing ties" not in str(analysis)
    # Without the spring the device translates, and the integrator adds up where to: no drift.
    loose = analyze(apply(system, [Override(Free("p.kp"), Fraction(0))]))
    assert (loose.verdict, loose.stable, loose.translations) == ("stable up to a common translation", True, 1)
    felt = analyze(apply(system, [Override(Free("p.ki"), Fraction(1))]))
    assert (felt.rigid_modes, felt.unfelt) == (0, ())


UNCLOCKED = """\
topology: unclocked
peers: {user: {count: 2}}
masses:
  device: {mass: MASS kg, damping: DAMPING N*s/m}
  cube: {mass: COPY kg, damping: BRAKE N*s/m, shared: true}
couplers:
  spring: {type: SpringDamper, a: device, b: cube, stiffness: SPRING N/m, damping: DAMPER N*s/m}
"""


@pytest.mark.parametrize(
    "numbers",
    [
        ("0.012024990784370273", "0.0021282909", "2.024910856889678", "0.040052959", "88.04437", "63.6466"),
        ("0.017405540793130555", "3.17138972e-6", "0.0118822421", "2.86345e-5", "0.74912642", "1.096408"),
        ("0.0012563506329556732", "0.0011384141", "0.01866965", "0.0101767", "0", "11.29332081"),
    ],
)
def test_a_derivative_is_within_its_error_where_a_step_is_long_beside_what_dies_out(
    numbers: tuple[str, ...],
) -> None:
    """A frame of 1 s, in which masses on a stiff damper settle 10³ to 10⁴ times over."""
    names = ("MASS", "DAMPING", "COPY", "BRAKE", "SPRING", "DAMPER")
    system = compiled(replaced(UNCLOCKED, *zip(names, numbers, strict=True)))
    assert check_sensitivities(system, sensitivities(system)) == ""
