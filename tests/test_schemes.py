"""The schemes of the library beside each other's networks: against a frame played tick by tick by hand.

Each law stands here as its source has it; the matrix of a frame, and its eigenvalues, are the test's own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import casadi
import pytest

import apc
from apc.analysis.methods import Method
from apc.comparison.comparison import compare
from apc.compiler.compiled import CompiledSystem
from tests.schemes import ByHand, everybody, magnitudes, mean
from tests.topologies import AVERAGE, SCENES, compiled, replaced

# Of the eigenvalues of a matrix of some forty rows in floats.
SAME = 1e-10

DEVICE, CUBE = (0.1, 5.0, 0.0), (0.3, 5.0, 0.0)
Packets = dict[int, Sequence[Any]]


def scene(name: str) -> str:
    return (SCENES / f"{name}.yaml").read_text(encoding="utf-8")


def contact(x: Sequence[tuple[Any, Any]], stiffness: float = 1000.0, damping: float = 0.0) -> Any:
    """Return the force of a spring and damper from body 0 on body 1."""
    return stiffness * (x[0][0] - x[1][0]) + damping * (x[0][1] - x[1][1])


def same(system: CompiledSystem, scheme: ByHand, method: Method = "auto") -> None:
    found = apc.analyze(system, method=method)
    rigid, radius = magnitudes(scheme)
    assert found.rigid_modes == rigid
    assert found.spectral_radius == pytest.approx(radius, abs=SAME + found.spectral_radius_error)
    assert found.spectral_radius_error < 1e-5
    assert found.stable == (radius < 1)


def test_the_harness_plays_the_papers_scene() -> None:
    """Three users with average coordination: here, by `tests.bruteforce` and by `apc.analyze` alike."""

    def law(_: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        push, pull = contact(x), 500 * (x[1][0] - mean(heard, 0))
        return [-push, push - pull], memory, []

    same(compiled(AVERAGE), ByHand([[DEVICE, (0.2, 5.0, 0.0)]] * 3, everybody(3), law, told=1))


# ---- injected damping, prediction ----


@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
@pytest.mark.parametrize(("stiffness", "injection"), [(500.0, 5.0), (2000.0, 0.0), (200.0, 40.0)])
def test_damped_average_is_its_law(delay: int, stiffness: float, injection: float) -> None:
    def law(_: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        push = contact(x)
        pull = stiffness * (x[1][0] - mean(heard, 0)) + injection * x[1][1]
        return [-push, push - pull], memory, []

    text = replaced(
        scene("two-users-damped"),
        (
            "stiffness: 500 N/m, injection: 5 N*s/m",
            f"stiffness: {stiffness} N/m, injection: {injection} N*s/m",
        ),
        ("delay: 8 ms", f"delay: {delay} ms"),
    )
    same(compiled(text), ByHand([[DEVICE, CUBE]] * 2, everybody(2), law, told=1, late=delay))


@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
@pytest.mark.parametrize("age", [None, 0, 12, 40])
def test_predicted_average_is_its_law(delay: int, age: int | None) -> None:
    """By the age of each packet at each tick, or by a number."""

    def law(_: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        push = contact(x)
        ahead = mean(heard, 0) + (mean(heard, 2) if age is None else age * 1e-3) * mean(heard, 1)
        pull = 500 * (x[1][0] - ahead) + 2 * (x[1][1] - mean(heard, 1))
        return [-push, push - pull], memory, []

    text = replaced(
        scene("three-users-predicted"),
        (
            "damping: 2 N*s/m,",
            f"damping: 2 N*s/m,{'' if age is None else f' ages: assumed, assumed: {age} ms,'}",
        ),
        ("delay: 8 ms", f"delay: {delay} ms"),
    )
    same(compiled(text), ByHand([[DEVICE, (0.2, 5.0, 0.0)]] * 3, everybody(3), law, told=1, late=delay))


@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
@pytest.mark.parametrize("ratio", [2, 5, 8])
def test_reported_average_is_a_mean_begun_anew_at_each_packet(ratio: int, delay: int) -> None:
    """By hand the sum starts from nothing at each packet, and is told over how many ticks there are."""
    calls = itertools.count()

    def law(_: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        begins = next(calls) // 2 % ratio == 0  # each tick asks both peers
        total = x[1][0] + (0 if begins else memory[0])
        push, pull = contact(x), 500 * (x[1][0] - mean(heard, 2)) + 5 * x[1][1]
        return [-push, push - pull], [total], [total / ratio]

    text = replaced(
        scene("two-users-reported"),
        ("network: 8 ms", f"network: {ratio} ms"),
        ("delay: 8 ms", f"delay: {delay} ms"),
    )
    hand = ByHand([[DEVICE, CUBE]] * 2, everybody(2), law, told=1, memory=1, out=1, ratio=ratio, late=delay)
    same(compiled(text), hand)


def test_a_prediction_of_age_nought_is_the_average() -> None:
    text = replaced(scene("three-users-predicted"), ("2 N*s/m,", "2 N*s/m, ages: assumed,"))
    average = replaced(text, ("PredictedAverage", "AveragePosition"), (" ages: assumed,", ""))
    found, expected = apc.analyze(compiled(text)), apc.analyze(compiled(average))
    assert found.spectral_radius == pytest.approx(expected.spectral_radius, abs=1e-12)


@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
@pytest.mark.parametrize("injection", [1.0, 5.0, 40.0])
def test_scheduled_average_is_its_law(delay: int, injection: float) -> None:
    """K = min(500 N/m, B/age) at each tick."""

    def law(_: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        push, oldest = contact(x), max(packet[2] for packet in heard.values())
        gain = injection / oldest if 500 * oldest > injection else 500
        pull = gain * (x[1][0] - mean(heard, 0)) + injection * x[1][1]
        return [-push, push - pull], memory, []

    text = replaced(
        scene("three-users-scheduled"),
        ("injection: 5 N*s/m, clock", f"injection: {injection} N*s/m, clock"),
        ("delay: 8 ms", f"delay: {delay} ms"),
    )
    hand = ByHand([[DEVICE, (0.2, 5.0, 0.0)]] * 3, everybody(3), law, told=1, late=delay)
    same(compiled(text), hand)


@pytest.mark.parametrize("delay", [8, 50, 200, 1000])
def test_a_scheduled_stiffness_makes_any_delay_passive(delay: int) -> None:
    """With B = K·age at every tick Re Z ≥ 0: stable where DampedAverage, of the same numbers, need not be."""
    text = f"""\
