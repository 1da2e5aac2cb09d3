"""The same sweep on a real Dask cluster: equal results, and a sentence when the cluster isn't there."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from apc.compiler.errors import ApcError
from apc.studies import cluster as sweep_cluster
from apc.studies import work as sweep_work
from apc.studies.resumable_sweep import sweep
from apc.support import processes
from apc.support.processes import Patience
from tests.sweeping import CHEAP, parts
from tests.topologies import compiled, messages_of

distributed = pytest.importorskip("distributed", reason="Dask's distributed is not installed: '.[cluster]'")

MODEL = compiled(CHEAP)
OVER = {"it.stiffness": "10 N/m:9000 N/m:50", "it.delay": "0,1,1.5 ms"}
ANYWHERE = {"processes": True, "dashboard_address": ":0"}


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait for those who are there as long as it takes them."""
    monkeypatch.setattr(sweep_cluster, "PATIENCE_S", 3600)


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with distributed.LocalCluster(n_workers=2, threads_per_worker=2, **ANYWHERE) as cluster:
        yield cluster.scheduler_address


@pytest.mark.whole
def test_what_was_begun_by_one_process_is_finished_on_a_cluster_to_the_last_bit(
    tmp_path: Path, address: str
) -> None:
    whole, target = tmp_path / "whole.csv", tmp_path / "r.csv"
    sweep(MODEL, OVER, out=whole, jobs=1)

    def stop(done: int, points: int) -> None:
        if done >= 128:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sweep(MODEL, OVER, out=target, jobs=1, progress=stop)
    assert sweep(MODEL, OVER, out=target, cluster=address).notes == ("128 points were computed before",)
    assert target.read_bytes() == whole.read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.whole
def test_workers_with_other_versions_are_refused(
    tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tuple((name, "1.2.3" if name == "numpy" else v) for name, v in sweep_work.program_versions())
    monkeypatch.setattr("apc.studies.resumable_sweep.program_versions", lambda: other)
    with pytest.raises(ApcError, match=r"E888 a worker has numpy .* \(here 1\.2\.3\): equal results"):
        sweep(MODEL, OVER, out=tmp_path / "r.csv", cluster=address)
    assert list(tmp_path.iterdir()) == []


FORM = ". Try: --cluster tcp://HOST:8786"


@pytest.mark.parametrize(
    ("where", "message"),
    [
        *(
            (where, f"{where}: E888 scheduler's address: expected HOST:PORT, got {where}{FORM}")
            for where in ("tcp://", "tcp://host", "host without port", "a:b:c", "x" * 80)
        ),
        ("", f": E888 scheduler's address: expected HOST:PORT{FORM}"),
        ("nonsense://host:1", "nonsense://host:1: E888 no answer of a Dask scheduler within"),
        (
            "tls://127.0.0.1:8786",
            "tls://127.0.0.1:8786: E888 Dask has no certificate for this address (distributed.comm.tls in",
        ),
    ],
)
def test_an_address_at_which_no_scheduler_can_be_is_told(
    where: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep_cluster, "PATIENCE_S", 0.5)
    (got,) = messages_of(lambda: sweep(MODEL, OVER, cluster=where))
    assert got.startswith(message)


@pytest.mark.whole
def test_a_cluster_that_is_not_there_is_told_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweep_cluster, "PATIENCE_S", 0.5)
    with socket.socket() as used:  # a port that nobody listens at
        used.bind(("127.0.0.1", 0))
        where = f"tcp://127.0.0.1:{used.getsockname()[1]}"
        assert messages_of(lambda: sweep(MODEL, OVER, out=tmp_path / "r.csv", cluster=where)) == [
            f"{where}: E888 no answer of a Dask scheduler within 0.5 s{FORM}"
        ]
    assert list(tmp_path.iterdir()) == []


def test_a_missing_distributed_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert messages_of(lambda: sweep(MODEL, OVER, cluster="tcp://host:1")) == [
        "tcp://host:1: E888 a cluster requires Dask's distributed on this computer and on the workers. "
        "Try: pip install '.[cluster]'  # in the folder of apc's own pyproject.toml"
    ]


@pytest.mark.whole
def test_a_cluster_without_workers_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_comes(*_: object, **__: object) -> None:
        raise TimeoutError

    monkeypatch.setattr(distributed.Client, "wait_for_workers", none_comes)
    with distributed.LocalCluster(n_workers=0, **ANYWHERE) as empty:
        assert messages_of(lambda: sweep(MODEL, OVER, cluster=empty.scheduler_address)) == [
            f"{empty.scheduler_address}: E888 the cluster has no workers."
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
    lost = distributed.LocalCluster(n_workers=1, **ANYWHERE)

    def lose(done: int, points: int) -> None:
        if done >= 64:
            # So long a client looks for a scheduler that it has lost, if that goes before it says so.
            clients[0]._timeout = 5
            lost.close()

    with pytest.raises(ApcError, match="E888 the connection to the cluster is lost"):
        sweep(MODEL, OVER, out=target, cluster=lost.scheduler_address, progress=lose)
    assert len(parts(target)) >= 1


@pytest.mark.whole
def test_a_frozen_worker_is_waited_for_aloud_and_only_so_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "SILENCE", 0.1)
    received: list[str] = []
    with distributed.LocalCluster(n_workers=1, **ANYWHERE) as frozen:
        (worker,) = (one.process.process.pid for one in frozen.workers.values())
        os.kill(worker, signal.SIGSTOP)
        try:
            waiting = Patience(0.3, received.append)
            (message,) = messages_of(
                lambda: sweep(MODEL, OVER, cluster=frozen.scheduler_address, patience=waiting)
            )
        finally:
            os.kill(worker, signal.SIGCONT)
    waited = "no result from the worker processes for {} s; still waiting"
    assert received == [waited.format(s) for s in (0.1, 0.2)]
    assert message == ('sweep: E889 no result from the worker processes for 0.3 s. Try: --patience "0.6 s"')
