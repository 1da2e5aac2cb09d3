"""Work shared out to a running Dask cluster.

Takes: a function of the shared data and of a task, the address of a scheduler. Gives: `cluster_workers`.
Guarantees: the workers compute what a process here computes (see `processes`), with the same function; a
cluster that isn't there, or lost, is told in a sentence.
Does not: start a cluster, or install anything on it.
"""

from __future__ import annotations

import importlib.util
import logging
import re
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.distribution import install_line
from apc.processes import Result, Shared, Task, Workers

# A scheduler in the same building answers within milliseconds; one across the world within a second.
PATIENCE_S = 5

# Dask's own reading of addresses hangs on some that are none.
_ADDRESS = re.compile(r"([a-z]+://)?([\w.-]+|\[[0-9a-fA-F:.]+\]):[0-9]{1,5}")


@contextmanager
def cluster_workers(
    compute: Callable[[Shared, Task], Result], shared: Shared, address: str
) -> Iterator[Workers[Task, Result]]:
    """Connect to a Dask scheduler and hand it the work.

    Parameters
    ----------
    compute, shared
        As of `processes.local_processes`.
    address
        The scheduler's, such as `tcp://host:8786`.

    Raises
    ------
    ApcError
        E888 distributed isn't installed, nobody answers at the address, or the cluster has no workers.
    """
    location = SourceLocation(address[:80])
    form = "--cluster tcp://HOST:8786"
    if not _ADDRESS.fullmatch(address):
        raise ApcError(Diagnostic("E888", location, "a scheduler's address", "HOST:PORT", address[:80], form))
    if importlib.util.find_spec("distributed") is None:
        message = "a cluster needs Dask's distributed, here and on its workers"
        raise ApcError(Diagnostic("E888", location, message, hint=install_line("cluster")))
    import distributed

    # Errors are reported once, by this program.
    loggers = [logging.getLogger(name) for name in ("distributed", "tornado")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        certificate = distributed.Security().get_connection_args("client").get("ssl_context")
        if address.startswith("tls://") and certificate is None:  # a client without one never ends well
            message = "Dask has no certificate for it (distributed.comm.tls in its own configuration)"
            raise ApcError(Diagnostic("E888", location, message, hint=form))
        try:
            client = distributed.Client(address, timeout=PATIENCE_S, set_as_default=False)
        except (OSError, ValueError) as error:
            message = f"no Dask scheduler answers there within {PATIENCE_S} s"
            raise ApcError(Diagnostic("E888", location, message, hint=form)) from error
        with client:
            try:
                client.wait_for_workers(1, timeout=PATIENCE_S)
            except TimeoutError as error:
                raise ApcError(Diagnostic("E888", location, "the cluster there has no workers")) from error
            executor = client.get_executor(pure=False)
            # A task like the others: to scatter it would wait for every worker, frozen ones included.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of a large model, which is sent once
                sent = client.submit(_taken, shared, pure=False)

            def submit(task: Task) -> Future[Result]:
                future: Future[Result] = executor.submit(compute, sent, task)
                return future

            yield Workers(submit, 2 * len(client.nthreads()), lambda error: _trouble(error, location))
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _taken(shared: Shared) -> Shared:
    """Store the shared data on a worker, from which the others fetch them."""
    return shared


def _trouble(error: BaseException, location: SourceLocation) -> ApcError | None:
    """Return the message for a part without a result."""
    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    if isinstance(error, KilledWorker):
        message = (
            "several workers of the cluster died on the same part of the sweep: out of memory, or stopped"
        )
    elif isinstance(error, (CancelledError, CommClosedError, TimeoutError, OSError)):
        message = "the connection to the cluster is lost"
    elif isinstance(error, ImportError) or "deserializ" in str(error):
        message = "the workers of the cluster can't load apc: install the same version there"
    else:
        return None
    return ApcError(Diagnostic("E888", location, message))
