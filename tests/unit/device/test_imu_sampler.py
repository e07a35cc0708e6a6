import errno
import os
import time

import pytest
from device_fakes import FakeBus

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.imu_records import ImuRecord
from bricktrack_device.config import SamplerTable
from bricktrack_device.inertial.imu_sampler import ask_for_realtime, sample, sleep_until_ns

MS = 1_000_000
T0 = 1_000_000 * MS


class SlowBus(FakeBus):
    """A bus on a clock of its own: each burst takes time, and some take long."""

    def __init__(self, *, burst_ns: int = 1 * MS, slow: dict[int, int] | None = None, **faults: int) -> None:
        super().__init__(**faults)  # type: ignore[arg-type]
        self.now_ns = T0 - 5 * MS
        self.burst_ns = burst_ns
        self.slow = slow or {}
        self.wake_late: dict[int, int] = {}
        self.n_sleeps = 0

    def clock(self) -> int:
        return self.now_ns

    def sleep_until(self, due_ns: int) -> None:
        self.now_ns = max(self.now_ns, due_ns) + self.wake_late.get(self.n_sleeps, 0)
        self.n_sleeps += 1

    def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
        self.now_ns += self.slow.get(self.n_bursts, self.burst_ns) if register == 0x08 else 200_000
        return super().read_burst(address, register, n_bytes)


def run(bus: SlowBus, n_records: int, *, status_every: int = 10, t0_ns: int = T0) -> list[ImuRecord]:
    records: list[ImuRecord] = []
    sample(
        bus, 0x28, t0_ns=t0_ns, period_ns=10 * MS, status_every=status_every, append=records.append,
        is_over=lambda: len(records) >= n_records, clock=bus.clock, sleep_until=bus.sleep_until,
    )  # fmt: skip
    return records


def test_slots_lie_on_the_grid_and_never_drift() -> None:
    bus = SlowBus()
    records = run(bus, 500)
    assert [r.slot for r in records] == list(range(500))
    assert [r.t_before_ns for r in records] == [T0 + n * 10 * MS for n in range(500)]
    assert all(r.t_after_ns - r.t_before_ns == 1 * MS and r.data is not None for r in records)


def test_an_overrun_skips_to_the_next_grid_point() -> None:
    bus = SlowBus(slow={3: 24 * MS})
    records = run(bus, 8)
    # Slot 3 ends 24 ms after its due time, at 54 ms: slots 4 and 5 are gone, slot 6 is on time.
    assert [r.slot for r in records] == [0, 1, 2, 3, 6, 7, 8, 9]
    assert records[4].t_before_ns == T0 + 60 * MS


def test_a_burst_that_ends_exactly_on_a_grid_point_takes_that_slot() -> None:
    bus = SlowBus(slow={1: 10 * MS})
    assert [r.slot for r in run(bus, 4)] == [0, 1, 2, 3]


def test_waking_up_a_whole_period_late_takes_the_slot_that_is_due_then() -> None:
    bus = SlowBus()
    bus.wake_late = {5: 25 * MS}
    records = run(bus, 8)
    assert [r.slot for r in records] == [0, 1, 2, 3, 4, 7, 8, 9]
    assert records[5].t_before_ns == T0 + 75 * MS


def test_waking_up_a_little_late_keeps_the_slot_and_tells_the_true_time() -> None:
    bus = SlowBus()
    bus.wake_late = {2: 3 * MS}
    records = run(bus, 4)
    assert [r.slot for r in records] == [0, 1, 2, 3]
    assert records[2].t_before_ns == T0 + 23 * MS and records[3].t_before_ns == T0 + 30 * MS


def test_errors_become_records_with_their_errno_and_no_data() -> None:
    records = run(SlowBus(fail_every=4), 12)
    for i, r in enumerate(records):
        assert (r.data is None) == (i % 4 == 3)
        assert r.errno == (errno.EREMOTEIO if i % 4 == 3 else 0)


def test_status_canaries_are_read_every_so_many_slots() -> None:
    bus = SlowBus()
    bus.pages[0][0x39], bus.pages[0][0x3A], bus.pages[0][0x3D] = 5, 0, 0x07
    records = run(bus, 25, status_every=10)
    assert [r.slot for r in records if r.status is not None] == [0, 10, 20]
    assert records[10].status == bytes((5, 0, 7))


def test_a_failed_canary_read_leaves_the_samples_data() -> None:
    class NoStatus(SlowBus):
        def read_burst(self, address: int, register: int, n_bytes: int) -> bytes:
            if register == 0x39:
                raise OSError(errno.ETIMEDOUT, "injected")
            return super().read_burst(address, register, n_bytes)

    record = run(NoStatus(), 1)[0]
    assert record.data is not None and record.status is None and record.errno == errno.ETIMEDOUT


def test_sleeping_ends_at_the_instant_and_not_before() -> None:
    for ahead_ns in (0, 2 * MS, 7 * MS):
        due = monotonic_ns() + ahead_ns
        sleep_until_ns(due)
        assert monotonic_ns() >= due
    before = time.monotonic()
    sleep_until_ns(1)  # long past
    assert time.monotonic() - before < 0.5


def test_what_the_scheduler_refuses_is_said_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    words = ask_for_realtime(SamplerTable(priority=50, cpu=0, lock_memory=False))
    assert "SCHED_FIFO refused" in words and "core 0 refused" in words
    assert ask_for_realtime(SamplerTable(priority=0, cpu=-1, lock_memory=False)).startswith("ordinary")
