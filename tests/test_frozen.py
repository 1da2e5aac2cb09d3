"""`frozen`: its classes are the standard dataclasses in all that can be seen, few objects or many."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from collections.abc import Callable
from dataclasses import FrozenInstanceError, astuple, field, fields, replace
from typing import Any, ClassVar

import pytest

from apc.compiler import frozen

Decorator = Callable[..., Any]


def family(dataclass: Decorator) -> dict[str, Any]:
    """Return classes of each kind, made by a decorator."""

    @dataclass(frozen=True, slots=True, kw_only=True)
    class Spanned:
        start: int = field(default=0, compare=False, repr=False)
        end: int = field(default=0, compare=False, repr=False)

    @dataclass(frozen=True, slots=True)
    class Inherits(Spanned):
        value: int
        items: list[int] = field(default_factory=list)
        MOST: ClassVar[int] = 3

        @property
        def twice(self) -> int:
            return 2 * self.value

    @dataclass(frozen=True, slots=True)
    class One:
        value: Any

    @dataclass(frozen=True, slots=True)
    class Nothing:
        pass

    @dataclass(frozen=True, slots=True, order=True)
    class Ordered:
        low: Any
        high: Any = 7

    @dataclass(frozen=True, slots=True, eq=False)
    class Same:
        value: Any

    @dataclass(slots=True)
    class Loose:
        value: Any
        other: Any = None

    @dataclass(frozen=True, slots=True)
    class Shown:
        value: Any

        def __repr__(self) -> str:
            return "shown"

    made = (Spanned, Inherits, One, Nothing, Ordered, Same, Loose, Shown)
    for one in made:
        one.__qualname__ = one.__name__
    return {one.__name__: one for one in made}


CALLS: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = [
    ("Spanned", (), {}),
    ("Spanned", (), {"end": 3}),
    ("Spanned", (1,), {}),
    ("Inherits", (1,), {}),
    ("Inherits", (1, [2]), {"start": 4}),
    ("Inherits", (), {"value": 1, "items": [2], "end": 5}),
    ("Inherits", (), {}),
    ("Inherits", (1, [2], 3), {}),
    ("One", (1,), {}),
    ("One", (1.0,), {}),
    ("One", ([],), {}),
    ("One", (1,), {"value": 1}),
    ("One", (1,), {"other": 1}),
    ("Nothing", (), {}),
    ("Nothing", (1,), {}),
    ("Ordered", (1,), {}),
    ("Ordered", (1, 2), {}),
    ("Ordered", (0.5,), {"high": 9}),
    ("Same", (1,), {}),
    ("Loose", (1,), {}),
    ("Loose", (1, 2), {}),
    ("Shown", (1,), {}),
]


def outcome(act: Callable[[], Any]) -> Any:
    """Return what a call gives, or the kind of its mistake."""
    try:
        return act()
    except Exception as error:
        return type(error)


@pytest.fixture(params=[0, frozen.OFTEN + 1], ids=["few", "many"])
def both(request: pytest.FixtureRequest) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the standard library's family, and ours, of which so many objects were made before."""
    ours = family(frozen.dataclass)
    for name, values, named in CALLS:
        if isinstance(outcome(lambda: ours[name](*values, **named)), ours[name]):  # noqa: B023 -- called at once
            for _ in range(request.param):
                ours[name](*values, **named)
    return family(dataclasses.dataclass), ours


def objects(classes: dict[str, Any]) -> list[Any]:
    return [outcome(lambda: classes[name](*values, **named)) for name, values, named in CALLS]  # noqa: B023


def test_objects_are_made_shown_and_hashed_alike(both: Any) -> None:
    standard, ours = map(objects, both)
    for one, other in zip(standard, ours, strict=True):
        if isinstance(one, type):
            assert one is other is TypeError
            continue
        assert outcome(lambda: repr(one)) == outcome(lambda: repr(other))  # noqa: B023
        if type(one).__name__ != "Same":
            told = [outcome(lambda: hash(each)) for each in (one, other)]  # noqa: B023
            assert told[0] == told[1]
        assert [part.name for part in fields(one)] == [part.name for part in fields(other)]
        assert astuple(one) == astuple(other)
        assert type(one).__match_args__ == type(other).__match_args__
        assert not hasattr(other, "__dict__")


def test_objects_compare_alike(both: Any) -> None:
    standard, ours = map(objects, both)
    for act in ("__eq__", "__ne__", "__lt__", "__le__", "__gt__", "__ge__"):
        for i, one in enumerate(standard):
            for j, other in enumerate(standard):
                if not isinstance(one, type) and not isinstance(other, type):
                    expected = outcome(lambda: getattr(one, act)(other))  # noqa: B023
                    assert outcome(lambda: getattr(ours[i], act)(ours[j])) == expected  # noqa: B023


def test_copies_are_equal_and_changes_take_place_in_a_copy_only(both: Any) -> None:
    for one in objects(both[1]):
        if isinstance(one, type) or type(one).__name__ == "Same":
            continue
        assert copy.copy(one) == copy.deepcopy(one) == replace(one) == one
        for name in (part.name for part in fields(one)):
            assert getattr(replace(one, **{name: 11}), name) == 11
            if type(one).__name__ != "Loose":
                with pytest.raises(FrozenInstanceError):
                    setattr(one, name, 11)
                with pytest.raises(FrozenInstanceError):
                    delattr(one, name)
    with pytest.raises(TypeError):
        replace(both[1]["One"](1), other=2)


@frozen.dataclass(frozen=True, slots=True)
class Sent:
    """Of a module, so that it can be pickled."""

    value: int
    name: str = field(default="x", compare=False)


def test_an_object_goes_to_another_process_whole() -> None:
    found = pickle.loads(pickle.dumps(Sent(3, "y")))
    assert (found.value, found.name) == (3, "y")


def test_a_pattern_takes_an_object_apart() -> None:
    match Sent(3, "y"):
        case Sent(value, name=name):
            assert (value, name) == (3, "y")
