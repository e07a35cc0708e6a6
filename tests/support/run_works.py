"""Works for processes of their own, which cannot import the tests themselves."""

import os
import signal
import time

from bricktrack_common.errors import TrackingError


def work(kind, progress):
    progress.stage("decode", 200)
    for i in range(1, 201):
        progress.advance_to(i)
    if kind == "lost":
        raise TrackingError("none of 5 frames gave a pose")
    if kind == "bug":
        raise ZeroDivisionError("of mine")
    if kind == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    return kind * 2


def together(folder, number, progress):
    """Wait until another work runs too: returns only if two run at once."""
    (folder / str(number)).touch()
    deadline = time.monotonic() + 20
    while len(list(folder.iterdir())) < 2:
        if time.monotonic() > deadline:
            raise TrackingError("alone")
        time.sleep(0.01)
    return os.getpid()


def half_written(folder, progress):
    partial_file = folder / "part"
    partial_file.touch()
    try:
        progress.stage("write", None)
        time.sleep(60)
    finally:
        partial_file.unlink()


def dies_once(note, progress):
    """Be killed the first time, as by a system out of memory."""
    if not note.exists():
        note.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "done at last"


def stays(note, progress):
    note.write_text(str(os.getpid()))
    time.sleep(60)


def dies(progress):
    os.kill(os.getpid(), signal.SIGKILL)
