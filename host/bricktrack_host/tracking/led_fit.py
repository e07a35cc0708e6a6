"""Fit what an LED type shows, its lit collar, from a recording, together with the poses.

The collar moves every centroid along its LED's axis by an amount that depends on the view, the poses move all
of them together: over a sweep the two come apart. Judged by cross-validation: with the collar fitted on
other frames, the residuals of the frames left out must shrink.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.errors import CalibrationError
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.led_profile import predict_brick
from bricktrack_host.tracking.led_tracker import NOT_USED
from bricktrack_host.tracking.prsoi import prsoi_starts
from bricktrack_host.tracking.refine import RefinedPoses, refine_poses
from bricktrack_host.tracks import LedObservations

_MIN_LEDS = 5  # four leave two degrees of freedom, which one collar and a false pose share too easily
_MIN_FRAMES = 5
_N_FOLDS = 5
_OUTLIER_SIGMAS = 4.0


@dataclass(frozen=True, slots=True)
class CollarFit:
    """A fitted collar.

    Attributes
    ----------
    collar_mm : float
    sd_mm : float
        From the residuals of frames taken as independent groups, since errors of one frame's LEDs, and of
        frames at rest, repeat.
    rms_px : float
        Of the residuals, each of u and v, with the collar.
    cross_validated_rms_px : float
        Of frames left out of the fit.
    rms_without_px : float
        Of the same frames with a sphere's centroid in place of the profile.
    n_frames, n_leds : int
        Frames, and LEDs in them, that were used.
    """

    collar_mm: float
    sd_mm: float
    rms_px: float
    cross_validated_rms_px: float
    rms_without_px: float
    n_frames: int
    n_leds: int

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
    max_collar_radii : float
        Longest collar believed, in LED radii.

    Returns
    -------
    CollarFit

    Raises
    ------
    CalibrationError
        If fewer than five frames show five LEDs, the views do not determine the collar, or the fit leaves
        the range from 0 to ``max_collar_radii``.

    Notes
    -----
    Gauss-Newton on the collar with the poses eliminated in every frame (variable projection).
    """
    used = ((observations.led_flags & NOT_USED) == 0) & all_finite(observations.uv_px)
    frames = np.flatnonzero(used.sum(axis=1) >= _MIN_LEDS)
    if frames.size < _MIN_FRAMES:
        raise CalibrationError(
            f"{frames.size} frames with {_MIN_LEDS} or more whole LEDs; the LED profile needs {_MIN_FRAMES}. "
            "Record a sweep with all LEDs in view."
        )
    uv = np.where(used[..., None], observations.uv_px, np.nan)[frames]
    problem = _Problem(uv, observations.cov_px2[frames], ray_model, brick_model)
    everything = np.ones(frames.size, dtype=bool)
    collar = problem.solve(everything, start_mm)
    longest = max_collar_radii * float(brick_model.led_radii_mm.max())
    if not 0 <= collar <= longest:
        raise CalibrationError(
            f"fitted collar is {collar:.3f} mm; expected 0 to {longest:g} mm. Check the LEDs' axes and "
            "radii in the layout, and the calibration."
        )
    residual, slope = problem.projected(collar)
    information = np.nansum(slope**2, axis=1)
    score = np.nansum(slope * residual, axis=1)
    # Sandwich: the frames' scores scatter as they do, whatever the centroids' covariance says.
    sd = float(np.sqrt(np.sum(score**2)) / information.sum())
    folds = np.arange(frames.size) % min(_N_FOLDS, frames.size)
    held_out = np.full(uv.shape, np.nan)
    for fold in np.unique(folds):
        out = folds == fold
        held_out[out] = problem.poses(problem.solve(~out, collar)).residual_px[out]
    without = problem.poses(None).residual_px
    return CollarFit(
        collar_mm=collar,
        sd_mm=max(sd, float(1 / np.sqrt(information.sum()))),
        rms_px=_rms(problem.poses(collar).residual_px),
        cross_validated_rms_px=_rms(held_out),
        rms_without_px=_rms(without),
        n_frames=int(frames.size),
        n_leds=int(np.isfinite(uv[..., 0]).sum()),
    )


def _rms(residual_px: FloatArray) -> float:
    return float(np.sqrt(np.nanmean(residual_px**2)))


class _Problem:
    """Residuals of all frames for a collar, with the poses fitted; outliers are left out as they show."""

    def __init__(self, uv: FloatArray, cov: FloatArray, ray_model: RayModel, brick_model: BrickModel) -> None:
        self._uv, self._cov = uv.copy(), cov
        self._rays, self._brick = ray_model, brick_model
        self._R, self._t = prsoi_starts(uv, ray_model, brick_model)
        if not all_finite(self._R, 2).any():
            raise CalibrationError("no frame has a start pose; the seen LEDs must not lie in one plane")

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
        low, high = max(collar_mm - step, 0.0), collar_mm + step
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

    def solve(self, which: BoolArray, start_mm: float) -> float:
        """Return the collar that fits the given frames best."""
        collar = start_mm
        for _ in range(20):
            residual, slope = self.projected(max(collar, 0.0))
            information = np.nansum(slope[which] ** 2)
            if not information > 1e-6:
                raise CalibrationError(
                    "these views do not determine the collar; tilt the brick between frames"
                )
            step = float(np.clip(np.nansum(slope[which] * residual[which]) / information, -0.5, 0.5))
            collar = max(collar, 0.0) + step
            if abs(step) < 1e-4 or collar < -0.3:
                break
        return collar
