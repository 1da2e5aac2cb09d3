"""What a hand feels among many peers that all differ: against one system of all, and a program of its own."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.hands import answers
from apc.hands.feel import NO_NORMS, Feel, feel
from tests.populations import different
from tests.topologies import AVERAGE, compiled, replaced

Complexes = NDArray[np.complex128]

HERTZ = (0.1, 0.7, 2.9, 9.7, 21.7, 58.3)

# Groups that differ inside, unlike each other, with a delay of their own between two of them.
SIDES = replaced(
    AVERAGE,
    (
        "user: {count: 3}",
        "left: {count: 3, set: {device.mass: [0.1 kg, 0.12 kg, 0.1 kg]}}\n"
        "  right: {count: 2, set: {device.damping: [4 N*s/m, 6 N*s/m], contact.stiffness: 800 N/m}}",
    ),
    ("delay: 8 ms}", "delay: 8 ms, delays: {right: {left: 11 ms}}}"),
    ("stiffness: 500", "stiffness: 300"),
)


def both(
    monkeypatch: pytest.MonkeyPatch, system: CompiledSystem, hertz: tuple[float, ...], **asked: str
) -> tuple[Feel, Feel]:
    """Return what is felt by one system of all, and peer by peer."""
    found = []
    for most in (10**6, 1):
        monkeypatch.setattr(answers, "MOST_TOGETHER", most)
        found.append(feel(system, hertz, at=asked.get("at", ""), between=asked.get("between", "")))
    return found[0], found[1]


def check_alike(one: Feel, other: Feel, tolerance: float) -> None:
    """Check that two ways agree, and no farther apart than they say."""
    for name, bound in (
        ("impedance", "bound"),
        ("transmitted_admittance", "transmitted_bound"),
        ("error_per_force", "error_bound"),
    ):
        size, off = np.abs(getattr(one, name)), np.abs(getattr(one, name) - getattr(other, name))
        assert (off <= tolerance * size).all(), name
        assert (off <= 1.1 * size * (getattr(one, bound) + getattr(other, bound))).all(), name
    np.testing.assert_allclose(one.alias, other.alias, rtol=1e-6)


@pytest.mark.parametrize(("operator", "peers"), [("mean", 3), ("sum", 4), ("mean", 10)])
def test_peer_by_peer_it_is_what_one_system_of_all_says(
    monkeypatch: pytest.MonkeyPatch, operator: str, peers: int
) -> None:
    one, other = both(monkeypatch, different(peers, operator), HERTZ, at="user[2]", between="user[3]")
    check_alike(one, other, 1e-9)
    assert max(map(max, (other.bound, other.transmitted_bound, other.error_bound))) < 1e-4
    assert one.low_frequency is not None
    assert other.low_frequency is not None
    for name, place in (("mass", 0), ("damping", 1), ("stiffness", 2)):
        near = one.low_frequency.errors[place] + other.low_frequency.errors[place]
        assert abs(getattr(one.low_frequency, name) - getattr(other.low_frequency, name)) <= near
    assert one.network_viscosity is not None
    assert other.network_viscosity is not None
    assert other.network_viscosity.network == pytest.approx(one.network_viscosity.network, rel=1e-6)
    assert (NO_NORMS in one.notes, NO_NORMS in other.notes) == (False, True)
    assert (bool(one.hinf), bool(one.h2), bool(other.hinf), bool(other.h2)) == (True, True, False, False)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("at", "between"),
    [("left[1]", "left[3]"), ("left[3]", "right[2]"), ("right[1]", "left[2]"), ("left[2]", "left[2]")],
)
def test_groups_that_differ_inside_hear_each_other_as_late_as_their_links_say(
    monkeypatch: pytest.MonkeyPatch, at: str, between: str
) -> None:
    """Two peers of the left are equal: a push at one of them is not one at the other."""
    one, other = both(monkeypatch, compiled(SIDES), HERTZ[1:5], at=at, between=between)
    check_alike(one, other, 1e-9)


def test_at_the_frame_rate_a_scene_that_may_rest_anywhere_has_a_response(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is told there is a mean over a circle, of answers that are a thousand times larger."""
    one, other = both(monkeypatch, different(4), (125.0, 250.0))
    check_alike(one, other, 1e-5)
    np.testing.assert_allclose(one.impedance, other.impedance, rtol=1e-11)


