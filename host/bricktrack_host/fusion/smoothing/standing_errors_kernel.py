"""How states and innovations of the tightly coupled filter depend on errors that stand still: compiled loops.

The filter is run once more, LED by LED; beside each state goes its derivative by every error, and back again
by the adjoint, as in `sensor_errors_kernel`. What an LED says is whitened: divided by the root of its
innovation's covariance. Matrices of 22 rows are flat inside, as in `covariance_kernel`. As on the smoother's
way back, one stretch is in memory at a time, made again from what is kept before it.
"""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled, compiled_sums
from bricktrack_host.fusion.smoothing.covariance_kernel import F_SIZE, M, N, step_back, step_forward
from bricktrack_host.fusion.smoothing.sensor_errors_kernel import drive, drive_further
from bricktrack_host.fusion.smoothing.smoother_kernel import (
    CHUNK,
    Kept,
    forward_stretch,
    measurements_of,
    room_for,
    room_to_work,
)
from bricktrack_host.fusion.smoothing.transition_kernel import RunArrays, transition


class Way(NamedTuple):
    """A filter's way over a run with the derivatives by all errors, as kept to go any stretch of it again.

    Attributes
    ----------
    run : RunArrays
        K nodes.
    gyro_var, acc_var : ndarray, shape (K - 1,)
    R_before, x_before, P_before
        What `smoother_kernel.forward_pass` kept before each stretch.
    own : ndarray, shape (m, 2, q), px
        What the errors change of each LED's residual by themselves; the first 18 are those of the inertial
        samples, which drive the states as well.
    further : ndarray, shape (K - 1, 3, c), m/s
        What the last c errors change of the velocity in each step.
    now_before : ndarray, shape (n, 22 q)
        Derivatives of the state before each stretch, written by `carry_forward`.
    """

    run: RunArrays
    gyro_var: FloatArray
    acc_var: FloatArray
    R_before: FloatArray
    x_before: FloatArray
    P_before: FloatArray
    own: FloatArray
    further: FloatArray
    now_before: FloatArray


@compiled_sums
def _take_in(kept: Kept, m: int, own: Any, now: Any, dy: Any) -> None:
    """Write the derivative of a whitened innovation, shape (2, q), and take it into that of the state."""
    q, H, HP, L = own.shape[1], kept.H[m], kept.HP[m], kept.L[m]
    for j in range(q):
        dy[0, j] = own[0, j] / L[0, 0]
        dy[1, j] = (own[1, j] - L[1, 0] * dy[0, j]) / L[1, 1]
    for i in range(N):
        a, b = H[i], H[N + i]
        if a != 0.0 or b != 0.0:
            for j in range(q):
                dy[0, j] -= a * now[i * q + j]
                dy[1, j] -= b * now[i * q + j]
    for i in range(N):
        a, b = HP[i], HP[N + i]
        for j in range(q):
            now[i * q + j] += a * dy[0, j] + b * dy[1, j]


@compiled
def _go_again(way: Way, c: int, of: Any, now: Any, changed: Any) -> tuple[Kept, Any]:
    """Go over stretch ``c`` again; return what the filter leaves and how its innovations change, (n, 2, q).

    The latter are whitened. The derivatives ``now``, flat, are carried over it. With room in ``changed``,
    those of the states ``of`` after each node are written, shape (n_nodes, c, q).
    """
    run, leds, q, n_nodes = way.run, way.run.leds, way.own.shape[2], len(way.run.has_frame)
    start, stop = c * CHUNK, min((c + 1) * CHUNK, n_nodes)
    kept = room_for(stop - start, measurements_of(run, start, stop))
    R, x, P = way.R_before[c].copy(), way.x_before[c].copy(), way.P_before[c].copy()
    nis, inflation = np.empty(n_nodes), np.empty(n_nodes)
    forward_stretch(
        run, way.gyro_var, way.acc_var, start, stop, R, x, P, nis, inflation, room_to_work(), kept
    )
    F_flat, dy = np.zeros(F_SIZE), np.empty((kept.first[stop - start], 2, q))
    F, now_rows = F_flat.reshape((M, N)), now.reshape((N, q))
    for k in range(start, stop):
        if k > 0 and run.dt_s[k - 1] > 0.0:
            R_last = kept.R[k - start - 1] if k > start else way.R_before[c]
            transition(run, k - 1, R_last, F)
            step_forward(F_flat, now, run.dt_s[k - 1], q)
            drive(run, k - 1, R_last, now_rows)
            drive_further(run.dt_s[k - 1], way.further[k - 1], now_rows)
        m = kept.first[k - start]
        for i in range(leds.first[k, 0], leds.first[k + 1, 0]):
            if leds.use[i]:
                _take_in(kept, m, way.own[i], now, dy[m])
                m += 1
        if len(changed):
            for r in range(len(of)):
                changed[k - start, r] = now_rows[of[r]]
    return kept, dy


