"""One thread for the linear algebra of small matrices.

Takes: nothing. Gives: the context manager `single_threaded`; `load_pool`; `start_single_threaded`.
Guarantees: BLAS and OpenMP pools are back as they were on leaving, whenever they were loaded.
Does not: limit threads of our own.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped] # it ships no types

# environment variables for the number of threads
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def single_threaded() -> Iterator[None]:
    """Run the body with every BLAS and OpenMP pool limited to one thread.

    A subsystem's matrices are too small to share: measured on a loaded machine, an unpinned loop over 21×21
    matrices varied 17-fold in time, because each product waited for threads it did not need. If the
    environment already specifies one thread, the pools are not searched.
    """
    if _pinned():
        yield
        return
    with ExitStack() as limits:
        _limit(limits)
        _entered.append(limits)
        try:
            yield
        finally:
            _entered.remove(limits)


def load_pool(module: str) -> Any:
    """Import a library with a thread pool, as SciPy's linear algebra, for `single_threaded` to limit it."""
    new = module not in sys.modules
    module_type = importlib.import_module(module)
    if new and _entered:  # the outermost keeps the limit until all have left
        _limit(_entered[0])
    return module_type


def _limit(limits: ExitStack) -> None:
    """Give every pool one thread until the limits end; the controller's method takes far longer."""
    for pool in _pools(len(sys.modules)).lib_controllers:
        threads = pool.get_num_threads()
        if threads != 1:
            limits.callback(pool.set_num_threads, threads)
            pool.set_num_threads(1)


_entered: list[ExitStack] = []  # what `single_threaded` is in now, outermost first


def start_single_threaded() -> None:
    """Set one thread for the libraries to be loaded, unless the environment specifies otherwise.

    For a process that does nothing else: threads that are never made save a short command 20 to 40 ms. With
    NumPy loaded already it is too late, and nothing is done.
    """
    if "numpy" not in sys.modules and not any(name in os.environ for name in POOLS):
        os.environ |= dict.fromkeys(POOLS, "1")


@lru_cache(maxsize=1)
def _pinned() -> bool:
    """Return whether every pool had one thread from the environment when it was loaded.

    OpenBLAS and MKL first use their specific variables; both, and OpenMP, use OMP_NUM_THREADS.
    """
    limits = (os.environ.get(name, "1") for name in POOLS)
    return "OMP_NUM_THREADS" in os.environ and all(value == "1" for value in limits)


@lru_cache(maxsize=1)
def _pools(_modules: int) -> ThreadpoolController:
    """Find the loaded pools, once while the number of modules is the same: it takes longer than an analysis.

    A pool comes with a module that is imported.
    """
    from threadpoolctl import ThreadpoolController  # not needed where there is one thread already

    return ThreadpoolController()
