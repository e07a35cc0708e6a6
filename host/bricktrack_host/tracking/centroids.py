"""From a window of luma to one light: where it is, how well that is known, and what shape it has.

An LED in these pictures is a disc of some ten to forty pixels' radius whose inside is flat or saturated: all
that is known of its place is in its rim. So the centroid is that of the lit *area*, each pixel counted by the
share of it that the light covers. The share is the grey value in linear light between the local background
and the LED's own plateau, so that a rim smeared by the lens or by motion counts half where half the light
fell: motion blur then leaves the centroid at mid-exposure. Shares below `SHARE_LOW` are background, those
above `SHARE_HIGH` plateau: an uneven wall behind the LED and the fall of brightness towards a dome's limb do
not pull. Nothing depends on an absolute grey level, hence not on exposure.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray

Plane = NDArray[np.uint8]

SHARE_LOW = 0.15
SHARE_HIGH = 0.85
SEARCH_SHARE = 0.5
FLOOR_SD_PX = 0.06
"""Precision of dot centres on real photographs by a Pi camera (DESIGN 7.1): lens, mosaic and codec, which the
pixels' own noise does not show."""
_NOISE_CODES = 2.0  # shot, read-out and codec noise at the rim, in grey levels of 8 bits
_FLOOR_PX2 = FLOOR_SD_PX**2 * np.eye(2)
_OWN = 128
_MIN_CONTRAST = 0.02  # of full linear scale; less is noise or compression, not a lamp


@cache
def _linear_light() -> FloatArray:
    """Return linear light (0..1) of the 256 limited-range luma codes, by the inverse of Rec. 709's curve."""
    signal = np.clip((np.arange(256) - 16.0) / 219.0, 0.0, 255.0 / 219.0)
    light: FloatArray = np.where(signal < 0.081, signal / 4.5, ((signal + 0.099) / 1.099) ** (1 / 0.45))
    light.setflags(write=False)
    return light


@cache
def _linear_light_list() -> list[float]:
    values: list[float] = _linear_light().tolist()
    return values


def linear_light_of_luma() -> FloatArray:
    """Return the table from limited-range luma code to linear light, shape (256,), read-only."""
    return _linear_light()


@dataclass(frozen=True, slots=True, eq=False)
class Spot:
    """One light measured in a window.

    Attributes
    ----------
    uv_px : ndarray, shape (2,), px, image frame
    cov_px2 : ndarray, shape (2, 2), px^2
    area_px2 : float
        Lit area: the sum of the shares.
    eccentricity : float
        Of the ellipse of the same second moments: 0 for a disc.
    fill : float
        Area over that of the ellipse of the same second moments: 1 for an ellipse, less for rings, crescents
        and two lights run together.
    plateau, background : float
        Linear light, 0..1.
    bbox : tuple of int
        Column, row, width, height of the lit component in the image.
    touches_window : bool
        The light goes on beyond the window.
    """

    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: float
    eccentricity: float
    fill: float
    plateau: float
    background: float
    bbox: tuple[int, int, int, int]
    touches_window: bool


@dataclass(frozen=True, slots=True, eq=False)
class FoundLight:
    """One light found in a window, not yet measured.

    Attributes
    ----------
    mask : ndarray of uint8, shape (rows, columns)
        Of the window: 128 where the light is, 255 where others are, 0 elsewhere.
    box : tuple of int
        Column, row, width, height in the window.
    n_pixels : int
    share : ndarray, shape (256,)
        From luma code to the share of a pixel that the light covers, not yet cut to 0..1.
    plateau, background : float
        Linear light, 0..1.
    touches_window : bool
        The light goes on beyond the window.
    """

    mask: Plane
    box: tuple[int, int, int, int]
    n_pixels: int
    share: FloatArray
    plateau: float
    background: float
    touches_window: bool


def light_levels(patch: Plane) -> tuple[float, float] | None:
    """Return background and plateau of a window in linear light, or `None` where nothing shines.

    The two classes are separated by their means (Ridler and Calvard), from the histogram; the levels are the
    medians of the classes, which neither a reflection nor the rim moves.
    """
    counts = np.bincount(patch[::2, ::2].ravel(), minlength=256).astype(np.float64)
    # Lists: single numbers are looked up and reckoned with several times faster than in arrays.
    light = _linear_light_list()
    cum_n: list[float] = np.cumsum(counts).tolist()
    cum_light: list[float] = np.cumsum(counts * _linear_light()).tolist()
    total_n, total_light = cum_n[-1], cum_light[-1]
    lit = counts.nonzero()[0]
    low, high = light[lit[0]], light[lit[-1]]
    if high - low < _MIN_CONTRAST:
        return None
    threshold = 0.5 * (low + high)
    for _ in range(20):
        i = bisect_right(light, threshold) - 1
        n_below = cum_n[i]
        if n_below <= 0 or n_below >= total_n:
            return None
        new = 0.5 * (cum_light[i] / n_below + (total_light - cum_light[i]) / (total_n - n_below))
        if abs(new - threshold) < 1e-4:
            break
        threshold = new
    n_below = cum_n[i]
    background = light[bisect_left(cum_n, 0.5 * n_below)]
    plateau = light[bisect_left(cum_n, n_below + 0.5 * (total_n - n_below))]
    return (background, plateau) if plateau - background >= _MIN_CONTRAST else None


