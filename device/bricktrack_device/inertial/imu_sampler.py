"""The inertial sampler: one process a sensor, reading on an absolute grid of time.

Slot n is due at ``t0 + n * period`` on CLOCK_MONOTONIC. A slot that runs over makes the next ones be skipped
until the grid is met again; the grid itself never shifts. A failed read becomes a record with its errno.
"""

import ctypes
import errno
import gc
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import BricktrackError, HardwareError
from bricktrack_common.imu_records import FIRST_REGISTER, N_DATA_BYTES, AxisMap, ImuRecord
from bricktrack_device.config import ImuMode, SamplerTable
from bricktrack_device.inertial.bno055 import (
    N_STATUS_BYTES,
    REG_SYS_STATUS,
    SensorFacts,
    read_calibration,
    set_up,
)
from bricktrack_device.inertial.imu_calibration import load_calibration
from bricktrack_device.inertial.sample_buffer import SampleBuffer
from bricktrack_device.interfaces import BusOpener, I2cBus

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_MCL_CURRENT_FUTURE_ONFAULT = 7  # pages stay once they were touched; untouched ones cost no memory
_START_DELAY_NS = 20_000_000
_SWITCH_INTERVAL_S = 0.0002  # another thread of this process gives way so soon; by default after 5 ms


@dataclass(frozen=True, slots=True)
class SamplerJob:
    """What a sampler's process is told; everything here crosses a process boundary."""

    name: str
    opener: BusOpener
    address: int
    mode: ImuMode
    axis_map: AxisMap
    period_ns: int
    status_every: int
    realtime: SamplerTable
    buffer_name: str
    buffer_capacity: int
    parent_pid: int
    calibration_folder: Path | None
    report_calibration: bool


@dataclass(frozen=True, slots=True)
class SamplerReady:
    """What a sampler's process answers once its sensor is set up.

    Attributes
    ----------
    t0_ns : int
        The grid's start.
    scheduling : str
        What the scheduler granted, in words.
    """

    facts: SensorFacts
    t0_ns: int
    scheduling: str


@dataclass(frozen=True, slots=True)
class SamplerCalibrated:
    """What a sensor had learnt when its sampling ended: 22 bytes, and its CALIB_STAT."""

    registers: bytes
    calib_stat: int


@dataclass(frozen=True, slots=True)
class SamplerFailed:
    """Why a sampler's process ends."""

    words: str


def sampler_main(job: SamplerJob, connection: Connection) -> None:
    """Run one sampler until it is told to stop or its parent is gone; the entry point of its process."""
    # Both reach the whole process group; the daemon decides when sampling ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    if os.getppid() != job.parent_pid:
        return  # killed while this process began; nobody waits for samples, and its memory may be gone
    buffer = SampleBuffer(job.buffer_capacity, job.buffer_name)
    try:
        _run(job, connection, buffer)
    except (BricktrackError, OSError) as e:
        _tell(connection, SamplerFailed(str(e)))
    except Exception as e:
        _tell(connection, SamplerFailed(f"a bug in the sampler: {type(e).__name__}: {e}"))
        raise
    finally:
        buffer.close()


