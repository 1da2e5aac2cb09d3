"""One thread for the linear algebra of small matrices.

Takes: nothing. Gives: the context manager `single_threaded`.
Guarantees: BLAS and OpenMP pools are back as they were on leaving.
Does not: limit threads of our own, or libraries loaded after its first use.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped] # it ships no types


@contextmanager
def single_threaded() -> Iterator[None]:
    """Run the body with every BLAS and OpenMP pool limited to one thread.

    A site's matrices are too small to share: measured on a loaded machine, an unpinned loop over
    21×21 matrices varied 17-fold in time, because each product waited for threads it did not need. Where
    the environment says one thread already, the pools are not even looked for.
    """
    if _pinned():
        yield
        return
    with _pools().limit(limits=1):
        yield


@lru_cache(maxsize=1)
def _pinned() -> bool:
    """Say whether every pool got one thread from the environment when it was loaded.

    OpenBLAS looks at its own variable first, and MKL at its own; both, and OpenMP, at OMP_NUM_THREADS.
    """
    own = (os.environ.get(name, "1") for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"))
    return os.environ.get("OMP_NUM_THREADS") == "1" and all(value == "1" for value in own)


@lru_cache(maxsize=1)
def _pools() -> ThreadpoolController:
    """Find the loaded pools, once: the search takes longer than a small analysis.

    A library loaded after the first call is not seen; every stage imports its own at the top.
    """
    return ThreadpoolController()
