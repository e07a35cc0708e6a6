"""Decoded in parts, side by side, a run gives what it gives in order: the same pictures, the same losses."""

import threading

import numpy as np
import pytest
from small_videos import damage, frame_times, write_cut_scenes, write_video

from bricktrack_common.errors import VideoError
from bricktrack_host.recordings.video_frames import decode_run_video
from bricktrack_host.recordings.video_parts import independent_parts, work_on_frames

N, GOP = 96, 4


@pytest.fixture(scope="module")
def encoded(tmp_path_factory):
    path = tmp_path_factory.mktemp("encoded") / "video.h264"
    write_video(path, N, gop=GOP)
    return path.read_bytes()


@pytest.fixture
def video(tmp_path, encoded):
    path = tmp_path / "video.h264"
    path.write_bytes(encoded)
    return path, frame_times(path)


def told(frame):
    """Return all that a frame holds, without its memory."""
    planes = None
    if frame.picture is not None:
        planes = [p.tobytes() for p in (frame.picture.luma, frame.picture.chroma_u, frame.picture.chroma_v)]
    return frame.index, frame.sensor_timestamp_ns, frame.lost_because, frame.color_range, planes


def test_a_sound_video_gives_the_same_pictures_side_by_side(video):
    seen_in, done = set(), []

    def work(frame):
        seen_in.add(threading.current_thread().name)
        return told(frame)

    assert work_on_frames(*video, work, progress=done.append) == [told(f) for f in decode_run_video(*video)]
    assert all(name.startswith("pictures") for name in seen_in)
    assert done == sorted(done)
    assert done[-1] == N


@pytest.mark.parametrize("seed", range(8))
def test_a_damaged_video_loses_the_same_frames_side_by_side(video, seed):
    """Pictures that are zeroed, cut short or overwritten, keyframes among them; the first one in one case."""
    path, frames = video
    draw = np.random.default_rng(seed)
    for i in draw.choice(N, 5, replace=False).tolist() + ([0] if seed == 0 else []):
        keep, rest = int(draw.integers(0, 60)), draw.integers(256)
        damage(path, frames, i, lambda b, k=keep, x=rest: (b[:k] + bytes([x]) * len(b))[: len(b)])
    in_order = [told(f) for f in decode_run_video(path, frames)]
    assert any(picture is None for *_, picture in in_order)
    assert work_on_frames(path, frames, told) == in_order


def test_parts_are_the_whole_and_grow_short(video):
    path, frames = video
    parts = independent_parts(path, frames, threads=2)
    assert [i for part in parts for i in part] == list(range(N))
    assert all(part.start % GOP == 0 for part in parts)
    lengths = [len(part) for part in parts]
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[0] == 12  # an eighth of the run
    assert lengths[-1] == GOP


def test_keyframes_that_need_what_was_before_begin_no_part(tmp_path, video):
    """An intra picture that is no IDR; a keyframe without its parameter sets; one that is not marked."""
    path = tmp_path / "scenes.h264"
    write_cut_scenes(path, refs=1)
    frames = frame_times(path)
    frames.keyframe[16] = True
    assert independent_parts(path, frames, threads=2) == [range(frames.n_frames)]

    path, frames = video
    data = path.read_bytes()
    bare = data.replace(b"\x00\x00\x01\x68", b"\x00\x00\x01\x6c")  # picture parameters, renamed to filler
    assert bare != data
    path.write_bytes(bare)
    assert independent_parts(path, frames, threads=2) == [range(N)]

    path.write_bytes(data)
    frames.keyframe[1:] = False
    assert independent_parts(path, frames, threads=2) == [range(N)]


def test_a_video_with_one_keyframe_is_decoded_in_order(tmp_path):
    path = tmp_path / "video.h264"
    write_video(path, 16, gop=16)
    frames = frame_times(path)
    here = threading.current_thread()

    def work(frame):
        assert threading.current_thread() is here
        return told(frame)

    done = []
    assert len(work_on_frames(path, frames, work, progress=done.append)) == 16
    assert done == list(range(1, 17))


def test_an_error_of_the_work_ends_it_all(video):
    before = threading.active_count()
    worked = []

    def work(frame):
        worked.append(frame.index)
        if frame.index == 9:
            raise VideoError("not this one")

    with pytest.raises(VideoError, match="not this one"):
        work_on_frames(*video, work)
    assert len(worked) < N
    assert threading.active_count() == before


def test_a_stop_from_the_keyboard_is_not_waited_out(video):
    """It reaches the thread that waits, here while it tells how far the work is."""
    worked = []

    def stopped(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work_on_frames(*video, lambda frame: worked.append(frame.index), progress=stopped)
    assert len(worked) < N


def test_b_pictures_and_missing_files_are_video_errors(tmp_path, video):
    path = tmp_path / "b.h264"
    write_video(path, 64, gop=8, options={"bf": "2", "b_strategy": "0"})
    frames = frame_times(path)
    assert len(independent_parts(path, frames, threads=2)) > 4
    with pytest.raises(VideoError, match=r"B pictures.*ffmpeg"):
        work_on_frames(path, frames, told)
    with pytest.raises(VideoError, match="No such file"):
        work_on_frames(tmp_path / "none.h264", video[1], told)
    (tmp_path / "empty.h264").touch()
    with pytest.raises(VideoError, match="empty"):
        work_on_frames(tmp_path / "empty.h264", video[1], told)
