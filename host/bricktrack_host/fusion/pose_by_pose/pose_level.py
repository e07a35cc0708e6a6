"""The pose-level smoother: a batch of runs from frames and samples to smoothed states at the nodes.

The order is DESIGN 8.2's: a first pass settles noise and outliers, a second is linearised at its result.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.rotations import nearest_rotation
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_signal import chain_rotations
from bricktrack_host.fusion.pose_by_pose.fusion_problem import (
    Nodes,
    Run,
    build_problem,
    first_linearisation,
    place_nodes,
    with_frames_used,
)
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel
from bricktrack_host.fusion.pose_by_pose.noise_choice import frame_chi2, settle_noise
from bricktrack_host.fusion.smoothing.linearisation import Linearisation
from bricktrack_host.fusion.smoothing.sensor_errors import with_sensor_doubt
from bricktrack_host.fusion.smoothing.smoother import (
    BA,
    BG,
    GRAV,
    LAG,
    LOSS,
    POS,
    SKEW,
    TAU,
    VEL,
    Estimate,
    Filter,
    Problem,
)
from bricktrack_host.fusion.smoothing.standing_doubt import Doubt

_FIRST_FRAMES = 15
_FIRST_WITHIN_RAD = 0.3
_FIRST_WITHIN_SD = 10.0  # of a frame's position; what is left out here may come back
_FIRST_WITHIN_MEDIANS = 6.0
_MIN_VOTERS = 7  # three give the parabola, and most of the others must agree with it
_LAST_PASSES = 4


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """One run of a batch after smoothing.

    Attributes
    ----------
    run, nodes, lin : Run, Nodes, Linearisation
    problem, passed, estimate : Problem, Filter, Estimate
        Of the whole batch.
    b : int
        The run's place in the batch.
    used : ndarray of bool, shape (n_frames,)
    scale : ndarray, shape (2,)
        Of the optical sd, rotation and position.
    levels : (NoiseLevel, NoiseLevel)
        Of gyro and accelerometer.
    chi2 : ndarray, shape (n_frames,)
        Of each frame by all others.
    doubt : Doubt or None
        What of the covariance comes from errors that stand still.
    """

    run: Run
    nodes: Nodes
    lin: Linearisation
    problem: Problem
    passed: Filter
    estimate: Estimate
    b: int
    used: BoolArray
    scale: FloatArray
    levels: tuple[NoiseLevel, NoiseLevel]
    chi2: FloatArray
    doubt: Doubt | None


def smooth_poses(
    runs: list[Run],
    settings: FusionSettings,
    *,
    levels: list[tuple[NoiseLevel, NoiseLevel]] | None = None,
) -> list[Smoothed]:
    """Return the smoothed states of a batch of runs.

    ``levels``: of gyro and accelerometer, where they are known from before: the sensors' standing errors are
    found the better for it.
    """
    lins = [first_linearisation(run, settings) for run in runs]
    nodes = [place_nodes(run, lin) for run, lin in zip(runs, lins, strict=True)]
    starts = [_agreeing_start(*three) for three in zip(runs, nodes, lins, strict=True)]
    lins = [lin for lin, _ in starts]
    used = [agrees for _, agrees in starts]
    first = settle_noise(runs, lins, nodes, used, settings, levels=levels)
    scales, levels = first.scales, first.levels
    for b, far in enumerate(first.chi2):
        good = far < settings.gate_chi2
        used[b] = good if good.mean() > 0.5 else used[b]  # else it is not the frames that are wrong
    # Relinearised once, with what the first pass found of clocks, noise and outliers.
    lins = [relinearised(runs[b], first.estimate, b, len(nodes[b].t_s), settings) for b in range(len(runs))]
    runs = [run.with_acc_loss(lin.loss_s2).seen_at(lin) for run, lin in zip(first.runs, lins, strict=True)]
    nodes = [place_nodes(run, lin) for run, lin in zip(runs, lins, strict=True)]
    problem, _ = build_problem(
        runs, nodes, lins, settings=settings, use_frame=used, noise_scale=scales, levels=levels
    )
    for is_last in [False] * (_LAST_PASSES - 1) + [True]:
        passed = Filter(problem)
        estimate = passed.smooth()
        chi2 = [frame_chi2(problem, passed, estimate, b, nodes[b], used[b]) for b in range(len(runs))]
        judged = [_judged(*three, settings) for three in zip(used, chi2, scales, strict=True)]
        if is_last or all(np.array_equal(u, j) for u, j in zip(used, judged, strict=True)):
            break
        used = judged
        problem = with_frames_used(problem, nodes, used)
    estimate, doubts = with_sensor_doubt(
        problem, passed, estimate, [run.sensor_covariance for run in runs],
        R_still_camera=[node.camera_attitudes(run) for node, run in zip(nodes, runs, strict=True)],
    )  # fmt: skip
    return [
        Smoothed(
            run, node, lin, problem, passed, estimate, b, used[b], scales[b], levels[b], chi2[b], doubts[b]
        )
        for b, (run, node, lin) in enumerate(zip(runs, nodes, lins, strict=True))
    ]


def _judged(used: BoolArray, chi2: FloatArray, scale: FloatArray, settings: FusionSettings) -> BoolArray:
    """Return which frames to use after a pass, by how far each lies from all the others.

    The first pass knew little of the sensors and may have been wrong about a frame at an impact: it comes
    back. One that no light or lens explains goes, and good ones that it dragged along come back after it.
    """
    far = chi2 * min(float(scale.min()), 1.0) ** 2
    kept = used & (far < settings.contest_chi2)
    if kept.sum() <= 0.5 * len(used):  # else it is not the frames that are wrong
        kept = used
    return np.asarray(kept | (~used & (far < settings.gate_chi2)))


def _agreeing_start(run: Run, nodes: Nodes, lin: Linearisation) -> tuple[Linearisation, BoolArray]:
    """Return the start that most of the early frames agree on, and which frames do.

    The filter's start is wide and would follow false first poses anywhere, so the early frames that disagree
    are not shown to it. The samples carry the frames to one instant; the later ones are all taken to agree.
    """
    at = nodes.node_of_frame[:_FIRST_FRAMES]
    k = max(int(at[-1]), 1)
    start_s, end_s = nodes.t_s[:k], nodes.t_s[1 : k + 1]
    step = run.signal.increments(
        start_s, end_s, gyro_bias_radps=lin.bg_radps, acc_bias_mps2=lin.ba_mps2, acc_lag_s=lin.lag_s
    )
    since = np.concatenate([np.eye(3)[None], chain_rotations(step.R)])
    R_first, turned = _attitude_at_first_node(run.R_seen[: len(at)], since[at])
    # Where the samples alone take a brick that stood still at the first node.
    known = np.zeros((k, 2, 3))
    if run.camera is not None:
        known = run.camera.increments(start_s, end_s, acc_lag_s=lin.lag_s)[:, :2]
    dt = (end_s - start_s)[:, None]
    R = R_first @ since[:-1]
    dv = np.einsum("nij,nj->ni", R, step.dv_mps) + dt * lin.gravity_mps2 + known[:, 0]
    dp = np.einsum("nij,nj->ni", R, step.dp_m) + 0.5 * dt**2 * lin.gravity_mps2 + known[:, 1]
    v = np.concatenate([np.zeros((1, 3)), np.cumsum(dv, axis=0)])
    felt_m = np.concatenate([np.zeros((1, 3)), np.cumsum(dp + v[:-1] * dt, axis=0)])[at]
    seen_m = run.p_seen_m[: len(at)] + run.R_seen[: len(at)] @ run.lever_arm_m
    sd_m = np.sqrt(np.trace(run.cov_seen[: len(at), 3:, 3:], axis1=1, axis2=2))
    placed = turned.copy()
    placed[turned] = _on_one_parabola(nodes.t_s[at[turned]], (seen_m - felt_m)[turned], sd_m[turned])
    agrees = np.ones(len(run.t_cam_s), dtype=np.bool_)
    agrees[: len(at)] = placed
    return replace(lin, R_first=R_first, p_first_m=seen_m[int(np.argmax(placed))]), agrees


def _attitude_at_first_node(R_seen: FloatArray, since: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the attitude at the first node that most frames agree on, and which do.

    ``since``, shape (n, 3, 3): what the gyro says that the brick has turned by at each frame.
    """
    first = R_seen @ np.swapaxes(since, 1, 2)
    cosine = 0.5 * (np.einsum("iab,jab->ij", first, first) - 1)
    best = int(np.argmax(np.median(cosine, axis=1)))
    return nearest_rotation(first[best]), np.asarray(cosine[best] > np.cos(_FIRST_WITHIN_RAD))


