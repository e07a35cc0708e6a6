import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from device_fakes import FakeCamera, FakeRig

from bricktrack_common.checksums import crc32, sha256_bytes
from bricktrack_common.errors import DeviceError, StorageError
from bricktrack_common.wire_messages import (
    Arm,
    Armed,
    Chunk,
    Confirm,
    Confirmed,
    DescribeRun,
    Disarm,
    Disarmed,
    GetStatus,
    Hello,
    HelloReply,
    ListRuns,
    Read,
    Refusal,
    Reply,
    Request,
    RunDescription,
    RunList,
    StatusReply,
    decode_reply,
    encode_message,
)
from bricktrack_device.config import DeviceConfig, RecordingTable, ServerTable, StorageTable, UnitTable
from bricktrack_device.daemon import Daemon


class Unit:
    """A daemon in a thread, on fakes, and a host that speaks to it."""

    def __init__(self, folder: Path, rig: FakeRig | None = None) -> None:
        self.config = DeviceConfig(
            unit=UnitTable(name="unit-1"),
            storage=StorageTable(folder=str(folder), margin_mb=1),
            server=ServerTable(port=0),
            recording=RecordingTable(duration_s=0.3, pre_roll_s=0.1, post_roll_s=0.1),
            imu=[],
        )
        self.rig = rig or FakeRig()
        self.daemon = Daemon(self.config, self.rig)
        self.thread = threading.Thread(target=self.daemon.run)
        self.thread.start()
        self.wait(lambda: self.daemon.port != 0)
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.connect(f"tcp://127.0.0.1:{self.daemon.port}")

    @staticmethod
    def wait(condition: object, timeout_s: float = 10.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():  # type: ignore[operator]
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def ask(self, request: Request) -> tuple[Reply, bytes | None]:
        self.socket.send(encode_message(1, request))
        assert self.socket.poll(20_000), f"no reply to {request}"
        header, *rest = self.socket.recv_multipart()
        return decode_reply(header)[1], (rest[0] if rest else None)

    def status(self) -> StatusReply:
        reply, _ = self.ask(GetStatus())
        assert isinstance(reply, StatusReply)
        return reply

    def record(self, label: str = "") -> str:
        armed, _ = self.ask(Arm(label=label))
        assert isinstance(armed, Armed), armed
        self.rig.pulse()
        self.wait(lambda: self.status().state == "recording")
        self.wait(lambda: self.status().state == "idle")
        return armed.run_id

    def close(self) -> None:
        self.socket.close()
        self.context.term()
        self.daemon.stop()
        self.thread.join()


@pytest.fixture
def unit(tmp_path: Path) -> Iterator[Unit]:
    made = Unit(tmp_path)
    yield made
    made.close()


def test_a_host_arms_watches_reads_and_confirms_a_run(unit: Unit, tmp_path: Path) -> None:
    hello, _ = unit.ask(Hello(software="test"))
    assert isinstance(hello, HelloReply) and (hello.unit, hello.simulated) == ("unit-1", True)
    before = unit.status()
    assert (before.state, before.runs, before.run_id, before.frames) == ("idle", 0, "", 0)
    # Twice 0.5 s at 12 Mbit/s, and 1 MB.
    assert before.disk_needed_bytes == 2_500_000 and before.disk_free_bytes > 0
    assert {"clocks", "storage", "real-time rights"} <= {item.name for item in before.health}
    assert before.health_age_s is not None and before.health_age_s < 30

    armed, _ = unit.ask(Arm(label="first"))
    assert isinstance(armed, Armed) and armed.missing == []
    status = unit.status()
    assert (status.state, status.run_id, status.line_is_high) == ("armed", armed.run_id, False)
    assert status.frames > 0 and status.frame_age_ms is not None and status.frame_age_ms < 1000
    assert abs(status.clocks.boottime_ns - status.clocks.monotonic_ns) < 1_000_000
    refused, _ = unit.ask(Read(run_id=armed.run_id, file_index=0, offset=0, length=10))
    assert isinstance(refused, Refusal) and refused.code == "busy" and "armed" in refused.message
    unit.rig.pulse()
    unit.wait(lambda: unit.status().state == "idle" and unit.status().runs == 1)

    listed, _ = unit.ask(ListRuns())
    assert isinstance(listed, RunList) and [(r.run_id, r.state, r.confirmed) for r in listed.runs] == [
        (armed.run_id, "complete", False)
    ]
    described, _ = unit.ask(DescribeRun(run_id=armed.run_id))
    assert isinstance(described, RunDescription)
    for i, f in enumerate(described.files):
        data = b""
        while len(data) < f.n_bytes:
            chunk, part = unit.ask(Read(run_id=armed.run_id, file_index=i, offset=len(data), length=100))
            assert isinstance(chunk, Chunk) and part is not None
            assert (chunk.n_bytes, chunk.crc32, chunk.offset) == (len(part), crc32(part), len(data))
            data += part
        assert sha256_bytes(data) == f.sha256
    wrong, _ = unit.ask(Confirm(run_id=armed.run_id, sha256=["0" * 64]))
    assert isinstance(wrong, Refusal) and wrong.code == "hash-mismatch"
    right, _ = unit.ask(Confirm(run_id=armed.run_id, sha256=[f.sha256 for f in described.files]))
    assert right == Confirmed(run_id=armed.run_id)
    listed, _ = unit.ask(ListRuns())
    assert isinstance(listed, RunList) and listed.runs[0].confirmed


def test_disarm_answers_and_unknown_runs_are_refused(unit: Unit) -> None:
    assert isinstance(unit.ask(Disarm())[0], Disarmed)
    for request in (DescribeRun(run_id="none"), Confirm(run_id="none", sha256=[])):
        reply, _ = unit.ask(request)
        assert isinstance(reply, Refusal) and reply.code == "no-such-run"


def test_a_second_daemon_on_the_same_folder_is_refused_before_it_touches_anything(
    unit: Unit, tmp_path: Path
) -> None:
    (tmp_path / "runs" / "unit-1_000000_0007.partial").mkdir()
    rig = FakeRig()
    with pytest.raises(StorageError, match="another bricktrackd"):
        Daemon(unit.config, rig).run()
    assert rig.closed and (tmp_path / "runs" / "unit-1_000000_0007.partial").is_dir()


def test_a_taken_port_ends_the_start_and_names_it(unit: Unit, tmp_path: Path) -> None:
    config = DeviceConfig(
        storage=StorageTable(folder=str(tmp_path / "other")),
        server=ServerTable(port=unit.daemon.port),
        imu=[],
    )
    rig = FakeRig()
    with pytest.raises(DeviceError, match=f"port {unit.daemon.port}"):
        Daemon(config, rig).run()
    assert rig.closed


def test_a_cut_run_is_recovered_at_start(tmp_path: Path) -> None:
    partial = tmp_path / "runs" / "unit-1_000000_0007.partial"
    partial.mkdir(parents=True)
    (partial / "video.h264").write_bytes(b"\0\0\0\1")
    unit = Unit(tmp_path)
    try:
        listed, _ = unit.ask(ListRuns())
        assert isinstance(listed, RunList)
        assert [(r.run_id, r.state) for r in listed.runs] == [("unit-1_000000_0007", "interrupted")]
        assert unit.record().endswith("_0008")
    finally:
        unit.close()


def test_systemd_hears_ready_watchdog_and_stopping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(path))
        systemd.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", os.fspath(path))
        monkeypatch.setattr("bricktrack_device.daemon.WATCHDOG_PERIOD_S", 0.05)
        unit = Unit(tmp_path / "storage")
        try:
            assert systemd.recv(100) == b"STATUS=trying the sensors"
            assert unit.rig.camera.n_stops == 1  # the self-test is over when the unit is ready
            assert systemd.recv(100) == b"READY=1"
            assert systemd.recv(100) == b"WATCHDOG=1\nSTATUS=idle"
        finally:
            unit.close()
        messages = []
        while not messages or messages[-1] != b"STOPPING=1":
            messages.append(systemd.recv(100))


def test_a_unit_whose_camera_failed_its_self_test_serves_and_says_so(tmp_path: Path) -> None:
    unit = Unit(tmp_path, FakeRig(camera=FakeCamera(fail="no ribbon cable")))
    try:
        camera = next(i for i in unit.status().health if i.name == "self-test: camera")
        assert camera.level == "fail" and "no ribbon cable" in camera.words and camera.remedy
    finally:
        unit.close()
