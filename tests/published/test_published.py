"""The published results of models/published: every row is true, and apc reports what the row has.

A closed form is evaluated here. Where it is an approximation, the result of apc is also compared with a
matrix made by hand, since a tolerance of some percent would not show an error.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.commands import Cli
from tests.published import by_hand
from tests.topologies import ROOT

FOLDER = ROOT / "models" / "published"
SOURCES: list[dict[str, Any]] = yaml.load((FOLDER / "results.yaml").read_text("utf-8"), yaml.BaseLoader)
ROWS = [
    {key: value for key, value in source.items() if key != "results"} | row
    for source in SOURCES
    for row in source["results"]
]
REQUIRED = {"title", "cite", "source", "statement", "result", "kind", "where", "unit", "number", "command"}
REQUIRED |= {"read", "apc", "tolerance", "reason"}
OPTIONAL = {"formula", "values", "divided_by", "check", "extensions", "slow"}
NAMES = {name: getattr(math, name) for name in ("pi", "sin", "sqrt")}
NAMES |= {name: getattr(by_hand, name) for name in ("growth", "largest_period", "most_losses", "verdict")}
NAMES |= {"abs": abs}
# What the words of verdicts come to, those of a motion among them.
SENSE = {
    "stable": "stable",
    "decays": "stable",
    "oscillates": "unstable",
    "unstable": "unstable",
    "none": "none",
}


def case(row: dict[str, Any]) -> Any:
    marks = [pytest.mark.whole] if "slow" in row else []
    marks += [pytest.mark.needs_extension(*row["extensions"])] if "extensions" in row else []
    return pytest.param(row, id=f"{row['title']}: {row['result']}", marks=marks)


CASES = pytest.mark.parametrize("row", [case(row) for row in ROWS])


def symbols(row: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in row.get("values", {}).items()}


def last_digit(number: str) -> float:
    """Return one unit in the last digit."""
    return float(10 ** -len(number.partition(".")[2]))


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row['title']}: {row['result']}")
def test_the_number_of_a_row_follows_from_its_formula(row: dict[str, Any]) -> None:
    assert REQUIRED <= row.keys() <= REQUIRED | OPTIONAL
    assert (row["kind"] == "closed form") is ("formula" in row)
    assert row["kind"] in ("closed form", "published")
    if "formula" in row:
        value = eval(row["formula"], {"__builtins__": {}}, NAMES | symbols(row))  # our own text
        number = row["number"]
        if isinstance(value, float | int):
            assert float(number) == pytest.approx(value, rel=1e-9 if "." in number else 1e-12)
        else:
            assert number == str(value).lower()


@CASES
def test_apc_reports_the_number_of_the_row(
    row: dict[str, Any], cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    found = result(cli, row["command"], row["read"])
    if "divided_by" in row:
        found /= result(cli, row["divided_by"], row["read"])
    if row["tolerance"] == "none":
        assert ("none" if found is None else found) == row["apc"]
        assert SENSE[row["apc"]] == row["number"]
        return
    assert abs(found - float(row["apc"])) <= last_digit(row["apc"])
    assert found == pytest.approx(float(row["number"]), rel=float(row["tolerance"]), abs=0)
    if "check" in row:
        assert found == pytest.approx(getattr(by_hand, row["check"])(**symbols(row)), rel=1e-9, abs=0)


def result(cli: Cli, command: str, key: str) -> Any:
    """Return one value of the JSON document of a command."""
    ran = cli(command.removeprefix("apc "), "--json")
    assert ran.code == 0, ran.err
    value = json.loads(ran.out)
    for name in key.split("."):
        value = value[int(name)] if isinstance(value, list) else value[name]
    return value


def test_a_tolerance_of_more_than_a_thousandth_has_a_check_by_hand() -> None:
    wide = [row for row in ROWS if row["tolerance"] != "none" and float(row["tolerance"]) > 1e-3]
    assert all("check" in row for row in wide)


def test_every_topology_of_the_folder_has_a_row_and_a_source() -> None:
    named = {name for row in ROWS for name in re.findall(r"models/published/\S+\.yaml", row["command"])}
    files = {path.relative_to(ROOT).as_posix() for path in FOLDER.glob("*/*.yaml")}
    assert named == files
    for name in files:
        first = Path(ROOT, name).read_text(encoding="utf-8").splitlines()[0]
        assert re.match(r"# .*\d{4}", first), name


def test_every_source_is_in_the_bibliography() -> None:
    entries = re.findall(r"^@\w+\{(\w+),", (ROOT / "docs" / "sources.bib").read_text("utf-8"), re.MULTILINE)
    assert {source["cite"] for source in SOURCES} <= {*entries}