def measure_spot(
    patch: Plane,
    *,
    origin_px: tuple[int, int],
    near_px: tuple[float, float] | None = None,
    levels: tuple[float, float] | None = None,
) -> Spot | None:
    """Return the light in a window that lies nearest to ``near_px``, or `None` where there is none.

    Parameters
    ----------
    patch : ndarray of uint8, shape (rows, columns)
        Luma, limited range: a view into the picture.
    origin_px : (int, int), px
        Column and row, in the image, of ``patch[0, 0]``.
    near_px : (float, float), px, optional
        Where the light is expected; default the middle of the window.
    levels : (float, float), optional
        Background and plateau in linear light; default from the window, `light_levels`.

    Notes
    -----
    Covariance: each rim pixel's share errs by the noise over the contrast, independently, and lies at about
    the radius; so var = 2 M sum(var_share) / area^2, M the matrix of second moments. `FLOOR_SD_PX` is added.
    """
    u0, v0 = (
        near_px
        if near_px is not None
        else (origin_px[0] + patch.shape[1] / 2, origin_px[1] + patch.shape[0] / 2)
    )
    light = find_light(patch, near_px=(u0 - origin_px[0], v0 - origin_px[1]), levels=levels)
    return None if light is None else measure_light(patch, light, origin_px=origin_px)


def find_light(
    patch: Plane, *, near_px: tuple[float, float], levels: tuple[float, float] | None = None
) -> FoundLight | None:
    """Return the light nearest to a point (column, row) of a window, or `None` where there is none."""
    found = levels if levels is not None else light_levels(patch)
    if found is None:
        return None
    background, plateau = found
    share = (_linear_light() - background) / (plateau - background)
    rows, columns = patch.shape
    cut = int(np.searchsorted(share, SEARCH_SHARE))
    mask = np.asarray(cv2.threshold(patch, max(cut - 1, 0), 255, cv2.THRESH_BINARY)[1], dtype=np.uint8)
    seed = _lit_pixel(mask, near_px[0], near_px[1])
    if seed is None:
        return None
    n_pixels, _, _, (x, y, w, h) = cv2.floodFill(mask, None, seed, _OWN, flags=8)
    touches = x == 0 or y == 0 or x + w == columns or y + h == rows
    return FoundLight(mask, (x, y, w, h), n_pixels, share, plateau, background, touches)


def measure_light(patch: Plane, light: FoundLight, *, origin_px: tuple[int, int]) -> Spot | None:
    """Measure a light found in the same window; `None` where it is less than three pixels of light."""
    x, y, w, h = light.box
    share, mask = light.share, light.mask
    # The soft rim reaches beyond the half-light line; three pixels hold it, and more where motion smears it.
    reach = 3 + max(w, h) // 12
    x0, y0 = max(x - reach, 0), max(y - reach, 0)
    box = (slice(y0, y + h + reach), slice(x0, x + w + reach))
    mask = mask[box]
    is_own = mask == _OWN
    own = cv2.dilate(is_own.view(np.uint8), _square(reach))
    if mask.max() == 255:
        others = mask == 255
        own[(cv2.dilate(others.view(np.uint8), _square(reach)) > 0) & ~is_own] = 0
    table = np.minimum(np.maximum((share - SHARE_LOW) / (SHARE_HIGH - SHARE_LOW), 0.0), 1.0)
    weights = cv2.LUT(patch[box], table.astype(np.float32)) * own
    m: dict[str, Any] = cv2.moments(weights)
    area = float(m["m00"])
    if area < 3.0:
        return None
    uv = np.array([origin_px[0] + x0 + m["m10"] / area, origin_px[1] + y0 + m["m01"] / area])
    M = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / area
    half_trace = 0.5 * (M[0, 0] + M[1, 1])
    root = float(np.hypot(0.5 * (M[0, 0] - M[1, 1]), M[0, 1]))
    large, small = half_trace + root, max(half_trace - root, 1e-9)
    rim_codes = np.flatnonzero((table > 0) & (table < 1))
    if rim_codes.size:
        first, last = max(int(rim_codes[0]) - 1, 0), min(int(rim_codes[-1]) + 1, 255)
        slope = (table[last] - table[first]) / (last - first) * _NOISE_CODES
        noise = float(np.count_nonzero((weights > 0) & (weights < 1))) * float(slope**2)
    else:
        noise = float(w + h)
    cov = 2.0 * M * (noise / area**2) + _FLOOR_PX2
    return Spot(
        uv_px=uv,
        cov_px2=cov,
        area_px2=area,
        eccentricity=float(np.sqrt(1 - small / large)),
        fill=float(area / (4 * np.pi * np.sqrt(large * small))),
        plateau=light.plateau,
        background=light.background,
        bbox=(origin_px[0] + x, origin_px[1] + y, w, h),
        touches_window=light.touches_window,
    )


def _lit_pixel(mask: Plane, u: float, v: float) -> tuple[int, int] | None:
    """Return a pixel of the light nearest to a point: of the component, not of a speck beside it."""
    rows, columns = mask.shape
    i, j = min(max(round(u), 0), columns - 1), min(max(round(v), 0), rows - 1)
    if mask[j, i] and mask[max(j - 1, 0) : j + 2, max(i - 1, 0) : i + 2].all():
        return i, j
    n, labels, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_16U)
    if n < 2:
        return None
    areas = stats[1:, cv2.CC_STAT_AREA]
    distances = np.hypot(centres[1:, 0] - u, centres[1:, 1] - v) - np.sqrt(areas / np.pi)
    distances[areas < 0.05 * areas.max()] += rows + columns
    y, x = np.nonzero(labels == 1 + int(np.argmin(distances)))
    return int(x[0]), int(y[0])


@cache
def _square(radius: int) -> Plane:
    return np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8)
