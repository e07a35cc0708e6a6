"""One short recording on the simulated rig, in this process, with whatever is to go wrong."""

import queue
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
from device_fakes import FakeCamera

from bricktrack_common.run_folder import Run, read_run
from bricktrack_common.wire_messages import Armed, Reply
from bricktrack_device.capture.recorder import Recorder
from bricktrack_device.config import (
    DeviceConfig,
    ImuTable,
    RecordingTable,
    SamplerTable,
    StorageTable,
    TriggerTable,
    UnitTable,
)
from bricktrack_device.interfaces import Camera
from bricktrack_device.sim.settings import SimFaults, SimSettings
from bricktrack_device.sim.sim_rig import SimRig
from bricktrack_device.storage.disk import Disk
from bricktrack_device.storage.run_store import RunStore

HZ = 200.0


class BlindRig(SimRig):
    """The simulated rig with a camera that makes no pictures: for faults that do not concern it."""

    def open_camera(self) -> Camera:
        return FakeCamera()


def config_of(
    folder: Path,
    *,
    faults: SimFaults | None = None,
    imu: list[ImuTable] | None = None,
    hz: float = HZ,
    **changes: Any,
) -> DeviceConfig:
    """Return a unit for runs of one second in a world that shakes after 0.3 s."""
    sim = SimSettings(
        shake_delay_s=0.3, quiet_s=0.2, shake_s=5.0, square_wave_hz=hz, faults=faults or SimFaults()
    )  # fmt: skip
    config = DeviceConfig(
        backend="sim",
        unit=UnitTable(name="faulty"),
        storage=StorageTable(folder=str(folder), margin_mb=1),
        recording=RecordingTable(duration_s=1.0, pre_roll_s=0.2, post_roll_s=0.1),
        trigger=TriggerTable(nominal_hz=hz),
        imu=[ImuTable(name="brick", bus="/dev/i2c-3")] if imu is None else imu,
        sampler=SamplerTable(priority=0, lock_memory=False),
        sim=sim,
    )
    return msgspec.structs.replace(config, **changes)


class Unit:
    """A recorder on a simulated rig; use it in a ``with`` statement."""

    def __init__(self, config: DeviceConfig, *, blind: bool = True, disk: Disk | None = None) -> None:
        self.rig = (BlindRig if blind else SimRig)(config.sim, config.camera)
        self.store = RunStore(config.storage_folder, config.unit.name, disk=disk)
        self.recorder = Recorder(config, self.rig, self.store)

    def __enter__(self) -> "Unit":
        self.recorder.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.recorder.stop()
        self.rig.close()

    def ask(self, what: str, *arguments: object) -> Reply:
        """Return what the recorder answers."""
        answers: queue.Queue[Reply] = queue.Queue()
        getattr(self.recorder, what)(*arguments, answers.put)
        return answers.get(timeout=60)

    def arm(self) -> Armed:
        """Arm the unit, or fail with its refusal."""
        reply = self.ask("arm", "", None)
        assert isinstance(reply, Armed), reply
        return reply

    def wait_for(self, *states: str, timeout_s: float = 30.0) -> str:
        """Wait for one of some states and return it."""
        self.wait_until(lambda: self.recorder.state in states, timeout_s)
        return self.recorder.state

    def wait_until(self, condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
        """Wait for a condition."""
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, self.recorder.status()
            time.sleep(0.002)

    def record(self) -> Run:
        """Arm, record and return the run as a host reads it, every hash checked."""
        run_id = self.arm().run_id
        self.wait_for("recording")
        self.wait_for("idle")
        return read_run(self.store.runs / run_id, verify_hashes=True)


def record(config: DeviceConfig, *, blind: bool = True, disk: Disk | None = None) -> Run:
    """Return one run of a unit."""
    with Unit(config, blind=blind, disk=disk) as unit:
        return unit.record()
