"""How states and innovations of the tightly coupled filter depend on errors that stand still: compiled loops.

The filter is run once more, LED by LED; beside each state goes its derivative by every error, and back again
by the adjoint, as in `sensor_errors_kernel`. What an LED says is whitened: divided by the root of its
innovation's covariance.
"""

from typing import Any

import numpy as np

from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.observation_kernel import N, observe_led
from bricktrack_host.fusion.rotation_kernel import turn_by
from bricktrack_host.fusion.sensor_errors_kernel import drive
from bricktrack_host.fusion.smoother_kernel import M, RunArrays, step_to, transition


@compiled
def _take_in(run: RunArrays, i: int, R: Any, x: Any, P: Any, H: Any, HP: Any, y: Any, root: Any) -> None:
    """Take in LED ``i`` with the covariance that the filter gave it, in place.

    H, HP and y, shape (2, 22), (2, 22), (2,), are left whitened; ``root``, shape (2, 2), is what by.
    """
    leds = run.leds
    observe_led(leds, i, R, x, run.arm_m, run.bg_lin, run.off_lin, run.tau_lin, run.skew_lin, H, y)
    HP[:] = H @ P
    S = HP @ H.T + leds.inflation[i] * leds.cov_px2[i]
    root[0, 0] = np.sqrt(S[0, 0])
    root[1, 0] = S[1, 0] / root[0, 0]
    root[1, 1] = np.sqrt(S[1, 1] - root[1, 0] ** 2)
    root[0, 1] = 0.0
    y[0] /= root[0, 0]
    y[1] = (y[1] - root[1, 0] * y[0]) / root[1, 1]
    for j in range(N):
        H[0, j] /= root[0, 0]
        H[1, j] = (H[1, j] - root[1, 0] * H[0, j]) / root[1, 1]
        HP[0, j] /= root[0, 0]
        HP[1, j] = (HP[1, j] - root[1, 0] * HP[0, j]) / root[1, 1]
    dx = HP.T @ y
    for r in range(N):
        for j in range(N):
            P[r, j] -= HP[0, r] * HP[0, j] + HP[1, r] * HP[1, j]
    turn_by(R, dx[:3])
    x[3:] += dx[3:]


@compiled
def carry_forward(
    run: RunArrays,
    gyro_var: Any,
    acc_var: Any,
    R: Any,
    x: Any,
    P: Any,
    own: Any,
    of: Any,
    R_nodes: Any,
    rows: Any,
    changed: Any,
    H: Any,
    HP: Any,
    y: Any,
    dy: Any,
) -> None:
    """Run the filter from R, x and P, and write what the way back needs.

    Parameters
    ----------
    own : ndarray, shape (m, 2, q), px
        What the errors change of each LED's residual by themselves; the first 18 are those of the inertial
        samples, which drive the states as well.
    of : ndarray of int64, shape (c,)
        The states that are wanted.
    R_nodes, rows, changed : ndarray, shape (K, 3, 3), (K, c, 22), (K, c, q)
        Written: attitude, rows of the covariance, and derivative of the states at each node.
    H, HP, y, dy : ndarray, shape (m, 2, 22), (m, 2, 22), (m, 2), (m, 2, q)
        Written, whitened: of each LED; zero where it is not used.
    """
    leds, q = run.leds, own.shape[2]
    now, F, FP, root = np.zeros((N, q)), np.zeros((M, N)), np.zeros((M, N)), np.zeros((2, 2))
    for k in range(len(run.has_frame)):
        if k > 0 and run.dt_s[k - 1] > 0.0:
            before = R.copy()
            step_to(run, k, gyro_var[k - 1], acc_var[k - 1], R, x, P, F, FP)
            now[:M] = F @ now
            drive(run, k - 1, before, now)
        for i in range(leds.first[k, 0], leds.first[k + 1, 0]):
            if not leds.use[i]:
                H[i], HP[i], y[i], dy[i] = 0.0, 0.0, 0.0, 0.0
                continue
            _take_in(run, i, R, x, P, H[i], HP[i], y[i], root)
            dy[i, 0] = own[i, 0] / root[0, 0]
            dy[i, 1] = (own[i, 1] - root[1, 0] * dy[i, 0]) / root[1, 1]
            dy[i] -= H[i] @ now
            now += HP[i].T @ dy[i]
        R_nodes[k] = R
        for c in range(len(of)):
            rows[k, c], changed[k, c] = P[of[c]], now[of[c]]


@compiled
def carry_back(run: RunArrays, R_nodes: Any, H: Any, HP: Any, dy: Any, rows: Any, changed: Any) -> None:
    """Turn the derivatives of the filter's states into those of the smoothed states, in place.

    The adjoint of the way forwards (modified Bryson-Frazier form); see `carry_forward`.
    """
    leds = run.leds
    later, F = np.zeros((N, changed.shape[2])), np.zeros((M, N))
    for k in range(len(run.has_frame) - 1, -1, -1):
        changed[k] += rows[k] @ later
        for i in range(leds.first[k + 1, 0] - 1, leds.first[k, 0] - 1, -1):
            if leds.use[i]:
                later += H[i].T @ (dy[i] - HP[i] @ later)
        if k > 0 and run.dt_s[k - 1] > 0.0:
            transition(run, k - 1, R_nodes[k - 1], F)
            before = F.T @ later[:M]
            before[M:] += later[M:]
            later = before
