"""Error-state Kalman filter on the manifold with a fixed-interval smoother, for a batch of runs at once.

The equations are DESIGN 8.2's. SI units inside. Error state, 22 components: attitude (body axes), position
and velocity of the IMU point (camera axes), gyro and accelerometer bias, gravity (camera axes), time offset,
clock skew, accelerometer-minus-gyro lag, and what the accelerometer's low-pass takes from its second
derivative. Arrays put time first and the runs of the batch second; a run shorter than the others is padded
with empty steps. The loops over time are compiled (`smoother_kernel`).
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix, skew
from bricktrack_host.fusion.smoother_kernel import LedArrays, backward_pass, forward_pass

N_STATES = 22
ATT, POS, VEL, BG, BA, GRAV = (slice(3 * i, 3 * i + 3) for i in range(6))
TAU, SKEW, LAG, LOSS = 18, 19, 20, 21


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
    known : ndarray, shape (K - 1, B, 4, 3)
        What a moving camera adds, in still axes, see `moving_camera.CameraMotion.increments`; else zero.
    gyro_var, acc_var : ndarray, shape (K - 1, B), rad^2/s and m^2/s^3
        Spectral densities of the inertial noise.
    gyro_bias_walk, acc_bias_walk : ndarray, shape (K - 1, B), rad^2/s^3 and m^2/s^5
    omega_radps : ndarray, shape (K, B, 3)
        Measured angular rate at the nodes.
    camera_omega_radps : ndarray, shape (K, B, 3)
        Angular rate of a moving camera in still axes; else zero.
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
    leds : LedArrays or None
        LEDs as seen, one by one: of the tightly coupled smoother, which has no frames.
    """

    dt_s: FloatArray
    R_step: FloatArray
    R_half: FloatArray
    dv_mps: FloatArray
    dp_m: FloatArray
    f_rate_mps3: FloatArray
    f_curve_mps4: FloatArray
    known: FloatArray
    gyro_var: FloatArray
    acc_var: FloatArray
    gyro_bias_walk: FloatArray
    acc_bias_walk: FloatArray
    omega_radps: FloatArray
    camera_omega_radps: FloatArray
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
    leds: LedArrays | None = None


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


