"""Recordings made by other means, as run folders: a video with its stamps, inertial samples, edges.

Nothing is made up to make things fit: a video and a list of stamps that differ in number are refused, because
every picture behind the missing one would stand at a wrong time.
"""

import contextlib
import platform
import shutil
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path

import numpy as np

from bricktrack_common.arrays import IntArray
from bricktrack_common.errors import ConfigError, StorageError, VideoError
from bricktrack_common.frame_times import FrameFlag, FrameRecord, write_frames
from bricktrack_common.imu_records import write_imu
from bricktrack_common.run_folder import write_edges
from bricktrack_common.run_manifest import (
    EDGES_NAME,
    FRAMES_NAME,
    MANIFEST_NAME,
    VIDEO_NAME,
    CameraSection,
    ClocksSection,
    QualitySection,
    RunManifest,
    TriggerSection,
    file_entry,
    is_run_id,
    write_manifest,
)
from bricktrack_host.durable_files import rename_durably, storage_errors, sync_file, sync_folder
from bricktrack_host.recordings.imu_import import ImportedImu, import_imu
from bricktrack_host.recordings.loose_files import (
    LooseRig,
    TimestampUnit,
    read_edges_csv,
    read_exposures_us,
    read_imu_csv,
    read_timestamps,
)
from bricktrack_host.recordings.loose_video import LooseVideo, load_video

_GAP_PERIODS = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Recording:
    """The files of one recording and what they do not say themselves.

    Attributes
    ----------
    video, timestamps : Path
    imus : dict of str to Path
        CSV files by the sensor's name; ``"brick"`` is the one on the LED component.
    edges : Path or None
    exposures : Path or None
        Text file with each picture's exposure, us; without it all are the rig's.
    rig : LooseRig
    unit, label : str
        The run's id is ``<unit>_<label>``.
    simulated : bool
    allow_shorter : bool
        Take the stamps and pictures that stand together at the beginning, where nothing speaks against
        the surplus being at the end.
    """

    video: Path
    timestamps: Path
    rig: LooseRig
    unit: str
    label: str
    simulated: bool
    imus: dict[str, Path] = field(default_factory=dict)
    edges: Path | None = None
    exposures: Path | None = None
    timestamps_unit: TimestampUnit = "auto"
    imu_acc_range_g: float = 16.0
    imu_gyro_range_dps: float = 2000.0
    allow_shorter: bool = False


@dataclass(frozen=True, slots=True)
class Imported:
    """A run folder made from loose files, and what is worth knowing of it, in words."""

    folder: Path
    manifest: RunManifest
    notes: list[str]


