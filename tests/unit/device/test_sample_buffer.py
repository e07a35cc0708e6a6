from collections.abc import Iterator

import pytest

from bricktrack_common.imu_records import ImuRecord
from bricktrack_device.inertial.sample_buffer import RECORD_BYTES, SampleBuffer


def record(slot: int) -> ImuRecord:
    if slot % 5 == 4:
        return ImuRecord(slot, slot * 10, slot * 10 + 3, None, 121, None)
    return ImuRecord(
        slot, slot * 10, slot * 10 + 3, bytes([slot % 256]) * 46, 0, b"\5\0\7" if slot % 3 == 0 else None
    )


@pytest.fixture
def buffer() -> Iterator[SampleBuffer]:
    made = SampleBuffer(16)
    yield made
    made.close()


def test_records_come_back_as_they_were_written(buffer: SampleBuffer) -> None:
    writer = SampleBuffer(16, buffer.name)
    for i in range(10):
        writer.append(record(i))
    writer.close()
    assert buffer.records() == [record(i) for i in range(10)]
    assert buffer.records(newest=2) == [record(8), record(9)]
    assert (buffer.count, buffer.n_failed) == (10, 2)


def test_the_oldest_are_overwritten_and_the_one_in_the_writers_hands_is_left_out(
    buffer: SampleBuffer,
) -> None:
    for i in range(100):
        buffer.append(record(i))
    # The slot that the next append overwrites is never handed out.
    assert buffer.records() == [record(i) for i in range(85, 100)]


def test_a_record_caught_half_written_is_left_out(buffer: SampleBuffer) -> None:
    for i in range(6):
        buffer.append(record(i))
    torn = 64 + 3 * RECORD_BYTES + 40
    buffer._view[torn] ^= 0xFF
    assert buffer.records() == [record(i) for i in (0, 1, 2, 4, 5)]


def test_the_reader_can_ask_the_writer_to_stop(buffer: SampleBuffer) -> None:
    writer = SampleBuffer(16, buffer.name)
    assert not writer.stop_asked
    buffer.ask_stop()
    assert writer.stop_asked
    writer.close()
