"""Decoded pictures of a run, each paired with its own record of time; what cannot be trusted is called lost.

A decoder conceals damage: it invents what is missing and goes on. Here a picture counts only if its bytes
were all there and decoded without an error, and so did every picture back to its keyframe.
"""

import logging
import os
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import av
import numpy as np
from av.codec.context import ThreadType
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.plane import VideoPlane

from bricktrack_common.errors import VideoError
from bricktrack_common.frame_times import FrameTimes
from bricktrack_host.quality import PoseFlag
from bricktrack_host.recordings.h264_headers import PictureOrder
from bricktrack_host.tracking.pictures.segment import Picture, Plane

logger = logging.getLogger(__name__)

ColorRange = Literal["limited", "full", "unknown"]
_COLOR_RANGES: dict[int, ColorRange] = {1: "limited", 2: "full"}  # AVCOL_RANGE_MPEG, AVCOL_RANGE_JPEG
_PIXEL_FORMATS = ("yuv420p", "yuvj420p")
REENCODE = (
    "Encode it again with 'ffmpeg -i IN -fps_mode passthrough -c:v libx264 -crf 12 -bf 0 "
    "-pix_fmt yuv420p OUT.mp4'"
)
_MAX_DECODER_ERRORS_AT_END = 64  # more than any frame-threaded decoder holds back


@dataclass(frozen=True, slots=True, eq=False)
class DecodedFrame:
    """One frame record with its picture, or with the reason why there is none.

    Attributes
    ----------
    index : int
        The frame's place in `FrameTimes`; every index comes once, in order.
    sensor_timestamp_ns : int, ns, CLOCK_MONOTONIC
        Start of read-out of the first row.
    exposure_us : int, us
    picture : Picture or None
        Views of the decoder's own planes: read-only, and to be copied if kept beyond a few frames.
    lost_because : str
        Why there is no picture, in words; ``""`` where there is one.
    color_range : "limited", "full" or "unknown"
        What luma 16..235 or 0..255 the stream says it uses; ``"unknown"`` also where the picture is lost.
    """

    index: int
    sensor_timestamp_ns: int
    exposure_us: int
    picture: Picture | None
    lost_because: str = ""
    color_range: ColorRange = "unknown"

    @property
    def flags(self) -> int:
        """`PoseFlag.FRAME_LOST` where there is no picture, else 0."""
        return 0 if self.picture is not None else int(PoseFlag.FRAME_LOST)


def decode_run_video(
    video: Path,
    frames: FrameTimes,
    *,
    threads: int = 2,
    part: range | None = None,
    decoder: VideoCodecContext | None = None,
) -> Generator[DecodedFrame, None, None]:
    """Yield every frame of a run, or of a part of it, in order, decoded or lost.

    Packets are cut from the file by the byte offsets of ``frames`` and carry their index through the decoder,
    so a picture is paired with its record by value and never by counting. Only the decoder's own pictures
    are held in memory; of the file no more than a packet.

    A decoder does not notice all damage: of 20 random bytes put at random into small pictures, a fifth
    decoded without an error. Compare the file's SHA-256 first (`read_run` with ``verify_hashes``).

    Parameters
    ----------
    video : Path
        H.264, Annex B.
    frames : FrameTimes
        As `bricktrack_common.frame_times.read_frames` returns them.
    threads : int
        Of the decoder.
    part : range, optional
        Indices of frames, which begin where prediction begins anew; see `video_parts`. All if not given.
    decoder : VideoCodecContext, optional
        Of `open_decoder`, that decoded another part before: its memory serves again. A new one if not given.

    Raises
    ------
    VideoError
        If the file cannot be opened, its pictures are not 8-bit YUV 4:2:0 or change size, or they come out
        in another order than they were stored in (B pictures).
    """
    part = range(frames.n_frames) if part is None else part
    if not part:
        return
    try:
        with video.open("rb") as file:
            yield from _Decoding(video, frames, part, decoder or open_decoder(threads)).run(file)
    except OSError as e:
        raise VideoError(f"{video}: {e.strerror or e}") from e


