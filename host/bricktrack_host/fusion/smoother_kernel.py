"""The smoother's loops over time, compiled: one run forwards, one run backwards.

The equations are DESIGN 8.2's, the layout of the 22 states and the arrays are `smoother`'s. The transition is
the identity but for the nine moving states, so only those rows are multiplied out. The loops hold no lock of
the interpreter: runs can share the cores by threads.
"""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.rotation_kernel import (
    orthonormalise,
    turn_by,
    write_rotation_vector,
)

N = 22
M = 9  # attitude, position, velocity
_NIS_CAP = 100.0  # so that an outlier does not choose the noise
CHI2_6_95 = 12.59  # 95 % point of chi-square with 6 degrees of freedom
CHI2_2_95 = 5.99
_LEAST_PIVOT = 1e-13  # of a correlation matrix: rounding leaves no less


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
def _transition(R: Any, dt: float, R_step: Any, effect: Any, known: Any, F: Any) -> None:
    """Write the moving rows of the transition, shape (9, 22), for a state with attitude R."""
    F[:] = 0.0
    for i in range(3):
        for j in range(3):
            F[i, j] = R_step[j, i]
        F[i, 9 + i] = -dt
        F[3 + i, 3 + i] = 1.0
        F[3 + i, 6 + i] = dt
        F[3 + i, 15 + i] = 0.5 * dt * dt
        F[6 + i, 6 + i] = 1.0
        F[6 + i, 15 + i] = dt
        for j in range(8):
            at = j if j < 3 else (9 + j if j < 6 else 14 + j)
            F[6 + i, at] = R[i, 0] * effect[0, j] + R[i, 1] * effect[1, j] + R[i, 2] * effect[2, j]
            F[3 + i, at] = R[i, 0] * effect[3, j] + R[i, 1] * effect[4, j] + R[i, 2] * effect[5, j]
        for j in range(2):
            F[6 + i, 20 + j] += known[2 + j, i] * dt
            F[3 + i, 20 + j] += 0.5 * known[2 + j, i] * dt * dt


@compiled
def _times(F: Any, P: Any, out: Any) -> None:
    """Write F P for the sparse F of `_transition`."""
    for i in range(M):
        row = out[i]
        row[:] = 0.0
        for m in range(N):
            f = F[i, m]
            if f != 0.0:
                for j in range(N):
                    row[j] += f * P[m, j]


@compiled
def _propagate(F: Any, P: Any, FP: Any, dt: float, gyro: float, acc: float, bg: float, ba: float) -> None:
    """Replace P by F P F^T + Q."""
    _times(F, P, FP)
    for i in range(M):
        for j in range(M, N):
            P[i, j] = FP[i, j]
            P[j, i] = FP[i, j]
        for j in range(i + 1):
            s = 0.0
            for m in range(N):
                s += FP[i, m] * F[j, m]
            P[i, j] = s
            P[j, i] = s
    for i in range(3):
        P[i, i] += gyro * dt
        P[6 + i, 6 + i] += acc * dt
        P[3 + i, 6 + i] += 0.5 * acc * dt * dt
        P[6 + i, 3 + i] += 0.5 * acc * dt * dt
        P[3 + i, 3 + i] += acc * dt * dt * dt / 3.0
        P[9 + i, 9 + i] += bg * dt
        P[12 + i, 12 + i] += ba * dt