def _run(job: SamplerJob, connection: Connection, buffer: SampleBuffer) -> None:
    bus = job.opener()
    try:
        facts = set_up(
            bus,
            job.address,
            job.mode,
            axis_map=job.axis_map,
            saved_calibration=partial(_saved_calibration, job),
        )
        scheduling = ask_for_realtime(job.realtime)
        gc.collect()
        gc.freeze()
        gc.disable()
        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        t0_ns = -(-(monotonic_ns() + _START_DELAY_NS) // job.period_ns) * job.period_ns
        _tell(connection, SamplerReady(facts, t0_ns, scheduling))
        sample(
            bus,
            job.address,
            t0_ns=t0_ns,
            period_ns=job.period_ns,
            status_every=job.status_every,
            append=buffer.append,
            is_over=lambda: buffer.stop_asked or os.getppid() != job.parent_pid,
        )
        if job.report_calibration and buffer.stop_asked:
            learnt = read_calibration(bus, job.address, facts.opr_mode)
            if learnt is not None:
                _tell(connection, SamplerCalibrated(*learnt))
    finally:
        bus.close()


def _saved_calibration(job: SamplerJob, chip_id: str) -> bytes | None:
    folder = job.calibration_folder
    return None if folder is None else load_calibration(folder, chip_id, job.mode)


def _tell(connection: Connection, message: SamplerReady | SamplerCalibrated | SamplerFailed) -> None:
    try:
        connection.send(message)
    except BrokenPipeError:
        return  # the daemon is gone; this process ends too


def sample(
    bus: I2cBus,
    address: int,
    *,
    t0_ns: int,
    period_ns: int,
    status_every: int,
    append: Callable[[ImuRecord], None],
    is_over: Callable[[], bool],
    clock: Callable[[], int] = monotonic_ns,
    sleep_until: Callable[[int], None] | None = None,
) -> None:
    """Read the sensor once a slot until ``is_over``; see the module's first lines."""
    sleep_until = sleep_until or sleep_until_ns
    n = 0
    while not is_over():
        sleep_until(t0_ns + n * period_ns)
        t_before = clock()
        # A wake-up later than a whole period belongs to the grid point it came after, not to the one missed.
        n = max(n, (t_before - t0_ns) // period_ns)
        data: bytes | None = None
        status: bytes | None = None
        error = 0
        try:
            data = bus.read_burst(address, FIRST_REGISTER, N_DATA_BYTES)
            t_after = clock()
            if n % status_every == 0:
                canaries = bus.read_burst(address, REG_SYS_STATUS, N_STATUS_BYTES)
                status = bytes((canaries[0], canaries[1], canaries[4]))
        except OSError as e:
            error = e.errno or errno.EIO
            t_after = clock()
        append(ImuRecord(n, t_before, t_after, data, error, status))
        n = max(n + 1, -(-(clock() - t0_ns) // period_ns))


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


_libc = ctypes.CDLL(None, use_errno=True)


def sleep_until_ns(due_ns: int) -> None:
    """Sleep until an instant of CLOCK_MONOTONIC, or return at once if it is past.

    The standard library only sleeps for a length of time, which is already wrong when the call begins.
    """
    until = _Timespec(due_ns // 1_000_000_000, due_ns % 1_000_000_000)
    while True:
        result = _libc.clock_nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(until), None)
        if result == 0:
            return
        if result != errno.EINTR:
            raise HardwareError(f"clock_nanosleep until {due_ns} ns: {os.strerror(result)}")


def ask_for_realtime(wishes: SamplerTable) -> str:
    """Ask the scheduler for a fixed priority, a core and locked memory; say in words what was granted."""
    granted = []
    if wishes.priority:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(wishes.priority))
            granted.append(f"SCHED_FIFO {wishes.priority}")
        except OSError as e:
            granted.append(f"ordinary scheduling (SCHED_FIFO refused: {e.strerror})")
    else:
        granted.append("ordinary scheduling")
    cores = sorted(os.sched_getaffinity(0))
    cpu = wishes.cpu if wishes.cpu >= 0 else (cores[-1] if len(cores) >= 4 else -1)
    if cpu >= 0:
        try:
            os.sched_setaffinity(0, {cpu})
            granted.append(f"core {cpu}")
        except OSError as e:
            granted.append(f"any core (core {cpu} refused: {e.strerror})")
    if wishes.lock_memory:
        locked = _libc.mlockall(_MCL_CURRENT_FUTURE_ONFAULT) == 0
        granted.append(
            "memory locked" if locked else f"memory not locked ({os.strerror(ctypes.get_errno())})"
        )
    return ", ".join(granted)
