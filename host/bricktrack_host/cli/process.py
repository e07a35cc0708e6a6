"""``bricktrack process``: runs into results."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from bricktrack_common.errors import BricktrackError, ConfigError
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_host.cli._console import err, out, say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._units import FleetOption, fleet_path
from bricktrack_host.transfer.fleet_config import CameraMount, UnitConfig, load_fleet
from bricktrack_host.transfer.pull import PulledRun

# What computes is imported by the command that runs it: OpenCV, SciPy, PyArrow and matplotlib take seconds
# to load, and `--help`, `status` and `pull` need none of them.
if TYPE_CHECKING:
    from bricktrack_host.pipeline import ProcessedRun, ProcessProgress, ProcessSettings
    from bricktrack_host.results.truth import TruthComparison

_PIPELINE = "bricktrack_host.pipeline"

CalibrationOption = Annotated[
    Path | None,
    typer.Option("--calibration", "-c", help="Calibration file of this unit. \\[default: the fleet file's]"),
]
LayoutOption = Annotated[
    Path | None,
    typer.Option("--layout", "-l", help="Layout file of the brick. \\[default: the fleet file's]"),
]
TruthOption = Annotated[
    Path | None,
    typer.Option("--truth", help="True motion of a simulated run: a file, or a folder that holds one."),
]


@dataclass(frozen=True, slots=True)
class _Belongings:
    """What belongs to a run's unit."""

    calibration: Path
    layout: Path
    camera: CameraMount


class _StageBar:
    """One bar that shows the stage under way and how far it is."""

    def __init__(self, progress: Progress, run_id: str) -> None:
        self._progress = progress
        self._run_id = run_id
        self._task: TaskID = progress.add_task(run_id, total=None)

    def stage(self, name: str, total: int | None) -> None:
        self._progress.reset(self._task, total=total, description=f"{self._run_id}: {name}")

    def advance_to(self, done: int) -> None:
        self._progress.update(self._task, completed=done)

    def remove(self) -> None:
        self._progress.remove_task(self._task)


def _bars() -> Progress:
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
    )
    return Progress(*columns, console=err, transient=True)


@contextmanager
def stage_bar(run_id: str) -> Iterator[_StageBar]:
    """Show the progress of one run on the terminal while the block runs."""
    with _bars() as progress:
        yield _StageBar(progress, run_id)


def process(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Run folders, as pulled or imported.")],
    calibration: CalibrationOption = None,
    layout: LayoutOption = None,
    fleet: FleetOption = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder for the results of one run. \\[default: RUN/results]"),
    ] = None,
    truth: TruthOption = None,
    segmentation: Annotated[
        Literal["default", "paper"],
        typer.Option(help="Grey-weighted centroids, or the paper's thresholds and plain means."),
    ] = "default",
    printed_form: Annotated[
        bool, typer.Option("--printed-form", help="PRSOI as printed in the paper, for comparison.")
    ] = False,
    rolling_shutter: Annotated[bool, typer.Option(help="Take each LED at the time of its own row.")] = True,
    imu: Annotated[
        str | None, typer.Option(help="Inertial sensor on the LED component. \\[default: the first]")
    ] = None,
    use_imu: Annotated[
        bool, typer.Option("--use-imu/--no-imu", help="Fuse with the IMU, or smooth the optical poses alone.")
    ] = True,
    camera: Annotated[
        CameraMount | None,
        typer.Option(
            help="What the camera moves with; unless static, optical poses alone. "
            "\\[default: the fleet file's, else static]"
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", "-j", min=1, help="Runs at once. \\[default: as processors and free memory allow]"
        ),
    ] = None,
) -> None:
    """Turn recordings into motion: poses, tables (Parquet and CSV) and a report in each run's folder.

    A run processed again gives the same numbers; earlier results that differ are kept beside the new ones, as
    results_1. Several runs are processed side by side, each in a process of its own; one that fails does not
    stop the others. Exits with 1 if a run could not be processed. Ctrl-C leaves each run's earlier results, or
    its new ones, whole.

    For example:

        bricktrack process runs/b2_9f31c2_0007_shake --calibration b2.json --layout brick.toml

        bricktrack process runs/b2_* --fleet fleet.toml --jobs 4
    """
    from bricktrack_host.pipeline import ProcessSettings

    if output is not None and len(runs) > 1:
        raise ConfigError(
            f"--output is for one run; {len(runs)} were given. Leave it out: each has its own folder"
        )
    settings = ProcessSettings(
        segmentation=segmentation,
        prsoi_form="printed" if printed_form else "safe",
        rolling_shutter=rolling_shutter,
        imu=imu,
        use_imu=use_imu,
    )
    wanted = partial(_process_one, output=output, settings=settings, truth=truth)
    if len(runs) == 1:
        files = _belongings(runs[0], calibration, layout, camera, fleet)
        with stage_bar(runs[0].name) as bar:
            processed = wanted(runs[0], files, bar)
        say_processed(processed)
        return
    failed = _process_all(
        runs,
        partial(_belongings, calibration=calibration, layout=layout, camera=camera, fleet_file=fleet),
        wanted,
        jobs,
    )
    if failed:
        say_error(f"{failed} of {len(runs)} runs could not be processed")
        raise typer.Exit(EXIT_ERROR)


def process_folders(runs: list[Path], *, fleet: Path, jobs: int | None) -> int:
    """Process runs with what the fleet file names, say what became of each, and return how many failed."""
    from bricktrack_host.pipeline import ProcessSettings

    wanted = partial(_process_one, output=None, settings=ProcessSettings(), truth=None)
    return _process_all(
        runs, partial(_belongings, calibration=None, layout=None, camera=None, fleet_file=fleet), wanted, jobs
    )


