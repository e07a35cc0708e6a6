"""Camera and IMU together: the motion of the brick at any instants, with covariance and flags.

One IMU rides in the brick (DESIGN 8.2); the camera stands still, or a sensor of its own tells how it moves.
`fuse` treats one run, `fuse_batch` many.
"""

import logging
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray, as_float_array
from bricktrack_common.errors import ConfigError, ShapeError
from bricktrack_host.fusion.camera_delay import settle_delay
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, align_times
from bricktrack_host.fusion.contested_frames import with_contested_frames
from bricktrack_host.fusion.cross_check import CrossCheck
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fused_output import common_part, sample_motion
from bricktrack_host.fusion.pose_by_pose.fusion_problem import Run
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel
from bricktrack_host.fusion.pose_by_pose.moving_camera import (
    NOT_OBSERVABLE,
    CameraAlignment,
    CameraImu,
    align_both,
)
from bricktrack_host.fusion.pose_by_pose.pose_level import Smoothed, smooth_poses
from bricktrack_host.fusion.sensor_agreement import require_agreement
from bricktrack_host.fusion.smoothing.smoother import BA, BG, GRAV, LAG, LOSS, SKEW, TAU, Estimate
from bricktrack_host.tracks import FusedTrack, ImuTrack, OpticalTrack

logger = logging.getLogger(__name__)

CameraMotionKind = Literal["static", "imu", "table"]


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
    pose_level, check : FusedTrack, CrossCheck, optional
        Of a tightly coupled motion: the pose-level one at the same instants, and how far both are apart.
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
    pose_level: FusedTrack | None = None
    check: CrossCheck | None = None


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
        Estimated by `align_times` when not given; not where the camera moves, which has two to estimate.
    camera : CameraImu, optional
        The sensor that moves with the camera; none: the camera stands still.
    camera_alignment : CameraAlignment, optional
        Of a moving camera; estimated by `align_both` when not given.
    """

    optical: OpticalTrack
    imu: ImuTrack
    lever_arm_mm: ArrayLike
    output_t_ns: IntArray
    alignment: TimeAlignment | None = None
    camera: CameraImu | None = None
    camera_alignment: CameraAlignment | None = None


def fuse(
    optical: OpticalTrack,
    imu: ImuTrack,
    *,
    lever_arm_mm: ArrayLike,
    output_t_ns: IntArray,
    alignment: TimeAlignment | None = None,
    camera: CameraMotionKind = "static",
    camera_imu: CameraImu | None = None,
    camera_alignment: CameraAlignment | None = None,
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
    camera : "static", "imu" or "table"
        The camera stands still; moves with a sensor of its own; or moves with a table whose accelerometers
        are recorded.
    camera_imu : CameraImu, optional
        That sensor, where the camera moves.
    camera_alignment : CameraAlignment, optional
        In place of ``alignment`` where the camera moves; estimated by `align_both` when not given.
    settings : FusionSettings, optional
    with_forward : bool
        Whether to give the forward filter's motion too.

    Returns
    -------
    FusionResult

    Raises
    ------
    ConfigError
        If the camera moves and there is no sensor with it: the position is then not observable.
    TrackingError
        If there is no optical pose.
    ShapeError
        If there are too few inertial samples, or arrays do not fit together.
    """
    require_observable(camera, camera_imu)
    one = FusionInput(optical, imu, lever_arm_mm, output_t_ns, alignment, camera_imu, camera_alignment)
    return fuse_batch([one], settings=settings, with_forward=with_forward)[0]


def require_observable(camera: CameraMotionKind, camera_imu: CameraImu | None) -> None:
    """Refuse a configuration in which the position cannot be told, or which contradicts itself.

    Raises
    ------
    ConfigError
    """
    if camera not in ("static", "imu", "table"):
        raise ConfigError(f"camera = {camera!r}: expected 'static', 'imu' or 'table'")
    if camera != "static" and camera_imu is None:
        raise ConfigError(
            f"camera = {camera!r} without a sensor that moves with the camera. {NOT_OBSERVABLE}"
        )
    if camera_imu is not None and camera_imu.kind != camera:
        raise ConfigError(
            f"camera = {camera!r}, but the sensor given with the camera is of {camera_imu.kind!r}"
        )


def fuse_batch(
    inputs: Sequence[FusionInput],
    *,
    settings: FusionSettings | None = None,
    with_forward: bool = False,
    executor: Executor | None = None,
) -> list[FusionResult]:
    """Return what `fuse` gives for each of many runs.

    ``executor``: any of `concurrent.futures`, as a pool of processes; the runs are shared out to it.
    """
    of_one = partial(_fuse_one, settings=settings or FusionSettings(), with_forward=with_forward)
    return list(map(of_one, inputs) if executor is None else executor.map(of_one, inputs))


