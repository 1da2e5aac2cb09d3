"""Where a verdict changes as one number grows: closed forms, and analyses on both sides of each value."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path

import flint
import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.analysis.analysis import analyze, determinant_radius
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from apc.lifting.numeric_model import numeric_model
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import find
from apc.spectrum.ball_arithmetic import precision
from apc.studies.critical_values import Critical
from apc.studies.crossing import ESTIMATE, SingleSegment, SmoothSegment, Verdict, search
from apc.studies.evaluator_choice import EvaluatorKind, evaluator_for
from apc.studies.margins import Margin
from apc.studies.parameter_path import pointwise
from apc.verdict import NO_PROOF
from tests.bench import random_scans
from tests.bruteforce import TopologySource, as_ball, frame_matrices, frame_matrix
from tests.topologies import AVERAGE, MESH, ROOT, TOPOLOGIES, compiled, replaced, wall
from tests.truths import STORED
from tests.varying.closed_forms import followers, late, sprung

HARD = ROOT / "tests" / "hard"
LIMIT = 1096.410868365630  # tests.reference, of the paper's topology
STIFFNESS = "coordination.stiffness"
PRESSED = replaced(
    AVERAGE,
    ("count: 3", "count: 3, set: {device.x: -10 mm}"),
    (
        "type: SampledSpringDamper, a: device, b: cube",
        "type: OneSidedContact, a: device, b: cube, half_width: 20 mm, side: left",
    ),
)
SOFT = replaced(AVERAGE, ("500 N/m", "690 N/m"), ("1000 N/m", "100 N/m"))
NAMED = replaced(AVERAGE, ("peers:", "parameters: {late: 8 ms}\npeers:"), ("delay: 8 ms}", "delay: late}"))
PHASED = replaced(AVERAGE, ("network: 8 ms", "network: {period: 4 ms, phase: 1 ms}"))
OWN = ("link: lan", "link: lan, delays: own")
# Equal at present; one group's limit is not everybody's.
GROUPS = replaced(
    AVERAGE,
    ("  user: {count: 3}", "  one: {count: 1, set: {contact.stiffness: 1000 N/m}}\n  two: {count: 2}"),
)
DIFFERENT = replaced(
    MESH, ("{count: 3}", "{count: 2}\n  other: {count: 1, set: {coordination.stiffness: 150 N/m}}")
)


def topology(text: str) -> Model:
    """Return the topology of a text, or by its name."""
    if "\n" in text:
        return compiled(text)
    path = TOPOLOGIES / f"{text}.yaml"
    return apc.compile(path if path.exists() else HARD / f"{text}.yaml")


def stable_at(model: Model, found: Critical | Margin, value: Fraction) -> bool | None:
    """Return the verdict of an analysis with the number that was searched at a value."""
    unit = "" if found.unit == "1" else f" {found.unit}"
    return apc.analyze(model, params={found.parameter: f"{value}{unit}"}).stable


def check(model: Model, found: Critical, values: Sequence[Fraction] = ()) -> None:
    """Assert that analyses on both sides of every crossing, and at more values, say what the search says."""
    for one in found.crossings:
        # Bounds of an analysis may be wider than a crossing's own, that is proved with more digits.
        aside = 2 * Fraction(one.error) + Fraction(max(abs(one.value), 1e-3)) / 10**9
        sides = [stable_at(model, found, Fraction(one.value) + side * aside) for side in (-1, 1)]
        assert sides == ([True, False] if one.stable_side == "below" else [False, True]), one
    edges = [Fraction(one.value) for one in found.crossings]
    first = (
        found.crossings[0].stable_side == "below" if edges else bool(found.verdict and found.verdict.stable)
    )
    for value in values:
        assert stable_at(model, found, value) is (first == (sum(e < value for e in edges) % 2 == 0)), value


# ---- closed forms ----


@pytest.mark.parametrize("ticks", [0, 1, 2, 7, 30, pytest.param(100, marks=pytest.mark.whole)])
def test_an_integrator_pulled_back_late_is_stable_up_to_its_closed_form(ticks: int) -> None:
    """p < 2 sin(π/(2(2d + 1))): Levin and May, Theoretical Population Biology 9, 1976."""
    limit = 2000 * np.sin(np.pi / (2 * (2 * ticks + 1)))
    found = apc.critical(late(ticks), "it.pull", upper=f"{3 * limit} Hz")
    (one,) = found.crossings
    assert one.value == pytest.approx(limit, rel=1e-12) and one.stable_side == "below"
    assert one.frequency_hz == pytest.approx(500 / (2 * ticks + 1), rel=1e-9)
    assert one.error <= 1e-9 * limit and found.complete and found.value == one.value


@pytest.mark.parametrize("ticks", [1, 8, pytest.param(64, marks=pytest.mark.whole)])
def test_what_grows_by_itself_is_held_between_two_values(ticks: int) -> None:
    """A pull too weak leaves it unstable at ζ = 1, one too strong further on, or always."""
    growth = 1000 / (2 * ticks + 2)
    pole = np.exp(growth / 1000)
    found = apc.critical(late(ticks, growth), "it.pull", upper=f"{10 * growth} Hz")
    grid = np.geomspace(growth / 100, 9.9 * growth, 1500)
    shares = grid * (pole - 1) / growth
    brute = [np.abs(np.roots([1.0, -pole, *np.zeros(ticks - 1), p])).max() < 1 for p in shares]
    places = np.flatnonzero(np.diff(brute))
    assert [one.stable_side == "below" for one in found.crossings] == [brute[place] for place in places]
    for one, place in zip(found.crossings, places, strict=True):
        assert grid[place] <= one.value <= grid[place + 1]
    assert found.crossings[0].value == pytest.approx(growth, rel=1e-9)


@pytest.mark.parametrize("packets", [2, 12, 40, pytest.param(300, marks=pytest.mark.whole)])
def test_where_all_eigenvalues_cross_at_once_the_value_is_that(packets: int) -> None:
    found = apc.critical(followers(packets), "it.pull", upper="3000 Hz")
    (one,) = found.crossings
    widest = 1e-2 if packets <= 40 else 1.0  # hundreds of eigenvalues at one place: floats scatter them
    assert abs(one.value - 1000) <= max(one.error, 1e-9) and one.error <= widest
    assert one.stable_side == "below"


@pytest.mark.parametrize("name", ["c.u", "dial"])
def test_a_bump_between_two_samples_is_found_at_its_closed_form(name: str) -> None:
    """k(u) crosses the spring's own limit K at u₀ ± w (h/(K − low) − 1)^¼."""
    bound = apc.critical(sprung("Straight", "low: 500 N/m, high: 1 N/m, u: 700"), "c.u").value
    assert bound is not None
    reach = 50 * (8000 / bound - 1) ** 0.25
    found = apc.critical(sprung("Bump"), name, lower="1100", upper="1400")
    assert [one.value for one in found.crossings] == pytest.approx([1237 - reach, 1237 + reach], rel=1e-9)
    assert [one.stable_side for one in found.crossings] == ["below", "above"]


