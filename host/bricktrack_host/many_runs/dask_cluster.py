"""Works done by the workers of a Dask cluster, over its ``concurrent.futures`` executor."""

import re
import time
import uuid
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bricktrack_common.errors import ConfigError
from bricktrack_host.many_runs.software_identity import differences, identity
from bricktrack_host.many_runs.workers import (
    Attempt,
    RunProgress,
    Work,
    WorkerLostError,
    WorkersGoneError,
    attempt,
)

_ANSWER_S = 10.0  # for the scheduler to answer
_WITHOUT_WORKERS_S = 60.0  # a nanny starts a killed worker again within seconds
_ADDRESS = r"(tcp|tls)://(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9._-]+):[0-9]{1,5}|inproc://.+"


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """What proves who we are to a ``tls://`` scheduler, PEM: the authority, our certificate and its key."""

    authority: Path
    certificate: Path
    key: Path


class DaskCluster:
    """The workers of a Dask cluster; a `Workers`.

    Parameters
    ----------
    address : str
        Of the scheduler, as ``tcp://10.0.0.5:8786``, or ``tls://...`` with ``tls``.
    tls : TlsFiles, optional
    patience_s : float, s
        How long to wait for the first worker, and for another one when none is left.

    Raises
    ------
    ConfigError
        If Dask is not installed, nobody answers at the address, or scheduler or a worker has other software.
    """

    # Each is several: the scheduler itself gives a work to another worker, three times unless it is told
    # otherwise. It blames a death on all that the worker had been given: the second attempt is for the
    # innocent, and the last, which is alone, for those who met another deadly one there.
    attempts = 3

    def __init__(
        self, address: str, *, tls: TlsFiles | None = None, patience_s: float = _WITHOUT_WORKERS_S
    ) -> None:
        self._client = _connect(address, tls)
        self._address = address
        self._patience_s = patience_s
        self._topic = f"bricktrack-{uuid.uuid4().hex}"
        self._progress: dict[str, RunProgress] = {}
        self._heard_s = time.monotonic()
        try:
            self._wait_for_workers()
            _require_same_software(self._client)
            self._client.subscribe_topic(self._topic, self._told)
        except BaseException:
            self._client.close()
            raise
        # Not pure: a run processed again is processed, and not answered from memory.
        self._executor = self._client.get_executor(pure=False)

    def room(self) -> int:
        """Return how many workers there are: each has one work, so that a death tells which one is deadly.

        Raises
        ------
        WorkersGoneError
            If the scheduler is gone, or has had no worker for a while.
        """
        n_workers = self._n_workers()
        now_s = time.monotonic()
        if n_workers:
            self._heard_s = now_s
        elif now_s - self._heard_s > self._patience_s:
            raise WorkersGoneError(
                f"{self._address} has had no worker for {self._patience_s:g} s. Start workers, then give the "
                "same command again: it goes on"
            )
        return n_workers

    def submit(self, work: Work[Any], progress: RunProgress) -> "Future[Attempt[Any]]":
        """Give a work to the cluster, which gives it to another worker if the first one dies."""
        token = uuid.uuid4().hex
        self._progress[token] = progress
        inner: Future[Attempt[Any]] = self._executor.submit(_on_worker, work, self._topic, token)
        outer: Future[Attempt[Any]] = Future()
        inner.add_done_callback(lambda done: self._pass_on(done, outer, token))
        return outer

    def stop(self) -> None:
        """Take back what is not begun, and leave; what a worker is at it ends by itself and throws away."""
        self._executor.shutdown(wait=False)
        self._client.close()

    def _n_workers(self) -> int:
        if self._client.status != "running":
            return 0
        try:
            return len(self._client.nthreads())
        except OSError:
            return 0

    def _wait_for_workers(self) -> None:
        give_up_s = time.monotonic() + self._patience_s
        while not self._n_workers():
            if time.monotonic() > give_up_s:
                raise ConfigError(
                    f"{self._address} has no workers. Start some: dask worker {self._address} --nthreads 1"
                )
            time.sleep(0.2)

    def _told(self, event: tuple[float, dict[str, Any]]) -> None:
        """Pass on what a worker says of its progress."""
        message = event[1]
        progress = self._progress.get(message["token"])
        if progress is None:
            return
        if "stage" in message:
            progress.stage(message["stage"], message["total"])
        else:
            progress.advance_to(message["done"])

    def _pass_on(self, done: "Future[Attempt[Any]]", outer: "Future[Attempt[Any]]", token: str) -> None:
        self._progress.pop(token, None)
        if not outer.set_running_or_notify_cancel():
            return
        try:
            outer.set_result(_came_of(done))
        except WorkerLostError as e:
            outer.set_exception(e)


