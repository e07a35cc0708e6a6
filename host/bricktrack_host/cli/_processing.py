"""Runs processed by workers, here or on a cluster: bars meanwhile, and a word on each as it ends."""

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from bricktrack_common.errors import BricktrackError, ConfigError
from bricktrack_host.cli._console import err, say_error
from bricktrack_host.cli._processed import say_stands, say_summary
from bricktrack_host.cli._run_jobs import run_job
from bricktrack_host.cli._stage_bar import StageBar, stage_bar, stage_bars
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull import PulledRun

# What computes is imported where it is used: `--help` and the units' commands need none of it.
if TYPE_CHECKING:
    from bricktrack_host.many_runs.dask_cluster import TlsFiles
    from bricktrack_host.many_runs.run_job import RunJob, RunSummary
    from bricktrack_host.many_runs.workers import Instead, Workers

_PRELOADED = (
    "bricktrack_host.many_runs.run_job",
    "bricktrack_host.stages.solution",
    "bricktrack_host.stages.writing",
)

Send = Literal["auto", "path", "bytes"]
JobsOption = Annotated[
    int | None,
    typer.Option(
        "--jobs", "-j", min=1, help="Runs at once. \\[default: as processors and free memory allow]"
    ),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        help="Have a Dask cluster process the runs: its scheduler, as tcp://10.0.0.5:8786.",
        rich_help_panel="Cluster",
    ),
]
SendOption = Annotated[
    Send,
    typer.Option(
        help="Send a worker each run's path, or its files; auto: the files where it does not find the path.",
        rich_help_panel="Cluster",
    ),
]
TlsAuthorityOption = Annotated[
    Path | None,
    typer.Option("--tls-ca", help="For a tls:// scheduler: the authority's file.", rich_help_panel="Cluster"),
]
TlsCertificateOption = Annotated[
    Path | None, typer.Option("--tls-cert", help="... our certificate.", rich_help_panel="Cluster")
]
TlsKeyOption = Annotated[
    Path | None, typer.Option("--tls-key", help="... and its key.", rich_help_panel="Cluster")
]


@dataclass(frozen=True, slots=True)
class Where:
    """Who processes runs: so many processes here, or the workers of a cluster.

    Attributes
    ----------
    jobs : int or None
        Processes here; `None`: as many as processors and memory allow.
    scheduler : str or None
        Of a Dask cluster.
    send : "auto", "path" or "bytes"
    tls_files : tuple of Path or None
        Authority, certificate and key.
    """

    jobs: int | None = None
    scheduler: str | None = None
    send: Send = "auto"
    tls_files: tuple[Path | None, Path | None, Path | None] = (None, None, None)

    def __post_init__(self) -> None:
        if self.scheduler is not None and self.jobs is not None:
            raise ConfigError(
                "--jobs is for this machine; with --scheduler the cluster has as many as workers"
            )
        if self.scheduler is None and (self.send != "auto" or any(self.tls_files)):
            raise ConfigError("--send and --tls-... are for a cluster: give its --scheduler too")

    def workers(self, jobs: "list[RunJob]") -> "Workers":
        """Return who processes these runs.

        Raises
        ------
        ConfigError
            If the cluster cannot be reached, or is not fit for it.
        """
        if self.scheduler is None:
            from bricktrack_host.many_runs.local_processes import LocalProcesses
            from bricktrack_host.many_runs.memory import default_workers

            n_workers = self.jobs or default_workers(job.recorded_s() for job in jobs)
            return LocalProcesses(n_workers, preload=_PRELOADED)
        from bricktrack_host.many_runs.dask_cluster import DaskCluster

        with err.status(f"asking {self.scheduler} for workers"):
            return DaskCluster(self.scheduler, tls=self._tls())

    def _tls(self) -> "TlsFiles | None":
        from bricktrack_host.many_runs.dask_cluster import TlsFiles

        authority, certificate, key = self.tls_files
        if authority is None and certificate is None and key is None:
            return None
        if authority is None or certificate is None or key is None:
            raise ConfigError("--tls-ca, --tls-cert and --tls-key belong together: give all three")
        return TlsFiles(authority, certificate, key)


def process_here(job: "RunJob", *, again: bool) -> None:
    """Process one run in this process, and say what came of it.

    Raises
    ------
    BricktrackError
        If it cannot be processed.
    """
    from bricktrack_host.many_runs.run_job import is_processed, process_job

    key = job.input_sha256()
    if not again and is_processed(job, key):
        say_stands([job])
        return
    with stage_bar(job.run.name) as bar:
        summary = process_job(job, key, bar)
    say_summary(summary)
    _tidy_up()


def process_folders(runs: list[Path], *, fleet: Path, where: Where) -> int:
    """Process runs with what the fleet file names, say what became of each, and return how many failed."""
    return process_side_by_side(runs, partial(run_job, fleet_file=fleet), where, again=False)


