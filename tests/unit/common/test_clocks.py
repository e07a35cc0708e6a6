import time

import pytest

from bricktrack_common.clocks import check_monotonic_is_boottime, read_clock_triplet
from bricktrack_common.errors import HardwareError

REAL_AHEAD_NS = 1_700_000_000_000_000_000


class BusyClock:
    """One time on three clocks; it takes 1 us to read, and more at the readings that are named."""

    def __init__(self, late_ns: dict[int, int], *, boot_ahead_ns: int = 0) -> None:
        self.now_ns = 5_000_000_000
        self.n = 0
        self.late_ns = late_ns
        self.ahead_ns = {
            time.CLOCK_MONOTONIC: 0, time.CLOCK_BOOTTIME: boot_ahead_ns, time.CLOCK_REALTIME: REAL_AHEAD_NS
        }  # fmt: skip

    def __call__(self, clock_id: int) -> int:
        self.now_ns += 1000 + self.late_ns.get(self.n, 0)
        self.n += 1
        return self.now_ns + self.ahead_ns[clock_id]


@pytest.mark.parametrize("late_at", [1, 2, 3, 5])
def test_a_thread_that_loses_the_processor_between_two_readings_reads_again(late_at: int) -> None:
    clock = BusyClock({late_at: 5_000_000})  # 5 ms: five times what would be called a suspended machine
    triplet = read_clock_triplet(clock=clock)
    assert abs(triplet.boottime_ns - triplet.monotonic_ns) <= 2000
    assert abs(triplet.realtime_ns - REAL_AHEAD_NS - triplet.monotonic_ns) <= 2000
    check_monotonic_is_boottime(triplet)


def test_where_no_reading_is_close_the_closest_is_taken() -> None:
    late_ns = {4 * k + 3: 1_000_000 + (k - 7) ** 2 * 100_000 for k in range(100)}
    triplet = read_clock_triplet(clock=BusyClock(late_ns))
    assert abs(triplet.boottime_ns - triplet.monotonic_ns) <= 0.5 * 1_000_000 + 3000


def test_a_machine_that_was_suspended_is_refused() -> None:
    with pytest.raises(HardwareError, match=r"CLOCK_BOOTTIME is 3600000.0 ms ahead"):
        check_monotonic_is_boottime(read_clock_triplet(clock=BusyClock({}, boot_ahead_ns=3600 * 10**9)))


def test_this_machines_clocks_agree() -> None:
    check_monotonic_is_boottime(read_clock_triplet())
