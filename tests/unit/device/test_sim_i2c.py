"""The simulated BNO055 under the real Adafruit driver, and the burst read of the hot path."""

import errno
import struct
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import adafruit_bno055
import numpy as np
import pytest

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.imu_records import ImuDescription, ImuFlag, ImuRecord, decode_imu
from bricktrack_device.sim.bno055_chip import RESET_S, START_S, Bno055Chip
from bricktrack_device.sim.imu_signal import Measured, SensorSetup
from bricktrack_device.sim.settings import SimFaults, SimImu, SimSettings
from bricktrack_device.sim.sim_i2c import SimI2c
from bricktrack_device.sim.world import SimWorld, make_epoch

AMG, NDOF, IMUPLUS = 0x07, 0x0C, 0x08
CALM = SimSettings(imu=SimImu(noise=0.0, bias=0.0))


def make_bus(settings: SimSettings, *, armed_ago_s: float | None = None) -> SimI2c:
    world = SimWorld(settings, make_epoch())
    if armed_ago_s is not None:
        world.schedule(monotonic_ns() - round((armed_ago_s + settings.shake_delay_s) * 1e9))
    return SimI2c(world, bus="sim")


def set_mode(bus: SimI2c, mode: int, *, acc_config: int | None = None) -> None:
    """Set up the chip without the driver's sleeps; its first sample is `START_S` away."""
    bus.writeto(0x28, bytes([0x3D, 0]))
    if acc_config is not None:
        for data in ([0x07, 1], [0x08, acc_config], [0x07, 0]):
            bus.writeto(0x28, bytes(data))
    bus.writeto(0x28, bytes([0x3D, mode]))


def wait_for_first_sample() -> None:
    end = monotonic_ns() + round((START_S + 0.002) * 1e9)
    while monotonic_ns() < end:
        pass


@pytest.fixture(scope="module")
def driver() -> Iterator[adafruit_bno055.BNO055_I2C]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(adafruit_bno055, "time", time)  # some fakes put a clock there that does not wait
        yield adafruit_bno055.BNO055_I2C(make_bus(CALM), 0x28)  # checks the chip id and resets


class TestUnderTheDriver:
    def test_it_starts_in_the_mode_that_the_driver_sets(self, driver: adafruit_bno055.BNO055_I2C) -> None:
        assert driver.mode == NDOF
        assert driver.accel_range == adafruit_bno055.ACCEL_4G

    def test_offsets_come_back_as_written(self, driver: adafruit_bno055.BNO055_I2C) -> None:
        driver.offsets_accelerometer = (-12, 34, 560)
        driver.offsets_gyroscope = (1, -2, 3)
        driver.radius_accelerometer = 1000
        assert driver.offsets_accelerometer == (-12, 34, 560)
        assert driver.offsets_gyroscope == (1, -2, 3)
        assert driver.radius_accelerometer == 1000
        driver.offsets_accelerometer = (0, 0, 0)
        driver.offsets_gyroscope = (0, 0, 0)

    def test_axes_are_remapped_as_the_driver_says(self, driver: adafruit_bno055.BNO055_I2C) -> None:
        driver.mode = AMG
        wait_for_first_sample()
        x, y, z = driver.acceleration
        assert driver.axis_remap == (0, 1, 2, 0, 0, 0) and y < -9.5
        driver.axis_remap = (1, 0, 2, 0, 0, 1)
        wait_for_first_sample()
        wait_for_first_sample()
        assert driver.acceleration == pytest.approx((y, x, -z), abs=0.02)
        driver.axis_remap = (1, 1, 2, 0, 0, 0)  # refused by the chip
        assert driver.axis_remap[:3] == (1, 0, 2)
        driver.axis_remap = (0, 1, 2, 0, 0, 0)

    def test_raw_modes_take_sixteen_g_and_fusion_takes_four(self, driver: adafruit_bno055.BNO055_I2C) -> None:
        driver.mode = AMG
        driver.accel_range = adafruit_bno055.ACCEL_16G
        assert driver.accel_range == adafruit_bno055.ACCEL_16G
        driver.mode = IMUPLUS
        assert driver.accel_range == adafruit_bno055.ACCEL_4G

    def test_fused_values_agree_with_each_other(self, driver: adafruit_bno055.BNO055_I2C) -> None:
        driver.mode = NDOF
        wait_for_first_sample()
        assert np.linalg.norm(driver.quaternion) == pytest.approx(1, abs=1e-3)
        assert driver.gravity == pytest.approx(driver.acceleration, abs=0.02)
        assert driver.linear_acceleration == pytest.approx((0, 0, 0), abs=0.02)
        assert np.linalg.norm(driver.gravity) == pytest.approx(9.80665, abs=0.02)
        assert driver.temperature == 31


def test_while_it_resets_it_does_not_answer() -> None:
    bus = make_bus(CALM)
    bus.writeto(0x28, bytes([0x3F, 0x20]))
    with pytest.raises(OSError) as refused:
        bus.read_burst(0x28, 0x00, 1)
    assert refused.value.errno == errno.EREMOTEIO
    t_ns = monotonic_ns()
    assert bus.chip.answers(t_ns + round(RESET_S * 1e9))


