"""The smoother's steps forwards in time, compiled, and the pass over a run.

The equations are DESIGN 8.2's, the layout of the 22 states is `smoother`'s. The transition is the identity
but for the nine moving states, and of their rows a third is not zero: only that is multiplied out. The loops
hold no lock of the interpreter: runs, and choices of noise, can share the cores by threads.
"""

from typing import Any, NamedTuple

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.compiled import compiled
from bricktrack_host.fusion.observation_kernel import LedArrays, N, observe_led, observe_pose
from bricktrack_host.fusion.rotation_kernel import orthonormalise, turn_by

M = 9  # attitude, position, velocity
CHUNK = 64  # nodes between the states that are kept on the way forwards
_NIS_CAP = 100.0  # so that an outlier does not choose the noise
CHI2_6_95 = 12.59  # 95 % point of chi-square with 6 degrees of freedom
CHI2_2_95 = 5.99
N_COLUMNS = np.array([4, 4, 4, 11, 11, 11, 10, 10, 10])
COLUMNS = np.array(
    [[0, 1, 2, 9 + i] + [0] * 7 for i in range(3)]
    + [[0, 1, 2, 3 + i, 6 + i, 12, 13, 14, 15 + i, 20, 21] for i in range(3)]
    + [[0, 1, 2, 6 + i, 12, 13, 14, 15 + i, 20, 21, 0] for i in range(3)]
)
"""Which columns of each moving row of the transition are not zero, and how many."""


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


class Kept(NamedTuple):
    """What a stretch of the way forwards leaves for the way back; arrays of length 0 where nothing is kept.

    Attributes
    ----------
    R, x, P : ndarray, shape (n, 3, 3), (n, 22), (n, 22, 22)
        States after the measurements of each node.
    first : ndarray of int64, shape (n + 1,)
        Measurements of node i of the stretch are ``first[i]`` to ``first[i + 1]``, in the order taken.
    n_rows : ndarray of int64, shape (m,)
    H, HP, y : ndarray, shape (m, 6, 22), (m, 6, 22), (m, 6)
        Of each measurement, whitened by its innovation: L^-1 H, L^-1 H P, L^-1 y.
    """

    R: FloatArray
    x: FloatArray
    P: FloatArray
    first: IntArray
    n_rows: IntArray
    H: FloatArray
    HP: FloatArray
    y: FloatArray


@compiled
def room_for(n_nodes: int, n_measurements: int) -> Kept:
    """Return what a stretch of so many nodes leaves; at least one measurement, to work in."""
    m = max(n_measurements, 1)
    return Kept(
        np.empty((n_nodes, 3, 3)),
        np.empty((n_nodes, N)),
        np.empty((n_nodes, N, N)),
        np.zeros(n_nodes + 1, dtype=np.int64),
        np.zeros(m, dtype=np.int64),
        np.empty((m, 6, N)),
        np.empty((m, 6, N)),
        np.empty((m, 6)),
    )


@compiled
def transition(run: RunArrays, k: int, R: Any, F: Any) -> None:
    """Write the moving rows of the transition from node ``k`` to the next, shape (9, 22), for attitude R.

    Biases, lag and loss act through the increments: what they add is turned as the middle of the step is.
    """
    dt = run.dt_s[k]
    dv, dp, rate, curve = run.dv_mps[k], run.dp_m[k], run.f_rate_mps3[k], run.f_curve_mps4[k]
    step, half, known = run.R_step[k], run.R_half[k], run.known[k]
    F[:] = 0.0
    for i in range(3):
        for j in range(3):
            F[i, j] = step[j, i]
        F[i, 9 + i] = -dt
        r0, r1, r2 = R[i, 0], R[i, 1], R[i, 2]
        F[6 + i, 0] = r2 * dv[1] - r1 * dv[2]  # -R [dv]x
        F[6 + i, 1] = r0 * dv[2] - r2 * dv[0]
        F[6 + i, 2] = r1 * dv[0] - r0 * dv[1]
        F[3 + i, 0] = r2 * dp[1] - r1 * dp[2]
        F[3 + i, 1] = r0 * dp[2] - r2 * dp[0]
        F[3 + i, 2] = r1 * dp[0] - r0 * dp[1]
        lag, loss = 0.0, 0.0
        for j in range(3):
            turned = r0 * half[0, j] + r1 * half[1, j] + r2 * half[2, j]
            F[6 + i, 12 + j] = -turned * dt
            F[3 + i, 12 + j] = -0.5 * turned * dt * dt
            lag += turned * rate[j]
            loss -= turned * curve[j]
        lag, loss = lag + known[2, i], loss + known[3, i]
        F[6 + i, 20], F[6 + i, 21] = lag * dt, loss * dt
        F[3 + i, 20], F[3 + i, 21] = 0.5 * lag * dt * dt, 0.5 * loss * dt * dt
        F[3 + i, 3 + i] = 1.0
        F[3 + i, 6 + i] = dt
        F[3 + i, 15 + i] = 0.5 * dt * dt
        F[6 + i, 6 + i] = 1.0
        F[6 + i, 15 + i] = dt


