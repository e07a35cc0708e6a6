"""Answers a host's requests from the recorder, the run store and the unit's settings."""

from collections.abc import Callable
from importlib import metadata

from bricktrack_common.checksums import crc32
from bricktrack_common.clocks import read_clock_triplet
from bricktrack_common.errors import ConfigError, StorageError
from bricktrack_common.wire_messages import (
    Arm,
    CameraStatus,
    Chunk,
    Configure,
    Configured,
    Confirm,
    Confirmed,
    DaemonState,
    Deleted,
    DeleteRun,
    DescribeRun,
    Disarm,
    GetStatus,
    HealthItem,
    Hello,
    HelloReply,
    ListRuns,
    Read,
    Request,
    RunList,
    StatusReply,
    TakeStill,
)
from bricktrack_device.capture.recorder import Recorder
from bricktrack_device.config import DeviceConfig
from bricktrack_device.health.machine import processor_temperature_degc
from bricktrack_device.health.watch import HealthWatch
from bricktrack_device.in_time import in_time
from bricktrack_device.interfaces import Rig
from bricktrack_device.network.file_server import Answer
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.remote_settings import RemoteSettings
from bricktrack_device.still import encode_still, take_still
from bricktrack_device.storage.recovery import describe_anew_if_altered
from bricktrack_device.storage.run_store import RunStore

_CHECK_TIMEOUT_S = 120.0


class UnitService:
    """See the module's first line; meets `bricktrack_device.network.file_server.RequestHandler`.

    Parameters
    ----------
    settings : RemoteSettings
        The unit's configuration, with what hosts have changed in it.
    rig : Rig
    recorder : Recorder
    store : RunStore
    """

    def __init__(self, settings: RemoteSettings, rig: Rig, recorder: Recorder, store: RunStore) -> None:
        self._settings = settings
        self._rig = rig
        self._recorder = recorder
        self._store = store
        self.health = HealthWatch(settings.config, rig)

    @property
    def is_busy(self) -> bool:
        """Whether a run is waited for, recorded or saved."""
        return self._recorder.state in ("armed", "recording", "saving")

    @property
    def _config(self) -> DeviceConfig:
        return self._settings.config

    def handle(self, request: Request, answer: Answer) -> None:
        """Answer one request, now or later; see `bricktrack_device.network.file_server.RequestHandler`."""
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
                self._read(request, answer)
            case Confirm():
                self._refuse_while("recording", "saving")
                self._confirm(request, answer)
            case DeleteRun():
                self._refuse_while("armed", "recording", "saving")
                n_bytes = self._store.delete(request.run_id, force=request.force)
                answer(Deleted(run_id=request.run_id, n_bytes=n_bytes), None)
            case TakeStill():
                self._when_idle("taking a picture", lambda: self._still(request, answer), answer)
            case Configure() if request.values:
                self._when_idle("configuring", lambda: self._configure(request, answer), answer)
            case Configure():
                answer(self._configured(), None)

    def _when_idle(self, doing: str, work: Callable[[], None], answer: Answer) -> None:
        self._recorder.do_when_idle(doing, work, lambda reply: answer(reply, None))

    def _refuse_while(self, *states: DaemonState) -> None:
        state = self._recorder.state
        if state in states:
            raise RequestRefusedError("busy", f"the unit is {state}; it transfers nothing meanwhile")

    def _read(self, request: Read, answer: Answer) -> None:
        self._refuse_while("armed", "recording", "saving")
        data = self._store.read_chunk(request.run_id, request.file_index, request.offset, request.length)
        chunk = Chunk(
            run_id=request.run_id,
            file_index=request.file_index,
            offset=request.offset,
            n_bytes=len(data),
            crc32=crc32(data),
        )
        answer(chunk, data)

    def _confirm(self, request: Confirm, answer: Answer) -> None:
        try:
            self._store.confirm(request.run_id, request.sha256)
        except RequestRefusedError as e:
            if e.code != "hash-mismatch" or self.is_busy:
                raise
            words = str(e)
            self._when_idle("checking a run", lambda: self._look_for_altered(request.run_id, words), answer)
        else:
            answer(Confirmed(run_id=request.run_id), None)

    # In the recorder's thread, while nothing is recorded

    def _look_for_altered(self, run_id: str, words: str) -> None:
        """Refuse hashes that are not the manifest's, after a look at whether the card altered the files."""
        altered = in_time(
            "checking a run",
            lambda: describe_anew_if_altered(self._store, run_id),
            _CHECK_TIMEOUT_S,
            beat=self._recorder.beat,
        )
        if altered:
            words += f". The card has altered {', '.join(altered)}; the run is described anew: pull it again"
        raise RequestRefusedError("hash-mismatch", words)

    def _still(self, request: TakeStill, answer: Answer) -> None:
        taken = take_still(
            self._config,
            self._rig,
            lit=request.lit,
            beat=self._recorder.beat,
            note_lost_camera=self._recorder.note_lost_camera,
        )
        answer(*encode_still(taken, request.encoding, simulated=self._rig.simulated))

    def _configure(self, request: Configure, answer: Answer) -> None:
        try:
            config = self._settings.change(request.values)
        except ConfigError as e:
            raise RequestRefusedError("bad-value", str(e)) from e
        self._rig.configure(config)
        self._recorder.configure(config)
        self.health.configure(config)
        answer(self._configured(), None)

    def _configured(self) -> Configured:
        return Configured(values=self._settings.values(), changed=self._settings.changed_keys())

    def _health(self) -> list[HealthItem]:
        problem = self._settings.problem
        own = [HealthItem(name="configuration", level="warn", words=problem[:2000])] if problem else []
        return [*own, *self.health.items]

    def _status(self) -> StatusReply:
        recorder = self._recorder.status()
        config = self._config
        try:
            n_runs, n_unconfirmed = self._store.count_runs(), self._store.count_unconfirmed()
            free = self._store.free_bytes()
        except (StorageError, OSError) as e:
            raise RequestRefusedError("internal", f"storage: {e}") from e
        return StatusReply(
            unit=config.unit.name,
            state=recorder.state,
            reason=recorder.reason[:2000],
            run_id=recorder.run_id,
            runs=n_runs,
            runs_unconfirmed=n_unconfirmed,
            disk_free_bytes=free,
            disk_needed_bytes=recorder.disk_needed_bytes,
            frames=recorder.frames,
            frame_age_ms=recorder.frame_age_ms,
            imus=recorder.imus,
            edges=recorder.edges,
            line_is_high=recorder.line_is_high,
            temperature_degc=processor_temperature_degc(),
            last_error=recorder.last_error,
            health=self._health(),
            health_age_s=self.health.age_s,
            clocks=read_clock_triplet(),
            auto_arm=recorder.auto_arm,
            camera=CameraStatus(
                mode=config.camera.mode,
                exposure_us=config.camera.exposure_us,
                analogue_gain=config.camera.analogue_gain,
                frame_rate_hz=config.camera.frame_rate_hz,
            ),
        )
