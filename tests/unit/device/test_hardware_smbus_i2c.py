"""The I2C bus without a kernel: what is sent, and what an adapter is. Its transfers are in tests/virtual_pi."""

import errno
import pickle
from pathlib import Path
from typing import Any

import pytest
import smbus2

from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.smbus_i2c import SmbusI2c, SmbusOpener, adapter_of, adapter_warning


class FakeSmbus:
    """Keeps what was transferred; a read gives 0, 1, 2, ..."""

    def __init__(self, bus: str) -> None:
        self.transfers: list[list[tuple[int, bool, bytes]]] = []
        self.closed = False

    def i2c_rdwr(self, *messages: Any) -> None:
        for m in messages:
            if m.flags & 1:
                for i in range(m.len):
                    m.buf[i] = i
        self.transfers.append([(m.addr, bool(m.flags & 1), bytes(m)) for m in messages])

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> SmbusI2c:
    monkeypatch.setattr(smbus2, "SMBus", FakeSmbus)
    return SmbusOpener("/dev/i2c-3")()


def transfers(bus: SmbusI2c) -> list[list[tuple[int, bool, bytes]]]:
    fake: Any = bus._bus
    return list(fake.transfers)


def test_a_burst_is_one_transaction_of_any_length(bus: SmbusI2c) -> None:
    for _ in range(2):
        assert bus.read_burst(0x28, 0x08, 46) == bytes(range(46))
    assert transfers(bus) == [[(0x28, False, b"\x08"), (0x28, True, bytes(range(46)))]] * 2


@pytest.mark.parametrize("n_bytes", [0, -1, 8193])
def test_a_burst_of_no_length_is_refused(bus: SmbusI2c, n_bytes: int) -> None:
    with pytest.raises(OSError, match=f"a burst of {n_bytes} bytes") as failure:
        bus.read_burst(0x28, 0, n_bytes)
    assert failure.value.errno == errno.EINVAL


def test_only_the_parts_asked_for_are_sent_and_filled(bus: SmbusI2c) -> None:
    buffer = bytearray(b"......")
    bus.writeto(0x29, b"abcd", start=1, end=3)
    bus.readfrom_into(0x29, buffer, start=1, end=3)
    bus.writeto_then_readfrom(0x29, b"xyz", buffer, out_end=1, in_start=4)
    assert transfers(bus) == [
        [(0x29, False, b"bc")],
        [(0x29, True, b"\0\1")],
        [(0x29, False, b"x"), (0x29, True, b"\0\1")],
    ]
    assert buffer == b".\0\1.\0\1"


def test_the_lock_is_had_once(bus: SmbusI2c) -> None:
    assert bus.try_lock()
    assert not bus.try_lock()
    bus.unlock()
    assert bus.try_lock()


def test_an_opener_crosses_to_another_process() -> None:
    assert pickle.loads(pickle.dumps(SmbusOpener("/dev/i2c-3"))) == SmbusOpener("/dev/i2c-3")


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOENT, "dtoverlay=i2c-gpio"),
        (errno.EACCES, "usermod -aG i2c"),
        (errno.EIO, "i2cdetect -l"),
    ],
)
def test_a_bus_that_does_not_open_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, code: int, words: str
) -> None:
    def fail(bus: str) -> None:
        raise OSError(code, "no")

    monkeypatch.setattr(smbus2, "SMBus", fail)
    with pytest.raises(HardwareError, match=rf"I2C bus /dev/i2c-3: no\..*{words}"):
        SmbusI2c("/dev/i2c-3")


def sysfs_with(tmp_path: Path, name: str, driver: str | None) -> Path:
    """Return a folder like /sys/bus/i2c/devices that holds adapter 3 of a driver."""
    device = tmp_path / "devices" / "platform" / "i2c@3"
    (device / "i2c-3").mkdir(parents=True)
    (device / "i2c-3" / "name").write_text(name + "\n")
    if driver:
        (tmp_path / "drivers" / driver).mkdir(parents=True)
        (device / "driver").symlink_to(tmp_path / "drivers" / driver)
    sysfs = tmp_path / "bus"
    sysfs.mkdir()
    (sysfs / "i2c-3").symlink_to(device / "i2c-3")
    return sysfs


def test_the_overlays_adapter_is_known_by_its_driver_not_by_its_name(tmp_path: Path) -> None:
    sysfs = sysfs_with(tmp_path, "i2c@3", "i2c-gpio")
    assert adapter_of("/dev/i2c-3", sysfs=sysfs).driver == "i2c-gpio"
    assert adapter_warning("/dev/i2c-3", sysfs=sysfs) is None


@pytest.mark.parametrize(
    ("name", "driver"), [("bcm2835 (i2c@7e804000)", "i2c-bcm2835"), ("Synopsys DesignWare I2C adapter", None)]
)
def test_a_hardware_bus_gets_a_warning_with_a_remedy(tmp_path: Path, name: str, driver: str | None) -> None:
    warning = adapter_warning("/dev/i2c-3", sysfs=sysfs_with(tmp_path, name, driver))
    assert warning is not None
    assert name in warning
    assert "expected one made by i2c-gpio" in warning
    assert (driver or "") in warning


def test_no_adapter_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(HardwareError, match="/dev/i2c-9 has no adapter: No such file"):
        adapter_of("/dev/i2c-9", sysfs=tmp_path)
