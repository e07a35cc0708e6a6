"""The calibration file: a fitted ray model with all that is needed to trust it, as versioned JSON text.

It says which unit and sensor mode it belongs to, from which pictures (with their SHA-256), target and planes
it was made, how, when and by which version, what the fit left, how well it predicts left-out dots, where
dots were, and the covariance of its coefficients.
"""

from dataclasses import replace
from datetime import UTC, datetime
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from bricktrack_common.camera_model import SensorMode
from bricktrack_common.errors import CalibrationError
from bricktrack_common.typed_data import convert, dump_json, load_json
from bricktrack_host.calibration.calibration_file_v1 import upgraded_from_v1
from bricktrack_host.calibration.ray_records import CentralRaysRecord, TwoPlaneRecord, model_of, record_of
from bricktrack_host.calibration.rays.central_rays import CentralRays
from bricktrack_host.calibration.rays.fit_residuals import PlaneResiduals
from bricktrack_host.calibration.rays.irt import TwoPlaneIrt
from bricktrack_host.calibration.rays.ray_calibration import ModelChoice, RayCalibration
from bricktrack_host.calibration.rays.ray_fit import PlaneNoise
from bricktrack_host.calibration.rays.rig_tolerance import RigTolerance, RigUnknown

FORMAT = "bricktrack-calibration"
VERSION = 2
"""2: walking pupil, covariance between the planes and with misfit, noise and rig. 1 is still read."""

Millimetres = Annotated[float, msgspec.Meta(gt=0)]


