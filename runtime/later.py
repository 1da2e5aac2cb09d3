"""A tuple that is made when it is looked at.

Takes: what makes it. Gives: `LazyTuple`.
Guarantees: made once, whoever looks; equal to what it holds, and copied or sent to another process as that.
Does not: keep what it was made from, once it is made; until then `make` keeps it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar, overload

T = TypeVar("T")


class LazyTuple(Sequence[T]):
    """What `make` gives, as if it were there already."""

    __slots__ = ("_made", "_make")

    def __init__(self, make: Callable[[], tuple[T, ...]]) -> None:
        self._make: Callable[[], tuple[T, ...]] | None = make
        self._made: tuple[T, ...] = ()

    def _all(self) -> tuple[T, ...]:
        if (make := self._make) is not None:
            self._made = make()
            self._make = None
        return self._made

    @overload
    def __getitem__(self, place: int) -> T: ...
    @overload
    def __getitem__(self, place: slice) -> tuple[T, ...]: ...
    def __getitem__(self, place: int | slice) -> T | tuple[T, ...]:
        """Return one of it, or some."""
        return self._all()[place]

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._all())

    def __iter__(self) -> Iterator[T]:
        """Yield one after another."""
        return iter(self._all())

    def __eq__(self, other: object) -> bool:
        """Say whether another holds the same, be it there already or not."""
        return self._all() == (other._all() if isinstance(other, LazyTuple) else other)

    def __hash__(self) -> int:
        """Return the hash of what it holds."""
        return hash(self._all())

    def __repr__(self) -> str:
        """Return what it holds as text."""
        return repr(self._all())

    def __reduce__(self) -> tuple[Any, ...]:
        """Send what it holds, a tuple."""
        return tuple, (self._all(),)
