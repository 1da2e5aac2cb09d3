"""Claims about `apc.later`."""

from __future__ import annotations

import copy

from apc.later import Later


def test_it_is_made_once_and_only_when_somebody_looks() -> None:
    asked: list[int] = []

    def make() -> tuple[str, ...]:
        asked.append(1)
        return "a", "b", "c"

    found = Later(make)
    assert not asked
    assert len(found) == 3
    assert found[0] == "a"
    assert found[1:] == ("b", "c")
    assert list(found) == ["a", "b", "c"]
    assert "b" in found
    assert asked == [1]


def test_it_equals_what_it_holds_and_is_copied_as_that() -> None:
    found = Later(lambda: (1, 2))
    assert found == (1, 2)
    assert found == Later(lambda: (1, 2))
    assert found != (1, 3)
    assert hash(found) == hash((1, 2))
    assert repr(found) == "(1, 2)"
    assert type(copy.copy(found)) is tuple
    assert copy.deepcopy(found) == (1, 2)
