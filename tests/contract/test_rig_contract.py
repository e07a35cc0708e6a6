"""What any rig must do, whatever is behind it: the simulated one always, a unit's own hardware where it is given.

On a unit, with its service stopped and a square wave on the trigger's line::

    pytest tests/contract --rig /etc/bricktrack/bricktrackd.toml
"""

import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from bricktrack_common.clocks import monotonic_ns
from bricktrack_device.backends import open_rig
from bricktrack_device.capture.ring import JOIN_TOLERANCE_NS, FrameRing, cut_video
from bricktrack_device.capture.trigger import Trigger
from bricktrack_device.config import CameraTable, DeviceConfig, ImuMode, ImuTable, TriggerTable, load_config
from bricktrack_device.inertial.bno055 import CHIP_ID, read_chip_id, set_up
from bricktrack_device.inertial.imu_reader import ImuReader
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata, I2cBus, Rig

STREAM_PICTURES = 25
STREAM_S = 2.0
PATIENCE_S = 120.0
"""For a computer that does much else; what works comes far sooner."""


@pytest.fixture(scope="module", params=["sim", pytest.param("hardware", marks=pytest.mark.hardware)])
def config(request: pytest.FixtureRequest) -> DeviceConfig:
    if request.param == "sim":
        # Rendering and encoding a picture takes some 30 ms of a core: this rate is kept beside other work, too.
        return DeviceConfig(backend="sim", camera=CameraTable(frame_rate_hz=10.0, iperiod=6))
    address = request.config.getoption("--rig")
    if address is None:
        pytest.skip("needs a unit's hardware: run it there with --rig /etc/bricktrack/bricktrackd.toml")
    if "://" in address:
        pytest.skip(f"{address} is another computer; these tests need the hardware of this one")
    return load_config(Path(address), {})


@pytest.fixture(scope="module")
def rig(config: DeviceConfig) -> Iterator[Rig]:
    made = open_rig(config)
    yield made
    made.close()


@pytest.fixture(scope="module")
def imu(config: DeviceConfig) -> ImuTable:
    if not config.imu:
        pytest.skip("this unit has no inertial sensor")
    return config.imu[0]


def wait_until(condition: Callable[[], bool], words: str = "") -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, words
        time.sleep(0.02)


def is_settled(reader: ImuReader) -> bool:
    reader.poll()
    return reader.is_ready or bool(reader.problem)


class Streamed:
    """What a camera gave in two seconds or more."""

    def __init__(self, rig: Rig) -> None:
        self.ring = FrameRing(60 * 10**9)
        camera = rig.open_camera()
        self.started_ns = monotonic_ns()
        self.section = camera.start(self.ring)
        time.sleep(STREAM_S)
        wait_until(lambda: self.ring.n_packets >= STREAM_PICTURES)
        camera.stop()
        self.n_at_stop = self.ring.n_packets
        self.stopped_ns = monotonic_ns()
        camera.stop()
        self.packets, self.metadata = self.ring.snapshot()


@pytest.fixture(scope="module")
def streamed(rig: Rig) -> Streamed:
    return Streamed(rig)


def nal_types(data: bytes) -> list[int]:
    """Return the types of the NAL units in an Annex-B picture (H.264, table 7-1)."""
    types = []
    at = data.find(b"\0\0\1")
    while at >= 0 and at + 3 < len(data):
        types.append(data[at + 3] & 0x1F)
        at = data.find(b"\0\0\1", at + 3)
    return types


class TestCamera:
    def test_pictures_come_at_the_rate_that_it_says(self, streamed: Streamed) -> None:
        gaps = [b.abs_us - a.abs_us for a, b in pairwise(streamed.packets)]
        assert len(streamed.packets) >= STREAM_PICTURES and min(gaps) > 0
        period_us = streamed.section.frame_duration_us
        # A gap is a whole number of periods; a line of the sensor (19 us) is the finest step of a period.
        assert all(abs(g - round(g / period_us) * period_us) < 100 for g in gaps), gaps
        assert sum(gaps) / len(gaps) < 1.5 * period_us

    def test_stamps_are_on_the_monotonic_clock_while_it_ran(self, streamed: Streamed) -> None:
        for packet in streamed.packets:
            assert streamed.started_ns - 1_000_000_000 < packet.abs_us * 1000 <= streamed.stopped_ns

    def test_the_stream_begins_with_a_keyframe_and_each_one_has_its_parameter_sets(
        self, streamed: Streamed
    ) -> None:
        assert streamed.packets[0].keyframe
        for packet in streamed.packets:
            types = nal_types(packet.data)
            assert packet.data.startswith((b"\0\0\1", b"\0\0\0\1"))
            assert (5 in types) == packet.keyframe  # an IDR slice
            if packet.keyframe:
                assert 7 in types and 8 in types  # sequence and picture parameter sets
            else:
                assert 1 in types

    def test_keyframes_come_often_enough_to_cut_at(self, streamed: Streamed) -> None:
        keys = [p.abs_us for p in streamed.packets if p.keyframe]
        longest_us = max(b - a for a, b in pairwise(keys))
        assert longest_us <= 30 * streamed.section.frame_duration_us * 1.1

    def test_every_picture_finds_its_metadata_by_time(self, streamed: Streamed) -> None:
        cut = cut_video(
            streamed.packets, streamed.metadata, start_ns=streamed.packets[0].abs_us * 1000,
            end_ns=streamed.packets[-1].abs_us * 1000, first_abs_us=streamed.packets[0].abs_us,
            period_us=streamed.section.frame_duration_us, default_exposure_us=0, default_gain=0.0,
        )  # fmt: skip
        assert cut.n_without_metadata == 0 and len(cut.packets) == len(streamed.packets)
        for packet, record in zip(cut.packets, cut.records, strict=True):
            assert abs(record.sensor_timestamp_ns - packet.abs_us * 1000) <= JOIN_TOLERANCE_NS

    def test_the_fixed_controls_are_held(self, streamed: Streamed) -> None:
        assert {m.exposure_us for m in streamed.metadata} == {streamed.section.exposure_us}
        assert {round(m.analogue_gain, 3) for m in streamed.metadata} == {
            round(streamed.section.analogue_gain, 3)
        }

    def test_nothing_comes_after_stop_and_it_starts_again(self, rig: Rig, streamed: Streamed) -> None:
        assert streamed.ring.n_packets == streamed.n_at_stop
        ring = FrameRing(10**10)
        camera = rig.open_camera()
        camera.start(ring)
        wait_until(lambda: ring.first_keyframe_us is not None)
        camera.stop()
        assert (ring.first_keyframe_us or 0) * 1000 > streamed.stopped_ns - 1_000_000_000

    def test_packets_and_metadata_are_of_the_declared_types(self, streamed: Streamed) -> None:
        assert all(isinstance(p, EncodedPacket) and type(p.data) is bytes for p in streamed.packets)
        assert all(
            isinstance(m, FrameMetadata) and type(m.sensor_timestamp_ns) is int for m in streamed.metadata
        )


