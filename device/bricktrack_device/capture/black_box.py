"""A copy of the run under way that outlives the daemon: files in memory, which belong to the system.

Nothing is written to the card while a run is recorded. A daemon that is killed, crashes or hangs meanwhile
would take the run with it; what is here is brought to the card at its next start (`storage.recovery`).
"""

import errno
import logging
import os
import shutil
import time
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

from bricktrack_common.run_manifest import VIDEO_NAME
from bricktrack_common.typed_data import dump_json
from bricktrack_device.capture.recording import Recording
from bricktrack_device.capture.room import memory_available_bytes
from bricktrack_device.capture.saving import build_manifest, streams
from bricktrack_device.config import DeviceConfig
from bricktrack_device.interfaces import EncodedPacket
from bricktrack_device.storage.folder_lock import FolderLock
from bricktrack_device.storage.recovery import recover_runs, waiting_copies
from bricktrack_device.storage.run_store import RunStore
from bricktrack_device.storage.run_writer import DRAFT_NAME

logger = logging.getLogger(__name__)

_EVERY_S = 1.0
_SHARE = 0.05
"""Of the recorder's time, at most: long runs are copied less often."""
_ROOM = 2.0
"""Times the run's video: so much memory must be free, or there is no copy."""
_OTHERS_BYTES = 16_000_000
"""Stays free: other services write to the same folder in memory."""


def black_box_folder(config: DeviceConfig) -> Path | None:
    """Return where copies are kept: as configured, else in systemd's runtime directory, else nowhere."""
    if config.storage.black_box:
        return Path(config.storage.black_box).expanduser().absolute()
    runtime = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    return Path(runtime) / "black-box" if runtime else None


def lack_of_room(folder: Path, video_bytes: int) -> str:
    """Return in words why there will be no copy of a run with so much video, or ``""``.

    Raises
    ------
    OSError
        If the folder does not tell.
    """
    free = min(shutil.disk_usage(folder).free, memory_available_bytes() or 0)
    wanted = max(_ROOM * video_bytes, video_bytes + _OTHERS_BYTES)
    if free >= wanted:
        return ""
    return (
        f"{free / 1e6:.0f} MB of memory are free for {folder}, {wanted / 1e6:.0f} MB are wanted. A daemon "
        "that is killed while it records would lose the run"
    )


class BlackBox:
    """Copies of runs, each in a folder named by it; nothing here raises, because the run itself goes on.

    Parameters
    ----------
    folder : Path or None
        In memory (tmpfs); `None` for no copies.
    """

    def __init__(self, folder: Path | None) -> None:
        self.folder = folder
        self._run: Path | None = None
        self._lock: FolderLock | None = None
        self._n_packets = 0
        self._first: list[EncodedPacket] = []
        self._due_s = 0.0

    @property
    def run_id(self) -> str:
        """Of which run there is a copy; ``""`` if there is none."""
        return "" if self._run is None else self._run.name

    def has(self, run_id: str) -> bool:
        """Tell whether there is anything in the copy of a run that a daemon left."""
        return self.folder is not None and (self.folder / run_id / DRAFT_NAME).exists()

    def bring_in(self, store: RunStore) -> None:
        """Put on the card what a daemon left that was killed; see `storage.recovery`."""
        self._let_go()
        if waiting_copies(self.folder):
            recover_runs(store, self.folder)

    def begin(self, run_id: str, video_bytes: int) -> None:
        """Copy this run from now on, if there is room for it in memory."""
        self._let_go()
        self._n_packets, self._due_s = 0, 0.0
        if self.folder is None:
            return
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            problem = lack_of_room(self.folder, video_bytes)
            run = self.folder / run_id
            if not problem:
                run.mkdir()
                self._lock = FolderLock(run)
        except OSError as e:
            problem = f"{self.folder}: {e.strerror or e}"
        if problem:
            logger.warning("%s: no copy in memory: %s", run_id, problem)
            return
        self._run = run

    def take_if_due(self, so_far: Callable[[], Recording]) -> None:
        """Copy the run as far as it got, if it is time to."""
        began = time.monotonic()
        if self._run is None or began < self._due_s:
            return
        self.take(so_far)
        now = time.monotonic()
        self._due_s = now + max(_EVERY_S, (now - began) / _SHARE)

    def take(self, recorded: Callable[[], Recording]) -> None:
        """Copy the run: what of its video is new, and all of its small streams."""
        if self._run is None:
            return
        try:
            self._write(self._run, recorded())
        except Exception as e:
            # Without strerror it is a bug, which must not reach the recorder either.
            logger.warning(
                "%s: its copy in memory ends: %s", self._run.name, e, exc_info=not isinstance(e, OSError)
            )
            self.forget()

    def forget(self) -> None:
        """Do away with the copy: the run is on the card, or there is no room for both."""
        if self._run is not None:
            shutil.rmtree(self._run, ignore_errors=True)
        self._let_go()

    def _let_go(self) -> None:
        """Write no more to the copy that there is; another daemon may have it from now on."""
        lock, self._run, self._lock = self._lock, None, None
        if lock is not None:
            lock.release()

    def _write(self, run: Path, recording: Recording) -> None:
        packets = [] if recording.video is None else recording.video.packets
        if self._n_packets and packets[:1] != self._first:
            # Cut from another keyframe on, as before the run's window had begun: the video begins anew, or
            # its pictures would not be where the frames' file says.
            (run / VIDEO_NAME).unlink()
            self._n_packets = 0
        _replace(run / DRAFT_NAME, dump_json(build_manifest(recording)))
        for name, fill in streams(recording):
            if name == VIDEO_NAME:
                continue
            contents = BytesIO()
            fill(contents)
            _replace(run / name, contents.getvalue())
        if packets:
            new = [p.data for p in packets[self._n_packets :]]
            # With a fixed quantiser, or in noise, a video grows beyond what its bit rate promised.
            if shutil.disk_usage(run).free - sum(map(len, new)) < _OTHERS_BYTES:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            with (run / VIDEO_NAME).open("ab") as file:
                file.writelines(new)
            self._n_packets, self._first = self._n_packets + len(new), packets[:1]


def _replace(path: Path, data: bytes) -> None:
    """Give a file new contents: a process that is killed leaves the old ones or the new."""
    temporary = path.with_name(f".{path.name}")  # no name of a run's file
    temporary.write_bytes(data)
    temporary.rename(path)
