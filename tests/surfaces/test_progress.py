"""Claims about `apc.cli.progress`: a terminal sees how far the work is, and nothing of it stays."""

from __future__ import annotations

import sys

import pytest

from apc.cli import progress
from apc.cli.progress import at_work, progress_bar, status_line


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


def test_long_work_of_unknown_length_says_that_it_goes_on(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []

    def ended(seconds: float) -> bool:
        waits.append(seconds)
        return len(waits) == 3

    monkeypatch.setattr(progress, "QUIET", 10.0)
    progress._watch("analysing", ended)
    said = "analysing: at work for 10 s\nanalysing: at work for 20 s\n"
    assert (capsys.readouterr(), waits) == (("", said), [10.0, 10.0, 20.0])


def test_what_may_take_long_is_said_first_and_nothing_of_what_may_not(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "QUIET", 1000.0)  # no machine is so busy that a second passes for these
    with at_work("analysing", about=7500.0), at_work("compiling", about=75.0), at_work("measuring"):
        pass
    assert capsys.readouterr() == ("", "analysing: this may take 7,500 s\n")
