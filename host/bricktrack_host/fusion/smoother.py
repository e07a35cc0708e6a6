"""Error-state Kalman filter on the manifold with a fixed-interval smoother, for a batch of runs at once.

The equations are DESIGN 8.2's. SI units inside. Error state, 22 components: attitude (body axes), position
and velocity of the IMU point (camera axes), gyro and accelerometer bias, gravity (camera axes), time offset,
clock skew, accelerometer-minus-gyro lag, and what the accelerometer's low-pass takes from its second
derivative. Arrays put time first and the runs of the batch second, so that each
step of the one loop over time works on contiguous memory; a run shorter than the others is padded with empty
steps.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix, skew

N_STATES = 22
N_MOVING = 9  # attitude, position, velocity: the others stand still or wander
ATT, POS, VEL, BG, BA, GRAV = (slice(3 * i, 3 * i + 3) for i in range(6))
TAU, SKEW, LAG, LOSS = 18, 19, 20, 21
_NIS_CAP = 100.0  # so that an outlier does not choose the noise
CHI2_6_95 = 12.59  # 95 % point of chi-square with 6 degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All that the filter needs of a batch; K nodes, B runs.

    Attributes
    ----------
    dt_s : ndarray, shape (K - 1, B)
        Zero where a run is already over.
    R_step, R_half : ndarray, shape (K - 1, B, 3, 3)
    dv_mps, dp_m, f_rate_mps3, f_curve_mps4 : ndarray, shape (K - 1, B, 3)
        Increments at the linearisation point of biases, lag and loss, see `imu_signal.Increments`.
    gyro_var, acc_var : ndarray, shape (K - 1, B), rad^2/s and m^2/s^3
        Spectral densities of the inertial noise.
    gyro_bias_walk, acc_bias_walk : ndarray, shape (K - 1, B), rad^2/s^3 and m^2/s^5
    omega_radps : ndarray, shape (K, B, 3)
        Measured angular rate at the nodes.
    has_frame : ndarray of bool, shape (K, B)
    R_seen, p_seen_m, cov_seen : ndarray, shape (K, B, 3, 3), (K, B, 3), (K, B, 6, 6)
        Optical poses of the brick's origin; covariance of [dtheta rad, dt m].
    since_mid_s : ndarray, shape (K, B)
        Camera time of the frame less that of the run's middle.
    lever_arm_m : ndarray, shape (B, 3)
    bg_lin, ba_lin : ndarray, shape (B, 3)
    tau_lin, skew_lin, lag_lin, loss_lin : ndarray, shape (B,)
        Where increments and node times were taken.
    start : State
    P_start : ndarray, shape (B, 22, 22)
    """

    dt_s: FloatArray
    R_step: FloatArray
    R_half: FloatArray
    dv_mps: FloatArray
    dp_m: FloatArray
    f_rate_mps3: FloatArray
    f_curve_mps4: FloatArray
    gyro_var: FloatArray
    acc_var: FloatArray
    gyro_bias_walk: FloatArray
    acc_bias_walk: FloatArray
    omega_radps: FloatArray
    has_frame: BoolArray
    R_seen: FloatArray
    p_seen_m: FloatArray
    cov_seen: FloatArray
    since_mid_s: FloatArray
    lever_arm_m: FloatArray
    bg_lin: FloatArray
    ba_lin: FloatArray
    tau_lin: FloatArray
    skew_lin: FloatArray
    lag_lin: FloatArray
    loss_lin: FloatArray
    start: "State"
    P_start: FloatArray

    def with_noise_choices(self, gyro_var: FloatArray, acc_var: FloatArray) -> "Problem":
        """Return a batch in which each run stands once for each choice of noise, choices running fastest.

        Parameters
        ----------
        gyro_var, acc_var : ndarray, shape (K - 1, B, n_choices)
        """
        n = gyro_var.shape[2]
        per_run = {"lever_arm_m", "bg_lin", "ba_lin", "tau_lin", "skew_lin", "lag_lin", "loss_lin", "P_start"}
        changed: dict[str, Any] = {
            f.name: np.repeat(getattr(self, f.name), n, axis=0 if f.name in per_run else 1)
            for f in fields(self)
            if f.name not in ("start", "gyro_var", "acc_var")
        }
        changed["start"] = State(np.repeat(self.start.R, n, axis=0), np.repeat(self.start.x, n, axis=0))
        changed["gyro_var"] = gyro_var.reshape(len(gyro_var), -1)
        changed["acc_var"] = acc_var.reshape(len(acc_var), -1)
        return Problem(**changed)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Attitude and the 19 additive components, for any leading shape.

    Attributes
    ----------
    R : ndarray, shape (..., 3, 3)
    x : ndarray, shape (..., 22)
        By the error state's indices; the attitude's three stay zero.
    """

    R: FloatArray
    x: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """States at all nodes with covariance.

    Attributes
    ----------
    state : State, leading shape (K, B)
    covariance : ndarray, shape (K, B, 22, 22)
    nis : ndarray, shape (K, B)
        Innovation squared over its covariance (6 degrees of freedom), NaN where no frame; only of the filter.
    """

    state: State
    covariance: FloatArray
    nis: FloatArray


def _matvec(A: FloatArray, v: FloatArray) -> FloatArray:
    return np.asarray((A @ v[..., None])[..., 0])


def _small_rvec(R: FloatArray) -> FloatArray:
    """Return rotation vectors of rotations well below 90 degrees, cheaply."""
    v = 0.5 * np.stack(
        [R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1
    )
    s2 = np.minimum((v * v).sum(axis=-1, keepdims=True), 1.0)
    return np.asarray(v * (1 + s2 / 6 + 0.075 * s2 * s2))


def _move(state: State, dx: FloatArray) -> State:
    x = state.x + dx
    x[..., ATT] = 0.0
    return State(state.R @ matrix_from_rvec(dx[..., ATT]), x)


def observe(
    state: State,
    omega_radps: FloatArray,
    lever_arm_m: FloatArray,
    since_mid_s: FloatArray,
    dt_s: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what a frame shows: attitude and origin of the brick, and the Jacobian of their errors.

    Parameters
    ----------
    state : State, leading shape (...)
        At the node; the frame lies ``dt_s`` later by the present estimate of offset and skew.
    omega_radps : ndarray, shape (..., 3)
        Angular rate less bias.

    Returns
    -------
    R, p_m, H : ndarray, shape (..., 3, 3), (..., 3), (..., 6, 22)
    """
    arm = _matvec(state.R, np.broadcast_to(lever_arm_m, omega_radps.shape))
    v_origin = state.x[..., VEL] - _matvec(state.R, np.cross(omega_radps, lever_arm_m))
    H = np.zeros((*omega_radps.shape[:-1], 6, N_STATES))
    eye = np.eye(3)
    H[..., :3, ATT] = eye
    H[..., :3, TAU] = omega_radps
    H[..., :3, SKEW] = omega_radps * since_mid_s[..., None]
    H[..., 3:, ATT] = state.R @ skew(np.broadcast_to(lever_arm_m, omega_radps.shape))
    H[..., 3:, POS] = eye
    H[..., 3:, TAU] = v_origin
    H[..., 3:, SKEW] = v_origin * since_mid_s[..., None]
    R = state.R @ matrix_from_rvec(omega_radps * dt_s[..., None])
    return R, np.asarray(state.x[..., POS] - arm + v_origin * dt_s[..., None]), H


