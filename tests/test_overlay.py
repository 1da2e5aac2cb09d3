"""Conditions over a scene's parameters: every symbol is named by the user, and the curve is the boundary."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.frame.names import Free, Range
from apc.regions.overlay import overlay_points, parse_overlay, symbol_values
from tests.topologies import AVERAGE, compiled, told, wall

COLGATE = "colgate:K=it.stiffness,B=it.damping,b=device.damping,T=tick.period"


def _on(name: str, low: float, high: float) -> Range:
    return Range(Free(name), "", Fraction(low), Fraction(high))


GIL = "gil:K=it.stiffness,B=it.damping,b=device.damping,T=tick.period,t_d=it.delay"


def test_an_overlay_takes_its_symbols_from_the_scene() -> None:
    overlay = parse_overlay(wall(0.1, 5.0, 0.001, 900.0, 0.25), GIL)
    assert symbol_values(wall(0.1, 5.0, 0.001, 900.0, 0.25), overlay) == (900.0, 5.0, 0.25, 0.001, 0.001)
    assert overlay.label == "Gil et al.: K < (b + B)/(T/2 + t_d)"


def test_an_overlay_follows_expressions_and_groups() -> None:
    text = AVERAGE.replace("clocks:", "parameters: {kc: 900 N/m}\nclocks:", 1).replace("1000 N/m", "kc")
    text = text.replace("user: {count: 3}", "a: {count: 1, set: {device.damping: 7 N*s/m}}\n  b: {count: 2}")
    model = compiled(text)
    words = "colgate:K=contact.stiffness,B=0 N*s/m,b=a.device.damping,T=haptic.period"
    overlay = parse_overlay(model, words)
    assert symbol_values(model, overlay) == (900.0, 7.0, 0.0, 0.001)
    curve = overlay_points(model, overlay, _on("kc", 10.0, 20_000.0), _on("haptic.period", 0.0005, 0.002))
    assert curve[:, 0] * curve[:, 1] == pytest.approx(2 * 7, rel=1e-12)
    message = told(parse_overlay, model, words.replace("a.device", "device"))
    assert message == [
        "overlay: E886 device.damping differs between peers, and b is one number. Write: b=a.device.damping"
    ]


def test_the_curve_of_an_overlay_runs_from_border_to_border() -> None:
    model = wall(0.1, 5.0, 0.001, 900.0)
    overlay = parse_overlay(model, GIL)
    curve = overlay_points(model, overlay, _on("it.stiffness", 0.0, 4000.0), _on("it.damping", 0.0, 3.0))
    # K = (5 + B)/1.5e-3 from (3333.3, 0) to (4000, 1).
    assert curve[0] == pytest.approx([5 / 1.5e-3, 0], rel=1e-12)
    assert curve[-1] == pytest.approx([4000, 1], rel=1e-12)
    assert curve[:, 0] == pytest.approx((5 + curve[:, 1]) / 1.5e-3, rel=1e-12)
    assert (np.diff(curve, axis=0) >= 0).all()
    swapped = overlay_points(model, overlay, _on("it.damping", 0.0, 3.0), _on("it.stiffness", 0.0, 4000.0))
    assert swapped[:, ::-1] == pytest.approx(curve, rel=1e-12)


def test_a_falling_curve_and_one_parallel_to_an_axis_are_in_order() -> None:
    model = wall(0.1, 5.0, 0.001, 900.0)
    overlay = parse_overlay(model, COLGATE)
    curve = overlay_points(model, overlay, _on("it.stiffness", 0.0, 20_000.0), _on("it.damping", 0.0, 8.0))
    assert curve[0] == pytest.approx([0, 5], rel=1e-12)
    assert curve[-1] == pytest.approx([10_000, 0], rel=1e-12)
    assert (np.diff(curve[:, 0]) >= 0).all() and (np.diff(curve[:, 1]) <= 0).all()
    line = overlay_points(model, overlay, _on("device.mass", 0.1, 1.0), _on("it.stiffness", 0.0, 20_000.0))
    assert line[:, 1] == pytest.approx(10_000, rel=1e-12)
    assert (line[0, 0], line[-1, 0]) == (0.1, 1.0)


def test_a_condition_that_holds_in_the_whole_window_has_no_curve() -> None:
    model = wall(0.1, 5.0, 0.001, 900.0)
    overlay = parse_overlay(model, COLGATE)
    assert overlay_points(
        model, overlay, _on("it.stiffness", 0.0, 100.0), _on("it.damping", 0.0, 1.0)
    ).shape == (
        0,
        2,
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "colgate",
            "overlay: E886 an overlay wants CONDITION:SYMBOL=NAME,…, got colgate. "
            "Write: colgate:K=contact.stiffness,B=contact.damping,b=device.damping,T=haptic.period",
        ),
        (
            "colgat:K=it.stiffness",
            "overlay: E886 colgat is no published condition known here (colgate, gil, diolaiti, abbott). "
            "Write: colgate",
        ),
        (
            "colgate:K",
            "overlay: E886 a symbol wants SYMBOL=NAME, got K. "
            "Write: colgate:K=contact.stiffness,B=contact.damping,b=device.damping,T=haptic.period",
        ),
        ("colgate:Q=it.stiffness", "overlay: E886 b > K T/2 + |B| has no Q; it has K, b, B, T."),
        ("colgate:K=it.stiffness,K=1 N/m", "overlay: E886 K is given twice."),
        (
            "colgate:K=it.stiffness,b=device.damping,B=0 N*s/m",
            "overlay: E886 b > K T/2 + |B| needs T, the sampling period. "
            "Write: colgate:K=it.stiffness,b=device.damping,B=0 N*s/m,T=… (a parameter or a quantity in ms)",
        ),
        (
            "colgate:K=it.stifness",
            "overlay: E622 it.stifness is no parameter of wall. Write: it.stiffness",
        ),
        (
            "colgate:K=it.damping",
            "overlay: E204 K, the stiffness of the virtual wall, wants N/m, got it.damping in N*s/m.",
        ),
        ("colgate:T=1", "overlay: E204 T wants ms, got 1 (no unit). Write: T: 1 ms"),
    ],
)
def test_a_faulty_overlay_gets_one_clear_message(text: str, message: str) -> None:
    assert told(parse_overlay, wall(0.1, 5.0, 0.001, 900.0), text) == [message]
