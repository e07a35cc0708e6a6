"""Which clock is which.

One clock rules a unit: CLOCK_MONOTONIC in int64 nanoseconds. The kernel stamps GPIO edges and camera frames
with it. Triplets of the unit's three clocks are logged at arming, trigger and end, for people and for checks;
no interval is ever computed from the real-time clock.
"""

import time
from collections.abc import Callable

import msgspec

from bricktrack_common.errors import HardwareError

MAX_BOOTTIME_DIFFERENCE_NS = 1_000_000
_CLOSE_NS = 50_000
_MAX_READINGS = 20


class ClockTriplet(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The three clocks of a unit, read within microseconds of each other, ns."""

    monotonic_ns: int
    boottime_ns: int
    realtime_ns: int


def monotonic_ns() -> int:
    """Return CLOCK_MONOTONIC, ns."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC)


def read_clock_triplet(*, clock: Callable[[int], int] = time.clock_gettime_ns) -> ClockTriplet:
    """Return the three clocks, the monotonic one being the middle of two readings around the others.

    Another thread may get the processor between two readings, for milliseconds on a busy unit: the clocks are
    read again until they were read close together, and the closest of some readings is taken.

    Parameters
    ----------
    clock : callable
        Returns the clock of an id of `time.clock_gettime_ns`, ns.
    """
    readings: list[tuple[int, int, int, int]] = []
    while len(readings) < _MAX_READINGS:
        before = clock(time.CLOCK_MONOTONIC)
        boot, real = clock(time.CLOCK_BOOTTIME), clock(time.CLOCK_REALTIME)
        width = clock(time.CLOCK_MONOTONIC) - before
        readings.append((width, before + width // 2, boot, real))
        if width <= _CLOSE_NS:
            break
    _, middle, boot, real = min(readings)
    return ClockTriplet(monotonic_ns=middle, boottime_ns=boot, realtime_ns=real)


def check_monotonic_is_boottime(triplet: ClockTriplet) -> None:
    """Make sure that frame stamps mean the same on either clock.

    Raises
    ------
    HardwareError
        If they differ by more than 1 ms: the machine was suspended since it booted.
    """
    difference = triplet.boottime_ns - triplet.monotonic_ns
    if abs(difference) > MAX_BOOTTIME_DIFFERENCE_NS:
        raise HardwareError(
            f"CLOCK_BOOTTIME is {difference / 1e6:.1f} ms ahead of CLOCK_MONOTONIC: this machine was "
            "suspended since it booted, so frame stamps are ambiguous. Reboot it and disable suspend"
        )
