"""`report`: what decides stands with its error, in 80 columns."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from apc.analysis.analysis import analyze
from apc.analysis.needs import needs
from apc.compiler.words import WIDTH, measured
from apc.present.analysis import analysis_text, compile_text
from tests.topologies import AVERAGE, MESH, ONE_MASS, compiled, replaced

LONG = replaced(AVERAGE, ("user: {count: 3}", "a_long_name_of_a_group: {count: 2, set: {device.mass: 1 kg}}"))
LONG += "  # and more\n"


@pytest.mark.parametrize("text", [AVERAGE, MESH, ONE_MASS, LONG])
def test_no_line_is_wider_than_a_terminal(text: str) -> None:
    system = compiled(text)
    for told in (
        compile_text(system, needs(system), Path("scene.apc"), 2e-16),
        analysis_text(analyze(system)),
    ):
        assert max(len(line) for line in told.splitlines()) <= WIDTH


def test_compiling_tells_what_the_scene_needs() -> None:
    system = compiled(AVERAGE)
    assert compile_text(system, needs(system), Path("scene.apc"), 2.22e-16).splitlines() == [
        "three-users-average → scene.apc",
        "  8 states a peer (4 motion, 2 delayed force, 2 network), 3 peers; analysed as 2",
        "    modes of 8",
        "  frame 8 ms: haptic ticks 8 times, network once",
        "  self-check: one frame event by event and lifted differ by 2e-16",
    ]


def test_compiling_tells_what_was_left_out() -> None:
    system = compiled(replaced(AVERAGE, ("  lan: {", "  wan: {clock: network}\n  lan: {")))
    lines = compile_text(system, needs(system), Path("scene.apc"), 0.0).splitlines()
    assert lines[-1] == "  left out: wan, as nobody hears what it would carry"


def test_a_scene_without_clocks_says_so() -> None:
    system = compiled(ONE_MASS)
    told = compile_text(system, needs(system), Path("scene.apc"), 0.0)
    assert "  frame 1 s: no clock is used, any frame will do" in told.splitlines()


def test_an_analysis_names_verdict_radius_and_error() -> None:
    result = analyze(compiled(AVERAGE))
    lines = analysis_text(result).splitlines()
    assert lines[0] == "three-users-average: stable up to a common translation"
    radius = next(line for line in lines if "spectral radius" in line)
    assert f"{measured(result.spectral_radius, result.spectral_radius_error)} per frame of 8 ms" in radius
    assert "  peers            3, 8 states each" in lines
    assert "  method           modes, 1 translation left out" in lines


def test_a_conjugate_pair_is_one_row_and_the_rest_is_counted() -> None:
    result = analyze(compiled(AVERAGE))
    rows = [line for line in analysis_text(result).splitlines() if " Hz " in line or " – " in line]
    alive = [mode for mode in result.modes if mode.magnitude > 1e-3]
    assert len(rows) == sum(1 for mode in alive if mode.eigenvalue.imag >= 0)
    dead = len(result.modes) - len(alive)
    assert analysis_text(result).endswith(f"  and {dead} faster-dying ones (--json lists all)")


def test_what_rounding_makes_of_a_zero_changes_nothing_that_is_printed() -> None:
    result = analyze(compiled(AVERAGE))
    other = dataclasses.replace(
        result,
        modes=tuple(
            dataclasses.replace(mode, eigenvalue=-1e-9j, magnitude=1e-9) if mode.magnitude < 1e-6 else mode
            for mode in result.modes
        ),
    )
    assert analysis_text(other) == analysis_text(result)


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        ("stable", "Every motion dies out."),
        ("drifts", "Nothing slows a common motion down."),
        ("unstable", "Some motion grows"),
        ("undecided: |ρ−1| below the error bound", "lies nearer to 1 than its error bound"),
    ],
)
def test_every_verdict_is_told_in_words(verdict: str, words: str) -> None:
    result = dataclasses.replace(analyze(compiled(ONE_MASS)), verdict=verdict)
    assert words in analysis_text(result)


def test_what_dies_out_at_once_is_counted_and_has_no_empty_table() -> None:
    result = analyze(compiled(AVERAGE))
    dead = tuple(dataclasses.replace(mode, magnitude=1e-9) for mode in result.modes[:2])
    text = analysis_text(dataclasses.replace(result, modes=dead))
    assert "magnitude" not in text
    assert text.endswith("  2 modes die out within a frame (--json lists all)")


def test_a_share_that_would_show_as_zero_is_left_out() -> None:
    result = analyze(compiled(AVERAGE))
    first = dataclasses.replace(result.modes[0], participation=(("device.v", 0.9996), ("device.x", 0.0004)))
    text = analysis_text(dataclasses.replace(result, modes=(first,)))
    assert "device.v 100%" in text
    assert " 0%" not in text


def test_only_what_is_known_to_be_faster_is_called_faster() -> None:
    """A mode known to ±1 may be of any size: neither in the table nor among those that die faster."""
    result = analyze(compiled(AVERAGE))
    unknown = dataclasses.replace(result.modes[0], error=1.0)
    text = " ".join(analysis_text(dataclasses.replace(result, modes=(*result.modes, unknown))).split())
    assert "5 modes more (--json lists all), 1 of them known too roughly to say how fast it" in text
    assert "faster-dying" not in text
    alone = " ".join(analysis_text(dataclasses.replace(result, modes=(unknown, unknown))).split())
    assert "2 modes (--json lists all), all of them known too roughly" in alone
    assert "within a frame" not in alone
