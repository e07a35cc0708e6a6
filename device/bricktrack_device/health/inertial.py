"""An inertial sensor: its bus, its identity, and its power-on self-test."""

from collections.abc import Mapping

from bricktrack_common.errors import HardwareError
from bricktrack_device.config import ImuTable
from bricktrack_device.health.findings import CheckResult, failure, good, warning
from bricktrack_device.inertial.bno055 import CHIP_ID, MODE_NAMES, REG_ST_RESULT, REG_SYS_STATUS, read_chip_id
from bricktrack_device.interfaces import Rig

_PARTS = ("accelerometer", "magnetometer", "gyroscope", "processor")
_BIT_BANGED = "i2c-gpio"


def check_imu(imu: ImuTable, rig: Rig) -> list[CheckResult]:
    """Read who answers on the bus, without disturbing it; raises `HardwareError` where nobody does."""
    name = f"imu {imu.name}"
    bus = rig.bus_opener(imu.bus)()
    try:
        chip_id = read_chip_id(bus, imu.address)
        if chip_id != CHIP_ID:
            raise HardwareError(
                f"chip id 0x{chip_id:02X} at address 0x{imu.address:02X} on {imu.bus}; expected 0xA0"
            )
        self_test = bus.read_burst(imu.address, REG_ST_RESULT, 1)[0]
        status = bus.read_burst(imu.address, REG_SYS_STATUS, 5)
    finally:
        bus.close()
    mode = MODE_NAMES.get(status[4] & 0x0F, f"0x{status[4]:02X}")
    words = f"BNO055 at address 0x{imu.address:02X} on {imu.bus} answers with id 0xA0, is in mode {mode}"
    remedy = "Switch the sensor's supply off and on; if it says so again, replace the sensor"
    failed = [part for bit, part in enumerate(_PARTS) if not self_test >> bit & 1]
    if failed:
        words += f"; self-test not passed: {', '.join(failed)} (ST_RESULT 0x{self_test:02X})"
        return [failure(name, words, remedy)]
    if status[0] == 1:
        return [failure(name, f"{words}; system error {status[1]} (SYS_ERR)", remedy)]
    return [good(name, f"{words}; self-test passed")]


def check_adapter(imu: ImuTable, described: Mapping[str, str], *, simulated: bool) -> list[CheckResult]:
    """See that the bus is one that bears a BNO055; ``described`` is the rig's own account."""
    name = f"bus of imu {imu.name}"
    if simulated:
        return [good(name, f"{imu.bus} is simulated")]
    adapter = described.get(f"i2c.{imu.bus}")
    if adapter is None:
        return [
            failure(
                name,
                f"{imu.bus} has no adapter",
                "Enable the i2c-gpio overlay (docs/device-setup.md, step 3)",
            )
        ]
    if _BIT_BANGED in adapter:
        return [good(name, f"{imu.bus} is {adapter}")]
    return [
        warning(
            name,
            f"{imu.bus} is {adapter}; expected one made by {_BIT_BANGED}: the Raspberry Pi's own controllers "
            "corrupt bytes when a BNO055 stretches the clock",
            "Wire the sensor to an i2c-gpio bus (docs/device-setup.md, step 3)",
        )
    ]
