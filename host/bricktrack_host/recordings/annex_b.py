"""H.264 byte streams (Annex B) cut into access units: one encoded picture each, with its parameter sets."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from mmap import mmap
from typing import Literal

from bricktrack_common.errors import VideoError

Buffer = bytes | bytearray | memoryview | mmap

_START_CODE = re.compile(b"\x00\x00\x01")
NAL_SLICE, NAL_SLICE_A, NAL_IDR, NAL_SEI, NAL_SPS, NAL_PPS, NAL_AUD = 1, 2, 5, 6, 7, 8, 9
_SLICES = (NAL_SLICE, NAL_SLICE_A, NAL_IDR)
# ITU-T H.264 7.4.1.2.3: these begin the next access unit when they come after a picture's last slice.
_OPENS_UNIT = (NAL_SEI, NAL_SPS, NAL_PPS, NAL_AUD, 14, 15, 16, 17, 18)


@dataclass(frozen=True, slots=True)
class NalUnit:
    """One NAL unit's place in the stream.

    Attributes
    ----------
    offset : int, bytes
        Where its start code begins, with the zero byte of a four-byte one.
    header : int, bytes
        Where its header byte stands, behind the start code.
    nal_type, ref_idc : int
        As in the header byte; a ``ref_idc`` of 0 means that no other picture refers to this one.
    """

    offset: int
    header: int
    nal_type: int
    ref_idc: int


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """One encoded picture.

    Attributes
    ----------
    byte_offset, n_bytes : int, bytes
        Its place; the units of a stream follow on from each other without a gap.
    keyframe : bool
        Whether it is an IDR picture: decoding can begin here, and nothing refers to what was before.
    """

    byte_offset: int
    n_bytes: int
    keyframe: bool


def iter_nal_units(data: Buffer) -> Iterator[NalUnit]:
    """Yield the NAL units of a stream in order; a start code at the very end without a header is left out."""
    for match in _START_CODE.finditer(data):
        header = match.end()
        if header >= len(data):
            return
        start = match.start()
        if start and data[start - 1] == 0:
            start -= 1
        yield NalUnit(start, header, data[header] & 0x1F, data[header] >> 5 & 3)


def split_access_units(data: Buffer) -> list[AccessUnit]:
    """Return the encoded pictures of an Annex-B stream.

    A picture begins at its access unit delimiter, parameter sets or SEI where it has them, else at its
    first slice, which is the one whose ``first_mb_in_slice`` is 0. Parameter sets after the last picture
    are counted to that picture.

    Raises
    ------
    VideoError
        If the data do not begin with a start code, or hold no picture.
    """
    head = data[:4]
    if not (head[:3] == b"\0\0\1" or head == b"\0\0\0\1"):
        raise VideoError(
            f"not an H.264 byte stream (Annex B): it begins with {bytes(head).hex()}, not with a start code. "
            "Give the .h264 file as recorded, or an MP4 or MKV"
        )
    starts: list[int] = []
    keyframes: list[bool] = []
    state: Literal["before", "prefix", "slices"] = "before"
    prefix = 0
    for nal in iter_nal_units(data):
        if nal.nal_type in _SLICES:
            # ue(v) 0 is the single bit 1.
            first = nal.header + 1 < len(data) and data[nal.header + 1] & 0x80 != 0
            if state == "prefix" or first or not starts:
                starts.append(prefix if state == "prefix" else nal.offset)
                keyframes.append(nal.nal_type == NAL_IDR)
            state = "slices"
        elif nal.nal_type in _OPENS_UNIT and state != "prefix":
            prefix = nal.offset
            state = "prefix"
    if not starts:
        raise VideoError("the H.264 stream holds no picture")
    starts[0] = 0
    ends = [*starts[1:], len(data)]
    return [AccessUnit(a, b - a, k) for a, b, k in zip(starts, ends, keyframes, strict=True)]
