import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import pytest
from recorder_bench import MakeBench

from bricktrack_common.run_folder import read_run
from bricktrack_common.wire_messages import Disarmed, Refusal
from bricktrack_device.capture import run_cycle
from bricktrack_device.storage.disk import Disk


class FillableDisk(Disk):
    """A card that is full while `is_full`."""

    def __init__(self) -> None:
        self.is_full = False

    def write_file(self, path: Path, fill: Callable[[BinaryIO], object]) -> None:
        if self.is_full and path.name == "video.h264":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write_file(path, fill)

    def free_bytes(self, folder: Path) -> int:
        return 0 if self.is_full else 10**12


def test_a_full_card_ends_in_fault_with_a_reason_and_the_run_is_saved_once_there_is_space(
    bench: MakeBench, tmp_path: Path
) -> None:
    disk = FillableDisk()
    b = bench(disk=disk)
    armed = b.arm()
    disk.is_full = True
    b.rig.pulse()
    b.wait_for("fault")
    assert "video.h264" in b.recorder.status().reason and "kept in memory" in b.recorder.status().reason
    partial = tmp_path / "runs" / f"{armed.run_id}.partial"
    assert (partial / "frames.msgpack").stat().st_size > 0  # what fitted stays
    reply = b.ask("arm", "", None)
    assert isinstance(reply, Refusal) and reply.code == "wrong-state" and "fault" in reply.message
    reply = b.ask("disarm")
    assert isinstance(reply, Refusal) and reply.code == "no-space" and armed.run_id in reply.message
    disk.is_full = False
    assert isinstance(b.ask("disarm"), Disarmed)
    assert b.recorder.state == "idle"
    run = read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True)
    assert run.manifest.state == "complete" and run.frames is not None and run.video is not None


def test_a_run_kept_in_memory_is_saved_by_itself_when_space_comes_back(
    bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_cycle, "_RETRY_S", 0.1)
    disk = FillableDisk()
    b = bench(disk=disk)
    armed = b.arm()
    disk.is_full = True
    b.rig.pulse()
    b.wait_for("fault")
    disk.is_full = False
    b.wait_for("idle")
    assert read_run(tmp_path / "runs" / armed.run_id, verify_hashes=True).problems == []
