"""The card: is there room for a run, and how fast does it take one."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.errors import StorageError
from bricktrack_device.capture.black_box import black_box_folder, lack_of_room
from bricktrack_device.config import DeviceConfig
from bricktrack_device.health.findings import CheckResult, failure, good, warning
from bricktrack_device.storage.run_store import RunStore

SPEED_TEST_BYTES = 16 << 20
MAX_SAVING_S = 60.0
"""The daemon's watchdog waits so long for one run to be saved."""
_PIECE_BYTES = 1 << 20


def check_space(config: DeviceConfig, *, folder: Path | None = None) -> list[CheckResult]:
    """See that a run fits; raises `StorageError` where the folder cannot be had."""
    store = RunStore(folder or config.storage_folder, config.unit.name)
    needed = 2 * config.video_bytes() + config.storage.margin_mb * 1_000_000
    free = store.free_bytes()
    words = f"{free / 1e6:.0f} MB free in {store.folder}, {needed / 1e6:.0f} MB needed for a run"
    if free < needed:
        remedy = "Pull runs and make room, or set storage.folder or storage.margin_mb"
        return [failure("storage", words, remedy)]
    words += f"; {store.count_runs()} runs"
    if free < 5 * needed:
        return [warning("storage", f"{words}. That is room for few", "Pull runs and make room")]
    return [good("storage", words)]


def check_black_box(config: DeviceConfig) -> list[CheckResult]:
    """See that a copy of a run fits into memory, if one is to be kept; raise `OSError` where that fails."""
    folder = black_box_folder(config)
    if folder is None:
        return []
    there = next(p for p in (folder, *folder.parents) if p.is_dir())  # it is made with the first run
    problem = lack_of_room(there, config.video_bytes())
    if problem:
        return [warning("black box", problem, "Free memory, or lower camera.bitrate_bps or the duration")]
    return [good("black box", f"a run is also kept in {folder} until it is on the card")]


def write_speed_bps(
    folder: Path, *, n_bytes: int | None = None, clock: Callable[[], int] = monotonic_ns
) -> float:
    """Return how many bytes a second reach the card, synced; the file that is written is taken away.

    Raises
    ------
    StorageError
        If it cannot be written.
    """
    n_bytes = SPEED_TEST_BYTES if n_bytes is None else n_bytes
    path = folder / f".speed-{os.getpid()}-{time.monotonic_ns()}"
    piece = os.urandom(_PIECE_BYTES)
    try:
        start_ns = clock()
        try:
            with path.open("xb", buffering=0) as file:
                for done in range(0, n_bytes, _PIECE_BYTES):
                    file.write(piece[: n_bytes - done])
                os.fsync(file.fileno())
            return n_bytes / ((clock() - start_ns) * 1e-9)
        finally:
            path.unlink(missing_ok=True)
    except OSError as e:
        raise StorageError(
            f"{folder}: cannot write there: {e.strerror}. Check storage.folder and its owner"
        ) from e


def check_speed(config: DeviceConfig, speed_bps: float) -> list[CheckResult]:
    """Judge the card's speed by how long a run takes to be saved."""
    saving_s = config.video_bytes() / speed_bps
    words = f"{speed_bps / 1e6:.1f} MB/s synced; a run's video takes {saving_s:.1f} s to save"
    remedy = "Use a faster card (class A1 or better), or lower camera.bitrate_bps or recording.duration_s"
    if saving_s > MAX_SAVING_S:
        return [failure("storage speed", f"{words}; the watchdog waits {MAX_SAVING_S:g} s", remedy)]
    if saving_s > config.span_s():
        return [warning("storage speed", f"{words}, longer than to record it", remedy)]
    return [good("storage speed", words)]
