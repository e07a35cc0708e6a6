"""The smoother's way back in time, compiled: what later frames say of each state, added up as they come.

Modified Bryson-Frazier form (Bierman 1973): with lambda and Lambda the gradient and the Hessian of what comes
later, taken at the filtered state x, P, the smoothed state is x - P lambda and its covariance P - P Lambda P.
Nothing is inverted, and only one stretch of filtered states is in memory at a time: it is made again from the
state before it. A variance of which the difference leaves nothing is NaN, never a number.
"""

from typing import Any

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_sums
from bricktrack_host.fusion.inertial.rotation_kernel import turn_by
from bricktrack_host.fusion.smoothing.covariance_kernel import (
    F_SIZE,
    SIZE,
    M,
    N,
    dot,
    make_symmetric,
    rows_times,
    step_back,
    take_off,
    transpose,
)
from bricktrack_host.fusion.smoothing.observation_kernel import observation_room, place_led
from bricktrack_host.fusion.smoothing.smoother_kernel import (
    CHUNK,
    Kept,
    copy_state,
    forward_stretch,
    measurements_of,
    room_for,
    room_to_work,
)
from bricktrack_host.fusion.smoothing.transition_kernel import RunArrays, transition

_WHOLE_EVERY = 16  # nodes: biases and gravity are as unsure at the next


@compiled_sums
def _before_measurement(kept: Kept, m: int, gradient: Any, hessian: Any, work: Any) -> None:
    """Carry gradient and Hessian to before measurement ``m``, in place.

    With A = I - K H they become A^T gradient - H^T S^-1 y and A^T hessian A + H^T S^-1 H. A is applied from
    one side and then the other: written out as one sum, small differences of large numbers would be left.
    """
    n, H, HP, y = kept.n_rows[m], kept.H[m], kept.HP[m], kept.y[m]
    for i in range(n):
        s = y[i]
        for j in range(N):
            s += HP[i * N + j] * gradient[j]
        work[i] = s
    for i in range(n):
        for j in range(N):
            gradient[j] -= work[i] * H[i * N + j]
    rows_times(HP, n, hessian, work)
    take_off(hessian, H, work, n)
    transpose(hessian)
    # H^T S^-1 H comes in with the second side: there A^T is what is taken off.
    rows_times(HP, n, hessian, work)
    for j in range(n * N):
        work[j] -= H[j]
    take_off(hessian, H, work, n)


@compiled_sums
def _before_step(F: Any, dt: float, gradient: Any, hessian: Any) -> None:
    """Carry gradient and Hessian to before a step, in place: F^T gradient and F^T hessian F."""
    step_back(F, gradient, dt, 1)
    step_back(F, hessian, dt, N)
    transpose(hessian)
    step_back(F, hessian, dt, N)
    make_symmetric(hessian)


@compiled_sums
def _smoothed(rows: Any, n: int, hessian: Any, work: Any, out: Any) -> None:
    """Write what later frames take from a covariance: rows hessian rows^T, for ``n`` rows of P, or of H P."""
    rows_times(rows, n, hessian, work)
    for r in range(n):
        for j in range(r + 1):
            out[r, j] = out[j, r] = dot(work, r, rows, j)


@compiled_sums
def _write_state(kept: Kept, i: int, gradient: Any, dx: Any, R: Any, x: Any) -> None:
    """Write the smoothed state of node ``i`` of a stretch."""
    P = kept.P[i]
    for r in range(N):
        total = 0.0
        for j in range(N):
            total -= P[j * N + r] * gradient[j]
        dx[r] = total
    copy_state(kept.R[i], kept.x[i], R, x)
    turn_by(R, dx)
    for r in range(3, N):
        x[r] += dx[r]


@compiled_sums
def _left_of(P: Any, r: int, taken: float) -> float:
    """Return what is left of the variance of state ``r``; NaN where rounding leaves nothing of it.

    Zero is the variance of a state that was known from the start: all of its row is zero.
    """
    left = P[r * N + r] - taken
    if left > 0.0:
        return float(left)
    for j in range(N):
        if P[r * N + j] != 0.0:
            return np.nan
    return 0.0


