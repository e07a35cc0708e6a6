"""Every picture stands with its own record, whatever happens to its neighbours."""

import io
import os

import numpy as np
import pytest
from small_videos import HEIGHT, WIDTH, damage, frame_times, grey_of, write_cut_scenes, write_video

from bricktrack_common.errors import VideoError
from bricktrack_host.quality import PoseFlag
from bricktrack_host.recordings.video_frames import decode_run_video

N, GOP = 32, 8
MEAN_TOLERANCE = 3  # grey levels; CRF 18 errs by less than one, neighbours differ by 37


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "video.h264"
    write_video(path, N, gop=GOP)
    return path, frame_times(path)


def check(path, frames, *, threads=2):
    """Decode; make sure that every picture is the one its index says; return the lost ones with reasons."""
    lost = {}
    indices = []
    for frame in decode_run_video(path, frames, threads=threads):
        indices.append(frame.index)
        assert frame.sensor_timestamp_ns == frames.sensor_timestamp_ns[frame.index]
        if frame.picture is None:
            assert frame.flags == PoseFlag.FRAME_LOST
            lost[frame.index] = frame.lost_because
        else:
            assert frame.flags == 0
            assert frame.lost_because == ""
            assert abs(float(frame.picture.luma.mean()) - grey_of(frame.index)) < MEAN_TOLERANCE
    assert indices == list(range(frames.n_frames))
    return lost


