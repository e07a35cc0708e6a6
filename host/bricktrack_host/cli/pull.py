"""``bricktrack pull``."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from bricktrack_common.errors import BricktrackError, UnitError
from bricktrack_host.cli._acknowledged import error_details
from bricktrack_host.cli._console import err, out, print_json, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import (
    AddressOption,
    ChosenUnits,
    FleetOption,
    JsonOption,
    TimeoutOption,
    UnitOption,
    choose_units,
)
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull import (
    DEFAULT_WORKERS,
    MAX_WORKERS,
    PulledRun,
    PullSettings,
    UnitPull,
    pull_fleet,
)

ProcessHook = Callable[[UnitConfig, PulledRun], None]
"""Processes one pulled run with its unit's calibration and layout; raises `BricktrackError`."""


class _Bars:
    """A bar for each unit under way and one for all, with rate and time left; notes go above them."""

    def __init__(self, progress: Progress, n_units: int) -> None:
        self._progress = progress
        self._n_units, self._n_done, self._total = n_units, 0, 0
        self._waiting: dict[str, tuple[str, int]] = {}
        self._bars: dict[str, TaskID] = {}
        self._all: TaskID | None = progress.add_task("all units", total=0) if n_units > 1 else None

    def unit_listed(self, unit: str, n_runs: int, n_bytes: int) -> None:
        self._waiting[unit] = (f"{unit}: {n_runs} run{'' if n_runs == 1 else 's'}", n_bytes)
        self._total += n_bytes
        if self._all is not None:
            self._progress.update(self._all, total=self._total)

    def unit_started(self, unit: str) -> None:
        words, n_bytes = self._waiting.pop(unit)
        self._bars[unit] = self._progress.add_task(words, total=n_bytes)

    def bytes_done(self, unit: str, n_bytes: int) -> None:
        self._progress.advance(self._bars[unit], n_bytes)
        if self._all is not None:
            self._progress.advance(self._all, n_bytes)

    def unit_done(self, unit: str) -> None:
        self._n_done += 1
        if self._all is None:
            return
        if unit in self._bars:
            self._progress.remove_task(self._bars.pop(unit))
        self._progress.update(self._all, description=f"{self._n_done} of {self._n_units} units")

    def note(self, unit: str, text: str) -> None:
        self._progress.console.print(f"{unit}: {text}", style="yellow", markup=False, soft_wrap=True)


def make_pull_command(process: ProcessHook | None = None) -> Callable[..., None]:
    """Return the command; ``process`` is what ``--process`` does with each run, if it is offered."""

    def pull(
        fleet: FleetOption = None,
        unit: UnitOption = None,
        address: AddressOption = None,
        run: Annotated[
            list[str] | None,
            typer.Option("--run", help="Only the run of this id; may be given again.", show_default=False),
        ] = None,
        runs: Annotated[
            Path | None,
            typer.Option(
                "-o",
                "--output",
                help="Folder of runs. \\[default: the fleet's runs_folder, else runs]",
                show_default=False,
            ),
        ] = None,
        disarm: Annotated[
            bool,
            typer.Option("--disarm", help="Disarm units that wait for their trigger: they transfer nothing."),
        ] = False,
        watch: Annotated[
            bool,
            typer.Option("--watch", "-w", help="Go on, and pull each new run as it appears, until Ctrl-C."),
        ] = False,
        every: Annotated[
            float, typer.Option("--every", min=0.2, max=3600, help="Seconds between looks with --watch.")
        ] = 5.0,
        process_them: Annotated[
            bool,
            typer.Option(
                "--process", help="Process each run that came, when all are here.", hidden=process is None
            ),
        ] = False,
        timeout: TimeoutOption = 5.0,
        patience: Annotated[
            float,
            typer.Option(
                "--patience", min=0, help="Seconds to wait for a unit that went away, records or saves."
            ),
        ] = 60.0,
        jobs: Annotated[
            int, typer.Option("--jobs", "-j", min=1, max=MAX_WORKERS, help="Units at a time.")
        ] = DEFAULT_WORKERS,
        as_json: JsonOption = False,
    ) -> None:
        """Bring runs from units to this machine, verified, and tell the units so.

        Interrupted at any point, the next pull goes on where this one was.

        Exits with 1 if a run did not come.

        For example:

            bricktrack pull

            bricktrack pull --watch --process

            bricktrack pull --unit b2 --run b2_9f31c2_0007_shake -o runs

            bricktrack pull --address tcp://10.0.0.21:41733 --disarm
        """
        chosen = choose_units(fleet, unit, address, timeout_s=timeout)
        folder = runs or (chosen.fleet.runs_path if chosen.fleet is not None else Path("runs"))
        settings = PullSettings(run_ids=run, disarm=disarm, patience_s=patience, max_workers=jobs)
        hook = process if process_them else None
        if watch:
            _watch(chosen, folder, settings, hook, every, as_json=as_json)
            return
        results = pull_with_bars(chosen, folder, settings)
        problems = [(r.unit, e) for r in results for e in r.errors] + _not_found(results, run)
        problems += _process_all(hook, chosen, results)
        if as_json:
            print_json(_for_scripts(results, problems))
        else:
            _report(results, said_nothing=run is None)
        _say(problems)
        if problems:
            raise typer.Exit(EXIT_ERROR)

    return pull


