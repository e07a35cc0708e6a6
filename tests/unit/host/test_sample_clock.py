"""The sensor's own clock, on registers read from the simulated chip, whose clock is known."""

from dataclasses import replace

import numpy as np
import pytest
from daemon_runs import EPOCH_NS, simulate_run

from bricktrack_common.errors import ShapeError
from bricktrack_common.imu_records import ImuFlag
from bricktrack_device.sim.bno055_chip import START_S
from bricktrack_device.sim.imu_signal import chip_period_s
from bricktrack_host.fusion.clocks.sample_clock import SampleClock
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.tracking.optical_track import solve_poses


def found(run):
    return align_times(solve_poses(run.observations, run.camera, run.brick), run.imu)


def true_sample_ns(run):
    """Return when the chip took what each read found; it was switched on two seconds before the epoch."""
    period_ns = chip_period_s(run.world.settings, 1) * 1e9
    first_ns = EPOCH_NS - 2_000_000_000 + round(START_S * 1e9)
    return first_ns + np.floor((run.imu.t_ns - first_ns) / period_ns) * period_ns


@pytest.mark.parametrize(
    ("seed", "clock_ppm", "late_share"),
    [(1, 2000.0, 0.0), (2, -1500.0, 0.0), (3, -2500.0, 0.04), (4, 3000.0, 0.04)],
)
def test_the_chips_clock_is_found_however_late_the_reads(seed, clock_ppm, late_share):
    run = simulate_run(seed, duration_s=10.0, clock_ppm=clock_ppm, late_share=late_share)
    clock = found(run).sample_clock
    assert clock is not None
    # The rate is settled to 2e-4 at least: the skew of the alignment takes up what is left.
    assert clock.period_ns == pytest.approx(1e7 * (1 + clock_ppm * 1e-6), rel=1e-4)
    read = (run.imu.flags & int(ImuFlag.GAP)) == 0
    off_ms = (clock.restamp(run.imu).t_ns - true_sample_ns(run))[read] * 1e-6
    off_ms -= np.median(off_ms)
    # As read, the stamps are off by up to half a period either way. Beside a slip a sample may be taken for
    # the one before: that is a whole period, for a few.
    assert (np.abs(off_ms) < 0.6).mean() > 0.98


def test_the_chips_clock_is_found_within_a_vibration():
    run = simulate_run(5, duration_s=10.0, clock_ppm=6000.0)
    at_s = (true_sample_ns(run) - EPOCH_NS) * 1e-9
    buzz = np.sin(2 * np.pi * 44.5 * at_s)[:, None]
    imu = replace(
        run.imu,
        acc_mps2=run.imu.acc_mps2 + 4.0 * buzz * [0.5, 1.0, -0.7],
        gyro_radps=run.imu.gyro_radps + 0.02 * buzz * [1.0, -0.5, 0.3],
    )
    clock = align_times(solve_poses(run.observations, run.camera, run.brick), imu).sample_clock
    assert clock is not None
    off_ms = (clock.restamp(imu).t_ns - true_sample_ns(run)) * 1e-6
    assert (np.abs(off_ms - np.median(off_ms)) < 0.6).mean() > 0.98


def test_a_blow_is_not_taken_for_a_sample_left_out():
    run = simulate_run(4, duration_s=10.0, clock_ppm=-1100.0)
    optical = solve_poses(run.observations, run.camera, run.brick)
    R = optical.R_camera_brick.copy()
    R[np.random.default_rng(4).random(len(R)) > 0.45] = np.nan  # a starved camera
    acc, gyro = run.imu.acc_mps2.copy(), run.imu.gyro_radps.copy()
    acc[95] += [30.0, -20.0, 10.0]  # 0.35 s before the sample that was left out
    gyro[95] += [1.0, -0.5, 0.5]
    imu = replace(run.imu, acc_mps2=acc, gyro_radps=gyro)
    clock = align_times(replace(optical, R_camera_brick=R), imu).sample_clock
    assert clock is not None
    off_ms = (clock.restamp(imu).t_ns - true_sample_ns(run)) * 1e-6
    # Some 25 in the calm after it, where nothing tells; were the first of several ways taken, 94.
    assert np.count_nonzero(np.abs(off_ms - np.median(off_ms)) > 5.0) < 50


def test_a_clock_that_does_not_beat_is_not_invented():
    run = simulate_run(5, duration_s=8.0, clock_ppm=20.0)
    assert found(run).sample_clock is None


@pytest.mark.parametrize("seed", [7, 9])
def test_stamps_at_a_wrong_rate_are_no_saw_tooth(seed):
    run = simulate_run(seed, duration_s=8.0, clock_ppm=20.0)
    t_ns = run.imu.t_ns
    too_fast = t_ns[0] + np.round((t_ns - t_ns[0]) * 1.001).astype(np.int64)
    alignment = align_times(
        solve_poses(run.observations, run.camera, run.brick), replace(run.imu, t_ns=too_fast)
    )
    assert alignment.sample_clock is None


def test_stamps_are_as_unsure_as_the_numbers_of_the_samples():
    run = simulate_run(6, duration_s=3.0)
    sample_sd = np.linspace(0.0, 0.5, len(run.imu.t_ns))
    clock = SampleClock(0, 1e7, np.arange(len(sample_sd)), 0, sample_sd)
    np.testing.assert_allclose(clock.restamp(run.imu).t_sd_s, 0.01 * sample_sd)


def test_a_clock_serves_only_the_track_it_was_found_for():
    run = simulate_run(6, duration_s=3.0)
    clock = SampleClock(0, 1e7, np.arange(7), 0)
    with pytest.raises(ShapeError, match="7 reads"):
        clock.restamp(run.imu)
