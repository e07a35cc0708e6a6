"""A flood of connections that never speak, or speak nonsense, does not disturb a recording.

The daemon has 256 file descriptors in all here: without a bound on connections it could not save its run.
"""

import contextlib
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from bricktrack_common.run_folder import read_run
from bricktrack_common.run_manifest import RunManifest
from bricktrack_common.wire_codec import decode_reply, encode_message
from bricktrack_common.wire_messages import (
    Arm,
    Armed,
    GetStatus,
    ListRuns,
    Reply,
    Request,
    RunList,
    StatusReply,
)
from bricktrack_device.network.connection_guard import MAX_CONNECTIONS

pytestmark = pytest.mark.slow

SUPPORT = Path(__file__).parents[1] / "support"
DESCRIPTORS = 256
FLOOD_S = 3.0
MAX_CONNECTS = 5000
HELD = 400
UNIT = f"""
import logging, resource, sys, threading, time
resource.setrlimit(resource.RLIMIT_NOFILE, ({DESCRIPTORS}, {DESCRIPTORS}))
from device_fakes import FakeBusOpener, FakeCamera, FakeRig
from bricktrack_device.config import *
from bricktrack_device.daemon import Daemon

class Rig(FakeRig):
    def on_armed(self, t_armed_ns):
        threading.Timer(0.2, self.pulse).start()

if __name__ == "__main__":
    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(message)s")
    config = DeviceConfig(
        unit=UnitTable(name="u"), storage=StorageTable(folder=sys.argv[1], margin_mb=1), server=ServerTable(port=0),
        recording=RecordingTable(duration_s=2.0, pre_roll_s=0.1, post_roll_s=0.1),
        imu=[ImuTable(name="brick", bus="a")], sampler=SamplerTable(priority=0, lock_memory=False),
    )
    Daemon(config, Rig(camera=FakeCamera(n_bytes=20_000), buses={{"a": FakeBusOpener()}})).run()
"""


class Unit:
    """The daemon in its own process, and a host."""

    def __init__(self, folder: Path) -> None:
        self.storage = folder / "card"
        self.log = folder / "log"
        script = folder / "unit.py"
        script.write_text(UNIT)
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, str(script), str(self.storage)], stderr=log,
                env=os.environ | {"PYTHONPATH": os.pathsep.join([str(SUPPORT), os.environ.get("PYTHONPATH", "")])},
            )  # fmt: skip
        deadline = time.monotonic() + 30
        while not (found := re.search(r"port (\d+)", self.log.read_text())):
            assert self.process.poll() is None and time.monotonic() < deadline, self.log.read_text()
            time.sleep(0.05)
        self.port = int(found.group(1))
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(f"tcp://127.0.0.1:{self.port}")

    def ask(self, request: Request) -> Reply:
        self.socket.send(encode_message(1, request))
        assert self.socket.poll(20_000), self.log.read_text()
        return decode_reply(self.socket.recv())[1]

    def n_descriptors(self) -> int:
        return len(list(Path(f"/proc/{self.process.pid}/fd").iterdir()))

    def record(self) -> RunManifest:
        armed = self.ask(Arm())
        assert isinstance(armed, Armed), armed
        deadline = time.monotonic() + 30
        while True:
            listed = self.ask(ListRuns())
            assert isinstance(listed, RunList)
            if any(r.run_id == armed.run_id for r in listed.runs):
                break
            assert time.monotonic() < deadline, self.log.read_text()
            time.sleep(0.1)
        run = read_run(self.storage / "runs" / armed.run_id, verify_hashes=True)
        assert run.problems == []
        return run.manifest

    def close(self) -> None:
        self.socket.close()
        self.context.term()
        self.process.terminate()
        self.process.wait(30)


class Flood:
    """Connects without end for a while, holds what it can, now and then says nonsense; ends by itself."""

    def __init__(self, port: int) -> None:
        self.n_connects = 0
        self._port = port
        self._thread = threading.Thread(target=self._run)
        self._over = threading.Event()

    def __enter__(self) -> "Flood":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        held: list[socket.socket] = []
        until = time.monotonic() + FLOOD_S
        while time.monotonic() < until and self.n_connects < MAX_CONNECTS and not self._over.is_set():
            connection = socket.socket()
            connection.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                connection.connect(("127.0.0.1", self._port))
            self.n_connects += 1
            if self.n_connects % 7 == 0:
                with contextlib.suppress(OSError):
                    connection.send(b"\xff\0\0\0\0\0\0\0\1\x7f\3\0NULL" + bytes(40))
            held.append(connection)
            if len(held) > HELD:
                held.pop(0).close()
            time.sleep(0.0005)
        for connection in held:
            connection.close()


@pytest.fixture
def unit(tmp_path: Path) -> Iterator[Unit]:
    made = Unit(tmp_path)
    yield made
    made.close()


def test_a_flood_of_connections_does_not_disturb_a_recording(unit: Unit) -> None:
    quiet = unit.record()
    with Flood(unit.port) as flood:
        most = 0
        while flood.n_connects < 200:  # the places are taken before the run begins
            time.sleep(0.01)
        counts = threading.Event()

        def watch() -> None:
            nonlocal most
            while not counts.wait(0.01) and unit.process.poll() is None:
                most = max(most, unit.n_descriptors())

        watcher = threading.Thread(target=watch)
        watcher.start()
        try:
            flooded = unit.record()
        finally:
            counts.set()
            watcher.join()
    assert flood.n_connects > 1000
    assert most < DESCRIPTORS
    print(
        f"\n{flood.n_connects} connections in {FLOOD_S:g} s; {most} file descriptors at most; gaps without and "
        f"with: {quiet.quality.imu_gaps}, {flooded.quality.imu_gaps} of {flooded.quality.imu_slots} slots"
    )
    for manifest in (quiet, flooded):
        assert manifest.state == "complete"
        assert manifest.quality.frames_dropped == 0
        # 2.2 s at 30.005 Hz, and up to five pictures to the keyframe before.
        assert 66 <= manifest.quality.frames <= 73
        assert manifest.quality.imu_slots in (220, 221)
    # A slot may be lost on any busy machine; the flood adds next to none.
    assert flooded.quality.imu_gaps <= quiet.quality.imu_gaps + 0.05 * flooded.quality.imu_slots
    status = unit.ask(GetStatus())
    assert isinstance(status, StatusReply) and status.state == "idle" and status.runs == 2
    assert "places are taken" in unit.log.read_text()
    assert unit.process.poll() is None and MAX_CONNECTIONS < DESCRIPTORS
