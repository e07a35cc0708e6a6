"""A BNO055 as a table of registers on a simulated I2C bus, under the real driver and the real burst read.

The chip samples on its own clock, a little off ours: reads at 100 Hz sometimes find the same sample twice.
What it samples is the world's motion through its low-pass filters, with bias, noise, quantisation and range.
"""

import errno
import os
import struct
import time
from dataclasses import dataclass

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.imu_records import FIRST_REGISTER, LAST_REGISTER, STANDARD_GRAVITY_MPS2
from bricktrack_common.rotations import quaternion_from_matrix
from bricktrack_device.sim.settings import SimSettings
from bricktrack_device.sim.world import Epoch, SimWorld

ADDRESS = 0x28
GYRO_LAG_S = 0.0070  # at the default bandwidths of 32 Hz and 62.5 Hz
ACC_LAG_S = 0.0036
_CHIP_PERIOD_S = 0.01
_CHIP_CLOCK_SD = 2e-3
_RESET_S = 0.3  # shorter than a real one's 0.65 s, within which the driver waits anyway
_ACC_NOISE_MPS2 = 0.0116  # 150 ug/sqrt(Hz) over 62.5 Hz (data sheet, table 0-3)
_GYRO_NOISE_DPS = 0.096  # 0.014 deg/s/sqrt(Hz) over 47 Hz
_BUS_BIT_S = 9 / 400_000
_BUS_OVERHEAD_S = 0.0003

_CONFIG, _ACCGYRO, _AMG, _IMUPLUS, _NDOF = 0x00, 0x05, 0x07, 0x08, 0x0C
_RAW_MODES = (_ACCGYRO, _AMG)
_FUSION_MODES = (_IMUPLUS, _NDOF)
_OPR_MODE, _SYS_TRIGGER, _PAGE, _SYS_STATUS = 0x3D, 0x3F, 0x07, 0x39
_ACC_RANGES_G = (2.0, 4.0, 8.0, 16.0)


def _lag_taps(lag_s: float) -> tuple[FloatArray, FloatArray]:
    """Return delays and weights of a critically damped second-order low-pass of this mean delay."""
    x, w = np.polynomial.laguerre.laggauss(10)
    weights = w * x
    return 0.5 * lag_s * x, weights / weights.sum()


_ACC_TAPS, _GYRO_TAPS = _lag_taps(ACC_LAG_S), _lag_taps(GYRO_LAG_S)


@dataclass(frozen=True, slots=True)
class SimBusOpener:
    """Opens the simulated bus in whichever process calls it; it passes to that process as it is spawned."""

    settings: SimSettings
    epoch: Epoch  # type: ignore[type-arg]

    def __call__(self) -> "SimI2c":
        """Return the bus."""
        return SimI2c(SimWorld(self.settings, self.epoch))


