"""Encoded pictures and their metadata in memory, bounded by time; a run is cut out of them by absolute time.

The camera's threads only append: no disk, no log line, no numpy there. Packets and metadata find each other
by time stamp, never by count: an encoder skips pictures and a callback runs ahead of it.
"""

import threading
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import median

from bricktrack_common.clocks import monotonic_ns
from bricktrack_common.frame_times import FrameFlag, FrameRecord
from bricktrack_device.interfaces import EncodedPacket, FrameMetadata

JOIN_TOLERANCE_NS = 100_000
"""A packet's stamp is its frame's, truncated to us twice at most; the next frame is 100 times further."""
GAP_PERIODS = 1.5
RING_SLACK_S = 5.0
"""What is held beyond the span of a run."""


class FrameRing:
    """The `FrameSink` of a recording.

    Parameters
    ----------
    span_ns : int
        How far back pictures are kept, counted from the newest by their stamps. None is held for longer than
        this either: a camera whose stamps stand still fills no memory.
    clock : callable
        CLOCK_MONOTONIC, ns.
    """

    def __init__(self, span_ns: int, *, clock: Callable[[], int] = monotonic_ns) -> None:
        self._clock = clock
        self._span_us = span_ns // 1000
        self._span_ns = span_ns
        self._lock = threading.Lock()
        # Each with when it came, ns.
        self._packets: deque[tuple[int, EncodedPacket]] = deque()
        self._metadata: deque[tuple[int, FrameMetadata]] = deque()
        self._first_abs_us: int | None = None
        self._first_keyframe_us: int | None = None
        self._n_bytes = 0
        self._n_packets = 0

    def on_packet(self, packet: EncodedPacket) -> None:
        """Keep one encoded picture."""
        with self._lock:
            if self._first_abs_us is None:
                self._first_abs_us = packet.abs_us
            if packet.keyframe and self._first_keyframe_us is None:
                self._first_keyframe_us = packet.abs_us
            now_ns = self._clock()
            self._packets.append((now_ns, packet))
            self._n_packets += 1
            self._n_bytes += len(packet.data)
            oldest_us, earliest_ns = packet.abs_us - self._span_us, now_ns - self._span_ns
            while self._packets[0][1].abs_us < oldest_us or self._packets[0][0] < earliest_ns:
                self._n_bytes -= len(self._packets.popleft()[1].data)

    def on_metadata(self, metadata: FrameMetadata) -> None:
        """Keep one frame's metadata."""
        with self._lock:
            now_ns = self._clock()
            self._metadata.append((now_ns, metadata))
            oldest_ns, earliest_ns = metadata.sensor_timestamp_ns - self._span_ns, now_ns - self._span_ns
            while self._metadata[0][1].sensor_timestamp_ns < oldest_ns or self._metadata[0][0] < earliest_ns:
                self._metadata.popleft()

    @property
    def n_packets(self) -> int:
        """Pictures taken since the start, kept or not."""
        return self._n_packets

    @property
    def n_bytes(self) -> int:
        """Bytes of video held now."""
        return self._n_bytes

    @property
    def first_abs_us(self) -> int | None:
        """Stamp of the first encoded picture, us: the zero of presentation times."""
        return self._first_abs_us

    @property
    def first_keyframe_us(self) -> int | None:
        """Stamp of the first keyframe, us: nothing before it can be decoded."""
        return self._first_keyframe_us

    @property
    def newest_us(self) -> int | None:
        """Stamp of the newest picture, us."""
        with self._lock:
            return self._packets[-1][1].abs_us if self._packets else None

    def snapshot(self) -> tuple[list[EncodedPacket], list[FrameMetadata]]:
        """Return what is held now, oldest first."""
        with self._lock:
            return [p for _, p in self._packets], [m for _, m in self._metadata]


@dataclass(frozen=True, slots=True)
class VideoCut:
    """The pictures of a run, joined with their metadata.

    Attributes
    ----------
    packets : list of EncodedPacket
        From a keyframe on, in order of time.
    records : list of FrameRecord
        One a packet.
    n_dropped : int
        Frames missing from the first picture to the window's end, told by gaps over 1.5 periods.
    n_without_metadata : int
    problems : list of str
    """

    packets: list[EncodedPacket]
    records: list[FrameRecord]
    n_dropped: int
    n_without_metadata: int
    problems: list[str]

    @property
    def n_bytes(self) -> int:
        """Size of the video."""
        return sum(len(p.data) for p in self.packets)


