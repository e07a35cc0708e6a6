"""What a pose, or one LED, tells the smoother: residual and Jacobian, compiled; one at a time, in place."""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.rotation_kernel import turn_by, write_rotation_vector

N = 22


class LedArrays(NamedTuple):
    """LEDs as seen, each tied to the node nearest in time; ordered by run and node, m in all.

    Attributes
    ----------
    first : ndarray of int64, shape (K + 1, B)
        Those of node k of run b are ``first[k, b]`` to ``first[k + 1, b]``.
    use : ndarray of bool, shape (m,)
        Others are not shown to the filter.
    dt_s, since_mid_s : ndarray, shape (m,)
        From the node to the LED's instant (negative: before it); camera time after the run's middle.
    R_step, dv_mps, dp_m : ndarray, shape (m, 3, 3), (m, 3), (m, 3)
        What the inertial samples say of that way, in body axes at the node.
    omega_radps : ndarray, shape (m, 3)
        Measured angular rate at the LED's instant.
    R_lin, t_lin_m : ndarray, shape (m, 3, 3), (m, 3)
        Pose of the brick at that instant for which the picture was predicted.
    residual_px, J, cov_px2 : ndarray, shape (m, 2), (m, 2, 6), (m, 2, 2)
        Seen less predicted; derivative of the prediction by [dtheta rad, dt m] of that pose; covariance.
    nis, inflation : ndarray, shape (m,)
        Written: innovation squared over its covariance, and by how much the covariance was enlarged.
    """

    first: IntArray
    use: BoolArray
    dt_s: FloatArray
    since_mid_s: FloatArray
    R_step: FloatArray
    dv_mps: FloatArray
    dp_m: FloatArray
    omega_radps: FloatArray
    R_lin: FloatArray
    t_lin_m: FloatArray
    residual_px: FloatArray
    J: FloatArray
    cov_px2: FloatArray
    nis: FloatArray
    inflation: FloatArray


@compiled
def observe_pose(
    R: Any,
    x: Any,
    w: Any,
    camera: Any,
    arm: Any,
    since: float,
    dt: float,
    R_seen: Any,
    p_seen: Any,
    H: Any,
    y: Any,
) -> None:
    """Write residual and Jacobian of a pose seen ``dt`` after the state by the present offset and skew.

    ``camera`` is the camera's angular rate in still axes: what it sees moves by the difference.
    """
    c = np.empty(3)  # velocity of the origin less that of the IMU, body axes
    c[0] = -(w[1] * arm[2] - w[2] * arm[1])
    c[1] = -(w[2] * arm[0] - w[0] * arm[2])
    c[2] = -(w[0] * arm[1] - w[1] * arm[0])
    H[:] = 0.0
    turn = np.empty(3)
    for i in range(3):
        turn[i] = w[i] - (R[0, i] * camera[0] + R[1, i] * camera[1] + R[2, i] * camera[2])
    for i in range(3):
        H[i, i] = 1.0
        H[i, 18], H[i, 19] = turn[i], turn[i] * since
        H[3 + i, 0] = R[i, 1] * arm[2] - R[i, 2] * arm[1]
        H[3 + i, 1] = R[i, 2] * arm[0] - R[i, 0] * arm[2]
        H[3 + i, 2] = R[i, 0] * arm[1] - R[i, 1] * arm[0]
        H[3 + i, 3 + i] = 1.0
        v = x[6 + i] + R[i, 0] * c[0] + R[i, 1] * c[1] + R[i, 2] * c[2]
        j, k = (i + 1) % 3, (i + 2) % 3
        v -= camera[j] * p_seen[k] - camera[k] * p_seen[j]
        H[3 + i, 18], H[3 + i, 19] = v, v * since
        y[3 + i] = p_seen[i] - (x[3 + i] - R[i, 0] * arm[0] - R[i, 1] * arm[1] - R[i, 2] * arm[2] + v * dt)
    ahead = R.copy()
    turn_by(ahead, turn * dt)
    write_rotation_vector(ahead, R_seen, y[:3])


