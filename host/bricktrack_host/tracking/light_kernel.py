"""The loops over the pixels of one light, compiled: its levels, its extent, its moments.

See `centroids` for what is measured and why. Planes come flat, with the number of bytes from row to row, so
that every decoder's pictures are of one type to the compiler; windows are columns u0..u1, rows v0..v1, ends
excluded, and nothing outside a window is looked at.
"""

from math import ceil, floor, hypot, inf, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled

Bytes = NDArray[np.uint8]
Stack = NDArray[np.int32]

SHARE_LOW = 0.15
SHARE_HIGH = 0.85
SEARCH_SHARE = 0.5
FLOOR_SD_PX = 0.06
"""Precision of dot centres on real photographs by a Pi camera (DESIGN 7.1): lens, mosaic and codec, which the
pixels' own noise does not show."""
NOISE_CODES = 2.0  # shot, read-out and codec noise at the rim, in grey levels of 8 bits
MIN_CONTRAST = 0.02  # of full linear scale; less is noise or compression, not a lamp
_MIN_PIXELS = 8  # of a light that a larger window is worth
_DARK, _LIT, _OWN = 0, 1, 2

N_FIELDS = 15
U, V, COV_UU, COV_UV, COV_VV, AREA, ECCENTRICITY, FILL = range(8)
PLATEAU, BACKGROUND, BOX_U, BOX_V, BOX_WIDTH, BOX_HEIGHT, TOUCHES = range(8, N_FIELDS)
"""Columns of a measured light: px, px^2, linear light 0..1; an area of NaN is no light."""


@compiled
def window_levels(
    luma: Bytes, stride: int, u0: int, v0: int, u1: int, v1: int, linear: FloatArray
) -> tuple[float, float]:
    """Return background and plateau of a window in linear light; NaN where nothing shines."""
    count = np.zeros(256)
    for v in range(v0, v1, 2):
        for u in range(u0, u1, 2):
            count[luma[v * stride + u]] += 1.0
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
    height, width = v1 - v0, u1 - u0
    mask = np.empty((height, width), dtype=np.uint8)
    n_lit = 0
    for j in range(height):
        row = (v0 + j) * stride + u0
        for i in range(width):
            mask[j, i] = _LIT if luma[row + i] >= cut else _DARK
            n_lit += mask[j, i]
    stack = stack_for(mask)
    seed = _seed_near(mask, stack, near_u - u0, near_v - v0)
    if seed < 0:
        return True
    x, y, w, h, n_pixels, _, _ = fill_component(mask, stack, seed, _LIT, _OWN)
    touches = x == 0 or y == 0 or x + w == width or y + h == height
    at_border = u0 + x <= 0 or v0 + y <= 0 or u0 + x + w >= columns or v0 + y + h >= rows
    inside_a_light = background > 0.6 * plateau
    if may_grow and ((touches and not at_border) or inside_a_light) and n_pixels >= _MIN_PIXELS:
        return False
    out[PLATEAU], out[BACKGROUND], out[TOUCHES] = plateau, background, 1.0 if touches else 0.0
    out[BOX_U], out[BOX_V], out[BOX_WIDTH], out[BOX_HEIGHT] = u0 + x, v0 + y, w, h
    _moments(luma, stride, u0, v0, mask, n_lit > n_pixels, x, y, w, h, share, out)
    return True


