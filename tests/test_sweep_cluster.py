"""The same sweep on a real Dask cluster: the same numbers, and a sentence when the cluster isn't there."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

import pytest

from apc import processes
from apc.compiler.errors import ApcError, Place
from apc.processes import Patience
from apc.sweeps import cluster as sweep_cluster
from apc.sweeps import work as sweep_work
from apc.sweeps.sweep import sweep
from tests.sweeping import CHEAP, parts
from tests.topologies import compiled, told

distributed = pytest.importorskip("distributed", reason="Dask's distributed is not installed: '.[cluster]'")

MODEL = compiled(CHEAP)
OVER = {"it.stiffness": "10 N/m:9000 N/m:50", "it.delay": "0,1,1.5 ms"}


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for those who are there as long as it takes them."""
    monkeypatch.setattr(sweep_cluster, "PATIENCE_S", 3600)


@pytest.fixture(scope="module")
def cluster() -> Iterator[distributed.LocalCluster]:
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=2, processes=True, dashboard_address=":0"
    ) as found:
        yield found


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the file that this process writes."""
    path = tmp_path_factory.mktemp("here") / "here.csv"
    sweep(MODEL, OVER, out=path, jobs=1)
    return path.read_bytes()


def test_a_cluster_gives_the_same_file_to_the_last_bit(
    tmp_path: Path, cluster: distributed.LocalCluster, here: bytes
) -> None:
    there = tmp_path / "there.csv"
    sweep(MODEL, OVER, out=there, cluster=cluster.scheduler_address)
    assert there.read_bytes() == here
    assert [path.name for path in tmp_path.iterdir()] == ["there.csv"]


def test_what_was_begun_here_is_finished_on_the_cluster(
    tmp_path: Path, cluster: distributed.LocalCluster, here: bytes
) -> None:
    target = tmp_path / "r.csv"

    def stop(done: int, points: int) -> None:
        if done >= 128:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(MODEL, OVER, out=target, jobs=1, progress=stop)
    found = sweep(MODEL, OVER, out=target, cluster=cluster.scheduler_address)
    assert found.notes == ("128 points were there already",)
    assert target.read_bytes() == here


def test_workers_with_other_versions_are_refused(
    tmp_path: Path, cluster: distributed.LocalCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tuple(
        (name, "1.2.3" if name == "numpy" else found) for name, found in sweep_work.program_versions()
    )
    monkeypatch.setattr("apc.sweeps.sweep.program_versions", lambda: here)
    address = cluster.scheduler_address
    with pytest.raises(ApcError, match=r"E888 a worker has numpy .* \(here 1\.2\.3\): the same numbers"):
        sweep(MODEL, OVER, out=tmp_path / "r.csv", cluster=address)
    assert list(tmp_path.iterdir()) == []


def test_a_cluster_that_is_not_there_is_told_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_cluster, "PATIENCE_S", 0.5)
    with socket.socket() as taken:  # a port that nobody listens at
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        assert told(lambda: sweep(MODEL, OVER, out=tmp_path / "r.csv", cluster=address)) == [
            f"{address}: E888 no Dask scheduler answers there within 0.5 s. Write: --cluster tcp://HOST:8786"
        ]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("address", ["", "tcp://", "tcp://host", "host without port", "a:b:c", "x" * 200])
def test_an_address_that_is_none_is_told(address: str) -> None:
    shown = address[:80]
    assert told(lambda: sweep(MODEL, OVER, cluster=address)) == [
        f"{shown}: E888 a scheduler's address wants HOST:PORT"
        + (f", got {shown}" if address else "")
        + ". Write: --cluster tcp://HOST:8786"
    ]


def test_a_transport_nobody_knows_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_cluster, "PATIENCE_S", 0.5)
    (message,) = told(lambda: sweep(MODEL, OVER, cluster="nonsense://host:1"))
    assert message.startswith("nonsense://host:1: E888 no Dask scheduler answers there")


def test_a_cluster_without_workers_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_comes(*_: object, **__: object) -> None:
        raise TimeoutError

    monkeypatch.setattr(distributed.Client, "wait_for_workers", none_comes)
    with distributed.LocalCluster(n_workers=0, processes=True, dashboard_address=":0") as empty:
        assert told(lambda: sweep(MODEL, OVER, cluster=empty.scheduler_address)) == [
            f"{empty.scheduler_address}: E888 the cluster there has no workers."
        ]


@pytest.mark.whole
def test_a_cluster_lost_on_the_way_keeps_what_is_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clients: list[distributed.Client] = []
    connect = distributed.Client

    def connected(address: str, **options: Any) -> distributed.Client:
        clients.append(connect(address, **options))
        return clients[-1]

    monkeypatch.setattr(distributed, "Client", connected)
    target = tmp_path / "r.csv"
    lost = distributed.LocalCluster(n_workers=1, processes=True, dashboard_address=":0")

    def lose(done: int, points: int) -> None:
        if done >= 64:
            # So long a client looks for a scheduler that it has lost, if that goes before it says so.
            clients[0]._timeout = 5
            lost.close()

    with pytest.raises(ApcError, match="E888 the connection to the cluster is lost"):
        sweep(MODEL, OVER, out=target, cluster=lost.scheduler_address, progress=lose)
    assert len(parts(target)) >= 1


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (CancelledError(), "the connection to the cluster is lost"),
        (distributed.KilledWorker("part", None, 3), "several workers of the cluster died on the same part"),
        (ModuleNotFoundError("No module named 'apc'"), "the workers of the cluster can't load apc"),
        (RuntimeError("Error during deserialization of the task graph"), "can't load apc"),
    ],
)
def test_what_a_cluster_may_suffer_is_told(error: Exception, message: str) -> None:
    told_error = sweep_cluster._trouble(error, Place("tcp://host:1"))
    assert told_error is not None
    assert message in str(told_error)


def test_a_bug_of_ours_is_no_trouble_of_the_cluster() -> None:
    assert sweep_cluster._trouble(AssertionError("ours"), Place("tcp://host:1")) is None


def test_a_missing_distributed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert told(lambda: sweep(MODEL, OVER, cluster="tcp://host:1")) == [
        "tcp://host:1: E888 a cluster needs Dask's distributed, here and on its workers. "
        "Write: pip install '.[cluster]'  # in the folder of apc's own pyproject.toml"
    ]


def test_an_address_that_wants_a_certificate_is_told() -> None:
    assert told(lambda: sweep(MODEL, OVER, cluster="tls://127.0.0.1:8786")) == [
        "tls://127.0.0.1:8786: E888 Dask has no certificate for it (distributed.comm.tls in its own "
        "configuration). Write: --cluster tcp://HOST:8786"
    ]


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="no process can be frozen here")
def test_a_frozen_worker_is_waited_for_aloud_and_only_so_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "SILENCE", 0.1)
    heard: list[str] = []
    with distributed.LocalCluster(n_workers=1, processes=True, dashboard_address=":0") as frozen:
        (worker,) = (one.process.process.pid for one in frozen.workers.values())
        os.kill(worker, signal.SIGSTOP)
        try:
            patience = Patience(0.3, heard.append)
            (message,) = told(lambda: sweep(MODEL, OVER, cluster=frozen.scheduler_address, patience=patience))
        finally:
            os.kill(worker, signal.SIGCONT)
    assert heard == [f"nothing has come from those who compute for {s} s; still waiting" for s in (0.1, 0.2)]
    assert message == (
        "sweep: E889 nothing has come from those who compute for 0.3 s: they are stuck, or a part takes "
        'longer. Write: --patience "0.6 s"'
    )
