"""Poses solved again by the fused motion, and where the inertial samples are missing."""

from dataclasses import replace

import numpy as np
from daemon_runs import simulate_run

from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.stages.clocks import Inertial
from bricktrack_host.stages.motion import retime
from bricktrack_host.tracking.optical_track import solve_poses, start_poses


def test_in_a_gap_of_the_samples_the_poses_stay_as_good_as_without_them():
    run = simulate_run(3, duration_s=5.0, amplitude_mm=6.0, amplitude_deg=3.0, impact_mps=0.0)
    first = start_poses(run.observations, run.camera, run.brick)
    optical = solve_poses(run.observations, run.camera, run.brick, first=first)
    alignment = align_times(optical, run.imu)
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
