"""``bricktrack import``."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer

from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import ConfigError
from bricktrack_common.typed_data import load_toml
from bricktrack_host.cli._console import err, out
from bricktrack_host.recordings.loose_files import LooseRig, read_rig, sensor_mode

_RIG = "How the sensor was read"
_IMU = "Inertial samples"


def import_recording(
    video: Annotated[
        Path, typer.Option("--video", help="H.264: a bare .h264, or MP4 or MKV.", exists=True, dir_okay=False)
    ],
    timestamps: Annotated[
        Path,
        typer.Option(
            "--timestamps",
            help="Text file, one stamp a picture: us since the first frame, or ms with decimals as picamera2 "
            "writes them.",
            exists=True,
            dir_okay=False,
        ),
    ],
    unit: Annotated[str, typer.Option("--unit", help="Name of the camera unit; begins the run's id.")],
    label: Annotated[str, typer.Option("--label", help="Name of the recording; ends the run's id.")],
    imu: Annotated[
        list[str] | None,
        typer.Option(
            "--imu",
            help="CSV: t_ns, ax_mps2, ay_mps2, az_mps2, gx_dps, gy_dps, gz_dps. NAME=FILE names the sensor; "
            "without a name it is 'brick', the one on the LED component. May be given again.",
            show_default=False,
            rich_help_panel=_IMU,
        ),
    ] = None,
    edges: Annotated[
        Path | None,
        typer.Option(
            "--edges",
            help="CSV with t_ns of each rising edge.",
            exists=True,
            dir_okay=False,
            show_default=False,
        ),
    ] = None,
    rig: Annotated[
        Path | None,
        typer.Option(
            "--rig",
            help="TOML file with the table \\[sensor].",
            exists=True,
            dir_okay=False,
            show_default=False,
            rich_help_panel=_RIG,
        ),
    ] = None,
    rig_table: Annotated[
        str,
        typer.Option(
            "--rig-table", help="Its table of this video, as motion or static.", rich_help_panel=_RIG
        ),
    ] = "motion",
    sensor_mode_file: Annotated[
        Path | None,
        typer.Option(
            "--sensor-mode",
            help="TOML file with the sensor mode, where it is not the IMX219's 1920 x 1080 crop.",
            exists=True,
            dir_okay=False,
            show_default=False,
            rich_help_panel=_RIG,
        ),
    ] = None,
    exposure_us: Annotated[
        int | None,
        typer.Option("--exposure-us", min=1, help="Exposure time.", show_default=False, rich_help_panel=_RIG),
    ] = None,
    exposures: Annotated[
        Path | None,
        typer.Option(
            "--exposures",
            help="Text file, one exposure time a picture, us, where they vary.",
            exists=True,
            dir_okay=False,
            show_default=False,
            rich_help_panel=_RIG,
        ),
    ] = None,
    line_time_us: Annotated[
        float | None,
        typer.Option(
            "--line-time-us",
            min=0,
            help="Time between two sensor rows; 0 for a global shutter.",
            show_default=False,
            rich_help_panel=_RIG,
        ),
    ] = None,
    first_sensor_timestamp_ns: Annotated[
        int | None,
        typer.Option(
            "--first-sensor-timestamp-ns",
            help="SensorTimestamp that belongs to stamp 0, CLOCK_MONOTONIC.",
            show_default=False,
            rich_help_panel=_RIG,
        ),
    ] = None,
    width: Annotated[
        int | None,
        typer.Option("--width", min=16, help="Of the picture, px.", show_default=False, rich_help_panel=_RIG),
    ] = None,
    height: Annotated[
        int | None,
        typer.Option(
            "--height", min=16, help="Of the picture, px.", show_default=False, rich_help_panel=_RIG
        ),
    ] = None,
    simulated: Annotated[
        bool | None,
        typer.Option(
            "--simulated/--real",
            help="Whether the pictures were computed; the rig file may say it too.",
            show_default=False,
        ),
    ] = None,
    timestamps_unit: Annotated[
        Literal["auto", "us", "ms"], typer.Option("--timestamps-unit", help="Unit of the stamps.")
    ] = "auto",
    imu_acc_range_g: Annotated[
        float,
        typer.Option("--imu-acc-range-g", min=0.1, help="Where it clips, g.", rich_help_panel=_IMU),
    ] = 16.0,
    imu_gyro_range_dps: Annotated[
        float,
        typer.Option("--imu-gyro-range-dps", min=1, help="Where it clips, deg/s.", rich_help_panel=_IMU),
    ] = 2000.0,
    allow_shorter: Annotated[
        bool,
        typer.Option(
            "--allow-shorter",
            help="Accept pictures or stamps too many at the end, if nothing says they are elsewhere.",
        ),
    ] = False,
    runs: Annotated[Path, typer.Option("-o", "--output", help="Folder of runs.")] = Path("runs"),
) -> None:
    """Make a run folder from a recording made by other means.

    The run's id is UNIT_LABEL. A video and stamps that differ in number are refused.

    For example:

        bricktrack import --video shake.mp4 --timestamps shake_pts.txt --imu imu.csv --edges edges.csv --rig rig.toml --rig-table motion --unit b1 --label shake-07 --real -o runs

        bricktrack import --video s.h264 --timestamps s.txt --exposure-us 4000 --line-time-us 18.9035 --first-sensor-timestamp-ns 0 --width 1920 --height 1080 --unit b1 --label s --real
    """  # noqa: E501
    from bricktrack_host.recordings.import_recording import Recording
    from bricktrack_host.recordings.import_recording import import_recording as make_run

    explicit = {
        "--exposure-us": exposure_us,
        "--line-time-us": line_time_us,
        "--first-sensor-timestamp-ns": first_sensor_timestamp_ns,
        "--width": width,
        "--height": height,
    }
    if rig is not None:
        given = [name for name, value in explicit.items() if value is not None]
        if given:
            raise ConfigError(
                f"{', '.join(given)}: the rig file {rig} says this already. Give one or the other"
            )
        loose = read_rig(rig, table=rig_table)
    else:
        if (
            exposure_us is None
            or line_time_us is None
            or first_sensor_timestamp_ns is None
            or width is None
            or height is None
        ):
            lacking = [name for name, value in explicit.items() if value is None]
            raise ConfigError(f"how the sensor was read is not known: give --rig, or {', '.join(lacking)}")
        mode = sensor_mode(width=width, height=height, line_time_us=line_time_us)
        loose = LooseRig(mode, exposure_us, first_sensor_timestamp_ns)
    if sensor_mode_file is not None:
        # The line time stays as the rig or the options say it: 0 for a picture without rolling shutter.
        full = load_toml(sensor_mode_file, SensorMode)
        full = msgspec.structs.replace(full, line_time_ns=loose.mode.line_time_ns)
        loose = dataclasses.replace(loose, mode=full)
    made = make_run(
        Recording(
            video=video,
            timestamps=timestamps,
            timestamps_unit=timestamps_unit,
            imus=_imu_files(imu or []),
            imu_acc_range_g=imu_acc_range_g,
            imu_gyro_range_dps=imu_gyro_range_dps,
            edges=edges,
            exposures=exposures,
            rig=loose,
            unit=unit,
            label=label,
            simulated=_is_simulated(simulated, loose, rig),
            allow_shorter=allow_shorter,
        ),
        runs,
    )
    for note in made.notes:
        err.print(f"  {note}", markup=False)
    quality = made.manifest.quality
    kind = "simulated" if made.manifest.simulated else "real"
    out.print(
        f"{made.folder}: {kind} run of {quality.frames} frames ({quality.frames_dropped} dropped), "
        f"{quality.imu_slots} inertial samples, {quality.edges} edges",
        markup=False,
        soft_wrap=True,
    )


def _is_simulated(option: bool | None, loose: LooseRig, rig: Path | None) -> bool:
    if option is not None and loose.simulated is not None and option != loose.simulated:
        raise ConfigError(f"--{'simulated' if option else 'real'}: the rig file {rig} says the opposite")
    known = loose.simulated if option is None else option
    if known is None:
        raise ConfigError("say --real or --simulated: results of computed pictures must be marked as such")
    return known


def _imu_files(options: list[str]) -> dict[str, Path]:
    files: dict[str, Path] = {}
    for text in options:
        name, equals, rest = text.partition("=")
        name, path = (name, Path(rest)) if equals else ("brick", Path(text))
        if name in files:
            raise ConfigError(
                f"--imu {text}: there is an inertial sensor {name!r} already. Give it as NAME=FILE"
            )
        files[name] = path
    return files
