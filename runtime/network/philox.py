"""Random words by their number: Philox, whose every word follows from a key and a counter alone.

Takes: a key and counters. Gives: `words`; `BLOCK`.
Guarantees: the words are those of `numpy.random.Philox` with that key, whatever its version, in any order.
Does not: make numbers of them (see `channel`).

Philox-4x64-10: Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC '11, section 4.3. The same
stands in `simulation/luck.c`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Words = NDArray[np.uint64]

BLOCK = 4  # words of one counter
ROUNDS = 10
FACTORS = (0xD2E7470EE14C6C93, 0xCA5A826395121157)
STEPS = (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)

_HALF, _LOW = np.uint64(32), np.uint64(2**32 - 1)


def words(key: tuple[int, int], counter: tuple[ArrayLike, ArrayLike, ArrayLike]) -> Words:
    """Return the words (…, BLOCK) of many counters.

    Parameters
    ----------
    key
        Two words.
    counter
        Its three lower words, each a number or an array, of one shape when broadcast; the fourth is 0.
    """
    given = np.broadcast_arrays(*(np.asarray(one).astype(np.uint64) for one in counter))
    one, two, three, four = (*given, np.zeros(given[0].shape, np.uint64))
    for turn in range(ROUNDS):
        first, second = ((k + turn * step) % 2**64 for k, step in zip(key, STEPS, strict=True))
        high, low = _product(FACTORS[0], one)
        other_high, other_low = _product(FACTORS[1], three)
        one, two = other_high ^ two ^ np.uint64(first), other_low
        three, four = high ^ four ^ np.uint64(second), low
    return np.stack([one, two, three, four], axis=-1)


def _product(factor: int, values: Words) -> tuple[Words, Words]:
    """Return the upper and the lower word of a product of two words, from products of their halves."""
    high, low = np.uint64(factor >> 32), np.uint64(factor % 2**32)
    upper, lower = values >> _HALF, values & _LOW
    middle = upper * low + (lower * low >> _HALF)
    other = lower * high + (middle & _LOW)
    return upper * high + (middle >> _HALF) + (other >> _HALF), values * np.uint64(factor)