class SimI2c:
    """A bus with one BNO055 at 0x28, meeting `interfaces.I2cBus`."""

    def __init__(self, world: SimWorld) -> None:
        self._world = world
        self._settings = world.settings
        rng = np.random.default_rng([world.settings.seed, 5])
        self._acc_bias_mps2 = rng.uniform(-0.25, 0.25, 3)
        self._gyro_bias_dps = rng.uniform(-0.8, 0.8, 3)
        self._chip_period_s = _CHIP_PERIOD_S * (1 + _CHIP_CLOCK_SD * float(rng.normal()))
        self._unique_id = rng.bytes(16)
        self._locked = False
        self._pointer = 0
        self._n_transactions = 0
        self._reset_done = False
        self._silent_until_ns = 0
        self._stuck: bytes | None = None
        self._last_sample = (-1, bytes(LAST_REGISTER - FIRST_REGISTER + 1))
        self._power_up()

    def _power_up(self) -> None:
        self._pages = bytearray(128), bytearray(128)
        page0, page1 = self._pages
        page0[0x00:0x07] = bytes([0xA0, 0xFB, 0x32, 0x0F, 0x11, 0x03, 0x15])
        page0[0x36], page0[0x3B], page0[0x41] = 0x0F, 0x80, 0x24
        page0[0x34] = 31
        page1[0x08], page1[0x09], page1[0x0A] = 0x0D, 0x6D, 0x38
        page1[0x50:0x60] = self._unique_id
        self._mode_since_ns = monotonic_ns()

    # The Adafruit driver's side.

    def try_lock(self) -> bool:
        """Take the bus; tell whether that worked."""
        if self._locked:
            return False
        self._locked = True
        return True

    def unlock(self) -> None:
        """Give the bus back."""
        self._locked = False

    def writeto(self, address: int, buffer: bytes, *, start: int = 0, end: int | None = None) -> None:
        """Write a register's number and values behind it."""
        data = bytes(buffer[start : len(buffer) if end is None else end])
        self._begin(address, len(data))
        if not data:
            return
        self._pointer = data[0]
        for value in data[1:]:
            self._set(self._pointer, value)
            self._pointer += 1

    def readfrom_into(
        self, address: int, buffer: bytearray, *, start: int = 0, end: int | None = None
    ) -> None:
        """Read on from the register last named."""
        end = len(buffer) if end is None else end
        self._begin(address, end - start)
        buffer[start:end] = self._read(self._pointer, end - start)

    def writeto_then_readfrom(
        self, address: int, out_buffer: bytes, in_buffer: bytearray, *, out_start: int = 0,
        out_end: int | None = None, in_start: int = 0, in_end: int | None = None,
    ) -> None:  # fmt: skip
        """Name a register and read from it with a repeated start."""
        self.writeto(address, out_buffer, start=out_start, end=out_end)
        self.readfrom_into(address, in_buffer, start=in_start, end=in_end)

    # The hot path.

    def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
        """Read consecutive registers in one transaction; raise `OSError` with its errno on failure."""
        self._begin(address, n_bytes + 2)
        return self._read(register, n_bytes)

    def close(self) -> None:
        """Release the bus."""

    # The chip.

    def _begin(self, address: int, n_bytes: int) -> None:
        """Take as long as the bus takes, and fail as it fails."""
        faults = self._settings.faults
        now = monotonic_ns()
        if address != ADDRESS or faults.imu_absent or now < self._silent_until_ns:
            raise OSError(errno.EREMOTEIO, os.strerror(errno.EREMOTEIO))
        self._faults_over_time(now)
        if self._pages[0][_OPR_MODE] and faults.imu_nack_every:
            self._n_transactions += 1
            if self._n_transactions % faults.imu_nack_every == 0:
                raise OSError(faults.imu_nack_errno, os.strerror(faults.imu_nack_errno))
        if n_bytes > 8:
            time.sleep(_BUS_OVERHEAD_S + n_bytes * _BUS_BIT_S)

    def _faults_over_time(self, now_ns: int) -> None:
        faults = self._settings.faults
        since_s = float(self._world.since_first_edge_s(np.array([now_ns]))[0])
        if faults.imu_reset_s is not None and since_s > faults.imu_reset_s and not self._reset_done:
            self._reset_done = True  # a brown-out: nothing fails, the sensor just starts anew in CONFIG
            self._power_up()
        if faults.imu_stuck_s is not None and since_s > faults.imu_stuck_s and self._stuck is None:
            self._stuck = self._last_sample[1]

    def _set(self, register: int, value: int) -> None:
        page0 = self._pages[0]
        if register == _PAGE:
            page0[_PAGE] = value & 1
            return
        if page0[_PAGE] == 1:
            if page0[_OPR_MODE] == _CONFIG and 0x08 <= register <= 0x1F:
                self._pages[1][register] = value
            return
        if register == _SYS_TRIGGER and value & 0x20:
            self._power_up()
            self._silent_until_ns = monotonic_ns() + round(_RESET_S * 1e9)
            return
        if register == _OPR_MODE:
            self._set_mode(value & 0x0F)
        elif register >= 0x3B:
            page0[register] = value

    def _set_mode(self, mode: int) -> None:
        page0, page1 = self._pages
        page0[_OPR_MODE] = mode
        page0[_SYS_STATUS] = 5 if mode in _FUSION_MODES else 6 if mode in _RAW_MODES else 0
        if mode in _FUSION_MODES:
            page1[0x08], page1[0x0A] = 0x0D, 0x38  # fusion owns the ranges: 4 g, 2000 deg/s
        self._mode_since_ns = monotonic_ns()

    def _read(self, register: int, n_bytes: int) -> bytes:
        if self._pages[0][_PAGE] == 1:
            whole = self._pages[1] if register != _PAGE else self._pages[0]
            return bytes(whole[register : register + n_bytes])
        page0 = self._pages[0]
        if register <= LAST_REGISTER and register + n_bytes > FIRST_REGISTER:
            page0[FIRST_REGISTER : LAST_REGISTER + 1] = self._sample()
        return bytes(page0[register : register + n_bytes])

    def _sample(self) -> bytes:
        """Return registers 0x08..0x35 of the chip's latest sample."""
        if self._stuck is not None:
            return self._stuck
        mode = self._pages[0][_OPR_MODE]
        if mode not in _RAW_MODES and mode not in _FUSION_MODES:
            return bytes(LAST_REGISTER - FIRST_REGISTER + 1)
        k = int((monotonic_ns() - self._mode_since_ns) * 1e-9 / self._chip_period_s)
        if k != self._last_sample[0]:
            t_ns = self._mode_since_ns + round(k * self._chip_period_s * 1e9)
            self._last_sample = k, self._measure(t_ns, mode)
        return self._last_sample[1]

    def _measure(self, t_ns: int, mode: int) -> bytes:
        world = self._world
        since_s = float(world.since_first_edge_s(np.array([t_ns]))[0])
        if not np.isfinite(since_s):
            since_s = -1e3  # not armed yet: at rest
        noise = np.random.default_rng([self._settings.seed, 6, t_ns & 0x7FFFFFFF]).normal(size=9)
        force = _ACC_TAPS[1] @ world.inertial(since_s - _ACC_TAPS[0]).specific_force_mps2
        omega_dps = np.rad2deg(_GYRO_TAPS[1] @ world.inertial(since_s - _GYRO_TAPS[0]).omega_radps)
        force = force + self._acc_bias_mps2 + _ACC_NOISE_MPS2 * noise[:3]
        omega_dps = omega_dps + self._gyro_bias_dps + _GYRO_NOISE_DPS * noise[3:6]
        range_g = _ACC_RANGES_G[self._pages[1][0x08] & 0x03]
        limit = range_g * STANDARD_GRAVITY_MPS2
        acc = _counts(np.clip(force, -limit, limit), 100.0)
        gyro = _counts(np.clip(omega_dps, -2000, 2000), 16.0)
        mag = _counts(np.array([18.0, -4.0, 43.0]) + 0.3 * noise[6:], 16.0) if mode != _ACCGYRO else [0, 0, 0]
        orientation, calibration = self._orientation(t_ns, force) if mode in _FUSION_MODES else ([0] * 13, 0)
        return struct.pack("<22hbB", *acc, *mag, *gyro, *orientation, 31, calibration)

    def _orientation(self, t_ns: int, force_mps2: FloatArray) -> tuple[list[int], int]:
        """Return Euler angles, quaternion, linear acceleration and gravity as counts, and CALIB_STAT."""
        R_camera_brick, _ = self._world.pose(np.array([t_ns], dtype=np.int64))
        R_brick_imu = self._world.brick.R_brick_imu
        R_camera_imu = R_camera_brick[0] @ (np.eye(3) if R_brick_imu is None else R_brick_imu)
        # The gravity frame: z up, heading arbitrary, here the camera's x.
        up = -self._world.gravity_camera_mps2 / np.linalg.norm(self._world.gravity_camera_mps2)
        x = np.array([1.0, 0.0, 0.0]) - up[0] * up
        x /= np.linalg.norm(x)
        R = np.stack([x, np.cross(up, x), up]) @ R_camera_imu
        q = quaternion_from_matrix(R)
        heading = np.rad2deg(np.arctan2(R[1, 0], R[0, 0])) % 360
        roll, pitch = (
            np.rad2deg(np.arctan2(R[2, 1], R[2, 2])),
            np.rad2deg(np.arcsin(np.clip(-R[2, 0], -1, 1))),
        )
        gravity = R.T @ np.array([0.0, 0.0, STANDARD_GRAVITY_MPS2])
        euler = _counts(np.array([heading, roll, pitch]), 16.0)
        return [
            *euler, *_counts(q, 16384.0), *_counts(force_mps2 - gravity, 100.0), *_counts(gravity, 100.0)
        ], 0xFF  # fmt: skip


def _counts(values: FloatArray, lsb: float) -> list[int]:
    return [int(v) for v in np.clip(np.rint(values * lsb), -32768, 32767)]
