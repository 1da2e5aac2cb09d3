"""What nothing holds back and what drifts: told exactly, whatever the numbers, and never by a tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import analyze, lifted_groups
from apc.compiler.compiled import ANGLES, CompiledSystem
from apc.compiler.errors import Place
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.units import parse_unit
from apc.eigen.closing import ClosedSystem
from apc.eigen.modes import dense, split
from apc.eigen.rigid import find_rigid_modes
from apc.large.translation import count_translations
from tests.populations import crowded, different
from tests.sites import MS, columned, grouped, paper
from tests.topologies import AVERAGE, compiled, library


def _closed(system: CompiledSystem) -> Sequence[ClosedSystem]:
    return split(*lifted_groups(system)).systems


def _undamped(**values: Any) -> CompiledSystem:
    system = paper(**values)
    return grouped(system, ("user", system.peers, {"device.damping": 0.0, "cube.damping": 0.0}))


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"kt": 0.0, "bt": 0.0}, [1, 1]),  # nothing ties the peers
        ({"kt": 0.0, "bt": 2.0}, [1, 1]),  # a damper holds no position
        ({"kt": 0.0, "bt": 2.0, "kc": 0.0}, [2, 2]),  # device and cube apart
        ({"kt": 1e-300}, [1, 0]),  # the weakest spring holds
        ({"kc": 1e-300}, [1, 0]),
        ({"kc": 0.0}, [2, 1]),
    ],
)
def test_a_stiffness_of_exactly_zero_frees_what_it_held(
    values: dict[str, float], expected: list[int]
) -> None:
    found = [find_rigid_modes(system).directions.shape[1] for system in _closed(paper(**values))]
    assert found == expected


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"kt": 0.0, "bt": 0.0}, [1, 1]),
        ({"kt": 0.0, "bt": 2.0}, [1, 0]),  # apart, the damper brakes
        ({"kt": 0.0, "bt": 2.0, "own_delay": True, "comp": MS}, [1, 0]),
        ({"kt": 0.0, "bt": 2.0, "operator": "sum", "comm": 11 * MS}, [1, 0]),
        ({"kt": 100.0, "bt": 2.0}, [0, 0]),  # the late network brakes, see Facts: K_eff((T_n − T_c)/2 + T_d)
        ({"kt": 0.0, "bt": 0.0, "kc": 0.0}, [2, 2]),
    ],
)
def test_undamped_peers_drift_as_far_as_nothing_brakes_them(
    values: dict[str, Any], expected: list[int]
) -> None:
    for system, drifts in zip(_closed(_undamped(**values)), expected, strict=True):
        rigid = find_rigid_modes(system)
        assert rigid.drifts == drifts
        # A Jordan pair: M w − w lies in the span of the directions and does not vanish.
        for vector in rigid.generalized.T:
            step = system.matrix @ vector - vector
            part = np.linalg.lstsq(rigid.directions, step, rcond=None)[0]
            assert np.abs(rigid.directions @ part - step).max() < 1e-12
            assert np.abs(step).max() > 1e-4


@pytest.mark.few(4)
@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize(
    ("values", "expected"), [({}, 1), ({"kt": 0.0}, 6), ({"kc": 0.0}, 7), ({"kc": 0.0, "kt": 0.0}, 12)]
)
def test_motions_are_counted_as_for_the_whole_matrix(
    operator: str, values: dict[str, float], expected: int
) -> None:
    system = different(6, operator, **values)
    whole = find_rigid_modes(dense(*lifted_groups(system)))
    assert count_translations(*crowded(system)) == expected == whole.directions.shape[1]


def test_a_motion_that_one_peer_does_not_share_is_not_told() -> None:
    contacts = [1000.0] * 5
    free = columned(paper(peers=5), contact__stiffness=[0.0, *contacts[1:]])
    assert count_translations(*crowded(free)) is None


def test_every_verdict_says_what_it_says() -> None:
    assert analyze(paper()).verdict == "stable up to a common translation"
    assert analyze(paper(kc=2500.0)).verdict == "unstable"
    drifting = analyze(_undamped(kt=0.0, bt=2.0, bc=2.0, comp=Fraction(0)))
    assert (drifting.verdict, drifting.stable) == ("drifts", False)
    assert drifting.spectral_radius < 1
    shaking = analyze(_undamped(kt=0.0, bt=0.0, kc=3000.0))
    assert (shaking.verdict, shaking.stable) == ("unstable", False)


WHEEL = """\
component: Wheel
connectors: {a: Flange}
parameters:
  mass: {unit: kg}
  damping: {unit: N*s/m}
  stiffness: {unit: N/m}
  inertia: {unit: kg*m^2}
  turning: {unit: N*m*s}
  twist: {unit: N*m}
  clock: clock
  link: link
