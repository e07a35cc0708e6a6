import errno
import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zmq
from device_fakes import FakeCamera, FakeRig
from saved_runs import confirmed_run, store_in

from bricktrack_common.checksums import crc32, sha256_bytes
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import DeviceError, StorageError
from bricktrack_common.wire_codec import decode_reply, encode_message
from bricktrack_common.wire_messages import (
    Arm,
    Armed,
    Chunk,
    Configure,
    Configured,
    Confirm,
    Confirmed,
    Deleted,
    DeleteRun,
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
    StillImage,
    TakeStill,
)
from bricktrack_device.capture.standing_order import ArmOrder, StandingOrder
from bricktrack_device.config import DeviceConfig, RecordingTable, ServerTable, StorageTable, UnitTable
from bricktrack_device.daemon import STOP_SIGNALS, Daemon
from bricktrack_device.health.watch import HealthWatch
from bricktrack_device.interfaces import Still
from bricktrack_device.storage.disk import Disk


def make_read_only(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a card refuse every write from now on, as a kernel does that found it faulty."""

    def refuse(*args: object, **kwargs: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    may = os.access
    monkeypatch.setattr(
        os, "access", lambda p, mode, **k: not (mode & os.W_OK and folder in Path(p).parents) and may(p, mode)
    )
    for name in ("make_folder", "write_file", "rename", "sync_file"):
        monkeypatch.setattr(Disk, name, refuse)


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
    def wait(condition: object, timeout_s: float = 60.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():  # type: ignore[operator]
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def ask(self, request: Request) -> tuple[Reply, bytes | None]:
        self.socket.send(encode_message(1, request))
        assert self.socket.poll(60_000), f"no reply to {request}"
        header, *rest = self.socket.recv_multipart()
        return decode_reply(header)[1], (rest[0] if rest else None)

    def status(self) -> StatusReply:
        reply, _ = self.ask(GetStatus())
        assert isinstance(reply, StatusReply)
        return reply

    def record(self, label: str = "") -> str:
        n_before = self.status().runs
        armed, _ = self.ask(Arm(label=label))
        assert isinstance(armed, Armed), armed
        self.rig.pulse()
        self.wait(lambda: self.status().runs > n_before and self.status().state == "idle")
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


def test_on_a_card_that_can_only_be_read_runs_are_served_and_none_is_promised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_in(tmp_path)
    run_id = confirmed_run(store)
    shutil.copytree(store.runs / run_id, store.runs / f"{run_id}_cut.partial")
    make_read_only(tmp_path, monkeypatch)
    with closing(Unit(tmp_path)) as unit:
        status = unit.status()
        assert (status.state, status.runs, status.runs_unconfirmed) == ("idle", 1, 0)
        (storage,) = (item for item in status.health if item.name == "storage")
        assert storage.level == "fail" and "Permission denied" in storage.words
        described, _ = unit.ask(DescribeRun(run_id=run_id))
        assert isinstance(described, RunDescription)
        whole = Read(run_id=run_id, file_index=0, offset=0, length=described.files[0].n_bytes)
        _, data = unit.ask(whole)
        assert data is not None and sha256_bytes(data) == described.files[0].sha256
        refused, _ = unit.ask(Arm(label=""))
        assert isinstance(refused, Refusal) and "storage folder" in refused.message
        refused, _ = unit.ask(Confirm(run_id=run_id, sha256=[f.sha256 for f in described.files]))
        assert isinstance(refused, Refusal) and "Read-only file system" in refused.message
        assert (store.runs / f"{run_id}_cut.partial").exists()
        monkeypatch.undo()  # put right while the daemon runs
        assert isinstance(unit.ask(Arm(label="again"))[0], Armed)


def test_a_daemon_that_was_killed_while_armed_arms_before_it_tries_its_sensors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    monkeypatch.setattr(HealthWatch, "test_hardware", lambda *a: tried.append(a))
    order = StandingOrder(tmp_path / "black-box", "unit-1", max_age_s=60.0, has_run=lambda run_id: False)
    order.note(ArmOrder(label="impact", duration_s=None), "unit-1_000000_0001_impact")
    with closing(Unit(tmp_path / "card")) as unit:
        unit.wait(lambda: unit.status().state == "armed")
        assert unit.status().run_id.endswith("_impact") and tried == []
    with closing(Unit(tmp_path / "card")) as unit:  # it was ended on purpose
        assert unit.status().state == "idle" and len(tried) == 1
    last_week = ArmOrder(label="old", duration_s=None, t_ns=monotonic_ns() - 7 * 86_400 * 10**9)
    order.note(last_week, "unit-1_000000_0002_old")
    with closing(Unit(tmp_path / "card")) as unit:
        unit.wait(lambda: "'old', and is not armed again" in unit.status().last_error)
        assert unit.status().state == "idle" and len(tried) == 2


def test_disarm_answers_and_unknown_runs_are_refused(unit: Unit) -> None:
    assert isinstance(unit.ask(Disarm())[0], Disarmed)
    for request in (DescribeRun(run_id="none"), Confirm(run_id="none", sha256=[])):
        reply, _ = unit.ask(request)
        assert isinstance(reply, Refusal) and reply.code == "no-such-run"


def test_a_run_is_deleted_when_confirmed_or_by_force_and_never_meanwhile(unit: Unit, tmp_path: Path) -> None:
    first, second = unit.record("a"), unit.record("b")
    refused, _ = unit.ask(DeleteRun(run_id=first))
    assert (
        isinstance(refused, Refusal)
        and refused.code == "not-confirmed"
        and "pull it first" in refused.message
    )
    described, _ = unit.ask(DescribeRun(run_id=first))
    assert isinstance(described, RunDescription)
    assert unit.status().runs_unconfirmed == 2
    unit.ask(Confirm(run_id=first, sha256=[f.sha256 for f in described.files]))
    assert unit.status().runs_unconfirmed == 1

    armed, _ = unit.ask(Arm())
    assert isinstance(armed, Armed)
    for run_id in (first, armed.run_id):
        refused, _ = unit.ask(DeleteRun(run_id=run_id, force=True))
        assert isinstance(refused, Refusal) and refused.code == "busy"
    unit.ask(Disarm())

    n_bytes = sum(p.stat().st_size for p in (unit.config.storage_folder / "runs" / first).iterdir())
    gone, _ = unit.ask(DeleteRun(run_id=first))
    assert gone == Deleted(run_id=first, n_bytes=n_bytes) and n_bytes > sum(
        f.n_bytes for f in described.files
    )
    assert isinstance(unit.ask(DeleteRun(run_id=second, force=True))[0], Deleted)
    listed, _ = unit.ask(ListRuns())
    assert isinstance(listed, RunList) and listed.runs == []
    assert unit.status().runs_unconfirmed == 0
    again, _ = unit.ask(DeleteRun(run_id=first))
    assert isinstance(again, Refusal) and again.code == "no-such-run"
    assert unit.record("c").endswith(
        "_0004_c"
    )  # ids of deleted runs, and of the disarmed one, are not used again


def test_a_still_is_taken_when_idle_and_refused_when_armed(unit: Unit) -> None:
    luma = np.arange(64, dtype=np.uint8).reshape(8, 8)
    chroma = np.full((4, 4), 128, np.uint8)
    unit.rig.camera.picture = Still(luma, chroma, chroma)
    image, data = unit.ask(TakeStill())
    assert isinstance(image, StillImage) and data is not None
    assert (image.n_bytes, image.crc32) == (len(data), crc32(data)) and data.startswith(b"\x89PNG")
    assert (image.width_px, image.height_px, image.exposure_us, image.simulated) == (8, 8, 2000, True)
    assert isinstance(unit.ask(Arm())[0], Armed)
    refused, _ = unit.ask(TakeStill())
    assert isinstance(refused, Refusal) and refused.code == "busy" and "armed" in refused.message
    assert unit.status().state == "armed" and unit.status().frames > 0


def test_what_is_configured_counts_at_once_and_after_a_restart(tmp_path: Path) -> None:
    unit = Unit(tmp_path)
    try:
        asked, _ = unit.ask(Configure())
        assert isinstance(asked, Configured) and asked.changed == []
        assert asked.values["recording.duration_s"] == 0.3
        needed = unit.status().disk_needed_bytes
        done, _ = unit.ask(Configure(values={"recording.duration_s": 0.8, "camera.exposure_us": 500}))
        assert isinstance(done, Configured) and done.changed == ["camera.exposure_us", "recording.duration_s"]
        # Twice half a second more at 12 Mbit/s.
        assert unit.status().disk_needed_bytes == needed + 1_500_000
        camera = unit.status().camera
        assert camera is not None and camera.exposure_us == 500 and unit.rig.config.camera.exposure_us == 500
        wrong, _ = unit.ask(Configure(values={"camera.exposure_us": 10**9}))
        assert (
            isinstance(wrong, Refusal) and wrong.code == "bad-value" and "camera.exposure_us" in wrong.message
        )
        assert isinstance(unit.ask(Arm())[0], Armed)
        busy, _ = unit.ask(Configure(values={"camera.exposure_us": 600}))
        assert isinstance(busy, Refusal) and busy.code == "busy"
        assert isinstance(unit.ask(Configure())[0], Configured)
    finally:
        unit.close()
    unit = Unit(tmp_path)
    try:
        camera = unit.status().camera
        assert camera is not None and camera.exposure_us == 500
        assert unit.rig.config.recording.duration_s == 0.8
    finally:
        unit.close()


def test_a_unit_told_to_arm_itself_says_so(unit: Unit) -> None:
    assert not unit.status().auto_arm
    unit.ask(Configure(values={"recording.auto_arm": True}))
    unit.wait(lambda: unit.status().state == "armed")
    assert unit.status().auto_arm
    unit.ask(Disarm())
    assert not unit.status().auto_arm


@pytest.fixture
def signals_as_before() -> Iterator[None]:
    before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("signals_as_before")
@pytest.mark.parametrize("by_nohup", [False, True])
def test_a_lost_terminal_ends_a_daemon_unless_nohup_was_to_prevent_it(by_nohup: bool) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN if by_nohup else signal.SIG_DFL)
    daemon = Daemon(DeviceConfig(), FakeRig())
    daemon._heed_signals()
    assert signal.getsignal(signal.SIGHUP) == (signal.SIG_IGN if by_nohup else daemon.stop)
    assert signal.getsignal(signal.SIGTERM) == daemon.stop


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