class _Decoding:
    """One pass over a video: what was fed, what was lost, what came out."""

    def __init__(self, video: Path, frames: FrameTimes, part: range, decoder: VideoCodecContext) -> None:
        self._video = video
        self._frames = frames
        self._part = part
        self._cut: dict[int, str] = {}  # never fed
        self._gaps: set[int] = set()  # predicted from a picture that the file does not hold
        self._restarts: set[int] = set()
        self._order = PictureOrder()
        self._next = part.start
        self._chain = ""  # why pictures until the next keyframe are lost; empty while all is well
        self._size: tuple[int, int] | None = None
        self._codec = decoder

    def run(self, file: BinaryIO) -> Iterator[DecodedFrame]:
        if os.fstat(file.fileno()).st_size == 0:
            raise VideoError(f"{self._video}: the file is empty")
        for i in self._part:
            n_bytes = int(self._frames.n_bytes[i])
            file.seek(int(self._frames.byte_offset[i]))
            unit = file.read(n_bytes)
            if len(unit) < n_bytes:
                size = os.fstat(file.fileno()).st_size
                self._cut[i] = f"the video file ends at byte {size}, before this frame does"
                continue
            follows, is_restart = self._order.check(unit)
            if follows == "gap":
                self._gaps.add(i)
            if is_restart and self._frames.keyframe[i]:  # both: one alone may be a damaged header
                self._restarts.add(i)
            packet = av.Packet(unit)
            packet.pts = packet.dts = i
            try:
                decoded = self._codec.decode(packet)
            except av.error.FFmpegError as e:  # of this packet or, with threads, of one shortly before
                logger.debug("%s: decoder at frame %d: %s", self._video, i, e)
                continue
            yield from self._take(decoded)
        yield from self._flush()

    def _flush(self) -> Iterator[DecodedFrame]:
        for _ in range(_MAX_DECODER_ERRORS_AT_END):
            try:
                decoded = self._codec.decode(None)
            except av.error.EOFError:
                break
            except av.error.FFmpegError as e:
                logger.debug("%s: decoder at the end: %s", self._video, e)
                continue
            yield from self._take(decoded)
            break
        for i in range(self._next, self._part.stop):
            yield self._lose(i, "its bytes are damaged: the decoder gave no picture")

    def _take(self, decoded: list[VideoFrame]) -> Iterator[DecodedFrame]:
        for frame in decoded:
            i = frame.pts
            if i is None or not self._next <= i < self._part.stop:
                if self._order.n_b_pictures >= 2:  # one alone may be a damaged header
                    raise VideoError(
                        f"{self._video}: not stored in the order of time (B pictures). {REENCODE}"
                    )
                logger.debug("%s: picture %s came after %d was given up", self._video, i, self._next - 1)
                continue
            while self._next < i:
                yield self._lose(self._next, "its bytes are damaged: the decoder gave no picture")
            if frame.is_corrupt:
                yield self._lose(i, "its bytes are damaged: the decoder had to conceal")
            elif i in self._gaps or (self._chain and i not in self._restarts):
                yield self._lose(i, "")
            else:
                yield self._found(i, frame)

    def _found(self, i: int, frame: VideoFrame) -> DecodedFrame:
        if frame.format.name not in _PIXEL_FORMATS:
            raise VideoError(
                f"{self._video}: pictures are {frame.format.name}; expected 8-bit YUV 4:2:0 (yuv420p). "
                + REENCODE
            )
        size = (frame.width, frame.height)
        if self._size not in (None, size):
            raise VideoError(
                f"{self._video}: frame {i} is {size[0]} x {size[1]} px; those before were {self._size}"
            )
        self._size = size
        self._chain = ""
        self._next = i + 1
        color_range = "full" if frame.format.name == "yuvj420p" else _COLOR_RANGES.get(frame.color_range)
        return DecodedFrame(
            i,
            int(self._frames.sensor_timestamp_ns[i]),
            int(self._frames.exposure_us[i]),
            Picture(*map(_plane_view, frame.planes)),
            color_range=color_range or "unknown",
        )

    def _lose(self, i: int, reason: str) -> DecodedFrame:
        if i in self._restarts:
            self._chain = ""
        if i in self._cut:
            reason = self._cut.pop(i)
        elif not reason and self._chain:
            reason = f"predicted from frame {self._chain}, which is lost"
        elif i in self._gaps:
            reason = "a picture that it is predicted from is not in the file"
        if not self._chain:
            self._chain = str(i)
        self._next = i + 1
        return DecodedFrame(
            i, int(self._frames.sensor_timestamp_ns[i]), int(self._frames.exposure_us[i]), None, reason
        )


def open_decoder(threads: int) -> VideoCodecContext:
    """Return a decoder of H.264 with so many threads of its own."""
    codec = av.CodecContext.create("h264", "r")
    if not isinstance(codec, VideoCodecContext):
        raise VideoError("this PyAV has no H.264 decoder. Install the 'av' wheel from PyPI")
    codec.thread_type = ThreadType.AUTO
    codec.thread_count = threads
    return codec


def _plane_view(plane: VideoPlane) -> Plane:
    """Return a plane without a copy; its rows are ``line_size`` bytes apart."""
    stride, rows = plane.line_size, plane.height
    whole: Plane = np.frombuffer(memoryview(plane), dtype=np.uint8, count=stride * rows)
    view = whole.reshape(rows, stride)[:, : plane.width]
    view.flags.writeable = False  # later pictures are predicted from this memory
    return view
