"""How noisy the centroids of a run are, measured from the run itself.

What no pose can explain of a frame is noise: the residuals in the directions that no pose reaches. The noise
of the pixels, what the profile leaves unknown and doubts about the motion are stated beforehand; the rest
(lens, mosaic, codec, the light's fall-off) is one more variance for all centroids of the run, and takes the
place of the floor that the segmentation put in.

Part of that rest stays the same while the picture does, so a hundred frames of a brick at rest say no more of
it than one: frames count as many as their residuals are independent, and what they do not say the floor does.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_common.rotations import matrix_from_rvec
from bricktrack_host.tracking.finite import all_finite
from bricktrack_host.tracking.first_poses import FirstPoses
from bricktrack_host.tracking.frame_motion import calm_frames, led_times_ns, motion_to_leds
from bricktrack_host.tracking.led_profile import collar_of, predict_brick
from bricktrack_host.tracking.light_kernel import FLOOR_SD_PX
from bricktrack_host.tracking.refine import OWN_SHARE, LedMotion
from bricktrack_host.tracks import LedObservations

logger = logging.getLogger(__name__)

_MIN_LEDS = 5
_MAX_FRAMES = 120
_PRIOR_DOF = 1.0
"""What the floor, of another camera, counts for beside the residuals' own degrees of freedom."""
_CLIP_SIGMAS = 3.0
_CLIPPED_VARIANCE = 0.9733  # of a normal variable within three sigmas of its mean
_SD_GRID_PX = np.geomspace(0.002, 2.0, 140)


@dataclass(frozen=True, slots=True, eq=False)
class CentroidNoise:
    """The noise of a run's centroids beside that of the pixels.

    Attributes
    ----------
    sd_px : float, px
        Of each of u and v, the part that the frames' residuals show and the prior together; to be used.
    seen_sd_px : float, px
        Of the residuals alone; NaN where no frame could tell.
    dof : float
        Independent residuals that say so.
    n_frames : int
    """

    sd_px: float
    seen_sd_px: float
    dof: float
    n_frames: int


def with_measured_noise(
    observations: LedObservations,
    first: FirstPoses,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    rolling_shutter: bool = True,
) -> LedObservations:
    """Return observations with the run's own noise in their covariances in place of the floor.

    Parameters
    ----------
    observations : LedObservations
        With covariances as the segmentation states them: the pixels' noise and `FLOOR_SD_PX`.
    first : FirstPoses
        Of the same observations.
    ray_model : RayModel
    brick_model : BrickModel
    rolling_shutter : bool
        False: the frames are taken for instants.
    """
    noise = measure_noise(observations, first, ray_model, brick_model, rolling_shutter=rolling_shutter)
    logger.info(
        "centroids: %.3f px from %.0f independent residuals in %d frames",
        noise.sd_px,
        noise.dof,
        noise.n_frames,
    )
    more = (noise.sd_px**2 - FLOOR_SD_PX**2) * np.eye(2)
    return replace(observations, cov_px2=observations.cov_px2 + more)


def measure_noise(
    observations: LedObservations,
    first: FirstPoses,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    rolling_shutter: bool = True,
) -> CentroidNoise:
    """Return the noise of a run's centroids; see `with_measured_noise`.

    Notes
    -----
    Restricted maximum likelihood: with K the complement of the pose's Jacobian, ``K' e`` does not depend on
    the pose, and has the covariance ``s^2 I + K' D K``, D being what is stated beforehand. One s for the run,
    without what lies beyond three sigmas. The answer is the mean of the inverse chi-square that prior and
    residuals give, which for few residuals is larger than their variance.
    """
    motion = None
    if rolling_shutter:
        t_ns, led_t_ns = led_times_ns(observations, ray_model)
        motion = motion_to_leds(t_ns, led_t_ns, first.R_camera_brick, first.t_camera_brick_mm)
    frames = calm_frames(first, motion, min_leds=_MIN_LEDS, at_most=_MAX_FRAMES)
    if frames.size == 0:
        return CentroidNoise(FLOOR_SD_PX, float("nan"), 0.0, 0)
    squares, stated, series = _free_residuals(frames, observations, first, motion, ray_model, brick_model)
    variance = _variance(squares, stated)
    dof = squares.size / max(frames.size / _independent(series), 1.0)
    total = _PRIOR_DOF + dof
    mean = (_PRIOR_DOF * FLOOR_SD_PX**2 + dof * variance) / max(total - 2.0, 1.0)
    return CentroidNoise(float(np.sqrt(mean)), float(np.sqrt(variance)), float(dof), int(frames.size))


