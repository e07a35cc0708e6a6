"""The stage of the clocks: square wave, choice of the inertial samples, their alignment, the pose at rest."""

from dataclasses import dataclass, replace

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.errors import ConfigError, ShapeError, TrackingError
from bricktrack_common.imu_records import STANDARD_GRAVITY_MPS2, ImuDescription, ImuSamples
from bricktrack_common.run_folder import Run
from bricktrack_host.fusion.clocks.frame_stamps import check_stamps
from bricktrack_host.fusion.clocks.slip_search import find_slips
from bricktrack_host.fusion.clocks.stamp_slips import StampSlips
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, align_times
from bricktrack_host.fusion.pose_by_pose.moving_camera import (
    NOT_OBSERVABLE,
    CameraAlignment,
    CameraImu,
    align_both,
)
from bricktrack_host.quality import LedFlag
from bricktrack_host.results.daq_clock import EdgeFit, EdgeFitError, fit_edges
from bricktrack_host.results.rest_pose import RestPose, tare
from bricktrack_host.stages.camera_sensor import read_camera_sensor
from bricktrack_host.stages.settings import ProcessSettings
from bricktrack_host.tracks import ImuTrack, LedObservations, OpticalTrack


@dataclass(frozen=True, slots=True, eq=False)
class ChipOrientation:
    """What the chip itself says of its attitude, in its fusion modes; only compared with.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,)
    q_wxyz_gravity_imu : ndarray, shape (n, 4)
    R_brick_imu : ndarray, shape (3, 3)
    """

    t_ns: IntArray
    q_wxyz_gravity_imu: FloatArray
    R_brick_imu: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """The inertial samples to be fused, and how their clocks lie to the camera's.

    Attributes
    ----------
    imu : ImuTrack
        Of the LED component, in brick axes.
    alignment : TimeAlignment
    camera : CameraImu or None
        What feels the motion of a camera that moves.
    camera_alignment : CameraAlignment or None
        Of both, there.
    chip : ChipOrientation or None
    is_hint : bool
        Whether the camera moves and nothing feels it: the samples cannot be fused, and only hint at turns and
        impacts.
    slips : StampSlips or None
        Where the frames' stamps slip by whole periods; the alignment is of the mended ones.
    """

    imu: ImuTrack
    alignment: TimeAlignment
    camera: CameraImu | None = None
    camera_alignment: CameraAlignment | None = None
    chip: ChipOrientation | None = None
    is_hint: bool = False
    slips: StampSlips | None = None


def fit_square_wave(run: Run, problems: list[str]) -> EdgeFit | None:
    """Return the square wave's samples in camera time, or `None` where there is none, and why."""
    try:
        fit = fit_edges(run.edges_ns, run.manifest.trigger.nominal_hz)
    except EdgeFitError as e:
        problems.append(f"square wave: {e}; results are not on the laboratory's samples")
        return None
    problems.extend(f"square wave: {p}" for p in fit.problems())
    return fit


def choose_imu(
    run: Run, brick: BrickModel, settings: ProcessSettings, problems: list[str]
) -> ImuTrack | None:
    """Return the samples of the sensor on the LED component in brick axes, or `None` and why."""
    if not settings.use_imu:
        return None
    name = _name_of_imu(run, settings)
    if name is None:
        problems.append("no inertial samples: the motion is smoothed from the optical poses alone")
        return None
    if brick.R_brick_imu is None:
        problems.append(
            "the layout file has no [imu], so the inertial samples cannot be used; optical poses alone"
        )
        return None
    return imu_in_brick_axes(*run.imus[name], brick.R_brick_imu)


def _name_of_imu(run: Run, settings: ProcessSettings) -> str | None:
    """Return the name of the sensor on the LED component, `None` where there is none."""
    if settings.imu is not None and settings.imu not in run.imus:
        raise ConfigError(f"the run has no IMU '{settings.imu}'; it has: {', '.join(run.imus) or 'none'}")
    sensor = settings.camera_sensor
    cameras = {sensor.imu} if sensor is not None and sensor.kind == "imu" and not sensor.source else set()
    if settings.imu in cameras:
        raise ConfigError(f"IMU '{settings.imu}' moves with the camera; name the one on the LED component")
    return settings.imu or next((name for name in run.imus if name not in cameras), None)


def chip_orientation(run: Run, brick: BrickModel, settings: ProcessSettings) -> ChipOrientation | None:
    """Return what the chip on the LED component says of its attitude; `None` in its raw modes."""
    name = _name_of_imu(run, settings)
    if name is None or brick.R_brick_imu is None or not run.imus[name][0].fusion:
        return None
    samples = run.imus[name][1]
    return ChipOrientation(samples.t_ns, samples.q_wxyz, brick.R_brick_imu)


