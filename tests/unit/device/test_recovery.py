import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import pytest
from saved_runs import BOOT, T0, CutDisk, PowerCut, save_one, store_in

from bricktrack_common.errors import RunFormatError, StorageError
from bricktrack_common.run_folder import read_run
from bricktrack_common.run_manifest import FileEntry, RunManifest, file_entry, read_manifest
from bricktrack_device.storage import recovery
from bricktrack_device.storage.disk import Disk
from bricktrack_device.storage.recovery import describe_anew_if_altered, recover_runs
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.storage.run_writer import DRAFT_NAME


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


@pytest.mark.parametrize("name", ["manifest.json", DRAFT_NAME])
def test_a_manifest_that_differs_from_its_draft_is_doubted(tmp_path: Path, name: str) -> None:
    store = store_in(tmp_path)
    run_id, other = save_one(store), save_one(store)
    path = tmp_path / "runs" / run_id / name
    altered = path.read_bytes().replace(b'"t0_ns": 5000000000', b'"t0_ns": 5000000008', 1)
    assert altered != path.read_bytes()  # one flipped bit, and still a manifest
    path.write_bytes(altered)
    assert recover_runs(store_in(tmp_path)) == [run_id]
    m = read_run(path.parent, verify_hashes=True).manifest
    assert m.state == "interrupted"
    assert any("altered the manifest or its draft" in words for words in m.missing)
    assert recover_runs(store_in(tmp_path)) == []
    assert read_run(tmp_path / "runs" / other).manifest.state == "complete"


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


def test_files_that_the_card_altered_are_described_as_they_are_now_and_named(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id, other = save_one(store), save_one(store)
    assert describe_anew_if_altered(store, run_id) == []
    before = store.describe(run_id)
    folder = tmp_path / "runs" / run_id
    video = bytearray((folder / "video.h264").read_bytes())
    video[500] ^= 4
    (folder / "video.h264").write_bytes(video)
    (folder / "edges.msgpack").unlink()
    (folder / "imu_brick.msgpack").write_bytes(b"\xc1" * 100)
    store.read_chunk(run_id, 0, 0, 10)  # known, and open

    altered = describe_anew_if_altered(store, run_id)
    assert sorted(altered) == ["edges.msgpack", "imu_brick.msgpack", "video.h264"]
    run = read_run(folder, verify_hashes=True)
    m = run.manifest
    assert m.state == "interrupted" and m.camera is not None and (run.video or folder).read_bytes() == video
    for name in altered:
        assert any(words.startswith(f"{name}: the card altered it") for words in m.missing)
    assert not run.imus and not run.edges_ns.size and m.file("imu_brick.msgpack.damaged") is not None
    assert store.describe(run_id) != before and len(store.list_runs()) == 2
    assert describe_anew_if_altered(store, run_id) == []
    assert describe_anew_if_altered(store, other) == []


def test_a_file_that_the_card_does_not_give_is_left_out_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)

    def failing(path: Path) -> FileEntry:
        if path.name == "video.h264":
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return file_entry(path)

    monkeypatch.setattr(recovery, "file_entry", failing)
    assert describe_anew_if_altered(store, run_id) == ["video.h264"]
    run = read_run(tmp_path / "runs" / run_id, verify_hashes=True)
    assert run.video is None and run.frames is not None and len(run.manifest.files) > 4
    assert "video.h264 is on the card and cannot be read" in run.manifest.missing
    assert (tmp_path / "runs" / run_id / "video.h264").exists()


def test_a_run_of_an_earlier_version_keeps_its_description_without_a_draft(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    folder = tmp_path / "runs" / save_one(store)
    (folder / DRAFT_NAME).unlink()
    (folder / "edges.msgpack").unlink()
    before = read_manifest(folder / "manifest.json")
    assert describe_anew_if_altered(store, folder.name) == ["edges.msgpack"]
    m = read_manifest(folder / "manifest.json")
    assert m.camera is not None and (m.camera, m.clocks, m.trigger) == (
        before.camera,
        before.clocks,
        before.trigger,
    )
    assert m.window_ns == before.window_ns and m.quality == before.quality


def test_a_manifest_altered_while_the_daemon_runs_is_not_offered_as_it_is(tmp_path: Path) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    path = tmp_path / "runs" / run_id / "manifest.json"
    store.describe(run_id)
    path.write_bytes(path.read_bytes().replace(b'"t0_ns": 5000000000', b'"t0_ns": 5000000008', 1))
    assert describe_anew_if_altered(store, run_id) == ["manifest.json"]
    m = read_run(path.parent, verify_hashes=True).manifest
    assert m.state == "interrupted" and m.trigger.t0_ns == T0
    assert any(words.startswith("manifest.json: the card altered it") for words in m.missing)
    assert describe_anew_if_altered(store, run_id) == []


@pytest.mark.parametrize("cut_at", range(1, 4))
def test_a_power_cut_while_a_run_is_described_anew_leaves_it_on_offer(tmp_path: Path, cut_at: int) -> None:
    run_id = save_one(store_in(tmp_path))
    (tmp_path / "runs" / run_id / "edges.msgpack").unlink()
    store = RunStore(tmp_path, "unit-1", disk=CutDisk(cut_at), boot_id=BOOT)
    with pytest.raises(PowerCut):
        describe_anew_if_altered(store, run_id)
    store = store_in(tmp_path)
    assert recover_runs(store) == [] and [r.run_id for r in store.list_runs()] == [run_id]
    describe_anew_if_altered(store, run_id)
    assert read_run(tmp_path / "runs" / run_id, verify_hashes=True).video is not None


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
def test_a_card_that_takes_nothing_keeps_an_altered_run_on_offer(tmp_path: Path, code: int) -> None:
    class Failing(Disk):
        def write_file(self, path: Path, fill: Callable[[BinaryIO], object]) -> None:
            raise OSError(code, os.strerror(code))

    run_id = save_one(store_in(tmp_path))
    (tmp_path / "runs" / run_id / "edges.msgpack").unlink()
    store = RunStore(tmp_path, "unit-1", disk=Failing(), boot_id=BOOT)
    before = store.describe(run_id)
    with pytest.raises(StorageError, match=f"{run_id}.*{os.strerror(code)}"):
        describe_anew_if_altered(store, run_id)
    store.forget(run_id)
    assert store.describe(run_id) == before


@pytest.mark.parametrize("reader", ["file_entry", "read_imu"])
def test_a_file_that_the_daemon_cannot_open_for_want_of_descriptors_is_not_called_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: str
) -> None:
    store = store_in(tmp_path)
    run_id = save_one(store)
    folder = tmp_path / "runs" / run_id
    (folder / "edges.msgpack").unlink()
    before = read_manifest(folder / "manifest.json")
    really = getattr(recovery, reader)

    def opened(path: Path) -> object:
        if path.name == "imu_brick.msgpack":
            try:
                raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
            except OSError as e:
                if reader == "file_entry":
                    raise
                raise RunFormatError(f"{path}: {e.strerror}") from e
        return really(path)

    monkeypatch.setattr(recovery, reader, opened)
    with pytest.raises(StorageError, match="Too many open files"):
        describe_anew_if_altered(store, run_id)
    assert read_manifest(folder / "manifest.json") == before and (folder / "imu_brick.msgpack").exists()
