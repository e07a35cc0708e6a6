"""The loops over the pixels of one light, compiled: its levels, its extent, its moments.

See `centroids` for what is measured and why. Planes come flat, with the number of bytes from row to row, so
that every decoder's pictures are of one type to the compiler; windows are columns u0..u1, rows v0..v1, ends
excluded, and nothing outside a window is looked at.
"""

from math import ceil, floor, hypot, nan, sqrt

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled, compiled_in_place
from bricktrack_host.tracking.pictures.lit_pixels import Bytes, Columns, light_near, near_others, widened

SHARE_LOW = 0.15
SHARE_HIGH = 0.85
SEARCH_SHARE = 0.5
FLOOR_SD_PX = 0.06
"""Precision of dot centres on real photographs by a Pi camera (DESIGN 7.1): lens, mosaic and codec, which the
pixels' own noise does not show."""
NOISE_CODES = 2.0  # shot, read-out and codec noise at the rim, in grey levels of 8 bits
MIN_CONTRAST = 0.02  # of full linear scale; less is noise or compression, not a lamp
_MIN_PIXELS = 8  # of a light that a larger window is worth

N_FIELDS = 15
U, V, COV_UU, COV_UV, COV_VV, AREA, ECCENTRICITY, FILL = range(8)
PLATEAU, BACKGROUND, BOX_U, BOX_V, BOX_WIDTH, BOX_HEIGHT, TOUCHES = range(8, N_FIELDS)
"""Columns of a measured light: px, px^2, linear light 0..1; an area of NaN is no light."""


@compiled
def window_levels(
    luma: Bytes, stride: int, u0: int, v0: int, u1: int, v1: int, linear: FloatArray
) -> tuple[float, float]:
    """Return background and plateau of a window in linear light; NaN where nothing shines."""
    count = _count_codes(luma, stride, u0, v0, u1, v1)
    lowest, highest = 255, 0
    for code in range(256):
        if count[code] > 0.0:
            lowest, highest = min(lowest, code), max(highest, code)
    if linear[highest] - linear[lowest] < MIN_CONTRAST:
        return nan, nan
    n_up_to, light_up_to = np.cumsum(count), np.cumsum(count * linear)
    n, light = n_up_to[255], light_up_to[255]
    threshold = light / n  # a glint beside the LED may be far brighter, but is small
    n_below = 0.0
    for _ in range(20):
        i = np.searchsorted(linear, threshold, side="right") - 1
        n_below = n_up_to[i]
        if n_below <= 0.0 or n_below >= n:
            return nan, nan
        new = 0.5 * (light_up_to[i] / n_below + (light - light_up_to[i]) / (n - n_below))
        if abs(new - threshold) < 1e-4:
            break
        threshold = new
    background = linear[np.searchsorted(n_up_to, 0.5 * n_below)]
    plateau = linear[np.searchsorted(n_up_to, n_below + 0.5 * (n - n_below))]
    return (background, plateau) if plateau - background >= MIN_CONTRAST else (nan, nan)


@compiled
def _count_codes(luma: Bytes, stride: int, u0: int, v0: int, u1: int, v1: int) -> FloatArray:
    """Return how many pixels of every other row and column have each code, shape (256,)."""
    # Neighbours mostly have the same code: counts in turn, so that none waits for the one before.
    counts = np.zeros((4, 256), dtype=np.int32)
    first, second, third, fourth = counts
    for v in range(v0, v1, 2):
        row = luma[v * stride + u0 : v * stride + u1]
        n = len(row)
        whole = n - n % 8
        for i in range(0, whole, 8):
            first[row[i]] += 1
            second[row[i + 2]] += 1
            third[row[i + 4]] += 1
            fourth[row[i + 6]] += 1
        for i in range(whole, n, 2):
            first[row[i]] += 1
    total = np.empty(256)
    for code in range(256):
        total[code] = first[code] + second[code] + third[code] + fourth[code]
    return total


