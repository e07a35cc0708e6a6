from pathlib import Path

import pytest
from saved_runs import BOOT, CutDisk, PowerCut, confirmed_run, save_one, store_in

from bricktrack_common.checksums import sha256_bytes
from bricktrack_common.errors import StorageError
from bricktrack_common.run_folder import read_run
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.storage.recovery import recover_runs
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.storage.run_writer import DRAFT_NAME


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


def test_a_card_that_does_not_say_how_full_it_is_is_named(tmp_path: Path) -> None:
    store = store_in(tmp_path / "card")
    (tmp_path / "card").rename(tmp_path / "gone")
    with pytest.raises(StorageError, match=r"card: its free space cannot be told: No such file"):
        store.free_bytes()
    with pytest.raises(StorageError, match=r"card: cannot be locked: No such file"):
        store.lock()


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
