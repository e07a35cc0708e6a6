"""Error-state Kalman filter on the manifold with a fixed-interval smoother, for a batch of runs at once.

The equations are DESIGN 8.2's. SI units inside. Error state, 22 components: attitude (body axes), position
and velocity of the IMU point (camera axes), gyro and accelerometer bias, gravity (camera axes), time offset,
clock skew, accelerometer-minus-gyro lag, and what the accelerometer's low-pass takes from its second
derivative. Arrays put time first and the runs of the batch second; a run shorter than the others is padded
with empty steps. The loops over time are compiled (`smoother_kernel`, `smoother_backward`).
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix, skew
from bricktrack_host.fusion.smoothing.covariance_kernel import SIZE
from bricktrack_host.fusion.smoothing.observation_kernel import LedArrays
from bricktrack_host.fusion.smoothing.smoother_backward import backward_pass
from bricktrack_host.fusion.smoothing.smoother_kernel import CHUNK, forward_pass, predict
from bricktrack_host.fusion.smoothing.transition_kernel import RunArrays

T = TypeVar("T", bound=np.generic)
N_STATES = 22
ATT, POS, VEL, BG, BA, GRAV = (slice(3 * i, 3 * i + 3) for i in range(6))
TAU, SKEW, LAG, LOSS = 18, 19, 20, 21
SEEN = np.array([0, 1, 2, 3, 4, 5, TAU, SKEW])
"""Attitude, position, offset and skew: all that a picture, or an instant of the output, depends on."""


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
        What a moving camera adds, in still axes, see `CameraMotion.increments`; else zero.
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
        Camera time of the node, or its frame, less that of the run's middle.
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
    """States at all nodes, with as much of their covariance as is asked for.

    Attributes
    ----------
    state : State, leading shape (K, B)
    covariance : ndarray, shape (K, B, c, c)
        Of the states `of`.
    of : ndarray of int64, shape (c,)
        By default `SEEN`: the whole would be 4 kB a node.
    variance : ndarray, shape (K, B, 22)
        Of every state; of those not in ``of``, that at one of the next 16 nodes.
    nis : ndarray, shape (K, B)
        Innovation squared over its covariance (6 degrees of freedom), NaN where no frame; only of the filter.
    led_residual_px, led_cov_px2 : ndarray, shape (m, 2), (m, 2, 2)
        Of each LED at the state of its node: seen less predicted, and H P H^T; empty where there are no LEDs.
    """

    state: State
    covariance: FloatArray
    of: IntArray
    variance: FloatArray
    nis: FloatArray
    led_residual_px: FloatArray
    led_cov_px2: FloatArray


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
    return residuals_of(problem, State(state.R[at, b], state.x[at, b]), at, b)


def residuals_of(problem: Problem, state: State, at: IntArray, b: int) -> tuple[FloatArray, FloatArray]:
    """Return the same as `residuals` for states, shape (n,), of nodes ``at`` alone."""
    x = state.x
    since_mid = problem.since_mid_s[at, b]
    dt = (x[:, TAU] - problem.tau_lin[b]) + since_mid * (x[:, SKEW] - problem.skew_lin[b])
    omega = problem.omega_radps[at, b] - x[:, BG]
    camera = problem.camera_omega_radps[at, b]
    R, p, H = observe(state, omega, problem.lever_arm_m[b], since_mid, dt, camera_omega_radps=camera)
    turn = rvec_from_matrix(np.swapaxes(R, -1, -2) @ problem.R_seen[at, b])
    return np.concatenate([turn, problem.p_seen_m[at, b] - p], axis=-1), H


class Filter:
    """The forward pass over a batch; `smooth` runs back over it.

    Only every `CHUNK`-th state is kept: the way back makes the others again as it needs them.

    Attributes
    ----------
    runs : list of RunArrays
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
        self.runs = [_arrays_of(problem, b) for b in range(n_runs)]
        n_kept = -(-n_nodes // CHUNK)
        R, x = np.empty((n_runs, n_kept, 3, 3)), np.empty((n_runs, n_kept, N_STATES))
        P = np.empty((n_runs, n_kept, SIZE))
        self._before = R, x, P
        # One run after the other in memory; seen with time first, as everything else.
        self.nis = np.full((n_runs, n_nodes), np.nan).T
        self.inflation = np.ones((n_runs, n_nodes)).T
        self.log_likelihood = np.zeros(n_runs)
        for b, run in enumerate(self.runs):
            gyro_var, acc_var = self._noise_of(b)
            self.log_likelihood[b] = forward_pass(
                run, gyro_var, acc_var, *_start_of(problem, b), self.nis.T[b], self.inflation.T[b],
                R[b], x[b], P[b],
            )  # fmt: skip

    def _noise_of(self, b: int) -> tuple[FloatArray, FloatArray]:
        pr = self._problem
        return np.ascontiguousarray(pr.gyro_var[:, b]), np.ascontiguousarray(pr.acc_var[:, b])

    def kept(self, b: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return the inertial noise of one run and the states before every `CHUNK` nodes, to go on from."""
        R, x, P = self._before
        return *self._noise_of(b), R[b], x[b], P[b]

    def mean_nis(self, b: int) -> float:
        """Return the mean of `nis` of one run: 6 of frames, 2 of LEDs, when all is as believed."""
        leds = self._problem.leds
        nis = self.nis[:, b] if leds is None else leds.nis[leds.use]
        return float(np.nanmean(nis)) if np.isfinite(nis).any() else float("nan")

    def predicted(self, b: int) -> FloatArray:
        """Return the covariance of one run's nodes before what was seen there, shape (K, 22, 22)."""
        P = np.empty((len(self.nis), N_STATES, N_STATES))
        predict(self.runs[b], *self._noise_of(b), *_start_of(self._problem, b), P)
        return P

    def forward(self, of: IntArray = SEEN) -> Estimate:
        """Return the filtered states: each knows only the past."""
        return self._estimate(of, is_smoothed=False)

    def smooth(self, of: IntArray = SEEN) -> Estimate:
        """Return the states given all frames, with the covariance of the states ``of``."""
        return self._estimate(of, is_smoothed=True)

    def _estimate(self, of: IntArray, *, is_smoothed: bool) -> Estimate:
        n_nodes, n_runs = self.nis.shape
        R, x = np.empty((n_runs, n_nodes, 3, 3)), np.empty((n_runs, n_nodes, N_STATES))
        variance = np.empty((n_runs, n_nodes, N_STATES))
        covariance = np.empty((n_runs, n_nodes, len(of), len(of)))
        n_leds = 0 if self._problem.leds is None else len(self._problem.leds.dt_s)
        led_residual_px, led_cov_px2 = np.empty((n_leds, 2)), np.empty((n_leds, 2, 2))
        R_before, x_before, P_before = self._before
        for b, run in enumerate(self.runs):
            backward_pass(
                run, *self._noise_of(b), R_before[b], x_before[b], P_before[b], of, is_smoothed,
                R[b], x[b], variance[b], covariance[b], led_residual_px, led_cov_px2,
            )  # fmt: skip
        return Estimate(
            state=State(R.swapaxes(0, 1), x.swapaxes(0, 1)),
            covariance=covariance.swapaxes(0, 1),
            of=of,
            variance=variance.swapaxes(0, 1),
            nis=self.nis,
            led_residual_px=led_residual_px,
            led_cov_px2=led_cov_px2,
        )


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
    log_likelihood = np.zeros((n_runs, n_choices))
    last = np.zeros((n_runs, n_choices, N_STATES))
    n_nodes = len(problem.has_frame)
    nis, inflation = np.empty(n_nodes), np.empty(n_nodes)
    nothing = np.empty((0, 3, 3)), np.empty((0, N_STATES)), np.empty((0, SIZE))
    for b in range(n_runs):
        run = _arrays_of(problem, b)
        for i in range(n_choices):
            R, x, P = _start_of(problem, b)
            log_likelihood[b, i] = forward_pass(
                run, gyro_var[b, i], acc_var[b, i], R, x, P, nis, inflation, *nothing
            )
            last[b, i] = x
    return log_likelihood, last


def _no_leds(n_nodes: int) -> LedArrays:
    none, none3 = np.empty(0), np.empty((0, 3))
    none33 = np.empty((0, 3, 3))
    return LedArrays(
        first=np.zeros((n_nodes + 1, 1), dtype=np.int64),
        use=np.zeros(0, dtype=np.bool_),
        dt_s=none, since_mid_s=none, R_step=none33, dv_mps=none3, dp_m=none3, omega_radps=none3,
        camera_omega_radps=none3, camera_dv_mps=none3, camera_dp_m=none3,
        R_lin=none33, t_lin_m=none3, residual_px=np.empty((0, 2)), J=np.empty((0, 2, 6)),
        cov_px2=np.empty((0, 2, 2)), nis=none, inflation=none,
    )  # fmt: skip


def _arrays_of(problem: Problem, b: int) -> RunArrays:
    """Return one run of a batch for the compiled loops."""
    pr = problem

    def own(values: NDArray[T]) -> NDArray[T]:
        return np.ascontiguousarray(values[:, b])

    return RunArrays(
        dt_s=own(pr.dt_s), R_step=own(pr.R_step), R_half=own(pr.R_half), dv_mps=own(pr.dv_mps),
        dp_m=own(pr.dp_m), f_rate_mps3=own(pr.f_rate_mps3), f_curve_mps4=own(pr.f_curve_mps4),
        known=own(pr.known), gyro_walk=own(pr.gyro_bias_walk), acc_walk=own(pr.acc_bias_walk),
        omega_radps=own(pr.omega_radps), camera_omega_radps=own(pr.camera_omega_radps),
        has_frame=own(pr.has_frame), R_seen=own(pr.R_seen), p_seen_m=own(pr.p_seen_m),
        cov_seen=own(pr.cov_seen), since_mid_s=own(pr.since_mid_s), arm_m=pr.lever_arm_m[b],
        bg_lin=pr.bg_lin[b], off_lin=np.append(pr.ba_lin[b], [pr.lag_lin[b], pr.loss_lin[b]]),
        tau_lin=float(pr.tau_lin[b]), skew_lin=float(pr.skew_lin[b]),
        leds=pr.leds or _no_leds(len(pr.has_frame)),
    )  # fmt: skip


def _start_of(problem: Problem, b: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return attitude, state and covariance to start from, which the filter then changes."""
    return problem.start.R[b].copy(), problem.start.x[b].copy(), problem.P_start[b].copy()