def cut_video(
    packets: Sequence[EncodedPacket],
    metadata: Sequence[FrameMetadata],
    *,
    start_ns: int,
    end_ns: int,
    first_abs_us: int,
    period_us: int,
    default_exposure_us: int,
    default_gain: float,
) -> VideoCut:
    """Cut a run out of what a ring held: from the last keyframe at or before ``start_ns`` to ``end_ns``.

    Parameters
    ----------
    packets, metadata : sequences, as from `FrameRing.snapshot`
    start_ns, end_ns : int, ns, CLOCK_MONOTONIC
        Pictures are placed by SensorTimestamp.
    first_abs_us : int, us
        Stamp of the first encoded picture since the camera started; presentation times count from it.
    period_us : int, us
        The frame period that was set; used where there are too few pictures to tell.
    default_exposure_us, default_gain
        What a frame record holds where the metadata were lost (flagged).

    Returns
    -------
    VideoCut
        Empty, with the reason among its problems, where no keyframe lies before ``end_ns``.
    """
    problems: list[str] = []
    ordered, n_disordered = _in_order(packets)
    if n_disordered:
        problems.append(f"video: {n_disordered} pictures did not come after the one before and were left out")
    start_us, end_us = start_ns // 1000, end_ns // 1000
    in_reach = [i for i, p in enumerate(ordered) if p.keyframe and p.abs_us <= end_us]
    if not in_reach:
        problems.append("video: no picture that can be decoded lies in the run's window")
        return VideoCut([], [], 0, 0, problems)
    before = [i for i in in_reach if ordered[i].abs_us <= start_us]
    first = before[-1] if before else in_reach[0]
    cut = [p for p in ordered[first:] if p.abs_us <= end_us]

    gaps_us = [b.abs_us - a.abs_us for a, b in pairwise(cut)]
    # A camera's true period differs from the one asked for by whole sensor lines: take it from the pictures,
    # unless so many are missing that the median gap is no period any more.
    period = median(gaps_us) if len(gaps_us) >= 8 else period_us
    if abs(period - period_us) > 0.2 * period_us:
        period = period_us
    if not before:
        late_ms = (cut[0].abs_us - start_us) / 1000
        problems.append(f"video: begins {late_ms:.1f} ms after the run's window")
    silent_us = end_us - cut[-1].abs_us
    n_dropped = 0
    if silent_us > GAP_PERIODS * period:
        if ordered[-1].abs_us > end_us:  # the camera went on: frames are missing across the window's end
            n_dropped = int(silent_us / period)
        else:
            problems.append(f"video: ends {silent_us / 1000:.1f} ms before the run's window")
    n_without = 0
    offset = 0
    records: list[FrameRecord] = []
    joined = _join(cut, metadata)
    for i, (packet, of_frame) in enumerate(zip(cut, joined, strict=True)):
        flags = FrameFlag.NONE
        if i and gaps_us[i - 1] > GAP_PERIODS * period:
            flags |= FrameFlag.GAP_BEFORE
            n_dropped += max(1, round(gaps_us[i - 1] / period) - 1)
        if of_frame is None:
            flags |= FrameFlag.NO_METADATA
            n_without += 1
        records.append(
            FrameRecord(
                pts_us=packet.abs_us - first_abs_us,
                sensor_timestamp_ns=of_frame.sensor_timestamp_ns if of_frame else packet.abs_us * 1000,
                exposure_us=of_frame.exposure_us if of_frame else default_exposure_us,
                analogue_gain=of_frame.analogue_gain if of_frame else default_gain,
                keyframe=packet.keyframe,
                byte_offset=offset,
                n_bytes=len(packet.data),
                flags=int(flags),
            )
        )
        offset += len(packet.data)
    return VideoCut(cut, records, n_dropped, n_without, problems)


def _in_order(packets: Sequence[EncodedPacket]) -> tuple[list[EncodedPacket], int]:
    """Return the packets whose stamp lies after all before them and that hold bytes, and how many do not."""
    ordered: list[EncodedPacket] = []
    for packet in packets:
        if packet.data and (not ordered or packet.abs_us > ordered[-1].abs_us):
            ordered.append(packet)
    return ordered, len(packets) - len(ordered)


def _join(packets: Sequence[EncodedPacket], metadata: Sequence[FrameMetadata]) -> list[FrameMetadata | None]:
    """Return for each packet the metadata of the same frame, found by time stamp; each is used once."""
    by_time = sorted(metadata, key=lambda m: m.sensor_timestamp_ns)
    stamps = [m.sensor_timestamp_ns for m in by_time]
    used = [False] * len(stamps)
    found: list[FrameMetadata | None] = []
    for packet in packets:
        t_ns = packet.abs_us * 1000
        i = bisect_left(stamps, t_ns)
        near = [k for k in (i - 1, i) if 0 <= k < len(stamps) and not used[k]]
        best = min(near, key=lambda k: abs(stamps[k] - t_ns), default=None)
        if best is None or abs(stamps[best] - t_ns) > JOIN_TOLERANCE_NS:
            found.append(None)
            continue
        used[best] = True
        found.append(by_time[best])
    return found
