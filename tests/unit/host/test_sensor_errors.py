"""Standing errors of the inertial sensor, found in simulated shakes and against differences of whole runs."""

from dataclasses import replace

import numpy as np
from brick_shakes import LEVER_ARM_MM, simulate_shake
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.estimate import FusionInput, fuse, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fusion_problem import build_problem, first_linearisation, place_nodes
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel
from bricktrack_host.fusion.smoothing.sensor_errors import (
    SensorErrors,
    estimate_sensor_errors,
    with_sensor_doubt,
)
from bricktrack_host.fusion.smoothing.smoother import POS, SEEN, Filter
from bricktrack_host.quality import PoseFlag

GYRO = np.array([[0.012, -0.004, 0.006], [0.003, -0.015, 0.002], [-0.005, 0.004, 0.010]])
ACC = np.array([[-0.010, 0.006, 0.004], [-0.005, 0.012, -0.007], [0.002, 0.006, -0.014]])
ARM_MM = np.array([1.5, -1.0, 0.8])
DROPOUTS = ((3.0, 3.4), (5.0, 5.5), (7.0, 7.5))


def shaken(seed, *, gyro=GYRO, acc=ACC):
    """Return a shake through a sensor with wrong scales and crossed axes."""
    s = simulate_shake(seed, duration_s=10.0, rotation_deg=8.0, amplitude_mm=8.0, dropouts=DROPOUTS)
    imu = replace(
        s.imu,
        gyro_radps=s.imu.gyro_radps @ (np.eye(3) + gyro).T,
        acc_mps2=s.imu.acc_mps2 @ (np.eye(3) + acc).T,
    )
    return s, imu


def problem_of(s, imu, lever_arm_mm, settings, *, noise_scale=1.0):
    """Return the problem of a run that knows nothing of its sensor yet, and how to build it again."""
    run = prepare_run(FusionInput(s.optical, imu, lever_arm_mm, s.optical.t_ns), settings)
    lin = first_linearisation(run, settings)
    nodes = place_nodes(run, lin)
    level = NoiseLevel(1.0, 0.5)

    def build(run):
        return build_problem(
            [run], [nodes], [lin], settings=settings, noise_scale=[np.full(2, noise_scale)],
            use_frame=[np.ones(len(run.t_cam_s), dtype=np.bool_)], levels=[(level, level)],
        )[0]  # fmt: skip

    return run, build


def test_errors_are_found_to_within_what_is_said_of_them():
    settings, z = FusionSettings(), []
    truth = np.concatenate([GYRO.ravel(), ACC.ravel(), ARM_MM * 1e-3])
    for seed in (1, 2, 3):
        s, imu = shaken(seed)
        run, build = problem_of(s, imu, np.array(LEVER_ARM_MM) - ARM_MM, settings)
        problem = build(run)
        errors = estimate_sensor_errors(problem, Filter(problem), 0, settings)
        found = np.concatenate([errors.gyro.ravel(), errors.acc.ravel(), errors.arm_m])
        sd = np.sqrt(np.diag(errors.covariance))
        z.append((found - truth) / sd)
        assert sd.max() <= settings.sensor_gain_sd and sd[-3:].max() < 0.5e-3  # the motion shows the arm
    # 63 numbers, correlated within a run: their mean square is 1 when honest.
    assert 0.3 < np.mean(np.square(z)) < 2.0


def test_what_is_carried_along_is_the_derivative_of_the_smoothed_motion():
    settings = FusionSettings()
    s, imu = shaken(4)
    # Frames believed so little that none surprises: how much a surprise is doubted has derivatives of its own.
    run, build = problem_of(s, imu, LEVER_ARM_MM, settings, noise_scale=2.0)
    problem = build(run)
    passed = Filter(problem)
    assert passed.inflation.max() == 1.0
    estimate = passed.smooth(SEEN)
    for error in (0, 4, 9, 13, 17):  # gyro xx, yy; accelerometer xx, yy, zz
        gains = np.zeros(18)
        gains[error] = size = 1e-3
        gyro, acc = gains.reshape(2, 3, 3)
        changed = run.with_sensor(SensorErrors(gyro, acc, np.zeros(3), np.zeros((21, 21))))
        again = Filter(build(changed)).smooth(SEEN)
        turn = Rotation.from_matrix(
            np.swapaxes(estimate.state.R[:, 0], 1, 2) @ again.state.R[:, 0]
        ).as_rotvec()
        moved = (again.state.x - estimate.state.x)[:, 0, POS]
        truth = np.abs(np.concatenate([turn, moved], axis=1) / size).reshape(-1, 2, 3)
        one = np.zeros((21, 21))
        one[error, error] = 1.0
        more = with_sensor_doubt(problem, passed, estimate, [one])[0].covariance - estimate.covariance
        carried = np.sqrt(np.diagonal(more[:, 0, :6, :6], axis1=1, axis2=2)).reshape(-1, 2, 3)
        off = np.sqrt(((carried - truth) ** 2).mean(axis=(0, 2)) / (truth**2).mean(axis=(0, 2)))
        # Taken at the middle of each step and at predicted attitudes: good to a few per cent.
        assert (off < 0.12).all()


def test_a_wrong_sensor_costs_little_once_it_is_known():
    s, imu = shaken(5)
    t_ns = np.arange(s.optical.t_ns[0], s.optical.t_ns[-1], 10_000_000)
    _, truth_mm = s.truth(t_ns)
    rms = {}
    for name, settings in (
        ("estimated", FusionSettings()),
        ("ignored", FusionSettings(sensor_gain_sd=0.0, lever_arm_sd_mm=0.0)),
    ):
        track = fuse(
            s.optical, imu, lever_arm_mm=np.array(LEVER_ARM_MM) - ARM_MM, output_t_ns=t_ns, settings=settings
        ).track
        inside = (track.flags & int(PoseFlag.DROPOUT)) != 0
        rms[name] = np.sqrt(np.mean(np.sum((track.t_camera_brick_mm - truth_mm)[inside] ** 2, axis=1)))
    assert rms["estimated"] < 0.7 * rms["ignored"]


def test_nothing_is_estimated_where_nothing_is_doubted():
    settings = FusionSettings(sensor_gain_sd=0.0, lever_arm_sd_mm=0.0)
    s, imu = shaken(6)
    run, build = problem_of(s, imu, LEVER_ARM_MM, settings)
    problem = build(run)
    passed = Filter(problem)
    assert estimate_sensor_errors(problem, passed, 0, settings) is None
    estimate = passed.smooth(SEEN)
    same, doubts = with_sensor_doubt(problem, passed, estimate, [np.zeros((21, 21))])
    assert doubts == [None]
    np.testing.assert_array_equal(same.covariance, estimate.covariance)