def import_recording(recording: Recording, runs_folder: Path) -> Imported:
    """Make the run folder ``<runs_folder>/<unit>_<label>`` from loose files.

    Raises
    ------
    VideoError
        If the video cannot be used, or does not agree with its stamps or the stated picture size.
    RunFormatError, ConfigError
        If another file says what it must not.
    StorageError
        If the run exists already, or cannot be written.
    """
    run_id = "_".join(part for part in (recording.unit, recording.label) if part)
    if not (is_run_id(recording.unit) and is_run_id(run_id)):
        raise ConfigError(
            f"run id {run_id!r}: unit and label may hold letters, digits, '-', '_' and '.', and begin with a "
            "letter or digit"
        )
    folder = runs_folder / run_id
    if folder.exists():
        raise StorageError(f"{folder} exists already. Choose another --label, or move that folder away")
    video = load_video(recording.video)
    stamps_us = read_timestamps(recording.timestamps, unit=recording.timestamps_unit)
    exposures_us = np.full(len(stamps_us), recording.rig.exposure_us, dtype=np.int64)
    if recording.exposures is not None:
        exposures_us = read_exposures_us(recording.exposures, n_frames=len(stamps_us))
    mode = recording.rig.mode
    if (video.width, video.height) != (mode.width, mode.height):
        raise VideoError(
            f"{recording.video}: pictures are {video.width} x {video.height} px; the rig says {mode.width} x "
            f"{mode.height}. Row times and calibration belong to one size"
        )
    missing = list(video.problems)
    n_frames = _match(recording, video, stamps_us, missing)
    notes = _check_container_times(recording, video, stamps_us, n_frames)
    imus = {
        name: import_imu(
            read_imu_csv(path), name=name, acc_range_g=recording.imu_acc_range_g,
            gyro_range_dps=recording.imu_gyro_range_dps,
        )
        for name, path in recording.imus.items()
    }  # fmt: skip
    notes += [f"imu {name}: {note}" for name, imu in imus.items() for note in imu.notes]
    edges_ns = np.empty(0, np.int64) if recording.edges is None else read_edges_csv(recording.edges)
    if recording.edges is None:
        missing.append("no edges of the square wave: there is no t = 0 and no laboratory clock")
    if not imus:
        missing.append("no inertial samples")

    part = runs_folder / f"{run_id}.partial"
    with storage_errors(runs_folder, "Make room or choose another folder with -o"):
        runs_folder.mkdir(parents=True, exist_ok=True)
        if part.exists():
            shutil.rmtree(part)  # of an import that was broken off; its sources are elsewhere
        part.mkdir()
        try:
            records = _frame_records(recording, video, stamps_us[:n_frames], exposures_us)
            _write_streams(part, video, records, imus, edges_ns)
            manifest = _manifest(recording, run_id, part, video, records, imus, edges_ns, missing)
            write_manifest(part / MANIFEST_NAME, manifest)
            sync_file(part / MANIFEST_NAME)
            sync_folder(part)
            rename_durably(part, folder)
        except BaseException:
            with contextlib.suppress(OSError):
                shutil.rmtree(part)
            raise
    return Imported(folder, manifest, [*notes, *missing])


def _match(recording: Recording, video: LooseVideo, stamps_us: IntArray, missing: list[str]) -> int:
    """Return how many pictures have a stamp, all of them unless a surplus was allowed and is at the end."""
    n_pictures, n_stamps = len(video.units), len(stamps_us)
    if n_pictures == n_stamps:
        return n_pictures
    counts = f"{recording.video} holds {n_pictures} pictures and {recording.timestamps} {n_stamps} stamps"
    if not recording.allow_shorter:
        raise VideoError(
            f"{counts}: from the missing one on, every picture would stand at a wrong time. Find where one "
            "is missing and remove its partner; if the longer one only runs on at its end, say "
            "--allow-shorter"
        )
    n = min(n_pictures, n_stamps)
    steps = np.diff(stamps_us)
    holes = np.flatnonzero(steps > _GAP_PERIODS * np.median(steps)) if steps.size else np.empty(0, np.int64)
    if stamps_us[0] != 0:
        raise VideoError(
            f"{counts}, and the first stamp is {stamps_us[0]} µs, not 0: what is missing may be at the "
            "beginning. Make them agree by hand"
        )
    if holes.size and holes[0] + 1 < n:
        raise VideoError(
            f"{counts}, and the stamps leave out a frame after line {holes[0] + 1}: what is missing may be "
            "there. Make them agree by hand"
        )
    if video.problems:
        raise VideoError(f"{counts}, and {video.problems[0]}. Make them agree by hand")
    missing.append(
        f"{n_stamps - n} stamps at the end have no picture: the video was cut, those frames are lost"
        if n_stamps > n
        else f"{n_pictures - n} pictures at the end have no stamp and were left out"
    )
    return n


def _check_container_times(
    recording: Recording, video: LooseVideo, stamps_us: IntArray, n_frames: int
) -> list[str]:
    """Compare the container's own times with the stamps; a frame that was left out in one shows here."""
    if video.container_us is None or n_frames < 2:
        return []
    container_us = video.container_us[:n_frames]
    stamps = stamps_us[:n_frames] - stamps_us[0]
    period_us = float(np.median(np.diff(stamps)))
    off = np.abs(container_us - stamps)
    worst = int(np.argmax(off))
    if off[worst] <= period_us / 2:
        return [f"the container's times agree with the stamps within {off[worst] / 1000:.3f} ms"]
    if np.ptp(np.diff(container_us)) <= 2000:
        return ["the container's times are those of a constant rate, not the camera's: not compared"]
    first = int(np.argmax(off > period_us / 2))
    raise VideoError(
        f"{recording.video}: by the container picture {first} comes {container_us[first] / 1000:.3f} ms "
        f"after the first, by {recording.timestamps} {stamps[first] / 1000:.3f} ms. A picture or a stamp is "
        "missing there"
    )