def _process_all(
    runs: list[Path],
    files_for: Callable[[Path], _Belongings],
    wanted: "Callable[..., ProcessedRun]",
    jobs: int | None,
) -> int:
    ready: list[tuple[Path, _Belongings]] = []
    for run in runs:
        try:
            ready.append((run, files_for(run)))
        except BricktrackError as e:
            say_error(f"{run}: {e}")
    return len(runs) - len(ready) + _process_many(ready, wanted, jobs)


def _process_one(
    run: Path,
    files: _Belongings,
    progress: "ProcessProgress",
    *,
    output: Path | None,
    settings: "ProcessSettings",
    truth: Path | None,
) -> "ProcessedRun":
    from bricktrack_host.pipeline import process_run

    return process_run(
        run, calibration=files.calibration, layout=files.layout, output=output,
        settings=msgspec.structs.replace(settings, camera=files.camera), truth=truth, progress=progress,
    )  # fmt: skip


def _process_many(
    ready: list[tuple[Path, _Belongings]], wanted: "Callable[..., ProcessedRun]", jobs: int | None
) -> int:
    """Process runs side by side, say what became of each as it ends, and return how many failed."""
    from bricktrack_host.many_runs import default_workers, process_side_by_side

    works = [partial(wanted, run, files) for run, files in ready]
    bars: dict[int, _StageBar] = {}
    failed = 0
    with _bars() as progress:

        def begin(i: int) -> _StageBar:
            bars[i] = _StageBar(progress, ready[i][0].name)
            return bars[i]

        outcomes = process_side_by_side(
            works, workers=jobs or default_workers(len(works)), progress=begin, preload=[_PIPELINE]
        )
        with closing(outcomes):
            for outcome in outcomes:
                bars[outcome.index].remove()
                run = ready[outcome.index][0]
                if outcome.value is not None:
                    say_processed(outcome.value, budget=False)
                    continue
                failed += 1
                if outcome.is_bug:
                    err.print(outcome.failure, markup=False, soft_wrap=True)
                say_error(f"{run}: {'a bug, see above' if outcome.is_bug else outcome.failure}")
    return failed


def process_pulled(unit: UnitConfig, pulled: PulledRun) -> None:
    """Process one run that was just pulled, with the calibration and layout that the fleet file names."""
    from bricktrack_host.pipeline import ProcessSettings, process_run

    if unit.calibration_path is None or unit.layout_path is None:
        raise ConfigError(
            f"fleet.toml names no calibration or no layout for unit '{unit.name}'. Add them, or "
            f"process by hand: bricktrack process {pulled.folder} --calibration FILE --layout FILE"
        )
    with stage_bar(pulled.run_id) as bar:
        processed = process_run(
            pulled.folder,
            calibration=unit.calibration_path,
            layout=unit.layout_path,
            settings=ProcessSettings(camera=unit.camera),
            progress=bar,
        )
    say_processed(processed)


def _belongings(
    run: Path,
    calibration: Path | None,
    layout: Path | None,
    camera: CameraMount | None,
    fleet_file: Path | None,
) -> _Belongings:
    """Return what the options name, or else the fleet file for the run's unit."""
    if fleet_file is None and calibration is not None and layout is not None:
        return _Belongings(calibration, layout, camera or "static")
    path = fleet_path(fleet_file)
    if fleet_file is None and not path.exists():
        raise ConfigError("give --calibration and --layout, or a fleet file that names them for the unit")
    unit = load_fleet(path).select([read_manifest(run / MANIFEST_NAME).unit])[0]
    found = calibration or unit.calibration_path, layout or unit.layout_path
    if found[0] is None or found[1] is None:
        raise ConfigError(
            f"{path}: unit '{unit.name}' has no {'calibration' if found[0] is None else 'layout'}"
        )
    return _Belongings(found[0], found[1], camera or unit.camera)


def say_processed(processed: "ProcessedRun", *, budget: bool = True) -> None:
    """Print the verdict, the errors against truth where there is one, the time budget and where it all is."""
    from bricktrack_host.results.run_summary import key_figures, verdict

    result = processed.result
    line, problems = verdict(result, key_figures(result))
    out.print(f"{result.manifest.run_id}: {line}", markup=False, soft_wrap=True)
    for problem in problems:
        out.print(f"  {problem}", style="yellow", markup=False, soft_wrap=True)
    say_truth(processed.truth)
    if budget:
        _say_budget(result.timings_s, len(result.optical.t_ns))
    out.print(f"results: {processed.folder}", markup=False, soft_wrap=True)
    out.print(f"report:  {processed.report}", markup=False, soft_wrap=True)
    if processed.earlier is not None:
        out.print(
            f"earlier: {processed.earlier}; what changed: bricktrack compare {processed.folder}",
            markup=False,
            soft_wrap=True,
        )


def _say_budget(timings_s: dict[str, float], n_frames: int) -> None:
    table = Table(title="Time budget")
    table.add_column("stage")
    table.add_column("s", justify="right")
    table.add_column("ms a frame", justify="right")
    for name, seconds in timings_s.items():
        table.add_row(name, f"{seconds:.2f}", f"{1000 * seconds / n_frames:.2f}")
    total = sum(timings_s.values())
    table.add_row("all", f"{total:.2f}", f"{1000 * total / n_frames:.2f}", style="bold")
    out.print(table)


def say_truth(comparison: "TruthComparison | None") -> None:
    """Print the errors against simulated truth, absolute and as displacements from rest."""
    from bricktrack_host.results.truth import comparison_table

    if comparison is None:
        return
    out.print(comparison_table(comparison))
    if comparison.from_rest:
        out.print(comparison_table(comparison, from_rest=True))
