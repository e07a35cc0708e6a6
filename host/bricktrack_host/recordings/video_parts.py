"""Parts of a run's video that can be decoded each on its own, side by side.

Frame threads of a decoder wait for each other: every picture is predicted from the one before. Where
prediction begins anew nothing is waited for, so a decoder of one thread for each part is quicker, and the
pictures are the same.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from threading import Event, local
from typing import BinaryIO, TypeVar, cast

import numpy as np
from av.video.codeccontext import VideoCodecContext

from bricktrack_common.errors import VideoError
from bricktrack_common.frame_times import FrameTimes
from bricktrack_host.recordings.annex_b import NAL_PPS, iter_nal_units
from bricktrack_host.recordings.h264_headers import PictureOrder
from bricktrack_host.recordings.video_frames import DecodedFrame, decode_run_video, open_decoder
from bricktrack_host.tracking.pictures.look_ahead import look_ahead

T = TypeVar("T")

_HEADER_BYTES = 4096  # more than parameter sets and an encoder's message take before a keyframe's first slice
_MOST_FRAMES = 60  # of a part: progress is told part by part
_SHARE = 4  # of what is left, a part takes one in so many for each thread: they end together


def work_on_frames(
    video: Path,
    frames: FrameTimes,
    work: Callable[[DecodedFrame], T],
    *,
    threads: int = 2,
    progress: Callable[[int], None] | None = None,
) -> list[T]:
    """Return what some work gives of each frame of a run, decoded or lost, in order.

    The work is done in the thread that decoded the picture, several at once, and may be of frames out of
    order; a video without enough places where prediction begins anew is decoded in order, and worked on by
    the caller's thread.

    Parameters
    ----------
    video, frames
        Of `video_frames.decode_run_video`.
    work : callable
        Gets a frame, whose picture is not to be kept.
    threads : int
        That decode.
    progress : callable, optional
        Called, by the caller's thread, with the number of frames done.

    Raises
    ------
    VideoError
        As `video_frames.decode_run_video` does. Of several errors, the work's among them, it is the one of
        the earliest part.
    """
    try:
        parts = independent_parts(video, frames, threads=threads)
    except OSError as e:
        raise VideoError(f"{video}: {e.strerror or e}") from e
    longest = max((len(part) for part in parts), default=0)
    if threads == 1 or longest > frames.n_frames / (2 * threads):
        return _one_after_the_other(video, frames, work, threads, progress)
    return _side_by_side(video, frames, parts, work, threads, progress)


def _one_after_the_other(
    video: Path,
    frames: FrameTimes,
    work: Callable[[DecodedFrame], T],
    threads: int,
    progress: Callable[[int], None] | None,
) -> list[T]:
    done: list[T] = []
    with closing(look_ahead(decode_run_video(video, frames, threads=threads))) as decoding:
        for frame in decoding:
            done.append(work(frame))
            if progress is not None:
                progress(len(done))
    return done


def _side_by_side(
    video: Path,
    frames: FrameTimes,
    parts: list[range],
    work: Callable[[DecodedFrame], T],
    threads: int,
    progress: Callable[[int], None] | None,
) -> list[T]:
    stop, own = Event(), local()

    def decoder_of_thread() -> VideoCodecContext:
        """Return one and the same for all parts of a thread: new memory for its pictures has its price."""
        if hasattr(own, "decoder"):
            own.decoder.flush_buffers()
        else:
            own.decoder = open_decoder(1)
        return cast(VideoCodecContext, own.decoder)

    def work_on(part: range) -> list[T]:
        done: list[T] = []
        with closing(decode_run_video(video, frames, part=part, decoder=decoder_of_thread())) as decoding:
            for frame in decoding:
                if stop.is_set():
                    break
                done.append(work(frame))
        return done

    done: list[T] = []
    with ThreadPoolExecutor(threads, "pictures") as pool:
        try:
            for worked in [pool.submit(work_on, part) for part in parts]:
                done += worked.result()
                if progress is not None:
                    progress(len(done))
        finally:  # an error, or Ctrl-C: the others need not go on
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
    return done


def independent_parts(video: Path, frames: FrameTimes, *, threads: int) -> list[range]:
    """Return a run's frames in parts which need nothing of each other to be decoded.

    A part begins with a keyframe whose bytes say that prediction begins anew and hold the parameter sets; the
    first begins with the run, whatever its first frame is. Towards the end they are short, so that several
    threads end at about the same time.
    """
    starts = [0] if frames.n_frames else []
    if frames.n_frames:
        with video.open("rb") as file:
            for i in np.flatnonzero(frames.keyframe).tolist():
                left = frames.n_frames - starts[-1]
                wanted = min(left / (_SHARE * threads), _MOST_FRAMES)
                if i - starts[-1] >= wanted and _begins_anew(file, frames, i):
                    starts.append(i)
    return [range(a, b) for a, b in zip(starts, [*starts[1:], frames.n_frames], strict=True)]


def _begins_anew(file: BinaryIO, frames: FrameTimes, i: int) -> bool:
    file.seek(int(frames.byte_offset[i]))
    head = file.read(min(int(frames.n_bytes[i]), _HEADER_BYTES))
    order, is_restart = PictureOrder().check(head)
    has_parameters = any(nal.nal_type == NAL_PPS for nal in iter_nal_units(head))
    return order == "follows" and is_restart and has_parameters
