"""A small recording, a card that fails at a chosen step, and the runs that are saved on it."""

import errno
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from bricktrack_common.camera_model import IMX219_1080P
from bricktrack_common.frame_times import FrameRecord
from bricktrack_common.imu_records import ImuDescription, ImuRecord
from bricktrack_common.run_manifest import (
    CameraSection,
    ClocksSection,
    WaveSection,
)
from bricktrack_device.capture.recording import ImuRecording, Recording, RunLog
from bricktrack_device.capture.ring import VideoCut
from bricktrack_device.capture.saving import save
from bricktrack_device.capture.trigger import EdgeTrain
from bricktrack_device.interfaces import EncodedPacket
from bricktrack_device.storage.disk import Disk
from bricktrack_device.storage.run_store import RunStore

T0 = 5_000_000_000
BOOT = "b3f2a7d0-0000-0000-0000-000000000000"
N_FRAMES = 12


class PowerCut(BaseException):
    """The process is gone: nobody catches this."""


class CutDisk(Disk):
    """Counts operations and fails at the n-th, before it, or half-way through a file."""

    def __init__(self, fail_at: int | None = None, error: Callable[[], BaseException] = PowerCut) -> None:
        self.n = 0
        self.fail_at = fail_at
        self.error = error
        self.half_way = False

    def _step(self) -> None:
        self.n += 1
        if self.n == self.fail_at:
            raise self.error()

    def make_folder(self, folder: Path) -> None:
        self._step()
        super().make_folder(folder)

    def write_file(self, path: Path, fill: Callable[[BinaryIO], object]) -> None:
        self._step()
        if self.n + 1 == self.fail_at and self.half_way:
            super().write_file(path, fill)
            os.truncate(path, path.stat().st_size // 2)
            raise self.error()
        super().write_file(path, fill)

    def sync_file(self, path: Path) -> None:
        self._step()
        super().sync_file(path)

    def sync_folder(self, folder: Path) -> None:
        self._step()
        super().sync_folder(folder)

    def rename(self, old: Path, new: Path) -> None:
        self._step()
        super().rename(old, new)


def full_disk() -> OSError:
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def recording(run_id: str) -> Recording:
    packets = [EncodedPacket(T0 // 1000 + i * 33_333, i % 4 == 0, bytes([i]) * 100) for i in range(N_FRAMES)]
    frames = [
        FrameRecord(i * 33_333, T0 + i * 33_333_000, 2000, 1.0, i % 4 == 0, 100 * i, 100, 0)
        for i in range(N_FRAMES)
    ]
    description = ImuDescription(
        name="brick", chip_id="", bus="a", address=0x28, opr_mode=7, fusion=False, acc_range_g=16.0,
        period_ns=10_000_000, t0_ns=T0,
    )  # fmt: skip
    samples = [
        ImuRecord(i, T0 + i * 10_000_000, T0 + i * 10_000_000 + 1_000_000, bytes([i + 1]) * 46, 0, None)
        for i in range(20)
    ]
    camera = CameraSection(
        model="fake", mode=IMX219_1080P, exposure_us=2000, analogue_gain=1.0, colour_gains=(1.0, 1.0),
        frame_duration_us=33_333, encoder="none", encoder_settings={},
    )  # fmt: skip
    log = RunLog()
    log.add("armed")
    return Recording(
        run_id=run_id, unit="unit-1", label="", state="complete", simulated=True, hardware={}, camera=camera,
        video=VideoCut(packets, frames, 0, 0, []), imus=[ImuRecording(description, samples, 20)],
        trigger_pin="GPIO17", nominal_hz=None, edges=EdgeTrain(T0, [T0, T0 + 20_000_000], 0, []), wave=WaveSection(),
        clocks=ClocksSection(), window_ns=(T0, T0 + 400_000_000), missing=[], log=log,
    )  # fmt: skip


def write_truth(folder: Path) -> Path:
    path = folder / "truth.npz"
    path.write_bytes(b"truth")
    return path


def store_in(folder: Path, disk: Disk | None = None) -> RunStore:
    return RunStore(folder, "unit-1", disk=disk, boot_id=BOOT)


def save_one(store: RunStore, label: str = "") -> str:
    run_id = store.new_run_id(label)
    save(recording(run_id), store.open_writer(run_id), write_truth)
    return run_id


def n_steps_of_a_save(folder: Path) -> int:
    disk = CutDisk()
    store = store_in(folder, disk)
    run_id = store.new_run_id("")
    disk.n = 0
    save(recording(run_id), store.open_writer(run_id), write_truth)
    return disk.n


def confirmed_run(store: RunStore) -> str:
    run_id = store.new_run_id("")
    save(recording(run_id), store.open_writer(run_id), lambda folder: None)
    store.confirm(run_id, [f.sha256 for f in store.describe(run_id).files])
    return run_id
