import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
from device_fakes import FakeBusOpener

from bricktrack_common.clocks import monotonic_ns
from bricktrack_device.config import ImuTable, SamplerTable
from bricktrack_device.inertial import imu_reader
from bricktrack_device.inertial.imu_reader import ImuReader

ORDINARY = SamplerTable(priority=0, lock_memory=False)


def reader_on(opener: FakeBusOpener) -> ImuReader:
    return ImuReader(ImuTable(name="brick", period_ms=5), opener, ORDINARY, span_s=5.0)


def poll_until(reader: ImuReader, condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, reader.problem or "nothing happened in time"
        reader.poll()
        time.sleep(0.005)


def test_samples_of_a_window_come_on_the_grid() -> None:
    reader = reader_on(FakeBusOpener(fail_every=10))
    assert reader._buffer is not None
    memory = Path("/dev/shm") / reader._buffer.name
    assert memory.exists()
    reader.start()
    try:
        poll_until(reader, lambda: reader.is_ready)
        description = reader.description()
        assert description is not None and description.period_ns == 5_000_000
        assert description.t0_ns % 5_000_000 == 0 and "ordinary scheduling" in reader.scheduling
        start = monotonic_ns() + 50_000_000
        end = start + 300_000_000
        poll_until(reader, lambda: reader.has_slot_due_at(end))
        records = reader.records(start, end)
        due = [description.t0_ns + r.slot * description.period_ns for r in records]
        assert all(start <= t <= end for t in due) and len(reader.slots_due(start, end)) in (60, 61)
        assert 0.5 * 60 < len(records) <= 61
        assert all(r.t_before_ns >= t for r, t in zip(records, due, strict=True))
        status = reader.status()
        assert status.samples > 0 and status.gaps > 0 and status.calibration == 0xFF and status.problem == ""
    finally:
        reader.stop()
        reader.stop()
    assert not memory.exists()
    assert reader.status().samples == 0


def test_a_hanging_sampler_is_noticed_and_ended() -> None:
    reader = reader_on(FakeBusOpener(hang_after=20))
    reader.start()
    try:
        poll_until(reader, lambda: bool(reader.problem))
        assert "hangs" in reader.problem and not reader._process.is_alive()
        assert len(reader.records(0, monotonic_ns())) == 20
    finally:
        reader.stop()


def test_a_unit_that_stood_still_does_not_hold_its_sampler_to_be_hanging() -> None:
    reader = reader_on(FakeBusOpener(hang_after=20, hang_s=1.0))
    reader.start()
    try:
        poll_until(reader, lambda: reader.is_ready)
        time.sleep(0.9)  # and so did the sampler
        reader.poll()
        assert reader.problem == "" and reader.news() == []
    finally:
        reader.stop()


def test_a_sampler_that_hangs_for_a_while_in_a_run_goes_on_and_only_a_gap_is_left() -> None:
    reader = reader_on(FakeBusOpener(hang_after=20, hang_s=0.8))
    reader.start()
    told: list[str] = []
    deadline = time.monotonic() + 60.0
    try:
        while reader.status().samples < 60:
            assert time.monotonic() < deadline, reader.status()
            reader.poll(may_give_up=False)
            told += reader.news()
            time.sleep(0.005)
        assert reader.status().problem == "" and len(told) == 1 and "hangs: no slot for" in told[0]
        records = reader.records(0, monotonic_ns())
        gaps = [b.slot - a.slot for a, b in pairwise(records)]
        # 0.8 s of slots of 5 ms; a slot that waits for the bus counts as taken.
        assert max(gaps) >= 155 and len(records) >= 60
    finally:
        reader.stop()


def test_a_sensor_that_resets_itself_in_silence_is_told_and_goes_on() -> None:
    reader = reader_on(FakeBusOpener(reset_after=30))
    reader.start()
    try:
        poll_until(reader, lambda: bool(reader.status().problem))
        assert "reads 0x00 where 0x07 was set" in reader.status().problem
        assert reader.news() == [reader.status().problem] and reader.news() == []
        assert reader.is_ready and not reader.problem
    finally:
        reader.stop()


def test_a_sensor_that_is_not_there_is_said_in_the_drivers_words() -> None:
    reader = reader_on(FakeBusOpener(present=False))
    reader.start()
    try:
        poll_until(reader, lambda: bool(reader.problem))
        assert "0x28" in reader.problem and not reader.is_ready and reader.description() is None
        assert reader.status().problem == reader.problem
    finally:
        reader.stop()


def test_a_set_up_that_never_ends_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imu_reader, "SET_UP_TIMEOUT_S", 0.2)
    reader = reader_on(FakeBusOpener(hang_at_opening=True))
    reader.start()
    try:
        poll_until(reader, lambda: bool(reader.problem))
        assert "not set up within" in reader.problem
    finally:
        reader.stop()


def test_what_a_sensor_learnt_is_kept_when_it_ends_and_restored_when_it_starts(tmp_path: Path) -> None:
    # The fake's CALIB_STAT is full at once; its offsets are zero until something is written.
    settings = ImuTable(name="brick", period_ms=5, mode="ndof", save_calibration=True)
    for was_restored in (False, True):
        reader = ImuReader(settings, FakeBusOpener(), ORDINARY, span_s=5.0, calibration_folder=tmp_path)
        reader.start()
        try:
            poll_until(reader, lambda reader=reader: reader.is_ready and reader.status().samples > 3)
            description = reader.description()
            assert description is not None and description.calibration_restored is was_restored
        finally:
            reader.stop()
        assert [p.stem for p in tmp_path.iterdir()] == [bytes(range(16)).hex()]


def test_nothing_is_kept_unless_it_was_asked_for(tmp_path: Path) -> None:
    settings = ImuTable(name="brick", period_ms=5, mode="ndof")
    reader = ImuReader(settings, FakeBusOpener(), ORDINARY, span_s=5.0, calibration_folder=tmp_path)
    reader.start()
    try:
        poll_until(reader, lambda: reader.is_ready)
    finally:
        reader.stop()
    assert list(tmp_path.iterdir()) == []
