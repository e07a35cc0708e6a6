"""``bricktrack process``: runs into results."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgspec
import typer

from bricktrack_common.errors import ConfigError
from bricktrack_common.run_manifest import MANIFEST_NAME, read_manifest
from bricktrack_host.cli._console import say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._processing import (
    JobsOption,
    SchedulerOption,
    SendOption,
    TlsAuthorityOption,
    TlsCertificateOption,
    TlsKeyOption,
    Where,
    process_here,
    process_side_by_side,
    say_processed,
    say_truth,
    stage_bar,
)
from bricktrack_host.cli._units import FleetOption, fleet_path
from bricktrack_host.transfer.camera_config import CameraMount
from bricktrack_host.transfer.fleet_config import UnitConfig, load_fleet
from bricktrack_host.transfer.pull import PulledRun

# What computes is imported by the command that runs it: OpenCV, SciPy, PyArrow and matplotlib take seconds
# to load, and `--help`, `status` and `pull` need none of them.
if TYPE_CHECKING:
    from bricktrack_host.many_runs.run_job import RunJob
    from bricktrack_host.pipeline import ProcessSettings

__all__ = [
    "TruthOption",
    "process",
    "process_folders",
    "process_pulled",
    "say_processed",
    "say_truth",
    "stage_bar",
]

_MOVING = "A camera that moves"
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
            help="What the camera moves with: nothing, a component with an IMU, or the table. "
            "\\[default: the fleet file's, else static]",
            rich_help_panel=_MOVING,
        ),
    ] = None,
    camera_run: Annotated[
        Path | None,
        typer.Option(
            help="Run of the unit whose IMU moves with the camera. "
            "\\[default: the one beside RUN with its label]",
            rich_help_panel=_MOVING,
        ),
    ] = None,
    table: Annotated[
        Path | None,
        typer.Option(
            help="CSV of the table's accelerations, where the camera moves with it.", rich_help_panel=_MOVING
        ),
    ] = None,
    sample_column: Annotated[
        str | None,
        typer.Option(
            help="Column of the CSV with the sample numbers. \\[default: rows are counted]",
            rich_help_panel=_MOVING,
        ),
    ] = None,
    first_sample: Annotated[
        int,
        typer.Option(help="What the CSV calls the sample of the first rising edge.", rich_help_panel=_MOVING),
    ] = 0,
    again: Annotated[
        bool, typer.Option("--again", help="Also runs whose results are of the same input already.")
    ] = False,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    send: SendOption = "auto",
    tls_ca: TlsAuthorityOption = None,
    tls_cert: TlsCertificateOption = None,
    tls_key: TlsKeyOption = None,
) -> None:
    """Turn recordings into motion: poses, tables (Parquet and CSV) and a report in each run's folder.

    A run processed again gives the same numbers; earlier results that differ are kept beside the new ones, as
    results_1. Several runs are processed side by side, each in a process of its own, or by a Dask cluster;
    one that fails does not stop the others. Runs whose results are of the same recording, calibration,
    layout and settings are left as they are: given again after an interruption, the command goes on. Exits
    with 1 if a run could not be processed. Ctrl-C leaves each run's earlier results, or its new ones, whole.

    For example:

        bricktrack process runs/b2_9f31c2_0007_shake --calibration b2.json --layout brick.toml

        bricktrack process runs/b2_* --fleet fleet.toml --jobs 4

        bricktrack process runs/*_shake-12 --scheduler tcp://10.0.0.5:8786

        bricktrack process runs/b7-2_9f31c2_0007_shake-12 --table shake-12.csv --sample-column Sample
    """
    from bricktrack_host.pipeline import ProcessSettings

    if output is not None and len(runs) > 1:
        raise ConfigError(
            f"--output is for one run; {len(runs)} were given. Leave it out: each has its own folder"
        )
    if camera_run is not None and len(runs) > 1:
        raise ConfigError(f"--camera-run is for one run; {len(runs)} were given")
    if table is None and (sample_column is not None or first_sample):
        raise ConfigError("--sample-column and --first-sample say how to read a --table; none was given")
    where = Where(jobs, scheduler, send, (tls_ca, tls_cert, tls_key))
    settings = ProcessSettings(
        segmentation=segmentation,
        prsoi_form="printed" if printed_form else "safe",
        rolling_shutter=rolling_shutter,
        imu=imu,
        use_imu=use_imu,
    )
    feels = {
        "camera_run": camera_run, "table": table, "sample_column": sample_column, "first_sample": first_sample
    }  # fmt: skip
    job_of = partial(
        _job, calibration=calibration, layout=layout, camera=camera, fleet_file=fleet, settings=settings,
        output=output, truth=truth, feels=feels,
    )  # fmt: skip
    if len(runs) == 1 and scheduler is None:
        process_here(job_of(runs[0]), again=again)
        return
    failed = process_side_by_side(runs, job_of, where, again=again)
    if failed:
        say_error(f"{failed} of {len(runs)} runs could not be processed")
        raise typer.Exit(EXIT_ERROR)


def process_folders(runs: list[Path], *, fleet: Path, where: Where) -> int:
    """Process runs with what the fleet file names, say what became of each, and return how many failed."""
    return process_side_by_side(runs, partial(_job, fleet_file=fleet), where, again=False)


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


def _job(
    run: Path,
    *,
    fleet_file: Path | None,
    calibration: Path | None = None,
    layout: Path | None = None,
    camera: CameraMount | None = None,
    settings: "ProcessSettings | None" = None,
    output: Path | None = None,
    truth: Path | None = None,
    feels: dict[str, Any] | None = None,
) -> "RunJob":
    """Return a run with what the options name, or else the fleet file for the run's unit.

    ``feels``: where to find what feels the camera's motion, see `choose_camera_sensor`.
    """
    from bricktrack_host.many_runs.run_job import RunJob
    from bricktrack_host.pipeline import ProcessSettings
    from bricktrack_host.stages.camera_sensor import choose_camera_sensor

    feels = feels or {}
    sensor = None
    if fleet_file is None and (feels.get("camera_run") or feels.get("table")):
        fleet_file = fleet_path(None)  # which says how that sensor sits
    if fleet_file is not None or calibration is None or layout is None:
        unit = _unit_of(run, fleet_file)
        calibration, layout = calibration or unit.calibration_path, layout or unit.layout_path
        if calibration is None or layout is None:
            raise ConfigError(
                f"{fleet_path(fleet_file)}: unit '{unit.name}' has no "
                f"{'calibration' if calibration is None else 'layout'}"
            )
        camera = camera or unit.camera
        if camera == unit.camera:
            sensor = choose_camera_sensor(run, unit, **feels)
    settings = msgspec.structs.replace(
        settings or ProcessSettings(), camera=camera or "static", camera_sensor=sensor
    )
    return RunJob(run, calibration, layout, settings, output=output, truth=truth)


def _unit_of(run: Path, fleet_file: Path | None) -> UnitConfig:
    path = fleet_path(fleet_file)
    if fleet_file is None and not path.exists():
        raise ConfigError("give --calibration and --layout, or a fleet file that names them for the unit")
    return load_fleet(path).select([read_manifest(run / MANIFEST_NAME).unit])[0]
