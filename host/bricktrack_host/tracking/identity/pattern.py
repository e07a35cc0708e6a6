"""Compiled: the pattern of LEDs, followed from picture to picture in the image alone.

Between two frames a brick at 10 Hz turns back: the pattern lies up to 0.3 m/s times 67 ms = 20 mm from a
constant-velocity prediction, more than the spacing of the LEDs, but keeps its form. So each pair of LED and
light proposes a displacement; the one under which most LEDs find a light, and closest, is taken.
"""

import math

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled

NOT_FOLLOWED = -2
"""In place of a light's number, all through a frame that the pattern did not reach."""


def assign_predicted(
    blobs_px: FloatArray, predicted_px: FloatArray, *, gate_px: float, shift_limit_px: float
) -> IntArray:
    """Assign blobs to predicted LEDs, at the least sum of distances, after a common displacement.

    Parameters
    ----------
    blobs_px : ndarray, shape (n_blobs, 2), px
    predicted_px : ndarray, shape (n_leds, 2), px
        NaN where an LED cannot be seen.
    gate_px : float
        Farthest that a blob may lie from its LED once the displacement is taken off.
    shift_limit_px : float
        Largest displacement that is tried.

    Returns
    -------
    blob_of_led : ndarray of int64, shape (n_leds,)
        -1 where none.
    """
    out = np.full(len(predicted_px), -1, dtype=np.int64)
    blobs = np.ascontiguousarray(blobs_px, dtype=np.float64)
    predicted = np.ascontiguousarray(predicted_px, dtype=np.float64)
    _assign(blobs, predicted, gate_px, shift_limit_px, out, np.empty((len(out), len(blobs))))
    return out


def follow_pattern(
    uv_px: FloatArray,
    first: IntArray,
    stamps_ns: IntArray,
    is_believed: BoolArray,
    anchor: int,
    pattern_px: FloatArray,
    *,
    radius_px: float,
    max_coast_ns: int,
) -> IntArray:
    """Follow the pattern of one frame forwards and backwards, each up to a frame that is believed already.

    Parameters
    ----------
    uv_px : ndarray, shape (n_lights, 2), px
        The lights of all frames, one after the other.
    first : ndarray of int64, shape (n_frames + 1,)
        Where each frame's begin.
    stamps_ns : ndarray of int64, shape (n_frames,)
    is_believed : ndarray of bool, shape (n_frames,)
    anchor : int
        The frame that the pattern is of.
    pattern_px : ndarray, shape (n_leds, 2), px
        NaN where an LED cannot be seen.
    radius_px : float
        About the radius of an LED.
    max_coast_ns : int
        The pattern is given up after so long without three LEDs.

    Returns
    -------
    blob_of_led : ndarray of int64, shape (n_frames, n_leds)
        Numbers within the frame's lights, -1 for none; `NOT_FOLLOWED` in frames without four LEDs.
    """
    out = np.full((len(stamps_ns), len(pattern_px)), NOT_FOLLOWED, dtype=np.int64)
    most = int(np.diff(first).max(initial=0))
    room = np.empty((len(pattern_px), max(most, 1)))
    for step in (1, -1):
        _follow(
            uv_px,
            first,
            stamps_ns,
            is_believed,
            anchor,
            step,
            pattern_px.copy(),
            radius_px,
            max_coast_ns,
            out,
            room,
        )
    return out


@compiled
def _follow(
    uv: FloatArray,
    first: IntArray,
    stamps_ns: IntArray,
    is_believed: BoolArray,
    anchor: int,
    step: int,
    pattern: FloatArray,
    radius: float,
    max_coast_ns: int,
    out: IntArray,
    room: FloatArray,
) -> None:
    n_leds = len(pattern)
    predicted, drift = np.empty((n_leds, 2)), np.zeros(2)
    assigned = np.empty(n_leds, dtype=np.int64)
    last_ns = stamps_ns[anchor]
    i = anchor + step
    while 0 <= i < len(stamps_ns):
        begin, end = first[i], first[i + 1]
        if abs(stamps_ns[i] - last_ns) > max_coast_ns or is_believed[i]:
            break
        if end > begin:
            for k in range(n_leds):
                predicted[k, 0], predicted[k, 1] = pattern[k, 0] + drift[0], pattern[k, 1] + drift[1]
            gate = max(0.45 * _closest(pattern, 10 * radius), 0.7 * radius)
            lights = uv[begin:end]
            n = _assign(lights, predicted, gate, 10 * radius, assigned, room)
            if n >= 3:
                _carry(lights, assigned, pattern, drift)
                last_ns = stamps_ns[i]
                if n >= 4:
                    for k in range(n_leds):
                        out[i, k] = assigned[k]
        i += step


