"""Samples that break a steady vibration, against signals whose truth is known."""

import numpy as np
import pytest

from bricktrack_host.fusion.inertial.imu_samples import roughness
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal
from bricktrack_host.fusion.inertial.vibration import (
    fill,
    interpolation_error,
    mend_vibration,
    prediction_coefficients,
)
from bricktrack_host.tracks import ImuTrack

RATE_HZ, HELD = 100.0, (300, 611, 1002)


def shaken_sensor(seed, *, vibration_mps2=4.0):
    """Return gyro and accelerometer of a slow motion under a 44.5 Hz vibration, as measured and as they were."""
    rng = np.random.default_rng(seed)
    t = np.arange(1500) / RATE_HZ
    phase, slow = rng.uniform(0, 2 * np.pi, (2, 6)), rng.uniform(0.7, 2.0, 6)
    beat = 1 + 0.1 * np.sin(2 * np.pi * 0.4 * t)[:, None]
    shape = np.sin(2 * np.pi * slow * t[:, None] + phase[0])
    buzz = beat * np.sin(2 * np.pi * 44.5 * t[:, None] + phase[1])
    size = np.r_[np.full(3, 0.5), np.full(3, 1.5)], np.r_[np.full(3, 0.02), np.full(3, vibration_mps2)]
    noise = rng.normal(0, 1, (t.size, 6)) * np.r_[np.full(3, 1e-3), np.full(3, 0.02)]
    truth = size[0] * shape + size[1] * buzz + noise
    seen = truth.copy()
    for k in HELD:
        seen[k : k + 3] = 0.4 * seen[k : k + 3] + 0.6 * seen[k - 1]
    return t, seen, truth


def test_prediction_knows_a_tone_and_fills_what_is_missing():
    # A tone obeys x[n] = 2 cos(w) x[n-1] - x[n-2] exactly.
    tone = np.sin(0.7 * np.arange(400) + 0.3)
    missing = np.zeros(400, dtype=bool)
    missing[200:204] = True
    coefficients = prediction_coefficients(tone, ~missing, 2)
    assert coefficients == pytest.approx([1, -2 * np.cos(0.7), 1], abs=1e-4)
    filled, sd = fill(tone, missing, coefficients)
    assert filled == pytest.approx(tone, abs=2e-3)
    assert (sd[~missing] == 0).all() and (sd[missing] < 2e-3).all()
    off = tone.copy()
    off[100] += 0.5
    assert int(np.argmax(np.abs(interpolation_error(off, coefficients)))) == 100


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_samples_lost_within_a_vibration_are_found_and_filled(seed):
    _, seen, truth = shaken_sensor(seed)
    mended = mend_vibration(seen[:, :3], seen[:, 3:], roughness(seen[:, 3:])[0])
    lost = np.concatenate([np.arange(k, k + 3) for k in HELD])
    assert mended.is_filled[[k + 1 for k in HELD]].all()
    assert mended.is_filled.sum() <= 3 * lost.size
    error = np.abs(mended.acc_mps2 - truth[:, 3:])[lost].max(axis=1)
    # What a vibration with a beat leaves to a prediction of 24 samples; the break itself is of several m/s^2.
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean((seen - truth)[lost, 3:].max(axis=1) ** 2))
    assert (mended.acc_sd_mps2 > 0).sum() == mended.is_filled.sum()
    kept = ~mended.is_filled
    assert mended.gyro_radps[kept] == pytest.approx(seen[kept, :3], abs=1e-12)


@pytest.mark.parametrize("width", [1, 2, 3, 4])
def test_as_many_samples_are_filled_as_were_lost(width):
    _, _, truth = shaken_sensor(8)
    seen = truth.copy()
    for k in HELD:
        seen[k : k + width] = truth[k - 1]
    mended = mend_vibration(seen[:, :3], seen[:, 3:], roughness(seen[:, 3:])[0])
    lost = np.zeros(len(seen), dtype=bool)
    lost[np.array(HELD)[:, None] + np.arange(width)] = True
    # Where the vibration happens to be as it was, a sample that is held is as good as one that is measured.
    told = lost & (np.abs(seen - truth)[:, 3:].max(axis=1) > 1.0)
    assert mended.is_filled[told].all()
    assert not mended.is_filled[~lost].any()


def test_impacts_and_quiet_signals_stay_as_measured():
    t, _, truth = shaken_sensor(4)
    struck = truth.copy()
    struck[700, 3:] += 40.0  # a hundredth of a second: 0.4 m/s
    mended = mend_vibration(struck[:, :3], struck[:, 3:], roughness(struck[:, 3:])[0])
    assert mended.acc_mps2[700] == pytest.approx(struck[700, 3:])
    # Without vibration nothing is predicted, and held samples are for the frames to judge.
    _, quiet, _ = shaken_sensor(5, vibration_mps2=0.0)
    track = ImuTrack(
        t_ns=np.round(t * 1e9).astype(np.int64), acc_mps2=quiet[:, 3:], gyro_radps=quiet[:, :3],
        flags=np.zeros(t.size, dtype=np.int64), acc_range_mps2=160.0,
    )  # fmt: skip
    assert ImuSignal.from_track(track).acc_mps2 == pytest.approx(quiet[:, 3:])


def test_a_signal_is_mended_where_it_vibrates():
    t, seen, truth = shaken_sensor(6)
    track = ImuTrack(
        t_ns=np.round(t * 1e9).astype(np.int64), acc_mps2=seen[:, 3:], gyro_radps=seen[:, :3],
        flags=np.zeros(t.size, dtype=np.int64), acc_range_mps2=160.0,
    )  # fmt: skip
    signal = ImuSignal.from_track(track)
    at = np.array(HELD) + 1
    assert np.abs(signal.acc_mps2 - truth[:, 3:])[at].max() < 0.4 * np.abs(seen - truth)[at, 3:].max()
    assert (signal.acc_impact_mps2[at] > 0).all()


def test_a_short_signal_is_left_alone():
    _, seen, _ = shaken_sensor(7)
    short = seen[290:400]
    mended = mend_vibration(short[:, :3], short[:, 3:], roughness(short[:, 3:])[0])
    assert not mended.is_filled.any() and mended.acc_mps2 == pytest.approx(short[:, 3:])
