"""The manifest of a run whose saving was cut off: what was drafted, and what the files themselves say."""

from pathlib import Path

import msgspec

from bricktrack_common.errors import RunFormatError
from bricktrack_common.frame_times import read_frames
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
from bricktrack_device.run_store import DRAFT_NAME


def rebuild_manifest(folder: Path, run_id: str, unit: str) -> RunManifest:
    """Return a manifest, still without files, over what a partial folder holds.

    The draft that was written first gives camera, clocks and trigger; without it the streams' own headers
    must do, and the manifest says so.
    """
    missing = ["saving was cut off before it was done; what had reached the card is here"]
    try:
        manifest = read_manifest(folder / DRAFT_NAME)
    except RunFormatError:
        missing.append("the run's description was lost: camera settings, clocks and window are unknown")
        manifest = RunManifest(
            run_id=run_id, unit=unit, label="", state="interrupted", simulated=False, origin="bricktrackd",
            hardware={}, software={}, camera=None, imus=[], trigger=TriggerSection(pin="unknown", t0_ns=None),
            clocks=ClocksSection(), window_ns=None, quality=QualitySection(), missing=[], files=[],
        )  # fmt: skip
        manifest = _from_streams(folder, manifest, missing)
    missing += _words_of_absent_files(folder, manifest)
    return msgspec.structs.replace(manifest, state="interrupted", missing=manifest.missing + missing)


def _from_streams(folder: Path, manifest: RunManifest, missing: list[str]) -> RunManifest:
    imus: list[ImuDescription] = []
    for path in sorted(folder.glob("imu_*.msgpack")):
        try:
            imus.append(read_imu(path)[0])
        except RunFormatError as e:
            missing.append(str(e))
    t0_ns = None
    if (folder / EDGES_NAME).exists():
        try:
            edges_ns, _ = read_edges(folder / EDGES_NAME)
            t0_ns = int(edges_ns[0]) if edges_ns.size else None
        except RunFormatError as e:
            missing.append(str(e))
    trigger = TriggerSection(pin="unknown", t0_ns=t0_ns)
    return msgspec.structs.replace(manifest, imus=imus, trigger=trigger)


def _words_of_absent_files(folder: Path, manifest: RunManifest) -> list[str]:
    words = [
        f"imu_{imu.name}.msgpack did not reach the card"
        for imu in manifest.imus
        if not (folder / f"imu_{imu.name}.msgpack").exists()
    ]
    video, frames = folder / VIDEO_NAME, folder / FRAMES_NAME
    if not video.exists():
        words.append(f"{VIDEO_NAME} did not reach the card")
    if not frames.exists():
        words.append(f"{FRAMES_NAME} did not reach the card")
    elif video.exists():
        try:
            times = read_frames(frames)
        except RunFormatError as e:
            return [*words, str(e)]
        ends = times.byte_offset + times.n_bytes
        whole = int((ends <= video.stat().st_size).sum())
        if whole < times.n_frames:
            words.append(f"{VIDEO_NAME} is cut: {whole} of {times.n_frames} pictures are whole")
    return words
