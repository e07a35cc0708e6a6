"""Works given to a real Dask cluster of two worker processes on this machine, and clusters that are refused."""

import threading
import time
from contextlib import closing
from functools import partial

import pytest
from heard_progress import Heard
from run_works import dies, dies_once, work

from bricktrack_common.errors import ConfigError
from bricktrack_host.many_runs import dask_cluster, software_identity
from bricktrack_host.many_runs.dask_cluster import DaskCluster, TlsFiles
from bricktrack_host.many_runs.workers import do_all

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")

# Dask leaves sockets and files to the collector when a worker is killed under it.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(scope="module")
def cluster():
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0"
    ) as local:
        yield local


def do(works, workers, finish=lambda i, value: value):
    heard = {}

    def begin(i):
        heard[i] = Heard()
        return heard[i]

    outcomes = do_all(len(works), lambda i: works[i], workers, progress=begin, finish=finish)
    with closing(outcomes):
        return {o.index: o for o in outcomes}, heard


def test_works_are_done_failures_told_and_progress_heard(cluster):
    outcomes, heard = do(
        [partial(work, kind) for kind in ("a", "lost", "bug", "b")], DaskCluster(cluster.scheduler.address)
    )
    assert (outcomes[0].value, outcomes[3].value) == ("aa", "bb")
    assert outcomes[1].failure == "none of 5 frames gave a pose"
    assert not outcomes[1].is_bug
    assert outcomes[2].is_bug
    assert "ZeroDivisionError: of mine" in outcomes[2].failure
    assert heard[0].stages == [("decode", 200)]
    assert heard[0].done[-1] == 200


@pytest.mark.slow
def test_a_killed_worker_loses_nothing_and_other_software_is_refused(tmp_path, monkeypatch):
    works = [partial(dies_once, tmp_path / "been"), partial(work, "a"), dies, partial(work, "b")]
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1"
        ) as local,
    ):
        outcomes, _ = do(works, DaskCluster(local.scheduler_address))
        assert [outcomes[i].value for i in (0, 1, 3)] == ["done at last", "aa", "bb"]
        assert (
            "given up after 3 attempts: 1 worker died under it, last tcp://127.0.0.1" in outcomes[2].failure
        )

        monkeypatch.setattr(software_identity, "code_sha256", lambda: "0123456789abcdef")
        with pytest.raises(ConfigError, match="has other software: bricktrack's code .*, here 0123456789ab"):
            DaskCluster(local.scheduler_address)


def test_a_worker_of_several_threads_is_refused_with_the_remedy():
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=2, processes=False, dashboard_address=":0"
        ) as local,
        pytest.raises(ConfigError, match="--nthreads 1 --nworkers 2"),
    ):
        DaskCluster(local.scheduler.address)


def test_where_nobody_answers_or_works_that_is_said(monkeypatch):
    monkeypatch.setattr(dask_cluster, "_ANSWER_S", 0.5)
    for wrong in ("hello", "10.0.0.5:8786", "tcp://10.0.0.5", "http://10.0.0.5:8786"):
        with pytest.raises(ConfigError, match="is no scheduler's address; expected one as tcp://"):
            DaskCluster(wrong)
    with pytest.raises(ConfigError, match="no Dask scheduler answers at tcp://127.0.0.1:9 "):
        DaskCluster("tcp://127.0.0.1:9")
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address=":0") as local,
        pytest.raises(ConfigError, match="has no workers. Start some: dask worker"),
    ):
        DaskCluster(local.scheduler.address, patience_s=0.1)


def test_when_the_last_worker_is_gone_what_is_left_is_named(tmp_path):
    local = distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0"
    )
    with local:
        workers = DaskCluster(local.scheduler.address, patience_s=0.5)
        stopping = threading.Timer(0.5, lambda: local.scale(0))
        stopping.start()
        outcomes, _ = do([partial(waits, 3.0), partial(waits, 3.0), partial(waits, 3.0)], workers)
        stopping.join()
    assert len(outcomes) == 3
    assert "has had no worker for 0.5 s" in outcomes[2].failure


def waits(seconds, progress):
    time.sleep(seconds)


def test_a_tls_scheduler_wants_to_know_who_asks(tmp_path):
    with pytest.raises(ConfigError, match="needs --tls-ca, --tls-cert and --tls-key"):
        DaskCluster("tls://127.0.0.1:9")
    security = distributed.Security.temporary()
    files = TlsFiles(tmp_path / "ca.pem", tmp_path / "cert.pem", tmp_path / "key.pem")
    with pytest.raises(ConfigError, match=r"ca\.pem: no such file"):
        DaskCluster("tls://127.0.0.1:9", tls=files)
    with pytest.raises(ConfigError, match="is not encrypted"):
        DaskCluster("tcp://127.0.0.1:9", tls=files)
    files.authority.write_text(security.tls_ca_file)
    files.certificate.write_text(security.tls_client_cert)
    files.key.write_text(security.tls_client_key)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0", security=security
    ) as local:
        assert local.scheduler.address.startswith("tls://")
        outcomes, _ = do([partial(work, "a")], DaskCluster(local.scheduler.address, tls=files))
    assert outcomes[0].value == "aa"
