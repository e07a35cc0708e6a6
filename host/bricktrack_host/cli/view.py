"""``bricktrack view``: a processed run in the Rerun viewer."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import ConfigError
from bricktrack_host.cli._console import out
from bricktrack_host.cli._progress import stage_of_counts
from bricktrack_host.cli._units import FleetOption, fleet_path
from bricktrack_host.transfer.fleet_config import load_fleet

if TYPE_CHECKING:
    from bricktrack_host.results.result_store import RunResult
    from bricktrack_host.viewing.rerun_recording import Belongings


def view(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="A processed run.")],
    save: Annotated[
        Path | None,
        typer.Option(
            "--save", "-s", help="Write this .rrd file in place of opening the viewer.", show_default=False
        ),
    ] = None,
    results: Annotated[
        Path | None, typer.Option("--results", help="Results elsewhere. \\[default: RUN/results]")
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", "-c", help="For rays and camera. \\[default: the fleet file's]"),
    ] = None,
    layout: Annotated[
        Path | None, typer.Option("--layout", "-l", help="For LEDs in space. \\[default: the fleet file's]")
    ] = None,
    fleet: FleetOption = None,
    video: Annotated[bool, typer.Option(help="The video is nearly all of the file's size.")] = True,
) -> None:
    """Look at a run in space and time: video, LEDs, rays, the brick by each sensor, and every curve.

    Everything stands on one timeline, the seconds of the unit's clock since the trigger. A file that --save
    writes opens elsewhere, without bricktrack, with 'rerun FILE'.

    For example:

        bricktrack view runs/b2_9f31c2_0007_shake

        bricktrack view runs/b2_9f31c2_0007_shake --save shake.rrd
    """
    try:
        from bricktrack_host.viewing.rerun_output import save_recording, show_recording
    except ModuleNotFoundError as e:
        if e.name is None or e.name.partition(".")[0] not in ("rerun", "rerun_bindings"):
            raise
        raise ConfigError("the Rerun viewer is not here. Run: pip install 'bricktrack[view]'") from e
    from bricktrack_common.run_folder import read_run
    from bricktrack_host.results.result_store import read_result, results_of

    recording, result = read_run(run), read_result(results or results_of(run))
    belongings = _belongings(result, calibration, layout, fleet)
    with stage_of_counts() as progress:
        if save is None:
            show_recording(recording, result, belongings, with_video=video, progress=progress)
        else:
            save_recording(save, recording, result, belongings, with_video=video, progress=progress)
    if save is not None:
        size_mb = save.stat().st_size / 1e6
        out.print(f"{size_mb:.1f} MB: {save} (open it with: rerun {save})", markup=False, soft_wrap=True)


def _belongings(
    result: "RunResult", calibration: Path | None, layout: Path | None, fleet_file: Path | None
) -> "Belongings":
    """Return the calibration and layout that the options or the fleet file name.

    Raises
    ------
    ConfigError
        If a file is not the one that the results were made with.
    """
    from bricktrack_common.brick_model import load_brick_model
    from bricktrack_host.calibration.calibration_file import load_calibration
    from bricktrack_host.viewing.rerun_recording import Belongings

    path = fleet_path(fleet_file)
    if (calibration is None or layout is None) and (fleet_file is not None or path.exists()):
        unit = load_fleet(path).select([result.manifest.unit])[0]
        calibration, layout = calibration or unit.calibration_path, layout or unit.layout_path
    for what, file, sha256 in (
        ("calibration", calibration, result.provenance.calibration_sha256),
        ("layout", layout, result.provenance.layout_sha256),
    ):
        if file is None:
            out.print(
                f"no {what}: {_WITHOUT[what]}. Name it with --{what}",
                style="yellow",
                markup=False,
                soft_wrap=True,
            )
        elif sha256_file(file) != sha256:
            raise ConfigError(
                f"{file} is not the {what} that these results were made with (SHA-256 "
                f"{(sha256 or 'none')[:12]}…). Name that one with --{what}, or process the run again"
            )
    return Belongings(
        rays=None if calibration is None else load_calibration(calibration).ray_model,
        brick=None if layout is None else load_brick_model(layout),
    )


_WITHOUT = {
    "calibration": "no rays, and the picture stands outside the space",
    "layout": "the brick is shown by its axes alone",
}
