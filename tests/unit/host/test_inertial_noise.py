"""How far samples are trusted: what is said of them is worked out by hand for waves of known steepness."""

from dataclasses import replace

import numpy as np
import pytest

from bricktrack_host.fusion.fusion_settings import FusionSettings
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.pose_by_pose.inertial_noise import noise_parts
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
