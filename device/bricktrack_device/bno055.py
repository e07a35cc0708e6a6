"""Setting up a BNO055 through the Adafruit driver, and reading back what it really does.

Only set-up goes through the driver: each of its properties costs two transactions, so samples are read by
`imu_reader` in one burst. Register numbers are those of the data sheet BST-BNO055-DS000 (pages 0 and 1).
"""

import errno
import time
from collections.abc import Callable
from dataclasses import dataclass

import adafruit_bno055

from bricktrack_common.errors import HardwareError
from bricktrack_device.config import ImuMode
from bricktrack_device.interfaces import I2cBus

CHIP_ID = 0xA0
OPR_MODES: dict[ImuMode, int] = {"accgyro": 0x05, "amg": 0x07, "imuplus": 0x08, "ndof": 0x0C}
FUSION_MODES = frozenset({0x08, 0x0C})
MODE_NAMES = {0x00: "CONFIG", 0x05: "ACCGYRO", 0x07: "AMG", 0x08: "IMUPLUS", 0x0C: "NDOF"}

REG_CHIP_ID = 0x00
REG_PAGE = 0x07
REG_CALIB_STAT = 0x35
REG_ST_RESULT = 0x36
REG_SYS_STATUS = 0x39
REG_UNIT_SEL = 0x3B
N_STATUS_BYTES = 5
"""One burst from SYS_STATUS to OPR_MODE (0x39..0x3D)."""
REG1_ACC_CONFIG = 0x08
REG1_GYR_CONFIG_0 = 0x0A
REG1_UNIQUE_ID = 0x50
N_UNIQUE_ID_BYTES = 16

_ACC_CONFIG_16G_62HZ5 = 0x0F
_GYR_CONFIG_2000DPS_32HZ = 0x38
_UNIT_SEL_DEFAULT = 0x80
_UNITS_THAT_SCALE = 0x03
_ACC_RANGES_G = (2.0, 4.0, 8.0, 16.0)
_GYRO_RANGES_DPS = (2000.0, 1000.0, 500.0, 250.0, 125.0)
_SELF_TEST_PASSED = 0x0F
_ATTEMPTS = 3


@dataclass(frozen=True, slots=True)
class SensorFacts:
    """What a sensor is and how it was set, as read back from it.

    Attributes
    ----------
    chip_id : str
        The unique id as hex, or ``""`` where it could not be read.
    acc_range_g, gyro_range_dps : float
        From the configuration registers, not from what was asked for.
    warnings : list of str
    """

    chip_id: str
    opr_mode: int
    fusion: bool
    acc_range_g: float
    gyro_range_dps: float
    calibration: int
    warnings: list[str]


def set_up(
    bus: I2cBus, address: int, mode: ImuMode, *, sleep: Callable[[float], None] = time.sleep
) -> SensorFacts:
    """Reset a sensor, set mode, ranges and units, read everything back.

    In the raw modes the accelerometer is set to ±16 g, bandwidth 62.5 Hz, and the gyroscope to 2000 dps,
    32 Hz. Fusion modes own these settings (±4 g): there they are only read.

    Raises
    ------
    HardwareError
        If the sensor is missing, is no BNO055, or does not hold what it was told.
    """
    driver = _open_driver(bus, address, sleep)
    opr_mode = OPR_MODES[mode]
    fusion = opr_mode in FUSION_MODES
    try:
        driver.mode = adafruit_bno055.CONFIG_MODE
        if not fusion:
            driver.accel_range = adafruit_bno055.ACCEL_16G
            driver.accel_bandwidth = adafruit_bno055.ACCEL_62_5HZ
            driver.gyro_range = adafruit_bno055.GYRO_2000_DPS
            driver.gyro_bandwidth = adafruit_bno055.GYRO_32HZ
            _make_sure(bus, address, REG1_ACC_CONFIG, _ACC_CONFIG_16G_62HZ5, page=1, what="ACC_CONFIG")
            _make_sure(bus, address, REG1_GYR_CONFIG_0, _GYR_CONFIG_2000DPS_32HZ, page=1, what="GYR_CONFIG_0")
        if _read(bus, address, REG_UNIT_SEL) & _UNITS_THAT_SCALE:
            _make_sure(bus, address, REG_UNIT_SEL, _UNIT_SEL_DEFAULT, page=0, what="UNIT_SEL")
        warnings = _self_test_words(_read(bus, address, REG_ST_RESULT))
        chip_id = _unique_id(bus, address)
        driver.mode = opr_mode
        sleep(0.02)
        mode_now = int(driver.mode)
        if mode_now != opr_mode:
            raise HardwareError(
                f"IMU at I2C address 0x{address:02X}: operation mode reads 0x{mode_now:02X} after "
                f"0x{opr_mode:02X} ({MODE_NAMES[opr_mode]}) was written. Check its supply, then run "
                "'bricktrackd check'"
            )
        acc_config = _read_page_1(bus, address, REG1_ACC_CONFIG)
        gyro_code = _read_page_1(bus, address, REG1_GYR_CONFIG_0) & 0x07
        calibration = _read(bus, address, REG_CALIB_STAT)
    except HardwareError:
        raise
    except OSError as e:
        raise HardwareError(_bus_words(address, "during its set-up", e)) from e
    if gyro_code >= len(_GYRO_RANGES_DPS):
        raise HardwareError(
            f"IMU at I2C address 0x{address:02X}: gyroscope range code {gyro_code} is unknown"
        )
    if fusion and gyro_code:
        raise HardwareError(
            f"IMU at I2C address 0x{address:02X}: the gyroscope's range is not 2000 dps in "
            f"{MODE_NAMES[opr_mode]}"
        )
    return SensorFacts(
        chip_id=chip_id,
        opr_mode=opr_mode,
        fusion=fusion,
        acc_range_g=_ACC_RANGES_G[acc_config & 0x03],
        gyro_range_dps=_GYRO_RANGES_DPS[gyro_code],
        calibration=calibration,
        warnings=warnings,
    )