@compiled
def _propagate(F: Any, P: Any, FP: Any, dt: float, gyro: float, acc: float, bg: float, ba: float) -> None:
    """Replace P by F P F^T + Q."""
    for i in range(M):
        row = FP[i]
        row[:] = 0.0
        for c in range(N_COLUMNS[i]):
            f, source = F[i, COLUMNS[i, c]], P[COLUMNS[i, c]]
            for j in range(N):
                row[j] += f * source[j]
    for i in range(M):
        for j in range(M, N):
            P[i, j] = FP[i, j]
            P[j, i] = FP[i, j]
        for j in range(i + 1):
            s = 0.0
            for c in range(N_COLUMNS[j]):
                s += FP[i, COLUMNS[j, c]] * F[j, COLUMNS[j, c]]
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
def _move(run: RunArrays, k: int, R: Any, x: Any, F: Any, off: Any) -> None:
    """Carry the state over one step; ``off`` is how far biases, lag and loss are from their linearisation."""
    dt, step, known = run.dt_s[k], run.R_step[k], run.known[k]
    dv, dp = run.dv_mps[k], run.dp_m[k]
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
        turn[i] = -dt * (x[9 + i] - run.bg_lin[i])
    row = np.empty(3)
    for i in range(3):
        for j in range(3):
            row[j] = R[i, 0] * step[0, j] + R[i, 1] * step[1, j] + R[i, 2] * step[2, j]
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
def _whiten(L: Any, A: Any, n: int) -> None:
    """Replace the rows of A, shape (n, 22), by those of L^-1 A."""
    for i in range(n):
        for m in range(i):
            for j in range(N):
                A[i, j] -= L[i, m] * A[m, j]
        for j in range(N):
            A[i, j] /= L[i, i]


@compiled
def _correct(
    H: Any, C: Any, y: Any, n: int, chi2_95: float, R: Any, x: Any, P: Any, kept: Kept, m: int
) -> Any:
    """Take in ``n`` residuals y with Jacobian H and covariance C, in place; leave them whitened as number m.

    Returns the innovation squared over its covariance, its log-determinant, and by how much C was enlarged: a
    surprise is believed less, in proportion, never refused, so that the filter finds back after it has gone
    wrong itself.
    """
    HP, white = kept.HP[m], kept.y[m]
    for i in range(n):
        HP[i] = 0.0
        for r in range(N):
            h = H[i, r]
            if h != 0.0:
                for j in range(N):
                    HP[i, j] += h * P[r, j]
    predicted, S = np.empty((n, n)), np.empty((n, n))
    for i in range(n):
        for j in range(i + 1):
            s = 0.0
            for r in range(N):
                s += HP[i, r] * H[j, r]
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
    _whiten(S, HP, n)
    dx = np.zeros(N)
    for i in range(n):
        for j in range(N):
            dx[j] += HP[i, j] * white[i]
        for r in range(N):
            w = HP[i, r]
            for j in range(N):
                P[r, j] -= w * HP[i, j]
    turn_by(R, dx[:3])
    for j in range(3, N):
        x[j] += dx[j]
    if len(kept.P):
        kept.H[m, :n] = H[:n]
        _whiten(S, kept.H[m], n)
        kept.n_rows[m] = n
    return nis, log_det, inflation


@compiled
def step_to(
    run: RunArrays, k: int, gyro_var: float, acc_var: float, R: Any, x: Any, P: Any, F: Any, FP: Any
) -> None:
    """Carry the state from the node before to node ``k``, in place; F and FP are room to work in."""
    j = k - 1
    transition(run, j, R, F)
    off = np.empty(5)
    for i in range(3):
        off[i] = x[12 + i] - run.off_lin[i]
    off[3], off[4] = x[20] - run.off_lin[3], x[21] - run.off_lin[4]
    _move(run, j, R, x, F, off)
    _propagate(F, P, FP, run.dt_s[j], gyro_var, acc_var, run.gyro_walk[j], run.acc_walk[j])