def residuals(problem: Problem, state: State, at: IntArray, b: int) -> tuple[FloatArray, FloatArray]:
    """Return optical residuals, shape (n, 6), and Jacobians, shape (n, 6, 22), at nodes of one run."""
    R_at, x = state.R[at, b], state.x[at, b]
    since_mid = problem.since_mid_s[at, b]
    dt = (x[:, TAU] - problem.tau_lin[b]) + since_mid * (x[:, SKEW] - problem.skew_lin[b])
    omega = problem.omega_radps[at, b] - x[:, BG]
    R, p, H = observe(State(R_at, x), omega, problem.lever_arm_m[b], since_mid, dt)
    turn = rvec_from_matrix(np.swapaxes(R, -1, -2) @ problem.R_seen[at, b])
    return np.concatenate([turn, problem.p_seen_m[at, b] - p], axis=-1), H


def _process_noise(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return the noise of attitude, position and velocity (K-1, B, 9, 9), and of the biases (.., 6)."""
    dt = problem.dt_s
    Q = np.zeros((*dt.shape, N_MOVING, N_MOVING))
    i = np.arange(3)
    Q[..., i, i] = (problem.gyro_var * dt)[..., None]
    Q[..., 6 + i, 6 + i] = (problem.acc_var * dt)[..., None]
    Q[..., 3 + i, 6 + i] = Q[..., 6 + i, 3 + i] = (problem.acc_var * dt**2 / 2)[..., None]
    Q[..., 3 + i, 3 + i] = (problem.acc_var * dt**3 / 3)[..., None]
    walk = np.stack([problem.gyro_bias_walk * dt, problem.acc_bias_walk * dt], axis=-1)
    return Q, np.repeat(walk, 3, axis=-1)


def _sensitivities(problem: Problem) -> FloatArray:
    """Return, in body axes, what changes dv: attitude, accelerometer bias, lag, loss; then the same for dp.

    Shape (K - 1, B, 6, 8): rows dv, dp; columns theta (3), ba (3), lag, loss.
    """
    dt = problem.dt_s[..., None, None]
    out = np.zeros((*problem.dt_s.shape, 6, 8))
    rate = problem.R_half @ np.stack([problem.f_rate_mps3, -problem.f_curve_mps4], axis=-1)
    out[..., :3, :3] = -skew(problem.dv_mps)
    out[..., 3:, :3] = -skew(problem.dp_m)
    out[..., :3, 3:6] = -problem.R_half * dt
    out[..., 3:, 3:6] = -problem.R_half * dt**2 / 2
    out[..., :3, 6:] = rate * dt
    out[..., 3:, 6:] = rate * dt**2 / 2
    return out


class Filter:
    """The forward pass; when kept whole, the smoother can run back over it.

    Attributes
    ----------
    nis : ndarray, shape (K, B)
        Innovation squared over its covariance, NaN where no frame.
    inflation : ndarray, shape (K, B)
        By how much the covariance of a surprising frame was enlarged.
    log_likelihood : ndarray, shape (B,)
        Of the frames given the past; what one frame can take away is bounded.
    last : State, leading shape (B,)
        After the last frame: of what stands still, all that the run tells.
    """

    def __init__(self, problem: Problem, *, keep: bool = True) -> None:
        n_nodes, n_runs = problem.has_frame.shape
        self._problem = problem
        n_kept = n_nodes if keep else 0
        self.R = np.empty((n_kept, n_runs, 3, 3))
        self.x = np.empty((n_kept, n_runs, N_STATES))
        self.P = np.empty((n_kept, n_runs, N_STATES, N_STATES))
        self._R_pred = np.empty_like(self.R)
        self._x_pred = np.empty_like(self.x)
        self._P_pred = np.empty_like(self.P)
        self._F = np.zeros((max(n_kept - 1, 0), n_runs, N_MOVING, N_STATES))
        self.nis = np.full((n_nodes, n_runs), np.nan)
        self.inflation = np.ones((n_nodes, n_runs))
        self.log_likelihood = np.zeros(n_runs)
        self._run(keep)

    def _run(self, keep: bool) -> None:
        pr = self._problem
        n_nodes, n_runs = pr.has_frame.shape
        sensor_lin = np.stack([pr.lag_lin, pr.loss_lin], axis=1)
        any_frame = np.asarray(pr.has_frame.any(axis=1))
        effect, dt1 = _sensitivities(pr), pr.dt_s[..., None]
        Q, Q_walk = _process_noise(pr)
        F = np.zeros((n_runs, N_MOVING, N_STATES))  # the other rows are the identity's
        i3, walks = np.arange(3), np.arange(BG.start, BA.stop)
        F[:, np.arange(N_MOVING), np.arange(N_MOVING)] = 1.0
        R, x, P = pr.start.R.copy(), pr.start.x.copy(), pr.P_start.copy()
        for k in range(n_nodes):
            if k:
                j, dt = k - 1, dt1[k - 1]
                turned = R[:, None] @ effect[j].reshape(n_runs, 2, 3, 8)  # dv, dp in camera axes
                F[:, ATT, ATT] = np.swapaxes(pr.R_step[j], -1, -2)
                F[:, i3, 9 + i3] = -dt
                F[:, 3 + i3, 6 + i3] = F[:, 6 + i3, 15 + i3] = dt
                F[:, 3 + i3, 15 + i3] = 0.5 * dt * dt
                F[:, VEL, ATT], F[:, POS, ATT] = turned[:, 0, :, :3], turned[:, 1, :, :3]
                F[:, VEL, BA], F[:, POS, BA] = turned[:, 0, :, 3:6], turned[:, 1, :, 3:6]
                F[:, VEL, LAG:], F[:, POS, LAG:] = turned[:, 0, :, 6:], turned[:, 1, :, 6:]
                off = np.concatenate([x[:, BA] - pr.ba_lin, x[:, LAG:] - sensor_lin], axis=1)
                step = R @ np.stack([pr.dv_mps[j], pr.dp_m[j]], axis=2)
                step = np.swapaxes(step, 1, 2) + _matvec(turned[..., 3:], off[:, None])  # (B, [dv, dp], 3)
                x[:, POS] += dt * x[:, VEL] + 0.5 * dt * dt * x[:, GRAV] + step[:, 1]
                x[:, VEL] += dt * x[:, GRAV] + step[:, 0]
                R = R @ pr.R_step[j]
                R = R - R @ skew(dt * (x[:, BG] - pr.bg_lin))
                R = 1.5 * R - 0.5 * R @ (np.swapaxes(R, -1, -2) @ R)  # one Newton step back to orthonormal
                FP = F @ P
                P = P.copy()
                P[:, :N_MOVING] = FP
                P[:, :, :N_MOVING] = np.swapaxes(FP, -1, -2)
                P[:, :N_MOVING, :N_MOVING] = FP @ np.swapaxes(F, -1, -2) + Q[j]
                P[:, walks, walks] += Q_walk[j]
                if keep:
                    self._F[j] = F
            if keep:
                self._R_pred[k], self._x_pred[k], self._P_pred[k] = R, x, P
            if any_frame[k]:
                R, x, P = self._update(k, R, x, P)
            if keep:
                self.R[k], self.x[k], self.P[k] = R, x, P
        self.last = State(R, x)

    def _update(
        self, k: int, R: FloatArray, x: FloatArray, P: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        pr = self._problem
        runs = np.flatnonzero(pr.has_frame[k])
        state = State(R[runs], x[runs])
        since_mid = pr.since_mid_s[k, runs]
        dt = (state.x[:, TAU] - pr.tau_lin[runs]) + since_mid * (state.x[:, SKEW] - pr.skew_lin[runs])
        omega = pr.omega_radps[k, runs] - state.x[:, BG]
        R_hat, p_hat, H = observe(state, omega, pr.lever_arm_m[runs], since_mid, dt)
        turn = rvec_from_matrix(np.swapaxes(R_hat, -1, -2) @ pr.R_seen[k, runs])
        y = np.concatenate([turn, pr.p_seen_m[k, runs] - p_hat], axis=1)
        before = P[runs]
        PHt = before @ np.swapaxes(H, -1, -2)
        predicted = H @ PHt
        S = predicted + pr.cov_seen[k, runs]
        nis = (y * np.linalg.solve(S, y[..., None])[..., 0]).sum(axis=1)
        self.nis[k, runs] = nis
        log_det = np.linalg.slogdet(S)[1]
        self.log_likelihood[runs] -= 0.5 * (log_det + np.minimum(nis, _NIS_CAP))
        # A frame beyond what S allows is believed less, in proportion: never refused, so that the filter
        # finds back after it has gone wrong itself. The second pass judges with hindsight.
        inflation = np.maximum(nis / CHI2_6_95, 1.0)
        self.inflation[k, runs] = inflation
        S = predicted + inflation[:, None, None] * pr.cov_seen[k, runs]
        gain = np.swapaxes(np.linalg.solve(S, np.swapaxes(PHt, -1, -2)), -1, -2)
        moved = _move(state, _matvec(gain, y))
        after = before - gain @ np.swapaxes(PHt, -1, -2)
        R, x, P = R.copy(), x.copy(), P.copy()
        R[runs], x[runs] = moved.R, moved.x
        P[runs] = 0.5 * (after + np.swapaxes(after, -1, -2))
        return R, x, P

    def forward(self) -> Estimate:
        """Return the filtered states: each knows only the past."""
        return Estimate(State(self.R, self.x), self.P, self.nis)

    def smooth(self) -> Estimate:
        """Return the states given all frames (Rauch, Tung and Striebel)."""
        # G = P F^T P_pred^-1 for all steps at once, scaled to unit diagonal: the units differ by 1e10.
        scale = 1 / np.sqrt(np.diagonal(self._P_pred[1:], axis1=-2, axis2=-1))
        scaled = self._P_pred[1:] * scale[..., :, None] * scale[..., None, :]
        FP = self.P[:-1].copy()
        FP[..., :N_MOVING, :] = self._F @ self.P[:-1]
        gains = np.swapaxes(np.linalg.solve(scaled, FP * scale[..., :, None]) * scale[..., :, None], -1, -2)
        R, x, P = self.R.copy(), self.x.copy(), self.P.copy()
        for k in range(len(R) - 2, -1, -1):
            d = x[k + 1] - self._x_pred[k + 1]
            d[:, ATT] = _small_rvec(np.swapaxes(self._R_pred[k + 1], -1, -2) @ R[k + 1])
            moved = _move(State(self.R[k], self.x[k]), _matvec(gains[k], d))
            R[k], x[k] = moved.R, moved.x
            Pk = self.P[k] + gains[k] @ (P[k + 1] - self._P_pred[k + 1]) @ np.swapaxes(gains[k], -1, -2)
            P[k] = 0.5 * (Pk + np.swapaxes(Pk, -1, -2))
        return Estimate(State(R, x), P, self.nis)