@compiled
def _move(
    R: Any, x: Any, dt: float, R_step: Any, dv: Any, dp: Any, known: Any, F: Any, off: Any, bg_lin: Any
) -> None:
    """Carry the state over one step; ``off`` is how far biases, lag and loss are from their linearisation."""
    turn = np.empty(3)
    for i in range(3):
        step_v = known[0, i] + R[i, 0] * dv[0] + R[i, 1] * dv[1] + R[i, 2] * dv[2]
        step_p = known[1, i] + R[i, 0] * dp[0] + R[i, 1] * dp[1] + R[i, 2] * dp[2]
        for j in range(5):
            at = 12 + j if j < 3 else 17 + j
            step_v += F[6 + i, at] * off[j]
            step_p += F[3 + i, at] * off[j]
        x[3 + i] += dt * x[6 + i] + 0.5 * dt * dt * x[15 + i] + step_p
        x[6 + i] += dt * x[15 + i] + step_v
        turn[i] = -dt * (x[9 + i] - bg_lin[i])
    row = np.empty(3)
    for i in range(3):
        for j in range(3):
            row[j] = R[i, 0] * R_step[0, j] + R[i, 1] * R_step[1, j] + R[i, 2] * R_step[2, j]
        R[i, 0] = row[0] + row[1] * turn[2] - row[2] * turn[1]
        R[i, 1] = row[1] + row[2] * turn[0] - row[0] * turn[2]
        R[i, 2] = row[2] + row[0] * turn[1] - row[1] * turn[0]
    orthonormalise(R)


@compiled
def _factor(S: Any, n: int) -> None:
    """Replace the lower triangle of S by its Cholesky factor."""
    for i in range(n):
        for j in range(i + 1):
            s = S[i, j]
            for m in range(j):
                s -= S[i, m] * S[j, m]
            S[i, j] = np.sqrt(s) if i == j else s / S[j, j]


@compiled
def _squared(L: Any, y: Any, n: int, out: Any) -> float:
    """Write L^-1 y and return its square."""
    total = 0.0
    for i in range(n):
        s = y[i]
        for m in range(i):
            s -= L[i, m] * out[m]
        out[i] = s / L[i, i]
        total += out[i] * out[i]
    return total


@compiled
def _correct(H: Any, C: Any, y: Any, n: int, chi2_95: float, R: Any, x: Any, P: Any) -> Any:
    """Take in ``n`` residuals y with Jacobian H and covariance C, in place.

    Returns the innovation squared over its covariance, its log-determinant, and by how much C was enlarged: a
    surprise is believed less, in proportion, never refused, so that the filter finds back after it has gone
    wrong itself.
    """
    HP = np.zeros((n, N))
    for i in range(n):
        for m in range(N):
            h = H[i, m]
            if h != 0.0:
                for j in range(N):
                    HP[i, j] += h * P[m, j]
    predicted, S, white = np.zeros((n, n)), np.empty((n, n)), np.empty(n)
    for i in range(n):
        for j in range(i + 1):
            s = 0.0
            for m in range(N):
                s += HP[i, m] * H[j, m]
            predicted[i, j] = s
            S[i, j] = s + C[i, j]
    _factor(S, n)
    log_det = 0.0
    for i in range(n):
        log_det += 2.0 * np.log(S[i, i])
    nis = _squared(S, y, n, white)
    inflation = max(nis / chi2_95, 1.0)
    if inflation > 1.0:
        for i in range(n):
            for j in range(i + 1):
                S[i, j] = predicted[i, j] + inflation * C[i, j]
        _factor(S, n)
        _squared(S, y, n, white)
    for i in range(n):  # HP becomes L^-1 H P
        for m in range(i):
            for j in range(N):
                HP[i, j] -= S[i, m] * HP[m, j]
        for j in range(N):
            HP[i, j] /= S[i, i]
    dx = np.zeros(N)
    for i in range(n):
        for j in range(N):
            dx[j] += HP[i, j] * white[i]
    for i in range(n):
        for r in range(N):
            w = HP[i, r]
            for j in range(N):
                P[r, j] -= w * HP[i, j]
    turn_by(R, dx[:3])
    for j in range(3, N):
        x[j] += dx[j]
    return nis, log_det, inflation


