"""How a brick whose LEDs are being identified moves within a frame: not known at all, or by its run.

A rolling shutter reads a shaken brick's LEDs up to 10 ms apart: 3 mm, an LED's own size. What is not known of
that motion is left to the fit of each frame, as far as it may be.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.tracking.led_model.led_profile import predict_brick
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.frame_motion import UNKNOWN_TWIST_SD, motion_to_leds
from bricktrack_host.tracking.pose.neighbour_poses import poses_between
from bricktrack_host.tracking.pose.refine import LedMotion


@dataclass(frozen=True, slots=True, eq=False)
class RunMotion:
    """A run's motion by splines over its frames.

    Attributes
    ----------
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
        The poses given, and between them those of their spline; NaN where there is neither.
    within : LedMotion
        Of all n frames.
    """

    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    within: LedMotion


def unknown_motion(uv_px: FloatArray, ray_model: RayModel) -> LedMotion:
    """Return what is known within frames of which nothing else is: that a brick is shaken so fast at most."""
    n, n_leds = uv_px.shape[:2]
    mode = ray_model.sensor_mode
    middle = 0.5 * (mode.height - 1)
    v = np.where(np.isfinite(uv_px[..., 1]), uv_px[..., 1], middle)
    return LedMotion(
        rvec_brick_rad=np.zeros((n, n_leds, 3)),
        shift_camera_mm=np.zeros((n, n_leds, 3)),
        dt_s=(mode.row_delay_ns(v) - float(mode.row_delay_ns(middle))) * 1e-9,
        twist_sd=np.tile(UNKNOWN_TWIST_SD, (n, 1)),
    )


def run_motion(
    stamps_ns: IntArray,
    uv_px: FloatArray,
    R_camera_brick: FloatArray,
    t_camera_brick_mm: FloatArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
) -> RunMotion:
    """Return the motion of a run whose frames have poses at their middle rows' instants, or NaN.

    Parameters
    ----------
    stamps_ns : ndarray of int64, shape (n,)
    uv_px : ndarray, shape (n, n_leds, 2), px
        The LEDs' lights; NaN: the rows are those where the pose shows them.
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)
    """
    mode = ray_model.sensor_mode
    has = all_finite(R_camera_brick, 2) & all_finite(t_camera_brick_mm)
    between = poses_between(stamps_ns, R_camera_brick, t_camera_brick_mm)
    R = np.where(has[:, None, None], R_camera_brick, between[0])
    t = np.where(has[:, None], t_camera_brick_mm, between[1])
    known = np.flatnonzero(all_finite(R, 2))
    v = uv_px[..., 1].copy()
    unseen = known[~np.isfinite(v[known]).all(axis=1)]
    shown, _ = predict_brick(R[unseen], t[unseen], ray_model, brick_model, collar_mm=collar_mm)
    v[unseen] = np.where(np.isfinite(v[unseen]), v[unseen], shown.uv_px[..., 1])
    v = np.clip(np.where(np.isfinite(v), v, 0.5 * (mode.height - 1)), 0, mode.height - 1)
    centre_ns = stamps_ns + int(np.rint(float(mode.row_delay_ns(0.5 * (mode.height - 1)))))
    within = motion_to_leds(
        centre_ns, stamps_ns[:, None] + np.rint(mode.row_delay_ns(v)).astype(np.int64), R, t
    )
    return RunMotion(R, t, within)


def places_px(
    motion: RunMotion,
    frames: IntArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
) -> FloatArray:
    """Return where frames that have poses show the LEDs, (m, n_leds, 2), px; NaN where they face away.

    Each LED at its own row's instant.
    """
    R_led = motion.R_camera_brick[frames][:, None] @ matrix_from_rvec(motion.within.rvec_brick_rad[frames])
    t_led_mm = motion.t_camera_brick_mm[frames][:, None] + motion.within.shift_camera_mm[frames]
    moved, _ = predict_brick(R_led, t_led_mm, ray_model, brick_model, collar_mm=collar_mm)
    return np.where(moved.facing[..., None] > 0, moved.uv_px, np.nan)
