import time
from pathlib import Path

import pytest
from device_fakes import FakeBusOpener, FakeCamera, FakeRig
from recorder_bench import MakeBench, wait_until

from bricktrack_common.errors import HardwareError
from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Disarmed, Refusal
from bricktrack_device.capture import lost_sensors, run_cycle
from bricktrack_device.capture import session as session_module
from bricktrack_device.capture.session import Session
from bricktrack_device.config import (
    CameraTable,
    ImuTable,
    RecordingTable,
    StorageTable,
)


def test_disarming_leaves_no_run(bench: MakeBench) -> None:
    b = bench()
    b.arm()
    assert isinstance(b.ask("disarm"), Disarmed)
    assert b.recorder.state == "idle" and b.store.list_runs() == []
    assert b.rig.camera.n_stops == 1


def test_a_second_arm_is_refused_and_names_the_state(bench: MakeBench) -> None:
    b = bench()
    b.arm()
    reply = b.ask("arm", "", None)
    assert isinstance(reply, Refusal) and reply.code == "wrong-state" and "armed" in reply.message


def test_stopping_in_the_middle_saves_an_interrupted_run(bench: MakeBench, tmp_path: Path) -> None:
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


def test_too_little_space_refuses_arming_with_numbers(bench: MakeBench, tmp_path: Path) -> None:
    b = bench(storage=StorageTable(folder=str(tmp_path), margin_mb=10**9))
    reply = b.ask("arm", "", None)
    assert isinstance(reply, Refusal) and reply.code == "no-space" and "MB" in reply.message


def test_the_unit_arms_itself_again_until_it_is_disarmed(bench: MakeBench) -> None:
    b = bench(recording=RecordingTable(duration_s=0.2, pre_roll_s=0.1, post_roll_s=0.0, auto_arm=True))
    for n in (1, 2):
        b.wait_for("armed")
        b.rig.pulse()
        wait_until(lambda n=n: b.store.count_runs() == n)
    b.wait_for("armed")
    assert isinstance(b.ask("disarm"), Disarmed)
    time.sleep(0.5)
    assert b.recorder.state == "idle"


def test_a_bug_while_recording_ends_in_fault_once_the_whole_window_is_saved(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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


def test_a_unit_that_arms_itself_leaves_an_armed_state_that_lost_its_camera(
    bench: MakeBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_cycle, "_RETRY_S", 0.05)
    monkeypatch.setattr(lost_sensors, "PATIENCE_S", 0.2)
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


def test_a_unit_that_arms_itself_again_does_so_for_the_hosts_order(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_cycle, "_RETRY_S", 0.05)
    monkeypatch.setattr(lost_sensors, "PATIENCE_S", 0.2)
    camera = FakeCamera()
    recording = RecordingTable(duration_s=0.5, pre_roll_s=0.2, post_roll_s=0.1, auto_arm=True, label="own")
    storage = StorageTable(folder=str(tmp_path), margin_mb=1, black_box=str(tmp_path / "box"))
    order = tmp_path / "box" / ".armed-unit-1.json"
    b = bench(rig=FakeRig(camera=camera), recording=recording, storage=storage)
    b.wait_for("armed")
    assert isinstance(b.ask("disarm"), Disarmed)
    first = b.arm("impact", 0.3).run_id
    camera.silent_after = 1
    b.wait_for("fault")
    assert "will arm itself again" in b.recorder.status().reason
    assert order.exists()  # the daemon may be killed meanwhile
    camera.silent_after = None
    b.wait_for("armed")
    second = b.recorder.status().run_id
    assert first.endswith("_impact") and second.endswith("_impact") and first != second
    b.rig.pulse(3)
    wait_until(lambda: b.store.count_runs() == 1)
    m = read_run(b.store.runs / second, verify_hashes=True).manifest
    assert m.trigger.t0_ns is not None and m.window_ns is not None
    assert m.window_ns[1] - m.trigger.t0_ns == 400_000_000  # the host's 0.3 s and 0.1 s after it
    assert any("edges in between were not heard" in words for words in m.missing)
    assert not order.exists()
    b.wait_for("armed")  # the order is carried out: the next run is the unit's own
    assert b.recorder.status().run_id.endswith("_own") and "again" not in b.recorder.status().reason
    assert isinstance(b.ask("disarm"), Disarmed)
    b.arm("impact", 0.3)
    camera.silent_after = 1
    b.wait_for("fault")
    b.recorder.stop()
    assert not order.exists()  # it was ended on purpose


def test_a_unit_whose_only_sensor_hangs_is_in_fault_after_as_long_as_one_without_pictures(
    bench: MakeBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lost_sensors, "PATIENCE_S", 0.5)
    rig = FakeRig(camera=FakeCamera(fail="unplugged"), buses={"a": FakeBusOpener(hang_after=60)})
    camera = CameraTable(required=False)
    b = bench(rig=rig, camera=camera, imu=[ImuTable(name="brick", bus="a")])
    b.arm()
    b.wait_for("fault")
    reason = b.recorder.status().reason
    assert "no sensor is left: camera: unplugged; imu brick: its sampler hangs" in reason
    assert reason.count("its sampler hangs") == 1  # its reader, who gives it up after 5 s, has not spoken


def test_a_unit_that_a_host_armed_stays_armed_without_its_camera_and_says_so(
    bench: MakeBench,
) -> None:
    b = bench(rig=FakeRig(camera=FakeCamera(silent_after=20)), imu=[ImuTable(name="brick", bus="a")])
    b.arm()
    wait_until(lambda: "camera: no picture" in b.recorder.status().reason)
    assert b.recorder.state == "armed"


def test_a_camera_that_does_not_stop_asks_for_a_new_start_once_nothing_is_under_way(
    bench: MakeBench, tmp_path: Path
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
