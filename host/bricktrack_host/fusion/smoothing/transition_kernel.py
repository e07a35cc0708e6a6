"""One step of the smoother's state in time, compiled: the motion, and its derivative.

The equations are DESIGN 8.2's, the layout of the 22 states is `smoother`'s.
"""

from typing import Any, NamedTuple

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_host.compiled import compiled_inline
from bricktrack_host.fusion.inertial.rotation_kernel import orthonormalise
from bricktrack_host.fusion.smoothing.covariance_kernel import propagate
from bricktrack_host.fusion.smoothing.observation_kernel import LedArrays


class RunArrays(NamedTuple):
    """What `smoother.Problem` holds of one run: its arrays without the axis of the batch, K nodes."""

    dt_s: FloatArray
    R_step: FloatArray
    R_half: FloatArray
    dv_mps: FloatArray
    dp_m: FloatArray
    f_rate_mps3: FloatArray
    f_curve_mps4: FloatArray
    known: FloatArray
    gyro_walk: FloatArray
    acc_walk: FloatArray
    omega_radps: FloatArray
    camera_omega_radps: FloatArray
    has_frame: BoolArray
    R_seen: FloatArray
    p_seen_m: FloatArray
    cov_seen: FloatArray
    since_mid_s: FloatArray
    arm_m: FloatArray
    bg_lin: FloatArray
    off_lin: FloatArray
    """Accelerometer bias, lag and loss where increments were taken, shape (5,)."""
    tau_lin: float
    skew_lin: float
    leds: LedArrays


@compiled_inline
def transition(run: RunArrays, k: int, R: Any, F: Any) -> None:
    """Write the moving rows of the transition from node ``k`` to the next, for attitude R.

    Biases, lag and loss act through the increments: what they add is turned as the middle of the step is. F,
    shape (9, 22), is zero where nothing is written.
    """
    dt = run.dt_s[k]
    dv, dp, rate, curve = run.dv_mps[k], run.dp_m[k], run.f_rate_mps3[k], run.f_curve_mps4[k]
    step, half, known = run.R_step[k], run.R_half[k], run.known[k]
    for i in range(3):
        p, v = 3 + i, 6 + i
        for j in range(3):
            F[i, j] = step[j, i]
        F[i, 9 + i] = -dt
        r0, r1, r2 = R[i, 0], R[i, 1], R[i, 2]
        F[v, 0] = r2 * dv[1] - r1 * dv[2]  # -R [dv]x
        F[v, 1] = r0 * dv[2] - r2 * dv[0]
        F[v, 2] = r1 * dv[0] - r0 * dv[1]
        F[p, 0] = r2 * dp[1] - r1 * dp[2]
        F[p, 1] = r0 * dp[2] - r2 * dp[0]
        F[p, 2] = r1 * dp[0] - r0 * dp[1]
        lag, loss = known[2, i], known[3, i]
        for j in range(3):
            turned = r0 * half[0, j] + r1 * half[1, j] + r2 * half[2, j]
            F[v, 12 + j] = -turned * dt
            F[p, 12 + j] = -0.5 * turned * dt * dt
            lag += turned * rate[j]
            loss -= turned * curve[j]
        F[v, 20], F[v, 21] = lag * dt, loss * dt
        F[p, 20], F[p, 21] = 0.5 * lag * dt * dt, 0.5 * loss * dt * dt
        F[p, 3 + i] = 1.0
        F[p, 6 + i] = dt
        F[p, 15 + i] = 0.5 * dt * dt
        F[v, 6 + i] = 1.0
        F[v, 15 + i] = dt


@compiled_inline
def _move(run: RunArrays, k: int, R: Any, x: Any, F: Any) -> None:
    """Carry the state over one step; biases, lag and loss act as far as they are from where F was taken."""
    dt, step, known = run.dt_s[k], run.R_step[k], run.known[k]
    dv, dp, off = run.dv_mps[k], run.dp_m[k], run.off_lin
    for i in range(3):
        p, v = 3 + i, 6 + i
        step_v = known[0, i] + R[i, 0] * dv[0] + R[i, 1] * dv[1] + R[i, 2] * dv[2]
        step_p = known[1, i] + R[i, 0] * dp[0] + R[i, 1] * dp[1] + R[i, 2] * dp[2]
        for j in range(5):
            at = 12 + j if j < 3 else 17 + j
            step_v += F[v, at] * (x[at] - off[j])
            step_p += F[p, at] * (x[at] - off[j])
        x[3 + i] += dt * x[6 + i] + 0.5 * dt * dt * x[15 + i] + step_p
        x[6 + i] += dt * x[15 + i] + step_v
    turn0 = -dt * (x[9] - run.bg_lin[0])
    turn1 = -dt * (x[10] - run.bg_lin[1])
    turn2 = -dt * (x[11] - run.bg_lin[2])
    for i in range(3):
        a = R[i, 0] * step[0, 0] + R[i, 1] * step[1, 0] + R[i, 2] * step[2, 0]
        b = R[i, 0] * step[0, 1] + R[i, 1] * step[1, 1] + R[i, 2] * step[2, 1]
        c = R[i, 0] * step[0, 2] + R[i, 1] * step[1, 2] + R[i, 2] * step[2, 2]
        R[i, 0] = a + b * turn2 - c * turn1
        R[i, 1] = b + c * turn0 - a * turn2
        R[i, 2] = c + a * turn1 - b * turn0
    orthonormalise(R)


@compiled_inline
def move_to(
    run: RunArrays,
    k: int,
    gyro_var: float,
    acc_var: float,
    R: Any,
    x: Any,
    P: Any,
    F: Any,
    F_flat: Any,
    room: Any,
) -> None:
    """Carry the state from the node before to node ``k``, in place; P is flat, and so is ``room``.

    F, and the same in a row, are room to work in.
    """
    j = k - 1
    transition(run, j, R, F)
    _move(run, j, R, x, F)
    propagate(F_flat, P, room, run.dt_s[j], gyro_var, acc_var, run.gyro_walk[j], run.acc_walk[j])
