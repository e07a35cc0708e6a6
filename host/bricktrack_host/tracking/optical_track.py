"""From identified centroids to poses: starts, refinement, rolling shutter, and what is not believed.

Each LED is seen at the mid-exposure of its own row; a pose is stated at that of the picture's centre row. The
first pass takes the frame as one instant; splines through its poses then say how far the brick moves between
the two instants, and the poses are fitted again, each LED at its own time, until that settles. What the
splines cannot follow, an impact or the shake's upper frequencies, is corrected by the frame itself: its rows
are 20 ms of motion, and pose and twist are fitted together, with the splines' twist as a prior.
"""

from dataclasses import replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, rows_of
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import TrackingError
from bricktrack_host.quality import LedFlag, PoseFlag
from bricktrack_host.tracking.centroid_noise import standing_share
from bricktrack_host.tracking.identity.led_identity import SegmentMethod
from bricktrack_host.tracking.led_fit import OF_THE_SAME_RUN
from bricktrack_host.tracking.led_model.led_profile import collar_of
from bricktrack_host.tracking.led_tracker import NOT_USED, observe_leds
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import FirstPoses, degrees_of_freedom, first_poses
from bricktrack_host.tracking.pose.frame_motion import (
    led_times_ns,
    motion_doubt_px2,
    motion_to_leds,
)
from bricktrack_host.tracking.pose.lone_turns import on_their_neighbours_course
from bricktrack_host.tracking.pose.p3p import ray_centre_mm
from bricktrack_host.tracking.pose.prsoi import PrsoiForm, prsoi_starts
from bricktrack_host.tracking.pose.refine import MIN_LEDS, LedMotion, RefinedPoses, refine_poses
from bricktrack_host.tracking.pose.twin_poses import better_of_twins
from bricktrack_host.tracks import LedObservations, OpticalTrack

__all__ = ["SegmentMethod", "led_times_ns", "observe_leds", "solve_poses", "start_poses"]

_PASSES = 4
_SETTLED_MM = 1e-3
_NO_FRAMES = np.zeros(0, dtype=np.int64)


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
    cov = observations.cov_px2.copy()

    known_motion = motion
    is_given = known_motion is not None or not rolling_shutter
    centre_mm = ray_centre_mm(ray_model)

    def fit(
        uv: FloatArray, R: FloatArray, t: FloatArray, motion: LedMotion | None
    ) -> tuple[RefinedPoses, BoolArray]:
        def fit_frames(rows: IntArray, R: FloatArray, t: FloatArray) -> RefinedPoses:
            within = None if motion is None else rows_of(motion, rows)
            return refine_poses(
                uv[rows], cov[rows], R, t, ray_model, brick_model, collar_mm=collar_mm, motion=within
            )

        def fit_on_course(rows: IntArray, R: FloatArray, t: FloatArray) -> RefinedPoses:
            within = motion
            if motion is not None and not is_given:
                within = _no_surer(motion_to_leds(t_ns, led_t_ns, R, t), motion)
            return refine_poses(
                uv[rows], cov[rows], R[rows], t[rows], ray_model, brick_model, collar_mm=collar_mm,
                motion=None if within is None else rows_of(within, rows),
            )  # fmt: skip

        poses = fit_frames(np.arange(n), R, t)
        poses, is_twofold = better_of_twins(poses, uv, t_ns, fit_frames, centre_mm, brick_model)
        poses, is_open = on_their_neighbours_course(poses, uv, t_ns, fit_on_course)
        return poses, is_twofold | is_open

    first = first or start_poses(observations, ray_model, brick_model, form=form)
    flags[first.is_ambiguous] |= PoseFlag.AMBIGUOUS
    uv, R, t_mm = first.uv_px, first.R_camera_brick, first.t_camera_brick_mm
    of_instants: LedMotion | None = None
    torn, twist_doubt = np.zeros(n, dtype=np.bool_), np.zeros((n, 6))
    for _ in range(_PASSES):
        if not is_given:
            motion = _no_less_sure(motion_to_leds(t_ns, led_t_ns, R, t_mm), of_instants)
            of_instants = of_instants or motion
        n_before, n_torn = int(all_finite(uv).sum()), int(torn.sum())
        if motion is not None and motion.twist_sd is not None:
            motion = replace(motion, twist_sd=np.maximum(motion.twist_sd, twist_doubt))
        poses, is_twofold = fit(uv, R, t_mm, motion)
        newly = np.flatnonzero(_misfits(poses, uv) & ~torn) if motion is not None else _NO_FRAMES
        if motion is not None and newly.size:
            # Whatever motion was given, what a spline through the frames cannot follow here is in doubt.
            spline = motion if known_motion is None else motion_to_leds(t_ns, led_t_ns, R, t_mm)
            twist_sd, jump_sd = (
                np.zeros((newly.size, 6)) if sd is None else sd[newly]
                for sd in (spline.twist_sd, spline.jump_sd)
            )
            more = motion_doubt_px2(
                motion, jump_sd, poses, newly, ray_model, brick_model, collar_mm=collar_mm
            )
            moving = np.einsum("nlii->n", more) > np.einsum("nlii->n", np.nan_to_num(cov[newly]))
            cov[newly[moving]] += more[moving]
            twist_doubt[newly[moving]] = twist_sd[moving]
            torn[newly[moving]] = True
            uv = np.where(torn[:, None, None], first.uv_px, uv)
        uv = _without_outliers(uv, poses, ~torn)
        moved_mm = np.abs(poses.t_camera_brick_mm - t_mm)
        R, t_mm = poses.R_camera_brick, poses.t_camera_brick_mm
        is_same = int(all_finite(uv).sum()) == n_before and int(torn.sum()) == n_torn
        is_settled = is_given or not (moved_mm > _SETTLED_MM).any()
        if is_same and is_settled:
            break
    else:
        if not is_same:
            poses, is_twofold = fit(uv, R, t_mm, motion)
    flags[torn] |= PoseFlag.IMPACT
    flags[is_twofold] |= PoseFlag.AMBIGUOUS
    misfit = _misfit(poses, uv)[:, None, None]
    track = _finish(
        observations,
        t_ns,
        led_t_ns,
        np.where(is_twofold[:, None, None], np.nan, poses.R_camera_brick),
        poses.t_camera_brick_mm,
        poses.covariance * misfit,
        poses.residual_px,
        flags,
        all_finite(uv),
        brick_model,
    )
    of_leds = standing_share(track.residual_px) * misfit * poses.by_centroids
    of_profile = poses.by_profile[:, :, None] * poses.by_profile[:, None, :]
    return replace(track, shared_covariance=of_leds + of_profile)


