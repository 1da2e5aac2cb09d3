"""A tuple that is computed on first access.

Takes: the function that computes it. Gives: `LazyTuple`.
Guarantees: computed once; equal to its contents, and copied or pickled as a tuple.
Does not: keep the function `make` after the computation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar, overload

T = TypeVar("T")


class LazyTuple(Sequence[T]):
    """The result of `make`, computed on first access."""

    __slots__ = ("_made", "_make")

    def __init__(self, make: Callable[[], tuple[T, ...]]) -> None:
        self._make: Callable[[], tuple[T, ...]] | None = make
        self._made: tuple[T, ...] = ()

    def _all(self) -> tuple[T, ...]:
        """Return the contents, computed on the first call."""
        if (make := self._make) is not None:
            self._made = make()
            self._make = None
        return self._made

    @overload
    def __getitem__(self, index: int) -> T: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[T, ...]: ...
    def __getitem__(self, index: int | slice) -> T | tuple[T, ...]:
        """Return an item or a slice."""
        return self._all()[index]

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._all())

    def __iter__(self) -> Iterator[T]:
        """Yield the items."""
        return iter(self._all())

    def __eq__(self, other: object) -> bool:
        """Return whether the contents are equal, computed or not."""
        return self._all() == (other._all() if isinstance(other, LazyTuple) else other)

    def __hash__(self) -> int:
        """Return the hash of the contents."""
        return hash(self._all())

    def __repr__(self) -> str:
        """Return the contents as text."""
        return repr(self._all())

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the contents, a tuple."""
        return tuple, (self._all(),)
