"""Sensors of a moving camera and of the brick, of which one is entered in wrong axes (simulated)."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import GRAVITY_MPS2, LEVER_ARM_MM
from scipy.spatial.transform import Rotation
from two_imus import IMU_TO_CAMERA_MM, simulate_two_imus

from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.estimate import FusionInput, fuse, prepare_run
from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.pose_by_pose.moving_camera import CameraImu
from bricktrack_host.fusion.sensor_agreement import doubt_about_camera_sensor


@pytest.fixture(scope="module")
def shaken():
    return simulate_two_imus(1, rocking_deg=0.5, duration_s=3.0)


def prepared(shaken, camera, *, kind="imu"):
    optical = shaken.shake.optical
    sensor = CameraImu(camera, IMU_TO_CAMERA_MM, kind)
    return prepare_run(
        FusionInput(optical, shaken.brick, LEVER_ARM_MM, optical.t_ns, camera=sensor), FusionSettings()
    )


def turned(imu, axis, angle_deg):
    R = Rotation.from_rotvec(np.radians(angle_deg) * axis).as_matrix()
    return replace(imu, acc_mps2=imu.acc_mps2 @ R.T, gyro_radps=imu.gyro_radps @ R.T)


def along_gravity(imu):
    down = np.median(imu.acc_mps2, axis=0)
    return down / np.linalg.norm(down)


def across_gravity(imu):
    down = np.median(imu.acc_mps2, axis=0)
    axis = np.cross(down, [1.0, 0.0, 0.0])
    return axis / np.linalg.norm(axis)


def test_a_sensor_entered_a_quarter_turned_is_refused_with_the_rows_to_check(shaken):
    # A vector of 1 g turned by 90 degrees lies 1.41 g from where it was: 13.9 m/s^2.
    with pytest.raises(TrackingError, match=r"differ by 1[345]\.. m/s².*`rotation` in \[unit.camera_imu\]"):
        prepared(shaken, turned(shaken.camera, across_gravity(shaken.camera), 90))


def test_a_turn_about_gravity_leaves_neither_sensor_believed():
    shaken = simulate_two_imus(1, rocking_deg=1.0, duration_s=5.0)
    optical = shaken.shake.optical

    def doubt(camera):
        result = fuse(
            optical, shaken.brick, lever_arm_mm=LEVER_ARM_MM, output_t_ns=optical.t_ns, camera="imu",
            camera_imu=CameraImu(camera, IMU_TO_CAMERA_MM),
        )  # fmt: skip
        return doubt_about_camera_sensor(result.gyro_noise, result.acc_noise)

    assert doubt(shaken.camera) is None
    assert "does not fit" in doubt(turned(shaken.camera, along_gravity(shaken.camera), 90))


def test_a_sensor_a_few_degrees_off_is_taken(shaken):
    assert prepared(shaken, turned(shaken.camera, across_gravity(shaken.camera), 5)).camera is not None


def test_channels_of_a_table_may_be_zeroed_but_not_upside_down(shaken):
    shifted = simulate_two_imus(1, rocking_deg=0.0, duration_s=3.0, camera_offset_s=0.0)
    table = replace(shifted.camera, gyro_radps=np.zeros_like(shifted.camera.gyro_radps))
    zeroed = replace(table, acc_mps2=table.acc_mps2 - np.median(table.acc_mps2, axis=0))
    assert prepared(shifted, table, kind="table").camera is not None
    assert prepared(shifted, zeroed, kind="table").camera is not None
    with pytest.raises(TrackingError, match=rf"about {GRAVITY_MPS2:.1f} if it was zeroed.*camera_table"):
        prepared(shifted, replace(table, acc_mps2=-table.acc_mps2), kind="table")
