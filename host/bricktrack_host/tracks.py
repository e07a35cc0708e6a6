"""The values that the stages hand on: what the camera saw, the optical poses, the fused motion.

Covariances are of the error ``[dtheta, dt]``: ``R_true = R @ Exp(dtheta)`` in rad in brick axes, and
``t_true = t + dt`` in mm in camera axes, of the brick's origin LED.
"""

from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LedObservations:
    """Where each LED was seen in each frame, with its identity decided.

    Attributes
    ----------
    sensor_timestamp_ns : ndarray of int64, shape (n_frames,), CLOCK_MONOTONIC of the unit
        Start of read-out of the first row.
    exposure_ns : ndarray of int64, shape (n_frames,)
    uv_px : ndarray, shape (n_frames, n_leds, 2), px
        Centroids; NaN where not seen.
    cov_px2 : ndarray, shape (n_frames, n_leds, 2, 2), px^2
    area_px2 : ndarray, shape (n_frames, n_leds), px^2
    led_flags : ndarray of int64, shape (n_frames, n_leds), `LedFlag`
    frame_flags : ndarray of int64, shape (n_frames,), `PoseFlag`
        What is known of the frame before any pose: lost, ambiguous, unverified.
    """

    sensor_timestamp_ns: IntArray
    exposure_ns: IntArray
    uv_px: FloatArray
    cov_px2: FloatArray
    area_px2: FloatArray
    led_flags: IntArray
    frame_flags: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class OpticalTrack:
    """Poses of the brick in the camera frame, one a frame.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,), CLOCK_MONOTONIC of the unit
        The instant of the pose: mid-exposure of the picture's centre row.
    R_camera_brick : ndarray, shape (n, 3, 3)
        NaN where there is no pose.
    t_camera_brick_mm : ndarray, shape (n, 3), mm
    covariance : ndarray, shape (n, 6, 6)
        Of ``[dtheta rad, dt mm]``, see the module.
    flags : ndarray of int64, shape (n,), `PoseFlag`
    residual_px : ndarray, shape (n, n_leds, 2), px
        Seen less predicted, NaN where the LED was not used.
    led_t_ns : ndarray of int64, shape (n, n_leds)
        Mid-exposure of the row that each LED was seen in.
    shared_covariance : ndarray, shape (n, 6, 6), optional
        What of the covariance is of errors that stand still: neighbouring frames share them.
    """

    t_ns: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    covariance: FloatArray
    flags: IntArray
    residual_px: FloatArray
    led_t_ns: IntArray
    shared_covariance: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ImuTrack:
    """Inertial samples in brick axes.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,), CLOCK_MONOTONIC of the unit
        Middle of the bus transaction plus the configured latency.
    acc_mps2 : ndarray, shape (n, 3), m/s^2, specific force in brick axes
        NaN where the sample is missing or was rejected.
    gyro_radps : ndarray, shape (n, 3), rad/s, brick axes
    flags : ndarray of int64, shape (n,), `bricktrack_common.imu_records.ImuFlag`
    acc_range_mps2 : float
        Where the accelerometer clips.
    t_sd_s : ndarray, shape (n,), s, or None
        How unsure each stamp is by itself, where a sample may belong to another slot.
    """

    t_ns: IntArray
    acc_mps2: FloatArray
    gyro_radps: FloatArray
    flags: IntArray
    acc_range_mps2: float
    t_sd_s: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class FusedTrack:
    """The motion of the brick from camera and IMU together, at any chosen instants.

    Attributes
    ----------
    t_ns : ndarray of int64, shape (n,), CLOCK_MONOTONIC of the unit, the camera's time
    R_camera_brick : ndarray, shape (n, 3, 3)
    t_camera_brick_mm : ndarray, shape (n, 3), mm
    omega_brick_radps : ndarray, shape (n, 3), rad/s, brick axes
    v_camera_mmps : ndarray, shape (n, 3), mm/s, of the brick's origin LED, camera axes
    covariance : ndarray, shape (n, 6, 6), of ``[dtheta rad, dt mm]``
    flags : ndarray of int64, shape (n,), `PoseFlag`
    with_rest : ndarray, shape (n, 6, 6), optional
        Covariance of each pose's error with that of the mean pose at rest; `None` where it is not told.
    """

    t_ns: IntArray
    R_camera_brick: FloatArray
    t_camera_brick_mm: FloatArray
    omega_brick_radps: FloatArray
    v_camera_mmps: FloatArray
    covariance: FloatArray
    flags: IntArray
    with_rest: FloatArray | None = None


def median_frame(covariance: FloatArray) -> int:
    """Return the frame whose covariance, of shape (n, 6, 6), is of the middle size: one that stands for all.

    Its own matrix can be used: medians of single elements would be no covariance.
    """
    size = np.log(np.diagonal(covariance, axis1=1, axis2=2)).sum(axis=1)
    return int(np.argsort(size)[len(size) // 2])