def process_pulled(unit: UnitConfig, pulled: PulledRun) -> None:
    """Process one run that was just pulled, with the calibration and layout that the fleet file names."""
    from bricktrack_host.many_runs.run_job import RunJob
    from bricktrack_host.pipeline import ProcessSettings
    from bricktrack_host.stages.camera_sensor import choose_camera_sensor

    if unit.calibration_path is None or unit.layout_path is None:
        raise ConfigError(
            f"fleet.toml names no calibration or no layout for unit '{unit.name}'. Add them, or "
            f"process by hand: bricktrack process {pulled.folder} --calibration FILE --layout FILE"
        )
    sensor = choose_camera_sensor(pulled.folder, unit)
    settings = ProcessSettings(camera=unit.camera, camera_sensor=sensor)
    job = RunJob(pulled.folder, unit.calibration_path, unit.layout_path, settings)
    process_here(job, again=False)


def process_side_by_side(
    runs: list[Path], job_of: "Callable[[Path], RunJob]", where: Where, *, again: bool
) -> int:
    """Process runs, say what became of each as it ends, and return how many failed.

    Those whose results are of the same input are left as they are, unless ``again``.
    """
    from bricktrack_host.many_runs.run_job import is_processed

    todo: list[tuple[RunJob, str]] = []
    standing: list[RunJob] = []
    n_failed = 0
    for run in dict.fromkeys(runs):
        try:
            job = job_of(run)
            key = job.input_sha256()
        except BricktrackError as e:
            n_failed += 1
            words = str(e)
            say_error(words if words.startswith(f"{run}") else f"{run}: {words}")
            continue
        if not again and is_processed(job, key):
            standing.append(job)
        else:
            todo.append((job, key))
    if standing:
        say_stands(standing)
    if todo:
        n_failed += _process(todo, where)
        _tidy_up()
    return n_failed


def _tidy_up() -> None:
    """Remove what earlier versions compiled, once the results stand."""
    from bricktrack_host.compiled_leftovers import remove_unused_code

    remove_unused_code()


def _process(todo: "list[tuple[RunJob, str]]", where: Where) -> int:
    from bricktrack_host.many_runs.workers import do_all

    handling: _Here | _Sent = _Here(todo) if where.scheduler is None else _Sent(todo, where.send)
    workers = where.workers([job for job, _ in todo])
    bars: dict[int, StageBar] = {}
    n_failed = 0
    with stage_bars() as progress:
        everything = progress.add_task("all runs", total=len(todo)) if len(todo) > 1 else None

        def begin(i: int) -> StageBar:
            if i not in bars:
                bars[i] = StageBar(progress, todo[i][0].run.name)
            return bars[i]

        outcomes = do_all(len(todo), handling.work, workers, progress=begin, finish=handling.finish)
        with closing(outcomes):
            for outcome in outcomes:
                if outcome.index in bars:
                    bars.pop(outcome.index).remove()
                if everything is not None:
                    progress.advance(everything)
                if outcome.value is not None:
                    say_summary(outcome.value, budget=len(todo) == 1)
                    continue
                n_failed += 1
                if outcome.is_bug:
                    err.print(outcome.failure, markup=False, soft_wrap=True)
                run = todo[outcome.index][0].run
                say_error(f"{run}: {'a bug, see above' if outcome.is_bug else outcome.failure}")
    return n_failed


class _Here:
    """Runs processed by processes of this machine, which write the results themselves."""

    def __init__(self, todo: "list[tuple[RunJob, str]]") -> None:
        self._todo = todo

    def work(self, i: int) -> Callable[..., Any]:
        from bricktrack_host.many_runs.run_job import process_job

        return partial(process_job, *self._todo[i])

    def finish(self, i: int, summary: "RunSummary") -> "RunSummary":
        return summary


class _Sent:
    """Runs sent to other machines, whose results are written here."""

    def __init__(self, todo: "list[tuple[RunJob, str]]", send: Send) -> None:
        self._todo = todo
        self._send = send

    def work(self, i: int) -> Callable[..., Any]:
        return self._parcel(i, as_bytes=self._send == "bytes")

    def _parcel(self, i: int, *, as_bytes: bool) -> Callable[..., Any]:
        from bricktrack_host.many_runs.shipped_run import pack, process_parcel

        return partial(process_parcel, pack(self._todo[i][0], as_bytes=as_bytes))

    def finish(self, i: int, came: Any) -> "RunSummary | Instead[Any]":
        from bricktrack_host.many_runs.shipped_run import NotThere, publish
        from bricktrack_host.many_runs.workers import Instead

        job, key = self._todo[i]
        if not isinstance(came, NotThere):
            return publish(job, key, came)
        if self._send == "path":
            raise ConfigError(
                f"the worker does not find this run at {job.run.resolve()}. Share that folder with it, or "
                "give --send bytes"
            )
        return Instead(self._parcel(i, as_bytes=True))
