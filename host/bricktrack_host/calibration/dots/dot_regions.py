"""Where dots may be: the compact round regions of a picture that stand out from their surroundings."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.calibration.dots.neighbours import Neighbours

Light = NDArray[np.float32]
"""Grey levels from 0 to 255, not necessarily whole."""

MIN_AREA_PX2 = 20.0
"""A dot under 5 px across has no plateau, and noise looks like it."""
MIN_FILL_OF_ELLIPSE = 0.85
"""Least ratio of a dot's area to that of its moment ellipse's; a disc has 1, a square 0.95, a cross 0.6."""
MAX_AXIS_RATIO = 2.0
"""Longest to shortest axis: a target tilted by 60 degrees."""
MIN_CONTRAST_GREY = 12.0
"""Least step from background to plateau, grey levels."""
MIN_RELATIVE_CONTRAST = 0.15
"""A dot must show this share of the picture's strongest contrasts."""
MAX_AREA_RATIO = 3.0
"""Dots next to each other differ less in area, large and small ones of a coded target included (1.96);
specks of dust and reflections are round too."""

_N_TYPICAL = 12


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """Compact foreground regions.

    Attributes
    ----------
    labels : ndarray of int32, shape (rows, columns)
        Label image of all regions, kept or not; 0 is the background.
    label : ndarray of int64, shape (n,)
        Labels of those kept.
    box : ndarray of int64, shape (n, 4), px
        Left, top, width, height.
    area_px2 : ndarray, shape (n,), px^2
        At half level.
    """

    labels: NDArray[np.int32]
    label: IntArray
    box: IntArray
    area_px2: FloatArray


def round_regions(light: Light) -> Regions:
    """Return the compact, round regions brighter than halfway between local dark and local bright.

    Regions at the picture's border are kept whatever their shape.
    """
    smooth = np.asarray(cv2.GaussianBlur(light, (0, 0), 1.0), dtype=np.float32)
    threshold, has_contrast = _local_threshold(smooth)
    mask = ((smooth > threshold) & has_contrast).astype(np.uint8)
    _, found, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4, ltype=cv2.CV_32S)
    labels = np.asarray(found, dtype=np.int32)
    box = stats[:, :4].astype(np.int64)
    area = stats[:, cv2.CC_STAT_AREA].astype(np.float64)
    rows, columns = light.shape
    fits = (area >= MIN_AREA_PX2) & (box[:, 2] < columns / 4) & (box[:, 3] < rows / 4)
    fits[0] = False
    at_edge = (
        (box[:, 0] == 0)
        | (box[:, 1] == 0)
        | (box[:, 0] + box[:, 2] == columns)
        | (box[:, 1] + box[:, 3] == rows)
    )
    is_round = fits & _are_round(labels, fits, box, area)
    keep = fits & (is_round | at_edge)
    guides = np.flatnonzero(is_round & ~at_edge)
    if not is_round.any():
        keep[:] = False
    elif len(guides):
        middle = box[:, :2] + box[:, 2:] / 2
        near = Neighbours(middle[guides]).nearest(middle[keep], min(_N_TYPICAL, len(guides)))[1]
        ratio = area[keep] / np.median(area[guides[near]], axis=1)
        keep[keep] = (ratio < MAX_AREA_RATIO) & ((ratio > 1 / MAX_AREA_RATIO) | at_edge[keep])
    kept = np.flatnonzero(keep).astype(np.int64)
    return Regions(labels, kept, box[kept], area[kept])


def _are_round(
    labels: NDArray[np.int32], fits: BoolArray, box: IntArray, area: FloatArray
) -> NDArray[np.bool_]:
    """Tell which regions are filled ellipses, by the moments of their pixels."""
    n = len(area)
    # All at once: sums over the picture grouped by label.
    v, u = np.nonzero(fits[labels])
    group = labels[v, u]
    count = np.bincount(group, minlength=n).clip(1)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(group, weights=values, minlength=n) / count)

    u_local = u - box[group, 0].astype(np.float64)
    v_local = v - box[group, 1].astype(np.float64)
    u_mean, v_mean = mean(u_local), mean(v_local)
    uu = mean(u_local * u_local) - u_mean**2 + 1 / 12  # a pixel is a square, not a point
    vv = mean(v_local * v_local) - v_mean**2 + 1 / 12
    uv = mean(u_local * v_local) - u_mean * v_mean
    half_trace, root = (uu + vv) / 2, np.hypot((uu - vv) / 2, uv)
    major, minor = half_trace + root, np.maximum(half_trace - root, 1e-9)
    fill = area / (4 * np.pi * np.sqrt(np.maximum(major, 1e-9) * minor))
    return np.asarray((np.sqrt(major / minor) < MAX_AXIS_RATIO) & (fill > MIN_FILL_OF_ELLIPSE))


def _local_threshold(smooth: Light) -> tuple[Light, NDArray[np.bool_]]:
    """Return, per pixel, the middle between the local dark and bright level, and where they differ."""
    tile = 8
    rows, columns = smooth.shape
    padded = cv2.copyMakeBorder(smooth, 0, -rows % tile, 0, -columns % tile, cv2.BORDER_REPLICATE)
    tiles = padded.reshape(padded.shape[0] // tile, tile, padded.shape[1] // tile, tile)
    low, high = tiles.min(axis=(1, 3)), tiles.max(axis=(1, 3))
    # A sixth of the picture's height holds several dots of any target worth fitting.
    reach = max(3, (rows // 6 // tile) | 1)
    kernel = np.ones((reach, reach), np.uint8)
    low = cv2.erode(low, kernel, borderType=cv2.BORDER_REPLICATE)
    high = cv2.dilate(high, kernel, borderType=cv2.BORDER_REPLICATE)
    size = (padded.shape[1], padded.shape[0])
    low_map = cv2.resize(cv2.blur(low, (reach, reach)), size)[:rows, :columns]
    high_map = cv2.resize(cv2.blur(high, (reach, reach)), size)[:rows, :columns]
    contrast = high_map - low_map
    strongest = float(np.percentile(contrast, 95))
    needed = max(MIN_CONTRAST_GREY, MIN_RELATIVE_CONTRAST * strongest)
    return np.asarray((low_map + high_map) / 2, dtype=np.float32), np.asarray(contrast >= needed)
