"""``bricktrack calibrate``: from target pictures to a calibration file."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from bricktrack_common.errors import ConfigError
from bricktrack_common.typed_data import load_toml
from bricktrack_host.cli import calibrate_capture, calibrate_check

app = typer.Typer(help="Calibrate cameras from pictures of dot targets.", no_args_is_help=True)


@app.callback()
def _calibrate() -> None:
    """Calibrate cameras from pictures of dot targets."""


@app.command()
def fit(
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration file to write (JSON).")],
    unit: Annotated[
        str | None, typer.Option(help="Name of the brick unit that the camera belongs to.")
    ] = None,
    captured: Annotated[
        Path | None, typer.Option(help="Folder of pictures that `calibrate capture` took.")
    ] = None,
    board: Annotated[Path | None, typer.Option(help="Target file, as `bricktrack target` wrote it.")] = None,
    picture: Annotated[
        list[str] | None,
        typer.Option(
            help="Depth in mm and picture of that target; two depths or more. Several of one depth are "
            "shifted boards.",
            metavar="Z=FILE",
        ),
    ] = None,
    rig: Annotated[Path | None, typer.Option(help="Rig file with a \\[calibration] table.")] = None,
    target: Annotated[str | None, typer.Option(help="Which target of the rig file, by name.")] = None,
    images_dir: Annotated[
        Path | None, typer.Option(help="Folder of the rig file's pictures; the rig file's own by default.")
    ] = None,
    plane_a: Annotated[
        Path | None, typer.Option(help="Picture of an unmarked target at the near plane.")
    ] = None,
    a_mm: Annotated[float | None, typer.Option(help="Depth of the near plane, mm.")] = None,
    plane_b: Annotated[Path | None, typer.Option(help="Picture of it at the far plane.")] = None,
    b_mm: Annotated[float | None, typer.Option(help="Depth of the far plane, mm.")] = None,
    pitch_mm: Annotated[float | None, typer.Option(help="Distance of neighbouring dots, mm.")] = None,
    columns: Annotated[int | None, typer.Option(help="Columns of the whole target.")] = None,
    rows: Annotated[int | None, typer.Option(help="Rows of the whole target.")] = None,
    origin_near: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="A pixel near the origin of an unmarked target; not needed where every column and row is "
            "in view.",
            metavar="U V",
        ),
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
        str | None,
        typer.Option(
            help="Order of the polynomials, 1 to 15; 'cross-validated'; or 'held', where the dots hold high "
            "degrees. \\[default: held; 5 for two-plane, as in the paper]",
            metavar="ORDER",
        ),
    ] = None,
    shift_tolerance_mm: Annotated[
        float, typer.Option(min=0, help="How well the planes' places are known, one standard deviation.")
    ] = 0.0,
    turn_tolerance_deg: Annotated[
        float, typer.Option(min=0, help="How well the far planes are parallel to the near one, likewise.")
    ] = 0.0,
    bend_tolerance_mm: Annotated[
        float, typer.Option(min=0, help="How flat the board is at its farthest dot, likewise.")
    ] = 0.0,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Write a page beside the calibration, as HTML.")
    ] = True,
    figures: Annotated[
        Path | None, typer.Option(help="Folder that gets the page's figures as PNG.", metavar="FOLDER")
    ] = None,
    layout: Annotated[
        Path | None, typer.Option("--layout", "-l", help="Layout file: its LEDs are drawn into the maps.")
    ] = None,
    earlier: Annotated[
        Path | None, typer.Option(help="Earlier calibration of this unit, to be compared with.")
    ] = None,
    sensor_mode: Annotated[
        Path | None,
        typer.Option(help="TOML file with the sensor mode; by default the IMX219's 1920 x 1080 crop."),
    ] = None,
    focus_note: Annotated[str, typer.Option(help="How the lens is focused, for the record.")] = "",
) -> None:
    """Fit a camera's rays to pictures of a dot target at two depths or more, and report how good they are.

    For example:

        bricktrack calibrate fit --captured pictures-b1 -o b1.json

        bricktrack calibrate fit --board target.toml --picture 101.117=near.png --picture 161.111=far.png
        --unit b1 -o b1.json

        bricktrack calibrate fit --rig rig.toml --target 32x18 --unit b1 -o b1.json --layout brick.toml
        --earlier b1-last-year.json

        bricktrack calibrate fit --plane-a near.png --a-mm 101.117 --plane-b far.png --b-mm 161.111
        --pitch-mm 4 --columns 32 --rows 18 --origin-near 960 540 --unit b1 -o b1.json
    """
    # With OpenCV and SciPy behind it: not for `--help`.
    from bricktrack_common.camera_model import SensorMode
    from bricktrack_host.calibration.dots.dot_grid import GridOrigin
    from bricktrack_host.cli._calibration_fit import FitOptions, order_wish, run_fit
    from bricktrack_host.cli._calibration_inputs import (
        FitJob,
        default_mode,
        job_of_capture,
        job_of_pictures,
        job_of_rig,
        plain_target,
    )

    flags = {
        "--plane-a": plane_a,
        "--a-mm": a_mm,
        "--plane-b": plane_b,
        "--b-mm": b_mm,
        "--pitch-mm": pitch_mm,
        "--columns": columns,
        "--rows": rows,
    }
    sources: dict[str, object] = {"--captured": captured, "--board": board, "--rig": rig}
    chosen = [name for name, value in sources.items() if value is not None]
    if len(chosen) > 1:
        raise ConfigError(f"{' and '.join(chosen)} given together; each says it all: give one of them")
    origin = None if origin_near is None else GridOrigin(origin_near, "dot" if origin_dot else "centre")
    if chosen:
        others: dict[str, object] = {**flags, "--origin-near": origin_near if chosen != ["--board"] else None}
        if chosen != ["--board"]:
            others["--picture"] = picture
        given = [name for name, value in others.items() if value]
        if given or (origin_dot and origin is None):
            raise ConfigError(
                f"{', '.join(given or ['--origin-dot'])} given together with {chosen[0]}; say it in that "
                "file, or leave the file out"
            )
    if captured is not None:
        job = job_of_capture(captured)
    elif board is not None:
        if not picture:
            raise ConfigError("--picture not given; give one for each depth, as --picture 101.117=near.png")
        job = job_of_pictures(board, picture, origin)
    elif rig is not None:
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
        ):
            missing = [name for name, value in flags.items() if value is None]
            raise ConfigError(
                f"{', '.join(missing)} not given; give them, or --captured, --board or --rig with a file"
            )
        job = FitJob(
            pictures=((a_mm, plane_a), (b_mm, plane_b)),
            target=plain_target(columns=columns, rows=rows, pitch_mm=pitch_mm, diameter_mm=dot_diameter_mm),
            origin=origin,
        )
    if dot_diameter_mm is not None:
        job = msgspec.structs.replace(job, dot_diameter_mm=dot_diameter_mm)
    name = unit or job.unit
    if name is None:
        raise ConfigError("--unit not given; a calibration belongs to one brick unit's camera")
    mode = load_toml(sensor_mode, SensorMode) if sensor_mode is not None else default_mode(job)
    options = FitOptions(
        model=model,
        order=order_wish(order),
        shift_tolerance_mm=shift_tolerance_mm,
        turn_tolerance_deg=turn_tolerance_deg,
        bend_tolerance_mm=bend_tolerance_mm,
        report=report,
        figures=figures,
        layout=layout,
        earlier=earlier,
    )
    run_fit(job, options, mode=mode, unit=name, focus_note=focus_note, output=output)


app.command("capture")(calibrate_capture.capture)
app.command("check")(calibrate_check.check)
