"""``bricktrack calibrate``: from target pictures to a calibration file."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from bricktrack_common.errors import ConfigError
from bricktrack_common.typed_data import load_toml

app = typer.Typer(help="Calibrate cameras from pictures of dot targets.", no_args_is_help=True)


@app.callback()
def _calibrate() -> None:
    """Calibrate cameras from pictures of dot targets."""


@app.command()
def fit(
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration file to write (JSON).")],
    unit: Annotated[str, typer.Option(help="Name of the brick unit that the camera belongs to.")],
    rig: Annotated[Path | None, typer.Option(help="Rig file with a [calibration] table.")] = None,
    target: Annotated[str | None, typer.Option(help="Which target of the rig file, by name.")] = None,
    images_dir: Annotated[
        Path | None, typer.Option(help="Folder of the rig file's pictures; the rig file's own by default.")
    ] = None,
    plane_a: Annotated[Path | None, typer.Option(help="Picture of the target at the near plane.")] = None,
    a_mm: Annotated[float | None, typer.Option(help="Depth of the near plane, mm.")] = None,
    plane_b: Annotated[Path | None, typer.Option(help="Picture of the target at the far plane.")] = None,
    b_mm: Annotated[float | None, typer.Option(help="Depth of the far plane, mm.")] = None,
    pitch_mm: Annotated[float | None, typer.Option(help="Distance of neighbouring dots, mm.")] = None,
    columns: Annotated[int | None, typer.Option(help="Columns of the whole target.")] = None,
    rows: Annotated[int | None, typer.Option(help="Rows of the whole target.")] = None,
    origin_near: Annotated[
        tuple[float, float] | None, typer.Option(help="A pixel near the origin.", metavar="U V")
    ] = None,
    origin_dot: Annotated[
        bool, typer.Option(help="The origin is the dot nearest to that pixel, not the target's centre.")
    ] = False,
    dot_diameter_mm: Annotated[
        float | None, typer.Option(help="Diameter of the dots, mm; measured where not given.")
    ] = None,
    model: Annotated[
        Literal["auto", "central", "walking-pupil", "two-plane"],
        typer.Option(
            help="Rays through one point, nearly so, the paper's two planes, or what the data support."
        ),
    ] = "auto",
    order: Annotated[
        int | None, typer.Option(min=1, max=15, help="Order of the polynomials; cross-validated by default.")
    ] = None,
    sensor_mode: Annotated[
        Path | None,
        typer.Option(help="TOML file with the sensor mode; by default the IMX219's 1920 x 1080 crop."),
    ] = None,
    focus_note: Annotated[str, typer.Option(help="How the lens is focused, for the record.")] = "",
) -> None:
    """Fit a camera's rays to pictures of a dot target at two depths.

    For example:

    bricktrack calibrate fit --rig rig.toml --target 32x18 --unit brick-1 -o brick-1.json

    bricktrack calibrate fit --plane-a near.png --a-mm 101.117 --plane-b far.png --b-mm 161.111 --pitch-mm 4
    --columns 32 --rows 18 --origin-near 960 540 --unit brick-1 -o brick-1.json
    """
    # With OpenCV and SciPy behind it: not for `--help`.
    from bricktrack_common.camera_model import SensorMode
    from bricktrack_host.calibration.dot_grid import GridOrigin
    from bricktrack_host.cli._calibration_fit import FitJob, default_mode, job_of_rig, run_fit

    flags = {
        "--plane-a": plane_a,
        "--a-mm": a_mm,
        "--plane-b": plane_b,
        "--b-mm": b_mm,
        "--pitch-mm": pitch_mm,
        "--columns": columns,
        "--rows": rows,
        "--origin-near": origin_near,
    }
    if rig is not None:
        given = [name for name, value in flags.items() if value is not None]
        if given or origin_dot:
            raise ConfigError(
                f"{', '.join(given or ['--origin-dot'])} given together with --rig; say it in the rig file, "
                "or leave the rig file out"
            )
        job = job_of_rig(rig, target, images_dir)
    else:
        if (
            plane_a is None
            or a_mm is None
            or plane_b is None
            or b_mm is None
            or pitch_mm is None
            or columns is None
            or rows is None
            or origin_near is None
        ):
            missing = [name for name, value in flags.items() if value is None]
            raise ConfigError(f"{', '.join(missing)} not given; give them, or --rig with a rig file")
        job = FitJob(
            planes=((a_mm, plane_a), (b_mm, plane_b)),
            columns=columns,
            rows=rows,
            pitch_mm=pitch_mm,
            dot_diameter_mm=None,
            origin=GridOrigin(origin_near, "dot" if origin_dot else "centre"),
        )
    if dot_diameter_mm is not None:
        job = msgspec.structs.replace(job, dot_diameter_mm=dot_diameter_mm)
    mode = load_toml(sensor_mode, SensorMode) if sensor_mode is not None else default_mode(job)
    run_fit(job, mode=mode, model=model, order=order, unit=unit, focus_note=focus_note, output=output)
