"""Camera and IMU together: the motion of the brick at any instants, with covariance and flags.

The camera is static and one IMU rides in the brick (DESIGN 8.2). `fuse` treats one run, `fuse_batch` many in
one loop over time.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, as_float_array
from bricktrack_common.errors import ConfigError, ShapeError
from bricktrack_common.rotations import nearest_rotation
from bricktrack_host.fusion.fused_output import sample_motion
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
)
from bricktrack_host.fusion.time_alignment import TimeAlignment, align_times
from bricktrack_host.tracks import FusedTrack, ImuTrack, OpticalTrack

logger = logging.getLogger(__name__)

_RUNS_AT_ONCE = 8  # 2000 nodes of four 21 x 21 matrices take 28 MB a run
_FIRST_FRAMES = 15
_FIRST_WITHIN_RAD = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class FusionResult:
    """The fused motion of one run, and what was learned about clocks, sensors and frames on the way.

    Attributes
    ----------
    track : FusedTrack
        At the requested instants.
    forward : FusedTrack or None
        The same by the filter alone, which knows only the past; for comparison.
    alignment : TimeAlignment
        What the smoother started from.
    offset_ns, offset_sd_ns, skew, skew_sd : float
        The convention is `TimeAlignment`'s.
    acc_lag_ns, acc_lag_sd_ns : float, ns
        Specific force at t is the sample stamped t + this.
    acc_loss_s2, acc_loss_sd_s2 : float, s^2
        What the accelerometer's low-pass takes from its second derivative.
    gyro_bias_radps, gyro_bias_sd_radps, acc_bias_mps2, acc_bias_sd_mps2 : ndarray, shape (3,)
        Mean over the run; brick axes.
    gravity_camera_mps2, gravity_sd_mps2 : ndarray, shape (3,), camera axes
    frame_chi2 : ndarray, shape (n_frames,)
        Residual of each frame to all the others, squared over its covariance (6 degrees of freedom); NaN
        where the frame has no pose.
    frame_rejected : ndarray of bool, shape (n_frames,)
        Frames left out as outliers.
    mean_nis : float
        Mean innovation squared over its covariance in the last forward pass; 6 when all is as believed.
    gyro_noise, acc_noise : NoiseLevel
        How much the samples were believed.
    rotation_noise_scale, position_noise_scale : float
        What the stated optical sd had to be multiplied by. Below 1 where frames agree better than stated: the
        rest of the stated variance is an error that they share, and stays in the covariance given out.
    """

    track: FusedTrack
    forward: FusedTrack | None
    alignment: TimeAlignment
    offset_ns: float
    offset_sd_ns: float
    skew: float
    skew_sd: float
    acc_lag_ns: float
    acc_lag_sd_ns: float
    acc_loss_s2: float
    acc_loss_sd_s2: float
    gyro_bias_radps: FloatArray
    gyro_bias_sd_radps: FloatArray
    acc_bias_mps2: FloatArray
    acc_bias_sd_mps2: FloatArray
    gravity_camera_mps2: FloatArray
    gravity_sd_mps2: FloatArray
    frame_chi2: FloatArray
    frame_rejected: BoolArray
    mean_nis: float
    gyro_noise: NoiseLevel
    acc_noise: NoiseLevel
    rotation_noise_scale: float
    position_noise_scale: float


@dataclass(frozen=True, slots=True, eq=False)
class FusionInput:
    """One run of a batch.

    Attributes
    ----------
    optical, imu : OpticalTrack, ImuTrack
    lever_arm_mm : array_like, shape (3,), mm, brick axes
        From the origin LED to the IMU.
    output_t_ns : ndarray of int64, shape (m,), camera time
        Where the motion is wanted, in any order.
    alignment : TimeAlignment, optional
        Estimated by `align_times` when not given.
    """

    optical: OpticalTrack
    imu: ImuTrack
    lever_arm_mm: ArrayLike
    output_t_ns: IntArray
    alignment: TimeAlignment | None = None


def fuse(
    optical: OpticalTrack,
    imu: ImuTrack,
    *,
    lever_arm_mm: ArrayLike,
    output_t_ns: IntArray,
    alignment: TimeAlignment | None = None,
    camera: Literal["static"] = "static",
    settings: FusionSettings | None = None,
    with_forward: bool = False,
) -> FusionResult:
    """Return the motion of the brick from optical poses and inertial samples together.

    Parameters
    ----------
    optical : OpticalTrack
    imu : ImuTrack
        In brick axes.
    lever_arm_mm : array_like, shape (3,), mm, brick axes
        From the origin LED to the IMU.
    output_t_ns : ndarray of int64, shape (m,), camera time
        Where the motion is wanted, in any order.
    alignment : TimeAlignment, optional
        Estimated by `align_times` when not given.
    camera : "static"
        The camera stands still in an inertial frame.
    settings : FusionSettings, optional
    with_forward : bool
        Whether to give the forward filter's motion too.

    Returns
    -------
    FusionResult

    Raises
    ------
    ConfigError
        If the camera moves.
    TrackingError
        If there is no optical pose.
    ShapeError
        If there are too few inertial samples, or arrays do not fit together.
    """
    one = FusionInput(optical, imu, lever_arm_mm, output_t_ns, alignment)
    return fuse_batch([one], camera=camera, settings=settings, with_forward=with_forward)[0]


def fuse_batch(
    inputs: Sequence[FusionInput],
    *,
    camera: Literal["static"] = "static",
    settings: FusionSettings | None = None,
    with_forward: bool = False,
) -> list[FusionResult]:
    """Return what `fuse` gives for each of many runs, in one loop over time for eight runs at once."""
    if camera != "static":
        raise ConfigError(
            f"camera = {camera!r}: expected 'static'. When the camera moves, one IMU on the LED component "
            "cannot tell the camera's acceleration from the brick's: the position is not observable. "
            "Mount a second IMU with the camera, or smooth the optical poses alone (smooth_optical)."
        )
    settings = settings or FusionSettings()
    results: list[FusionResult] = []
    for i in range(0, len(inputs), _RUNS_AT_ONCE):
        results += _fuse_together(inputs[i : i + _RUNS_AT_ONCE], settings, with_forward)
    return results


def _prepare(item: FusionInput) -> Run:
    lever_arm_mm = as_float_array("lever_arm_mm", item.lever_arm_mm, (3,))
    if not np.isfinite(lever_arm_mm).all():
        raise ShapeError(f"lever_arm_mm is {lever_arm_mm.tolist()}; expected three finite numbers")
    if item.output_t_ns.ndim != 1 or not np.issubdtype(item.output_t_ns.dtype, np.integer):
        raise ShapeError(
            f"output_t_ns has shape {item.output_t_ns.shape} and type {item.output_t_ns.dtype}; "
            "expected one dimension of int64 ns"
        )
    alignment = item.alignment or align_times(item.optical, item.imu)
    imu = item.imu if alignment.sample_clock is None else alignment.sample_clock.restamp(item.imu)
    return Run.from_tracks(
        item.optical, imu, alignment, lever_arm_mm=lever_arm_mm, output_t_ns=item.output_t_ns
    )


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


def _relinearise(estimate: Estimate, b: int, n_nodes: int, settings: FusionSettings) -> Linearisation:
    """Return the linearisation at the first pass's result for run b."""
    x = estimate.state.x[:n_nodes, b]
    gravity = x[0, GRAV]
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
        gravity_mps2=gravity * settings.gravity_mps2 / np.linalg.norm(gravity),
    )


