"""What to calibrate from: a rig file, a folder of captured pictures, or options; all become one `FitJob`."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec

from bricktrack_common.camera_model import IMX219_1080P, SensorMode
from bricktrack_common.errors import CalibrationError, ConfigError
from bricktrack_common.typed_data import load_toml
from bricktrack_host.calibration.capture_file import CAPTURE_FILE, Capture, load_capture
from bricktrack_host.calibration.dots.dot_detection import Polarity
from bricktrack_host.calibration.dots.dot_grid import GridOrigin
from bricktrack_host.calibration.dots.plane_pictures import PlanePicture, observe_pictures
from bricktrack_host.calibration.target.printed_target import DotTarget, load_target
from bricktrack_host.cli._progress import counting_bar


class TargetTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A ``[[calibration.target]]``: counts of the whole target and its pictures, nearest plane first."""

    name: str
    columns: Annotated[int, msgspec.Meta(ge=2)]
    rows: Annotated[int, msgspec.Meta(ge=2)]
    images: tuple[str, str]


class CalibrationTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ``[calibration]`` table of a rig file."""

    plane_a_mm: Annotated[float, msgspec.Meta(gt=0)]
    plane_b_mm: Annotated[float, msgspec.Meta(gt=0)]
    pitch_mm: Annotated[float, msgspec.Meta(gt=0)]
    origin_near_px: tuple[float, float]
    target: Annotated[tuple[TargetTable, ...], msgspec.Meta(min_length=1)]
    origin_at: Literal["centre", "dot"] = "centre"
    dot_diameter_mm: Annotated[float, msgspec.Meta(gt=0)] | None = None


class SensorTable(msgspec.Struct, frozen=True):
    """What calibration needs of the ``[sensor]`` table; the rest of it belongs to others."""

    width: int
    height: int
    line_time_us: Annotated[float, msgspec.Meta(ge=0)]


class RigFile(msgspec.Struct, frozen=True):
    """What calibration needs of a rig file; its other tables belong to others."""

    calibration: CalibrationTable
    sensor: SensorTable | None = None
    simulated: bool = False


class FitJob(msgspec.Struct, frozen=True, kw_only=True):
    """What to calibrate from, whichever way it was said.

    Attributes
    ----------
    pictures : tuple of (float, Path)
        Depth, mm, and file; several of one depth are shifted boards.
    target : DotTarget
    origin : GridOrigin or None
        Of a plain target.
    polarity : "auto", "white-on-black" or "black-on-white"
    dot_diameter_mm : float or None, mm
        Of the (small) dots; measured where not known.
    unit : str or None
        Where the pictures say it.
    mode : SensorMode or None
        Likewise.
    size, line_time_us
        What a rig file says of the sensor.
    simulated : bool
    """

    pictures: tuple[tuple[float, Path], ...]
    target: DotTarget
    origin: GridOrigin | None
    polarity: Polarity = "auto"
    dot_diameter_mm: float | None = None
    unit: str | None = None
    mode: SensorMode | None = None
    line_time_us: float | None = None
    size: tuple[int, int] | None = None
    simulated: bool = False


def plain_target(*, columns: int, rows: int, pitch_mm: float, diameter_mm: float | None = None) -> DotTarget:
    """Return a target of equal dots; half the pitch stands for a diameter that is not known."""
    if not (pitch_mm > 0 and columns >= 2 and rows >= 2):
        raise CalibrationError(
            f"target of {columns} x {rows} dots at {pitch_mm:g} mm: expected two or more columns and rows "
            "and a positive pitch"
        )
    return DotTarget(
        columns=columns, rows=rows, pitch_mm=pitch_mm, diameter_mm=diameter_mm or pitch_mm / 2, coded=False
    )


def job_of_rig(rig: Path, target: str | None, images_dir: Path | None) -> FitJob:
    """Return the job that a rig file describes."""
    data = load_toml(rig, RigFile)
    c = data.calibration
    names = ", ".join(t.name for t in c.target)
    if target is None and len(c.target) > 1:
        raise ConfigError(f"{rig}: calibration.target: several targets ({names}); choose one with --target")
    found = [t for t in c.target if target in (None, t.name)]
    if len(found) != 1:
        raise ConfigError(f"{rig}: calibration.target: {len(found)} named {target!r}; the file has {names}")
    folder = rig.parent if images_dir is None else images_dir
    a, b = found[0].images
    return FitJob(
        pictures=((c.plane_a_mm, folder / a), (c.plane_b_mm, folder / b)),
        target=plain_target(
            columns=found[0].columns,
            rows=found[0].rows,
            pitch_mm=c.pitch_mm,
            diameter_mm=c.dot_diameter_mm,
        ),
        origin=GridOrigin(c.origin_near_px, c.origin_at),
        dot_diameter_mm=c.dot_diameter_mm,
        line_time_us=data.sensor.line_time_us if data.sensor else None,
        size=(data.sensor.width, data.sensor.height) if data.sensor else None,
        simulated=data.simulated,
    )


def job_of_capture(folder: Path) -> FitJob:
    """Return the job that a folder of captured pictures describes."""
    capture = load_capture(folder)
    if not capture.picture:
        raise CalibrationError(f"{folder / CAPTURE_FILE}: no pictures yet; take them with calibrate capture")
    return FitJob(
        pictures=tuple((p.z_mm, folder / p.file) for p in capture.picture),
        target=capture.target,
        origin=origin_of(capture),
        polarity=capture.target.polarity,
        dot_diameter_mm=capture.target.diameter_mm,
        unit=capture.unit,
        mode=capture.sensor_mode,
        simulated=capture.simulated,
    )


def origin_of(capture: Capture) -> GridOrigin | None:
    """Return the origin that was nominated for captured pictures of a plain target."""
    if capture.origin_near_px is None:
        return None
    return GridOrigin(capture.origin_near_px, capture.origin_at)


def job_of_pictures(board: Path, pictures: list[str], origin: GridOrigin | None) -> FitJob:
    """Return the job of a target file and pictures given as Z_MM=FILE."""
    target = load_target(board)
    return FitJob(
        pictures=tuple(depth_and_file(p) for p in pictures),
        target=target,
        origin=origin,
        polarity=target.polarity,
        dot_diameter_mm=target.diameter_mm,
    )


def depth_and_file(text: str) -> tuple[float, Path]:
    """Return what ``101.117=near.png`` says.

    Raises
    ------
    ConfigError
        If it is not a positive number, an equals sign and a file.
    """
    depth, equals, file = text.partition("=")
    try:
        z_mm = float(depth)
    except ValueError:
        z_mm = -1.0
    if not (equals and file and 0 < z_mm < float("inf")):
        raise ConfigError(f"{text!r}: expected the depth in mm and the file, as 101.117=near.png")
    return z_mm, Path(file)


def observe_job(job: FitJob, mode: SensorMode) -> tuple[PlanePicture, ...]:
    """Measure a job's pictures, with a progress bar.

    Raises
    ------
    CalibrationError
        If fewer than two depths are given, a picture is not of the mode's size, or shows no target.
    """
    depths = sorted({z for z, _ in job.pictures})
    if len(depths) < 2 or depths[0] <= 0:
        listed = ", ".join(f"{z:g}" for z in depths)
        raise CalibrationError(f"planes at {listed} mm: expected 0 < a < b, two or more depths")
    with counting_bar("dots", len(job.pictures)) as progress:
        return observe_pictures(
            job.pictures,
            job.target,
            origin=job.origin,
            polarity=job.polarity,
            mode=mode,
            progress=progress,
        )


def default_mode(job: FitJob) -> SensorMode:
    """Return the job's mode, or the IMX219's 1080p crop with the rig's line time.

    Raises
    ------
    ConfigError
        If the rig's pictures have another size.
    """
    if job.mode is not None:
        return job.mode
    mode = IMX219_1080P
    if job.size not in (None, (mode.width, mode.height)):
        raise ConfigError(
            f"the rig's sensor delivers {job.size}, not the {mode.width} x {mode.height} of the IMX219's "
            "crop; say which sensor mode it is with --sensor-mode"
        )
    if job.line_time_us is None:
        return mode
    return msgspec.structs.replace(mode, line_time_ns=1e3 * job.line_time_us)
