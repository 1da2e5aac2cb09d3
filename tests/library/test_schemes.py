"""The schemes of the library over a network: against a frame played tick by tick by hand.

Each law stands here as its source has it; the matrix of a frame, and its eigenvalues, are the test's own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest

import apc
from tests.schemes import ByHand, Law, everybody, magnitudes, mean
from tests.topologies import TOPOLOGIES, compiled, replaced

# Of the eigenvalues of a matrix of some forty rows in floats.
SAME = 1e-10

DEVICE, CUBE, THIRD = (0.1, 5.0, 0.0), (0.3, 5.0, 0.0), (0.2, 5.0, 0.0)
Packets = dict[int, Sequence[Any]]
# What pulls a copy back, of its position, its velocity and what it hears.
Pull = Callable[[Any, Any, Packets], Any]


def topology(name: str) -> str:
    return (TOPOLOGIES / f"{name}.yaml").read_text(encoding="utf-8")


def contact(x: Sequence[tuple[Any, Any]], stiffness: float = 1000.0, damping: float = 0.0) -> Any:
    """Return the force of a spring and damper from body 0 on body 1."""
    return stiffness * (x[0][0] - x[1][0]) + damping * (x[0][1] - x[1][1])


def pulling(pull: Pull, damping: float = 0.0) -> Law:
    """Return the law of a device in contact with a copy that is pulled back."""

    def law(_: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        push = contact(x, damping=damping)
        return [-push, push - pull(*x[1], received)], memory, []

    return law


def same(model: apc.Model, scheme: ByHand, method: Any = "auto") -> None:
    found = apc.analyze(model, method=method)
    rigid, radius = magnitudes(scheme)
    assert found.rigid_modes == rigid
    assert found.spectral_radius == pytest.approx(radius, abs=SAME + found.spectral_radius_error)
    assert found.spectral_radius_error < 1e-5
    assert found.stable == (radius < 1)


def scheduled(injection: float) -> Pull:
    """K = min(500 N/m, B/age) at each tick."""

    def pull(x: Any, v: Any, received: Packets) -> Any:
        oldest = max(packet[2] for packet in received.values())
        gain = injection / oldest if 500 * oldest > injection else 500
        return gain * (x - mean(received, 0)) + injection * v

    return pull


def damped(stiffness: float, damping: float, injection: float) -> Pull:
    return lambda x, v, received: (
        stiffness * (x - mean(received, 0)) + damping * (v - mean(received, 1)) + injection * v
    )


def predicted(age: float | None) -> Pull:
    """By the age of each packet at each tick, or by a number."""

    def pull(x: Any, v: Any, received: Packets) -> Any:
        ahead = mean(received, 0) + (mean(received, 2) if age is None else age) * mean(received, 1)
        return 500 * (x - ahead) + 2 * (v - mean(received, 1))

    return pull


# A topology, what is changed in it, the copy as a body, and what pulls it.
SCHEMES: dict[str, tuple[str, dict[str, str], tuple[float, float, float], Pull]] = {
    "DampedAverage": (
        "two-users-damped",
        {"stiffness: 500 N/m, injection: 5": "stiffness: 200 N/m, damping: 3 N*s/m, injection: 40"},
        CUBE,
        damped(200, 3, 40),
    ),
    "PredictedAverage": ("three-users-predicted", {}, THIRD, predicted(None)),
    "PredictedAverage by an age": (
        "three-users-predicted",
        {"damping: 2 N*s/m,": "damping: 2 N*s/m, ages: assumed, assumed: 12 ms,"},
        THIRD,
        predicted(0.012),
    ),
    "ScheduledAverage": ("three-users-scheduled", {}, THIRD, scheduled(5)),
}


@pytest.mark.few(14)
@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
@pytest.mark.parametrize("name", SCHEMES)
def test_an_average_is_its_law(name: str, delay: int) -> None:
    base, changes, copy, pull = SCHEMES[name]
    text = replaced(topology(base), *changes.items(), ("delay: 8 ms", f"delay: {delay} ms"))
    peers = 2 if copy == CUBE else 3
    same(compiled(text), ByHand([[DEVICE, copy]] * peers, everybody(peers), pulling(pull), 1, late=delay))


@pytest.mark.parametrize("delay", [0, 50])
def test_a_remote_proxy_follows_the_others_device(delay: int) -> None:
    """Each device feels the proxy it touches; the proxy follows the other's device as heard."""
    follow = pulling(lambda x, v, received: 300 * (x - mean(received, 0)) + 5 * (v - mean(received, 1)))
    text = replaced(topology("two-users-proxies"), ("delay: 8 ms, loss", f"delay: {delay} ms, loss"))
    bodies = [[(0.1, 5.0 + 2.0, 50.0), (0.1, 1.0, 0.0)]] * 2
    same(compiled(text), ByHand(bodies, everybody(2), follow, first_sent=0, late=delay))


