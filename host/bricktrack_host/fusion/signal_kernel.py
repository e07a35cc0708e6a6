"""The integrals of inertial splines over short steps, compiled; see `imu_signal.ImuSignal.increments`."""

from typing import NamedTuple

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.rotation_kernel import write_rotation

SUBSTEPS = 4  # of at most 2.5 ms at 100 Hz: cubic signal, exact integrals, coning left below 1e-8 rad


class SignalPieces(NamedTuple):
    """Piecewise polynomials as SciPy keeps them: coefficients, highest power first, of each piece and axis.

    Attributes
    ----------
    knots_s : ndarray, shape (m + 1,)
        May reach beyond the samples that are believed.
    span_s : (float, float)
        First and last sample: signals are held constant beyond.
    angle, gyro : ndarray, shape (5, m, 3), (4, m, 3)
    acc_twice, acc_once, acc : ndarray, shape (6, m, 3), (5, m, 3), (4, m, 3)
        Double integral, integral, signal.
    """

    knots_s: FloatArray
    span_s: tuple[float, float]
    angle: FloatArray
    gyro: FloatArray
    acc_twice: FloatArray
    acc_once: FloatArray
    acc: FloatArray


@compiled
def piece_of(knots_s: FloatArray, t_s: float, near: int) -> int:
    """Return the piece that holds an instant, looked for from a piece nearby."""
    last = len(knots_s) - 2
    i = min(max(near, 0), last)
    if not knots_s[max(i - 4, 0)] <= t_s <= knots_s[min(i + 5, last + 1)]:
        i = min(max(int(np.searchsorted(knots_s, t_s, side="right")) - 1, 0), last)
    while i < last and t_s >= knots_s[i + 1]:
        i += 1
    while i > 0 and t_s < knots_s[i]:
        i -= 1
    return i


@compiled
def _value(coefficients: FloatArray, i: int, axis: int, s: float) -> float:
    """Return the value of a piece, ``s`` after its start."""
    value = coefficients[0, i, axis]
    for k in range(1, coefficients.shape[0]):
        value = value * s + coefficients[k, i, axis]
    return float(value)


@compiled
def held_value(
    integral: FloatArray, signal: FloatArray, i: int, axis: int, t_s: float, pieces: SignalPieces
) -> float:
    """Return an integral of a signal that is held constant beyond the samples; ``i`` is the piece there."""
    held = min(max(t_s, pieces.span_s[0]), pieces.span_s[1])
    s = held - pieces.knots_s[i]
    value = _value(integral, i, axis, s)
    return value if t_s == held else value + _value(signal, i, axis, s) * (t_s - held)


@compiled
def integrate_steps(
    pieces: SignalPieces,
    start_s: FloatArray,
    end_s: FloatArray,
    gyro_bias: FloatArray,
    acc_bias: FloatArray,
    acc_lag_s: float,
    R: FloatArray,
    dv: FloatArray,
    dp: FloatArray,
    R_half: FloatArray,
    f_rate: FloatArray,
    f_curve: FloatArray,
) -> None:
    """Write the motion between pairs of instants, shape (n,), with biases of shape (n, 3).

    The outputs have the shapes of `imu_signal.Increments`.
    """
    knots = pieces.knots_s
    low, high = pieces.span_s
    angle, angle_before, half, middle = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    once, once_before, twice_before = np.empty(3), np.empty(3), np.empty(3)
    velocity, shift, row = np.empty(3), np.empty(3), np.empty(3)
    force_first, slope_first = np.empty(3), np.empty(3)
    i, j = 0, 0
    for n in range(len(start_s)):
        dt = end_s[n] - start_s[n]
        h = dt / SUBSTEPS
        for a in range(3):
            dv[n, a] = dp[n, a] = 0.0
            for b in range(3):
                R[n, a, b] = 1.0 if a == b else 0.0
        for k in range(2 * SUBSTEPS + 1):  # ends and middles of the sub-steps
            since = dt * k / (2.0 * SUBSTEPS)
            t = start_s[n] + since
            held = min(max(t, low), high)
            i = piece_of(knots, held, i)
            for a in range(3):
                angle[a] = held_value(pieces.angle, pieces.gyro, i, a, t, pieces) - gyro_bias[n, a] * since
            if k > 0:
                for a in range(3):
                    row[a] = angle[a] - angle_before[a]
                write_rotation(row, half)
            if k % 2 == 0:
                t += acc_lag_s
                held = min(max(t, low), high)
                j = piece_of(knots, held, j)
                s, beyond = held - knots[j], t - held
                for a in range(3):
                    force = _value(pieces.acc, j, a, s)
                    at_held = _value(pieces.acc_once, j, a, s)
                    twice = _value(pieces.acc_twice, j, a, s) + (at_held + 0.5 * force * beyond) * beyond
                    once[a] = at_held + force * beyond
                    slope = (3.0 * pieces.acc[0, j, a] * s + 2.0 * pieces.acc[1, j, a]) * s
                    slope += pieces.acc[2, j, a]
                    if k == 0:
                        force_first[a], slope_first[a] = force, slope
                    else:
                        velocity[a] = once[a] - once_before[a] - acc_bias[n, a] * h
                        shift[a] = twice - twice_before[a] - once_before[a] * h - 0.5 * acc_bias[n, a] * h * h
                        f_rate[n, a] = 0.0 if dt == 0.0 else (force - force_first[a]) / dt
                        f_curve[n, a] = 0.0 if dt == 0.0 else (slope - slope_first[a]) / dt
                    once_before[a], twice_before[a] = once[a], twice
            if k > 0:
                for a in range(3):
                    for b in range(3):
                        row[b] = R[n, a, 0] * half[0, b] + R[n, a, 1] * half[1, b] + R[n, a, 2] * half[2, b]
                    for b in range(3):
                        R[n, a, b] = row[b]
            if k % 2 == 1:
                middle[:] = R[n]
            elif k > 0:  # what a sub-step adds is turned as its middle is
                for a in range(3):
                    dp[n, a] += dv[n, a] * h
                    for b in range(3):
                        dp[n, a] += middle[a, b] * shift[b]
                        dv[n, a] += middle[a, b] * velocity[b]
            if k == SUBSTEPS:
                R_half[n] = R[n]
            angle_before[:] = angle
