"""How far a run's centroids lie from its first poses, frame by frame, with what is stated of their errors.

The poses are only places to linearise at: what is made of these errors leaves out, or fits anew, what a pose
explains.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.tracking.led_model.led_profile import collar_of, predict_brick
from bricktrack_host.tracking.pictures.light_kernel import FLOOR_SD_PX
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import FirstPoses
from bricktrack_host.tracking.pose.frame_motion import calm_frames, led_times_ns, motion_to_leds
from bricktrack_host.tracking.pose.refine import OWN_SHARE, LedMotion
from bricktrack_host.tracks import LedObservations

MIN_LEDS = 5
_MAX_FRAMES = 120


@dataclass(frozen=True, slots=True, eq=False)
class FrameErrors:
    """Errors of the centroids of n frames.

    Attributes
    ----------
    frames : ndarray of int64, shape (n,)
        Which of the run's they are.
    seen : ndarray of bool, shape (n, n_leds)
    error_px : ndarray, shape (n, n_leds, 2), px
        Seen less predicted; zero where not seen.
    J_px : ndarray, shape (n, n_leds, 2, 6)
        Of the prediction, by [dtheta rad, dt mm].
    own_px2 : ndarray, shape (n, n_leds, 2, 2), px^2
        Stated variance of each LED for itself: of its pixels, and of its own share of the profile's doubt.
    common_px : ndarray, shape (n, n_leds, 2, 7)
        One standard deviation of what all LEDs have in common: the profile's doubt and the twist's.
    """

    frames: IntArray
    seen: BoolArray
    error_px: FloatArray
    J_px: FloatArray
    own_px2: FloatArray
    common_px: FloatArray

    def of_leds(self, rows: IntArray, leds: BoolArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return errors, derivatives and stated covariance of some frames' LEDs.

        Shapes (k, m), (k, m, 6) and (k, m, m) for k frames and m coordinates, u and v of each LED by turns.
        """
        m = 2 * int(leds.sum())
        common = self.common_px[rows][:, leds].reshape(len(rows), m, 7)
        D = common @ np.swapaxes(common, 1, 2)
        for k in range(m // 2):
            D[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += self.own_px2[rows][:, leds][:, k]
        error, J = self.error_px[rows][:, leds], self.J_px[rows][:, leds]
        return error.reshape(len(rows), m), J.reshape(len(rows), m, 6), D


def floor_px2(cov_px2: FloatArray) -> FloatArray:
    """Return what of stated covariances of centroids, (..., 2, 2), is the segmentation's floor, (...); px^2.

    Centroids from elsewhere may be stated better than it: then nothing is left beside it.
    """
    return np.asarray(np.minimum(FLOOR_SD_PX**2, np.linalg.eigvalsh(cov_px2)[..., 0]))


def frame_errors(
    observations: LedObservations,
    first: FirstPoses,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    rolling_shutter: bool = True,
) -> FrameErrors:
    """Return the errors of the frames of a run whose motion is best known, of 120 at most.

    Parameters
    ----------
    observations : LedObservations
        With covariances as the segmentation states them: of the pixels, and `FLOOR_SD_PX`, left out here.
    first : FirstPoses
        Of the same observations.
    ray_model : RayModel
    brick_model : BrickModel
    rolling_shutter : bool
        False: the frames are taken for instants.
    """
    motion: LedMotion | None = None
    if rolling_shutter:
        t_ns, led_t_ns = led_times_ns(observations, ray_model)
        motion = motion_to_leds(t_ns, led_t_ns, first.R_camera_brick, first.t_camera_brick_mm)
    frames = calm_frames(first, motion, min_leds=MIN_LEDS, at_most=_MAX_FRAMES)
    seen = all_finite(first.uv_px[frames])
    n, n_leds = seen.shape
    R_led = np.repeat(first.R_camera_brick[frames, None], n_leds, axis=1)
    t_led = np.repeat(first.t_camera_brick_mm[frames, None], n_leds, axis=1)
    twist_dt = np.zeros((n, n_leds, 6))
    if motion is not None:
        R_led = R_led @ matrix_from_rvec(motion.rvec_brick_rad[frames])
        t_led = t_led + motion.shift_camera_mm[frames]
        if motion.twist_sd is not None:
            twist_dt = motion.dt_s[frames][..., None] * motion.twist_sd[frames][:, None]
    prediction, J = predict_brick(R_led, t_led, ray_model, brick_model, collar_mm=collar_of(brick_model))
    shift = prediction.model_shift_px
    stated = observations.cov_px2[frames]
    pixels = stated - floor_px2(stated)[..., None, None] * np.eye(2)
    return FrameErrors(
        frames=frames,
        seen=seen,
        error_px=np.where(seen[..., None], first.uv_px[frames] - prediction.uv_px, 0.0),
        J_px=J,
        own_px2=OWN_SHARE**2 * shift[..., :, None] * shift[..., None, :] + pixels,
        common_px=np.concatenate([shift[..., None], J * twist_dt[:, :, None, :]], axis=-1),
    )
