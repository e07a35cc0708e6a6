import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import msgspec
import numpy as np
import pytest

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.checksums import sha256_bytes
from bricktrack_common.errors import StorageError
from bricktrack_common.frame_times import FrameRecord
from bricktrack_common.imu_records import ImuDescription, ImuRecord
from bricktrack_common.run_folder import read_run
from bricktrack_common.run_manifest import (
    CameraSection,
    ClocksSection,
    RunManifest,
    WaveSection,
    read_manifest,
)
from bricktrack_device.capture.recording import ImuRecording, Recording, RunLog, save
from bricktrack_device.capture.ring import VideoCut
from bricktrack_device.capture.trigger import EdgeTrain
from bricktrack_device.interfaces import EncodedPacket
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.storage import recovery
from bricktrack_device.storage.disk import Disk
from bricktrack_device.storage.recovery import recover_runs
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.storage.run_writer import DRAFT_NAME

T0 = 5_000_000_000
BOOT = "b3f2a7d0-0000-0000-0000-000000000000"
N_FRAMES = 12


class PowerCut(BaseException):
    """The process is gone: nobody catches this."""


class CutDisk(Disk):
    """Counts operations and fails at the n-th, before it, or half-way through a file."""

    def __init__(self, fail_at: int | None = None, error: Callable[[], BaseException] = PowerCut) -> None:
        self.n = 0
        self.fail_at = fail_at
        self.error = error
        self.half_way = False

    def _step(self) -> None:
        self.n += 1
        if self.n == self.fail_at:
            raise self.error()

    def make_folder(self, folder: Path) -> None:
        self._step()
        super().make_folder(folder)

    def write_file(self, path: Path, fill: Callable[[BinaryIO], object]) -> None:
        self._step()
        if self.n + 1 == self.fail_at and self.half_way:
            super().write_file(path, fill)
            os.truncate(path, path.stat().st_size // 2)
            raise self.error()
        super().write_file(path, fill)

    def sync_file(self, path: Path) -> None:
        self._step()
        super().sync_file(path)

    def sync_folder(self, folder: Path) -> None:
        self._step()
        super().sync_folder(folder)

    def rename(self, old: Path, new: Path) -> None:
        self._step()
        super().rename(old, new)


def full_disk() -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def recording(run_id: str) -> Recording:
    packets = [EncodedPacket(T0 // 1000 + i * 33_333, i % 4 == 0, bytes([i]) * 100) for i in range(N_FRAMES)]
    frames = [
        FrameRecord(i * 33_333, T0 + i * 33_333_000, 2000, 1.0, i % 4 == 0, 100 * i, 100, 0)
        for i in range(N_FRAMES)
    ]
    description = ImuDescription(
        name="brick", chip_id="", bus="a", address=0x28, opr_mode=7, fusion=False, acc_range_g=16.0,
        period_ns=10_000_000, t0_ns=T0,
    )  # fmt: skip
    samples = [
        ImuRecord(i, T0 + i * 10_000_000, T0 + i * 10_000_000 + 1_000_000, bytes([i + 1]) * 46, 0, None)
        for i in range(20)
    ]
    camera = CameraSection(
        model="fake", mode=IMX219_1080P, exposure_us=2000, analogue_gain=1.0, colour_gains=(1.0, 1.0),
        frame_duration_us=33_333, encoder="none", encoder_settings={},
    )  # fmt: skip
    log = RunLog()
    log.add("armed")
    return Recording(
        run_id=run_id, unit="unit-1", label="", state="complete", simulated=True, hardware={}, camera=camera,
        video=VideoCut(packets, frames, 0, 0, []), imus=[ImuRecording(description, samples, 20)],
        trigger_pin="GPIO17", nominal_hz=None, edges=EdgeTrain(T0, [T0, T0 + 20_000_000], 0, []), wave=WaveSection(),
        clocks=ClocksSection(), window_ns=(T0, T0 + 400_000_000), missing=[], log=log,
    )  # fmt: skip


def write_truth(folder: Path) -> Path:
    path = folder / "truth.npz"
    path.write_bytes(b"truth")
    return path


def store_in(folder: Path, disk: Disk | None = None) -> RunStore:
    return RunStore(folder, "unit-1", disk=disk, boot_id=BOOT)


def save_one(store: RunStore, label: str = "") -> str:
    run_id = store.new_run_id(label)
    save(recording(run_id), store.open_writer(run_id), write_truth)
    return run_id


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


def test_numbers_go_on_over_restarts_and_a_lost_counter(tmp_path: Path) -> None:
    assert save_one(store_in(tmp_path)).endswith("_0001")
    assert store_in(tmp_path).new_run_id("").endswith("_0002")  # taken, though its run was never saved
    assert save_one(store_in(tmp_path)).endswith("_0003")
    (tmp_path / "next_run.json").write_text("garbage")
    assert store_in(tmp_path).new_run_id("x").endswith("_0004_x")
    saved = next((tmp_path / "runs").glob("*_0003"))
    saved.rename(saved.with_name(saved.name.replace("_0003", "_0007.partial")))  # as a cut leaves it
    (tmp_path / "next_run.json").write_text("garbage")
    assert store_in(tmp_path).new_run_id("").endswith("_0008")


def n_steps_of_a_save(folder: Path) -> int:
    disk = CutDisk()
    store = store_in(folder, disk)
    run_id = store.new_run_id("")
    disk.n = 0
    save(recording(run_id), store.open_writer(run_id), write_truth)
    return disk.n


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


def test_recovery_without_the_draft_takes_what_the_streams_say(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    final = tmp_path / "runs" / run_id
    partial = final.rename(final.with_name(run_id + ".partial"))
    (partial / "manifest.json").unlink()
    (partial / DRAFT_NAME).unlink()
    (partial / "Weird Name").write_text("left alone")
    assert recover_runs(store_in(tmp_path)) == [run_id]
    run = read_run(final, verify_hashes=True)
    assert run.manifest.state == "interrupted" and run.manifest.trigger.t0_ns == T0
    assert list(run.imus) == ["brick"] and run.manifest.camera is None
    assert any("description was lost" in words for words in run.manifest.missing)
    assert (final / "Weird Name").exists()


def test_recovery_never_overwrites_a_run_and_leaves_strange_folders(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    before = (tmp_path / "runs" / run_id / "manifest.json").read_bytes()
    (tmp_path / "runs" / f"{run_id}.partial").mkdir()
    (tmp_path / "runs" / "-odd-.partial").mkdir()
    assert recover_runs(store_in(tmp_path)) == []
    assert (tmp_path / "runs" / f"{run_id}.partial").is_dir()
    assert (tmp_path / "runs" / run_id / "manifest.json").read_bytes() == before


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: bytes(len(data)),
        lambda data: data[:100],
        lambda data: b"",
        lambda data: b"[" * 9999,
        lambda data: data.replace(b'"window_ns"', b'"vindow_ns"'),
        lambda data: data.replace(b'"bricktrack.run"', b'"bricktrack.rwn"'),
    ],
)
def test_a_run_whose_manifest_is_damaged_is_made_anew_from_its_draft(
    tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    store = store_in(tmp_path)
    run_id, other = save_one(store), save_one(store)
    path = tmp_path / "runs" / run_id / "manifest.json"
    before = read_manifest(path)
    path.write_bytes(damage(path.read_bytes()))
    newer = tmp_path / "runs" / other / "manifest.json"
    newer.write_text('{"schema": "bricktrack.run", "version": 99}')
    assert recover_runs(store_in(tmp_path)) == [run_id]
    m = read_run(path.parent, verify_hashes=True).manifest
    assert m.state == "interrupted" and (m.camera, m.clocks) == (before.camera, before.clocks)
    assert (m.window_ns, m.trigger, m.quality) == (before.window_ns, before.trigger, before.quality)
    assert set(before.files) < set(m.files)
    assert path.with_name("manifest.json.damaged").exists()
    assert newer.read_text().endswith("99}")  # a newer bricktrack reads it


def test_a_run_whose_manifest_is_lost_is_taken_up_again_and_no_other_folder(tmp_path: Path) -> None:
    run_id = save_one(store_in(tmp_path))
    (tmp_path / "runs" / run_id / "manifest.json").unlink()
    (tmp_path / "runs" / "notes").mkdir()
    (tmp_path / "runs" / "notes" / "README").write_text("of somebody")
    store = store_in(tmp_path)
    assert store.list_runs() == []  # nothing to offer as long as nobody has looked
    assert recover_runs(store) == [run_id]
    assert [(r.run_id, r.state) for r in store.list_runs()] == [(run_id, "interrupted")]
    run = read_run(tmp_path / "runs" / run_id, verify_hashes=True)
    assert run.manifest.camera is not None and run.video is not None
    assert (tmp_path / "runs" / "notes" / "README").exists()
    assert recover_runs(store_in(tmp_path)) == []


def test_a_power_cut_while_a_damaged_run_is_taken_up_again_does_not_lose_it(tmp_path: Path) -> None:
    cut_at, was_cut = 0, True
    while was_cut:
        cut_at += 1
        folder = tmp_path / str(cut_at)
        run_id = save_one(store_in(folder))
        (folder / "runs" / run_id / "manifest.json").write_bytes(b"")
        try:
            recover_runs(RunStore(folder, "unit-1", disk=CutDisk(cut_at), boot_id=BOOT))
            was_cut = False
        except PowerCut:
            recover_runs(store_in(folder))
        run = read_run(folder / "runs" / run_id, verify_hashes=True)
        assert run.manifest.trigger.t0_ns == T0 and run.video is not None
    assert cut_at > 4  # two names, the new manifest, and its name


def test_a_bug_in_a_recovery_leaves_the_folder_alone_and_the_unit_comes_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_in(tmp_path)
    folders = [tmp_path / "runs" / save_one(store) for _ in range(2)]
    for folder in folders:
        (folder / "manifest.json").unlink()
        folder.rename(folder.with_name(folder.name + ".partial"))

    def break_down(folder: Path, run_id: str, unit: str) -> RunManifest:
        if run_id == folders[0].name:
            raise ZeroDivisionError("a bug")
        return rebuild(folder, run_id, unit)

    rebuild = recovery.rebuild_manifest
    monkeypatch.setattr(recovery, "rebuild_manifest", break_down)
    assert recover_runs(store_in(tmp_path)) == [folders[1].name]
    assert folders[0].with_name(folders[0].name + ".partial").is_dir()


def test_a_card_that_does_not_say_how_full_it_is_is_named(tmp_path: Path) -> None:
    store = store_in(tmp_path / "card")
    (tmp_path / "card").rename(tmp_path / "gone")
    with pytest.raises(StorageError, match=r"card: its free space cannot be told: No such file"):
        store.free_bytes()
    with pytest.raises(StorageError, match=r"lock: cannot be locked: No such file"):
        store.lock()


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


def test_listing_is_oldest_first_and_leaves_partial_and_broken_folders_out(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    ids = [save_one(store), save_one(store)]
    (tmp_path / "runs" / f"{ids[0]}x.partial").mkdir()
    (tmp_path / "runs" / "empty").mkdir()
    listed = store.list_runs()
    assert [r.run_id for r in listed] == ids
    on_disk = sum(p.stat().st_size for p in (tmp_path / "runs" / ids[0]).iterdir() if p.name != DRAFT_NAME)
    assert listed[0].n_bytes == on_disk and not listed[0].confirmed


def test_describing_lists_the_manifest_first_with_true_hashes(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    files = store.describe(run_id).files
    assert files[0].name == "manifest.json"
    for f in files:
        data = (tmp_path / "runs" / run_id / f.name).read_bytes()
        assert (f.n_bytes, f.sha256) == (len(data), sha256_bytes(data))


def test_chunks_are_the_files_bytes_and_end_with_the_file(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    files = store.describe(run_id).files
    index = [f.name for f in files].index("video.h264")
    data = (tmp_path / "runs" / run_id / "video.h264").read_bytes()
    assert store.read_chunk(run_id, index, 100, 350) == data[100:450]
    assert store.read_chunk(run_id, index, 1100, 350) == data[1100:]
    assert store.read_chunk(run_id, index, len(data), 10) == b""
    for arguments, code in [
        ((run_id, index, len(data) + 1, 10), "out-of-range"),
        ((run_id, 64, 0, 10), "no-such-file"),
        (("unit-1_000000_0009", 0, 0, 10), "no-such-run"),
        (("..", 0, 0, 10), "no-such-run"),
        ((f"{run_id}.partial", 0, 0, 10), "no-such-run"),
    ]:
        with pytest.raises(RequestRefusedError) as e:
            store.read_chunk(*arguments)
        assert e.value.code == code


def test_confirming_needs_every_hash_and_lasts(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    hashes = [f.sha256 for f in store.describe(run_id).files]
    for wrong in ([], hashes[1:], [*hashes[:-1], "0" * 64], [*hashes, hashes[0]]):
        with pytest.raises(RequestRefusedError) as e:
            store.confirm(run_id, wrong)
        assert e.value.code == "hash-mismatch"
    assert not store.list_runs()[0].confirmed
    store.confirm(run_id, hashes[::-1])
    assert store_in(tmp_path).list_runs()[0].confirmed


def test_a_folder_belongs_to_one_daemon_at_a_time(tmp_path: Path) -> None:
    first, second = store_in(tmp_path), store_in(tmp_path)
    first.lock()
    with pytest.raises(StorageError, match="another bricktrackd"):
        second.lock()
    first.unlock()
    second.lock()
    second.unlock()


def test_a_storage_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match=r"storage\.folder"):
        store_in(tmp_path / "file" / "sub")


def test_the_manifest_of_a_run_is_the_documented_one(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    manifest = read_run(tmp_path / "runs" / run_id).manifest
    assert isinstance(manifest, RunManifest)
    q = msgspec.to_builtins(manifest.quality)
    assert (q["frames"], q["imu_slots"], q["imu_gaps"], q["edges"]) == (N_FRAMES, 20, 0, 2)
    assert np.isclose(q["imu_late_max_us"], 0.0)


def confirmed_run(store: RunStore) -> str:
    run_id = store.new_run_id("")
    save(recording(run_id), store.open_writer(run_id), lambda folder: None)
    store.confirm(run_id, [f.sha256 for f in store.describe(run_id).files])
    return run_id


def test_deleting_needs_a_confirmation_or_force_and_a_run(tmp_path: Path) -> None:
    store = RunStore(tmp_path, "unit-1", boot_id=BOOT)
    run_id = confirmed_run(store)
    (tmp_path / "confirmed" / f"{run_id}.json").unlink()
    size = sum(p.stat().st_size for p in (tmp_path / "runs" / run_id).iterdir())
    with pytest.raises(RequestRefusedError, match="pull it first") as e:
        store.delete(run_id)
    assert e.value.code == "not-confirmed" and store.count_unconfirmed() == 1
    store.read_chunk(run_id, 0, 0, 10)  # leaves a file open
    assert store.delete(run_id, force=True) == size
    assert list((tmp_path / "runs").iterdir()) == [] and store.list_runs() == []
    for gone in (run_id, "../confirmed", "", f"{run_id}.partial"):
        with pytest.raises(RequestRefusedError) as e:
            store.delete(gone, force=True)
        assert e.value.code == "no-such-run"
    with pytest.raises(RequestRefusedError):
        store.read_chunk(run_id, 0, 0, 10)


def test_force_removes_a_folder_that_cannot_be_read(tmp_path: Path) -> None:
    store = RunStore(tmp_path, "unit-1", boot_id=BOOT)
    run_id = confirmed_run(store)
    (tmp_path / "runs" / run_id / "manifest.json").write_text("{")
    assert RunStore(tmp_path, "unit-1", boot_id=BOOT).delete(run_id, force=True) > 0
    assert store.count_runs() == 0


def test_a_power_cut_while_deleting_leaves_a_whole_run_or_none(tmp_path: Path) -> None:
    for fail_at in range(1, 5):
        folder = tmp_path / str(fail_at)
        run_id = confirmed_run(RunStore(folder, "unit-1", boot_id=BOOT))
        disk = CutDisk(fail_at)
        try:
            RunStore(folder, "unit-1", boot_id=BOOT, disk=disk).delete(run_id)
        except PowerCut:
            pass
        else:
            assert fail_at > disk.n  # every step was cut once
            break
        store = RunStore(folder, "unit-1", boot_id=BOOT)
        assert recover_runs(store) == []
        if (folder / "runs" / run_id).exists():
            assert read_run(folder / "runs" / run_id, verify_hashes=True).manifest.state == "complete"
        assert not (folder / "deleted").exists()
    else:
        pytest.fail("deleting has more steps than were tried")


def test_reading_many_files_keeps_only_a_few_open(tmp_path: Path) -> None:
    store = RunStore(tmp_path, "unit-1", boot_id=BOOT)
    run_ids = [confirmed_run(store) for _ in range(4)]
    before = len(list(Path("/proc/self/fd").iterdir()))
    for run_id in run_ids:
        for i, f in enumerate(store.describe(run_id).files):
            assert len(store.read_chunk(run_id, i, 0, f.n_bytes)) == f.n_bytes
    assert 0 < len(list(Path("/proc/self/fd").iterdir())) - before <= 8
    store.unlock()
    assert len(list(Path("/proc/self/fd").iterdir())) == before