sends: {phi: sample(phi)}
variables:
  x: {unit: m, start: 0 m}
  v: {unit: m/s, start: 0 m/s}
  phi: {unit: rad, start: 0}
  w: {unit: rad/s, start: 0 rad/s}
  t: {unit: N*m}
equations:
  - der(x) = v
  - mass*der(v) = a.f - damping*v - stiffness*x
  - der(phi) = w
  - t = twist*(sample(phi) - mean(others.phi))
  - inertia*der(w) = -hold(t) - turning*w
  - a.x = x
"""
WHEELS = """\
topology: wheels
clocks: {haptic: 1 ms, network: 4 ms}
peers: {left: {count: 1}, right: {count: 1, set: {wheel.phi: 0.1}}}
masses:
  wheel: {type: Wheel, mass: 1 kg, damping: 5 N*s/m, stiffness: K, inertia: 0.001 kg*m^2, turning: 0.01 N*m*s,
          twist: TWIST, clock: haptic, link: lan}
links: {lan: {clock: network, delay: 4 ms}}
"""
# What is kept follows what the others keep, and pulls nothing.
KEPT = """\
component: Kept
connectors: {object: Flange}
parameters: {lag: {unit: s, default: 1 s}, clock: clock, link: link}
sends: {s: sample(s)}
variables: {s: {unit: N, start: 1 N}, y: {unit: N, start: 0 N}}
equations:
  - der(s) = (hold(y) - s)/lag
  - y = mean(others.s)
  - object.f = 0*s
"""


def _wheels(folder: Path, twist: str, stiffness: str = "0 N/m") -> CompiledSystem:
    return compiled(WHEELS.replace("TWIST", twist).replace("K,", f"{stiffness},"), library(folder, WHEEL))


@pytest.mark.parametrize("unit", ["rad", "deg", "turn", "1"])
def test_an_angle_is_known_by_its_unit_as_models_have_it(unit: str) -> None:
    assert format_dimension(parse_unit(unit, Place("a test")).dimension) in ANGLES


def test_what_turns_freely_is_a_rotation_and_what_shifts_freely_a_translation(tmp_path: Path) -> None:
    free = analyze(_wheels(tmp_path, "0.1 N*m"))
    assert (free.translations, free.rotations, free.unfelt) == (2, 1, ())
    assert "2 translations and 1 rotation left out" in str(free)
    assert "3 motions are held back by nothing" in str(free)
    held = analyze(_wheels(tmp_path, "0.1 N*m", "300 N/m"))
    assert (held.verdict, held.translations, held.rotations) == ("stable up to a common rotation", 0, 1)
    assert "turned together" in str(held)


def test_what_is_left_out_though_some_of_it_moves_in_modes_is_a_common_shift(tmp_path: Path) -> None:
    text = AVERAGE.replace("links:", "  kept: {type: Kept, object: cube, clock: haptic, link: lan}\nlinks:")
    found = analyze(compiled(text, library(tmp_path, KEPT)))
    assert found.unfelt == ("the common shift of kept.s, kept.s sent",)
    assert any(share[0].startswith("kept.s") for mode in found.modes for share in mode.participation)
    assert "the common shift of kept.s" in str(found)
