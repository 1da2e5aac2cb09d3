"""Scenes that break a plain eigenvalue computation, each against a computation at 60 digits or more.

Claimed of each: every verdict is right, and every printed bound holds the truth.
"""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi
import flint
import numpy as np
import pytest

from apc.analysis.analysis import Analysis, analyze
from apc.compiler.compiled import CompiledSystem, Group, Parameter
from apc.eigen.balls import precision
from tests.bruteforce import Scene, as_ball, frame_matrix
from tests.sites import MS, alone, columned, grouped, linked, paper

TRANSLATING = "stable up to a common translation"

# Damping and masses of `bruteforce.Scene`, by the name of the parameter.
_OWN = {
    "cube": "cube.mass",
    "cube_damping": "cube.damping",
    "device": "device.mass",
    "device_damping": "device.damping",
}


def truth(scene: Scene, bits: int) -> list[flint.acb]:
    """Return the eigenvalues of the full map, all peers as one, by propagating it event by event."""
    with precision(bits):
        rows = frame_matrix(scene, number=as_ball, exp=lambda value: value.exp())
        return flint.acb_mat([[flint.acb(e.mid()) for e in row] for row in rows]).eig(algorithm="approx")


def analysed(**values: Any) -> Analysis:
    """Analyse a scene of equal peers given as `bruteforce.Scene` gives it."""
    own = {_OWN[key]: values.pop(key) for key in list(values) if key in _OWN}
    system = paper(**values)
    if own:
        system = grouped(system, ("user", system.peers, own))
    return analyze(system)


# What a Jordan block of ten zeros, a queue, keeps of the truth's 300 digits or so.
SCATTERED = 1e-25


def check(found: Analysis, values: list[flint.acb], *, rigid: int, bits: int = 200) -> None:
    """Assert that the truth is within every bound and the verdict is what it says.

    Parameters
    ----------
    found
        The analysis.
    values
        All eigenvalues, approximately.
    rigid
        How many of them are 1 and no matter of stability, drifts counted twice.
    bits
        A precision at which differences of the values mean something.
    """
    with precision(bits):
        for mode in found.modes:
            place = flint.acb(mode.eigenvalue.real, mode.eigenvalue.imag)
            apart = min(float(abs(place - value).mid()) for value in values)
            assert apart <= mode.error * (1 + 1e-9) + SCATTERED
        apart = sorted(values, key=lambda value: float(abs(value - 1).mid()))
        assert all(float(abs(value - 1).mid()) < 1e-25 for value in apart[:rigid])
        radius = max((abs(value).mid() for value in apart[rigid:]), default=flint.arb(0))
        assert abs(float(radius - flint.arb(found.spectral_radius))) <= found.spectral_radius_error * (
            1 + 1e-9
        )
        if found.verdict != "drifts":
            assert found.stable == bool(radius < 1)


HARD = {
    "contact 1e8 N/m at 1 kHz": {"kc": 1e8},
    "contact 1e8 N/m at 1 kHz, damped": {"kc": 1e8, "bc": 1e3},
    "contact 1e8 N/m at 100 kHz": {
        "kc": 1e8,
        "haptic": MS / 100,
        "network": MS / 10,
        "comp": MS / 100,
        "comm": MS / 10,
    },
    "mass 1e-6 kg": {"device": 1e-6, "kc": 100.0},
    "mass 1e-6 kg of the copy": {"cube": 1e-6},
    "hardly any damping": {"device_damping": 1e-12, "cube_damping": 1e-12},
    "hardly any damping, hardly tied": {
        "device_damping": 1e-12,
        "cube_damping": 1e-12,
        "kt": 1e-3,
        "kc": 1e-3,
    },
    "as many packets as ticks": {"network": MS, "comm": MS},
    "one packet in 40 ticks": {"network": 40 * MS, "comm": 40 * MS},
    "one packet in 100 ticks": {
        "kt": 50.0,
        "kc": 500.0,
        "bc": 1.0,
        "network": 100 * MS,
        "comm": 100 * MS,
    },
    "1 ms and 1/90 s": {"network": Fraction(1, 90), "comm": Fraction(1, 90)},
    "no delay at all": {"comp": Fraction(0), "comm": Fraction(0)},
    "delay of 12 frames": {"comm": 96 * MS, "bt": 2.0, "kt": 50.0},
    "delay within a tick": {"comp": MS / 7, "comm": MS * 22 / 7},
    "one peer": {"peers": 1, "operator": "sum", "network": MS, "comm": MS},
    "two peers, sum": {"peers": 2, "operator": "sum"},
}


