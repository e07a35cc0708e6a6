"""The simulated sensors' filters, noise and ranges against SciPy's filters and the data sheet's figures."""

import numpy as np
import pytest
from scipy.signal import lsim, lti

from bricktrack_common.arrays import FloatArray
from bricktrack_device.sim.imu_signal import (
    ACC_LAG_S,
    GYRO_LAG_S,
    ImuSensors,
    SensorSetup,
    chip_period_s,
    low_pass_taps,
    noise_sds,
    sensor_biases,
)
from bricktrack_device.sim.settings import SimImu, SimSettings
from bricktrack_device.sim.world import SimWorld, make_epoch

SETUP = SensorSetup(acc_range_g=16.0, acc_bandwidth_hz=62.5, gyro_range_dps=2000.0, gyro_bandwidth_hz=32.0)
CLEAN = SimImu(noise=0.0, bias=0.0)
FIRST_NS = 1_000_000_000


def sensors(settings: SimSettings, *, on_camera: bool = False) -> tuple[SimWorld, ImuSensors]:
    world = SimWorld(settings, make_epoch())
    world.schedule(FIRST_NS - round(settings.shake_delay_s * 1e9))
    return world, ImuSensors(world, on_camera=on_camera, stream=1)


@pytest.mark.parametrize("lag_s", [ACC_LAG_S, GYRO_LAG_S, 0.0009])
def test_the_filter_s_mean_delay_is_the_lag(lag_s: float) -> None:
    delays, weights = low_pass_taps(lag_s)
    assert weights.sum() == pytest.approx(1)
    # What lies beyond 12 time constants is 8e-5 of the whole, and its moment a thousandth.
    assert (weights * delays).sum() == pytest.approx(lag_s, rel=2e-3)


@pytest.mark.parametrize(("lag_s", "bandwidth_hz"), [(ACC_LAG_S, 62.5), (GYRO_LAG_S, 32.0)])
def test_the_lags_belong_to_the_chip_s_bandwidths(lag_s: float, bandwidth_hz: float) -> None:
    delays, weights = low_pass_taps(lag_s)
    gain = abs((weights * np.exp(-2j * np.pi * bandwidth_hz * delays)).sum())
    assert 0.6 < gain < 0.75  # -3 dB is 0.71


def test_an_impact_passes_the_filter_as_scipy_s_does() -> None:
    settings = SimSettings(motion="impacts", impact_mps=0.2, imu=CLEAN)
    world, chip = sensors(settings)
    t = np.arange(0, 3.5, 1e-4)  # the first impacts
    for lag_s, signal, channel in (
        (ACC_LAG_S, world.inertial(t).specific_force_mps2, "acc"),
        (GYRO_LAG_S, np.rad2deg(world.inertial(t).omega_radps), "gyro"),
    ):
        tau = lag_s / 2
        low_pass = lti([1.0], [tau**2, 2 * tau, 1.0])
        smooth = np.stack([lsim(low_pass, x - x[0], t)[1] + x[0] for x in signal.T], axis=1)
        strongest = t[np.argmax(np.abs(np.diff(signal, axis=0)).max(axis=1))]
        at = np.round(strongest + np.array([-0.004, 0.0, 0.001, 0.002, 0.004, 0.008, 0.02]), 4)
        found = [chip.measure(FIRST_NS + round(s * 1e9), SETUP) for s in at]
        values = np.array([m.acc_mps2 if channel == "acc" else m.gyro_dps for m in found])
        expected = smooth[np.rint(at * 1e4).astype(int)]
        # 2e-3 of an impact of 100 m/s^2, from the filter's tail and the steps of both quadratures.
        np.testing.assert_allclose(values, expected, atol=0.01 * np.ptp(signal))


def test_noise_is_the_data_sheet_s() -> None:
    acc_sd, gyro_sd = noise_sds(SETUP)
    # 150 ug/sqrt(Hz) and 0.014 deg/s/sqrt(Hz) over the bandwidth, whose equivalent is a little wider.
    assert 0.0116 < acc_sd < 0.0135 and 0.079 < gyro_sd < 0.096
    _, chip = sensors(SimSettings(quiet_s=100.0))
    found = [chip.measure(k * 10_000_000, SETUP) for k in range(1, 300)]
    np.testing.assert_allclose(np.std([m.acc_mps2 for m in found], axis=0), acc_sd, rtol=0.15)
    np.testing.assert_allclose(np.std([m.gyro_dps for m in found], axis=0), gyro_sd, rtol=0.15)


def test_biases_are_constant_and_each_chip_s_own() -> None:
    settings = SimSettings(imu=SimImu(noise=0.0))
    world, chip = sensors(settings)
    acc_bias, gyro_bias = sensor_biases(settings, 1)
    R, _ = world.rest_pose
    for t_ns in (0, FIRST_NS):
        m = chip.measure(t_ns, SETUP)
        np.testing.assert_allclose(m.acc_mps2 - acc_bias, -R.T @ world.gravity_camera_mps2, atol=1e-9)
        np.testing.assert_allclose(m.gyro_dps, gyro_bias, atol=1e-9)
    assert not np.allclose(acc_bias, sensor_biases(settings, 2)[0])


def test_signals_clip_at_the_range() -> None:
    _, chip = sensors(SimSettings(motion="sines", amplitude_mm=60.0, amplitude_deg=40.0, imu=CLEAN))
    narrow = SensorSetup(acc_range_g=2.0, acc_bandwidth_hz=62.5, gyro_range_dps=125.0, gyro_bandwidth_hz=32.0)
    found = [chip.measure(FIRST_NS + k * 10_000_000, narrow) for k in range(200, 500)]
    assert np.abs([m.acc_mps2 for m in found]).max() == pytest.approx(2 * 9.80665)
    assert np.abs([m.gyro_dps for m in found]).max() == 125.0


def test_a_chip_on_the_camera_rests_while_the_brick_shakes() -> None:
    world, chip = sensors(SimSettings(imu=CLEAN), on_camera=True)
    m = chip.measure(FIRST_NS + 4_000_000_000, SETUP)
    np.testing.assert_allclose(m.acc_mps2, -world.gravity_camera_mps2)
    assert not m.gyro_dps.any()


def test_orientation_takes_the_chip_s_axes_to_gravity_s() -> None:
    world, chip = sensors(SimSettings(imu=CLEAN))
    for t_ns in (0, FIRST_NS + 5_000_000_000):
        R = chip.measure(t_ns, SETUP).R_gravity_imu
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        R_camera_brick = world.pose(np.array([t_ns]))[0][0]
        up_camera = R_camera_brick @ R.T @ np.array([0.0, 0.0, 1.0])
        np.testing.assert_allclose(up_camera * 9.80665, -world.gravity_camera_mps2, atol=1e-9)


def mean_period(settings: SimSettings) -> float:
    return chip_period_s(settings, 0)


def test_the_chip_s_clock_is_as_wrong_as_told() -> None:
    assert mean_period(SimSettings(imu=SimImu(clock_ppm=500.0))) == pytest.approx(0.01 * 1.0005)
    assert mean_period(SimSettings(imu=SimImu(clock_ppm=0.0, sample_hz=1000.0))) == 0.001
    seeded: FloatArray = np.array([mean_period(SimSettings(seed=s)) for s in range(200)])
    assert 0.0015 < seeded.std() / 0.01 < 0.0025
