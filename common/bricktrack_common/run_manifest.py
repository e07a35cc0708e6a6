"""The manifest of a run folder: what was recorded, how, and the hash of every file.

It is written last, so a folder with a readable manifest is whole. `docs/run-format.md` describes every key.
"""

import re
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from bricktrack_common.camera_model import SensorMode
from bricktrack_common.checksums import sha256_file
from bricktrack_common.clocks import ClockTriplet
from bricktrack_common.errors import RunFormatError
from bricktrack_common.imu_records import ImuDescription
from bricktrack_common.typed_data import convert, dump_json

MANIFEST_NAME = "manifest.json"
MANIFEST_SCHEMA = "bricktrack.run"
MANIFEST_VERSION = 2
VIDEO_NAME = "video.h264"
FRAMES_NAME = "frames.msgpack"
EDGES_NAME = "edges.msgpack"
LOG_NAME = "log.jsonl"
TRUTH_NAME = "truth.npz"

RUN_ID_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$"
FILE_NAME_PATTERN = r"^[a-z0-9][a-z0-9_.-]{0,63}$"

_Count = Annotated[int, msgspec.Meta(ge=0)]


class NewerRunError(RunFormatError):
    """A run folder of a newer version than this bricktrack reads: nothing is wrong with it."""


class _Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of the manifest's sections: frozen, by keyword, and strict about unknown keys."""


