"""The search of a whole picture for lights of an LED's size, compiled; see `find_lights`."""

from math import hypot

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled
from bricktrack_host.quality import LedFlag
from bricktrack_host.tracking.pictures.light_kernel import (
    AREA,
    BOX_HEIGHT,
    BOX_U,
    ECCENTRICITY,
    FILL,
    MIN_CONTRAST,
    U,
    V,
    measure_windows,
)
from bricktrack_host.tracking.pictures.lit_pixels import Bytes, fill_component, stack_for

_LEVELS = (0.55, 0.28, 0.12)
"""Fractions of the brightest light at which the decimated picture is cut: LEDs of one brick differ in
brightness, and a lamp or a reflection may outshine them."""
_MAX_CANDIDATES = 40
_MIN_BOX_SHARE = 0.45
_SAME_PX = 2.0
_MIN_FILL = 0.90  # a disc behind a straight edge keeps 0.93 and more; rings, arcs and pairs have less
_MAX_ECCENTRICITY = 0.87  # a hemisphere seen from the side: half a disc, 0.85
_BORDER, _MERGED, _PARTLY_COVERED = int(LedFlag.BORDER), int(LedFlag.MERGED), int(LedFlag.PARTLY_COVERED)
_DARK, _LIT, _OWN, _DONE = 0, 1, 2, 3
Owners = NDArray[np.int16]


@compiled
def find_lights(
    luma: Bytes,
    stride: int,
    rows: int,
    columns: int,
    step: int,
    smallest_px: float,
    largest_px: float,
    linear: FloatArray,
) -> tuple[FloatArray, IntArray]:
    """Search a picture and measure what is found, each light once.

    Returns
    -------
    lights : ndarray, shape (n, `light_kernel.N_FIELDS`)
    flags : ndarray, shape (n,)
        `LedFlag`: BORDER, MERGED, PARTLY_COVERED as far as the shape alone tells.
    """
    places, half_sizes = search_picture(luma, stride, rows, columns, step, smallest_px, largest_px, linear)
    lights = measure_windows(luma, stride, rows, columns, places, half_sizes, linear)
    n = 0
    for k in range(len(lights)):
        is_new = not np.isnan(lights[k, AREA])
        for other in range(n):
            if hypot(lights[k, U] - lights[other, U], lights[k, V] - lights[other, V]) < _SAME_PX:
                is_new = False
        if is_new:
            lights[n] = lights[k]
            n += 1
    lights = lights[:n].copy()
    return lights, _shape_flags(lights, rows, columns)


@compiled
def search_picture(
    luma: Bytes,
    stride: int,
    rows: int,
    columns: int,
    step: int,
    smallest_px: float,
    largest_px: float,
    linear: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Search a picture, every ``step``-th row and column, for lights between two radii.

    Returns
    -------
    places_px, half_sizes_px : ndarray, shape (n, 2), px
        Centres, and half the bounding boxes, columns and rows.
    """
    first = step // 2
    small = np.empty(
        ((rows - first + step - 1) // step, (columns - first + step - 1) // step), dtype=np.uint8
    )
    height, width = small.shape
    for j in range(height):
        at = (first + step * j) * stride + first
        for i in range(width):
            small[j, i] = luma[np.uint64(at + step * i)]  # unsigned: counts from no end
    brightest = _brightest(small)
    places, half_sizes = np.empty((_MAX_CANDIDATES, 2)), np.empty((_MAX_CANDIDATES, 2))
    background = linear[_median_code(small[::3, ::3])]
    contrast = linear[brightest] - background
    n = 0
    if contrast < MIN_CONTRAST:
        return places[:0], half_sizes[:0]
    low_area, high_area = 0.4 * np.pi * (smallest_px / step) ** 2, np.pi * (largest_px / step) ** 2
    owner = np.full(small.shape, -1, dtype=np.int16)
    mask = np.empty(small.shape, dtype=np.uint8)
    stack = stack_for(mask)
    for fraction in _LEVELS:
        cut = max(np.searchsorted(linear, background + fraction * contrast), 1)
        for j in range(height):
            for i in range(width):
                mask[j, i] = _LIT if small[j, i] >= cut else _DARK
        for j in range(height):
            for i in range(width):
                if mask[j, i] != _LIT:
                    continue
                x, y, w, h, area, mean_x, mean_y = fill_component(mask, stack, j * width + i, _LIT, _OWN)
                known = -1
                if _may_be_a_light(w, h, area, low_area, high_area, 2.0 * largest_px / step):
                    known = _owner_of(owner, mask, x, y, w, h, area)
                    if known == -1 and n < _MAX_CANDIDATES:
                        known = n
                        n += 1
                for jj in range(y, y + h):
                    for ii in range(x, x + w):
                        if mask[jj, ii] == _OWN:
                            mask[jj, ii] = _DONE
                            if known >= 0:
                                owner[jj, ii] = known
                if known >= 0:  # new, or the same light cut nearer to its rim
                    places[known] = first + step * mean_x, first + step * mean_y
                    half_sizes[known] = 0.5 * step * w, 0.5 * step * h
    return places[:n].copy(), half_sizes[:n].copy()


@compiled
def _shape_flags(lights: FloatArray, rows: int, columns: int) -> IntArray:
    flags = np.zeros(len(lights), dtype=np.int64)
    areas = lights[:, AREA]
    good = np.zeros(len(lights), dtype=np.bool_)
    for k in range(len(lights)):
        u0, v0, width, height = lights[k, BOX_U : BOX_HEIGHT + 1]
        if u0 <= 0 or v0 <= 0 or u0 + width >= columns or v0 + height >= rows:
            flags[k] = _BORDER
        good[k] = flags[k] == 0 and not _is_odd(lights[k])
    if not len(lights):
        return flags
    usual = np.median(areas[good]) if good.any() else np.median(areas)
    for k in range(len(lights)):
        large, is_odd = areas[k] > 1.3 * usual, _is_odd(lights[k])
        # Foreshortened domes are small and elongated, near ones large and round: large and elongated are two.
        is_pair = areas[k] > 1.4 * usual and lights[k, ECCENTRICITY] > 0.7
        if is_pair or (is_odd and large):
            flags[k] |= _MERGED
        if is_odd and not large:
            flags[k] |= _PARTLY_COVERED
    return flags


@compiled
def _is_odd(light: FloatArray) -> bool:
    return bool(light[FILL] < _MIN_FILL or light[ECCENTRICITY] > _MAX_ECCENTRICITY)


@compiled
def _brightest(codes: Bytes) -> int:
    highest = np.zeros(codes.shape[1], dtype=np.uint8)
    for j in range(codes.shape[0]):
        row = codes[j]
        for i in range(len(row)):
            highest[i] = max(highest[i], row[i])
    return int(highest.max())


@compiled
def _median_code(codes: Bytes) -> int:
    count = np.zeros(256, dtype=np.int64)
    for j in range(codes.shape[0]):
        for i in range(codes.shape[1]):
            count[codes[j, i]] += 1
    n, code = count[0], 0
    while 2 * n < codes.size:
        code += 1
        n += count[code]
    return code


@compiled
def _may_be_a_light(
    w: int, h: int, area: int, low_area: float, high_area: float, longest_side: float
) -> bool:
    longest, shortest = max(w, h), min(w, h)
    fits = low_area <= area <= high_area and longest <= 3 * shortest + 2 and longest <= longest_side
    # A disc fills 0.79 of its box; lamps' rings and arcs, cables and rims of things do not.
    return fits and (area >= _MIN_BOX_SHARE * w * h or area <= 9)


@compiled
def _owner_of(owner: Owners, mask: Bytes, x: int, y: int, w: int, h: int, area: int) -> int:
    """Return which light the component was at a higher level, -1 for none, -2 for not one light alone."""
    known = -1
    for jj in range(y, y + h):
        for ii in range(x, x + w):
            if mask[jj, ii] == _OWN and owner[jj, ii] >= 0:
                if known >= 0 and known != owner[jj, ii]:
                    return -2  # two lights run together at this level
                known = owner[jj, ii]
    if known >= 0 and area < 0.6 * w * h:
        return -2  # one light with what surrounds it
    return known
