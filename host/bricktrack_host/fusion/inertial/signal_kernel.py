"""The integrals of inertial splines over short steps, compiled; see `imu_signal.ImuSignal.increments`."""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled, compiled_inline
from bricktrack_host.fusion.inertial.rotation_kernel import rotation_of, times

_LONGEST_SUBSTEP_S = 2.5e-3  # cubic signal, exact integrals: coning left below 1e-8 rad
_MOST_SUBSTEPS = 4  # a step that is longer than a sample interval has lost its accuracy already


class GyroPieces(NamedTuple):
    """What `SignalPieces` holds of the angular rate."""

    knots_s: FloatArray
    span_s: tuple[float, float]
    angle: FloatArray
    gyro: FloatArray


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


@compiled_inline
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


@compiled_inline
def _value(coefficients: FloatArray, i: int, axis: int, s: float) -> float:
    """Return the value of a piece, ``s`` after its start."""
    value = coefficients[0, i, axis]
    for k in range(1, coefficients.shape[0]):
        value = value * s + coefficients[k, i, axis]
    return float(value)


@compiled_inline
def held_value(
    integral: FloatArray, signal: FloatArray, i: int, axis: int, t_s: float, pieces: GyroPieces
) -> float:
    """Return an integral of a signal that is held constant beyond the samples; ``i`` is the piece there."""
    held = min(max(t_s, pieces.span_s[0]), pieces.span_s[1])
    s = held - pieces.knots_s[i]
    value = _value(integral, i, axis, s)
    return value if t_s == held else value + _value(signal, i, axis, s) * (t_s - held)


@compiled_inline
def _cubic(c: Any, i: int, axis: int, s: float) -> float:
    return float(((c[0, i, axis] * s + c[1, i, axis]) * s + c[2, i, axis]) * s + c[3, i, axis])


@compiled_inline
def _quartic(c: Any, i: int, axis: int, s: float) -> float:
    value = ((c[0, i, axis] * s + c[1, i, axis]) * s + c[2, i, axis]) * s + c[3, i, axis]
    return float(value * s + c[4, i, axis])


@compiled_inline
def _quintic(c: Any, i: int, axis: int, s: float) -> float:
    value = ((c[0, i, axis] * s + c[1, i, axis]) * s + c[2, i, axis]) * s + c[3, i, axis]
    return float((value * s + c[4, i, axis]) * s + c[5, i, axis])


@compiled_inline
def _angle_at(pieces: SignalPieces, t_s: float, near: int, out: Any) -> int:
    """Write the integral of the angular rate, held constant beyond the samples; return the piece."""
    held = min(max(t_s, pieces.span_s[0]), pieces.span_s[1])
    i = piece_of(pieces.knots_s, held, near)
    s, beyond = held - pieces.knots_s[i], t_s - held
    for a in range(3):
        out[a] = _quartic(pieces.angle, i, a, s)
    if beyond != 0.0:
        for a in range(3):
            out[a] += _cubic(pieces.gyro, i, a, s) * beyond
    return i


class StepRoom(NamedTuple):
    """Room to work in: what was at the start of a sub-step, and what came on since."""

    angle: FloatArray
    angle_before: FloatArray
    once: FloatArray
    twice: FloatArray
    velocity: FloatArray
    shift: FloatArray
    force_first: FloatArray
    slope_first: FloatArray
    middle: FloatArray


@compiled
def step_room() -> StepRoom:
    """Return room for any number of steps, one after the other."""
    return StepRoom(
        np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3),
        np.empty(3), np.empty((3, 3)),
    )  # fmt: skip


@compiled_inline
def gyro_at(pieces: SignalPieces, t_s: float, near: int, out: Any) -> None:
    """Write the angular rate, held constant beyond the samples."""
    held = min(max(t_s, pieces.span_s[0]), pieces.span_s[1])
    i = piece_of(pieces.knots_s, held, near)
    for a in range(3):
        out[a] = _cubic(pieces.gyro, i, a, held - pieces.knots_s[i])


