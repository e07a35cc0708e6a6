"""Files and folders that are on the disk when a function returns, and disk errors in words."""

import errno
import os
from collections.abc import Iterator
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