@pytest.mark.parametrize(
    ("shape", "middle", "width"),
    [("Step", 1001, 1.1), ("Kink", 1001, 3), ("Bell", 1001, 4), ("Plateau", 1002, 3), ("Angle", 1002, 4)],
)
def test_a_narrow_window_is_found_by_a_search_about_it(shape: str, middle: float, width: float) -> None:
    model = sprung(shape)
    about = {"lower": str(middle - 2 * width), "upper": str(middle + 2 * width)}
    found = apc.critical(model, "dial", **about)
    assert [one.stable_side for one in found.crossings] == ["below", "above"]
    assert all(abs(one.value - middle) < width for one in found.crossings)
    inside = Fraction(sum(one.value for one in found.crossings) / 2)
    assert [stable_at(model, found, value) for value in (Fraction(700), inside, Fraction(1500))] == [
        *(True, False, True)
    ]


@pytest.mark.whole
def test_a_delay_that_stands_in_a_force_moves_the_force_as_well() -> None:
    model = sprung("Straight", "low: 100 N/m, high: 1 N/m, u: 0, rate: 1e6 N/m/s")
    found = apc.critical(model, "c.delay")
    assert len(found.crossings) == 1
    check(model, found)


@pytest.mark.parametrize(
    ("model", "name", "value", "off"),
    [
        # (N − 1) times less each is the average's limit.
        (
            compiled(
                replaced(
                    MESH,
                    ("masses:", "parameters: {kt: 500 N/m}\nmasses:"),
                    ("stiffness: 500 N/m", "stiffness: kt/(peers - 1)"),
                )
            ),
            *("kt", LIMIT, 1e-9),
        ),
        # The half width of the cube, 20 mm: beyond it a device moves freely, which is one motion more.
        pytest.param(
            *(topology("experiment-average"), "left.device.x", -0.02, 1e-12), marks=pytest.mark.whole
        ),
        # The contact closes where its half width is how far the device begins from the cube.
        pytest.param(
            compiled(replaced(PRESSED, ("-10 mm", "-15 mm"), (", side: left", ""), ("1000 N/m", "3000 N/m"))),
            *("contact.half_width", 0.015, 1e-12),
            marks=pytest.mark.whole,
        ),
    ],
    ids=["an expression", "a start value", "a half width"],
)
def test_what_a_number_reaches_by_other_ways_has_its_known_value(
    model: Model, name: str, value: float, off: float
) -> None:
    found = apc.critical(model, name, upper="40 mm" if "width" in name else None)
    (one,) = found.crossings
    assert one.value == pytest.approx(value, abs=off) and found.has_effect
    if name != "kt":
        assert "nonlinear topology" in str(found)


