"""The smoother's way back in time, compiled: what later frames say of each state, added up as they come.

Modified Bryson-Frazier form (Bierman 1973): with lambda and Lambda the gradient and the Hessian of what comes
later, taken at the filtered state x, P, the smoothed state is x - P lambda and its covariance P - P Lambda P.
Nothing is inverted, and only one stretch of filtered states is in memory at a time: it is made again from the
state before it.
"""

from typing import Any

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.observation_kernel import N, observe_led
from bricktrack_host.fusion.rotation_kernel import turn_by
from bricktrack_host.fusion.smoother_kernel import (
    CHUNK,
    COLUMNS,
    N_COLUMNS,
    Kept,
    M,
    RunArrays,
    forward_stretch,
    room_for,
    transition,
)

_WHOLE_EVERY = 16  # nodes: biases and gravity are as unsure at the next


@compiled
def _before_measurement(kept: Kept, m: int, gradient: Any, hessian: Any, work: Any) -> None:
    """Carry gradient and Hessian to before measurement ``m``, in place.

    With A = I - K H they become A^T gradient - H^T S^-1 y and A^T hessian A + H^T S^-1 H. A is applied from
    one side and then the other: written out as one sum, small differences of large numbers would be left.
    """
    n, H, HP, y = kept.n_rows[m], kept.H[m], kept.HP[m], kept.y[m]
    for i in range(n):
        s = y[i]
        for j in range(N):
            s += HP[i, j] * gradient[j]
        work[i, 0] = s
    for i in range(n):
        for j in range(N):
            gradient[j] -= work[i, 0] * H[i, j]
    for _ in range(2):
        # Rows first; as the Hessian is symmetric, its columns are the rows of the result, turned over.
        for i in range(n):
            work[i] = 0.0
            for r in range(N):
                for j in range(N):
                    work[i, j] += HP[i, r] * hessian[r, j]
        for i in range(n):
            for r in range(N):
                for j in range(N):
                    hessian[r, j] -= H[i, r] * work[i, j]
        for r in range(N):
            for j in range(r):
                hessian[r, j], hessian[j, r] = hessian[j, r], hessian[r, j]
    for i in range(n):
        for r in range(N):
            for j in range(N):
                hessian[r, j] += H[i, r] * H[i, j]


@compiled
def _rows_before_step(F: Any, A: Any, out: Any) -> None:
    """Write F^T A for the moving rows F of a transition."""
    for r in range(N):
        if r < M:
            out[r] = 0.0
        else:
            out[r] = A[r]
    for i in range(M):
        for c in range(N_COLUMNS[i]):
            f, row = F[i, COLUMNS[i, c]], out[COLUMNS[i, c]]
            for j in range(N):
                row[j] += f * A[i, j]


@compiled
def _before_step(F: Any, gradient: Any, hessian: Any, work: Any) -> None:
    """Carry gradient and Hessian to before a step, in place: F^T gradient and F^T hessian F."""
    _rows_before_step(F, hessian, work)
    for r in range(N):
        for j in range(r):
            work[r, j], work[j, r] = work[j, r], work[r, j]
    _rows_before_step(F, work, hessian)
    moving = gradient[:M].copy()
    gradient[:M] = 0.0
    for i in range(M):
        for c in range(N_COLUMNS[i]):
            gradient[COLUMNS[i, c]] += F[i, COLUMNS[i, c]] * moving[i]
    _make_symmetric(hessian)


@compiled
def _dot(a: Any, b: Any) -> float:
    """Return the product of two states, two sums at a time: one alone would wait for itself."""
    even, odd = 0.0, 0.0
    for j in range(0, N, 2):
        even += a[j] * b[j]
        odd += a[j + 1] * b[j + 1]
    return even + odd


@compiled
def _smoothed(rows: Any, hessian: Any, work: Any, out: Any) -> None:
    """Write what later frames take from a covariance: rows hessian rows^T, for some rows of P, or of H P."""
    n = len(rows)
    for r in range(n):
        work[r] = 0.0
        for m in range(N):
            p = rows[r, m]
            for j in range(N):
                work[r, j] += p * hessian[m, j]
    for r in range(n):
        for j in range(r + 1):
            out[r, j] = _dot(work[r], rows[j])
            out[j, r] = out[r, j]