def _no_surer(motion: LedMotion, than: LedMotion) -> LedMotion:
    """Return a motion no surer than another."""
    if motion.twist_sd is None or than.twist_sd is None:
        return motion
    return replace(motion, twist_sd=np.maximum(motion.twist_sd, than.twist_sd))


def _no_less_sure(motion: LedMotion, of_instants: LedMotion | None) -> LedMotion:
    """Return a motion at least as sure as poses of frames taken for instants make it.

    Later poses with few LEDs scatter by what the motion leaves them free to, and the motion by what poses
    scatter: each pass would be less sure than the one before.
    """
    if of_instants is None or of_instants.twist_sd is None or motion.twist_sd is None:
        return motion
    return replace(motion, twist_sd=np.minimum(motion.twist_sd, of_instants.twist_sd))


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


def _without_outliers(uv: FloatArray, poses: RefinedPoses, may: BoolArray) -> FloatArray:
    """Leave out the worst LED of each frame whose residual is beyond belief, while five others remain."""
    n_seen = all_finite(uv).sum(axis=1)
    sigmas = np.where(poses.is_outlier, poses.sigmas, 0.0)
    rest = np.nanmedian(np.where(np.isfinite(poses.sigmas), poses.sigmas, 0.0), axis=1)
    worst = sigmas.argmax(axis=1)
    rows = np.flatnonzero(may & (sigmas.max(axis=1) > 4 * rest) & (n_seen > 5) & (sigmas.max(axis=1) > 0))
    out = uv.copy()
    out[rows, worst[rows]] = np.nan
    return out


def _reduced_chi2(poses: RefinedPoses, uv: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return frames' reduced chi-square, NaN below two degrees of freedom, and which are beyond belief."""
    dof = degrees_of_freedom(uv)
    with np.errstate(invalid="ignore", divide="ignore"):
        reduced = np.where(dof >= 2, poses.chi2 / dof, np.nan)
    # One frame's chi-square scatters by sqrt(2 / dof).
    beyond = np.nan_to_num(reduced) > 1 + 3 * np.sqrt(2 / np.maximum(dof, 1))
    return reduced, np.asarray(beyond)


def _misfits(poses: RefinedPoses, uv: FloatArray) -> BoolArray:
    """Tell which frames the model does not describe: as a whole, or in one LED."""
    return np.asarray(_reduced_chi2(poses, uv)[1] | poses.is_outlier.any(axis=1))


def _misfit(poses: RefinedPoses, uv: FloatArray) -> FloatArray:
    """Return the factor on each frame's covariance that the residuals of the run, and its own, ask for; >= 1.

    Never below one: what all LEDs have in common does not show in residuals, and the freedom that the profile
    and the twist leave the LEDs takes some of the chi-square.
    """
    reduced, beyond = _reduced_chi2(poses, uv)
    good = np.isfinite(reduced) & ~beyond
    dof = degrees_of_freedom(uv)[good]
    run = float(np.sum(poses.chi2[good]) / np.sum(dof)) if good.any() else 1.0
    return np.maximum(max(run, 1.0), np.where(beyond, reduced, 1.0))


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
    if brick_model.led_profile is None or brick_model.led_profile.source == OF_THE_SAME_RUN:
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
