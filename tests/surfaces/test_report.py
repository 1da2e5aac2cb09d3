"""A report: one page that holds everything in itself, whose numbers are those of the commands."""

from __future__ import annotations

import base64
import functools
import html
import json
import re
import shlex
import shutil
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.app.motion import motion_of
from apc.output import report_output as pages
from apc.output.report_output import read_page, report_page
from apc.reports.contents import Report, differences
from apc.reports.shown_lines import line_differences
from tests.commands import Cli, folder, write
from tests.surfaces.pages import CHROMIUM, launched
from tests.topologies import AVERAGE, TOPOLOGIES, replaced

TOPOLOGY = TOPOLOGIES / "three-users-average.yaml"


LONE = "topology: lone\npeers: {user: {count: 1}}\nmasses: {device: {mass: 1 kg, damping: 1 N*s/m}}\n"


@functools.cache
def paper() -> Report:
    return apc.report(TOPOLOGY)


@functools.cache
def page() -> str:
    return report_page(paper())


class Reader(HTMLParser):
    """What of a page would be loaded or run; every element must be closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.requested: list[str] = []
        self.scripts: list[str | None] = []
        self.open: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what an element names."""
        for name, value in attrs:
            self.requested += (
                [value] if name in ("src", "href", "xlink:href", "data", "action") and value else []
            )
            assert not name.startswith("on"), name
        self.scripts += [dict(attrs).get("type")] if tag == "script" else []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note that an element begins."""
        self.handle_startendtag(tag, attrs)
        self.open += [tag] if tag not in ("meta", "link", "br", "img", "input") else []

    def handle_endtag(self, tag: str) -> None:
        """Check that what ends had begun last."""
        assert self.open.pop() == tag


@pytest.mark.whole
def test_a_page_loads_nothing_runs_nothing_and_names_nothing_twice() -> None:
    reader = Reader(page())
    assert all(one.startswith(("#", "data:")) for one in reader.requested)
    assert reader.scripts == ["application/json"]
    assert "default-src 'none'" in page()
    assert len(page().encode("utf-8")) < 5 * 2**20
    named = re.findall(r'id="([^"]+)"', page())
    assert len(named) == len(set(named))
    assert set(re.findall(r'(?:xlink:href="#|url\(#)([^")]+)', page())) <= set(named)


def test_every_section_is_there_with_its_picture_text_and_command() -> None:
    for key, title in pages.TITLES.items():
        [section] = re.findall(rf'<section id="{key}">.*?</section>', page(), re.DOTALL)
        assert f"<h2>{title.replace('&', '&amp;')}</h2>" in section
        if key == "network":
            assert "no link has a loss" in section
            continue
        assert "<pre>" in section and "Produced by <code>apc " in section
        assert ("data:image/svg" in section) == (key != "compiled")
    assert AVERAGE.splitlines()[0] in page()  # the topology's own text
    assert "prefers-color-scheme: dark" in page()


def test_the_numbers_are_those_of_the_commands() -> None:
    model = apc.compile(TOPOLOGY)
    sections = {one.key: one for one in paper().topologies[0].sections}
    assert str(apc.margins(model)) in str(sections["verdict"].results[0])
    [stiffness, _] = sections["limits"].results
    assert str(stiffness) == str(apc.critical(model, "coordination.stiffness")) in page()
    [region] = sections["region"].results
    assert str(region) == str(apc.region(model)) in page()


def test_one_user_is_struck_as_by_the_command_and_in_the_browser() -> None:
    """A common initial velocity excites the common mode alone, in which mesh and average are the same."""
    section = next(one for one in paper().topologies[0].sections if one.key == "response")
    [played] = section.results
    start = {one.name: played.values[0, at] for at, one in enumerate(played.signals) if one.unit == "m/s"}
    assert {name: value for name, value in start.items() if value} == {"user[1].device.v": 0.1}
    words = shlex.split(section.command)
    assert words[words.index("--impulse") + 1] == "user[1]"
    observed = motion_of(apc.compile(TOPOLOGY), struck=True)
    places = [at for at, one in enumerate(played.signals) if one.local == "device.x"]
    moved = 1e3 * played.values[:, places]
    columns = [at for at, (_, body) in enumerate(observed.bodies) if body.states[0] == "device.x"]
    off = observed.x[:, columns] - observed.x[0, columns]
    rows = np.searchsorted(played.time, observed.time)
    np.testing.assert_allclose(off, moved[rows], atol=1e-9)


@pytest.mark.whole
def test_what_a_topology_says_is_text_and_no_markup(cli: Cli) -> None:
    evil = "</pre></script><script>alert(1)</script><img src=x>"
    write("topology.yaml", replaced(LONE, ("lone\n", f'lone\ndescription: "{evil}"\n')))
    assert cli("report topology.yaml --out r.html").code == 0
    text = Path("r.html").read_text("utf-8")
    reader = Reader(text)
    assert reader.scripts == ["application/json"]
    assert "<script>alert" not in text and "x" not in reader.requested
    assert read_page(Path("r.html")).stored["topologies"][0]["description"] == evil


@pytest.mark.whole
def test_sections_that_a_topology_cannot_fill_say_why(cli: Cli) -> None:
    write("topology.yaml", LONE)
    report = apc.report("topology.yaml")
    why = {one.key: one.refused for one in report.topologies[0].sections if one.refused}
    assert (
        why["region"]
        == "fewer than two stiffnesses are common to all peers; the topology has no studies.region"
    )
    assert why["network"] == "loss: there is no link"
    text = html.unescape(report_page(report))
    assert all(f"Not available: {reason}" in text for reason in why.values())


@pytest.mark.whole
def test_from_python_a_report_is_a_result_and_a_page(cli: Cli) -> None:
    write("topology.yaml", LONE)
    report = apc.report("topology.yaml", "r.html", params={"device.mass": "2 kg"})
    assert isinstance(report, apc.Report) and report.topologies[0].settings == ("device.mass=2 kg",)
    assert read_page(Path("r.html")).stored["topologies"][0]["settings"] == ["device.mass=2 kg"]
    repeated = apc.report(["topology.yaml"], params={"device.mass": "2 kg"})
    assert Path("r.html").read_text("utf-8") == report_page(repeated) + "\n"
    with pytest.raises(apc.ApcError, match="E616"):
        apc.report("topology.yaml", "topology.yaml")


@pytest.mark.whole
def test_a_report_is_computed_anew_from_itself_alone(cli: Cli) -> None:
    write("topology.yaml", replaced(LONE, ("{count: 1}", "{table: users.csv}")))
    write("users.csv", "device.mass [kg]\n0.1\n0.12\n")
    assert cli("report topology.yaml --set 'device.damping=2 N*s/m' --out r.html").code == 0
    for name in ("topology.yaml", "users.csv"):
        Path(name).unlink()
    assert "r.html: all numbers reproduced" in cli("report --check r.html").out
    assert folder() == ["r.html"]
    text = Path("r.html").read_text(encoding="utf-8")
    stored = read_page(Path("r.html")).stored
    old = stored["topologies"][0]["sections"][1]["results"][0]["spectral_radius"]
    version = f'"apc": "{apc.__version__}"'
    assert version in text
    write("r.html", text.replace(f"{old!r},", f"{old + 0.001!r},").replace(version, '"apc": "0.0.1"'))
    ran = cli("report --check r.html")
    assert ran.code == 1
    assert f"note: apc: 0.0.1 in the report, {apc.__version__} here" in ran.err
    assert f"E991 Verdict, modes and margins: [1].spectral_radius is {old:.12g}, not" in ran.err


@pytest.mark.parametrize(
    ("old", "new", "reported"),
    [
        ({"a": 1.0, "error": 1e-9}, {"a": 1.0 + 1e-8, "error": 1e-3}, []),
        ({"a": 1.0, "a_error": 0.2}, {"a": 1.1, "a_error": None}, []),
        ([1.0, 1e-17], [1.0, -3e-16], []),
        ({"a": [1.0], "error": 1e-9}, {"a": [1.1], "error": 1e-9}, ["a[1] is 1.1, not 1"]),
        ({"a": None}, {"a": 2.0}, ["a is 2, not nothing"]),
        ([], [1.0], ["[1] is 1, not nothing"]),
    ],
)
def test_differences_are_by_more_than_roundings_and_their_own_errors(
    old: object, new: object, reported: list[str]
) -> None:
    assert [*differences(old, new)] == reported


def in_figure(page: str, old: str, new: str) -> str:
    """Return a page in whose figures a text is another one."""

    def changed(found: re.Match[str]) -> str:
        drawn = base64.b64decode(found[1]).decode("utf-8").replace(old, new)
        return f"base64,{base64.b64encode(drawn.encode('utf-8')).decode('ascii')}"

    return re.sub(r"base64,([^\"]+)", changed, page)


@pytest.mark.whole
def test_what_a_page_shows_is_what_is_checked(cli: Cli) -> None:
    write("topology.yaml", LONE)
    assert cli("report topology.yaml --out r.html").code == 0
    text = Path("r.html").read_text(encoding="utf-8")
    [radius] = re.findall(r"(spectral radius +[0-9.]+)", text)[:1]
    stored = text[text.index(SCRIPT) :]
    changes = {
        "a digit": text.replace(radius, f"{radius[:-1]}{(int(radius[-1]) + 1) % 10}"),
        "a verdict": text.replace("lone: ", "lone: proved "),
        "a mass": text.replace("<pre>" + LONE, "<pre>" + LONE.replace("1 kg", "2 kg")),
        "a figure": in_figure(text, "</text>", "0</text>"),
        "a curve": in_figure(text, "L 1", "L 2"),
        "what no figure is": re.sub("base64,....", "base64,?", text),
        "a command": text.replace("apc analyze", "apc analyse"),
        "a style": text.replace("</style>", "pre { display: none; }\n</style>"),
        "an inserted line": text.replace("<header>", "<p>gain margin 9</p>\n<header>"),
        "a removed section": re.sub(r'<section id="verdict">.*?</section>\n', "", text, flags=re.DOTALL),
        "the end": text.replace("</body>", "").replace("</html>", ""),
        "a second one": text.replace("</body>", stored.partition("</script>")[0] + "</script></body>"),
        "a version": text.replace(f"apc              {apc.__version__}", "apc              9.9.9"),
    }
    for what, page in changes.items():
        assert page != text, what
        write("r.html", page)
        ran = cli("report --check r.html")
        assert ran.code == 1, what
        assert re.search(r"^r\.html:\d+:1: E991 line: expected ", ran.err, re.MULTILINE), (what, ran.err)
        assert "every number" not in ran.out
    write("r.html", text)
    assert cli("report --check r.html").code == 0


@pytest.mark.parametrize(
    ("shown", "expected", "same"),
    [
        ("radius 0.957171 ± 7e-16 per frame", "radius 0.957172 ± 3e-16 per frame", True),
        ("radius 0.95717138962509 ±", "radius 0.95717138962511 ±", True),
        ("radius 0.957171", "radius 0.957181", False),
        ("margin 1.6", "margin 1.7", False),
        ("margin 3", "margin 4", False),
        ("1,000,000 peers", "1,000,001 peers", True),
        ("± 7e-16", "± 7e-14", False),
        ("stable", "unstable", False),
        ("-1", "1", False),
        ("a 1 b", "a 1 b 2", False),
        ("1e999", "1e998", False),
        ("a\nb", "a", False),
        ("", "a", False),
    ],
)
def test_lines_differ_by_more_than_roundings(shown: str, expected: str, same: bool) -> None:
    assert (not [*line_differences(shown, expected, exact=False)]) == same
    assert [*line_differences(shown, expected, exact=True)]


def test_a_line_that_differs_is_named_once_and_by_its_number() -> None:
    [found] = line_differences("a\nb\nX\nd", "a\nb\nc\nd", exact=True)
    assert (found.line, found.shown, found.expected) == (3, "X", "c")
    [found] = line_differences("a\nb\nX\nc\nd", "a\nb\nc\nd", exact=True)
    assert (found.line, found.shown, found.expected) == (3, "X", "nothing")
    [found] = line_differences("a\nb\nd", "a\nb\nc\nd", exact=True)
    assert (found.line, found.shown, found.expected) == (3, "nothing", "c")


SCRIPT = '<script type="application/json" id="apc-report">'


@pytest.mark.parametrize(
    "stored",
    [
        "",
        "<html></html>",
        "<html><script type='application/json'>{}</script></html>",
        SCRIPT,
        f"{SCRIPT}</script>",
        f"{SCRIPT}{{</script>",
        f"{SCRIPT}[]</script>",
        f"{SCRIPT}{'[' * 100_000}</script>",
        SCRIPT * 10_000,
        f'{SCRIPT}{{"topologies": [{{"name": 3}}]}}</script>',
        None,
    ],
)
def test_what_is_no_report_is_refused(stored: str | None, cli: Cli) -> None:
    if stored is not None:
        write("r.html", stored)
    ran = cli("report --check r.html")
    assert ran.code == 1 and "E990" in ran.err
    assert stored is None or "E990 is no report that apc has written, or is damaged" in ran.err


@pytest.mark.parametrize(
    "name", ["../out.yaml", "/tmp/out.yaml", "a/../../out.yaml", "C:out.yaml", "a\\..\\b"]
)
def test_a_report_from_somebody_writes_nowhere_else(name: str, cli: Cli) -> None:
    old = json.dumps(["three-users-average.yaml", "x"])[:-5]
    assert old in page()
    write("r.html", page().replace(old, json.dumps([name, "x"])[:-5]))
    ran = cli("report --check r.html")
    assert ran.code == 1 and "E990 names a file outside of the topology's folder" in ran.err
    assert folder() == ["r.html"]


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (f"'{TOPOLOGY}' --out r.txt", 1, "E878 suffix of --out"),
        (f"'{TOPOLOGY}' --out no/r.html", 1, "E601"),
        (
            f"'{TOPOLOGY}' --out r.pdf",
            1,
            "E875 Chromium is not installed, which prints a .pdf. Try: --out r.html",
        ),
        (f"'{TOPOLOGY}'", 2, "--out"),
        ("topology.apc --out r.html", 1, "E615"),
    ],
)
def test_what_cannot_be_written_or_read_is_refused_before_anything_is_computed(
    words: str, code: int, message: str, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    ran = cli(f"report {words}")
    assert ran.code == code and message in ran.err
    assert folder() == []


@pytest.mark.skipif(not any(map(shutil.which, pages.BROWSERS)), reason="there is no Chromium")
def test_a_pdf_is_printed(tmp_path: Path) -> None:
    (tmp_path / "topology.yaml").write_text(LONE, encoding="utf-8")
    pages.save_report(apc.report([tmp_path / "topology.yaml"]), tmp_path / "r.pdf")
    assert (tmp_path / "r.pdf").read_bytes().startswith(b"%PDF")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["r.pdf", "topology.yaml"]


def made_up(**fields: object) -> str:
    """Return a page of one topology with some other fields."""
    topology = {"name": "n", "description": "", "file": "s.yaml", "settings": [], "texts": [["s.yaml", LONE]]}
    topology |= {"origin": [], "sections": []} | fields
    return f"{SCRIPT}{json.dumps({'versions': {}, 'topologies': [topology]})}</script>"


HUGE = [{"key": "verdict", "refused": "", "results": [{"spectral_radius": 10**400}]}]


@pytest.mark.parametrize(
    ("page", "reported"),
    [
        (f'{SCRIPT}{{"versions": {{}}, "topologies": []}}</script>', "holds no topology"),
        (made_up(file=""), "holds no text of ''"),
        (made_up(file="other.yaml"), "holds no text of 'other.yaml'"),
        (
            made_up(texts=[["s.yaml", LONE], ["a", ""], ["a/b", ""]]),
            "names a file that can't be written: 'a/b'",
        ),
        (made_up(texts=[["s.yaml", LONE], ["a" * 300, ""]]), "names a file that can't be written: 'aaa"),
        (made_up(texts=[["s.yaml", LONE], ["a\0b", ""]]), "names a file that can't be written"),
        (made_up(sections=HUGE), "is no report that apc has written, or is damaged"),
    ],
)
def test_what_another_program_put_into_a_page_is_refused(page: str, reported: str, cli: Cli) -> None:
    write("r.html", page)
    ran = cli("report --check r.html")
    assert ran.code == 1 and f"E990 {reported}" in ran.err
    assert folder() == ["r.html"]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-32", "latin-1"])
def test_a_page_in_another_encoding_is_refused(encoding: str, cli: Cli) -> None:
    Path("r.html").write_bytes(f"é{made_up()}".encode(encoding))
    ran = cli("report --check r.html")
    assert ran.code == 1 and "E990" in ran.err


def test_a_folder_is_no_report(cli: Cli) -> None:
    Path("r.html").mkdir()
    ran = cli("report --check r.html")
    assert ran.code == 1 and "E990 is a folder" in ran.err


@pytest.mark.whole
def test_a_digest_that_is_not_that_of_its_text_is_found(cli: Cli) -> None:
    write("topology.yaml", LONE)
    assert cli("report topology.yaml --out r.html").code == 0
    text = Path("r.html").read_text(encoding="utf-8")
    digest = dict(read_page(Path("r.html")).stored["topologies"][0]["origin"])["topology.yaml"]
    write("r.html", text.replace(digest, "0" * 64))
    ran = cli("report --check r.html")
    assert ran.code == 1 and "SHA-256 of topology.yaml does not match its text" in ran.err


@pytest.mark.whole
def test_several_topologies_are_checked_side_by_side(cli: Cli) -> None:
    write("a.yaml", LONE)
    write("b.yaml", LONE.replace("1 kg", "2 kg"))
    assert cli("report a.yaml b.yaml --out r.html").code == 0
    assert cli("report --check r.html").code == 0
    text = Path("r.html").read_text(encoding="utf-8")
    compared = text.index('<section id="compared">')
    write("r.html", text[:compared] + text[compared:].replace("lone", "alone", 1))
    ran = cli("report --check r.html")
    assert ran.code == 1 and "E991 line: expected" in ran.err


@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium")
def test_code_of_a_report_fits_a_window_of_1200_pixels(tmp_path: Path) -> None:
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    line = '<pre>{}</pre><div class="topologies"><div><pre>{}</pre></div><div><pre>{}</pre></div></div>'
    wide = page().partition("<main>")[0] + "<main>" + line.format(*["x" * 79 + " " + "word " * 60] * 3)
    with launched() as browser:
        for text in (page(), wide + "</main></body></html>"):
            (tmp_path / "r.html").write_text(text, encoding="utf-8")
            tab = browser.new_page(viewport={"width": 1200, "height": 900})
            tab.goto((tmp_path / "r.html").as_uri())
            scrolled = (
                "[...document.querySelectorAll('pre')].filter(p => p.scrollWidth > p.clientWidth).length"
            )
            assert tab.evaluate(scrolled) == 0
            assert tab.evaluate("document.documentElement.scrollWidth") <= 1200
