"""Files and folders that are on the disk when a function returns, and disk errors in words."""

import errno
import os
import re
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from bricktrack_common.errors import BricktrackError, StorageError

_SYNCED_AT_ONCE = 8
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_file(path: Path) -> None:
    """Make a file's bytes durable."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())


def _sync_files(paths: list[Path]) -> None:
    """Make the bytes of files durable, together: a disk takes little longer over many than over one."""
    with ThreadPoolExecutor(_SYNCED_AT_ONCE) as disk:
        list(disk.map(sync_file, paths))  # an error of any is raised


def write_durably(path: Path, data: bytes) -> None:
    """Write a new file; after return its bytes survive a power cut."""
    with path.open("xb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def rename_durably(source: Path, target: Path) -> None:
    """Rename within one folder; after return the new name survives a power cut."""
    source.rename(target)
    sync_folder(target.parent)


def partial_path(path: Path) -> Path:
    """Return the name beside a file or folder under which it is written before it takes its place.

    Raises
    ------
    StorageError
        If the path ends in no name, as "." does.
    """
    if not path.name:
        raise StorageError(f"{path}: has no name of its own; give the name of what is to be written")
    return path.with_name(f".{path.name}.partial")


@contextmanager
def written_whole(path: Path, remedy: str) -> Iterator[Path]:
    """Give the name to write a file under; all being well it then takes its place, durably, and else goes.

    Raises
    ------
    StorageError
        If it cannot be written; with the remedy.
    """
    with storage_errors(path, remedy):
        partial = partial_path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield partial
            sync_file(partial)
            rename_durably(partial, path)
        finally:
            partial.unlink(missing_ok=True)


def replace_durably(path: Path, data: bytes) -> None:
    """Write a file in place of one of before, whole or not at all; after return it survives a power cut."""
    partial = partial_path(path)
    partial.unlink(missing_ok=True)
    write_durably(partial, data)
    rename_durably(partial, path)


def write_folder_whole(
    folder: Path,
    write: Callable[[Path], object],
    *,
    marker: str,
    keep_if: Callable[[Path, Path], bool] | None = None,
) -> Path | None:
    """Write a folder of results, replacing one of before: whole or not at all.

    Everything is written beside the folder first, synced, and then renamed: a kill at any moment leaves the
    old folder, or none, or the new one, never a part.

    Parameters
    ----------
    folder : Path
    write : callable
        Gets the folder to write into.
    marker : str
        Name of a file that every such folder holds: a folder without it is somebody else's.
    keep_if : callable, optional
        Tells of the new folder and the one of before whether the latter is to be kept, beside the new one as
        ``<folder>_1``, then ``_2``. Where it need not be, files that only it holds move into the new one.

    Returns
    -------
    kept : Path or None
        Where the folder of before is now; `None` where there was none, or it was not to be kept.

    Raises
    ------
    StorageError
        If the folder exists and is somebody else's, or cannot be written.
    """
    partial = partial_path(folder)
    previous = folder.with_name(f".{folder.name}.previous")
    with storage_errors(folder, "Results cannot be written; make room, or choose another folder"):
        if folder.exists() and not (folder / marker).is_file():
            raise StorageError(f"{folder} exists and holds no {marker}; it is left alone. Move it away")
        if previous.exists() and not folder.exists():  # killed between the two renames below
            previous.rename(folder)
        for leftover in (partial, previous):
            if leftover.exists():
                shutil.rmtree(leftover)
        partial.mkdir(parents=True)
        try:
            write(partial)
        except OSError:  # of a full disk, perhaps: the part takes room, and is good for nothing
            shutil.rmtree(partial, ignore_errors=True)
            raise
        is_kept = folder.exists() and keep_if is not None and keep_if(partial, folder)
        if folder.exists() and keep_if is not None and not is_kept:
            for path in folder.iterdir():
                if path.is_file() and not (partial / path.name).exists():
                    shutil.copy2(path, partial / path.name)
        _sync_files(sorted(partial.iterdir()))
        sync_folder(partial)
        kept = _next_beside(folder) if is_kept else None
        if folder.exists():
            folder.rename(kept or previous)
        partial.rename(folder)
        sync_folder(folder.parent)
        if previous.exists():
            shutil.rmtree(previous)
    return kept


def kept_beside(folder: Path, *, marker: str) -> list[Path]:
    """Return the folders of before that `write_folder_whole` has kept, the oldest first."""
    return [path for _, path in _beside(folder) if (path / marker).is_file()]


def _beside(folder: Path) -> list[tuple[int, Path]]:
    name = re.compile(re.escape(folder.name) + r"_([1-9][0-9]*)")
    there = folder.parent.iterdir() if folder.parent.is_dir() else ()
    return sorted((int(match[1]), path) for path in there if (match := name.fullmatch(path.name)))


def _next_beside(folder: Path) -> Path:
    taken = _beside(folder)
    return folder.with_name(f"{folder.name}_{taken[-1][0] + 1 if taken else 1}")


def require_writable(folder: Path, remedy: str) -> None:
    """Make sure, before long work, that its results can be put into a folder, which need not exist yet.

    Raises
    ------
    StorageError
        If the folder, or the nearest one above it that exists, is none or cannot be written; with the remedy.
    """
    there = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise StorageError(f"{there}: is a file, where a folder is expected. {remedy}")
    if not os.access(there, os.W_OK | os.X_OK):  # asks the file system too, which may be mounted read-only
        raise StorageError(f"{there}: cannot be written. {remedy}")


@contextmanager
def storage_errors(path: Path, remedy: str) -> Iterator[None]:
    """Turn an `OSError` of the disk into a `StorageError` that names the path and the remedy."""
    try:
        yield
    except BricktrackError:  # a TransferError is an OSError too
        raise
    except OSError as e:
        what = "no space left" if e.errno in _FULL else (e.strerror or str(e))
        raise StorageError(f"{path}: {what}. {remedy}") from e
