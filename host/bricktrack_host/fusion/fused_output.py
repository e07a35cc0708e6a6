"""The smoothed motion at any instants between the filter's nodes: pose, twist, covariance, flags."""

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.fusion.fusion_problem import Nodes, Run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.imu_signal import ImuSignal, seconds_since
from bricktrack_host.fusion.smoother import (
    BA,
    BG,
    GRAV,
    LAG,
    POS,
    SKEW,
    TAU,
    VEL,
    Estimate,
    Problem,
    State,
    observe,
)
from bricktrack_host.quality import PoseFlag
from bricktrack_host.tracks import FusedTrack

# The velocity comes from poses at the same stamps: its own share that is unsure, in any direction.
_UNSURE_VELOCITY = 0.3


def sample_motion(
    run: Run,
    nodes: Nodes,
    problem: Problem,
    estimate: Estimate,
    b: int,
    *,
    output_t_ns: IntArray,
    seen_cam_s: FloatArray,
    common: FloatArray,
    settings: FusionSettings,
    is_smoothed: bool,
) -> FusedTrack:
    """Return the motion of run ``b`` of a batch at instants of camera time.

    ``seen_cam_s``: when the camera saw something that was used, rising. ``common``: covariance, shape (6, 6),
    of what all that it saw has in common, see `common_part`.

    From the node before, the inertial samples carry the state to the instant, so what happened between nodes
    is kept. Where that path misses the node after (it does where the samples are not believed), the miss is
    spread as white noise would: attitude linearly, velocity and position along the cubic between both ends.
    A filter's state (``is_smoothed`` false) knows nothing of the node after and is only carried on.
    """
    n = len(nodes.t_s)
    t_cam = seconds_since(output_t_ns, run.signal.epoch_ns)
    x0 = estimate.state.x[0, b]
    tau, rate = float(x0[TAU]), float(x0[SKEW])
    t = t_cam + tau + rate * (t_cam - run.t_mid_s)
    slack = 1e-6
    outside = (t < nodes.t_s[0] - slack) | (t > nodes.t_s[-1] + slack)
    t = np.clip(t, nodes.t_s[0], nodes.t_s[-1])
    k = np.clip(np.searchsorted(nodes.t_s, t, side="right") - 1, 0, n - 2)
    x, R = estimate.state.x[k, b], estimate.state.R[k, b]
    lag_s = float(x0[LAG])
    dt = t - nodes.t_s[k]
    part = run.signal.increments(
        nodes.t_s[k], t, gyro_bias_radps=x[:, BG], acc_bias_mps2=x[:, BA], acc_lag_s=lag_s
    )
    h = dt[:, None]
    R_t = R @ part.R
    part_v, part_p = _camera_part(run, nodes.t_s[k], t, lag_s)
    v = x[:, VEL] + h * x[:, GRAV] + np.einsum("nij,nj->ni", R, part.dv_mps) + part_v
    p = x[:, POS] + h * x[:, VEL] + 0.5 * h**2 * x[:, GRAV] + np.einsum("nij,nj->ni", R, part.dp_m) + part_p
    cov = estimate.covariance[k, b]
    if is_smoothed:
        span = nodes.t_s[k + 1] - nodes.t_s[k]
        whole = run.signal.increments(
            nodes.t_s[k],
            nodes.t_s[k + 1],
            gyro_bias_radps=x[:, BG],
            acc_bias_mps2=x[:, BA],
            acc_lag_s=lag_s,
        )
        s, a = span[:, None], (dt / span)[:, None]
        after_x, after_R = estimate.state.x[k + 1, b], estimate.state.R[k + 1, b]
        miss_turn = rvec_from_matrix(np.swapaxes(R @ whole.R, 1, 2) @ after_R)
        whole_v, whole_p = _camera_part(run, nodes.t_s[k], nodes.t_s[k + 1], lag_s)
        miss_v = (
            after_x[:, VEL]
            - (x[:, VEL] + s * x[:, GRAV] + np.einsum("nij,nj->ni", R, whole.dv_mps))
            - whole_v
        )
        miss_p = after_x[:, POS] - (
            x[:, POS]
            + s * x[:, VEL]
            + 0.5 * s**2 * x[:, GRAV]
            + np.einsum("nij,nj->ni", R, whole.dp_m)
            + whole_p
        )
        R_t = R_t @ matrix_from_rvec(a * miss_turn)
        p = p + (3 * a**2 - 2 * a**3) * miss_p + s * (a**3 - a**2) * miss_v
        v = v + 6 * (a - a**2) / s * miss_p + (3 * a**2 - 2 * a) * miss_v
        cov = (1 - a[..., None]) * cov + a[..., None] * estimate.covariance[k + 1, b]
    omega = run.signal.gyro_at(t) - x[:, BG]
    state = State(R_t, np.concatenate([x[:, :3], p, v, x[:, 9:]], axis=1))
    zero = np.zeros(len(t))
    R_out, p_out, H = observe(state, omega, run.lever_arm_m, t_cam - run.t_mid_s, zero)
    H = H[..., estimate.of]
    P = H @ cov @ np.swapaxes(H, 1, 2)
    _add_bridge(P, problem, k, b, dt, nodes, is_smoothed=is_smoothed)
    P = P + common
    v_out = v - np.einsum("nij,nj->ni", R_t, np.cross(omega, run.lever_arm_m))

    P = 0.5 * (P + np.swapaxes(P, 1, 2))
    P[:, 3:] *= 1e3
    P[:, :, 3:] *= 1e3
    flags = _flags(run, t_cam, t, seen_cam_s, settings)
    flags[outside] |= int(PoseFlag.EXTRAPOLATED)
    variance = np.diagonal(P, axis1=1, axis2=2)
    unsure = (variance[:, 3:].max(axis=1) > settings.max_position_sd_mm**2) | (
        variance[:, :3].max(axis=1) > settings.max_rotation_sd_rad**2
    )
    # What rounding has made less than nothing says nothing.
    lost = outside | unsure | ~(variance > 0).all(axis=1)
    flags[lost] |= int(PoseFlag.NO_POSE)
    t_mm, v_mmps = 1e3 * p_out, 1e3 * v_out
    R_out, omega = R_out.copy(), omega.copy()
    for values in (R_out, t_mm, omega, v_mmps, P):
        values[lost] = np.nan
    track = FusedTrack(
        t_ns=output_t_ns,
        R_camera_brick=R_out,
        t_camera_brick_mm=t_mm,
        omega_brick_radps=omega,
        v_camera_mmps=v_mmps,
        covariance=P,
        flags=flags,
    )
    return track if run.camera is None else run.camera.to_camera(track, t)


