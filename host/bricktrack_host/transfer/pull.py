"""Copies the runs of many units, a few at a time: what each has that is not here yet."""

import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from bricktrack_common.errors import (
    BricktrackError,
    RunFormatError,
    StorageError,
    UnitError,
    UnitTimeoutError,
)
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_common.wire_messages import DaemonState, RunSummary
from bricktrack_host.durable_files import storage_errors, sync_folder
from bricktrack_host.transfer.contact import Contact, Dialer, ask_units
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull_progress import PullProgress, QuietProgress
from bricktrack_host.transfer.run_transfer import PulledRun, pull_run
from bricktrack_host.transfer.unit_client import UnitClient
from bricktrack_host.transfer.unit_connection import Stopped

__all__ = ["MAX_WORKERS", "PullSettings", "PulledRun", "UnitPull", "pull_fleet", "pull_unit"]

MAX_WORKERS = 16
DEFAULT_WORKERS = 8
_POLL_S = 0.5


@dataclass(frozen=True, slots=True)
class PullSettings:
    """How runs are pulled.

    Attributes
    ----------
    run_ids : list of str, optional
        Only these runs; default: all that are not here.
    disarm : bool
        Disarm a unit that waits for its trigger, because it transfers nothing meanwhile.
    patience_s : float, s
        How long to wait for a unit that went away, or that records and saves.
    max_workers : int
        Units at a time, at most `MAX_WORKERS`: with 2.5 MiB asked for ahead of each, it bounds the memory.
    """

    run_ids: list[str] | None = None
    disarm: bool = False
    patience_s: float = 60.0
    max_workers: int = DEFAULT_WORKERS


@dataclass(frozen=True, slots=True)
class UnitPull:
    """What came of one unit: its runs, and the errors of those runs that did not come."""

    unit: str
    runs: list[PulledRun]
    errors: list[BricktrackError]


def pull_unit(
    unit: UnitConfig,
    runs_folder: Path,
    *,
    dialer: Dialer | None = None,
    settings: PullSettings | None = None,
    progress: PullProgress | None = None,
) -> UnitPull:
    """Bring a unit's runs, or those named, into ``runs_folder``; one that fails does not stop the rest."""
    return pull_fleet([unit], runs_folder, dialer=dialer, settings=settings, progress=progress)[0]


def pull_fleet(
    units: list[UnitConfig],
    runs_folder: Path,
    *,
    dialer: Dialer | None = None,
    settings: PullSettings | None = None,
    progress: PullProgress | None = None,
) -> list[UnitPull]:
    """Pull several units at a time; return one result a unit, in their order.

    All are asked first what they have, at once: so it is known from the beginning how much is to come, and a
    unit that is silent holds up no other. On `KeyboardInterrupt` every transfer stops at its next chunk,
    resumable, before it is raised again.
    """
    stop = (dialer and dialer.stop) or threading.Event()
    dialer, settings = replace(dialer or Dialer(), stop=stop), settings or PullSettings()
    pull = _Pull(runs_folder, dialer, settings, progress or QuietProgress())
    with storage_errors(runs_folder, "Choose another folder with -o"):
        runs_folder.mkdir(parents=True, exist_ok=True)
        sync_folder(runs_folder)
    listed = ask_units(units, pull.list_unit, dialer=dialer)
    n_workers = max(1, min(settings.max_workers, MAX_WORKERS, len(units)))
    with ThreadPoolExecutor(n_workers, "pull") as pool:
        futures: list[Future[UnitPull]] = [
            pool.submit(pull.transfer, unit, runs) for unit, runs in zip(units, listed, strict=True)
        ]
        try:
            return [future.result() for future in futures]
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


@dataclass(frozen=True, slots=True)
class _Listed:
    """The runs of a unit that are wanted, and those of them that are not here yet."""

    wanted: list[RunSummary]
    todo: list[RunSummary]


