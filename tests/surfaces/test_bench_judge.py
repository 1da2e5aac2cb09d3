"""Whether a benchmark can fail: a wrong number ends it with code 1, a missed time only when asked."""

from __future__ import annotations

import math

import pytest

from tests.bench.judge import NOISE, Judge, parser_of


def _code(judge: Judge) -> int:
    with pytest.raises(SystemExit) as raised:
        judge.end()
    assert isinstance(raised.value.code, int)
    return raised.value.code


def test_a_wrong_number_fails_and_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    judge = Judge()
    assert judge.within("radius", 1e-9, 1e-12) == "WRONG"
    assert judge.right("verdict", True) == "right"
    assert _code(judge) == 1
    assert capsys.readouterr().out == "\nWRONG radius: 1e-09, at most 1e-12\n"


def test_a_target_missed_by_no_more_than_noise_is_no_failure() -> None:
    judge = Judge(strict=True)
    assert judge.in_time("a", NOISE * 0.99, 1.0) == "near"
    assert _code(judge) == 0
    assert judge.in_time("a", NOISE * 1.01, 1.0) == "missed"
    assert judge.in_time("b", math.nan, 1.0) == "missed"
    assert _code(judge) == 1


def test_an_error_that_is_no_number_is_wrong() -> None:
    judge = Judge()
    assert judge.within("radius", math.nan, math.inf) == "WRONG"
    assert _code(judge) == 1


@pytest.mark.parametrize(("words", "code"), [([], 0), (["--strict"], 1)])
def test_a_missed_time_is_said_and_fails_when_asked(
    words: list[str], code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    judge = Judge(parser_of("none", None).parse_args(words).strict)
    assert judge.in_time("analyze", 0.7, 0.5) == "missed"
    assert judge.in_time("compile", 0.5, 0.5) == "kept"
    assert judge.in_time("help", 0.12, 0.1) == "near"
    assert judge.in_time("megabytes", 120, 100, noise=1) == "missed"
    assert _code(judge) == code
    assert (
        "missed analyze: 0.7, target 0.5\nmissed megabytes: 120, target 100\nevery number is right\n"
        in capsys.readouterr().out
    )
