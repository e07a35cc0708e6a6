"""What is lit in a window, compiled: the rows of one light, components of several, and what lies near them.

A mask's pixels are dark, lit, or the light's own.
"""

from math import hypot, inf, sqrt

import numpy as np
from numpy.typing import NDArray

from bricktrack_host.compiled import compiled, compiled_in_place, compiled_inline

Bytes = NDArray[np.uint8]
Columns = NDArray[np.int64]
Stack = NDArray[np.int32]
DARK, LIT, OWN = 0, 1, 2


@compiled
def light_near(
    luma: Bytes, stride: int, u0: int, v0: int, u1: int, v1: int, cut: np.uint8, near_u: float, near_v: float
) -> tuple[int, int, int, int, int, Columns, Columns, Bytes]:
    """Find, in a window of a picture, the light whose pixels reach a code and that lies nearest to a point.

    Parameters
    ----------
    luma : ndarray of uint8, flat
    stride : int
        Bytes from row to row.
    u0, v0, u1, v1 : int
        The window's first column and row, and those behind its last.
    cut : int
        Lit is what has this code or more.
    near_u, near_v : float, px
        In the window.

    Returns
    -------
    x, y, w, h : int
        Its box in the window.
    n_pixels : int
        0 if nothing is lit.
    first, last : ndarray, shape (v1 - v0,)
        Its first and last column in each row; where it has none, first beyond last.
    mask : ndarray, shape (v1 - v0, u1 - u0)
        `LIT`, `OWN` or `DARK`; empty where it is plain that nothing else is lit in the window.
    """
    first, last = np.empty(v1 - v0, dtype=np.int64), np.empty(v1 - v0, dtype=np.int64)
    mask = np.empty((0, 0), dtype=np.uint8)
    i, j = min(max(round(near_u), 0), u1 - u0 - 1), min(max(round(near_v), 0), v1 - v0 - 1)
    x, y, w, h, n_pixels = _traced(luma, stride, u0, v0, u1, v1, cut, i, j, first, last)
    if n_pixels == 0:
        mask = _lit_mask(luma, stride, u0, v0, u1, v1, cut)
        stack = stack_for(mask)
        seed = _seed_near(mask, stack, near_u, near_v)
        if seed >= 0:
            x, y, w, h, n_pixels, _, _ = fill_component(mask, stack, seed, LIT, OWN)
            _spans_of_own(mask, x, y, w, h, first, last)
            if not _holds(mask, LIT):
                mask = np.empty((0, 0), dtype=np.uint8)
    elif _n_lit_of_window(luma, stride, u0, v0, u1, v1, cut) > n_pixels:
        mask = _lit_mask(luma, stride, u0, v0, u1, v1, cut)
        for k in range(y, y + h):
            mask[k, first[k] : last[k] + 1] = OWN
    return x, y, w, h, n_pixels, first, last, mask


@compiled_in_place
def _traced(
    luma: Bytes,
    stride: int,
    u0: int,
    v0: int,
    u1: int,
    v1: int,
    cut: np.uint8,
    i: int,
    j: int,
    first: Columns,
    last: Columns,
) -> tuple[int, int, int, int, int]:
    """Return box x, y, w, h and pixels of the light around a pixel of a window, if it is one run a row.

    No pixels: the pixel or one beside it is dark, or the light forks. Fills in the runs' first and last
    columns, row by row; where there is none, first beyond last.
    """
    width, height = u1 - u0, v1 - v0
    first[:], last[:] = width, -1
    for k in range(max(j - 1, 0), min(j + 2, height)):
        at = (v0 + k) * stride + u0
        for m in range(max(i - 1, 0), min(i + 2, width)):
            if luma[at + m] < cut:
                return 0, 0, 0, 0, 0
    at = (v0 + j) * stride + u0
    first[j], last[j] = _ends_of_run(luma[at : at + width], i, i, cut)
    y0, y1, n_pixels = j, j, last[j] - first[j] + 1
    for step in (-1, 1):
        k = j + step
        while 0 <= k < height:
            at, at_before = (v0 + k) * stride + u0, (v0 + k - step) * stride + u0
            row, before = luma[at : at + width], luma[at_before : at_before + width]
            from_, to = max(first[k - step] - 1, 0), min(last[k - step] + 1, width - 1)
            begin, end = _ends_of_run(row, from_, to, cut)
            if begin > end:
                break
            n = _n_lit(row[begin : end + 1], cut)
            # Another run of this row meets the run before, or another one of that row meets this run.
            beside = _n_lit(before[max(begin - 1, 0) : from_], cut) + _n_lit(before[to + 1 : end + 2], cut)
            if n < end - begin + 1 or beside > 0:
                return 0, 0, 0, 0, 0
            first[k], last[k] = begin, end
            y0, y1, n_pixels = min(y0, k), max(y1, k), n_pixels + n
            k += step
    x0, x1 = width, -1
    for k in range(y0, y1 + 1):
        x0, x1 = min(x0, first[k]), max(x1, last[k])
    return x0, y0, x1 - x0 + 1, y1 - y0 + 1, n_pixels


