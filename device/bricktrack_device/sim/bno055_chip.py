"""The registers of a BNO055: two pages, modes, units, axis remap, reset, and samples on the chip's own clock.

Register numbers and codes are those of the data sheet BST-BNO055-DS000.
"""

import struct
from collections.abc import Callable
from concurrent.futures import Executor, Future

import numpy as np

from bricktrack_common.arrays import FloatArray
from bricktrack_common.imu_records import FIRST_REGISTER, LAST_REGISTER, STANDARD_GRAVITY_MPS2
from bricktrack_common.rotations import quaternion_from_matrix
from bricktrack_device.sim.imu_signal import Measured, SensorSetup

N_SAMPLE_BYTES = LAST_REGISTER - FIRST_REGISTER + 1
RESET_S = 0.3  # shorter than a real one's 0.65 s, within which the driver waits anyway
START_S = 0.02  # from a mode's start to its first sample: the registers hold zeros meanwhile
_CALIBRATED_S = 2.0

_PAGE, _TEMP, _CALIB_STAT, _ST_RESULT = 0x07, 0x34, 0x35, 0x36
_SYS_STATUS, _UNIT_SEL, _OPR_MODE, _SYS_TRIGGER = 0x39, 0x3B, 0x3D, 0x3F
_AXIS_MAP, _AXIS_SIGN = 0x41, 0x42
_ACC_OFFSET, _GYRO_OFFSET = 0x55, 0x61
_WRITABLE = {0x3E, _SYS_TRIGGER, 0x40}  # power mode, trigger, source of the temperature
_WRITABLE_IN_CONFIG = {_UNIT_SEL, _AXIS_SIGN, *range(0x55, 0x6B)}
_ACC_CONFIG, _GYRO_CONFIG = 0x08, 0x0A  # page 1
_IDS = bytes([0xA0, 0xFB, 0x32, 0x0F, 0x11, 0x03, 0x15])
_FUSION_ACC_CONFIG, _FUSION_GYRO_CONFIG = 0x0D, 0x38  # 4 g and 62.5 Hz; 2000 deg/s and 32 Hz
_FUSION_MODES = range(0x08, 0x0D)
_WITH_ACC = {0x01, 0x04, 0x05, 0x07, *_FUSION_MODES}
_WITH_MAG = {0x02, 0x04, 0x06, 0x07, 0x09, 0x0A, 0x0B, 0x0C}
_WITH_GYRO = {0x03, 0x05, 0x06, 0x07, 0x08, 0x0B, 0x0C}
_ACC_RANGES_G = (2.0, 4.0, 8.0, 16.0)
_ACC_BANDWIDTHS_HZ = (7.81, 15.63, 31.25, 62.5, 125.0, 250.0, 500.0, 1000.0)
_GYRO_RANGES_DPS = (2000.0, 1000.0, 500.0, 250.0, 125.0)
_GYRO_BANDWIDTHS_HZ = (523.0, 230.0, 116.0, 47.0, 23.0, 12.0, 64.0, 32.0)