def imu_in_brick_axes(description: ImuDescription, samples: ImuSamples, R_brick_imu: FloatArray) -> ImuTrack:
    """Return inertial samples turned from the sensor's axes to the brick's."""
    return ImuTrack(
        t_ns=samples.t_ns,
        acc_mps2=samples.acc_mps2 @ R_brick_imu.T,
        gyro_radps=samples.gyro_radps @ R_brick_imu.T,
        flags=samples.flags,
        acc_range_mps2=description.acc_range_g * STANDARD_GRAVITY_MPS2,
    )


def align(
    optical: OpticalTrack,
    imu: ImuTrack,
    run: Run,
    brick: BrickModel,
    edge_fit: EdgeFit | None,
    settings: ProcessSettings,
    problems: list[str],
) -> Inertial | None:
    """Return the samples with how camera and IMU clocks lie to each other, or `None` and why not."""
    # The daemon's stamps are of one clock and promise milliseconds; recordings from elsewhere nothing.
    within_s = settings.max_clock_offset_s
    prior_sd_ns = 5e6 if run.manifest.origin == "bricktrackd" else within_s * 1e9
    camera, chip = None, chip_orientation(run, brick, settings)

    def aligned(poses: OpticalTrack) -> TimeAlignment:
        return align_times(poses, imu, max_offset_s=within_s, prior_sd_ns=prior_sd_ns)

    if settings.camera != "static":
        sensor = settings.camera_sensor
        camera = None if sensor is None else read_camera_sensor(run, sensor, edge_fit, problems)
        if camera is None:
            problems.append(
                f"the camera moves (camera = {settings.camera!r}): optical poses alone. {NOT_OBSERVABLE}"
            )
        elif camera.kind != settings.camera:
            raise ConfigError(
                f"camera = {settings.camera!r}, but the sensor given with the camera is of {camera.kind!r}"
            )
    try:
        if camera is not None:
            both = align_both(optical, imu, camera, max_offset_s=within_s, prior_sd_ns=prior_sd_ns)
            inertial = Inertial(imu, both.brick, camera, both, chip=chip)
        elif settings.camera != "static":
            inertial = Inertial(imu, aligned(optical), chip=chip, is_hint=True)
        else:
            alignment = aligned(optical)
            slips = find_slips(
                optical, imu, alignment, aligned, prior_sd_ns=prior_sd_ns, max_offset_s=within_s
            )
            if slips is not None:
                alignment = slips.alignment
                problems.extend(slips.words())
            inertial = Inertial(imu, alignment, chip=chip, slips=slips)
    except ShapeError as e:
        problems.append(f"the inertial samples cannot be used: {e}")
        return None
    if inertial.alignment.reason and not inertial.is_hint:
        problems.append(f"time alignment of camera and IMU: {inertial.alignment.reason}")
    if inertial.camera_alignment is not None and inertial.camera_alignment.camera.reason:
        problems.append(
            "time alignment of the camera and the IMU that moves with it: "
            f"{inertial.camera_alignment.camera.reason}"
        )
    return inertial


def with_stamps_mended(observations: LedObservations, slips: StampSlips, t_ns: IntArray) -> LedObservations:
    """Return observations with slipped stamps mended, and no LEDs where a frame has no instant of its own.

    ``t_ns``, shape (n_frames,): the frames' instants by their stamps as they were.
    """
    out = slips.left_out[:, None]
    return replace(
        observations,
        sensor_timestamp_ns=observations.sensor_timestamp_ns + (slips.t_ns - t_ns),
        uv_px=np.where(out[..., None], np.nan, observations.uv_px),
        led_flags=observations.led_flags | np.where(out, int(LedFlag.MISSING), 0),
        frame_flags=observations.frame_flags | slips.frame_flags,
    )


def unsure_stamps(
    stamps_ns: IntArray, optical: OpticalTrack, inertial: Inertial | None, problems: list[str]
) -> FloatArray:
    """Return how unsure the instant of each frame is, ns, where its stamps cannot all be right, and say why.

    Shape (n_frames,); zero where nothing speaks against them. ``stamps_ns`` are the sensor's.
    """
    if inertial is None or inertial.is_hint or inertial.camera is not None:
        # What a moving camera sees turn is not what the sensor on the brick feels: the rate alone counts.
        check = check_stamps(stamps_ns, optical, None, None)
    else:
        check = check_stamps(stamps_ns, optical, inertial.imu, inertial.alignment)
    problems.extend(check.problems)
    slips_ns = 0.0 if inertial is None or inertial.slips is None else inertial.slips.sd_ns
    return np.hypot(check.sd_ns, slips_ns)


def rest_pose(optical: OpticalTrack, inertial: Inertial | None, problems: list[str]) -> RestPose | None:
    """Return the pose before the shaking began, or `None` and why."""
    imu = None
    if inertial is not None:
        imu = replace(inertial.imu, t_ns=inertial.alignment.sampled_ns(inertial.imu))
    try:
        return tare(optical, imu)
    except TrackingError as e:
        problems.append(f"no rest pose, so no displacements from rest: {e}")
        return None