@compiled_inline
def _felt(
    pieces: SignalPieces,
    t_s: float,
    near: int,
    h: float,
    dt: float,
    is_first: bool,
    acc_bias: Any,
    room: StepRoom,
    f_rate: Any,
    f_curve: Any,
) -> int:
    """Write what the specific force adds since the instant before, and its mean slopes; return the piece."""
    held = min(max(t_s, pieces.span_s[0]), pieces.span_s[1])
    j = piece_of(pieces.knots_s, held, near)
    s, beyond, acc = held - pieces.knots_s[j], t_s - held, pieces.acc
    for a in range(3):
        force = _cubic(acc, j, a, s)
        at_held = _quartic(pieces.acc_once, j, a, s)
        twice = _quintic(pieces.acc_twice, j, a, s) + (at_held + 0.5 * force * beyond) * beyond
        once = at_held + force * beyond
        slope = (3.0 * acc[0, j, a] * s + 2.0 * acc[1, j, a]) * s + acc[2, j, a]
        if is_first:
            room.force_first[a], room.slope_first[a] = force, slope
            f_rate[a] = f_curve[a] = 0.0
        else:
            room.velocity[a] = once - room.once[a] - acc_bias[a] * h
            room.shift[a] = twice - room.twice[a] - room.once[a] * h - 0.5 * acc_bias[a] * h * h
            f_rate[a] = 0.0 if dt == 0.0 else (force - room.force_first[a]) / dt
            f_curve[a] = 0.0 if dt == 0.0 else (slope - room.slope_first[a]) / dt
        room.once[a], room.twice[a] = once, twice
    return j


@compiled_inline
def _turn_since(room: StepRoom, angle_rate_bias: Any, h: float, R: Any) -> None:
    """Turn R by how the angle has changed since the instant before."""
    now, before = room.angle, room.angle_before
    E = rotation_of(
        now[0] - before[0] - angle_rate_bias[0] * h,
        now[1] - before[1] - angle_rate_bias[1] * h,
        now[2] - before[2] - angle_rate_bias[2] * h,
    )
    times(R, E)
    for a in range(3):
        before[a] = now[a]


@compiled_inline
def integrate_step(
    pieces: SignalPieces,
    start_s: float,
    dt: float,
    gyro_bias: Any,
    acc_bias: Any,
    acc_lag_s: float,
    R: Any,
    dv: Any,
    dp: Any,
    R_half: Any,
    f_rate: Any,
    f_curve: Any,
    room: StepRoom,
    i: int,
    j: int,
) -> tuple[int, int]:
    """Write the motion of one step; ``i`` and ``j`` are pieces nearby, and returned for the next."""
    n = min(max(int(np.ceil(abs(dt) / _LONGEST_SUBSTEP_S)), 1), _MOST_SUBSTEPS)
    h = dt / n
    for a in range(3):
        dv[a] = dp[a] = 0.0
        for b in range(3):
            R[a, b] = R_half[a, b] = 1.0 if a == b else 0.0
    i = _angle_at(pieces, start_s, i, room.angle_before)
    j = _felt(pieces, start_s + acc_lag_s, j, h, dt, True, acc_bias, room, f_rate, f_curve)
    middle = room.middle
    for k in range(n):
        i = _angle_at(pieces, start_s + (k + 0.5) * h, i, room.angle)
        _turn_since(room, gyro_bias, 0.5 * h, R)
        for a in range(3):
            for b in range(3):
                middle[a, b] = R[a, b]
                if 2 * k + 1 == n:
                    R_half[a, b] = R[a, b]
        i = _angle_at(pieces, start_s + (k + 1) * h, i, room.angle)
        _turn_since(room, gyro_bias, 0.5 * h, R)
        j = _felt(pieces, start_s + (k + 1) * h + acc_lag_s, j, h, dt, False, acc_bias, room, f_rate, f_curve)
        for a in range(3):  # what a sub-step adds is turned as its middle is
            dp[a] += dv[a] * h
            for b in range(3):
                dp[a] += middle[a, b] * room.shift[b]
                dv[a] += middle[a, b] * room.velocity[b]
                if 2 * (k + 1) == n:
                    R_half[a, b] = R[a, b]
    return i, j


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
    room = step_room()
    i, j = 0, 0
    for n in range(len(start_s)):
        i, j = integrate_step(
            pieces, start_s[n], end_s[n] - start_s[n], gyro_bias[n], acc_bias[n], acc_lag_s,
            R[n], dv[n], dp[n], R_half[n], f_rate[n], f_curve[n], room, i, j,
        )  # fmt: skip