@compiled
def measure_windows(
    luma: Bytes,
    stride: int,
    rows: int,
    columns: int,
    places_px: FloatArray,
    half_sizes_px: FloatArray,
    linear: FloatArray,
) -> FloatArray:
    """Measure each light in a window about twice its size, larger where it does not fit.

    Parameters
    ----------
    luma : ndarray of uint8, flat
    stride, rows, columns : int
        Bytes from row to row; the picture's size.
    places_px, half_sizes_px : ndarray, shape (n, 2), px
        Centres, and half the bounding boxes, columns and rows.
    linear : ndarray, shape (256,)
        From luma code to linear light.

    Returns
    -------
    lights : ndarray, shape (n, N_FIELDS)
    """
    out = np.full((len(places_px), N_FIELDS), nan)
    for k in range(len(places_px)):
        u, v = places_px[k]
        half_u, half_v = half_sizes_px[k]
        margin_u, margin_v = 8.0 + 0.35 * half_u, 8.0 + 0.35 * half_v
        for attempt in range(3):
            u0, v0 = max(floor(u - half_u - margin_u), 0), max(floor(v - half_v - margin_v), 0)
            u1 = min(ceil(u + half_u + margin_u) + 1, columns)
            v1 = min(ceil(v + half_v + margin_v) + 1, rows)
            if u1 - u0 < 4 or v1 - v0 < 4:
                break
            complete = measure_window(
                luma, stride, rows, columns, u0, v0, u1, v1, u, v, linear, attempt < 2, out[k]
            )
            if complete:
                break
            margin_u, margin_v = 2.0 * margin_u, 2.0 * margin_v
    return out


@compiled
def measure_window(
    luma: Bytes,
    stride: int,
    rows: int,
    columns: int,
    u0: int,
    v0: int,
    u1: int,
    v1: int,
    near_u: float,
    near_v: float,
    linear: FloatArray,
    may_grow: bool,
    out: FloatArray,
) -> bool:
    """Measure the light of a window that lies nearest to a point; False if it needs a larger window."""
    background, plateau = window_levels(luma, stride, u0, v0, u1, v1, linear)
    if not plateau > background:
        return True
    share = (linear - background) / (plateau - background)
    cut = np.uint8(np.searchsorted(share, SEARCH_SHARE))
    x, y, w, h, n_pixels, first, last, mask = light_near(
        luma, stride, u0, v0, u1, v1, cut, near_u - u0, near_v - v0
    )
    if n_pixels == 0:
        return True
    touches = x == 0 or y == 0 or x + w == u1 - u0 or y + h == v1 - v0
    at_border = u0 + x <= 0 or v0 + y <= 0 or u0 + x + w >= columns or v0 + y + h >= rows
    inside_a_light = background > 0.6 * plateau
    if may_grow and ((touches and not at_border) or inside_a_light) and n_pixels >= _MIN_PIXELS:
        return False
    out[PLATEAU], out[BACKGROUND], out[TOUCHES] = plateau, background, 1.0 if touches else 0.0
    out[BOX_U], out[BOX_V], out[BOX_WIDTH], out[BOX_HEIGHT] = u0 + x, v0 + y, w, h
    # The soft rim reaches beyond the half-light line; three pixels hold it, and more where motion smears it.
    reach = 3 + max(w, h) // 12
    x0, y0 = max(x - reach, 0), max(y - reach, 0)
    x1, y1 = min(x + w + reach, u1 - u0), min(y + h + reach, v1 - v0)
    first, last = widened(first[y0:y1], last[y0:y1], reach, x0, x1)
    others = near_others(mask[y0:y1, x0:x1], reach)
    _moments(luma, stride, u0, v0, (x0, y0, x1, y1), first, last, others, w + h, share, out)
    return True


