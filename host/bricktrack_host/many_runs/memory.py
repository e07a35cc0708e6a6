"""How many runs this machine has processors and memory for."""

import os
from pathlib import Path

RUN_MEMORY_MB = 800
"""More than a run of 1080p and 45 s takes, simulated: 330 MB, and 9 MB a second for the smoother."""
_MEMORY_SHARE = 0.8
_CGROUP = Path("/sys/fs/cgroup")


def default_workers(n_runs: int) -> int:
    """Return how many runs to process at once: as many as there are processors and memory for."""
    at_most = min(n_runs, usable_processors())
    available_mb = available_memory_mb()
    if available_mb is not None:
        at_most = min(at_most, int(_MEMORY_SHARE * available_mb / RUN_MEMORY_MB))
    return max(at_most, 1)


def usable_processors() -> int:
    """Return how many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):  # Linux
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def available_memory_mb() -> float | None:
    """Return how much memory programs can still have, here and in this container; `None` if nobody says."""
    known = [mb for mb in (_system_memory_mb(), container_memory_mb(_CGROUP)) if mb is not None]
    return min(known, default=None)


def _system_memory_mb() -> float | None:
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    except OSError:  # not Linux
        return None
    kilobytes = next((line.split()[1] for line in lines if line.startswith("MemAvailable:")), None)
    return None if kilobytes is None else int(kilobytes) / 1024


def container_memory_mb(cgroup: Path) -> float | None:
    """Return what a control group (version 2) leaves of its limit; `None` where there is none.

    Pages of files that it holds but could give back count as free.
    """
    try:
        limit = (cgroup / "memory.max").read_text(encoding="ascii").strip()
        used = int((cgroup / "memory.current").read_text(encoding="ascii"))
        stat = dict(
            line.split() for line in (cgroup / "memory.stat").read_text(encoding="ascii").splitlines()
        )
    except (OSError, ValueError):
        return None
    if not limit.isdigit():  # "max": no limit
        return None
    return max(int(limit) - used + int(stat.get("inactive_file", 0)), 0) / 2**20