def _came_of(done: "Future[Attempt[Any]]") -> Attempt[Any]:
    from distributed import KilledWorker

    try:
        return done.result()
    except CancelledError:
        return Attempt(None, "the scheduler is gone, or let go of this run. Give the same command again")
    except KilledWorker as e:
        n = e.allowed_failures + 1
        raise WorkerLostError(
            f"{n} worker{'s' if n > 1 else ''} died under it, last {e.last_worker.address}. Memory may have "
            "run out there: see the workers' logs"
        ) from None
    except Exception as e:  # noqa: BLE001 - whatever the cluster says of this run, the others go on
        return Attempt(None, f"the cluster did not do it: {type(e).__name__}: {e}")


def _connect(address: str, tls: TlsFiles | None) -> Any:
    try:
        import dask
        from distributed import Client, Security
    except ModuleNotFoundError as e:
        raise ConfigError("Dask is not installed. Install it with: pip install 'bricktrack[scale]'") from e
    if re.fullmatch(_ADDRESS, address) is None:
        raise ConfigError(f"{address!r} is no scheduler's address; expected one as tcp://10.0.0.5:8786")
    security = None
    if address.startswith("tls://"):
        if tls is None:
            raise ConfigError(
                f"{address} needs --tls-ca, --tls-cert and --tls-key: the files that prove who we are"
            )
        missing = [path for path in (tls.authority, tls.certificate, tls.key) if not path.is_file()]
        if missing:
            raise ConfigError(f"{missing[0]}: no such file")
        security = Security(  # type: ignore[no-untyped-call]
            tls_ca_file=str(tls.authority), tls_client_cert=str(tls.certificate), tls_client_key=str(tls.key),
            require_encryption=True,
        )  # fmt: skip
    elif tls is not None:
        raise ConfigError(f"{address} is not encrypted: give the scheduler as tls://..., or no --tls files")
    # A run sent as bytes is large, and meant to be.
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "10GB"})
    try:
        return Client(  # type: ignore[no-untyped-call]
            address, security=security, timeout=_ANSWER_S, set_as_default=False, name="bricktrack"
        )
    except (OSError, ValueError, TypeError, RuntimeError) as e:
        raise ConfigError(
            f"no Dask scheduler answers at {address} ({e}). Start one with 'dask scheduler', and give its "
            "address as tcp://host:8786"
        ) from e


def _require_same_software(client: Any) -> None:
    """Refuse a cluster whose results might differ from this machine's."""
    here = identity()
    answers = {"the scheduler": _answer_of_scheduler(client)}
    answers |= {
        f"worker {address}": answer for address, answer in client.run(identity, on_error="return").items()
    }
    for who, answer in answers.items():
        if isinstance(answer, Exception):
            raise ConfigError(
                f"{who} cannot load bricktrack ({answer}). Install the same bricktrack there as here: "
                f"{here['bricktrack']}, with the extras 'host' and 'scale'"
            )
        wrong = differences(here, answer)
        if wrong:
            raise ConfigError(f"{who} has other software: {wrong}. Install the same on both")
    for address, n_threads in client.nthreads().items():
        if n_threads > 1:
            raise ConfigError(
                f"worker {address} does {n_threads} runs at once in one process, in one interpreter's time. "
                f"Start it as: dask worker SCHEDULER --nthreads 1 --nworkers {n_threads}"
            )


def _answer_of_scheduler(client: Any) -> Any:
    try:
        return client.run_on_scheduler(identity)
    except Exception as e:  # noqa: BLE001 - whatever Python says there is the answer
        return e


class _Events:
    """Sends progress as events of the cluster, a hundred times a stage at most."""

    def __init__(self, topic: str, token: str) -> None:
        from distributed import get_worker

        self._worker = get_worker()
        self._topic, self._token = topic, token
        self._every = 1

    def stage(self, name: str, total: int | None) -> None:
        self._every = max((total or 0) // 100, 1)
        self._send({"stage": name, "total": total})

    def advance_to(self, done: int) -> None:
        if done % self._every == 0:
            self._send({"done": done})

    def _send(self, message: dict[str, Any]) -> None:
        self._worker.log_event(self._topic, {"token": self._token, **message})


def _on_worker(work: Work[Any], topic: str, token: str) -> Attempt[Any]:
    return attempt(work, _Events(topic, token))
