"""Pictures say what they show: no two lines alike, nothing covered, nothing left out unsaid."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib.colors
import matplotlib.figure
import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.comparison.comparison import compare
from apc.compiler.errors import ApcError
from apc.present import animation
from apc.present.comparison_picture import comparison_picture
from apc.present.eigenvalues import eigenvalues_picture, locus_picture
from apc.present.pictures import COLOURS, LINES, colours_of, write_figure
from apc.present.region_picture import _off, panels_picture
from apc.present.simulation import played_picture
from apc.regions.panels import compare_regions, parse_vary
from apc.vary.critical import critical
from apc.vary.locus import root_locus
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

X, Y = "contact.stiffness=0 N/m:3000 N/m", "coordination.stiffness=0 N/m:3000 N/m"


def alike(count: int, **changed: str) -> list[apc.CompiledSystem]:
    """Return scenes that differ in their link's delay, by name and number."""
    names = [f"scheme-{place + 1}" for place in range(count)]
    return [
        compiled(
            replaced(AVERAGE, ("three-users-average", name), ("delay: 8 ms}", f"delay: {4 + place} ms}}"))
        )
        for place, name in enumerate(names)
    ]


def test_the_first_fifty_six_lines_and_colours_are_pairs_that_all_differ() -> None:
    pairs = {(COLOURS[n % len(COLOURS)], LINES[n % len(LINES)]) for n in range(56)}
    assert len(pairs) == 56


@pytest.mark.parametrize("count", [1, 10, 11, 31, 100])
def test_as_many_colours_as_are_asked_for(count: int) -> None:
    assert len(set(colours_of(count))) == count


def test_eight_scenes_have_eight_lines_and_one_that_is_another_says_so() -> None:
    systems = [
        *alike(8),
        compiled(replaced(AVERAGE, ("three-users-average", "again"), ("delay: 8 ms}", "delay: 4 ms}"))),
    ]
    found = compare_regions(systems, x=X, y=Y, panels=((),), cells=4)
    [ax] = panels_picture(found).axes
    named = [line for line in ax.lines if not line.get_label().startswith("_")]
    assert [line.get_label() for line in named] == [one.name for one in systems]
    assert (
        len(
            {
                (
                    line.get_color(),
                    line._unscaled_dash_pattern[1],
                )
                for line in named
            }
        )
        == 9
    )
    assert "again: identical to scheme-1" in " ".join(ax.get_title().split())
    assert ax.get_title().count("identical") == 1


@pytest.mark.parametrize(
    ("count", "shape"), [(1, (1, 1)), (2, (1, 2)), (3, (1, 3)), (4, (2, 2)), (6, (2, 3))]
)
def test_four_panels_stand_two_by_two(count: int, shape: tuple[int, int]) -> None:
    values = ",".join(str(4 + n) for n in range(count))
    found = compare_regions(
        [compiled(AVERAGE)], x=X, y=Y, panels=parse_vary(f"lan.delay={values} ms"), cells=2
    )
    [spec] = {ax.get_subplotspec().get_gridspec().get_geometry() for ax in panels_picture(found).axes}
    assert spec == shape


def test_how_far_a_point_is_from_lines_is_measured_to_the_lines_and_not_to_their_corners() -> None:
    line = np.array([[0.0, 0.0], [1.0, 0.0]])
    assert _off(np.array([[0.5, 0.25], [0.3, 0.1]]), [line]) == pytest.approx(0.25)
    assert _off(np.array([[1.3, 0.4]]), [line, line + np.array([0.0, 5.0])]) == pytest.approx(0.5)


def test_the_word_stable_covers_no_curve() -> None:
    found = compare_regions([compiled(AVERAGE), compiled(MESH)], x=X, y=Y, panels=((),), cells=4)
    figure = panels_picture(found)
    figure.draw_without_rendering()
    [ax] = figure.axes
    [word] = ax.texts
    box = word.get_window_extent()
    for line in ax.lines:
        points = ax.transData.transform(line.get_xydata())
        inside = (points > [box.x0, box.y0]).all(axis=1) & (points < [box.x1, box.y1]).all(axis=1)
        assert not inside.any()


