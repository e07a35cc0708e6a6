"""The recorded and path-traced fusion samples as tracks."""

from pathlib import Path

import numpy as np

from bricktrack_common.arrays import FloatArray, IntArray
from bricktrack_common.rotations import matrix_from_quaternion, matrix_from_rvec
from bricktrack_host.tracks import ImuTrack, OpticalTrack


def path_traced_tracks(folder: Path, *, seed: int) -> tuple[OpticalTrack, ImuTrack]:
    """Return the path-traced (simulated) motion: true poses with 0.1 mm / 0.05 deg noise, and its IMU file."""
    rng = np.random.default_rng(seed)
    poses = np.genfromtxt(folder / "truth" / "motion_poses.csv", delimiter=",", names=True)
    t_ns = np.genfromtxt(
        folder / "truth" / "motion_poses.csv", delimiter=",", skip_header=1, usecols=10, dtype=np.int64
    )
    n, sd = len(t_ns), np.repeat([np.radians(0.05), 0.1], 3)
    noise = rng.normal(0, sd, (n, 6))
    R = matrix_from_quaternion(np.stack([poses[k] for k in ("qw", "qx", "qy", "qz")], axis=1))
    optical = OpticalTrack(
        t_ns=t_ns,
        R_camera_brick=R @ matrix_from_rvec(noise[:, :3]),
        t_camera_brick_mm=np.stack([poses[k] for k in ("x_mm", "y_mm", "z_mm")], axis=1) + noise[:, 3:],
        covariance=np.broadcast_to(np.diag(sd**2), (n, 6, 6)).copy(),
        flags=np.zeros(n, dtype=np.int64),
        residual_px=np.full((n, 0, 2), np.nan),
        led_t_ns=np.zeros((n, 0), dtype=np.int64),
    )
    path = folder / "imu_motion.csv"
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    imu_t_ns = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=0, dtype=np.int64)
    imu = ImuTrack(
        t_ns=imu_t_ns,
        acc_mps2=rows[:, 1:4],
        gyro_radps=np.radians(rows[:, 4:7]),
        flags=np.zeros(len(rows), dtype=np.int64),
        acc_range_mps2=16 * 9.80665,
    )
    return optical, imu


def path_traced_truth(folder: Path) -> tuple[IntArray, FloatArray, FloatArray]:
    """Return camera times, rotations and positions (mm) of the dense truth, every millisecond."""
    path = folder / "truth" / "motion_dense.csv"
    rows = np.genfromtxt(path, delimiter=",", skip_header=1)
    t_ns = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=1, dtype=np.int64)
    return t_ns, matrix_from_quaternion(rows[:, 6:10]), rows[:, 3:6]
