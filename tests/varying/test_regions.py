"""Stable regions of two numbers: against known curves, single analyses, critical values and fifty digits."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.__main__ import run
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.output.region_picture import stable_outlines
from apc.regions.boundary import relative_to
from apc.regions.curves import between, tangents
from apc.regions.stable_region import Region
from tests.paper_limit import limit as limit_of
from tests.reference import CONTACT_LIMITS
from tests.topologies import AVERAGE, MESH, ROOT, TOPOLOGIES, compiled, replaced

Floats = NDArray[np.float64]

X = "contact.stiffness=10 N/m:3000 N/m"
Y = "coordination.stiffness=10 N/m:3000 N/m"
TOLERANCE = 1e-9


@cache
def topology(name: str) -> Model:
    folders = (TOPOLOGIES, ROOT / "tests" / "small_topologies", ROOT / "tests" / "hard")
    return apc.compile(next(path for one in folders if (path := one / f"{name}.yaml").exists()))


@cache
def paper() -> Region:
    return apc.region(topology("three-users-average"), x=X, y=Y)


def random_points(found: Region, count: int, seed: int = 7) -> list[list[float]]:
    low, width = found.rectangle.low, found.rectangle.width
    return (low + width * np.random.default_rng(seed).uniform(0, 1, (count, 2))).tolist()


def stable(model: Model, found: Region, x: float, y: float) -> bool | None:
    values = zip((found.x, found.y), (x, y), strict=True)
    settings = {axis.free.label: f"{value!r} {axis.unit}".removesuffix(" 1") for axis, value in values}
    return apc.analyze(model, params=settings).stable


def true_error(found: Region, every: int) -> float:
    """Return the curves' largest distance from the boundary in 50 digits, relative as their `error` is."""
    worst = 0.0
    low, width = found.rectangle.low, found.rectangle.width
    for curve in found.curves:
        knots = (curve.points - low) / width
        handles = (curve.handles - low) / width
        normal = tangents(knots, handles)[:-1, ::-1] * [1, -1]
        for share in (0.0, 0.25, 0.5, 0.75):
            places = between(knots, handles, share)[1::every]
            values = found.rectangle.values(places)
            away = values[:, 1] - [limit_of(float(x), float(y)) for x, y in values]
            away = np.abs(away) / width[1] * np.abs(normal[1::every, 1])
            worst = max(worst, float((away / relative_to(places, normal[1::every], low / width)).max()))
    return worst


# ---- boundaries known by construction ----

# m = 0.1 kg, b = 5 N·s/m, T = T_d = 1 ms: the stiffness of a sampled wall.
WALL = 3378.9392990035294


def fields(first: str, second: str = "-1") -> Model:
    """Return two devices on walls of their own, stable where both functions of u and v are below 0."""
    wall = (
        f'type: SampledSpringDamper, b: ground, clock: tick, delay: 1 ms, stiffness: "scale*({WALL!r} + 1000*'
    )
    return compiled(
        "topology: fields\nclocks: {tick: 1 ms}\nparameters: {u: 0.5, v: 0.5, scale: 1 N/m}\n"
        "peers: {user: {count: 1}}\nmasses:\n  a: {mass: 0.1 kg, damping: 5 N*s/m}\n"
        "  b: {mass: 0.1 kg, damping: 5 N*s/m}\ncouplers:\n"
        f'  left: {{a: a, {wall}({first}))"}}\n  right: {{a: b, {wall}({second}))"}}\n'
    )


def disc(x: float, y: float, radius: float) -> str:
    return f"((u - {x})^2 + (v - {y})^2 - {radius * radius!r})"


