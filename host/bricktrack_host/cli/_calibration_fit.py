"""What ``bricktrack calibrate fit`` does once its options are read: measure, fit, save and report."""

import hashlib
from pathlib import Path
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from bricktrack_common.camera_model import IMX219_1080P, SensorMode
from bricktrack_common.errors import CalibrationError, ConfigError
from bricktrack_common.typed_data import load_toml
from bricktrack_host.calibration.calibration_file import (
    Target,
    TargetImage,
    make_calibration,
    save_calibration,
)
from bricktrack_host.calibration.dot_detection import GreyImage, detect_dots
from bricktrack_host.calibration.dot_grid import GridOrigin, assign_grid
from bricktrack_host.calibration.ray_calibration import ModelWish, RayCalibration, calibrate_rays

WARN_BELOW_COVERED = 0.8
"""Whole dots that fill the picture surround some 85 % of it: up to a pitch is lost all round."""


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
    """What to calibrate from, whichever way it was said."""

    planes: tuple[tuple[float, Path], tuple[float, Path]]
    columns: int
    rows: int
    pitch_mm: float
    dot_diameter_mm: float | None
    origin: GridOrigin
    line_time_us: float | None = None
    size: tuple[int, int] | None = None
    simulated: bool = False


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
        planes=((c.plane_a_mm, folder / a), (c.plane_b_mm, folder / b)),
        columns=found[0].columns,
        rows=found[0].rows,
        pitch_mm=c.pitch_mm,
        dot_diameter_mm=c.dot_diameter_mm,
        origin=GridOrigin(c.origin_near_px, c.origin_at),
        line_time_us=data.sensor.line_time_us if data.sensor else None,
        size=(data.sensor.width, data.sensor.height) if data.sensor else None,
        simulated=data.simulated,
    )


def run_fit(
    job: FitJob,
    *,
    mode: SensorMode,
    model: ModelWish,
    order: int | None,
    unit: str,
    focus_note: str,
    output: Path,
) -> None:
    """Measure, fit, save and report."""
    (a_mm, _), (b_mm, _) = job.planes
    if not 0 < a_mm < b_mm:
        raise CalibrationError(f"planes at a = {a_mm:g} mm and b = {b_mm:g} mm: expected 0 < a < b")
    planes, images = [], []
    for z_mm, path in job.planes:
        grey, sha256 = read_grey(path)
        height, width = grey.shape
        if (mode.width, mode.height) != (width, height):
            raise CalibrationError(
                f"{path}: {width} x {height} px; sensor mode {mode.name!r} delivers {mode.width} x "
                f"{mode.height}. Say which mode it is with --sensor-mode"
            )
        try:
            found = assign_grid(
                detect_dots(grey),
                pitch_mm=job.pitch_mm,
                columns=job.columns,
                rows=job.rows,
                origin=job.origin,
            )
        except CalibrationError as e:
            raise CalibrationError(f"{path}: {e}") from e
        planes.append((z_mm, found))
        images.append((path.name, sha256, z_mm, len(found)))
    fitted = calibrate_rays(
        planes, sensor_mode=mode, model=model, order=order, dot_diameter_mm=job.dot_diameter_mm
    )
    calibration = make_calibration(
        fitted,
        unit=unit,
        target=Target(
            columns=job.columns,
            rows=job.rows,
            pitch_mm=job.pitch_mm,
            dot_diameter_mm=fitted.dot_diameter_mm,
        ),
        images=tuple(
            TargetImage(name=name, sha256=sha256, z_mm=z, n_dots_found=n, n_dots_left_out=out)
            for (name, sha256, z, n), out in zip(images, fitted.n_left_out, strict=True)
        ),
        focus_note=focus_note,
        simulated=job.simulated,
    )
    save_calibration(output, calibration)
    _report(fitted, names=[image[0] for image in images], simulated=job.simulated)
    Console().print(f"Calibration of unit {unit} in mode {mode.name} written to {output}")


def read_grey(path: Path) -> tuple[GreyImage, str]:
    """Return a picture's grey levels and the SHA-256 of its file.

    Raises
    ------
    CalibrationError
        If the file cannot be read or is not a picture.
    """
    try:
        data = path.read_bytes()
    except OSError as e:
        raise CalibrationError(f"{path}: {e.strerror or e}") from e
    grey = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if data else None
    if grey is None:
        raise CalibrationError(f"{path}: not a picture that can be read; expected PNG, JPEG or TIFF")
    return np.asarray(grey, dtype=np.uint8), hashlib.sha256(data).hexdigest()


def default_mode(job: FitJob) -> SensorMode:
    """Return the IMX219's 1080p crop, with the rig's line time; refuse a rig of another picture size."""
    mode = IMX219_1080P
    if job.size not in (None, (mode.width, mode.height)):
        raise ConfigError(
            f"the rig's sensor delivers {job.size}, not the {mode.width} x {mode.height} of the IMX219's "
            "crop; say which sensor mode it is with --sensor-mode"
        )
    if job.line_time_us is None:
        return mode
    return msgspec.structs.replace(mode, line_time_ns=1e3 * job.line_time_us)


def _report(fitted: RayCalibration, *, names: list[str], simulated: bool) -> None:
    """Print what was found and how good it is."""
    console = Console()
    model, choice = fitted.model, fitted.choice
    mode = model.sensor_mode
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64 * mode.width, (np.arange(36) + 0.5) / 36 * mode.height)
    everywhere = np.stack([u.ravel(), v.ravel()], axis=1) - 0.5
    covered = model.is_covered(everywhere)

    table = Table(title="Calibration" + (" (simulated pictures)" if simulated else ""))
    table.add_column("")
    for letter, name in zip("AB", names, strict=True):
        table.add_column(f"plane {letter}: {name}", justify="right")
    rs = model.residuals
    sd_um = [1e3 * model.point_sd_mm(everywhere, r.z_mm) for r in rs]
    table.add_row("depth, mm", *(f"{r.z_mm:.3f}" for r in rs))
    table.add_row("dots used", *(str(r.n_dots) for r in rs))
    table.add_row("dots left out", *(str(n) for n in fitted.n_left_out))
    table.add_row("mean residual, um", *(f"{r.mean_um:.2f}" for r in rs))
    table.add_row("rms residual, um", *(f"{r.rms_um:.2f}" for r in rs))
    table.add_row("max residual, um", *(f"{r.max_um:.2f}" for r in rs))
    table.add_row(
        "noise of the fit where dots are, um, at most", *(f"{sd[covered].max():.2f}" for sd in sd_um)
    )
    table.add_row("... over the whole picture, um, at most", *(f"{sd.max():.2f}" for sd in sd_um))
    console.print(table)

    candidates = Table(title="Error at dots left out of the fit")
    for heading in ("model", "order", "rms um", "max um", "noise over the picture um", ""):
        candidates.add_column(heading, justify="left" if heading in ("model", "") else "right")
    for c in choice.candidates:
        taken = (c.model, c.order) == (choice.model, choice.order)
        candidates.add_row(
            c.model,
            str(c.order),
            f"{c.rms_um:.2f}",
            f"{c.max_um:.2f}",
            f"{c.picture_noise_um:.2f}",
            "taken" if taken else "",
        )
    console.print(candidates)
    console.print(f"Model: {choice.reason}")
    share = float(np.mean(covered))
    both = " at both planes" if choice.model == "two-plane" else ""
    console.print(f"Dots surround {share:.0%} of the picture{both}.")
    if share < WARN_BELOW_COVERED:
        console.print(
            "Warning: rays outside are extrapolated. Take a larger target, or bring the planes nearer.",
            style="yellow",
        )