@compiled
def _moments(
    luma: Bytes,
    stride: int,
    u0: int,
    v0: int,
    part: tuple[int, int, int, int],
    first: Columns,
    last: Columns,
    others: Bytes,
    size: int,
    share: FloatArray,
    out: FloatArray,
) -> None:
    """Measure the light of a part of the window: each pixel counts by the share of it that the light covers.

    ``part`` is its first column and row and those behind its last, ``first`` and ``last`` the columns of the
    light and its rim in each of its rows, ``others`` where another light's rim is (empty if there is none).
    """
    x0, y0, x1, y1 = part
    weight_of = np.minimum(np.maximum((share - SHARE_LOW) / (SHARE_HIGH - SHARE_LOW), 0.0), 1.0)
    middle_x, middle_y = 0.5 * (x1 - x0), 0.5 * (y1 - y0)
    low, high = 256, -1  # the codes of a rim
    for code in range(256):
        if 0.0 < weight_of[code] < 1.0:
            low, high = min(low, code), max(high, code)
    area, sum_x, sum_y, sum_xx, sum_xy, sum_yy, n_rim = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for j in range(y1 - y0):
        at = (v0 + y0 + j) * stride + u0
        row, dx, dy = luma[at + first[j] : at + last[j] + 1], first[j] - x0 - middle_x, j - middle_y
        beside = others[j, first[j] - x0 : last[j] + 1 - x0] if others.size else others[:0, 0]
        if _is_any(beside):
            row_area, row_x, row_xx, n = _sums_without(row, beside, weight_of, dx, low, high)
        else:
            row_area, row_x, row_xx, n = _sums(row, weight_of, dx, low, high)
        area += row_area
        sum_x += row_x
        sum_y += row_area * dy
        sum_xx += row_xx
        sum_xy += row_x * dy
        sum_yy += row_area * dy * dy
        n_rim += n
    if area < 3.0:
        return
    mean_x, mean_y = sum_x / area, sum_y / area
    xx, xy = sum_xx / area - mean_x * mean_x, sum_xy / area - mean_x * mean_y
    yy = sum_yy / area - mean_y * mean_y
    half_trace, root = 0.5 * (xx + yy), hypot(0.5 * (xx - yy), xy)
    large, small = max(half_trace + root, 1e-9), max(half_trace - root, 1e-9)
    noise = float(size)
    if high >= 0:
        low, high = max(low - 1, 0), min(high + 1, 255)
        slope = (weight_of[high] - weight_of[low]) / (high - low) * NOISE_CODES
        noise = n_rim * slope * slope
    spread = 2.0 * noise / (area * area)
    out[U], out[V] = u0 + x0 + middle_x + mean_x, v0 + y0 + middle_y + mean_y
    out[COV_UU] = spread * xx + FLOOR_SD_PX**2
    out[COV_UV] = spread * xy
    out[COV_VV] = spread * yy + FLOOR_SD_PX**2
    out[AREA] = area
    out[ECCENTRICITY] = sqrt(max(1.0 - small / large, 0.0))
    out[FILL] = area / (4.0 * np.pi * sqrt(large * small))


@compiled_in_place
def _is_any(marks: Bytes) -> bool:
    n = 0
    for i in range(len(marks)):
        n += marks[i]
    return n > 0


@compiled_in_place
def _sums(
    row: Bytes, weight_of: FloatArray, dx: float, low: int, high: int
) -> tuple[float, float, float, int]:
    """Return a row's sums of weights, times dx and its square, dx growing by 1, and its pixels of the rim."""
    row_area, row_x, row_xx, n_rim = 0.0, 0.0, 0.0, 0
    for i in range(len(row)):
        weight = weight_of[row[i]]
        row_area += weight
        row_x += weight * dx
        row_xx += weight * dx * dx
        dx += 1.0
    for i in range(len(row)):
        n_rim += low <= row[i] <= high
    return row_area, row_x, row_xx, n_rim


@compiled_in_place
def _sums_without(
    row: Bytes, beside: Bytes, weight_of: FloatArray, dx: float, low: int, high: int
) -> tuple[float, float, float, int]:
    """Return what `_sums` does, of pixels that are not marked."""
    row_area, row_x, row_xx, n_rim = 0.0, 0.0, 0.0, 0
    for i in range(len(row)):
        if not beside[i]:
            weight = weight_of[row[i]]
            row_area += weight
            row_x += weight * dx
            row_xx += weight * dx * dx
            n_rim += low <= row[i] <= high
        dx += 1.0
    return row_area, row_x, row_xx, n_rim