def _free_residuals(
    frames: IntArray,
    observations: LedObservations,
    first: FirstPoses,
    motion: LedMotion | None,
    ray_model: RayModel,
    brick_model: BrickModel,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the squares of residuals that no pose explains, their stated variances, and a time series.

    The first two have shape (m,); the series (n_frames, n_leds, 2) is of residuals with the pose taken off,
    NaN where an LED is not used.
    """
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
    error = np.where(seen[..., None], first.uv_px[frames] - prediction.uv_px, 0.0)
    shift = prediction.model_shift_px
    pixels = observations.cov_px2[frames] - FLOOR_SD_PX**2 * np.eye(2)
    own = OWN_SHARE**2 * shift[..., :, None] * shift[..., None, :] + pixels
    by_twist = J * twist_dt[:, :, None, :]
    squares, stated, series = [], [], np.full((n, n_leds, 2), np.nan)
    for pattern in np.unique(seen, axis=0):
        rows = np.flatnonzero((seen == pattern).all(axis=1))
        m = 2 * int(pattern.sum())
        A = J[rows][:, pattern].reshape(len(rows), m, 6)
        e = error[rows][:, pattern].reshape(len(rows), m)
        common = shift[rows][:, pattern].reshape(len(rows), m, 1)
        T = by_twist[rows][:, pattern].reshape(len(rows), m, 6)
        D = common @ np.swapaxes(common, 1, 2) + T @ np.swapaxes(T, 1, 2)
        for k in range(m // 2):
            D[:, 2 * k : 2 * k + 2, 2 * k : 2 * k + 2] += own[rows][:, pattern][:, k]
        Q, _ = np.linalg.qr(A, mode="complete")
        K = Q[..., 6:]
        values, vectors = np.linalg.eigh(np.swapaxes(K, 1, 2) @ D @ K)
        z = (np.swapaxes(vectors, 1, 2) @ (np.swapaxes(K, 1, 2) @ e[..., None]))[..., 0]
        squares.append((z**2).ravel())
        stated.append(np.maximum(values, 0.0).ravel())
        free = (K @ (np.swapaxes(K, 1, 2) @ e[..., None]))[..., 0]
        block = np.full((len(rows), n_leds, 2), np.nan)
        block[:, pattern] = free.reshape(len(rows), -1, 2)
        series[rows] = block
    return np.concatenate(squares), np.concatenate(stated), series


def _variance(squares: FloatArray, stated: FloatArray) -> float:
    """Return the variance that, added to the stated ones, makes the squares likeliest; px^2."""
    use: BoolArray = np.ones(squares.shape, dtype=np.bool_)
    grid = _SD_GRID_PX**2
    variance = float(np.median(squares)) / 0.455  # of chi-square with one degree of freedom
    for _ in range(5):
        use = squares <= _CLIP_SIGMAS**2 * (variance + stated)
        total = grid[:, None] + stated[use]
        cost = np.sum(np.log(total) + squares[use] / _CLIPPED_VARIANCE / total, axis=1)
        at = int(np.argmin(cost))
        if grid[at] == variance:
            break
        variance = float(grid[at])
    return variance


def _independent(series: FloatArray) -> float:
    """Return how many of the frames' residuals are independent of each other, at least 1.

    Were they all, the mean over n frames would have the n-th part of their variance.
    """
    with np.errstate(invalid="ignore"):
        known = np.isfinite(series)
        count = known.sum(axis=0)
        mean = np.where(known, series, 0.0).sum(axis=0) / np.maximum(count, 1)
    many = count > 1
    if not many.any():
        return 1.0
    total = float(np.sum(np.where(known, series, 0.0)[:, many] ** 2) / np.sum(count[many]))
    of_means = float(np.sum(count[many] * mean[many] ** 2) / np.sum(count[many]))
    return max(total / max(of_means, 1e-30), 1.0)
