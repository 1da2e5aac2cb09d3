"""Claims about scenes over recorded delays: what is heard when, and what motions then grow by."""

from __future__ import annotations

from pathlib import Path

import pytest

import apc
from apc.moments.network import NetworkVerdict
from tests.lossy import LINK
from tests.topologies import AVERAGE, replaced

# The nominal spectral radii of the scene with delays of 8 and 9 ms, by `dense`.
NOMINAL = {"8 ms": 0.9571713896251, "9 ms": 0.9564057627899}


def judged(folder: Path, rows: str, more: str = "") -> NetworkVerdict:
    (folder / "t.csv").write_text(f"delay [ms]\n{rows}", encoding="utf-8")
    (folder / "s.yaml").write_text(
        replaced(AVERAGE, (LINK, f"{LINK[:-1]}, trace: t.csv{more}}}")), encoding="utf-8"
    )
    found = apc.judge_network(apc.compile(folder / "s.yaml"))
    assert found is not None
    return found


@pytest.mark.parametrize("delay", NOMINAL)
@pytest.mark.parametrize("count", [1, 2, 3, 40])
@pytest.mark.parametrize("more", ["", ", reorder: all"])
def test_equal_recorded_delays_are_a_nominal_delay(tmp_path: Path, delay: str, count: int, more: str) -> None:
    """A packet that takes 8 ms is there at the tick 8 ms later, though the float 0.008 is a little more."""
    found = judged(tmp_path, f"{delay.split()[0]}\n" * count, more)
    assert found.verdict == "stable in mean square"
    assert found.mean_square_radius is not None
    assert found.error is not None
    assert abs(found.mean_square_radius - NOMINAL[delay] ** 2) <= 1e-12 + found.error


def test_many_recorded_delays_are_told_with_how_they_were_found(tmp_path: Path) -> None:
    """Over 1000 frames bounds on roundings say nothing; two orders of multiplying agree."""
    found = judged(tmp_path, "8\n" * 999 + "lost\n")
    assert found.verdict == "probably stable in mean square"
    assert not found.exact
    assert found.mean_square_radius is not None
    # One lost packet in a thousand moves it by less than a thousandth.
    assert found.mean_square_radius == pytest.approx(NOMINAL["8 ms"] ** 2, rel=1e-3)
    assert any("1,000 frames" in note for note in found.notes)


def test_too_many_recorded_delays_are_not_judged_at_once(tmp_path: Path) -> None:
    found = judged(tmp_path, "8\n9\n" * 10_001)
    assert found.verdict == "not judged"
    assert "20,002 frames" in found.notes[0]
