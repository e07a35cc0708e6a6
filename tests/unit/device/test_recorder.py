import errno
import os
import queue
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np
import pytest
from device_fakes import FakeBusOpener, FakeCamera, FakeRig

from bricktrack_common.errors import HardwareError
from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Armed, Disarmed, Refusal, Reply
from bricktrack_device.capture import recorder as recorder_module
from bricktrack_device.capture import session as session_module
from bricktrack_device.capture.recorder import Recorder
from bricktrack_device.capture.session import Session
from bricktrack_device.config import (
    CameraTable,
    DeviceConfig,
    ImuTable,
    RecordingTable,
    StorageTable,
    TriggerTable,
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


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Callable[..., Bench]]:
    made: list[Bench] = []

    def make(*, rig: FakeRig | None = None, disk: Disk | None = None, **changes: object) -> Bench:
        made.append(Bench(config_for(tmp_path, **changes), rig or FakeRig(), disk))
        return made[-1]

    yield make
    for b in made:
        b.recorder.stop()


def test_an_edge_makes_a_whole_run_around_it(bench: Callable[..., Bench], tmp_path: Path) -> None:
    b = bench(imu=[ImuTable(name="brick", bus="a")])
    armed = b.arm("shake")
    assert b.recorder.state == "armed" and b.rig.armed_ns
    b.rig.pulse(3)
    b.wait_for_run()
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    m = run.manifest
    assert m.state == "complete" and m.missing == [] and run.problems == []
    assert m.label == "shake" and m.simulated and m.run_id.endswith("_0001_shake")
    t0 = m.trigger.t0_ns
    assert t0 is not None and run.edges_ns.size == 3 and run.edges_ns[0] == t0
    # The window is asked for in the configuration: 0.2 s before the edge, 0.5 + 0.1 s after it.
    assert m.window_ns == (t0 - 200_000_000, t0 + 600_000_000)
    assert run.frames is not None
    stamps = run.frames.sensor_timestamp_ns
    assert run.frames.keyframe[0] and stamps[0] <= m.window_ns[0] < stamps[6]
    assert m.window_ns[1] - 34_000_000 < stamps[-1] <= m.window_ns[1]
    assert np.all(np.abs(np.diff(stamps) - 33_327_000) < 1000)
    assert m.quality.frames_dropped == 0 and m.quality.frames_without_metadata == 0
    description, samples = run.imus["brick"]
    assert description.chip_id == bytes(range(16)).hex() and description.acc_range_g == 16.0
    assert m.window_ns[0] <= samples.t_ns[0] and samples.t_ns[-1] - m.window_ns[1] < 20_000_000
    assert m.quality.imu_slots in (80, 81)
    assert m.clocks.arm and m.clocks.trigger and m.clocks.end
    assert m.file("truth.npz") is not None and m.file("log.jsonl") is not None


