"""Both sensors' clocks found at once, where one rocks with the camera and the other feels that too (simulated)."""

from dataclasses import replace

import numpy as np
import pytest
from two_imus import simulate_two_imus

from bricktrack_host.fusion.clocks.joint_alignment import align_jointly
from bricktrack_host.fusion.clocks.time_alignment import TimeAlignment
from bricktrack_host.fusion.inertial.attitude import mean_rate

BRICK_MS, CAMERA_MS = 4.0, 6.5


@pytest.fixture(scope="module")
def run():
    return simulate_two_imus(
        3, rocking_deg=2.0, duration_s=5.0, brick_offset_s=BRICK_MS * 1e-3, camera_offset_s=CAMERA_MS * 1e-3
    )


def roughly(run, imu, offset_ms):
    t_ns = run.shake.optical.t_ns
    return TimeAlignment(
        offset_ns=offset_ms * 1e6, offset_sd_ns=1e6, skew=0.0, skew_sd=1e-4,
        t_mid_ns=int(t_ns[0] + t_ns[-1]) // 2, gyro_bias_radps=mean_rate(imu),
        gyro_bias_sd_radps=np.full(3, 0.01), correlation=0.9, rotation_residual_sd=1.0, source="data",
        is_trusted=True, disagrees_with_stamps=False, reason="",
    )  # fmt: skip


def align(run, brick_ms, camera_ms, optical=None):
    return align_jointly(
        optical or run.shake.optical, run.brick, roughly(run, run.brick, brick_ms), run.camera,
        roughly(run, run.camera, camera_ms), camera_bias_radps=mean_rate(run.camera),
    )  # fmt: skip


@pytest.mark.parametrize("off_ms", [(-3.0, 3.0), (2.5, 2.5)])
def test_offsets_that_begin_milliseconds_off_end_where_they_are(run, off_ms):
    brick, camera = align(run, BRICK_MS + off_ms[0], CAMERA_MS + off_ms[1])
    for found, true_ms in ((brick, BRICK_MS), (camera, CAMERA_MS)):
        assert found.offset_ns * 1e-6 == pytest.approx(true_ms, abs=4 * found.offset_sd_ns * 1e-6)
        assert found.offset_sd_ns * 1e-6 < 0.15
    assert 0.8 < brick.rotation_residual_sd < 1.25  # the optical noise is as stated


def test_poses_thrown_far_off_do_not_draw_the_clocks(run):
    R = run.shake.optical.R_camera_brick.copy()
    R[::9] = R[::9] @ np.diag([1.0, -1.0, -1.0])
    brick, camera = align(run, BRICK_MS, CAMERA_MS, optical=replace(run.shake.optical, R_camera_brick=R))
    clean_brick, clean_camera = align(run, BRICK_MS, CAMERA_MS)
    # A ninth of the frames less, and no more: a sd.
    assert abs(brick.offset_ns - clean_brick.offset_ns) < clean_brick.offset_sd_ns
    assert abs(camera.offset_ns - clean_camera.offset_ns) < clean_camera.offset_sd_ns


@pytest.mark.parametrize("seed", [3, 6])
def test_offsets_are_as_unsure_as_orders_left_out_make_them(seed):
    # A narrow low-pass, seen by sharp poses: what it does in orders above the third is 0.15 ms, and was 5 sd.
    run = simulate_two_imus(
        seed, duration_s=5.0, brick_offset_s=BRICK_MS * 1e-3, camera_offset_s=CAMERA_MS * 1e-3,
        lowpass_hz=15.0, rotation_sd_deg=0.015,
    )  # fmt: skip
    for found, true_ms in zip(align(run, BRICK_MS, CAMERA_MS), (BRICK_MS, CAMERA_MS), strict=True):
        assert found.offset_ns * 1e-6 == pytest.approx(true_ms, abs=3 * found.offset_sd_ns * 1e-6)
        assert found.offset_sd_ns * 1e-6 < 0.15
