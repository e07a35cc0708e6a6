"""The small parts of the hardware backend: versions, bounded calls, LEDs, the rig, and a missing picamera2."""

import threading
import time

import gpiozero
import pytest
from gpiozero.pins.mock import MockFactory

from bricktrack_common.errors import HardwareError
from bricktrack_device.capture.ring import FrameRing
from bricktrack_device.config import CameraTable, DeviceConfig
from bricktrack_device.hardware import versions
from bricktrack_device.hardware.led_bank import LedBank
from bricktrack_device.hardware.pi_camera import PiCamera
from bricktrack_device.hardware.pi_rig import PiRig, camera_settings
from bricktrack_device.hardware.smbus_i2c import SmbusOpener
from bricktrack_device.in_time import finishes


@pytest.mark.parametrize(
    ("older", "newer"),
    [("0.3.9", "0.3.32"), ("2.0.1", "2.0.1.post3"), ("2.0.1.post2", "2.0.1.post3"), ("2.0.1.post3", "2.1")],
)
def test_versions_are_compared_by_number(older: str, newer: str) -> None:
    assert versions.release(older) < versions.release(newer)


def test_an_old_or_missing_library_is_told_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(versions, "installed", {"old": "2.0.1", "new": "2.0.1.post3"}.get)
    assert versions.require("new", "2.0.1.post3", why="w", remedy="r") == "2.0.1.post3"
    with pytest.raises(
        HardwareError, match=r"old 2.0.1 is too old; expected 2.0.1.post3 or newer, because w. r"
    ):
        versions.require("old", "2.0.1.post3", why="w", remedy="r")
    with pytest.raises(HardwareError, match="none is not installed; expected 2 or newer. r"):
        versions.require("none", "2", why="w", remedy="r")


def test_what_hangs_is_left_behind() -> None:
    forever = threading.Event()
    start = time.monotonic()
    assert not finishes(forever.wait, within_s=0.05, name="hangs")
    assert time.monotonic() - start < 2
    forever.set()
    assert finishes(lambda: None, within_s=5, name="ends")


def test_what_fails_in_time_fails_here() -> None:
    def fail() -> None:
        raise ValueError("so")

    with pytest.raises(ValueError, match="so"):
        finishes(fail, within_s=5, name="fails")


def test_leds_switch_together_and_go_out_at_the_end() -> None:
    factory = MockFactory()
    bank = LedBank(["GPIO22", "GPIO27"], factory)
    pins = [factory.pin("GPIO22"), factory.pin("GPIO27")]
    before_ns, after_ns = bank.switch(True)
    assert before_ns <= after_ns
    assert [p.state for p in pins] == [1, 1]
    bank.switch(False)
    assert [p.state for p in pins] == [0, 0]
    bank.close()
    gpiozero.LED("GPIO22", pin_factory=factory).close()
    factory.close()


def test_a_wrong_led_pin_gives_the_others_back() -> None:
    factory = MockFactory()
    with pytest.raises(HardwareError, match="LED pins GPIO22, GPIO99"):
        LedBank(["GPIO22", "GPIO99"], factory)
    gpiozero.LED("GPIO22", pin_factory=factory).close()
    factory.close()


def test_a_computer_without_picamera2_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(versions, "installed", lambda distribution: None)
    camera = PiCamera(camera_settings(CameraTable()))
    with pytest.raises(HardwareError, match="picamera2 is not installed.*apt install python3-picamera2"):
        camera.start(FrameRing(10**9))
    camera.stop()
    assert camera.problem() == "camera: it does not stream"


def test_the_rig_takes_the_cameras_table() -> None:
    settings = camera_settings(CameraTable(exposure_us=1234, analogue_gain=2.0, iperiod=10))
    assert (settings.exposure_us, settings.analogue_gain, settings.iperiod) == (1234, 2.0, 10)
    assert settings.mode.picture_size == (1920, 1080)


def test_the_rig_describes_where_it_runs_and_a_missing_bus_is_only_a_warning(
    caplog: pytest.LogCaptureFixture,
) -> None:
    rig = PiRig(DeviceConfig())
    assert rig.bus_opener("/dev/i2c-77") == SmbusOpener("/dev/i2c-77")
    assert "I2C bus /dev/i2c-77 has no adapter" in caplog.text
    found = rig.describe()
    assert found["library.gpiozero"].startswith("2.")
    assert found["kernel"]
    assert all(isinstance(v, str) for v in found.values())
    rig.close()
    rig.close()
