"""Claims about `apc.analyze_many`, and what a sweep shares with it: a point is as its own analysis says."""

from __future__ import annotations

import math
from dataclasses import fields
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest

import apc
from apc.analysis.analysis import analyze
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.eigen.balls import precision
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.vary import many
from apc.vary.evaluator import free_parameters
from apc.vary.many import Analyses, analyze_many
from tests.fifty_digits.truth import spectral_truth
from tests.paper_limit import BITS, truth
from tests.topologies import AVERAGE, MESH, OSCILLATOR, ROOT, SCENES, compiled, replaced, told


def scene(path: Path) -> CompiledSystem:
    return apc.compile(path)


def alone(system: CompiledSystem, found: Analyses, names: list[Free], point: int) -> None:
    """Assert that a point is as its own analysis says."""
    overrides = [
        Override(name, Fraction(repr(float(values.ravel()[point]))))
        for name, values in zip(names, found.values, strict=True)
    ]
    try:
        one = analyze(apply(system, overrides))
    except ApcError as error:
        assert found.verdict[point] == f"error: {error.mistakes[0].code}"
        assert found.message[point] == error.mistakes[0].sentence
        return
    assert found.verdict[point] == one.verdict
    assert found.rigid_modes[point] == one.rigid_modes
    off = abs(found.spectral_radius[point] - one.spectral_radius)
    assert off <= found.spectral_radius_error[point] + one.spectral_radius_error
    # Points share the largest of what their frames round, so that a bound may be some times an own one's.
    assert found.spectral_radius_error[point] <= 4 * one.spectral_radius_error + 1e-15
    assert np.isnan(found.frequency_hz[point]) == np.isnan(one.modes[0].frequency_hz)
    if not np.isnan(one.modes[0].frequency_hz):
        # What the radius may be off by, the angle and the rate may be too.
        away = 100 * (found.spectral_radius_error[point] + one.spectral_radius_error) / one.frame_s + 1e-12
        assert found.frequency_hz[point] == pytest.approx(one.modes[0].frequency_hz, rel=1e-11, abs=away)
        assert found.damping_ratio[point] == pytest.approx(one.modes[0].damping_ratio, rel=1e-10, abs=1e-9)


