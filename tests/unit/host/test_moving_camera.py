"""Fusion with a camera that moves, against a simulated relative motion that is the same with it at rest."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import EPOCH_NS, LEVER_ARM_MM
from scipy.spatial.transform import Rotation
from two_imus import IMU_TO_CAMERA_MM, simulate_two_imus

from bricktrack_common.errors import ConfigError
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.fusion.inertial.attitude import mean_rate
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu, align_both, closing_bias
from bricktrack_host.tracks import ImuTrack

DROPOUTS = ((2.0, 2.4), (3.6, 3.9))


def outputs(run):
    return np.arange(run.shake.optical.t_ns[3], run.shake.optical.t_ns[-3], 5_000_000)


def fuse_moving(run, *, kind="imu", camera=None):
    return fuse(
        run.shake.optical,
        run.brick,
        lever_arm_mm=LEVER_ARM_MM,
        output_t_ns=outputs(run),
        camera=kind,
        camera_imu=CameraImu(camera or run.camera, IMU_TO_CAMERA_MM, kind),
    )


def squared_mm(run, result):
    _, t_mm = run.shake.truth(result.track.t_ns)
    return ((result.track.t_camera_brick_mm - t_mm) ** 2).sum(axis=1)


def rms(squares):
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def test_a_shaken_and_rocked_camera_costs_less_than_five_percent():
    rest, shaken = [], []
    for seed in (1, 3):
        for squares, acc_g, rocking_deg in ((rest, 0.0, 0.0), (shaken, 0.3, 0.5)):
            run = simulate_two_imus(
                seed, acc_g=acc_g, rocking_deg=rocking_deg, duration_s=5.0, dropouts=DROPOUTS
            )
            squares.append(squared_mm(run, fuse_moving(run)))
    assert rms(shaken) < 1.05 * rms(rest)
    assert rms(rest) < 0.1


def test_twist_clocks_and_covariance_are_those_of_the_relative_motion():
    run = simulate_two_imus(2, rocking_deg=1.0, duration_s=5.0, dropouts=DROPOUTS)
    result = fuse_moving(run)
    track, shake = result.track, run.shake
    R, t_mm = shake.truth(track.t_ns)
    turn = Rotation.from_matrix(np.swapaxes(track.R_camera_brick, 1, 2) @ R).as_rotvec()
    e = np.concatenate([turn, t_mm - track.t_camera_brick_mm], axis=1)
    chi2 = (e * np.linalg.solve(track.covariance, e[..., None])[..., 0]).sum(axis=1)
    assert (chi2 < 12.59).mean() > 0.93  # 95 % of chi-square with 6 degrees of freedom lie below
    i = np.round((track.t_ns - EPOCH_NS) * 1e-9 * 4000).astype(int) - round(shake.t_s[0] * 4000)
    # The camera's own angular rate is some 0.6 rad/s and moves the brick in its view by some 80 mm/s.
    assert np.sqrt(((track.omega_brick_radps - shake.omega_radps[i]) ** 2).sum(axis=1).mean()) < 0.02
    assert np.sqrt(((track.v_camera_mmps - shake.v_mmps[i]) ** 2).sum(axis=1).mean()) < 3.0
    assert result.offset_ns * 1e-6 == pytest.approx(4.0, abs=0.15)
    assert result.acc_lag_ns * 1e-6 == pytest.approx(-3.4, abs=0.2)


def test_a_tables_accelerometers_serve_where_it_only_shifts():
    rest = simulate_two_imus(4, acc_g=0.0, rocking_deg=0.0, duration_s=5.0, dropouts=DROPOUTS)
    run = simulate_two_imus(
        4, rocking_deg=0.0, duration_s=5.0, dropouts=DROPOUTS, acc_lag_s=0.0, camera_offset_s=0.0
    )
    table = replace(run.camera, gyro_radps=np.zeros_like(run.camera.gyro_radps))
    result = fuse_moving(run, kind="table", camera=table)
    assert rms([squared_mm(run, result)]) < 1.1 * rms([squared_mm(rest, fuse_moving(rest))])


def test_a_wrong_offset_to_begin_with_is_mended_in_the_poses_that_do_not_turn_too():
    # By 0.4 ms the camera, which turns by some 0.6 rad/s, was elsewhere by 0.04 mm in its view of the brick.
    run = simulate_two_imus(1, rocking_deg=2.0, duration_s=5.0)
    optical, sensor = run.shake.optical, CameraImu(run.camera, IMU_TO_CAMERA_MM)
    right = align_both(optical, run.brick, sensor)
    brick, camera = (replace(a, offset_ns=a.offset_ns + 4e5) for a in (right.brick, right.camera))

    def error_mm(clocks):
        result = fuse(
            optical, run.brick, lever_arm_mm=LEVER_ARM_MM, output_t_ns=outputs(run), camera="imu",
            camera_imu=sensor, camera_alignment=clocks,
        )  # fmt: skip
        return rms([squared_mm(run, result)])

    assert error_mm(replace(right, brick=brick, camera=camera)) < 1.05 * error_mm(right)


def test_without_the_cameras_sensor_the_same_run_would_be_wrong_and_is_refused():
    run = simulate_two_imus(1, rocking_deg=0.0, duration_s=5.0, dropouts=DROPOUTS)
    arguments = {"lever_arm_mm": LEVER_ARM_MM, "output_t_ns": outputs(run)}
    with pytest.raises(ConfigError, match="not observable"):
        fuse(run.shake.optical, run.brick, camera="imu", **arguments)
    as_static = fuse(run.shake.optical, run.brick, **arguments)
    assert rms([squared_mm(run, as_static)]) > 3 * rms([squared_mm(run, fuse_moving(run))])


def test_contradicting_configurations_are_refused():
    run = simulate_two_imus(1, duration_s=3.0)
    arguments = {"lever_arm_mm": LEVER_ARM_MM, "output_t_ns": outputs(run)}
    sensor = CameraImu(run.camera, IMU_TO_CAMERA_MM)
    with pytest.raises(ConfigError, match="'table'"):
        fuse(run.shake.optical, run.brick, camera="table", camera_imu=sensor, **arguments)
    with pytest.raises(ConfigError, match="'static', 'imu' or 'table'"):
        fuse(run.shake.optical, run.brick, camera="flying", camera_imu=sensor, **arguments)


def test_a_bias_is_the_mean_rate_of_a_body_that_ends_as_it_began():
    run = simulate_two_imus(1, rocking_deg=1.0, duration_s=4.0)
    rest = simulate_two_imus(1, acc_g=0.0, rocking_deg=0.0, duration_s=4.0)
    assert np.allclose(mean_rate(run.camera), mean_rate(rest.camera), atol=1.5e-3)


def test_a_body_that_rocks_about_two_axes_turns_on_the_mean_but_has_no_bias():
    # Rocking by 3 degrees at 5 Hz, a quarter period apart: on the mean it turns about the third axis by half the
    # amplitudes' product times the rate (coning), 0.5 * 0.052**2 * 31.4 = 0.043 rad/s.
    t = np.arange(0, 6.0, 1e-3)
    rest = np.clip(t - 1, 0, 1) * np.clip(5 - t, 0, 1)
    angles = (
        np.radians(3)
        * rest[:, None]
        * np.stack([np.sin(10 * np.pi * t), np.cos(10 * np.pi * t), 0 * t], axis=1)
    )
    body = Rotation.from_rotvec(angles)
    between = (body[:-1].inv() * body[1:]).as_rotvec() / 1e-3
    bias = np.array([0.01, -0.02, 0.005])
    middle = t[:-1] + 5e-4
    at = np.arange(0.05, 5.95, 0.01)
    gyro = np.stack([np.interp(at, middle, column) for column in between.T], axis=1) + bias
    track = ImuTrack(
        t_ns=np.round(at * 1e9).astype(np.int64), acc_mps2=np.zeros((len(at), 3)), gyro_radps=gyro,
        flags=np.zeros(len(at), dtype=np.int64), acc_range_mps2=0.0,
    )  # fmt: skip
    mean = mean_rate(track)
    assert abs(mean[2] - bias[2]) > 0.01
    assert closing_bias(ImuSignal.from_track(track), mean) == pytest.approx(bias, abs=5e-4)