@compiled
def observe_led(
    leds: LedArrays,
    m: int,
    R: Any,
    x: Any,
    arm: Any,
    bg_lin: Any,
    off_lin: Any,
    tau_lin: float,
    skew_lin: float,
    H: Any,
    y: Any,
) -> None:
    """Write the residual, shape (2,), and its Jacobian, shape (2, 22), of LED ``m`` for a state at its node.

    The state is carried to the LED's instant by the inertial samples, and on by what offset and skew differ
    from their linearisation; the picture there is that of the linearisation plus its derivative.
    """
    dt, since = leds.dt_s[m], leds.since_mid_s[m]
    step, dv, dp = leds.R_step[m], leds.dv_mps[m], leds.dp_m[m]
    ahead = (x[18] - tau_lin) + since * (x[19] - skew_lin)
    Ri, w, turn = np.empty((3, 3)), np.empty(3), np.empty(3)
    for i in range(3):
        for j in range(3):
            Ri[i, j] = R[i, 0] * step[0, j] + R[i, 1] * step[1, j] + R[i, 2] * step[2, j]
        turn[i] = -dt * (x[9 + i] - bg_lin[i])
        w[i] = leds.omega_radps[m, i] - x[9 + i]
    turn_by(Ri, turn)
    swing = np.empty(3)  # velocity of the origin less that of the IMU, body axes
    swing[0] = -(w[1] * arm[2] - w[2] * arm[1])
    swing[1] = -(w[2] * arm[0] - w[0] * arm[2])
    swing[2] = -(w[0] * arm[1] - w[1] * arm[0])
    off, H6 = np.empty(6), np.zeros((6, N))
    moved = np.empty(3)
    for i in range(3):
        moved[i] = dp[i] - 0.5 * dt * dt * (x[12 + i] - off_lin[i])
    for i in range(3):
        v = x[6 + i] + dt * x[15 + i] + R[i, 0] * dv[0] + R[i, 1] * dv[1] + R[i, 2] * dv[2]
        v += Ri[i, 0] * swing[0] + Ri[i, 1] * swing[1] + Ri[i, 2] * swing[2]
        p = x[3 + i] + dt * x[6 + i] + 0.5 * dt * dt * x[15 + i]
        p += R[i, 0] * moved[0] + R[i, 1] * moved[1] + R[i, 2] * moved[2]
        p -= Ri[i, 0] * arm[0] + Ri[i, 1] * arm[1] + Ri[i, 2] * arm[2]
        off[3 + i] = p + v * ahead - leds.t_lin_m[m, i]
        H6[i, 9 + i] = -dt
        H6[i, 18], H6[i, 19] = w[i], w[i] * since
        H6[3 + i, 18], H6[3 + i, 19] = v, v * since
        H6[3 + i, 3 + i], H6[3 + i, 6 + i], H6[3 + i, 15 + i] = 1.0, dt, 0.5 * dt * dt
        # -R [dp]x, and R_i [arm]x behind what turns the LED's own attitude.
        H6[3 + i, 0] = -(R[i, 1] * dp[2] - R[i, 2] * dp[1])
        H6[3 + i, 1] = -(R[i, 2] * dp[0] - R[i, 0] * dp[2])
        H6[3 + i, 2] = -(R[i, 0] * dp[1] - R[i, 1] * dp[0])
        a0 = Ri[i, 1] * arm[2] - Ri[i, 2] * arm[1]
        a1 = Ri[i, 2] * arm[0] - Ri[i, 0] * arm[2]
        a2 = Ri[i, 0] * arm[1] - Ri[i, 1] * arm[0]
        for j in range(3):
            H6[i, j] = step[j, i]
            H6[3 + i, j] += a0 * step[j, 0] + a1 * step[j, 1] + a2 * step[j, 2]
            H6[3 + i, 12 + j] = -0.5 * dt * dt * R[i, j]
        H6[3 + i, 9], H6[3 + i, 10], H6[3 + i, 11] = -dt * a0, -dt * a1, -dt * a2
    turn_by(Ri, w * ahead)
    write_rotation_vector(leds.R_lin[m], Ri, off[:3])
    for i in range(2):
        s = leds.residual_px[m, i]
        for j in range(6):
            s -= leds.J[m, i, j] * off[j]
        y[i] = s
        for j in range(N):
            h = 0.0
            for c in range(6):
                h += leds.J[m, i, c] * H6[c, j]
            H[i, j] = h
