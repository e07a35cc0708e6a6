"""Header fields against streams whose encoder settings are known, and numbers worked out by hand."""

import pytest
from small_videos import write_video

from bricktrack_common.errors import VideoError
from bricktrack_host.recordings.annex_b import NAL_SPS, iter_nal_units, split_access_units
from bricktrack_host.recordings.h264_headers import PictureOrder, _Bits, parse_sequence_parameters


def units_of(path):
    data = path.read_bytes()
    return [data[u.byte_offset : u.byte_offset + u.n_bytes] for u in split_access_units(data)]


def test_exp_golomb_numbers_are_those_of_the_standards_table():
    # ITU-T H.264 table 9-2: 1, 010, 011, 00100 code 0, 1, 2, 3; signed 0, 1, -1, 2 (table 9-3).
    bits = _Bits(bytes([0b1_010_011_0, 0b0100_1_010, 0b011_00100]))
    assert [bits.ue() for _ in range(4)] == [0, 1, 2, 3]
    assert [bits.se() for _ in range(4)] == [0, 1, -1, 2]
    with pytest.raises(VideoError):
        bits.u(1)


def test_emulation_prevention_is_taken_out():
    assert _Bits(b"\x00\x00\x03\x01").u(24) == 1


def test_profiles_and_interlacing_are_read(tmp_path):
    for profile, options in (("baseline", {}), ("high", {}), ("high", {"x264-params": "interlaced=1"})):
        path = tmp_path / "v.h264"
        write_video(path, 3, options={"profile": profile} | options)
        data = path.read_bytes()
        nal = next(n for n in iter_nal_units(data) if n.nal_type == NAL_SPS)
        sequence = parse_sequence_parameters(data[nal.header : nal.header + 100])
        assert 4 <= sequence.log2_max_frame_num <= 16
        assert sequence.frames_only == (not options)
        assert not sequence.gaps_allowed


@pytest.mark.parametrize("options", [{}, {"x264-params": "slices=3"}, {"refs": "4"}, {"profile": "baseline"}])
def test_a_whole_stream_has_no_gap_and_every_missing_picture_makes_one(tmp_path, options):
    path = tmp_path / "v.h264"
    write_video(path, 45, gop=20, options=options)
    units = units_of(path)
    order = PictureOrder()
    assert [order.check(u) for u in units] == [("follows", i % 20 == 0) for i in range(45)]
    assert order.n_b_pictures == 0
    for missing in (1, 17, 18, 39 - 1):
        order = PictureOrder()
        seen = [order.check(u)[0] for i, u in enumerate(units) if i != missing]
        assert seen.index("gap") == missing


def test_b_pictures_are_noticed(tmp_path):
    path = tmp_path / "v.h264"
    write_video(path, 30, options={"bf": "2", "b_strategy": "0"})
    order = PictureOrder()
    assert [order.check(u)[0] for u in units_of(path)].count("gap") == 0
    assert order.n_b_pictures > 5


def test_noise_is_unreadable_and_raises_nothing():
    import random

    draw = random.Random(3)
    order = PictureOrder()
    for _ in range(300):
        header = draw.choice([b"\0\0\1\x67", b"\0\0\1\x41", b"\0\0\1\x65", b""])
        order.check(header + draw.randbytes(draw.randrange(40)))
