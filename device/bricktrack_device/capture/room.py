"""What a run needs of the card and of memory, looked at before arming."""

from pathlib import Path

from bricktrack_device.capture.ring import RING_SLACK_S
from bricktrack_device.config import DeviceConfig
from bricktrack_device.refusals import RequestRefusedError
from bricktrack_device.storage.run_store import RunStore

MEMORY_MARGIN = 1.3
"""Times the video that is held: the run is cut out of it by reference, not copied."""
_MEMINFO = Path("/proc/meminfo")


def disk_needed_bytes(config: DeviceConfig, duration_s: float | None = None) -> int:
    """Return what must be free on the card: twice the video of a run, and the configured margin."""
    return 2 * config.video_bytes(duration_s) + config.storage.margin_mb * 1_000_000


def check_room(config: DeviceConfig, store: RunStore, duration_s: float) -> None:
    """Make sure that a run of ``duration_s`` fits.

    Raises
    ------
    RequestRefusedError
        If the card or the memory has too little room.
    """
    needed, free = disk_needed_bytes(config, duration_s), store.free_bytes()
    if free < needed:
        raise RequestRefusedError(
            "no-space",
            f"{free / 1e6:.0f} MB are free in {store.folder}; a run of {duration_s:g} s needs "
            f"{needed / 1e6:.0f} MB (twice its video and a margin). Make room there",
        )
    held = config.video_bytes(duration_s + RING_SLACK_S)
    available = memory_available_bytes()
    if available is not None and available < MEMORY_MARGIN * held:
        raise RequestRefusedError(
            "not-ready",
            f"{available / 1e6:.0f} MB of memory are available; a run of {duration_s:g} s at "
            f"{config.camera.bitrate_bps / 1e6:g} Mbit/s needs {MEMORY_MARGIN * held / 1e6:.0f} MB. Record "
            "for a shorter time or lower camera.bitrate_bps",
        )


def memory_available_bytes() -> int | None:
    """Return what the kernel says can be had without swapping, or `None` where it does not say."""
    try:
        for line in _MEMINFO.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except (OSError, ValueError):
        return None
    return None
