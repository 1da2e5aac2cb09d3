"""Stability proved over a box of numbers: limits on either side, points inside, what is open or refused."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import apc
from apc.__main__ import run
from apc.compiler.compiled import Channel
from apc.compiler.errors import ApcError
from apc.extensions.loss_models.periodic_delays import trace_radius
from apc.lifting.numeric_model import numeric_model
from tests.bruteforce import TopologySource
from tests.topologies import AVERAGE, MESH, ONE_MASS, TOPOLOGIES, compiled, library, replaced
from tests.truths import text_of

LIMIT = 1096.410868365630  # tests.reference: the largest stable K_T at K_C = 1000
GROUPS = replaced(
    AVERAGE,
    (
        "  user: {count: 3}",
        "  left: {count: 2, set: {contact.stiffness: 1000 N/m}}\n"
        "  right: {count: 1, set: {contact.stiffness: 1000 N/m}}",
    ),
)
SQUARED = replaced(
    AVERAGE,
    ("peers:", "parameters: {kt: 500 N/m, unit: 2 N/m}\npeers:"),
    ("stiffness: 500 N/m", "stiffness: kt*kt/unit/(peers + 247)"),
)
DIFFERENT = text_of(TopologySource(users=({"device": 0.1}, {"device": 0.2}, {"device": 0.15})))
COLUMN = replaced(AVERAGE, ("{count: 3}", "{set: {device.mass: [0.1 kg, 0.2 kg, 0.15 kg]}}"))
ROOT_OF = (LIMIT * 500) ** 0.5  # kt²/500 is the limit


def following(formula: str) -> str:
    """Return the topology with a stiffness that follows kt by a formula."""
    return replaced(
        AVERAGE,
        ("peers:", "parameters: {kt: 500 N/m}\npeers:"),
        ("stiffness: 500 N/m", f"stiffness: {formula}"),
    )


PROVED = [
    (AVERAGE, {"contact.stiffness": "±1%"}),
    (AVERAGE, {"contact.stiffness": "±10%", "coordination.stiffness": "+-10 %"}),
    (AVERAGE, {"coordination.stiffness": "100 N/m:1 N/mm"}),
    (AVERAGE, {"device.mass": "±2%", "cube.mass": "±2%", "cube.damping": "±5%"}),
    (AVERAGE, {"couplers.contact.damping": "0 N*s/m:0.5 N*s/m"}),
    (AVERAGE, {"coordination.stiffness": f"1050 N/m:{LIMIT - 0.005} N/m"}),
    (MESH, {"coordination.stiffness": f"100 N/m:{LIMIT / 2 - 0.01} N/m"}),
    # Groups of the same numbers, of which one is opened, or both, are alike on a diagonal of the box at most.
    (GROUPS, {"left.contact.stiffness": "±5%"}),
    (GROUPS, {"left.contact.stiffness": "±5%", "right.contact.stiffness": "±5%"}),
    (DIFFERENT, {"contact.stiffness": "±1%"}),
    (SQUARED, {"kt": "490 N/m:510 N/m"}),
    (SQUARED, {"kt": f"{ROOT_OF * 0.99} N/m:{ROOT_OF * 0.9999} N/m"}),
    # What the box doesn't ask for may be no rational function.
    (following("if peers > 2 then kt else sqrt(kt*kt)/(peers - 3)"), {"kt": "±1%"}),
]

UNSTABLE = [
    (AVERAGE, {"coordination.stiffness": f"1050 N/m:{LIMIT + 0.1} N/m"}, LIMIT),
    # The contact alone allows 1865 N/m: the point is between the middle and the end.
    (AVERAGE, {"contact.stiffness": "1 N/m:3000 N/m"}, 1645),
    (GROUPS, {"left.contact.stiffness": "1000 N/m:2500 N/m"}, 1645),
    (SQUARED, {"kt": f"{ROOT_OF * 0.99} N/m:{ROOT_OF * 1.0001} N/m"}, ROOT_OF),
]


@pytest.mark.few(6)
@pytest.mark.parametrize("place", range(len(PROVED)))
def test_a_box_is_proved_and_every_point_of_it_is_stable(place: int) -> None:
    text, box = PROVED[place]
    found = apc.robust_stability(compiled(text), box)
    assert (found.stable, found.verdict, found.undecided_fraction) == (
        True,
        "stable up to a common translation",
        0.0,
    )
    generator = np.random.default_rng(place)
    for _ in range(3):
        point = {}
        for one in found.ranges:
            share = Fraction(float(generator.choice([0.0, 1.0, 0.3, 0.77])))
            unit = "" if one.unit == "1" else f" {one.unit}"
            point[one.free.label] = f"{one.low + share * (one.high - one.low)}{unit}"
        assert apc.analyze(compiled(text), params=point).stable


@pytest.mark.parametrize(("text", "box", "limit"), UNSTABLE)
def test_a_box_beyond_the_limit_is_unstable_at_a_point(text: str, box: dict[str, str], limit: float) -> None:
    found = apc.robust_stability(compiled(text), box)
    [point], [name] = found.counterexample, box
    assert found.stable is False and point > limit
    assert apc.analyze(compiled(text), params={name: f"{point!r} N/m"}).stable is False
    assert "proved unstable at" in str(found)


@settings(max_examples=12, deadline=None)
@given(centre=st.floats(-1e-3, 1e-3), exponent=st.integers(-9, -4))
def test_cells_as_small_as_their_distance_from_the_limit_are_never_wrong(
    centre: float, exponent: int
) -> None:
    low, high = (LIMIT * (1 + centre + side * 10.0**exponent) for side in (-1, 1))
    found = apc.robust_stability(compiled(AVERAGE), {"coordination.stiffness": f"{low!r} N/m:{high!r} N/m"})
    if high < LIMIT * (1 - 1e-9):
        assert found.stable is not False
    else:
        assert found.stable is not True or high < LIMIT
    assert found.stable is not None or (low < LIMIT * (1 + 1e-9) and high > LIMIT * (1 - 1e-9))


def test_what_can_not_be_proved_is_left_open_and_says_where() -> None:
    """At K_T = 0 nothing ties the copies: no box that holds this point is stable in the same sense."""
    found = apc.robust_stability(compiled(AVERAGE), {"coordination.stiffness": "0 N/m:200 N/m"}, cells=100)
    assert (found.stable, found.verdict) == (None, "undecided")
    assert 0 < found.undecided_fraction < 0.1 and 0 < found.counterexample[0] < 20
    assert max(len(line) for line in str(found).splitlines()) <= 80
    assert found.to_dict()["undecided_around"] == list(found.counterexample)
    loose = replaced(
        *(AVERAGE, ("damping: 5 N*s/m", "damping: 0 N*s/m"), ("damping: 5 N*s/m", "damping: 0 N*s/m")),
        ("500 N/m", "0 N/m"),
    )
    assert apc.robust_stability(compiled(loose), {"contact.stiffness": "±1%"}).stable is not True


@pytest.mark.whole
def test_a_box_stands_before_the_answer_and_says_that_more_cells_may_decide_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "topology.yaml").write_text(AVERAGE, encoding="utf-8")
    words = ["analyze", str(tmp_path / "topology.yaml"), "--box", "coordination.stiffness=100 N/m:1 N/mm"]
    assert run([*words, "--cells", "1"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("three-users-average: undecided in 100 % of the box (1 cell)")
    assert "--cells 10\n" in text
    assert run(words) == 0
    assert capsys.readouterr().out.startswith("three-users-average: proved stable")


def test_a_box_over_a_delay_is_stable_where_every_delay_in_it_is() -> None:
    noise = np.random.default_rng(4)
    for low, high in np.sort(noise.integers(0, 36, (6, 2)) / 2000, axis=1).tolist():
        model = apc.set_parameters(compiled(AVERAGE), {"coordination.stiffness": noise.uniform(300, 1500)})
        found = apc.robust_stability(model, {"lan.delay": (low, high + 0.0005)})
        grid = np.arange(low, high + 0.0006, 0.00025).round(7)
        stable = [apc.analyze(model, params={"lan.delay": one}).stable for one in grid]
        assert found.stable is all(stable)
        assert found.stable or not apc.analyze(model, params={"lan.delay": found.counterexample[0]}).stable


def changing(model: apc.Model, low: float, high: float) -> Any:
    return apc.robust_stability(model, {"lan.delay": (low, high)}).changing


def with_delays(model: apc.Model, delays: list[float]) -> float:
    """Return the least that a topology grows by a frame if its packets have these delays again and again."""
    channel = Channel(None, None, "uniform", "newest", "hold", np.array(delays))
    recorded = replace(model, links=tuple(replace(link, channel=channel) for link in model.links))
    return trace_radius(numeric_model(recorded)).low


def test_where_a_changing_delay_is_proved_harmless_no_delays_met_are_unstable() -> None:
    noise, proved = np.random.default_rng(3), 0
    for _ in range(8):
        numbers = {"coordination.stiffness": noise.uniform(200, 700), "user.count": int(noise.integers(2, 5))}
        model = apc.set_parameters(compiled(AVERAGE), numbers)
        if (found := changing(model, 0.008, 0.02)) is not None and found.proved_to is not None:
            proved += found.proved_to == 0.02
            ends = [0.008, found.proved_to]
            assert max(with_delays(model, noise.choice(ends, k).tolist()) for k in range(1, 9)) < 1
    assert 3 <= proved < 8


def test_delays_that_are_harmless_while_constant_are_unstable_by_turns() -> None:
    # By a program of its own, tick by tick: 0.99976 at most at constant delays, 1.0049 by turns.
    numbers = {"contact.stiffness": 320.589, "device.damping": 5.8966, "coordination.stiffness": 481.175}
    model = apc.set_parameters(compiled(AVERAGE), {**numbers, "user.count": 2})
    found = changing(model, 0.008, 0.046)
    assert found.unstable == (2, 5)
    assert with_delays(model, [0.008] * 2 + [0.046] * 5) == pytest.approx(1.004925, rel=1e-6)
    assert "unstable if 2 packets with 8 ms and 5 packets with 46 ms alternate" in " ".join(
        str(apc.robust_stability(model, {"lan.delay": (0.008, 0.046)})).split()
    )


@pytest.mark.parametrize(
    ("text", "box", "message"),
    [
        (AVERAGE, "contact.stiffness=900 N/m", "E830"),
        (AVERAGE, "contact.stiffness=±1", "E830"),
        (AVERAGE, "contact.stiffness=±x%", "E830"),
        (AVERAGE, "contact.stiffness=±0%", "E833"),
        (AVERAGE, "contact.damping=±1%", "E833 contact.damping is 0, so a relative range is empty"),
        (
            AVERAGE,
            "contact.stiffness=5 N/m:1 N/m",
            "E833 range of contact.stiffness: expected a lower limit below the upper, got 5 N/m to 1 N/m",
        ),
        (AVERAGE, "contact.stiffness=-5 N/m:1 N/m", "E833"),
        (
            AVERAGE,
            "device.mass=±200%",
            "E833 lower end of the range of device.mass: expected more than 0 kg, got -0.1 kg. "
            "Try: device.mass=0.003 kg:0.3 kg",
        ),
        (AVERAGE, "contact.delay=±1%", "E831 contact.delay is a time or sets one"),
        (AVERAGE, "contact.stiffness=900:1100", "E204"),
        (AVERAGE, "contact.stiffness=±1%|couplers.contact.stiffness=±2%", "E831"),
        (COLUMN, "device.mass=±1%", "E831 device.mass differs between groups"),
        (COLUMN, "user.device.mass=±1%", "E831 device.mass differs between the peers"),
        ("experiment-average", "contact.stiffness=±1%", "E832"),
        (
            following("sqrt(kt*kt)"),
            "kt=±1%",
            "E832 coordination.stiffness = sqrt(kt*kt) has sqrt() of a parameter in the box.",
        ),
    ],
)
def test_a_box_that_can_not_be_is_refused_in_one_message(text: str, box: str, message: str) -> None:
    model = compiled(text) if "\n" in text else apc.compile(TOPOLOGIES / f"{text}.yaml")
    with pytest.raises(ApcError) as caught:
        apc.robust_stability(model, dict(one.split("=") for one in box.split("|")))
    [mistake] = caught.value.mistakes
    assert f"{mistake.code} {mistake.sentence}".startswith(message)
    assert "Try: contact.stiffness: " not in str(caught.value)


def test_a_memory_that_nobody_reads_is_no_translation_of_a_box(tmp_path: Path) -> None:
    part = """\
component: Sum
description: A spring, and a sum of errors that nothing reads while ki is 0.
connectors: {a: Flange, b: Flange}
parameters: {k: {unit: N/m}, ki: {unit: N/m}, clock: clock}
variables: {s: {unit: m, start: 0 m}}
equations:
  - s = previous(s) + sample(a.x) - sample(b.x)
  - a.f = hold(k*(sample(a.x) - sample(b.x)) + ki*s)
  - b.f = -a.f
"""
    text = replaced(ONE_MASS, ("peers:", "clocks: {tick: 1 ms}\npeers:"))
    text += "couplers:\n  own: {type: Sum, a: device, b: ground, k: 100 N/m, ki: 0 N/m, clock: tick}\n"
    model = compiled(text, library(tmp_path, part))
    found = apc.robust_stability(model, {"own.k": "±1%"})
    assert (found.verdict, found.stable, apc.analyze(model).verdict) == ("stable", True, "stable")