class FileEntry(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One file of the run."""

    name: Annotated[str, msgspec.Meta(pattern=FILE_NAME_PATTERN)]
    n_bytes: _Count
    sha256: Annotated[str, msgspec.Meta(pattern=r"^[0-9a-f]{64}$")]


class CameraSection(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the pictures were taken and encoded."""

    model: str
    mode: SensorMode
    exposure_us: int
    analogue_gain: float
    colour_gains: tuple[float, float]
    frame_duration_us: int
    encoder: str
    encoder_settings: dict[str, str | int | float | bool | None]


class WaveSection(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What the unit saw of the square wave, counted against its period; the host judges the edges anew.

    ``hz`` is by the unit's clock, `None` where too few edges came to tell. ``last_edge_ns`` belongs to the
    last edge in step; ``n_after_last`` periods would still have fitted into the window behind it.
    ``rejected_ns`` are rising edges between arming and t = 0 that did not count (the newest hundred).
    """

    hz: float | None = None
    n_missed: _Count = 0
    n_extra: _Count = 0
    n_late: _Count = 0
    last_edge_ns: int | None = None
    n_after_last: _Count = 0
    rejected_ns: list[int] = []


class TriggerSection(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The square wave.

    ``t0_ns`` is the kernel stamp of the first rising edge after arming that counts, `None` if there was
    none. ``nominal_hz`` is the wave's frequency as configured, `None` if not told. ``wave`` is `None` in
    runs of before version 2 and in imported ones.
    """

    pin: str
    t0_ns: int | None
    nominal_hz: float | None = None
    wave: WaveSection | None = None


class ClocksSection(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The unit's clocks at three moments; `None` where that moment never came or was not logged."""

    arm: ClockTriplet | None = None
    trigger: ClockTriplet | None = None
    end: ClockTriplet | None = None


class QualitySection(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Counts that tell at a glance whether the run is good.

    ``imu_unusable`` are samples that came but are not to be believed (stuck, blank, torn, sensor reset);
    ``imu_unique_hz`` says, by sensor, how many *new* samples came a second.
    """

    frames: _Count = 0
    frames_dropped: _Count = 0
    frames_without_metadata: _Count = 0
    imu_slots: _Count = 0
    imu_gaps: _Count = 0
    imu_repeats: _Count = 0
    imu_clipped: _Count = 0
    imu_unusable: _Count = 0
    imu_unique_hz: dict[str, float] = {}
    imu_late_max_us: float = 0.0
    edges: _Count = 0


class RunManifest(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Everything that is said of one run.

    Attributes
    ----------
    missing : list of str
        What the run should have and does not, in words: a sensor that failed, a trigger that never came.
    window_ns : (int, int) or None
        First and last instant that was asked for, CLOCK_MONOTONIC.
    origin : str
        ``bricktrackd`` for recordings of the daemon, ``import`` for those made by other means.
    """

    schema: str = MANIFEST_SCHEMA
    version: int = MANIFEST_VERSION
    run_id: Annotated[str, msgspec.Meta(pattern=RUN_ID_PATTERN)]
    unit: Annotated[str, msgspec.Meta(pattern=RUN_ID_PATTERN)]
    label: str
    state: Literal["complete", "interrupted"]
    simulated: bool
    origin: Literal["bricktrackd", "import"]
    hardware: dict[str, str]
    software: dict[str, str]
    camera: CameraSection | None
    imus: list[ImuDescription]
    trigger: TriggerSection
    clocks: ClocksSection
    window_ns: tuple[int, int] | None
    quality: QualitySection
    missing: list[str]
    files: list[FileEntry]

    def file(self, name: str) -> FileEntry | None:
        """Return the entry of a file, or `None` if the run has none of that name."""
        return next((f for f in self.files if f.name == name), None)


def write_manifest(path: Path, manifest: RunManifest) -> None:
    """Write the manifest's text; the caller does the fsync."""
    path.write_bytes(dump_json(manifest))


def read_manifest(path: Path) -> RunManifest:
    """Return a manifest, checked.

    Raises
    ------
    RunFormatError
        If there is none, it is no manifest, or a key is missing or wrong; `NewerRunError` if it is of a newer
        version.
    """
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as e:
        raise RunFormatError(f"{path.parent}: {_why_no_run(path.parent)}") from e
    except OSError as e:
        raise RunFormatError(f"{path}: {e.strerror or e}") from e
    return parse_manifest(data, where=str(path))


def _why_no_run(folder: Path) -> str:
    if not folder.exists():
        return "no such run folder"
    if folder.is_file():
        return "a file; expected a run folder"
    if any(folder.glob(f"*/{MANIFEST_NAME}")):
        return f"a folder of runs. Name the runs in it, as {folder}/*"
    return f"no {MANIFEST_NAME}, so no whole run folder. Give one that was pulled or imported"


def parse_manifest(data: bytes, *, where: str) -> RunManifest:
    """Return the manifest in ``data``; see `read_manifest`."""
    try:
        value = msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as e:
        raise RunFormatError(f"{where}: not valid JSON: {e}") from e
    if not isinstance(value, dict) or value.get("schema") != MANIFEST_SCHEMA:
        raise RunFormatError(f"{where}: not a {MANIFEST_SCHEMA} manifest")
    version = value.get("version")
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise RunFormatError(f"{where}: version {version!r}; expected a positive integer")
    if version > MANIFEST_VERSION:
        raise NewerRunError(
            f"{where}: {MANIFEST_SCHEMA} version {version}; this bricktrack reads up to version "
            f"{MANIFEST_VERSION}. Upgrade bricktrack on this machine"
        )
    manifest = convert(value, RunManifest, where=where, error=RunFormatError)
    names = [f.name for f in manifest.files]
    if len(set(names)) < len(names) or MANIFEST_NAME in names:
        raise RunFormatError(f"{where}: files: a name stands twice")
    return manifest


def file_entry(path: Path) -> FileEntry:
    """Return name, size and hash of a file on disk."""
    return FileEntry(name=path.name, n_bytes=path.stat().st_size, sha256=sha256_file(path))


def is_run_id(text: str) -> bool:
    """Tell whether ``text`` may name a run: safe on any file system, no path in it.

    Examples
    --------
    >>> is_run_id("unit-01_b3f2a7_0004_shake"), is_run_id("../etc"), is_run_id("")
    (True, False, False)
    """
    return re.fullmatch(RUN_ID_PATTERN, text) is not None