def _frame_records(
    recording: Recording, video: LooseVideo, stamps_us: IntArray, exposures_us: IntArray
) -> list[FrameRecord]:
    steps = np.diff(stamps_us, prepend=stamps_us[:1])
    period_us = float(np.median(steps[1:])) if len(steps) > 1 else np.inf
    return [
        FrameRecord(
            pts_us=int(stamp - stamps_us[0]),
            sensor_timestamp_ns=recording.rig.first_sensor_timestamp_ns + 1000 * int(stamp),
            exposure_us=int(exposure_us),
            analogue_gain=float("nan"),
            keyframe=unit.keyframe,
            byte_offset=unit.byte_offset,
            n_bytes=unit.n_bytes,
            flags=int(FrameFlag.GAP_BEFORE if step > _GAP_PERIODS * period_us else FrameFlag.NONE),
        )
        for stamp, step, exposure_us, unit in zip(stamps_us, steps, exposures_us, video.units, strict=False)
    ]


def _write_streams(
    part: Path,
    video: LooseVideo,
    records: list[FrameRecord],
    imus: dict[str, ImportedImu],
    edges_ns: IntArray,
) -> None:
    end = records[-1].byte_offset + records[-1].n_bytes
    (part / VIDEO_NAME).write_bytes(video.data[:end])
    with (part / FRAMES_NAME).open("xb") as file:
        write_frames(file, records)
    for name, imu in imus.items():
        with (part / f"imu_{name}.msgpack").open("xb") as file:
            write_imu(file, imu.description, imu.records)
    if edges_ns.size:
        with (part / EDGES_NAME).open("xb") as file:
            write_edges(file, edges_ns)
    for path in part.iterdir():
        sync_file(path)


def _manifest(
    recording: Recording,
    run_id: str,
    part: Path,
    video: LooseVideo,
    records: list[FrameRecord],
    imus: dict[str, ImportedImu],
    edges_ns: IntArray,
    missing: list[str],
) -> RunManifest:
    stamps_us = np.array([r.pts_us for r in records])
    period_us = float(np.median(np.diff(stamps_us))) if len(records) > 1 else 0.0
    dropped = int(np.maximum(np.rint(np.diff(stamps_us) / period_us) - 1, 0).sum()) if period_us else 0
    return RunManifest(
        run_id=run_id,
        unit=recording.unit,
        label=recording.label,
        state="complete",
        simulated=recording.simulated,
        origin="import",
        hardware={},
        software={"bricktrack": version("bricktrack"), "python": platform.python_version()},
        camera=CameraSection(
            model="unknown (imported)",
            mode=recording.rig.mode,
            exposure_us=round(float(np.median([r.exposure_us for r in records]))),
            analogue_gain=0.0,  # 0 stands for not known: no camera has it
            colour_gains=(0.0, 0.0),
            frame_duration_us=round(period_us),
            encoder="unknown (imported)",
            encoder_settings={"color_range": video.color_range},
        ),
        imus=[imu.description for imu in imus.values()],
        trigger=TriggerSection(
            pin="",
            t0_ns=int(edges_ns[0]) if edges_ns.size else None,
            nominal_hz=recording.rig.square_wave_hz,
        ),
        clocks=ClocksSection(),
        window_ns=None,
        quality=QualitySection(
            frames=len(records),
            frames_dropped=dropped,
            imu_slots=sum(len(imu.records) for imu in imus.values()),
            imu_gaps=sum(imu.n_missing for imu in imus.values()),
            imu_repeats=sum(imu.n_repeats for imu in imus.values()),
            imu_clipped=sum(imu.n_clipped for imu in imus.values()),
            edges=len(edges_ns),
        ),
        missing=missing,
        files=[file_entry(p) for p in sorted(part.iterdir())],
    )