def test_the_error_holds_against_the_full_map_in_50_digits() -> None:
    """At value ± error the eigenvalue of all peers' own map lies on either side of the circle."""
    found = apc.critical(compiled(AVERAGE), STIFFNESS)
    assert found.value is not None and found.error is not None and found.error < 1e-12 * found.value
    assert str(found.crossings[0].proof).startswith("proved") and found.complete
    assert "no narrower" in str(replace(found, crossings=(replace(found.crossings[0], error=200.0),)))
    mode = np.exp(2j * np.pi * found.crossings[0].frequency_hz * 0.008)
    sizes = []
    with precision(200):
        for sign in (-1, 1):
            k_t = flint.arb(found.value) + sign * flint.arb(found.error)
            alongside = TopologySource(kt=k_t, kc=flint.arb(1000))  # type: ignore[arg-type] # a topology of balls
            rows = frame_matrix(alongside, number=as_ball, exp=lambda value: value.exp())
            matrix = flint.acb_mat([[flint.acb(entry.mid()) for entry in row] for row in rows])
            values = matrix.eig(algorithm="approx")
            sizes.append(abs(min(values, key=lambda value: abs(complex(value.mid()) - mode))).mid())
        assert sizes[0] < 1 < sizes[1]


@pytest.mark.parametrize("frames", [13, *(pytest.param(many, marks=pytest.mark.whole) for many in (40, 100))])
def test_a_long_delay_has_the_crossing_of_all_peers_by_hand(frames: int) -> None:
    """The spectral radius of the full map, a packet a state, is 1 between the ends of the error."""
    delay = Fraction(8 * frames, 1000)
    found = apc.critical(compiled(AVERAGE), STIFFNESS, params={"lan.delay": f"{delay} s"})
    assert found.value is not None and found.error is not None and found.error < 1e-9 * found.value

    def largest(k_t: float) -> float:
        sizes = np.abs(np.linalg.eigvals(frame_matrices(TopologySource(kt=k_t, comm=delay), 1)[0]))
        return float(np.sort(sizes)[-2])  # all can move together

    aside = 1e-6 * found.value
    assert largest(found.value - aside) < 1 < largest(found.value + aside)


def test_a_defective_cluster_is_held_where_its_eigenvalue_alone_crosses() -> None:
    """Four equal peers in a chain have one eigenvector; floats scatter their eigenvalue by a part in 10⁴.

    Each of them is a part of its own, which has it once.
    """
    text = (HARD / "defective.yaml").read_text(encoding="utf-8")
    # One of them behind the first moves as each of them does; a copy keeps its share of the mass.
    alone = replaced(
        *(text, ("count: 4", "count: 1"), ("mass: 1 kg", "mass: 0.4 kg")),
        ("[1, 2, 1], [2, 3, 1], [3, 4, 1], [4, 5, 1]", "[1, 2, 1]"),
    )
    chain, single = (apc.critical(compiled(one), STIFFNESS).crossings[0] for one in (text, alone))
    assert chain.proof.bits and single.proof.bits
    assert abs(chain.value - single.value) <= chain.error + single.error < 1e-10 * chain.value


# ---- verdicts along a scan ----

MS = [Fraction(k, 1000) for k in range(200)]
HALVES = [one + Fraction(1, 2000) for one in MS]

