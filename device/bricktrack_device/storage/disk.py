"""The few file operations that make a write survive a power cut, and what their failures are called."""

import errno
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from bricktrack_common.errors import StorageError


class Disk:
    """The few file operations that make a write survive a power cut; replaced in tests that cut it."""

    def make_folder(self, folder: Path) -> None:
        """Make a folder that must not exist, durably."""
        folder.mkdir()
        self.sync_folder(folder.parent)

    def write_file(self, path: Path, fill: Callable[[BinaryIO], object]) -> None:
        """Write a file with ``fill`` and make its contents durable."""
        with path.open("wb") as file:
            fill(file)
            file.flush()
            os.fsync(file.fileno())

    def replace_file(self, path: Path, data: bytes) -> None:
        """Give a small file new contents, durably: after a power cut it holds the old ones or the new."""
        temporary = path.with_suffix(".tmp")
        self.write_file(temporary, lambda file: file.write(data))
        self.rename(temporary, path)

    def sync_file(self, path: Path) -> None:
        """Make the contents of a file that others wrote durable."""
        with path.open("rb") as file:
            os.fsync(file.fileno())

    def sync_folder(self, folder: Path) -> None:
        """Make the names in a folder durable."""
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def rename(self, old: Path, new: Path) -> None:
        """Give a file or folder its final name, durably."""
        old.rename(new)
        self.sync_folder(new.parent)

    def free_bytes(self, folder: Path) -> int:
        """Return how much an ordinary user may still write."""
        return shutil.disk_usage(folder).free


def storage_error(what: str, error: OSError) -> StorageError:
    """Return a failed file operation in words, with its errno and what to do about a full card."""
    remedy = ". Make room on the card" if error.errno == errno.ENOSPC else ""
    storage_error = StorageError(f"{what}: {error.strerror or error}{remedy}")
    storage_error.errno = error.errno
    return storage_error
