"""From identified centroids to poses: starts, refinement, rolling shutter, and what is not believed.

Each LED is seen at the mid-exposure of its own row; a pose is stated at that of the picture's centre row. The
first pass takes the frame as one instant; splines through its poses then say how far the brick moves between
the two instants, and the poses are fitted again, each LED at its own time, until that settles. What the
splines cannot follow, an impact or the shake's upper frequencies, is corrected by the frame itself: its rows
are 20 ms of motion, and pose and twist are fitted together, with the splines' twist as a prior.
"""

import numpy as np
from scipy.interpolate import CubicSpline

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.first_poses import FirstPoses, degrees_of_freedom, first_poses
from bricktrack_host.tracking.led_identity import SegmentMethod
from bricktrack_host.tracking.led_profile import collar_of
from bricktrack_host.tracking.led_tracker import NOT_USED, observe_leds
from bricktrack_host.tracking.prsoi import PrsoiForm, prsoi_starts
from bricktrack_host.tracking.refine import MIN_LEDS, LedMotion, RefinedPoses, refine_poses
from bricktrack_host.tracks import FusedTrack, LedObservations, OpticalTrack

__all__ = ["SegmentMethod", "led_motion", "led_times_ns", "observe_leds", "solve_poses", "start_poses"]

_PASSES = 4
_SETTLED_MM = 1e-3
_MAX_GAP_PERIODS = 3.5  # wider gaps end a spline: a shaken brick turns back within them
_SPLINE_SHARE = 0.1
_TWIST_FLOOR = np.array([0.005, 0.3])  # rad/s, mm/s: far below what moves a centroid within a frame
_FUSED_TWIST_SD = np.repeat([0.03, 5.0], 3)  # rad/s, mm/s: of the fused motion between frames
_UNKNOWN_TWIST = np.array([1.0, 1.0, 1.0, 300.0, 300.0, 300.0])
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


def solve_poses(
    observations: LedObservations,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    form: PrsoiForm = "safe",
    refined: bool = True,
    rolling_shutter: bool = True,
    motion: LedMotion | None = None,
    first: FirstPoses | None = None,
) -> OpticalTrack:
    """Solve the poses of a run.

    Parameters
    ----------
    observations : LedObservations
    ray_model : RayModel
    brick_model : BrickModel
    form : "safe" or "printed"
        Of PRSOI, see there.
    refined : bool
        False: the PRSOI poses as they are, without verification, for comparison with the literature.
    rolling_shutter : bool
        False: the frame is taken for one instant.
    motion : LedMotion, optional
        How the brick moves from each frame's instant to its LEDs', where that is known better than splines
        through 30 frames a second can tell: from camera and IMU together, see `led_motion`.
    first : FirstPoses, optional
        Of the same observations, from `start_poses`, which ``form`` is of; default found here.

    Returns
    -------
    OpticalTrack
        NaN, with the reason in the flags, where four LEDs do not give one pose. Covariances are scaled by the
        run's, and the frame's own, reduced chi-square where that is above one.
    """
    n, n_leds = _checked_shape(observations, brick_model)
    t_ns, led_t_ns = led_times_ns(observations, ray_model)
    flags = np.asarray(observations.frame_flags, dtype=np.int64).copy()
    if not refined:
        uv = _used_px(observations)
        start_R, start_t = prsoi_starts(uv, ray_model, brick_model, form)
        return _finish(
            observations,
            t_ns,
            led_t_ns,
            start_R,
            start_t,
            np.full((n, 6, 6), np.nan),
            np.full((n, n_leds, 2), np.nan),
            flags,
            all_finite(uv),
            brick_model,
        )
    collar_mm = collar_of(brick_model)
    cov = observations.cov_px2

    def fit(uv: FloatArray, R: FloatArray, t: FloatArray, motion: LedMotion | None) -> RefinedPoses:
        return refine_poses(uv, cov, R, t, ray_model, brick_model, collar_mm=collar_mm, motion=motion)

    first = first or start_poses(observations, ray_model, brick_model, form=form)
    flags[first.is_ambiguous] |= PoseFlag.AMBIGUOUS
    uv, R, t_mm = first.uv_px, first.R_camera_brick, first.t_camera_brick_mm
    known_motion = motion
    for _ in range(_PASSES):
        if rolling_shutter and known_motion is None:
            motion = _motion_to_leds(t_ns, led_t_ns, R, t_mm)
        n_before = int(all_finite(uv).sum())
        poses = fit(uv, R, t_mm, motion)
        uv = _without_outliers(uv, poses)
        moved_mm = np.abs(poses.t_camera_brick_mm - t_mm)
        R, t_mm = poses.R_camera_brick, poses.t_camera_brick_mm
        if int(all_finite(uv).sum()) == n_before and not (moved_mm > _SETTLED_MM).any():
            break
    else:
        poses = fit(uv, R, t_mm, motion)
    return _finish(
        observations,
        t_ns,
        led_t_ns,
        poses.R_camera_brick,
        poses.t_camera_brick_mm,
        poses.covariance * _misfit(poses, uv)[:, None, None],
        poses.residual_px,
        flags,
        all_finite(uv),
        brick_model,
    )


