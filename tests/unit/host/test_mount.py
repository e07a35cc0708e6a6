"""The mount of the IMU refined from simulated shakes with a known one, and checked against the chip's quaternion."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import LEVER_ARM_MM, simulate_shake
from scipy.spatial.transform import Rotation

from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.mount import check_chip_orientation, refine_mount


def turned(imu, rvec):
    """Return the samples of a sensor whose axes are turned against what the layout says."""
    R = Rotation.from_rotvec(rvec).as_matrix()
    return replace(imu, acc_mps2=imu.acc_mps2 @ R, gyro_radps=imu.gyro_radps @ R)


def test_axes_and_place_are_found_within_their_uncertainty():
    s = simulate_shake(3, duration_s=6.0)
    rvec = np.radians([0.8, -1.2, 0.5])
    mount = refine_mount(s.optical, turned(s.imu, rvec), lever_arm_mm=LEVER_ARM_MM)
    assert mount.rvec_is_told.all()
    assert (np.abs(mount.rvec_layout_rad - rvec) < 4 * mount.rvec_sd_rad).all()
    assert np.degrees(mount.rvec_sd_rad).max() < 0.3
    for wrong_mm in ([3.0, -4.0, 2.0], [-8.0, 6.0, 9.0]):  # so far away the likelihood curves the other way
        mount = refine_mount(s.optical, s.imu, lever_arm_mm=LEVER_ARM_MM + wrong_mm)
        assert mount.lever_arm_is_told.all()
        assert (np.abs(mount.lever_arm_mm - LEVER_ARM_MM) < 4 * mount.lever_arm_sd_mm + 0.1).all()
    assert mount.gravity_mps2 == pytest.approx(9.8, abs=0.35)  # the biases are up to 0.2 an axis
    assert mount.gravity_off_deg < 2.5


def test_what_the_motion_does_not_turn_is_not_told():
    s = simulate_shake(4, duration_s=6.0, rotation_deg=0.35)
    mount = refine_mount(s.optical, s.imu, lever_arm_mm=LEVER_ARM_MM)
    assert not mount.lever_arm_is_told.any()
    still = simulate_shake(4, duration_s=4.0, rotation_deg=0.0)
    with pytest.raises(TrackingError, match="cannot be refined"):
        refine_mount(still.optical, still.imu, lever_arm_mm=LEVER_ARM_MM)


def test_the_chips_quaternion_is_compared_with_the_camera():
    s = simulate_shake(6, duration_s=4.0)
    alignment = align_times(s.optical, s.imu)
    up = -s.gravity_mps2 / np.linalg.norm(s.gravity_mps2)
    x = np.cross([0.3, -0.5, 0.8], up)
    x /= np.linalg.norm(x)
    R_gravity_camera = np.stack([x, np.cross(up, x), up])
    R_brick_imu = Rotation.from_rotvec([0.2, 1.0, -0.4]).as_matrix()
    R, _ = s.truth(s.imu.t_ns)
    q = Rotation.from_matrix(R_gravity_camera @ R @ R_brick_imu).as_quat()[:, [3, 0, 1, 2]]
    arguments = {
        "R_brick_imu": R_brick_imu, "alignment": alignment, "gravity_camera_mps2": s.gravity_mps2,
    }  # fmt: skip
    check = check_chip_orientation(s.optical, s.imu.t_ns, q, **arguments)
    # Noise of 0.1 deg an axis in the first frame and in each; samples are up to 10 ms late: 1 deg at 2 rad/s.
    assert check.rms_deg < 1.0 and check.gravity_deg < 0.5
    askew = check_chip_orientation(
        s.optical,
        s.imu.t_ns,
        q,
        **(arguments | {"R_brick_imu": R_brick_imu @ Rotation.from_rotvec([0.1, 0, 0]).as_matrix()}),
    )
    assert askew.gravity_deg > 3.0
    with pytest.raises(TrackingError, match="fusion mode"):
        check_chip_orientation(s.optical, s.imu.t_ns, q * np.nan, **arguments)