@compiled_sums
def _write_covariance(P: Any, hessian: Any, of: IntArray, rows: Any, work: Any, out: Any) -> None:
    """Write the smoothed covariance of the states ``of``, shape (c, c)."""
    for r in range(len(of)):
        for j in range(N):
            rows[r * N + j] = P[of[r] * N + j]
    _smoothed(rows, len(of), hessian, work, out)
    for r in range(len(of)):
        for j in range(len(of)):
            if j != r:
                out[r, j] = rows[r * N + of[j]] - out[r, j]
        out[r, r] = _left_of(P, of[r], out[r, r])


@compiled_sums
def _write_variance(P: Any, hessian: Any, work: Any, out: Any) -> None:
    """Write the smoothed variance of every state, shape (22,)."""
    rows_times(P, N, hessian, work)
    for r in range(N):
        out[r] = _left_of(P, r, dot(work, r, P, r))


@compiled
def backward_pass(
    run: RunArrays,
    gyro_var: FloatArray,
    acc_var: FloatArray,
    R_before: FloatArray,
    x_before: FloatArray,
    P_before: FloatArray,
    of: IntArray,
    is_smoothed: bool,
    R_out: FloatArray,
    x_out: FloatArray,
    variance: FloatArray,
    covariance: FloatArray,
    led_residual_px: FloatArray,
    led_cov_px2: FloatArray,
) -> None:
    """Write the states given all frames (or, not smoothed, all earlier ones), from what `forward_pass` kept.

    Parameters
    ----------
    of : ndarray of int64, shape (c,)
        The states whose covariance is written.
    R_out, x_out, variance, covariance : ndarray, shape (K, 3, 3), (K, 22), (K, 22), (K, c, c)
        The variance of states that are not asked for is that of a node at most 16 later.
    led_residual_px, led_cov_px2 : ndarray, shape (m, 2), (m, 2, 2)
        Of each LED at the state of its node, and H P H^T.
    """
    n_nodes, leds = len(run.has_frame), run.leds
    R, x, P = np.empty((3, 3)), np.empty(N), np.empty(SIZE)
    F_flat, H, HP, taken = np.zeros(F_SIZE), np.zeros(2 * N), np.zeros(2 * N), np.zeros((2, 2))
    F = F_flat.reshape((M, N))
    # Nothing comes later than the last node; where later frames are not to count, that holds for all.
    gradient, hessian = np.zeros(N), np.zeros(SIZE)
    dx, rows, work = np.empty(N), np.zeros(SIZE), np.zeros(SIZE)
    nis, inflation = np.empty(n_nodes), np.empty(n_nodes)
    room, observation = room_to_work(), observation_room()
    for c in range(len(R_before) - 1, -1, -1):
        start, stop = c * CHUNK, min((c + 1) * CHUNK, n_nodes)
        kept = room_for(stop - start, measurements_of(run, start, stop))
        R[:], x[:], P[:] = R_before[c], x_before[c], P_before[c]
        forward_stretch(run, gyro_var, acc_var, start, stop, R, x, P, nis, inflation, room, kept)
        for k in range(stop - 1, start - 1, -1):
            i = k - start
            _write_state(kept, i, gradient, dx, R_out[k], x_out[k])
            _write_covariance(kept.P[i], hessian, of, rows, work, covariance[k])
            if k == n_nodes - 1 or k % _WHOLE_EVERY == 0:
                _write_variance(kept.P[i], hessian, work, variance[k])
            else:
                variance[k] = variance[k + 1]
            for r in range(len(of)):
                variance[k, of[r]] = covariance[k, r, r]
            for led in range(leds.first[k, 0], leds.first[k + 1, 0]):
                place_led(
                    leds, led, R_out[k], x_out[k], run.arm_m, run.bg_lin, run.off_lin, run.tau_lin,
                    run.skew_lin, H, led_residual_px[led], observation,
                )  # fmt: skip
                rows_times(H, 2, kept.P[i], HP)
                _smoothed(HP, 2, hessian, work, taken)
                for r in range(2):
                    for j in range(2):
                        left = dot(HP, r, H, j) - taken[r, j]
                        led_cov_px2[led, r, j] = left if r != j or left > 0.0 else np.nan
            if not is_smoothed:
                continue
            for m in range(kept.first[i + 1] - 1, kept.first[i] - 1, -1):
                _before_measurement(kept, m, gradient, hessian, work)
            if k > 0 and run.dt_s[k - 1] > 0.0:
                transition(run, k - 1, kept.R[i - 1] if i > 0 else R_before[c], F)
                _before_step(F_flat, run.dt_s[k - 1], gradient, hessian)
