"""Fit what an LED type shows, its lit collar, from a recording, together with the poses.

The collar moves every centroid along its LED's axis by an amount that depends on the view, the poses move all
of them together: over a sweep the two come apart. Judged by cross-validation: with the collar fitted on
other frames, the residuals of the frames left out must shrink.
"""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, rows_of
from bricktrack_common.brick_model import DEFAULT_SHIFT_SD_PER_RADIUS, BrickModel, ProfileEntry
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import CalibrationError
from bricktrack_host.tracking.led_model.led_profile import (
    UNKNOWN_SHIFT_PER_RADIUS,
    predict_brick,
    shift_per_radius,
)
from bricktrack_host.tracking.odd_leds import oddest_led
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracking.pose.first_poses import FirstPoses, first_poses
from bricktrack_host.tracking.pose.frame_motion import calm_frames, carried_px, led_times_ns, motion_to_leds
from bricktrack_host.tracking.pose.refine import OWN_SHARE, RefinedPoses, refine_poses
from bricktrack_host.tracking.sweep_frames import (
    errors_of_sweep,
    rms_px,
    sweep_frames,
    without_led,
    words_on_left_out,
)
from bricktrack_host.tracks import LedObservations

_MIN_LEDS = 5  # four leave two degrees of freedom, which one collar and a false pose share too easily
_MIN_FRAMES = 5
_N_FOLDS = 5
_OUTLIER_SIGMAS = 4.0
_SIDE_ON_PX = 8.0  # of radius times sine; an LED seen from in front tells nothing of its shape
LEAST_SHIFT_SD = 0.0015
"""Between LEDs that saturate, just do not, and are dim, the middle of the light moves along the axis by 0.001
to 0.0025 of radius times sine (simulated, limb 30 % darker): a fit in one light does not know the others."""
OF_THE_SAME_RUN = "fitted in the run that it is used on"
_SELF_FIT_SHIFT_SD = 0.005
"""Of a profile that the run itself gave: views of one shake are few, and nothing else checks them."""
_MAX_SELF_FIT_FRAMES = 60


@dataclass(frozen=True, slots=True, eq=False)
class CollarFit:
    """A fitted collar.

    Attributes
    ----------
    collar_mm : float
        Below zero: the dome is so much taller than half a sphere.
    sd_mm : float
        From the residuals of frames taken as independent groups, since errors of one frame's LEDs, and of
        frames at rest, repeat.
    shift_sd_per_radius : float
        How far off the shape leaves the light's middle, for `ProfileEntry`: what the collar's own sd makes of
        it, and what the LEDs show along their axes beside the fit, which no collar explains.
    rms_px : float
        Of the residuals, each of u and v, with the collar.
    cross_validated_rms_px : float
        Of frames left out of the fit.
    rms_without_px : float
        Of the same frames with a sphere's centroid in place of the profile.
    n_frames, n_leds : int
        Frames, and LEDs in them, that were used.
    left_out_px : ndarray, shape (n_leds of the layout,), px
        How far LEDs that were left out are from where the others put them; 0 of those used.
    """

    collar_mm: float
    sd_mm: float
    shift_sd_per_radius: float
    rms_px: float
    cross_validated_rms_px: float
    rms_without_px: float
    n_frames: int
    n_leds: int
    left_out_px: FloatArray

    @property
    def is_believable(self) -> bool:
        """Tell whether frames that the fit did not see are described better with the collar than without."""
        return self.cross_validated_rms_px < self.rms_without_px and self.sd_mm < 0.5


def fit_collar(
    observations: LedObservations,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    start_mm: float = 0.5,
    least_sd_mm: float = 0.0,
    max_collar_radii: float = 2.0,
) -> CollarFit:
    """Fit the length of the lit collar of all LEDs of a layout.

    Parameters
    ----------
    observations : LedObservations
        Of a brick at rest in several poses, or moving slowly: rolling shutter is not taken off.
    ray_model : RayModel
    brick_model : BrickModel
        Its own profile, if any, is not used.
    start_mm : float
    least_sd_mm : float
        That the collar is known to at best: of LEDs whose places were fitted beside it, which these residuals
        do not show.
    max_collar_radii : float
        Longest collar believed, in LED radii.

    Returns
    -------
    CollarFit

    Raises
    ------
    CalibrationError
        If fewer than five frames show five LEDs that agree, the views do not determine the collar, or it
        comes out longer than ``max_collar_radii``, or the dome as much too tall.

    Notes
    -----
    Gauss-Newton on the collar with the poses eliminated in every frame (variable projection). LEDs that all
    the others contradict are left out, the worst first, and the collar is fitted anew.
    """
    sweep, problem, collar, left_out_px = _without_odd_leds(observations, ray_model, brick_model, start_mm)
    uv = sweep.uv_px
    longest = max_collar_radii * float(brick_model.led_radii_mm.max())
    if not -longest <= collar <= longest:
        what = (
            "The light lies farther in front than a tall dome's: do the layout's positions lie behind the "
            "middles of the LEDs' spheres?"
            if collar < 0
            else "Check the LEDs' axes and radii in the layout, and the calibration"
        )
        raise CalibrationError(
            f"fitted collar is {collar:.3f} mm; expected -{longest:g} to {longest:g} mm. {what}."
        )
    residual, slope = problem.projected(collar)
    information = np.nansum(slope**2, axis=1)
    score = np.nansum(slope * residual, axis=1)
    # Sandwich: the frames' scores scatter as they do, whatever the centroids' covariance says.
    sd = float(np.sqrt(np.sum(score**2)) / information.sum())
    folds = np.arange(len(uv)) % _N_FOLDS
    held_out = np.full(uv.shape, np.nan)
    for fold in np.unique(folds):
        out = folds == fold
        held_out[out] = problem.poses(problem.solve(~out, collar)).residual_px[out]
    without = problem.poses(None).residual_px
    sd = max(sd, float(1 / np.sqrt(information.sum())), least_sd_mm)
    return CollarFit(
        collar_mm=collar,
        sd_mm=sd,
        shift_sd_per_radius=problem.shift_sd_per_radius(collar, sd),
        rms_px=rms_px(problem.poses(collar).residual_px),
        cross_validated_rms_px=rms_px(held_out),
        rms_without_px=rms_px(without),
        n_frames=len(uv),
        n_leds=int(np.isfinite(uv[..., 0]).sum()),
        left_out_px=left_out_px,
    )