def test_where_the_word_has_no_room_the_title_says_what_is_hatched() -> None:
    found = compare_regions(
        [compiled(AVERAGE)],
        x="contact.stiffness=0 N/m:90000 N/m",
        y="coordination.stiffness=0 N/m:90000 N/m",
        panels=((),),
        cells=32,
    )
    [ax] = panels_picture(found).axes
    assert not ax.texts
    assert "hatched: stable" in ax.get_title()


@pytest.mark.whole
def test_numbers_in_bars_stand_beside_them_and_frames_are_compared_in_seconds() -> None:
    systems = alike(7)
    found = compare(systems)
    figure = comparison_picture(found)
    figure.draw_without_rendering()
    titles = [ax.get_title() for ax in figure.axes]
    assert "settles within 2 % in (s)" in titles
    looks = {(bar.get_edgecolor(), bar.get_hatch()) for bar in figure.axes[0].patches}
    assert len(looks) == 7
    [boundary] = figure.axes[0].lines
    x = figure.axes[0].transData.transform((boundary.get_xdata()[0], 0))[0]
    assert all(text.get_window_extent().x0 >= x for text in figure.axes[0].texts)
    one = found.schemes[0].analysis
    # Of ρ a frame T seconds long: ρ^(t/T) = 1/50.
    assert one.settling_s is not None
    assert one.spectral_radius ** (one.settling_s / one.frame_s) == pytest.approx(0.02)
    unstable = apc.analyze(compiled(AVERAGE), set={"coordination.stiffness": "5000 N/m"})
    assert unstable.settling_s is None


PUSHED = replaced(
    AVERAGE,
    ("user: {count: 3}", "left: {count: 1, set: {device.x: 3 mm}}\n  right: {count: 2}"),
)


def test_curves_that_are_one_are_said_to_be() -> None:
    found = apc.simulate(compiled(PUSHED), duration="20 ms", signals=["cube.x"], jit=False)
    [ax] = played_picture(found).axes
    labels = [" ".join(line.get_label().split()) for line in ax.lines]
    assert labels == ["left[1].cube.x", "right[1].cube.x, right[2].cube.x: identical"]


def test_of_more_than_ten_peers_a_group_has_a_colour_and_the_extremes_are_named(tmp_path: Path) -> None:
    rows = "\n".join(f"{0.05 + 0.01 * n}, {n}" for n in range(14))
    text = replaced(
        AVERAGE,
        ("user: {count: 3}", "few: {count: 1}\n  many: {count: 14, set: {device.x: 1 mm}}"),
    )
    same = played_picture(apc.simulate(compiled(text), duration="20 ms", signals=["device.x"], jit=False))
    assert [line.get_label() for line in same.axes[0].lines] == [
        "few.device.x: 1 peer",
        "many.device.x: 14 peers, identical",
    ]
    (tmp_path / "t.csv").write_text(f"device.mass [kg], device.x [mm]\n{rows}\n", encoding="utf-8")
    (tmp_path / "scene.yaml").write_text(
        replaced(AVERAGE, ("user: {count: 3}", "user: {table: t.csv}")), encoding="utf-8"
    )
    system = apc.compile(tmp_path / "scene.yaml")
    [ax] = played_picture(apc.simulate(system, duration="20 ms", signals=["device.x"], jit=False)).axes
    labels = [line.get_label() for line in ax.lines]
    assert labels == ["user[14].device.x: highest", "user[1].device.x: lowest"]
    assert [one.get_label() for one in ax.collections] == ["user.device.x: all 14 peers"]


