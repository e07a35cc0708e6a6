"""How the filter's states and innovations depend on errors of the sensor that stand still: compiled loops.

The errors are those of `sensor_errors.SensorErrors`: 9 of the gyro, 9 of the accelerometer, 3 of the arm; and
after these whatever else is given by what it does in each step and to each frame.
"""

from typing import Any

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.smoothing.transition_kernel import RunArrays, transition

_N = 22
_MOVING = 9


@compiled
def drive(run: RunArrays, k: int, R: Any, now: Any) -> None:
    """Add what the errors do to the state in the step from node ``k``."""
    h, half, dv = run.dt_s[k], run.R_half[k], run.dv_mps[k]
    for m in range(3):
        rate = 0.5 * (run.omega_radps[k, m] + run.omega_radps[k + 1, m])
        force = (half[0, m] * dv[0] + half[1, m] * dv[1] + half[2, m] * dv[2]) / h
        for i in range(3):
            now[i, 3 * i + m] -= h * rate
            for r in range(3):
                axis = R[r, 0] * half[0, i] + R[r, 1] * half[1, i] + R[r, 2] * half[2, i]
                now[6 + r, 9 + 3 * i + m] -= h * axis * force
                now[3 + r, 9 + 3 * i + m] -= 0.5 * h * h * axis * force


@compiled
def drive_further(h: float, further: Any, now: Any) -> None:
    """Add what the last c errors, not the sensor's own, do to velocity, shape (3, c), and so to position."""
    first = now.shape[1] - further.shape[1]
    for r in range(3):
        for c in range(further.shape[1]):
            now[6 + r, first + c] += further[r, c]
            now[3 + r, first + c] += 0.5 * h * further[r, c]


@compiled
def carry_forward(
    run: RunArrays, at: Any, R: Any, H: Any, gain: Any, own: Any, further: Any, of: Any
) -> tuple[FloatArray, FloatArray]:
    """Return the derivatives of predicted states (K, c, q) and of innovations (n, 6, q) by the errors.

    Parameters
    ----------
    at : ndarray of int64, shape (n,)
        Nodes with a frame, rising.
    R : ndarray, shape (K, 3, 3)
        The filter's attitudes.
    of : ndarray of int64, shape (c,)
        The states that are wanted.
    H, gain, own : ndarray, shape (n, 6, 22), (n, 22, 6), (n, 6, q)
        Of the frames; the last is what an error changes of the innovation by itself.
    further : ndarray, shape (K - 1, 3, q - 21), m/s
        What the errors beyond the sensor's own change of the velocity in each step.
    """
    n_nodes, q = len(R), own.shape[2]
    predicted, dy = np.zeros((n_nodes, len(of), q)), np.zeros((len(at), 6, q))
    now, F = np.zeros((_N, q)), np.zeros((_MOVING, _N))
    frame = 0
    for k in range(n_nodes):
        if k > 0 and run.dt_s[k - 1] > 0.0:
            transition(run, k - 1, R[k - 1], F)
            now[:_MOVING] = F @ now
            drive(run, k - 1, R[k - 1], now)
            drive_further(run.dt_s[k - 1], further[k - 1], now)
        for c in range(len(of)):
            predicted[k, c] = now[of[c]]
        if frame < len(at) and at[frame] == k:
            dy[frame] = own[frame] - H[frame] @ now
            now += gain[frame] @ dy[frame]
            frame += 1
    return predicted, dy


@compiled
def carry_back(
    run: RunArrays, at: Any, R: Any, H: Any, gain: Any, weighted: Any, P_rows: Any, changed: Any
) -> None:
    """Turn derivatives of predicted states into those of smoothed states, (K, c, q), in place.

    The adjoint of the forward pass (modified Bryson-Frazier form): what comes after a node reaches it as
    ``P H^T S^-1 dy``. ``weighted`` is S^-1 dy, shape (n, 6, q); ``P_rows`` the predicted covariance's rows of
    the states that are wanted, shape (K, c, 22).
    """
    n_nodes, q = len(R), changed.shape[2]
    later, F = np.zeros((_N, q)), np.zeros((_MOVING, _N))
    frame = len(at) - 1
    for k in range(n_nodes - 1, -1, -1):
        if frame >= 0 and at[frame] == k:
            later += H[frame].T @ (weighted[frame] - gain[frame].T @ later)
            frame -= 1
        changed[k] += P_rows[k] @ later
        if k > 0 and run.dt_s[k - 1] > 0.0:
            transition(run, k - 1, R[k - 1], F)
            before = F.T @ later[:_MOVING]
            before[_MOVING:] += later[_MOVING:]
            later = before