def read_chip_id(bus: I2cBus, address: int) -> int:
    """Return the chip id register without disturbing the sensor; 0xA0 is a BNO055.

    Raises
    ------
    HardwareError
        If nothing answers.
    """
    try:
        return _read(bus, address, REG_CHIP_ID)
    except OSError as e:
        raise HardwareError(_bus_words(address, "when asked for its id", e)) from e


def _open_driver(bus: I2cBus, address: int, sleep: Callable[[float], None]) -> "adafruit_bno055.BNO055_I2C":
    """Return the driver; its constructor resets the chip, which may not answer for a second afterwards."""
    problem: Exception | None = None
    for attempt in range(_ATTEMPTS):
        if attempt:
            sleep(0.5)
        try:
            return adafruit_bno055.BNO055_I2C(bus, address)
        except (OSError, RuntimeError, ValueError) as e:
            problem = e
    if isinstance(problem, OSError):
        raise HardwareError(_bus_words(address, "during its reset", problem)) from problem
    raise HardwareError(
        f"IMU at I2C address 0x{address:02X}: {problem}; expected a BNO055 with chip id 0xA0. "
        "Check wiring and the address (0x28 or 0x29), then run 'bricktrackd check'"
    ) from problem


def _bus_words(address: int, when: str, error: OSError) -> str:
    name = errno.errorcode.get(error.errno, "no errno") if error.errno is not None else "no errno"
    return (
        f"IMU at I2C address 0x{address:02X} does not answer {when}: {error.strerror or error} ({name}). "
        "Check wiring and supply; EREMOTEIO is a missing sensor, ETIMEDOUT a stuck bus"
    )


def _self_test_words(result: int) -> list[str]:
    if result & 0x0F == _SELF_TEST_PASSED:
        return []
    parts = ("accelerometer", "magnetometer", "gyroscope", "processor")
    failed = [name for bit, name in enumerate(parts) if not result >> bit & 1]
    return [f"power-on self-test not passed: {', '.join(failed)} (ST_RESULT 0x{result:02X})"]


def _write(bus: I2cBus, address: int, register: int, value: int) -> None:
    while not bus.try_lock():
        time.sleep(0.001)
    try:
        bus.writeto(address, bytes([register, value]))
    finally:
        bus.unlock()


def _read(bus: I2cBus, address: int, register: int) -> int:
    return bus.read_burst(address, register, 1)[0]


def _read_page_1(bus: I2cBus, address: int, register: int) -> int:
    _write(bus, address, REG_PAGE, 1)
    try:
        return _read(bus, address, register)
    finally:
        _write(bus, address, REG_PAGE, 0)


def _make_sure(bus: I2cBus, address: int, register: int, value: int, *, page: int, what: str) -> None:
    """Write a register directly unless it already reads as wanted; it must read so in the end."""
    read = _read_page_1 if page == 1 else _read
    if read(bus, address, register) == value:
        return
    if page == 1:
        _write(bus, address, REG_PAGE, 1)
    try:
        _write(bus, address, register, value)
    finally:
        if page == 1:
            _write(bus, address, REG_PAGE, 0)
    now = read(bus, address, register)
    if now != value:
        raise HardwareError(
            f"IMU at I2C address 0x{address:02X}: {what} reads 0x{now:02X} after 0x{value:02X} was written"
        )


def _unique_id(bus: I2cBus, address: int) -> str:
    _write(bus, address, REG_PAGE, 1)
    try:
        return bus.read_burst(address, REG1_UNIQUE_ID, N_UNIQUE_ID_BYTES).hex()
    except OSError:
        return ""
    finally:
        _write(bus, address, REG_PAGE, 0)
