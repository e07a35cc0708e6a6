"""Standing errors of the sensor at a moving camera, in simulated shakes and against differences of whole runs."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import LEVER_ARM_MM
from scipy.spatial.transform import Rotation
from two_imus import IMU_TO_CAMERA_MM, simulate_two_imus

from bricktrack_host.fusion.estimate import FusionInput, fuse, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.fusion_problem import build_problem, first_linearisation, place_nodes
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu
from bricktrack_host.fusion.smoothing.camera_errors import N_CAMERA_ERRORS, CameraErrors
from bricktrack_host.fusion.smoothing.sensor_errors import (
    SensorErrors,
    estimate_sensor_errors,
    with_sensor_doubt,
)
from bricktrack_host.fusion.smoothing.smoother import POS, SEEN, Filter

GYRO = np.array([[0.008, -0.004, 0.005], [0.003, -0.010, 0.002], [-0.005, 0.004, 0.007]])
ACC = np.array([[-0.007, 0.005, 0.004], [-0.005, 0.009, -0.006], [0.002, 0.005, -0.010]])
ARM_MM = np.array([1.5, -1.0, 1.2])
DELAY_S, RATE = 2e-4, 1e-4
NOTHING = np.zeros((3, 3))


def with_wrong_camera_sensor(run):
    """Return the samples of a run's camera through a sensor with wrong scales and crossed axes."""
    return replace(
        run.camera,
        gyro_radps=run.camera.gyro_radps @ (np.eye(3) + GYRO).T,
        acc_mps2=run.camera.acc_mps2 @ (np.eye(3) + ACC).T,
    )


def problem_of(run, camera, arm_mm, *, noise_scale=1.0):
    """Return a run that knows nothing of its sensors yet, its nodes, and how to build its problem."""
    settings = FusionSettings()
    optical = run.shake.optical
    item = FusionInput(
        optical, run.brick, LEVER_ARM_MM, optical.t_ns, camera=CameraImu(camera, IMU_TO_CAMERA_MM - arm_mm)
    )
    prepared = prepare_run(item, settings)
    lin = first_linearisation(prepared, settings)
    nodes = place_nodes(prepared, lin)
    level = NoiseLevel(1.0, 0.05)

    def build(changed):
        return build_problem(
            [changed], [nodes], [lin], settings=settings, noise_scale=[np.full(2, noise_scale)],
            use_frame=[np.ones(len(changed.t_cam_s), dtype=np.bool_)], levels=[(level, level)],
        )[0]  # fmt: skip

    return prepared, nodes, build


def as_the_camera_sees(run, t_s, R, p_m, arm_m):
    """Return attitudes and origins in camera axes, from those of the brick's sensor in still axes."""
    back = np.swapaxes(run.camera.still_attitude(t_s), 1, 2)
    origin = np.einsum("nij,nj->ni", back, p_m - R @ arm_m)
    return back @ R, origin - run.camera.imu_to_camera_m


def test_errors_of_both_sensors_are_found_to_within_what_is_said_of_them():
    truth = np.concatenate([np.zeros(21), GYRO.ravel(), ACC.ravel(), ARM_MM * 1e-3, [DELAY_S, RATE]])
    shaken = simulate_two_imus(1, duration_s=6.0)
    run, nodes, build = problem_of(shaken, with_wrong_camera_sensor(shaken), ARM_MM)
    # Simulated: 6.5 ms less 4 ms, by one clock.
    late = CameraErrors(
        delay_s=2.5e-3 - DELAY_S - run.camera.delay_s, delay_rate=-RATE - run.camera.delay_rate
    )
    run = run.with_sensor(SensorErrors(NOTHING, NOTHING, np.zeros(3), np.zeros((44, 44)), camera=late))
    problem = build(run)
    errors = estimate_sensor_errors(
        problem, Filter(problem), 0, FusionSettings(), R_still_camera=nodes.camera_attitudes(run)
    )
    camera = errors.camera
    found = np.concatenate([errors.gyro.ravel(), errors.acc.ravel(), errors.arm_m, camera.values()])
    sd = np.sqrt(np.diag(errors.covariance))
    assert sd[42] < 0.2 * FusionSettings().camera_delay_sd_ns * 1e-9
    assert sd[39:42].max() < 0.8e-3  # rocking by 2 degrees shows the arm
    assert sd[21:39].mean() < 0.6 * FusionSettings().sensor_gain_sd
    # 44 numbers, correlated: their mean square is 1 when honest.
    assert 0.3 < np.mean(np.square((found - truth) / sd)) < 2.0


