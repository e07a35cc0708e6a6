"""SmbusI2c over the kernel's I2C, with and without the Adafruit driver, against an emulated BNO055."""

import errno
import math
import pickle
import struct
import time

import adafruit_bno055
import guest_knobs
import pytest
from guest_knobs import ADDRESS, BUS

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import HardwareError
from bricktrack_device.hardware.smbus_i2c import SmbusI2c, SmbusOpener, adapter_of, adapter_warning

DATA, N_DATA = 0x08, 46
NDOF, AMG = 0x0C, 0x07


@pytest.fixture
def bus():
    opened = pickle.loads(pickle.dumps(SmbusOpener(BUS)))()
    set_mode(opened, NDOF)
    yield opened
    for name in ("fail_next", "fail_every", "hang_next_ms", "corrupt_every", "pattern"):
        guest_knobs.set_sensor(name, 0)
    guest_knobs.set_sensor("fail_errno", errno.EREMOTEIO)
    guest_knobs.set_sensor("present", 1)
    opened.close()


def set_mode(bus, mode):
    bus.writeto(ADDRESS, bytes([0x3D, 0]))
    time.sleep(0.03)
    bus.writeto(ADDRESS, bytes([0x3D, mode]))
    time.sleep(0.03)


def motion_at(t_ns):
    """Heading, deg, and its rate, deg/s, as the emulator states them for its 10 ms grid."""
    t_s = t_ns // 10_000_000 * 0.01
    return 180 + 90 * math.sin(math.pi * t_s), 90 * math.pi * math.cos(math.pi * t_s)


def test_a_burst_is_one_instant_of_the_stated_motion(bus):
    n_unambiguous = 0
    for _ in range(60):
        before_ns = monotonic_ns()
        raw = bus.read_burst(ADDRESS, DATA, N_DATA)
        after_ns = monotonic_ns()
        time.sleep(0.007)
        heading_deg, rate_dps = motion_at(before_ns)
        if motion_at(after_ns) != (heading_deg, rate_dps):
            continue  # a new sample was latched meanwhile
        n_unambiguous += 1
        words = struct.unpack_from("<22h", raw)
        # One count is 1/16 deg and 1/16 deg/s; the emulator interpolates its sine in whole degrees.
        assert words[9] / 16 == pytest.approx(heading_deg, abs=0.07)
        assert words[8] / 16 == pytest.approx(rate_dps, abs=0.15)
        w, x, y, z = (n / 2**14 for n in words[12:16])
        assert math.hypot(w, x, y, z) == pytest.approx(1, abs=2e-4)
        assert math.degrees(2 * math.atan2(z, w)) % 360 == pytest.approx(heading_deg, abs=0.03)
    assert n_unambiguous > 30


def test_a_burst_is_never_torn(bus):
    guest_knobs.set_sensor("pattern", 1)
    for _ in range(150):
        before = guest_knobs.count("n_xfer")
        words = struct.unpack("<19h", bus.read_burst(ADDRESS, DATA, 38))
        assert guest_knobs.count("n_xfer") == before + 1
        assert len(set(words)) == 1


def test_the_adafruit_driver_works_over_it(bus):
    sensor = adafruit_bno055.BNO055_I2C(bus, ADDRESS)
    assert sensor.mode == NDOF
    assert sensor.acceleration[2] == pytest.approx(9.80, abs=0.011)
    for _ in range(20):
        before_ns = monotonic_ns()
        heading_deg = sensor.euler[0]
        span = sorted((motion_at(before_ns)[0], motion_at(monotonic_ns())[0]))
        assert span[0] - 0.07 <= heading_deg <= span[1] + 0.07
    sensor.mode = AMG
    assert sensor.mode == AMG
    assert bus.try_lock()
    assert not bus.try_lock()
    bus.unlock()


