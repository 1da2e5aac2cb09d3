"""Distribution of work to a running Dask cluster.

Takes: a function of the shared data and of a task, the address of a scheduler. Gives: `cluster_workers`.
Guarantees: the workers compute the same function as local processes (see `processes`); a missing or lost
cluster raises an error of one sentence.
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
from apc.support.distribution import install_line
from apc.support.processes import Result, Shared, Task, Workers

# A scheduler in the same building answers within milliseconds; one across the world within a second.
PATIENCE_S = 5

# Dask's parser of addresses does not return for some invalid addresses.
_ADDRESS = re.compile(r"([a-z]+://)?([\w.-]+|\[[0-9a-fA-F:.]+\]):[0-9]{1,5}")


@contextmanager
def cluster_workers(
    compute: Callable[[Shared, Task], Result], shared: Shared, address: str
) -> Iterator[Workers[Task, Result]]:
    """Yield the workers of a Dask cluster, with the shared data sent to it.

    Parameters
    ----------
    compute, shared
        As for `processes.local_processes`.
    address
        The scheduler's address, such as `tcp://host:8786`.

    Raises
    ------
    ApcError
        E888 distributed is not installed, no scheduler answers at the address, or the cluster has no workers.
    """
    location = SourceLocation(address[:80])
    form = "--cluster tcp://HOST:8786"
    if not _ADDRESS.fullmatch(address):
        raise ApcError(Diagnostic("E888", location, "scheduler's address", "HOST:PORT", address[:80], form))
    if importlib.util.find_spec("distributed") is None:
        message = "a cluster requires Dask's distributed on this computer and on the workers"
        raise ApcError(Diagnostic("E888", location, message, fix=install_line("cluster")))
    import distributed

    # Errors are reported once, by this program.
    loggers = [logging.getLogger(name) for name in ("distributed", "tornado")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        certificate = distributed.Security().get_connection_args("client").get("ssl_context")
        if (
            address.startswith("tls://") and certificate is None
        ):  # without a certificate the client does not return
            message = "Dask has no certificate for this address (distributed.comm.tls in its configuration)"
            raise ApcError(Diagnostic("E888", location, message, fix=form))
        try:
            client = distributed.Client(address, timeout=PATIENCE_S, set_as_default=False)
        except (OSError, ValueError) as error:
            message = f"no answer of a Dask scheduler within {PATIENCE_S} s"
            raise ApcError(Diagnostic("E888", location, message, fix=form)) from error
        with client:
            try:
                client.wait_for_workers(1, timeout=PATIENCE_S)
            except TimeoutError as error:
                raise ApcError(Diagnostic("E888", location, "the cluster has no workers")) from error
            executor = client.get_executor(pure=False)
            # Sent as a task: `scatter` would wait for every worker, including blocked ones.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # about a large model, which is sent once
                sent = client.submit(_stored_on_worker, shared, pure=False)

            def submit(task: Task) -> Future[Result]:
                """Return the future of a task on the cluster."""
                future: Future[Result] = executor.submit(compute, sent, task)
                return future

            yield Workers(submit, 2 * len(client.nthreads()), lambda error: _error_of_part(error, location))
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _stored_on_worker(shared: Shared) -> Shared:
    """Return the shared data unchanged: as a task's result they are stored on a worker for the others."""
    return shared


def _error_of_part(error: BaseException, location: SourceLocation) -> ApcError | None:
    """Return the error of a part without a result; None for an unknown cause."""
    from distributed import KilledWorker
    from distributed.comm import CommClosedError

    if isinstance(error, KilledWorker):
        message = (
            "several workers exited unexpectedly in the same part of the sweep: out of memory, or stopped"
        )
    elif isinstance(error, (CancelledError, CommClosedError, TimeoutError, OSError)):
        message = "the connection to the cluster is lost"
    elif isinstance(error, ImportError) or "deserializ" in str(error):
        message = "the workers of the cluster can't import apc; the same version is required there"
    else:
        return None
    return ApcError(Diagnostic("E888", location, message))
