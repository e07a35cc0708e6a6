"""A recorder on the least hardware, and what it answered."""

import queue
import time
from collections.abc import Callable
from pathlib import Path

import msgspec
from device_fakes import FakeRig

from bricktrack_common.wire_messages import Armed, Reply
from bricktrack_device.capture.recorder import Recorder
from bricktrack_device.config import (
    DeviceConfig,
    RecordingTable,
    StorageTable,
    UnitTable,
)
from bricktrack_device.storage.disk import Disk
from bricktrack_device.storage.run_store import RunStore


def config_for(folder: Path, **changes: object) -> DeviceConfig:
    config = DeviceConfig(
        unit=UnitTable(name="unit-1"),
        storage=StorageTable(folder=str(folder), margin_mb=1),
        recording=RecordingTable(duration_s=0.5, pre_roll_s=0.2, post_roll_s=0.1),
        imu=[],
    )
    return msgspec.structs.replace(config, **changes)


def wait_until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "the condition was not met in time"
        time.sleep(0.005)


class Bench:
    """A recorder on fakes, and what it answered."""

    def __init__(self, config: DeviceConfig, rig: FakeRig, disk: Disk | None = None) -> None:
        self.config = config
        self.rig = rig
        self.store = RunStore(config.storage_folder, config.unit.name, disk=disk)
        self.recorder = Recorder(config, rig, self.store)
        self.recorder.start()

    def ask(self, what: str, *args: object, timeout_s: float = 60.0) -> Reply:
        answers: queue.Queue[Reply] = queue.Queue()
        getattr(self.recorder, what)(*args, answers.put)
        return answers.get(timeout=timeout_s)

    def arm(self, label: str = "", duration_s: float | None = None) -> Armed:
        self.n_runs_before = self.store.count_runs()
        reply = self.ask("arm", label, duration_s)
        assert isinstance(reply, Armed), reply
        return reply

    def wait_for_run(self) -> None:
        wait_until(lambda: self.store.count_runs() > self.n_runs_before and self.recorder.state == "idle")

    def wait_for(self, state: str) -> None:
        wait_until(lambda: self.recorder.state == state)


MakeBench = Callable[..., Bench]