def test_disarming_leaves_no_run(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.arm()
    assert isinstance(b.ask("disarm"), Disarmed)
    assert b.recorder.state == "idle" and b.store.list_runs() == []
    assert b.rig.camera.n_stops == 1


def test_a_second_arm_is_refused_and_names_the_state(bench: Callable[..., Bench]) -> None:
    b = bench()
    b.arm()
    reply = b.ask("arm", "", None)
    assert isinstance(reply, Refusal) and reply.code == "wrong-state" and "armed" in reply.message


def test_a_missing_imu_stops_neither_the_camera_nor_the_other(
    bench: Callable[..., Bench], tmp_path: Path
) -> None:
    rig = FakeRig(buses={"dead": FakeBusOpener(present=False)})
    b = bench(rig=rig, imu=[ImuTable(name="gone", bus="dead"), ImuTable(name="brick", bus="live")])
    armed = b.arm()
    assert len(armed.missing) == 1 and "imu gone" in armed.missing[0] and "0x28" in armed.missing[0]
    rig.pulse()
    b.wait_for_run()
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    assert list(run.imus) == ["brick"] and run.frames is not None
    assert any("imu gone" in words for words in run.manifest.missing)


def test_a_sampler_that_dies_during_the_run_is_said_and_its_samples_kept(
    bench: Callable[..., Bench], tmp_path: Path
) -> None:
    rig = FakeRig(buses={"a": FakeBusOpener(exit_after=60)})
    b = bench(rig=rig, imu=[ImuTable(name="brick", bus="a")])
    armed = b.arm()
    rig.pulse()
    b.wait_for_run()
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    assert any("died (exit code 7)" in words for words in run.manifest.missing)
    _, samples = run.imus["brick"]
    assert 0 < samples.t_ns.size < 70 and run.manifest.quality.imu_gaps > 0


def test_a_camera_that_does_not_start_refuses_arming_unless_not_required(
    bench: Callable[..., Bench], tmp_path: Path
) -> None:
    b = bench(rig=FakeRig(camera=FakeCamera(fail="exposure wanders")))
    reply = b.ask("arm", "", None)
    assert isinstance(reply, Refusal) and reply.code == "not-ready" and "exposure wanders" in reply.message
    assert b.recorder.state == "idle"


def test_a_camera_that_is_not_required_may_be_missing(bench: Callable[..., Bench], tmp_path: Path) -> None:
    b = bench(
        rig=FakeRig(camera=FakeCamera(fail="no camera")),
        camera=CameraTable(required=False),
        imu=[ImuTable(name="brick", bus="a")],
    )
    armed = b.arm()
    assert armed.missing == ["camera: no camera"]
    b.rig.pulse()
    b.wait_for_run()
    run = read_run(tmp_path / "runs" / armed.run_id)
    assert run.frames is None and run.video is None and run.imus and run.manifest.camera is None


def test_a_camera_that_falls_silent_is_noticed_and_what_came_is_kept(
    bench: Callable[..., Bench], tmp_path: Path
) -> None:
    b = bench(
        rig=FakeRig(camera=FakeCamera(silent_after=20)),
        recording=RecordingTable(duration_s=1.5, pre_roll_s=0.2, post_roll_s=0.1),
    )
    armed = b.arm()
    b.rig.pulse()
    b.wait_for_run()
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    assert any("camera: no picture" in words for words in run.manifest.missing)
    assert any("video: ends" in words for words in run.manifest.missing)
    assert run.frames is not None and 0 < run.frames.n_frames <= 20


def test_stopping_in_the_middle_saves_an_interrupted_run(bench: Callable[..., Bench], tmp_path: Path) -> None:
    b = bench(recording=RecordingTable(duration_s=30.0, pre_roll_s=0.2, post_roll_s=0.1))
    armed = b.arm()
    b.rig.pulse()
    b.wait_for("recording")
    time.sleep(0.3)
    b.recorder.stop()
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    assert run.manifest.state == "interrupted"
    assert any("the daemon was stopped" in words for words in run.manifest.missing)
    assert run.frames is not None and run.frames.n_frames >= 10


def test_too_little_space_refuses_arming_with_numbers(bench: Callable[..., Bench], tmp_path: Path) -> None:
    b = bench(storage=StorageTable(folder=str(tmp_path), margin_mb=10**9))
    reply = b.ask("arm", "", None)
    assert isinstance(reply, Refusal) and reply.code == "no-space" and "MB" in reply.message


def test_the_unit_arms_itself_again_until_it_is_disarmed(bench: Callable[..., Bench]) -> None:
    b = bench(recording=RecordingTable(duration_s=0.2, pre_roll_s=0.1, post_roll_s=0.0, auto_arm=True))
    for n in (1, 2):
        b.wait_for("armed")
        b.rig.pulse()
        wait_until(lambda n=n: b.store.count_runs() == n)
    b.wait_for("armed")
    assert isinstance(b.ask("disarm"), Disarmed)
    time.sleep(0.5)
    assert b.recorder.state == "idle"


class FillableDisk(Disk):
    """A card that is full while `is_full`."""

    def __init__(self) -> None:
        self.is_full = False

    def write_file(self, path: Path, fill: Callable[[BinaryIO], object]) -> None:
        if self.is_full and path.name == "video.h264":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write_file(path, fill)

    def free_bytes(self, folder: Path) -> int:
        return 0 if self.is_full else 10**12


def test_a_full_card_ends_in_fault_with_a_reason_and_the_run_is_saved_once_there_is_space(
    bench: Callable[..., Bench], tmp_path: Path
) -> None:
    disk = FillableDisk()
    b = bench(disk=disk)
    armed = b.arm()
    disk.is_full = True
    b.rig.pulse()
    b.wait_for("fault")
    assert "video.h264" in b.recorder.status().reason and "kept in memory" in b.recorder.status().reason
    partial = tmp_path / "runs" / f"{armed.run_id}.partial"
    assert (partial / "frames.msgpack").stat().st_size > 0  # what fitted stays
    reply = b.ask("arm", "", None)
    assert isinstance(reply, Refusal) and reply.code == "wrong-state" and "fault" in reply.message
    reply = b.ask("disarm")
    assert isinstance(reply, Refusal) and reply.code == "no-space" and armed.run_id in reply.message
    disk.is_full = False
    assert isinstance(b.ask("disarm"), Disarmed)
    assert b.recorder.state == "idle"
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    assert run.manifest.state == "complete" and run.frames is not None and run.video is not None


def test_a_run_kept_in_memory_is_saved_by_itself_when_space_comes_back(
    bench: Callable[..., Bench], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "_RETRY_S", 0.1)
    disk = FillableDisk()
    b = bench(disk=disk)
    armed = b.arm()
    disk.is_full = True
    b.rig.pulse()
    b.wait_for("fault")
    disk.is_full = False
    b.wait_for("idle")
    assert read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True).problems == []