LENS = 2 * (0.09 * np.arccos(1 / 3) - 0.1 * np.sqrt(0.08))
# Functions, the stable area and how many of the curves are closed and how many end.
FIELDS = {
    "an island": ([disc(0.5, 0.5, 0.3)], 0.09 * np.pi, 1, 0),
    "a hole": (["-" + disc(0.52, 0.47, 0.2)], 1 - 0.04 * np.pi, 1, 0),
    "two islands and a hole in one": (
        [f"{disc(0.25, 0.3, 0.17)}*{disc(0.7, 0.65, 0.2)}", "-" + disc(0.68, 0.66, 0.05)],
        *(np.pi * (0.17**2 + 0.2**2 - 0.05**2), 3, 0),
    ),
    "another mode takes over": (["u + 0.2*v - 0.5", "0.1*u + v - 0.5"], 0.216836734693878, 0, 2),
    "a lens": ([disc(0.4, 0.5, 0.3), disc(0.6, 0.5, 0.3)], LENS, 0, 2),
    "a corner bitten off": (["u - 0.51", "-" + disc(0.51, 0.52, 0.03)], 0.51 - np.pi * 0.0009 / 2, 0, 3),
    "through the nodes of a grid": (["u + v - 1"], 0.5, 0, 1),
    "much smaller than a cell": ([disc(0.53, 0.53, 0.015)], np.pi * 0.015**2, 1, 0),
    "a tongue with another curve in its cell": (
        ["0.01*(u - 0.3) - 4*(v - 0.5)^2", "0.44 - v"],
        *(0.56 - 4 / 3 * 0.7 * np.sqrt(0.7 / 400), 0, 2),
    ),
    "along the edge of the rectangle": (["-u"], 1.0, 0, 0),
    "everything": (["0.1*u + 0.1*v - 2"], 1.0, 0, 0),
    "nothing": (["0.1*u + 0.1*v + 1"], 0.0, 0, 0),
}


def off_boundary(functions: list[str], points: Floats) -> Floats:
    """Return how far points are, to first order, from where a function is 0, and that the others allow."""

    def value(text: str, u: Floats, v: Floats) -> Floats:
        return np.asarray(eval(text.replace("^", "**"), {"u": u, "v": v}))

    u, v = points.T
    away = []
    for text in functions:
        along = [(value(text, u + a, v + b) - value(text, u - a, v - b)) / 2e-6 for a, b in np.eye(2) * 1e-6]
        away.append(value(text, u, v) / np.hypot(*along))
    return np.abs(np.max(away, axis=0))


@pytest.mark.few(5)
@pytest.mark.parametrize("name", FIELDS)
def test_a_region_made_by_construction_has_its_curves_and_its_area(name: str) -> None:
    functions, area, closed, open_ended = FIELDS[name]
    found = apc.region(fields(*functions), x="u=0:1", y="v=0:1")
    assert [sum(one.closed for one in found.curves), sum(not one.closed for one in found.curves)] == [
        *(closed, open_ended)
    ]
    assert found.stable_area == pytest.approx(area, rel=3e-8, abs=1e-12)
    assert abs(found.stable_area - area) <= found.stable_area_error + 1e-8 * area
    for curve in found.curves:
        assert curve.error <= TOLERANCE and curve.smooth
        assert off_boundary(functions, curve.points).max() <= 1e-8
    for u, v in random_points(found, 200):
        inside = max(float(eval(one.replace("^", "**"), {"u": u, "v": v})) for one in functions) < 0
        assert found.contains(u, v) is inside


@pytest.mark.whole
def test_a_boundary_that_rounding_puts_anywhere_is_refused() -> None:
    with pytest.raises(ApcError, match=KEEPS):
        apc.region(topology("high-rate-ratio"), x=X, y=Y)


