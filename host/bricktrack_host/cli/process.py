"""``bricktrack process``: runs into results."""

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import say_error
from bricktrack_host.cli._errors import EXIT_ERROR
from bricktrack_host.cli._processed import TruthOption
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
)
from bricktrack_host.cli._run_jobs import run_job
from bricktrack_host.cli._units import FleetOption
from bricktrack_host.transfer.camera_config import CameraMount

_MOVING = "A camera that moves"
CalibrationOption = Annotated[
    Path | None,
    typer.Option("--calibration", "-c", help="Calibration file of this unit. \\[default: the fleet file's]"),
]
LayoutOption = Annotated[
    Path | None,
    typer.Option("--layout", "-l", help="Layout file of the brick. \\[default: the fleet file's]"),
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
    # What computes is imported where it is used: it takes seconds to load, and `--help` needs none of it.
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
        run_job, calibration=calibration, layout=layout, camera=camera, fleet_file=fleet, settings=settings,
        output=output, truth=truth, feels=feels,
    )  # fmt: skip
    if len(runs) == 1 and scheduler is None:
        process_here(job_of(runs[0]), again=again)
        return
    failed = process_side_by_side(runs, job_of, where, again=again)
    if failed:
        say_error(f"{failed} of {len(runs)} runs could not be processed")
        raise typer.Exit(EXIT_ERROR)
