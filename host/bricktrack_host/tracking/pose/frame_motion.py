"""How the brick moves within a frame: when each LED was seen, and where it then was beside the frame's pose.

By splines through the poses of neighbouring frames, or by a fused motion; both say how well they know it.
"""

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.tracking.led_model.led_profile import collar_of, predict_brick
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import FirstPoses
from bricktrack_host.tracking.pose.refine import LedMotion, RefinedPoses
from bricktrack_host.tracking.pose.spline_kernel import carried_by_spline, poses_as_vectors, spline_doubt
from bricktrack_host.tracks import FusedTrack, LedObservations

_MAX_GAP_PERIODS = 3.5  # wider gaps end a spline: a shaken brick turns back within them
_FEWEST_FRAMES = 9  # of which five fourth differences are had: fewer may all be small by chance
_UNEVEN = 0.618034  # multiples of it, less whole numbers, fill 0 to 1 without a period
_TWIST_FLOOR = np.array([0.005, 0.3])  # rad/s, mm/s: far below what moves a centroid within a frame
_FUSED_TWIST_SD = np.repeat([0.03, 5.0], 3)  # rad/s, mm/s: of the fused motion between frames
UNKNOWN_TWIST_SD = np.array([1.0, 1.0, 1.0, 300.0, 300.0, 300.0])
"""Of a shaken brick (DESIGN 2: 0.3 m/s), where the neighbours do not say."""


def led_times_ns(observations: LedObservations, ray_model: RayModel) -> tuple[IntArray, IntArray]:
    """Return the instants of the frames, shape (n,), and of the LEDs in them, shape (n, n_leds).

    Mid-exposure of a row is ``SensorTimestamp - exposure / 2 + row delay``, because the stamp is the start of
    the first row's read-out, when its exposure ends. LEDs that were not seen carry the frame's instant.
    """
    mode = ray_model.sensor_mode
    first = observations.sensor_timestamp_ns - observations.exposure_ns // 2
    centre = first + int(np.rint(float(mode.row_delay_ns(0.5 * (mode.height - 1)))))
    v = np.where(np.isfinite(observations.uv_px[..., 1]), observations.uv_px[..., 1], 0.5 * (mode.height - 1))
    return centre, first[:, None] + np.rint(mode.row_delay_ns(v)).astype(np.int64)


def within_exposure_ns(led_t_ns: IntArray, exposure_ns: IntArray) -> IntArray:
    """Return two instants within each LED's exposure at which a motion's mean is that over all of it.

    The points of Gauss's rule: before and after the middle by the exposure over the root of 12.

    Parameters
    ----------
    led_t_ns : ndarray of int64, shape (n, n_leds)
        Mid-exposure.
    exposure_ns : ndarray of int64, shape (n,)

    Returns
    -------
    t_ns : ndarray of int64, shape (2, n, n_leds)
    """
    aside = np.rint(exposure_ns / np.sqrt(12.0)).astype(np.int64)[:, None]
    return np.stack([led_t_ns - aside, led_t_ns + aside])


def led_motion(at_frames: FusedTrack, at_leds: FusedTrack, *, n_instants: int = 1) -> LedMotion:
    """Return how the brick moves from the frames' instants to those of the LEDs, by a fused track.

    An LED's light is gathered over an exposure: a brick that turns back meanwhile is seen where it is on the
    mean, not in the middle. At 10 Hz and 10 ms that is 1.6 % of the amplitude.

    Parameters
    ----------
    at_frames : FusedTrack
        At the n instants of the frames.
    at_leds : FusedTrack
        At the instants of the LEDs, frame by frame; or at those of `within_exposure_ns`, in its order.
    n_instants : int
        Instants of each LED, whose mean counts: 2 for those of `within_exposure_ns`.
    """
    n = len(at_frames.t_ns)
    R = at_leds.R_camera_brick.reshape(n_instants, n, -1, 3, 3)
    t_mm = at_leds.t_camera_brick_mm.reshape(n_instants, n, -1, 3).mean(axis=0)
    turn = rvec_from_matrix(np.swapaxes(at_frames.R_camera_brick, -1, -2)[:, None] @ R).mean(axis=0)
    later_ns = (at_leds.t_ns.reshape(n_instants, n, -1) - at_frames.t_ns[:, None]).mean(axis=0)
    return LedMotion(
        rvec_brick_rad=turn,
        shift_camera_mm=t_mm - at_frames.t_camera_brick_mm[:, None],
        dt_s=np.asarray(later_ns * 1e-9, dtype=np.float64),
        twist_sd=np.tile(_FUSED_TWIST_SD, (n, 1)),
    )


