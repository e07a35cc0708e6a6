"""What can be chosen about the processing of a run."""

from typing import Literal

import msgspec

from bricktrack_host.results.result_store import Details
from bricktrack_host.stages.camera_sensor import CameraSensor
from bricktrack_host.transfer.camera_config import CameraMount


class ProcessSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What can be chosen about the processing of a run; stored with its results.

    Attributes
    ----------
    segmentation : "default" or "paper"
        Grey-weighted sub-pixel centroids, or the paper's thresholds, plain means and rules of identity.
    prsoi_form : "safe" or "printed"
        The form that is defined for every layout, or the paper's equations 6 and 20 as printed.
    rolling_shutter : bool
        Whether each LED is taken at the time of its own row.
    imu : str or None
        Name of the inertial sensor on the LED component; `None`: the run's first.
    use_imu : bool
        False: smooth the optical poses alone.
    camera : "static", "imu" or "table"
        What the camera moves with.
    camera_sensor : CameraSensor or None
        What feels that motion. A camera that moves without it: the poses are smoothed alone, for one sensor
        on the LED component cannot tell the camera's acceleration from the brick's.
    max_clock_offset_s : float
        How far apart the stamps of camera and IMU may be: recordings made elsewhere have clocks of their own.
    """

    segmentation: Literal["default", "paper"] = "default"
    prsoi_form: Literal["safe", "printed"] = "safe"
    rolling_shutter: bool = True
    imu: str | None = None
    use_imu: bool = True
    camera: CameraMount = "static"
    camera_sensor: CameraSensor | None = None
    max_clock_offset_s: float = 0.25

    def facts(self) -> Details:
        """Return the settings by name, as results store them: those of the camera's sensor one by one."""
        facts = msgspec.to_builtins(self)
        sensor = facts.pop("camera_sensor") or {}
        for name, value in sensor.items():
            if value not in ("", None):
                rows = [x for row in value for x in row] if name == "rotation" else value
                facts[f"camera_sensor_{name}"] = rows
        return dict(facts)
