"""An I2C bus by smbus2: whole transactions with a repeated start, errors as they come from the kernel."""

import errno
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import smbus2

from bricktrack_common.errors import HardwareError

SYSFS_I2C = Path("/sys/bus/i2c/devices")
GPIO_DRIVER = "i2c-gpio"
MAX_MESSAGE_BYTES = 8192
"""What i2c-dev takes in one message (kernel i2c-dev.c)."""


class SmbusI2c:
    """An I2C bus as the Adafruit driver wants it, and one burst read for the hot path.

    Parameters
    ----------
    bus : str
        Device node, as ``/dev/i2c-3``.

    Raises
    ------
    HardwareError
        If the bus cannot be opened.

    Notes
    -----
    Every transfer is one ``I2C_RDWR`` ioctl: SMBus block reads stop at 32 bytes, and a write and a read of
    their own let another program in between. A device that does not answer is ``OSError`` EREMOTEIO (or
    ENXIO, by driver), a clock line held low ``OSError`` ETIMEDOUT; nothing is retried.
    """

    def __init__(self, bus: str) -> None:
        self._lock = threading.Lock()
        self._bursts: dict[tuple[int, int, int], tuple[Any, Any]] = {}
        try:
            self._bus: smbus2.SMBus | None = smbus2.SMBus(bus)
        except OSError as e:
            raise HardwareError(f"I2C bus {bus}: {e.strerror}. {_advice(bus, e)}") from e

    def try_lock(self) -> bool:
        """Take the bus; tell whether that worked."""
        return self._lock.acquire(blocking=False)

    def unlock(self) -> None:
        """Give the bus back."""
        self._lock.release()

    def writeto(self, address: int, buffer: bytes, *, start: int = 0, end: int | None = None) -> None:
        """Write bytes to a device."""
        self._transfer(smbus2.i2c_msg.write(address, bytes(buffer[start:end])))

    def readfrom_into(
        self, address: int, buffer: bytearray, *, start: int = 0, end: int | None = None
    ) -> None:
        """Read bytes from a device into ``buffer``."""
        n_bytes = len(range(len(buffer))[start:end])
        message = smbus2.i2c_msg.read(address, n_bytes)
        self._transfer(message)
        buffer[start : start + n_bytes] = bytes(message)

    def writeto_then_readfrom(
        self, address: int, out_buffer: bytes, in_buffer: bytearray, *, out_start: int = 0,
        out_end: int | None = None, in_start: int = 0, in_end: int | None = None,
    ) -> None:  # fmt: skip
        """Write, then read with a repeated start."""
        n_bytes = len(range(len(in_buffer))[in_start:in_end])
        message = smbus2.i2c_msg.read(address, n_bytes)
        self._transfer(smbus2.i2c_msg.write(address, bytes(out_buffer[out_start:out_end])), message)
        in_buffer[in_start : in_start + n_bytes] = bytes(message)

    def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
        """Read consecutive registers in one transaction; raise `OSError` with its errno on failure.

        The messages are made once for each (address, register, length): the hot path makes no garbage but
        the bytes it returns.
        """
        key = (address, register, n_bytes)
        messages = self._bursts.get(key)
        if messages is None:
            if not 0 < n_bytes <= MAX_MESSAGE_BYTES:
                raise OSError(errno.EINVAL, f"a burst of {n_bytes} bytes; expected 1 to {MAX_MESSAGE_BYTES}")
            messages = smbus2.i2c_msg.write(address, [register]), smbus2.i2c_msg.read(address, n_bytes)
            self._bursts[key] = messages
        self._transfer(*messages)
        return bytes(messages[1])

    def close(self) -> None:
        """Release the bus. Calling it twice does no harm."""
        bus, self._bus = self._bus, None
        if bus is not None:
            bus.close()

    def _transfer(self, *messages: Any) -> None:
        if self._bus is None:
            raise OSError(errno.EBADF, "the I2C bus is closed")
        self._bus.i2c_rdwr(*messages)


@dataclass(frozen=True, slots=True)
class SmbusOpener:
    """Opens one bus; picklable, because the sampler's process opens its own."""

    bus: str

    def __call__(self) -> SmbusI2c:
        """Return the bus, open."""
        return SmbusI2c(self.bus)


@dataclass(frozen=True, slots=True)
class Adapter:
    """The kernel's adapter behind a bus: its name, and the name of its driver if it has one."""

    name: str
    driver: str | None

    @property
    def is_bit_banged(self) -> bool:
        """Whether the clock and data lines are GPIO pins, driven by software."""
        return self.driver == GPIO_DRIVER or self.name.startswith(GPIO_DRIVER)


def adapter_of(bus: str, *, sysfs: Path = SYSFS_I2C) -> Adapter:
    """Return the adapter behind a bus.

    Parameters
    ----------
    bus : str
        Device node, as ``/dev/i2c-3``; links are followed.
    sysfs : Path

    Raises
    ------
    HardwareError
        If there is no such adapter.
    """
    entry = sysfs / os.path.basename(os.path.realpath(bus))  # noqa: PTH119  a text, maybe no file
    try:
        name = (entry / "name").read_text(encoding="utf-8").strip()
    except OSError as e:
        raise HardwareError(f"I2C bus {bus} has no adapter: {e.strerror}. {_advice(bus, e)}") from e
    # The adapter's parent is the device whose driver made it.
    driver = entry.resolve().parent / "driver"
    return Adapter(name, driver.resolve().name if driver.exists() else None)


def adapter_warning(bus: str, *, sysfs: Path = SYSFS_I2C) -> str | None:
    """Return why a bus is not the right one for a BNO055, or `None` if it is.

    The overlay's adapter is called ``i2c@3``, not i2c-gpio (the kernel's i2c-gpio.c takes the device tree's
    name), so the driver is what tells.
    """
    adapter = adapter_of(bus, sysfs=sysfs)
    if adapter.is_bit_banged:
        return None
    by = f", driver {adapter.driver}" if adapter.driver else ""
    return (
        f"I2C bus {bus} is {adapter.name!r}{by}; expected one made by {GPIO_DRIVER}. The hardware buses of "
        "the Raspberry Pi corrupt bytes when a BNO055 stretches the clock. Wire the sensor to an i2c-gpio "
        "bus (docs/device-setup.md)"
    )


def _advice(bus: str, e: OSError) -> str:
    if e.errno in (errno.EACCES, errno.EPERM):
        return "The user needs the group 'i2c': sudo usermod -aG i2c USER"
    if e.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return (
            "Enable the bus in /boot/firmware/config.txt: dtparam=i2c_arm=off and "
            "dtoverlay=i2c-gpio,bus=3,i2c_gpio_sda=2,i2c_gpio_scl=3,i2c_gpio_delay_us=2, load the module "
            "i2c-dev, and reboot (docs/device-setup.md)"
        )
    return f"Check with 'i2cdetect -l' what {bus} is"
