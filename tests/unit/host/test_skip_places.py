"""Samples left out are put where the attitudes say; simulated shakes."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import simulate_shake

from bricktrack_host.fusion.clocks.rotation_fit import RotationFit
from bricktrack_host.fusion.clocks.skip_places import skips_by_attitudes
from bricktrack_host.fusion.clocks.time_alignment import has_pose, posed_frames
from bricktrack_host.fusion.inertial.imu_samples import seconds_since
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal

LEFT_OUT = 200
PERIOD_NS = 10_000_000


def placed(shake, believed, age_ms):
    """Return numbers by the attitudes where they are believed at first, and those in truth."""
    true = np.delete(np.arange(len(shake.imu.t_ns)), LEFT_OUT)
    imu = shake.imu
    imu = replace(
        imu,
        t_ns=imu.t_ns[0] + believed(true) * PERIOD_NS,
        gyro_radps=imu.gyro_radps[true],
        acc_mps2=imu.acc_mps2[true],
        flags=imu.flags[true],
    )
    signal = ImuSignal.from_track(imu)
    frames = posed_frames(
        shake.optical, has_pose(shake.optical), seconds_since(shake.optical.t_ns, signal.epoch_ns)
    )
    fit = RotationFit(frames, signal, skew_prior_sd=1e-4).solve(0.0)
    age_s = 1e-3 * age_ms + (true - believed(true)) * PERIOD_NS * 1e-9
    sample_s = seconds_since(imu.t_ns, signal.epoch_ns)
    return skips_by_attitudes(believed(true), age_s, frames, signal, sample_s, fit), true


def later(true):
    return np.where((true > LEFT_OUT) & (true <= LEFT_OUT + 7), true - 1, true)


def earlier(true):
    return np.where((true < LEFT_OUT) & (true >= LEFT_OUT - 7), true + 1, true)


@pytest.mark.parametrize(("believed", "age_ms"), [(later, 0.1), (earlier, 9.9)])
def test_a_sample_left_out_is_put_where_the_attitudes_jump(believed, age_ms):
    shake = simulate_shake(3, duration_s=4.0, rotation_sd_deg=0.02)
    found, true = placed(shake, believed, age_ms)
    assert np.count_nonzero(believed(true) != true) == 7
    assert np.count_nonzero(found != true) <= 1


@pytest.mark.parametrize("rotation_deg", [0.0, 3.0])
def test_nothing_moves_that_the_motion_does_not_tell_or_the_reads_forbid(rotation_deg):
    shake = simulate_shake(3, duration_s=4.0, rotation_deg=rotation_deg, rotation_sd_deg=0.02)
    found, true = placed(shake, later, age_ms=0.1 if rotation_deg == 0 else -5.0)
    np.testing.assert_array_equal(found, later(true))


def test_a_right_place_stays():
    shake = simulate_shake(4, duration_s=4.0, rotation_sd_deg=0.02)
    found, true = placed(shake, lambda number: number, age_ms=0.1)
    np.testing.assert_array_equal(found, true)
