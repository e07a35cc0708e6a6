"""What a pose, or one LED, tells the smoother: residual and Jacobian, compiled; one at a time, in place.

Inside, a Jacobian is flat, as in `covariance_kernel`.
"""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled, compiled_inline, compiled_sums
from bricktrack_host.fusion.inertial.rotation_kernel import turn_by, write_rotation_vector
from bricktrack_host.fusion.smoothing.covariance_kernel import N


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
    camera_omega_radps, camera_dv_mps, camera_dp_m : ndarray, shape (m, 3)
        Angular rate of a camera that moves at that instant, and what its motion adds on that way to velocity
        and displacement, in still axes; zero of one that stands.
    R_lin, t_lin_m : ndarray, shape (m, 3, 3), (m, 3)
        Pose of the brick at that instant for which the picture was predicted; of a camera that moves in still
        axes, as is ``J``.
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
    camera_omega_radps: FloatArray
    camera_dv_mps: FloatArray
    camera_dp_m: FloatArray
    R_lin: FloatArray
    t_lin_m: FloatArray
    residual_px: FloatArray
    J: FloatArray
    cov_px2: FloatArray
    nis: FloatArray
    inflation: FloatArray


class ObservationRoom(NamedTuple):
    """Room to work in: a turned attitude, small vectors, a pose's distance and Jacobian."""

    R: FloatArray
    a: FloatArray
    b: FloatArray
    off: FloatArray
    H6: FloatArray


@compiled
def observation_room() -> ObservationRoom:
    """Return room for `observe_pose` and `place_led`, which may go from one to the next."""
    return ObservationRoom(np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(6), np.zeros(6 * N))


@compiled_sums
def _swing(w: Any, arm: Any, out: Any) -> None:
    """Write the velocity of the origin less that of the IMU, body axes."""
    out[0] = w[2] * arm[1] - w[1] * arm[2]
    out[1] = w[0] * arm[2] - w[2] * arm[0]
    out[2] = w[1] * arm[0] - w[0] * arm[1]


@compiled_inline
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
    room: ObservationRoom,
) -> None:
    """Write residual and Jacobian of a pose seen ``dt`` after the state by the present offset and skew.

    ``camera`` is the camera's angular rate in still axes: what it sees moves by the difference.
    """
    swing, turn, ahead = room.a, room.b, room.R
    _swing(w, arm, swing)
    H[:] = 0.0
    for i in range(3):
        turn[i] = w[i] - (R[0, i] * camera[0] + R[1, i] * camera[1] + R[2, i] * camera[2])
        H[i * N + i] = 1.0
        H[i * N + 18], H[i * N + 19] = turn[i], turn[i] * since
        o = (3 + i) * N
        H[o] = R[i, 1] * arm[2] - R[i, 2] * arm[1]
        H[o + 1] = R[i, 2] * arm[0] - R[i, 0] * arm[2]
        H[o + 2] = R[i, 0] * arm[1] - R[i, 1] * arm[0]
        H[o + 3 + i] = 1.0
        v = x[6 + i] + R[i, 0] * swing[0] + R[i, 1] * swing[1] + R[i, 2] * swing[2]
        j, k = (i + 1) % 3, (i + 2) % 3
        v -= camera[j] * p_seen[k] - camera[k] * p_seen[j]
        H[o + 18], H[o + 19] = v, v * since
        y[3 + i] = p_seen[i] - (x[3 + i] - R[i, 0] * arm[0] - R[i, 1] * arm[1] - R[i, 2] * arm[2] + v * dt)
        for j in range(3):
            ahead[i, j] = R[i, j]
    for i in range(3):
        turn[i] *= dt
    turn_by(ahead, turn)
    write_rotation_vector(ahead, R_seen, y)