@compiled
def take_in(
    run: RunArrays,
    k: int,
    R: Any,
    x: Any,
    P: Any,
    H: Any,
    y: Any,
    nis: FloatArray,
    inflation: FloatArray,
    kept: Kept,
    m: int,
) -> tuple[float, int]:
    """Take in what was seen at node ``k``, in place; return its log-likelihood and how many measurements.

    They are left in ``kept`` from number ``m`` on, where it has room. H and y, shape (6, 22) and (6,), are
    room to work in.
    """
    leds, keep = run.leds, len(kept.P) > 0
    log_likelihood, n = 0.0, 0
    if run.has_frame[k]:
        since, w = run.since_mid_s[k], np.empty(3)
        ahead = (x[18] - run.tau_lin) + since * (x[19] - run.skew_lin)
        for i in range(3):
            w[i] = run.omega_radps[k, i] - x[9 + i]
        observe_pose(
            R, x, w, run.camera_omega_radps[k], run.arm_m, since, ahead, run.R_seen[k], run.p_seen_m[k], H, y
        )
        nis[k], log_det, inflation[k] = _correct(H, run.cov_seen[k], y, 6, CHI2_6_95, R, x, P, kept, m)
        log_likelihood -= 0.5 * (log_det + min(nis[k], _NIS_CAP))
        n += 1
    for i in range(leds.first[k, 0], leds.first[k + 1, 0]):
        if leds.use[i]:
            observe_led(leds, i, R, x, run.arm_m, run.bg_lin, run.off_lin, run.tau_lin, run.skew_lin, H, y)
            at = m + n if keep else m
            far, log_det, enlarged = _correct(H, leds.cov_px2[i], y, 2, CHI2_2_95, R, x, P, kept, at)
            leds.nis[i], leds.inflation[i] = far, enlarged
            log_likelihood -= 0.5 * (log_det + min(far, _NIS_CAP))
            n += 1
    return log_likelihood, n


@compiled
def forward_stretch(
    run: RunArrays,
    gyro_var: FloatArray,
    acc_var: FloatArray,
    start: int,
    stop: int,
    R: FloatArray,
    x: FloatArray,
    P: FloatArray,
    nis: FloatArray,
    inflation: FloatArray,
    kept: Kept,
) -> float:
    """Run the filter over nodes from ``start`` to before ``stop``; R, x and P come from the node before.

    They end as the state of the last node. ``gyro_var`` and ``acc_var`` have shape (K - 1,). Innovations
    squared and inflations are written for each node with a frame, shape (K,), and into the LEDs' arrays; with
    room in ``kept``, all that the way back needs is left there. Returns the log-likelihood of what was seen.
    """
    F, FP, H, y = np.zeros((M, N)), np.zeros((M, N)), np.zeros((6, N)), np.zeros(6)
    keep = len(kept.P) > 0
    log_likelihood, m = 0.0, 0
    for k in range(start, stop):
        if k > 0 and run.dt_s[k - 1] > 0.0:
            step_to(run, k, gyro_var[k - 1], acc_var[k - 1], R, x, P, F, FP)
        earned, n = take_in(run, k, R, x, P, H, y, nis, inflation, kept, m)
        log_likelihood += earned
        m += n * keep
        if keep:
            kept.R[k - start], kept.x[k - start], kept.P[k - start] = R, x, P
            kept.first[k - start + 1] = m
    return log_likelihood


@compiled
def forward_pass(
    run: RunArrays,
    gyro_var: FloatArray,
    acc_var: FloatArray,
    R: FloatArray,
    x: FloatArray,
    P: FloatArray,
    nis: FloatArray,
    inflation: FloatArray,
    R_before: FloatArray,
    x_before: FloatArray,
    P_before: FloatArray,
) -> float:
    """Run the filter over a run, from R, x and P, which end as the last state; see `forward_stretch`.

    The state before every `CHUNK` nodes is written into the last three, where they have room: from these the
    way back goes forward again, a stretch at a time, so that memory holds one stretch and not the run.
    """
    n_nodes = len(run.has_frame)
    nothing = room_for(0, 1)
    log_likelihood = 0.0
    for c in range((n_nodes + CHUNK - 1) // CHUNK):
        if len(R_before):
            R_before[c], x_before[c], P_before[c] = R, x, P
        log_likelihood += forward_stretch(
            run, gyro_var, acc_var, c * CHUNK, min((c + 1) * CHUNK, n_nodes), R, x, P, nis, inflation, nothing
        )
    return log_likelihood


@compiled
def states_before_frames(
    run: RunArrays,
    gyro_var: FloatArray,
    acc_var: FloatArray,
    R: FloatArray,
    x: FloatArray,
    P: FloatArray,
    at: IntArray,
    R_out: FloatArray,
    x_out: FloatArray,
    P_out: FloatArray,
) -> None:
    """Write the states at nodes ``at``, rising, before what was seen there was taken in."""
    n_nodes, i = len(run.has_frame), 0
    F, FP, H, y = np.zeros((M, N)), np.zeros((M, N)), np.zeros((6, N)), np.zeros(6)
    nis, inflation, nothing = np.empty(n_nodes), np.empty(n_nodes), room_for(0, 1)
    for k in range(n_nodes):
        if k > 0 and run.dt_s[k - 1] > 0.0:
            step_to(run, k, gyro_var[k - 1], acc_var[k - 1], R, x, P, F, FP)
        if i < len(at) and at[i] == k:
            R_out[i], x_out[i], P_out[i] = R, x, P
            i += 1
        take_in(run, k, R, x, P, H, y, nis, inflation, nothing, 0)
