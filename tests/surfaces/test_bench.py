"""`apc bench`: what is measured, what counts as better, what is printed; hard cases, whose truth is known."""

from __future__ import annotations

import json
import math
import shutil
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest

import apc
from apc.benchmark.hard import compare, run_hard_cases
from apc.benchmark.scale import scale
from apc.benchmark.speed_and_error import SAME, Bench, MethodTiming, bench, pareto_front
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.output.bench_output import bench_picture
from apc.verdict import Limitation, LimitationCode
from tests.commands import Cli, write
from tests.hard.truths import HERE, TRUTHS, truth_of
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, replaced


@pytest.fixture(scope="module")
def found() -> Bench:
    return bench(compiled(AVERAGE), rounds=1, duration=Fraction(1, 50))


def _single(name: str, seconds: float, error: float | None, spread: float = 0.0) -> MethodTiming:
    return MethodTiming(name, seconds, spread, 3, error, None, False)


@pytest.mark.parametrize(
    ("measured", "front"),
    [
        (
            [
                _single("b", 2.0, 1e-5),
                _single("c", 3.0, 1e-4),
                _single("a", 1.0, 1e-3),
                _single("d", 4.0, 1e-9),
            ],
            {"a": True, "b": True, "c": False, "d": True},
        ),
        (
            [_single("a", 1.0, 1e-9, 0.2), _single("b", 1.1, 1e-9, 0.1)],
            {"a": True, "b": True},
        ),  # within spread
        ([_single("a", 1.0, SAME / 2), _single("b", 2.0, 0.0)], {"a": True, "b": False}),  # but for rounding
        ([_single("a", 1.0, None), _single("b", 2.0, None)], {"a": False, "b": False}),
    ],
)
def test_the_front_is_what_nothing_beats_in_both_ways(
    measured: list[MethodTiming], front: dict[str, bool]
) -> None:
    marked = {one.name: one.front for one in pareto_front(measured)}
    assert marked == front
    assert [*marked] == sorted(marked)


@pytest.mark.whole
def test_the_report_fits_a_terminal_and_names_the_choice(found: Bench) -> None:
    text = str(found)
    assert max(map(len, text.splitlines())) <= 80
    assert "default method of analyze: modes" in text
    assert "default method of simulate: exact" in text
    analysis = found.comparisons[0]
    for one in analysis.measured:
        assert one.error is None or one.bound is None or one.error <= one.bound
    assert "spectral radius 0.957171389625094952208279125575" in analysis.reference
    json.dumps(found.to_dict(), allow_nan=False)
    axes = bench_picture(found).axes
    assert [ax.get_title() for ax in axes] == ["apc analyze", "apc simulate"]
    assert "exact (default)" in [text.get_text() for text in axes[1].get_legend().get_texts()]


# ---- more peers ----


@pytest.mark.whole
def test_more_peers_are_measured_each_in_a_process_of_its_own(cli: Cli) -> None:
    """The text with another count, of the group that grows; a number is measured once."""
    write("topology.yaml", replaced(AVERAGE, ("user: {count: 3}", "one: {count: 1}\n  many: {count: 4}")))
    grown = scale(Path("topology.yaml"), [5, 3000, 5])
    assert [(row.count, row.peers) for row in grown.rows] == [(5, 6), (3000, 3001)]
    assert all(row.error is not None and row.error <= row.bound for row in grown.rows)
    assert all(row.memory > 10 * 2**20 for row in grown.rows)
    text = str(grown)
    assert max(map(len, text.splitlines())) <= 80
    assert "peers of group many, with 1 of other groups" in text and "3,000" in text


@pytest.mark.whole
@pytest.mark.parametrize(
    ("topology", "counts", "message"),
    [
        ("three-users-average", [1], r"E921 1 peer of user can't be measured: .* 2 peers"),
        ("users-table", [3], "no group of this topology has a count that can be varied"),
        ("three-users-average", [], "E921"),
        ("three-users-average", [0], "E921"),
        ("three-users-average", [3, -1], "E921"),
    ],
)
def test_numbers_of_peers_that_are_none_are_refused(topology: str, counts: list[int], message: str) -> None:
    with pytest.raises(ApcError, match=message):
        scale(TOPOLOGIES / f"{topology}.yaml", counts)


# ---- the command ----


