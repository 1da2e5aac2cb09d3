"""How far each number may grow: rows that hold, notes where one was not looked for."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.analysis.analysis import analyze
from apc.compiler.compiled import Model
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.parameter_names import ParameterRef
from apc.studies.evaluator import evaluator
from apc.studies.margins import Margin
from apc.studies.parameter_path import DelayPath, MatrixPath, verdict_of
from apc.studies.timing_values import delay_now
from tests import bruteforce
from tests.language.own import component
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, library, replaced
from tests.truths import text_of
from tests.varying.test_critical_values import HARD, PRESSED, stable_at

SAMPLED = "stiffness: 1000 N/m, clock: haptic, delay: 1 ms"

DEAD_RECKONING = """
topology: dead-reckoning
clocks: {haptic: 1 ms, network: 8 ms}
peers: {user: {count: 2}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube:   {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  contact:      {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic,
                 delay: 1 ms}
  coordination: {type: DeadReckoning, object: cube, stiffness: 200 N/m, damping: 5 N*s/m,
                 threshold: 0.1 mm, clock: haptic, delay: 1 ms, link: lan}
links: {lan: {clock: network, delay: 8 ms, loss: 0 %}}
hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 100 N/m, damping: 2 N*s/m}}
"""


def hasty(delay: str, stiffness: str = "60 N/m") -> str:
    """Return two users whose frame is a tick, so that many packets are on their way."""
    return replaced(
        *(AVERAGE, ("count: 3", "count: 2"), ("network: 8 ms", "network: 1 ms")),
        *(("delay: 8 ms", f"delay: {delay}"), ("stiffness: 500 N/m", f"stiffness: {stiffness}")),
    )


def rows_of(model: Model) -> dict[str, Margin]:
    return {one.parameter: one for one in apc.margins(model).rows}


def holds(model: Model, one: Margin) -> None:
    """Assert that analyses decide otherwise on both sides of a margin."""
    assert one.value is not None and one.error is not None
    assert one.value > one.current and one.error <= 1e-6 * one.value
    aside = max(2 * one.error, 1e-8 * one.value)
    assert [stable_at(model, one, Fraction(one.value + side * aside)) for side in (-1, 1)] == [True, False]
    assert one.gain_margin == (one.value / one.current if one.current else None)


def test_every_stiffness_damping_and_delay_of_a_coupler_has_a_row() -> None:
    assert list(rows_of(compiled(AVERAGE))) == [
        *("contact.stiffness", "contact.damping", "coordination.stiffness", "coordination.damping"),
        *("contact.delay", "coordination.delay", "lan.delay"),
    ]
    assert all(
        one.value is not None or one.searched_to > one.current for one in rows_of(compiled(AVERAGE)).values()
    )


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("topology", "names"),
    [
        (AVERAGE, ["contact.stiffness", "contact.damping", "coordination.damping", "contact.delay"]),
        (PRESSED, ["contact.delay"]),
        # Its equations ask how old packets are: a delay moves where a kind starts.
        (DEAD_RECKONING, ["contact.delay"]),
        (hasty("12 ms"), ["contact.stiffness", "coordination.stiffness", "contact.delay"]),
        (hasty("30 ms"), ["contact.stiffness", "contact.delay"]),
        # 250 states, 200 of them packets on their way.
        pytest.param(hasty("50 ms"), ["contact.delay"], marks=pytest.mark.whole),
        # 72 states, of which each number moves as many.
        pytest.param(
            "different-peers", ["contact.stiffness", "coordination.damping"], marks=pytest.mark.whole
        ),
    ],
    ids=["average", "pressed", "dead reckoning", "12 ms", "30 ms", "50 ms", "different"],
)
def test_a_margin_lies_between_two_analyses(topology: str, names: Sequence[str]) -> None:
    model = compiled(topology) if "\n" in topology else apc.compile(HARD / f"{topology}.yaml")
    rows = rows_of(model)
    for name in names:
        assert not rows[name].note
        holds(model, rows[name])


@pytest.mark.whole
def test_a_delay_without_a_margin_is_stable_as_far_as_it_was_scanned() -> None:
    model = compiled(DEAD_RECKONING)
    row = rows_of(model)["coordination.delay"]
    assert row.value is None
    for share in (0.3, 0.6, 0.9):
        assert apc.analyze(model, params={row.parameter: f"{share * row.searched_to} s"}).stable


def test_a_topology_that_is_not_stable_has_no_margins_and_says_so() -> None:
    found = apc.margins(compiled(AVERAGE), params={"coordination.stiffness": "2000 N/m"})
    assert found.rows == () and "not stable" in str(found)


@pytest.mark.whole
def test_a_delay_is_scanned_far_enough_or_said_not_to_be() -> None:
    text = replaced(AVERAGE, (SAMPLED, SAMPLED.replace("1 ms", "0.13 ms")))
    for one in rows_of(compiled(text)).values():
        assert (one.value is not None or one.searched_to >= 1.5 * one.current) and one.note == ""
    # 0.95 ms and 1 ms meet at every twentieth of a millisecond.
    found = apc.margins(compiled(replaced(text, ("network: 8 ms", "network: 0.95 ms"))))
    row = next(one for one in found.rows if one.parameter == "lan.delay")
    assert row.value is None and re.fullmatch(r"\d+ orders of events up to 0\.012\d* s", row.note)
    assert f"not searched: {row.parameter}: {row.note}" in str(found)


@pytest.mark.whole
def test_a_links_delay_that_no_way_has_is_no_margin() -> None:
    text = replaced(
        AVERAGE,
        ("  user: {count: 3}", "  one: {count: 1}\n  two: {count: 1}"),
        ("delay: 8 ms}", "delay: 8 ms, delays: {one: {two: 16 ms}, two: {one: 9 ms}}}"),
    )
    rows = {row.parameter for row in apc.margins(compiled(text)).rows}
    assert {"lan.delays.one.two", "lan.delays.two.one"} <= rows and "lan.delay" not in rows
    one_direction = replaced(text, ("two: {one: 9 ms}", "two: {one: 8 ms}"), ("one: {two: 16 ms}, ", ""))
    assert "lan.delay" in {row.parameter for row in apc.margins(compiled(one_direction)).rows}


@pytest.mark.whole
def test_of_very_large_systems_delays_are_said_not_to_be_looked_for() -> None:
    notes = {one.parameter: one.note for one in rows_of(apc.compile(HARD / "very-long-delay.yaml")).values()}
    assert {notes[name] for name in ("contact.delay", "coordination.delay")} == {
        "2,006 states in each order of events"
    }


@pytest.mark.whole
def test_in_passing_what_takes_long_is_named_with_the_option_that_asks_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two users 100 ms apart: 400 packets on their way, in whose matrices a delay takes some 20 seconds."""
    text = replaced(hasty("100 ms", "30 N/m"), ("1000 N/m", "100 N/m"))
    (tmp_path / "topology.yaml").write_text(text, encoding="utf-8")
    assert run(["analyze", str(tmp_path / "topology.yaml")]) == 0
    text = capsys.readouterr().out
    assert "not computed by default for a topology of this size (apc analyze --margins)" in " ".join(
        text.split()
    )
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.whole
def test_margins_are_those_of_the_function_and_left_out_where_they_are_not_wanted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "topology.yaml")
    Path(path).write_text(AVERAGE.replace("delay: 8 ms}", "delay: 8 ms, loss: 1 %}"), "utf-8")
    assert run(["analyze", path, "--no-margins"]) == 0
    assert "\n\n  not requested\n" in capsys.readouterr().out
    text = str(apc.margins(compiled(AVERAGE)))
    assert "no limit up to" in text and max(map(len, text.splitlines())) <= 80
    for words in ([], ["--margins"]):
        assert run(["analyze", str(TOPOLOGIES / "three-users-average.yaml"), *words]) == 0
        assert text.rstrip() in capsys.readouterr().out