@dataclass(frozen=True, slots=True)
class _Pull:
    """One pull of some units."""

    runs_folder: Path
    dialer: Dialer
    settings: PullSettings
    progress: PullProgress

    def list_unit(self, contact: Contact) -> _Listed:
        """Ask a unit what it has."""
        wanted = _select(contact.client.list_runs().runs, self.settings.run_ids)
        todo = [r for r in wanted if not (r.confirmed and _is_here(self.runs_folder / r.run_id))]
        self.progress.unit_listed(contact.unit.name, len(todo), sum(r.n_bytes for r in todo))
        return _Listed(wanted, todo)

    def transfer(self, unit: UnitConfig, listed: "_Listed | BricktrackError") -> UnitPull:
        """Bring what a unit has and is not here."""
        result = UnitPull(unit.name, [], [])
        if isinstance(listed, BricktrackError):
            result.errors.append(listed)
        elif listed.todo:
            self.progress.unit_started(unit.name)
            self._transfer_into(result, unit, listed)
        else:
            result.runs.extend(self._already_here(r) for r in listed.wanted)
        self.progress.unit_done(unit.name)
        return result

    def _transfer_into(self, result: UnitPull, unit: UnitConfig, listed: _Listed) -> None:
        try:
            with self.dialer.client(unit) as client:
                self._make_free(client, unit.name, len(listed.todo))
        except BricktrackError as e:
            result.errors.append(e)
            return
        for summary in listed.wanted:
            if summary not in listed.todo:
                result.runs.append(self._already_here(summary))
                continue
            try:
                pulled = pull_run(
                    lambda: self.dialer.client(unit),
                    summary.run_id,
                    self.runs_folder,
                    unit=unit.name,
                    progress=self.progress,
                    patience_s=self.settings.patience_s,
                    stop=self.dialer.stop,
                )
            except BricktrackError as e:
                result.errors.append(e)
                if isinstance(e, StorageError | UnitTimeoutError) or (
                    isinstance(e, UnitError) and e.code in ("busy", "wrong-state")
                ):
                    return  # the next run would end in the same way
                continue
            result.runs.append(pulled)

    def _already_here(self, run: RunSummary) -> PulledRun:
        return PulledRun(run.run_id, self.runs_folder / run.run_id, "already here", run.n_bytes, 0)

    def _make_free(self, client: UnitClient, name: str, n_runs: int) -> None:
        """Wait until a unit has recorded and saved; disarm one that waits for its trigger, if that is wanted.

        Raises
        ------
        UnitError
            If it is armed and shall stay so, or is still not ready after ``settings.patience_s``.
        """
        give_up_s = time.monotonic() + self.settings.patience_s
        told: DaemonState | None = None
        while (status := client.status()).state in ("armed", "recording", "saving"):
            if status.state == "armed":
                if not self.settings.disarm:
                    why = " and arms itself again after each run (auto_arm)" if status.auto_arm else ""
                    raise UnitError(
                        f"{name} is armed{why}; it transfers nothing meanwhile, and has {n_runs} runs to "
                        "fetch. 'bricktrack pull --disarm' disarms it first; 'bricktrack arm' arms it again",
                        code="busy",
                    )
                client.disarm()
                self.progress.note(name, "disarmed for the transfer; 'bricktrack arm' makes it wait again")
                return
            if time.monotonic() > give_up_s:
                raise UnitError(
                    f"{name} is still {status.state} after {self.settings.patience_s:g} s. Pull again later, "
                    "or give --patience more seconds",
                    code="busy",
                )
            if told != status.state:
                told = status.state
                self.progress.note(name, f"{status.state}; its runs come when it is ready")
            if (self.dialer.stop or threading.Event()).wait(_POLL_S):
                raise Stopped


def _select(listed: list[RunSummary], run_ids: list[str] | None) -> list[RunSummary]:
    if run_ids is None:
        return listed
    known = {r.run_id: r for r in listed}
    return [known[r] for r in run_ids if r in known]


def _is_here(folder: Path) -> bool:
    """Tell whether a run's folder stands with files of the right sizes; hashes were checked at its pull."""
    try:
        manifest = read_manifest(folder / MANIFEST_NAME)
        return all((folder / f.name).stat().st_size == f.n_bytes for f in manifest.files)
    except (RunFormatError, OSError):
        return False
