"""Whether a folder can be written is told before the work, and a part of it is never left."""

import errno
import sys
from pathlib import Path

import pytest

from bricktrack_common.errors import StorageError
from bricktrack_host import durable_files
from bricktrack_host.durable_files import require_writable, write_folder_whole, written_whole


def test_nothing_is_left_where_the_disk_is_full(tmp_path):
    def write(partial):
        (partial / "fused.csv").write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(StorageError, match="no space left.*make room"):
        write_folder_whole(tmp_path / "results", write, marker="summary.json")
    assert list(tmp_path.iterdir()) == []


def test_a_file_takes_its_place_when_it_is_whole_and_leaves_the_old_one_otherwise(tmp_path):
    film = tmp_path / "films" / "shake.mp4"
    with written_whole(film, "") as partial:
        partial.write_text("first")
    with pytest.raises(ZeroDivisionError), written_whole(film, "") as partial:
        partial.write_text("half")
        raise ZeroDivisionError
    assert [(path.name, path.read_text()) for path in film.parent.iterdir()] == [("shake.mp4", "first")]


def test_a_place_without_a_name_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for place in (Path(), Path("/")):
        with pytest.raises(StorageError, match="no name of its own"), written_whole(place, ""):
            pass
        with pytest.raises(StorageError, match="no name of its own"):
            write_folder_whole(place, lambda _: None, marker="summary.json")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_can_be_made_or_written_is_taken(tmp_path):
    require_writable(tmp_path, "")
    require_writable(tmp_path / "not" / "yet", "")
    assert not (tmp_path / "not").exists()


def test_a_file_in_the_way_is_named_with_the_remedy(tmp_path):
    (tmp_path / "runs").write_text("no folder")
    for folder in (tmp_path / "runs", tmp_path / "runs" / "b7" / "results"):
        with pytest.raises(StorageError, match=rf"{tmp_path}/runs: is a file.*Name another"):
            require_writable(folder, "Name another")


def test_a_folder_of_another_or_a_read_only_disk_is_named(tmp_path, monkeypatch):
    # Tests may run as root, who may write anywhere but on a disk that is mounted read-only.
    monkeypatch.setattr(durable_files.os, "access", lambda path, mode: False)
    with pytest.raises(StorageError, match=rf"{tmp_path}: cannot be written. Name another"):
        require_writable(tmp_path / "results", "Name another")


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux which file a handle is of")
def test_every_file_is_on_the_disk_before_the_folder_takes_its_name(tmp_path, monkeypatch):
    names = {"summary.json", *(f"{i}.csv" for i in range(20))}
    synced, fsync = set(), durable_files.os.fsync

    def noted(handle):
        assert not (tmp_path / "results").exists() or synced >= names
        synced.add(Path(f"/proc/self/fd/{handle}").readlink().name)
        fsync(handle)

    monkeypatch.setattr(durable_files.os, "fsync", noted)
    write_folder_whole(
        tmp_path / "results", lambda p: [(p / name).write_text(name) for name in names], marker="summary.json"
    )
    assert synced >= names


def test_a_disk_that_fails_for_one_of_many_files_is_named(tmp_path, monkeypatch):
    def failing(path):
        if path.name == "7.csv":
            raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(durable_files, "sync_file", failing)
    with pytest.raises(StorageError, match="Input/output error"):
        write_folder_whole(
            tmp_path / "results",
            lambda p: [(p / f"{i}.csv").touch() for i in range(9)],
            marker="summary.json",
        )
    assert not (tmp_path / "results").exists()