@pytest.mark.few(5)
@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
@pytest.mark.parametrize("ratio", [2, 5, 8])
def test_a_reported_average_is_a_mean_begun_anew_at_each_packet(ratio: int, delay: int) -> None:
    """By hand the sum starts from nothing at each packet, and is told over how many ticks there are."""
    calls = itertools.count()

    def law(_: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        begins = next(calls) // 2 % ratio == 0  # each tick asks both peers
        total = x[1][0] + (0 if begins else memory[0])
        push, pull = contact(x), 500 * (x[1][0] - mean(received, 2)) + 5 * x[1][1]
        return [-push, push - pull], [total], [total / ratio]

    text = replaced(
        topology("two-users-reported"),
        ("network: 8 ms", f"network: {ratio} ms"),
        ("delay: 8 ms", f"delay: {delay} ms"),
    )
    hand = ByHand(
        [[DEVICE, CUBE]] * 2, everybody(2), law, first_sent=1, memory=1, out=1, ratio=ratio, late=delay
    )
    same(compiled(text), hand)


# ---- waves ----


def waves(*, correction: float = 0.0, cutoff: float | None = None) -> Law:
    """Return the law of wave variables: f = K (x − p) + B (x' − v) with v = (√(2b) w + f)/b + c (x_2 − p)."""
    stiffness, damping, impedance = 500.0, 5.0, 10.0

    def law(_: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        p, *filtered = memory
        wave = mean(received, 2)
        if cutoff is not None:
            wave = filtered[0] + cutoff * 1e-3 / (1 + cutoff * 1e-3) * (wave - filtered[0])
        push = contact(x)
        moved = math.sqrt(2 / impedance) * wave + correction * (mean(received, 0) - p)
        # f = K (x − p − T v) + B (x' − v) with v = moved + f/b, solved for f.
        give = stiffness * 1e-3 + damping
        f = (stiffness * (x[1][0] - p) + damping * x[1][1] - give * moved) / (1 + give / impedance)
        v = moved + f / impedance
        out = (impedance * v + f) / math.sqrt(2 * impedance)
        stand = p + 1e-3 * v
        return [-push, push - f], [stand] if cutoff is None else [stand, wave], [out]

    return law


@pytest.mark.few(6)
@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
@pytest.mark.parametrize(
    ("cutoff", "correction"), [(None, 0.0), (None, 2.0), (60.0, 2.0), (5.0, 0.5), (2000.0, 2.0)]
)
def test_a_wave_coupling_is_its_law(delay: int, cutoff: float | None, correction: float) -> None:
    """Two motions are rigid without correction: positions drift, as waves carry velocities alone."""
    change = ("impedance: 10 N*s/m", f"impedance: 10 N*s/m, correction: {correction} 1/s")
    if cutoff is not None:
        change = ("cutoff: 60 1/s, correction: 2 1/s", f"cutoff: {cutoff} 1/s, correction: {correction} 1/s")
    name = "two-users-waves" if cutoff is None else "two-users-filtered-waves"
    law = waves(correction=correction, cutoff=cutoff)
    memory = 1 if cutoff is None else 2
    hand = ByHand([[DEVICE, CUBE]] * 2, everybody(2), law, first_sent=1, memory=memory, out=1, late=delay)
    assert magnitudes(hand)[0] == (1 if correction else 2)
    same(compiled(replaced(topology(name), change, ("delay: 8 ms", f"delay: {delay} ms"))), hand)


# ---- a server, unlike devices, weights, a tool in two hands ----


@pytest.mark.few(3)
@pytest.mark.parametrize("delay", [0, 8, 10, 50, 200])
def test_a_served_object_is_its_law(delay: int) -> None:
    """The server, peer 0, has the object alone; what clients computed and held arrives with their packets."""

    def law(i: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        if i == 0:
            added = sum(packet[2] for packet in received.values())
            return [added], memory, [0 * added]
        push = contact([x[1], x[0]])
        (server,) = received.values()
        pull = 300 * (x[0][0] - server[0]) + 2 * (x[0][1] - server[1])
        return [push - pull, -push], memory, [pull]

    text = replaced(topology("client-server"), ("delay: 8 ms, graph", f"delay: {delay} ms, graph"))
    bodies = [[(0.6, 5.0, 0.0)], *[[(0.05, 5.0, 0.0), DEVICE]] * 3]
    hand = ByHand(bodies, [[1, 2, 3], [0], [0], [0]], law, first_sent=0, out=1, late=delay)
    same(compiled(text), hand)
    same(compiled(text), hand, "determinant")


@pytest.mark.parametrize(("scale", "force"), [(0.25, 0.25), (3.0, 3.0), (0.5, 0.75)])
def test_a_scaled_spring_and_damper_joins_unlike_devices(scale: float, force: float) -> None:
    def law(i: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        own, back = (scale, force) if i else (1.0, 1.0)
        push = 1000 * (own * x[0][0] - x[1][0]) + 2 * (own * x[0][1] - x[1][1])
        return [-back * push, push - 500 * (x[1][0] - mean(received, 0))], memory, []

    text = replaced(
        topology("unlike-devices"),
        ("_scale: 0.25, contact.force_scale: 0.25", f"_scale: {scale}, contact.force_scale: {force}"),
        ("stiffness: 1000 N/m", "stiffness: 1000 N/m, damping: 2 N*s/m"),
    )
    same(compiled(text), ByHand([[DEVICE, THIRD], [(0.4, 8.0, 0.0), THIRD]], everybody(2), law, first_sent=1))


def test_weights_bend_springs_and_decide_nothing_of_stability() -> None:
    """`Weight` and `GravityCompensation`: each arm carries its copy and what a motor leaves of a device."""
    weight, below = 9.80665 * 0.3, -9.80665 * (0.3 + 0.3 - 0.27) / 200
    run = apc.simulate(compiled(topology("lifted-box")), signals=["*.x"], jit=False)
    assert run["user[1].device.x"][-1] == pytest.approx(below, abs=1e-6)
    assert run["user[1].box.x"][-1] == pytest.approx(below - weight / 1000, abs=1e-6)
    pull = pulling(lambda x, v, received: 300 * (x - mean(received, 0)), damping=2)
    bodies = [[(0.3, 5.0 + 2.0, 200.0), CUBE]] * 2
    same(compiled(topology("lifted-box")), ByHand(bodies, everybody(2), pull, first_sent=1))


def test_a_tool_in_two_hands_moves_as_its_middle_does() -> None:
    """Both devices and the tool are one mass at its middle; the hands apart move against dampers alone."""

    def law(_: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        push = contact(x, 1000, 2)
        return [-push, push - 300 * (x[1][0] - mean(received, 0)), 0 * push], memory, []

    apart = (0.05, 2.5, 0.0)  # the hands against each other: half of one device
    bodies = [[(0.1 + 0.1 + 0.2, 5.0 + 5.0, 0.0), CUBE, apart]] * 2
    same(compiled(topology("two-handed-tool")), ByHand(bodies, everybody(2), law, first_sent=1))


@pytest.mark.parametrize("damping", [0.0, 0.2])
def test_a_beam_in_two_hands_is_pulled_and_turned_by_its_ends(damping: float) -> None:
    """To first order an end moves by arm·angle across the beam, and what pulls there turns by arm·force."""

    def law(i: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        arm = 0.3 if i else -0.3
        own = np.array(x)  # device and beam along either axis, angle; each with its rate
        end = own[2:4] + np.array([0, arm])[:, None, None] * own[4]
        push = np.tensordot([500, damping], own[:2] - end, (0, 1))
        behind = own[2:] - np.reshape([mean(received, place) for place in range(6)], own[2:].shape)
        pull = behind[:, 0] * np.array([[200], [200], [4]]) + damping * behind[:, 1]
        return [*-push, *push - pull[:2], arm * push[1] - pull[2]], memory, []

    bodies = [[DEVICE, DEVICE, (1.0, 5.0, 0.0), (1.0, 5.0, 0.0), (0.03, 0.15, 0.0)]] * 2
    more = f"damping: {damping} N*s/m, turn_damping: {damping} N*m*s/rad, turn_stiffness"
    both = (("turn_stiffness", more), ("500 N/m", f"500 N/m, damping: {damping} N*s/m"))
    same(
        compiled(replaced(topology("carried-beam"), *both)),
        ByHand(bodies, everybody(2), law, first_sent=2, many=3),
    )