def _without_odd_leds(
    observations: LedObservations, ray_model: RayModel, brick_model: BrickModel, start_mm: float
) -> tuple[LedObservations, "_Problem", float, FloatArray]:
    """Return a sweep's LEDs that agree, their problem and collar, and how far off those left out are, px."""
    left_out_px = np.zeros(brick_model.n_leds)
    sweep = observations
    while True:
        try:
            sweep = sweep_frames(
                sweep, wanted="the LED profile needs", min_leds=_MIN_LEDS, min_frames=_MIN_FRAMES
            )
        except CalibrationError as e:
            if not left_out_px.any():
                raise
            raise CalibrationError(f"{words_on_left_out(left_out_px, brick_model)} Then: {e}") from e
        problem = _Problem(sweep, ray_model, brick_model)
        collar = problem.solve(np.ones(len(sweep.uv_px), dtype=np.bool_), start_mm)
        shown = ProfileEntry(collar_mm=collar, source="being fitted", shift_sd_per_radius=LEAST_SHIFT_SD)
        errors = errors_of_sweep(
            sweep, problem.poses(shown.collar_mm), ray_model, replace(brick_model, led_profile=shown)
        )
        odd = oddest_led(errors, errors.seen)
        if odd is None:
            return sweep, problem, collar, left_out_px
        left_out_px[odd[0]] = odd[1]
        sweep = without_led(sweep, odd[0])


def with_profile_of_run(
    observations: LedObservations,
    first: FirstPoses,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    rolling_shutter: bool = True,
) -> BrickModel:
    """Return a layout without a profile with one fitted to the run that it is used on, if the run tells one.

    Domes pull all poses of a run alike, by tenths of a millimetre: what the run's own views tell of them is
    worth more than none. The poses stay flagged `PoseFlag.LED_PROFILE_UNKNOWN`.

    Parameters
    ----------
    observations : LedObservations
    first : FirstPoses
        Of the same observations.
    ray_model : RayModel
    brick_model : BrickModel
        Returned as it is where it has a profile, or the run does not tell one.
    rolling_shutter : bool
        False: the frames are taken for instants.
    """
    if brick_model.led_profile is not None:
        return brick_model
    motion = None
    if rolling_shutter:
        t_ns, led_t_ns = led_times_ns(observations, ray_model)
        motion = motion_to_leds(t_ns, led_t_ns, first.R_camera_brick, first.t_camera_brick_mm)
    frames = calm_frames(first, motion, min_leds=_MIN_LEDS, at_most=_MAX_SELF_FIT_FRAMES)
    uv_px = first.uv_px[frames]
    if motion is not None and frames.size:
        uv_px = uv_px - carried_px(motion, first, frames, ray_model, brick_model)
    few = replace(rows_of(observations, frames), uv_px=uv_px)
    try:
        fit = fit_collar(few, ray_model, brick_model)
    except CalibrationError:
        return brick_model
    if not fit.is_believable:
        return brick_model
    profile = ProfileEntry(
        collar_mm=fit.collar_mm,
        source=OF_THE_SAME_RUN,
        shift_sd_per_radius=max(fit.shift_sd_per_radius, _SELF_FIT_SHIFT_SD),
    )
    return replace(brick_model, led_profile=profile)


