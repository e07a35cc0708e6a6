"""Inertial signals: increments against direct integration, and what is said of noise, clipping and gaps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bricktrack_common.errors import ShapeError
from bricktrack_common.imu_records import ImuFlag
from bricktrack_host.fusion.inertial.imu_samples import clean_samples, roughness
from bricktrack_host.fusion.inertial.imu_signal import ImuSignal, chain_rotations
from bricktrack_host.tracks import ImuTrack

EPOCH_NS = 5_000_000_000_000


def track(t_s, gyro, acc, *, limit=160.0, flags=None):
    return ImuTrack(
        t_ns=EPOCH_NS + np.round(np.asarray(t_s) * 1e9).astype(np.int64),
        acc_mps2=np.asarray(acc, dtype=float),
        gyro_radps=np.asarray(gyro, dtype=float),
        flags=np.zeros(len(t_s), dtype=np.int64) if flags is None else flags,
        acc_range_mps2=limit,
    )


def wave(t):
    """Angular rate and specific force of a 6 Hz shake, far from symmetric, shape (n, 3) each."""
    w = 2 * np.pi * 6.0 * np.asarray(t)
    gyro = np.stack([2 * np.sin(w), 1.5 * np.cos(w), 0.8 * np.sin(w + 0.7)], axis=-1)
    acc = np.stack([4 * np.cos(w + 0.3), 9.8 + 3 * np.sin(w), 2 * np.sin(0.7 * w)], axis=-1)
    return gyro, acc


def integrate(start, end, n=4000):
    """Return rotation, velocity and position change by many small exact steps of the analytic signals."""
    h = (end - start) / n
    R, v, p = Rotation.identity(), np.zeros(3), np.zeros(3)
    for middle in start + h * (np.arange(n) + 0.5):
        gyro, acc = wave(middle)
        a = (R * Rotation.from_rotvec(gyro * h / 2)).apply(acc)
        p = p + v * h + 0.5 * a * h * h
        v = v + a * h
        R = R * Rotation.from_rotvec(gyro * h)
    return R, v, p


def test_increments_follow_direct_integration_of_the_shake():
    t = np.arange(0, 1, 0.01)
    signal = ImuSignal.from_track(track(t, *wave(t)))
    step = signal.increments(
        np.array([0.4031]),
        np.array([0.4131]),
        gyro_bias_radps=np.zeros(3),
        acc_bias_mps2=np.zeros(3),
        acc_lag_s=0.0,
    )
    R, v, p = integrate(0.4031, 0.4131)
    # The cubic of a 6 Hz wave at 100 Hz is 3e-4 off its size: 2 rad/s and 4 m/s^2 over 10 ms.
    assert np.allclose(step.R[0], R.as_matrix(), atol=1e-5)
    assert np.allclose(step.dv_mps[0], v, atol=2e-5)
    assert np.allclose(step.dp_m[0], p, atol=2e-7)


def test_bias_and_lag_are_taken_out_where_the_design_says():
    t = np.arange(0, 1, 0.01)
    gyro, _ = wave(t)
    _, acc_late = wave(t - 0.002)  # stamped T, felt at T - 2 ms: f(t) = a~(t + lag), lag = 2 ms
    bg, ba = np.array([0.02, -0.01, 0.03]), np.array([0.3, -0.2, 0.1])
    signal = ImuSignal.from_track(track(t, gyro + bg, acc_late + ba))
    step = signal.increments(
        np.array([0.5]), np.array([0.509]), gyro_bias_radps=bg, acc_bias_mps2=ba, acc_lag_s=0.002
    )
    R, v, p = integrate(0.5, 0.509)
    assert np.allclose(step.R[0], R.as_matrix(), atol=1e-5)
    assert np.allclose(step.dv_mps[0], v, atol=2e-5)
    assert np.allclose(step.dp_m[0], p, atol=2e-7)


def test_chained_rotations_are_the_running_product():
    steps = Rotation.random(37, rng=np.random.default_rng(1)).as_matrix()
    product, expected = np.eye(3), []
    for step in steps:
        product = product @ step
        expected.append(product)
    assert np.allclose(chain_rotations(steps), expected, atol=1e-12)


def test_roughness_tells_noise_and_impacts_from_smooth_motion():
    t = np.arange(0, 4, 0.01)
    slow = np.sin(2 * np.pi * 5 * t)[:, None] * np.ones(3)
    steady, impact = roughness(slow)
    assert steady.max() < 0.01 and (impact == 0).all()
    noise = np.random.default_rng(2).normal(0, 0.1, (400, 3))
    steady, impact = roughness(slow + noise)
    assert 0.08 < np.median(steady) < 0.16  # sd 0.1; the greatest of three medians of 25
    assert (impact > 0).mean() < 0.02
    slow[200] += 5.0
    steady, impact = roughness(slow + noise)
    assert steady.max() < 0.25
    assert np.flatnonzero(impact > 3).tolist() == [199, 200, 201]
    assert impact[200] == pytest.approx(5.0, abs=0.5)


def test_clipped_peak_is_completed_and_marked():
    t = np.arange(0, 1, 0.01)
    _, true = wave(t)
    true[:, 0] *= 3.0  # peaks at 12; the other axes stay below 13
    measured = np.column_stack([np.clip(true[:, 0], -10.0, 10.0), 0.5 * true[:, 1:]])
    signal = ImuSignal.from_track(track(t, np.zeros_like(true), measured, limit=10.0 + 1e-9))
    clipped = np.abs(measured[:, 0]) == 10.0
    assert clipped.sum() > 5
    before = 10.0 - np.abs(true[clipped, 0])
    after = np.abs(signal.acc_mps2[clipped, 0]) - np.abs(true[clipped, 0])
    assert np.sqrt(np.mean(after**2)) < 0.5 * np.sqrt(np.mean(before**2))
    assert (signal.clip_sd_mps2[clipped] >= 1.0).all()
    assert (signal.clip_sd_mps2[np.abs(true[:, 0]) < 2] == 0).all()


def test_a_sample_a_little_below_the_limit_was_clipped_if_those_around_it_say_so():
    t = np.arange(300) / 100.0
    # One peak clipped, its first and last sample rounded off by filters, and one that just stays below.
    true = 14.0 * np.exp(-(((t - 1.0) / 0.05) ** 2)) + 9.95 * np.exp(-(((t - 2.0) / 0.2) ** 2))
    measured = np.minimum(true, 10.0)
    rounded = np.flatnonzero(measured == 10.0)[[0, -1]]
    measured[rounded] = 9.9
    acc = measured[:, None] * [1.0, 0.1, 0.1]
    samples = clean_samples(track(t, np.zeros((300, 3)), acc, limit=10.0))
    assert (samples.acc_mps2[rounded, 0] > 10.0).all() and (samples.clip_sd_mps2[rounded] > 0).all()
    below = np.abs(t - 2.0) < 0.15
    assert (measured[below] > 9.8).any()
    assert (samples.acc_mps2[below, 0] == measured[below]).all()
    assert (samples.clip_sd_mps2[below] == 0).all()


def test_missing_samples_are_gaps_and_repeats_are_not_used():
    t = np.arange(0, 2, 0.01)
    gyro, acc = wave(t)
    gyro[50:60], acc[50:60] = np.nan, np.nan
    flags = np.zeros(len(t), dtype=np.int64)
    flags[120] = int(ImuFlag.REPEAT)
    acc[120] = 1e3  # would be seen
    signal = ImuSignal.from_track(track(t, gyro, acc, flags=flags))
    at = np.array([0.3, 0.545, 0.605, 1.195, 1.3, -0.02, 2.1])
    assert signal.in_gap(at).tolist() == [False, True, False, True, False, True, True]
    assert np.abs(signal.acc_mps2).max() < 20
    # A straight line across the long gap: nothing swings out.
    assert np.abs(signal.acc_at(np.linspace(0.49, 0.6, 50))).max() < 14


@pytest.mark.parametrize("broken", ["few", "order"])
def test_useless_tracks_are_refused_with_words(broken):
    t = np.arange(0, 1, 0.01)
    gyro, acc = wave(t)
    if broken == "few":
        acc[10:] = np.nan
        with pytest.raises(ShapeError, match="only 10 of 100 inertial samples are whole"):
            ImuSignal.from_track(track(t, gyro, acc))
    else:
        t[20] = t[19]
        with pytest.raises(ShapeError, match="do not increase"):
            ImuSignal.from_track(track(t, gyro, acc))


def test_gains_taken_out_give_the_signals_of_samples_without_them():
    # A gap of 0.1 s is in it; the splines are turned, where the reference is made anew from other samples.
    t = np.delete(np.arange(0, 2, 0.01), np.arange(80, 90))
    rng = np.random.default_rng(4)
    gyro, acc = wave(t)
    gyro_gain, acc_gain = (np.eye(3) + 0.01 * rng.normal(size=(3, 3)) for _ in range(2))
    read = track(t, gyro @ gyro_gain.T, acc @ acc_gain.T)
    found = ImuSignal.from_track(read, gyro_filter_s=0.003).with_acc_filter(0.001)
    found = found.without_gains(np.eye(3) + 0.1, np.eye(3))  # which is replaced
    found = found.without_gains(gyro_gain, acc_gain).with_acc_filter(0.002)
    direct = ImuSignal.from_track(track(t, gyro, acc), gyro_filter_s=0.003, acc_filter_s=0.002)
    at = np.linspace(0.0, 1.99, 700)
    for ours, wanted in (
        (found.gyro_at(at), direct.gyro_at(at)),
        (found.acc_at(at), direct.acc_at(at)),
        (found.angle_at(at), direct.angle_at(at)),
        (found.pieces().acc_twice, direct.pieces().acc_twice),
    ):
        np.testing.assert_allclose(ours, wanted, rtol=1e-9, atol=1e-9 * np.abs(wanted).max())
