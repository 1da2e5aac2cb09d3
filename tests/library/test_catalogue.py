"""What comes with the program, seen from an empty folder: the library, its topologies, and what may be
set.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

import apc
from apc.__main__ import run
from tests.topologies import ROOT, TOPOLOGIES

LIBRARY = [
    path
    for path in (ROOT / "models").rglob("*.yaml")
    if path.relative_to(ROOT / "models").parts[0] not in ("published", "topologies")
]
NAMES = sorted("".join(word.capitalize() for word in path.stem.split("-")) for path in LIBRARY)
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture
def call(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Call:
    monkeypatch.chdir(tmp_path)

    def run_it(*words: str) -> tuple[int, str, str]:
        code = run(list(words))
        return code, *capsys.readouterr()

    return run_it


def test_every_component_is_listed_with_its_whole_first_sentence(call: Call) -> None:
    code, out, _ = call("library")
    lines = [line for line in out.splitlines() if line.startswith("  ") and line[2] != " "]
    assert code == 0 and "…" not in out
    assert sorted(line.split()[0] for line in lines) == NAMES
    assert all(len(line) <= 80 for line in out.splitlines())
    rooms = json.loads(call("library", "--json")[1])
    assert sorted(one["name"] for room in rooms.values() for one in room) == NAMES


@pytest.mark.few(20)
@pytest.mark.parametrize("path", LIBRARY, ids=lambda path: path.stem)
def test_every_component_is_shown_with_its_parameters_and_equations(path: Path, call: Call) -> None:
    name = "".join(word.capitalize() for word in path.stem.split("-"))
    code, out, _ = call("library", name)
    assert code == 0
    text = yaml.load(path.read_text(encoding="utf-8"), yaml.BaseLoader)
    if "component" in text:
        facts = json.loads(call("library", name, "--json")[1])
        shown = " ".join(out.split())
        assert text["description"].endswith(".") and text["source"]
        for own, printed in text.get("parameters", {}).items():
            assert own in shown
            assert isinstance(printed, str) or "description" in printed or "extends" in text
        for equation in text.get("equations", []):
            assert equation in facts["equations"]
            assert equation in out


def test_a_parameter_is_told_with_unit_default_and_limits(call: Call) -> None:
    listed = json.loads(call("library", "Touch", "--json")[1])["parameters"]
    [force] = [one for one in listed if one["name"] == "force_limit"]
    assert (force["unit"], force["value"], force["limits"]) == ("N", "3.3", "> 0")


def test_components_of_ones_own_folder_are_listed_and_shown(call: Call, tmp_path: Path) -> None:
    (tmp_path / "part.yaml").write_text(
        "component: Own\ndescription: Mine.\nconnectors: {a: Flange}\nequations: [a.f = 0]\n", "utf-8"
    )
    own = ("--folder", str(tmp_path))
    assert "  Own  Mine" in call("library", *own)[1]
    assert json.loads(call("library", "Own", *own, "--json")[1])["connectors"] == {"a": "Flange"}
    assert "--folder: E214" in call("library", *own, "--folder", "none")[2]


def test_a_misspelt_component_or_topology_is_told_with_the_nearest(call: Call) -> None:
    assert call("library", "AveragePositon") == (
        1,
        "",
        "apc library: E206 unknown component 'AveragePositon'. Try: apc library AveragePosition\n",
    )
    assert call("new", "--like", "three-user-average")[2] == (
        "--like: E206 unknown topology three-user-average. Try: apc new --like three-users-average\n"
    )


@pytest.mark.whole
def test_every_topology_of_the_library_is_listed_and_copied_so_that_it_is_sound(call: Call) -> None:
    lines = call("new", "--list")[1].splitlines()
    listed = [line.split()[0] for line in lines if line.startswith("  ") and line[2] != " "]
    assert listed == sorted(path.stem for path in TOPOLOGIES.glob("*.yaml"))
    for name in listed:
        assert call("new", "--like", name)[0] == 0
        assert call("compile", f"{name}.yaml", "--until", "topology")[0] == 0
        assert Path(f"{name}.yaml").read_text(encoding="utf-8").count(f"topology: {name}") == 1
    assert call("new", "--list", "--out", "topologies.html")[0] == 0
    page = Path("topologies.html").read_text(encoding="utf-8")
    texts = re.findall(r"(?:^|<pre>)topology: ", page, re.MULTILINE)
    assert page.count("data:image/svg+xml") == len(texts) == len(listed)
    assert "<pre>three-users-average: stable up to a common translation</pre>" in page


def test_a_copy_takes_another_name_and_brings_the_tables_it_names(call: Call) -> None:
    assert call("new", "mine", "--like", "users-table")[1] == (
        "mine.yaml and users.csv are written. Next: apc analyze mine.yaml\n"
    )
    assert apc.compile("mine.yaml").name == "mine"
    assert call("new", "other", "--like", "users-table")[0] == 0  # the table is there as it is
    Path("users.csv").write_text("device.mass [kg]\n1\n", encoding="utf-8")
    assert call("new", "third", "--like", "users-table")[2] == (
        "users.csv: E613 file exists and was not changed. Try: mv users.csv another-name.csv\n"
    )
    assert not Path("third.yaml").exists()


@pytest.mark.parametrize(
    "name", ["three-users-average", "unlike-devices", "users-table", "lossy-average", "planar-users"]
)
def test_what_is_listed_may_be_set_within_its_limits_and_not_beyond(name: str) -> None:
    model = apc.compile(TOPOLOGIES / f"{name}.yaml")
    for one in apc.parameters(model).rows:
        unit = "" if one.unit == "1" else f" {one.unit}"
        if not one.fixed:
            apc.set_parameters(model, {one.name: f"{max(one.low, one.minimum or 0.0)!r}{unit}"})
        beyond = [one.minimum - (not one.exclusive_minimum)] if one.minimum is not None else []
        for value in [*beyond, *([one.maximum + 1.0] if one.maximum is not None else [])]:
            with pytest.raises(apc.ApcError):
                apc.set_parameters(model, {one.name: f"{value!r}{unit}"})


def test_a_group_has_rows_of_its_own_and_a_fixed_count_says_why(call: Call) -> None:
    call("new", "--like", "users-table")
    out = call("show", "users-table.yaml", "--parameters")[1]
    assert "user.device.mass" in out and "0.08 to 0.25 kg" in out
    assert "fixed: device.mass has a value for each peer" in " ".join(out.split())
    rows = apc.parameters("users-table.yaml").to_dict()["rows"]
    [mass] = [one for one in rows if one["name"] == "user.device.mass"]
    assert (mass["low"], mass["high"], mass["unit"], mass["minimum"]) == (0.08, 0.25, "kg", 0.0)
