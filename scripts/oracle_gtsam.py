"""The motion of a run by GTSAM: batch optimisation over preintegrated inertial factors, to compare with ours.

Poses seen by the camera are relations between one unknown pose of the camera, in a world whose gravity is
known, and the poses of the IMU at the frames; `CombinedImuFactor` (Forster et al., On-manifold preintegration
for real-time visual-inertial odometry, IEEE Trans. Robotics 33, 2017) ties neighbouring instants. What ours
has beyond that - a time offset, lag and loss as unknowns, the sensor's scale and axes, noise by what the
samples look like - GTSAM is not given: it takes the offset of the alignment and white noise.
"""

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V, X
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from bricktrack_common.arrays import FloatArray, IntArray, as_float_array
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment, has_pose
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.tracks import ImuTrack, OpticalTrack

_SAME_INSTANT_S = 1e-6
_GYRO_SD_RADPS, _ACC_SD_MPS2 = 0.004, 0.1  # of a sample: its noise, and room for what the factors leave out
_CAMERA = C(0)


def gtsam_poses(
    optical: OpticalTrack,
    imu: ImuTrack,
    *,
    lever_arm_mm: FloatArray,
    output_t_ns: IntArray,
    alignment: TimeAlignment,
) -> tuple[FloatArray, FloatArray]:
    """Return rotations (m, 3, 3) and origins (m, 3), mm, of the brick at instants of camera time.

    The instants must lie between the first and the last frame with a pose.
    """
    settings = FusionSettings()
    signal = ImuSignal.from_track(imu)
    arm_m = np.asarray(lever_arm_mm) * 1e-3
    seen = np.flatnonzero(has_pose(optical))
    frame_s = seconds_since(alignment.imu_time_ns(optical.t_ns[seen]), signal.epoch_ns)
    wanted_s = seconds_since(alignment.imu_time_ns(output_t_ns), signal.epoch_ns)
    t_s = np.unique(np.concatenate([frame_s, wanted_s]))
    t_s = t_s[np.concatenate([[True], np.diff(t_s) > _SAME_INSTANT_S])]
    node_of_frame, node_of_output = (np.abs(t_s[:, None] - at).argmin(axis=0) for at in (frame_s, wanted_s))

    R_seen = optical.R_camera_brick[seen]
    p_imu_m = optical.t_camera_brick_mm[seen] * 1e-3 + R_seen @ arm_m
    force = np.einsum("nij,nj->ni", R_seen, signal.acc_at(frame_s))
    R_world_camera = _levelling(np.median(force, axis=0))

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(_CAMERA, gtsam.Pose3(gtsam.Rot3(R_world_camera), np.zeros(3)))
    # Heading and place of the camera are free to choose; its tilt is not known.
    loose = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, 0.1, 1e-6, 1e-6, 1e-6]))
    graph.add(gtsam.PriorFactorPose3(_CAMERA, values.atPose3(_CAMERA), loose))
    for k, i in enumerate(node_of_frame):
        pose = gtsam.Pose3(gtsam.Rot3(R_seen[k]), p_imu_m[k])
        noise = gtsam.noiseModel.Gaussian.Covariance(_pose_covariance(optical, int(seen[k]), arm_m))
        graph.add(gtsam.BetweenFactorPose3(_CAMERA, X(int(i)), pose, noise))

    _add_motion(graph, values, signal, t_s, settings, alignment)
    _add_start(values, t_s, frame_s, R_world_camera @ R_seen, p_imu_m @ R_world_camera.T)
    # From a start that interpolates through dropouts the way is long: the defaults stop on it.
    patient = gtsam.LevenbergMarquardtParams.CeresDefaults()
    patient.setMaxIterations(200)
    patient.setRelativeErrorTol(1e-8)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, patient).optimize()

    camera = result.atPose3(_CAMERA)
    poses = [camera.between(result.atPose3(X(int(i)))) for i in node_of_output]
    R = np.stack([pose.rotation().matrix() for pose in poses])
    p_m = np.stack([pose.translation() for pose in poses])
    return R, 1e3 * (p_m - R @ arm_m)


def _levelling(up: FloatArray) -> FloatArray:
    """Return the smallest rotation that takes a direction to +z."""
    up = up / np.linalg.norm(up)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    angle = np.arctan2(np.linalg.norm(axis), up[2])
    axis = axis / max(float(np.linalg.norm(axis)), 1e-12)
    return as_float_array("R", gtsam.Rot3.Expmap(axis * angle).matrix(), (3, 3))


def _pose_covariance(optical: OpticalTrack, frame: int, arm_m: FloatArray) -> FloatArray:
    """Return the covariance of a frame's pose of the IMU in GTSAM's order and axes: both in the body's."""
    R = optical.R_camera_brick[frame]
    cov = optical.covariance[frame].copy()
    cov[3:] *= 1e-3
    cov[:, 3:] *= 1e-3
    x, y, z = arm_m
    J = np.eye(6)
    J[3:, 3:] = R.T
    J[3:, :3] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(J @ cov @ J.T)


def _add_motion(
    graph: Any,
    values: Any,
    signal: ImuSignal,
    t_s: FloatArray,
    settings: FusionSettings,
    alignment: TimeAlignment,
) -> None:
    """Add what the inertial samples say from each node to the next, and the biases."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(settings.gravity_mps2)
    params.setGyroscopeCovariance(np.eye(3) * _GYRO_SD_RADPS**2 * signal.period_s)
    params.setAccelerometerCovariance(np.eye(3) * _ACC_SD_MPS2**2 * signal.period_s)
    params.setIntegrationCovariance(np.eye(3) * 1e-12)
    params.setBiasOmegaCovariance(np.eye(3) * settings.gyro_bias_walk_radps**2)
    params.setBiasAccCovariance(np.eye(3) * settings.acc_bias_walk_mps2**2)
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.asarray(alignment.gyro_bias_radps))
    sd = np.repeat([settings.acc_bias_sd_mps2, settings.gyro_bias_sd_radps], 3)
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, gtsam.noiseModel.Diagonal.Sigmas(sd)))
    middle = 0.5 * (t_s[1:] + t_s[:-1])
    for i, (acc, gyro, dt) in enumerate(
        zip(signal.acc_at(middle), signal.gyro_at(middle), np.diff(t_s), strict=True)
    ):
        step = gtsam.PreintegratedCombinedMeasurements(params, bias)
        step.integrateMeasurement(acc, gyro, float(dt))
        graph.add(gtsam.CombinedImuFactor(X(i), V(i), X(i + 1), V(i + 1), B(i), B(i + 1), step))
    for i in range(len(t_s)):
        values.insert(B(i), bias)


def _add_start(
    values: Any, t_s: FloatArray, frame_s: FloatArray, R_world: FloatArray, p_world_m: FloatArray
) -> None:
    """Add start values: poses and velocities between the frames, as interpolation has them."""
    attitude = Slerp(frame_s, Rotation.from_matrix(R_world))(np.clip(t_s, frame_s[0], frame_s[-1]))
    place = CubicSpline(frame_s, p_world_m)
    for i, (R, p_m, v_mps) in enumerate(zip(attitude.as_matrix(), place(t_s), place(t_s, 1), strict=True)):
        values.insert(X(i), gtsam.Pose3(gtsam.Rot3(R), p_m))
        values.insert(V(i), v_mps)
