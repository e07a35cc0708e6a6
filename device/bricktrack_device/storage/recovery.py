"""The manifest of a run whose saving was cut off: what was drafted, and what the files themselves say."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import msgspec

from bricktrack_common.errors import RunFormatError
from bricktrack_common.frame_times import FrameTimes, read_frames
from bricktrack_common.imu_records import ImuDescription, read_imu
from bricktrack_common.run_folder import read_edges
from bricktrack_common.run_manifest import (
    EDGES_NAME,
    FRAMES_NAME,
    VIDEO_NAME,
    ClocksSection,
    QualitySection,
    RunManifest,
    TriggerSection,
    read_manifest,
)
from bricktrack_device.storage.run_writer import DRAFT_NAME

logger = logging.getLogger(__name__)

DAMAGED_SUFFIX = ".damaged"

T = TypeVar("T")


def rebuild_manifest(folder: Path, run_id: str, unit: str) -> RunManifest:
    """Return a manifest, still without files, over what a partial folder holds.

    The draft that was written first gives camera, clocks and trigger; without it the streams' own headers
    must do, and the manifest says so. A stream that cannot be read is renamed, so that it stands in nobody's
    way and is still there.
    """
    missing = ["saving was cut off before it was done; what had reached the card is here"]
    imus: list[ImuDescription] = []
    t0_ns: int | None = None
    for path in sorted(folder.glob("imu_*.msgpack")):
        read = _read_or_set_aside(path, read_imu, missing)
        if read is not None:
            imus.append(read[0])
    if (edges := _read_or_set_aside(folder / EDGES_NAME, read_edges, missing)) is not None:
        t0_ns = int(edges[0][0]) if edges[0].size else None
    frames = _read_or_set_aside(folder / FRAMES_NAME, read_frames, missing)
    try:
        manifest = read_manifest(folder / DRAFT_NAME)
    except RunFormatError:
        missing.append("the run's description was lost: camera settings, clocks and window are unknown")
        manifest = RunManifest(
            run_id=run_id, unit=unit, label="", state="interrupted", simulated=False, origin="bricktrackd",
            hardware={}, software={}, camera=None, imus=imus,
            trigger=TriggerSection(pin="unknown", t0_ns=t0_ns), clocks=ClocksSection(), window_ns=None,
            quality=QualitySection(), missing=[], files=[],
        )  # fmt: skip
    missing += _words_of_absent_files(folder, manifest, frames)
    return msgspec.structs.replace(manifest, state="interrupted", missing=manifest.missing + missing)


def _read_or_set_aside(path: Path, read: Callable[[Path], T], missing: list[str]) -> T | None:
    if not path.exists():
        return None
    try:
        return read(path)
    except RunFormatError as e:
        aside = path.with_name(path.name + DAMAGED_SUFFIX)
        path.rename(aside)
        logger.warning("%s; kept as %s", e, aside.name)
        missing.append(f"{path.name} cannot be read and is kept as {aside.name}")
        return None


def _words_of_absent_files(folder: Path, manifest: RunManifest, frames: FrameTimes | None) -> list[str]:
    words = [
        f"imu_{imu.name}.msgpack did not reach the card"
        for imu in manifest.imus
        if not (folder / f"imu_{imu.name}.msgpack").exists()
    ]
    if not (folder / EDGES_NAME).exists():
        words.append(f"{EDGES_NAME} did not reach the card")
    video = folder / VIDEO_NAME
    if not video.exists():
        words.append(f"{VIDEO_NAME} did not reach the card")
    if frames is None:
        words.append(f"{FRAMES_NAME} did not reach the card")
    elif video.exists():
        ends = frames.byte_offset + frames.n_bytes
        whole = int((ends <= video.stat().st_size).sum())
        if whole < frames.n_frames:
            words.append(f"{VIDEO_NAME} is cut: {whole} of {frames.n_frames} pictures are whole")
    return words
