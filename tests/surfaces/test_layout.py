"""Texts of results: their order, their width, and the digits that errors permit."""

from __future__ import annotations

import json
import re
from fractions import Fraction
from math import floor, log10
from pathlib import Path
from types import SimpleNamespace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from apc.analysis.box_result import ChangingDelay
from apc.output.analysis_output import changing_text
from apc.output.formatting import capitalized, full_digits, quantity, span, table, with_error, without_dashes
from tests.commands import Cli
from tests.topologies import TOPOLOGIES

TITLES = ("Stability margins", "Sensitivity of", "Modes (")
LEGEND = "(-T): value at T before the frame; sent(-T): value sent at that time"
PACKETS = 2 / 3  # participation from which a mode belongs to packets in transit


@pytest.mark.needs_extension("event_order")
@pytest.mark.parametrize("name", ["three-users-average", "teleoperation-pair", "unlike-devices"])
def test_an_analysis_prints_verdict_summary_margins_sensitivities_and_modes(name: str, cli: Cli) -> None:
    """At most 45 lines of 80 columns; packets in transit take one line, counted here from the JSON data."""
    ran = cli(f"analyze {TOPOLOGIES / name}.yaml")
    lines = ran.out.splitlines()
    assert lines[0] == f"{name}: stable up to a common translation"
    at = [next(row for row, line in enumerate(lines) if line.startswith(title)) for title in TITLES]
    summary = next(row for row, line in enumerate(lines) if line.startswith("  spectral radius"))
    assert summary < at[0] and at == sorted(at)
    assert len(lines) <= 45 and max(map(len, lines)) <= 80

    modes = json.loads(cli(f"analyze {TOPOLOGIES / name}.yaml --json").out)["modes"]
    pairs = [mode for mode in modes if mode["magnitude"] > 1e-6 and mode["eigenvalue"][1] >= -mode["error"]]
    shares = [
        sum(share for state, share in mode["participation"].items() if " sent(" in state) for mode in pairs
    ]
    folded = sum(share > PACKETS for share in shares[1:])
    found = re.search(r"(\d+) transport-delay modes?", ran.out)
    assert (int(found[1]) if found else 0) == folded


def test_every_mode_has_a_row_if_all_are_requested(cli: Cli) -> None:
    file = TOPOLOGIES / "teleoperation-pair.yaml"
    text = cli(f"analyze {file} --modes all").out.partition("Modes (")[2]
    modes = json.loads(cli(f"analyze {file} --json").out)["modes"]
    rows = [line for line in text.splitlines() if re.match(r" +\d\.\d", line)]
    assert len(rows) == sum(mode["eigenvalue"][1] >= -mode["error"] for mode in modes)
    assert "not shown" not in text and "transport-delay" not in text


def test_full_digits_are_those_of_the_data_with_their_errors(cli: Cli) -> None:
    words = f"critical coordination.stiffness {TOPOLOGIES / 'three-users-average.yaml'}"
    crossing = json.loads(cli(f"{words} --json").out)["crossings"][0]
    short, full = cli(words).out, cli(f"{words} --digits full").out
    assert f"{crossing['value']:.6g} N/m" in short and "±" not in short
    value, error = re.search(r"([\d.]+) N/m ± (\S+)", full).groups()  # type: ignore[union-attr]
    assert abs(Fraction(value) - Fraction(crossing["value"])) <= Fraction(error)
    assert crossing["error"] <= float(error) <= 10 * crossing["error"]


@given(st.floats(1e-9, 1e9), st.floats(-20, 3))
@example(9.999996, -6)  # rounds to another power of ten
@example(1.0000049, -6)
def test_no_digit_is_printed_that_an_error_could_change_by_more_than_one(value: float, power: float) -> None:
    """Six digits alone state a number to half a unit of the sixth; its error is at most another half."""
    error = value * 10.0**power
    text = with_error(value, error, "N")
    if "±" in text:
        number, bound = text.removesuffix(" N").replace(" N", "").split(" ± ")
        assert abs(Fraction(number) - Fraction(value)) + Fraction(error) <= Fraction(bound) * Fraction(
            101, 100
        )
        return
    printed = Fraction(text.removesuffix(" N"))
    unit = Fraction(10) ** (floor(log10(float(printed)) + 1e-12) - 5)
    assert abs(printed - Fraction(value)) <= unit / 2 and Fraction(error) <= unit / 2 * Fraction(101, 100)
    with full_digits():
        assert "±" in with_error(value, error, "N")


