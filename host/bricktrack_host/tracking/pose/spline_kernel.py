"""Compiled: a motion by a spline through the poses of frames, between their instants, and its doubts."""

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled
from bricktrack_host.tracking.pose.turn_kernel import put_rotation_vector, turn_between_vectors, turn_matrix

_SPLINE_SHARE = 0.1
_SHAKE_RADPS = 54.0  # 8.6 Hz: the highest frequency of a shake that 30 frames a second follow


@compiled
def poses_as_vectors(R: FloatArray, t_mm: FloatArray) -> FloatArray:
    """Return poses (n, 3, 3), (n, 3) as turns from the middle one's attitude, rad, and places, mm, (n, 6)."""
    n = len(R)
    out, M = np.empty((n, 6)), np.empty((3, 3))
    for i in range(n):
        turn_matrix(R[n // 2], R[i], M)
        put_rotation_vector(M, out[i])
        for c in range(3):
            out[i, 3 + c] = t_mm[i, c]
    return out


@compiled
def carried_by_spline(
    samples: FloatArray, t_s: FloatArray, led_t_s: FloatArray, rvec_rad: FloatArray, shift_mm: FloatArray
) -> None:
    """Fill in how far a brick moves from each frame to instants about it, by a cubic spline ("not a knot").

    Parameters
    ----------
    samples : ndarray, shape (n, 6), rad and mm
        See `poses_as_vectors`.
    t_s : ndarray, shape (n,), s
        Increasing; two at least.
    led_t_s : ndarray, shape (n, m), s
    rvec_rad, shift_mm : ndarray, shapes (n, m, 3)
        Turns in brick axes and shifts.
    """
    n = len(t_s)
    slopes, at = knot_slopes(samples, t_s), np.empty(6)
    for i in range(n):
        for k in range(led_t_s.shape[1]):
            t, j = led_t_s[i, k], min(i, n - 2)
            while j > 0 and t < t_s[j]:
                j -= 1
            while j < n - 2 and t >= t_s[j + 1]:
                j += 1
            width = t_s[j + 1] - t_s[j]
            s = (t - t_s[j]) / width
            for c in range(6):
                rise = samples[j + 1, c] - samples[j, c]
                begin, end = width * slopes[j, c] - rise, rise - width * slopes[j + 1, c]
                at[c] = samples[j, c] + s * (rise + (1 - s) * ((1 - s) * begin + s * end))
            turn_between_vectors(samples[i], at, rvec_rad[i, k])
            for c in range(3):
                shift_mm[i, k, c] = at[3 + c] - samples[i, 3 + c]


@compiled
def knot_slopes(y: FloatArray, t: FloatArray) -> FloatArray:
    """Return a cubic spline's slopes at its knots, (n, m), of values (n, m).

    Its third derivative goes through the second and the last but one knot; of three knots it is a parabola,
    of two a line. By elimination from the first to the last: no pivot is less than a step between knots.
    """
    n, m = y.shape
    out, upper = np.empty((n, m)), np.empty(n)
    h = t[1:] - t[:-1]
    for c in range(m):
        if n == 2:
            out[0, c] = out[1, c] = (y[1, c] - y[0, c]) / h[0]
            continue
        first, second = (y[1, c] - y[0, c]) / h[0], (y[2, c] - y[1, c]) / h[1]
        both = h[0] + h[1]
        if n == 3:
            bend = (second - first) / both
            out[0, c], out[1, c] = first - bend * h[0], first + bend * h[0]
            out[2, c] = second + bend * h[1]
            continue
        upper[0] = both / h[1]
        out[0, c] = ((h[0] + 2 * both) * h[1] * first + h[0] ** 2 * second) / both / h[1]
        for i in range(1, n - 1):
            before, after = (y[i, c] - y[i - 1, c]) / h[i - 1], (y[i + 1, c] - y[i, c]) / h[i]
            pivot = 2 * (h[i - 1] + h[i]) - h[i] * upper[i - 1]
            upper[i] = h[i - 1] / pivot
            out[i, c] = (3 * (h[i] * before + h[i - 1] * after) - h[i] * out[i - 1, c]) / pivot
        both = h[n - 2] + h[n - 3]
        before = (y[n - 2, c] - y[n - 3, c]) / h[n - 3]
        last = (y[n - 1, c] - y[n - 2, c]) / h[n - 2]
        right = (h[n - 2] ** 2 * before + (2 * both + h[n - 2]) * h[n - 3] * last) / both
        out[n - 1, c] = (right - both * out[n - 2, c]) / (h[n - 3] - both * upper[n - 2])
        for i in range(n - 2, -1, -1):
            out[i, c] -= upper[i] * out[i + 1, c]
    return out


@compiled
def spline_doubt(
    samples: FloatArray, t_s: FloatArray, least: FloatArray, most: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return how wrong a cubic spline's velocity may be at each frame, and how far it may jump there.

    Parameters
    ----------
    samples : ndarray, shape (n, 6), rad and mm
        Nine at least.
    t_s : ndarray, shape (n,), s
    least, most : ndarray, shape (2,), rad/s and mm/s
        Limits of both.

    Returns
    -------
    velocity, jump : ndarray, shape (n, 6), rad/s and mm/s

    Notes
    -----
    For a sine of w T = 1.8 (8.6 Hz at 30 frames a second) the velocity is 8.5 % off, which is 0.026 of the
    fourth difference over T; at lower frequencies less, at an impact several times that. Where frames are
    missing, such a sine turns back unseen between two of them: then it is all of w times the amplitude that
    may be wrong, and the largest of five fourth differences is about twenty amplitudes. Ends know one side
    only.
    """
    n = len(samples)
    apart = t_s[1:] - t_s[:-1]
    usual = np.median(apart)
    size = np.zeros((n - 4, 2))
    for i in range(n - 4):
        for c in range(6):
            fourth = samples[i, c] - 4 * samples[i + 1, c] + 6 * samples[i + 2, c]
            fourth += samples[i + 4, c] - 4 * samples[i + 3, c]
            size[i, c // 3] += fourth**2
    size = np.sqrt(size)
    velocity, jump = np.empty((n, 6)), np.empty((n, 6))
    for i in range(n):
        middle = min(max(i - 4, 0), n - 9)  # the five differences that it is in; near an end the nearest
        is_unseen = False
        for k in range(i - 2, i + 2):
            is_unseen = is_unseen or _SHAKE_RADPS * apart[min(max(k, 0), n - 2)] > np.pi
        for c in range(6):
            largest = size[middle : middle + 5, c // 3].max()
            local = _SPLINE_SHARE * largest * (3.0 if i < 2 or i >= n - 2 else 1.0)
            jumps = local / usual
            wrong = max(jumps, 0.5 * _SHAKE_RADPS * local) if is_unseen else jumps
            velocity[i, c] = min(max(wrong, least[c // 3]), most[c // 3])
            jump[i, c] = min(max(jumps, least[c // 3]), most[c // 3])
    return velocity, jump