def test_ends_where_modes_meet_are_the_corner_and_a_cusp_is_followed_to_its_tangent() -> None:
    first, second = apc.region(fields(*FIELDS["another mode takes over"][0]), x="u=0:1", y="v=0:1").curves
    corner = np.linalg.solve([[1, 0.2], [0.1, 1]], [0.5, 0.5])
    ends = np.concatenate([first.points[[0, -1]], second.points[[0, -1]]])
    assert np.sort(np.hypot(*(ends - corner).T))[:2] == pytest.approx([0, 0], abs=1e-11)
    cusp = apc.region(fields("(v - 0.47)^2 - (u - 0.32)^3"), x="u=0:1", y="v=0:1")
    points = np.concatenate([curve.points for curve in cusp.curves])
    assert np.abs(points - [0.32, 0.47]).max(axis=1).min() < 0.02
    along = np.linspace(0.32, 1, 100_001)
    half = (along - 0.32) ** 1.5
    area = np.trapezoid(np.minimum(1, 0.47 + half) - np.maximum(0, 0.47 - half), along)
    assert cusp.stable_area == pytest.approx(area, abs=1.1 * cusp.stable_area_error)


# ---- the paper's plane ----


@pytest.mark.whole
def test_the_papers_boundary_is_right_to_one_part_in_a_billion() -> None:
    """Against fifty digits at one place in seven."""
    [curve] = paper().curves
    assert curve.error <= TOLERANCE and true_error(paper(), 7) <= curve.error


def test_a_mean_of_three_allows_twice_the_gain_of_their_sum() -> None:
    other = apc.region(topology("three-users-mesh"), x=X, y="coordination.stiffness=5 N/m:1500 N/m")
    assert paper().stable_area / other.stable_area == pytest.approx(2, rel=1e-9)
    for x, y in other.curves[0].points[1:-1:20].tolist():
        assert [paper().contains(x, 2 * y * (1 + side)) for side in (-1e-8, 1e-8)] == [True, False]


def test_the_contact_alone_limits_the_region_where_nothing_coordinates() -> None:
    zeros = ("contact.stiffness=0 N/m:3000 N/m", "coordination.stiffness=0 N/m:3000 N/m")
    [curve] = apc.region(topology("three-users-average"), x=zeros[0], y=zeros[1]).curves
    assert curve.points[0] == pytest.approx([CONTACT_LIMITS[0][1], 0], abs=1e-3) and curve.points[-1, 0] == 0


def test_nearer_to_a_curve_than_its_error_the_eigenvalues_decide_and_outside_nobody() -> None:
    limit = apc.critical(topology("three-users-average"), "coordination.stiffness").value
    assert limit is not None
    assert [paper().contains(1000.0, limit * (1 + side)) for side in (-1e-11, 1e-11)] == [True, False]
    with pytest.raises(ApcError, match=r"E904 point: expected contact\.stiffness in 10 to 3000 N/m"):
        paper().contains(5.0, 100.0)


@pytest.mark.parametrize("stiffness", [200, 1000, 3000])
def test_with_damping_and_no_delay_the_mean_allows_1_51_to_1_76_times_as_much(stiffness: int) -> None:
    given = {f"{name}.damping": "2 N*s/m" for name in ("contact", "coordination")}
    given |= dict.fromkeys(("contact.delay", "coordination.delay", "lan.delay"), "0 ms")
    given |= {"contact.stiffness": f"{stiffness} N/m"}
    mean, total = (
        apc.critical(topology(f"three-users-{name}"), "coordination.stiffness", params=given).value
        for name in ("average", "mesh")
    )
    assert mean is not None and total is not None and 1.51 < mean / total < 1.76


# ---- any plane ----