# What varies, what else is set, and values at which analyses are asked besides both sides of each crossing.
ALONG = {
    # Stable, unstable, stable again, unstable for good.
    "an island": (AVERAGE, "coordination.damping", {}, [Fraction(k) for k in (30, 70, 90, 200)], 3),
    "a mass": (AVERAGE, "device.mass", {}, [], 2),
    "a damping": (AVERAGE, "device.damping", {}, [], 1),
    "a computational delay": (AVERAGE, "contact.delay", {"upper": "4 ms"}, MS[:4], 1),
    "a link's delay": (SOFT, "lan.delay", {"upper": "16 ms"}, [*MS[:17], *HALVES[:16]], 0),
    "nearly on the boundary": ("boundary-inside-13", "lan.delay", {"upper": "16 ms"}, HALVES[:16], 2),
    "a clock with a phase": (PHASED, "lan.delay", {"upper": "160 ms"}, HALVES[:160:7], 0),
    "users that differ": (DIFFERENT, "lan.delay", {"upper": "160 ms"}, HALVES[:160:7], 0),
    "a delay by its name": (NAMED, "late", {"upper": "160 ms"}, HALVES[:160:13], 0),
    "peers that all differ": ("different-peers", "contact.stiffness", {}, [], 0),
    "a finger": ("finger", "wall.delay", {"upper": "3 ms", "params": {"wall.stiffness": "5000 N/m"}}, [], 0),
    "linearized at its start": ("experiment-average", STIFFNESS, {}, [], 0),
    "a motor within its limits": ("limited-motor", "wall.stiffness", {}, [], 0),
    "a force against itself": (replaced(AVERAGE, OWN), STIFFNESS, {}, [], 1),
    "one of several groups": (GROUPS, "one.contact.stiffness", {}, [], 0),
}


@pytest.mark.few(4)
@pytest.mark.parametrize("name", ALONG)
def test_the_verdict_along_a_scan_is_what_analyses_say(name: str) -> None:
    text, parameter, requested, values, count = ALONG[name]
    model = topology(text)
    found = apc.critical(model, parameter, **requested)
    assert found.crossings and (not count or len(found.crossings) == count)
    assert found.value in [one.value for one in found.crossings]
    check(apc.set_parameters(model, requested.get("params", {})), found, values)


def test_how_many_users_is_answered_as_each_topology_alone_would() -> None:
    found = apc.critical(compiled(MESH), "user.count", lower="2", upper="40")
    assert {str(one.proof) for one in found.crossings} == {"both analyzed"}
    ends = [int(one.boundary) for one in found.crossings]
    alone = [apc.analyze(compiled(MESH), params={"user.count": str(count)}).stable for count in range(2, 41)]
    expected = [alone[0] is (sum(end < count for end in ends) % 2 == 0) for count in range(2, 41)]
    assert ends and expected == alone and found.evaluations <= 39


FIRST = [TOPOLOGIES / "finger.yaml"]
OTHERS = sorted({*TOPOLOGIES.glob("*.yaml"), *HARD.glob("*.yaml")} - {*FIRST})


@pytest.mark.parametrize(
    "path",
    [*FIRST, *(pytest.param(one, marks=pytest.mark.whole) for one in OTHERS)],
    ids=lambda one: one.stem,
)
def test_every_crossing_that_is_answered_is_one_between_two_analyses(path: Path) -> None:
    """Of the first and last delay and the first stiffness: other verdicts on its sides, none of them open."""
    model = apc.compile(path)
    names = [one.name for one in apc.parameters(model).rows]
    stiff, late = ([one for one in names if one.endswith(end)] for end in ("stiffness", ".delay"))
    for name in dict.fromkeys([*late[:1], *late[-1:], *stiff[:1]]):
        try:
            found = apc.critical(model, name, criterion="nominal")
        except ApcError as error:
            assert error.mistakes[0].code in ("E804", "E805", "E844", "E845", "E846"), error
            continue
        check(model, found)


@pytest.mark.parametrize("seed", [3, pytest.param(4, marks=pytest.mark.whole)])
def test_no_crossing_is_invented_and_none_is_missed_in_random_topologies(seed: int) -> None:
    """Against eigenvalues of all peers' matrix on a grid and beside each crossing."""
    tally = random_scans.run(2, seed=seed)
    assert tally.wrong == [] and tally.scans == 2


def test_a_link_delay_jumps_where_a_packet_comes_a_tick_later() -> None:
    found = apc.critical(compiled(SOFT), "lan.delay", upper="16 ms")
    first = found.crossings[0]
    assert (first.kind, first.error, first.stable_side) == ("jump", 0.0, "below")
    assert 1000 * first.value == round(1000 * first.value)
    # A packet that comes with a tick is seen by it: the jump's own value is one with what is below.
    moved = apc.set_parameters(compiled(SOFT), {"lan.delay": f"{first.value!r} s"})
    assert apc.analyze(moved).stable and apc.critical(moved, "lan.delay").value == first.value
    assert first.stable_at is True
    assert f"stable with lan.delay up to {1000 * first.value:g} ms\n" in str(found)
    assert "below (jump, inclusive)" in str(found)
    row = next(one for one in apc.margins(moved).rows if one.parameter == "lan.delay")
    assert (row.value, row.gain_margin, row.kind) == (first.value, 1.0, "jump")


