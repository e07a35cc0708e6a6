"""What the simulated BNO055's sensors measure: the true motion, filtered, with bias, noise and range."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.imu_records import STANDARD_GRAVITY_MPS2
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.world import SimWorld

ACC_LAG_S, ACC_BANDWIDTH_HZ = 0.0036, 62.5
GYRO_LAG_S, GYRO_BANDWIDTH_HZ = 0.0070, 32.0
"""Mean delays at the default bandwidths; a wider band is quicker in proportion."""

_ACC_NOISE_G_PER_ROOT_HZ = 150e-6  # data sheet, table 0-3
_GYRO_NOISE_DPS_PER_ROOT_HZ = 0.014
_NOISE_BANDWIDTH = 1.22  # of a critically damped second-order low-pass over its -3 dB bandwidth
_MAG_FIELD_CAMERA_UT = np.array([18.0, 43.0, -4.0])
_MAG_NOISE_UT = 0.3
_CLOCK_SD = 2e-3  # an internal oscillator; measure on hardware
_TAPS_A_CONSTANT, _LENGTH_IN_CONSTANTS = 8, 12


@dataclass(frozen=True, slots=True)
class SensorSetup:
    """Ranges and bandwidths as the chip's registers have them."""

    acc_range_g: float
    acc_bandwidth_hz: float
    gyro_range_dps: float
    gyro_bandwidth_hz: float


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """One sample of the chip's sensors in its own axes.

    Attributes
    ----------
    acc_mps2, gyro_dps, mag_ut : ndarray, shape (3,)
    R_gravity_imu : ndarray, shape (3, 3)
        What the chip's fusion finds: true, z up, x as far as may be along the camera's x.
    """

    acc_mps2: FloatArray
    gyro_dps: FloatArray
    mag_ut: FloatArray
    R_gravity_imu: FloatArray


@cache
def low_pass_taps(lag_s: float) -> tuple[FloatArray, FloatArray]:
    """Return delays, s, and weights of a critically damped second-order low-pass with this mean delay.

    Its response is ``t / tau^2 exp(-t / tau)`` with ``tau = lag / 2``; the taps are dense enough for
    impacts of 1 ms.
    """
    tau = lag_s / 2
    delays = (np.arange(_TAPS_A_CONSTANT * _LENGTH_IN_CONSTANTS) + 0.5) * tau / _TAPS_A_CONSTANT
    weights = delays * np.exp(-delays / tau)
    return delays, weights / weights.sum()


class ImuSensors:
    """The sensors of one chip.

    Parameters
    ----------
    world : SimWorld
    on_camera : bool
        Whether the chip sits on the camera's component instead of at the brick's lever arm.
    stream : int
        Tells the random numbers of one chip from another's.
    """

    def __init__(self, world: SimWorld, *, on_camera: bool, stream: int) -> None:
        self._world = world
        self._on_camera = on_camera
        self._key = [world.settings.seed, 6, stream]
        self.acc_bias_mps2, self.gyro_bias_dps = sensor_biases(world.settings, stream)
        up = -world.gravity_camera_mps2 / STANDARD_GRAVITY_MPS2
        x = np.array([1.0, 0.0, 0.0]) - up[0] * up
        x /= np.linalg.norm(x)
        self._R_gravity_camera = np.stack([x, np.cross(up, x), up])

    def measure(self, t_ns: int, setup: SensorSetup) -> Measured:
        """Return the sample that the chip takes at an instant."""
        world = self._world
        since_s = float(world.since_first_edge_s(np.array([t_ns]))[0])
        if not np.isfinite(since_s):
            since_s = -1e3  # not armed yet: at rest
        noise = (
            np.random.default_rng([*self._key, t_ns & 0x7FFFFFFF]).normal(size=9) * world.settings.imu.noise
        )
        acc_sd, gyro_sd = noise_sds(setup)
        acc, gyro_dps, R_still_imu = self._true(since_s, setup)
        acc = acc + self.acc_bias_mps2 + acc_sd * noise[:3]
        gyro_dps = gyro_dps + self.gyro_bias_dps + gyro_sd * noise[3:6]
        limit = setup.acc_range_g * STANDARD_GRAVITY_MPS2
        return Measured(
            acc_mps2=np.clip(acc, -limit, limit),
            gyro_dps=np.clip(gyro_dps, -setup.gyro_range_dps, setup.gyro_range_dps),
            mag_ut=_MAG_FIELD_CAMERA_UT @ R_still_imu + _MAG_NOISE_UT * noise[6:],
            R_gravity_imu=self._R_gravity_camera @ R_still_imu,
        )

    def _true(self, since_s: float, setup: SensorSetup) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return filtered specific force, m/s^2, filtered rate, deg/s, and ``R_still_imu``."""
        world = self._world
        acc_delays, acc_weights = low_pass_taps(ACC_LAG_S * ACC_BANDWIDTH_HZ / setup.acc_bandwidth_hz)
        gyro_delays, gyro_weights = low_pass_taps(GYRO_LAG_S * GYRO_BANDWIDTH_HZ / setup.gyro_bandwidth_hz)
        at_s = since_s - np.concatenate([acc_delays, gyro_delays, [0.0]])
        if self._on_camera:
            ideal = world.camera_inertial(at_s, at_mm=np.array(world.settings.imu.on_camera_mm))
        else:
            ideal = world.inertial(at_s)
        n = len(acc_delays)
        gyro = gyro_weights @ ideal.omega_radps[n:-1]
        return acc_weights @ ideal.specific_force_mps2[:n], np.rad2deg(gyro), ideal.R_still_imu[-1]


def noise_sds(setup: SensorSetup) -> tuple[float, float]:
    """Return the standard deviations of the noise, m/s^2 and deg/s."""
    acc = (
        _ACC_NOISE_G_PER_ROOT_HZ * STANDARD_GRAVITY_MPS2 * np.sqrt(_NOISE_BANDWIDTH * setup.acc_bandwidth_hz)
    )
    gyro = _GYRO_NOISE_DPS_PER_ROOT_HZ * np.sqrt(_NOISE_BANDWIDTH * setup.gyro_bandwidth_hz)
    return float(acc), float(gyro)


def sensor_biases(settings: SimSettings, stream: int) -> tuple[FloatArray, FloatArray]:
    """Return the constant biases of a chip's accelerometer, m/s^2, and gyroscope, deg/s."""
    rng = np.random.default_rng([settings.seed, 5, stream])
    scale = settings.imu.bias
    return rng.uniform(-0.25, 0.25, 3) * scale, rng.uniform(-0.8, 0.8, 3) * scale


def chip_period_s(settings: SimSettings, stream: int) -> float:
    """Return the time between two samples by the chip's own clock."""
    if settings.imu.clock_ppm is not None:
        error = settings.imu.clock_ppm * 1e-6
    else:
        error = _CLOCK_SD * float(np.random.default_rng([settings.seed, 9, stream]).normal())
    return (1 + error) / settings.imu.sample_hz
