"""The stage of the clocks: square wave, choice of the inertial samples, their alignment, the pose at rest."""

from bricktrack_common.arrays import FloatArray
from bricktrack_common.brick_model import BrickModel
from bricktrack_common.errors import ConfigError, ShapeError, TrackingError
from bricktrack_common.imu_records import STANDARD_GRAVITY_MPS2, ImuDescription, ImuSamples
from bricktrack_common.run_folder import Run
from bricktrack_host.fusion.moving_camera import NOT_OBSERVABLE
from bricktrack_host.fusion.time_alignment import TimeAlignment, align_times
from bricktrack_host.results.daq_clock import EdgeFit, EdgeFitError, fit_edges
from bricktrack_host.results.rest_pose import RestPose, tare
from bricktrack_host.stages.settings import ProcessSettings
from bricktrack_host.tracks import ImuTrack, OpticalTrack


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
    if settings.camera != "static":
        problems.append(
            f"the camera moves (camera = {settings.camera!r}): optical poses alone. {NOT_OBSERVABLE}"
        )
        return None
    if settings.imu is not None and settings.imu not in run.imus:
        raise ConfigError(f"the run has no IMU '{settings.imu}'; it has: {', '.join(run.imus) or 'none'}")
    if not run.imus:
        problems.append("no inertial samples: the motion is smoothed from the optical poses alone")
        return None
    if brick.R_brick_imu is None:
        problems.append(
            "the layout file has no [imu], so the inertial samples cannot be used; optical poses alone"
        )
        return None
    description, samples = run.imus[settings.imu or next(iter(run.imus))]
    return imu_in_brick_axes(description, samples, brick.R_brick_imu)


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
    optical: OpticalTrack, imu: ImuTrack, run: Run, settings: ProcessSettings, problems: list[str]
) -> TimeAlignment | None:
    """Return how camera and IMU clocks lie to each other, or `None` where the samples do not tell."""
    # The daemon's stamps are of one clock and promise milliseconds; recordings from elsewhere nothing.
    prior_sd_ns = 5e6 if run.manifest.origin == "bricktrackd" else settings.max_clock_offset_s * 1e9
    try:
        alignment = align_times(
            optical, imu, max_offset_s=settings.max_clock_offset_s, prior_sd_ns=prior_sd_ns
        )
    except ShapeError as e:
        problems.append(f"the inertial samples cannot be used: {e}")
        return None
    if alignment.reason:
        problems.append(f"time alignment of camera and IMU: {alignment.reason}")
    return alignment


def rest_pose(
    optical: OpticalTrack, imu: ImuTrack | None, alignment: TimeAlignment | None, problems: list[str]
) -> RestPose | None:
    """Return the pose before the shaking began, or `None` and why."""
    offset_ns = 0 if alignment is None else round(alignment.offset_ns)
    try:
        return tare(optical, imu if alignment is not None else None, imu_minus_camera_ns=offset_ns)
    except TrackingError as e:
        problems.append(f"no rest pose, so no displacements from rest: {e}")
        return None