class Counted:
    """How many points had an analysis of their own."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.points = 0
        own = many.analyze

        def analyze_one(*given: Any, **named: Any) -> Any:
            self.points += 1
            return own(*given, **named)

        monkeypatch.setattr(many, "analyze", analyze_one)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Counted:
    return Counted(monkeypatch)


EVERY_SCENE = sorted(
    path
    for path in (*SCENES.glob("*.yaml"), *(ROOT / "tests" / "hard").glob("*.yaml"))
    if path.stem
    not in ("million-peers", "non-commensurate", "chain-of-masses", "nearly-defective", "high-rate-ratio")
)


@pytest.mark.few(len(EVERY_SCENE))
@pytest.mark.parametrize("path", EVERY_SCENE, ids=lambda path: path.stem)
@pytest.mark.parametrize("points", [2, 6])
def test_every_point_is_as_an_analysis_of_its_own_says(path: Path, points: int) -> None:
    system = scene(path)
    names = free_parameters(system)[:3]
    random = np.random.default_rng(len(path.stem))
    base = np.array([[next(p.value for p in system.parameters if p.name == name.name)] for name in names])
    drawn = np.where(base, base, 1.0) * random.uniform(0.5, 1.7, (len(names), points))
    drawn[:, 0] = base[:, 0]
    found = analyze_many(system, {name.label: row for name, row in zip(names, drawn, strict=True)})
    for point in range(drawn.shape[1]):
        alone(system, found, names, point)


@pytest.mark.few(2)
@pytest.mark.parametrize("damping", [0.0, 2.0])
@pytest.mark.parametrize("mesh", [False, True])
def test_the_truth_in_sixty_digits_is_within_every_bound(
    mesh: bool, damping: float, counted: Counted
) -> None:
    random = np.random.default_rng(int(mesh) + int(damping))
    k_c, k_t = random.uniform(10, 5000, (2, 120))
    given = {"contact.stiffness": k_c, "coordination.stiffness": k_t}
    given |= {"contact.damping": damping, "coordination.damping": damping}
    found = analyze_many(compiled(MESH if mesh else AVERAGE), given)
    assert counted.points <= 2
    for place, (x, y) in enumerate(zip(k_c.tolist(), k_t.tolist(), strict=True)):
        with precision(BITS):
            known = truth(mesh, x, y, damping)
            off = float(abs(known.radius - flint.arb(found.spectral_radius[place])).mid())
            assert found.stable[place] == bool(known.radius < 1)
        assert off <= found.spectral_radius_error[place]


@pytest.mark.parametrize("name", ["mixed-clocks", "star-lecture"])
def test_the_truth_of_other_scenes_is_within_every_bound(name: str) -> None:
    system = scene(SCENES / f"{name}.yaml")
    values = np.random.default_rng(3).uniform(200, 2500, 6)
    found = analyze_many(system, {"contact.stiffness": values})
    for place, value in enumerate(values.tolist()):
        known = spectral_truth(apply(system, [Override(Free("contact.stiffness"), Fraction(value))]))
        assert not isinstance(known, str)
        off = float(abs(known.radius - flint.arb(found.spectral_radius[place])).mid())
        assert off <= found.spectral_radius_error[place]
        assert found.rigid_modes[place] == known.rigid


def test_where_a_stiffness_of_zero_frees_a_motion_it_is_counted() -> None:
    """Without coordination each peer moves by itself; with the contact gone the devices do so, too."""
    system = compiled(AVERAGE)
    names = [Free("contact.stiffness"), Free("coordination.stiffness")]
    grid = np.array(np.meshgrid([0.0, 800.0, 4000.0], [0.0, 300.0])).reshape(2, -1)
    found = analyze_many(system, dict(zip([name.label for name in names], grid, strict=True)))
    assert set(found.rigid_modes.tolist()) == {1, 3, 4, 6}
    for point in range(grid.shape[1]):
        alone(system, found, names, point)


def test_whole_turns_in_a_frame_are_counted(counted: Counted) -> None:
    """m x″ + d x′ + k x = 0 over a frame of a second: √(k/m − d²/4m²)/2π, however often it turns."""
    system = compiled(OSCILLATOR.format(stiffness=1000, damping=0.5))
    hertz = np.array([0.3, 0.7, 3.3, 10.2, 10.45, 40.2])
    stiffness = (2 * math.pi * hertz) ** 2
    found = analyze_many(system, {"s.stiffness": stiffness})
    expected = np.sqrt(stiffness - 0.25**2) / (2 * math.pi)
    assert found.frequency_hz == pytest.approx(expected, rel=1e-10)
    assert found.damping_ratio == pytest.approx(0.25 / np.sqrt(stiffness), rel=1e-9)


FORMULAS = replaced(
    AVERAGE,
    ("clocks:", "parameters: {kt: 900 N/m, share: 0.5}\nclocks:"),
    ("stiffness: 500 N/m", "stiffness: kt*share/(peers - 1)"),
)


def test_what_follows_from_a_value_follows_and_keeps_its_bounds(counted: Counted) -> None:
    system = compiled(FORMULAS)
    names = [Free("kt"), Free("share"), Free("contact.stiffness")]
    kt = np.array([900.0, 1234.5, -3.0, 700.0, 100.1, 350.25])
    share = np.array([0.5, 0.1, 0.3, -1.0, 0.7, 1.3])
    stiffness = np.array([1000.0, 700.0, 500.0, 300.0, -1.0, 1500.0])
    found = analyze_many(system, {"kt": kt, "share": share, "contact.stiffness": stiffness})
    faults = [str(one)[:11] == "error: E624" for one in found.verdict]
    assert faults == [False, False, True, True, True, False]
    assert counted.points == 0  # those at fault have none
    for point in range(len(kt)):
        alone(system, found, names, point)


@pytest.mark.parametrize(("damping", "worked_out"), [("kt*lead", 12), ("(kc + kt)*lead", 36)])
def test_what_follows_from_two_values_apart_is_worked_out_once_for_each(
    damping: str, worked_out: int, counted: Counted, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = compiled(
        replaced(
            AVERAGE,
            ("peers:\n", "parameters: {kc: 1000 N/m, kt: 500 N/m, lead: 0.1 ms}\npeers:\n"),
            ("stiffness: 1000 N/m", "stiffness: kc"),
            ("stiffness: 500 N/m", f"stiffness: kt, damping: {damping}"),
        )
    )
    resolved: list[object] = []
    resolve = many.resolve
    kc, kt = (one.ravel() for one in np.meshgrid(np.linspace(300, 1800, 6), np.linspace(100, 900, 6)))
    analyze_many(system, {"kc": kc[:3] / 7, "kt": kt[:3] / 7})  # what the scene's points share is made ready
    monkeypatch.setattr(many, "resolve", lambda given: resolved.append(given) or resolve(given))
    found = analyze_many(system, {"kc": kc, "kt": kt})
    assert (counted.points, len(resolved)) == (0, worked_out)
    for point in (0, 7, 20, 35):
        alone(system, found, [Free("kc"), Free("kt")], point)


GROUPS = replaced(
    AVERAGE,
    (
        "  user: {count: 3}\n",
        "  one: {count: 1, set: {device.mass: 0.2 kg}}\n  other: {count: 2}\n",
    ),
)


@pytest.mark.parametrize(
    "name", ["one.contact.stiffness", "other.device.mass", "device.mass", "one.device.mass"]
)
def test_a_group_has_its_own_value_and_everybody_theirs(name: str, counted: Counted) -> None:
    """0.1 and 0.2 kg are what the others have: peers are alike there that differ elsewhere."""
    system = compiled(GROUPS)
    values = np.array([0.1, 0.15, 0.2, 0.25]) * (5000 if "stiffness" in name else 1)
    found = analyze_many(system, {name: values})
    group, _, rest = name.partition(".")
    free = Free(rest, group) if group in ("one", "other") else Free(name)
    assert counted.points <= 1
    for point in range(len(values)):
        alone(system, found, [free], point)


def test_times_vary_beside_numbers_each_with_its_own_schedule(counted: Counted) -> None:
    system = compiled(AVERAGE)
    names = [Free("lan.delay"), Free("contact.stiffness"), Free("contact.delay")]
    delay, stiffness = np.array([[0.0], [0.008], [0.0125], [0.02]]), np.linspace(300, 1900, 5)
    found = analyze_many(
        system, {"lan.delay": delay, "contact.stiffness": stiffness, "contact.delay": ["1 ms"]}
    )
    assert found.verdict.shape == (4, 5)
    assert counted.points <= 1
    flat = Analyses(
        *(found.topology, found.parameters, tuple(one.ravel() for one in found.values)),
        *(getattr(found, one.name).ravel() for one in fields(many.Rows)),
        found.left_out,
    )
    for point in range(20):
        alone(system, flat, names, point)


def test_a_scene_that_is_not_affine_is_analysed_point_by_point(counted: Counted) -> None:
    system = scene(SCENES / "experiment-average.yaml")
    found = analyze_many(system, {"contact.stiffness": [500.0, 900.0]})
    assert counted.points == 2
    assert found.left_out == apc.analyze(system).left_out
    assert (
        found.spectral_radius[0] == apc.analyze(system, set={"contact.stiffness": "500 N/m"}).spectral_radius
    )


def test_the_result_is_a_table_a_text_and_plain_data() -> None:
    pytest.importorskip("pandas")
    values = ["500 N/m", "2 kN/m", "-1 N/m"]
    found = apc.analyze_many(SCENES / "three-users-average.yaml", {"contact.stiffness": values})
    table = found.to_dataframe()
    assert list(table.columns) == [
        *("contact.stiffness [N/m]", "verdict", "spectral_radius", "spectral_radius_error", "rigid_modes"),
        *("frequency [Hz]", "damping_ratio", "message"),
    ]
    assert table["contact.stiffness [N/m]"].tolist() == [500, 2000, -1]
    assert found.stable.tolist() == [True, False, False]
    document = found.to_dict()
    assert document["spectral_radius"][2] is None
    first, second = str(found).splitlines()[:2]
    assert (first, second) == ("three-users-average: 3 points", "  contact.stiffness [N/m]: -1 … 2000")
    assert "at 1 of them: contact.stiffness wants at least 0 N/m, got -1 N/m." in str(found)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, 'E883 nothing varies. Write: {"contact.stiffness": [500.0, 1000.0]}'),
        (
            {"contact.stifness": 1.0},
            "E622 contact.stifness is no parameter of three-users-average. Write: contact.stiffness",
        ),
        (
            {"contact.stiffness": [math.nan]},
            "E881 the values of contact.stiffness wants finite numbers, in N/m, got [nan].",
        ),
        (
            {"contact.stiffness": []},
            "E881 the values of contact.stiffness wants finite numbers, in N/m, got [].",
        ),
        ({"contact.stiffness": ["5 kg"]}, "E204 contact.stiffness wants N/m, got 5 kg."),
        (
            {"contact.stiffness": [1.0, 2.0], "device.mass": [1.0, 2.0, 3.0]},
            "E881 values of shapes that can't be broadcast wants equal shapes, got (2,) and (3,).",
        ),
        (
            {"contact.stiffness": 1.0, "couplers.contact.stiffness": 2.0},
            "E883 contact.stiffness is given twice.",
        ),
    ],
)
def test_values_that_are_none_are_told(values: dict[str, Any], message: str) -> None:
    (got,) = told(analyze_many, compiled(AVERAGE), values)
    assert got.startswith(f"analyze_many: {message}")


def test_no_point_beside_a_double_eigenvalue_has_a_far_wider_bound() -> None:
    """At 1708 N/m and 10 N/m two eigenvalues nearly meet, and the vectors nearly are one."""
    contact, coordination = np.meshgrid(np.linspace(10, 3000, 200), [10.0, 25.0])
    found = analyze_many(
        compiled(AVERAGE), {"contact.stiffness": contact, "coordination.stiffness": coordination}
    )
    assert found.spectral_radius_error.max() < 2 * many.WIDER * np.median(found.spectral_radius_error)
