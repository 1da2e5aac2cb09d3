"""Pictures say what they show: no two lines alike, nothing covered, nothing left out unsaid."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib.colors
import matplotlib.figure
import matplotlib.text
import numpy as np
import pytest

import apc
from apc.output import animation
from apc.output.analysis_output import analysis_picture
from apc.output.haptics_output import transparency_picture
from apc.output.pictures import colours_of, legend_below, write_figure
from apc.output.region_picture import panels_picture
from apc.regions.panels import compare_regions
from tests.commands import Cli, folder
from tests.topologies import AVERAGE, MESH, TOPOLOGIES, compiled, replaced

TOPOLOGY = str(TOPOLOGIES / "three-users-average.yaml")
X, Y = "contact.stiffness=0 N/m:3000 N/m", "coordination.stiffness=0 N/m:3000 N/m"


@pytest.mark.whole
def test_eight_topologies_have_eight_lines_and_one_that_is_another_says_so() -> None:
    names = [*(f"scheme-{place}" for place in range(8)), "again"]
    systems = [
        compiled(
            replaced(AVERAGE, ("three-users-average", name), ("delay: 8 ms}", f"delay: {4 + at % 8} ms}}"))
        )
        for at, name in enumerate(names)
    ]
    [ax] = panels_picture(compare_regions(systems, x=X, y=Y, panels=((),), cells=4)).axes
    lines = [line for line in ax.lines if not line.get_label().startswith("_")]
    assert [line.get_label() for line in lines] == names
    assert (
        len({(line.get_color(), line.get_linestyle(), line._unscaled_dash_pattern[1]) for line in lines}) == 9
    )
    assert "again: identical to scheme-0" in " ".join(ax.get_title().split())
    assert ax.get_title().count("identical") == 1


def _notes_of(figure: matplotlib.figure.Figure) -> str:
    return " ".join(text.get_text() for text in figure.findobj(matplotlib.text.Text) if text.get_gid())


def test_notes_on_regions_are_below_the_figure_once_and_optional() -> None:
    model = compiled((TOPOLOGIES / "lossy-average.yaml").read_text(encoding="utf-8"))
    panels = compare_regions(
        [model], x=X, y=Y, panels=(("cube.mass=0.6 kg",), ("cube.mass=1 kg",)), cells=4, criterion="nominal"
    )
    figure = panels.plot()
    note = panels.panels[0].regions[0].limitations[0]
    assert " ".join(_notes_of(figure).split()).lower().count(note.lower()) == 1
    assert not any(note in " ".join(ax.get_title().split()) for ax in figure.axes)
    assert _notes_of(panels.plot(notes=False)) == ""


@pytest.mark.parametrize(
    ("topology", "axis", "label", "ticks"),
    [
        (
            "three-users-average",
            "coordination.stiffness=0 N/m:1e5 N/m",
            "coordination.stiffness [kN/m]",
            (0, 100),
        ),
        ("three-users-average", "cube.mass=0.01 kg:0.05 kg", "cube.mass [g]", (10, 50)),
        ("lossy-average", "lan.loss=0:0.5", "lan.loss [%]", (0, 50)),
    ],
)
def test_axes_have_units_with_numbers_of_a_readable_size(
    topology: str, axis: str, label: str, ticks: tuple[float, float]
) -> None:
    model = compiled((TOPOLOGIES / f"{topology}.yaml").read_text(encoding="utf-8"))
    y = "contact.stiffness=50 N/m:100 N/m" if topology == "lossy-average" else X  # stable everywhere
    [found] = compare_regions([model], x=axis, y=y, cells=4).panels[0].regions
    ax = found.plot()
    ax.figure.draw_without_rendering()
    printed = [float(text.get_text()) for text in ax.get_xticklabels()]
    assert ax.get_xlabel() == label and (printed[0], printed[-1]) == ticks
    assert all(0.1 <= abs(number) <= 1e4 for number in printed if number)
    assert ax.xaxis.get_offset_text().get_text() == ""
    assert ax.get_xlim() == (float(found.x.low), float(found.x.high))  # data in SI
    assert topology == "lossy-average" or found.curves
    share = 100 * found.stable_area / float(found.rectangle.width.prod())
    if found.curves:
        assert f"stable: {share:.3g} % of the rectangle" in ax.get_title()


def test_a_comparison_has_no_empty_panel_and_no_line_through_a_number() -> None:
    compared = apc.compare([compiled(AVERAGE), compiled(MESH)])
    figure = compared.plot()
    shown = [ax for ax in figure.axes if ax.axison]
    assert all(any(patch.get_width() > 0 for patch in ax.patches) for ax in shown)
    assert "No panel for largest stable loss" in _notes_of(figure)
    radius = next(ax for ax in shown if ax.get_title() == "spectral radius per frame")
    figure.draw_without_rendering()
    [line] = [line for line in radius.lines if list(line.get_xdata()) == [1, 1]]
    across = line.get_window_extent().x0
    boxes = [text.get_window_extent() for text in radius.texts if text.get_text()]
    assert len(boxes) >= 2 and not any(box.x0 <= across <= box.x1 for box in boxes)


def test_a_legend_has_at_most_six_entries_and_the_number_of_the_others() -> None:
    ax = matplotlib.figure.Figure().subplots()
    for number in range(12):
        ax.plot([0, 1], [0, number], label=f"curve {number}")
    legend_below(ax)
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts == [*(f"curve {number}" for number in range(6)), "... and 6 more"]
    run = apc.simulate(TOPOLOGIES / "ring-of-eight.yaml", duration="4 ms", jit=False)
    for ax in run.plot().axes:
        assert len(ax.get_legend().get_texts()) <= 7


@pytest.mark.parametrize("count", [1, 10, 11, 31, 100])
def test_as_many_colours_as_are_asked_for(count: int) -> None:
    assert len(set(colours_of(count))) == count


@pytest.mark.parametrize("certify", [False, True])
def test_the_eigenvalues_drawn_are_those_of_the_analysis_within_the_circle(certify: bool) -> None:
    found = apc.analyze(compiled(AVERAGE), certify=certify)
    ax = analysis_picture(found)
    drawn = np.concatenate([line.get_xydata() for line in ax.lines if line.get_marker() != "None"])
    requested = [mode.eigenvalue for mode in found.modes]
    assert len(drawn) >= len(requested)
    for value in requested:
        assert np.abs(drawn @ [1, 1j] - value).min() < 1e-12
    (low, high), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    assert low < -1 < 1 < high and bottom < -1 < 1 < top
    assert "settling time (2 %)" in " ".join(ax.get_title().split())
    assert any(", real, " in text.get_text() for text in ax.get_legend().get_texts())


def test_signals_have_axes_with_a_prefix_of_their_unit() -> None:
    """A device that starts at 0.1 m/s moves by less than 1 mm: in mm and mm/s, not 0.0008 m and 0.1 m/s."""
    model = compiled(AVERAGE.replace("cube:   {", "cube:   {v: 0.1 m/s, ", 1))
    figure = apc.simulate(model, duration="0.2 s").plot().figure
    labels = [ax.get_ylabel() for ax in figure.axes]
    assert labels[:2] == ["position [mm]", "velocity [mm/s]"]


def test_text_in_an_svg_is_text(tmp_path: Path) -> None:
    write_figure(analysis_picture(apc.analyze(compiled(AVERAGE))).figure, tmp_path / "e.svg")
    text = (tmp_path / "e.svg").read_text(encoding="utf-8")
    assert re.search(r"<text[^>]*>real part</text>", text)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(animation, "RATE", 2)
    monkeypatch.setattr(animation, "SHORTEST", 1.0)


def test_a_picture_has_the_size_words_and_style_that_are_asked_for() -> None:
    found = apc.analyze(compiled(AVERAGE))
    ax = found.plot()
    word = ax.get_xlabel()
    assert word
    other = found.plot(size=(3.0, 2.0), labels={word: "Realteil"}, style={"axes.facecolor": "#123456"})
    assert tuple(other.figure.get_size_inches()) == (3.0, 2.0)
    assert other.get_xlabel() == "Realteil"
    assert matplotlib.colors.to_hex(other.get_facecolor()) == "#123456"
    assert ax.get_xlabel() == word
    assert matplotlib.colors.to_hex(ax.get_facecolor()) != "#123456"
    own = matplotlib.figure.Figure().subplots()
    assert found.plot(own, labels={word: "Realteil"}) is own
    assert own.get_xlabel() == "Realteil"


def test_a_root_locus_passes_the_circle_where_stability_changes() -> None:
    model = compiled(AVERAGE)
    critical = apc.critical(model, "coordination.stiffness")
    axes = critical.plot(size=(4, 3), labels={"real part": "Re"})
    assert axes.get_xlabel() == "Re" and tuple(axes.figure.get_size_inches()) == (4, 3)
    texts = [one.get_text() for one in axes.get_legend().get_texts()]
    assert texts == ["present value, 500 N/m", "stability limit 1096.41 N/m, 20.29 Hz"]
    points = np.asarray(axes.collections[0].get_offsets()) @ [1, 1j]
    assert np.abs(points).max() > 1.01
    for value in (500, 1096):
        modes = apc.analyze(model, params={"coordination.stiffness": f"{value} N/m"}).modes
        for mode in modes:
            assert np.abs(points - mode.eigenvalue).min() < 0.02


def test_what_settles_is_told_in_seconds() -> None:
    """Of ρ a frame T seconds long: ρ^(t/T) = 1/50."""
    stable = apc.analyze(compiled(AVERAGE))
    assert stable.settling_s is not None
    assert stable.spectral_radius ** (stable.settling_s / stable.frame_s) == pytest.approx(0.02)
    assert apc.analyze(compiled(AVERAGE), params={"coordination.stiffness": "5000 N/m"}).settling_s is None


@pytest.mark.whole
@pytest.mark.parametrize(
    ("suffix", "magic"), [("gif", b"GIF89a"), pytest.param("mp4", b"ftyp", marks=pytest.mark.whole)]
)
@pytest.mark.usefixtures("short")
def test_a_run_is_written_as_a_moving_picture(suffix: str, magic: bytes, cli: Cli) -> None:
    if suffix == "mp4" and not pytest.importorskip("matplotlib.animation").writers.is_available("ffmpeg"):
        pytest.skip("ffmpeg is not installed")
    ran = cli(f"simulate '{TOPOLOGIES}/planar-users.yaml' --duration 20ms --out run.{suffix}")
    assert ran.code == 0 and f"run.{suffix} is written" in ran.out
    assert magic in Path(f"run.{suffix}").read_bytes()[:8]
    assert folder() == [f"run.{suffix}"]


def test_without_ffmpeg_it_says_what_to_do(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    writers = pytest.importorskip("matplotlib.animation").writers
    monkeypatch.setattr(type(writers), "is_available", lambda self, name: False)
    ran = cli(f"simulate '{TOPOLOGIES}/planar-users.yaml' --out run.mp4")
    message = "E875 ffmpeg is not installed, which writes .mp4. Try: --out run.gif, or apt install ffmpeg"
    assert ran.code == 1 and message in ran.err
    assert folder() == []


@pytest.mark.whole
@pytest.mark.parametrize("words", [f"analyze '{TOPOLOGY}'", f"critical coordination.stiffness '{TOPOLOGY}'"])
def test_pictures_beside_answers_are_refused_before_anything_is_computed(words: str, cli: Cli) -> None:
    assert "E878 suffix of --plot" in cli(f"{words} --plot a.txt").err
    assert "E930" in cli(f"{words} --hands passive --plot a.svg").err
    assert "a.svg is written" in cli(f"{words} --plot a.svg").out


@pytest.mark.whole
@pytest.mark.parametrize(
    "settings",
    [
        None,
        pytest.param("animation.ffmpeg_path: ./ran", marks=pytest.mark.whole),
        pytest.param("\udcff\udcfe", marks=pytest.mark.whole),
    ],
)
def test_a_picture_is_drawn_without_the_settings_in_the_working_folder(
    tmp_path: Path, settings: str | None
) -> None:
    (tmp_path / "topology.yaml").write_text(AVERAGE, encoding="utf-8")
    if settings is None:
        os.mkfifo(tmp_path / "matplotlibrc")  # who opens it waits for ever
    else:
        (tmp_path / "matplotlibrc").write_text(settings, errors="surrogateescape")
    made = "from apc.__main__ import run; failed = run(['show', 'topology.yaml', '--out', 'topology.png'])"
    reported = f"{made}\nimport matplotlib; print(failed, matplotlib.rcParams['animation.ffmpeg_path'])"
    ran = subprocess.run(
        [sys.executable, "-c", reported],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert ran.stdout.splitlines()[-1:] == ["0 ffmpeg"], ran.stderr
    assert (tmp_path / "topology.png").is_file()


@pytest.mark.whole
def test_settings_that_somebody_made_in_python_stay(cli: Cli) -> None:
    with matplotlib.rc_context({"animation.ffmpeg_path": "mine"}):
        assert cli(f"show '{TOPOLOGY}' --out a.png").code == 0
        assert matplotlib.rcParams["animation.ffmpeg_path"] == "mine"


def test_a_nyquist_curve_has_no_corners_and_passes_the_computed_points() -> None:
    found = apc.transparency(compiled(AVERAGE), np.geomspace(0.1, 60, 1000))
    line, *_ = transparency_picture(found, "nyquist").axes[0].lines
    drawn = line.get_xydata() @ [1, 1j]
    assert np.abs(drawn[::8] - found.impedance).max() < 1e-12
    exact = apc.transparency(compiled(AVERAGE), np.geomspace(0.1, 60, 7993)[4::80]).impedance
    assert np.abs(drawn[4::80] - exact).max() < 1e-4 * np.abs(exact).max()
    assert np.abs(np.angle(np.diff(drawn)[1:] / np.diff(drawn)[:-1])).max() < 0.05
    few = apc.transparency(compiled(AVERAGE), np.geomspace(0.1, 60, 40))
    line, *_ = transparency_picture(few, "nyquist").axes[0].lines
    assert len(line.get_xydata()) == 40
