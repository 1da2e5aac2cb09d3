"""What is asked of the nominal network says first what it leaves out, and never answers for it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import apc
from apc.__main__ import run
from tests.lossy import unreliable
from tests.topologies import AVERAGE, compiled

LEFT_OUT = "excluded: packet loss (30 %) and jitter of lan; every packet has the nominal delay of 8 ms"


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(unreliable("loss: 30 %, jitter: 1 ms"), encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "name"),
    [
        (["critical", "lan.loss", "s.yaml"], "lan.loss"),
        (["critical", "links.lan.jitter", "s.yaml"], "lan.jitter"),
        (["region", "s.yaml", "--x", "lan.loss=0 %:5 %"], "lan.loss"),
        (["sweep", "s.yaml", "--over", "lan.jitter=0,1 ms", "--out", "o.csv"], "lan.jitter"),
    ],
)
def test_a_nominal_question_about_lost_or_late_packets_is_refused_by_name(
    words: list[str], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*words, "--criterion", "nominal"]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert f"E896 {name} has no effect on the nominal network" in printed.err
    assert "Try: --criterion mean-square" in printed.err


@pytest.mark.parametrize(
    "words",
    [
        ["critical", "contact.stiffness", "s.yaml"],
        ["region", "s.yaml", "--cells", "4"],
        ["sweep", "s.yaml", "--over", "contact.stiffness=1,2 N/m", "--out", "o.csv"],
    ],
)
def test_other_questions_say_in_their_second_line_what_is_left_out(
    words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*words, "--criterion", "nominal"]) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith(f"  {LEFT_OUT[:55]}")
    assert run([*words, "--criterion", "nominal", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["limitations"] == [LEFT_OUT]


RANGE = AVERAGE.replace("delay: 8 ms}", "delay: [8 ms, 20 ms]}")
MIDDLE = "excluded: the range 8 ms to 20 ms of lan.delay; the midpoint 14 ms is used"


@pytest.mark.parametrize(
    ("words", "places"),
    [
        ("transparency", [1]),
        ("critical contact.stiffness", [1]),
        ("region --cells 4", [1]),
        ("region --x lan.delay=0ms:20ms --cells 4", []),
        ("critical lan.delay", []),
    ],
)
def test_an_answer_for_the_middle_of_a_delay_that_is_a_range_says_so(
    words: str, places: list[int], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("s.yaml").write_text(RANGE, encoding="utf-8")
    assert run([*words.split(), "s.yaml"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [at for at, line in enumerate(lines) if line.strip() == MIDDLE] == places


@pytest.mark.parametrize("words", ["simulate --duration 1s", "export --out s.mat"])
def test_a_topology_is_played_and_written_out_with_one_delay(
    words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("s.yaml").write_text(RANGE, encoding="utf-8")
    assert run([*words.split(), "s.yaml"]) == 1
    assert "E899 lan.delay is a range, 8 ms to 20 ms; this command" in capsys.readouterr().err
    assert run([*words.split(), "s.yaml", "--set", "lan.delay=14 ms"]) == 0


@pytest.mark.whole
def test_an_analysis_answers_for_the_network_first(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["analyze", "s.yaml", "--method", "paper", "--nominal"]) == 0
    reported, _, nominal = capsys.readouterr().out.partition("\n\nthree-users-average: ")
    assert reported.startswith("three-users-average: stable in mean square\n")
    assert nominal.splitlines()[1].startswith(f"  {LEFT_OUT[:55]}")


def test_no_nominal_derivative_is_given_with_respect_to_what_is_left_out() -> None:
    """Nor one for a named parameter that a link's numbers follow from, unless something else does too."""
    text = unreliable("loss: {p: drop/2, r: 25 %}, jitter: 1 ms")
    found = apc.sensitivities(compiled(text.replace("clocks:", "parameters: {drop: 2 %}\nclocks:", 1)))
    names = {row.parameter for row in found.rows}
    assert "contact.stiffness" in names and "drop" not in names
    assert not {name for name in names if name.startswith("lan.")}
