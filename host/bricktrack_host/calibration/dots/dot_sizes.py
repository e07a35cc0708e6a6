"""Small dots, large ones, and odd ones: each dot's area and shape beside those of the dots around it.

Distance, slant and distortion change the dots' areas smoothly over a picture, so only dots of one
neighbourhood are compared.
"""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.calibration.dots.neighbours import Neighbours
from bricktrack_host.calibration.target.printed_target import LARGE_RATIO

LARGE_AREA_RATIO = LARGE_RATIO**2
MAX_ODD = 0.35
"""Share of the way from small to large by which a dot may miss its class."""
MIN_ODD_SHAPE = 0.06
"""No dot is odd whose second moments differ by less than this share from its neighbours'."""
ODD_SIGMAS = 8.0

_N_AROUND = 24
_SMALL_PERCENTILE = 30.0  # a quarter are large: of 24 dots more than 16 are so once in 5 million
_N_ROUNDS = 3


def area_ratios(uv_px: FloatArray, area_px2: FloatArray) -> FloatArray:
    """Return each dot's area by that of the small dots around it.

    Parameters
    ----------
    uv_px : ndarray, shape (n, 2), px
    area_px2 : ndarray, shape (n,), px^2

    Returns
    -------
    ratio : ndarray, shape (n,)
        About 1 for small dots and 1.96 for large ones. All are about 1 where there is one size only.
    """
    n = len(uv_px)
    log_area = np.log(area_px2)
    near = Neighbours(uv_px).nearest(uv_px, min(_N_AROUND, n))[1]
    small = np.percentile(log_area[near], _SMALL_PERCENTILE, axis=1)
    step = np.log(LARGE_AREA_RATIO)
    if n >= _N_AROUND:
        # A plane through the neighbourhood's areas, once it is known which are large.
        offset = uv_px[near] - uv_px[:, None]
        scale = np.abs(offset).max(axis=(1, 2))[:, None, None]
        design = np.concatenate([np.ones((*near.shape, 1)), offset / scale], axis=2)
        for _ in range(_N_ROUNDS):
            share = (log_area - small) / step
            is_large = share > 0.5
            as_small = log_area - step * is_large
            # What fits neither class has no say.
            weight = (np.abs(share - is_large) < MAX_ODD)[near].astype(np.float64)[..., None]
            normal = np.swapaxes(design * weight, 1, 2) @ design + 1e-6 * np.eye(3)
            right = np.swapaxes(design * weight, 1, 2) @ as_small[near][..., None]
            count = weight[:, :, 0].sum(axis=1)
            fitted = np.linalg.solve(normal, right)[:, 0, 0]
            small = np.where(count >= 8, fitted, small)
    return np.asarray(np.exp(log_area - small))


def size_classes(ratio: FloatArray) -> IntArray:
    """Return 1 for large dots, 0 for small ones, and -1 where the area fits neither.

    Parameters
    ----------
    ratio : ndarray, shape (n,)
        As `area_ratios` returns it.

    Examples
    --------
    >>> size_classes(np.array([1.02, 1.9, 1.4, 0.6])).tolist()
    [0, 1, -1, -1]
    """
    share = np.log(ratio) / np.log(LARGE_AREA_RATIO)
    nearest = np.clip(np.rint(share), 0, 1)
    return np.where(np.abs(share - nearest) < MAX_ODD, nearest, -1).astype(np.int64)


def have_odd_shapes(uv_px: FloatArray, shape_px2: FloatArray) -> BoolArray:
    """Tell which dots have another shape than their neighbours: glare, dirt, or not dots at all.

    Parameters
    ----------
    uv_px : ndarray, shape (n, 2), px
    shape_px2 : ndarray, shape (n, 2, 2), px^2
        Second moments of the dots' light, those of large dots divided by `LARGE_AREA_RATIO`.
    """
    n = len(uv_px)
    k = min(_N_AROUND // 2 + 1, n)
    if k < 6:
        return np.zeros(n, dtype=np.bool_)
    near = Neighbours(uv_px).nearest(uv_px, k)[1][:, 1:]
    usual = np.median(shape_px2[near], axis=1)
    size = np.trace(usual, axis1=1, axis2=2)
    differing = np.sqrt(2 * np.sum((shape_px2 - usual) ** 2, axis=(1, 2))) / size
    return np.asarray(differing > np.maximum(MIN_ODD_SHAPE, ODD_SIGMAS * np.median(differing)))