def test_the_eigenvalues_drawn_are_those_of_the_analysis_within_the_circle() -> None:
    found = apc.analyze(compiled(AVERAGE))
    ax = eigenvalues_picture(found)
    drawn = np.concatenate([line.get_xydata() for line in ax.lines if line.get_marker() != "None"])
    wanted = [mode.eigenvalue for mode in found.modes]
    assert len(drawn) >= len(wanted)
    for value in wanted:
        assert np.abs(drawn @ [1, 1j] - value).min() < 1e-12
    (low, high), (bottom, top) = ax.get_xlim(), ax.get_ylim()
    assert low < -1 < 1 < high and bottom < -1 < 1 < top
    assert "settles within 2 % in" in " ".join(ax.get_title().split())


def test_a_root_locus_passes_the_circle_where_stability_changes() -> None:
    system = compiled(AVERAGE)
    found = critical(system, "coordination.stiffness")
    locus = root_locus(system, found)
    radii = np.array([np.abs(one).max() for one in locus.eigenvalues])
    assert found.value is not None
    assert radii[0] == pytest.approx(1)  # without it the copies move apart as they please
    assert (radii[1:][locus.values[1:] < found.value] < 1).all()
    assert (radii[locus.values > found.value] > 1).all()
    assert np.abs(locus.now).max() == pytest.approx(apc.analyze(system).spectral_radius)
    texts = [one.get_text() for one in locus_picture(locus).get_legend().get_texts()]
    assert texts == ["now, 500 N/m", "changes at 1096.41 N/m, 20.29 Hz"]


def test_a_critical_value_draws_its_root_locus(tmp_path: Path) -> None:
    found = apc.critical(compiled(AVERAGE), "coordination.stiffness")
    ax = pytest.importorskip("matplotlib.figure").Figure().subplots()
    assert found.plot(ax) is ax
    apart = ax.collections[0].get_offsets()
    locus = root_locus(found.system, found)
    assert np.array_equal(apart[:, 0], np.concatenate(locus.eigenvalues).real)
    drawn = found.plot(size=(4, 3), labels={"real part": "Re"})
    assert drawn.get_xlabel() == "Re" and tuple(drawn.figure.get_size_inches()) == (4, 3)
    assert "system" not in found.to_dict() and "<img" not in found._repr_mimebundle_()["text/html"]
    passive = apc.critical(compiled(AVERAGE), "coordination.stiffness", criterion="passive")
    with pytest.raises(ApcError, match="E930 what every passive hand can draw has no eigenvalues"):
        passive.plot()


def test_text_in_an_svg_is_text(tmp_path: Path) -> None:
    write_figure(eigenvalues_picture(apc.analyze(compiled(AVERAGE))).figure, tmp_path / "e.svg")
    text = (tmp_path / "e.svg").read_text(encoding="utf-8")
    assert re.search(r"<text[^>]*>real part</text>", text)


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(animation, "RATE", 2)
    monkeypatch.setattr(animation, "SHORTEST", 2.0)