@compiled_inline
def _ends_of_run(row: Bytes, from_: int, to: int, cut: np.uint8) -> tuple[int, int]:
    """Return where what is lit from one column to another begins and ends; the end first if nothing is."""
    begin, end = from_, to
    if row[begin] >= cut:
        while begin > 0 and row[begin - 1] >= cut:
            begin -= 1
    else:
        while begin <= to and row[begin] < cut:
            begin += 1
    if row[end] >= cut:
        while end < len(row) - 1 and row[end + 1] >= cut:
            end += 1
    else:
        while end >= from_ and row[end] < cut:
            end -= 1
    return begin, end


@compiled_inline
def _n_lit(row: Bytes, cut: np.uint8) -> int:
    n = 0
    for i in range(len(row)):
        n += row[i] >= cut
    return n


@compiled_in_place
def _n_lit_of_window(luma: Bytes, stride: int, u0: int, v0: int, u1: int, v1: int, cut: np.uint8) -> int:
    n = 0
    for v in range(v0, v1):
        n += _n_lit(luma[v * stride + u0 : v * stride + u1], cut)
    return n


@compiled
def _lit_mask(luma: Bytes, stride: int, u0: int, v0: int, u1: int, v1: int, cut: np.uint8) -> Bytes:
    """Return which pixels of a window are lit."""
    mask = np.empty((v1 - v0, u1 - u0), dtype=np.uint8)
    for j in range(v1 - v0):
        at = (v0 + j) * stride
        row = luma[at + u0 : at + u1]
        for i in range(u1 - u0):
            mask[j, i] = LIT if row[i] >= cut else DARK
    return mask


@compiled
def _seed_near(mask: Bytes, stack: Stack, u: float, v: float) -> int:
    """Return a pixel of the light nearest to a point: of the component, not of a speck beside it; or -1."""
    rows, columns = mask.shape
    i, j = min(max(round(u), 0), columns - 1), min(max(round(v), 0), rows - 1)
    if mask[j, i] != DARK:
        alone = False
        for jj in range(max(j - 1, 0), min(j + 2, rows)):
            for ii in range(max(i - 1, 0), min(i + 2, columns)):
                alone = alone or mask[jj, ii] == DARK
        if not alone:
            return int(j * columns + i)
    # Every component once, marked as done; the marks are taken back below.
    seeds = np.empty((mask.size, 3))  # first pixel, area, distance from the rim
    n, largest = 0, 0.0
    for p in range(mask.size):
        if mask[p // columns, p % columns] == LIT:
            _, _, _, _, area, mean_x, mean_y = fill_component(mask, stack, p, LIT, OWN)
            seeds[n] = float(p), float(area), hypot(mean_x - u, mean_y - v) - sqrt(area / np.pi)
            largest = max(largest, float(area))
            n += 1
    best, nearest = -1, inf
    for k in range(n):
        if seeds[k, 1] >= 0.05 * largest and seeds[k, 2] < nearest:
            best, nearest = int(seeds[k, 0]), seeds[k, 2]
    for p in range(mask.size):
        if mask[p // columns, p % columns] == OWN:
            mask[p // columns, p % columns] = LIT
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
def _spans_of_own(mask: Bytes, x: int, y: int, w: int, h: int, first: Columns, last: Columns) -> None:
    """Fill in the first and last column of the component, whose box is given, row by row."""
    first[:], last[:] = mask.shape[1], -1
    for j in range(y, y + h):
        begin, end = x, x + w - 1
        while mask[j, begin] != OWN:
            begin += 1
        while mask[j, end] != OWN:
            end -= 1
        first[j], last[j] = begin, end


@compiled
def widened(first: Columns, last: Columns, reach: int, x0: int, x1: int) -> tuple[Columns, Columns]:
    """Return first and last columns within ``reach`` rows and columns of spans, inside x0 to x1 - 1."""
    rows = len(first)
    wide_first, wide_last = np.full(rows, x1), np.full(rows, x0 - 1)
    for j in range(rows):
        if first[j] <= last[j]:
            from_, to = max(first[j] - reach, x0), min(last[j] + reach, x1 - 1)
            for jj in range(max(j - reach, 0), min(j + reach + 1, rows)):
                wide_first[jj] = min(wide_first[jj], from_)
                wide_last[jj] = max(wide_last[jj], to)
    return wide_first, wide_last


@compiled
def near_others(mask: Bytes, reach: int) -> Bytes:
    """Return 1 within ``reach`` rows and columns of another light, but not on this one; empty if none is."""
    if not _holds(mask, LIT):
        return np.empty((0, 0), dtype=np.uint8)
    rows, columns = mask.shape
    out = np.zeros((rows, columns), dtype=np.uint8)
    for j in range(rows):
        end = 0
        while _holds(mask[j : j + 1, end:], LIT):
            begin = end
            while mask[j, begin] != LIT:
                begin += 1
            end = begin
            while end < columns and mask[j, end] == LIT:
                end += 1
            for jj in range(max(j - reach, 0), min(j + reach + 1, rows)):
                out[jj, max(begin - reach, 0) : min(end + reach, columns)] = 1
    for j in range(rows):
        for i in range(columns):
            out[j, i] &= mask[j, i] != OWN
    return out


@compiled
def _holds(mask: Bytes, kind: int) -> bool:
    for j in range(mask.shape[0]):
        row = mask[j]
        n = 0
        for i in range(len(row)):
            n += row[i] == kind
        if n > 0:
            return True
    return False
