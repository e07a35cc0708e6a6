"""What the stage of the motion says of a camera's sensor that does not fit (simulated)."""

from dataclasses import replace

import numpy as np
from daemon_runs import simulate_run
from scipy.spatial.transform import Rotation

from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.pose_by_pose.moving_camera import align_both
from bricktrack_host.quality import LedFlag
from bricktrack_host.stages.clocks import Inertial
from bricktrack_host.stages.motion import (
    OutputGrid,
    fuse_run,
    with_rejected_told,
    with_times_doubted,
    words_on_led_offsets,
    words_on_rejected,
)
from bricktrack_host.tracking.optical_track import solve_poses


def test_a_camera_sensor_in_wrong_axes_is_doubted_though_leds_are_followed():
    run = simulate_run(
        13, duration_s=4.0, amplitude_mm=5.0, camera_acc_g=0.3, camera_rocking_deg=1.0, has_camera_imu=True
    )
    optical = solve_poses(run.observations, run.camera, run.brick)
    samples = run.camera_imu.imu
    down = np.median(samples.acc_mps2, axis=0)

    def said(angle_deg):
        # About gravity: both accelerometers agree about that.
        R = Rotation.from_rotvec(np.radians(angle_deg) * down / np.linalg.norm(down)).as_matrix()
        turned = replace(samples, acc_mps2=samples.acc_mps2 @ R.T, gyro_radps=samples.gyro_radps @ R.T)
        sensor, problems = replace(run.camera_imu, imu=turned), []
        both = align_both(optical, run.imu, sensor)
        fuse_run(
            optical, Inertial(run.imu, both.brick, sensor, both), run.brick,
            OutputGrid({"frame": optical.t_ns}, np.empty(0, dtype=np.int64)), problems,
            seen=(run.observations, run.camera),
        )  # fmt: skip
        return " ".join(problems)

    assert "does not fit" not in said(0)
    assert "does not fit" in said(15)


def test_a_centroid_left_out_now_and_then_is_no_point_to_read():
    fused, rejected = np.ones((60, 5), dtype=bool), np.zeros((60, 5), dtype=bool)
    fused[:, 4] = False
    rejected.ravel()[:2] = True
    assert words_on_rejected(rejected, fused) == []  # 2 of 240
    rejected.ravel()[2:4] = True
    assert "4 of 240 LED centroids (1.7 %)" in words_on_rejected(rejected, fused)[0]
    assert words_on_rejected(rejected[:0], fused[:0]) == []


def test_the_table_of_flags_counts_the_centroids_that_the_problems_say_were_left_out():
    run = simulate_run(11, duration_s=4.0, amplitude_mm=5.0)
    optical = solve_poses(run.observations, run.camera, run.brick)
    uv = run.observations.uv_px.copy()
    uv[10:70:4, 2] += 6.0  # glints: LEDs that the poses' start had right
    observations, problems = replace(run.observations, uv_px=uv), []
    *_, rejected = fuse_run(
        optical, Inertial(run.imu, align_times(optical, run.imu)), run.brick,
        OutputGrid({"frame": optical.t_ns}, np.empty(0, dtype=np.int64)), problems,
        seen=(observations, run.camera),
    )  # fmt: skip
    told = with_rejected_told(observations, rejected)
    n = np.count_nonzero(told.led_flags & LedFlag.OUTLIER)
    assert n >= 14 and any(f"{n} of " in words and "left out" in words for words in problems)
    assert ((told.led_flags ^ observations.led_flags) == np.where(rejected, LedFlag.OUTLIER, 0)).all()
    assert with_rejected_told(observations, None) is observations


def test_leds_beside_their_places_are_told_beyond_what_is_usual():
    assert words_on_led_offsets(0.05) == words_on_led_offsets(np.nan) == []
    assert "0.26 px" in words_on_led_offsets(0.264)[0]


def test_centroids_are_as_unsure_as_they_move_in_what_their_frames_are_unsure_by():
    # 600 px/s along u, 3 of 4 LEDs seen, 0.5 ms: 0.3 px, and three times the variance.
    run = simulate_run(3, duration_s=1.0)
    uv = np.zeros((4, 4, 2))
    uv[..., 0] = 100.0 + 20.0 * np.arange(4)[:, None]
    uv[:, 3] = np.nan
    seen = replace(
        run.observations, uv_px=uv, cov_px2=np.tile(0.01 * np.eye(2), (4, 4, 1, 1)),
        sensor_timestamp_ns=np.arange(4) * 33_333_333,
    )  # fmt: skip
    doubted = with_times_doubted(seen, np.full(4, 0.5e6)).cov_px2
    np.testing.assert_allclose(doubted[:, :3], np.tile(np.diag([0.28, 0.01]), (4, 3, 1, 1)), rtol=1e-6)
    # Beside frames that do not show it, an LED moves no less: two LEDs are left in these.
    uv[1:3, 0] = np.nan
    doubted = with_times_doubted(seen, np.full(4, 0.5e6)).cov_px2
    np.testing.assert_allclose(doubted[[0, 3], 0], np.tile(np.diag([0.28, 0.01]), (2, 1, 1)), rtol=1e-6)
    np.testing.assert_allclose(doubted[1:3, 1], np.tile(np.diag([0.19, 0.01]), (2, 1, 1)), rtol=1e-6)
    assert with_times_doubted(seen, np.zeros(4)) is seen