class _Problem:
    """Residuals of all frames for a collar, with the poses fitted; outliers are left out as they show."""

    def __init__(self, sweep: LedObservations, ray_model: RayModel, brick_model: BrickModel) -> None:
        self._uv, self._cov = sweep.uv_px, sweep.cov_px2
        self._rays, self._brick = ray_model, brick_model
        start = first_poses(self._uv, self._cov, sweep.sensor_timestamp_ns, ray_model, brick_model)
        self._R, self._t = start.R_camera_brick, start.t_camera_brick_mm
        if not all_finite(self._R, 2).any():
            raise CalibrationError(
                "no frame of the sweep has a pose to start from. Check the LEDs' positions and names in the "
                "layout, and the calibration"
            )

    def poses(self, collar_mm: float | None) -> RefinedPoses:
        """Return the poses and residuals for a collar; `None` is a sphere's outline."""
        return refine_poses(
            self._uv,
            self._cov,
            self._R,
            self._t,
            self._rays,
            self._brick,
            collar_mm=collar_mm,
            profile_is_exact=True,
        )

    def projected(self, collar_mm: float) -> tuple[FloatArray, FloatArray]:
        """Return whitened residuals and their derivative by the collar, poses eliminated, (n, 2 n_leds)."""
        poses = self.poses(collar_mm)
        step = 0.02
        R, t = poses.R_camera_brick, poses.t_camera_brick_mm
        ok = all_finite(R, 2)
        R, t = np.where(ok[:, None, None], R, np.eye(3)), np.where(ok[:, None], t, [0.0, 0.0, 150.0])
        low, high = collar_mm - step, collar_mm + step
        here, J = predict_brick(R, t, self._rays, self._brick, collar_mm=collar_mm)
        below, _ = predict_brick(R, t, self._rays, self._brick, collar_mm=low)
        above, _ = predict_brick(R, t, self._rays, self._brick, collar_mm=high)
        slope = (above.uv_px - below.uv_px) / (high - low)
        # Far from the solution every residual is long: outliers are those long beside the others.
        sigmas = np.nan_to_num(poses.sigmas)
        limit = _OUTLIER_SIGMAS * max(1.0, 1.5 * float(np.nanmedian(poses.sigmas)))
        seen = all_finite(self._uv) & ok[:, None] & (sigmas <= limit)
        n, n_leds = seen.shape
        L = np.linalg.inv(np.linalg.cholesky(np.where(seen[..., None, None], self._cov, np.eye(2))))
        mask = seen[..., None]
        r = np.where(mask, np.einsum("nlij,nlj->nli", L, self._uv - here.uv_px), 0.0).reshape(n, -1)
        d = np.where(mask, np.einsum("nlij,nlj->nli", L, slope), 0.0).reshape(n, -1)
        Jw = np.where(mask[..., None], L @ J, 0.0).reshape(n, 2 * n_leds, 6)
        Q, _ = np.linalg.qr(Jw)
        good = (ok & (seen.sum(axis=1) >= _MIN_LEDS))[:, None]
        r, d = (x - np.einsum("nij,nkj,nk->ni", Q, Q, x) for x in (r, d))
        return np.where(good, r, np.nan), np.where(good, d, np.nan)

    def shift_sd_per_radius(self, collar_mm: float, sd_mm: float) -> float:
        """Return what the shape leaves unknown; see `CollarFit`."""
        poses = self.poses(collar_mm)
        ok = all_finite(poses.R_camera_brick, 2)
        R, t = poses.R_camera_brick[ok], poses.t_camera_brick_mm[ok]
        here, _ = predict_brick(R, t, self._rays, self._brick, collar_mm=collar_mm)
        there, _ = predict_brick(R, t, self._rays, self._brick, collar_mm=collar_mm + sd_mm)
        per_radius = here.model_shift_px / shift_per_radius(collar_mm, self._brick)  # r sin psi, px
        length2 = np.sum(per_radius**2, axis=-1)
        by_collar = np.sum((there.uv_px - here.uv_px) * per_radius, axis=-1) / length2
        beside = np.sum(poses.residual_px[ok] * per_radius, axis=-1) / length2
        side_on = np.isfinite(beside) & (length2 > _SIDE_ON_PX**2)
        if not side_on.any():
            return DEFAULT_SHIFT_SD_PER_RADIUS
        n = np.maximum(side_on.sum(axis=0), 1)
        of_led = np.where(side_on, beside, 0.0).sum(axis=0) / n
        own = float(np.sqrt(np.mean(of_led[side_on.any(axis=0)] ** 2))) / OWN_SHARE
        common = float(np.sqrt(np.mean(by_collar[side_on] ** 2)))
        return float(min(max(np.hypot(own, common), LEAST_SHIFT_SD), UNKNOWN_SHIFT_PER_RADIUS))

    def solve(self, which: BoolArray, start_mm: float) -> float:
        """Return the collar that fits the given frames best."""
        collar = start_mm
        for _ in range(20):
            residual, slope = self.projected(collar)
            information = np.nansum(slope[which] ** 2)
            if not information > 1e-6:
                raise CalibrationError(
                    "these views do not determine the collar; tilt the brick between frames"
                )
            step = float(np.clip(np.nansum(slope[which] * residual[which]) / information, -0.5, 0.5))
            collar += step
            if abs(step) < 1e-4:
                break
        return collar