@pytest.mark.parametrize(("name", "value"), [("device.x", -0.02), ("contact.half_width", 0.01)])
def test_where_a_contact_closes_the_radius_jumps_at_the_geometry(name: str, value: float) -> None:
    """The device at x = −10 mm touches a cube at 0 within its half width: open at equality, where f = 0."""
    model = compiled(replaced(PRESSED, ("1000 N/m", "200 kN/m")))
    found = apc.critical(model, name, lower="-0.05 m" if value < 0 else None, upper="0.05 m")
    (one,) = found.crossings
    assert (one.kind, one.value, one.stable_side) == ("jump", value, "below")
    for off, stable in ((-1e-9, True), (1e-9, False)):
        moved = apc.set_parameters(model, {name: value + off})
        assert apc.analyze(moved).stable is stable
    at = apc.analyze(apc.set_parameters(model, {name: value})).stable
    assert one.stable_at is at


def test_jumps_of_a_topology_within_a_part_in_10_13_of_its_boundary_are_exact() -> None:
    assert STORED["boundary-inside-13"]["spectral_radius"].startswith("0.9999999999")
    found = apc.critical(HARD / "boundary-inside-13.yaml", "lan.delay", upper="16 ms")
    assert [(one.value, one.error) for one in found.crossings] == [(0.002, 0.0), (0.007, 0.0)]
    assert found.complete and not found.undecided


@pytest.mark.parametrize("low", [0, 14])
def test_where_a_search_of_delays_begins_is_looked_at_by_itself(low: int) -> None:
    """A packet due at a tick is heard at it, and one a microsecond later at the next."""
    model = apc.set_parameters(topology("star-lecture"), {STIFFNESS: "873.3965451925634 N/m"})
    found = apc.critical(model, "lecture.delay", lower=f"{low} ms", upper="18 ms")
    at, above = (stable_at(model, found, Fraction(low, 1000) + more) for more in (0, Fraction(1, 10**6)))
    assert at is not above
    first = found.crossings[0]
    assert (first.value, first.error, first.stable_side) == (low / 1000, 0.0, "below" if at else "above")


def test_stretches_of_which_no_analysis_decides_are_said_to_be_left_open() -> None:
    """Every eigenvalue of those who move together is on the circle, exactly, as soon as packets are late."""
    found = apc.critical(followers(2, 1000.0), "lan.delay", upper="3 ms")
    assert not found.complete and found.undecided[-1] == (0.002, 0.003)
    assert "undecided: " in " ".join(str(found).split())
    assert found.to_dict()["undecided"] == [list(one) for one in found.undecided]


def test_the_frequency_is_that_of_the_motion_that_decides() -> None:
    [one, *_] = apc.critical(compiled(AVERAGE), "contact.stiffness").crossings
    mode = apc.analyze(compiled(AVERAGE), params={"contact.stiffness": f"{one.value!r} N/m"}).modes[0]
    assert one.frequency_hz == pytest.approx(mode.frequency_hz, rel=1e-6)
    # Eight ticks make a frame: a sign that changes at each, (−1)⁸ = 1, is no common translation.
    found = apc.critical(
        topology("experiment-average"), "coordination.damping", lower="100 N*s/m", upper="300 N*s/m"
    )
    assert [one.frequency_hz for one in found.crossings] == pytest.approx([500], rel=1e-9)


# ---- what is said ----


def test_no_crossing_is_an_answer_in_words() -> None:
    found = apc.critical(compiled(AVERAGE), STIFFNESS, upper="900 N/m")
    assert (found.value, found.error, found.stable_side, found.searched_to) == (
        None,
        None,
        None,
        (0.0, 900.0),
    )
    assert str(found.verdict) == "stable at every evaluated value" and found.has_effect
    above = apc.critical(compiled(AVERAGE), STIFFNESS, lower="1200 N/m", upper="2000 N/m")
    assert str(above.verdict) == "unstable at every evaluated value"
    # A wave impedance of 0: the least value looked at is above it.
    waves = apc.set_parameters(topology("two-users-waves"), {"lan.delay": "72 ms"})
    found = apc.critical(waves, "coordination.impedance", upper="1 N*s/m")
    assert str(found.verdict) == "stable at every evaluated value" and found.searched_to[0] > 0
    idle = apc.critical(compiled(AVERAGE), "cube.x")
    assert not idle.has_effect and idle.value is None
    printed = " ".join(str(idle).split())
    assert "stable at every value: the parameter does not affect stability" in printed
    apart = apc.set_parameters(wall(0.1, 1.0, 0.0, 100.0), {"device.x": "-1 mm", "it.x": "-1 mm"})
    printed = " ".join(str(apc.critical(apart, "it.stiffness")).split())
    assert "at the initial state, where this parameter has no effect" in printed