@compiled
def carry_forward(way: Way, normal: Any, pull: Any) -> None:
    """Write how the errors move what is seen in a whole run, and what `carry_back` begins its stretches with.

    ``normal``, shape (q, q), and ``pull``, shape (q,), are the sums over the LEDs of the products of the
    innovations' derivatives with each other, and with the innovations; whitened.
    """
    q = way.own.shape[2]
    now, of, nothing = np.zeros(N * q), np.zeros(0, dtype=np.int64), np.empty((0, 0, q))
    normal[:], pull[:] = 0.0, 0.0
    for c in range(len(way.R_before)):
        way.now_before[c] = now
        kept, dy = _go_again(way, c, of, now, nothing)
        n = len(dy)
        rows, y = dy.reshape((2 * n, q)), np.empty(2 * n)
        for m in range(n):
            y[2 * m], y[2 * m + 1] = kept.y[m, 0], kept.y[m, 1]
        normal += np.dot(rows.T, rows)
        pull += np.dot(rows.T, y)


@compiled_sums
def _take_back(H: Any, HP: Any, dy: Any, later: Any, work: Any) -> None:
    """Carry what comes later, flat, to before an LED, in place; ``work``, shape (2, q), is to work in."""
    q = dy.shape[1]
    for r in range(2):
        for j in range(q):
            work[r, j] = dy[r, j]
    for i in range(N):
        a, b = HP[i], HP[N + i]
        for j in range(q):
            work[0, j] -= a * later[i * q + j]
            work[1, j] -= b * later[i * q + j]
    for i in range(N):
        a, b = H[i], H[N + i]
        if a != 0.0 or b != 0.0:
            for j in range(q):
                later[i * q + j] += a * work[0, j] + b * work[1, j]


@compiled
def carry_back(way: Way, of: Any, changed: Any) -> None:
    """Write the derivatives of the smoothed states ``of`` by the errors, shape (K, c, q).

    By the adjoint of the way forwards (modified Bryson-Frazier form), which was gone before.
    """
    run, q, n_nodes = way.run, way.own.shape[2], len(way.run.has_frame)
    later, work, F_flat = np.zeros(N * q), np.empty((2, q)), np.zeros(F_SIZE)
    F, later_rows, rows = F_flat.reshape((M, N)), later.reshape((N, q)), np.empty((len(of), N))
    for c in range(len(way.R_before) - 1, -1, -1):
        start, stop = c * CHUNK, min((c + 1) * CHUNK, n_nodes)
        part = np.empty((stop - start, len(of), q))
        kept, dy = _go_again(way, c, of, way.now_before[c].copy(), part)
        for k in range(stop - 1, start - 1, -1):
            i = k - start
            for r in range(len(of)):
                rows[r] = kept.P[i, of[r] * N : (of[r] + 1) * N]
            changed[k] = part[i] + np.dot(rows, later_rows)
            for m in range(kept.first[i + 1] - 1, kept.first[i] - 1, -1):
                _take_back(kept.H[m], kept.HP[m], dy[m], later, work)
            if k > 0 and run.dt_s[k - 1] > 0.0:
                transition(run, k - 1, kept.R[i - 1] if i > 0 else way.R_before[c], F)
                step_back(F_flat, later, run.dt_s[k - 1], q)
