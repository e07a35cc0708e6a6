"""The files that hosts read from just now, kept open between chunks."""

import os
import threading
from pathlib import Path

_MAX_OPEN = 8


class OpenFiles:
    """The last few files of a folder of runs that were read from. Safe from any thread.

    Parameters
    ----------
    runs : Path
    """

    def __init__(self, runs: Path) -> None:
        self._runs = runs
        self._lock = threading.Lock()
        self._descriptors: dict[tuple[str, str], int] = {}

    def read(self, run_id: str, name: str, *, offset: int, length: int) -> bytes:
        """Return ``length`` bytes of a run's file from ``offset``; raise `OSError` where the card fails.

        They are not mapped into memory: there a failing card would be the end of the process.
        """
        with self._lock:
            return os.pread(self._descriptor((run_id, name)), length, offset)

    def close(self, run_id: str | None = None) -> None:
        """Close the files of one run, or all."""
        with self._lock:
            for key in [k for k in self._descriptors if run_id in (None, k[0])]:
                os.close(self._descriptors.pop(key))

    def _descriptor(self, key: tuple[str, str]) -> int:
        found = self._descriptors.pop(key, None)
        if found is None:
            found = os.open(self._runs.joinpath(*key), os.O_RDONLY)
        self._descriptors[key] = found  # the newest comes last
        if len(self._descriptors) > _MAX_OPEN:
            os.close(self._descriptors.pop(next(iter(self._descriptors))))
        return found
