"""The V4L2 sub-device calls against a kernel driver that answers them: vimc's sensor."""

import os
from pathlib import Path

import pytest

from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.sensor_subdev import (
    SYSFS_VIDEO,
    get_control,
    get_output_size,
    read_line_timing,
)

BRIGHTNESS = 0x00980900


@pytest.fixture
def sensor():
    names = {p.name: (p / "name").read_text().strip() for p in SYSFS_VIDEO.glob("v4l-subdev*")}
    node = next(n for n, name in names.items() if name == "Sensor A")
    fd = os.open(Path("/dev", node), os.O_RDWR)
    yield fd
    os.close(fd)


def test_the_active_format_is_read(sensor):
    assert get_output_size(sensor) == (640, 480)  # vimc's default (kernel vimc-sensor.c)


def test_a_control_is_read(sensor):
    assert get_control(sensor, BRIGHTNESS) == 128  # vimc's default


def test_a_driver_without_line_times_is_refused():
    with pytest.raises(HardwareError, match=r"does not tell its line time.*HBLANK and PIXEL_RATE"):
        # vimc calls its first sensor "Sensor A": the model is the name's first word.
        read_line_timing("Sensor", "platform/vimc.0 Sensor A", sysfs=only_sensor_a())


def only_sensor_a():
    folder = Path("/tmp/sysfs")
    folder.mkdir(exist_ok=True)
    for entry in SYSFS_VIDEO.glob("v4l-subdev*"):
        if (entry / "name").read_text().strip() == "Sensor A" and not (folder / entry.name).exists():
            (folder / entry.name).symlink_to(entry.resolve())
    return folder


def test_two_sensors_that_cannot_be_told_apart_are_refused():
    with pytest.raises(HardwareError, match=r"2 kernel sensor devices fit Sensor"):
        read_line_timing("Sensor", "somewhere")
