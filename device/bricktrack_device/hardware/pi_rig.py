"""All the hardware of one unit on a Raspberry Pi."""

import logging
import os
import platform
from collections.abc import Sequence
from pathlib import Path

import gpiozero

from bricktrack_common.errors import HardwareError
from bricktrack_device.config import CameraTable, DeviceConfig
from bricktrack_device.hardware.camera_settings import MODES, PiCameraSettings
from bricktrack_device.hardware.led_bank import LedBank
from bricktrack_device.hardware.lgpio_pins import open_pin_factory
from bricktrack_device.hardware.pi_camera import PiCamera
from bricktrack_device.hardware.smbus_i2c import SmbusOpener, adapter_of, adapter_warning
from bricktrack_device.hardware.versions import versions_of
from bricktrack_device.interfaces import BusOpener, Camera

logger = logging.getLogger(__name__)

_DISTRIBUTIONS = (
    "adafruit-circuitpython-bno055",
    "av",
    "gpiozero",
    "lgpio",
    "numpy",
    "picamera2",
    "smbus2",
)


class PiRig:
    """The hardware of a unit: meets `bricktrack_device.interfaces.Rig`.

    Parameters
    ----------
    config : DeviceConfig
    """

    simulated = False

    def __init__(self, config: DeviceConfig) -> None:
        self._config = config
        self._factory: gpiozero.Factory | None = None
        self._buses: dict[str, str] = {}

    def configure(self, config: DeviceConfig) -> None:
        """Use another configuration from the next opening of a part on."""
        self._config = config

    def open_camera(self) -> Camera:
        """Return the camera, not yet started."""
        return PiCamera(camera_settings(self._config.camera))

    def pin_factory(self) -> gpiozero.Factory:
        """Return the one factory of this rig: lgpio, or a `HardwareError`."""
        if self._factory is None:
            self._factory = open_pin_factory()
        return self._factory

    def bus_opener(self, bus: str) -> BusOpener:
        """Return what opens an I2C bus; warn if its adapter is not the right kind, or not there.

        A missing bus is an error only where it is opened: the camera may still serve.
        """
        if bus not in self._buses:
            try:
                adapter = adapter_of(bus)
                warning = adapter_warning(bus)
                self._buses[bus] = f"{adapter.name} ({adapter.driver or 'no driver named'})"
            except HardwareError as e:
                warning = str(e)
            if warning is not None:
                logger.warning("%s", warning)
        return SmbusOpener(bus)

    def leds(self, pins: Sequence[str], *, active_high: bool = True) -> LedBank:
        """Return the LEDs on some pins, switched off."""
        return LedBank(pins, self.pin_factory(), active_high=active_high)

    def on_armed(self, t_armed_ns: int) -> None:
        """Do nothing: a real table shakes when it likes."""

    def write_truth(self, folder: Path, *, start_ns: int, end_ns: int) -> Path | None:
        """Return `None`: nobody knows a real brick's true motion."""
        return None

    def describe(self) -> dict[str, str]:
        """Return model, serial number, system, kernel and library versions, and the I2C adapters in use."""
        found = {
            "model": board_model(),
            "serial": _device_tree_text("serial-number") or "unknown",
            "system": platform.freedesktop_os_release().get("PRETTY_NAME", "unknown"),
            "kernel": f"{os.uname().release} {os.uname().version}",
            "machine": os.uname().machine,
            "python": platform.python_version(),
        }
        found |= {f"library.{k}": v for k, v in versions_of(_DISTRIBUTIONS).items()}
        libcamera = libcamera_version()
        if libcamera:
            found["library.libcamera"] = libcamera
        found |= {f"i2c.{bus}": adapter for bus, adapter in self._buses.items()}
        return found

    def close(self) -> None:
        """Give the pins back. Calling it twice does no harm."""
        factory, self._factory = self._factory, None
        if factory is not None:
            factory.close()


def camera_settings(table: CameraTable) -> PiCameraSettings:
    """Return what a configuration's camera table says."""
    return PiCameraSettings(
        mode=MODES[table.mode],
        qp=table.qp,
        exposure_us=table.exposure_us,
        analogue_gain=table.analogue_gain,
        colour_gains=table.colour_gains,
        frame_rate_hz=table.frame_rate_hz,
        bitrate_bps=table.bitrate_bps,
        iperiod=table.iperiod,
    )


def board_model() -> str:
    """Return the board's name, from the device tree or, without one, from /proc/cpuinfo."""
    model = _device_tree_text("model")
    if model:
        return model
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "Model":
                return value.strip()
    except OSError:
        pass
    return "unknown"


def _device_tree_text(name: str) -> str | None:
    try:
        raw = Path("/proc/device-tree", name).read_bytes()
    except OSError:
        return None
    return raw.rstrip(b"\0").decode("utf-8", errors="replace")


def libcamera_version() -> str | None:
    """Return libcamera's version, or `None` where it is not installed."""
    try:
        import libcamera
    except ImportError:
        return None
    return str(libcamera.CameraManager.version)
