"""The running sensor's line time, asked of its kernel driver (V4L2 sub-device).

libcamera tells exposures and frame periods in whole microseconds, from which a line time of 18.9 us cannot be
had to better than a percent: 0.2 ms at the last row. The driver holds what it is made of: a line is
``width + HBLANK`` pixel clocks long. Definitions: linux/videodev2.h, linux/v4l2-controls.h,
linux/v4l2-subdev.h.
"""

import ctypes
import fcntl
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from bricktrack_common.errors import HardwareError

SYSFS_VIDEO = Path("/sys/class/video4linux")
DEVICE_TREE = "firmware/devicetree"

CID_HBLANK = 0x009E0902
CID_PIXEL_RATE = 0x009F0902
_FORMAT_ACTIVE = 1
_WHICH_CURRENT = 0
_READ_WRITE = 3


class _ExtControl(ctypes.Structure):
    _pack_ = 1
    _layout_ = "ms"  # what _pack_ has always meant; Python 3.14 wants it said
    _fields_ = (
        ("id", ctypes.c_uint32),
        ("size", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
        ("value64", ctypes.c_int64),
    )


class _ExtControls(ctypes.Structure):
    _fields_ = (
        ("which", ctypes.c_uint32),
        ("count", ctypes.c_uint32),
        ("error_idx", ctypes.c_uint32),
        ("request_fd", ctypes.c_int32),
        ("reserved", ctypes.c_uint32),
        ("controls", ctypes.POINTER(_ExtControl)),
    )


class _SubdevFormat(ctypes.Structure):
    _fields_ = (
        ("which", ctypes.c_uint32),
        ("pad", ctypes.c_uint32),
        ("width", ctypes.c_uint32),
        ("height", ctypes.c_uint32),
        ("rest", ctypes.c_uint8 * 72),
    )


def _iowr(number: int, size: int) -> int:
    """Return the request number of a V4L2 ioctl that reads and writes ``size`` bytes."""
    return (_READ_WRITE << 30) | (size << 16) | (ord("V") << 8) | number


_G_EXT_CTRLS = _iowr(71, ctypes.sizeof(_ExtControls))
_SUBDEV_G_FMT = _iowr(4, ctypes.sizeof(_SubdevFormat))


@dataclass(frozen=True, slots=True)
class LineTiming:
    """What a sensor's line is made of.

    Attributes
    ----------
    width, height : int, px
        The sensor's output.
    hblank : int, pixel clocks
    pixel_rate_hz : int
    """

    width: int
    height: int
    hblank: int
    pixel_rate_hz: int

    @property
    def line_time_ns(self) -> float:
        """Time from one line's start to the next one's, ns.

        Examples
        --------
        >>> LineTiming(1920, 1080, 1528, 182_400_000).line_time_ns  # IMX219: 3448 clocks a line
        18903.508771929824
        """
        return (self.width + self.hblank) * 1e9 / self.pixel_rate_hz


def get_control(fd: int, control: int) -> int:
    """Return the value of a V4L2 control, 32 or 64 bits wide.

    Raises
    ------
    OSError
        If the driver does not have it.
    """
    one = _ExtControl(id=control)
    request = _ExtControls(which=_WHICH_CURRENT, count=1, controls=ctypes.pointer(one))
    fcntl.ioctl(fd, _G_EXT_CTRLS, request)
    # Which width a control has is fixed by its id; only the lower half is written for a 32-bit one.
    if control == CID_PIXEL_RATE:
        return int(one.value64)
    return ctypes.c_int32(one.value64 & 0xFFFFFFFF).value


def get_output_size(fd: int) -> tuple[int, int]:
    """Return width and height of the active format on a sensor's pad 0, px."""
    fmt = _SubdevFormat(which=_FORMAT_ACTIVE, pad=0)
    fcntl.ioctl(fd, _SUBDEV_G_FMT, fmt)
    return int(fmt.width), int(fmt.height)


def find_sensor(model: str, camera_id: str, *, sysfs: Path = SYSFS_VIDEO) -> Path:
    """Return the device node of a camera's sensor.

    Parameters
    ----------
    model : str
        The sensor's name, as ``imx219``.
    camera_id : str
        libcamera's id of the camera: on a Pi the sensor's path in the device tree.
    sysfs : Path

    Raises
    ------
    HardwareError
        If there is none, or more than one and the id fits none of them.
    """
    found = list(_subdevs(model, sysfs))
    if len(found) > 1:
        by_path = [n for n in found if _device_tree_path(sysfs / n.name) == camera_id]
        found = by_path or found
    if len(found) != 1:
        raise HardwareError(
            f"camera: {len(found)} kernel sensor devices fit {model} at {camera_id}; expected one. Check "
            "with 'v4l2-ctl --list-devices' that the sensor's driver is loaded"
        )
    return found[0]


def _subdevs(model: str, sysfs: Path) -> Iterator[Path]:
    for entry in sorted(sysfs.glob("v4l-subdev*")):
        name = (entry / "name").read_text(encoding="utf-8").strip()
        if name.split()[:1] == [model]:
            yield Path("/dev") / entry.name


def _device_tree_path(entry: Path) -> str | None:
    """Return the path of a video device's sensor in the device tree, as libcamera names it."""
    node = entry / "device" / "of_node"
    if not node.exists():
        return None
    _, _, path = str(node.resolve()).partition(DEVICE_TREE)
    return path or None


def read_line_timing(model: str, camera_id: str, *, sysfs: Path = SYSFS_VIDEO) -> LineTiming:
    """Return the line timing that a configured camera's sensor has now.

    Raises
    ------
    HardwareError
        If the sensor's device cannot be found or read.
    """
    node = find_sensor(model, camera_id, sysfs=sysfs)
    try:
        fd = os.open(node, os.O_RDWR | os.O_CLOEXEC)
    except OSError as e:
        raise HardwareError(
            f"camera: {node}: {e.strerror}. The user needs the group 'video': sudo usermod -aG video USER"
        ) from e
    try:
        width, height = get_output_size(fd)
        timing = LineTiming(width, height, get_control(fd, CID_HBLANK), get_control(fd, CID_PIXEL_RATE))
    except OSError as e:
        raise HardwareError(
            f"camera: {node}: the driver of {model} does not tell its line time ({e.strerror}), without "
            "which pictures have no row times. Use a sensor whose driver has HBLANK and PIXEL_RATE"
        ) from e
    finally:
        os.close(fd)
    if timing.pixel_rate_hz <= 0 or timing.width <= 0 or timing.hblank < 0:
        raise HardwareError(f"camera: {node}: the driver's line timing makes no sense: {timing}")
    return timing