def _on_one_parabola(t_s: FloatArray, p_m: FloatArray, sd_m: FloatArray) -> BoolArray:
    """Return which positions lie near the parabola that most of them lie near: least median of distances.

    What the samples leave of a motion is its start, its velocity then, and what the tilt of gravity and the
    accelerometer's bias add, in proportion to the square of time.
    """
    n = len(t_s)
    if n < _MIN_VOTERS:
        return np.ones(n, dtype=np.bool_)
    powers = np.vander((t_s - t_s[0]) / (t_s[-1] - t_s[0]), 3)
    three = np.array(list(combinations(range(n), 3)))
    off_m = np.linalg.norm(p_m - powers @ np.linalg.solve(powers[three], p_m[three]), axis=2)
    best = off_m[int(np.argmin(np.median(off_m, axis=1)))]
    return np.asarray(best < np.maximum(_FIRST_WITHIN_SD * sd_m, _FIRST_WITHIN_MEDIANS * np.median(best)))


def relinearised(
    run: Run, estimate: Estimate, b: int, n_nodes: int, settings: FusionSettings
) -> Linearisation:
    """Return the linearisation at the first pass's result for run b."""
    x = estimate.state.x[:n_nodes, b]
    gravity = x[0, GRAV]
    if run.camera is None:
        gravity = gravity * settings.gravity_mps2 / np.linalg.norm(gravity)
    return Linearisation(
        tau_s=float(x[0, TAU]),
        skew=float(x[0, SKEW]),
        lag_s=float(x[0, LAG]),
        loss_s2=max(float(x[0, LOSS]), 0.0),
        bg_radps=x[:, BG].mean(axis=0),
        ba_mps2=x[:, BA].mean(axis=0),
        R_first=nearest_rotation(estimate.state.R[0, b]),
        v_first_mps=x[0, VEL],
        p_first_m=x[0, POS],
        gravity_mps2=gravity,
    )
