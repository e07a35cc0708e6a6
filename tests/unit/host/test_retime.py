"""Poses solved again by the fused motion, and where the inertial samples are missing."""

from dataclasses import replace

import numpy as np
import pytest
from daemon_runs import simulate_run

from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.stages import motion
from bricktrack_host.stages.clocks import Inertial
from bricktrack_host.stages.motion import retime
from bricktrack_host.tracking.optical_track import solve_poses, start_poses


@pytest.fixture(scope="module")
def solved():
    """A recording, what its poses start from, and the poses without the inertial samples' help."""
    run = simulate_run(3, duration_s=5.0, amplitude_mm=6.0, amplitude_deg=3.0, impact_mps=0.0)
    first = start_poses(run.observations, run.camera, run.brick)
    optical = solve_poses(run.observations, run.camera, run.brick, first=first)
    return run, first, optical, align_times(optical, run.imu)


def test_where_the_fused_motion_is_lost_the_poses_stay(solved, monkeypatch):
    # Of poses that say nothing the motion is soon too unsure to be given: 1 mm serves as well as 50, sooner.
    monkeypatch.setattr(motion, "_WITHIN_FRAMES", replace(motion._WITHIN_FRAMES, max_position_sd_mm=1.0))
    run, first, optical, alignment = solved
    since_s = (optical.t_ns - optical.t_ns[0]) * 1e-9
    unsure = (since_s > 1.0) & (since_s < 4.5)
    doubted = replace(
        optical, covariance=np.where(unsure[:, None, None], 1e12 * optical.covariance, optical.covariance)
    )
    again = retime(run.observations, first, doubted, Inertial(run.imu, alignment), run.camera, run.brick)
    assert np.isfinite(again.t_camera_brick_mm).all()
    off_mm = np.linalg.norm(again.t_camera_brick_mm - run.truth(optical.t_ns)[1], axis=1)
    before_mm = np.linalg.norm(optical.t_camera_brick_mm - run.truth(optical.t_ns)[1], axis=1)
    assert np.median(off_mm[unsure]) < 1.2 * np.median(before_mm[unsure])


def test_in_a_gap_of_the_samples_the_poses_stay_as_good_as_without_them(solved):
    run, first, optical, alignment = solved
    since_s = (run.imu.t_ns - run.imu.t_ns[0]) * 1e-9
    lost = (since_s > 2.2) & (since_s < 3.0)
    acc, gyro = run.imu.acc_mps2.copy(), run.imu.gyro_radps.copy()
    acc[lost], gyro[lost] = np.nan, np.nan
    gappy = replace(run.imu, acc_mps2=acc, gyro_radps=gyro)
    again = retime(
        run.observations, first, optical, Inertial(gappy, alignment), run.camera, run.brick
    )  # fmt: skip
    imu_ns = alignment.imu_time_ns(optical.t_ns)
    inside = (imu_ns > run.imu.t_ns[lost][0]) & (imu_ns < run.imu.t_ns[lost][-1])
    _, true_mm = run.truth(optical.t_ns)

    def rms_mm(track, frames):
        off_mm = track.t_camera_brick_mm[frames] - true_mm[frames]
        return np.sqrt(np.nanmean((off_mm**2).sum(axis=1)))

    assert inside.sum() > 15
    # Splines in both, to frames beside the gap that moved a little.
    assert rms_mm(again, inside) < 1.05 * rms_mm(optical, inside)
    assert rms_mm(again, ~inside) < rms_mm(optical, ~inside)
