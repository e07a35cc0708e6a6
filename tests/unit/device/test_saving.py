import errno
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from saved_runs import (
    N_FRAMES,
    T0,
    CutDisk,
    PowerCut,
    full_disk,
    n_steps_of_a_save,
    recording,
    save_one,
    store_in,
    write_truth,
)

from bricktrack_common.errors import StorageError
from bricktrack_common.run_folder import read_run
from bricktrack_common.run_manifest import (
    RunManifest,
)
from bricktrack_device.capture import saving
from bricktrack_device.capture.saving import save
from bricktrack_device.storage.recovery import recover_runs
from bricktrack_device.storage.run_writer import DRAFT_NAME


def test_a_saved_run_reads_back_verified(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store, "shake-3")
    assert run_id == "unit-1_b3f2a7_0001_shake-3"
    run = read_run(tmp_path / "runs" / run_id, verify_hashes=True)
    assert run.problems == [] and run.manifest.state == "complete"
    assert run.frames is not None and run.frames.n_frames == N_FRAMES
    assert run.edges_ns.tolist() == [T0, T0 + 20_000_000]
    assert (run.video or tmp_path).read_bytes() == b"".join(bytes([i]) * 100 for i in range(N_FRAMES))
    names = {p.name for p in (tmp_path / "runs" / run_id).iterdir()}
    assert names == {"manifest.json", DRAFT_NAME} | {f.name for f in run.manifest.files}


@pytest.mark.parametrize("half_way", [False, True])
def test_power_cut_at_any_step_leaves_a_run_that_says_what_it_lacks(tmp_path: Path, half_way: bool) -> None:
    n_steps = n_steps_of_a_save(tmp_path / "count")
    assert n_steps > 12
    states = []
    for cut_at in range(1, n_steps + 1):
        folder = tmp_path / f"cut-{cut_at}"
        disk = CutDisk()
        store = store_in(folder, disk)
        run_id = store.new_run_id("")
        disk.n, disk.fail_at, disk.half_way = 0, cut_at, half_way
        with pytest.raises(PowerCut):
            save(recording(run_id), store.open_writer(run_id), write_truth)

        again = store_in(folder)  # the next boot
        recover_runs(again)
        assert not list((folder / "runs").glob("*.partial"))
        runs = again.list_runs()
        if cut_at == 1:  # the folder itself was never made
            assert runs == []
            continue
        assert [r.run_id for r in runs] == [run_id]
        run = read_run(folder / "runs" / run_id, verify_hashes=True)
        states.append(run.manifest.state)
        if run.manifest.state == "interrupted":
            assert any("cut off" in words for words in run.problems)
            whole_video = run.video is not None and run.video.stat().st_size == 100 * N_FRAMES
            assert whole_video or any("video.h264" in words for words in run.problems)
        else:
            assert run.problems == []
        assert recover_runs(again) == []
    # Only the last steps, after the manifest was written, give a whole run.
    assert states == sorted(states, reverse=True) and states[0] == "interrupted" and states[-1] == "complete"


def test_a_full_disk_at_any_step_keeps_what_was_saved_and_can_be_taken_up_again(tmp_path: Path) -> None:
    n_steps = n_steps_of_a_save(tmp_path / "count")
    for full_at in range(1, n_steps + 1):
        folder = tmp_path / f"full-{full_at}"
        disk = CutDisk(error=full_disk)
        store = store_in(folder, disk)
        run_id = store.new_run_id("")
        writer = store.open_writer(run_id)
        disk.n, disk.fail_at = 0, full_at
        with pytest.raises(StorageError) as e:
            save(recording(run_id), writer, write_truth)
        assert e.value.errno == errno.ENOSPC and "Make room" in str(e.value)
        disk.fail_at = None
        save(recording(run_id), writer, write_truth)
        run = read_run(folder / "runs" / run_id, verify_hashes=True)
        assert run.manifest.state == "complete" and run.problems == []


def test_the_manifest_of_a_run_is_the_documented_one(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    manifest = read_run(tmp_path / "runs" / run_id).manifest
    assert isinstance(manifest, RunManifest)
    q = msgspec.to_builtins(manifest.quality)
    assert (q["frames"], q["imu_slots"], q["imu_gaps"], q["edges"]) == (N_FRAMES, 20, 0, 2)
    assert np.isclose(q["imu_late_max_us"], 0.0)


def break_down(*args: object, **more: object) -> None:
    raise ZeroDivisionError("a bug")


@pytest.mark.parametrize(
    ("broken", "lost"),
    [
        ("write_imu", "imu_brick.msgpack"),
        ("write_edges", "edges.msgpack"),
        ("write_frames", "frames.msgpack"),
        ("quality", "the counts"),
        ("software_versions", "the versions"),
    ],
)
def test_a_bug_in_one_part_costs_no_other_and_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str, lost: str
) -> None:
    monkeypatch.setattr(saving, broken, break_down)
    run_id = save_one(store_in(tmp_path))
    m = read_run(tmp_path / "runs" / run_id, verify_hashes=True).manifest
    assert m.missing == [f"{lost}: internal error: ZeroDivisionError: a bug"]
    names = {"imu_brick.msgpack", "edges.msgpack", "frames.msgpack", "video.h264", "log.jsonl", "truth.npz"}
    assert {f.name for f in m.files} == names - {lost}


@pytest.mark.parametrize(
    ("part", "wrong"),
    [
        ("hardware", {"model": np.int64(4)}),  # not to be encoded
        ("hardware", {"model": None}),  # encoded, and refused by whoever reads it
        ("camera", msgspec.structs.replace(recording("x").camera, analogue_gain=float("nan"))),
    ],
)
def test_what_no_host_could_read_is_left_out_of_the_manifest_and_named(
    tmp_path: Path, part: str, wrong: object
) -> None:
    store = store_in(tmp_path)
    run_id = store.new_run_id("")
    save(replace(recording(run_id), **{part: wrong}), store.open_writer(run_id), write_truth)
    assert [r.run_id for r in store.list_runs()] == [run_id]
    m = read_run(tmp_path / "runs" / run_id, verify_hashes=True).manifest
    assert len(m.missing) == 1 and m.missing[0].startswith(f"{part}: internal error: ")
    assert not getattr(m, part) and m.quality.frames == N_FRAMES and len(m.files) == 6


def test_a_full_card_after_a_bug_is_taken_up_again_and_the_bug_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(saving, "write_edges", break_down)
    disk = CutDisk(fail_at=8, error=full_disk)
    store = store_in(tmp_path, disk)
    run_id = store.new_run_id("")
    kept, writer = recording(run_id), store.open_writer(run_id)
    with pytest.raises(StorageError):
        save(kept, writer, write_truth)
    save(kept, writer, write_truth)
    assert read_run(tmp_path / "runs" / run_id, verify_hashes=True).manifest.missing == [
        "edges.msgpack: internal error: ZeroDivisionError: a bug"
    ]