def test_a_delay_where_what_is_heard_at_the_start_decides_is_refused() -> None:
    text = replaced(MESH, ("type: FullMesh", "type: SaturatedMesh, limit: 3 N"))
    with pytest.raises(ApcError, match="E845 the linearization depends on the initial packets"):
        apc.critical(compiled(text), "contact.delay")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "topology.yaml").write_text(AVERAGE, encoding="utf-8")


ORDER = "apc critical: E841 arguments: expected PATH, then FILE, got "


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("haptic.phase", "E844 haptic.phase sets the phase of a clock"),
        ("user.contact.delay", "contact.delay is common to all groups. Try: contact.delay"),
        ("", "E622 an empty name is not a parameter of"),
        ("contact.stiffness|--upper|900", "--upper: E204 contact.stiffness: expected N/m, got 900 (no"),
        ("contact.stiffness|--upper|900", 'Try: --upper "900 N/m"'),
        ("contact.stiffness|--lower|9 N/m|--upper|3 N/m", "E842 range of contact.stiffness: expected"),
        ("contact.stiffness|--lower|-5 N/m", "E843 limit of contact.stiffness: expected at least 0"),
        (
            "topology.yaml|lan.delay",
            f"{ORDER}topology.yaml, then lan.delay. Try: apc critical lan.delay topology.yaml\n",
        ),
        (
            "topology.yaml",
            f"{ORDER}topology.yaml alone. Try: apc critical contact.stiffness topology.yaml\n",
        ),
    ],
)
def test_a_mistake_is_one_message(words: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["critical", *words.split("|")]) == 1
    written = capsys.readouterr()
    assert message in written.err and written.out == ""


