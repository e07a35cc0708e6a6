"""One inertial sensor as the daemon sees it: its sampler process, watched, and the records of a run.

A sampler that dies, hangs or never gets ready is noticed and reported in words; it stops neither the camera
nor the other sensors. One that hangs in a run is left to go on: a bus may come free again.
"""

import logging
import multiprocessing
import os
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import StorageError
from bricktrack_common.imu_records import FIRST_REGISTER, ImuDescription, ImuRecord
from bricktrack_common.wire_messages import ImuStatus
from bricktrack_device.config import ImuTable, SamplerTable
from bricktrack_device.inertial.bno055 import REG_CALIB_STAT
from bricktrack_device.inertial.imu_calibration import save_calibration
from bricktrack_device.inertial.imu_sampler import (
    SamplerCalibrated,
    SamplerFailed,
    SamplerJob,
    SamplerReady,
    sampler_main,
)
from bricktrack_device.inertial.sample_buffer import SampleBuffer
from bricktrack_device.interfaces import BusOpener

logger = logging.getLogger(__name__)

SET_UP_TIMEOUT_S = 12.0
_HANG_NS = 500_000_000
_HANG_PERIODS = 20
_GIVE_UP_NS = 5_000_000_000
"""A bus that hung for a moment comes free again, a sampler that was ended does not."""
_STALLED_NS = 250_000_000
"""Between two looks: the whole unit stood still, and the sampler is given time to show that it lives."""
_STOP_TIMEOUT_S = 1.0

_context = multiprocessing.get_context("spawn")

SamplerMain = Callable[[SamplerJob, Connection], None]


