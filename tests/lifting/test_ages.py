"""What is heard with its age, or of the tick before, wherever it is served: against laws played by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from tests.schemes import ByHand, everybody, magnitudes, mean, played
from tests.topologies import compiled, library

# Of the eigenvalues of a matrix of some thirty rows in floats; and of positions after hundreds of ticks.
SAME = 1e-10


Packets = dict[int, Sequence[Any]]


Motion = Sequence[tuple[Any, Any]]


PART = """\
component: Aged
description: A force between copies that knows how old what it heard is.
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


TOPOLOGY = """\
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


def dead(x: Motion, received: Packets) -> Any:
    """Return the force to where the others are by now."""
    return 300 * (x[0][0] - sum(one[0] + one[2] * one[1] for one in received.values()) / len(received))


def each(x: Motion, received: Packets) -> Any:
    """Return the force of springs to each other one, stiffer the older what is known of it is."""
    return sum(300 * (x[0][0] - one[0]) * (1 + one[2] / 0.02) for one in received.values())


def gain(x: Motion, received: Packets) -> Any:
    """Return the force of a spring that is softer the older what is heard is."""
    return 300 / (1 + mean(received, 2) / 0.02) * (x[0][0] - mean(received, 0))


def total(x: Motion, received: Packets) -> Any:
    """Return the force of a spring stiffer by the sum of ages."""
    return 300 * sum(one[2] for one in received.values()) / 0.02 * (x[0][0] - mean(received, 0))


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


def topology(force: str, delay: str, folder: Path, text: str = TOPOLOGY) -> Model:
    return compiled(text.replace("DELAY", delay), library(folder, PART.replace("FORCE", force)))


def by_hand(law: Law, late: int) -> ByHand:
    def forces(_: int, x: Motion, received: Packets, memory: Sequence[Any]) -> Any:
        return [-law(x, received)], memory, []

    return ByHand([[(0.2, 5.0, 0.0)]] * 3, everybody(3), forces, first_sent=0, ratio=4, late=late)


def same(model: Model, hand: ByHand, method: str = "auto") -> None:
    found = apc.analyze(model, method=method)  # type: ignore[arg-type] # one of its methods
    rigid, radius = magnitudes(hand)
    assert found.rigid_modes == rigid
    assert found.spectral_radius == pytest.approx(radius, abs=SAME + found.spectral_radius_error)
    assert found.spectral_radius_error < 1e-9
    assert not found.linearized


@pytest.mark.few(8)
@pytest.mark.parametrize("late", [0, 1, 3, 4, 10])
@pytest.mark.parametrize("force", LAWS)
def test_a_coefficient_of_age_is_its_law_in_every_tick(force: str, late: int, tmp_path: Path) -> None:
    same(topology(force, f"{late} ms", tmp_path), by_hand(LAWS[force], late))


def positions(model: Model, *, jit: bool = False) -> Any:
    run = apc.simulate(model, duration="200 ms", signals=["*.cube.x"], jit=jit)
    return np.array([run[one.name] for one in run.signals]).T


@pytest.mark.few(5)
@pytest.mark.parametrize("late", [0, 3, 10])
@pytest.mark.parametrize("force", LAWS)
def test_a_simulation_is_the_law_played(force: str, late: int, tmp_path: Path) -> None:
    """Before the first packet is there start values are heard, sent at time 0: at rest, so are all."""
    found = positions(topology(force, f"{late} ms", tmp_path))
    law, ticks = LAWS[force], 0

    def forces(i: int, x: Motion, received: Packets, memory: Sequence[Any]) -> Any:
        # By hand, what was there before time 0 has ages of its own: of what was never sent it is the time.
        nonlocal ticks
        now, ticks = ticks // 3 * 1e-3, ticks + 1
        return [-law(x, {j: [*one[:-1], min(one[-1], now)] for j, one in received.items()})], memory, []

    hand = ByHand([[(0.2, 5.0, 0.0)]] * 3, everybody(3), forces, first_sent=0, ratio=4, late=late)
    expected = played(hand, [[(0.001, 0.0)], [(-0.001, 0.0)], [(-0.001, 0.0)]], [[], [], []], len(found))
    assert np.ptp(expected, axis=0).min() > 1e-4
    assert found == pytest.approx(expected, abs=SAME)


BEFORE = {
    "k*(y - mean(previous(others.x)))": lambda now, before: now - sum(before) / 2,
    "k*y - k*previous(mean(others.x))": lambda now, before: now - sum(before) / 2,
    "k*(2*y - sum(2*previous(others.x) - others.x))": None,
}


@pytest.mark.few(3)
@pytest.mark.parametrize("late", [0, 1, 3, 10])
@pytest.mark.parametrize("force", BEFORE)
def test_what_was_heard_before_is_its_law(force: str, late: int, tmp_path: Path) -> None:
    def law(i: int, x: Motion, received: Packets, memory: Sequence[Any]) -> Any:
        now, others = x[0][0], [one[0] for one in received.values()]
        if BEFORE[force] is None:
            pull = 2 * now - sum(2 * old - new for old, new in zip(memory, others, strict=True))
        else:
            pull = now - sum(memory) / 2
        return [-300 * pull], others, []

    hand = ByHand([[(0.2, 5.0, 0.0)]] * 3, everybody(3), law, first_sent=0, memory=2, ratio=4, late=late)
    model = topology(force, f"{late} ms", tmp_path)
    same(model, hand)
    starts = [0.001, -0.001, -0.001]
    memories = [[starts[j] for j in others] for others in everybody(3)]
    found = positions(model)
    expected = played(hand, [[(x, 0.0)] for x in starts], memories, len(found))
    assert found == pytest.approx(expected, abs=SAME)
    if late == 10:
        assert positions(model, jit=True) == pytest.approx(found, abs=1e-15)


def forces(model: Model, *, jit: bool) -> list[Any]:
    """Return what each peer computed at each tick but the last, over k."""
    run = apc.simulate(model, duration="300 ms", signals=["*.it.f"], jit=jit)
    assert len(run.signals) == 3
    return [run[one.name][1:] / 1e-15 for one in run.signals]  # a row holds that of the tick before


@pytest.mark.few(3)
@pytest.mark.parametrize("network", ["loss: 30 %", "jitter: 9 ms", "jitter: 9 ms, reorder: all"])
@pytest.mark.parametrize("jit", [False, True])
def test_a_constant_velocity_is_predicted_whatever_the_network_does(
    network: str, jit: bool, tmp_path: Path
) -> None:
    """x + v a is where a sender is by now, for packets of any age a and the start values of time 0."""
    text = TOPOLOGY.replace("delay: DELAY", f"delay: 10 ms, {network}").replace(
        "damping: 5 N*s/m", "damping: 0 N*s/m"
    )
    text = text.replace("cube.x: 1 mm", "cube.v: 0.3 m/s").replace("cube.x: -1 mm", "cube.v: -0.2 m/s")
    part = PART.replace("FORCE", "k*(y - mean(others.x + age(others.x)*others.v))")
    model = compiled(text, library(tmp_path, part.replace("default: 300", "default: 1e-15")))
    found = forces(model, jit=jit)
    for one, own, others in zip(found, (0.3, -0.2, -0.2), (-0.2, 0.05, 0.05), strict=True):
        assert one.tolist() == pytest.approx([(own - others) * tick * 1e-3 for tick in range(300)], abs=1e-9)


UNLIKE_AGES = """\
topology: t
clocks: {haptic: 1 ms, network: 8 ms}
peers: {a: {count: 1}, b: {count: 1}, c: {count: 1, set: {cube.x: 10 mm}}}
masses: {cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}}
couplers: {coordination: {type: PredictedAverage, object: cube, stiffness: 100 N/m, clock: haptic, link: lan}}
links: {lan: {clock: network, delay: 8 ms, delays: {a: {b: 12 ms}}}}
experiment: {duration: 50 ms}
"""


def test_ages_that_differ_from_sender_to_sender_are_played_and_not_analysed(tmp_path: Path) -> None:
    text = TOPOLOGY.replace("delay: DELAY", "delay: 3 ms, delays: {left: {right: 7 ms}}")
    model = topology("k*(y - mean(others.x + age(others.x)*others.v))", "", tmp_path, text)
    with pytest.raises(ApcError) as refused:
        apc.analyze(model)
    assert str(refused.value).splitlines()[0] == (
        "topology.yaml: E811 the age of samples received by left and right over lan differs "
        "between senders (lan.delay, lan.delays.left.right); different ages can be simulated but not "
        "analyzed. Try: apc simulate"
    )
    assert np.isfinite(positions(model)).all()


def test_a_file_whose_ages_differ_compiles_and_is_simulated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """At first a copy at 10 mm pulls the two others by 100 N/m times half of that."""
    monkeypatch.chdir(tmp_path)
    Path("t.yaml").write_text(UNLIKE_AGES, encoding="utf-8")
    for command in ("check", "compile", "simulate"):
        assert run([command, "t.yaml"]) == 0, capsys.readouterr().err
    played = apc.simulate("t.yaml", duration="2 ms", jit=False)
    assert float(played["a[1].coordination.f"][-1]) == pytest.approx(-0.5, rel=2e-3)
    assert run(["analyze", "t.yaml"]) == 1
    assert "E811" in capsys.readouterr().err


@pytest.mark.needs_extension("event_order")
def test_another_order_of_events_has_its_own_ages(tmp_path: Path) -> None:
    """A tick that misses the packet that arrives with it hears one a period older, as if it were later."""
    found = apc.event_order(topology(next(iter(LAWS)), "4 ms", tmp_path))
    late = by_hand(dead, 4)
    default, missed = (one.spectral_radius for one in found.outcomes[:2])
    assert default == pytest.approx(magnitudes(late)[1], abs=1e-9)
    slightly_later = apc.analyze(topology(next(iter(LAWS)), "4.001 ms", tmp_path))
    assert missed == pytest.approx(slightly_later.spectral_radius, abs=1e-9)
