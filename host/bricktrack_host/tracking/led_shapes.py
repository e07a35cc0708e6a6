"""Lights that look other than they do from there: a card, or a reflection, begins to touch them.

Both take a part of a light's rim away, or add to it. A share s of the area at the rim, of radius r, moves the
centroid by ``s r``, changes the area by its share s, and the difference of the second moments in and across
its direction by 2 s of their sum. So the shape tells how far off the centroid may be long before a residual
does: that of an LED which decides the attitude nearly alone never does.
"""

import numpy as np
from scipy.ndimage import median_filter

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.rotations import rvec_from_matrix
from bricktrack_host.tracking.pictures.light_kernel import FLOOR_SD_PX

_SIGMAS = 3.0
_NEAR_FRAMES = 31
"""A second: what has stood there longer is the light's usual shape, and judged with the whole run. In fewer
frames nothing is usual."""
_VIEW_MM, _VIEW_RAD, _LEAST_VIEW = 10.0, 0.1, 0.03
"""Shapes change smoothly over such moves. Of a brick within a thirtieth of them nothing is learnt."""
_FITS = 4
_CLIP_SIGMAS = 2.5
_NORMAL_MEDIAN, _RAYLEIGH_MEDIAN = 0.6745, 1.1774  # of the length of a normal vector of one and of two


def doubt_by_shape(
    log_area_ratio: FloatArray,
    cov_px2: FloatArray,
    usable: BoolArray,
    R_camera_brick: FloatArray,
    t_camera_brick_mm: FloatArray,
) -> FloatArray:
    """Return how far centroids may be off, by what their lights' shapes are beside those of all other frames.

    Parameters
    ----------
    log_area_ratio : ndarray, shape (n, n_leds)
        Of the lights' areas over those that their poses predict; what each LED's has added does not matter.
    cov_px2 : ndarray, shape (n, n_leds, 2, 2), px^2
        As the segmentation states them: second moments times the pixels' noise, and `FLOOR_SD_PX`.
    usable : ndarray of bool, shape (n, n_leds)
        Lights of which these are known, and that are whole as far as is known.
    R_camera_brick, t_camera_brick_mm : ndarray, shapes (n, 3, 3) and (n, 3)

    Returns
    -------
    doubt : ndarray, shape (n, n_leds)
        In radii of the light; 0 where it may be noise, that of the frame's other lights or of the frames
        around it.
    """
    shapes = np.concatenate([log_area_ratio[..., None], _stretch(cov_px2)], axis=-1)
    usable = usable & np.isfinite(shapes).all(axis=-1)
    usable &= usable.sum(axis=0) >= _NEAR_FRAMES
    if not usable.any():
        return np.zeros(usable.shape)
    off = _off_their_usual(shapes, usable, _views(R_camera_brick, t_camera_brick_mm))
    larger, longer = np.abs(off[..., 0]), np.hypot(off[..., 1], off[..., 2])
    return np.maximum(
        _beyond_noise(larger, _NORMAL_MEDIAN, usable), 0.5 * _beyond_noise(longer, _RAYLEIGH_MEDIAN, usable)
    )


def _stretch(cov_px2: FloatArray) -> FloatArray:
    """Return how much longer lights are than wide, and which way, shape (..., 2): 0 for a disc.

    The difference of their second moments along u and v, and twice the mixed one, over their sum.
    """
    M = cov_px2 - FLOOR_SD_PX**2 * np.eye(2)
    difference = np.stack([M[..., 0, 0] - M[..., 1, 1], 2 * M[..., 0, 1]], axis=-1)
    return np.asarray(difference / (M[..., 0, 0] + M[..., 1, 1])[..., None])


def _views(R: FloatArray, t_mm: FloatArray) -> FloatArray:
    """Return the quadratic terms of the poses' differences from the middle one, shape (n, 28)."""
    turn = rvec_from_matrix(R[len(R) // 2].T @ R) / _VIEW_RAD
    x = np.hstack([turn, (t_mm - np.median(t_mm, axis=0)) / _VIEW_MM])
    i, j = np.tril_indices(6)
    return np.hstack([np.ones((len(x), 1)), x, x[:, i] * x[:, j]])


def _off_their_usual(shapes: FloatArray, usable: BoolArray, views: FloatArray) -> FloatArray:
    """Return shapes (n, n_leds, 3) less what is usual for their LED, seen from there and at that time.

    Least squares over the run, in which what lies far off counts no more than what lies at the edge of the
    usual; what then is left less its median about each frame. 0 where not usable.
    """
    n = len(shapes)
    weights = np.full(views.shape[1], n * _LEAST_VIEW**2)
    weights[0] = 0.0
    solve = np.linalg.solve(views.T @ views + np.diag(weights), views.T)
    out, frames = np.zeros(shapes.shape), np.arange(n)
    for k in np.flatnonzero(usable.any(axis=0)):
        seen = usable[:, k]
        fit = np.repeat(np.median(shapes[seen, k], axis=0)[None], n, axis=0)
        for _ in range(_FITS):
            left = np.where(seen[:, None], shapes[:, k] - fit, 0.0)
            limit = _CLIP_SIGMAS / _NORMAL_MEDIAN * np.median(np.abs(left[seen]), axis=0)
            fit = views @ (solve @ (fit + np.clip(left, -limit, limit)))
        for axis in range(3):
            left = shapes[seen, k, axis] - fit[seen, axis]
            filled = np.interp(frames, frames[seen], left)
            out[seen, k, axis] = left - median_filter(filled, _NEAR_FRAMES, mode="nearest")[seen]
    return out


def _beyond_noise(off: FloatArray, median_of_noise: float, usable: BoolArray) -> FloatArray:
    """Return lengths, (n, n_leds), and 0 for those that noise as all lights have it explains."""
    some = usable.any(axis=1)
    of_frame = np.nanmedian(np.where(usable, off, np.nan)[some], axis=1)
    sd = np.maximum(of_frame, median_filter(of_frame, _NEAR_FRAMES, mode="nearest")) / median_of_noise
    out = np.zeros(off.shape)
    out[some] = np.where(usable[some] & (off[some] > _SIGMAS * sd[:, None]), off[some], 0.0)
    return out
