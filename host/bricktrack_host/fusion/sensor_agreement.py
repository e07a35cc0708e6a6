"""Whether the sensors of a moving camera and of the brick feel one and the same gravity.

A wrong row in the fleet file, the camera's sensor turned by a quarter, would make the fused motion wrong by
centimetres where nothing is seen. Turned into the same axes both accelerometers differ by their biases, and
by gravity where a table's channels were zeroed before the shake.
"""

import numpy as np

from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Run, first_linearisation

_MOST_BETWEEN_BIASES_MPS2 = 3.0
"""The data sheet allows 0.8 m/s^2 in each axis of each sensor: 2 together. Axes 18 degrees off make 3."""


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
        f"{difference:.1f} m/s^2; expected less than {_MOST_BETWEEN_BIASES_MPS2:g}{zeroed}. Check `rotation` "
        f"in [unit.{entry}] of the fleet file and the axes of the IMU in the brick's layout file"
    )
