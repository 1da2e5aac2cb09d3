"""Recorded delays: what motions grow by over them, against products of frames and nominal delays."""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from apc.mean_square.mean_square_stability import MeanSquareStability
from tests.held_topologies import frames, growth, topology
from tests.topologies import replaced

# The nominal spectral radii of three users with delays of 8 and 9 ms.
NOMINAL = {"8": 0.9571713896251, "9": 0.9564057627899}


def decided(folder: Path, rows: str, more: str = "", peers: int = 3) -> MeanSquareStability:
    (folder / "t.csv").write_text(f"delay [ms]\n{rows}", encoding="utf-8")
    text = replaced(topology(peers, 500.0), ("loss: 10 %", f"trace: t.csv{more}"))
    (folder / "s.yaml").write_text(text, encoding="utf-8")
    found = apc.mean_square_stability(apc.compile(folder / "s.yaml"))
    assert found is not None
    return found


@pytest.mark.needs_extension("loss_models")
@pytest.mark.few(4)
@pytest.mark.parametrize("delay", NOMINAL)
@pytest.mark.parametrize("count", [1, 2, 3, 40])
@pytest.mark.parametrize("more", ["", ", reorder: all"])
def test_equal_recorded_delays_are_a_nominal_delay(tmp_path: Path, delay: str, count: int, more: str) -> None:
    """A packet that takes 8 ms is there at the tick 8 ms later, though the float 0.008 is a little more."""
    found = decided(tmp_path, f"{delay}\n" * count, more)
    assert found.verdict == "stable in mean square"
    assert found.mean_square_radius is not None and found.error is not None
    assert abs(found.mean_square_radius - NOMINAL[delay] ** 2) <= 1e-12 + found.error


@pytest.mark.needs_extension("loss_models")
@pytest.mark.parametrize("received", [(1, 0), (1, 0, 0, 1, 0), (1, 1, 1, 0, 0, 0, 0)])
def test_recorded_losses_are_frames_multiplied_by_hand(tmp_path: Path, received: tuple[int, ...]) -> None:
    found = decided(tmp_path, "".join("8\n" if one else "lost\n" for one in received), peers=2)
    own = frames(2, 500.0)
    truth = growth([own.matrix([one, one]) for one in received])
    assert found.mean_square_radius is not None and found.error is not None
    assert abs(found.mean_square_radius - truth**2) <= 1e-9 + found.error


@pytest.mark.whole
def test_many_recorded_delays_are_told_with_how_they_were_found_and_too_many_are_not(tmp_path: Path) -> None:
    """Over 1000 frames bounds on roundings say nothing; one lost packet moves it by less than 0.1 %."""
    found = decided(tmp_path, "8\n" * 999 + "lost\n")
    assert (found.verdict, found.exact) == ("probably stable in mean square", False)
    assert found.mean_square_radius == pytest.approx(NOMINAL["8"] ** 2, rel=1e-3)
    assert any("1,000 frames" in note for note in found.notes)
    assert found.rms_error_m is None
    assert "coordination error not available: it is not computed for recorded delays" in found.notes
    found = decided(tmp_path, "8\n9\n" * 10_001)
    assert found.verdict == "not judged" and "20,002 frames" in found.notes[0]


def test_what_is_never_heard_is_not_judged(tmp_path: Path) -> None:
    [*_, why] = decided(tmp_path, "lost\nlost\n").notes[0].split("; ")
    assert why.endswith("the trace has only losses")