def test_the_command_prints_one_document_or_lines_of_80_columns(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["critical", STIFFNESS, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["value"] == pytest.approx(LIMIT, rel=1e-12) and document["unit"] == "N/m"
    assert document["crossings"][0]["stable_side"] == "below"
    assert run(["critical", STIFFNESS, "--set", "contact.stiffness=2000 N/m"]) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 80


# ---- long delays, where dense matrices leave the verdict open ----

PAIR = """\
topology: two
clocks: {haptic: 1 ms, network: 1 ms}
peers:
  leader: {count: 1}
  follower: {count: 1, set: {device.mass: 1.5 kg}}
masses: {device: {mass: 0.2 kg, damping: 4 N*s/m, shared: false}}
couplers:
  pd: {type: AveragePosition, object: device, stiffness: 100 N/m, DAMPING clock: haptic, link: wan}
links: {wan: {clock: network, delay: 40 ms}}
"""


@pytest.mark.few(1)
@pytest.mark.parametrize("damping", ["", "damping: 2 N*s/m,"])
def test_a_long_delay_is_decided_as_an_analysis_decides_it(damping: str) -> None:
    model = compiled(PAIR.replace("DAMPING", damping))
    found = apc.critical(model, "pd.stiffness")
    (one,) = found.crossings
    assert one.error < 1e-6 * one.value
    check(model, found)
    if not damping:
        # By another program, which lifts the frame and takes eigenvalues in NumPy.
        assert one.value == pytest.approx(858.30610337740, rel=1e-11)


# ---- the search itself, on verdicts that are known ----


class Known(SingleSegment):
    """A line of one stretch from 0 to 100 whose radius is a given function, open in a band about 1."""

    label = "number"

    def __init__(self, radius: Callable[[float], float], band: float = 0.0, *, slow: bool = True) -> None:
        self.radius, self.band, self.slow = radius, band, slow
        self.judged: list[float] = []

    def judge(self, value: Fraction) -> Verdict:
        self.judged.append(float(value))
        radius = self.radius(float(value))
        stable = None if abs(radius - 1) <= self.band else radius < 1
        return Verdict(stable, radius, self.band, (), NO_PROOF)

    def smooth_segments(self) -> Iterator[SmoothSegment]:
        points = np.array([0.0, 1.0, 10.0, 50.0, 100.0])
        look = partial(pointwise, self.judge)
        yield SmoothSegment(Fraction(0), Fraction(100), points, 1.0, look, self.judge, slow=self.slow)


def test_a_crossing_on_an_end_of_a_cell_is_held_from_both_sides() -> None:
    for value in (10.0, 50.0):
        (one,) = search(Known(lambda at, value=value: 1 + (at - value) / 1e3, band=1e-12)).crossings
        assert abs(one.value - value) <= one.error < 1e-8 and one.proof != ESTIMATE


def test_a_first_loss_of_stability_next_to_a_sample_is_held_from_both_sides() -> None:
    """The sample at 10 is unstable by less than any analysis decides: it is no end of the bracket."""
    found = search(Known(lambda at: 1 + (at - 10) / 1e3 + 2e-11, band=1e-10, slow=True), first=True)
    (one,) = found.crossings
    assert abs(one.value - 10) <= one.error < 1e-6 and one.proof != ESTIMATE


def test_values_without_a_verdict_at_the_end_of_a_range_are_undecided() -> None:
    found = search(Known(lambda at: 0.9 if at < 60 else math.nan))
    assert found.undecided == ((50.0, 100.0),) and found.searched_to == (0.0, 50.0)


def test_a_search_for_the_first_loss_of_stability_evaluates_no_later_crossing() -> None:
    # Zeros of a cubic: stability is lost at 5, regained at 30 and lost again at 70.
    path = Known(lambda at: 1 + (at - 5) * (at - 30) * (at - 70) / 1e7, slow=False)
    found = search(path, first=True)
    assert [one.value for one in found.crossings] == pytest.approx([5.0], rel=1e-9)
    assert {one for one in path.judged if 10 < one < 99} == {50.0}  # a first sample
    assert [one.value for one in search(path).crossings] == pytest.approx([5.0, 30.0, 70.0], rel=1e-9)


def test_an_end_that_stands_alone_is_no_crossing() -> None:
    found = search(Known(lambda at: 0.5 if at == 0 else 2.0 + at))
    assert (found.crossings, found.stable, found.isolated) == ((), (False,), (0.0,))
    # The same at the other end; and a crossing next to an end is one.
    found = search(Known(lambda at: 2.0 if at == 100 else 0.5))
    assert (found.crossings, found.stable, found.isolated) == ((), (True,), (100.0,))
    (one,) = search(Known(lambda at: 0.9 + at)).crossings
    assert one.value == pytest.approx(0.1, rel=1e-10)


@pytest.mark.parametrize("half", [1e-7, 5e-7, 7e-7, 8e-7, 9e-7, 9.8e-7])
def test_no_error_is_wider_than_1e_6_where_analyses_that_near_decide(half: float) -> None:
    """No analysis decides within `half` of the limit, relative to it: all decide at 1e-6 of it."""
    limit, slope = 33.3, 0.01
    band = math.expm1(slope * limit * half)
    (one,) = search(Known(lambda at: math.exp(slope * (at - limit)), band=band)).crossings
    assert abs(one.value - limit) <= one.error <= 1e-6 * one.value


@pytest.mark.parametrize(("slope", "band"), [(1e-3, 1e-7), (14 / 33.3, 1e-5), (-14 / 33.3, 1e-5)])
def test_a_bracket_is_narrowed_to_the_values_that_no_analysis_decides(slope: float, band: float) -> None:
    """The radius is undecided within `band` of 1, so that no bracket is narrower than 2 `band` / `slope`."""
    (one,) = search(Known(lambda at: math.exp(slope * (at - 33.3)), band=band)).crossings
    assert one.kind == "crossing"
    assert abs(one.value - 33.3) <= one.error <= 1.6 * band / abs(slope)


def test_a_jump_between_values_is_held_by_bisection() -> None:
    (one,) = search(Known(lambda at: 0.5 if at < 33.3 else 2.0)).crossings
    assert abs(one.value - 33.3) <= one.error < 1e-9


TELEOPERATION = """\
topology: teleoperation
clocks: {fast: 2 kHz, slow: 1 kHz, network: 1 kHz}
peers:
  leader: {count: 1}
  follower: {count: 1, set: {device.mass: 1.5 kg, device.damping: 8 N*s/m, pd.clock: slow}}
masses:
  device: {mass: 0.2 kg, damping: 4 N*s/m, shared: false}
couplers:
  pd: {type: AveragePosition, object: device, stiffness: 100 N/m, damping: 2 N*s/m, clock: fast, link: wan}
links:
  wan: {clock: network, delay: 20 ms, delays: {follower: {leader: 60 ms}}}
"""


@pytest.mark.whole
def test_a_critical_value_over_long_delays_is_as_close_as_its_analyses() -> None:
    """A lifting by another program gives 1032.600987 N/m; dense matrices alone leave every value open."""
    model = compiled(TELEOPERATION)
    found = apc.critical(model, "pd.stiffness")
    assert found.value is not None and found.error is not None
    assert found.value == pytest.approx(1032.600987, abs=1e-5)
    assert found.error < 1e-6 * found.value
    for factor, stable in ((1 - 1e-6, True), (1 + 1e-6, False)):
        assert apc.analyze(model, params={"pd.stiffness": factor * found.value}).stable is stable


@pytest.mark.parametrize(
    ("name", "value"),
    [
        (STIFFNESS, Fraction(600)),
        ("lan.delay", Fraction(1, 100)),
        ("coordination.delay", Fraction(1, 500)),
        ("haptic.period", Fraction(1, 600)),
        ("user.count", Fraction(4)),
    ],
)
def test_the_evaluator_follows_from_what_a_parameter_changes(name: str, value: Fraction) -> None:
    # A changed model shows it: another number of peers, frame or order of events, or none of them.
    numeric = numeric_model(compiled(AVERAGE))
    parameter_ref = find(numeric.model, name, counts=True)
    changed = numeric.at(apply(numeric.model, [Override(parameter_ref, value)]))
    expected = next(
        kind
        for kind, differs in (
            (EvaluatorKind.COUNTS, changed.model.peers != numeric.model.peers),
            (EvaluatorKind.PERIODS, changed.schedules[0].frame_s != numeric.schedules[0].frame_s),
            (EvaluatorKind.DELAYS, changed.timings != numeric.timings),
            (EvaluatorKind.MATRICES, True),
        )
        if differs
    )
    choice = evaluator_for(numeric, [parameter_ref])
    assert (choice.kind, len(choice.linearized)) == (expected, 1)
    assert evaluator_for(numeric, [find(numeric.model, STIFFNESS), parameter_ref]).kind is expected
    scalar = evaluator_for(numeric, [parameter_ref], "mean-square")
    continuous = expected in (EvaluatorKind.MATRICES, EvaluatorKind.DELAYS)
    assert (scalar.kind, scalar.linearized) == (EvaluatorKind.POINTS if continuous else expected, ())


def test_a_search_over_many_packets_evaluates_the_side_of_one_by_a_count() -> None:
    """Analyses with bounds agree on the side at every value, and near the crossing on the radius."""
    model = apc.set_parameters(compiled(AVERAGE), {"lan.delay": 2.4, "contact.stiffness": 0})
    found = apc.critical(model, "coordination.stiffness", lower=1.0, upper=20_000.0)
    assert len(found.crossings) == 1
    for value in (2.0, 30.0, 60.0, 61.0, 200.0, 3000.0, 15_000.0):
        numeric = numeric_model(apc.set_parameters(model, {"coordination.stiffness": value}))
        quick, analysis = determinant_radius(numeric), analyze(numeric)
        assert analysis.method == "determinant"
        assert (quick < 1) is analysis.stable is (value < found.value)
        if abs(analysis.spectral_radius - 1) < 0.01:
            assert quick == pytest.approx(analysis.spectral_radius, abs=analysis.spectral_radius_error)


def test_the_bound_of_a_single_largest_eigenvalue_holds_and_is_narrow() -> None:
    """One pair is larger than the others, of 300 frames of delay; the matrix of all states agrees."""
    model = apc.set_parameters(compiled(AVERAGE), {"lan.delay": "2.4 s", "contact.stiffness": "0 N/m"})
    found = apc.critical(model, "coordination.stiffness", lower=1.0, upper=20_000.0)
    assert found.value is not None and found.error is not None and found.error < 1e-9 * found.value
    for side in (-1, 1):
        value = found.value + side * 2 * found.error
        numeric = numeric_model(apc.set_parameters(model, {"coordination.stiffness": value}))
        analysis, matrix = analyze(numeric), analyze(numeric, method="modes")
        assert analysis.method == "determinant" and analysis.stable is (side < 0)
        apart = abs(matrix.spectral_radius - analysis.spectral_radius)
        assert apart <= matrix.spectral_radius_error + analysis.spectral_radius_error < 1e-11