def test_the_matrices_decide_both_sides_of_a_margin_together_as_brute_force_does() -> None:
    topology = bruteforce.TopologySource(kt=500.0, kc=1000.0)
    numeric = numeric_model(compiled(text_of(topology)))
    free = ParameterRef("contact.stiffness")
    path = MatrixPath(evaluator(numeric, [free]), numeric, np.array([1000.0]), 0)
    values = [Fraction(500), Fraction(2000), Fraction(-1)]
    *decided, invalid = path.decided_at(values[:2]) + path.decided_at(values[2:])
    assert invalid is None  # below the minimum of the parameter
    for value, verdict in zip(values, decided, strict=False):
        matrix = np.array(bruteforce.frame_matrix(replace(topology, kc=float(value))))
        eigenvalues = np.linalg.eigvals(matrix)
        moving = np.delete(eigenvalues, np.argmin(np.abs(eigenvalues - 1.0)))  # without the translation
        assert verdict is not None
        assert verdict.radius == pytest.approx(np.abs(moving).max(), abs=1e-10)
        assert verdict.stable == (np.abs(moving).max() < 1)
    assert [verdict.stable for verdict in decided if verdict] == [True, False]


def test_the_search_of_a_delay_begins_with_the_analysis_at_the_present_value() -> None:
    numeric, free = numeric_model(compiled(AVERAGE)), ParameterRef("contact.delay")
    present = delay_now(numeric.model, free)
    known = {present: verdict_of(analyze(numeric))}
    path = DelayPath(free, numeric, present, 2 * present, known=known)
    first = next(path.smooth_segments())
    values, _ = first.sample_at(first.points)
    radius = 0.95717138962509  # of the brute-force matrix, without the translation
    assert values[0, 0] == known[present].radius == pytest.approx(radius, abs=1e-13)
    assert not path.rigid  # no other matrix was built


def test_at_a_degenerate_kink_no_margin_is_lost(
    tmp_path: Path,
) -> None:
    """With f = max(k x, q x), k = q = 0, each value is analyzed alone; another mode has the radius."""
    part = component("f = max(K*sample(flange.x), Q*sample(flange.x))", "flange.f = hold(f)", variables="f=N")
    numbers = "parameters:\n  Q: {unit: N/m, default: 0 N/m}\n"
    text = (
        "topology: tie\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 1 kg, damping: 20 N*s/m}, other: {mass: 1 kg, damping: 1 N*s/m}}\n"
        "couplers:\n  own: {type: Own, flange: device, clock: tick, K: 0 N/m}\n"
        "  spring: {type: SpringDamper, a: device, b: ground, stiffness: 100 N/m}\n"
        "  slow: {type: SpringDamper, a: other, b: ground, stiffness: 1 N/m}\n"
    )
    model = compiled(text, library(tmp_path, part.replace("parameters:\n", numbers)))
    rows = {row.parameter: row for row in apc.margins(model).rows}
    assert {"own.K", "own.Q", "spring.stiffness", "slow.stiffness"} <= set(rows)
    assert rows["own.K"].searched_to >= 1e5 or rows["own.K"].value is not None