def test_nobody_answers_at_another_address() -> None:
    with pytest.raises(OSError) as refused:
        make_bus(CALM).read_burst(0x29, 0x00, 1)
    assert refused.value.errno == errno.EREMOTEIO


def test_the_unique_id_is_on_page_one_and_each_bus_s_own() -> None:
    ids = []
    for name in ("i2c-3", "i2c-4", "i2c-3"):
        bus = SimI2c(SimWorld(CALM, make_epoch()), bus=name)
        bus.writeto(0x28, bytes([0x07, 1]))
        ids.append(bus.read_burst(0x28, 0x50, 16))
    assert ids[0] == ids[2] != ids[1] and len(ids[0]) == 16


def test_a_burst_takes_bus_time_and_decodes_to_gravity() -> None:
    bus = make_bus(CALM)
    set_mode(bus, AMG, acc_config=0x0F)
    wait_for_first_sample()
    before = monotonic_ns()
    data = bus.read_burst(0x28, 0x08, 46)
    after = monotonic_ns()
    assert after - before > 1_200_000  # 49 bytes of nine bits at 400 kHz, and the driver's own time
    description = ImuDescription(
        name="brick", chip_id="", bus="sim", address=0x28, opr_mode=AMG, fusion=False, acc_range_g=16.0,
        period_ns=10_000_000, t0_ns=before,
    )  # fmt: skip
    samples = decode_imu(description, [ImuRecord(0, before, after, data, 0, None)])
    assert samples.flags.tolist() == [ImuFlag.NONE]
    R, _ = bus._world.rest_pose
    np.testing.assert_allclose(samples.acc_mps2[0], -R.T @ bus._world.gravity_camera_mps2, atol=0.0051)
    np.testing.assert_allclose(samples.gyro_radps[0], 0, atol=1e-9)


def constant(t_ns: int, setup: SensorSetup) -> Measured:
    """Measure t in its x channel, so that the sample's instant can be read back."""
    return Measured(
        np.array([t_ns * 1e-9, 100.0, -3.0]),
        np.array([1.0, -500.0, 30.0]),
        np.array([20.0, 0, -40]),
        np.eye(3),
    )


class TestTheChipsOwnClock:
    def test_reads_find_the_latest_sample_and_beat_with_it(self) -> None:
        chip = Bno055Chip(bytes(16), constant, period_s=0.0101)
        chip.write(0x3D, bytes([AMG]), 0)
        reads_ns = [1_000_000_000 + k * 10_000_000 for k in range(400)]
        taken_s = [struct.unpack("<h", chip.read(0x08, 46, t)[:2])[0] / 100 for t in reads_ns]
        ages = np.array(reads_ns) * 1e-9 - taken_s
        # As old as one period at most, and the register's 0.01 s/2 of rounding.
        assert ages.min() > -0.0051 and ages.max() < 0.0101 + 0.0051
        assert (
            2 <= np.count_nonzero(np.diff(taken_s) == 0) <= 6
        )  # 1 % too slow: every hundredth, and rounding

    def test_samples_worked_out_ahead_are_the_same(self) -> None:
        with ThreadPoolExecutor(1) as executor:
            plain, ahead = (
                Bno055Chip(bytes(16), constant, period_s=0.0101, ahead=e) for e in (None, executor)
            )
            for chip in (plain, ahead):
                chip.write(0x3D, bytes([AMG]), 0)
            for t_ns in (10**9, 10**9 + 11_000_000, 10**9 + 21_000_000, 2 * 10**9, 2 * 10**9 + 1_000_000):
                assert plain.read(0x08, 46, t_ns) == ahead.read(0x08, 46, t_ns)
            for chip in (plain, ahead):  # another mode: what was worked out for the old one is void
                chip.write(0x3D, bytes([0x01]), 2 * 10**9 + 2_000_000)
            assert plain.read(0x08, 46, 3 * 10**9) == ahead.read(0x08, 46, 3 * 10**9)

    def test_before_the_first_sample_the_registers_hold_zeros(self) -> None:
        chip = Bno055Chip(bytes(16), constant, period_s=0.01)
        chip.write(0x3D, bytes([AMG]), 10**9)
        assert not any(chip.read(0x08, 44, 10**9 + 1_000_000))
        assert any(chip.read(0x08, 44, 10**9 + 30_000_000))


