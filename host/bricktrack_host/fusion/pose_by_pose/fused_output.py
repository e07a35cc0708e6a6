"""The smoothed motion at any instants between the filter's nodes: pose, twist, covariance, flags."""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Nodes, Run
from bricktrack_host.fusion.pose_by_pose.sampling_kernel import (
    Path,
    carry_between,
    covariance_between,
    shared_between,
)
from bricktrack_host.fusion.smoothing.covariance_kernel import are_definite
from bricktrack_host.fusion.smoothing.smoother import LAG, SEEN, SKEW, TAU, Estimate, Problem, State
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
    with_rest: FloatArray | None = None,
) -> FusedTrack:
    """Return the motion of run ``b`` of a batch at instants of camera time.

    ``seen_cam_s``: when the camera saw something that was used, rising. ``common``: covariance, shape (6, 6),
    of what all that it saw has in common, see `common_part`. ``with_rest``: as `shared_with_rest` gives it.

    From the node before, the inertial samples carry the state to the instant, so what happened between nodes
    is kept. Where that path misses the node after (it does where the samples are not believed), the miss is
    spread as white noise would: attitude linearly, velocity and position along the cubic between both ends.
    A filter's state (``is_smoothed`` false) knows nothing of the node after and is only carried on.
    """
    at = _carry(run, nodes, estimate.state, b, output_t_ns, is_smoothed=is_smoothed)
    R, turn, arm_m = at.R, at.omega_radps, run.lever_arm_m
    p_m = at.p_m - R @ arm_m
    v_mps = at.v_mps - np.einsum("nij,nj->ni", R, np.cross(at.omega_radps, arm_m))
    v_seen_mps = v_mps
    if run.camera is not None:
        camera = run.camera.still_omega_radps(at.t_s)
        turn = turn - np.einsum("nji,nj->ni", R, camera)
        v_seen_mps = v_mps - np.cross(camera, p_m)
    P = np.empty((len(output_t_ns), 6, 6))
    share = at.share if is_smoothed else np.zeros(len(at.share))
    way = at.node, share, R, turn, v_seen_mps, at.t_cam_s - run.t_mid_s, arm_m
    covariance_between(
        np.ascontiguousarray(estimate.covariance[:, b]), np.searchsorted(estimate.of, SEEN), *way,
        _bridge(problem, b, at, is_smoothed=is_smoothed), common, P,
    )  # fmt: skip
    of_rest = None
    if with_rest is not None:
        of_rest = np.empty((len(output_t_ns), 6, with_rest.shape[2]))
        shared_between(with_rest, *way, of_rest)
    flags = _flags(run, at.t_cam_s, at.t_s, seen_cam_s, settings)
    flags[at.is_outside] |= int(PoseFlag.EXTRAPOLATED)
    variance = np.diagonal(P, axis1=1, axis2=2)
    unsure = (variance[:, 3:].max(axis=1) > settings.max_position_sd_mm**2) | (
        variance[:, :3].max(axis=1) > settings.max_rotation_sd_rad**2
    )
    # What rounding has made less than nothing says nothing.
    lost = at.is_outside | unsure | ~are_definite(P)
    flags[lost] |= int(PoseFlag.NO_POSE)
    t_mm, omega, v_mmps = 1e3 * p_m, at.omega_radps, 1e3 * v_mps
    for values in (R, t_mm, omega, v_mmps, P):
        values[lost] = np.nan
    track = FusedTrack(
        t_ns=output_t_ns,
        R_camera_brick=R,
        t_camera_brick_mm=t_mm,
        omega_brick_radps=omega,
        v_camera_mmps=v_mmps,
        covariance=P,
        flags=flags,
        with_rest=of_rest,
    )
    return track if run.camera is None else run.camera.to_camera(track, at.t_s)


def sample_poses(
    run: Run, nodes: Nodes, states: State, b: int, t_ns: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return smoothed rotations and positions, mm, of run ``b`` of a batch at instants of camera time.

    As by `sample_motion`, whether sure or not; NaN beyond the nodes.
    """
    at = _carry(run, nodes, states, b, t_ns, is_smoothed=True)
    R, p_m = at.R, at.p_m - at.R @ run.lever_arm_m
    if run.camera is not None:
        R, p_m = run.camera.from_still(at.t_s, R, p_m)
    R[at.is_outside], p_m[at.is_outside] = np.nan, np.nan
    return R, 1e3 * p_m


def imu_seconds(run: Run, states: State, b: int, t_ns: IntArray) -> FloatArray:
    """Return instants of camera time as seconds of the IMU, by the clocks of run ``b`` of a batch."""
    t_s, x = seconds_since(t_ns, run.signal.epoch_ns), states.x[0, b]
    return np.asarray(t_s + float(x[TAU]) + float(x[SKEW]) * (t_s - run.t_mid_s))


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
    R, p_m, v_mps, omega_radps : ndarray, shape (n, 3, 3), (n, 3) each
        Of the IMU point; the rate without its bias.
    """

    t_cam_s: FloatArray
    t_s: FloatArray
    is_outside: BoolArray
    node: IntArray
    since_s: FloatArray
    share: FloatArray
    R: FloatArray
    p_m: FloatArray
    v_mps: FloatArray
    omega_radps: FloatArray


def _carry(run: Run, nodes: Nodes, states: State, b: int, t_ns: IntArray, *, is_smoothed: bool) -> _Carried:
    """Return the states at instants of camera time, see `sample_motion`."""
    t_cam, t = seconds_since(t_ns, run.signal.epoch_ns), imu_seconds(run, states, b, t_ns)
    outside = (t < nodes.t_s[0] - _SLACK_S) | (t > nodes.t_s[-1] + _SLACK_S)
    t = np.clip(t, nodes.t_s[0], nodes.t_s[-1])
    k = np.clip(np.searchsorted(nodes.t_s, t, side="right") - 1, 0, len(nodes.t_s) - 2)
    start_s, n = nodes.t_s[k], len(t)
    since, lag_s = t - start_s, float(states.x[0, b, LAG])
    felt = felt_over_steps = np.zeros((0, 2, 3))
    if run.camera is not None:
        felt, felt_over_steps = (
            run.camera.increments(*ends, acc_lag_s=lag_s)[:, :2]
            for ends in ((start_s, t), (nodes.t_s[:-1], nodes.t_s[1:]))
        )
    path = Path(
        nodes.t_s, np.ascontiguousarray(states.R[:, b]), np.ascontiguousarray(states.x[:, b]),
        run.signal.pieces(), lag_s, np.ascontiguousarray(felt_over_steps),
    )  # fmt: skip
    R, p_m, v_mps, omega_radps = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    carry_between(path, t, k, np.ascontiguousarray(felt), is_smoothed, R, p_m, v_mps, omega_radps)
    share = since / (nodes.t_s[k + 1] - start_s)
    return _Carried(t_cam, t, outside, k, since, share, R, p_m, v_mps, omega_radps)


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


def _bridge(problem: Problem, b: int, at: _Carried, *, is_smoothed: bool) -> FloatArray:
    """Return the variance that inertial noise adds between known nodes, or after one: (n, 2), rad^2, m^2."""
    left = 1 - at.share if is_smoothed else np.ones(len(at.share))
    turn = problem.gyro_var[at.node, b] * at.since_s * left
    shift = problem.acc_var[at.node, b] * at.since_s**3 / 3 * left**3
    return np.stack([turn, shift], axis=1)


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
