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
from bricktrack_host.transfer.contact import Dialer
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull_progress import PullProgress, QuietProgress
from bricktrack_host.transfer.run_transfer import PulledRun, pull_run
from bricktrack_host.transfer.unit_client import Stopped, UnitClient

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
    dialer, settings, progress = dialer or Dialer(), settings or PullSettings(), progress or QuietProgress()
    result = UnitPull(unit.name, [], [])
    progress.unit_started(unit.name)
    try:
        _pull_into(result, unit, runs_folder, dialer, settings, progress)
    except BricktrackError as e:
        result.errors.append(e)
    finally:
        progress.unit_done(unit.name)
    return result


def _pull_into(
    result: UnitPull,
    unit: UnitConfig,
    runs_folder: Path,
    dialer: Dialer,
    settings: PullSettings,
    progress: PullProgress,
) -> None:
    with storage_errors(runs_folder, "Choose another folder with -o"):
        runs_folder.mkdir(parents=True, exist_ok=True)
        sync_folder(runs_folder)
    with dialer.client(unit) as client:
        wanted = _select(client.list_runs().runs, settings.run_ids)
        todo = [r for r in wanted if not (r.confirmed and _is_here(runs_folder / r.run_id))]
        progress.unit_listed(unit.name, len(todo), sum(r.n_bytes for r in todo))
        if todo:
            _make_free(client, unit.name, len(todo), settings, progress, dialer.stop)
    for summary in wanted:
        if summary not in todo:
            folder = runs_folder / summary.run_id
            result.runs.append(PulledRun(summary.run_id, folder, "already here", summary.n_bytes, 0))
            continue
        try:
            pulled = pull_run(
                lambda: dialer.client(unit),
                summary.run_id,
                runs_folder,
                unit=unit.name,
                progress=progress,
                patience_s=settings.patience_s,
                stop=dialer.stop,
            )
        except BricktrackError as e:
            result.errors.append(e)
            if isinstance(e, StorageError | UnitTimeoutError) or (
                isinstance(e, UnitError) and e.code in ("busy", "wrong-state")
            ):
                break  # the next run would end in the same way
            continue
        result.runs.append(pulled)


def _make_free(
    client: UnitClient,
    name: str,
    n_runs: int,
    settings: PullSettings,
    progress: PullProgress,
    stop: threading.Event | None,
) -> None:
    """Wait until a unit has recorded and saved; disarm one that waits for its trigger, if that is wanted.

    Raises
    ------
    UnitError
        If it is armed and shall stay so, or is still not ready after ``settings.patience_s``.
    """
    give_up_s = time.monotonic() + settings.patience_s
    told: DaemonState | None = None
    while (status := client.status()).state in ("armed", "recording", "saving"):
        if status.state == "armed":
            if not settings.disarm:
                why = " and arms itself again after each run (auto_arm)" if status.auto_arm else ""
                raise UnitError(
                    f"{name} is armed{why}; it transfers nothing meanwhile, and has {n_runs} runs to fetch. "
                    "'bricktrack pull --disarm' disarms it first; 'bricktrack arm' makes it wait again",
                    code="busy",
                )
            client.disarm()
            progress.note(name, "disarmed for the transfer; 'bricktrack arm' makes it wait again")
            return
        if time.monotonic() > give_up_s:
            raise UnitError(
                f"{name} is still {status.state} after {settings.patience_s:g} s. Pull again later, or give "
                "--patience more seconds",
                code="busy",
            )
        if told != status.state:
            told = status.state
            progress.note(name, f"{status.state}; its runs come when it is ready")
        if (stop or threading.Event()).wait(_POLL_S):
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


def pull_fleet(
    units: list[UnitConfig],
    runs_folder: Path,
    *,
    dialer: Dialer | None = None,
    settings: PullSettings | None = None,
    progress: PullProgress | None = None,
) -> list[UnitPull]:
    """Pull several units at a time; return one result a unit, in their order.

    On `KeyboardInterrupt` every transfer stops at its next chunk, resumable, before it is raised again.
    """
    stop = threading.Event()
    dialer, settings = replace(dialer or Dialer(), stop=stop), settings or PullSettings()

    def work(unit: UnitConfig) -> UnitPull:
        return pull_unit(unit, runs_folder, dialer=dialer, settings=settings, progress=progress)

    n_workers = max(1, min(settings.max_workers, MAX_WORKERS, len(units)))
    with ThreadPoolExecutor(n_workers, "pull") as pool:
        futures: list[Future[UnitPull]] = [pool.submit(work, unit) for unit in units]
        try:
            return [future.result() for future in futures]
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise
