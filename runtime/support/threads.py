"""One thread for the linear algebra of small matrices.

Takes: nothing. Gives: the context manager `single_threaded`; `load_pool`; `start_single_threaded`.
Guarantees: BLAS and OpenMP pools are restored on exit, also those loaded within the context.
Does not: limit threads of Python.
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

# Environment variables for the number of threads.
POOLS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit every BLAS and OpenMP pool to one thread within the `with` body.

    The matrices of a subsystem are too small for several threads: measured on a loaded machine, the time of
    an unlimited loop over 21×21 matrices varied 17-fold, because each product waited for unnecessary threads.
    If the environment already specifies one thread, the pools are not searched.
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
    """Return an imported library with a thread pool, such as SciPy's linear algebra, limited by
    `single_threaded`.
    """
    new = module not in sys.modules
    library = importlib.import_module(module)
    if new and _entered:  # the limit holds until the outermost context ends
        _limit(_entered[0])
    return library


def _limit(limits: ExitStack) -> None:
    """Set one thread for every pool until `limits` is closed; faster than the method of the controller."""
    for pool in _pools(len(sys.modules)).lib_controllers:
        threads = pool.get_num_threads()
        if threads != 1:
            limits.callback(pool.set_num_threads, threads)
            pool.set_num_threads(1)


_entered: list[ExitStack] = []  # the active contexts of `single_threaded`, outermost first


def start_single_threaded() -> None:
    """Set one thread for libraries loaded later, unless the environment specifies otherwise.

    This is for processes that run one command: without thread creation a short command is 20 to 40 ms faster.
    If NumPy is already loaded, the function has no effect.
    """
    if "numpy" not in sys.modules and not any(name in os.environ for name in POOLS):
        os.environ |= dict.fromkeys(POOLS, "1")


@lru_cache(maxsize=1)
def _pinned() -> bool:
    """Return whether the environment limited every pool to one thread when it was loaded.

    OpenBLAS and MKL first use their own variables; both, and OpenMP, use OMP_NUM_THREADS.
    """
    limits = (os.environ.get(name, "1") for name in POOLS)
    return "OMP_NUM_THREADS" in os.environ and all(value == "1" for value in limits)


@lru_cache(maxsize=1)
def _pools(_modules: int) -> ThreadpoolController:
    """Return the controller of the loaded pools, cached for the same number of modules: the search is slow.

    A pool is loaded by the import of a module.
    """
    from threadpoolctl import ThreadpoolController  # not required if there is one thread

    return ThreadpoolController()