topology: two-copies
clocks: {{haptic: 1 ms, network: 8 ms}}
peers: {{user: {{count: 2}}}}
masses: {{cube: {{mass: 0.2 kg}}}}
couplers:
  it:
    {{type: ScheduledAverage, object: cube, stiffness: 2000 N/m, injection: 5 N*s/m, clock: haptic,
      link: lan}}
links: {{lan: {{clock: network, delay: {delay} ms}}}}
"""
    assert apc.analyze(compiled(text)).stable
    assert not apc.analyze(compiled(replaced(text, ("Scheduled", "Damped")))).stable


@pytest.mark.parametrize("late", [8, 24, 48])
def test_injected_damping_of_stiffness_by_delay_makes_it_passive(late: int) -> None:
    """Two copies apart from each other: Z = m s + B + K (1 + e^(−sT))/s, Re Z = B − K sin(ωT)/ω ≥ B − K T.

    Sampling and holding, packets of 8 ms and forces of 1 ms, add less than 10 ms to the delay. So with
    B = K (T + 10 ms) it is stable, whatever the mass; with B = K T/4 it isn't, for the mass at which Im Z is
    0 where ωT = π/2: m ω = K/ω.
    """
    stiffness, delay = 200.0, late * 1e-3
    text = f"""\
topology: two-copies
clocks: {{haptic: 1 ms, network: 8 ms}}
peers: {{user: {{count: 2}}}}
masses: {{cube: {{mass: 1 kg}}}}
couplers:
  it:
    {{type: DampedAverage, object: cube, stiffness: {stiffness} N/m, injection: 1 N*s/m, clock: haptic,
      link: lan}}
