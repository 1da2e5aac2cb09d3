"""Claims about `frame.ages`, and what is heard with its age or of the tick before, wherever it is served."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.frame.ages import nominal, stamped
from tests.schemes import ByHand, everybody, magnitudes, mean, played
from tests.topologies import AVERAGE, compiled, library

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


@pytest.mark.few(8)
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


@pytest.mark.few(3)
@pytest.mark.parametrize("force", LAWS)
def test_machine_code_does_the_same(force: str, tmp_path: Path) -> None:
    system = scene(force, "3 ms", tmp_path)
    assert positions(system, jit=True) == pytest.approx(positions(system), abs=1e-15)


# ---- what the tick before heard ----

BEFORE = {
    "k*(y - mean(previous(others.x)))": lambda now, before: now - sum(before) / 2,
    "k*y - k*previous(mean(others.x))": lambda now, before: now - sum(before) / 2,
    "k*(2*y - sum(2*previous(others.x) - others.x))": None,
}


@pytest.mark.few(4)
@pytest.mark.parametrize("late", [0, 1, 3, 10])
@pytest.mark.parametrize("force", BEFORE)
def test_what_was_heard_before_is_its_law(force: str, late: int, tmp_path: Path) -> None:
    def law(i: int, x: Motion, heard: Packets, memory: Sequence[Any]) -> Any:
        now, others = x[0][0], [one[0] for one in heard.values()]
        if BEFORE[force] is None:
            pull = 2 * now - sum(2 * old - new for old, new in zip(memory, others, strict=True))
        else:
            pull = now - sum(memory) / 2
        return [-300 * pull], others, []

    hand = ByHand([[(0.2, 5.0, 0.0)]] * 3, everybody(3), law, told=0, memory=2, ratio=4, late=late)
    system = scene(force, f"{late} ms", tmp_path)
    same(system, hand)
    starts = [0.001, -0.001, -0.001]
    memories = [[starts[j] for j in others] for others in everybody(3)]
    found = positions(system)
    expected = played(hand, [[(x, 0.0)] for x in starts], memories, len(found))
    assert found == pytest.approx(expected, abs=SAME)
    assert positions(system, jit=True) == pytest.approx(found, abs=1e-15)


# ---- networks that are late by chance, and other values ----

DELAYS = [3.0, 9.0, 2.0, float("inf"), 5.0, 14.0, 1.0]  # ms, of one packet after another


def heard_by_hand(tick: int) -> int:
    """Return which packet of a way a tick sees, −1 for none: the one sent last of those that are here."""
    sent = [k for k in range(tick // 4 + 1) if 4 * k + DELAYS[k % len(DELAYS)] <= tick]
    return max(sent, default=-1)


def over_trace(force: str, folder: Path) -> CompiledSystem:
    """Return copies that push each other too little to matter, over recorded delays."""
    rows = ("lost" if one == float("inf") else f"{one}" for one in DELAYS)
    (folder / "d.csv").write_text("\n".join(["delay [ms]", *rows, ""]))
    part = PART.replace("FORCE", force).replace("default: 300", "default: 1e-15")
    part = part.replace("  clock: clock", "  V: {unit: m/s, default: 1}\n  clock: clock")
    text = SCENE.replace("delay: DELAY", f"trace: {folder / 'd.csv'}").replace(
        "damping: 5 N*s/m", "damping: 0 N*s/m"
    )
    return compiled(text.replace("cube.x: 1 mm", "cube.v: 0.3 m/s"), library(folder, part))


def forces(system: CompiledSystem, *, jit: bool) -> list[Any]:
    """Return what each peer computed at each tick but the last, over k."""
    run = apc.simulate(system, duration="300 ms", signals=["*.it.f"], jit=jit)
    assert len(run.signals) == 3
    return [run[one.name][1:] / 1e-15 for one in run.signals]  # a row holds that of the tick before


@pytest.mark.parametrize("jit", [False, True])
def test_an_age_is_right_whatever_happens_to_a_packet(jit: bool, tmp_path: Path) -> None:
    """Before the first packet is there it is that of time 0, of which the start values are."""
    expected = [
        tick * 1e-3 if (packet := heard_by_hand(tick)) < 0 else (tick - 4 * packet) * 1e-3
        for tick in range(300)
    ]
    for found in forces(over_trace("k*V*mean(age(others.x))", tmp_path), jit=jit):
        assert found.tolist() == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("jit", [False, True])
def test_what_was_heard_before_is_what_was_heard_at_the_tick_before(jit: bool, tmp_path: Path) -> None:
    before = forces(over_trace("k*mean(previous(others.x))", tmp_path), jit=jit)
    now = forces(over_trace("k*mean(others.x)", tmp_path), jit=jit)
    for one, other in zip(before, now, strict=True):
        assert one[1:] == pytest.approx(other[:-1], abs=1e-15)
        assert one[0] == other[0], "start values, at both"
    assert np.ptp(now[1]) > 0.01


@pytest.mark.parametrize("network", ["loss: 30 %", "jitter: 9 ms", "jitter: 9 ms, reorder: all"])
@pytest.mark.parametrize("jit", [False, True])
def test_a_constant_velocity_is_predicted_whatever_the_network_does(
    network: str, jit: bool, tmp_path: Path
) -> None:
    """x + v a is where a sender is by now, for packets of any age a and the start values of time 0."""
    text = SCENE.replace("delay: DELAY", f"delay: 10 ms, {network}").replace(
        "damping: 5 N*s/m", "damping: 0 N*s/m"
    )
    text = text.replace("cube.x: 1 mm", "cube.v: 0.3 m/s").replace("cube.x: -1 mm", "cube.v: -0.2 m/s")
    part = PART.replace("FORCE", "k*(y - mean(others.x + age(others.x)*others.v))")
    system = compiled(text, library(tmp_path, part.replace("default: 300", "default: 1e-15")))
    found = forces(system, jit=jit)
    for one, own, others in zip(found, (0.3, -0.2, -0.2), (-0.2, 0.05, 0.05), strict=True):
        assert one.tolist() == pytest.approx([(own - others) * tick * 1e-3 for tick in range(300)], abs=1e-9)


# ---- what is not served, by name ----


def test_ages_that_differ_from_sender_to_sender_are_played_and_not_analysed(tmp_path: Path) -> None:
    text = SCENE.replace("delay: DELAY", "delay: 3 ms, delays: {left: {right: 7 ms}}")
    system = scene("k*(y - mean(others.x + age(others.x)*others.v))", "", tmp_path, text)
    with pytest.raises(ApcError) as refused:
        apc.analyze(system)
    assert str(refused.value).splitlines()[0] == (
        "scene.yaml: E811 the age of what peers of left and right hear over lan differs from sender to "
        "sender (lan.delay, lan.delays.left.right): that is not analysed; a simulation plays it. "
        "Write: apc simulate"
    )
    assert np.isfinite(positions(system)).all()


@pytest.mark.parametrize(
    ("force", "why"),
    [
        (
            "k*(y - mean(others.x + age(others.x)*others.v))",
            "the age of what is heard over lan, which is left to chance and enters the equations",
        ),
        ("k*(y - mean(previous(others.x)))", "what was heard over lan at the tick before"),
    ],
)
def test_mean_squares_are_refused_by_name(force: str, why: str, tmp_path: Path) -> None:
    system = scene(force, "3 ms, loss: 10 %", tmp_path)
    found = apc.judge_network(system)
    assert found is not None
    assert found.verdict == "not judged"
    assert f"not judged: {why}" in found.notes
    assert found.losses_in_a_row is None
    with pytest.raises(ApcError) as refused:
        apc.critical(system, "it.k")
    assert str(refused.value) == (
        f"critical value: E898 the scene can't be judged in mean square: {why}. Write: --in nominal"
    )
    nominal = apc.analyze(system)
    assert nominal.left_out[0].startswith("left out: packet loss (10 %) of lan")


def test_a_stand_in_for_what_was_heard_before_is_refused(tmp_path: Path) -> None:
    system = scene("k*(y - mean(previous(others.x)))", "3 ms, loss: 10 %, on_loss: zero", tmp_path)
    with pytest.raises(ApcError) as refused:
        apc.simulate(system, duration="10 ms")
    assert str(refused.value) == (
        "scene.yaml: E893 mean(previous(others.it.x)): what stood in for a missing value at the tick before "
        "is not kept. Write: on_loss: hold"
    )


# ---- what else is asked of the same scene ----


def test_a_delay_is_searched_with_the_ages_that_it_makes(tmp_path: Path) -> None:
    """Ages are the same between two delays at which a tick finds another packet: there a verdict may jump."""
    system = scene("4*k*(y - mean(others.x + age(others.x)*others.v))", "3 ms", tmp_path)
    found = apc.critical(system, "lan.delay", upper="60 ms")
    (crossing,) = found.crossings
    assert crossing.stable_side == "below"
    for delay, stable in ((crossing.value, True), (crossing.value + 1e-4, False)):
        assert apc.analyze(system, set={"lan.delay": f"{delay:.9g} s"}).stable is stable
    many = apc.analyze_many(system, {"lan.delay": [0.0, 0.003, 0.011]})
    each = [apc.analyze(system, set={"lan.delay": f"{ms} ms"}).spectral_radius for ms in (0, 3, 11)]
    assert many.spectral_radius.tolist() == pytest.approx(each, abs=1e-12)


def test_another_order_of_events_has_its_own_ages(tmp_path: Path) -> None:
    """A tick that misses the packet that arrives with it hears one a period older, as if it were later."""
    found = apc.conventions(scene(next(iter(LAWS)), "4 ms", tmp_path))
    late = by_hand(dead, 4)
    default, missed = (one.spectral_radius for one in found.outcomes[:2])
    assert default == pytest.approx(magnitudes(late)[1], abs=1e-9)
    slightly_later = apc.analyze(scene(next(iter(LAWS)), "4.001 ms", tmp_path))
    assert missed == pytest.approx(slightly_later.spectral_radius, abs=1e-9)


def test_a_scene_that_asks_for_no_age_is_returned_as_it_is() -> None:
    system = compiled(AVERAGE)
    assert nominal(system) is system
    assert stamped(system) is system


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (
            "k*y*age(others.x)/T",
            "E506 age(others.x) of it is a value of each other peer, and one is due here. "
            "Write: mean(age(others.x)), or sum, max, min",
        ),
        (
            "k*previous(others.x)",
            "E506 previous(others.x) of it is a value of each other peer, and one is due here. "
            "Write: mean(previous(others.x)), or sum, max, min",
        ),
        (
            "k*y*age(y)/T",
            "E506 age is of one value that is heard of the others, and wants others.x in it, got age(y). "
            "Write: age(others.x)",
        ),
        (
            "k*y*mean(age(others))/T",
            "E506 age is of one value that is heard of the others, and wants others.x in it, "
            "got age(others). Write: age(others.x)",
        ),
        (
            "k*y*mean(age(2*others.v))/T",
            "E506 age is of one value that is heard of the others, and wants others.v in it, "
            "got age(2*others.v). Write: age(others.v)",
        ),
        ("k*y*mean(age(others.w))", "E303 Aged sends nothing called w. Write: sends: {x: sample(object.x)}"),
        (
            "k*y + k*mean(age(others.x)*others.x)",
            "E401 k*mean(age(others.x)*others.x) wants N like k*y, got N*s.",
        ),
        (
            "k*sum(max(y, previous(others.x)))",
            "E506 previous(others.x) wants a mean or sum that is linear in it. "
            "Write: mean(previous(others.x)), or sum",
        ),
    ],
)
def test_a_misuse_is_told_with_the_line_to_write(force: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ApcError) as refused:
        scene(force, "3 ms", tmp_path)
    (told,) = (one.splitlines()[0] for one in str(refused.value).split("\n/") if message in one)
    assert told.endswith(message)


def test_an_age_in_a_component_without_a_clock_is_told(tmp_path: Path) -> None:
    part = PART.replace("FORCE", "k*mean(age(others.x))*y/T").replace("  clock: clock\n", "")
    part = part.replace("y = sample(object.x)", "y = object.x").replace("hold(f, delay)", "f")
    text = SCENE.replace("clock: haptic, delay: 1 ms", "delay: 1 ms").replace("DELAY", "3 ms")
    with pytest.raises(ApcError) as refused:
        compiled(text, library(tmp_path, part))
    assert (
        "E504 it hears the other peers but has no parameter that names one clock. "
        "Write: parameters: {clock: clock}"
    ) in str(refused.value)
