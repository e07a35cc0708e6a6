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
from bricktrack_host.tracking.frame_errors import MIN_LEDS, FrameErrors, floor_px2
from bricktrack_host.tracking.pictures.light_kernel import FLOOR_SD_PX
from bricktrack_host.tracking.pose.finite import all_finite
from bricktrack_host.tracks import LedObservations

logger = logging.getLogger(__name__)

_PRIOR_DOF = 1.0
"""What the floor, of another camera, counts for beside the residuals' own degrees of freedom."""
_KIND_DOF = 8.0
"""What the whole run counts for beside the residuals of one kind of its pictures."""
_OTHERS, _KEYFRAME, _AFTER_KEYFRAME = range(3)
_CLIP_SIGMAS = 3.0
_CLIPPED_VARIANCE = 0.9733  # of a normal variable within three sigmas of its mean
_MOST_STANDING = 0.9  # of a centroid's variance: the noise of its pixels is new in every picture
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
    observations: LedObservations, errors: FrameErrors, is_keyframe: BoolArray | None = None
) -> LedObservations:
    """Return observations with the run's own noise in their covariances in place of the floor.

    Parameters
    ----------
    observations : LedObservations
        With covariances as the segmentation states them: the pixels' noise and `FLOOR_SD_PX`.
    errors : FrameErrors
        Of the same observations.
    is_keyframe : ndarray of bool, shape (n,), optional
        Frames whose pictures were coded for themselves; default: not known, all have one noise.
    """
    noise = measure_noise(errors)
    logger.info(
        "centroids: %.3f px from %.0f independent residuals in %d frames",
        noise.sd_px,
        noise.dof,
        noise.n_frames,
    )
    variance = np.full(len(observations.uv_px), noise.sd_px**2)
    if is_keyframe is not None:
        kinds = _picture_kinds(is_keyframe)
        variance = _variance_of_kinds(errors, kinds, noise)[kinds]
    more = variance[:, None] - floor_px2(observations.cov_px2)
    return replace(observations, cov_px2=observations.cov_px2 + more[..., None, None] * np.eye(2))


def _picture_kinds(is_keyframe: BoolArray) -> IntArray:
    kinds = np.where(np.append(False, is_keyframe[:-1]), _AFTER_KEYFRAME, _OTHERS)
    return np.where(is_keyframe, _KEYFRAME, kinds)


def _variance_of_kinds(errors: FrameErrors, kinds: IntArray, of_run: CentroidNoise) -> FloatArray:
    """Return the variance of the centroids in each kind of pictures, shape (3,), px^2.

    Kinds differ by a factor; how little the run's residuals may say of all of them is in the run's variance.
    """
    share = np.ones(3)
    for kind in range(3):
        own = measure_noise(errors, errors.seen & (kinds[errors.frames] == kind)[:, None])
        if own.dof > 0:
            shown = (own.seen_sd_px / of_run.seen_sd_px) ** 2
            share[kind] = (_KIND_DOF + own.dof * shown) / (_KIND_DOF + own.dof)
    return share * of_run.sd_px**2


def measure_noise(errors: FrameErrors, leds: BoolArray | None = None) -> CentroidNoise:
    """Return the noise of a run's centroids; of some LEDs of each frame if they are given, (n, n_leds).

    Notes
    -----
    Restricted maximum likelihood: with K the complement of the pose's Jacobian, ``K' e`` does not depend on
    the pose, and has the covariance ``s^2 I + K' D K``, D being what is stated beforehand. One s for the run,
    without what lies beyond three sigmas. The answer is the mean of the inverse chi-square that prior and
    residuals give, which for few residuals is larger than their variance.
    """
    leds = errors.seen if leds is None else leds
    enough = np.flatnonzero(leds.sum(axis=1) >= MIN_LEDS)
    if enough.size == 0:
        return CentroidNoise(FLOOR_SD_PX, float("nan"), 0.0, 0)
    squares, stated, series = _free_residuals(errors, leds, enough)
    variance = _variance(squares, stated)
    dof = squares.size / max(enough.size / _independent(series), 1.0)
    total = _PRIOR_DOF + dof
    mean = (_PRIOR_DOF * FLOOR_SD_PX**2 + dof * variance) / max(total - 2.0, 1.0)
    return CentroidNoise(float(np.sqrt(mean)), float(np.sqrt(variance)), float(dof), int(enough.size))


def standing_share(residual_px: FloatArray) -> float:
    """Return which share of the variance of a run's centroids stands still over it, 0 to 0.9.

    Parameters
    ----------
    residual_px : ndarray, shape (n, n_leds, 2), px
        Seen less predicted by the poses; NaN where an LED was not used.

    Notes
    -----
    What no pose explains of the mean picture is a handful of numbers, and may be small by chance: the share
    is the mean of the inverse chi-square that they give.
    """
    leds = all_finite(residual_px)
    enough = leds.sum(axis=1) >= MIN_LEDS
    if not enough.any():
        return _MOST_STANDING
    dof = 2 * float(np.median(leds[enough].sum(axis=1))) - 6
    return min(_MOST_STANDING, dof / (dof - 2) / _independent(residual_px[enough]))


def _free_residuals(
    errors: FrameErrors, leds: BoolArray, frames: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the squares of residuals that no pose explains, their stated variances, and a time series.

    The first two have shape (m,); the series (n_frames, n_leds, 2) is of residuals with the pose taken off,
    NaN where an LED is not used.
    """
    squares, stated, series = [], [], np.full((frames.size, leds.shape[1], 2), np.nan)
    for pattern in np.unique(leds[frames], axis=0):
        rows = np.flatnonzero((leds[frames] == pattern).all(axis=1))
        e, A, D = errors.of_leds(frames[rows], pattern)
        Q, _ = np.linalg.qr(A, mode="complete")
        K = Q[..., 6:]
        values, vectors = np.linalg.eigh(np.swapaxes(K, 1, 2) @ D @ K)
        z = (np.swapaxes(vectors, 1, 2) @ (np.swapaxes(K, 1, 2) @ e[..., None]))[..., 0]
        squares.append((z**2).ravel())
        stated.append(np.maximum(values, 0.0).ravel())
        free = (K @ (np.swapaxes(K, 1, 2) @ e[..., None]))[..., 0]
        block = np.full((len(rows), leds.shape[1], 2), np.nan)
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