links: {{lan: {{clock: network, delay: {late} ms}}}}
"""
    system = compiled(text)
    mass = stiffness * (2 * delay / math.pi) ** 2
    for factor in (1.0, 3.0, 30.0):
        enough = {"cube.mass": f"{factor * mass} kg", "it.injection": f"{stiffness * (delay + 0.01)} N*s/m"}
        assert apc.analyze(system, set=enough).stable
    little = {"cube.mass": f"{mass} kg", "it.injection": f"{stiffness * delay / 4} N*s/m"}
    assert apc.analyze(system, set=little).stable is False


# ---- waves ----


def waves(
    *,
    stiffness: float = 500.0,
    damping: float = 5.0,
    impedance: float = 10.0,
    correction: float = 0.0,
    cutoff: float | None = None,
) -> Any:
    """Return the law of wave variables: f = K (x − p) + B (x' − v) with v = (√(2b) w + f)/b + c (x_2 − p)."""

    def law(_: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        p, *filtered = memory
        wave = mean(heard, 2)
        if cutoff is not None:
            wave = filtered[0] + cutoff * 1e-3 / (1 + cutoff * 1e-3) * (wave - filtered[0])
        push = contact(x)
        moved = math.sqrt(2 / impedance) * wave + correction * (mean(heard, 0) - p)
        # f = K (x − p − T v) + B (x' − v) with v = moved + f/b, solved for f.
        give = stiffness * 1e-3 + damping
        f = (stiffness * (x[1][0] - p) + damping * x[1][1] - give * moved) / (1 + give / impedance)
        v = moved + f / impedance
        out = (impedance * v + f) / math.sqrt(2 * impedance)
        stand = p + 1e-3 * v
        kept = [stand] if cutoff is None else [stand, wave]
        return [-push, push - f], kept, [out]

    return law


@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
@pytest.mark.parametrize("correction", [0.0, 2.0])
def test_wave_coupling_is_its_law(delay: int, correction: float) -> None:
    """Two motions are rigid without correction: positions drift, as waves carry velocities alone."""
    text = replaced(
        scene("two-users-waves"),
        ("delay: 8 ms", f"delay: {delay} ms"),
        ("impedance: 10 N*s/m", f"impedance: 10 N*s/m, correction: {correction} 1/s"),
    )
    scheme = ByHand(
        [[DEVICE, CUBE]] * 2, everybody(2), waves(correction=correction), told=1, memory=1, out=1, late=delay
    )
    assert magnitudes(scheme)[0] == (1 if correction else 2)
    same(compiled(text), scheme)


@pytest.mark.parametrize("delay", [0, 8, 50])
@pytest.mark.parametrize(("cutoff", "correction"), [(60.0, 2.0), (5.0, 0.5), (2000.0, 2.0)])
def test_filtered_waves_are_their_law(delay: int, cutoff: float, correction: float) -> None:
    text = replaced(
        scene("two-users-filtered-waves"),
        ("delay: 8 ms", f"delay: {delay} ms"),
        ("cutoff: 60 1/s, correction: 2 1/s", f"cutoff: {cutoff} 1/s, correction: {correction} 1/s"),
    )
    law = waves(correction=correction, cutoff=cutoff)
    scheme = ByHand([[DEVICE, CUBE]] * 2, everybody(2), law, told=1, memory=2, out=1, late=delay)
    same(compiled(text), scheme)


@pytest.mark.parametrize("impedance", [0.3, 10.0, 400.0])
def test_power_into_the_line_is_half_the_outgoing_square_less_half_the_incoming(impedance: float) -> None:
    """(u² − w²)/2 = f v, whatever the copy does and whatever is heard; both waves come times √(2b)."""
    text = replaced(scene("two-users-waves"), ("impedance: 10 N*s/m", f"impedance: {impedance} N*s/m"))
    system = compiled(text)
    (kind,) = system.kinds
    (clock,) = kind.clocks
    value = {parameter.name: parameter.value for parameter in system.parameters}
    states = [state.name for state in kind.states]
    for heard, place, speed, point in (
        (0.7, 0.02, -0.3, 0.01),
        (-2.0, -0.1, 0.0, 0.3),
        (0.0, 0.05, 1.0, 0.0),
    ):
        x = [{"cube.x": place, "cube.v": speed}.get(name, 0.0) for name in states]
        r = [heard if one.name.endswith("wave)") else 0.0 for one in clock.receives]
        p = [value[name] for name in kind.parameters]
        y = clock.tick(x, [0.0] * len(kind.holds), [point], r, p, 0)
        found = dict(zip(clock.outputs, casadi.DM(y).full().ravel().tolist(), strict=True))
        f, out = found["coordination.f"], found["coordination.out"]
        v = (found["coordination.p"] - point) / 1e-3
        assert (out**2 - heard**2) / (4 * impedance) == pytest.approx(f * v, rel=1e-9, abs=1e-12)
        assert f == pytest.approx(500 * (place - found["coordination.p"]) + 5 * (speed - v), rel=1e-9)


@pytest.mark.parametrize("delay", [0, 10, 50, 200])
def test_waves_are_stable_for_any_constant_delay(delay: int) -> None:
    """Sent as continuously as forces are computed, they are passive at both ends; a spring alone is not."""
    every_tick = ("network: 8 ms", "network: 1 ms")
    text = replaced(scene("two-users-waves"), every_tick, ("delay: 8 ms", f"delay: {delay} ms"))
    assert apc.analyze(compiled(text)).stable
    stiff = replaced(
        scene("two-users-damped"),
        every_tick,
        ("delay: 8 ms", f"delay: {delay} ms"),
        ("injection: 5 N*s/m", "injection: 0 N*s/m"),
        ("stiffness: 500 N/m", "stiffness: 1500 N/m"),
    )
    assert apc.analyze(compiled(stiff)).stable is (delay == 0)


# ---- client and server ----


@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
def test_served_object_is_its_law(delay: int) -> None:
    """The server, peer 0, has the object alone; what clients computed and held arrives with their packets."""

    def law(i: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        if i == 0:
            added = sum(packet[2] for packet in heard.values())
            return [added], memory, [0 * added]
        push = contact([x[1], x[0]])
        (server,) = heard.values()
        pull = 300 * (x[0][0] - server[0]) + 2 * (x[0][1] - server[1])
        return [push - pull, -push], memory, [pull]

    text = replaced(scene("client-server"), ("delay: 8 ms, graph", f"delay: {delay} ms, graph"))
    client = [(0.05, 5.0, 0.0), DEVICE]
    bodies = [[(0.6, 5.0, 0.0)], client, client, client]
    scheme = ByHand(bodies, [[1, 2, 3], [0], [0], [0]], law, told=0, out=1, late=delay)
    same(compiled(text), scheme)
    same(compiled(text), scheme, "determinant")


# ---- unlike devices, weights, a tool in two hands ----


@pytest.mark.parametrize("scale", [0.25, 1.0, 3.0])
def test_scaled_spring_damper_joins_unlike_devices(scale: float) -> None:
    def law(i: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        own = scale if i else 1.0
        push = 1000 * (own * x[0][0] - x[1][0])
        return [-own * push, push - 500 * (x[1][0] - mean(heard, 0))], memory, []

    text = replaced(
        scene("unlike-devices"),
        (
            "position_scale: 0.25, contact.force_scale: 0.25",
            f"position_scale: {scale}, contact.force_scale: {scale}",
        ),
    )
    copy = (0.2, 5.0, 0.0)
    bodies = [[DEVICE, copy], [(0.4, 8.0, 0.0), copy]]
    same(compiled(text), ByHand(bodies, everybody(2), law, told=1))


def test_a_scaled_device_is_one_of_another_mass() -> None:
    """With both scales s it acts as one of mass m/s² and damping b/s² whose motion is s times as large."""
    text = scene("unlike-devices")
    plain = replaced(
        text,
        ("device.mass: 0.4 kg, device.damping: 8 N*s/m", "device.mass: 6.4 kg, device.damping: 128 N*s/m"),
        (", contact.position_scale: 0.25, contact.force_scale: 0.25", ""),
    )
    found, expected = apc.analyze(compiled(text)), apc.analyze(compiled(plain))
    assert found.spectral_radius == pytest.approx(expected.spectral_radius, abs=1e-12)


def test_weight_and_gravity_compensation_let_a_box_hang_where_springs_hold_it() -> None:
    """`Weight` and `GravityCompensation`: each arm carries its copy and what a motor leaves of a device."""
    weight = 9.80665 * (0.3 + 0.3 - 0.27)
    run = apc.simulate(compiled(scene("lifted-box")), signals=["*.x"], jit=False)
    below = -weight / 200
    assert run["user[1].device.x"][-1] == pytest.approx(below, abs=1e-6)
    assert run["user[1].box.x"][-1] == pytest.approx(below - 9.80665 * 0.3 / 1000, abs=1e-6)


def test_what_weighs_decides_nothing_of_stability() -> None:
    text = scene("lifted-box")
    light = replaced(text, ("flange: box, mass: 0.3 kg", "flange: box, mass: 0 kg"))
    found, expected = apc.analyze(compiled(text)), apc.analyze(compiled(light))
    assert found.spectral_radius == pytest.approx(expected.spectral_radius, abs=1e-13)

    def law(_: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        push = contact(x, 1000, 2)
        return [-push, push - 300 * (x[1][0] - mean(heard, 0))], memory, []

    bodies = [[(0.3, 5.0 + 2.0, 200.0), CUBE]] * 2
    same(compiled(text), ByHand(bodies, everybody(2), law, told=1))


def test_a_tool_in_two_hands_moves_as_its_middle_does() -> None:
    """Both devices and the tool are one mass at its middle; the hands apart move against dampers alone."""

    def law(_: int, x: Sequence[tuple[Any, Any]], heard: Packets, memory: Sequence[Any]) -> Any:
        push = contact(x, 1000, 2)
        return [-push, push - 300 * (x[1][0] - mean(heard, 0)), 0 * push], memory, []

    apart = (0.05, 2.5, 0.0)  # the hands against each other: half of one device
    bodies = [[(0.1 + 0.1 + 0.2, 5.0 + 5.0, 0.0), CUBE, apart]] * 2
    same(compiled(scene("two-handed-tool")), ByHand(bodies, everybody(2), law, told=1))


# ---- all of them beside each other ----


def test_every_linear_scheme_stands_beside_the_papers() -> None:
    names = [
        "three-users-average",
        "client-server",
        "two-users-waves",
        "two-users-filtered-waves",
        "two-users-damped",
        "three-users-predicted",
        "two-users-reported",
    ]
    found = compare([compiled(scene(name)) for name in names])
    assert [one.topology for one in found.schemes] == names
    for one in found.schemes:
        assert one.stable
        assert not one.analysis.linearized
        assert one.stiffness is not None
        assert one.stiffness.parameter == "coordination.stiffness"
        assert one.delay is not None
        assert one.feel is not None
    assert found.schemes[1].feel is not None
    assert found.schemes[1].feel.at == "client[1].device", "the server holds no device"
    without = [one.topology for one in found.schemes if one.loss is None]
    assert without == ["three-users-average", "three-users-predicted"], (
        "no loss to vary; by the ages of packets"
    )