def test_parts_of_buffers_are_written_and_read(bus):
    assert bus.read_burst(ADDRESS, 0x00, 4) == bytes([0xA0, 0xFB, 0x32, 0x0F])
    buffer = bytearray(b"......")
    bus.writeto_then_readfrom(ADDRESS, b"\x55\x01\x55", buffer, out_start=1, out_end=2, in_start=2, in_end=5)
    assert buffer == b"..\xfb\x32\x0f."
    bus.writeto(ADDRESS, b"\xff\x02", start=1)
    bus.readfrom_into(ADDRESS, buffer, start=4)
    assert buffer == b"..\xfb\x32\x32\x0f"


@pytest.mark.parametrize("code", [errno.EREMOTEIO, errno.EIO, errno.ETIMEDOUT])
def test_a_failed_transfer_is_an_os_error_with_its_errno(bus, code):
    guest_knobs.set_sensor("fail_errno", code)
    guest_knobs.set_sensor("fail_next", 1)
    with pytest.raises(OSError) as failure:
        bus.read_burst(ADDRESS, DATA, N_DATA)
    assert failure.value.errno == code
    assert len(bus.read_burst(ADDRESS, DATA, N_DATA)) == N_DATA


def test_a_stuck_bus_times_out(bus):
    guest_knobs.set_sensor("hang_next_ms", 200)
    start = time.monotonic()
    with pytest.raises(TimeoutError) as failure:
        bus.read_burst(ADDRESS, DATA, N_DATA)
    assert failure.value.errno == errno.ETIMEDOUT
    assert 0.2 <= time.monotonic() - start < 5


def test_an_unplugged_sensor_does_not_answer_and_comes_back(bus):
    guest_knobs.set_sensor("present", 0)
    for transfer in (
        lambda: bus.read_burst(ADDRESS, DATA, N_DATA),
        lambda: bus.writeto(ADDRESS, b"\x3d"),
        lambda: bus.readfrom_into(ADDRESS, bytearray(2)),
    ):
        with pytest.raises(OSError) as failure:
            transfer()
        assert failure.value.errno == errno.EREMOTEIO
    guest_knobs.set_sensor("present", 1)
    assert bus.read_burst(ADDRESS, 0, 1) == b"\xa0"


def test_nothing_answers_at_another_address(bus):
    with pytest.raises(OSError) as failure:
        bus.read_burst(0x29, 0, 1)
    assert failure.value.errno == errno.EREMOTEIO


def test_corrupted_bytes_pass_unnoticed_here(bus):
    # The bus has no checksum: what a stretched clock corrupts must be found by the sampler's checks.
    clean = bus.read_burst(ADDRESS, 0x00, 7)
    guest_knobs.set_sensor("corrupt_every", 1)
    corrupt = bus.read_burst(ADDRESS, 0x00, 7)
    assert corrupt[:-1] == clean[:-1]
    assert corrupt[-1] == clean[-1] ^ 0x80


def test_a_silent_reset_shows_in_the_mode_register(bus):
    resets = guest_knobs.count("n_resets")
    SmbusI2c(BUS).writeto(ADDRESS, bytes([0x3F, 0x20]))
    with pytest.raises(OSError) as failure:
        bus.read_burst(ADDRESS, DATA, N_DATA)
    assert failure.value.errno == errno.EREMOTEIO
    time.sleep(0.75)
    assert guest_knobs.count("n_resets") == resets + 1
    assert bus.read_burst(ADDRESS, 0x3D, 1) == b"\0"
    assert bus.read_burst(ADDRESS, DATA, 38) == bytes(38)


def test_a_closed_bus_says_so(bus):
    bus.close()
    bus.close()
    with pytest.raises(OSError) as failure:
        bus.read_burst(ADDRESS, DATA, N_DATA)
    assert failure.value.errno == errno.EBADF


def test_a_bus_that_is_not_there_is_explained():
    with pytest.raises(HardwareError, match=r"/dev/i2c-77: No such file.*dtoverlay=i2c-gpio"):
        SmbusI2c("/dev/i2c-77")


def test_the_wrong_kind_of_adapter_gets_a_warning():
    assert adapter_of(BUS).name == "bno055 emulator (bcm2835-like)"
    assert "expected one made by i2c-gpio" in adapter_warning(BUS)
