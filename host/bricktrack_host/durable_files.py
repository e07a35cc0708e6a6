"""Files and folders that are on the disk when a function returns, and disk errors in words."""

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bricktrack_common.errors import BricktrackError, StorageError

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


def write_folder_whole(folder: Path, write: Callable[[Path], None], *, marker: str) -> None:
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

    Raises
    ------
    StorageError
        If the folder exists and is somebody else's, or cannot be written.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    previous = folder.with_name(f".{folder.name}.previous")
    if folder.exists() and not (folder / marker).is_file():
        raise StorageError(f"{folder} exists and holds no {marker}; it is left alone. Move it away")
    with storage_errors(folder, "Results cannot be written; make room, or choose another folder"):
        for leftover in (partial, previous):
            if leftover.exists():
                shutil.rmtree(leftover)
        partial.mkdir(parents=True)
        write(partial)
        for path in sorted(partial.iterdir()):
            sync_file(path)
        sync_folder(partial)
        if folder.exists():
            folder.rename(previous)
        partial.rename(folder)
        sync_folder(folder.parent)
        if previous.exists():
            shutil.rmtree(previous)


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