@compiled_inline
def place_led(
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
    room: ObservationRoom,
) -> None:
    """Write the residual, shape (2,), and its Jacobian, flat, of LED ``m`` for a state at its node.

    The state is carried to the LED's instant by the inertial samples, and on by what offset and skew differ
    from their linearisation; the picture there is that of the linearisation plus its derivative.
    """
    dt, since = leds.dt_s[m], leds.since_mid_s[m]
    half = 0.5 * dt * dt
    step, dv, dp, J = leds.R_step[m], leds.dv_mps[m], leds.dp_m[m], leds.J[m]
    camera, t_lin = leds.camera_omega_radps[m], leds.t_lin_m[m]
    ahead = (x[18] - tau_lin) + since * (x[19] - skew_lin)
    Ri, w, turn, off, H6 = room.R, room.a, room.b, room.off, room.H6
    for i in range(3):
        for j in range(3):
            Ri[i, j] = R[i, 0] * step[0, j] + R[i, 1] * step[1, j] + R[i, 2] * step[2, j]
        turn[i] = -dt * (x[9 + i] - bg_lin[i])
        w[i] = leds.omega_radps[m, i] - x[9 + i]
    turn_by(Ri, turn)
    swing = turn
    _swing(w, arm, swing)
    for i in range(3):
        w[i] -= Ri[0, i] * camera[0] + Ri[1, i] * camera[1] + Ri[2, i] * camera[2]
    moved0 = dp[0] - half * (x[12] - off_lin[0])
    moved1 = dp[1] - half * (x[13] - off_lin[1])
    moved2 = dp[2] - half * (x[14] - off_lin[2])
    for i in range(3):
        v = x[6 + i] + dt * x[15 + i] + R[i, 0] * dv[0] + R[i, 1] * dv[1] + R[i, 2] * dv[2]
        v += Ri[i, 0] * swing[0] + Ri[i, 1] * swing[1] + Ri[i, 2] * swing[2]
        b, c = (i + 1) % 3, (i + 2) % 3
        v += leds.camera_dv_mps[m, i] - (camera[b] * t_lin[c] - camera[c] * t_lin[b])
        p = x[3 + i] + dt * x[6 + i] + half * x[15 + i] + leds.camera_dp_m[m, i]
        p += R[i, 0] * moved0 + R[i, 1] * moved1 + R[i, 2] * moved2
        p -= Ri[i, 0] * arm[0] + Ri[i, 1] * arm[1] + Ri[i, 2] * arm[2]
        off[3 + i] = p + v * ahead - t_lin[i]
        # -R [dp]x, and R_i [arm]x behind what turns the LED's own attitude.
        a0 = Ri[i, 1] * arm[2] - Ri[i, 2] * arm[1]
        a1 = Ri[i, 2] * arm[0] - Ri[i, 0] * arm[2]
        a2 = Ri[i, 0] * arm[1] - Ri[i, 1] * arm[0]
        r, o = i * N, (3 + i) * N
        H6[o] = R[i, 2] * dp[1] - R[i, 1] * dp[2]
        H6[o + 1] = R[i, 0] * dp[2] - R[i, 2] * dp[0]
        H6[o + 2] = R[i, 1] * dp[0] - R[i, 0] * dp[1]
        for j in range(3):
            H6[r + j] = step[j, i]
            H6[o + j] += a0 * step[j, 0] + a1 * step[j, 1] + a2 * step[j, 2]
            H6[o + 12 + j] = -half * R[i, j]
        H6[o + 3 + i], H6[o + 6 + i], H6[o + 15 + i] = 1.0, dt, half
        H6[r + 9 + i] = -dt
        H6[o + 9], H6[o + 10], H6[o + 11] = -dt * a0, -dt * a1, -dt * a2
        H6[r + 18], H6[r + 19] = w[i], w[i] * since
        H6[o + 18], H6[o + 19] = v, v * since
    for i in range(3):
        turn[i] = w[i] * ahead
    turn_by(Ri, turn)
    write_rotation_vector(leds.R_lin[m], Ri, off)
    for i in range(2):
        s = leds.residual_px[m, i]
        for c in range(6):
            s -= J[i, c] * off[c]
        y[i] = s
        j0, j1, j2, j3, j4, j5 = J[i, 0], J[i, 1], J[i, 2], J[i, 3], J[i, 4], J[i, 5]
        for j in range(N):
            turned = j0 * H6[j] + j1 * H6[N + j] + j2 * H6[2 * N + j]
            shifted = j3 * H6[3 * N + j] + j4 * H6[4 * N + j] + j5 * H6[5 * N + j]
            H[i * N + j] = turned + shifted
