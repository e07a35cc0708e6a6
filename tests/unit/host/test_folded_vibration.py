"""Vibrations folded down by the clocks of a sensor, found beside the camera: simulated, so the truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from brick_shakes import EPOCH_NS, LEVER_ARM_MM, simulate_shake
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter, sosfiltfilt

from bricktrack_common.errors import TrackingError
from bricktrack_host.fusion.clocks.time_alignment import align_times
from bricktrack_host.fusion.inertial.imu_samples import clean_samples
from bricktrack_host.fusion.inertial.vibration_phase import low_pass, phase_jumps, vibration_phase
from bricktrack_host.fusion.pose_by_pose.camera_accelerations import CameraAccelerations
from bricktrack_host.fusion.pose_by_pose.folded_vibration import samples_beside_camera

ARM_M = LEVER_ARM_MM * 1e-3
READ_HZ = 2000 / 7


def chip_vibration(t_s, *, tone_hz, chip_hz, mps2=2.5):
    """Return what a sensor feels of a motor: it measures at ``chip_hz``, is read at 285.7 Hz, then smoothed.

    Each read finds the chip's latest sample. A low-pass of 40 Hz and samples at 100 Hz follow.
    """
    read = np.arange(t_s[0] - 1.0, t_s[-1] + 0.1, 1 / READ_HZ)
    measured = np.floor(read * chip_hz) / chip_hz
    turns = tone_hz * measured + 0.15 / (2 * np.pi * 0.2) * np.sin(2 * np.pi * 0.2 * measured)
    axes = mps2 * np.array([1.0, -0.7, 0.4]), np.array([0.3, 1.4, 2.0])
    felt = axes[0] * np.cos(2 * np.pi * turns[:, None] + axes[1])
    b, a = butter(2, 40.0, fs=READ_HZ)
    smooth = lfilter(b, a, felt, axis=0)
    impulse = lfilter(b, a, np.r_[1.0, np.zeros(300)])
    delay_s = float((np.arange(301) * impulse).sum() / impulse.sum() / READ_HZ)
    return CubicSpline(read - delay_s, smooth)(t_s)


def slow_rms(acc_mps2):
    """Return the rms between 1 and 10 Hz, where bricks move; away from the ends."""
    sos = butter(3, (1.0, 10.0), btype="band", fs=100.0, output="sos")
    return float(np.sqrt(np.mean(sosfiltfilt(sos, acc_mps2, axis=0)[100:-100] ** 2)))


def shaken(seed, **vibration):
    """Return a run of 12 s whose sensor also vibrates, its clocks as found, and what is false in its samples."""
    run = simulate_shake(seed, duration_s=12.0, dropouts=((3.0, 3.4), (7.2, 7.6)))
    false = chip_vibration((run.imu.t_ns - EPOCH_NS) * 1e-9, **vibration)
    imu = replace(run.imu, acc_mps2=run.imu.acc_mps2 + false)
    return run, imu, align_times(run.optical, imu), false


# Phases that jump every 0.36, 0.29 and 1.1 s, and a copy near to 3 Hz.
@pytest.mark.parametrize(
    ("tone_hz", "chip_hz"), [(330.5, 998.63), (327.8, 998.27), (331.8, 1000.45), (244.0, 1125.4)], ids=str
)
def test_what_a_vibration_leaves_among_the_motions_is_taken_out(tone_hz, chip_hz):
    run, imu, alignment, false = shaken(1, tone_hz=tone_hz, chip_hz=chip_hz)
    done = samples_beside_camera(run.optical, imu, alignment, ARM_M)
    # 0.1 mm of the camera over 12 s tells a line of 3 Hz to 0.003 m/s^2; at 8 Hz, where part of what jumps
    # leave lies, it tells a tenth of that.
    assert slow_rms(done.acc_mps2 - run.imu.acc_mps2) < 0.65 * slow_rms(false)


def test_nothing_changes_without_a_vibration():
    run = simulate_shake(2, duration_s=8.0)
    done = samples_beside_camera(run.optical, run.imu, align_times(run.optical, run.imu), ARM_M)
    assert (done.acc_mps2 == clean_samples(run.imu).acc_mps2).all()


@pytest.mark.parametrize("seed", [3, 4])
def test_a_vibration_that_leaves_nothing_slow_stays(seed):
    # 37 Hz as it is, neither folded nor jumping: once integrated nothing of it is left.
    run = simulate_shake(seed, duration_s=10.0)
    t_s = (run.imu.t_ns - EPOCH_NS) * 1e-9
    buzz = 3.0 * np.sin(2 * np.pi * 37.0 * t_s)[:, None] * [0.5, 1.0, -0.7]
    imu = replace(run.imu, acc_mps2=run.imu.acc_mps2 + buzz)
    done = samples_beside_camera(run.optical, imu, align_times(run.optical, imu), ARM_M)
    assert (done.acc_mps2 == imu.acc_mps2).all()


def test_the_camera_says_where_jumps_are_no_lost_samples():
    # Jumps every 1.1 s each stand out so far that they look like samples lost.
    run, imu, alignment, _ = shaken(2, tone_hz=331.8, chip_hz=1000.45)
    mended = clean_samples(imu)
    assert (mended.filled_sd_mps2 > 0).any()
    done = samples_beside_camera(run.optical, imu, alignment, ARM_M)
    off = slow_rms(done.acc_mps2 - run.imu.acc_mps2)
    assert not done.filled_sd_mps2.any() and off < 0.3 * slow_rms(mended.acc_mps2 - run.imu.acc_mps2)


def test_the_camera_says_where_samples_were_lost():
    run = simulate_shake(6, duration_s=10.0)
    t_s = (run.imu.t_ns - EPOCH_NS) * 1e-9
    buzz = 4.0 * np.sin(2 * np.pi * 44.5 * t_s)[:, None] * [0.5, 1.0, -0.7]
    acc = run.imu.acc_mps2 + buzz
    lost = np.arange(120, 960, 105)
    acc[lost], acc[lost + 1] = acc[lost - 1], acc[lost - 1]
    imu = replace(run.imu, acc_mps2=acc)
    done = samples_beside_camera(run.optical, imu, align_times(run.optical, imu), ARM_M)
    assert (done.filled_sd_mps2[lost] > 0).all()
    assert slow_rms(done.acc_mps2 - run.imu.acc_mps2 - buzz) < 0.3 * slow_rms(acc - run.imu.acc_mps2 - buzz)


def test_a_camera_that_sees_too_little_changes_nothing():
    run, imu, alignment, _ = shaken(5, tone_hz=330.5, chip_hz=998.63)
    position = run.optical.t_camera_brick_mm.copy()
    position[60:] = np.nan
    blind = replace(run.optical, t_camera_brick_mm=position)
    samples = clean_samples(imu)
    assert (samples_beside_camera(blind, imu, alignment, ARM_M).acc_mps2 == samples.acc_mps2).all()
    position[2:] = np.nan
    with pytest.raises(TrackingError, match="2 frames with a pose"):
        CameraAccelerations(replace(blind, t_camera_brick_mm=position), samples, alignment, ARM_M)


def test_the_beat_of_two_clocks_is_found_and_chance_is_none():
    t_s = np.arange(0.0, 15.0, 0.01)
    jumping = chip_vibration(t_s, tone_hz=330.5, chip_hz=998.63) + np.random.default_rng(6).normal(
        0, 0.05, (1500, 3)
    )
    beat, _ = phase_jumps(jumping)
    # Two reads take seven periods of the chip, nearly: what both differ by is the beat.
    assert beat == pytest.approx(100 / (7 * READ_HZ - 2 * 998.63), rel=2e-3)
    steady = 2.0 * np.sin(2 * np.pi * 31.0 * t_s)[:, None] * [1.0, 0.5, -1.0]
    for seed in range(3):
        assert phase_jumps(steady + np.random.default_rng(seed).normal(0, 0.05, (1500, 3))) is None


def test_the_phase_of_a_motor_that_wanders_is_followed():
    t_s = np.arange(0.0, 10.0, 0.01)
    turns = 31.0 * t_s + 0.3 * np.sin(2 * np.pi * 0.3 * t_s)
    acc = np.cos(2 * np.pi * turns)[:, None] * [2.0, -1.0, 0.5] + 3 * np.sin(2 * np.pi * 2 * t_s)[:, None]
    found = vibration_phase(t_s, acc).at(t_s)
    off = np.angle(found * np.exp(-2j * np.pi * turns))[60:-60]
    assert np.angle(np.exp(1j * (off - off[0]))).std() < 0.05
    assert vibration_phase(t_s[:150], acc[:150]) is None


def test_camera_and_samples_agree_where_nothing_is_false():
    run = simulate_shake(7, duration_s=8.0, acc_bias_mps2=(0.0, 0.0, 0.0))
    samples, alignment = clean_samples(run.imu), align_times(run.optical, run.imu)
    camera = CameraAccelerations(run.optical, samples, alignment, ARM_M)
    false = np.tile([0.0, 0.3, 0.0], (len(samples.t_s), 1)) * np.sin(9.0 * samples.t_s)[:, None]
    of = camera.of([np.einsum("nij,nj->ni", camera.R, false)])[:, 0]
    # Samples hold no gravity; beside it frames and samples agree to the noise of the frames.
    fall = camera.of([np.broadcast_to(run.gravity_mps2, false.shape)])[:, 0]
    assert np.sqrt(np.mean((camera.off() - fall) ** 2)) < 1.3
    # The same through the samples: a transpose gives the same product, but for lines in place of cubics.
    left = np.random.default_rng(8).normal(0, 1, of.shape) + of
    assert (camera.seen_by_samples(left) * false).sum() * 0.01 == pytest.approx(float(left @ of), rel=0.05)


def test_a_low_pass_keeps_what_is_slow_where_it_is():
    t_s = np.arange(0.0, 6.0, 0.01)
    slow, fast = np.sin(2 * np.pi * 3.0 * t_s)[:, None], np.sin(2 * np.pi * 30.0 * t_s)[:, None]
    kept = low_pass(slow + fast, 12.0, rate_hz=100.0)
    # A Hamming window leaves a five-hundredth beyond its edge; at the ends a mirrored sine has a corner.
    np.testing.assert_allclose(kept[50:-50], slow[50:-50], atol=0.005)
    np.testing.assert_allclose(low_pass(np.full((80, 1), 2.0 + 1j), 1.2, rate_hz=100.0), 2.0 + 1j)
