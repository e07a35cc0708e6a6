"""The smoothed motion at any instants between the filter's nodes: pose, twist, covariance, flags."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_rvec, rvec_from_matrix
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Nodes, Run
from bricktrack_host.fusion.pose_by_pose.sampling_kernel import covariance_between
from bricktrack_host.fusion.smoothing.covariance_kernel import are_definite
from bricktrack_host.fusion.smoothing.smoother import (
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
from bricktrack_host.tracks import FusedTrack, median_frame

# The velocity comes from poses at the same stamps: its own share that is unsure, in any direction.
_UNSURE_VELOCITY = 0.3
_SLACK_S = 1e-6


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
    at = _carry(run, nodes, estimate.state, b, output_t_ns, is_smoothed=is_smoothed)
    zero = np.zeros(len(at.t_s))
    camera = None if run.camera is None else run.camera.still_omega_radps(at.t_s)
    R_out, p_out, H = observe(
        at.state, at.omega_radps, run.lever_arm_m, at.t_cam_s - run.t_mid_s, zero, camera_omega_radps=camera
    )
    P = covariance_between(
        np.ascontiguousarray(estimate.covariance[:, b]), at.node, at.share if is_smoothed else zero,
        np.ascontiguousarray(H[..., estimate.of]),
    )  # fmt: skip
    _add_bridge(P, problem, b, at, is_smoothed=is_smoothed)
    P = P + common
    R_t, omega = at.state.R, at.omega_radps
    v_out = at.state.x[:, VEL] - np.einsum("nij,nj->ni", R_t, np.cross(omega, run.lever_arm_m))

    P = 0.5 * (P + np.swapaxes(P, 1, 2))
    P[:, 3:] *= 1e3
    P[:, :, 3:] *= 1e3
    flags = _flags(run, at.t_cam_s, at.t_s, seen_cam_s, settings)
    flags[at.is_outside] |= int(PoseFlag.EXTRAPOLATED)
    variance = np.diagonal(P, axis1=1, axis2=2)
    unsure = (variance[:, 3:].max(axis=1) > settings.max_position_sd_mm**2) | (
        variance[:, :3].max(axis=1) > settings.max_rotation_sd_rad**2
    )
    # What rounding has made less than nothing says nothing.
    lost = at.is_outside | unsure | ~are_definite(P)
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
    return track if run.camera is None else run.camera.to_camera(track, at.t_s)


def sample_poses(
    run: Run, nodes: Nodes, states: State, b: int, t_ns: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return smoothed rotations and positions, mm, of run ``b`` of a batch at instants of camera time.

    As by `sample_motion`, whether sure or not; NaN beyond the nodes.
    """
    at = _carry(run, nodes, states, b, t_ns, is_smoothed=True)
    R, p_m = at.state.R, at.state.x[:, POS] - at.state.R @ run.lever_arm_m
    if run.camera is not None:
        R, p_m = run.camera.from_still(at.t_s, R, p_m)
    R[at.is_outside], p_m[at.is_outside] = np.nan, np.nan
    return R, 1e3 * p_m


@dataclass(frozen=True, slots=True, eq=False)
class _Carried:
    """States at n instants, and where these lie between the nodes.

    Attributes
    ----------
    t_cam_s, t_s : ndarray, shape (n,)
        In camera time, and in IMU time, the latter held within the nodes.
    is_outside : ndarray of bool, shape (n,)
        Whether it had to be held.
    node : ndarray of int64, shape (n,)
        The one before.
    since_s, share : ndarray, shape (n,)
        Time since then, and over the whole step.
    state : State, leading shape (n,)
    omega_radps : ndarray, shape (n, 3)
    """

    t_cam_s: FloatArray
    t_s: FloatArray
    is_outside: BoolArray
    node: IntArray
    since_s: FloatArray
    share: FloatArray
    state: State
    omega_radps: FloatArray


