"""Wires the daemon's parts, owns start and stop, and feeds the watchdog while work goes on."""

import logging
import signal
import threading
from importlib import metadata
from pathlib import Path
from types import FrameType

from bricktrack_common.checksums import crc32
from bricktrack_common.clocks import read_clock_triplet
from bricktrack_common.errors import StorageError
from bricktrack_common.wire_messages import (
    Arm,
    Chunk,
    Confirm,
    Confirmed,
    DescribeRun,
    Disarm,
    GetStatus,
    Hello,
    HelloReply,
    ListRuns,
    Read,
    Request,
    RunList,
    StatusReply,
)
from bricktrack_device.config import DeviceConfig
from bricktrack_device.file_server import Answer, FileServer
from bricktrack_device.health.machine import processor_temperature_degc
from bricktrack_device.health.watch import HealthWatch
from bricktrack_device.interfaces import Rig
from bricktrack_device.recorder import Recorder
from bricktrack_device.recovery import rebuild_manifest
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.run_store import RunStore
from bricktrack_device.systemd_notify import notify
from bricktrack_device.watchdog import Watchdog

logger = logging.getLogger(__name__)

WATCHDOG_PERIOD_S = 1.0


class UnitService:
    """Answers the host's requests from the recorder and the run store."""

    def __init__(self, config: DeviceConfig, rig: Rig, recorder: Recorder, store: RunStore) -> None:
        self._config = config
        self._rig = rig
        self.health = HealthWatch(config, rig)
        self._recorder = recorder
        self._store = store

    def handle(self, request: Request, answer: Answer) -> None:
        """Answer one request; see `bricktrack_device.file_server.RequestHandler`."""
        match request:
            case Hello():
                answer(
                    HelloReply(
                        unit=self._config.unit.name,
                        software=f"bricktrack {metadata.version('bricktrack')}",
                        simulated=self._rig.simulated,
                    ),
                    None,
                )
            case GetStatus():
                answer(self._status(), None)
            case Arm():
                self._recorder.arm(request.label, request.duration_s, lambda reply: answer(reply, None))
            case Disarm():
                self._recorder.disarm(lambda reply: answer(reply, None))
            case ListRuns():
                answer(RunList(runs=self._store.list_runs()), None)
            case DescribeRun():
                answer(self._store.describe(request.run_id), None)
            case Read():
                self._refuse_while("armed", "recording", "saving")
                data = self._store.read_chunk(
                    request.run_id, request.file_index, request.offset, request.length
                )
                chunk = Chunk(
                    run_id=request.run_id,
                    file_index=request.file_index,
                    offset=request.offset,
                    n_bytes=len(data),
                    crc32=crc32(data),
                )
                answer(chunk, data)
            case Confirm():
                self._refuse_while("recording", "saving")
                self._store.confirm(request.run_id, request.sha256)
                answer(Confirmed(run_id=request.run_id), None)

    def _refuse_while(self, *states: str) -> None:
        state = self._recorder.state
        if state in states:
            raise RequestRefusedError("busy", f"the unit is {state}; it transfers nothing meanwhile")

    def _status(self) -> StatusReply:
        recorder = self._recorder.status()
        try:
            n_runs, free = self._store.count_runs(), self._store.free_bytes()
        except (StorageError, OSError) as e:
            raise RequestRefusedError("internal", f"storage: {e}") from e
        return StatusReply(
            unit=self._config.unit.name,
            state=recorder.state,
            reason=recorder.reason[:2000],
            run_id=recorder.run_id,
            runs=n_runs,
            disk_free_bytes=free,
            disk_needed_bytes=recorder.disk_needed_bytes,
            frames=recorder.frames,
            frame_age_ms=recorder.frame_age_ms,
            imus=recorder.imus,
            edges=recorder.edges,
            line_is_high=recorder.line_is_high,
            temperature_degc=processor_temperature_degc(),
            last_error=recorder.last_error,
            health=list(self.health.items),
            health_age_s=self.health.age_s,
            clocks=read_clock_triplet(),
        )


class Daemon:
    """A unit, from start to stop.

    Parameters
    ----------
    config : DeviceConfig
    rig : Rig
        Closed by `run` in the end.
    """

    def __init__(self, config: DeviceConfig, rig: Rig) -> None:
        self._config = config
        self._rig = rig
        self._stop = threading.Event()
        self.port = 0

    def stop(self, signal_number: int = 0, frame: FrameType | None = None) -> None:
        """Ask `run` to end; fit to be a signal handler."""
        self._stop.set()

    def run(self) -> None:
        """Serve until told to stop by SIGTERM, SIGINT or `stop`; then save what is under way.

        Raises
        ------
        BricktrackError
            If the storage folder cannot be written or the port is taken.
        """
        store = RunStore(self._config.storage_folder, self._config.unit.name)
        try:
            store.lock()
            recorder = Recorder(self._config, self._rig, store)
            service = UnitService(self._config, self._rig, recorder, store)
            server = FileServer(self._config.server.address, self._config.server.port, service)
            for run_id in store.recover(rebuild_manifest):
                logger.warning("%s: recovered after a cut while it was being saved", run_id)
            if threading.current_thread() is threading.main_thread():
                for number in (signal.SIGTERM, signal.SIGINT):
                    signal.signal(number, self.stop)
            service.health.refresh_if_due(recorder.state)
            notify("STATUS=trying the sensors")
            service.health.test_hardware(self._stop.is_set)
            self._serve(recorder, server, service.health, store.folder)
        finally:
            store.unlock()
            self._rig.close()

    def _serve(self, recorder: Recorder, server: FileServer, health: HealthWatch, folder: Path) -> None:
        recorder.start()
        server.start()
        self.port = server.port
        logger.info(
            "unit %s serves on %s port %d; runs are kept in %s%s",
            self._config.unit.name, server.address, server.port, folder,
            " (simulated)" if self._rig.simulated else "",
        )  # fmt: skip
        notify("READY=1")
        watchdog = Watchdog(recorder, server)
        try:
            while not self._stop.wait(WATCHDOG_PERIOD_S):
                watchdog.feed()
                health.refresh_if_due(recorder.state)
        finally:
            notify("STOPPING=1")
            logger.info("stopping")
            recorder.stop()
            server.stop()
