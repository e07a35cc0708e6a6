import pytest
from device_fakes import FakeBus

from bricktrack_common.errors import HardwareError
from bricktrack_common.imu_records import AxisMap
from bricktrack_device.config import ImuMode
from bricktrack_device.inertial import bno055


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


# Table 3-4 of the data sheet: AXIS_MAP_CONFIG and AXIS_MAP_SIGN of each placement.
@pytest.mark.parametrize(
    ("axis_map", "registers"),
    [
        ("P0", "2104"), ("P1", "2400"), ("P2", "2406"), ("P3", "2102"),
        ("P4", "2403"), ("P5", "2101"), ("P6", "2107"), ("P7", "2405"),
    ],
)  # fmt: skip
def test_each_placement_is_written_and_read_back(axis_map: AxisMap, registers: str) -> None:
    bus = FakeBus()
    facts = bno055.set_up(bus, 0x28, "amg", axis_map=axis_map, sleep=no_sleep)
    assert bus.pages[0][0x41:0x43].hex() == registers and facts.axis_map == axis_map


def test_an_axis_map_that_the_chip_refuses_is_an_error() -> None:
    class Stubborn(FakeBus):
        def _write(self, register: int, value: int) -> None:
            if register != 0x41:
                super()._write(register, value)

    with pytest.raises(HardwareError, match=r"axis map reads 2401 after 2101 \(P5\)"):
        bno055.set_up(Stubborn(), 0x28, "amg", axis_map="P5", sleep=no_sleep)


class ConfigOnly(FakeBus):
    """A chip that takes and shows offsets only in CONFIG mode, as the real one does."""

    def __post_init__(self) -> None:
        self.bursts: list[tuple[int, int]] = []
        super().__post_init__()

    def writeto(self, address: int, buffer: bytes, *, start: int = 0, end: int | None = None) -> None:
        data = bytes(buffer)[start:end]
        if data and 0x55 <= data[0] <= 0x6A:
            self.bursts.append((data[0], len(data) - 1))
            if self.pages[0][0x3D] != 0:
                return
        super().writeto(address, buffer, start=start, end=end)

    def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
        data = super().read_burst(address, register, n_bytes)
        return bytes(n_bytes) if register == 0x55 and self.pages[0][0x3D] != 0 else data


SAVED = bytes(range(100, 122))


@pytest.mark.parametrize("mode", ["imuplus", "ndof"])
def test_a_saved_calibration_is_written_in_one_burst_before_fusion_starts(mode: ImuMode) -> None:
    bus, asked = ConfigOnly(), []

    def saved(chip_id: str) -> bytes:
        asked.append(chip_id)
        return SAVED

    facts = bno055.set_up(bus, 0x28, mode, saved_calibration=saved, sleep=no_sleep)
    assert asked == [facts.chip_id] and facts.calibration_restored
    assert bus.bursts == [(0x55, 22)] and bytes(bus.pages[0][0x55:0x6B]) == SAVED


def test_raw_modes_and_unknown_chips_get_no_calibration() -> None:
    bus = ConfigOnly()
    assert not bno055.set_up(
        bus, 0x28, "amg", saved_calibration=lambda chip_id: SAVED, sleep=no_sleep
    ).calibration_restored
    assert not bno055.set_up(bus, 0x28, "ndof", sleep=no_sleep).calibration_restored and bus.bursts == []


def test_a_calibration_is_read_in_config_mode_and_the_mode_comes_back() -> None:
    bus = ConfigOnly()
    bno055.set_up(bus, 0x28, "ndof", saved_calibration=lambda chip_id: SAVED, sleep=no_sleep)
    bus.pages[0][0x35] = 0xFF
    waits: list[float] = []
    assert bno055.read_calibration(bus, 0x28, 0x0C, sleep=waits.append) == (SAVED, 0xFF)
    assert bus.pages[0][0x3D] == 0x0C and min(waits) >= 0.019


@pytest.mark.parametrize(
    ("opr_mode", "calib_stat", "expected"),
    # System, gyroscope, accelerometer, magnetometer: two bits each; IMUPLUS has no magnetometer, and says 0.
    [(0x0C, 0xFF, True), (0x0C, 0xFC, False), (0x08, 0x3C, True), (0x08, 0x2C, False), (0x07, 0xFF, False)],
)
def test_calibrated_means_all_that_the_mode_uses(opr_mode: int, calib_stat: int, expected: bool) -> None:
    assert bno055.is_calibrated(opr_mode, calib_stat) is expected
