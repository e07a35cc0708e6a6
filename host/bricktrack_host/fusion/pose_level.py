"""The pose-level smoother: a batch of runs from frames and samples to smoothed states at the nodes.

The order is DESIGN 8.2's: a first pass settles noise and outliers, a second is linearised at its result.
"""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray
from bricktrack_common.rotations import nearest_rotation
from bricktrack_host.fusion.fusion_problem import (
    Linearisation,
    Nodes,
    NoiseLevel,
    Run,
    build_problem,
    first_linearisation,
    place_nodes,
)
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.imu_signal import chain_rotations
from bricktrack_host.fusion.noise_choice import frame_chi2, settle_noise
from bricktrack_host.fusion.sensor_errors import with_sensor_doubt
from bricktrack_host.fusion.smoother import (
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

_FIRST_FRAMES = 15
_FIRST_WITHIN_RAD = 0.3


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


def smooth_poses(runs: list[Run], settings: FusionSettings) -> list[Smoothed]:
    """Return the smoothed states of a batch of runs."""
    lins = [first_linearisation(run, settings) for run in runs]
    nodes = [place_nodes(run, lin) for run, lin in zip(runs, lins, strict=True)]
    starts = [_attitude_at_first_node(*three) for three in zip(runs, nodes, lins, strict=True)]
    lins = [
        replace(lin, R_first=R, p_first_m=run.p_seen_m[first] + run.R_seen[first] @ run.lever_arm_m)
        for run, lin, (R, agrees) in zip(runs, lins, starts, strict=True)
        for first in [int(np.argmax(agrees))]
    ]
    used = [agrees for _, agrees in starts]
    first = settle_noise(runs, lins, nodes, used, settings)
    scales, levels = first.scales, first.levels
    for b, far in enumerate(first.chi2):
        good = far < settings.gate_chi2
        used[b] = good if good.mean() > 0.5 else used[b]  # else it is not the frames that are wrong
    # Relinearised once, with what the first pass found of clocks, noise and outliers.
    lins = [relinearised(runs[b], first.estimate, b, len(nodes[b].t_s), settings) for b in range(len(runs))]
    runs = [run.with_acc_loss(lin.loss_s2) for run, lin in zip(first.runs, lins, strict=True)]
    nodes = [place_nodes(run, lin) for run, lin in zip(runs, lins, strict=True)]
    for is_last in (False, True):
        problem, _ = build_problem(
            runs, nodes, lins, settings=settings, use_frame=used, noise_scale=scales, levels=levels
        )
        passed = Filter(problem)
        estimate = passed.smooth()
        chi2 = [frame_chi2(problem, passed, estimate, b, nodes[b], used[b])[2] for b in range(len(runs))]
        # The first pass knew little of the sensors and may have been wrong about a frame at an impact.
        back = [
            ~u & (c * min(float(scale.min()), 1.0) ** 2 < settings.gate_chi2)
            for u, c, scale in zip(used, chi2, scales, strict=True)
        ]
        if is_last or not any(b.any() for b in back):
            break
        used = [u | b for u, b in zip(used, back, strict=True)]
    estimate = with_sensor_doubt(problem, passed, estimate, [run.sensor_covariance for run in runs])
    return [
        Smoothed(run, node, lin, problem, passed, estimate, b, used[b], scales[b], levels[b], chi2[b])
        for b, (run, node, lin) in enumerate(zip(runs, nodes, lins, strict=True))
    ]


def _attitude_at_first_node(run: Run, nodes: Nodes, lin: Linearisation) -> tuple[FloatArray, BoolArray]:
    """Return the attitude at the first node that most of the early frames agree on, and which frames do.

    The frames are carried back by the gyro. The filter's start is wide and would follow a false first pose
    anywhere, so the early frames that disagree are not shown to it.
    """
    at = nodes.node_of_frame[:_FIRST_FRAMES]
    k = max(int(at[-1]), 1)
    step = run.signal.increments(
        nodes.t_s[:k],
        nodes.t_s[1 : k + 1],
        gyro_bias_radps=lin.bg_radps,
        acc_bias_mps2=lin.ba_mps2,
        acc_lag_s=lin.lag_s,
    )
    since = np.concatenate([np.eye(3)[None], chain_rotations(step.R)])[at]
    first = run.R_seen[: len(at)] @ np.swapaxes(since, 1, 2)
    cosine = 0.5 * (np.einsum("iab,jab->ij", first, first) - 1)
    best = int(np.argmax(np.median(cosine, axis=1)))
    agrees = np.ones(len(run.t_cam_s), dtype=np.bool_)
    agrees[: len(at)] = cosine[best] > np.cos(_FIRST_WITHIN_RAD)
    return nearest_rotation(first[best]), agrees


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