Problem = tuple[str, BricktrackError]


def pull_with_bars(chosen: ChosenUnits, folder: Path, settings: PullSettings) -> list[UnitPull]:
    """Pull with a bar for each unit; Ctrl-C says how to go on."""
    columns = (
        TextColumn("{task.description}", markup=False), BarColumn(), DownloadColumn(), TransferSpeedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    try:
        with Progress(*columns, console=err, transient=True) as progress:
            shown = _Bars(progress, len(chosen.units))
            return pull_fleet(chosen.units, folder, dialer=chosen.dialer, settings=settings, progress=shown)
    except KeyboardInterrupt as e:
        raise KeyboardInterrupt(
            f"Interrupted. What came is kept in {folder}; 'bricktrack pull' goes on from there."
        ) from e


def _watch(
    chosen: ChosenUnits,
    folder: Path,
    settings: PullSettings,
    hook: ProcessHook | None,
    every_s: float,
    *,
    as_json: bool,
) -> None:
    """Pull again and again; say what came, and of each unit's problems only what is new."""
    told: dict[str, str] = {}
    n_pulled = 0
    while True:
        results = pull_with_bars(chosen, folder, settings)
        came = [UnitPull(r.unit, [p for p in r.runs if p.outcome == "pulled"], r.errors) for r in results]
        n_pulled += sum(len(r.runs) for r in came)
        problems = [(r.unit, e) for r in came for e in r.errors]
        now = {unit: str(e) for unit, e in problems}
        new = [(unit, e) for unit, e in problems if told.get(unit) != str(e)]
        new += _process_all(hook, chosen, came)
        told = now
        if as_json and (new or any(r.runs for r in came)):
            print_json(_for_scripts(came, new), indent=False)
        elif not as_json:
            _report(came, said_nothing=False)
        _say(new)
        try:
            with err.status(f"watching {len(chosen.units)} units; {n_pulled} runs came, Ctrl-C ends"):
                time.sleep(every_s)
        except KeyboardInterrupt:
            return


def _report(results: list[UnitPull], *, said_nothing: bool) -> None:
    for result in results:
        for pulled in result.runs:
            out.print(
                f"{pulled.folder}: {pulled.outcome}, {pulled.n_bytes / 1e6:.1f} MB",
                markup=False,
                soft_wrap=True,
            )
        if said_nothing and not result.runs and not result.errors:
            err.print(f"{result.unit}: no runs", markup=False)


def _say(problems: list[Problem]) -> None:
    for name, error in problems:
        say_error(f"{name}: {error}" if name else str(error))


def _not_found(results: list[UnitPull], wanted: list[str] | None) -> list[Problem]:
    """Return an error about runs that were asked for and that no unit has; none while a unit failed."""
    missing = set(wanted or []) - {pulled.run_id for result in results for pulled in result.runs}
    if not missing or any(result.errors for result in results):
        return []
    words = f"no unit has the run {', '.join(sorted(missing))}. 'bricktrack pull' brings all runs"
    return [("", UnitError(words, code="no-such-run"))]


def _process_all(hook: ProcessHook | None, chosen: ChosenUnits, results: list[UnitPull]) -> list[Problem]:
    """Process the runs that came; return what went wrong, by run id."""
    problems: list[Problem] = []
    if hook is None:
        return problems
    for unit, result in zip(chosen.units, results, strict=True):
        for pulled in result.runs:
            if pulled.outcome == "pulled":
                try:
                    hook(unit, pulled)
                except BricktrackError as e:
                    problems.append((pulled.run_id, e))
    return problems


def _for_scripts(results: list[UnitPull], problems: list[Problem]) -> dict[str, object]:
    runs = [
        {
            "unit": result.unit,
            "run_id": pulled.run_id,
            "folder": str(pulled.folder),
            "outcome": pulled.outcome,
            "n_bytes": pulled.n_bytes,
            "n_bytes_fetched": pulled.n_bytes_fetched,
        }
        for result in results
        for pulled in result.runs
    ]
    errors = [{"of": name, **error_details(error)} for name, error in problems]
    return {"ok": not problems, "runs": runs, "errors": errors}
