"""How many runs this machine has processors and memory for."""

import os
import sys
from collections.abc import Iterable
from pathlib import Path

_RUN_MEMORY_MB = 480
_RUN_MEMORY_MB_PER_S = 0.2 if sys.platform == "linux" else 2.0
"""More than simulated runs of 1080p took from reading to the report (``scripts/bench_memory.py``): 333 MB at
16 s, 441 MB at 600 s. On other systems large arrays lie in memory (`scratch_arrays`): half an hour took
2744 MB, its lights found before."""
_MEMORY_SHARE = 0.8
_CGROUP = Path("/sys/fs/cgroup")


def run_memory_mb(recorded_s: float) -> float:
    """Return what processing a recording of this length takes at most, modules included."""
    return _RUN_MEMORY_MB + _RUN_MEMORY_MB_PER_S * recorded_s


def default_workers(recorded_s: Iterable[float]) -> int:
    """Return how many of these recordings to process at once.

    As many as there are processors, and as the memory holds even if the longest meet.

    Parameters
    ----------
    recorded_s : iterable of float, s
        The length of each.
    """
    longest_first = sorted(recorded_s, reverse=True)[: usable_processors()]
    available_mb = available_memory_mb()
    if available_mb is None:
        return max(len(longest_first), 1)
    left_mb = _MEMORY_SHARE * available_mb
    n_workers = 0
    for length_s in longest_first:
        left_mb -= run_memory_mb(length_s)
        if left_mb < 0:
            break
        n_workers += 1
    return max(n_workers, 1)


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
