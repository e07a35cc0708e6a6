"""Cutting byte streams into pictures: hand-made NAL units, and streams of x264 cut by FFmpeg's own parser."""

import mmap

import av
import pytest
from small_videos import write_video

from bricktrack_common.errors import VideoError
from bricktrack_host.recordings.annex_b import AccessUnit, split_access_units

SPS, PPS, SEI, AUD = b"\x67sps", b"\x68pps", b"\x06sei", b"\x09\x10"
IDR, P = b"\x65\x88data", b"\x41\x9adata"  # first bit after the header is 1: first_mb_in_slice == 0
IDR_MORE, P_MORE = b"\x65\x08data", b"\x41\x1adata"  # a later slice of the same picture


def stream(*nals, code=b"\0\0\0\1"):
    return b"".join(code + n for n in nals)


def test_parameter_sets_belong_to_the_picture_behind_them():
    data = stream(SPS, PPS, SEI, IDR) + stream(P) + stream(SEI, P) + stream(SPS, PPS, IDR)
    lengths = [
        len(stream(SPS, PPS, SEI, IDR)),
        len(stream(P)),
        len(stream(SEI, P)),
        len(stream(SPS, PPS, IDR)),
    ]
    units = split_access_units(data)
    assert [u.n_bytes for u in units] == lengths
    assert [u.keyframe for u in units] == [True, False, False, True]
    assert [u.byte_offset for u in units] == [sum(lengths[:i]) for i in range(4)]


def test_slices_of_one_picture_stay_together():
    data = stream(SPS, PPS, IDR, IDR_MORE, IDR_MORE) + stream(P, P_MORE)
    assert [u.n_bytes for u in split_access_units(data)] == [
        len(stream(SPS, PPS, IDR, IDR_MORE, IDR_MORE)),
        len(stream(P, P_MORE)),
    ]


def test_delimiters_and_three_byte_codes():
    first = stream(AUD, SPS, PPS) + stream(IDR, code=b"\0\0\1")
    second = stream(AUD) + stream(P, code=b"\0\0\1")
    assert split_access_units(first + second) == [
        AccessUnit(0, len(first), True),
        AccessUnit(len(first), len(second), False),
    ]


def test_the_last_picture_keeps_what_trails_it():
    data = stream(SPS, PPS, IDR) + b"\0\0\0"
    assert split_access_units(data) == [AccessUnit(0, len(data), True)]


def test_a_stream_cut_in_a_start_code_loses_no_picture():
    data = stream(SPS, PPS, IDR) + stream(P)
    assert len(split_access_units(data + b"\0\0\1")) == 2


@pytest.mark.parametrize("data", [b"", b"\0\0", b"ftypmp42", stream(SPS, PPS), b"RIFF" + stream(IDR)])
def test_what_is_no_stream_of_pictures_is_refused(data):
    with pytest.raises(VideoError):
        split_access_units(data)


@pytest.mark.parametrize(
    "options", [{}, {"x264-params": "slices=4:aud=1"}, {"x264-params": "sliced-threads=1"}]
)
def test_agrees_with_ffmpegs_parser(tmp_path, options):
    path = tmp_path / "v.h264"
    write_video(path, 25, gop=8, options=options)
    with av.open(str(path)) as container:
        packets = [(p.size, p.is_keyframe) for p in container.demux(video=0) if p.size]
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        units = split_access_units(data)
    assert [(u.n_bytes, u.keyframe) for u in units] == packets
    assert sum(u.keyframe for u in units) == 4  # 25 pictures, one keyframe every 8