class TargetImage(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One target picture: file name, hash, depth of its plane, dots found, and left out as contradicting."""

    name: str
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]
    z_mm: Millimetres
    n_dots_found: int
    n_dots_left_out: int


class Target(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The dot target: its size, pitch and dot diameter (as used for the disc correction)."""

    columns: Annotated[int, msgspec.Meta(ge=2)]
    rows: Annotated[int, msgspec.Meta(ge=2)]
    pitch_mm: Millimetres
    dot_diameter_mm: Millimetres


class Calibration(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, dict=True, omit_defaults=False
):
    """One camera's calibration.

    Attributes
    ----------
    format, version
        What the file is; readers refuse newer versions.
    unit : str
        Name of the brick unit.
    sensor_mode : SensorMode
        The only mode that it holds for.
    focus_note : str
        How the lens stood; a turned lens needs a new calibration.
    created_utc : datetime
    software : str
        Name and version of what made it.
    method : str
        How the dots were measured and the model fitted, in words.
    simulated : bool
        Made from simulated pictures.
    target : Target
    images : tuple of TargetImage
    plane_a_mm, plane_b_mm : float, mm
    choice : ModelChoice
        The model taken, why, and the cross-validated errors of the candidates.
    residuals : tuple of PlaneResiduals
    noise : tuple of PlaneNoise
        How the dots of each plane scatter about the rays; none in files of version 1.
    tolerance : RigTolerance
        How well the planes were said to be known.
    rig : tuple of RigUnknown
        What was found of the planes' shifts and turns and of the board's bend, within that tolerance.
    rays : CentralRaysRecord or TwoPlaneRecord
    """

    format: str = FORMAT
    version: int = VERSION
    unit: Annotated[str, msgspec.Meta(min_length=1)]
    sensor_mode: SensorMode
    focus_note: str = ""
    created_utc: Annotated[datetime, msgspec.Meta(tz=True)]
    software: str
    method: str
    simulated: bool = False
    target: Target
    images: tuple[TargetImage, ...]
    plane_a_mm: Millimetres
    plane_b_mm: Millimetres
    choice: ModelChoice
    residuals: tuple[PlaneResiduals, ...]
    noise: tuple[PlaneNoise, ...] = ()
    tolerance: RigTolerance = RigTolerance()
    rig: tuple[RigUnknown, ...] = ()
    rays: CentralRaysRecord | TwoPlaneRecord

    @cached_property
    def ray_model(self) -> CentralRays | TwoPlaneIrt:
        """The calibrated rays; a `bricktrack_common.camera_model.RayModel`."""
        return model_of(
            self.rays,
            sensor_mode=self.sensor_mode,
            plane_a_mm=self.plane_a_mm,
            plane_b_mm=self.plane_b_mm,
            residuals=self.residuals,
        )


def make_calibration(
    fitted: RayCalibration,
    *,
    unit: str,
    target: Target,
    images: tuple[TargetImage, ...],
    focus_note: str = "",
    simulated: bool = False,
    created_utc: datetime | None = None,
) -> Calibration:
    """Return what is to be saved of a fitted ray model.

    Parameters
    ----------
    fitted : RayCalibration
    unit : str
    target : Target
    images : tuple of TargetImage
    focus_note : str, optional
    simulated : bool, optional
    created_utc : datetime, optional
        With its time zone; now where not given.
    """
    model = fitted.model
    how = "two-plane incident-ray tracking"
    if isinstance(model, CentralRays):
        how = "central rays with a walking pupil" if model.walks else "central rays"
    how += f", {'degrees held by the dots up to' if fitted.choice.held else 'order'} {model.order}"
    return Calibration(
        unit=unit,
        sensor_mode=model.sensor_mode,
        focus_note=focus_note,
        created_utc=(created_utc or datetime.now(UTC)).astimezone(UTC),
        software=f"bricktrack {metadata.version('bricktrack')}",
        method="light-weighted dot centroids, weighted by their covariances, corrected for the discs' "
        f"distortion; {how}",
        simulated=simulated,
        target=target,
        images=images,
        plane_a_mm=model.plane_a_mm,
        plane_b_mm=model.plane_b_mm,
        choice=fitted.choice,
        residuals=model.residuals,
        noise=fitted.fit.noise,
        tolerance=fitted.tolerance,
        rig=fitted.fit.rig,
        rays=record_of(model),
    )


def save_calibration(path: Path, calibration: Calibration) -> None:
    """Write a calibration as JSON text.

    Raises
    ------
    CalibrationError
        If the file cannot be written.
    """
    try:
        path.write_bytes(dump_json(calibration))
    except OSError as e:
        raise CalibrationError(f"{path}: {e.strerror or e}") from e


def load_calibration(path: Path) -> Calibration:
    """Read a calibration.

    Raises
    ------
    CalibrationError
        If the file is missing, is not a calibration, is of a newer version, or contradicts itself.
    """
    data = load_json(path, dict[str, Any], error=CalibrationError)
    if data.get("format") != FORMAT:
        raise CalibrationError(
            f"{path}: format is {data.get('format')!r}; expected {FORMAT!r}, a file that "
            "'bricktrack calibrate fit' wrote"
        )
    version = data.get("version")
    if not isinstance(version, int) or version < 1:
        raise CalibrationError(f"{path}: version is {version!r}; expected a whole number from 1 to {VERSION}")
    if version > VERSION:
        raise CalibrationError(
            f"{path}: calibration version {version} is newer than {VERSION}, the newest that this bricktrack "
            f"{metadata.version('bricktrack')} reads; update bricktrack, or calibrate again with this one"
        )
    if version == 1:
        data = upgraded_from_v1(data, where=str(path))
    calibration = convert(data, Calibration, where=str(path), error=CalibrationError)
    try:
        _check_rays(calibration)
    except CalibrationError as e:
        raise CalibrationError(f"{path}: {e}") from e
    return calibration


def _check_rays(calibration: Calibration) -> None:
    """Refuse rays that do not open towards the far plane, or do not lead back to their pixels."""
    a_mm, b_mm = calibration.plane_a_mm, calibration.plane_b_mm
    if not 0 < a_mm < b_mm:
        raise CalibrationError(f"planes at {a_mm:g} and {b_mm:g} mm: expected 0 < a < b")
    model = calibration.ray_model
    middle = np.array([calibration.sensor_mode.width - 1, calibration.sensor_mode.height - 1]) / 2
    uv = middle + middle / 4 * np.array([[-1.0, -1.0], [1.0, 1.0]])
    at_a, at_b = model.points_on_plane(uv, a_mm), model.points_on_plane(uv, b_mm)
    # u grows along x and v along y, at either plane, and more so farther away.
    opens = np.all((at_a[1] - at_a[0] > 0) & (at_b[1] - at_b[0] > at_a[1] - at_a[0]))
    if not opens or not np.allclose(
        model.project(np.column_stack([at_b, [b_mm, b_mm]])).uv_px, uv, rtol=0, atol=1e-6
    ):
        raise CalibrationError("the rays do not lead back to their pixels: the coefficients are damaged")


def require_match(calibration: Calibration, *, unit: str | None, sensor_mode: SensorMode) -> None:
    """Refuse a calibration that belongs to another unit or sensor mode.

    Parameters
    ----------
    calibration : Calibration
    unit : str or None
        The unit that recorded; None where it is not known.
    sensor_mode : SensorMode
        The mode that it recorded in.

    Raises
    ------
    CalibrationError
        Naming both units, or both modes.
    """
    if unit is not None and unit != calibration.unit:
        raise CalibrationError(
            f"the calibration is of unit {calibration.unit!r}, the recording of unit {unit!r}; every camera "
            "needs its own calibration"
        )
    if not calibration.sensor_mode.matches(sensor_mode):
        raise CalibrationError(
            f"the calibration is for sensor mode {_describe(calibration.sensor_mode)}, the recording was "
            f"made in {_describe(sensor_mode)}; calibrate in the mode that is recorded"
        )


def rays_of_recording(
    calibration: Calibration, *, unit: str | None, sensor_mode: SensorMode
) -> CentralRays | TwoPlaneIrt:
    """Return the calibrated rays for a recording, its rows read as fast as it says.

    The same field may be read out faster or slower, or all rows at once: the line time is the recording's.

    Raises
    ------
    CalibrationError
        As `require_match`.
    """
    require_match(calibration, unit=unit, sensor_mode=sensor_mode)
    return replace(calibration.ray_model, sensor_mode=sensor_mode)


def _describe(mode: SensorMode) -> str:
    return (
        f"{mode.name!r} ({mode.width} x {mode.height}, crop {mode.crop_width} x {mode.crop_height} at "
        f"({mode.crop_x}, {mode.crop_y}), binning {mode.binning}, rows {mode.row_order})"
    )