@compiled
def _closest(pattern: FloatArray, limit: float) -> float:
    """Return the least distance between two LEDs, at most ``limit``."""
    least = limit
    for k in range(len(pattern)):
        for other in range(k):
            gap = math.hypot(pattern[k, 0] - pattern[other, 0], pattern[k, 1] - pattern[other, 1])
            if 0 < gap < least:
                least = gap
    return least


@compiled
def _carry(lights: FloatArray, assigned: IntArray, pattern: FloatArray, drift: FloatArray) -> None:
    """Move the pattern onto its lights, LEDs without one by the shift, turn and scale of the others.

    The best similarity in the sense of least squares, in complex numbers; ``drift`` becomes the median shift.
    """
    n, sx, sy, tx, ty = 0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(pattern)):
        if assigned[k] >= 0:
            at = assigned[k]
            n += 1
            sx, sy, tx, ty = sx + pattern[k, 0], sy + pattern[k, 1], tx + lights[at, 0], ty + lights[at, 1]
    sx, sy, tx, ty = sx / n, sy / n, tx / n, ty / n
    re, im, size = 0.0, 0.0, 1e-9
    for k in range(len(pattern)):
        if assigned[k] >= 0:
            at = assigned[k]
            ax, ay, bx, by = pattern[k, 0] - sx, pattern[k, 1] - sy, lights[at, 0] - tx, lights[at, 1] - ty
            re, im, size = re + ax * bx + ay * by, im + ax * by - ay * bx, size + ax * ax + ay * ay
    re, im = re / size, im / size
    du, dv = np.empty(n), np.empty(n)
    n = 0
    for k in range(len(pattern)):
        x, y = pattern[k, 0] - sx, pattern[k, 1] - sy
        if assigned[k] >= 0:
            at = assigned[k]
            du[n], dv[n] = lights[at, 0] - pattern[k, 0], lights[at, 1] - pattern[k, 1]
            n += 1
            pattern[k, 0], pattern[k, 1] = lights[at, 0], lights[at, 1]
        else:
            pattern[k, 0], pattern[k, 1] = tx + re * x - im * y, ty + im * x + re * y
    drift[0], drift[1] = _median(du), _median(dv)


@compiled
def _median(values: FloatArray) -> float:
    """Return the median of some numbers, which are sorted in place."""
    for i in range(1, len(values)):
        x, j = values[i], i
        while j > 0 and values[j - 1] > x:
            values[j] = values[j - 1]
            j -= 1
        values[j] = x
    middle = len(values) // 2
    return float(values[middle] if len(values) % 2 else 0.5 * (values[middle - 1] + values[middle]))


@compiled
def _assign(
    lights: FloatArray,
    predicted: FloatArray,
    gate: float,
    shift_limit: float,
    out: IntArray,
    room: FloatArray,
) -> int:
    """Put the light of each LED into ``out``, and return how many have one."""
    n_leds = len(predicted)
    shift_u, shift_v, lowest = 0.0, 0.0, np.inf
    for k in range(n_leds):
        out[k] = -1
        for at in range(len(lights)):
            u, v = lights[at, 0] - predicted[k, 0], lights[at, 1] - predicted[k, 1]
            size = math.hypot(u, v)
            if size <= shift_limit:
                # A large displacement is believed only if it explains more: one gate's worth for each limit.
                cost = _cost(lights, predicted, u, v, gate, gate * size / shift_limit, lowest)
                if cost < lowest:
                    shift_u, shift_v, lowest = u, v, cost
    if not lowest < np.inf:
        return 0
    n = 0
    for _ in range(2):
        n = _match(lights, predicted, shift_u, shift_v, gate, out, room)
        if n == 0:
            break
        du, dv, m = np.empty(n), np.empty(n), 0
        for k in range(n_leds):
            if out[k] >= 0:
                du[m], dv[m] = lights[out[k], 0] - predicted[k, 0], lights[out[k], 1] - predicted[k, 1]
                m += 1
        shift_u, shift_v = _median(du), _median(dv)
    return n