@pytest.mark.parametrize("name", HARD)
def test_bounds_hold_the_truth(name: str) -> None:
    values = {"peers": 2, "operator": "mean", **HARD[name]}
    found = analysed(**values)
    assert found.stable is not None
    rigid = 1
    check(found, truth(Scene(**values), 1024), rigid=rigid)
    assert found.rigid_modes == rigid
    assert found.spectral_radius_error <= 1e-8 * max(found.spectral_radius, 1)


def test_no_damping_at_all_drifts_where_nothing_brakes() -> None:
    """Loose, every copy and every device coasts on: six Jordan pairs of three users; nothing else is left."""
    loose = analysed(kt=0.0, kc=0.0, device_damping=0.0, cube_damping=0.0)
    assert loose.verdict == "drifts"
    assert loose.rigid_modes == 6
    assert all(mode.magnitude <= mode.error for mode in loose.modes)


def test_no_damping_but_ties_are_decided() -> None:
    values = {"peers": 2, "kt": 100.0, "bt": 2.0, "bc": 3.0, "device_damping": 0.0, "cube_damping": 0.0}
    found = analysed(**values)
    check(found, truth(Scene(**values), 1024), rigid=1)


@pytest.mark.parametrize("ratio", [1, 10, 100, 1000])
def test_the_frame_of_loose_peers_is_the_tick_to_the_power_of_the_ratio(ratio: int) -> None:
    """One peer and a loose copy: what the frame does is the tick's own map to the power of the ratio."""
    found = analyze(paper(kt=0.0, kc=500.0, bc=1.0, network=ratio * MS, comm=ratio * MS))
    [tick] = {
        mode.magnitude for mode in analyze(paper(kt=0.0, kc=500.0, bc=1.0, network=MS, comm=MS)).modes[:1]
    }
    assert found.verdict == TRANSLATING
    assert found.rigid_modes == 3
    expected = tick**ratio
    assert abs(found.spectral_radius - expected) <= found.spectral_radius_error + 1e-12 * ratio * expected


@pytest.mark.parametrize("frames", [0, 1, 7, 100, 200])
def test_a_delay_of_many_frames_is_decided(frames: int) -> None:
    """Each reported eigenvalue leads, by the secant rule at 90 digits, to a zero of what it must be one of.

    Two peers on the mean hear ±s[k − d]: det(z − P ∓ z^(−d) Q S) = 0, whatever the number of packets.
    """
    found = analyze(paper(peers=2, kt=5.0, bt=0.0, kc=500.0, comm=8 * MS * frames))
    assert found.stable is not None
    function = _characteristic(frames)
    for mode in found.modes[:4]:
        sign = 1 if mode.shape == "common" else -1
        root = _newton(lambda z, sign=sign: function(z, sign), mode.eigenvalue)
        assert abs(complex(root) - mode.eigenvalue) <= mode.error + 1e-15
    assert found.spectral_radius_error < 1e-9


def _characteristic(frames: int):  # type: ignore[no-untyped-def] # a helper of one test
    """Return det(z − P − sign·z^(−d) Q S) of one user, from the brute force map of two."""
    with precision(300):
        base = {"kt": 5.0, "bt": 0.0, "kc": 500.0, "comm": 8 * MS}
        two = frame_matrix(Scene(peers=2, operator="mean", **base), number=as_ball, exp=lambda v: v.exp())
    # A user's own part, and what the other's packets do: packets of one frame ago are what is heard.
    size = len(two) // 2
    own = [[two[i][j] for j in range(size)] for i in range(size)]
    other = [[two[i][size + j] for j in range(size)] for i in range(size)]
    packet = size - 4  # its two packets (x, v), the newest first; the newest is heard
    states = list(range(packet))

    def determinant(z: flint.acb, sign: int) -> flint.acb:
        n = len(states)
        delayed = z ** (-frames) * sign
        rows = []
        for i in states:
            row = []
            for j in states:
                entry = flint.acb(z if i == j else 0) - own[i][j]
                # What is heard: the copy's (x, v) as it was sent, `frames` ago.
                for part, sent in ((0, 2), (1, 3)):
                    if j == sent:
                        entry -= delayed * other[i][packet + part]
                row.append(entry)
            rows.append(row)
        return flint.acb_mat(n, n, [entry for row in rows for entry in row]).det()

    return determinant