def test_what_is_carried_along_is_the_derivative_of_the_relative_motion():
    shaken = simulate_two_imus(4, duration_s=5.0)
    # Frames believed so little that none surprises: how much a surprise is doubted has derivatives of its own.
    run, nodes, build = problem_of(shaken, shaken.camera, np.zeros(3), noise_scale=2.0)
    problem = build(run)
    passed = Filter(problem)
    assert passed.inflation.max() == 1.0
    estimate = passed.smooth(SEEN)
    n = len(nodes.t_s)
    R, p_m = as_the_camera_sees(
        run, nodes.t_s, estimate.state.R[:n, 0], estimate.state.x[:n, 0, POS], run.lever_arm_m
    )
    for error, size in (
        (0, 1e-3),
        (5, 1e-3),
        (9, 1e-3),
        (13, 1e-3),
        (18, 1e-4),
        (20, 1e-4),
        (21, 1e-5),
        (22, 1e-5),
    ):
        value = np.zeros(N_CAMERA_ERRORS)
        value[error] = size
        taken = CameraErrors.of(value)
        changed = run.with_sensor(
            SensorErrors(NOTHING, NOTHING, np.zeros(3), np.zeros((44, 44)), camera=taken)
        )
        again = Filter(build(changed)).smooth(SEEN).state
        R_now, p_now = as_the_camera_sees(
            changed, nodes.t_s, again.R[:n, 0], again.x[:n, 0, POS], run.lever_arm_m
        )
        turn = Rotation.from_matrix(np.swapaxes(R, 1, 2) @ R_now).as_rotvec()
        one = np.zeros((44, 44))
        one[21 + error, 21 + error] = 1.0
        more = (
            with_sensor_doubt(problem, passed, estimate, [one], R_still_camera=[nodes.camera_attitudes(run)])[
                0
            ].covariance
            - estimate.covariance
        )
        # Of the origin: what the arm to the sensor makes of an attitude's error belongs to it.
        across = np.zeros((n, 3, 6))
        across[:, :, 3:] = np.eye(3)
        lever = run.lever_arm_m
        cross = np.array([[0, -lever[2], lever[1]], [lever[2], 0, -lever[0]], [-lever[1], lever[0], 0]])
        across[:, :, :3] = estimate.state.R[:n, 0] @ cross
        of_origin = across @ more[:n, 0, :6, :6] @ np.swapaxes(across, 1, 2)
        # Lengths, for the still axes in which the covariance is told are turned by what is tried.
        for carried, truth in (
            (np.trace(more[:n, 0, :3, :3], axis1=1, axis2=2), (turn / size) ** 2),
            (np.trace(of_origin, axis1=1, axis2=2), ((p_now - p_m) / size) ** 2),
        ):
            sought = np.sqrt(truth.sum(axis=1))
            off = np.sqrt(np.maximum(carried, 0)) - sought
            # Of errors that turn or move next to nothing, next to nothing is asked.
            assert np.sqrt(np.mean(off**2)) < 0.15 * np.sqrt(np.mean(sought**2)) + 2e-3


def test_a_wrong_sensor_at_the_camera_costs_little_once_it_is_known():
    shaken = simulate_two_imus(3, duration_s=6.0, dropouts=((2.0, 2.4), (3.6, 3.9)))
    optical = shaken.shake.optical
    t_ns = np.arange(optical.t_ns[3], optical.t_ns[-3], 10_000_000)
    _, truth_mm = shaken.shake.truth(t_ns)

    def rms_mm(camera, arm_mm, settings):
        track = fuse(
            optical, shaken.brick, lever_arm_mm=LEVER_ARM_MM, output_t_ns=t_ns, camera="imu",
            camera_imu=CameraImu(camera, IMU_TO_CAMERA_MM - arm_mm), settings=settings,
        ).track  # fmt: skip
        return np.sqrt(np.mean(np.sum((track.t_camera_brick_mm - truth_mm) ** 2, axis=1)))

    wrong = with_wrong_camera_sensor(shaken), ARM_MM
    ignored = rms_mm(*wrong, FusionSettings(sensor_gain_sd=0.0, lever_arm_sd_mm=0.0))
    assert (
        rms_mm(*wrong, FusionSettings()) < 0.75 * ignored
    )  # 0.65 to 0.8 by seed; as good as an exact sensor


@pytest.mark.parametrize("kind", ["imu", "table"])
def test_the_poses_in_still_axes_follow_a_change_of_the_sensor(kind):
    shaken = simulate_two_imus(5, duration_s=3.0)
    camera = shaken.camera
    if kind == "table":
        camera = replace(camera, gyro_radps=np.zeros_like(camera.gyro_radps))
    optical = shaken.shake.optical
    item = FusionInput(
        optical, shaken.brick, LEVER_ARM_MM, optical.t_ns, camera=CameraImu(camera, IMU_TO_CAMERA_MM, kind)
    )
    run = prepare_run(item, FusionSettings())
    errors = SensorErrors(
        NOTHING, NOTHING, np.zeros(3), np.zeros((44, 44)), camera=CameraErrors(GYRO, ACC, ARM_MM * 1e-3)
    )
    changed = run.with_sensor(errors)
    R, p_m = as_the_camera_sees(changed, run.aligned_s(), changed.R_seen, changed.p_seen_m, np.zeros(3))
    assert np.allclose(R, optical.R_camera_brick, atol=1e-9)
    assert np.allclose(1e3 * p_m, optical.t_camera_brick_mm, atol=1e-6)
