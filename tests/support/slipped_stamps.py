"""Recordings whose frame stamps slip by whole periods, made from whole ones."""

from dataclasses import replace
from typing import TypeVar

import numpy as np

from bricktrack_common.arrays import IntArray, rows_of
from bricktrack_host.tracks import LedObservations, OpticalTrack

Frames = TypeVar("Frames", LedObservations, OpticalTrack)


def slip(frames: Frames, frame: int, late_periods: int) -> Frames:
    """Stamps that from a frame on are periods too late, with a hole in them; or too early, pictures lost there.

    The pictures that are lost for stamps too early are those before ``frame`` as it is counted afterwards.
    """
    stamps = _stamps(frames)
    period_ns = round(float(np.median(np.diff(stamps))))
    if late_periods < 0:
        keep = np.r_[0:frame, frame - late_periods : len(stamps)]
        frames, stamps = rows_of(frames, keep), stamps[keep]
    stamps = stamps.copy()
    stamps[frame:] += late_periods * period_ns
    return _stamped(frames, stamps)


def double(frames: Frames, frame: int) -> Frames:
    """Put one picture there twice; stamps run on evenly, so all after it are a period too late."""
    stamps = _stamps(frames)
    keep = np.r_[0:frame, frame - 1, frame : len(stamps)]
    period_ns = round(float(np.median(np.diff(stamps))))
    return _stamped(rows_of(frames, keep), np.append(stamps, stamps[-1] + period_ns))


def _stamps(frames: LedObservations | OpticalTrack) -> IntArray:
    return frames.t_ns if isinstance(frames, OpticalTrack) else frames.sensor_timestamp_ns


def _stamped(frames: Frames, stamps_ns: IntArray) -> Frames:
    if isinstance(frames, OpticalTrack):
        return replace(frames, t_ns=stamps_ns)
    return replace(frames, sensor_timestamp_ns=stamps_ns)
