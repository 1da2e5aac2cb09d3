"""Published conditions of passivity and stability: numbers, promises, and curves over a topology."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

import apc
from apc.extensions.wall_conditions.overlay import overlay_points, parse_overlay, symbol_values
from apc.haptics.wall_conditions import CONDITIONS
from apc.parameter_values.parameter_names import ParameterRef, Range
from tests.topologies import AVERAGE, compiled, messages_of, wall


@pytest.mark.parametrize(("virtual", "limit"), [(0.0, 1600.0), (0.4, 800.0), (-0.4, 800.0), (0.9, 0.0)])
def test_colgate_and_schenkel_allow_the_published_stiffness(virtual: float, limit: float) -> None:
    """2 (0.8 − |B|)/0.001; nothing at all where the wall's damping exceeds the device's.

    And so does their general condition, b > T/2 · Re((1 − 1/z) H(z))/(1 − cos ωT), z = e^{jωT}.
    """
    assert CONDITIONS["colgate"].margin(limit, 0.8, virtual, 0.001) == pytest.approx(min(0, 0.8 - virtual))
    z = np.exp(1j * np.linspace(1e-3, np.pi, 4001))
    for share in (0.98, 1.02) if limit else ():
        impedance = share * limit + virtual * (1 - 1 / z) / 0.001
        needed = 0.001 / 2 * ((1 - 1 / z) * impedance).real / (1 - z.real)
        assert bool((needed < 0.8).all()) is (share < 1)
        assert share > 1 or virtual < 0 or apc.analyze(wall(0.04, 0.8, 0.0, share * limit, virtual)).stable


@pytest.mark.parametrize(
    ("mass", "damping", "delay", "virtual", "linear", "exact"),
    [
        (0.1, 5.0, 0.001, 0.0, 3333.333, 3378.939),
        (0.04, 0.8, 0.0, 0.0, 1600.0, 1605.351),
        (0.4, 5.0, 0.001, 5.0, 6666.667, None),  # little damping for the mass: (b + B) T/m is 0.025
    ],
)
def test_the_linear_condition_is_within_4_percent_of_a_walls_exact_limit(
    mass: float, damping: float, delay: float, virtual: float, linear: float, exact: float | None
) -> None:
    assert abs(CONDITIONS["gil"].margin(linear, damping, virtual, 0.001, delay)) <= 1e-6
    assert virtual or abs(CONDITIONS["diolaiti"].margin(linear, damping, 0.001, delay)) <= 1e-6
    found = apc.critical(wall(mass, damping, delay, 100.0, virtual), "it.stiffness", upper="20 kN/m").value
    assert linear == pytest.approx(found, rel=0.04)
    assert exact is None or found == pytest.approx(exact, abs=5e-4)  # printed to three decimals


MODEL = wall(0.1, 5.0, 0.001, 900.0, 0.25)
COLGATE = "colgate:K=it.stiffness,B=it.damping,b=device.damping,T=tick.period"
GIL = "gil:K=it.stiffness,B=it.damping,b=device.damping,T=tick.period,t_d=it.delay"


def curve(words: str, *axes: tuple[str, float, float]) -> np.ndarray:
    """Return the curve of a condition over two numbers of the wall."""
    ranges = [Range(ParameterRef(name), "", Fraction(low), Fraction(high)) for name, low, high in axes]
    return overlay_points(MODEL, parse_overlay(MODEL, words), *ranges)


@pytest.mark.parametrize(
    ("words", "x", "y", "ends"),
    [
        # K = (5 + B)/1.5e-3
        (GIL, ("it.stiffness", 0.0, 4000.0), ("it.damping", 0.0, 3.0), [(5 / 1.5e-3, 0), (4000, 1)]),
        (GIL, ("it.damping", 0.0, 3.0), ("it.stiffness", 0.0, 4000.0), [(0, 5 / 1.5e-3), (1, 4000)]),
        # K = 2 (5 − B)/1e-3
        (COLGATE, ("it.stiffness", 0.0, 20_000.0), ("it.damping", 0.0, 8.0), [(0, 5), (10_000, 0)]),
        (COLGATE, ("device.mass", 0.1, 1.0), ("it.stiffness", 0.0, 20_000.0), [(0.1, 9500), (1.0, 9500)]),
    ],
)
def test_a_curve_is_its_line_from_border_to_border(
    words: str, x: tuple[str, float, float], y: tuple[str, float, float], ends: list[tuple[float, float]]
) -> None:
    found = curve(words, x, y)
    assert found[[0, -1]].tolist() == [pytest.approx(end) for end in ends]
    first, last = found[[0, -1]]
    along = (found - first) @ (last - first) / ((last - first) @ (last - first))
    assert (np.diff(along) > 0).all()
    np.testing.assert_allclose(found, first + along[:, None] * (last - first), rtol=1e-9, atol=1e-9)


def test_symbols_follow_the_topology_its_expressions_and_groups() -> None:
    overlay = parse_overlay(MODEL, GIL)
    assert symbol_values(MODEL, overlay) == (900.0, 5.0, 0.25, 0.001, 0.001)
    assert overlay.label == "Gil et al.: K < (b + B)/(T/2 + t_d)"
    text = AVERAGE.replace("clocks:", "parameters: {kc: 900 N/m}\nclocks:", 1).replace("1000 N/m", "kc")
    model = compiled(
        text.replace("user: {count: 3}", "a: {count: 1, set: {device.damping: 7 N*s/m}}\n  b: {count: 2}")
    )
    words = "colgate:K=contact.stiffness,B=0 N*s/m,b=a.device.damping,T=haptic.period"
    assert symbol_values(model, parse_overlay(model, words)) == (900.0, 7.0, 0.0, 0.001)
    assert messages_of(parse_overlay, model, words.replace("a.device", "device")) == [
        "overlay: E886 device.damping differs between peers, but b is a single number. "
        "Try: b=a.device.damping"
    ]


EXAMPLE = "colgate:K=contact.stiffness,B=contact.damping,b=device.damping,T=haptic.period"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("colgate", f"E886 overlay: expected CONDITION:SYMBOL=NAME,…, got colgate. Try: {EXAMPLE}"),
        (
            "colgat:K=it.stiffness",
            "E886 colgat is not a known condition (colgate, gil, diolaiti, abbott). Try: colgate",
        ),
        ("colgate:K", f"E886 symbol: expected SYMBOL=NAME, got K. Try: {EXAMPLE}"),
        ("colgate:Q=it.stiffness", "E886 b > K T/2 + |B| has no Q; it has K, b, B, T."),
        ("colgate:K=it.stiffness,K=1 N/m", "E886 K is given twice."),
        ("colgate:K=it.stifness", "E622 it.stifness is not a parameter of wall. Try: it.stiffness"),
        (
            "colgate:K=it.damping",
            "E204 K, the stiffness of the virtual wall: expected N/m, got it.damping in N*s/m.",
        ),
        ("colgate:T=1", "E204 T: expected ms, got 1 (no unit). Try: T: 1 ms"),
    ],
)
def test_a_faulty_overlay_gets_one_clear_message(text: str, message: str) -> None:
    assert messages_of(parse_overlay, MODEL, text) == [f"overlay: {message}"]


@pytest.mark.parametrize(
    ("stiffness", "coulomb", "holds"),
    [(900, 0.5, True), (1010, 0.5, False), (900, 0.0224, False), (900, 0.0226, True)],
)
def test_a_wall_behind_an_encoder_is_held_against_published_conditions(
    stiffness: float, coulomb: float, holds: bool
) -> None:
    """Abbott and Okamura: K ≤ min(2 b/T, 2 c/D), b = 0.5 N·s/m, T = 1 ms, D = 0.05 mm."""
    text = (
        "topology: wall\nclocks: {haptic: 1 ms}\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 0.1 kg, damping: 0.4 N*s/m}}\ncouplers:\n"
        "  encoder: {type: EncoderQuantization, flange: device, resolution: 0.05 mm}\n"
        f"  friction: {{type: CoulombViscousFriction, a: device, b: ground, coulomb: {coulomb} N,"
        " viscous: 0.1 N*s/m, threshold: 1 mm/s}\n"
        "  wall: {type: VirtualWall, flange: encoder.measured, clock: haptic, x: 1 mm,"
        f" stiffness: {stiffness} N/m}}\n"
    ).replace("damping: 0.4 N*s/m}", "damping: 0.4 N*s/m, x: 1 mm}")
    (line,) = [
        note for note in apc.absolute_stability(compiled(text)).limitations if note.startswith("Abbott")
    ]
    assert ("2 c/D) holds" if holds else "2 c/D) does not hold") in line
    delayed = text.replace("clock: haptic, x", "clock: haptic, delay: 1 ms, x")
    assert not [
        note for note in apc.absolute_stability(compiled(delayed)).limitations if note.startswith("Abbott")
    ]
