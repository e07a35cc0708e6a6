"""How states and innovations of the tightly coupled filter depend on errors that stand still: compiled loops.

The filter is run once more, LED by LED; beside each state goes its derivative by every error, and back again
by the adjoint, as in `sensor_errors_kernel`. What an LED says is whitened: divided by the root of its
innovation's covariance. Matrices of 22 rows are flat inside, as in `covariance_kernel`.
"""

from typing import Any

import numpy as np

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
def carry_forward(
    run: RunArrays,
    gyro_var: Any,
    acc_var: Any,
    R: Any,
    x: Any,
    P_start: Any,
    own: Any,
    further: Any,
    of: Any,
    R_nodes: Any,
    rows: Any,
    changed: Any,
    H: Any,
    HP: Any,
    y: Any,
    dy: Any,
) -> None:
    """Run the filter from R, x and P, shape (22, 22), and write what the way back needs.

    Parameters
    ----------
    own : ndarray, shape (m, 2, q), px
        What the errors change of each LED's residual by themselves; the first 18 are those of the inertial
        samples, which drive the states as well.
    further : ndarray, shape (K - 1, 3, c), m/s
        What the last c errors change of the velocity in each step.
    of : ndarray of int64, shape (c,)
        The states that are wanted.
    R_nodes, rows, changed : ndarray, shape (K, 3, 3), (K, c, 22), (K, c, q)
        Written: attitude, rows of the covariance, and derivative of the states at each node.
    H, HP, y, dy : ndarray, shape (m, 2 N), (m, 2 N), (m, 2), (m, 2, q)
        Written, whitened: of each LED; zero where it is not used.
    """
    leds, n_nodes, q, P = run.leds, len(run.has_frame), own.shape[2], P_start.ravel()
    nis, inflation, room = np.empty(n_nodes), np.empty(n_nodes), room_to_work()
    now, F_flat = np.zeros(N * q), np.zeros(F_SIZE)
    F, now_rows = F_flat.reshape((M, N)), now.reshape((N, q))
    for start in range(0, n_nodes, CHUNK):
        stop = min(start + CHUNK, n_nodes)
        kept = room_for(stop - start, measurements_of(run, start, stop))
        forward_stretch(run, gyro_var, acc_var, start, stop, R, x, P, nis, inflation, room, kept)
        for k in range(start, stop):
            if k > 0 and run.dt_s[k - 1] > 0.0:
                transition(run, k - 1, R_nodes[k - 1], F)
                step_forward(F_flat, now, run.dt_s[k - 1], q)
                drive(run, k - 1, R_nodes[k - 1], now_rows)
                drive_further(run.dt_s[k - 1], further[k - 1], now_rows)
            m = kept.first[k - start]
            for i in range(leds.first[k, 0], leds.first[k + 1, 0]):
                if leds.use[i]:
                    H[i], HP[i], y[i] = kept.H[m, : 2 * N], kept.HP[m, : 2 * N], kept.y[m, :2]
                    _take_in(kept, m, own[i], now, dy[i])
                    m += 1
                else:
                    H[i], HP[i], y[i], dy[i] = 0.0, 0.0, 0.0, 0.0
            R_nodes[k] = kept.R[k - start]
            for c in range(len(of)):
                rows[k, c] = kept.P[k - start, of[c] * N : (of[c] + 1) * N]
                changed[k, c] = now_rows[of[c]]


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
def carry_back(run: RunArrays, R_nodes: Any, H: Any, HP: Any, dy: Any, rows: Any, changed: Any) -> None:
    """Turn the derivatives of the filter's states into those of the smoothed states, in place.

    The adjoint of the way forwards (modified Bryson-Frazier form); see `carry_forward`.
    """
    leds, q = run.leds, changed.shape[2]
    later, work, F_flat = np.zeros(N * q), np.empty((2, q)), np.zeros(F_SIZE)
    F, later_rows = F_flat.reshape((M, N)), later.reshape((N, q))
    for k in range(len(run.has_frame) - 1, -1, -1):
        changed[k] += rows[k] @ later_rows
        for i in range(leds.first[k + 1, 0] - 1, leds.first[k, 0] - 1, -1):
            if leds.use[i]:
                _take_back(H[i], HP[i], dy[i], later, work)
        if k > 0 and run.dt_s[k - 1] > 0.0:
            transition(run, k - 1, R_nodes[k - 1], F)
            step_back(F_flat, later, run.dt_s[k - 1], q)
