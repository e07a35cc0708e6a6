"""Camera and IMU together, LED by LED: every LED seen counts, at its own row's instant, even one alone.

The pose-level smoother (`pose_level`) comes first: it finds the clocks, the noise and a motion near enough to
predict the pictures from. Here the measurement is the centroid itself, through the calibrated rays and the
dome (DESIGN 8.2): nothing of the rolling shutter is left, frames with one or two LEDs still hold the motion,
and dropouts are rare. Where the two disagree by more than they may, that is said.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.camera_model import RayModel
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment
from bricktrack_host.fusion.cross_check import CrossCheck, cross_check
from bricktrack_host.fusion.estimate import (
    CameraMotionKind,
    FusionInput,
    FusionResult,
    fused_result,
    require_observable,
    smooth_one,
)
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.led_by_led.led_measurements import SeenLeds
from bricktrack_host.fusion.led_by_led.led_smoothing import LedSmoother, SmoothedLeds
from bricktrack_host.fusion.pose_by_pose.fused_output import sample_motion
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraAlignment, CameraImu
from bricktrack_host.tracks import ImuTrack, LedObservations, OpticalTrack

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, eq=False)
class TightResult:
    """The tightly coupled motion of one run.

    Attributes
    ----------
    fused : FusionResult
        With the tightly coupled track, clocks and biases; ``frame_chi2`` and ``frame_rejected`` are the
        pose-level smoother's.
    pose_level : FusionResult
        What it began with, kept as the check.
    check : CrossCheck
    led_chi2 : ndarray, shape (n_frames, n_leds)
        Of each LED by all others, squared over its covariance (2 degrees of freedom); NaN where not used.
    led_rejected : ndarray of bool, shape (n_frames, n_leds)
        LEDs left out as outliers.
    centroid_noise_scale : float
        What the stated sd of the centroids had to be multiplied by.
    led_offset_sd_px : float
        How far single LEDs lie beside where layout and profile have them, all over the run; NaN where fewer
        than four are seen at once, which does not tell.
    """

    fused: FusionResult
    pose_level: FusionResult
    check: CrossCheck
    led_chi2: FloatArray
    led_rejected: BoolArray
    centroid_noise_scale: float
    led_offset_sd_px: float


def fuse_tight(
    observations: LedObservations,
    optical: OpticalTrack,
    imu: ImuTrack,
    ray_model: RayModel,
    brick_model: BrickModel,
    *,
    lever_arm_mm: ArrayLike,
    output_t_ns: IntArray,
    alignment: TimeAlignment | None = None,
    camera: CameraMotionKind = "static",
    camera_imu: CameraImu | None = None,
    camera_alignment: CameraAlignment | None = None,
    settings: FusionSettings | None = None,
    rest_ns: tuple[int, int] | None = None,
) -> TightResult:
    """Return the motion of the brick from LED centroids and inertial samples together.

    Parameters
    ----------
    observations : LedObservations
    optical : OpticalTrack
        The poses of the same frames, from `bricktrack_host.tracking.optical_track.solve_poses`.
    imu : ImuTrack
        In brick axes.
    ray_model, brick_model : RayModel, BrickModel
    lever_arm_mm : array_like, shape (3,), mm, brick axes
        From the origin LED to the IMU.
    output_t_ns : ndarray of int64, shape (k,), camera time
    alignment : TimeAlignment, optional
        Estimated by `align_times` when not given.
    camera, camera_imu, camera_alignment
        Of a camera that moves, as in `bricktrack_host.fusion.estimate.fuse`.
    settings : FusionSettings, optional
    rest_ns : (int, int), camera time, optional
        When the brick rested: then the track says what it shares with the pose there.

    Raises
    ------
    ConfigError
        If the camera moves and there is no sensor with it.
    TrackingError
        If there is no optical pose.
    ShapeError
        If there are too few inertial samples, or arrays do not fit together.
    """
    require_observable(camera, camera_imu)
    settings = settings or FusionSettings()
    item = FusionInput(optical, imu, lever_arm_mm, output_t_ns, alignment, camera_imu, camera_alignment)
    first = smooth_one(item, settings)
    pose_level = fused_result(item, first, settings)
    smoother = LedSmoother(
        SeenLeds.of(observations, ray_model), first, ray_model, brick_model,
        lever_arm_m=np.asarray(lever_arm_mm, dtype=np.float64) * 1e-3, settings=settings, rest_ns=rest_ns,
    )  # fmt: skip
    del first  # memory holds one smoother
    done = smoother.smooth()
    del smoother
    return tight_result(observations, item, pose_level, done, settings)


def tight_result(
    observations: LedObservations,
    item: FusionInput,
    pose_level: FusionResult,
    done: SmoothedLeds,
    settings: FusionSettings,
) -> TightResult:
    """Return what is given out of smoothed states, beside the motion pose by pose that they began with."""
    leds, smoothed, use, scale = done.leds, done.states, done.use, float(done.noise_scales[0])
    seen_ns = np.unique(item.optical.t_ns[leds.frame[use]])
    track = sample_motion(
        smoothed.run, smoothed.nodes, smoothed.problem, smoothed.estimate, 0,
        output_t_ns=item.output_t_ns, seen_cam_s=seconds_since(seen_ns, smoothed.run.signal.epoch_ns),
        common=np.zeros((6, 6)), settings=settings, is_smoothed=True, with_rest=done.with_rest,
    )  # fmt: skip
    shape = observations.uv_px.shape[:2]
    chi2_of_led, rejected = np.full(shape, np.nan), np.zeros(shape, dtype=np.bool_)
    chi2_of_led[leds.frame, leds.led], rejected[leds.frame, leds.led] = done.chi2, ~use
    if rejected.any():
        logger.info("%d of %d LED centroids left out as outliers", rejected.sum(), len(use))
    check = cross_check(track, pose_level.track)
    if not check.agrees:
        logger.warning(
            "tightly coupled and pose-level motion are up to %.2f mm apart, and by more than they may in "
            "%.0f %% of the instants",
            check.max_mm,
            100 * check.share_apart,
        )
    clocks = fused_result(item, smoothed, settings, track=track)
    fused = replace(
        clocks, frame_chi2=pose_level.frame_chi2, frame_rejected=pose_level.frame_rejected,
        rotation_noise_scale=scale, position_noise_scale=scale, pose_level=pose_level.track, check=check,
    )  # fmt: skip
    return TightResult(fused, pose_level, check, chi2_of_led, rejected, scale, done.errors.offset_sd_px)
