"""Whether what feels the motion of a moving camera fits the brick's sensor, and what is seen.

A wrong row in the fleet file, the camera's sensor turned by a quarter, would make the fused motion wrong by
centimetres where nothing is seen. Turned into the same axes both accelerometers differ by their biases, and
by gravity where a table's channels were zeroed before the shake. A turn about gravity does not show in that;
but then the frames believe neither sensor.
"""

import numpy as np

from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Run, first_linearisation
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel

_MOST_BETWEEN_BIASES_MPS2 = 3.0
"""The data sheet allows 0.8 m/s^2 in each axis of each sensor: 2 together. Axes 18 degrees off make 3."""

_NOT_BELIEVED = 6.0
"""Times the stated systematic error; a run may choose 6.25 at most, one whose sensors fit less than one."""


def require_agreement(run: Run, settings: FusionSettings) -> None:
    """Refuse a run whose two accelerometers do not agree about gravity.

    Raises
    ------
    TrackingError
    """
    if run.camera is None:
        return
    difference = float(np.linalg.norm(first_linearisation(run, settings).gravity_mps2))
    allowed = [0.0] if run.camera.kind == "imu" else [0.0, settings.gravity_mps2]
    if min(abs(difference - one) for one in allowed) <= _MOST_BETWEEN_BIASES_MPS2:
        return
    entry = "camera_imu" if run.camera.kind == "imu" else "camera_table"
    zeroed = "" if run.camera.kind == "imu" else f", or about {settings.gravity_mps2:.1f} if it was zeroed"
    raise TrackingError(
        f"turned into the same axes, the accelerometers of the moving camera and of the brick differ by "
        f"{difference:.1f} m/s²; expected less than {_MOST_BETWEEN_BIASES_MPS2:g}{zeroed}. Check `rotation` "
        f"in [unit.{entry}] of the fleet file and the axes of the IMU in the brick's layout file"
    )


def doubt_about_camera_sensor(gyro: NoiseLevel, acc: NoiseLevel) -> str | None:
    """Return what is to be said where a run believes its sensors as little as it may, else `None`."""
    if max(gyro.systematic, acc.systematic) < _NOT_BELIEVED:
        return None
    return (
        "what feels the camera's motion does not fit what the camera sees: the fused motion in dropouts is "
        "as unsure as it says. Check `rotation`, and the place, of the camera's sensor in the fleet file"
    )
