"""Compiled code that nothing uses any more: every change of a loop leaves the old one in the user's cache."""

import os
import re
import shutil
import time
from pathlib import Path

from bricktrack_host.compiled import COMPILED_ROOT

UNUSED_S = 90 * 86_400
LOOK_AGAIN_S = 7 * 86_400
"""A folder of many versions takes seconds to look through."""
_LOOKED = "looked_through"
_FOLDER = re.compile(r"[0-9a-f]{16}")  # as `compiled` names them; anything else is somebody else's


def remove_unused_code(root: Path = COMPILED_ROOT, *, now_s: float | None = None) -> int:
    """Remove folders of compiled code that was neither written nor read for `UNUSED_S`; return how many.

    The folders are looked through every `LOOK_AGAIN_S`. Where the disk notes no reading, code goes so long
    after it was written, and is compiled once more. What cannot be removed stays.
    """
    now_s = time.time() if now_s is None else now_s
    if not root.is_dir() or not _is_time(root / _LOOKED, now_s):
        return 0
    n_removed = 0
    for folder in root.iterdir():
        if _FOLDER.fullmatch(folder.name) and folder.is_dir() and _last_used_s(folder) < now_s - UNUSED_S:
            shutil.rmtree(folder, ignore_errors=True)
            n_removed += not folder.exists()
    return n_removed


def _is_time(looked: Path, now_s: float) -> bool:
    """Tell whether the folders were last looked through long ago, and note that they are now."""
    try:
        if looked.exists() and abs(now_s - looked.stat().st_mtime) < LOOK_AGAIN_S:
            return False
        looked.touch()
        os.utime(looked, (now_s, now_s))
    except OSError:  # a folder that cannot be written holds nothing of ours to remove
        return False
    return True


def _last_used_s(folder: Path) -> float:
    """Return when a file of a folder was last written or read, s since 1970; now where nobody can tell."""
    try:
        stats = [path.stat() for path in (folder, *folder.rglob("*"))]
    except OSError:  # another process is at it
        return time.time()
    return max(max(s.st_mtime, s.st_atime) if i else s.st_mtime for i, s in enumerate(stats))
