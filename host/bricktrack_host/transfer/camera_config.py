"""``[unit.camera_imu]`` and ``[unit.camera_table]`` of a fleet file: what feels the camera's own motion."""

from typing import Annotated, Literal

import msgspec
import numpy as np

from bricktrack_common.errors import ConfigError
from bricktrack_common.run_manifest import RUN_ID_PATTERN

CameraMount = Literal["static", "imu", "table"]
AccelerationUnit = Literal["mps2", "g"]

_Vector = tuple[float, float, float]
_Matrix = tuple[_Vector, _Vector, _Vector]
_AXES: _Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class CameraImuEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[unit.camera_imu]``: an inertial sensor on the camera's component.

    Attributes
    ----------
    imu : str
        Its name in the runs.
    unit : str
        Whose runs hold it, where the camera rides on another unit's LED component; ``""``: the unit's own.
    to_camera_mm : (float, float, float), mm, camera axes
        From the sensor to the projection centre.
    rotation : 3 x 3
        Takes the sensor's axes to the camera's.
    """

    imu: Annotated[str, msgspec.Meta(min_length=1)] = "camera"
    unit: Annotated[str, msgspec.Meta(pattern=RUN_ID_PATTERN)] | Literal[""] = ""
    to_camera_mm: _Vector
    rotation: _Matrix = _AXES


class CameraTableEntry(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """``[unit.camera_table]``: the shaking table's accelerometers, of a camera that stands on the table.

    Attributes
    ----------
    columns : (str, str, str)
        Of the data acquisition's CSV file: acceleration along the table's x, y, z.
    measured_in : "mps2" or "g"
    rotation : 3 x 3
        Takes the table's axes to the camera's.
    """

    columns: tuple[str, str, str]
    measured_in: AccelerationUnit = "mps2"
    rotation: _Matrix = _AXES


def check_camera(
    camera: CameraMount, imu: CameraImuEntry | None, table: CameraTableEntry | None, *, where: str
) -> None:
    """Make sure that what is said of a unit's camera goes together.

    Raises
    ------
    ConfigError
        If a sensor is described for another kind of camera, a rotation is none, or a number is not finite.
    """
    for key, entry, kind in (("camera_imu", imu, "imu"), ("camera_table", table, "table")):
        if entry is None:
            continue
        if camera != kind:
            raise ConfigError(
                f'{where}.{key}: belongs to camera = "{kind}", and the unit has camera = "{camera}"'
            )
        R = np.array(entry.rotation)
        if not np.isfinite(R).all() or np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0:
            raise ConfigError(f"{where}.{key}.rotation: {R.tolist()} is not a rotation matrix")
    if imu is not None and not np.isfinite(imu.to_camera_mm).all():
        raise ConfigError(
            f"{where}.camera_imu.to_camera_mm: {imu.to_camera_mm}; expected three finite numbers"
        )
