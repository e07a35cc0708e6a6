"""The stream of frame times: for each encoded picture its stamps, exposure and place in the video file."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntFlag
from pathlib import Path
from typing import BinaryIO

import numpy as np

from bricktrack_common.arrays import BoolArray, FloatArray, IntArray
from bricktrack_common.errors import RunFormatError
from bricktrack_common.streams import Field, StreamSchema, read_stream, write_stream

FRAMES_SCHEMA = StreamSchema(
    "bricktrack.frames",
    1,
    (
        Field("pts_us", "int", "us since the first encoded frame"),
        Field("sensor_timestamp_ns", "int", "ns, CLOCK_MONOTONIC, start of read-out of the first row"),
        Field("exposure_us", "int", "us"),
        Field("analogue_gain", "float", "1"),
        Field("keyframe", "bool", ""),
        Field("byte_offset", "int", "bytes from the start of video.h264"),
        Field("n_bytes", "int", "bytes"),
        Field("flags", "int", "FrameFlag bits"),
    ),
)


class FrameFlag(IntFlag):
    """What is wrong with one frame record."""

    NONE = 0
    NO_METADATA = 1
    """The sensor's metadata of this frame were lost: stamp from the encoder, exposure as configured."""
    GAP_BEFORE = 2
    """At least one frame is missing before this one."""


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One encoded picture; the fields are those of `FRAMES_SCHEMA`."""

    pts_us: int
    sensor_timestamp_ns: int
    exposure_us: int
    analogue_gain: float
    keyframe: bool
    byte_offset: int
    n_bytes: int
    flags: int


@dataclass(frozen=True, slots=True, eq=False)
class FrameTimes:
    """The frame stream as columns, each of shape (n,); see `FRAMES_SCHEMA` for the units."""

    pts_us: IntArray
    sensor_timestamp_ns: IntArray
    exposure_us: IntArray
    analogue_gain: FloatArray
    keyframe: BoolArray
    byte_offset: IntArray
    n_bytes: IntArray
    flags: IntArray
    leftover_bytes: int

    @property
    def n_frames(self) -> int:
        """Number of frame records."""
        return len(self.pts_us)


def write_frames(file: BinaryIO, records: Iterable[FrameRecord]) -> int:
    """Write the frame stream to an open file; return the number of records."""
    rows = (
        (r.pts_us, r.sensor_timestamp_ns, r.exposure_us, float(r.analogue_gain), r.keyframe, r.byte_offset,
         r.n_bytes, int(r.flags))
        for r in records
    )  # fmt: skip
    return write_stream(file, FRAMES_SCHEMA, rows, meta={})


def read_frames(path: Path) -> FrameTimes:
    """Return the frame stream of a run.

    Raises
    ------
    RunFormatError
        If it is no frame stream, or time or byte offsets do not increase: such a file would put
        pictures at wrong times.
    """
    contents = read_stream(path, FRAMES_SCHEMA)
    c = contents.columns
    times = FrameTimes(
        pts_us=_int_column(path, "pts_us", c),
        sensor_timestamp_ns=_int_column(path, "sensor_timestamp_ns", c),
        exposure_us=_int_column(path, "exposure_us", c),
        analogue_gain=np.array(c["analogue_gain"], dtype=np.float64),
        keyframe=np.array(c["keyframe"], dtype=np.bool_),
        byte_offset=_int_column(path, "byte_offset", c),
        n_bytes=_int_column(path, "n_bytes", c),
        flags=_int_column(path, "flags", c),
        leftover_bytes=contents.leftover_bytes,
    )
    for name in ("pts_us", "sensor_timestamp_ns"):
        steps = np.diff(getattr(times, name))
        if steps.size and steps.min() <= 0:
            i = int(np.argmin(steps))
            raise RunFormatError(f"{path}: {name} of frame {i + 1} does not come after that of frame {i}")
    ends = times.byte_offset + times.n_bytes
    if times.n_frames and (
        times.byte_offset[0] != 0 or times.n_bytes.min() < 1 or np.any(ends[:-1] != times.byte_offset[1:])
    ):
        raise RunFormatError(f"{path}: byte offsets do not follow on from each other")
    return times


def _int_column(path: Path, name: str, columns: dict[str, list[int]]) -> IntArray:
    try:
        return np.array(columns[name], dtype=np.int64)
    except OverflowError as e:
        raise RunFormatError(f"{path}: {name} does not fit 64 bits") from e


def mid_exposure_ns(
    sensor_timestamp_ns: IntArray, exposure_ns: IntArray, row_delay_ns: FloatArray
) -> IntArray:
    """Return the middle of the exposure of a row: ``SensorTimestamp - ExposureTime/2 + row delay``, int64 ns.

    A Pi stamps the start of *read-out* of the first row, when its exposure ends (kernel drivers
    bcm2835-unicam and rp1-cfe), hence the minus.

    Examples
    --------
    >>> int(mid_exposure_ns(np.int64(10_000_000), np.int64(4_000_000), np.float64(18903.5)))
    8018904
    """
    return np.asarray(sensor_timestamp_ns - exposure_ns // 2 + np.rint(row_delay_ns).astype(np.int64))
