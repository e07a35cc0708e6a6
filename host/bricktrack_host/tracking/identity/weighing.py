"""What speaks for assignments of lights to LEDs whose poses were fitted: see `evidence`."""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import matrix_from_rvec, skew
from bricktrack_host.tracking.identity.assigned_lights import MIN_INLIERS, LedLights
from bricktrack_host.tracking.identity.evidence import Evidence, Given, Shown, evidence_of
from bricktrack_host.tracking.identity.identity_motion import unknown_motion
from bricktrack_host.tracking.led_model.led_profile import predict_brick, shift_per_radius
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.frame_motion import UNKNOWN_TWIST_SD
from bricktrack_host.tracking.pose.refine import LedMotion, RefinedPoses

_COLLARS, _BETWEEN_COLLARS = (0.0, 0.2, 0.4, 0.6), 0.05
"""Guesses of a collar that was not fitted, in LED radii, and what each leaves, about: the shift of the
centroid to the next guess, in radii times the sine of the view angle."""
_ANY_MM = np.array([0.0, 0.0, 130.0])  # in place of what is not known


def weighed_at(
    lights: LedLights,
    poses: RefinedPoses,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
    motion: LedMotion | None,
    n_lights: IntArray,
) -> Evidence:
    """Return what speaks for assignments, by poses near those that they have.

    Parameters
    ----------
    lights : LedLights
        Of the LEDs that are taken to be seen.
    poses : RefinedPoses
        So near that pixels depend linearly on what they are off by.
    collar_mm : float or None
        See `led_profile`.
    motion : LedMotion or None
        See `verification.verify`.
    n_lights : ndarray of int64, shape (n,)
        Of each one's picture.
    """
    mode = ray_model.sensor_mode
    return evidence_of(
        _given(lights, motion, n_lights, ray_model),
        _guesses(poses, motion, ray_model, brick_model, collar_mm),
        all_finite(lights.uv_px),
        poses.t_camera_brick_mm[:, 2],
        n_pixels=mode.width * mode.height,
        min_leds=MIN_INLIERS,
        axes_length=float(np.linalg.norm(brick_model.led_axes.mean(axis=0))),
    )


def _given(lights: LedLights, motion: LedMotion | None, n_lights: IntArray, ray_model: RayModel) -> Given:
    within = unknown_motion(lights.uv_px, ray_model) if motion is None else motion
    return Given(
        uv_px=lights.uv_px,
        cov_px2=lights.cov_px2,
        area_px2=lights.area_px2,
        is_whole=lights.is_whole,
        dt_s=within.dt_s,
        twist_sd=np.tile(UNKNOWN_TWIST_SD, (len(lights.uv_px), 1))
        if within.twist_sd is None
        else within.twist_sd,
        n_lights=n_lights,
    )


def _guesses(
    poses: RefinedPoses,
    motion: LedMotion | None,
    ray_model: RayModel,
    brick_model: BrickModel,
    collar_mm: float | None,
) -> list[Shown]:
    """Return what poses show by each guess of the profile: one where it was fitted."""
    R, t_mm = poses.R_camera_brick[:, None], poses.t_camera_brick_mm[:, None]
    if motion is not None:
        R, t_mm = R @ matrix_from_rvec(motion.rvec_brick_rad), t_mm + motion.shift_camera_mm
    posed = all_finite(R, 3) & all_finite(t_mm, 2)
    R, t_mm = (
        np.where(posed[:, None, None, None], R, np.eye(3)),
        np.where(posed[:, None, None], t_mm, _ANY_MM),
    )
    wider, collars_mm = 1.0, [collar_mm or 0.0]
    if collar_mm is None:
        radius_mm = float(np.median(brick_model.led_radii_mm))
        wider = _BETWEEN_COLLARS / shift_per_radius(0.0, brick_model)
        collars_mm = [share * radius_mm for share in _COLLARS]
    tilt, J_tilt = _tilt(
        np.where(posed[:, None, None], poses.R_camera_brick, np.eye(3)), t_mm.mean(axis=1), brick_model
    )
    out = []
    for guess_mm in collars_mm:
        seen, J = predict_brick(R, t_mm, ray_model, brick_model, collar_mm=guess_mm)
        places = np.where(posed[:, None, None], seen.uv_px, np.nan)
        out.append(Shown(places, seen.area_px2, seen.facing, J, wider * seen.model_shift_px, tilt, J_tilt))
    return out


def _tilt(R: FloatArray, t_mm: FloatArray, brick_model: BrickModel) -> tuple[FloatArray, FloatArray]:
    """Return how far poses are turned from facing the camera, and that by the turn: (n, 3) and (n, 3, 3).

    A vector across the line of sight to the brick, as long as the chord from there to the LEDs' mean axis.
    """
    axis = brick_model.led_axes.mean(axis=0)
    axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
    middle_mm = R @ brick_model.led_positions_mm.mean(axis=0) + t_mm
    sight = middle_mm / np.linalg.norm(middle_mm, axis=-1, keepdims=True)
    mean = R @ axis
    across = np.eye(3) - sight[:, :, None] * sight[:, None, :]
    tilt = np.einsum("nij,nj->ni", across, mean)
    sine = np.linalg.norm(tilt, axis=-1)
    chord = np.sqrt(np.maximum(2 + 2 * (mean * sight).sum(axis=-1), 0.0))
    longer = chord / np.maximum(sine, 1e-9)
    return tilt * np.where(sine > 1e-9, longer, 1.0)[:, None], -across @ R @ skew(axis)
