"""Alignment of camera and IMU clocks, on simulated shakes with known offsets and on real recordings."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from brick_shakes import simulate_shake
from broad_windows import make_case

from bricktrack_common.errors import ConfigError, TrackingError
from bricktrack_host.fusion.clocks.sample_clock import SampleClock
from bricktrack_host.fusion.clocks.time_alignment import align_times

pytestmark = pytest.mark.filterwarnings("error")


@pytest.mark.parametrize(("seed", "offset_s", "skew"), [(1, 0.0, 0.0), (2, -0.197, 4e-5), (3, 0.183, -5e-5)])
def test_offset_is_found_anywhere_within_reach(seed, offset_s, skew):
    s = simulate_shake(seed, offset_s=offset_s, skew=skew, dropouts=((3.0, 3.4),))
    a = align_times(s.optical, s.imu, prior_sd_ns=0.2e9)
    assert a.source == "data" and a.is_trusted and not a.disagrees_with_stamps
    # 200 frames of 0.1 deg at about 1 rad/s: 1.7 mrad / sqrt(400) = 0.09 ms; four of these.
    assert a.offset_ns * 1e-9 == pytest.approx(offset_s, abs=0.35e-3)
    assert abs(a.offset_ns * 1e-9 - offset_s) < 4 * a.offset_sd_ns * 1e-9
    assert a.offset_sd_ns < 0.2e6
    assert abs(a.skew - skew) < 4 * a.skew_sd
    assert np.allclose(a.gyro_bias_radps, [0.008, -0.005, 0.011], atol=1e-3)
    assert a.correlation > 0.9
    assert a.rotation_residual_sd == pytest.approx(1.0, abs=0.2)


def test_imu_time_follows_the_stated_convention():
    s = simulate_shake(4, offset_s=0.05)
    a = replace(align_times(s.optical, s.imu), offset_ns=5e7, skew=1e-4)
    t = a.t_mid_ns + np.array([0, 2_000_000_000])
    assert (a.imu_time_ns(t) - t).tolist() == [50_000_000, 50_200_000]


def test_samples_stand_on_the_cameras_time_when_they_were_taken():
    s = simulate_shake(4, offset_s=0.05)
    a = replace(align_times(s.optical, s.imu), offset_ns=5e7, skew=1e-4, sample_clock=None)
    assert np.abs(a.imu_time_ns(a.camera_time_ns(s.imu.t_ns)) - s.imu.t_ns).max() <= 1
    # Reads that find each sample 4 ms after it was taken.
    n = len(s.imu.t_ns)
    clock = SampleClock(int(s.imu.t_ns[0]) - 4_000_000, 1e7, np.arange(n), 0)
    taken = replace(a, sample_clock=clock).sampled_ns(s.imu)
    assert np.abs(a.imu_time_ns(taken) - (s.imu.t_ns[0] - 4_000_000 + 10_000_000 * np.arange(n))).max() <= 1


def test_errors_of_many_runs_are_what_the_sd_says():
    z = []
    for seed in range(10):
        s = simulate_shake(100 + seed, offset_s=0.01, duration_s=4.0, rotation_deg=2.0)
        a = align_times(s.optical, s.imu)
        z.append((a.offset_ns * 1e-9 - 0.01) / (a.offset_sd_ns * 1e-9))
    assert (
        0.4 < np.sqrt(np.mean(np.square(z))) < 1.6
    )  # chi-square with 10 degrees of freedom, 99.9 %: 0.38-1.72


@pytest.mark.parametrize("seed", [201, 203, 205])
def test_offset_is_the_delay_of_slow_motion_however_the_low_pass_bends_it(seed):
    # Second-order Butterworth at 23 Hz: motion of 8 Hz comes 0.2 ms later than its mean delay, taken out here.
    s = simulate_shake(seed, offset_s=0.01, lowpass_hz=23.0, rotation_sd_deg=0.015)
    a = align_times(s.optical, s.imu)
    assert abs(a.offset_ns * 1e-9 - 0.01) < 4 * a.offset_sd_ns * 1e-9
    assert a.offset_sd_ns < 0.07e6


def test_without_rotation_the_stamps_stand_and_no_offset_is_invented():
    s = simulate_shake(5, offset_s=0.02, rotation_deg=0.0)
    a = align_times(s.optical, s.imu, prior_sd_ns=3e6)
    assert (a.offset_ns, a.offset_sd_ns, a.skew, a.source) == (0.0, 3e6, 0.0, "stamps")
    assert not a.is_trusted
    assert a.reason


def test_brick_at_rest_gives_the_stamps_too():
    s = simulate_shake(6, rotation_deg=0.0, amplitude_mm=0.0)
    assert align_times(s.optical, s.imu).source == "stamps"


def test_stamps_that_the_motion_contradicts_are_reported():
    s = simulate_shake(7, offset_s=0.06)
    a = align_times(s.optical, s.imu, prior_sd_ns=2e6)
    assert a.disagrees_with_stamps
    assert a.offset_ns == pytest.approx(60e6, abs=0.5e6)
    assert "60." in a.reason or "59." in a.reason


@pytest.mark.parametrize("offset_s", [0.002, 0.1])
def test_a_sine_is_aligned_rightly_or_not_at_all(offset_s):
    s = simulate_shake(8, offset_s=offset_s, periodic_hz=6.0, duration_s=6.0)
    a = align_times(s.optical, s.imu, prior_sd_ns=3e6)
    right = abs(a.offset_ns * 1e-9 - offset_s) < 0.5e-3
    assert right if a.is_trusted else a.offset_ns == 0.0


def test_wrong_axes_are_not_believed():
    s = simulate_shake(9)
    turned = replace(s.imu, gyro_radps=s.imu.gyro_radps[:, [1, 2, 0]])
    a = align_times(s.optical, turned)
    assert a.source == "stamps"
    assert "axes" in a.reason


def test_what_turns_while_no_sample_is_there_is_no_bias_of_the_gyro():
    shake = simulate_shake(10, duration_s=4.0, imu_gaps=((1.9, 2.3),))
    found = align_times(shake.optical, shake.imu)
    # Attitudes of 0.1 degrees, 45 frames in 1.4 s on either side, tell a rate to 0.0005 rad/s: four of these.
    assert found.gyro_bias_radps == pytest.approx([0.008, -0.005, 0.011], abs=0.002)


def test_a_bias_that_turns_the_integrated_gyro_over_and_over_does_not_matter():
    # 3.1 deg/s over 130 s is once round: attitudes by the gyro alone are anywhere in between.
    shake = simulate_shake(3, offset_s=0.012, skew=2e-5, duration_s=130.0)
    far = np.array([0.046, -0.024, 0.016])
    bias = far + np.array([0.008, -0.005, 0.011])
    found = align_times(shake.optical, replace(shake.imu, gyro_radps=shake.imu.gyro_radps + far))
    assert abs(found.offset_ns - 12e6) < 4 * found.offset_sd_ns < 0.12e6
    assert abs(found.skew - 2e-5) < 4 * found.skew_sd
    assert found.gyro_bias_radps == pytest.approx(bias, abs=1e-4)


def test_gaps_on_both_sides_do_not_matter():
    s = simulate_shake(
        10, offset_s=-0.03, dropouts=((1.5, 2.0), (5.0, 5.4)), imu_gaps=((3.0, 3.06), (4.2, 4.6))
    )
    a = align_times(s.optical, s.imu)
    assert a.is_trusted
    assert a.offset_ns == pytest.approx(-30e6, abs=0.45e6)


def test_few_poses_fall_back_and_none_is_an_error():
    s = simulate_shake(11, dropouts=((0.3, 99.0),))
    assert align_times(s.optical, s.imu).source == "stamps"
    blind = simulate_shake(11, dropouts=((-1.0, 99.0),))
    with pytest.raises(TrackingError, match="none of"):
        align_times(blind.optical, blind.imu)
    with pytest.raises(ConfigError, match="prior_sd_ns is 0"):
        align_times(s.optical, s.imu, prior_sd_ns=0.0)


@pytest.mark.skipif(
    "BRICKTRACK_SAMPLES" not in os.environ,
    reason="BRICKTRACK_SAMPLES is not set: the recordings are not part of the repository",
)
def test_real_recordings_are_aligned_to_the_optics():
    folder = Path(os.environ["BRICKTRACK_SAMPLES"]) / "fusion"
    errors_s = []
    for path in sorted(folder.glob("*.npz")):
        case = make_case(path, seed=11)
        a = align_times(case.optical, case.imu, prior_sd_ns=0.2e9)
        assert a.is_trusted
        errors_s.append(a.offset_ns * 1e-9 - case.offset_s)
    assert len(errors_s) == 6
    assert np.sqrt(np.mean(np.square(errors_s))) < 0.3e-3  # 0.18 ms rms was reached before; six draws
