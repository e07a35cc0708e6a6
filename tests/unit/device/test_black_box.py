import errno
import os
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recorder_bench import MakeBench, wait_until
from saved_runs import N_FRAMES, T0, CutDisk, full_disk, recording, save_one, store_in

from bricktrack_common.run_folder import Run, read_run
from bricktrack_device.capture import black_box as black_box_module
from bricktrack_device.capture.black_box import BlackBox, black_box_folder
from bricktrack_device.capture.recording import Recording
from bricktrack_device.capture.ring import VideoCut
from bricktrack_device.config import DeviceConfig, ImuTable, RecordingTable, StorageTable
from bricktrack_device.storage.recovery import recover_runs
from bricktrack_device.storage.run_store import RunStore


def cut_after(whole: Recording, n: int) -> Recording:
    """Return a recording as it was after its first pictures."""
    assert whole.video is not None
    return replace(whole, video=VideoCut(whole.video.packets[:n], whole.video.records[:n], 0, 0, []))


def copy_of(run_id: str, box: Path, *, n_frames: int = N_FRAMES) -> None:
    """Leave what a daemon leaves that is killed after so many pictures."""
    black_box = BlackBox(box)
    black_box.begin(run_id, 1000)
    for n in (3, n_frames):
        black_box.take(lambda n=n: cut_after(recording(run_id), n))


def check_whole(run: Run) -> None:
    assert run.manifest.trigger.t0_ns == T0 and run.manifest.camera is not None
    assert run.frames is not None and run.frames.n_frames == N_FRAMES
    assert run.video is not None and run.video.stat().st_size == 100 * N_FRAMES
    assert run.imus["brick"][1].t_ns.size == 20 and run.edges_ns.size == 2