@compiled
def _observe_pose(
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


@compiled
def led_residuals(
    leds: LedArrays,
    b: int,
    R: Any,
    x: Any,
    P: Any,
    arm: Any,
    bg_lin: Any,
    off_lin: Any,
    tau_lin: float,
    skew_lin: float,
    y: Any,
    A: Any,
) -> None:
    """Write residuals (m, 2) of run ``b``'s LEDs for states at nodes, (K, B, ..), and H P H^T (m, 2, 2)."""
    H = np.zeros((2, N))
    for k in range(leds.first.shape[0] - 1):
        for m in range(leds.first[k, b], leds.first[k + 1, b]):
            observe_led(leds, m, R[k, b], x[k, b], arm, bg_lin, off_lin, tau_lin, skew_lin, H, y[m])
            for i in range(2):
                for j in range(2):
                    s = 0.0
                    for r in range(N):
                        for c in range(N):
                            s += H[i, r] * P[k, b, r, c] * H[j, c]
                    A[m, i, j] = s


@compiled
def forward_pass(
    b: int,
    dt: Any,
    R_step: Any,
    dv: Any,
    dp: Any,
    effect: Any,
    known: Any,
    gyro_var: Any,
    acc_var: Any,
    gyro_walk: Any,
    acc_walk: Any,
    omega: Any,
    camera_omega: Any,
    has_frame: Any,
    R_seen: Any,
    p_seen: Any,
    cov_seen: Any,
    since_mid: Any,
    arm: Any,
    bg_lin: Any,
    off_lin: Any,
    tau_lin: float,
    skew_lin: float,
    R: Any,
    x: Any,
    P: Any,
    keep: bool,
    R_kept: Any,
    x_kept: Any,
    P_kept: Any,
    R_pred: Any,
    x_pred: Any,
    P_pred: Any,
    nis: Any,
    inflation: Any,
    leds: LedArrays,
) -> float:
    """Run the filter over run ``b`` of a batch, from R, x and P, which end as the last state.

    ``gyro_var`` and ``acc_var`` have shape (K - 1,), all else is `smoother.Problem`'s with time first;
    ``off_lin`` holds where accelerometer bias, lag and loss were linearised. What is kept goes to column b.
    Returns the log-likelihood of the frames and LEDs.
    """
    n_nodes = has_frame.shape[0]
    F, FP, H, y = np.zeros((M, N)), np.zeros((M, N)), np.zeros((6, N)), np.zeros(6)
    H2, y2 = np.zeros((2, N)), np.zeros(2)
    off = np.empty(5)
    w = np.empty(3)
    log_likelihood = 0.0
    for k in range(n_nodes):
        if k > 0:
            j = k - 1
            h = dt[j, b]
            if h > 0.0:
                _transition(R, h, R_step[j, b], effect[j, b], known[j, b], F)
                for i in range(3):
                    off[i] = x[12 + i] - off_lin[i]
                off[3], off[4] = x[20] - off_lin[3], x[21] - off_lin[4]
                _move(R, x, h, R_step[j, b], dv[j, b], dp[j, b], known[j, b], F, off, bg_lin)
                _propagate(F, P, FP, h, gyro_var[j], acc_var[j], gyro_walk[j, b], acc_walk[j, b])
        if keep:
            R_pred[k, b] = R
            x_pred[k, b] = x
            P_pred[k, b] = P
        if has_frame[k, b]:
            since = since_mid[k, b]
            ahead = (x[18] - tau_lin) + since * (x[19] - skew_lin)
            for i in range(3):
                w[i] = omega[k, b, i] - x[9 + i]
            _observe_pose(R, x, w, camera_omega[k, b], arm, since, ahead, R_seen[k, b], p_seen[k, b], H, y)
            far, log_det, enlarged = _correct(H, cov_seen[k, b], y, 6, CHI2_6_95, R, x, P)
            nis[k, b], inflation[k, b] = far, enlarged
            log_likelihood -= 0.5 * (log_det + min(far, _NIS_CAP))
        for m in range(leds.first[k, b], leds.first[k + 1, b]):
            if not leds.use[m]:
                continue
            observe_led(leds, m, R, x, arm, bg_lin, off_lin, tau_lin, skew_lin, H2, y2)
            far, log_det, enlarged = _correct(H2, leds.cov_px2[m], y2, 2, CHI2_2_95, R, x, P)
            leds.nis[m], leds.inflation[m] = far, enlarged
            log_likelihood -= 0.5 * (log_det + min(far, _NIS_CAP))
        if keep:
            R_kept[k, b] = R
            x_kept[k, b] = x
            P_kept[k, b] = P
    return log_likelihood


@compiled
def backward_pass(
    b: int,
    dt: Any,
    R_step: Any,
    effect: Any,
    known: Any,
    R_kept: Any,
    x_kept: Any,
    P_kept: Any,
    R_pred: Any,
    x_pred: Any,
    P_pred: Any,
    R_out: Any,
    x_out: Any,
    P_out: Any,
) -> None:
    """Run the smoother of Rauch, Tung and Striebel over what `forward_pass` kept of run ``b``.

    G = P F^T P_pred^-1 by Cholesky of the predicted correlations: the units differ by 1e10. The outputs may
    not be the arrays that were kept.
    """
    last = R_kept.shape[0] - 1
    F, L, B, D = np.zeros((M, N)), np.empty((N, N)), np.empty((N, N)), np.empty((N, N))
    GD, scale, d, turn = np.empty((N, N)), np.empty(N), np.empty(N), np.empty(3)
    R_out[last, b] = R_kept[last, b]
    x_out[last, b] = x_kept[last, b]
    P_out[last, b] = P_kept[last, b]
    for k in range(last - 1, -1, -1):
        if not dt[k, b] > 0.0:
            R_out[k, b] = R_out[k + 1, b]
            x_out[k, b] = x_out[k + 1, b]
            P_out[k, b] = P_out[k + 1, b]
            continue
        P = P_kept[k, b]
        _transition(R_kept[k, b], dt[k, b], R_step[k, b], effect[k, b], known[k, b], F)
        _times(F, P, B)
        for i in range(M, N):
            B[i] = P[i]
        pred = P_pred[k + 1, b]
        for i in range(N):
            scale[i] = 1.0 / np.sqrt(pred[i, i])
        for i in range(N):
            for j in range(i + 1):
                s = pred[i, j] * scale[i] * scale[j]
                for m in range(j):
                    s -= L[i, m] * L[j, m]
                L[i, j] = np.sqrt(max(s, _LEAST_PIVOT)) if i == j else s / L[j, j]
            for j in range(N):
                B[i, j] *= scale[i]
        for i in range(N):  # B = G^T: first L^-1, then L^-T
            for m in range(i):
                f = L[i, m]
                for j in range(N):
                    B[i, j] -= f * B[m, j]
            f = 1.0 / L[i, i]
            for j in range(N):
                B[i, j] *= f
        for i in range(N - 1, -1, -1):
            for m in range(i + 1, N):
                f = L[m, i]
                for j in range(N):
                    B[i, j] -= f * B[m, j]
            f = 1.0 / L[i, i]
            for j in range(N):
                B[i, j] *= f
        for i in range(N):
            for j in range(N):
                B[i, j] *= scale[i]
                D[i, j] = P_out[k + 1, b, i, j] - pred[i, j]
            d[i] = x_out[k + 1, b, i] - x_pred[k + 1, b, i]
        write_rotation_vector(R_pred[k + 1, b], R_out[k + 1, b], turn)
        for i in range(3):
            d[i] = turn[i]
        after = P_out[k, b]
        for i in range(N):
            row = GD[i]
            row[:] = 0.0
            for m in range(N):
                g = B[m, i]
                for j in range(N):
                    row[j] += g * D[m, j]
        # P + (G D) G^T, its lower triangle mirrored.
        for i in range(N):
            for j in range(N):
                after[i, j] = P[i, j]
            for m in range(N):
                g = GD[i, m]
                for j in range(i + 1):
                    after[i, j] += g * B[m, j]
        for i in range(N):
            for j in range(i):
                after[j, i] = after[i, j]
        for i in range(N):
            s = 0.0
            for m in range(N):
                s += B[m, i] * d[m]
            if i < 3:
                turn[i] = s
                x_out[k, b, i] = 0.0
            else:
                x_out[k, b, i] = x_kept[k, b, i] + s
        for i in range(3):
            for j in range(3):
                R_out[k, b, i, j] = R_kept[k, b, i, j]
        turn_by(R_out[k, b], turn)
