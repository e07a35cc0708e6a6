"""A video made by other means, as an Annex-B stream of counted pictures in the order of time."""

import logging
from dataclasses import dataclass
from pathlib import Path

import av
import numpy as np
from av.bitstream import BitStreamFilterContext
from av.video.stream import VideoStream

from bricktrack_common.arrays import IntArray
from bricktrack_common.errors import VideoError
from bricktrack_host.recordings.annex_b import NAL_IDR, AccessUnit, iter_nal_units, split_access_units
from bricktrack_host.recordings.h264_headers import PictureOrder
from bricktrack_host.recordings.video_frames import REENCODE

logger = logging.getLogger(__name__)

_PIXEL_FORMATS = ("yuv420p", "yuvj420p")
_START_CODES = (b"\x00\x00\x01", b"\x00\x00\x00\x01")


@dataclass(frozen=True, slots=True, eq=False)
class LooseVideo:
    """A video as a byte stream.

    Attributes
    ----------
    data : bytes
        H.264, Annex B.
    units : list of AccessUnit
        Its pictures.
    container_us : ndarray of int64, shape (n,), us, or None
        The container's own times of the pictures from its first; `None` for a bare stream.
    width, height : int, px
    color_range : str
        ``"limited"``, ``"full"`` or ``"unknown"``, as the stream says.
    problems : list of str
        What is wrong with the stream and yet can be lived with.
    """

    data: bytes
    units: list[AccessUnit]
    container_us: IntArray | None
    width: int
    height: int
    color_range: str
    problems: list[str]


def load_video(path: Path) -> LooseVideo:
    """Return a video's pictures as an Annex-B stream: bare ``.h264`` as it is, MP4 and MKV repacked.

    Raises
    ------
    VideoError
        If it cannot be read, is not H.264 of 8-bit YUV 4:2:0, does not begin with a keyframe, or its
        pictures are not stored in the order of time (B pictures).
    """
    try:
        with path.open("rb") as file:
            head = file.read(4)
    except OSError as e:
        raise VideoError(f"{path}: {e.strerror or e}") from e
    if not head:
        raise VideoError(f"{path}: the file is empty; expected an H.264 video. Copy it again")
    bare = head.startswith(_START_CODES)
    width, height, color_range = _probe(path, bare=bare)
    container_us = None
    if bare:
        data = path.read_bytes()
        try:
            units = split_access_units(data)
        except VideoError as e:
            raise VideoError(f"{path}: {e}") from e
    else:
        data, units, container_us = _repack(path)
    problems = _check_order(path, data, units)
    return LooseVideo(data, units, container_us, width, height, color_range, problems)


def _probe(path: Path, *, bare: bool) -> tuple[int, int, str]:
    try:
        with av.open(str(path), format="h264" if bare else None) as container:
            if not container.streams.video:
                raise VideoError(f"{path}: no video in this file")
            stream = container.streams.video[0]
            codec = stream.codec_context
            if codec.name != "h264":
                raise VideoError(f"{path}: the video is {codec.name}; a run holds H.264. {REENCODE}")
            if codec.pix_fmt not in _PIXEL_FORMATS:
                raise VideoError(
                    f"{path}: pictures are {codec.pix_fmt}; expected 8-bit YUV 4:2:0. {REENCODE}"
                )
            full = codec.pix_fmt == "yuvj420p" or codec.color_range == 2
            known = "limited" if codec.color_range == 1 else "unknown"
            return codec.width, codec.height, "full" if full else known
    except av.error.FFmpegError as e:
        raise VideoError(
            f"{path}: no video that can be read: {e.strerror}. Expected H.264: bare (.h264), or in MP4 or MKV"
        ) from e


def _repack(path: Path) -> tuple[bytes, list[AccessUnit], IntArray]:
    """Take the packets out of a container, one picture each, with the container's times."""
    chunks: list[bytes] = []
    units: list[AccessUnit] = []
    pts: list[int] = []
    offset = 0
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        to_annex_b = BitStreamFilterContext("h264_mp4toannexb", stream)
        time_base = stream.time_base
        for packet in _packets(path, container, stream, to_annex_b):
            if packet.pts is None:
                raise VideoError(f"{path}: picture {len(units)} has no time in the container. {REENCODE}")
            chunk = bytes(packet)
            chunks.append(chunk)
            # The container's own flag may also mark pictures that later ones look back past.
            keyframe = any(n.nal_type == NAL_IDR for n in iter_nal_units(chunk))
            units.append(AccessUnit(offset, len(chunk), keyframe))
            pts.append(packet.pts)
            offset += len(chunk)
    if not units or time_base is None:
        raise VideoError(f"{path}: the video holds no picture")
    ticks = np.array(pts, dtype=np.int64)
    if ticks.size > 1 and np.diff(ticks).min() <= 0:
        raise VideoError(f"{path}: pictures are not stored in the order of time (B pictures). {REENCODE}")
    container_us = np.rint((ticks - ticks[0]) * (1e6 * time_base.numerator / time_base.denominator))
    return b"".join(chunks), units, container_us.astype(np.int64)


def _packets(
    path: Path,
    container: av.container.InputContainer,
    stream: VideoStream,
    to_annex_b: BitStreamFilterContext,
) -> "list[av.Packet[VideoStream]]":
    out: list[av.Packet[VideoStream]] = []
    try:
        for packet in container.demux(stream):
            if packet.size:
                out += to_annex_b.filter(packet)
        out += to_annex_b.filter(None)
    except av.error.FFmpegError as e:
        raise VideoError(
            f"{path}: damaged after picture {len(out)}: {e.strerror}. Rescue what is whole with 'ffmpeg "
            "-i IN -c copy OUT.mp4' and import that"
        ) from e
    return out


def _check_order(path: Path, data: bytes, units: list[AccessUnit]) -> list[str]:
    order = PictureOrder()
    gaps: list[int] = []
    for i, unit in enumerate(units):
        follows, is_idr = order.check(data[unit.byte_offset : unit.byte_offset + unit.n_bytes])
        if i == 0 and not is_idr:
            raise VideoError(
                f"{path}: the first picture is no keyframe, so nothing before the next one can be decoded. "
                "Cut the video at a keyframe, and its time stamps with it"
            )
        if order.sequence is not None and not order.sequence.frames_only:
            raise VideoError(f"{path}: the video is interlaced; its rows have no single order of time")
        if order.n_b_pictures:
            raise VideoError(
                f"{path}: picture {i} is a B picture: not stored in the order of time. {REENCODE}"
            )
        if follows != "follows":
            gaps.append(i)
    if not gaps:
        return []
    return [
        f"the video lacks encoded pictures before picture {', '.join(map(str, gaps[:5]))}"
        f"{' and others' if len(gaps) > 5 else ''}: what is predicted from them is lost"
    ]
