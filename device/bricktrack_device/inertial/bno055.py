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
from bricktrack_common.imu_records import AxisMap
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
REG_OPR_MODE = 0x3D
REG_AXIS_MAP = 0x41
"""AXIS_MAP_CONFIG, and AXIS_MAP_SIGN behind it."""
REG_CALIBRATION = 0x55
N_CALIBRATION_BYTES = 22
"""Offsets and radii, 0x55..0x6A; the chip takes them when the last byte is written."""
CALIBRATED = 0xFF
CALIBRATED_WITHOUT_MAGNETOMETER = 0x3C
"""Gyroscope and accelerometer alone: all that IMUPLUS calibrates."""
AXIS_MAPS: dict[AxisMap, tuple[int, int]] = {
    "P0": (0x21, 0x04), "P1": (0x24, 0x00), "P2": (0x24, 0x06), "P3": (0x21, 0x02),
    "P4": (0x24, 0x03), "P5": (0x21, 0x01), "P6": (0x21, 0x07), "P7": (0x24, 0x05),
}  # fmt: skip
"""AXIS_MAP_CONFIG and AXIS_MAP_SIGN of the placements (data sheet, table 3-4 and figure 4)."""
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
_TO_CONFIG_S = 0.02
"""The data sheet's 19 ms; any other change takes 7 ms."""


@dataclass(frozen=True, slots=True)
class SensorFacts:
    """What a sensor is and how it was set, as read back from it.

    Attributes
    ----------
    chip_id : str
        The unique id as hex, or ``""`` where it could not be read.
    acc_range_g, gyro_range_dps : float
        From the configuration registers, not from what was asked for.
    axis_map : str
        As read back.
    calibration_restored : bool
        Whether a saved calibration was written and read back.
    warnings : list of str
    """

    chip_id: str
    opr_mode: int
    fusion: bool
    acc_range_g: float
    gyro_range_dps: float
    calibration: int
    axis_map: AxisMap
    calibration_restored: bool
    warnings: list[str]


def set_up(
    bus: I2cBus,
    address: int,
    mode: ImuMode,
    *,
    axis_map: AxisMap = "P1",
    saved_calibration: Callable[[str], bytes | None] = lambda chip_id: None,
    sleep: Callable[[float], None] = time.sleep,
) -> SensorFacts:
    """Reset a sensor, set mode, ranges, axes and units, read everything back.

    In the raw modes the accelerometer is set to ±16 g, bandwidth 62.5 Hz, and the gyroscope to 2000 dps,
    32 Hz. Fusion modes own these settings (±4 g): there they are only read. ``saved_calibration`` is asked
    with the chip's id in a fusion mode (raw data are not compensated), and what it returns is written.

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
        _set_axis_map(bus, address, axis_map)
        warnings = _self_test_words(_read(bus, address, REG_ST_RESULT))
        chip_id = _unique_id(bus, address)
        calibration_registers = saved_calibration(chip_id) if fusion else None
        if calibration_registers is not None:
            _write_calibration(bus, address, calibration_registers)
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
        axis_map=axis_map,
        calibration_restored=calibration_registers is not None,
        warnings=warnings,
    )


def is_calibrated(opr_mode: int, calib_stat: int) -> bool:
    """Tell whether CALIB_STAT says that everything is calibrated that a fusion mode uses."""
    if opr_mode not in FUSION_MODES:
        return False  # the raw modes calibrate nothing
    needed = CALIBRATED if opr_mode == OPR_MODES["ndof"] else CALIBRATED_WITHOUT_MAGNETOMETER
    return calib_stat & needed == needed


def read_calibration(
    bus: I2cBus, address: int, opr_mode: int, *, sleep: Callable[[float], None] = time.sleep
) -> tuple[bytes, int] | None:
    """Return a calibrated sensor's 22 bytes and its CALIB_STAT, `None` if it is not calibrated.

    Never during a run: the sensor goes to CONFIG mode for it, and back to ``opr_mode``.

    Raises
    ------
    HardwareError
        If the bus fails.
    """
    try:
        calib_stat = _read(bus, address, REG_CALIB_STAT)
        if not is_calibrated(opr_mode, calib_stat):
            return None
        _write(bus, address, REG_OPR_MODE, 0)
        sleep(_TO_CONFIG_S)
        try:
            registers = bus.read_burst(address, REG_CALIBRATION, N_CALIBRATION_BYTES)
        finally:
            _write(bus, address, REG_OPR_MODE, opr_mode)
            sleep(_TO_CONFIG_S)
    except OSError as e:
        raise HardwareError(_bus_words(address, "when its calibration was read", e)) from e
    return registers, calib_stat


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


def _set_axis_map(bus: I2cBus, address: int, axis_map: AxisMap) -> None:
    """Write both registers at once, in CONFIG mode; the chip keeps the old map if it dislikes the new one."""
    wanted = bytes(AXIS_MAPS[axis_map])
    if bus.read_burst(address, REG_AXIS_MAP, 2) != wanted:
        _write(bus, address, REG_AXIS_MAP, *wanted)
    now = bus.read_burst(address, REG_AXIS_MAP, 2)
    if now != wanted:
        raise HardwareError(
            f"IMU at I2C address 0x{address:02X}: axis map reads {now.hex()} after {wanted.hex()} "
            f"({axis_map}) was written. Check its supply, then run 'bricktrackd check'"
        )


def _write_calibration(bus: I2cBus, address: int, registers: bytes) -> None:
    if len(registers) != N_CALIBRATION_BYTES:
        raise HardwareError(f"a calibration has {N_CALIBRATION_BYTES} bytes; got {len(registers)}")
    _write(bus, address, REG_CALIBRATION, *registers)
    now = bus.read_burst(address, REG_CALIBRATION, N_CALIBRATION_BYTES)
    if now != registers:
        raise HardwareError(
            f"IMU at I2C address 0x{address:02X}: calibration reads {now.hex()} after {registers.hex()} was "
            "written. Delete its file in the storage folder's calibration/ to start without"
        )


def _write(bus: I2cBus, address: int, register: int, *values: int) -> None:
    while not bus.try_lock():
        time.sleep(0.001)
    try:
        bus.writeto(address, bytes([register, *values]))
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