@pytest.mark.few(4)
@pytest.mark.parametrize("file", sorted(TOPOLOGIES.glob("*.yaml")), ids=lambda file: file.stem)
def test_no_line_is_wider_than_a_terminal_and_no_cell_of_a_margin_is_broken(file: Path, cli: Cli) -> None:
    ran = cli(f"analyze {file}")
    lines = ran.out.splitlines()
    assert max(map(len, lines)) <= 80
    margins = ran.out.partition("Stability margins")[2].partition("\n\n")[2].partition("\n\n")[0]
    assert not any(re.match(r" {20,}\S", line) for line in margins.splitlines())


@pytest.mark.parametrize(("name", "has_legend"), [("three-users-average", True), ("client-server", False)])
def test_past_values_among_the_participations_have_a_legend(name: str, has_legend: bool, cli: Cli) -> None:
    text = cli(f"analyze --no-margins {TOPOLOGIES / name}.yaml").out.partition("Modes (")[2]
    table, legend, _ = text.partition(f"  {LEGEND}\n")
    assert (bool(legend), bool(re.search(r"\(-\d", table))) == (has_legend, has_legend)


@pytest.mark.parametrize("words", ["", "--hands passive"])
@pytest.mark.parametrize("name", ["three-users-average", "teleoperation-pair"])
def test_a_critical_value_is_the_same_in_the_sentence_and_in_the_table(
    name: str, words: str, cli: Cli
) -> None:
    out = cli(f"critical coordination.stiffness {TOPOLOGIES / name}.yaml {words}").out
    stated, printed = re.search(r"below (\S+) N/m", out), re.search(r"^  (\S+) N/m +below", out, re.MULTILINE)
    assert stated and printed and stated[1] == printed[1]
    assert ("frequency" in out) == (not words)


def test_a_column_without_any_text_is_omitted() -> None:
    rows = [("parameter", "limit", "f [Hz]"), ("a", "1", "–"), ("b", "2", "")]
    assert without_dashes(rows, "<<>") == ([("parameter", "limit"), ("a", "1"), ("b", "2")], "<<")
    kept = [*rows, ("c", "3", "4")]
    assert without_dashes(kept, "<<>") == (kept, "<<>")
    assert without_dashes(rows[:1], "<<>") == (rows[:1], "<<>")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (9999.5, "N/m", "9999.5 N/m"),
        (10_000, "N/m", "10000 N/m"),
        (5e5, "N/m", "500 kN/m"),
        (2e4, "kg", "20000 kg"),
    ],
)
def test_forces_above_ten_thousand_have_a_prefix(value: float, unit: str, text: str) -> None:
    assert quantity(value, unit) == text
    assert span(0, value, unit) == f"0 to {text}"


def test_a_mode_has_one_row_of_the_table(cli: Cli) -> None:
    for name in ("three-users-average", "teleoperation-pair"):
        text = cli(f"analyze --no-margins {TOPOLOGIES / name}.yaml").out.partition("Modes (")[2]
        assert ("multiplicity" in text) == (" × " in text)
        rows = text.partition("participation [%]\n")[2].partition("  (-T)")[0].splitlines()
        assert rows and all(re.match(r" +[\d.]+  (\w| × )+ .* \d+$", row) for row in rows)


def test_a_delay_that_alternates_between_single_packets_is_in_the_singular() -> None:
    over = SimpleNamespace(low=Fraction(1, 100), high=Fraction(1, 50), unit="s")
    text = changing_text(ChangingDelay(proved_to=None, unstable=(1, 2), note=""), over)  # type: ignore[arg-type]
    assert "1 packet with 10 ms and 2 packets with 20 ms alternate" in text


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("stable: hatched", "Stable: hatched"),
        ("device.mass has one value", "device.mass has one value"),
        ("", ""),
    ],
)
def test_a_note_begins_with_a_capital_letter_unless_with_a_name(text: str, printed: str) -> None:
    assert capitalized(text) == printed


@pytest.mark.needs_extension("event_order")
def test_orders_of_events_are_in_the_words_of_the_default_order(cli: Cli) -> None:
    out = cli(f"analyze --no-margins --event-order {TOPOLOGIES / 'three-users-average.yaml'}").out
    orders = out.partition("the verdict is the same")[2]
    assert "such as: send, deliver, compute, apply" in orders
    assert not re.search(r"\btick\b <|\bact\b", orders)
    assert max(map(len, out.splitlines())) <= 80


def test_a_table_that_is_too_wide_has_narrow_gaps_and_no_broken_row() -> None:
    rows = [("name", "value", "ratio"), ("n" * 40, "v" * 28, "1.234567")]
    assert list(table(rows, "<<>")) == [
        f"  {'name':40} {'value':28}    ratio",
        f"  {'n' * 40} {'v' * 28} 1.234567",
    ]
    assert [len(line) for line in table([(cell[:30], *others) for cell, *others in rows], "<<>")] == [72, 72]