def _newton(function, start: complex) -> flint.acb:  # type: ignore[no-untyped-def] # a helper of one test
    """Return the zero of a function near a start, by the secant rule at 90 digits."""
    with precision(300):
        a = flint.acb(start.real, start.imag)
        b = a + flint.acb(1e-12, 1e-12)
        for _ in range(60):
            fa, fb = function(a), function(b)
            step = (fb * (b - a) / (fb - fa)).mid()
            a, b = b, (b - step).mid()
            if float(abs(step)) < 1e-40:
                break
        return b


def test_two_nearly_equal_eigenvalues_on_the_boundary_are_told_apart() -> None:
    """y⁺ = c y at two peers, one c a rounding from the other, on either side of one."""
    below, above = 1 - 2.0**-53, 1 + 2.0**-52
    for pair, stable in (
        ((below, 1 - 2.0**-52), True),
        ((below, above), False),
        ((above, 1 + 2.0**-51), False),
    ):
        found = analyze(columned(_shrinking(), factor=pair))
        assert found.stable is stable
        assert found.spectral_radius == max(pair)
        assert found.spectral_radius_error < 1e-15


def _shrinking() -> CompiledSystem:
    """Return two peers that hear nobody: a memory is multiplied each tick, and pushes a decaying x."""
    system = alone(
        lambda x, u: u - 100 * x,
        lambda x, u, m: casadi.vertcat(m[0], m[0]),
        outputs=("f", "y"),
        memories=(1,),
    )
    [kind] = system.kinds
    [clock] = kind.clocks
    x, u, m = casadi.SX.sym("x"), casadi.SX.sym("u", 1), casadi.SX.sym("m", 1)
    r, p, t = casadi.SX.sym("r", 0), casadi.SX.sym("p", 2), casadi.SX.sym("t")
    derivative = casadi.Function("derivative", [x, u, p, t], [u - 100 * x])
    tick = casadi.Function("tick", [x, u, m, r, p, t], [casadi.vertcat(m[0], p[1] * m[0])])
    kind = replace(
        kind, derivative=derivative, clocks=(replace(clock, tick=tick),), parameters=("zero", "factor")
    )
    return replace(
        system,
        kinds=(kind,),
        parameters=(*system.parameters, Parameter("factor", "1", 1.0)),
        groups=(Group("peer", 2, 0),),
    )


def test_two_clusters_have_two_translations() -> None:
    arcs = [(0, 1, 1.0), (1, 0, 1.0), (2, 3, 1.0), (3, 2, 1.0)]
    found = analyze(linked(paper(peers=4), arcs))
    weights = {(i, j): weight for i, j, weight in arcs}
    assert found.rigid_modes == 2
    assert found.verdict == TRANSLATING
    check(found, truth(Scene(peers=4, weights=weights), 512), rigid=2)


def test_a_peer_nobody_hears_changes_nobody_else() -> None:
    arcs = [(0, 1, 1.0), (1, 0, 1.0), (0, 2, 1.0)]  # 2 hears 0, and is heard by nobody
    found = analyze(linked(paper(peers=3), arcs))
    weights = {(i, j): weight for i, j, weight in arcs}
    assert found.stable is True
    check(found, truth(Scene(peers=3, weights=weights), 1024), rigid=1)


def test_a_lone_mass_is_its_closed_form() -> None:
    """One peer of one mass under no force: e^(−b T/m), and the translation."""
    for mass, damping in ((1e-6, 5.0), (0.1, 1e-12), (1e3, 1e6), (0.1, 5.0)):
        system = grouped(
            paper(peers=1, operator="sum", kt=0.0, kc=0.0, comp=Fraction(0), comm=Fraction(0)),
            (
                "user",
                1,
                {"device.mass": mass, "device.damping": damping, "cube.mass": mass, "cube.damping": damping},
            ),
        )
        found = analyze(system)
        with precision(300):
            exact = (-flint.arb(damping) / flint.arb(mass) * flint.arb(found.frame_s)).exp()
        assert found.verdict == TRANSLATING
        assert abs(found.spectral_radius - float(exact)) <= found.spectral_radius_error + 1e-16 * float(exact)
        assert math.isfinite(found.spectral_radius_error)
        assert found.stable is not None
        assert np.isfinite([mode.error for mode in found.modes]).all()
