"""Claims about `frame.ages`, and what is heard with its age or of the tick before, wherever it is served."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.compiler.compiled import CompiledSystem
from tests.schemes import ByHand, everybody, magnitudes, mean, played
from tests.topologies import compiled, library

# Of the eigenvalues of a matrix of some thirty rows in floats; and of positions after hundreds of ticks.
SAME = 1e-10

Packets = dict[int, Sequence[Any]]
Motion = Sequence[tuple[Any, Any]]

PART = """\
component: Aged
about: A force between copies that knows how old what it heard is.
connectors: {object: Flange}
sends: {x: sample(object.x), v: sample(der(object.x))}
parameters:
  k: {unit: N/m, default: 300}
  T: {unit: s, default: 20 ms}
  clock: clock
  link: link
  delay: {unit: s, default: 0}
equations:
  - y = sample(object.x)
  - f = FORCE
  - object.f = hold(f, delay)
"""

SCENE = """\
topology: aged
clocks: {haptic: 1 ms, network: 4 ms}
peers:
  left: {count: 1, set: {cube.x: 1 mm}}
  right: {count: 2, set: {cube.x: -1 mm}}
masses: {cube: {mass: 0.2 kg, damping: 5 N*s/m}}
couplers: {it: {type: Aged, object: cube, clock: haptic, delay: 1 ms, link: lan}}
links: {lan: {clock: network, delay: DELAY}}
"""

Law = Callable[[Motion, Packets], Any]


def dead(x: Motion, heard: Packets) -> Any:
    """Return the force to where the others are by now."""
    return 300 * (x[0][0] - sum(one[0] + one[2] * one[1] for one in heard.values()) / len(heard))


def each(x: Motion, heard: Packets) -> Any:
    """Return the force of springs to each other one, stiffer the older what is known of it is."""
    return sum(300 * (x[0][0] - one[0]) * (1 + one[2] / 0.02) for one in heard.values())


def gain(x: Motion, heard: Packets) -> Any:
    """Return the force of a spring that is softer the older what is heard is."""
    return 300 / (1 + mean(heard, 2) / 0.02) * (x[0][0] - mean(heard, 0))


def total(x: Motion, heard: Packets) -> Any:
    """Return the force of a spring stiffer by the sum of ages."""
    return 300 * sum(one[2] for one in heard.values()) / 0.02 * (x[0][0] - mean(heard, 0))


LAWS: dict[str, Law] = {
    "k*(y - mean(others.x + age(others.x)*others.v))": dead,
    "k*(y - mean(others.x) - mean(others.v*age(others.v)))": dead,
    "sum(k*(y - others.x)*(1 + age(others.x)/T))": each,
    "k/(1 + mean(age(others.x))/T)*(y - mean(others.x))": gain,
    "k*(y - mean(others.x))/(1 + max(age(others.x))/T)": gain,
    "k*sum(age(others.v))/T*(y - mean(others.x))": total,
    "k*sum(min(age(others.v), 1000*T))/T*(y - mean(others.x))": total,
    "k*mean(y/(1 + age(others.x)/T)) - k*mean(others.x/(1 + age(others.x)/T))": gain,
}


def scene(force: str, delay: str, folder: Path, text: str = SCENE) -> CompiledSystem:
    return compiled(text.replace("DELAY", delay), library(folder, PART.replace("FORCE", force)))


def by_hand(law: Law, late: int) -> ByHand:
    def forces(_: int, x: Motion, heard: Packets, memory: Sequence[Any]) -> Any:
        return [-law(x, heard)], memory, []

    return ByHand([[(0.2, 5.0, 0.0)]] * 3, everybody(3), forces, told=0, ratio=4, late=late)


def same(system: CompiledSystem, hand: ByHand, method: str = "auto") -> None:
    found = apc.analyze(system, method=method)  # type: ignore[arg-type] # one of its methods
    rigid, radius = magnitudes(hand)
    assert found.rigid_modes == rigid
    assert found.spectral_radius == pytest.approx(radius, abs=SAME + found.spectral_radius_error)
    assert found.spectral_radius_error < 1e-9
    assert not found.linearized


@pytest.mark.parametrize("late", [0, 1, 3, 4, 10])
@pytest.mark.parametrize("force", LAWS)
def test_a_coefficient_of_age_is_its_law_in_every_tick(force: str, late: int, tmp_path: Path) -> None:
    same(scene(force, f"{late} ms", tmp_path), by_hand(LAWS[force], late))


@pytest.mark.parametrize("force", list(LAWS)[:4])
def test_all_peers_as_one_matrix_are_the_same(force: str, tmp_path: Path) -> None:
    system = scene(force, "5 ms", tmp_path)
    same(system, by_hand(LAWS[force], 5), "dense")
    whole = apc.analyze(system, certify=True)
    assert whole.proof


# ---- in time ----


def positions(system: CompiledSystem, *, jit: bool = False) -> Any:
    run = apc.simulate(system, duration="200 ms", signals=["*.cube.x"], jit=jit)
    return np.array([run[one.name] for one in run.signals]).T


@pytest.mark.parametrize("late", [0, 3, 10])
@pytest.mark.parametrize("force", LAWS)
def test_a_simulation_is_the_law_played(force: str, late: int, tmp_path: Path) -> None:
    """Before the first packet is there start values are heard, sent at time 0: at rest, so are all."""
    found = positions(scene(force, f"{late} ms", tmp_path))
    law, ticks = LAWS[force], 0

    def forces(i: int, x: Motion, heard: Packets, memory: Sequence[Any]) -> Any:
        # By hand, what was there before time 0 has ages of its own: of what was never sent it is the time.
        nonlocal ticks
        now, ticks = ticks // 3 * 1e-3, ticks + 1
        return [-law(x, {j: [*one[:-1], min(one[-1], now)] for j, one in heard.items()})], memory, []

    hand = ByHand([[(0.2, 5.0, 0.0)]] * 3, everybody(3), forces, told=0, ratio=4, late=late)
    expected = played(hand, [[(0.001, 0.0)], [(-0.001, 0.0)], [(-0.001, 0.0)]], [[], [], []], len(found))
    assert np.ptp(expected, axis=0).min() > 1e-4
    assert found == pytest.approx(expected, abs=SAME)


@pytest.mark.parametrize("force", LAWS)
def test_machine_code_does_the_same(force: str, tmp_path: Path) -> None:
    system = scene(force, "3 ms", tmp_path)
    assert positions(system, jit=True) == pytest.approx(positions(system), abs=1e-15)