class ImuReader:
    """One sensor, from `start` to `stop`.

    Parameters
    ----------
    settings : ImuTable
    opener : callable
        Opens the sensor's bus, in the sampler's process.
    realtime : SamplerTable
    span_s : float
        How far back records are kept.
    calibration_folder : Path or None
        Where calibrations are kept by chip; `None` keeps and restores none.
    main : callable
        What the process runs; replaced in tests of dying and hanging samplers.
    """

    def __init__(
        self,
        settings: ImuTable,
        opener: BusOpener,
        realtime: SamplerTable,
        *,
        span_s: float,
        calibration_folder: Path | None = None,
        main: SamplerMain = sampler_main,
    ) -> None:
        self.settings = settings
        self._period_ns = settings.period_ms * 1_000_000
        self._lock = threading.Lock()
        self._buffer: SampleBuffer | None = SampleBuffer(max(64, round(span_s * 1e9 / self._period_ns)))
        self._connection, self._child_connection = _context.Pipe(duplex=False)
        job = SamplerJob(
            name=settings.name,
            opener=opener,
            address=settings.address,
            mode=settings.mode,
            axis_map=settings.axis_map,
            period_ns=self._period_ns,
            status_every=settings.status_every,
            realtime=realtime,
            buffer_name=self._buffer.name,
            buffer_capacity=self._buffer.capacity,
            parent_pid=os.getpid(),
            calibration_folder=calibration_folder,
            report_calibration=settings.save_calibration and calibration_folder is not None,
        )
        self._calibration_folder = calibration_folder
        self._process: SpawnProcess = _context.Process(
            target=main, args=(job, self._child_connection), name=f"imu-{settings.name}", daemon=True
        )
        self._ready: SamplerReady | None = None
        self._problem = ""
        self._reset_words = ""
        self._stall_words = ""
        self._news: list[str] = []
        self._started_ns = 0
        self._seen_count = 0
        self._seen_at_ns = 0
        self._looked_ns = 0
        self._status = ImuStatus(name=settings.name, samples=0, gaps=0)

    @property
    def name(self) -> str:
        """The sensor's name."""
        return self.settings.name

    @property
    def problem(self) -> str:
        """Why there are no more samples, or ``""``."""
        return self._problem

    @property
    def is_ready(self) -> bool:
        """Whether the sensor is set up and was not lost since."""
        return self._ready is not None and not self._problem

    @property
    def silence(self) -> str:
        """Why no samples come now, in words, or ``""``; a sensor whose bus hangs may come again."""
        return self._problem or self._stall_words

    @property
    def warnings(self) -> list[str]:
        """What the set-up found that does not stop the sensor."""
        return [] if self._ready is None else self._ready.facts.warnings

    @property
    def scheduling(self) -> str:
        """What the scheduler granted to the sampler."""
        return "" if self._ready is None else self._ready.scheduling

    def start(self) -> None:
        """Start the sampler's process; `poll` tells when it is ready."""
        self._started_ns = monotonic_ns()
        self._process.start()
        self._child_connection.close()

    def poll(self, *, may_give_up: bool = True) -> None:
        """Take the sampler's messages and see whether it is alive and at work.

        With ``may_give_up`` one that hangs for long is ended; without it may go on, and only `news` tells.
        """
        if self._problem or self._buffer is None:
            return
        self._take_messages()
        now = monotonic_ns()
        if now - self._looked_ns > _STALLED_NS:
            self._seen_at_ns = now
        self._looked_ns = now
        if self._problem:
            pass
        elif not self._process.is_alive():
            self._take_messages()
            self._problem = self._problem or f"its sampler died (exit code {self._process.exitcode})"
        elif self._ready is None:
            if now - self._started_ns > SET_UP_TIMEOUT_S * 1e9:
                self._problem = f"was not set up within {SET_UP_TIMEOUT_S:g} s; the bus may be stuck"
        else:
            count = self._buffer.count
            if count != self._seen_count:
                self._seen_count, self._seen_at_ns, self._stall_words = count, now, ""
                self._look_for_reset(self._ready.facts.opr_mode)
            elif (silent_ns := now - self._seen_at_ns) > max(_HANG_NS, _HANG_PERIODS * self._period_ns):
                words = f"its sampler hangs: no slot for {silent_ns / 1e9:.1f} s; the bus may be stuck"
                if may_give_up and silent_ns > _GIVE_UP_NS:
                    self._problem = words
                elif not self._stall_words:
                    self._stall_words = words
                    self._news.append(words)
        if self._problem:
            self._news.append(self._problem)
            self._end_process()

    def news(self) -> list[str]:
        """Return in words what has gone wrong since the last time this was asked."""
        told, self._news = self._news, []
        return told

    def description(self) -> ImuDescription | None:
        """Return what the stream's header says, or `None` if the sensor was never ready."""
        if self._ready is None:
            return None
        facts = self._ready.facts
        return ImuDescription(
            name=self.name,
            chip_id=facts.chip_id,
            bus=self.settings.bus,
            address=self.settings.address,
            opr_mode=facts.opr_mode,
            fusion=facts.fusion,
            acc_range_g=facts.acc_range_g,
            gyro_range_dps=facts.gyro_range_dps,
            period_ns=self._period_ns,
            t0_ns=self._ready.t0_ns,
            latency_ns=self.settings.latency_us * 1000,
            axis_map=facts.axis_map,
            calibration_restored=facts.calibration_restored,
        )

    def slots_due(self, start_ns: int, end_ns: int) -> range:
        """Return the slots whose due time lies in a window."""
        if self._ready is None:
            return range(0)
        t0 = self._ready.t0_ns
        return range(max(0, -(-(start_ns - t0) // self._period_ns)), (end_ns - t0) // self._period_ns + 1)

    def records(self, start_ns: int, end_ns: int) -> list[ImuRecord]:
        """Return the records of the slots that were due in a window, oldest first."""
        due = self.slots_due(start_ns, end_ns)
        with self._lock:
            held = [] if self._buffer is None else self._buffer.records()
        return [r for r in held if r.slot in due]

    def has_slot_due_at(self, t_ns: int) -> bool:
        """Tell whether the sampler has come past an instant, or never will."""
        if not self.is_ready or self._ready is None:
            return True
        with self._lock:
            newest = [] if self._buffer is None else self._buffer.records(newest=1)
        return bool(newest) and self._ready.t0_ns + (newest[-1].slot + 1) * self._period_ns > t_ns

    def status(self) -> ImuStatus:
        """Return counts since the start, for the host; safe from any thread."""
        with self._lock:
            if self._buffer is None or self._ready is None:
                return ImuStatus(name=self.name, samples=0, gaps=0, problem=self._problem)
            recent = self._buffer.records(newest=100)
            count, n_failed = self._buffer.count, self._buffer.n_failed
        with_data = [r.data for r in recent if r.data is not None]
        slots = recent[-1].slot + 1 if recent else 0
        calibration = with_data[-1][REG_CALIB_STAT - FIRST_REGISTER] if with_data else None
        return ImuStatus(
            name=self.name,
            samples=count - n_failed,
            gaps=max(0, slots - count) + n_failed,
            calibration=calibration,
            problem=self._problem or self._stall_words or self._reset_words,
        )

    def stop(self) -> None:
        """End the process and release the memory. Calling it twice does no harm."""
        if self._buffer is None:
            return
        self._end_process()
        self._take_messages()  # what the sensor had learnt comes last
        with self._lock:
            self._buffer.close()
            self._buffer = None
        self._connection.close()

    def _look_for_reset(self, opr_mode: int) -> None:
        """Compare the mode that the sensor says it is in; a reset in mid-run raises no error on the bus."""
        if self._reset_words or self._buffer is None:
            return
        recent = self._buffer.records(newest=self.settings.status_every + 1)
        modes = [r.status[2] for r in recent if r.status is not None]
        if modes and modes[-1] != opr_mode:
            self._reset_words = (
                f"operation mode reads 0x{modes[-1]:02X} where 0x{opr_mode:02X} was set: the sensor was "
                "reset and delivers nothing usable until the unit is armed again. Check its supply"
            )
            self._news.append(self._reset_words)

    def _take_messages(self) -> None:
        try:
            while self._connection.poll():
                message = self._connection.recv()
                if isinstance(message, SamplerReady):
                    self._ready = message
                    self._seen_at_ns = monotonic_ns()
                elif isinstance(message, SamplerFailed):
                    self._problem = message.words
                elif isinstance(message, SamplerCalibrated):
                    self._keep(message)
        except (EOFError, OSError):
            return  # the process is gone; poll says so

    def _keep(self, learnt: SamplerCalibrated) -> None:
        if self._ready is None or self._calibration_folder is None:
            return
        try:
            path = save_calibration(
                self._calibration_folder,
                self._ready.facts.chip_id,
                self.settings.mode,
                learnt.registers,
                calib_stat=learnt.calib_stat,
            )
        except StorageError as e:
            logger.warning("imu %s: %s", self.name, e)
        else:
            logger.info("imu %s: calibration of mode %s saved in %s", self.name, self.settings.mode, path)

    def _end_process(self) -> None:
        if self._process.pid is None or self._buffer is None:
            return
        self._buffer.ask_stop()
        self._process.join(_STOP_TIMEOUT_S if not self._problem else 0.1)
        if self._process.is_alive():
            self._process.kill()
            self._process.join(_STOP_TIMEOUT_S)
