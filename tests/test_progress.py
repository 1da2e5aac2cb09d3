"""Claims about `apc.cli.progress`: a terminal sees how far the work is, and nothing of it stays."""

from __future__ import annotations

import sys

import pytest

from apc.cli import progress
from apc.cli.progress import progress_bar, status_line


def test_what_is_no_terminal_sees_nothing_of_short_work(capsys: pytest.CaptureFixture[str]) -> None:
    with status_line() as told:
        told("looking")
    with progress_bar("sweep", "points") as show:
        show(1, 2)
    assert capsys.readouterr() == ("", "")


def test_what_is_no_terminal_sees_a_line_now_and_then_of_long_work(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "QUIET", 10.0)
    clock = iter([0.0, 5.0, 11.0, 15.0, 23.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with status_line() as told:
        for text in ("after 5 s", "after 11 s", "after 15 s", "after 23 s"):
            told(text)
    assert capsys.readouterr() == ("", "after 11 s\nafter 23 s\n")
    monkeypatch.setattr(progress.time, "monotonic", iter([0.0, 0.0, 60.0, 60.0]).__next__)
    with progress_bar("sweep", "points") as show:
        show(1000, 4000)
    assert capsys.readouterr().err == "sweep: 1,000 of 4,000 points, about 3 min left\n"


def test_a_line_is_written_over_and_gone_when_the_work_ends(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with pytest.raises(KeyboardInterrupt), status_line() as told:
        told("looking at 3 values")
        told("x" * 500)
        raise KeyboardInterrupt
    written = capsys.readouterr()
    assert written.out == ""
    lines = written.err.split("\r\x1b[K")
    assert lines[1] == "looking at 3 values"
    assert len(lines[2]) < 500, "no wider than the terminal"
    assert lines[-1] == ""


def test_a_bar_is_shown_once_the_work_takes_long(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with progress_bar("sweep", "points", after=float("inf")) as show:
        show(1, 4)
    assert capsys.readouterr().err == ""
    with progress_bar("sweep", "points", after=0.0) as show:
        show(1, 4)
        show(3, 4)
    assert "of 4 points" in capsys.readouterr().err
