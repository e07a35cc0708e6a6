"""The kernel's words for a sensor. The calls themselves are tried on a kernel in tests/virtual_pi."""

import ctypes
from pathlib import Path

import pytest

from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware import sensor_subdev
from bricktrack_device.hardware.sensor_subdev import LineTiming, find_sensor, read_line_timing

CSI_0 = "/base/axi/pcie@120000/rp1/i2c@88000/imx219@10"
CSI_1 = "/base/axi/pcie@120000/rp1/i2c@80000/imx219@10"


@pytest.mark.skipif(ctypes.sizeof(ctypes.c_void_p) != 8, reason="the numbers below are of 64-bit kernels")
def test_the_requests_are_the_kernels() -> None:
    # From linux/videodev2.h and linux/v4l2-subdev.h on a 64-bit machine, as strace prints them.
    assert sensor_subdev._G_EXT_CTRLS == 0xC0205647
    assert sensor_subdev._SUBDEV_G_FMT == 0xC0585604
    assert ctypes.sizeof(sensor_subdev._ExtControl) == 20


def test_a_line_is_its_pixel_clocks_long() -> None:
    # IMX219, kernel imx219.c: 3448 clocks a line at 182.4 MHz, whatever the mode's width.
    for width in (1920, 1640, 3280):
        timing = LineTiming(width, 1080, 3448 - width, 182_400_000)
        assert timing.line_time_ns == pytest.approx(18903.5088, abs=1e-4)


def sysfs_with(tmp_path: Path, devices: dict[str, tuple[str, str]]) -> Path:
    """Return a folder like /sys/class/video4linux with some sub-devices: node to (name, device tree path)."""
    folder = tmp_path / "video4linux"
    for node, (name, path) in devices.items():
        entry = folder / node
        tree = tmp_path / "sys" / "firmware" / "devicetree" / path[1:]
        tree.mkdir(parents=True, exist_ok=True)
        (entry / "device").mkdir(parents=True)
        (entry / "name").write_text(name + "\n")
        (entry / "device" / "of_node").symlink_to(tree)
    return folder


def test_the_only_sensor_of_a_model_is_found_by_its_name(tmp_path: Path) -> None:
    sysfs = sysfs_with(
        tmp_path,
        {"v4l-subdev0": ("csi2", "/base/csi"), "v4l-subdev2": ("imx219 10-0010", "/base/elsewhere")},
    )
    assert find_sensor("imx219", CSI_0, sysfs=sysfs) == Path("/dev/v4l-subdev2")


def test_two_sensors_of_a_model_are_told_apart_by_the_device_tree(tmp_path: Path) -> None:
    sysfs = sysfs_with(
        tmp_path,
        {"v4l-subdev2": ("imx219 10-0010", CSI_0), "v4l-subdev5": ("imx219 11-0010", CSI_1)},
    )
    assert find_sensor("imx219", CSI_1, sysfs=sysfs) == Path("/dev/v4l-subdev5")
    assert find_sensor("imx219", CSI_0, sysfs=sysfs) == Path("/dev/v4l-subdev2")
    with pytest.raises(HardwareError, match="2 kernel sensor devices fit imx219 at /base/unknown"):
        find_sensor("imx219", "/base/unknown", sysfs=sysfs)


def test_no_sensor_is_an_error_that_names_the_model(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="0 kernel sensor devices fit imx477"):
        read_line_timing("imx477", CSI_0, sysfs=tmp_path)


def test_a_device_that_cannot_be_opened_is_told(tmp_path: Path) -> None:
    sysfs = sysfs_with(tmp_path, {"v4l-subdev999": ("imx219 10-0010", CSI_0)})
    with pytest.raises(HardwareError, match=r"/dev/v4l-subdev999: No such file.*group 'video'"):
        read_line_timing("imx219", CSI_0, sysfs=sysfs)