class TestUnitsAndScales:
    def words(self, *setup: tuple[int, int], mode: int = AMG) -> list[int]:
        chip = Bno055Chip(bytes(16), constant, period_s=0.01)
        for register, value in setup:
            chip.write(register, bytes([value]), 0)
        chip.write(0x3D, bytes([mode]), 0)
        return list(struct.unpack("<22h", chip.read(0x08, 44, 10**9)))

    def test_the_default_units_are_those_of_the_data_sheet(self) -> None:
        words = self.words()
        assert (
            words[1:3] == [10_000, -300] and words[6:9] == [16, -8000, 480] and words[3:6] == [320, 0, -640]
        )
        assert not any(words[9:])  # no fusion

    def test_other_units_are_taken(self) -> None:
        words = self.words((0x3B, 0x03))
        # 100 m/s^2 is 10197 mg; 500 deg/s is 8.7266 rad/s at 900 counts each.
        assert words[1] == 10_197 and words[7] == -7854

    def test_outside_fusion_the_gyroscope_s_scale_follows_its_range(self) -> None:
        words = self.words((0x07, 1), (0x0A, 0x38 | 2), (0x07, 0))  # 500 deg/s
        assert words[6] == 64

    def test_modes_leave_sensors_off(self) -> None:
        assert not any(self.words(mode=0x01)[3:9])  # ACCONLY
        assert not any(self.words(mode=0x05)[3:6])  # ACCGYRO
        assert not any(self.words(mode=0x00))  # CONFIG

    def test_configuration_is_refused_outside_config_mode(self) -> None:
        chip = Bno055Chip(bytes(16), constant, period_s=0.01)
        chip.write(0x3D, bytes([AMG]), 0)
        for register, value in ((0x3B, 0x03), (0x41, 0x21), (0x55, 0x7F)):
            before = chip.read(register, 1, 0)
            chip.write(register, bytes([value]), 0)
            assert chip.read(register, 1, 0) == before
        chip.write(0x07, b"\x01", 0)
        chip.write(0x08, b"\x0f", 0)
        assert chip.read(0x08, 1, 0) == b"\x0d"

    def test_status_tells_of_the_mode(self) -> None:
        chip = Bno055Chip(bytes(16), constant, period_s=0.01)
        for mode, status in ((0, 0), (AMG, 6), (NDOF, 5)):
            chip.write(0x3D, bytes([mode]), 0)
            assert chip.read(0x39, 5, 0)[0] == status and chip.read(0x39, 5, 0)[4] == mode
        assert chip.read(0x35, 1, 10**9) == b"\x00" and chip.read(0x35, 1, 3 * 10**9) == b"\xff"


class TestFaults:
    def bus(self, *, armed_ago_s: float = 10.0, **faults: object) -> SimI2c:
        settings = SimSettings(imu=SimImu(noise=0.0), faults=SimFaults(**faults))  # type: ignore[arg-type]
        return make_bus(settings, armed_ago_s=armed_ago_s)

    def running(self, **more: object) -> SimI2c:
        bus = self.bus(**more)  # type: ignore[arg-type]
        set_mode(bus, AMG, acc_config=0x0F)
        wait_for_first_sample()
        return bus

    def test_every_nth_transaction_fails_with_the_errno(self) -> None:
        bus = self.running(imu_nack_every=3, imu_nack_errno=errno.ETIMEDOUT)
        outcomes = []
        for _ in range(9):
            try:
                bus.read_burst(0x28, 0x39, 5)
                outcomes.append(0)
            except OSError as e:
                outcomes.append(e.errno or -1)
        assert outcomes.count(errno.ETIMEDOUT) == 3 and outcomes.count(0) == 6

    def test_a_bus_that_is_down_for_a_while_fails_for_that_while(self) -> None:
        down = self.bus(imu_bus_down=[(9.0, 5.0)])
        with pytest.raises(OSError, match="Remote I/O"):
            down.read_burst(0x28, 0x00, 1)
        assert self.bus(imu_bus_down=[(1.0, 5.0)]).read_burst(0x28, 0x00, 1) == b"\xa0"

    def test_a_silent_reset_raises_nothing_and_leaves_config_mode(self) -> None:
        bus = self.bus(imu_reset_s=11.0)
        bus._world.schedule(monotonic_ns() - 10_000_000_000)
        set_mode(bus, AMG)
        assert bus.read_burst(0x28, 0x3D, 1)[0] & 0x0F == AMG
        bus._world.schedule(monotonic_ns() - 13_000_000_000)
        assert not any(bus.read_burst(0x28, 0x08, 44))
        assert bus.read_burst(0x28, 0x3D, 1)[0] & 0x0F == 0

    def test_a_stuck_sensor_repeats_itself_for_ever(self) -> None:
        bus = self.running(imu_stuck_s=5.0)
        first = bus.read_burst(0x28, 0x08, 46)
        wait_for_first_sample()
        assert bus.read_burst(0x28, 0x08, 46) == first

    def test_a_flipped_bit_shows_as_a_jump_of_the_first_channel(self) -> None:
        bus = self.running(imu_bit_flip_every=2)
        xs = [struct.unpack("<h", bus.read_burst(0x28, 0x08, 46)[:2])[0] for _ in range(4)]
        assert max(np.abs(np.diff(xs))) > 16_000 - 100

    def test_an_absent_sensor_does_not_answer(self) -> None:
        with pytest.raises(OSError, match="Remote I/O"):
            self.bus(imu_absent=True).read_burst(0x28, 0x00, 1)
