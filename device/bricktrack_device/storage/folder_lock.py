"""A folder that belongs to one process at a time, also where nothing can be written."""

import fcntl
import os
import weakref
from pathlib import Path


class FolderLock:
    """Held from the beginning until `release`, or until the process ends, however it ends.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    BlockingIOError
        If another one holds it.
    OSError
        If there is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        self._close = weakref.finalize(self, os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BaseException:
            self._close()
            raise

    def release(self) -> None:
        """Let others have it. Calling it twice does no harm."""
        self._close()