@compiled
def _seed_near(mask: Bytes, stack: Stack, u: float, v: float) -> int:
    """Return a pixel of the light nearest to a point: of the component, not of a speck beside it; or -1."""
    rows, columns = mask.shape
    i, j = min(max(round(u), 0), columns - 1), min(max(round(v), 0), rows - 1)
    if mask[j, i] != _DARK:
        alone = False
        for jj in range(max(j - 1, 0), min(j + 2, rows)):
            for ii in range(max(i - 1, 0), min(i + 2, columns)):
                alone = alone or mask[jj, ii] == _DARK
        if not alone:
            return int(j * columns + i)
    # Every component once, marked as done; the marks are taken back below.
    seeds = np.empty((mask.size, 3))  # first pixel, area, distance from the rim
    n, largest = 0, 0.0
    for p in range(mask.size):
        if mask[p // columns, p % columns] == _LIT:
            _, _, _, _, area, mean_x, mean_y = fill_component(mask, stack, p, _LIT, _OWN)
            seeds[n] = float(p), float(area), hypot(mean_x - u, mean_y - v) - sqrt(area / np.pi)
            largest = max(largest, float(area))
            n += 1
    best, nearest = -1, inf
    for k in range(n):
        if seeds[k, 1] >= 0.05 * largest and seeds[k, 2] < nearest:
            best, nearest = int(seeds[k, 0]), seeds[k, 2]
    for p in range(mask.size):
        if mask[p // columns, p % columns] == _OWN:
            mask[p // columns, p % columns] = _LIT
    return best


@compiled
def stack_for(mask: Bytes) -> Stack:
    """Return a stack that is large enough for `fill_component`.

    A row of c pixels holds at most (c + 1) / 2 runs, and two rows of a and b runs touch in at most a + b
    places, each of which is put on the stack once at most.
    """
    return np.empty((mask.shape[0] + 1) * (mask.shape[1] + 1), dtype=np.int32)


@compiled
def fill_component(
    mask: Bytes, stack: Stack, seed: int, old: int, new: int
) -> tuple[int, int, int, int, int, float, float]:
    """Mark a component (8 neighbours), run by run; return its box x, y, w, h, pixels, mean column and row."""
    rows, columns = mask.shape
    stack[0] = seed
    n_stack, n_pixels, sum_x, sum_y = 1, 0, 0.0, 0.0
    x0, y0, x1, y1 = columns, rows, -1, -1
    while n_stack > 0:
        n_stack -= 1
        j, first = stack[n_stack] // columns, stack[n_stack] % columns
        if mask[j, first] != old:
            continue
        last = first
        while first > 0 and mask[j, first - 1] == old:
            first -= 1
        while last < columns - 1 and mask[j, last + 1] == old:
            last += 1
        for i in range(first, last + 1):
            mask[j, i] = new
        n = last - first + 1
        n_pixels += n
        sum_x += 0.5 * n * (first + last)
        sum_y += n * j
        x0, x1, y0, y1 = min(x0, first), max(x1, last), min(y0, j), max(y1, j)
        for jj in (j - 1, j + 1):
            if 0 <= jj < rows:
                in_run = False
                for i in range(max(first - 1, 0), min(last + 2, columns)):
                    if mask[jj, i] == old:
                        if not in_run:
                            stack[n_stack] = jj * columns + i
                            n_stack += 1
                        in_run = True
                    else:
                        in_run = False
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1, n_pixels, sum_x / n_pixels, sum_y / n_pixels


@compiled
def _near_own(mask: Bytes, reach: int) -> tuple[IntArray, IntArray]:
    """Return the first and last column of each row within ``reach`` rows and columns of the component."""
    rows, columns = mask.shape
    first, last = np.full(rows, columns), np.full(rows, -1)
    for j in range(rows):
        for i in range(columns):
            if mask[j, i] == _OWN:
                for jj in range(max(j - reach, 0), min(j + reach + 1, rows)):
                    first[jj] = min(first[jj], max(i - reach, 0))
                break
        for i in range(columns - 1, -1, -1):
            if mask[j, i] == _OWN:
                for jj in range(max(j - reach, 0), min(j + reach + 1, rows)):
                    last[jj] = max(last[jj], min(i + reach, columns - 1))
                break
    return first, last


@compiled
def _near(mask: Bytes, kind: int, reach: int) -> Bytes:
    """Return 1 within ``reach`` rows and columns of a pixel of one kind: dilation by a square."""
    rows, columns = mask.shape
    wide = np.zeros((rows, columns), dtype=np.uint8)
    for j in range(rows):
        filled_to = 0
        for i in range(columns):
            if mask[j, i] == kind:
                to = min(i + reach + 1, columns)
                for ii in range(max(i - reach, filled_to), to):
                    wide[j, ii] = 1
                filled_to = to
    out = np.empty((rows, columns), dtype=np.uint8)
    rows_since = np.full(columns, reach + 1, dtype=np.int32)  # a marked one: downwards, then upwards
    for j in range(rows):
        for i in range(columns):
            rows_since[i] = 0 if wide[j, i] else rows_since[i] + 1
            out[j, i] = rows_since[i] <= reach
    rows_since[:] = reach + 1
    for j in range(rows - 1, -1, -1):
        for i in range(columns):
            rows_since[i] = 0 if wide[j, i] else rows_since[i] + 1
            out[j, i] |= rows_since[i] <= reach
    return out


@compiled
def _moments(
    luma: Bytes,
    stride: int,
    u0: int,
    v0: int,
    mask: Bytes,
    has_others: bool,
    x: int,
    y: int,
    w: int,
    h: int,
    share: FloatArray,
    out: FloatArray,
) -> None:
    """Measure the component marked as own: each pixel counts by the share of it that the light covers."""
    # The soft rim reaches beyond the half-light line; three pixels hold it, and more where motion smears it.
    reach = 3 + max(w, h) // 12
    x0, y0 = max(x - reach, 0), max(y - reach, 0)
    part = mask[y0 : min(y + h + reach, mask.shape[0]), x0 : min(x + w + reach, mask.shape[1])]
    first_of_row, last_of_row = _near_own(part, reach)
    others = _near(part, _LIT, reach) if has_others else part
    weight_of = np.minimum(np.maximum((share - SHARE_LOW) / (SHARE_HIGH - SHARE_LOW), 0.0), 1.0)
    middle_x, middle_y = 0.5 * part.shape[1], 0.5 * part.shape[0]
    area, sum_x, sum_y, sum_xx, sum_xy, sum_yy, n_rim = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0
    for j in range(part.shape[0]):
        row = (v0 + y0 + j) * stride + u0 + x0
        row_area, row_x, row_xx, dy = 0.0, 0.0, 0.0, j - middle_y
        for i in range(first_of_row[j], last_of_row[j] + 1):
            if has_others and others[j, i] and part[j, i] != _OWN:
                continue
            weight, dx = weight_of[luma[row + i]], i - middle_x
            row_area += weight
            row_x += weight * dx
            row_xx += weight * dx * dx
            n_rim += 0.0 < weight < 1.0
        area += row_area
        sum_x += row_x
        sum_y += row_area * dy
        sum_xx += row_xx
        sum_xy += row_x * dy
        sum_yy += row_area * dy * dy
    if area < 3.0:
        return
    mean_x, mean_y = sum_x / area, sum_y / area
    xx, xy = sum_xx / area - mean_x * mean_x, sum_xy / area - mean_x * mean_y
    yy = sum_yy / area - mean_y * mean_y
    half_trace, root = 0.5 * (xx + yy), hypot(0.5 * (xx - yy), xy)
    large, small = max(half_trace + root, 1e-9), max(half_trace - root, 1e-9)
    noise = float(w + h)
    first, last = 256, -1
    for code in range(256):
        if 0.0 < weight_of[code] < 1.0:
            first, last = min(first, code), max(last, code)
    if last >= 0:
        first, last = max(first - 1, 0), min(last + 1, 255)
        slope = (weight_of[last] - weight_of[first]) / (last - first) * NOISE_CODES
        noise = n_rim * slope * slope
    spread = 2.0 * noise / (area * area)
    out[U], out[V] = u0 + x0 + middle_x + mean_x, v0 + y0 + middle_y + mean_y
    out[COV_UU] = spread * xx + FLOOR_SD_PX**2
    out[COV_UV] = spread * xy
    out[COV_VV] = spread * yy + FLOOR_SD_PX**2
    out[AREA] = area
    out[ECCENTRICITY] = sqrt(max(1.0 - small / large, 0.0))
    out[FILL] = area / (4.0 * np.pi * sqrt(large * small))
