"""One finished recording in memory, and how it becomes a run folder."""

import platform
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import BinaryIO, Literal

import msgspec
import numpy as np

from bricktrack_common.arrays import IntArray
from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.frame_times import write_frames
from bricktrack_common.imu_records import (
    UNUSABLE,
    ImuDescription,
    ImuFlag,
    ImuRecord,
    decode_imu,
    write_imu,
)
from bricktrack_common.run_folder import write_edges
from bricktrack_common.run_manifest import (
    EDGES_NAME,
    FRAMES_NAME,
    LOG_NAME,
    VIDEO_NAME,
    CameraSection,
    ClocksSection,
    QualitySection,
    RunManifest,
    TriggerSection,
    WaveSection,
)
from bricktrack_device.capture.ring import VideoCut
from bricktrack_device.capture.trigger import EdgeTrain
from bricktrack_device.storage.run_writer import RunWriter

_PACKAGES = (
    "bricktrack", "numpy", "pyzmq", "gpiozero", "adafruit-circuitpython-bno055", "lgpio", "picamera2", "av",
)  # fmt: skip


class RunLog:
    """The daemon's own events during a run; becomes ``log.jsonl``."""

    def __init__(self) -> None:
        self._events: list[dict[str, str | int | float | None]] = []

    def add(self, event: str, **facts: str | int | float | None) -> None:
        """Note an event, stamped now."""
        self._events.append({"t_ns": monotonic_ns(), "event": event, **facts})

    def write(self, file: BinaryIO) -> None:
        """Write one JSON object a line."""
        for event in self._events:
            file.write(msgspec.json.encode(event) + b"\n")


_USELESS = {
    ImuFlag.STUCK: "repeat the one before for ten slots or more: the sensor no longer measured",
    ImuFlag.BLANK: "are all zero or all ones: the sensor was in reset or off the bus",
    ImuFlag.MODE_CHANGED: "came in another mode than the one set: the sensor had reset itself",
    ImuFlag.BAD_QUATERNION: "have a quaternion that is none: torn or corrupted reads",
}


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecording:
    """One sensor's part of a run.

    ``n_slots`` is how many slots were due in the window; ``flags`` are those of `decode_imu`.
    """

    description: ImuDescription
    records: list[ImuRecord]
    n_slots: int
    flags: IntArray = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "flags", decode_imu(self.description, self.records).flags)

    def problems(self) -> list[str]:
        """Return in words what makes samples useless, beyond the gaps that are counted anyway."""
        name, words = self.description.name, []
        for flag, what in _USELESS.items():
            n = int(np.count_nonzero(self.flags & flag))
            if n:
                words.append(f"imu {name}: {n} of {self.n_slots} samples {what}")
        return words


@dataclass(frozen=True, slots=True)
class Recording:
    """Everything of one run, before it is written."""

    run_id: str
    unit: str
    label: str
    state: Literal["complete", "interrupted"]
    simulated: bool
    hardware: dict[str, str]
    camera: CameraSection | None
    video: VideoCut | None
    imus: list[ImuRecording]
    trigger_pin: str
    nominal_hz: float | None
    edges: EdgeTrain
    wave: WaveSection
    clocks: ClocksSection
    window_ns: tuple[int, int]
    missing: list[str]
    log: RunLog = field(repr=False)

    @property
    def truth_window_ns(self) -> tuple[int, int]:
        """What the true motion beside a simulated run must cover: the window and every picture in it."""
        start_ns, end_ns = self.window_ns
        if self.video and self.video.records:
            start_ns = min(start_ns, self.video.records[0].sensor_timestamp_ns)
        return start_ns, end_ns

    @property
    def n_bytes(self) -> int:
        """Roughly what the run takes on the card."""
        return (self.video.n_bytes if self.video else 0) + sum(100 * len(i.records) for i in self.imus)


def save(
    recording: Recording, writer: RunWriter, write_truth: Callable[[Path], Path | None]
) -> tuple[Path, RunManifest]:
    """Write a recording as a run folder: small streams first, the video, the manifest last.

    May be called again with the same ``writer`` after it failed: files already on the card stay.

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
    for imu in recording.imus:
        writer.write(
            f"imu_{imu.description.name}.msgpack",
            partial(write_imu, description=imu.description, records=imu.records),
        )
    edges = np.array(recording.edges.edges_ns, dtype=np.int64)
    writer.write(EDGES_NAME, lambda f: write_edges(f, edges))
    video = recording.video
    if video is not None and video.packets:
        writer.write(FRAMES_NAME, lambda f: write_frames(f, video.records))
        writer.write(VIDEO_NAME, lambda f: f.writelines(p.data for p in video.packets))
    writer.write(LOG_NAME, recording.log.write)
    writer.write_by_others(write_truth)
    return writer.finish(manifest), manifest


def build_manifest(recording: Recording) -> RunManifest:
    """Return a recording's manifest, still without its files."""
    return RunManifest(
        run_id=recording.run_id,
        unit=recording.unit,
        label=recording.label,
        state=recording.state,
        simulated=recording.simulated,
        origin="bricktrackd",
        hardware=recording.hardware,
        software=software_versions(),
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
        quality=quality(recording),
        missing=recording.missing,
        files=[],
    )


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
    versions = {"python": platform.python_version(), "kernel": platform.release()}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions
