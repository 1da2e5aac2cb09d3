"""The page of a topology: its sliders say what they set, its answers are the API's, and nobody else gets
in.
"""

from __future__ import annotations

import base64
import gzip
import http.client
import json
import logging
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

import apc
from apc.compiler.compiled import Model
from apc.parameter_values.overrides import parse_override
from apc.parameter_values.parameter_names import ParameterRef
from tests.commands import Cli, write
from tests.surfaces.pages import CHROMIUM, MODEL, VERDICT, Tab, launched, served
from tests.topologies import AVERAGE, TOPOLOGIES

pytest.importorskip("bokeh")

from bokeh.document import Document

from apc.app import sections
from apc.app.figures import MotionFigure, RegionFigure, RootsFigure, TransparencyFigure
from apc.app.motion import motion_of
from apc.app.page import TopologyTab, topology_of
from apc.app.sections import SectionAnswer, Task, compute
from apc.app.server import MOST, _shortened
from apc.app.sliders import (
    Slider,
    axes_of,
    is_number,
    overrides_of,
    position_of,
    set_to,
    sliders_of,
    with_value,
)
from apc.app.worker_process import SectionWorker
from apc.app.yaml_edit import with_values
from apc.simulation.initial_velocity import SPEED
from apc.support.processes import Workers, model_bytes

NOTHING = "topology: none\npeers: {user: {count: 1}}\nmasses: {}\n"
LOSSY = AVERAGE.replace("delay: 8 ms}", "delay: 8 ms, loss: 10 %, jitter: 1 ms}")


def compiled(text: str, folder: Path) -> Model:
    (folder / "topology.yaml").write_text(text, encoding="utf-8")
    return apc.compile(folder / "topology.yaml")


def named(sliders: tuple[Slider, ...], label: str) -> Slider:
    return next(one for one in sliders if one.label == label)


# The sliders.


@pytest.mark.few(2)
@pytest.mark.parametrize(
    "name", ["three-users-average", "experiment-average", "mixed-clocks", "lossy-average"]
)
def test_what_a_slider_says_is_what_set_takes(name: str) -> None:
    model = apc.compile(TOPOLOGIES / f"{name}.yaml")
    for one in sliders_of(model):
        assert list(one.values) == sorted(set(one.values)), one.label
        for value, text in zip(one.values, one.texts, strict=True):
            assert parse_override(model, f"{one.label}={text}").value == value


def test_every_number_of_the_paper_s_topology_has_a_slider(tmp_path: Path) -> None:
    sliders = sliders_of(compiled(AVERAGE, tmp_path))
    assert [one.label for one in sliders] == [
        *("contact.stiffness", "coordination.stiffness", "contact.damping", "coordination.damping"),
        *("device.mass", "device.damping", "cube.mass", "cube.damping"),
        *("contact.delay", "coordination.delay", "lan.delay", "haptic.period", "network.period"),
        *("haptic.phase", "network.phase", "user.count"),
    ]
    stiffness, mass = named(sliders, "contact.stiffness"), named(sliders, "device.mass")
    assert (stiffness.texts[stiffness.start], stiffness.span) == ("1000 N/m", (0, 5000))  # the study's
    ratios = [float(b / a) for a, b in zip(mass.values, mass.values[1:], strict=False)]
    assert mass.values[0] == Fraction(1, 1000) and mass.values[-1] == 10  # four decades
    assert max(ratios) / min(ratios) < 1.02  # even on a logarithmic scale, but for three digits
    assert named(sliders, "user.count").texts == tuple(str(k) for k in range(2, 13))
    for label, other in (("haptic.period", Fraction(8, 1000)), ("network.period", Fraction(1, 1000))):
        for period in named(sliders, label).values:  # one is a multiple of the other: frames stay short
            assert (max(period, other) / min(period, other)).denominator == 1


def test_a_value_that_a_slider_has_not_gets_a_place_of_its_own(tmp_path: Path) -> None:
    model = compiled(AVERAGE, tmp_path)
    sliders = sliders_of(model)
    place, value = set_to(model, sliders, "contact.stiffness=1234.5 N/m")
    moved, at = with_value(sliders[place], value)
    assert moved.texts[at] == "1234.5 N/m" and moved.values[moved.start] == 1000
    (override,) = overrides_of([moved], [at])
    assert override.value == Fraction("1234.5")
    assert overrides_of([moved], [moved.start]) == []
    assert moved.values[position_of(moved, 1234.0)] == Fraction("1234.5")


def test_what_follows_from_others_has_no_slider(tmp_path: Path) -> None:
    text = AVERAGE.replace("stiffness: 500 N/m", "stiffness: kt/(peers - 1)")
    model = compiled(text.replace("clocks:", "parameters: {kt: 1000 N/m}\nclocks:"), tmp_path)
    sliders = sliders_of(model)
    assert "kt" in [one.label for one in sliders]
    with pytest.raises(apc.ApcError, match=r"E980 coordination\.stiffness has no slider"):
        set_to(model, sliders, "coordination.stiffness=500 N/m")


# What is computed.


@pytest.mark.whole
def test_sections_tell_what_the_api_tells(tmp_path: Path) -> None:
    compiled_model = compiled(AVERAGE, tmp_path)
    sliders, model = sliders_of(compiled_model), model_bytes(compiled_model)
    places = [one.start for one in sliders]
    places[sliders.index(named(sliders, "lan.delay"))] += 40
    overrides = tuple(overrides_of(sliders, places))
    setting = {one.free.label: f"{float(one.value) * 1e3!r} ms" for one in overrides}

    def report_of(section: str, requested: Any = None) -> dict[str, Any]:
        answer = compute(model, Task(section, overrides, requested)).result
        assert answer is not None
        return answer

    analysis, whole = apc.analyze(compiled_model, params=setting), apc.region(compiled_model, params=setting)
    verdict, transparency = report_of("verdict"), report_of("transparency")
    assert verdict["radius"] == analysis.spectral_radius and verdict["text"] == str(analysis)
    region = report_of("region", (*axes_of(sliders, places, (0, 1)), "nominal"))
    assert region["share"] == pytest.approx(whole.stable_area / (5000 * 1500), rel=1e-4)  # drawn to 1e-5
    used = apc.transparency(compiled_model, transparency["frequency"], params=setting)
    assert np.array_equal(transparency["magnitude"], np.abs(used.impedance))
    best = apc.tune(
        compiled_model, {"contact.stiffness": "0 N/m:5000 N/m"}, maximize="contact.stiffness", params=setting
    )
    assert report_of("tune", (("contact.stiffness=0 N/m:5000 N/m",), "contact.stiffness"))["text"] == str(
        best
    )


def test_a_section_that_a_topology_has_nothing_for_says_so(tmp_path: Path) -> None:
    model = model_bytes(compiled(AVERAGE, tmp_path))
    reported = compute(model, Task("network", ()))
    assert reported.result is None
    assert "no link here loses packets" in reported.why and "loss: 1 %" in reported.why
    unstable = (parse_override(compiled(AVERAGE, tmp_path), "contact.stiffness=5000 N/m"),)
    why = compute(model, Task("transparency", unstable)).why
    assert "unstable" in why and "--" not in why  # a page has no command line


def test_a_struck_device_moves_as_its_equation_says(tmp_path: Path) -> None:
    """m v' = −b v from v(0) = 0.1 m/s: x = v m/b (1 − e^(−b t/m))."""
    text = "topology: one\npeers: {user: {count: 1}}\nmasses: {device: {mass: 2 kg, damping: 3 N*s/m}}\n"
    motion = motion_of(compiled(text, tmp_path), struck=True)
    expected = 1e3 * SPEED * 2 / 3 * (1 - np.exp(-1.5 * motion.time))
    assert np.allclose(motion.x.T, expected, rtol=1e-9, atol=1e-12)
    with pytest.raises(apc.ApcError, match="E983"):
        motion_of(compiled(NOTHING, tmp_path), struck=True)


def test_what_goes_wrong_in_a_section_is_told_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> dict[str, Any]:
        raise ValueError("shapes differ")

    monkeypatch.setitem(sections.SECTIONS, "transparency", broken)
    reported = compute(model_bytes(compiled(AVERAGE, tmp_path)), Task("transparency", ()))
    assert reported.why == "Internal error of apc: ValueError: shapes differ"


# Who computes it.


class Held:
    """Workers that do nothing until they are told to."""

    def __init__(self) -> None:
        self.requested: list[tuple[Task, Future[SectionAnswer]]] = []

    def submit(self, task: Task) -> Future[SectionAnswer]:
        self.requested.append((task, Future()))
        return self.requested[-1][1]

    def finish(self, place: int) -> None:
        task, future = self.requested[place]
        future.set_result(SectionAnswer({"of": task.request}))


def at_once(call: Callable[[], None], seconds: float) -> None:
    if not seconds:
        call()


def test_an_old_answer_never_takes_the_place_of_a_newer_one() -> None:
    held, shown = Held(), []
    desk = SectionWorker(
        b"", ("a", "b"), at_once, lambda section, reported: shown.append((section, reported.result))
    )
    desk.workers = Workers(held.submit, 1, lambda _: None)
    assert desk.submit(Task("b", (), 1)) and not desk.submit(Task("b", (), 1))
    for number in (2, 3, 4):  # while it computes, the newest waits in the place of those before it
        desk.submit(Task("b", (), number))
    desk.submit(Task("a", (), 5))
    held.finish(0)
    held.finish(1)
    held.finish(2)
    assert shown == [("b", {"of": 1}), ("a", {"of": 5}), ("b", {"of": 4})]
    desk.submit(Task("b", (), 6))
    desk.cancel("b")
    held.finish(3)
    assert len(shown) == 3


# The topology with other values.


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("label", "value", "line"),
    [
        ("contact.stiffness", "800 N/m", "stiffness: 800 N/m, clock: haptic"),
        ("contact.damping", "2 N*s/m", "delay: 1 ms, damping: 2 N*s/m}"),
        ("network.period", "4 ms", "network: 4 ms"),
        ("network.phase", "1 ms", "network: {period: 8 ms, phase: 1 ms}"),
        ("lan.delay", "3 ms", "delay: 3 ms}"),
        ("user.count", "5", "user: {count: 5}"),
    ],
)
def test_a_value_is_written_where_it_stands(label: str, value: str, line: str, tmp_path: Path) -> None:
    model = compiled(AVERAGE, tmp_path)
    text = with_values(AVERAGE, model, {ParameterRef(label): value})
    assert line in text
    changed = compiled(text, tmp_path)
    expected = apc.analyze(model, params={label: value})
    assert apc.analyze(changed).spectral_radius == pytest.approx(expected.spectral_radius, rel=1e-12)
    assert len(text.splitlines()) == len(AVERAGE.splitlines())  # and comments stay where they were
    assert "# a copy at each peer" in text


# What can't be.


def test_what_can_t_be_explored_is_told_before_a_page_is_served(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    write("topology.yaml", AVERAGE)
    assert "E204" in cli("explore topology.yaml --set 'contact.stiffness=5 kg'").err
    with socket.socket() as used:
        used.bind(("127.0.0.1", 0))
        used.listen()
        port = used.getsockname()[1]
        message = f"--port: E982 port {port} is taken. Try: --port 0\n"
        assert cli(f"explore topology.yaml --no-browser --port {port}") == (1, "", "starting ...\n" + message)
    monkeypatch.setitem(sys.modules, "bokeh.server.server", None)
    message = "E875 bokeh.server.server is not installed. Try: pip install '.[explore]'"
    assert message in cli("explore topology.yaml").err


# In a browser.


@pytest.fixture(scope="module")
def link(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    path = tmp_path_factory.mktemp("explore") / "topology.yaml"
    path.write_text(AVERAGE, encoding="utf-8")
    with served(path) as found:
        yield found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with launched() as found:
        yield found


@pytest.fixture(scope="module")
def tab(browser: Any, link: str) -> Iterator[Tab]:
    """Open a tab that several tests use, whichever values it has come to."""
    found = Tab(browser, link)
    yield found
    found.close(link)


def test_a_slider_that_is_moved_changes_region_and_verdict_to_what_the_api_says(
    browser: Any, link: str, tab: Tab, tmp_path: Path
) -> None:
    model = compiled(AVERAGE, tmp_path)
    first, second = Tab(browser, link), tab
    first.radius(apc.analyze(model).spectral_radius)
    text = first.press("lan.delay", "PageUp", 3).replace("·", "*")
    setting = {"lan.delay": text}
    assert text != "8 ms"
    first.radius(apc.analyze(model, params=setting).spectral_radius)
    share = apc.region(model, params=setting).stable_area / (5000 * 1500)
    first.page.wait_for_function(f"{MODEL}('region-words').text.includes('{100 * share:.3g} %')")
    # An axis of the region: the point moves, and the verdict becomes another.
    text = first.press("contact.stiffness", "End", 1).replace("·", "*")
    found = apc.analyze(model, params=setting | {"contact.stiffness": text})
    assert found.stable is False
    first.radius(found.spectral_radius)
    assert "class='unstable'" in first.page.evaluate(VERDICT)
    # The link holds the values, and opens with them; the second tab knows nothing of it.
    first.page.wait_for_function("location.search.includes('contact.stiffness=5000')")
    assert parse_qs(urlsplit(first.page.url).query)["lan.delay"] == [setting["lan.delay"]]
    url = first.page.url
    first.close(link)
    third = Tab(browser, url)
    third.radius(found.spectral_radius)
    third.close(link)
    second.radius(apc.analyze(model).spectral_radius)
    assert second.press("lan.delay", "Tab", 1) == "8 ms"
    second.check(link)


@pytest.mark.whole
def test_topology_and_numbers_are_downloaded_with_the_values(tab: Tab, link: str, tmp_path: Path) -> None:
    text = tab.press("device.damping", "PageUp", 3).replace("·", "*")
    found = {}
    for label in ("Topology", "Picture", "Numbers"):
        with tab.page.expect_download() as waited:
            tab.page.get_by_role("button", name=label).click()
        found[label] = tmp_path / waited.value.suggested_filename
        waited.value.save_as(found[label])
    numbers = json.loads(found["Numbers"].read_text("utf-8"))
    assert numbers["set"]["device.damping"] == text
    expected = apc.analyze(compiled(AVERAGE, tmp_path), params=numbers["set"])
    assert apc.analyze(found["Topology"]).spectral_radius == expected.spectral_radius
    assert found["Picture"].read_bytes().startswith(b"\x89PNG")
    assert numbers["analyze"]["spectral_radius"] == expected.spectral_radius
    assert numbers["region"]["x"]["parameter"] == "contact.stiffness"
    tab.check(link)


@pytest.mark.whole
def test_whoever_sees_no_pictures_and_has_no_mouse_finds_everything_by_name(tab: Tab, link: str) -> None:
    tab.page.get_by_role("slider", name="time").wait_for()  # shown with the computed response
    names = [one.get_attribute("aria-label") for one in tab.page.get_by_role("slider").all()]
    assert None not in names and {"lan.delay", "user.count", "time"} <= set(names)
    headings = [one.inner_text() for one in tab.page.get_by_role("heading").all()]
    assert {"Verdict", "Stable region", "Eigenvalues", "Response", "Impedance"} <= set(headings)
    for width in (1280, 800):
        tab.page.set_viewport_size({"width": width, "height": 900})
        tab.page.wait_for_timeout(500)
        assert tab.page.evaluate("document.documentElement.scrollWidth") <= width
    tab.check(link)


@pytest.mark.whole
def test_a_topology_without_two_axes_is_shown_without_a_region(browser: Any, tmp_path: Path) -> None:
    (tmp_path / "none.yaml").write_text(NOTHING, encoding="utf-8")
    with served(tmp_path / "none.yaml") as link:
        tab = Tab(browser, f"{link}&x-axis=user.count")
        tab.page.wait_for_function(f"{MODEL}('region-words').text.includes('this topology has fewer')")
        assert "user.count cannot be an axis" in tab.page.evaluate(f"{MODEL}('message').text")
        assert tab.page.get_by_role("combobox", name="Region: horizontal axis").count() == 0
        assert tab.press("user.count", "ArrowRight", 1) == "2"
        tab.page.wait_for_function("location.search.includes('user.count=2')")
        tab.page.wait_for_function(f"{MODEL}('motion-words').text.includes('velocity')")
        assert not tab.page.get_by_role("button", name="Play").is_visible()
        tab.close(link)


@pytest.mark.whole
def test_a_topology_may_name_its_numbers_as_the_link_does(browser: Any, tmp_path: Path) -> None:
    text = AVERAGE.replace("clocks:", "parameters: {x: 1000 N/m, y: 500 N/m, token: 5 N*s/m}\nclocks:", 1)
    text = text.replace("stiffness: 1000 N/m", "stiffness: x").replace("stiffness: 500 N/m", "stiffness: y")
    model = compiled(text.replace("mass: 0.1 kg, damping: 5 N*s/m", "mass: 0.1 kg, damping: token"), tmp_path)
    with served(tmp_path / "topology.yaml") as link:
        tab = Tab(browser, link)
        setting = {name: tab.press(name, "PageDown", 1).replace("·", "*") for name in ("x", "token")}
        radius = apc.analyze(model, params=setting).spectral_radius
        tab.radius(radius)
        tab.page.wait_for_function("new URLSearchParams(location.search).getAll('token').length == 2")
        url = tab.page.url
        tab.close(link)
        repeated = Tab(browser, url)
        repeated.radius(radius)
        assert repeated.page.evaluate(f"{MODEL}('message').text") == ""
        repeated.close(link)


SERVED = """
import os, webbrowser
from pathlib import Path
from urllib.parse import unquote, urlsplit
from tornado.httpclient import AsyncHTTPClient
from apc.app.server import bound, run

async def opened(url):
    path = Path(unquote(urlsplit(url).path))
    print(url.startswith("file:///"), oct(path.stat().st_mode), link in path.read_text(), path)
    await AsyncHTTPClient().fetch(link)
    raise KeyboardInterrupt

webbrowser.open = opened
server, link = bound(lambda tab: tab.on_session_destroyed(lambda session_context: print("closed")), 0)
run(server, link, browser=True)
"""


@pytest.mark.whole
def test_the_browser_opens_a_file_of_ours_and_ctrl_c_closes_the_tabs_that_are_open() -> None:
    """What a browser is started with, all users see: the link's token is not in it."""
    ended = subprocess.run([sys.executable, "-c", SERVED], capture_output=True, text=True, check=False)
    opened, *closed = ended.stdout.splitlines()
    own, mode, leads, path = opened.split()
    assert (own, mode, leads) == ("True", "0o100600", "True")
    assert not Path(path).exists()
    assert (closed, ended.stderr) == (["closed"], "")


FLOODED = """
import resource, socket
from tornado.httpclient import AsyncHTTPClient
from apc.app.server import MOST, bound, run

async def opened():
    port = int(link.rpartition(":")[2].partition("/")[0])
    silent = [socket.socket() for _ in range({silent})]
    for one in silent:
        one.setblocking(False)
        one.connect_ex(("127.0.0.1", port))
    resource.setrlimit(resource.RLIMIT_NOFILE, (silent[-1].fileno() + {left}, 4096))
    for _ in range(3):
        print((await AsyncHTTPClient().fetch(link)).code)
    raise KeyboardInterrupt

server, link = bound(lambda tab: None, 0)
server.io_loop.add_callback(opened)
run(server, link, browser=False)
"""


@pytest.mark.whole
@pytest.mark.parametrize(
    "left", [40, pytest.param(MOST + 20, marks=pytest.mark.whole)], ids=["few", "enough"]
)
def test_connections_that_ask_for_nothing_keep_nobody_out(left: int) -> None:
    """More than are taken, or than there are descriptors for: those that came first go, without a word."""
    script = FLOODED.format(silent=2 * MOST, left=left)
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=60
    )
    assert (ended.stdout, ended.stderr) == ("200\n" * 3, "")


class Asked:
    """What stands in the place of a `SectionWorker`: it keeps what it is asked."""

    requested: ClassVar[list[Task]] = []

    def __init__(self, model: bytes, order: Sequence[str], *_: object) -> None:
        self.order, self.busy = order, None

    def submit(self, task: Task) -> bool:
        self.requested.append(task)
        return True

    def cancel(self, section: str) -> None:
        pass

    def precede(self, other: Asked) -> None:
        pass


def test_figures_are_hidden_until_their_result_is_there() -> None:
    for figure in (RegionFigure(), RootsFigure(), TransparencyFigure()):
        assert not figure.plot.visible and "Computing" in figure.words.model.text
    motion = MotionFigure()
    assert not any(one.visible for one in (motion.plot, motion.stage, motion.time, motion.simulation))


def test_peaks_of_an_impedance_are_resolved_and_inside_the_axes(tmp_path: Path) -> None:
    model = compiled(AVERAGE, tmp_path)
    reported = compute(model_bytes(model), Task("transparency", (), "")).result
    assert reported is not None
    dense = np.abs(apc.transparency(model, np.geomspace(0.1, 60, 1500)).impedance)
    assert reported["magnitude"].max() > 0.99 * dense.max()
    figure = TransparencyFigure()
    figure.show(reported)
    low, high = figure.plot.y_range.start, figure.plot.y_range.end
    decades = np.log10(high / low)
    assert figure.magnitudes.ticks == [2, 5, 10, 20, 50] and figure.frequencies.ticks == [0.1, 1, 10]
    assert np.log10(high / dense.max()) > 0.05 * decades < np.log10(dense.min() / low) + 1e-2 * decades


def test_a_named_parameter_has_a_range_by_its_margin_within_the_limits_of_what_depends_on_it(
    tmp_path: Path,
) -> None:
    text = AVERAGE.replace("clocks:", "parameters: {k: 100 N/m}\nclocks:", 1).partition("studies:")[0]
    model = compiled(text.replace("stiffness: 500 N/m", "stiffness: k"), tmp_path)
    slider = named(sliders_of(model), "k")
    limit = apc.critical(model, "k").value
    assert slider.span is not None and limit is not None
    assert slider.span[0] == 0 == slider.values[0] and limit < slider.span[1] < 3 * limit


def test_an_unreliable_topology_opens_with_mean_square_stability(tmp_path: Path) -> None:
    opened = tab_of(compiled(LOSSY, tmp_path))
    assert opened.criterion_select.value.startswith("mean-square")
    verdict = next(task for task in Asked.requested if task.section == "verdict")
    reported = compute(model_bytes(opened.model), verdict).result
    assert reported is not None and reported["measure"] == "second-moment growth"
    assert tab_of(compiled(AVERAGE, tmp_path)).criterion_select.value.startswith("nominal")


def tab_of(model: Model) -> TopologyTab:
    """Return the page of a tab without a browser, and without those who compute for it."""
    document, request = Document(), SimpleNamespace(arguments={})
    context = SimpleNamespace(request=request)
    document._session_context = lambda: context  # type: ignore[assignment]
    Asked.requested.clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("apc.app.page.SectionWorker", Asked)
        return TopologyTab(topology_of(model, (), None), document)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> TopologyTab:
    """Give the page of a tab that several tests use."""
    found = tab_of(compiled(LOSSY, tmp_path_factory.mktemp("page")))
    found._deliver("verdict", SectionAnswer(None, "none"))
    names = ["user[1].device.x", "user[1].cube.x"]
    used = {"names": names, "at": names[0], "notes": ()} | {one: np.ones(2) for one in TRANSPARENCY}
    found._deliver("transparency", SectionAnswer(used))
    Asked.requested.clear()
    return found


TRANSPARENCY = ("frequency", "magnitude", "phase")
NAN, INFINITY = {"type": "number", "value": "nan"}, {"type": "number", "value": "+inf"}
ZEROS = {"type": "bytes", "data": base64.b64encode(gzip.compress(bytes(8))).decode()}
ARRAY = {"type": "ndarray", "array": ZEROS, "dtype": "float64", "shape": [1], "order": "little"}
WRONG = [NAN, INFINITY, -5, -0.6, 10**6, 10**400, 1e308, True, None, "", "text", [1], {"type": "map"}, ARRAY]


def says(page: TopologyTab, model: Any, value: Any) -> None:
    """Have the browser say a value, as Bokeh reads it; where that refuses it, nobody of the page is asked."""
    event = {"kind": "ModelChanged", "model": {"id": model.id}, "attr": "value", "new": value}
    try:
        page.document.apply_json_patch({"events": [event]})
    except ValueError as error:
        record = logging.makeLogRecord({"msg": "", "exc_info": (type(error), error, error.__traceback__)})
        assert _shortened(record) and record.exc_info is None
        assert record.getMessage().startswith("a message of the page was ignored: ValueError(")


def tapped(page: TopologyTab, x: Any, y: Any) -> None:
    """Have the browser say that the region was clicked."""
    values = [["model", {"id": page.region.plot.id}], ["x", x], ["y", y]]
    tap = {"type": "event", "name": "tap", "values": {"type": "map", "entries": values}}
    reported = {"kind": "MessageSent", "msg_type": "bokeh_event", "msg_data": tap}
    page.document.apply_json_patch({"events": [reported]})


@pytest.mark.whole
def test_what_the_browser_can_t_say_changes_nothing(page: TopologyTab) -> None:
    models = [*page.handles, *page.selects, page.start_select, page.criterion_select, page.device_select]
    before = [one.value for one in models]
    for value in WRONG:
        for model in models:
            says(page, model, value)
        for x, y in ((value, 1.0), (1.0, value)):
            if not is_number(value):  # of those the nearest values are taken
                tapped(page, x, y)
        assert [one.value for one in models] == before, value
    assert page.positions == [one.start for one in page.sliders]
    assert not Asked.requested


def status(link: str, **headers: str) -> int:
    parts = urlsplit(link)
    connection = http.client.HTTPConnection(parts.netloc, timeout=60)
    try:
        connection.request("GET", f"{parts.path}?{parts.query}", headers=headers)
        return connection.getresponse().status
    finally:
        connection.close()


def test_what_the_browser_may_say_is_computed(page: TopologyTab) -> None:
    """A slider to its last value, an axis, what is played and what stable means, a hand, a click."""
    last = len(page.sliders[0].values) - 1
    for model, value in (
        (page.handles[0], last),
        (page.selects[0], "device.mass"),
        (page.criterion_select, "nominal (every packet on time)"),
        (page.start_select, "initial state of the topology"),
        (page.device_select, "user[1].cube.x"),
    ):
        says(page, model, value)
    assert page.positions[0] == last
    assert page.sliders[page.chosen[0]].label == "device.mass"
    assert page.criterion_select.value.startswith("nominal")
    assert next(one for one in reversed(Asked.requested) if one.section == "motion").request is False
    assert Asked.requested[-1].request == "user[1].cube.x"
    says(page, page.handles[0], last + 1)
    assert "contact.stiffness: " in page.message.model.text
    says(page, page.selects[0], "contact.stiffness")
    tapped(page, 1500, 300)
    moved = {one.label: one.values[at] for one, at in zip(page.sliders, page.positions, strict=True)}
    assert moved["contact.stiffness"] == 1500 and moved["coordination.stiffness"] == 300
    page._start_tuning()
    free, best = Asked.requested[-1].request
    assert best == "contact.stiffness" and page.tune.label == "Maximize contact.stiffness"
    assert free[0] == "contact.stiffness=0.0 N/m:5000.0 N/m"


UPGRADE = {
    "Connection": "Upgrade",
    "Upgrade": "websocket",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
}


@pytest.mark.whole
def test_only_this_machine_with_the_token_and_no_other_origin_gets_in(link: str) -> None:
    bare, query = link.partition("?")[0], urlsplit(link).query
    assert link.startswith("http://127.0.0.1:")
    assert status(link) == 200
    for wrong in (bare, f"{bare}?token=", f"{link}x", f"{bare}?token=%ff"):
        assert status(wrong) in (400, 403)
    foreign = {"Origin": "http://example.org"}
    for requested, headers in (
        (link, foreign),
        (link, {"Host": "example.org"}),
        (f"{bare}metadata", {}),
        (f"{bare}autoload.js?bokeh-autoload-element=1", {}),
        (f"{bare}ws", UPGRADE),
        (f"{bare}ws?{query}", UPGRADE | foreign),
    ):
        assert status(requested, **headers) == 403
    for path in (
        "etc/passwd",
        "static/../../../../../../etc/passwd",
        "topology.yaml",
        "static/extensions/x/y",
    ):
        assert status(f"{bare}{path}?{query}") in (403, 404)