TICKS, TICK = 8, 1e-3


def responses(masses: Complexes, stiffness: float, hertz: float) -> tuple[complex, complex, complex]:
    """Return velocity here and at the second device, and the first copy's error, a newton at the first.

    Of the paper's users, all devices unlike, by one dense system of all: ξ⁺ = M ξ + k, ξ⁺ = e^{jωT} ξ.
    Of x = e^{jωt} w, w' = (A − jω) w + B u e^{−jωt} + b, and the mean of w over a frame is what is wanted.
    """
    count, omega = len(masses), 2j * np.pi * hertz
    steps = [_tick(mass, 0.6 / count, omega) for mass in masses.real]
    # Of each peer: both motions, the two forces that act, the position that is on its way; last, 1 N.
    whole = np.eye(7 * count + 1, dtype=complex)
    mean = np.zeros((count, 4, 7 * count + 1), dtype=complex)
    heard = np.array([whole[6 : 7 * count : 7].sum(axis=0) - whole[7 * i + 6] for i in range(count)])
    for i in range(count):
        whole[7 * i + 6] = whole[7 * i + 2]
    for tick in range(TICKS):
        turned = np.exp(omega * tick * TICK)
        for i, step in enumerate(steps):
            own = slice(7 * i, 7 * i + 4)
            now = np.concatenate([whole[7 * i : 7 * i + 6], whole[-1:] * turned * (i == 0)])
            moved = step @ now
            pressed = 1000 * (now[0] - now[2])
            drawn = stiffness * (now[2] - heard[i] / (count - 1))
            whole[own], whole[7 * i + 4], whole[7 * i + 5] = moved[:4], pressed, drawn
            mean[i] += moved[4:] / turned / (TICKS * TICK)
    z = np.exp(omega * TICKS * TICK)
    state = np.linalg.solve(z * np.eye(7 * count) - whole[:-1, :-1], whole[:-1, -1])
    motion = mean[:, :, :-1] @ state + mean[:, :, -1]
    return motion[0, 1], motion[1, 1], motion[0, 2] - motion[1:, 2].mean()


def _tick(mass: float, copy: float, omega: complex) -> Complexes:
    """Return what a tick makes of the motions, and ∫ x e^{−jωσ}, of motions, forces and a push (8, 7)."""
    rate = np.zeros((11, 11), dtype=complex)
    rate[0, 1] = rate[2, 3] = 1
    rate[1, [1, 4, 6]] = -5 / mass, -1 / mass, 1 / mass
    rate[3, [3, 4, 5]] = -5 / copy, 1 / copy, -1 / copy
    for place in range(6):  # what is held turns backwards, seen from the push
        rate[place, place] -= omega
    rate[range(7, 11), range(4)] = 1
    moved = scipy.linalg.expm(rate * TICK)
    moved[:4] *= np.exp(omega * TICK)
    return moved[[*range(4), *range(7, 11)], :7]


@pytest.mark.parametrize(("count", "hertz"), [(3, 7.3), (100, 7.3)])
def test_a_hundred_users_feel_what_one_dense_system_says(
    monkeypatch: pytest.MonkeyPatch, count: int, hertz: float
) -> None:
    masses = np.linspace(0.08, 0.13, count)
    listed = ", ".join(f"{mass!r} kg" for mass in masses.tolist())
    text = replaced(AVERAGE, ("count: 3", f"count: {count}, set: {{device.mass: [{listed}]}}"))
    monkeypatch.setattr(answers, "MOST_TOGETHER", 1000)
    if count < 10:
        monkeypatch.setattr(answers, "MOST_TOGETHER", 1)
    found = feel(compiled(text), [hertz], quick=True)
    here, there, apart = responses(masses + 0j, 500.0, hertz)
    assert found.impedance[0] == pytest.approx(1 / here, rel=1e-10)
    assert found.transmitted_admittance[0] == pytest.approx(there, rel=1e-8)
    assert found.error_per_force[0] == pytest.approx(apart, rel=1e-9)
    assert found.bound[0] < 1e-6