def observe(
    state: State,
    omega_radps: FloatArray,
    lever_arm_m: FloatArray,
    since_mid_s: FloatArray,
    dt_s: FloatArray,
    *,
    camera_omega_radps: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return what a frame shows: attitude and origin of the brick, and the Jacobian of their errors.

    Parameters
    ----------
    state : State, leading shape (...)
        At the node; the frame lies ``dt_s`` later by the present estimate of offset and skew.
    omega_radps : ndarray, shape (..., 3)
        Angular rate less bias.
    camera_omega_radps : ndarray, shape (..., 3), optional
        Of a camera that moves, in still axes: what it sees moves by the difference.

    Returns
    -------
    R, p_m, H : ndarray, shape (..., 3, 3), (..., 3), (..., 6, 22)
    """
    arm = _matvec(state.R, np.broadcast_to(lever_arm_m, omega_radps.shape))
    p_m = state.x[..., POS] - arm
    turn = omega_radps
    v_origin = state.x[..., VEL] - _matvec(state.R, np.cross(omega_radps, lever_arm_m))
    if camera_omega_radps is not None:
        turn = turn - _matvec(np.swapaxes(state.R, -1, -2), camera_omega_radps)
        v_origin = v_origin - np.cross(camera_omega_radps, p_m)
    H = np.zeros((*omega_radps.shape[:-1], 6, N_STATES))
    eye = np.eye(3)
    H[..., :3, ATT] = eye
    H[..., :3, TAU] = turn
    H[..., :3, SKEW] = turn * since_mid_s[..., None]
    H[..., 3:, ATT] = state.R @ skew(np.broadcast_to(lever_arm_m, omega_radps.shape))
    H[..., 3:, POS] = eye
    H[..., 3:, TAU] = v_origin
    H[..., 3:, SKEW] = v_origin * since_mid_s[..., None]
    R = state.R @ matrix_from_rvec(turn * dt_s[..., None])
    return R, np.asarray(p_m + v_origin * dt_s[..., None]), H


def residuals(problem: Problem, state: State, at: IntArray, b: int) -> tuple[FloatArray, FloatArray]:
    """Return optical residuals, shape (n, 6), and Jacobians, shape (n, 6, 22), at nodes of one run."""
    R_at, x = state.R[at, b], state.x[at, b]
    since_mid = problem.since_mid_s[at, b]
    dt = (x[:, TAU] - problem.tau_lin[b]) + since_mid * (x[:, SKEW] - problem.skew_lin[b])
    omega = problem.omega_radps[at, b] - x[:, BG]
    camera = problem.camera_omega_radps[at, b]
    R, p, H = observe(State(R_at, x), omega, problem.lever_arm_m[b], since_mid, dt, camera_omega_radps=camera)
    turn = rvec_from_matrix(np.swapaxes(R, -1, -2) @ problem.R_seen[at, b])
    return np.concatenate([turn, problem.p_seen_m[at, b] - p], axis=-1), H


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


_Kept = tuple[
    bool,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
    FloatArray,
]


class Filter:
    """The forward pass over a batch, kept whole, so that the smoother can run back over it.

    Attributes
    ----------
    nis : ndarray, shape (K, B)
        Innovation squared over its covariance, NaN where no frame.
    inflation : ndarray, shape (K, B)
        By how much the covariance of a surprising frame was enlarged.
    log_likelihood : ndarray, shape (B,)
        Of the frames given the past; what one frame can take away is bounded.
    """

    def __init__(self, problem: Problem) -> None:
        n_nodes, n_runs = problem.has_frame.shape
        self._problem = problem
        self._effect = _sensitivities(problem)
        self.R = np.empty((n_nodes, n_runs, 3, 3))
        self.x = np.empty((n_nodes, n_runs, N_STATES))
        self.P = np.empty((n_nodes, n_runs, N_STATES, N_STATES))
        self._predicted = (np.empty_like(self.R), np.empty_like(self.x), np.empty_like(self.P))
        self.nis = np.full((n_nodes, n_runs), np.nan)
        self.inflation = np.ones((n_nodes, n_runs))
        self.log_likelihood = np.zeros(n_runs)
        kept = (True, self.R, self.x, self.P, *self._predicted, self.nis, self.inflation)
        for b in range(n_runs):
            self.log_likelihood[b], _ = _forward(
                problem, b, self._effect, problem.gyro_var[:, b], problem.acc_var[:, b], kept
            )

    def mean_nis(self, b: int) -> float:
        """Return the mean of `nis` of one run: 6 of frames, 2 of LEDs, when all is as believed."""
        leds = self._problem.leds
        nis = self.nis[:, b] if leds is None else leds.nis[leds.use]
        return float(np.nanmean(nis)) if np.isfinite(nis).any() else float("nan")

    def forward(self) -> Estimate:
        """Return the filtered states: each knows only the past."""
        return Estimate(State(self.R, self.x), self.P, self.nis)

    def smooth(self) -> Estimate:
        """Return the states given all frames (Rauch, Tung and Striebel)."""
        R, x, P = np.empty_like(self.R), np.empty_like(self.x), np.empty_like(self.P)
        pr = self._problem
        for b in range(len(self.log_likelihood)):
            backward_pass(
                b,
                pr.dt_s,
                pr.R_step,
                self._effect,
                pr.known,
                self.R,
                self.x,
                self.P,
                *self._predicted,
                R,
                x,
                P,
            )
        return Estimate(State(R, x), P, self.nis)


def score_noise(problem: Problem, gyro_var: FloatArray, acc_var: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how likely the frames are under choices of inertial noise, and the filter's last states.

    Parameters
    ----------
    gyro_var, acc_var : ndarray, shape (B, n_choices, K - 1), rad^2/s and m^2/s^3

    Returns
    -------
    log_likelihood : ndarray, shape (B, n_choices)
    last : ndarray, shape (B, n_choices, 22)
        Of what stands still, all that the run tells.
    """
    n_runs, n_choices = gyro_var.shape[:2]
    effect = _sensitivities(problem)
    log_likelihood = np.zeros((n_runs, n_choices))
    last = np.zeros((n_runs, n_choices, N_STATES))
    for b in range(n_runs):
        for i in range(n_choices):
            log_likelihood[b, i], last[b, i] = _forward(
                problem, b, effect, gyro_var[b, i], acc_var[b, i], _nothing_kept(problem)
            )
    return log_likelihood, last


def _no_leds(shape: tuple[int, ...]) -> LedArrays:
    none, none3 = np.empty(0), np.empty((0, 3))
    none33 = np.empty((0, 3, 3))
    return LedArrays(
        first=np.zeros((shape[0] + 1, shape[1]), dtype=np.int64),
        use=np.zeros(0, dtype=np.bool_),
        dt_s=none, since_mid_s=none, R_step=none33, dv_mps=none3, dp_m=none3, omega_radps=none3,
        R_lin=none33, t_lin_m=none3, residual_px=np.empty((0, 2)), J=np.empty((0, 2, 6)),
        cov_px2=np.empty((0, 2, 2)), nis=none, inflation=none,
    )  # fmt: skip


def _nothing_kept(problem: Problem) -> _Kept:
    none3, none2 = np.empty((0, 0, 3, 3)), np.empty((0, 0, N_STATES))
    none4 = np.empty((0, 0, N_STATES, N_STATES))
    scratch = np.empty(problem.has_frame.shape), np.empty(problem.has_frame.shape)
    return (False, none3, none2, none4, none3, none2, none4, *scratch)


def _forward(
    problem: Problem,
    b: int,
    effect: FloatArray,
    gyro_var: FloatArray,
    acc_var: FloatArray,
    kept: _Kept,
) -> tuple[float, FloatArray]:
    """Run the filter over one run of a batch; return the log-likelihood and the last state."""
    pr = problem
    x = pr.start.x[b].copy()
    log_likelihood = forward_pass(
        b, pr.dt_s, pr.R_step, pr.dv_mps, pr.dp_m, effect, pr.known,
        np.ascontiguousarray(gyro_var), np.ascontiguousarray(acc_var),
        pr.gyro_bias_walk, pr.acc_bias_walk, pr.omega_radps, pr.camera_omega_radps,
        pr.has_frame, pr.R_seen, pr.p_seen_m, pr.cov_seen, pr.since_mid_s,
        pr.lever_arm_m[b], pr.bg_lin[b], np.append(pr.ba_lin[b], [pr.lag_lin[b], pr.loss_lin[b]]),
        pr.tau_lin[b], pr.skew_lin[b],
        pr.start.R[b].copy(), x, pr.P_start[b].copy(), *kept,
        pr.leds or _no_leds(pr.has_frame.shape),
    )  # fmt: skip
    return float(log_likelihood), x