def start_poses(
    observations: LedObservations, ray_model: RayModel, brick_model: BrickModel, *, form: PrsoiForm = "safe"
) -> FirstPoses:
    """Return what `solve_poses` starts from; the same for any motion, so had once for several solutions."""
    _checked_shape(observations, brick_model)
    t_ns, _ = led_times_ns(observations, ray_model)
    uv = _used_px(observations)
    return first_poses(uv, observations.cov_px2, t_ns, ray_model, brick_model, form=form)


def _used_px(observations: LedObservations) -> FloatArray:
    used = ((observations.led_flags & NOT_USED) == 0) & all_finite(observations.uv_px)
    return np.where(used[..., None], observations.uv_px, np.nan)


def _checked_shape(observations: LedObservations, brick_model: BrickModel) -> tuple[int, int]:
    n, n_leds = observations.uv_px.shape[:2]
    if n_leds != brick_model.n_leds or len(observations.sensor_timestamp_ns) != n:
        raise TrackingError(
            f"observations are of {n_leds} LEDs in {n} frames with {len(observations.sensor_timestamp_ns)} "
            f"time stamps; the layout '{brick_model.name}' has {brick_model.n_leds} LEDs"
        )
    return n, n_leds


def led_motion(at_frames: FusedTrack, at_leds: FusedTrack) -> LedMotion:
    """Return how the brick moves from the frames' instants to those of the LEDs, by a fused track.

    Parameters
    ----------
    at_frames : FusedTrack
        At the n instants of the frames.
    at_leds : FusedTrack
        At the n x n_leds instants of the LEDs, frame by frame.
    """
    n = len(at_frames.t_ns)
    R = at_leds.R_camera_brick.reshape(n, -1, 3, 3)
    t_mm = at_leds.t_camera_brick_mm.reshape(n, -1, 3)
    turn = rvec_from_matrix(np.swapaxes(at_frames.R_camera_brick, -1, -2)[:, None] @ R)
    return LedMotion(
        rvec_brick_rad=turn,
        shift_camera_mm=t_mm - at_frames.t_camera_brick_mm[:, None],
        dt_s=np.asarray((at_leds.t_ns.reshape(n, -1) - at_frames.t_ns[:, None]) * 1e-9, dtype=np.float64),
        twist_sd=np.tile(_FUSED_TWIST_SD, (n, 1)),
    )


def _without_outliers(uv: FloatArray, poses: RefinedPoses) -> FloatArray:
    """Leave out the worst LED of each frame whose residual is beyond belief, while five others remain."""
    n_seen = all_finite(uv).sum(axis=1)
    sigmas = np.where(poses.is_outlier, poses.sigmas, 0.0)
    rest = np.nanmedian(np.where(np.isfinite(poses.sigmas), poses.sigmas, 0.0), axis=1)
    worst = sigmas.argmax(axis=1)
    rows = np.flatnonzero((sigmas.max(axis=1) > 4 * rest) & (n_seen > 5) & (sigmas.max(axis=1) > 0))
    out = uv.copy()
    out[rows, worst[rows]] = np.nan
    return out