def _camera_part(
    run: Run, start_s: FloatArray, end_s: FloatArray, lag_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return what a moving camera adds to velocity and displacement between instants, shape (n, 3) each."""
    if run.camera is None:
        return np.zeros((len(start_s), 3)), np.zeros((len(start_s), 3))
    felt = run.camera.increments(start_s, end_s, acc_lag_s=lag_s)
    return felt[:, 0], felt[:, 1]


def common_part(cov_seen: FloatArray, scale: FloatArray, share: float) -> FloatArray:
    """Return the covariance of errors that the frames have in common; the median frame stands for all.

    At least the share that is stated; more where the frames agree with each other better than their
    covariance allows, for then it holds what they share.

    Parameters
    ----------
    cov_seen : ndarray, shape (n_frames, 6, 6)
        As stated.
    scale : ndarray, shape (2,)
        Of the stated sd of rotation and position.
    share : float
        Of the stated sd that is in common in any case.
    """
    share_at = np.repeat(np.sqrt(np.maximum((share * scale) ** 2, 1.0 - scale**2)), 3)
    return np.asarray(share_at[:, None] * np.median(cov_seen, axis=0) * share_at)


def unsure_times(
    t_ns: IntArray, frames_ns: IntArray, time_sd_ns: FloatArray, motion: FusedTrack
) -> tuple[FloatArray, IntArray]:
    """Return what instants that are unsure add to the covariance of poses, and their flags.

    Parameters
    ----------
    t_ns : ndarray of int64, shape (n,), camera time
        Of the poses.
    frames_ns, time_sd_ns : ndarray, shape (n_frames,), ns
        How unsure the frames' instants are; between them linear.
    motion : FusedTrack
        What tells the velocities.

    Returns
    -------
    covariance : ndarray, shape (n, 6, 6), of ``[dtheta rad, dt mm]``
        The motion in one sd, earlier and later. NaN where no velocity is known at all.
    flags : ndarray of int64, shape (n,)
    """
    sd_s = np.interp(t_ns, frames_ns, time_sd_ns) * 1e-9
    flags = np.where(sd_s > 0, int(PoseFlag.UNSURE_TIME), 0)
    twist = np.concatenate([motion.omega_brick_radps, motion.v_camera_mmps], axis=1)
    known = np.isfinite(twist).all(axis=1)
    covariance = np.zeros((len(t_ns), 6, 6))
    if not known.any():
        covariance[sd_s > 0] = np.nan
        return covariance, flags
    at_s = seconds_since(motion.t_ns[known], int(frames_ns[0]))
    t_s = seconds_since(t_ns, int(frames_ns[0]))

    def twist_at(instants_s: FloatArray) -> FloatArray:
        return np.stack([np.interp(instants_s, at_s, column) for column in twist[known].T], axis=1)

    now = twist_at(t_s)
    for side in (-1.0, 1.0):
        # The mean of the velocities at both ends: where the motion turns round, it still went somewhere.
        moved = 0.5 * (now + twist_at(t_s + side * sd_s)) * sd_s[:, None]
        covariance += 0.5 * moved[:, :, None] * moved[:, None, :]
        for part in (slice(0, 3), slice(3, 6)):
            aside = np.einsum("ni,ni->n", moved[:, part], moved[:, part])[:, None, None] * np.eye(3)
            covariance[:, part, part] += 0.5 * _UNSURE_VELOCITY**2 * aside
    return covariance, flags


def _add_bridge(
    P: FloatArray, problem: Problem, k: IntArray, b: int, dt: FloatArray, nodes: Nodes, *, is_smoothed: bool
) -> None:
    """Add what inertial noise makes unsure between two known nodes (or after one), in place."""
    span = nodes.t_s[k + 1] - nodes.t_s[k]
    a = dt / span
    q_turn, q_acc = problem.gyro_var[k, b], problem.acc_var[k, b]
    turn = q_turn * dt * ((1 - a) if is_smoothed else 1.0)
    shift = q_acc * dt**3 / 3 * ((1 - a) ** 3 if is_smoothed else 1.0)
    i = np.arange(3)
    P[:, i, i] += turn[:, None]
    P[:, 3 + i, 3 + i] += shift[:, None]


def _near_sample(signal: ImuSignal, t_s: FloatArray, marked: BoolArray) -> BoolArray:
    """Return which instants have a marked sample on either side."""
    i = np.clip(np.searchsorted(signal.t_s, t_s), 1, len(signal.t_s) - 1)
    return np.asarray(marked[i] | marked[i - 1])


def _flags(
    run: Run,
    t_cam: FloatArray,
    t_imu: FloatArray,
    frames: FloatArray,
    settings: FusionSettings,
) -> IntArray:
    signal = run.signal
    i = np.clip(np.searchsorted(frames, t_cam), 1, max(len(frames) - 1, 1))
    other = np.minimum(i, len(frames) - 1)
    period = float(np.median(np.diff(frames))) if len(frames) > 1 else np.inf
    away = np.minimum(np.abs(t_cam - frames[other]), np.abs(t_cam - frames[i - 1]))
    slack = 1e-6
    marks = {
        PoseFlag.DROPOUT: away > 1.5 * period,
        PoseFlag.EXTRAPOLATED: (t_cam < frames[0] - slack) | (t_cam > frames[-1] + slack),
        PoseFlag.IMPACT: _near_sample(signal, t_imu, signal.acc_impact_mps2 > settings.impact_mps2),
        PoseFlag.CLIPPED: _near_sample(signal, t_imu, signal.clip_sd_mps2 > 0),
        PoseFlag.IMU_GAP: signal.in_gap(t_imu),
    }
    flags = np.zeros(len(t_cam), dtype=np.int64)
    for flag, where in marks.items():
        flags[where] |= int(flag)
    return flags