def until_keyframe(i):
    return list(range(i, (i // GOP + 1) * GOP))


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_a_sound_video_gives_every_picture(video, threads):
    assert check(*video, threads=threads) == {}


def test_planes_are_read_only_views_of_the_pictures_size(video):
    frame = next(decode_run_video(*video))
    planes = (frame.picture.luma, frame.picture.chroma_u, frame.picture.chroma_v)
    assert [p.shape for p in planes] == [
        (HEIGHT, WIDTH),
        (HEIGHT // 2, WIDTH // 2),
        (HEIGHT // 2, WIDTH // 2),
    ]
    assert not any(p.flags.owndata or p.flags.writeable for p in planes)
    assert abs(int(planes[1].mean()) - 128) <= 1


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    "change",
    [
        lambda b: b[:40] + bytes(len(b) - 40),
        lambda b: b[:60] + bytes(x ^ 0x55 for x in b[60:]),
        lambda b: bytes(len(b)),
        lambda b: b"\xff" * len(b),
    ],
    ids=["tail blank", "tail flipped", "all blank", "all ones"],
)
def test_a_damaged_picture_is_lost_with_all_that_is_predicted_from_it(video, change, threads):
    path, frames = video
    damage(path, frames, 11, change)
    lost = check(path, frames, threads=threads)
    assert list(lost) == until_keyframe(11)
    assert "damaged" in lost[11]
    assert lost[12] == "predicted from frame 11, which is lost"


def test_a_damaged_keyframe_loses_its_group_only(video):
    path, frames = video
    damage(path, frames, 8, lambda b: b[:60] + bytes(len(b) - 60))
    assert list(check(path, frames)) == until_keyframe(8)


def test_damage_in_the_last_picture_loses_it_alone(video):
    path, frames = video
    damage(path, frames, N - 1, lambda b: bytes(len(b)))
    assert list(check(path, frames)) == [N - 1]


def test_a_video_cut_in_the_middle_of_a_picture_ends_there(video):
    path, frames = video
    cut = int(frames.byte_offset[20]) + 30
    path.write_bytes(path.read_bytes()[:cut])
    lost = check(path, frames)
    assert list(lost) == list(range(20, N))
    assert lost[20] == f"the video file ends at byte {cut}, before this frame does"


def test_a_file_that_is_cut_while_it_is_read_loses_its_end_and_not_the_process(video):
    """Of a mapped file, the pages that are gone would end the process."""
    path, frames = video
    assert frames.byte_offset[19] > 2 * io.DEFAULT_BUFFER_SIZE  # else it is read before it is cut
    decoding = decode_run_video(path, frames)
    assert next(decoding).picture is not None
    cut = int(frames.byte_offset[20] - 1)
    os.truncate(path, cut)
    lost = {f.index: f.lost_because for f in decoding if f.picture is None}
    assert min(lost) == 19
    assert lost[19] == f"the video file ends at byte {cut}, before this frame does"


def test_a_picture_that_never_was_written_loses_what_is_predicted_from_it(video):
    """The decoder would invent it and say nothing."""
    path, frames = video
    data = path.read_bytes()
    keep = [i for i in range(N) if i != 12]
    path.write_bytes(
        b"".join(data[frames.byte_offset[i] : frames.byte_offset[i] + frames.n_bytes[i]] for i in keep)
    )
    shorter = frame_times(path)
    lost = {f.index: f.lost_because for f in decode_run_video(path, shorter) if f.picture is None}
    assert list(lost) == [12, 13, 14]  # pictures 13, 14 and 15 of the scene
    assert lost[12] == "a picture that it is predicted from is not in the file"


def test_a_video_that_begins_without_a_keyframe_starts_at_the_next(video):
    path, frames = video
    path.write_bytes(path.read_bytes()[frames.byte_offset[3] :])
    lost = [f.index for f in decode_run_video(path, frame_times(path)) if f.picture is None]
    assert lost == list(range(GOP - 3))


@pytest.mark.parametrize("seed", range(6))
def test_no_damage_ever_puts_a_picture_at_a_wrong_time(video, seed):
    """Random bytes at random places: what is not lost must look like its own picture and no other."""
    path, frames = video
    draw = np.random.default_rng(seed)
    data = bytearray(path.read_bytes())
    for _ in range(int(draw.integers(1, 8))):
        at, n = int(draw.integers(len(data) - 40)), int(draw.integers(4, 40))
        data[at : at + n] = draw.bytes(n)
    path.write_bytes(data)
    check(path, frames)


@pytest.mark.parametrize(
    ("x264", "expected"),
    [
        ("fullrange=on", "full"),
        ("fullrange=off:colorprim=smpte170m", "limited"),
        ("fullrange=off", "unknown"),
    ],
)
def test_the_range_is_stated_as_the_stream_says_it(tmp_path, x264, expected):
    path = tmp_path / "video.h264"
    write_video(path, 2, options={"x264-params": x264})
    assert {f.color_range for f in decode_run_video(path, frame_times(path))} == {expected}


def test_b_pictures_are_refused(tmp_path):
    path = tmp_path / "video.h264"
    write_video(path, 30, options={"bf": "2", "b_strategy": "0"})
    with pytest.raises(VideoError, match=r"B pictures.*ffmpeg"):
        list(decode_run_video(path, frame_times(path)))


def test_a_missing_and_an_empty_file_are_video_errors(tmp_path, video):
    with pytest.raises(VideoError, match="No such file"):
        list(decode_run_video(tmp_path / "none.h264", video[1]))
    (tmp_path / "empty.h264").touch()
    with pytest.raises(VideoError, match="empty"):
        list(decode_run_video(tmp_path / "empty.h264", video[1]))


def test_leaving_early_closes_the_file(video):
    frames = decode_run_video(*video)
    assert next(frames).index == 0
    frames.close()


@pytest.mark.parametrize(
    ("refs", "keyframe", "lost"),
    [(1, True, list(range(11, 16))), (3, True, list(range(11, N))), (1, False, list(range(11, N)))],
    ids=["one reference", "three references", "not said to be a keyframe"],
)
def test_an_intra_picture_ends_the_loss_only_if_nothing_can_look_past_it(tmp_path, refs, keyframe, lost):
    path = tmp_path / "video.h264"
    write_cut_scenes(path, refs)
    frames = frame_times(path)
    frames.keyframe[16] = keyframe
    clean = [f.picture.luma.copy() for f in decode_run_video(path, frames)]
    damage(path, frames, 11, lambda b: bytes(len(b)))
    seen = {f.index: f.picture for f in decode_run_video(path, frames)}
    assert [i for i, p in seen.items() if p is None] == lost
    assert all(
        np.array_equal(f.picture.luma, clean[f.index]) for f in decode_run_video(path, frames) if f.picture
    )