def _motion_to_leds(
    t_ns: IntArray, led_t_ns: IntArray, R_camera_brick: FloatArray, t_camera_brick_mm: FloatArray
) -> LedMotion:
    """Return how far the brick moves from each frame's instant to each LED's, by splines over frames."""
    n, n_leds = led_t_ns.shape
    rvec, shift = np.zeros((n, n_leds, 3)), np.zeros((n, n_leds, 3))
    twist_sd = np.tile(_UNKNOWN_TWIST, (n, 1))
    valid = np.flatnonzero(all_finite(R_camera_brick, 2))
    if valid.size >= 2:
        seconds = (t_ns - t_ns[valid[0]]) * 1e-9
        led_seconds = (led_t_ns - t_ns[valid[0]]) * 1e-9
        period = float(np.median(np.diff(seconds[valid])))
        for part in np.split(valid, np.flatnonzero(np.diff(seconds[valid]) > _MAX_GAP_PERIODS * period) + 1):
            if part.size < 2:
                continue
            R0 = R_camera_brick[part[part.size // 2]]
            turns = rvec_from_matrix(R0.T @ R_camera_brick[part])
            samples = np.hstack([turns, t_camera_brick_mm[part]])
            spline = CubicSpline(seconds[part], samples)
            here, there = spline(seconds[part]), spline(led_seconds[part])
            back = np.swapaxes(matrix_from_rvec(here[:, :3]), -1, -2)[:, None]
            rvec[part] = rvec_from_matrix(back @ matrix_from_rvec(there[..., :3]))
            shift[part] = there[..., 3:] - here[:, None, 3:]
            twist_sd[part] = _twist_sd(samples, period)
    return LedMotion(
        rvec_brick_rad=rvec,
        shift_camera_mm=shift,
        dt_s=np.asarray((led_t_ns - t_ns[:, None]) * 1e-9, dtype=np.float64),
        twist_sd=twist_sd,
    )


def _twist_sd(samples: FloatArray, period_s: float) -> FloatArray:
    """Return how wrong a cubic spline's velocity may be at each frame, shape (n, 6), rad/s and mm/s.

    For a sine of w T = 1.8 (8.6 Hz at 30 frames a second) it is 8.5 % off, which is 0.026 of the fourth
    difference over T; at lower frequencies less, at an impact several times that. Ends know one side only.
    """
    n = len(samples)
    if n < 5:
        return np.tile(_UNKNOWN_TWIST, (n, 1))
    fourth = np.diff(samples, 4, axis=0)
    size = np.stack([np.linalg.norm(fourth[:, :3], axis=1), np.linalg.norm(fourth[:, 3:], axis=1)], axis=1)
    near = np.pad(size, ((4, 4), (0, 0)), mode="edge")  # frame i is centred among those from i to i + 4
    local = np.max([near[k : k + n] for k in range(5)], axis=0)
    sd = np.maximum(_SPLINE_SHARE * local / period_s, _TWIST_FLOOR)
    sd[[0, 1, -2, -1]] *= 3.0
    return np.asarray(np.repeat(np.minimum(sd, _UNKNOWN_TWIST[[0, 3]]), 3, axis=1))


def _misfit(poses: RefinedPoses, uv: FloatArray) -> FloatArray:
    """Return the factor on each frame's covariance that the residuals of the run, and its own, ask for; >= 1.

    Never below one: what all LEDs have in common does not show in residuals, and the freedom that the profile
    and the twist leave the LEDs takes some of the chi-square.
    """
    dof = degrees_of_freedom(uv)
    with np.errstate(invalid="ignore", divide="ignore"):
        reduced = np.where(dof >= 2, poses.chi2 / dof, np.nan)
    good = np.isfinite(reduced)
    run = float(np.sum(poses.chi2[good]) / np.sum(dof[good])) if good.any() else 1.0
    # One frame's chi-square scatters by sqrt(2 / dof): only what is clearly beyond counts as its own.
    own = np.where(np.nan_to_num(reduced) > 1 + 3 * np.sqrt(2 / np.maximum(dof, 1)), reduced, 1.0)
    return np.maximum(max(run, 1.0), own)


def _finish(
    observations: LedObservations,
    t_ns: IntArray,
    led_t_ns: IntArray,
    R: FloatArray,
    t: FloatArray,
    covariance: FloatArray,
    residual_px: FloatArray,
    flags: IntArray,
    used: BoolArray,
    brick_model: BrickModel,
) -> OpticalTrack:
    posed = all_finite(R, 2) & all_finite(t)
    flags[~posed] |= PoseFlag.NO_POSE
    flags[posed & ~used.all(axis=1)] |= PoseFlag.LED_MISSING
    flags[posed & (used.sum(axis=1) == MIN_LEDS)] |= PoseFlag.UNVERIFIED
    uncovered = (used & ((observations.led_flags & LedFlag.UNCOVERED) != 0)).any(axis=1)
    flags[posed & uncovered] |= PoseFlag.UNCOVERED
    if brick_model.led_profile is None:
        flags[posed] |= PoseFlag.LED_PROFILE_UNKNOWN
    gone = ~posed
    return OpticalTrack(
        t_ns=t_ns,
        R_camera_brick=np.where(gone[:, None, None], np.nan, R),
        t_camera_brick_mm=np.where(gone[:, None], np.nan, t),
        covariance=np.where(gone[:, None, None], np.nan, covariance),
        flags=flags,
        residual_px=np.where((gone[:, None] | ~used)[..., None], np.nan, residual_px),
        led_t_ns=led_t_ns,
    )