SEPARATE = ("contact.half_width=25 mm:35 mm", "contact.stiffness=100 N/m:5000 N/m")
BOTH = ("contact.stiffness=100 N/m:5000 N/m", "coordination.stiffness=100 N/m:5000 N/m")
DELAYED = ("contact.delay=0.5 ms:1.5 ms", "contact.stiffness=500 N/m:3000 N/m")
FURTHER = ("contact.delay=0 ms:3 ms", "contact.stiffness=10 N/m:4000 N/m")
OWN = replaced(AVERAGE, ("link: lan}", "link: lan, delays: own}"))
PLANES = {
    "gains": ("three-users-average", X, Y, {}),
    "a mass and a damping": (
        "three-users-average",
        "device.mass=20 g:300 g",
        "device.damping=0.5 N*s/m:8 N*s/m",
        {},
    ),
    "several clocks": ("mixed-clocks", "contact.stiffness=20 N/m:4000 N/m", Y, {}),
    # Each hears the one before: nearly equal eigenvalues, of a matrix far from normal.
    "a chain one way": ("directed-chain", X, Y, {}),
    "what is heard is 0 at the start": ("two-users-passivity", X, Y, {}),
    "a delay": ("three-users-average", *DELAYED, {}),
    "a delay upright": ("three-users-average", *DELAYED[::-1], {}),
    "a delay of a mesh": ("three-users-mesh", *FURTHER, {}),
    "a delay of a ring": ("ring-of-eight", *FURTHER, {}),
    # With the received part at once the translation follows the stiffness: both start at 0.
    "a force against itself": (
        OWN,
        "contact.stiffness=0 N/m:5000 N/m",
        "coordination.stiffness=0 N/m:1500 N/m",
        {},
    ),
    "linearized at its start": ("experiment-average", *BOTH, {}),
    # One motion of all and one of some have the same eigenvalue.
    "a shared eigenvalue": ("experiment-average", *BOTH, {"contact.half_width": "40 mm"}),
    # A device begins 30 mm from the middle of the cube, and holds nothing of one that is narrower.
    "begins apart or touching": ("experiment-average", *SEPARATE, {}),
    "looks at each sender": ("three-users-scheduled", "contact.stiffness=10 N/m:4000 N/m", Y, {}),
}


@cache
def plane(name: str) -> tuple[Model, Region]:
    text, x, y, settings = PLANES[name]
    model = apc.set_parameters(compiled(text) if "\n" in text else topology(text), settings)
    return model, apc.region(model, x=x, y=y)


