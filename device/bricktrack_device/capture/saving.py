"""How a recording becomes a run folder: part by part, so that a bug in one costs no other."""

import platform
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib import metadata
from pathlib import Path
from typing import BinaryIO, TypeVar

import msgspec
import numpy as np

from bricktrack_common.errors import RunFormatError
from bricktrack_common.frame_times import write_frames
from bricktrack_common.imu_records import UNUSABLE, ImuFlag, write_imu
from bricktrack_common.run_folder import write_edges
from bricktrack_common.run_manifest import (
    EDGES_NAME,
    FRAMES_NAME,
    LOG_NAME,
    VIDEO_NAME,
    ClocksSection,
    QualitySection,
    RunManifest,
    TriggerSection,
    parse_manifest,
)
from bricktrack_common.typed_data import dump_json
from bricktrack_device.capture.part_by_part import unless_a_bug
from bricktrack_device.capture.recording import Recording
from bricktrack_device.storage.run_writer import RunWriter

_PACKAGES = (
    "bricktrack", "numpy", "pyzmq", "gpiozero", "adafruit-circuitpython-bno055", "lgpio", "picamera2", "av",
)  # fmt: skip
_CAN_BE_LEFT_OUT: dict[str, object] = {
    "quality": QualitySection(),
    "hardware": {},
    "software": {},
    "clocks": ClocksSection(),
    "camera": None,
}
"""Parts of a manifest, and what stands for one that cannot be written down."""

T = TypeVar("T")


def save(
    recording: Recording, writer: RunWriter, write_truth: Callable[[Path], Path | None]
) -> tuple[Path, RunManifest]:
    """Write a recording as a run folder: small streams first, the video, the manifest last.

    May be called again with the same ``writer`` after it failed: files already on the card stay. What a bug
    keeps from being written is left out, and named in the recording's ``missing``.

    Returns
    -------
    folder : Path
    manifest : RunManifest
        Without the files' list.

    Raises
    ------
    StorageError
        If the card is full or does not take a write; what was written stays.
    """
    manifest = build_manifest(recording)
    writer.begin(manifest)
    for name, fill in streams(recording):
        _unless_a_bug(recording, name, partial(writer.write, name, fill), None)
    _unless_a_bug(recording, "the true motion", lambda: writer.write_by_others(write_truth), None)
    manifest = msgspec.structs.replace(manifest, missing=list(recording.missing))
    return writer.finish(manifest), manifest


def streams(recording: Recording) -> Iterator[tuple[str, Callable[[BinaryIO], object]]]:
    """Yield the name of each file of a run, and what writes its contents."""
    for imu in recording.imus:
        yield (
            f"imu_{imu.description.name}.msgpack",
            partial(write_imu, description=imu.description, records=imu.records),
        )
    edges = np.array(recording.edges.edges_ns, dtype=np.int64)
    yield EDGES_NAME, lambda f: write_edges(f, edges)
    video = recording.video
    if video is not None and video.packets:
        yield FRAMES_NAME, lambda f: write_frames(f, video.records)
        yield VIDEO_NAME, lambda f: f.writelines(p.data for p in video.packets)
    yield LOG_NAME, recording.log.write


def _unless_a_bug(recording: Recording, what: str, make: Callable[[], T], otherwise: T) -> T:
    return unless_a_bug(what, make, otherwise, note=partial(_note, recording))


def _note(recording: Recording, words: str) -> bool:
    is_new = words not in recording.missing
    if is_new:
        recording.missing.append(words)
    return is_new


def build_manifest(recording: Recording) -> RunManifest:
    """Return a recording's manifest, still without its files, fit to be read by a host."""
    manifest = RunManifest(
        run_id=recording.run_id,
        unit=recording.unit,
        label=recording.label,
        state=recording.state,
        simulated=recording.simulated,
        origin="bricktrackd",
        hardware=recording.hardware,
        software=_unless_a_bug(recording, "the versions", software_versions, {}),
        camera=recording.camera,
        imus=[imu.description for imu in recording.imus],
        trigger=TriggerSection(
            pin=recording.trigger_pin,
            t0_ns=recording.edges.t0_ns,
            nominal_hz=recording.nominal_hz,
            wave=recording.wave,
        ),
        clocks=recording.clocks,
        window_ns=recording.window_ns,
        quality=_unless_a_bug(recording, "the counts", lambda: quality(recording), QualitySection()),
        missing=list(recording.missing),
        files=[],
    )
    for name, nothing in _CAN_BE_LEFT_OUT.items():
        problem = _why_unreadable(manifest)
        if not problem:
            break
        without = msgspec.structs.replace(manifest, **{name: nothing})
        if _why_unreadable(without) != problem:
            recording.missing.append(f"{name}: internal error: {problem}")
            manifest = msgspec.structs.replace(without, missing=list(recording.missing))
    return manifest


def _why_unreadable(manifest: RunManifest) -> str:
    """Return in words why no host could read a manifest, or ``""``: such a run would never be offered."""
    try:
        parse_manifest(dump_json(manifest), where="manifest")
    except (RunFormatError, TypeError, ValueError) as e:
        return str(e)
    return ""


def quality(recording: Recording) -> QualitySection:
    """Return the counts that tell whether a recording is good; over all its inertial sensors together."""
    slots = gaps = repeats = clipped = unusable = 0
    unique_hz: dict[str, float] = {}
    late_max_ns = 0
    for imu in recording.imus:
        flags = imu.flags
        present = flags & ImuFlag.GAP == 0
        fresh = present & (flags & (UNUSABLE | ImuFlag.REPEAT) == 0)
        slots += imu.n_slots
        gaps += imu.n_slots - int(np.count_nonzero(present))
        repeats += int(np.count_nonzero(flags & ImuFlag.REPEAT))
        clipped += int(np.count_nonzero(flags & (ImuFlag.ACC_CLIPPED | ImuFlag.GYRO_CLIPPED)))
        unusable += int(np.count_nonzero(present & (flags & UNUSABLE != 0)))
        t0_ns, period_ns = imu.description.t0_ns, imu.description.period_ns
        if imu.n_slots:
            hz = np.count_nonzero(fresh) * 1e9 / (imu.n_slots * period_ns)
            unique_hz[imu.description.name] = round(float(hz), 3)
        lateness_ns = (r.t_before_ns - (t0_ns + r.slot * period_ns) for r in imu.records)
        late_max_ns = max(late_max_ns, max(lateness_ns, default=0))
    video = recording.video
    return QualitySection(
        frames=len(video.records) if video else 0,
        frames_dropped=video.n_dropped if video else 0,
        frames_without_metadata=video.n_without_metadata if video else 0,
        imu_slots=slots,
        imu_gaps=gaps,
        imu_repeats=repeats,
        imu_clipped=clipped,
        imu_unusable=unusable,
        imu_unique_hz=unique_hz,
        imu_late_max_us=late_max_ns / 1000,
        edges=len(recording.edges.edges_ns),
    )


def software_versions() -> dict[str, str]:
    """Return what runs here, by name."""
    return dict(_software_versions())


@cache
def _software_versions() -> tuple[tuple[str, str], ...]:
    versions = {"python": platform.python_version(), "kernel": platform.release()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return tuple(versions.items())