@pytest.mark.parametrize(
    ("plot", "message"),
    [
        ("bench.txt", "E878 suffix of --plot"),
        ("bench.png", "E875 matplotlib is not installed"),
        ("nowhere/bench.png", "E601 can't be written: No such file or directory"),
        (".", "E601 can't be written: it is a folder"),
        ("''", "E601 can't be written: it is a folder"),
    ],
)
def test_a_picture_that_cannot_be_is_refused_before_anything_is_measured(
    plot: str, message: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("apc.benchmark.speed_and_error.bench", lambda *_: pytest.fail("it is measured"))
    if "E875" in message:
        monkeypatch.setitem(sys.modules, "matplotlib", None)
    ran = cli(f"bench '{TOPOLOGIES}/template.yaml' --plot {plot}")
    assert ran.code == 1 and message in ran.err


@pytest.mark.whole
def test_what_goes_wrong_in_the_end_costs_no_figures(
    found: Bench, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise ApcError(Diagnostic("E601", SourceLocation("bench.png"), "can't be written: no space"))

    assert found.faults == ()
    note = Limitation(LimitationCode.WRONG_BOUND, ("dense",))
    first, *rest = found.comparisons
    broken = replace(found, comparisons=(replace(first, notes=(note,)), *rest))
    monkeypatch.setattr("apc.output.pictures.write_figure", full)
    for measured, plot, messages in (
        (found, "--plot bench.png", ["E601 can't be written"]),
        (broken, "", ["E922", "WRONG: the bound of dense does not hold"]),
    ):
        monkeypatch.setattr("apc.benchmark.speed_and_error.bench", lambda *_, measured=measured: measured)
        ran = cli(f"bench '{TOPOLOGIES}/template.yaml' {plot}")
        assert ran.code == 1 and all(one in ran.err for one in messages)
        assert "default method of analyze: modes" in ran.out


# ---- hard cases ----

STORED: dict[str, dict[str, object]] = json.loads(TRUTHS.read_text(encoding="utf-8"))
NAMES = sorted(path.stem for path in HERE.glob("*.yaml"))


def test_every_topology_has_its_truth_and_says_where_it_comes_from_and_what_is_hard() -> None:
    assert sorted(STORED) == NAMES
    for name in NAMES:
        text = (HERE / f"{name}.yaml").read_text(encoding="utf-8")
        assert f"topology: {name}\ndescription: " in text
        assert "\n# From: " in text


@pytest.mark.few(8)
@pytest.mark.parametrize("name", NAMES)
def test_a_hard_case_gets_the_right_verdict_and_a_bound_that_holds(name: str) -> None:
    model = apc.compile(HERE / f"{name}.yaml")
    case = compare(model, apc.analyze(model), STORED[name], 0.0, name)
    assert case.failed == ""
    assert case.verdict == STORED[name]["verdict"], "none of these is left undecided"
    assert math.isfinite(case.bound)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["coasting", "stiff-contact", "two-clusters", "million-peers"])
def test_the_stored_truth_is_what_its_script_computes(name: str) -> None:
    assert truth_of(apc.compile(HERE / f"{name}.yaml")) == STORED[name]


def _one_case(**changes: object) -> str:
    """Make the working folder one of one hard case, its truth changed; return its text."""
    shutil.copy(HERE / "tiny-device.yaml", ".")
    truth = STORED["tiny-device"] | changes
    write("truths.json", json.dumps({"tiny-device": truth}))
    return str(truth["spectral_radius"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"spectral_radius": "0.968810016486"}, "the bound does not hold"),
        ({"verdict": "stable"}, "the verdict is wrong: stable"),
        ({"rigid_modes": 0}, "0 rigid modes, not 1"),
    ],
)
def test_a_case_that_is_wrong_fails(cli: Cli, changes: dict[str, object], message: str) -> None:
    _one_case(**changes)
    ran = cli("bench --hard .")
    assert ran.code == 1 and f"FAILED tiny-device: {message}" in ran.out
    assert "E922 failed reference cases: tiny-device" in ran.err


OPEN = "the bound is infinite; the verdict is undecided; expected: stable up to a common translation"


@pytest.mark.parametrize(
    ("changes", "failed"),
    [
        ({"spectral_radius_error": math.inf, "stable": None, "verdict": "undecided: …"}, OPEN),
        ({"spectral_radius": math.nan}, "no spectral radius"),
        ({"spectral_radius_error": math.nan}, "the bound is infinite"),
    ],
)
def test_what_is_no_number_or_no_verdict_fails_and_is_counted(
    changes: dict[str, object], failed: str, cli: Cli
) -> None:
    def solve(model: Model) -> apc.Analysis:
        return replace(apc.analyze(model), **changes)  # type: ignore[arg-type] # some fields of it

    _one_case()
    report = run_hard_cases(Path(), solve=solve, repeats=1)
    assert [case.failed for case in report.failures] == [failed]
    assert "1 of 1 topology failed" in str(report)
    assert report.to_dict()["undecided"] == (["tiny-device"] if "stable" in changes else [])


def test_the_report_of_hard_cases_fits_a_terminal(cli: Cli) -> None:
    write("other.yaml", "topology: other\n")
    _one_case()
    ran = cli("bench --hard .")
    assert ran.code == 0 and max(map(len, ran.out.splitlines())) <= 80
    assert "all bounds hold; all verdicts are correct" in ran.out
    assert "stable*: stable up to a common translation" in ran.out
    assert "other.yaml excluded: no known result" in ran.out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "does not exist"),
        ("{", "invalid JSON"),
        ("[]", "reference results: expected spectral_radius"),
        ('{"a": {"spectral_radius": "much"}}', "a: expected spectral_radius"),
        ('{"a": {"spectral_radius": "1/0", "rigid_modes": 1, "verdict": "stable"}}', "a: expected spectral"),
        (
            '{"a": {"spectral_radius": "1", "rigid_modes": "one", "verdict": "stable"}}',
            "a: expected spectral",
        ),
        ("{}", "has no topology with a reference result"),
    ],
)
def test_truths_that_are_none_are_refused(cli: Cli, text: str | None, message: str) -> None:
    if text is not None:
        write("truths.json", text)
    ran = cli("bench --hard .")
    assert ran.code == 1 and f"E920 {message}" in " ".join(ran.err.split())
