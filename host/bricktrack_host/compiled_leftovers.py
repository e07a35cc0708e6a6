"""Compiled code that nothing uses any more: every change of a loop leaves the old one in the user's cache."""

import re
import shutil
import time
from pathlib import Path

from bricktrack_host.compiled import COMPILED_ROOT

UNUSED_S = 90 * 86_400
_FOLDER = re.compile(r"[0-9a-f]{16}")  # as `compiled` names them; anything else is somebody else's


def remove_unused_code(root: Path = COMPILED_ROOT, *, now_s: float | None = None) -> int:
    """Remove folders of compiled code that was neither written nor read for `UNUSED_S`; return how many.

    Where the disk notes no reading, code goes so long after it was written, and is compiled once more. What
    cannot be removed stays.
    """
    before_s = (time.time() if now_s is None else now_s) - UNUSED_S
    n_removed = 0
    for folder in root.iterdir() if root.is_dir() else ():
        if _FOLDER.fullmatch(folder.name) and folder.is_dir() and _last_used_s(folder) < before_s:
            shutil.rmtree(folder, ignore_errors=True)
            n_removed += not folder.exists()
    return n_removed


def _last_used_s(folder: Path) -> float:
    """Return when a file of a folder was last written or read, s since 1970; now where nobody can tell."""
    try:
        stats = [path.stat() for path in (folder, *folder.rglob("*"))]
    except OSError:  # another process is at it
        return time.time()
    return max(max(s.st_mtime, s.st_atime) if i else s.st_mtime for i, s in enumerate(stats))
