import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bricktrack_common.errors import BricktrackError, RunFormatError
from bricktrack_common.frame_times import (
    FRAMES_SCHEMA,
    FrameRecord,
    mid_exposure_ns,
    read_frames,
    write_frames,
)
from bricktrack_common.run_folder import EDGES_SCHEMA, read_edges, write_edges
from bricktrack_common.streams import read_stream


def frame(i, **changes):
    values = {
        "pts_us": 33327 * i,
        "sensor_timestamp_ns": 5_000_000_000_123 + 33_326_871 * i,
        "exposure_us": 4000,
        "analogue_gain": 1.5,
        "keyframe": i % 10 == 0,
        "byte_offset": 1000 * i,
        "n_bytes": 1000,
        "flags": 0,
    }
    return FrameRecord(**(values | changes))


@pytest.fixture
def frames_file(tmp_path):
    path = tmp_path / "frames.msgpack"
    with path.open("wb") as file:
        write_frames(file, [frame(i) for i in range(20)])
    return path


def test_frame_times_survive_the_disk_to_the_nanosecond(frames_file):
    times = read_frames(frames_file)
    assert times.n_frames == 20
    assert times.sensor_timestamp_ns[7] == 5_000_000_000_123 + 33_326_871 * 7
    assert times.keyframe.tolist() == [i % 10 == 0 for i in range(20)]
    assert times.leftover_bytes == 0


def test_a_cut_stream_gives_its_whole_records_and_says_what_is_left_over(frames_file):
    whole = frames_file.read_bytes()
    frames_file.write_bytes(whole[:-7])
    times = read_frames(frames_file)
    assert times.n_frames == 19
    assert 0 < times.leftover_bytes < len(whole) // 20


def test_a_newer_version_is_refused_by_name(tmp_path):
    path = tmp_path / "edges.msgpack"
    path.write_bytes(
        msgpack.packb({"schema": "bricktrack.edges", "version": 2, "fields": ["t_ns"], "meta": {}})
    )
    with pytest.raises(
        RunFormatError, match=r"bricktrack.edges version 2; this bricktrack reads up to version 1"
    ):
        read_edges(path)


def test_another_stream_is_not_taken_for_this_one(frames_file):
    with pytest.raises(RunFormatError, match=r"not a bricktrack\.edges stream"):
        read_edges(frames_file)


@pytest.mark.parametrize(
    ("records", "words"),
    [
        ([frame(1), frame(0)], "pts_us of frame 1 does not come after"),
        ([frame(0), frame(1, sensor_timestamp_ns=0)], "sensor_timestamp_ns of frame 1 does not come after"),
        ([frame(0), frame(1, byte_offset=999)], "byte offsets do not follow on"),
        ([frame(1)], "byte offsets do not follow on"),
    ],
)
def test_frames_out_of_order_are_refused(tmp_path, records, words):
    path = tmp_path / "frames.msgpack"
    with path.open("wb") as file:
        write_frames(file, records)
    with pytest.raises(RunFormatError, match=words):
        read_frames(path)


def test_edges_must_be_in_order(tmp_path):
    path = tmp_path / "edges.msgpack"
    with path.open("wb") as file:
        write_edges(file, np.array([5, 4], dtype=np.int64))
    with pytest.raises(RunFormatError, match="edge 1 does not come after"):
        read_edges(path)


def test_damage_inside_is_an_error_and_not_a_cut(frames_file):
    data = bytearray(frames_file.read_bytes())
    data[data.rindex(b"\x98")] = 0xC1  # the last record's array mark, now a byte that msgpack never uses
    frames_file.write_bytes(bytes(data))
    with pytest.raises(RunFormatError, match=r"damaged at byte \d+, after 19 records"):
        read_frames(frames_file)


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=200), after_header=st.booleans())
def test_arbitrary_bytes_never_escape_as_another_error(tmp_path_factory, data, after_header):
    header = msgpack.packb(
        {
            "schema": FRAMES_SCHEMA.name,
            "version": 1,
            "fields": [f.name for f in FRAMES_SCHEMA.fields],
            "meta": {},
        }
    )
    path = tmp_path_factory.mktemp("fuzz") / "frames.msgpack"
    path.write_bytes((header if after_header else b"") + data)
    for read in (read_frames, read_edges, lambda p: read_stream(p, EDGES_SCHEMA)):
        try:
            read(path)
        except BricktrackError as e:
            assert str(path) in str(e)


def test_mid_exposure_is_before_the_read_out_of_its_row():
    # 4 ms exposure, row 539.5 of the IMX219 crop: -2 ms + 539.5 * 18.9035 us (the sample's rig.toml)
    t = mid_exposure_ns(np.int64(5118442907613), np.int64(4_000_000), np.float64(539.5 * 18903.5))
    assert int(t) == 5118442907613 + 8_198_438
