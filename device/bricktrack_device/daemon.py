"""Wires the daemon's parts, owns start and stop, and feeds the watchdog while work goes on."""

import logging
import signal
import threading
from pathlib import Path
from types import FrameType

from bricktrack_common.discovery import Announcement
from bricktrack_common.errors import StorageError
from bricktrack_common.key_files import fingerprint
from bricktrack_device.capture.black_box import black_box_folder
from bricktrack_device.capture.recorder import Recorder
from bricktrack_device.config import DeviceConfig
from bricktrack_device.health.watch import HealthWatch
from bricktrack_device.interfaces import Rig
from bricktrack_device.network.advertisement import Advertisement
from bricktrack_device.network.connection_guard import raise_descriptor_limit
from bricktrack_device.network.file_server import FileServer
from bricktrack_device.network.unit_keys import UnitKeys
from bricktrack_device.remote_settings import RemoteSettings
from bricktrack_device.storage.recovery import recover_runs
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.systemd_notify import notify
from bricktrack_device.unit_service import UnitService
from bricktrack_device.watchdog import Watchdog

logger = logging.getLogger(__name__)

WATCHDOG_PERIOD_S = 1.0
STOP_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""The last one comes when the terminal goes from which a daemon was started by hand: a lost SSH line."""


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
        """Serve until told to stop by SIGTERM, SIGINT, SIGHUP or `stop`; then save what is under way.

        Raises
        ------
        BricktrackError
            If the storage folder cannot be made, another daemon has it, or the port is taken. One that can
            only be read is served as it is, and the status says so.
        """
        raise_descriptor_limit()
        store = RunStore(self._config.storage_folder, self._config.unit.name, may_be_read_only=True)
        if store.problem:
            logger.error("%s. What is there is served; nothing can be recorded", store.problem)
        try:
            store.lock()
            settings = RemoteSettings(self._config, store.folder)
            config = settings.load()
            self._rig.configure(config)
            recorder = Recorder(config, self._rig, store)
            service = UnitService(settings, self._rig, recorder, store)
            folder = self._config.keys_folder
            keys = None if folder is None else UnitKeys(folder)
            server = FileServer(self._config.server.address, self._config.server.port, service, keys=keys)
            self._recover(store)
            if threading.current_thread() is threading.main_thread():
                self._heed_signals()
            service.health.refresh_if_due(recorder.state)
            # One that was killed while armed tries its sensors by arming: every second counts.
            if not recorder.will_arm_again:
                notify("STATUS=trying the sensors")
                service.health.test_hardware(self._stop.is_set)
            advertisement = self._advertisement(server.port, keys)
            try:
                advertisement.start()
                self._serve(recorder, server, service.health, store.folder)
            finally:
                advertisement.stop()
        finally:
            store.unlock()
            self._rig.close()

    def _recover(self, store: RunStore) -> None:
        try:
            for run_id in recover_runs(store, black_box_folder(self._config)):
                logger.warning("%s: recovered; its manifest says what it lacks", run_id)
        except StorageError as e:
            logger.error("nothing was recovered: %s", e)  # the unit must come up, if only to say so

    def _heed_signals(self) -> None:
        for number in STOP_SIGNALS:
            if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                continue  # started by nohup, to outlive its terminal
            signal.signal(number, self.stop)

    def _advertisement(self, port: int, keys: UnitKeys | None) -> Advertisement:
        server = self._config.server
        address = server.address if server.advertise else "127.0.0.1"
        key = "" if keys is None else fingerprint(keys.own.public)
        return Advertisement(Announcement(self._config.unit.name, key_fingerprint=key), address, port)

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
