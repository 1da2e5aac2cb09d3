"""A report: one page that holds everything in itself, whose numbers are those of the commands."""

from __future__ import annotations

import json
import math
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest

import apc
from apc.__main__ import run
from apc.compiler.errors import Mistake, Place
from apc.present import report as pages
from apc.present.report import kept_report, report_page
from apc.reports import contents
from apc.reports.contents import Report, Table, differences, report
from tests.topologies import AVERAGE, SCENES, replaced

SCENE = SCENES / "three-users-average.yaml"
LONE = "topology: lone\npeers: {user: {count: 1}}\nmasses: {device: {mass: 1 kg, damping: 1 N*s/m}}\n"


@pytest.fixture(scope="module")
def found() -> Report:
    return report([SCENE])


@pytest.fixture(scope="module")
def page(found: Report) -> str:
    return report_page(found)


class Reader(HTMLParser):
    """What of a page would be loaded or run, and whether every element is closed."""

    VOID = ("meta", "link", "br", "img", "input")

    def __init__(self) -> None:
        super().__init__()
        self.wanted: list[str] = []
        self.scripts: list[str | None] = []
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element names."""
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "data", "action") and value:
                self.wanted.append(value)
            assert not name.startswith("on"), name
        if tag == "script":
            self.scripts.append(dict(attrs).get("type"))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an empty element names."""
        self.handle_starttag(tag, attrs)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        """Check that what ends had begun last."""
        assert self.open.pop() == tag


def test_a_page_loads_nothing_and_runs_nothing(page: str) -> None:
    reader = Reader()
    reader.feed(page)
    assert not reader.open
    assert all(one.startswith(("#", "data:")) for one in reader.wanted)
    assert reader.scripts == ["application/json"]
    assert "default-src 'none'" in page
    assert len(page.encode("utf-8")) < 5 * 2**20


def test_pictures_name_nothing_twice(page: str) -> None:
    named = re.findall(r'id="([^"]+)"', page)
    assert len(named) == len(set(named))
    used = set(re.findall(r'(?:xlink:href="#|url\(#)([^")]+)', page))
    assert used <= set(named)


def test_every_section_is_there_with_its_picture_table_and_command(page: str) -> None:
    for key, title in pages.TITLES.items():
        [section] = re.findall(rf'<section id="{key}">.*?</section>', page, re.DOTALL)
        assert f"<h2>{title.replace('&', '&amp;')}</h2>" in section
        if key == "network":
            assert "no packet can get lost" in section
            continue
        assert "<table>" in section and "As by <code>apc " in section
        assert ("<svg" in section) == (key != "compiled")
    assert AVERAGE.splitlines()[0] in page  # the scene's own text
    assert "prefers-color-scheme: dark" in page


def test_the_numbers_are_those_of_the_commands(found: Report) -> None:
    model = apc.compile(SCENE)
    sections = {one.key: one for one in found.scenes[0].sections}

    def value(key: str, table: int, name: str, column: int = 1) -> object:
        return next(row[column] for row in sections[key].tables[table].rows if row[0] == name)

    radius = value("verdict", 0, "spectral radius a frame")
    assert radius == pytest.approx(apc.analyze(model).spectral_radius, abs=1e-12)
    limit = value("limits", 0, "coordination.stiffness", 2)
    assert limit == apc.critical(model, "coordination.stiffness").value
    area = value("region", 0, "stable share of the rectangle")
    assert area == pytest.approx(apc.region(model).stable_area / (5000 * 1500))


def test_what_a_scene_says_is_text_and_no_markup(tmp_path: Path) -> None:
    evil = "</pre></script><script>alert(1)</script><img src=x>"
    path = tmp_path / "scene.yaml"
    path.write_text(replaced(LONE, ("lone\n", f'lone\nabout: "{evil}"\n')), encoding="utf-8")
    page = report_page(report([path]))
    reader = Reader()
    reader.feed(page)
    assert reader.scripts == ["application/json"]
    assert "<script>alert" not in page and "x" not in reader.wanted
    (tmp_path / "r.html").write_text(page, encoding="utf-8")
    assert kept_report(tmp_path / "r.html")["scenes"][0]["about"] == evil


def test_sections_that_a_scene_cannot_fill_say_why(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(LONE, encoding="utf-8")
    found = report([path])
    why = {one.key: one.refused for one in found.scenes[0].sections if one.refused}
    assert why["region"] == "the scene has fewer than two stiffnesses, and says no studies: region:"
    assert why["network"] == "loss: there is no link"
    assert all(f"Not here: {text}" in report_page(found).replace("&#x27;", "'") for text in why.values())


def test_over_an_unreliable_link_loss_and_jitter_are_looked_at_and_the_region_says_what_stable_means(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def refusing(system: apc.CompiledSystem, name: str) -> apc.Critical:  # what it answers takes minutes
        asked.append(name)
        raise apc.ApcError(Mistake("E898", Place("here"), f"{name} takes too long"))

    monkeypatch.setattr(contents, "critical", refusing)
    path = tmp_path / "scene.yaml"
    lossy = ("delay: 8 ms}", "delay: 8 ms, loss: 10 %, jitter: 1 ms}")
    path.write_text(replaced(AVERAGE, lossy, ("count: 3", "count: 2")), "utf-8")
    [scene] = apc.report(path).scenes
    sections = {one.key: one for one in scene.sections}
    assert {"lan.loss", "lan.jitter"} <= set(asked)
    told = " ".join((sections["network"].refused, *sections["network"].told))
    assert "loss: lan.loss takes too long" in told and "jitter: lan.jitter takes too long" in told
    assert "with every packet on time" in sections["region"].told[-1]
    assert "--in mean-square --out region.svg" in sections["region"].told[-1]
    assert "--in nominal" in sections["region"].command


def test_from_python_a_report_is_a_result_and_a_page(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(LONE, encoding="utf-8")
    found = apc.report(path, tmp_path / "r.html", set={"device.mass": "2 kg"})
    assert isinstance(found, apc.Report) and found.scenes[0].settings == ("device.mass=2 kg",)
    assert kept_report(tmp_path / "r.html")["scenes"][0]["settings"] == ["device.mass=2 kg"]
    again = apc.report([path], set={"device.mass": "2 kg"})
    assert (tmp_path / "r.html").read_text("utf-8") == report_page(again) + "\n"
    with pytest.raises(apc.ApcError, match="E616"):
        apc.report(path, path)


def test_a_report_is_computed_anew_from_itself_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("scene.yaml").write_text(replaced(LONE, ("{count: 1}", "{table: users.csv}")), encoding="utf-8")
    Path("users.csv").write_text("device.mass [kg]\n0.1\n0.12\n", encoding="utf-8")
    assert run(["report", "scene.yaml", "--set", "device.damping=2 N*s/m", "--out", "r.html"]) == 0
    for name in ("scene.yaml", "users.csv"):
        Path(name).unlink()
    assert run(["report", "--check", "r.html"]) == 0
    assert "r.html: every number is the same, computed anew" in capsys.readouterr().out
    assert sorted(one.name for one in tmp_path.iterdir()) == ["r.html"]
    text = Path("r.html").read_text(encoding="utf-8")
    kept = kept_report(Path("r.html"))
    name, old = kept["scenes"][0]["sections"][1]["tables"][0]["rows"][1][:2]
    version = f'"apc": "{apc.__version__}"'
    assert version in text
    text = text.replace(f"{old!r},", f"{old + 0.001!r},").replace(version, '"apc": "0.0.1"')
    Path("r.html").write_text(text, encoding="utf-8")
    assert run(["report", "--check", "r.html"]) == 1
    said = capsys.readouterr().err
    assert f"note: apc was 0.0.1, and is {apc.__version__} here" in said
    assert f"E991 Verdict, modes and margins: Verdict: value of {name} is {old:.12g}, not" in said
    assert name.startswith("spectral radius")


def test_differences_are_by_more_than_roundings_and_their_own_errors() -> None:
    def table(*rows: tuple[object, ...]) -> list[dict[str, object]]:
        return [{"title": "T", "columns": ["what", "value", "error"], "rows": [list(row) for row in rows]}]

    assert not differences(table(("a", 1.0, 1e-9)), table(("a", 1.0 + 1e-8, 1e-3)))
    assert not differences(table(("a", 1.0, 0.2)), table(("a", 1.1, None)))
    assert not differences(
        table(("a", 1.0, None), ("b", 1e-17, None)), table(("a", 1.0, None), ("b", -3e-16, None))
    )
    assert differences(table(("a", 1.0, 1e-9)), table(("a", 1.1, 1e-9))) == ["T: value of a is 1.1, not 1"]
    assert differences(table(("a", None, None)), table(("a", 2.0, None))) == [
        "T: value of a is 2, not nothing"
    ]
    assert differences(table(), table(("a", 1.0, None))) == ["T: 1 row, not the 0 that it has"]
    assert differences([], table()) == ["T is new"] and differences(table(), []) == ["T is gone"]


@pytest.mark.parametrize(
    "kept",
    [
        "",
        "<html></html>",
        '<script type="application/json" id="apc-report">[]</script>',
        '<script type="application/json" id="apc-report">{"scenes": [{"name": 3}]}</script>',
    ],
)
def test_what_is_no_report_is_refused(kept: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.html"
    path.write_text(kept, encoding="utf-8")
    assert run(["report", "--check", str(path)]) == 1
    assert "E990 is no report that apc has written, or is damaged" in capsys.readouterr().err
    assert run(["report", "--check", str(tmp_path / "none.html")]) == 1
    assert "E990" in capsys.readouterr().err


@pytest.mark.parametrize(
    "name", ["../out.yaml", "/tmp/out.yaml", "a/../../out.yaml", "C:out.yaml", "a\\..\\b"]
)
def test_a_report_from_somebody_writes_nowhere_else(
    name: str, page: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "r.html"
    old = json.dumps(["three-users-average.yaml", "x"])[:-5]
    assert old in page
    path.write_text(page.replace(old, json.dumps([name, "x"])[:-5]), encoding="utf-8")
    assert run(["report", "--check", str(path)]) == 1
    assert "E990 names a file outside of the scene's folder" in capsys.readouterr().err


def test_a_number_that_there_is_not_is_a_dash() -> None:
    table = Table("T", ("where", "frequency [Hz]"), (("a", math.nan), ("b", None), ("c", 2.5)))
    shown = re.findall(r"<td[^>]*>([^<]*)</td>", pages._table(table))
    assert shown == ["a", "–", "b", "–", "c", "2.5"]


def test_several_scenes_stand_side_by_side(tmp_path: Path) -> None:
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text(replaced(LONE, ("lone", name)), encoding="utf-8")
    page = report_page(report([tmp_path / "one.yaml", tmp_path / "two.yaml"]))
    [section] = re.findall(r'<section id="verdict">.*?</section>', page, re.DOTALL)
    assert "<h3>one</h3>" in section and "<h3>two</h3>" in section
    assert '<section id="compared">' in page and "apc compare one.yaml two.yaml" in page


def test_what_cannot_be_written_or_read_is_refused_before_anything_is_computed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["report", str(SCENE), "--out", "r.txt"]) == 1
    assert "E878 the suffix of --out" in capsys.readouterr().err
    assert run(["report", str(SCENE), "--out", "no/r.html"]) == 1
    assert "E601" in capsys.readouterr().err
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert run(["report", str(SCENE), "--out", "r.pdf"]) == 1
    assert (
        "E875 Chromium is not installed, which prints a .pdf. Write: --out r.html" in capsys.readouterr().err
    )
    assert run(["report", str(SCENE)]) == 2
    assert run(["report", "scene.apc", "--out", "r.html"]) == 1
    assert "E615" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not any(map(shutil.which, pages.BROWSERS)), reason="there is no Chromium")
def test_on_paper_what_is_told_stays_with_its_figure(tmp_path: Path) -> None:
    """Each h2 and the figure below it, though sentences stand between them, begin on one page."""
    pytest.importorskip("playwright.sync_api")
    from playwright.sync_api import sync_playwright

    page = (
        f"<style>{pages._STYLE} @page {{ size: 400px 400px; margin: 0; }} svg {{ height: 300px; }}</style>"
        '<p style="height: 310px">Above</p><section><div class="scenes"><div>'
        "<h2>Over time</h2><p>It settles.</p><p>Twice.</p><figure><svg></svg></figure></div></div></section>"
    )
    out = tmp_path / "r.pdf"
    with sync_playwright() as play:
        path = next(one for name in pages.BROWSERS if (one := shutil.which(name)))
        browser = play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        shown = browser.new_page()
        shown.set_content(page)
        out.write_bytes(shown.pdf(prefer_css_page_size=True))
        browser.close()
    assert len(re.findall(rb"/Type\s*/Page\b", out.read_bytes())) == 2


@pytest.mark.skipif(not any(map(shutil.which, pages.BROWSERS)), reason="there is no Chromium")
def test_a_pdf_is_printed(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(LONE, encoding="utf-8")
    pages.save_report(report([tmp_path / "scene.yaml"]), tmp_path / "r.pdf")
    assert (tmp_path / "r.pdf").read_bytes().startswith(b"%PDF")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["r.pdf", "scene.yaml"]