def test_what_a_killed_daemon_had_recorded_is_a_run_at_the_next_start(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(black_box_module, "_EVERY_S", 0.05)
    monkeypatch.setattr(black_box_module, "_SHARE", 1.0)
    box = tmp_path / "box"
    b = bench(
        imu=[ImuTable(name="brick", bus="a")],
        recording=RecordingTable(duration_s=1.5, pre_roll_s=0.2, post_roll_s=0.1),
        storage=StorageTable(folder=str(tmp_path), margin_mb=1, black_box=str(box)),
    )
    run_id = b.arm("shake").run_id
    b.rig.pulse(3)
    video = box / run_id / "video.h264"
    wait_until(lambda: video.exists() and video.stat().st_size >= 9 * 25)
    shutil.copytree(box, tmp_path / "left")  # the card has nothing of it now

    store = store_in(tmp_path / "other card")
    assert recover_runs(store, tmp_path / "left") == [run_id]
    assert list((tmp_path / "left").iterdir()) == []
    run = read_run(store.runs / run_id, verify_hashes=True)
    m = run.manifest
    assert m.state == "interrupted" and any("the daemon was killed" in words for words in m.missing)
    assert m.label == "shake" and m.camera is not None and run.edges_ns.size == 3
    assert m.trigger.t0_ns == run.edges_ns[0] and m.clocks.trigger is not None
    assert run.frames is not None and run.frames.n_frames >= 20 and m.window_ns is not None
    assert run.frames.keyframe[0] and run.frames.sensor_timestamp_ns[0] <= m.window_ns[0]
    _, samples = run.imus["brick"]
    assert m.window_ns[0] <= samples.t_ns[0] and np.all(np.diff(samples.t_ns) < 20_000_000)

    b.wait_for_run()
    assert list(box.iterdir()) == []
    assert read_run(tmp_path / "runs" / run_id, verify_hashes=True).manifest.state == "complete"


def test_a_copy_goes_on_where_it_was_and_is_brought_to_the_card(tmp_path: Path) -> None:
    copy_of("unit-1_b3f2a7_0001", tmp_path / "box")
    store = store_in(tmp_path)
    assert recover_runs(store, tmp_path / "box") == ["unit-1_b3f2a7_0001"]
    check_whole(read_run(store.runs / "unit-1_b3f2a7_0001", verify_hashes=True))


@pytest.mark.parametrize("half_way", [False, True])
def test_a_card_that_is_full_when_the_copy_is_brought_in_costs_nothing_of_it(
    tmp_path: Path, half_way: bool
) -> None:
    fail_at, was_full = 0, True
    while was_full:
        fail_at += 1
        folder = tmp_path / str(fail_at)
        run_id = "unit-1_b3f2a7_0001"
        copy_of(run_id, folder / "box")
        disk = CutDisk(fail_at, error=full_disk)
        disk.half_way = half_way
        recover_runs(store_in(folder, disk), folder / "box")
        was_full = disk.n + half_way >= fail_at
        store = store_in(folder)
        recover_runs(store, folder / "box")
        assert list((folder / "box").iterdir()) == []
        check_whole(read_run(store.runs / run_id, verify_hashes=True))
    assert fail_at > 10  # every step was the one that failed


def test_a_run_that_was_saved_before_the_kill_is_not_touched(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id, unnamed = save_one(store), save_one(store)
    (store.runs / unnamed).rename(store.runs / f"{unnamed}.partial")  # killed before the renaming
    for name in (run_id, unnamed):
        copy_of(name, tmp_path / "box", n_frames=4)
    assert recover_runs(store_in(tmp_path), tmp_path / "box") == [unnamed]
    for name in (run_id, unnamed):
        run = read_run(store.runs / name, verify_hashes=True)
        assert run.manifest.state == "complete" and run.problems == []
    assert list((tmp_path / "box").iterdir()) == []


def test_a_copy_that_was_first_cut_from_an_earlier_keyframe_has_its_pictures_where_the_frames_say(
    tmp_path: Path,
) -> None:
    """Just after the first edge a run may still be cut from before its window: pre-roll under 0.3 s."""
    run_id = "unit-1_b3f2a7_0001"
    whole = recording(run_id)
    assert whole.video is not None
    later = [replace(r, byte_offset=r.byte_offset - 400) for r in whole.video.records[4:]]
    black_box = BlackBox(tmp_path / "box")
    black_box.begin(run_id, 1000)
    black_box.take(lambda: cut_after(whole, 3))
    black_box.take(lambda: replace(whole, video=VideoCut(whole.video.packets[4:], later, 0, 0, [])))
    del black_box
    store = store_in(tmp_path)
    assert recover_runs(store, tmp_path / "box") == [run_id]
    run = read_run(store.runs / run_id, verify_hashes=True)
    assert run.video is not None and run.frames is not None and run.frames.n_frames == N_FRAMES - 4
    assert run.video.read_bytes() == b"".join(p.data for p in whole.video.packets[4:])


def test_a_copy_that_a_daemon_is_at_work_on_is_nobody_elses_until_it_is_gone(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run_id = "unit-1_b3f2a7_0001"
    at_work = BlackBox(tmp_path / "box")
    at_work.begin(run_id, 1000)
    at_work.take(lambda: cut_after(recording(run_id), 3))
    other = store_in(tmp_path / "other card")
    assert recover_runs(other, tmp_path / "box") == []
    assert "another bricktrackd is at work on it" in caplog.text
    at_work.take(lambda: recording(run_id))
    del at_work  # the process is gone
    assert recover_runs(other, tmp_path / "box") == [run_id]
    check_whole(read_run(other.runs / run_id, verify_hashes=True))


def test_a_copy_of_another_unit_is_left_to_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for unit in ("unit-2", "unit", "unit-1_b"):
        copy_of(f"{unit}_b3f2a7_0001", tmp_path / "box")
    assert recover_runs(store_in(tmp_path), tmp_path / "box") == []
    assert len(list((tmp_path / "box").iterdir())) == 3 and caplog.text.count("is of another unit") == 3


def test_arming_first_brings_in_what_is_left_in_memory(bench: MakeBench, tmp_path: Path) -> None:
    box = tmp_path / "box"
    copy_of("unit-1_b3f2a7_0001", box)
    b = bench(storage=StorageTable(folder=str(tmp_path), margin_mb=1, black_box=str(box)))
    b.arm()
    assert [r.run_id for r in b.store.list_runs()] == ["unit-1_b3f2a7_0001"]


def test_a_folder_of_copies_that_cannot_be_listed_stops_neither_start_nor_arming(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    box = tmp_path / "box"
    copy_of("unit-1_b3f2a7_0001", box)
    listed = Path.iterdir

    def of_another_user(path: Path) -> Iterator[Path]:
        if path == box:
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return listed(path)

    monkeypatch.setattr(Path, "iterdir", of_another_user)
    assert recover_runs(store_in(tmp_path), box) == []
    bench(storage=StorageTable(folder=str(tmp_path), margin_mb=1, black_box=str(box))).arm()
    assert f"{box}: cannot be listed: Permission denied" in caplog.text


def test_a_slow_card_that_takes_a_copy_in_does_not_starve_the_watchdog(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box = tmp_path / "box"
    b = bench(storage=StorageTable(folder=str(tmp_path), margin_mb=1, black_box=str(box)))
    ages_s: list[float] = []

    def slowly(black_box: BlackBox, store: RunStore) -> None:
        for _ in range(10):
            time.sleep(0.05)
            ages_s.append(b.recorder.beat_age_s)

    monkeypatch.setattr(BlackBox, "bring_in", slowly)
    b.arm()
    assert len(ages_s) == 10 and min(ages_s[5:]) < 0.1  # beaten meanwhile, every 10 ms


def test_without_room_in_memory_there_is_no_copy_and_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    black_box = BlackBox(tmp_path / "box")
    black_box.begin("unit-1_b3f2a7_0001", 10**15)
    black_box.take(lambda: recording("unit-1_b3f2a7_0001"))
    assert not list((tmp_path / "box").iterdir()) and "no copy in memory" in caplog.text


def test_a_video_that_outgrows_its_bit_rate_leaves_room_for_other_services(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    free = [17_000_000]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free[0]))
    black_box = BlackBox(tmp_path / "box")
    black_box.begin("unit-1_b3f2a7_0001", 2_000_000)  # 17 MB hold it twice, but not it and what others need
    assert not black_box.run_id and "18 MB are wanted" in caplog.text

    black_box.begin("unit-1_b3f2a7_0001", 1000)
    black_box.take(lambda: cut_after(recording("unit-1_b3f2a7_0001"), 3))
    assert (tmp_path / "box" / "unit-1_b3f2a7_0001" / "video.h264").stat().st_size == 300
    free[0] = 16_000_000 + 100 * (N_FRAMES - 3) - 1  # a byte less than the rest of the video wants
    black_box.take(lambda: recording("unit-1_b3f2a7_0001"))
    assert not black_box.run_id and not list((tmp_path / "box").iterdir())
    assert "its copy in memory ends: [Errno 28] No space left" in caplog.text


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), KeyError("a bug")])
def test_what_goes_wrong_with_the_copy_ends_the_copy_alone(
    tmp_path: Path, error: Exception, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> Recording:
        raise error

    black_box = BlackBox(tmp_path / "box")
    black_box.begin("unit-1_b3f2a7_0001", 1000)
    black_box.take(lambda: recording("unit-1_b3f2a7_0001"))
    assert black_box.run_id and list((tmp_path / "box").iterdir())
    black_box.take(fail)
    assert not black_box.run_id and not list((tmp_path / "box").iterdir())
    assert "its copy in memory ends" in caplog.text


def test_copying_takes_only_its_share_of_the_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(black_box_module.time, "monotonic", lambda: now[0])
    taken: list[float] = []

    def slow() -> Recording:
        taken.append(now[0])
        now[0] += 0.5
        return recording("unit-1_b3f2a7_0001")

    black_box = BlackBox(tmp_path / "box")
    black_box.begin("unit-1_b3f2a7_0001", 1000)
    while now[0] < 131.0:
        black_box.take_if_due(slow)
        now[0] += 0.02
    assert len(taken) == 3 and np.allclose(np.diff(taken), 10.5, atol=0.03)  # 0.5 s is a twentieth of 10 s


def test_a_copy_is_kept_where_the_configuration_says_or_systemd_gives_memory(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert black_box_folder(DeviceConfig()) is None
    monkeypatch.setenv("RUNTIME_DIRECTORY", "/run/bricktrack:/run/other")
    assert black_box_folder(DeviceConfig()) == Path("/run/bricktrack/black-box")
    chosen = DeviceConfig(storage=StorageTable(black_box="/dev/shm/copies"))
    assert black_box_folder(chosen) == Path("/dev/shm/copies")