@pytest.mark.few(4)
@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=[pytest.mark.whole] if one.startswith("begins") else []) for one in PLANES],
)
def test_what_is_inside_is_what_an_analysis_calls_stable_and_curves_are_as_near_as_is_said(name: str) -> None:
    model, found = plane(name)
    assert found.curves
    for a, b in random_points(found, 10):
        assert found.contains(a, b) == stable(model, found, a, b)
    coarse = name == "looks at each sender"
    assert bool(found.coarse) == coarse == bool(found.to_dict()["coarse"])
    assert ("above the requested 1e-09" in str(found)) == coarse
    assert all(one.error <= TOLERANCE for one in found.curves if one.smooth and one not in found.coarse)
    # A part in 10⁵ of the ranges beside a curve, the stable side is on its left.
    width = found.rectangle.width
    for curve in found.curves:
        if not curve.smooth or coarse:
            continue
        along = np.diff(curve.points / width, axis=0)
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None]
        for k in range(1, len(along), max(2, len(along) // 4)):
            for side in (1, -1):
                a, b = (curve.points[k] + side * 1e-5 * normal[k] * width).tolist()
                if np.all(np.abs(np.array([a, b]) - found.rectangle.low - width / 2) < width / 2):
                    assert stable(model, found, a, b) is (side > 0)


@pytest.mark.whole
def test_where_a_topology_begins_apart_a_straight_line_parts_the_motions() -> None:
    _, found = plane("begins apart or touching")
    assert "holds near the initial state" in " ".join(str(found).split())
    straight = [curve for curve in found.curves if not curve.smooth]
    assert [len(found.curves), len(straight)] == [3, 1]
    assert np.abs(straight[0].points[:, 0] - 0.03).max() <= 1e-12


# ---- times and counts ----


def limit(settings: Mapping[str, str], name: str) -> float:
    found = apc.critical(topology("three-users-average"), name, params=settings).value
    assert found is not None
    return found


def test_the_curves_of_a_computational_delay_meet_its_critical_values() -> None:
    found, other = plane("a delay")[1], plane("a delay upright")[1]
    assert not found.stepped and all(curve.smooth for curve in found.curves)
    ends = np.concatenate([curve.points[[0, -1]] for curve in found.curves])
    for delay in (0.0005, 0.001, 0.0015):
        [height] = {round(float(y), 6) for x, y in ends if x == delay}
        assert height == pytest.approx(limit({"contact.delay": f"{delay} s"}, "contact.stiffness"), rel=2e-9)
    off = found.stable_area_error + other.stable_area_error
    assert other.stable_area == pytest.approx(found.stable_area, abs=off)


def test_over_a_link_the_boundary_is_a_staircase_at_the_critical_values() -> None:
    coordination = "coordination.stiffness=500 N/m:2000 N/m"
    found = apc.region(topology("three-users-average"), x="lan.delay=2 ms:5 ms", y=coordination)
    [curve] = found.curves
    assert not curve.smooth and curve.error <= 1e-12 and curve.mode == "difference"
    # A packet that arrives between two ticks is heard at the second.
    heights = [limit({"lan.delay": f"{tick}.5 ms"}, "coordination.stiffness") for tick in (2, 3, 4)]
    for height in heights:
        assert np.abs(curve.points[:, 1] - height).min() <= 1e-12 * height
    assert {round(1e3 * float(x), 12) for x, _ in curve.points} == {2.0, 3.0, 4.0, 5.0}
    assert found.stable_area == pytest.approx(sum(heights) * 1e-3 - 1.5, rel=1e-11)


@pytest.mark.whole
def test_a_staircase_that_another_mode_takes_over_is_a_curve_a_mode() -> None:
    tall = "coordination.stiffness=500 N/m:3000 N/m"
    found = apc.region(topology("three-users-average"), x="lan.delay=0 ms:40 ms", y=tall)
    assert {curve.mode for curve in found.curves} == {"difference", "common"}


@pytest.mark.whole
def test_over_two_times_the_boundary_is_known_to_a_cell() -> None:
    found = apc.region(
        topology("three-users-average"),
        x="contact.delay=0.5 ms:3 ms",
        y="coordination.delay=0 ms:2 ms",
        params={"coordination.stiffness": "900 N/m"},
    )
    assert found.stepped and found.curves and found.curves[0].mode == "difference"
    assert "it is accurate to one cell" in str(found) and max(map(len, str(found).splitlines())) <= 80


def test_a_region_over_counts_has_steps_at_each_counts_critical_value() -> None:
    mesh = topology("three-users-mesh")
    found = apc.region(mesh, x="user.count=2:6", y="coordination.stiffness=10 N/m:3000 N/m")
    for count in range(2, 7):
        crossings = apc.critical(
            mesh,
            "coordination.stiffness",
            params={"user.count": str(count)},
            lower="10 N/m",
            upper="3000 N/m",
        ).crossings
        assert crossings
        for one in crossings:
            for off in (-1.0, 1.0):
                inside = (one.stable_side == "below") == (off < 0)
                for x in (count, min(count + 0.4, 6)):
                    assert found.contains(x, one.value + off) == inside


# ---- what cannot be ----

FREE = """\
topology: free
peers: {user: {count: 1}}
masses: {device: {mass: 2 kg}, other: {mass: 1 kg}}
couplers:
  tie: {type: SpringDamper, a: device, b: other, stiffness: 30 N/m}
  wall: {type: SpringDamper, a: device, b: ground, stiffness: 30 N/m}
"""
TINY = "contact.stiffness=0 N/m:1e-300 N/m"
KEEPS = "E905 in a part of the rectangle the spectral radius equals 1"


@pytest.mark.parametrize(
    ("text", "x", "y", "message"),
    [
        (FREE, "tie.stiffness=1 N/m:100 N/m", "wall.stiffness=1 N/m:100 N/m", KEEPS),
        (AVERAGE, TINY, "coordination.stiffness=0 N/m:1500 N/m", "E905"),
        (
            AVERAGE,
            X,
            "contact.stiffness=1000 N/m:1000.0000001 N/m",
            r"--y: E903 .* at least 1.5e-05 N/m, got 1e-07",
        ),
        (
            AVERAGE,
            Y,
            f"user.{Y}",
            "E902 coordination.stiffness and user.coordination.stiffness overlap",
        ),
        (AVERAGE, "haptic.phase=1 ms:2 ms", Y, "E903 haptic.phase sets the phase of a clock"),
        (
            AVERAGE,
            "user.count=2:5.5",
            Y,
            "--x: E881 range of user.count: expected whole numbers, got 2 to 5.5",
        ),
        (
            AVERAGE.partition("studies:")[0],
            None,
            None,
            "E901 --x is missing",
        ),
    ],
)
def test_a_rectangle_without_a_region_is_refused(
    text: str, x: str | None, y: str | None, message: str
) -> None:
    with pytest.raises(ApcError, match=message):
        apc.region(compiled(text), x=x, y=y)


# ---- the command ----


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("average.yaml").write_text(AVERAGE, encoding="utf-8")
    (tmp_path / "others").mkdir()
    Path("others/mesh.yaml").write_text(MESH, encoding="utf-8")
    return tmp_path


@pytest.fixture
def printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Return what runs `apc region` and returns what it prints."""

    def region(*words: str) -> str:
        assert run(["region", *words]) == 0
        return capsys.readouterr().out

    return region


def test_text_fits_a_terminal_and_json_is_the_contract(printed: Callable[..., str]) -> None:
    text = printed("--x", X, "--y", Y)
    assert text.startswith("three-users-average: stable in a part of the rectangle, boundary: 1 curve\n")
    assert "difference  10.83 to 26.12" in text and max(map(len, text.splitlines())) <= 80
    for span, words in (("10 N/m:50", "stable in the whole"), ("4000 N/m:5000", "stable nowhere inside the")):
        axes = [one.replace("10 N/m:3000", span) for one in (X, Y)]
        assert f"{words} rectangle" in printed("--x", axes[0], "--y", axes[1])
    document = json.loads(printed("--json"))
    # The axes of the topology's own studies.
    assert document["x"] == {"parameter": "contact.stiffness", "unit": "N/m", "range": [0.0, 5000.0]}
    assert document["y"]["range"] == [0.0, 1500.0] and document["stable_area"] > 0
    [curve] = document["boundary"]
    assert (curve["mode"], curve["closed"], len(curve["points"][0])) == ("difference", False, 2)
    assert 10 < curve["frequency_hz"][0] < curve["frequency_hz"][1] < 30 and curve["error"] <= TOLERANCE


@pytest.mark.whole
def test_several_topologies_and_settings_are_panels(printed: Callable[..., str]) -> None:
    words = ("--x", X, "--y", Y, "--compare", "others/mesh.yaml")
    document = json.loads(printed(*words, "--vary", "lan.delay=0,8 ms", "--json"))
    assert [panel["panel"] for panel in document["panels"]] == ["lan.delay=0 ms", "lan.delay=8 ms"]
    areas = [[one["stable_area"] for one in panel["regions"]] for panel in document["panels"]]
    assert areas[1][0] == pytest.approx(paper().stable_area, rel=1e-9) and areas[1][0] > areas[1][1]
    # At equal effective gain the mean and the sum are one curve.
    text = printed(*words, "--normalize")
    document = json.loads(printed(*words, "--normalize", "--json"))
    mean, total = (one["stable_area"] for one in document["panels"][0]["regions"])
    assert 2 * total == pytest.approx(mean, rel=1e-9) and "y is multiplied by 2" in text


@pytest.mark.needs_extension("wall_conditions")
def test_an_overlay_is_told_with_its_source_and_is_its_formula(printed: Callable[..., str]) -> None:
    laid = "colgate:K=contact.stiffness,B=contact.damping,b=device.damping,T=haptic.period"
    text = printed("--x", X, "--y", "device.damping=0.1 N*s/m:5 N*s/m", "--overlay", laid, "--json")
    [line] = json.loads(text)["panels"][0]["overlays"]
    assert "Colgate" in line["label"]
    points = np.array(line["points"])  # b > K T/2 + |B|
    assert points[:, 1] == pytest.approx(points[:, 0] * 1e-3 / 2, rel=1e-9)


@pytest.mark.whole
def test_tables_and_pictures_are_written_by_their_suffix_and_the_same_each_time(
    printed: Callable[..., str],
) -> None:
    printed("--x", X, "--y", Y, "--out", "region.csv")
    with Path("region.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    [curve] = paper().curves
    assert [float(row["contact.stiffness [N/m]"]) for row in rows] == curve.points[:, 0].tolist()
    assert {row["mode"] for row in rows} == {"difference"}
    pytest.importorskip("pandas")
    table = paper().to_dataframe()
    assert list(table.columns[4:6]) == ["contact.stiffness [N/m]", "coordination.stiffness [N/m]"]
    assert len(table) == len(rows)
    pytest.importorskip("matplotlib")
    heads = {"a.svg": b"<?xml", "b.svg": b"<?xml"}
    for name, head in heads.items():
        printed("--x", X, "--y", Y, "--compare", "others/mesh.yaml", "--out", name)
        assert head in Path(name).read_bytes()[:200]
    assert Path("a.svg").read_bytes() == Path("b.svg").read_bytes()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--x|contact.stifness=0 N/m:1 N/m", "--x: E622 contact.stifness is not a parameter"),
        ("--x|contact.stiffness", "E901 --x: expected PATH=LOW:HIGH, got contact.stiffness"),
        (
            "--x|contact.stiffness=5 N/m:1 N/m",
            "--x: E881 range of contact.stiffness: expected the lower end first",
        ),
        (f"--x|{Y}|--y|{Y}", "E902 coordination.stiffness is on both axes"),
        ("--out|region.bmp", "region.bmp: E878 suffix of --out: expected one of .png, .svg, .pdf,"),
        ("--out|nowhere/region.csv", "E601 can't be written: No such file or directory"),
        ("--vary|lan.delay", "--vary: E907 --vary: expected NAME=VALUE,VALUE,…"),
        ("--panel|lan.delay", "--panel: E907 panel: expected NAME=VALUE, …"),
        ("--vary|lan.delay=0,8 ms|--panel|lan.delay=0 ms", "E907 --vary can't be combined with --panel"),
        ("--vary|contact.stiffness=5,8 N/m", "E902 contact.stiffness is both on an axis and set"),
        ("--compare|missing.yaml", "missing.yaml"),
    ],
)
def test_what_can_not_be_is_one_message_and_exit_code_1(
    folder: Path, capsys: pytest.CaptureFixture[str], words: str, message: str
) -> None:
    before = sorted(folder.iterdir())
    assert run(["region", *words.split("|")]) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and message in captured.err and "Traceback" not in captured.err
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("name", ["island", "hole"])
def test_the_drawn_outlines_enclose_the_stable_area(name: str) -> None:
    found = apc.region(topology(name), x="u=0 N/m:1000 N/m", y="v=0 N/m:1000 N/m")
    area = 0.0
    for outline in stable_outlines(found):
        x, y = np.concatenate([outline, outline[:1]]).T
        area += float(((x[:-1] + x[1:]) / 2) @ np.diff(y))
    # n chords of a circle leave out 2π²/(3n²) of it: of the 270 that are drawn, not all alike, 1e-4.
    assert area == pytest.approx(found.stable_area, rel=2e-4)
