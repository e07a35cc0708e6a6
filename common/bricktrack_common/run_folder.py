"""A run folder as read: the manifest and its streams, each checked, with what is missing said in words."""

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bricktrack_common.arrays import IntArray
from bricktrack_common.checksums import sha256_file
from bricktrack_common.errors import RunFormatError
from bricktrack_common.frame_times import FrameTimes, read_frames
from bricktrack_common.imu_records import ImuDescription, ImuSamples, read_imu_samples
from bricktrack_common.run_manifest import (
    EDGES_NAME,
    FRAMES_NAME,
    LOG_NAME,
    MANIFEST_NAME,
    VIDEO_NAME,
    RunManifest,
    read_manifest,
)
from bricktrack_common.streams import Field, StreamSchema, read_stream, write_stream

logger = logging.getLogger(__name__)

EDGES_SCHEMA = StreamSchema(
    "bricktrack.edges", 1, (Field("t_ns", "int", "ns, CLOCK_MONOTONIC, rising edge"),)
)


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One recording, read and checked.

    Attributes
    ----------
    folder : Path
    manifest : RunManifest
    frames : FrameTimes or None
    imus : dict of str to (ImuDescription, ImuSamples)
    edges_ns : ndarray of int64, shape (n,)
        Rising edges of the square wave in order, CLOCK_MONOTONIC.
    video : Path or None
    problems : list of str
        What is missing or cut, for the report: the manifest's own words and what reading found.
    """

    folder: Path
    manifest: RunManifest
    frames: FrameTimes | None
    imus: dict[str, tuple[ImuDescription, ImuSamples]]
    edges_ns: IntArray
    video: Path | None
    problems: list[str]


def write_edges(file: BinaryIO, edges_ns: IntArray) -> int:
    """Write the stream of rising edges to an open file; return their number."""
    return write_stream(file, EDGES_SCHEMA, ([int(t)] for t in edges_ns), meta={})


def read_edges(path: Path) -> tuple[IntArray, int]:
    """Return the rising edges, int64 ns, and the bytes left over after the last whole record.

    Raises
    ------
    RunFormatError
        If it is no stream of edges or they are not in order of time.
    """
    contents = read_stream(path, EDGES_SCHEMA)
    try:
        edges = np.array(contents.columns["t_ns"], dtype=np.int64)
    except OverflowError as e:
        raise RunFormatError(f"{path}: an edge does not fit 64 bits") from e
    if edges.size > 1 and np.diff(edges).min() <= 0:
        raise RunFormatError(
            f"{path}: edge {int(np.argmin(np.diff(edges))) + 1} does not come after the one before"
        )
    return edges, contents.leftover_bytes


def read_run(folder: Path, *, verify_hashes: bool = False) -> Run:
    """Return a run folder's contents.

    A file that the manifest lists and that is not there, or holds nothing, a cut stream and a size that
    differs are put into ``problems`` in words; a stream that is damaged inside raises.

    Parameters
    ----------
    folder : Path
    verify_hashes : bool
        Also compare each file's SHA-256; a difference raises.

    Raises
    ------
    RunFormatError
        If there is no manifest, or a stream cannot be what it claims to be.
    """
    if not folder.is_dir():
        raise RunFormatError(f"{folder}: no such folder")
    manifest = read_manifest(folder / MANIFEST_NAME)
    problems = list(manifest.missing)
    if manifest.state != "complete":
        problems.append("the recording was interrupted; what was saved is used")
    present: set[str] = set()
    for entry in manifest.files:
        path = folder / entry.name
        if not path.is_file():
            problems.append(f"{entry.name} is missing")
            continue
        size = path.stat().st_size
        if size == 0 and entry.name != LOG_NAME:  # as a power cut leaves files that were not on the disk yet
            problems.append(f"{entry.name} is empty and counts as missing")
            continue
        present.add(entry.name)
        if size != entry.n_bytes:
            problems.append(f"{entry.name} has {size} bytes; the manifest says {entry.n_bytes}")
        elif verify_hashes and sha256_file(path) != entry.sha256:
            raise RunFormatError(
                f"{path}: its SHA-256 is not the manifest's; the file was altered. Pull it again"
            )

    frames = None
    if FRAMES_NAME in present:
        frames = read_frames(folder / FRAMES_NAME)
        _note_cut(problems, FRAMES_NAME, frames.leftover_bytes)
    imus: dict[str, tuple[ImuDescription, ImuSamples]] = {}
    for described in manifest.imus:
        name = f"imu_{described.name}.msgpack"
        if name not in present:
            continue
        description, samples, leftover = read_imu_samples(folder / name)
        _note_cut(problems, name, leftover)
        imus[description.name] = (description, samples)
    edges = np.empty(0, dtype=np.int64)
    if EDGES_NAME in present:
        edges, leftover = read_edges(folder / EDGES_NAME)
        _note_cut(problems, EDGES_NAME, leftover)
    video = folder / VIDEO_NAME if VIDEO_NAME in present else None
    if video is not None and frames is None:
        problems.append("there is a video but no frame times: its pictures cannot be placed in time")
    for problem in problems:
        logger.warning("%s: %s", manifest.run_id, problem)
    return Run(folder, manifest, frames, imus, edges, video, problems)


def _note_cut(problems: list[str], name: str, leftover_bytes: int) -> None:
    if leftover_bytes:
        problems.append(f"{name} is cut: {leftover_bytes} bytes of a last, incomplete record were left out")
