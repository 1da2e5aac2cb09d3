"""Many points at once: each as its own analysis says, and the truth in sixty digits within its bound."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest

import apc
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.spectrum.ball_arithmetic import precision
from apc.studies.batch_analysis import Analyses
from tests.paper_limit import BITS, truth
from tests.topologies import AVERAGE, MESH, OSCILLATOR, ROOT, TOPOLOGIES, compiled, messages_of, replaced


def as_alone(model: Model, given: Mapping[str, Any], points: Any = None) -> Analyses:
    """Analyse points and assert that each, or each of some, is as its own analysis says."""
    found = apc.analyze_many(model, given)
    rows = apc.parameters(model).rows
    units = {
        name: next(one.unit for one in rows if one.name.endswith(name) or name.endswith(one.name))
        for name in given
    }
    shape = found.verdict.shape
    listed = [np.broadcast_to(values, shape).ravel() for values in found.values]
    radii, errors = found.spectral_radius.ravel(), found.spectral_radius_error.ravel()
    for point in points if points is not None else range(found.verdict.size):
        settings = {}
        for name, values in zip(given, listed, strict=True):
            settings[name] = f"{float(values[point])!r} {units[name]}".removesuffix(" 1")
        try:
            one = apc.analyze(model, params=settings)
        except ApcError as error:
            assert found.verdict.ravel()[point] == f"error: {error.mistakes[0].code}"
            assert found.message.ravel()[point] == error.mistakes[0].sentence
            continue
        printed = found.verdict.ravel()[point], found.rigid_modes.ravel()[point]
        assert printed == (one.verdict, one.rigid_modes)
        assert abs(radii[point] - one.spectral_radius) <= errors[point] + one.spectral_radius_error
        # A defective cluster, split by itself alone, costs a stack more.
        assert errors[point] <= 8 * one.spectral_radius_error + 1e-15
        # What the radius may be off by, the angle and the rate may be too.
        away = 100 * (errors[point] + one.spectral_radius_error) / one.frame_s + 1e-12
        motion = (found.frequency_hz.ravel()[point], found.damping_ratio.ravel()[point])
        leading = (one.modes[0].frequency_hz, one.modes[0].damping_ratio)
        assert motion == pytest.approx(leading, rel=1e-10, abs=max(away, 1e-9), nan_ok=True)
    return found


EVERY_TOPOLOGY = sorted(
    path
    for path in (*TOPOLOGIES.glob("*.yaml"), *(ROOT / "tests" / "hard").glob("*.yaml"))
    if path.stem
    not in ("million-peers", "non-commensurate", "chain-of-masses", "nearly-defective", "high-rate-ratio")
)


@pytest.mark.few(4)
@pytest.mark.parametrize("points", [2, 6])
@pytest.mark.parametrize("path", EVERY_TOPOLOGY, ids=lambda path: path.stem)
def test_every_point_is_as_an_analysis_of_its_own_says(path: Path, points: int) -> None:
    model = apc.compile(path)
    rows = apc.parameters(model).rows
    free = [one for one in rows if one.low == one.high and not (one.follows or one.fixed) and one.unit != "s"]
    free = [one for one in free if not one.name.endswith((".x", ".v", ".count", "loss", ".start"))][:3]
    random = np.random.default_rng(len(path.stem))
    drawn = {one.name: (one.low or 1.0) * random.uniform(0.5, 1.7, points) for one in free}
    for one in free:
        drawn[one.name][0] = one.low
    as_alone(model, drawn)


@pytest.mark.parametrize("damping", [0.0, pytest.param(2.0, marks=pytest.mark.whole)])
@pytest.mark.parametrize("mesh", [False, True])
def test_the_truth_in_sixty_digits_is_within_every_bound(mesh: bool, damping: float) -> None:
    random = np.random.default_rng(int(mesh) + int(damping))
    k_c, k_t = random.uniform(10, 5000, (2, 40))
    given = {"contact.stiffness": k_c, "coordination.stiffness": k_t}
    given |= {"contact.damping": damping, "coordination.damping": damping}
    found = apc.analyze_many(compiled(MESH if mesh else AVERAGE), given)
    for place, (x, y) in enumerate(zip(k_c.tolist(), k_t.tolist(), strict=True)):
        with precision(BITS):
            known = truth(mesh, x, y, damping)
            off = float(abs(known.radius - flint.arb(found.spectral_radius[place])).mid())
            assert found.stable[place] == bool(known.radius < 1)
        assert off <= found.spectral_radius_error[place]


def test_where_a_stiffness_of_zero_frees_a_motion_it_is_counted() -> None:
    """Without coordination each peer moves by itself; with the contact gone the devices do so, too."""
    contact, coordination = np.meshgrid([0.0, 800.0, 4000.0], [0.0, 300.0])
    found = as_alone(
        compiled(AVERAGE), {"contact.stiffness": contact, "coordination.stiffness": coordination}
    )
    assert set(found.rigid_modes.ravel().tolist()) == {1, 3, 4, 6}
    # An arm of stiffness 0 frees all.
    as_alone(apc.compile(TOPOLOGIES / "star-lecture.yaml"), {"arm.stiffness": np.array([0.0, 100.0])})


def test_whole_turns_in_a_frame_are_counted() -> None:
    """m x″ + d x′ + k x = 0 over a frame of a second: √(k/m − d²/4m²)/2π, however often it turns."""
    hertz = np.array([0.3, 0.7, 3.3, 10.2, 10.45, 40.2])
    stiffness = (2 * math.pi * hertz) ** 2
    found = apc.analyze_many(
        compiled(OSCILLATOR.format(stiffness=1000, damping=0.5)), {"s.stiffness": stiffness}
    )
    assert found.frequency_hz == pytest.approx(np.sqrt(stiffness - 0.25**2) / (2 * math.pi), rel=1e-10)
    assert found.damping_ratio == pytest.approx(0.25 / np.sqrt(stiffness), rel=1e-9)


def test_what_enters_as_a_ratio_alone_is_moved_all_the_same() -> None:
    """Without clocks A has k/m and d/m and nothing else: moved all alike, these stay."""
    model = compiled(replaced(OSCILLATOR.format(stiffness=50, damping=4), ("1 kg", "2 kg")))
    mass, stiffness = np.array([2.0, 4.0, 3.0]), np.array([50.0, 70.0, 90.0])
    found = apc.analyze_many(model, {"device.mass": mass, "s.stiffness": stiffness, "s.damping": mass * 2})
    assert found.spectral_radius == pytest.approx([math.exp(-1)] * 3, rel=1e-12)  # e^{−d/(2m)}
    assert found.frequency_hz == pytest.approx(np.sqrt(stiffness / mass - 1) / (2 * math.pi), rel=1e-10)


FORMULAS = replaced(
    AVERAGE,
    ("clocks:", "parameters: {kt: 900 N/m, share: 0.5, lead: 0.1 ms}\nclocks:"),
    ("stiffness: 500 N/m", "stiffness: kt*share/(peers - 1), damping: (kt + share*kt)*lead"),
)
GROUPS = replaced(
    AVERAGE, ("  user: {count: 3}\n", "  one: {count: 1, set: {device.mass: 0.2 kg}}\n  other: {count: 2}\n")
)


def test_what_follows_from_a_value_follows_and_values_at_fault_say_so() -> None:
    found = as_alone(
        compiled(FORMULAS),
        {
            "kt": np.array([900.0, 1234.5, -3.0, 700.0, 100.1, 350.25]),
            "share": np.array([0.5, 0.1, 0.3, -1.0, 0.7, 1.3]),
            "contact.stiffness": np.array([1000.0, 700.0, 500.0, 300.0, -1.0, 1500.0]),
        },
    )
    assert [str(one).startswith("error: E624") for one in found.verdict] == [
        *(False, False, True, True, True, False)
    ]


# 0.1 and 0.2 kg are what the others have: peers are alike there that differ elsewhere.
@pytest.mark.parametrize(
    "name", ["one.contact.stiffness", "other.device.mass", "device.mass", "one.device.mass"]
)
def test_a_group_has_its_own_value_and_everybody_theirs(name: str) -> None:
    values = np.array([0.1, 0.15, 0.2, 0.25]) * (5000 if "stiffness" in name else 1)
    as_alone(compiled(GROUPS), {name: values})


def test_times_vary_beside_numbers_each_with_its_own_schedule() -> None:
    delay, stiffness = np.array([[0.0], [0.008], [0.0125], [0.02]]), np.linspace(300, 1900, 5)
    given = {"lan.delay": delay, "contact.stiffness": stiffness, "contact.delay": ["1 ms"]}
    assert as_alone(compiled(AVERAGE), given).verdict.shape == (4, 5)


def test_no_point_beside_a_double_eigenvalue_has_a_far_wider_bound() -> None:
    """At 1708 N/m and 10 N/m two eigenvalues nearly meet, and the vectors nearly are one."""
    contact, coordination = np.meshgrid(np.linspace(10, 3000, 200), [10.0, 25.0])
    given = {"contact.stiffness": contact, "coordination.stiffness": coordination}
    errors = apc.analyze_many(compiled(AVERAGE), given).spectral_radius_error
    assert errors.max() < 100 * np.median(errors)


def test_the_result_is_a_table_a_text_and_plain_data() -> None:
    pytest.importorskip("pandas")
    values = ["500 N/m", "2 kN/m", "-1 N/m"]
    found = apc.analyze_many(TOPOLOGIES / "three-users-average.yaml", {"contact.stiffness": values})
    table = found.to_dataframe()
    assert list(table.columns) == [
        *("contact.stiffness [N/m]", "verdict", "spectral_radius", "spectral_radius_error", "rigid_modes"),
        *("frequency [Hz]", "damping_ratio", "message"),
    ]
    assert table["contact.stiffness [N/m]"].tolist() == [500, 2000, -1]
    assert found.stable.tolist() == [True, False, False] and found.to_dict()["spectral_radius"][2] is None
    first, second = str(found).splitlines()[:2]
    assert (first, second) == ("three-users-average: 3 points", "  contact.stiffness [N/m]: -1 … 2000")
    assert "at 1 of them: contact.stiffness: expected at least 0 N/m, got -1 N/m." in str(found)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, 'E883 no parameter is varied. Try: {"contact.stiffness": [500.0, 1000.0]}'),
        (
            {"contact.stiffness": [math.nan]},
            "E881 values of contact.stiffness: expected finite numbers, in N/m, got [nan].",
        ),
        (
            {"contact.stiffness": []},
            "E881 values of contact.stiffness: expected finite numbers, in N/m, got [].",
        ),
        (
            {"contact.stiffness": [1.0, 2.0], "device.mass": [1.0, 2.0, 3.0]},
            "E881 values of the shapes (2,) and (3,) can't be broadcast against one another.",
        ),
        (
            {"contact.stiffness": 1.0, "couplers.contact.stiffness": 2.0},
            "E883 contact.stiffness is given twice.",
        ),
    ],
)
def test_values_that_are_none_are_told(values: dict[str, Any], message: str) -> None:
    (got,) = messages_of(apc.analyze_many, compiled(AVERAGE), values)
    assert got.startswith(f"analyze_many: {message}")