class Bno055Chip:
    """One chip; every call says what time it is.

    Parameters
    ----------
    unique_id : bytes, 16
    measure : callable
        Returns what the sensors measure at an instant, ns, with a `SensorSetup`, in the chip's own axes.
    period_s : float
        Between samples.
    ahead : Executor or None
        Works out the next sample while nobody reads, so that a read takes no longer than its bus.
    """

    def __init__(
        self,
        unique_id: bytes,
        measure: Callable[[int, SensorSetup], Measured],
        *,
        period_s: float,
        ahead: Executor | None = None,
    ) -> None:
        self._unique_id = unique_id
        self._measure = measure
        self._period_ns = period_s * 1e9
        self._silent_until_ns = 0
        self._ahead = ahead
        self._next: tuple[int, Future[bytes]] | None = None
        self._latest: tuple[int, bytes] = (-1, bytes(N_SAMPLE_BYTES))
        self.power_up(0)

    @property
    def opr_mode(self) -> int:
        """The operation mode; 0 is CONFIG."""
        return self._page0[_OPR_MODE] & 0x0F

    @property
    def latest(self) -> bytes:
        """Registers 0x08..0x35 as last read."""
        return self._latest[1]

    def power_up(self, t_ns: int) -> None:
        """Start anew with all registers at their defaults, in CONFIG mode."""
        self._page0, self._page1 = bytearray(128), bytearray(128)
        self._page0[: len(_IDS)] = _IDS
        self._page0[_ST_RESULT], self._page0[_UNIT_SEL], self._page0[_AXIS_MAP] = 0x0F, 0x80, 0x24
        self._page1[_ACC_CONFIG], self._page1[0x09], self._page1[_GYRO_CONFIG] = 0x0D, 0x6D, 0x38
        self._page1[0x50:0x60] = self._unique_id
        self._on_page_1 = False
        self._next = None
        self._mode_since_ns = t_ns

    def answers(self, t_ns: int) -> bool:
        """Tell whether the chip is on the bus: not while it resets."""
        return t_ns >= self._silent_until_ns

    def write(self, register: int, values: bytes, t_ns: int) -> None:
        """Write consecutive registers."""
        for i, value in enumerate(values):
            self._write(register + i, value, t_ns)

    def _write(self, register: int, value: int, t_ns: int) -> None:
        config = self.opr_mode == 0
        if register == _PAGE:
            self._on_page_1 = bool(value & 1)
        elif self._on_page_1:
            if config and 0x08 <= register <= 0x1F:
                self._page1[register] = value
        elif register == _SYS_TRIGGER and value & 0x20:
            self.power_up(t_ns)
            self._silent_until_ns = t_ns + round(RESET_S * 1e9)
        elif register == _OPR_MODE:
            self._set_mode(value & 0x0F, t_ns)
        elif register == _AXIS_MAP:
            if config and sorted((value >> shift) & 3 for shift in (0, 2, 4)) == [0, 1, 2]:
                self._page0[register] = value  # an axis named twice is refused, the old map stays
        elif register in _WRITABLE or (config and register in _WRITABLE_IN_CONFIG):
            self._page0[register] = value

    def _set_mode(self, mode: int, t_ns: int) -> None:
        if mode not in _WITH_ACC | _WITH_MAG | _WITH_GYRO | {0}:
            return
        self._page0[_OPR_MODE] = mode
        self._page0[_SYS_STATUS] = 0 if mode == 0 else 5 if mode in _FUSION_MODES else 6
        if mode in _FUSION_MODES:  # fusion owns ranges and bandwidths
            self._page1[_ACC_CONFIG], self._page1[_GYRO_CONFIG] = _FUSION_ACC_CONFIG, _FUSION_GYRO_CONFIG
        self._mode_since_ns = t_ns
        self._next = None
        self._latest = -1, bytes(N_SAMPLE_BYTES)

    def read(self, register: int, n_bytes: int, t_ns: int) -> bytes:
        """Read consecutive registers of the page that is chosen."""
        if self._on_page_1:
            self._page1[_PAGE] = 1
            return bytes(self._page1[register : register + n_bytes])
        if register <= LAST_REGISTER and register + n_bytes > FIRST_REGISTER:
            self._page0[FIRST_REGISTER : LAST_REGISTER + 1] = self._sample(t_ns)
        return bytes(self._page0[register : register + n_bytes])

    def _sample(self, t_ns: int) -> bytes:
        """Return registers 0x08..0x35 of the latest sample by the chip's clock."""
        first_ns = self._mode_since_ns + round(START_S * 1e9)
        if self.opr_mode == 0 or t_ns < first_ns:
            return bytes(N_SAMPLE_BYTES)
        k = int((t_ns - first_ns) / self._period_ns)
        if k != self._latest[0]:
            if self._next is not None and self._next[0] == k:
                self._latest = k, self._next[1].result()
            else:
                self._latest = k, self._registers(first_ns + round(k * self._period_ns))
            if self._ahead is not None:
                next_ns = first_ns + round((k + 1) * self._period_ns)
                self._next = k + 1, self._ahead.submit(self._registers, next_ns)
        return self._latest[1]

    def _registers(self, t_ns: int) -> bytes:
        mode = self.opr_mode
        setup = self._setup()
        measured = self._measure(t_ns, setup)
        remap = self._remap()
        acc_lsb, gyro_lsb, angle_lsb = self._scales(setup)
        acc_counts = _counts(remap @ measured.acc_mps2, acc_lsb, mode in _WITH_ACC)
        mag_counts = _counts(remap @ measured.mag_ut, 16.0, mode in _WITH_MAG)
        gyro_counts = _counts(remap @ measured.gyro_dps, gyro_lsb, mode in _WITH_GYRO)
        fused, calibration = [0] * 13, 0
        if mode in _FUSION_MODES:
            acc_counts -= self._offsets(_ACC_OFFSET)
            gyro_counts -= self._offsets(_GYRO_OFFSET)
            fused = _fused(measured.R_gravity_imu @ remap.T, acc_counts / acc_lsb, acc_lsb, angle_lsb)
            calibration = 0xFF if t_ns - self._mode_since_ns > _CALIBRATED_S * 1e9 else 0
        words = [*_limited(acc_counts), *_limited(mag_counts), *_limited(gyro_counts), *fused]
        return struct.pack("<22hbB", *words, 31, calibration)

    def _setup(self) -> SensorSetup:
        acc, gyro = self._page1[_ACC_CONFIG], self._page1[_GYRO_CONFIG]
        return SensorSetup(
            acc_range_g=_ACC_RANGES_G[acc & 0x03],
            acc_bandwidth_hz=_ACC_BANDWIDTHS_HZ[(acc >> 2) & 0x07],
            gyro_range_dps=_GYRO_RANGES_DPS[min(gyro & 0x07, len(_GYRO_RANGES_DPS) - 1)],
            gyro_bandwidth_hz=_GYRO_BANDWIDTHS_HZ[(gyro >> 3) & 0x07],
        )

    def _scales(self, setup: SensorSetup) -> tuple[float, float, float]:
        """Return counts per m/s^2, per deg/s and per degree."""
        units = self._page0[_UNIT_SEL]
        acc = 1000 / STANDARD_GRAVITY_MPS2 if units & 0x01 else 100.0
        degrees_per_rad = 180 / np.pi
        gyro = 900.0 / degrees_per_rad if units & 0x02 else 16.0
        angle = 900.0 / degrees_per_rad if units & 0x04 else 16.0
        # Outside fusion the gyroscope's scale follows its range (firmware; so does the kernel's driver).
        return acc, gyro * 2000.0 / setup.gyro_range_dps, angle

    def _remap(self) -> FloatArray:
        """Return the matrix from the chip's axes to the registers'."""
        places, signs = self._page0[_AXIS_MAP], self._page0[_AXIS_SIGN]
        remap = np.zeros((3, 3))
        for row in range(3):
            remap[row, (places >> (2 * row)) & 3] = -1.0 if (signs >> (2 - row)) & 1 else 1.0
        return remap

    def _offsets(self, register: int) -> FloatArray:
        return np.array(struct.unpack_from("<3h", self._page0, register), dtype=np.float64)


def _fused(R_gravity_imu: FloatArray, acc_mps2: FloatArray, acc_lsb: float, angle_lsb: float) -> list[int]:
    """Return Euler angles, quaternion, linear acceleration and gravity as counts."""
    R = R_gravity_imu
    heading = np.rad2deg(np.arctan2(R[1, 0], R[0, 0])) % 360
    roll = np.rad2deg(np.arctan2(R[2, 1], R[2, 2]))
    pitch = np.rad2deg(np.arcsin(np.clip(-R[2, 0], -1, 1)))
    gravity = STANDARD_GRAVITY_MPS2 * R[2]
    return [
        *_limited(_counts(np.array([heading, roll, pitch]), angle_lsb)),
        *_limited(_counts(quaternion_from_matrix(R), 16384.0)),
        *_limited(_counts(acc_mps2 - gravity, acc_lsb)),
        *_limited(_counts(gravity, acc_lsb)),
    ]


def _counts(values: FloatArray, lsb: float, measured: bool = True) -> FloatArray:
    return np.rint(values * lsb) if measured else np.zeros_like(values)


def _limited(counts: FloatArray) -> list[int]:
    return [int(c) for c in np.clip(counts, -32768, 32767)]
