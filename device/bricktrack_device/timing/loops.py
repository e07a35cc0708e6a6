"""Three ways to read a sensor a hundred times a second, in one process, block after block in turn.

"grid" is the sampler of a run: absolute deadlines. "naive" sleeps one period after each read, as the simplest
program does. "adaptive" is the source paper's: it shortens each sleep by the time that the last iteration
took, so it errs by whatever it does not measure. The two others exist only to be measured beside the first.
"""

import errno
import gc
import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Literal

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import BricktrackError
from bricktrack_common.imu_records import FIRST_REGISTER, N_DATA_BYTES, ImuRecord
from bricktrack_device.config import ImuTable, SamplerTable
from bricktrack_device.inertial.bno055 import set_up
from bricktrack_device.inertial.imu_sampler import ask_for_realtime, sample
from bricktrack_device.interfaces import BusOpener, I2cBus

Method = Literal["grid", "naive", "adaptive"]
METHODS: tuple[Method, ...] = ("grid", "naive", "adaptive")
_START_DELAY_NS = 20_000_000


@dataclass(frozen=True, slots=True)
class Block:
    """One method's reads without a break; slots count from the block's own start."""

    method: Method
    t0_ns: int
    n_slots: int
    records: list[ImuRecord]


@dataclass(frozen=True, slots=True)
class LoopsJob:
    """What the process is told; everything here crosses a process boundary."""

    opener: BusOpener
    imu: ImuTable
    realtime: SamplerTable
    plan: tuple[tuple[Method, int], ...]


@dataclass(frozen=True, slots=True)
class LoopsReady:
    """The sensor is set up; what the scheduler granted, in words."""

    scheduling: str


@dataclass(frozen=True, slots=True)
class LoopsFailed:
    """Why there will be no more blocks."""

    words: str


def plan_blocks(
    n_slots: int, methods: tuple[Method, ...], *, block_slots: int
) -> tuple[tuple[Method, int], ...]:
    """Return methods in turn, in blocks, until each has its slots.

    Examples
    --------
    >>> plan_blocks(250, ("grid", "naive"), block_slots=200)
    (('grid', 200), ('naive', 200), ('grid', 50), ('naive', 50))
    """
    plan: list[tuple[Method, int]] = []
    for done in range(0, n_slots, block_slots):
        plan += [(method, min(block_slots, n_slots - done)) for method in methods]
    return tuple(plan)


def loops_main(job: LoopsJob, connection: Connection) -> None:
    """Run the plan and send each block as it ends; the entry point of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = os.getppid()
    try:
        bus = job.opener()
        try:
            set_up(bus, job.imu.address, job.imu.mode, axis_map=job.imu.axis_map)
            connection.send(LoopsReady(ask_for_realtime(job.realtime)))
            gc.collect()
            gc.freeze()
            gc.disable()
            for method, n_slots in job.plan:
                connection.send(run_block(bus, job.imu, method, n_slots))
                if os.getppid() != parent:
                    return
        finally:
            bus.close()
    except (BricktrackError, OSError) as e:
        connection.send(LoopsFailed(str(e)))
    except Exception as e:
        connection.send(LoopsFailed(f"a bug in the loops: {type(e).__name__}: {e}"))
        raise


def run_block(bus: I2cBus, imu: ImuTable, method: Method, n_slots: int) -> Block:
    """Read for ``n_slots`` slots by one method."""
    period_ns = imu.period_ms * 1_000_000
    records: list[ImuRecord] = []
    if method == "grid":
        t0_ns = -(-(monotonic_ns() + _START_DELAY_NS) // period_ns) * period_ns
        end_ns = t0_ns + (n_slots - 1) * period_ns
        sample(
            bus,
            imu.address,
            t0_ns=t0_ns,
            period_ns=period_ns,
            status_every=imu.status_every,
            append=records.append,
            # Over once the last slot is taken or passed.
            is_over=lambda: bool(records) and t0_ns + (records[-1].slot + 1) * period_ns > end_ns,
        )
    else:
        loop = naive_loop if method == "naive" else adaptive_loop
        t0_ns = monotonic_ns()
        loop(bus, imu, n_slots, records.append)
    return Block(method, t0_ns, n_slots, records)


def naive_loop(
    bus: I2cBus,
    imu: ImuTable,
    n_slots: int,
    append: Callable[[ImuRecord], None],
    *,
    sleep: Callable[[float], None] = time.sleep,
    clock: Callable[[], int] = monotonic_ns,
) -> None:
    """Read, then sleep one period, and so on."""
    period_s = imu.period_ms / 1000
    for n in range(n_slots):
        _read(bus, imu, n, append, clock)
        sleep(period_s)


def adaptive_loop(
    bus: I2cBus,
    imu: ImuTable,
    n_slots: int,
    append: Callable[[ImuRecord], None],
    *,
    sleep: Callable[[float], None] = time.sleep,
    clock: Callable[[], int] = monotonic_ns,
) -> None:
    """Read, then sleep one period less the time that this iteration's work took, and so on."""
    period_s = imu.period_ms / 1000
    for n in range(n_slots):
        start_ns = clock()
        _read(bus, imu, n, append, clock)
        sleep(max(0.0, period_s - (clock() - start_ns) * 1e-9))


def _read(
    bus: I2cBus, imu: ImuTable, n: int, append: Callable[[ImuRecord], None], clock: Callable[[], int]
) -> None:
    data, error = None, 0
    t_before = clock()
    try:
        data = bus.read_burst(imu.address, FIRST_REGISTER, N_DATA_BYTES)
    except OSError as e:
        error = e.errno or errno.EIO
    append(ImuRecord(n, t_before, clock(), data, error, None))