@compiled
def _make_symmetric(A: Any) -> None:
    """Replace both halves by their mean: rounding alone tells them apart."""
    for r in range(N):
        for j in range(r):
            mean = 0.5 * (A[r, j] + A[j, r])
            A[r, j] = mean
            A[j, r] = mean


@compiled
def _measurements_of(run: RunArrays, start: int, stop: int) -> int:
    n = run.leds.first[stop, 0] - run.leds.first[start, 0]
    for k in range(start, stop):
        n += run.has_frame[k]
    return int(n)


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
    n_nodes = len(run.has_frame)
    leds = run.leds
    R, x, P = np.empty((3, 3)), np.empty(N), np.empty((N, N))
    F, H, y = np.zeros((M, N)), np.zeros((2, N)), np.zeros(2)
    gradient, hessian, work = np.zeros(N), np.zeros((N, N)), np.empty((N, N))
    rows, HP, taken = np.empty((len(of), N)), np.empty((2, N)), np.zeros((N, N))
    nis, inflation = np.empty(n_nodes), np.empty(n_nodes)
    for c in range(len(R_before) - 1, -1, -1):
        start, stop = c * CHUNK, min((c + 1) * CHUNK, n_nodes)
        kept = room_for(stop - start, _measurements_of(run, start, stop))
        R[:], x[:], P[:] = R_before[c], x_before[c], P_before[c]
        forward_stretch(run, gyro_var, acc_var, start, stop, R, x, P, nis, inflation, kept)
        for k in range(stop - 1, start - 1, -1):
            i = k - start
            R[:], x[:] = kept.R[i], kept.x[i]
            if is_smoothed:
                dx = np.zeros(N)
                for j in range(N):
                    for r in range(N):
                        dx[r] -= kept.P[i, j, r] * gradient[j]
                turn_by(R, dx[:3])
                for r in range(3, N):
                    x[r] += dx[r]
            R_out[k], x_out[k] = R, x
            for r in range(len(of)):
                rows[r] = kept.P[i, of[r]]
            if is_smoothed:
                _smoothed(rows, hessian, work, taken)
            for r in range(len(of)):
                for j in range(len(of)):
                    covariance[k, r, j] = rows[r, of[j]] - taken[r, j]
            if k == n_nodes - 1 or k % _WHOLE_EVERY == 0:
                if is_smoothed:
                    _smoothed(kept.P[i], hessian, work, P)
                for r in range(N):
                    variance[k, r] = kept.P[i, r, r] - (P[r, r] if is_smoothed else 0.0)
            else:
                variance[k] = variance[k + 1]
            for r in range(len(of)):
                variance[k, of[r]] = covariance[k, r, r]
            for led in range(leds.first[k, 0], leds.first[k + 1, 0]):
                observe_led(
                    leds, led, R, x, run.arm_m, run.bg_lin, run.off_lin, run.tau_lin, run.skew_lin, H, y
                )
                led_residual_px[led] = y
                for r in range(2):
                    HP[r] = 0.0
                    for p in range(N):
                        h = H[r, p]
                        for q in range(N):
                            HP[r, q] += h * kept.P[i, p, q]
                if is_smoothed:
                    _smoothed(HP, hessian, work, taken)
                for r in range(2):
                    for j in range(2):
                        led_cov_px2[led, r, j] = _dot(HP[r], H[j]) - taken[r, j]
            if not is_smoothed:
                continue
            for m in range(kept.first[i + 1] - 1, kept.first[i] - 1, -1):
                _before_measurement(kept, m, gradient, hessian, work)
            if k > 0 and run.dt_s[k - 1] > 0.0:
                transition(run, k - 1, kept.R[i - 1] if i > 0 else R_before[c], F)
                _before_step(F, gradient, hessian, work)
