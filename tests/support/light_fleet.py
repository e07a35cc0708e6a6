"""Many units in one process: the real server, service and run store, with a recorder that only keeps its state.

``python light_fleet.py FOLDER NAME...`` serves a unit for each name from ``FOLDER/<name>`` and prints a JSON
object of their ports. Then each line that comes in is an order: ``trigger N_BYTES`` makes every armed unit save
a real run folder, whose video is that long, and go idle; ``record FOLDER`` makes them save a copy of that run, as
if they had recorded it; ``quit`` ends the process.
"""

import json
import random
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
from device_fakes import FakeRig

from bricktrack_common.run_manifest import (
    MANIFEST_NAME,
    ClocksSection,
    QualitySection,
    RunManifest,
    TriggerSection,
    file_entry,
    read_manifest,
    write_manifest,
)
from bricktrack_common.wire_messages import Armed, Disarmed
from bricktrack_device.capture.recorder_status import RecorderStatus
from bricktrack_device.config import DeviceConfig, ServerTable, StorageTable, UnitTable
from bricktrack_device.network.file_server import FileServer
from bricktrack_device.network.unit_keys import UnitKeys
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.remote_settings import RemoteSettings
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.unit_service import UnitService


class StateOnly:
    """A recorder without sensors; what it records is made up when it is told to.

    A file ``full`` in its storage makes it refuse to arm; ``mute`` makes it arm and not say so.
    """

    def __init__(self, store: RunStore) -> None:
        self.state = "idle"
        self.run_id = ""
        self._store = store

    def arm(self, label, duration_s, answer) -> None:
        if self.state != "idle":
            raise RequestRefusedError("wrong-state", f"the unit is {self.state} for {self.run_id}")
        storage = self._store.runs.parent
        if (storage / "full").exists():
            raise RequestRefusedError("no-space", "0.3 GB free; a run needs 1.2 GB")
        self.state, self.run_id = "armed", self._store.new_run_id(label)
        if (storage / "mute").exists():
            return
        answer(Armed(run_id=self.run_id, missing=[]))

    def disarm(self, answer) -> None:
        self.state, self.run_id = "idle", ""
        answer(Disarmed())

    def status(self) -> RecorderStatus:
        return RecorderStatus(
            state=self.state, reason="", run_id=self.run_id, frames=0, frame_age_ms=None, imus=[], edges=0,
            line_is_high=None, last_error="", disk_needed_bytes=10**6, auto_arm=False,
        )  # fmt: skip

    def save(self, data: bytes) -> None:
        if self.state != "armed":
            return
        folder = self._store.runs / f"{self.run_id}.partial"
        folder.mkdir()
        (folder / "video.h264").write_bytes(data)
        manifest = RunManifest(
            run_id=self.run_id, unit=self._store.unit, label="", state="complete", simulated=True,
            origin="bricktrackd", hardware={}, software={}, camera=None, imus=[],
            trigger=TriggerSection(pin="GPIO17", t0_ns=None), clocks=ClocksSection(), window_ns=None,
            quality=QualitySection(), missing=[], files=[file_entry(folder / "video.h264")],
        )  # fmt: skip
        self._end(folder, manifest)

    def record(self, recorded: Path) -> None:
        if self.state != "armed":
            return
        folder = self._store.runs / f"{self.run_id}.partial"
        manifest = read_manifest(recorded / MANIFEST_NAME)
        folder.mkdir()
        for entry in manifest.files:
            shutil.copy2(recorded / entry.name, folder)
        self._end(folder, msgspec.structs.replace(manifest, run_id=self.run_id, unit=self._store.unit))

    def _end(self, folder: Path, manifest: RunManifest) -> None:
        write_manifest(folder / MANIFEST_NAME, manifest)
        folder.rename(self._store.runs / self.run_id)
        self.state, self.run_id = "idle", ""


def serve(folder: Path, names: list[str]) -> None:
    recorders: list[StateOnly] = []
    ports: dict[str, int] = {}
    servers = []
    for name in names:
        storage = folder / name
        keys_folder = storage / "keys"
        config = DeviceConfig(
            unit=UnitTable(name=name), storage=StorageTable(folder=str(storage), margin_mb=1),
            server=ServerTable(port=0),
        )  # fmt: skip
        store = RunStore(storage, name)
        recorders.append(StateOnly(store))
        service = UnitService(RemoteSettings(config, storage), FakeRig(), recorders[-1], store)
        keys = UnitKeys(keys_folder) if keys_folder.exists() else None
        servers.append(FileServer("127.0.0.1", 0, service, keys=keys))
        servers[-1].start()
        ports[name] = servers[-1].port
    print(json.dumps(ports), flush=True)
    draw = random.Random(5)
    for line in sys.stdin:
        order = line.split()
        if order == ["quit"]:
            break
        for recorder in recorders:
            if order[0] == "record":
                recorder.record(Path(line.split(maxsplit=1)[1].rstrip("\n")))
            else:
                recorder.save(draw.randbytes(int(order[1])))
        print("saved", flush=True)
    for server in servers:
        server.stop()


class LightFleet:
    """Such units, spread over a few processes; a context that ends them."""

    def __init__(self, folder: Path, names: list[str], *, n_processes: int = 4) -> None:
        self.folder = folder
        self._names = names
        self._n_processes = min(n_processes, len(names))
        self._processes: list[subprocess.Popen[str]] = []
        self.ports: dict[str, int] = {}

    def __enter__(self) -> "LightFleet":
        for i in range(self._n_processes):
            command = [sys.executable, __file__, str(self.folder), *self._names[i :: self._n_processes]]
            self._processes.append(
                subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )
        try:
            for process in self._processes:
                self.ports |= json.loads(self._heard(process))
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
            process.communicate()

    def trigger(self, n_bytes: int) -> None:
        """Make every armed unit record and save a run."""
        self._order(f"trigger {n_bytes}")

    def record(self, folder: Path) -> None:
        """Make every armed unit save a copy of this run as its own."""
        self._order(f"record {folder}")

    def _order(self, order: str) -> None:
        for process in self._processes:
            print(order, file=process.stdin, flush=True)
        for process in self._processes:
            self._heard(process)

    @staticmethod
    def _heard(process: "subprocess.Popen[str]") -> str:
        line = process.stdout.readline() if process.stdout else ""
        if not line:
            raise RuntimeError("a process of the light fleet ended; see its standard error")
        return line


def write_fleet_file(path: Path, ports: dict[str, int]) -> Path:
    """Write a fleet file that names these units, and return its path."""
    path.write_text(
        "".join(
            f'[[unit]]\nname = "{name}"\naddress = "tcp://127.0.0.1:{port}"\n' for name, port in ports.items()
        )
    )
    return path


if __name__ == "__main__":
    serve(Path(sys.argv[1]), sys.argv[2:])
