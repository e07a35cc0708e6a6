"""The self-test before a unit is ready: what it finds, in which words, and that nothing holds it up."""

import threading
from pathlib import Path

import pytest
from device_fakes import FakeBusOpener, FakeCamera, FakeRig

from bricktrack_common.run_manifest import CameraSection
from bricktrack_device.config import CameraTable, DeviceConfig, ImuTable, StorageTable
from bricktrack_device.health import self_test
from bricktrack_device.health.self_test import run_self_test
from bricktrack_device.health.watch import HealthWatch
from bricktrack_device.interfaces import FrameSink

TWO = [ImuTable(name="brick", bus="a"), ImuTable(name="base", bus="b", required=True)]


def never() -> bool:
    return False


def levels(config: DeviceConfig, rig: FakeRig) -> dict[str, str]:
    return {r.name: r.level for r in run_self_test(config, rig, is_over=never)}


def test_a_whole_unit_passes_and_gives_everything_back() -> None:
    rig = FakeRig(buses={"a": FakeBusOpener(), "b": FakeBusOpener()})
    results = run_self_test(DeviceConfig(imu=TWO), rig, is_over=never)
    assert [(r.name, r.level, r.remedy) for r in results] == [
        (f"self-test: {part}", "ok", "") for part in ("trigger", "imu brick", "imu base", "camera")
    ]
    assert rig.camera.n_stops == 1
    again = run_self_test(DeviceConfig(imu=TWO), rig, is_over=never)  # the pin is free again
    assert all(r.ok for r in again)


def test_what_is_required_fails_and_what_is_not_warns() -> None:
    absent = FakeBusOpener(present=False)
    rig = FakeRig(camera=FakeCamera(fail="no ribbon cable"), buses={"a": absent, "b": absent})
    found = levels(DeviceConfig(imu=TWO), rig)
    assert found == {
        "self-test: trigger": "ok", "self-test: imu brick": "warn", "self-test: imu base": "fail",
        "self-test: camera": "fail",
    }  # fmt: skip
    rig = FakeRig(camera=FakeCamera(fail="no ribbon cable"))
    results = run_self_test(DeviceConfig(camera=CameraTable(required=False), imu=[]), rig, is_over=never)
    camera = results[-1]
    assert (
        camera.level == "warn"
        and "no ribbon cable" in camera.detail
        and "at the daemon's start" in camera.detail
    )
    assert "restart bricktrackd" in camera.remedy


def test_a_camera_without_a_picture_fails_in_its_own_words(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(self_test, "_FIRST_KEYFRAME_S", 0.2)
    camera = FakeCamera(silent_after=0)
    camera.trouble = "camera: its thread has died"
    camera_line = run_self_test(DeviceConfig(imu=[]), FakeRig(camera=camera), is_over=never)[-1]
    assert camera_line.level == "fail" and "its thread has died" in camera_line.detail


def test_a_step_that_hangs_is_left_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    released = threading.Event()

    class Hanging(FakeCamera):
        def start(self, sink: FrameSink) -> CameraSection:
            released.wait()
            return super().start(sink)

    monkeypatch.setattr(self_test, "STEP_LIMIT_S", 0.2)
    try:
        camera = run_self_test(DeviceConfig(imu=[]), FakeRig(camera=Hanging()), is_over=never)[-1]
    finally:
        released.set()
    assert camera.level == "fail" and "no answer within 0.2 s" in camera.detail


def test_a_bug_in_a_step_is_a_failure_with_its_name_and_stops_nothing() -> None:
    class Broken(FakeCamera):
        def start(self, sink: FrameSink) -> CameraSection:
            raise ZeroDivisionError("one over nothing")

    camera = run_self_test(DeviceConfig(imu=[]), FakeRig(camera=Broken()), is_over=never)[-1]
    assert camera.level == "fail" and "ZeroDivisionError: one over nothing" in camera.detail


def test_a_daemon_that_is_told_to_end_tries_nothing_more() -> None:
    rig = FakeRig()
    assert run_self_test(DeviceConfig(imu=[]), rig, is_over=lambda: True) == []
    assert rig.camera.n_stops == 0


def test_its_findings_stay_in_the_health_of_the_status(tmp_path: Path) -> None:
    rig = FakeRig(camera=FakeCamera(fail="no ribbon cable"))
    config = DeviceConfig(imu=[], storage=StorageTable(folder=str(tmp_path)))
    watch = HealthWatch(config, rig, clock=lambda: 0.0)
    watch.test_hardware(never)
    watch.refresh_if_due("idle")
    found = {i.name: i.level for i in watch.items}
    assert found["self-test: camera"] == "fail" and found["self-test: trigger"] == "ok" and "clocks" in found
