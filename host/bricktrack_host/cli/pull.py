"""``bricktrack pull``."""

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

from bricktrack_common.errors import BricktrackError
from bricktrack_host.cli._console import err, out, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import AddressOption, FleetOption, TimeoutOption, UnitOption, choose_units
from bricktrack_host.transfer.fleet_config import UnitConfig
from bricktrack_host.transfer.pull import MAX_WORKERS, PulledRun, UnitPull, pull_fleet

ProcessHook = Callable[[UnitConfig, PulledRun], None]
"""Processes one pulled run with its unit's calibration and layout; raises `BricktrackError`."""


class _Bars:
    """A bar for each unit and one for all, with rate and time left; notes go above them."""

    def __init__(self, progress: Progress, units: list[UnitConfig]) -> None:
        self._progress = progress
        self._bars: dict[str, TaskID] = {u.name: progress.add_task(u.name, total=None) for u in units}
        self._all: TaskID | None = progress.add_task("all", total=0) if len(units) > 1 else None
        self._total = 0

    def unit_listed(self, unit: str, n_runs: int, n_bytes: int) -> None:
        words = f"{unit}: {n_runs} run{'' if n_runs == 1 else 's'}"
        self._progress.update(self._bars[unit], total=n_bytes, description=words)
        self._total += n_bytes
        if self._all is not None:
            self._progress.update(self._all, total=self._total)

    def bytes_done(self, unit: str, n_bytes: int) -> None:
        self._progress.advance(self._bars[unit], n_bytes)
        if self._all is not None:
            self._progress.advance(self._all, n_bytes)

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
        process_them: Annotated[
            bool,
            typer.Option(
                "--process", help="Process each run that came, when all are here.", hidden=process is None
            ),
        ] = False,
        timeout: TimeoutOption = 5.0,
        patience: Annotated[
            float, typer.Option("--patience", min=0, help="Seconds to wait for a unit that went away.")
        ] = 60.0,
        jobs: Annotated[
            int, typer.Option("--jobs", "-j", min=1, max=MAX_WORKERS, help="Units at a time.")
        ] = MAX_WORKERS,
    ) -> None:
        """Bring runs from units to this machine, verified, and tell the units so.

        Interrupted at any point, the next pull goes on where this one was.

        Exits with 1 if a run did not come.

        For example:

            bricktrack pull

            bricktrack pull --unit b2 --run b2_9f31c2_0007_shake -o runs

            bricktrack pull --address tcp://10.0.0.21:41733 --process
        """
        units, fleet_file = choose_units(fleet, unit, address)
        folder = runs or (fleet_file.runs_path if fleet_file is not None else Path("runs"))
        columns = (
            TextColumn("{task.description}", markup=False), BarColumn(), DownloadColumn(),
            TransferSpeedColumn(), TimeRemainingColumn(),
        )  # fmt: skip
        try:
            with Progress(*columns, console=err, transient=True) as progress:
                results = pull_fleet(
                    units, folder, run_ids=run, progress=_Bars(progress, units), timeout_s=timeout,
                    patience_s=patience, max_workers=jobs,
                )  # fmt: skip
        except KeyboardInterrupt as e:
            raise KeyboardInterrupt(
                f"Interrupted. What came is kept in {folder}; 'bricktrack pull' goes on from there."
            ) from e
        good = _report(results, run)
        if process_them and process is not None:
            for one, result in zip(units, results, strict=True):
                for pulled in result.runs:
                    if pulled.outcome == "pulled":
                        good = _process(process, one, pulled) and good
        if not good:
            raise typer.Exit(EXIT_ERROR)

    return pull


def _report(results: list[UnitPull], wanted: list[str] | None) -> bool:
    good = True
    for result in results:
        for pulled in result.runs:
            out.print(
                f"{pulled.folder}: {pulled.outcome}, {pulled.n_bytes / 1e6:.1f} MB",
                markup=False,
                soft_wrap=True,
            )
        for error in result.errors:
            say_error(f"{result.unit}: {error}")
            good = False
        if not result.runs and not result.errors and wanted is None:
            err.print(f"{result.unit}: no runs", markup=False)
    came = {pulled.run_id for result in results for pulled in result.runs}
    asked_for = set(wanted or [])
    if good and asked_for - came:
        say_error(
            f"no unit has the run {', '.join(sorted(asked_for - came))}. 'bricktrack pull' brings all runs"
        )
        good = False
    return good


def _process(process: ProcessHook, unit: UnitConfig, pulled: PulledRun) -> bool:
    try:
        process(unit, pulled)
    except BricktrackError as e:
        say_error(f"{pulled.run_id}: {e}")
        return False
    return True
