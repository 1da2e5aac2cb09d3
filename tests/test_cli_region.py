"""`apc region`: what it prints, draws and writes, and what it refuses."""

from __future__ import annotations

import csv
import errno
import json
from pathlib import Path

import numpy as np
import pytest

from apc.__main__ import run
from apc.compiler.errors import ApcError
from apc.present.region_picture import panel_letter, stable_outlines
from apc.regions.axes import parse_axes
from apc.regions.panels import (
    compare_regions,
    gain_factor,
    parse_panel,
    parse_vary,
)
from apc.regions.region import region
from tests.topologies import AVERAGE, MESH, ROOT, compiled, replaced

X = "contact.stiffness=10 N/m:3000 N/m"
Y = "coordination.stiffness=10 N/m:3000 N/m"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("average.yaml").write_text(AVERAGE, encoding="utf-8")
    (tmp_path / "others").mkdir()
    Path("others/mesh.yaml").write_text(MESH, encoding="utf-8")
    return tmp_path


def test_text_fits_a_terminal_and_says_what_is_stable(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["region", "--x", X, "--y", Y]) == 0
    out = capsys.readouterr().out
    assert out.startswith("three-users-average: the stable region has a boundary in one piece\n")
    assert "difference   10.83 to 26.12" in out
    assert max(map(len, out.splitlines())) <= 80


def test_json_is_one_document_of_the_contract(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["region", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["x"] == {"parameter": "contact.stiffness", "unit": "N/m", "range": [0.0, 5000.0]}
    assert [
        set(one) >= {"points", "error", "mode", "frequency_hz", "closed"} for one in document["boundary"]
    ] == [True]
    assert document["stable_area"] > 0


def test_several_scenes_and_settings_are_panels(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["region", "--x", X, "--y", Y, "--compare", "others/mesh.yaml", "--vary", "lan.delay=0,8 ms"]
    assert run([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [panel["panel"] for panel in document["panels"]] == ["lan.delay=0 ms", "lan.delay=8 ms"]
    areas = [[one["stable_area"] for one in panel["regions"]] for panel in document["panels"]]
    assert areas[1][0] > areas[1][1]


def test_at_equal_effective_gain_the_mean_and_the_sum_are_one_curve() -> None:
    found = compare_regions([compiled(AVERAGE), compiled(MESH)], x=X, y=Y, normalize=True)
    [panel] = found.panels
    assert panel.gains == (1, 2)
    mean, total = panel.regions
    assert total.stable_area * 2 == pytest.approx(mean.stable_area, rel=1e-9)
    assert "y counts 2 times" in str(found)


def test_the_gain_of_a_sum_is_its_number_of_others_and_of_what_couples_nothing_one() -> None:
    five = compiled(replaced(MESH, ("count: 3", "count: 5")))
    x, y = parse_axes(five, X, Y)
    assert (gain_factor(five, x), gain_factor(five, y)) == (1, 4)
    assert gain_factor(compiled(AVERAGE), y) == 1


@pytest.mark.parametrize("suffix", ["svg", "png", "pdf"])
def test_a_picture_is_drawn_by_its_suffix(folder: Path, suffix: str) -> None:
    pytest.importorskip("matplotlib")
    out = f"region.{suffix}"
    assert run(["region", "--x", X, "--y", Y, "--compare", "others/mesh.yaml", "--out", out]) == 0
    head = Path(out).read_bytes()[:200]
    assert {"svg": b"<?xml", "png": b"\x89PNG", "pdf": b"%PDF"}[suffix] in head


def test_the_same_picture_is_the_same_bytes(folder: Path) -> None:
    pytest.importorskip("matplotlib")
    for out in ("one.svg", "two.svg"):
        assert run(["region", "--out", out]) == 0
    assert Path("one.svg").read_bytes() == Path("two.svg").read_bytes()


def test_an_overlay_is_drawn_and_told_with_its_source(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    laid = "colgate:K=contact.stiffness,B=contact.damping,b=device.damping,T=haptic.period"
    assert (
        run(["region", "--x", X, "--y", "device.damping=0.1 N*s/m:5 N*s/m", "--overlay", laid, "--json"]) == 0
    )
    [panel] = json.loads(capsys.readouterr().out)["panels"]
    [line] = panel["overlays"]
    assert "Colgate" in line["label"]
    # b > K T/2 + |B|: a straight line.
    points = np.array(line["points"])
    assert points[:, 1] == pytest.approx(points[:, 0] * 1e-3 / 2, rel=1e-9)


def test_a_table_holds_every_point_of_the_curves(folder: Path) -> None:
    assert run(["region", "--x", X, "--y", Y, "--out", "region.csv"]) == 0
    with Path("region.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    system = compiled(AVERAGE)
    [curve] = region(system, parse_axes(system, X, Y)).curves
    assert [float(row["contact.stiffness [N/m]"]) for row in rows] == curve.points[:, 0].tolist()
    assert {row["mode"] for row in rows} == {"difference"}


def test_the_drawn_outline_encloses_the_stable_area() -> None:
    for name in ("island", "hole"):
        system = compiled((ROOT / "tests" / "scenes" / f"{name}.yaml").read_text(encoding="utf-8"))
        found = region(system, parse_axes(system, "u=0 N/m:1000 N/m", "v=0 N/m:1000 N/m"))
        area = 0.0
        for ring in stable_outlines(found):
            x, y = np.concatenate([ring, ring[:1]]).T
            area += float(((x[:-1] + x[1:]) / 2) @ np.diff(y))
        assert area == pytest.approx(found.stable_area, rel=1e-4)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["--x", "contact.stifness=0 N/m:1 N/m"],
            "--x: E622 contact.stifness is no parameter",
        ),
        (["--x", "contact.stiffness=5 N/m:1 N/m"], "wants its lower end first"),
        (["--x", "contact.stiffness=1 kg:5 kg"], "E204 contact.stiffness wants N/m"),
        (["--x", "peers=2:5"], "E623 peers is the number of all peers"),
        (["--x", Y, "--y", Y], "E902 coordination.stiffness is on both axes"),
        (
            ["--out", "region.bmp"],
            "region.bmp: E878 the suffix of --out wants one of .png, .svg, .pdf,",
        ),
        (["--out", "nowhere/region.csv"], "E601 can't be written: No such file or directory"),
        (["--vary", "lan.delay"], "--vary: E907 --vary wants NAME=VALUE,VALUE,…"),
        (["--panel", "lan.delay"], "--panel: E907 a panel wants NAME=VALUE, …"),
        (["--vary", "lan.delay=0,8 ms", "--panel", "lan.delay=0 ms"], "E907 --vary and --panel both say"),
        (
            ["--vary", "contact.stiffness=5,8 N/m"],
            "E902 contact.stiffness is on an axis and set",
        ),
        (["--compare", "missing.yaml"], "missing.yaml"),
    ],
)
def test_what_can_not_be_is_one_message_and_exit_code_1(
    folder: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    before = sorted(folder.iterdir())
    assert run(["region", *words]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err
    assert "Traceback" not in captured.err
    assert sorted(folder.iterdir()) == before


def test_a_full_disk_is_a_message_and_leaves_nothing_behind(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, text: str) -> None:
        path.write_text("some of it", encoding="utf-8")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    before = sorted(folder.iterdir())
    assert run(["region", "--out", "region.json"]) == 1
    assert "region.json: E601 can't be written: No space left on device" in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before


def test_panels_read_as_they_are_written() -> None:
    assert parse_vary("lan.delay=0,8 ms") == (("lan.delay=0 ms",), ("lan.delay=8 ms",))
    assert parse_vary("lan.delay=0 s, 8 ms") == (("lan.delay=0 s",), ("lan.delay=8 ms",))
    assert parse_panel("lan.delay=0 ms, contact.delay=1 ms") == ("lan.delay=0 ms", "contact.delay=1 ms")
    with pytest.raises(ApcError, match="E907"):
        parse_panel("lan.delay 0 ms")


def test_every_panel_has_a_letter_however_many_there_are() -> None:
    assert [panel_letter(place) for place in (0, 1, 25, 26)] == ["a", "b", "z", "a"]