@pytest.mark.parametrize(("suffix", "magic", "at"), [(".gif", b"GIF89a", 0), (".mp4", b"ftyp", 4)])
@pytest.mark.usefixtures("short")
def test_a_run_is_written_as_a_moving_picture(
    suffix: str, magic: bytes, at: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if suffix == ".mp4" and not pytest.importorskip("matplotlib.animation").writers.is_available("ffmpeg"):
        pytest.skip("ffmpeg is not installed")
    out = tmp_path / f"run{suffix}"
    words = ["simulate", str(SCENES / "planar-users.yaml"), "--duration", "20 ms", "--out", str(out)]
    assert run(words) == 0
    assert out.read_bytes()[at : at + len(magic)] == magic
    assert [one.name for one in tmp_path.iterdir()] == [out.name]
    assert f"{out} is written" in capsys.readouterr().out


def test_bodies_are_where_the_run_has_them_and_never_out_of_sight() -> None:
    from apc.present.still import draw_actors

    system = compiled(replaced(AVERAGE, ("device: {", "device: {v: 2 m/s, ")))
    found = apc.simulate(system, duration="50 ms", jit=False)
    _, actors = draw_actors(system, named=False)
    tracks = [1e3 * np.stack([found[name] for name in one.states], axis=1) for one in actors]
    animation._keep_in_sight(actors, tracks)
    for actor, track in zip(actors, tracks, strict=True):
        low, high = actor.ax.get_xlim()
        assert low < track.min() - actor.half and track.max() + actor.half < high
        actor.move(track[-1])
        assert actor.dot.get_xdata()[0] == track[-1][0]
    assert {one.states[0] for one in actors} == {
        f"user[{n}].{x}" for n in (1, 2, 3) for x in ("device.x", "cube.x")
    }


@pytest.mark.usefixtures("short")
def test_every_frame_shows_what_stands_and_what_moved(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    system = compiled(replaced(AVERAGE, ("device: {", "device: {v: 2 m/s, ")))
    out = tmp_path / "run.gif"
    animation.save_animation(system, apc.simulate(system, duration="1 s", jit=False), out)
    with image.open(out) as run:
        frames = []
        for number in (0, run.n_frames - 1):
            run.seek(number)
            frames.append(np.asarray(run.convert("L"), dtype=float))
    assert run.n_frames == 5
    dark = [one < 100 for one in frames]
    assert min(one.sum() for one in dark) > 0.9 * max(one.sum() for one in dark)  # axes, ticks and names
    assert (dark[0] != dark[1]).any() and (dark[0] & dark[1]).sum() > 0.5 * dark[0].sum()


def test_without_ffmpeg_it_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    writers = pytest.importorskip("matplotlib.animation").writers
    monkeypatch.setattr(type(writers), "is_available", lambda self, name: False)
    monkeypatch.chdir(tmp_path)
    assert run(["simulate", str(SCENES / "planar-users.yaml"), "--out", "run.mp4"]) == 1
    said = capsys.readouterr().err
    assert "E875 ffmpeg is not installed, which writes .mp4. Write: --out run.gif, or install ffmpeg" in said
    assert not list(tmp_path.iterdir())


def test_pictures_beside_answers_are_refused_before_anything_is_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = str(SCENES / "three-users-average.yaml")
    for words in (["analyze", scene], ["critical", "lan.delay", scene]):
        assert run([*words, "--plot", "a.txt"]) == 1
        assert "E878 the suffix of --plot" in capsys.readouterr().err
        assert run([*words, "--hands", "passive", "--plot", "a.svg"]) == 1
        assert "E930" in capsys.readouterr().err
        assert run([*words, "--plot", "a.svg"]) == 0
        assert "a.svg is written" in capsys.readouterr().out


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


@pytest.mark.parametrize("settings", ["animation.ffmpeg_path: ./ran", "\udcff\udcfe", None])
def test_a_picture_is_drawn_without_the_settings_in_the_working_folder(
    tmp_path: Path, settings: str | None
) -> None:
    (tmp_path / "scene.yaml").write_text(AVERAGE, encoding="utf-8")
    if settings is None:
        os.mkfifo(tmp_path / "matplotlibrc")  # who opens it waits for ever
    else:
        (tmp_path / "matplotlibrc").write_text(settings, errors="surrogateescape")
    made = "from apc.__main__ import run; failed = run(['show', 'scene.yaml', '--out', 'scene.png'])"
    told = "import matplotlib; print(failed, matplotlib.rcParams['animation.ffmpeg_path'])"
    ran = subprocess.run(
        [sys.executable, "-c", f"{made}\n{told}"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert ran.stdout.splitlines()[-1:] == ["0 ffmpeg"], ran.stderr
    assert (tmp_path / "scene.png").is_file()


def test_settings_that_somebody_made_in_python_stay(tmp_path: Path) -> None:
    with matplotlib.rc_context({"animation.ffmpeg_path": "mine"}):
        assert run(["show", str(SCENES / "three-users-average.yaml"), "--out", str(tmp_path / "a.png")]) == 0
        assert matplotlib.rcParams["animation.ffmpeg_path"] == "mine"
