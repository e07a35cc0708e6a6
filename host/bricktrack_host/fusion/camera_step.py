"""Whether the camera was knocked within a run: attitudes step against the gyro, and stay.

The gyro on the brick feels every turn of the brick and none of the camera. A camera that gives way turns all
that it sees at once; so does an IMU that slips on the brick. What only shifts and does not turn is not told,
nor a step where LEDs come or go while some stand beside their places: poses step there too.
"""

import numpy as np

from bricktrack_host.fusion.clocks.offset_change import errors_of
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, has_pose
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracks import ImuTrack, OpticalTrack

_KNOCKED_CHI2 = 110.0
"""With 3 degrees of freedom. In 30 recordings by another renderer of cameras that stood still it was 71 at
most, from impacts and misplaced LEDs, and 157 and 237 where they were knocked by 0.17 and 0.40 degrees
(simulated). Of recorded inertial windows, with simulated cameras, it was 72 at most."""
_LEAST_DEG = 0.05
_BESIDE = 15  # frames on either side, whose LEDs must mostly be the same ones
_MUCH_OFF_PX = 0.1
"""That any LED is off on the mean: where one comes or goes, poses step."""


def words_on_camera_step(optical: OpticalTrack, imu: ImuTrack, alignment: TimeAlignment) -> list[str]:
    """Return a line on the camera's having been knocked, if it was.

    Parameters
    ----------
    optical : OpticalTrack
        Seen by a camera that is to stand still.
    imu : ImuTrack
        Of the brick.
    alignment : TimeAlignment
    """
    errors = errors_of(optical, imu, alignment)
    step = None if errors is None else errors.attitude_step()
    if step is None:
        return []
    frames = np.flatnonzero(has_pose(optical))
    size_deg = float(np.rad2deg(np.linalg.norm(step.rvec_rad)))
    if step.gain < _KNOCKED_CHI2 or size_deg < _LEAST_DEG:
        return []
    frame = int(frames[step.frame])
    used = all_finite(optical.residual_px)[frames]
    before, after = used[max(step.frame - _BESIDE, 0) : step.frame], used[step.frame : step.frame + _BESIDE]
    changes = np.abs(before.mean(axis=0) - after.mean(axis=0)) > 0.5
    seen = used.any(axis=0)
    off_px = np.linalg.norm(np.nanmean(optical.residual_px[:, seen], axis=0), axis=1)
    if changes.any() and off_px.max() > _MUCH_OFF_PX:
        return []
    at_s = (optical.t_ns[frame] - optical.t_ns[0]) * 1e-9
    sd_deg = float(np.rad2deg(np.sqrt(np.trace(step.covariance))))
    return [
        f"the camera was knocked, or the IMU slipped on the brick, at frame {frame} ({at_s:.2f} s after the "
        f"first): from there on attitudes are {size_deg:.2f} ± {sd_deg:.2f} deg beside the gyro's. "
        "Displacements from rest hold the knock from there on, its shift too. Fasten both and record again, "
        "or use the frames before it"
    ]
