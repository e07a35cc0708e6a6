from pathlib import Path

import numpy as np
import pytest
from device_fakes import FakeBusOpener, FakeCamera, FakeRig
from recorder_bench import MakeBench, wait_until

from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Disarmed, Refusal
from bricktrack_device.capture import session as session_module
from bricktrack_device.config import (
    CameraTable,
    ImuTable,
    RecordingTable,
    TriggerTable,
)


def test_an_edge_makes_a_whole_run_around_it(bench: MakeBench, tmp_path: Path) -> None:
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


def test_a_missing_imu_stops_neither_the_camera_nor_the_other(bench: MakeBench, tmp_path: Path) -> None:
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
    bench: MakeBench, tmp_path: Path
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
    bench: MakeBench, tmp_path: Path
) -> None:
    b = bench(rig=FakeRig(camera=FakeCamera(fail="exposure wanders")))
    reply = b.ask("arm", "", None)
    assert isinstance(reply, Refusal) and reply.code == "not-ready" and "exposure wanders" in reply.message
    assert b.recorder.state == "idle"


def test_a_camera_that_is_not_required_may_be_missing(bench: MakeBench, tmp_path: Path) -> None:
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
    bench: MakeBench, tmp_path: Path
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


def test_a_bug_in_watching_the_sensors_costs_no_run(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
    bench: MakeBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[int] = []

    def break_down(self: FakeCamera) -> str:
        looks.append(len(looks))
        raise KeyError(len(looks))

    monkeypatch.setattr(FakeCamera, "problem", break_down)
    b = bench()
    b.arm()
    wait_until(lambda: len(looks) > 40)
    assert b.recorder._cycle.session is not None
    assert len(b.recorder._cycle.session.missing) == 20


def test_a_bug_in_one_part_of_a_run_does_not_cost_the_others(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
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
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    b = bench(imu=[ImuTable(name="brick", bus="a")])
    armed = b.arm()
    session = b.recorder._cycle.session
    assert session is not None and session.trigger is not None

    def fail() -> None:
        raise RuntimeError("GPIO not allocated")

    monkeypatch.setattr(session.trigger, "close", fail)
    b.rig.pulse(3)
    b.wait_for_run()
    assert read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True).manifest.state == "complete"
    assert b.rig.camera.n_stops == 1 and not session.imus[0]._process.is_alive()


def test_a_line_stuck_high_leaves_the_unit_armed_and_the_status_says_why(
    bench: MakeBench,
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


def test_a_bug_in_stopping_the_camera_leaves_no_sampler_behind(bench: MakeBench) -> None:
    camera = FakeCamera()
    b = bench(rig=FakeRig(camera=camera), imu=[ImuTable(name="brick", bus="a")])
    b.arm()
    session = b.recorder._cycle.session
    assert session is not None
    reader = session.imus[0]
    camera.stop_error = RuntimeError("a bug")
    assert isinstance(b.ask("disarm"), Disarmed) and b.recorder.restart_reason == "a bug"
    assert not reader._process.is_alive() and reader._buffer is None


def test_what_the_camera_itself_says_is_wrong_stands_in_the_run(bench: MakeBench, tmp_path: Path) -> None:
    camera = FakeCamera()
    b = bench(rig=FakeRig(camera=camera))
    run_id = b.arm().run_id
    camera.trouble = "camera: 3 frames were lost on the way: disk"
    b.rig.pulse(3)
    b.wait_for_run()
    missing = read_run(tmp_path / "runs" / run_id).manifest.missing
    assert [m for m in missing if m.startswith(camera.trouble)] and len(missing) == 1