def test_a_bug_while_recording_ends_in_fault_once_the_whole_window_is_saved(
    bench: Callable[..., Bench], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(session_module, "LATE_FRAMES_GRACE_S", 0.1)
    b = bench(imu=[ImuTable(name="brick", bus="a")])
    armed = b.arm()

    def break_down(self: Session, now_ns: int = 0) -> bool:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(Session, "note_trigger", break_down)
    monkeypatch.setattr(Session, "is_over", break_down)  # in every tick
    b.rig.pulse(3)
    b.wait_for("fault")
    assert "ZeroDivisionError" in b.recorder.status().reason
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    m = run.manifest
    assert m.state == "complete" and m.missing == ["internal error: ZeroDivisionError: a bug"]
    assert run.frames is not None and m.window_ns is not None
    assert m.window_ns[1] - 34_000_000 < run.frames.sensor_timestamp_ns[-1]
    assert run.imus["brick"][1].t_ns[-1] > m.window_ns[1] - 20_000_000
    assert isinstance(b.ask("disarm"), Disarmed) and b.recorder.state == "idle"


def test_a_bug_in_watching_the_sensors_costs_no_run(
    bench: Callable[..., Bench], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def break_down(self: FakeCamera) -> str:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(FakeCamera, "problem", break_down)  # from arming on
    b = bench()
    armed = b.arm()
    wait_until(lambda: "ZeroDivisionError" in b.recorder.status().reason)
    b.rig.pulse(3)
    b.wait_for_run()
    m = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True).manifest
    assert m.state == "complete" and m.missing == [
        "watching the camera: internal error: ZeroDivisionError: a bug"
    ]


def test_a_bug_whose_words_are_new_each_time_fills_no_memory(
    bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []

    def break_down(self: FakeCamera) -> str:
        looks.append(len(looks))
        raise KeyError(len(looks))

    monkeypatch.setattr(FakeCamera, "problem", break_down)
    b = bench()
    b.arm()
    wait_until(lambda: len(looks) > 40)
    assert b.recorder._session is not None
    assert len(b.recorder._session.missing) == 20


def test_a_bug_in_one_part_of_a_run_does_not_cost_the_others(
    bench: Callable[..., Bench], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(imu=[ImuTable(name="brick", bus="a")])

    def break_down(*args: object, **more: object) -> None:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(session_module, "judge_edges", break_down)
    monkeypatch.setattr(session_module, "ImuRecording", break_down)
    monkeypatch.setattr(b.rig, "describe", break_down)
    armed = b.arm()
    b.rig.pulse(3)
    b.wait_for_run()
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    assert run.frames is not None and run.edges_ns.size == 3 and not run.imus
    named = [words.partition(": internal error")[0] for words in run.manifest.missing]
    assert named == ["the wave", "imu brick", "the hardware"]


def test_a_pin_that_cannot_be_given_back_costs_no_run(
    bench: Callable[..., Bench], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(imu=[ImuTable(name="brick", bus="a")])
    armed = b.arm()
    session = b.recorder._session
    assert session is not None and session.trigger is not None

    def fail() -> None:
        raise RuntimeError("GPIO not allocated")

    monkeypatch.setattr(session.trigger, "close", fail)
    b.rig.pulse(3)
    b.wait_for_run()
    assert read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True).manifest.state == "complete"
    assert b.rig.camera.n_stops == 1 and not session.imus[0]._process.is_alive()


def test_a_line_stuck_high_leaves_the_unit_armed_and_the_status_says_why(
    bench: Callable[..., Bench],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(session_module, "_STUCK_HIGH_NS", 200_000_000)
    b = bench(trigger=TriggerTable(pull="none"))  # a mock pin with a pull starts there
    b.rig.factory.pin("GPIO17").drive_high()
    b.arm()
    wait_until(lambda: "the line was high all the time" in caplog.text)
    assert b.recorder.state == "armed" and "high all the time" in b.recorder.status().reason
    b.rig.factory.pin("GPIO17").drive_low()
    b.rig.pulse()
    b.wait_for_run()
    assert b.recorder.status().reason == ""


def test_a_unit_that_arms_itself_leaves_an_armed_state_that_lost_its_camera(
    bench: Callable[..., Bench], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "_RETRY_S", 0.05)
    camera = FakeCamera(silent_after=20)
    recording = RecordingTable(duration_s=0.5, pre_roll_s=0.2, post_roll_s=0.1, auto_arm=True)
    b = bench(rig=FakeRig(camera=camera), recording=recording, imu=[ImuTable(name="brick", bus="a")])
    b.wait_for("armed")
    b.wait_for("fault")
    assert "lost while armed: camera: no picture" in b.recorder.status().last_error
    camera.silent_after = None  # as a camera that works again once it is started anew
    b.wait_for("armed")
    b.rig.pulse(3)
    b.wait_for("recording")
    wait_until(lambda: b.store.count_runs() == 1)
    assert b.store.list_runs()[0].state == "complete"


def test_a_unit_that_a_host_armed_stays_armed_without_its_camera_and_says_so(
    bench: Callable[..., Bench],
) -> None:
    b = bench(rig=FakeRig(camera=FakeCamera(silent_after=20)), imu=[ImuTable(name="brick", bus="a")])
    b.arm()
    wait_until(lambda: "camera: no picture" in b.recorder.status().reason)
    assert b.recorder.state == "armed"


def test_a_camera_that_does_not_stop_asks_for_a_new_start_once_nothing_is_under_way(
    bench: Callable[..., Bench], tmp_path: Path
) -> None:
    camera = FakeCamera()
    camera.stop_error = HardwareError("camera: it did not stop within 4.5 s")
    b = bench(rig=FakeRig(camera=camera))
    b.arm()
    assert b.recorder.restart_reason == ""
    b.rig.pulse(3)
    b.wait_for_run()
    assert b.recorder.restart_reason == "camera: it did not stop within 4.5 s"
    assert b.store.list_runs()[0].state == "complete"


def test_a_bug_in_stopping_the_camera_leaves_no_sampler_behind(bench: Callable[..., Bench]) -> None:
    camera = FakeCamera()
    b = bench(rig=FakeRig(camera=camera), imu=[ImuTable(name="brick", bus="a")])
    b.arm()
    session = b.recorder._session
    assert session is not None
    reader = session.imus[0]
    camera.stop_error = RuntimeError("a bug")
    assert isinstance(b.ask("disarm"), Disarmed) and b.recorder.restart_reason == "a bug"
    assert not reader._process.is_alive() and reader._buffer is None


def test_what_the_camera_itself_says_is_wrong_stands_in_the_run(
    bench: Callable[..., Bench], tmp_path: Path
) -> None:
    camera = FakeCamera()
    b = bench(rig=FakeRig(camera=camera))
    run_id = b.arm().run_id
    camera.trouble = "camera: 3 frames were lost on the way: disk"
    b.rig.pulse(3)
    b.wait_for_run()
    missing = read_run(tmp_path / "runs" / run_id).manifest.missing
    assert [m for m in missing if m.startswith(camera.trouble)] and len(missing) == 1