@pytest.fixture
def bus(rig: Rig, imu: ImuTable) -> Iterator[I2cBus]:
    made = rig.bus_opener(imu.bus)()
    yield made
    made.close()


@pytest.fixture
def address(imu: ImuTable) -> int:
    return imu.address


class TestI2cBus:
    def test_the_sensor_answers_with_its_id(self, bus: I2cBus, address: int) -> None:
        assert read_chip_id(bus, address) == CHIP_ID

    def test_an_address_without_a_device_is_an_os_error_with_its_number(
        self, bus: I2cBus, address: int
    ) -> None:
        with pytest.raises(OSError) as e:
            bus.read_burst(0x55, 0x00, 1)
        assert e.value.errno
        with pytest.raises(OSError):
            bus.writeto(0x55, b"\x07\x00")

    def test_only_one_holds_the_lock(self, bus: I2cBus, address: int) -> None:
        assert bus.try_lock() and not bus.try_lock()
        bus.unlock()
        assert bus.try_lock()
        bus.unlock()

    def test_a_burst_is_as_long_as_asked_for(self, bus: I2cBus, address: int) -> None:
        for n in (1, 5, 46):
            got = bus.read_burst(address, 0x08, n)
            assert type(got) is bytes and len(got) == n

    def test_buffer_ranges_of_the_drivers_calls_are_kept(self, bus: I2cBus, address: int) -> None:
        buffer = bytearray(b"\xee\xee\xee\xee")
        bus.writeto_then_readfrom(address, b"\xff\x00", buffer, out_start=1, out_end=2, in_start=2, in_end=3)
        assert buffer == b"\xee\xee\xa0\xee"

    @pytest.mark.parametrize(("mode", "acc_range_g"), [("amg", 16.0), ("accgyro", 16.0), ("ndof", 4.0)])
    def test_set_up_by_the_real_driver_holds(
        self, bus: I2cBus, address: int, mode: ImuMode, acc_range_g: float
    ) -> None:
        facts = set_up(bus, address, mode)
        assert (facts.acc_range_g, facts.gyro_range_dps) == (acc_range_g, 2000.0)
        assert len(facts.chip_id) == 32 and facts.warnings == []
        time.sleep(0.05)
        words = memoryview(bus.read_burst(address, 0x08, 6)).cast("h")
        norm_mps2 = sum((w / 100) ** 2 for w in words) ** 0.5
        # At rest on the table: gravity, within the data sheet's 1.5 m/s2 zero-g offset.
        assert abs(norm_mps2 - 9.81) < 1.5

    def test_its_opener_passes_to_the_samplers_process(
        self, rig: Rig, config: DeviceConfig, imu: ImuTable
    ) -> None:
        reader = ImuReader(imu, rig.bus_opener(imu.bus), config.sampler, span_s=5.0)
        reader.start()
        try:
            wait_until(lambda: is_settled(reader))
            assert not reader.problem
            start_ns = monotonic_ns() + 100_000_000
            wait_until(lambda: reader.has_slot_due_at(start_ns + 500_000_000))
            records = reader.records(start_ns, start_ns + 500_000_000)
            assert len(records) > 25 and all(r.data is not None for r in records)
        finally:
            reader.stop()


class TestTriggerPin:
    def test_after_arming_edges_come_stamped_on_the_monotonic_clock(
        self, rig: Rig, config: DeviceConfig
    ) -> None:
        # Edges count from arming on, whichever level the line has then: a laboratory's wave may run already.
        table = TriggerTable(pin=config.trigger.pin, pull=config.trigger.pull, require_low=rig.simulated)
        trigger = Trigger(rig.pin_factory(), table)
        try:
            t_armed = trigger.arm(lambda: None)
            rig.on_armed(t_armed)
            wait_until(lambda: trigger.n_edges >= 10, "no square wave came")
            train = trigger.disarm()
            now = monotonic_ns()
        finally:
            trigger.close()
        assert train.problems == [] and train.t0_ns == train.edges_ns[0]
        assert t_armed < train.edges_ns[0] and train.edges_ns[-1] <= now
        gaps = [b - a for a, b in pairwise(train.edges_ns)]
        assert all(abs(g - gaps[0]) < 0.2 * gaps[0] for g in gaps)