def prepare_run(item: FusionInput, settings: FusionSettings) -> Run:
    """Return what of one input the smoother uses, with its times aligned."""
    lever_arm_mm = as_float_array("lever_arm_mm", item.lever_arm_mm, (3,))
    if not np.isfinite(lever_arm_mm).all():
        raise ShapeError(f"lever_arm_mm is {lever_arm_mm.tolist()}; expected three finite numbers")
    if item.output_t_ns.ndim != 1 or not np.issubdtype(item.output_t_ns.dtype, np.integer):
        raise ShapeError(
            f"output_t_ns has shape {item.output_t_ns.shape} and type {item.output_t_ns.dtype}; "
            "expected one dimension of int64 ns"
        )
    if item.camera is None:
        alignment, motion, is_near = item.alignment or align_times(item.optical, item.imu), None, True
    else:
        both = item.camera_alignment or align_both(item.optical, item.imu, item.camera)
        alignment, motion = both.brick, both.motion
        is_near = "stamps" not in (both.brick.source, both.camera.source)
    imu = alignment.restamped(item.imu)
    run = Run.from_tracks(
        item.optical, imu, alignment,
        lever_arm_mm=lever_arm_mm, output_t_ns=item.output_t_ns, camera=motion,
        vibration_beside_camera=settings.vibration_beside_camera,
    )  # fmt: skip
    if motion is None:
        return run
    require_agreement(run, settings)
    settled = settle_delay(
        item.optical, imu, alignment, motion, lever_arm_mm=lever_arm_mm, settings=settings, is_near=is_near
    )
    return Run.from_tracks(
        item.optical, imu, alignment,
        lever_arm_mm=lever_arm_mm, output_t_ns=item.output_t_ns, camera=settled,
    )  # fmt: skip


def smooth_one(item: FusionInput, settings: FusionSettings) -> Smoothed:
    """Return the smoothed states of one input, pose by pose.

    Two sensors have twice the errors, which are found the better for the noise that a first round settles.
    """
    run = prepare_run(item, settings)
    (smoothed,) = smooth_poses([run], settings)
    if run.camera is not None:
        (smoothed,) = smooth_poses([run], settings, levels=[smoothed.levels])
    return smoothed


def _fuse_one(item: FusionInput, settings: FusionSettings, with_forward: bool) -> FusionResult:
    return fused_result(item, smooth_one(item, settings), settings, with_forward=with_forward)


def fused_result(
    item: FusionInput,
    s: Smoothed,
    settings: FusionSettings,
    *,
    with_forward: bool = False,
    track: FusedTrack | None = None,
) -> FusionResult:
    """Return what is given out of one smoothed run; ``track`` where the motion was sampled already."""
    n = len(s.nodes.t_s)
    x, variance = s.estimate.state.x[:n, s.b], s.estimate.variance[:n, s.b]
    n_frames = len(item.optical.t_ns)
    chi2, rejected = np.full(n_frames, np.nan), np.zeros(n_frames, dtype=np.bool_)
    chi2[s.run.frame], rejected[s.run.frame] = s.chi2, ~s.used
    if rejected.any() and track is None:
        logger.warning("%d of %d optical poses left out as outliers", rejected.sum(), len(s.run.frame))

    def sample(estimate: Estimate, *, is_smoothed: bool, t_ns: IntArray = item.output_t_ns) -> FusedTrack:
        return sample_motion(
            s.run, s.nodes, s.problem, estimate, s.b,
            output_t_ns=t_ns, seen_cam_s=s.run.t_cam_s[s.used],
            common=common_part(s.run, s.scale, settings.optical_common_share),
            settings=settings, is_smoothed=is_smoothed,
        )  # fmt: skip

    if track is None:
        track = sample(s.estimate, is_smoothed=True)
        # A frame that is used and yet not followed contradicts the rest as much as one left out.
        contested = np.isfinite(chi2) & (rejected != (chi2 >= settings.contest_chi2))
        if contested.any():
            frames = item.optical
            track = with_contested_frames(
                track, sample(s.estimate, is_smoothed=True, t_ns=frames.t_ns[contested]),
                frames.R_camera_brick[contested], frames.t_camera_brick_mm[contested],
                period_ns=float(np.median(np.diff(frames.t_ns))),
            )  # fmt: skip
    sd = np.sqrt(np.maximum(variance.mean(axis=0), 0.0))
    return FusionResult(
        track=track,
        forward=sample(s.passed.forward(), is_smoothed=False) if with_forward else None,
        alignment=s.run.alignment,
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
        frame_chi2=chi2,
        frame_rejected=rejected,
        mean_nis=s.passed.mean_nis(s.b),
        gyro_noise=s.levels[0],
        acc_noise=s.levels[1],
        rotation_noise_scale=float(s.scale[0]),
        position_noise_scale=float(s.scale[1]),
    )