def _fuse_together(
    inputs: Sequence[FusionInput], settings: FusionSettings, with_forward: bool
) -> list[FusionResult]:
    runs = [_prepare(item) for item in inputs]
    lins = [first_linearisation(run, settings) for run in runs]
    nodes = [place_nodes(run, lin) for run, lin in zip(runs, lins, strict=True)]
    starts = [_attitude_at_first_node(*three) for three in zip(runs, nodes, lins, strict=True)]
    lins = [replace(lin, R_first=R) for lin, (R, _) in zip(lins, starts, strict=True)]
    used = [agrees for _, agrees in starts]
    first = settle_noise(runs, lins, nodes, used, settings)
    scales, levels = first.scales, first.levels
    for b, far in enumerate(first.chi2):
        good = far < settings.gate_chi2
        used[b] = good if good.mean() > 0.5 else used[b]  # else it is not the frames that are wrong
    # Relinearised once, with what the first pass found of clocks, noise and outliers.
    lins = [_relinearise(first.estimate, b, len(nodes[b].t_s), settings) for b in range(len(runs))]
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
    forward = passed.forward() if with_forward else None
    results = []
    for b, (item, run, node, lin) in enumerate(zip(inputs, runs, nodes, lins, strict=True)):
        n = len(node.t_s)
        x, P = estimate.state.x[:n, b], estimate.covariance[:n, b]
        n_frames = len(item.optical.t_ns)
        chi2_of_frame, rejected = np.full(n_frames, np.nan), np.zeros(n_frames, dtype=np.bool_)
        chi2_of_frame[run.frame], rejected[run.frame] = chi2[b], ~used[b]
        if rejected.any():
            logger.warning("%d of %d optical poses left out as outliers", rejected.sum(), len(run.frame))

        def sample(
            e: Estimate,
            *,
            is_smoothed: bool,
            run: Run = run,
            node: Nodes = node,
            lin: Linearisation = lin,
            b: int = b,
            item: FusionInput = item,
        ) -> FusedTrack:
            return sample_motion(
                run, node, lin, problem, e, b,
                output_t_ns=item.output_t_ns, used=used[b], scale=scales[b], settings=settings,
                is_smoothed=is_smoothed,
            )  # fmt: skip

        sd = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2).mean(axis=0), 0.0))
        results.append(
            FusionResult(
                track=sample(estimate, is_smoothed=True),
                forward=sample(forward, is_smoothed=False) if forward is not None else None,
                alignment=run.alignment,
                offset_ns=float(x[0, TAU] * 1e9),
                offset_sd_ns=float(sd[TAU] * 1e9),
                skew=float(x[0, SKEW]),
                skew_sd=float(sd[SKEW]),
                acc_lag_ns=float(x[0, LAG] * 1e9),
                acc_lag_sd_ns=float(sd[LAG] * 1e9),
                acc_loss_s2=float(x[0, LOSS]),
                acc_loss_sd_s2=float(sd[LOSS]),
                gyro_bias_radps=x[:, BG].mean(axis=0),
                gyro_bias_sd_radps=sd[BG],
                acc_bias_mps2=x[:, BA].mean(axis=0),
                acc_bias_sd_mps2=sd[BA],
                gravity_camera_mps2=x[0, GRAV],
                gravity_sd_mps2=sd[GRAV],
                frame_chi2=chi2_of_frame,
                frame_rejected=rejected,
                mean_nis=float(np.nanmean(passed.nis[:, b])),
                gyro_noise=levels[b][0],
                acc_noise=levels[b][1],
                rotation_noise_scale=float(scales[b][0]),
                position_noise_scale=float(scales[b][1]),
            )
        )
    return results