def _carry(run: Run, nodes: Nodes, states: State, b: int, t_ns: IntArray, *, is_smoothed: bool) -> _Carried:
    """Return the states at instants of camera time, see `sample_motion`."""
    t_cam = seconds_since(t_ns, run.signal.epoch_ns)
    x0 = states.x[0, b]
    t = t_cam + float(x0[TAU]) + float(x0[SKEW]) * (t_cam - run.t_mid_s)
    outside = (t < nodes.t_s[0] - _SLACK_S) | (t > nodes.t_s[-1] + _SLACK_S)
    t = np.clip(t, nodes.t_s[0], nodes.t_s[-1])
    k = np.clip(np.searchsorted(nodes.t_s, t, side="right") - 1, 0, len(nodes.t_s) - 2)
    x = states.x[k, b]
    start_s, span = nodes.t_s[k], nodes.t_s[k + 1] - nodes.t_s[k]
    since = t - start_s
    R, v, p = _carried(run, State(states.R[k, b], x), start_s, t, float(x0[LAG]))
    if is_smoothed:
        miss_turn, miss_v, miss_p = _misses(run, nodes, states, b, k)
        s, a = span[:, None], (since / span)[:, None]
        R = R @ matrix_from_rvec(a * miss_turn)
        p = p + (3 * a**2 - 2 * a**3) * miss_p + s * (a**3 - a**2) * miss_v
        v = v + 6 * (a - a**2) / s * miss_p + (3 * a**2 - 2 * a) * miss_v
    omega = run.signal.gyro_at(t) - x[:, BG]
    x[:, POS], x[:, VEL] = p, v
    return _Carried(t_cam, t, outside, k, since, since / span, State(R, x), omega)


def _carried(
    run: Run, start: State, start_s: FloatArray, end_s: FloatArray, lag_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return attitude, velocity and position to which the inertial samples carry states, shape (n,)."""
    x, R, h = start.x, start.R, (end_s - start_s)[:, None]
    part = run.signal.increments(
        start_s, end_s, gyro_bias_radps=x[:, BG], acc_bias_mps2=x[:, BA], acc_lag_s=lag_s
    )
    v = x[:, VEL] + h * x[:, GRAV] + np.einsum("nij,nj->ni", R, part.dv_mps)
    p = x[:, POS] + h * x[:, VEL] + 0.5 * h**2 * x[:, GRAV] + np.einsum("nij,nj->ni", R, part.dp_m)
    if run.camera is not None:
        felt = run.camera.increments(start_s, end_s, acc_lag_s=lag_s)
        v, p = v + felt[:, 0], p + felt[:, 1]
    return R @ part.R, v, p


def _misses(
    run: Run, nodes: Nodes, state: State, b: int, k: IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return turn, velocity and position from where the samples carry nodes ``k`` to the nodes after them.

    Many instants lie in one step, whose miss is theirs.
    """
    step, of = np.unique(k, return_inverse=True)
    start = State(state.R[step, b], state.x[step, b])
    R, v, p = _carried(run, start, nodes.t_s[step], nodes.t_s[step + 1], float(state.x[0, b, LAG]))
    after_R, after_x = state.R[step + 1, b], state.x[step + 1, b]
    turn = rvec_from_matrix(np.swapaxes(R, 1, 2) @ after_R)
    return turn[of], (after_x[:, VEL] - v)[of], (after_x[:, POS] - p)[of]


def common_part(run: Run, scale: FloatArray, share: float) -> FloatArray:
    """Return the covariance of errors that a run's frames have in common, (6, 6); one frame stands for all.

    As the poses say. Where they do not, at least the share that is stated; more where the frames agree with
    each other better than their covariance allows, for then it holds what they share.

    Parameters
    ----------
    run : Run
    scale : ndarray, shape (2,)
        Of the stated sd of rotation and position.
    share : float
        Of the stated sd that is in common in any case.
    """
    median = median_frame(run.cov_seen)
    if run.shared_seen is not None:
        return np.asarray(run.shared_seen[median])
    share_at = np.repeat(np.sqrt(np.maximum((share * scale) ** 2, 1.0 - scale**2)), 3)
    return np.asarray(share_at[:, None] * run.cov_seen[median] * share_at)


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


def _add_bridge(P: FloatArray, problem: Problem, b: int, at: _Carried, *, is_smoothed: bool) -> None:
    """Add what inertial noise makes unsure between two known nodes (or after one), in place."""
    left = 1 - at.share if is_smoothed else 1.0
    turn = problem.gyro_var[at.node, b] * at.since_s * left
    shift = problem.acc_var[at.node, b] * at.since_s**3 / 3 * left**3
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
    marks = {
        PoseFlag.DROPOUT: away > 1.5 * period,
        PoseFlag.EXTRAPOLATED: (t_cam < frames[0] - _SLACK_S) | (t_cam > frames[-1] + _SLACK_S),
        PoseFlag.IMPACT: _near_sample(signal, t_imu, signal.acc_impact_mps2 > settings.impact_mps2),
        PoseFlag.CLIPPED: _near_sample(signal, t_imu, signal.clip_sd_mps2 > 0),
        PoseFlag.IMU_GAP: signal.in_gap(t_imu),
    }
    flags = np.zeros(len(t_cam), dtype=np.int64)
    for flag, where in marks.items():
        flags[where] |= int(flag)
    return flags
