import pytest
from device_fakes import FakeBus

from bricktrack_common.errors import HardwareError
from bricktrack_device import bno055
from bricktrack_device.config import ImuMode


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver sleeps 0.7 s after a reset; a table of registers needs no time."""
    monkeypatch.setattr("adafruit_bno055.time.sleep", lambda seconds: None)


def no_sleep(seconds: float) -> None:
    pass


@pytest.mark.parametrize(
    ("mode", "opr_mode", "fusion"),
    [("amg", 0x07, False), ("accgyro", 0x05, False), ("imuplus", 0x08, True), ("ndof", 0x0C, True)],
)
def test_each_mode_ends_in_its_register_value(mode: ImuMode, opr_mode: int, fusion: bool) -> None:
    bus = FakeBus()
    facts = bno055.set_up(bus, 0x28, mode, sleep=no_sleep)
    # Values of table 3-5 of the data sheet.
    assert bus.pages[0][0x3D] == opr_mode == facts.opr_mode and facts.fusion is fusion
    assert bus.page == 0 and facts.chip_id == bytes(range(16)).hex() and facts.warnings == []
    assert facts.calibration == 0xFF


def test_raw_modes_run_at_16_g_and_2000_dps_as_read_back() -> None:
    bus = FakeBus()
    facts = bno055.set_up(bus, 0x28, "amg", sleep=no_sleep)
    # ACC_CONFIG: 16 g = 0b11, 62.5 Hz = 0b011 << 2; GYR_CONFIG_0: 2000 dps = 0, 32 Hz = 0b111 << 3.
    assert (bus.pages[1][0x08], bus.pages[1][0x0A]) == (0b000_011_11, 0b111_000)
    assert (facts.acc_range_g, facts.gyro_range_dps) == (16.0, 2000.0)


def test_fusion_modes_report_the_range_that_the_chip_has() -> None:
    facts = bno055.set_up(FakeBus(), 0x28, "ndof", sleep=no_sleep)
    assert facts.acc_range_g == 4.0


def test_a_range_that_does_not_stick_is_an_error() -> None:
    bus = FakeBus(stuck_registers={0x08: 0x0D})  # stays at 4 g
    with pytest.raises(HardwareError, match=r"ACC_CONFIG reads 0x0D after 0x0F"):
        bno055.set_up(bus, 0x28, "amg", sleep=no_sleep)


def test_units_that_would_change_the_scales_are_put_right() -> None:
    class OddUnits(FakeBus):
        def _reset(self) -> None:
            super()._reset()
            self.pages[0][0x3B] = 0x83  # mg and rad/s

    bus = OddUnits()
    bno055.set_up(bus, 0x28, "amg", sleep=no_sleep)
    assert bus.pages[0][0x3B] == 0x80


def test_a_failed_self_test_is_said_but_does_not_stop() -> None:
    class Sick(FakeBus):
        def _reset(self) -> None:
            super()._reset()
            self.pages[0][0x36] = 0b1101

    facts = bno055.set_up(Sick(), 0x28, "amg", sleep=no_sleep)
    assert "magnetometer" in facts.warnings[0] and "gyroscope" not in facts.warnings[0]


def test_a_missing_sensor_is_named_with_its_address() -> None:
    with pytest.raises(HardwareError, match=r"0x28.*Check wiring"):
        bno055.set_up(FakeBus(present=False), 0x28, "amg", sleep=no_sleep)
    with pytest.raises(HardwareError, match="0x29"):
        bno055.set_up(FakeBus(), 0x29, "amg", sleep=no_sleep)
    with pytest.raises(HardwareError, match="EREMOTEIO"):
        bno055.read_chip_id(FakeBus(present=False), 0x28)


def test_another_chip_is_refused_with_the_id_it_gave() -> None:
    with pytest.raises(HardwareError, match=r"0xfb != 0xa0.*expected a BNO055"):
        bno055.set_up(FakeBus(chip_id=0xFB), 0x28, "amg", sleep=no_sleep)
    assert bno055.read_chip_id(FakeBus(chip_id=0xFB), 0x28) == 0xFB


def test_a_chip_that_is_slow_to_wake_is_tried_again() -> None:
    class Sleepy(FakeBus):
        n_refused = 0

        def _answer(self, address: int) -> None:
            if self.n_refused < 3:
                self.n_refused += 1
                raise OSError(121, "no acknowledge")

    waits: list[float] = []
    facts = bno055.set_up(Sleepy(), 0x28, "amg", sleep=waits.append)
    assert facts.opr_mode == 0x07 and waits[0] >= 0.3
