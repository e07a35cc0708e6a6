"""One command at a time on a run: two that write the same results would spoil each other's."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bricktrack_common.errors import ConfigError


@contextmanager
def alone_with(folder: Path) -> Iterator[None]:
    """Hold a folder while the block runs; the system lets go of it whenever and however this process ends.

    Where the file system has no such locks, as some network shares, nothing is held.

    Raises
    ------
    ConfigError
        If another process holds it.
    """
    if not folder.is_dir():  # what is wrong with it is said by whoever reads it
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"{folder} is being processed by another command. Wait for that one, or end it"
            ) from None
        except OSError:
            pass
        yield
    finally:
        os.close(handle)
