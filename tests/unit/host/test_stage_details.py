"""What the results say of the fusion's checks: chip's own attitude, and LED by LED against pose by pose."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import LEVER_ARM_MM, simulate_shake
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.cross_check import cross_check
from bricktrack_host.fusion.estimate import fuse
from bricktrack_host.stages.clocks import ChipOrientation, Inertial
from bricktrack_host.stages.details import alignment_details


@pytest.fixture(scope="module")
def shake():
    return simulate_shake(6, duration_s=4.0)


@pytest.fixture(scope="module")
def fused(shake):
    alignment = align_times(shake.optical, shake.imu)
    t_ns = shake.optical.t_ns[5:-5]
    return alignment, fuse(
        shake.optical, shake.imu, lever_arm_mm=LEVER_ARM_MM, output_t_ns=t_ns, alignment=alignment
    )


def chip_of(shake, tilt_deg):
    """Return the quaternions of a chip that is turned by so much against where the layout has it."""
    up = -shake.gravity_mps2 / np.linalg.norm(shake.gravity_mps2)
    x = np.cross([0.3, -0.5, 0.8], up)
    x /= np.linalg.norm(x)
    R_gravity_camera = np.stack([x, np.cross(up, x), up])
    tilt = Rotation.from_rotvec([np.radians(tilt_deg), 0, 0]).as_matrix()
    R, _ = shake.truth(shake.imu.t_ns)
    q = Rotation.from_matrix(R_gravity_camera @ R @ tilt).as_quat()[:, [3, 0, 1, 2]]
    return ChipOrientation(shake.imu.t_ns, q, np.eye(3))


def test_a_chip_that_sits_otherwise_than_the_layout_says_shows(shake, fused):
    alignment, fusion = fused
    found = {
        tilt: alignment_details(
            Inertial(shake.imu, alignment, chip=chip_of(shake, tilt)), fusion, shake.optical
        )["chip_gravity_off_deg"]
        for tilt in (0.0, 8.0)
    }
    assert found[0.0] < 1.0  # 0.1 deg of each frame's noise, and 10 ms at some deg/s
    assert found[8.0] > 4.0


def test_without_a_fusion_mode_nothing_is_said_of_the_chip(shake, fused):
    alignment, fusion = fused
    details = alignment_details(Inertial(shake.imu, alignment), fusion, shake.optical)
    assert not any(name.startswith("chip") for name in details)


def test_two_motions_that_lie_apart_by_more_than_they_may_are_told(fused):
    track = fused[1].track
    away = replace(track, t_camera_brick_mm=track.t_camera_brick_mm + np.array([0.0, 0.5, 0.0]))
    near = cross_check(track, track)
    far = cross_check(away, track)
    assert near.agrees and near.rms_mm == 0.0
    assert not far.agrees and far.rms_mm == pytest.approx(0.5)
    nowhere = cross_check(replace(track, t_camera_brick_mm=track.t_camera_brick_mm * np.nan), track)
    assert not nowhere.agrees and np.isnan(nowhere.rms_mm)
