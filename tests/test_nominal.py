"""Claims about `apc.network.nominal`: what is left out is said first, and never answered for."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from apc.__main__ import run
from apc.network.nominal import channel_numbers, left_out
from apc.regions.axes import parse_axes
from apc.regions.region import region
from apc.vary.sensitivity import sensitivities
from tests.lossy import unreliable
from tests.topologies import AVERAGE, compiled


def test_an_answer_can_say_what_it_leaves_out() -> None:
    assert left_out(compiled(AVERAGE)) == ()
    assert left_out(compiled(unreliable("loss: 0 %, jitter: 0 ms"))) == ()
    [note] = left_out(compiled(unreliable("loss: {p: 1 %, r: 25 %}, jitter: 2 ms")))
    assert note == (
        "left out: packet loss (3.85 %) and jitter of lan; here every packet takes the nominal 8 ms"
    )


def test_the_numbers_of_a_channel_are_those_it_names_and_what_they_follow_from() -> None:
    text = unreliable("loss: {p: drop/2, r: 25 %}, jitter: 1 ms")
    system = compiled(text.replace("clocks:", "parameters: {drop: 2 %, other: 3 %}\nclocks:", 1))
    found = channel_numbers(system)
    assert {"drop", "lan.loss.p", "lan.loss.r", "lan.jitter"} <= found
    assert not found & {"other", "lan.delay", "coordination.stiffness"}
    assert channel_numbers(compiled(AVERAGE)) == frozenset()


NOMINALLY = ("--in", "nominal")


@pytest.fixture(name="scene")
def in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    Path("s.yaml").write_text(unreliable("loss: 30 %, jitter: 1 ms"), encoding="utf-8")
    return "s.yaml"


@pytest.mark.parametrize(
    ("words", "name", "instead"),
    [
        (["critical", "lan.loss", "s.yaml", *NOMINALLY], "lan.loss", "--in mean-square"),
        (["critical", "links.lan.jitter", "s.yaml", *NOMINALLY], "lan.jitter", "--in mean-square"),
        (["region", "s.yaml", "--x", "lan.loss=0 %:5 %", *NOMINALLY], "lan.loss", "--in mean-square"),
        (
            ["sweep", "s.yaml", "--over", "lan.jitter=0,1 ms", "--out", "o.csv", *NOMINALLY],
            "lan.jitter",
            "--in mean-square",
        ),
    ],
)
def test_a_nominal_question_about_lost_or_late_packets_is_refused_by_name(
    scene: str, words: list[str], name: str, instead: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert f"E896 {name} can't be varied: this verdict is of the nominal network" in said.err
    assert f"Write: {instead}" in said.err
    assert scene


@pytest.mark.parametrize(
    "words",
    [
        ["critical", "contact.stiffness", "s.yaml", *NOMINALLY],
        ["region", "s.yaml", "--cells", "4", *NOMINALLY],
        ["sweep", "s.yaml", "--over", "contact.stiffness=1,2 N/m", "--out", "o.csv", *NOMINALLY],
    ],
)
def test_other_questions_say_in_their_second_line_what_is_left_out(
    scene: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(words) == 0
    second = capsys.readouterr().out.splitlines()[1]
    assert second.startswith("  left out: packet loss (30 %) and jitter of lan;")
    assert run([*words, "--json"]) == 0
    [note] = json.loads(capsys.readouterr().out)["left_out"]
    assert note.startswith("left out: packet loss (30 %) and jitter of lan;")
    assert scene


@pytest.mark.few(1)
@pytest.mark.parametrize("method", ["paper", "auto"])
def test_an_analysis_answers_for_the_network_first_and_says_what_the_rest_leaves_out(
    scene: str, method: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["analyze", scene, "--method", method]) == 0
    told, _, nominal = capsys.readouterr().out.partition("\n\nthree-users-average: ")
    assert told.startswith("three-users-average: stable in mean square\n")
    assert nominal.splitlines()[1].startswith("  left out: packet loss (30 %) and jitter of lan;")


def test_no_derivative_is_given_with_respect_to_what_is_left_out(scene: str) -> None:
    names = {row.parameter for row in sensitivities(compiled(Path(scene).read_text("utf-8"))).rows}
    assert "contact.stiffness" in names
    assert not {name for name in names if name.startswith("lan.")}


def test_a_picture_says_it_too(scene: str) -> None:
    system = compiled(Path(scene).read_text("utf-8"))
    spans = ("contact.stiffness=100 N/m:3000 N/m", "coordination.stiffness=100 N/m:2000 N/m")
    title = region(system, parse_axes(system, *spans), cells=4, criterion="nominal").plot().get_title()
    assert " ".join(title.split()).startswith("left out: packet loss (30 %) and jitter of lan;")
