"""How far samples are trusted: what is said of them is worked out by hand for waves of known steepness."""

from dataclasses import replace

import numpy as np
import pytest

from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.pose_by_pose.inertial_noise import NoiseLevel, noise_parts
from bricktrack_host.fusion.smoothing.linearisation import Linearisation
from bricktrack_host.tracks import ImuTrack


def test_samples_that_may_belong_to_another_slot_are_doubted_by_what_that_changes():
    t_s = np.arange(400) * 0.01
    wave = np.sin(2 * np.pi * t_s)[:, None] * [1.0, 0.2, 0.1]  # 1 Hz: 6.28 rad/s2 where it is steepest
    imu = ImuTrack(np.round(t_s * 1e9).astype(np.int64), 4 * wave, wave, np.zeros(400, dtype=np.int64), 160.0)
    unsure = replace(imu, t_sd_s=np.where((t_s >= 1.0) & (t_s < 3.0), 0.005, 0.0))
    zero = np.zeros(3)
    lin = Linearisation(0.0, 0.0, 0.0, 0.0, zero, zero, np.eye(3), zero, zero, zero)
    sure, doubted = (
        noise_parts(ImuSignal.from_track(track), t_s, lin, FusionSettings()) for track in (imu, unsure)
    )
    more_gyro, more_acc = doubted.gyro_fixed - sure.gyro_fixed, doubted.acc_fixed - sure.acc_fixed
    assert (more_gyro[:98] == 0.0).all()
    assert (more_gyro[302:] == 0.0).all()
    # Variance (steepness x sd of the stamp)^2, times the period for a density; 1 % for the differences taken.
    expected = (2 * np.pi * np.cos(2 * np.pi * (t_s[:-1] + 0.005)) * 0.005) ** 2 * 0.01
    np.testing.assert_allclose(more_gyro[102:298], expected[102:298], rtol=0.01, atol=0.01 * expected.max())
    assert more_acc[200] == pytest.approx(16 * more_gyro[200], rel=1e-6)


def test_pulses_are_believed_by_a_level_of_their_own():
    t_s = np.arange(400) * 0.01
    wave = 0.01 * np.sin(2 * np.pi * t_s)[:, None] * [1.0, 0.2, 0.1]
    acc = 4 * wave
    acc[200, 0] += 3.0  # 1000 times what is usual
    imu = ImuTrack(np.round(t_s * 1e9).astype(np.int64), acc, wave, np.zeros(400, dtype=np.int64), 160.0)
    zero = np.zeros(3)
    lin = Linearisation(0.0, 0.0, 0.0, 0.0, zero, zero, np.eye(3), zero, zero, zero)
    stated, less = FusionSettings(), FusionSettings(gyro_impact_share=0.06, acc_impact_share=0.2)
    of_stated, of_less = (noise_parts(ImuSignal.from_track(imu), t_s, lin, s) for s in (stated, less))
    assert of_stated.acc_impact[200] == pytest.approx(9.0 * 0.01, rel=0.01)  # its height squared, for 10 ms
    assert not of_stated.acc_impact[:150].any()
    # A fifth of the level is a fifth of the share.
    level, fifth = NoiseLevel(1.0, 1.0), NoiseLevel(1.0, 1.0, 0.2)
    np.testing.assert_allclose(of_stated.acc(fifth), of_less.acc(level), rtol=1e-12)
    np.testing.assert_allclose(of_stated.gyro(fifth), of_less.gyro(level), rtol=1e-12)