@compiled
def _cost(
    lights: FloatArray, predicted: FloatArray, u: float, v: float, gate: float, cost: float, limit: float
) -> float:
    """Return ``cost`` and the LEDs' distances from their nearest lights, each at most the gate, or infinity.

    Infinity once it is above the limit.
    """
    for k in range(len(predicted)):
        if math.isnan(predicted[k, 0]):
            continue
        nearest = gate * gate
        for at in range(len(lights)):
            d2 = (lights[at, 0] - predicted[k, 0] - u) ** 2 + (lights[at, 1] - predicted[k, 1] - v) ** 2
            nearest = min(nearest, d2)
        cost += math.sqrt(nearest)
        if cost >= limit:
            return np.inf
    return cost


@compiled
def _match(
    lights: FloatArray,
    predicted: FloatArray,
    u: float,
    v: float,
    gate: float,
    out: IntArray,
    room: FloatArray,
) -> int:
    """Assign lights to LEDs at the least sum of distances, each at most twice the gate; none beyond it."""
    n_leds, n_lights = len(predicted), len(lights)
    clash = False
    for k in range(n_leds):
        out[k] = -1
        known = not math.isnan(predicted[k, 0])
        nearest = gate
        for j in range(n_lights):
            d = 2 * gate
            if known:
                d = min(d, math.hypot(lights[j, 0] - predicted[k, 0] - u, lights[j, 1] - predicted[k, 1] - v))
            room[k, j] = d
            if d < nearest:
                nearest, out[k] = d, j
        for other in range(k):
            clash |= out[k] >= 0 and out[other] == out[k]
    if clash:  # else each has its nearest, and there is nothing better
        _least_sum(room, n_lights, out)
    n = 0
    for k in range(n_leds):
        if out[k] >= 0 and not room[k, out[k]] < gate:
            out[k] = -1
        n += out[k] >= 0
    return n


@compiled
def _least_sum(cost: FloatArray, n_columns: int, out: IntArray) -> None:
    """Assign columns to rows at the least sum, by shortest augmenting paths (Jonker and Volgenant, 1987).

    With fewer columns than rows, rows may go without one: the columns that are missing cost as much as the
    dearest.
    """
    n_rows = len(cost)
    n = max(n_rows, n_columns)
    dearest = 0.0
    for r in range(n_rows):
        for c in range(n_columns):
            dearest = max(dearest, cost[r, c])
    by_row, by_column = np.zeros(n_rows + 1), np.zeros(n + 1)
    row_of = np.full(n + 1, -1, dtype=np.int64)
    way = np.zeros(n + 1, dtype=np.int64)
    for r in range(n_rows):
        row_of[n] = r
        at = n
        least, used = np.full(n + 1, np.inf), np.zeros(n + 1, dtype=np.bool_)
        while row_of[at] >= 0:
            used[at] = True
            row, delta, to = row_of[at], np.inf, -1
            for c in range(n):
                if not used[c]:
                    reduced = (cost[row, c] if c < n_columns else dearest) - by_row[row] - by_column[c]
                    if reduced < least[c]:
                        least[c], way[c] = reduced, at
                    if least[c] < delta:
                        delta, to = least[c], c
            for c in range(n + 1):
                if used[c]:
                    by_row[row_of[c]] += delta
                    by_column[c] -= delta
                else:
                    least[c] -= delta
            at = to
        while at != n:
            row_of[at] = row_of[way[at]]
            at = way[at]
    for r in range(n_rows):
        out[r] = -1
    for c in range(n_columns):
        if row_of[c] >= 0:
            out[row_of[c]] = c