def motion_to_leds(
    t_ns: IntArray, led_t_ns: IntArray, R_camera_brick: FloatArray, t_camera_brick_mm: FloatArray
) -> LedMotion:
    """Return how far the brick moves from each frame's instant to each LED's, by splines over frames."""
    n, n_leds = led_t_ns.shape
    rvec, shift = np.zeros((n, n_leds, 3)), np.zeros((n, n_leds, 3))
    twist_sd, jump_sd = np.tile(UNKNOWN_TWIST_SD, (2, n, 1))
    valid = np.flatnonzero(all_finite(R_camera_brick, 2))
    if valid.size >= 2:
        seconds = (t_ns - t_ns[valid[0]]) * 1e-9
        led_seconds = (led_t_ns - t_ns[valid[0]]) * 1e-9
        period = float(np.median(np.diff(seconds[valid])))
        for part in np.split(valid, np.flatnonzero(np.diff(seconds[valid]) > _MAX_GAP_PERIODS * period) + 1):
            if part.size < 2:
                continue
            samples = poses_as_vectors(R_camera_brick[part], t_camera_brick_mm[part])
            turns, shifts = np.empty((2, part.size, n_leds, 3))
            carried_by_spline(samples, seconds[part], led_seconds[part], turns, shifts)
            rvec[part], shift[part] = turns, shifts
            if part.size >= _FEWEST_FRAMES:
                limits = _TWIST_FLOOR, UNKNOWN_TWIST_SD[[0, 3]]
                twist_sd[part], jump_sd[part] = spline_doubt(samples, seconds[part], *limits)
    return LedMotion(
        rvec_brick_rad=rvec,
        shift_camera_mm=shift,
        dt_s=np.asarray((led_t_ns - t_ns[:, None]) * 1e-9, dtype=np.float64),
        twist_sd=twist_sd,
        jump_sd=jump_sd,
    )


def calm_frames(first: FirstPoses, motion: LedMotion | None, *, min_leds: int, at_most: int) -> IntArray:
    """Return frames with enough LEDs whose motion within the frame is best known, spread over the run."""
    good = all_finite(first.R_camera_brick, 2) & (all_finite(first.uv_px).sum(axis=1) >= min_leds)
    frames = np.flatnonzero(good)
    if frames.size and motion is not None and motion.twist_sd is not None:
        doubt = motion.twist_sd[frames, 3]
        frames = frames[doubt <= max(float(np.median(doubt)), 2 * float(doubt.min()))]
    if frames.size <= at_most:
        return np.asarray(frames)
    # One of each stretch, not at even steps: of a video's pictures every so many are coded alike.
    stretch = np.arange(at_most)
    return np.asarray(frames[((stretch + stretch * _UNEVEN % 1.0) * frames.size / at_most).astype(np.int64)])


def carried_px(
    motion: LedMotion, first: FirstPoses, frames: IntArray, ray_model: RayModel, brick_model: BrickModel
) -> FloatArray:
    """Return how far each LED is seen from where it was at its frame's instant, (m, n_leds, 2), px."""
    R, t_mm = first.R_camera_brick[frames], first.t_camera_brick_mm[frames]
    R_led = R[:, None] @ matrix_from_rvec(motion.rvec_brick_rad[frames])
    t_led_mm = t_mm[:, None] + motion.shift_camera_mm[frames]
    collar_mm = collar_of(brick_model)
    there, _ = predict_brick(R_led, t_led_mm, ray_model, brick_model, collar_mm=collar_mm)
    here, _ = predict_brick(R, t_mm, ray_model, brick_model, collar_mm=collar_mm)
    return there.uv_px - here.uv_px


def motion_doubt_px2(
    motion: LedMotion,
    jump_sd: FloatArray,
    poses: RefinedPoses,
    frames: IntArray,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    collar_mm: float | None,
) -> FloatArray:
    """Return what a sudden change of velocity leaves of each LED's place, each for itself.

    Parameters
    ----------
    motion : LedMotion
    jump_sd : ndarray, shape (m, 6), rad/s and mm/s
    poses : RefinedPoses
    frames : ndarray of int64, shape (m,)
        Those wanted; they have poses.

    Returns
    -------
    covariance_px2 : ndarray, shape (m, n_leds, 2, 2), px^2
        Zero for an LED seen at the frame's own instant.
    """
    _, J = predict_brick(
        poses.R_camera_brick[frames],
        poses.t_camera_brick_mm[frames],
        ray_model,
        brick_model,
        collar_mm=collar_mm,
    )
    by_jump = J * (motion.dt_s[frames][..., None] * jump_sd[:, None])[:, :, None, :]
    return np.asarray(by_jump @ np.swapaxes(by_jump, -1, -2))
