"""By how much the camera's inertial sensor lags the brick's: the delay under which the frames are likeliest.

A tenth of a millisecond counts: at 0.3 g and 10 Hz the camera's acceleration changes by 0.02 m/s^2 in it. The
rotations tell the two offsets against the camera less well than that, and nothing where the camera's
component only shifts; accelerations tell it all, through the filter's likelihood.
"""

from dataclasses import replace

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Run
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraMotion
from bricktrack_host.fusion.pose_by_pose.noise_choice import frames_log_likelihood
from bricktrack_host.tracks import ImuTrack, OpticalTrack

_UNKNOWN_S = 0.016  # a whole sample's age either way, and the lag of a gyro
_STEPS_S = (2e-3, 5e-4, 1.5e-4)
_SIDE = 4


def settle_delay(
    optical: OpticalTrack,
    imu: ImuTrack,
    alignment: TimeAlignment,
    motion: CameraMotion,
    *,
    lever_arm_mm: FloatArray,
    settings: FusionSettings,
    is_near: bool,
) -> CameraMotion:
    """Return the camera's motion with the delay between both sensors as the frames have it.

    Parameters
    ----------
    optical : OpticalTrack
    imu : ImuTrack
        The brick's, by its own sample clock.
    alignment : TimeAlignment
        Of the brick's.
    motion : CameraMotion
        With the delay to begin at.
    lever_arm_mm : ndarray, shape (3,), mm, brick axes
    is_near : bool
        Whether the delay to begin at is good to a millisecond or two.
    """

    def log_likelihood(delay_s: float) -> float:
        run = Run.from_tracks(
            optical, imu, alignment, lever_arm_mm=lever_arm_mm,
            output_t_ns=optical.t_ns[:0], camera=replace(motion, delay_s=delay_s),
        )  # fmt: skip
        return frames_log_likelihood(run, settings)

    best = motion.delay_s
    for i, step in enumerate(_STEPS_S[1:] if is_near else _STEPS_S):
        n = _SIDE if i or is_near else round(_UNKNOWN_S / step)
        tried = best + step * np.arange(-n, n + 1)
        score = np.array([log_likelihood(float(delay)) for delay in tried])
        top = int(np.clip(np.argmax(score), 1, len(tried) - 2))
        before, at, after = score[top - 1 : top + 2]
        bend = before - 2 * at + after
        best = float(tried[top] + (0.5 * step * (before - after) / bend if bend < 0 else 0.0))
    return replace(motion, delay_s=best)
