"""`errors`: what a message looks like, and in which order messages come."""

import pytest

from apc.compiler.errors import ApcError, Mistake, Mistakes, Place, nearest


def test_a_message_reads_place_code_sentence_hint_line_and_caret() -> None:
    place = Place("three-users.yaml", 14, 22, "      stiffness:     500")
    mistake = Mistake("E204", place, "stiffness", "N/m", "500 (no unit)", "stiffness: 500 N/m")
    assert str(mistake) == (
        "three-users.yaml:14:22: E204 stiffness wants N/m, got 500 (no unit). Write: stiffness: 500 N/m\n"
        "          stiffness:     500\n"
        "                         ^"
    )


def test_a_file_as_a_whole_has_neither_line_nor_caret() -> None:
    assert str(Mistake("E108", Place("a.yaml"), "this file is empty")) == "a.yaml: E108 this file is empty."


def test_a_fault_far_to_the_right_is_still_shown_above_its_caret() -> None:
    line = "x" * 300 + "!" + "y" * 300
    _, shown, caret = str(Mistake("E1", Place("a", 1, 301, line), "w")).splitlines()
    assert shown[caret.index("^")] == "!"
    assert len(shown) < 110


def test_mistakes_of_a_file_come_out_in_file_order_each_once() -> None:
    mistakes = Mistakes()
    mistakes.add("E2", Place("a", 3, 1), "later")
    mistakes.add("E1", Place("a", 1, 5), "first")
    mistakes.add("E2", Place("a", 3, 1), "later")
    assert mistakes
    with pytest.raises(ApcError) as caught:
        mistakes.raise_if_any()
    assert [mistake.what for mistake in caught.value.mistakes] == ["first", "later"]


def test_taking_an_error_keeps_its_mistakes_for_later() -> None:
    mistakes = Mistakes()
    mistakes.take(ApcError(Mistake("E1", Place("a"), "inner")))
    with pytest.raises(ApcError, match="inner"):
        mistakes.raise_if_any()


def test_a_collector_without_mistakes_raises_nothing() -> None:
    Mistakes().raise_if_any()
    assert not Mistakes()


def test_the_nearest_name_is_proposed_only_when_it_is_near() -> None:
    assert nearest("stifness", ["stiffness", "damping"]) == "stiffness"
    assert nearest("zzz", ["stiffness", "damping"]) == ""
